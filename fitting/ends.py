"""Where many strands are at the ends of phases: simulated a tile at a time, without derivatives."""

from collections.abc import Callable, Iterator
from functools import partial

import jax
import numpy as np
from jax import Array

from fitting.tiles import TILE, has_strands
from jaxhair import Scene, named_leaves, run


@partial(jax.jit, static_argnames="states")
def _ends(scene: Scene, states: tuple[str, ...]) -> dict[str, Array]:
    ends = run(scene)
    return {state: ends[state].points for state in states}


def in_tiles(
    scene: Scene, states: tuple[str, ...], tile: int = TILE
) -> Iterator[tuple[slice, dict[str, np.ndarray]]]:
    """Strands simulated a tile at a time, of one size, so that all tiles share a program.

    Yields the places of a tile's strands, and of each phase named their points [m] at its end,
    shape (strands of the tile, points, 3).
    """
    count, some = scene.strands.count, _some(scene, tile)
    for first in range(0, count, tile):
        last = min(first + tile, count)
        ends = _ends(some(first), states)
        yield slice(first, last), {n: np.asarray(x)[: last - first] for n, x in ends.items()}


def program(scene: Scene, states: tuple[str, ...], tile: int = TILE) -> str:
    """The compiled program of `in_tiles`, as text."""
    return str(_ends.lower(_some(scene, tile)(0), states).as_text())


def _some(scene: Scene, tile: int) -> Callable[[int], Scene]:
    """Gives the tile of strands from a place on; the scene's last strand fills up the last one."""
    scene, count = scene.as_arrays(), scene.strands.count
    leaves, structure = jax.tree.flatten(scene)
    own = [has_strands(n, x, count) for n, x in zip(named_leaves(scene), leaves, strict=True)]

    def some(first: int) -> Scene:
        at = np.minimum(np.arange(first, first + tile), count - 1)
        parts = [x[at] if each else x for x, each in zip(leaves, own, strict=True)]
        return jax.tree.unflatten(structure, parts)

    return some
