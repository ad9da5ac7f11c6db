"""Programs compiled side by side, before they are called."""

import os
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import jax
import numpy as np


def compile_together(program: Any, calls: Iterable[tuple[Any, ...]]) -> None:
    """Compiles what some calls of a function need, so that the calls find it compiled.

    A compiler works on one core for most of the time, and a scene has several phases. With one
    program to compile nothing is done: its call does it as well.

    Arguments:
        program: a function made by `jax.jit`.
        calls: the arguments of each.

    Errors of the compiler are left to the calls.
    """
    different = {_shared(arguments): arguments for arguments in calls}
    if len(different) < 2:
        return
    pool = ThreadPoolExecutor(min(len(different), os.cpu_count() or 1), "compiling")
    try:  # tracing needs Python's lock, so that it gains nothing from a thread
        traced = (program.lower(*arguments) for arguments in different.values())
        wait([pool.submit(one.compile) for one in traced])
    finally:  # also after Ctrl-C
        pool.shutdown(wait=False, cancel_futures=True)


def _shared(arguments: tuple[Any, ...]) -> Any:
    """What calls that share a program have in common."""
    leaves, structure = jax.tree.flatten(arguments)
    kinds = (x if callable(x) else (np.shape(x), jax.dtypes.result_type(x)) for x in leaves)
    return structure, tuple(kinds)
