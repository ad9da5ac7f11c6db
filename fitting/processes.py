"""Strands shared by the processes of `jax.distributed`, each of which then knows of all."""

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

Arrays = TypeVar("Arrays", bound=NamedTuple)


def shared(
    evaluate: Callable[[np.ndarray], Arrays], strands: np.ndarray, *, together: int
) -> Arrays:
    """evaluate(strands), of which every process evaluates its share.

    Arguments:
        evaluate: from places of strands to arrays whose first axis is theirs.
        strands: the same in all processes, which must all call.
        together: strands that are evaluated at once, all of them by one process. A program may
            round differently in each place (JAX 0.12), and so no strand's place may depend on the
            number of processes.
    """
    processes = jax.process_count()
    if processes == 1:
        return evaluate(strands)
    size = -(-len(strands) // (processes * together)) * together
    places = size * jax.process_index() + np.arange(size)
    found = evaluate(strands[np.minimum(places, len(strands) - 1)])  # the last share is filled up

    def of_all(x: np.ndarray) -> np.ndarray:
        # as bytes: JAX would make float32 of them
        raw = np.ascontiguousarray(x).view(np.uint8).reshape(size, -1)
        gathered = np.asarray(multihost_utils.process_allgather(raw, tiled=True))
        return gathered[: len(strands)].copy().view(x.dtype).reshape(-1, *x.shape[1:])

    return found._make(of_all(x) for x in found)
