"""All tests run with strict dtypes and ranks; float64 is on, so that both precisions can run."""

import os

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tests that read a movie back start a program; by default that forks Python beside JAX's threads.
os.environ["IMAGEIO_FFMPEG_NO_PREVENT_SIGINT"] = "1"
