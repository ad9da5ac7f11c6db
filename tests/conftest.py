"""All tests run with strict dtypes and ranks; float64 is on, so that both precisions can run."""

import os
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

# Tests that read a movie back start a program; by default that forks Python beside JAX's threads.
os.environ["IMAGEIO_FFMPEG_NO_PREVENT_SIGINT"] = "1"

MAPS = Path("/proc/self/maps")  # of Linux
MOST_MAPS = 45_000


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Keeps the tests of a file in one process, where they share compiled programs."""
    for item in items:
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


def pytest_collection_finish(session: pytest.Session) -> None:
    """Refuses versions of pytest and xdist that ignore groups: all takes twice as long then."""
    in_groups = session.config.getoption("dist", None) == "loadgroup"
    if in_groups and "PYTEST_XDIST_WORKER" in os.environ:
        alone = [item.nodeid for item in session.items if "@" not in item.nodeid]
        if alone:
            raise pytest.UsageError(f"--dist loadgroup left {alone[0]} in no group")


def pytest_runtest_teardown() -> None:
    """Forgets compiled programs when there are many: a process may have 65,530 pieces of memory
    mapped, each program has hundreds, and one too many kills the process."""
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
