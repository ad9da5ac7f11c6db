"""Strands in tiles that stay in a processor's cache, and in shares for several devices.

Strands that do not touch do not know of each other: all steps of one tile can be done before
those of the next. Effects say whether they allow it, `Effect.each_strand_alone`.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jaxhair import check
from jaxhair.effects import Effect
from jaxhair.kernels import LARGEST, used

if TYPE_CHECKING:
    from jaxhair.scene import Scene
    from jaxhair.simulate import Setup
    from jaxhair.strands import State

LANES = 16
"""Strands of a tile are a multiple of it, which fills vector registers."""

FEWEST, MOST, POINTS = 64, 128, 9600
"""Strands of a tile, and their points. More do not stay in cache; fewer waste time on starting
what XLA makes of a step. Measured: see `tests/benchmarks/devices.py`."""


def couples(effects: Iterable[Effect]) -> Effect | None:
    """The first effect that does not say of its own class that it works on each strand alone."""
    return next((e for e in effects if not vars(type(e)).get("each_strand_alone", False)), None)


def checked_devices(scene: "Scene", devices: int) -> int:
    """The number of devices to simulate a scene on.

    Raises ValueError for more than there are, for some of those of several processes but not all,
    and for several where an effect couples strands.
    """
    check.whole("devices", devices, least=1)
    there = jax.devices()
    if devices > len(there):
        more = 'jax.config.update("jax_num_cpu_devices", n) before JAX computes anything gives n'
        raise ValueError(
            f"devices is {devices}; it must be at most {len(there)}, which JAX has"
            + (f" ({more})" if there[0].platform == "cpu" else "")
        )
    if jax.process_count() > 1 and devices not in (1, len(there)):
        raise ValueError(
            f"devices is {devices}; with {jax.process_count()} processes it must be 1, each "
            f"process's own, or {len(there)}, those of all"
        )
    for phase in scene.phases if devices > 1 else ():
        if (effect := couples(phase.effects)) is not None:
            raise ValueError(
                f"devices is {devices}; it must be 1, because phase {phase.name!r} has a "
                f"{type(effect).__name__}, which may couple strands (each_strand_alone is False)"
            )
    return devices


def tiling(strands: int, points: int, numbers: int = 0) -> tuple[int, int]:
    """How many tiles, and strands in each, of which the last repeats some.

    One where the largest arrays, of remembered shapes, fit into one kernel, and where a tile's
    strands would be too few because they are long.

    numbers: of a point in the largest array of a solver's kernels, which take 1.5 to 3 times as
        long where they do not fit; 0 where there are no kernels.
    """
    most, fewest = POINTS // points // LANES * LANES, FEWEST
    if numbers and (fitting := LARGEST // (numbers * points) // LANES * LANES):
        most, fewest = fitting, LANES
    most = min(most, MOST)
    if strands * 12 * points <= LARGEST or strands <= most or most < fewest:
        return 1, strands
    tiles = -(-strands // most)
    return tiles, -(-strands // (LANES * tiles)) * LANES


def in_shares(
    advanced: Callable[..., "State"], setup: "Setup", state: "State", *shared: Array
) -> "State":
    """advanced(setup, state, *shared), on the setup's devices, on a CPU by tiles.

    Arrays whose last axis has the strands' number are cut there: all of the state's, and those
    of rod, effects and solver that have a value for each strand. The last tile and device repeat
    the last strand. As a whole where an effect couples strands. Where several processes share
    the devices, each gets all that was computed.
    """
    arguments = setup, state, *shared
    if couples(setup.effects) is not None:
        return advanced(*arguments)
    strands = state.positions.shape[-1]
    processes, devices = jax.process_count(), setup.devices
    if processes == 1:  # of several, all must take part
        devices = min(devices, -(-strands // LANES))
    if devices == 1:
        return _by_tiles(advanced, setup, state, *shared)
    leaves, tree, own = _flat(arguments, strands)
    size = -(-strands // devices) * devices

    def share(*leaves: Array) -> "State":
        return _by_tiles(advanced, *jax.tree.unflatten(tree, leaves))

    mesh = Mesh(np.array(jax.devices()[:devices]), ("strands",))
    found = jax.shard_map(
        share,
        mesh=mesh,
        in_specs=tuple(_cut_last(x, cut) for x, cut in zip(leaves, own, strict=True)),
        out_specs=jax.tree.map(lambda x: _cut_last(x, True), state),
        check_vma=False,
    )(*(_padded(x, size) if cut else x for x, cut in zip(leaves, own, strict=True)))
    found = jax.tree.map(lambda x: x[..., :strands], found)
    if processes > 1:
        found = lax.with_sharding_constraint(found, NamedSharding(mesh, PartitionSpec()))  # type: ignore[no-untyped-call]
    return found


def _cut_last(x: Any, cut: bool) -> Any:
    """How an array lies on the devices: cut along its last axis, or whole on each."""
    axes = [None] * (np.ndim(x) - 1) + ["strands"] if cut else []
    return PartitionSpec(*axes)  # type: ignore[no-untyped-call]


def _flat(arguments: Any, strands: int) -> tuple[list[Any], Any, list[bool]]:
    """Leaves, their structure, and which of them have strands on their last axis."""
    leaves, tree = jax.tree.flatten(arguments)
    return leaves, tree, [np.shape(x)[-1:] == (strands,) for x in leaves]


def _by_tiles(
    advanced: Callable[..., "State"], setup: "Setup", state: "State", *shared: Array
) -> "State":
    points, _, strands = state.positions.shape
    tiles, lanes = tiling(strands, points, setup.solver.numbers if used() else 0)
    if tiles == 1 or jax.default_backend() != "cpu":
        return advanced(setup, state, *shared)
    leaves, tree, own = _flat((setup, state, *shared), strands)

    def one(tile: Sequence[Array]) -> "State":
        parts = iter(tile)
        each = [next(parts) if cut else x for x, cut in zip(leaves, own, strict=True)]
        return advanced(*jax.tree.unflatten(tree, each))

    size = tiles * lanes
    cut = [_cut(_padded(x, size), tiles) for x, cut in zip(leaves, own, strict=True) if cut]
    return jax.tree.map(lambda x: _joined(x)[..., :strands], lax.map(one, cut))


def _padded(x: Array, size: int) -> Array:
    """x with its last strand repeated."""
    if (missing := size - x.shape[-1]) == 0:
        return x
    return jnp.concatenate([x, jnp.broadcast_to(x[..., -1:], (*x.shape[:-1], missing))], axis=-1)


def _cut(x: Array, tiles: int) -> Array:
    """(..., strands) to (tiles, ..., lanes)."""
    return jnp.moveaxis(x.reshape(*x.shape[:-1], tiles, -1), -2, 0)


def _joined(x: Array) -> Array:
    """(tiles, ..., lanes) to (..., strands)."""
    x = jnp.moveaxis(x, 0, -2)
    return x.reshape(*x.shape[:-2], -1)
