"""How long a user waits for a picture: python tests/benchmarks/first_frame.py

From the command to the file with the first frame of each of the paper's scenes, in a process of its
own: with an empty folder of compiled programs, and again.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jaxhair as jh


def wait(scene: str, folder: Path, name: str) -> float:
    """Seconds until the command has written a scene's first frame."""
    output = folder / f"{scene}-{name}.npz"
    command = [sys.executable, "-m", "jaxhair", "simulate", scene, "--seconds", "0.033", "--quiet"]
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(folder / scene),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "TF_CPP_MIN_LOG_LEVEL": "3",
    }
    begin = time.perf_counter()
    subprocess.run([*command, "--output", str(output)], env=environment, check=True)
    return time.perf_counter() - begin


def main() -> None:
    for scene in jh.scenes.SCENES:
        with tempfile.TemporaryDirectory() as folder:
            first, second = (wait(scene, Path(folder), n) for n in ("first", "second"))
        print(f"{scene}: first {first:.1f} s, with the cache {second:.1f} s", flush=True)


if __name__ == "__main__":
    main()
