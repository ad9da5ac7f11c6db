"""Strands simulated in tiles, with the derivatives in numbers that each has of its own."""

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fitting.constraints import Constraint
from fitting.parameters import OWN_AXES, check_alike, check_free, unknown
from fitting.processes import shared
from fitting.targets import MM, Shape, Target
from jaxhair import Scene, check, named_leaves, run
from jaxhair.scene import matching
from jaxhair.strands import strands_last

TILE = 64
"""Strands simulated together: the fastest of `tests/benchmarks/many_strands.py`."""


@dataclass(frozen=True)
class Freed:
    """Numbers that every strand has its own of.

    leaves: their places among the scene's leaves. start: shape (strands, ...). column: the leaf is
    one number of an effect, which is put as (1, 1, strands).
    """

    name: str
    constraint: Constraint
    leaves: tuple[int, ...]
    start: np.ndarray
    column: bool
    size: int


def freed(scene: Scene, free: Mapping[str, Constraint]) -> tuple[Freed, ...]:
    """What `fit_each` frees. Raises ValueError for leaves that cannot be freed so."""
    check_free(free)
    leaves = named_leaves(scene)
    names = list(leaves)
    found: list[Freed] = []
    for name, constraint in free.items():
        shown = check.short(name)
        matches = matching(name, names)
        if not matches:
            raise unknown(name, names)
        starts = [_start(scene, n, leaves[n]) for n in matches]
        check_alike(name, starts)
        places = tuple(names.index(n) for n in matches)
        if any(set(places) & set(p.leaves) for p in found):
            raise ValueError(f"free names {shown}, of which a leaf is named twice")
        try:
            size = np.asarray(constraint.free(starts[0][0])).size
        except ValueError as error:
            raise ValueError(f"free names {shown}, whose {error}") from error
        column = matches[0].startswith(("phases.", "solver."))
        found.append(Freed(name, constraint, places, starts[0], column, size))
    return tuple(found)


def _start(scene: Scene, name: str, leaf: Any) -> np.ndarray:
    """The value of a leaf for each strand."""
    value, count = np.asarray(leaf, float), scene.strands.count
    of_strands = name.startswith("strands.")
    if value.ndim == OWN_AXES.get(name, 0) and not of_strands:
        return np.broadcast_to(value, (count, *value.shape)).copy()
    if not name.startswith(("strands.", "bonds.", "fibre.")) or len(value) not in (1, count):
        wanted = "it must be of the fibre, the bonds or the strands, or a single number"
        raise ValueError(f"free names {name!r}, which cannot differ between strands; {wanted}")
    return np.broadcast_to(value, (count, *value.shape[1:])).copy()


def numbers(p: Freed) -> np.ndarray:
    """Free numbers to start from, shape (strands, free numbers)."""
    try:
        return np.stack([np.ravel(p.constraint.free(value)) for value in p.start])
    except ValueError as error:
        raise ValueError(f"free names {check.short(p.name)}, whose {error}") from error


def values_and_errors(
    p: Freed, x_found: np.ndarray, covariance: np.ndarray, dtype: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Values and their standard errors, of shape (strands, ...).

    Arguments:
        x_found: free numbers, shape (strands, n). covariance: theirs, shape (strands, n, n).
    """
    x, start = jnp.asarray(x_found, dtype), jnp.asarray(p.start, dtype)

    def value(x: Array, start: Any) -> Array:
        return p.constraint.value(x, start).reshape(start.shape)

    derivative = np.asarray(jax.vmap(jax.jacfwd(value))(x, start), float)
    d = derivative.reshape(len(x_found), -1, p.size)
    variance = np.einsum("svi,sij,svj->sv", d, covariance, d)
    return np.asarray(jax.vmap(value)(x, start), float), np.sqrt(variance).reshape(p.start.shape)


class Squares(NamedTuple):
    """Of each strand |r|^2, J' r and J' J, in standard errors, and its residual [mm]."""

    square: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray
    residual_mm: np.ndarray

    @property
    def finite(self) -> np.ndarray:
        """True where all sums of a strand are finite."""
        return np.isfinite(self.square) & np.isfinite(self.curvature).all(axis=(1, 2))


class Tiles:
    """Squares of the residuals and their derivatives, as functions of the strands' free numbers.

    residuals: number of them a strand.
    """

    def __init__(
        self,
        scene: Scene,
        targets: dict[str, Target],
        parameters: tuple[Freed, ...],
        noise_mm: float,
        tile: int,
    ) -> None:
        self.scene, self.parameters = scene.as_arrays(), parameters
        self.targets = targets
        self.tile = min(tile, scene.strands.count)
        leaves, self.structure = jax.tree.flatten(self.scene)
        names = list(named_leaves(self.scene))
        freed = {place for p in parameters for place in p.leaves}
        of_strands = {
            i: np.asarray(leaf)
            for i, (name, leaf) in enumerate(zip(names, leaves, strict=True))
            if i not in freed and has_strands(name, leaf, scene.strands.count)
        }
        self.shared = {i: x for i, x in enumerate(leaves) if i not in of_strands}
        shapes = {n: t.strands for n, t in targets.items() if isinstance(t, Shape)}
        # everything of which each strand has its own, with the strands first
        self.own: Any = jax.tree.map(
            lambda x: np.asarray(x, self.scene.dtype),
            {"leaves": of_strands, "shapes": shapes, "starts": [p.start for p in parameters]},
        )
        self.devices = jax.local_devices()
        self._evaluate = jax.jit(self._residuals_and_jacobian)
        self.weights = MM / noise_mm * np.concatenate(self._sizes(noise_mm))
        self.residuals = self.weights.size

    def program(self) -> str:
        """The compiled program, as text."""
        x = np.zeros((sum(p.size for p in self.parameters), self.tile), self.scene.dtype)
        return str(self._evaluate.lower(x, self._tile(np.arange(self.tile))).as_text())

    def _sizes(self, noise_mm: float) -> list[np.ndarray]:
        """Of each target noise_mm over its own error, as often as it has residuals a strand.

        Finds out, without computing, whether all leaves take a value for each strand.
        """
        first = np.arange(self.tile)
        size = sum(p.size for p in self.parameters)
        x = np.zeros((size, self.tile), self.scene.dtype)
        try:
            with jax.numpy_rank_promotion("raise"):  # where a leaf is no column, shapes get wrong
                shapes = jax.eval_shape(self._simulated, x, self._tile(first))
        except (TypeError, ValueError) as error:
            columns = [p.name for p in self.parameters if p.column]
            if not columns:
                raise
            shown = check.listed(columns)
            raise ValueError(f"free names {shown}, which cannot differ between strands") from error
        sizes = []
        wanted = (self.scene.strands.points, 3, self.tile)
        for name, target in self.targets.items():
            if shapes[name].shape != wanted:
                raise ValueError(
                    f"targets[{name!r}] has residuals of shape {shapes[name].shape}; a target of "
                    "each strand must want points, as Shape and Helix do"
                )
            noise = getattr(target, "error", None)
            share = 1.0 if noise is None else noise_mm / (MM * float(noise))
            sizes.append(np.full(wanted[0] * 3, share))
        return sizes

    def _tile(self, strands: np.ndarray) -> Any:
        return jax.tree.map(lambda x: x[strands], self.own)

    def _simulated(self, x: Array, own: Any) -> dict[str, Array]:
        """Residuals [m] of each target, shape (points, 3, strands), for x (numbers, strands)."""
        leaves, begin = {**self.shared, **own["leaves"]}, 0
        for p, start in zip(self.parameters, own["starts"], strict=True):
            value = jax.vmap(p.constraint.value)(x[begin : begin + p.size].T, start)
            value = value.astype(x.dtype).reshape(start.shape)
            begin += p.size
            for place in p.leaves:
                leaves[place] = value.reshape(1, 1, -1) if p.column else value
        scene = jax.tree.unflatten(self.structure, [leaves[i] for i in range(len(leaves))])
        ends = run(scene)
        lengths = strands_last(scene.strands.lengths)[:, None]
        found = {}
        for name, target in self.targets.items():
            if isinstance(target, Shape):
                target = replace(target, strands=own["shapes"][name])
            found[name] = target.residuals(ends[name], lengths)
        return found

    def _residuals_and_jacobian(self, x: Array, own: Any) -> tuple[Array, Array]:
        """Residuals [m], shape (m, strands), and their derivatives, shape (n, m, strands)."""

        def residuals(x: Array) -> Array:
            parts = self._simulated(x, own).values()
            return jnp.concatenate([r.reshape(-1, r.shape[-1]) for r in parts])

        def along(direction: Array) -> tuple[Array, Array]:
            change = jnp.broadcast_to(direction[:, None], x.shape)
            return jax.jvp(residuals, (x,), (change,))

        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(x.shape[0], dtype=x.dtype))

    def _tiles(self, x: np.ndarray, strands: np.ndarray) -> Iterator[tuple[slice, Any]]:
        """Places of each tile's strands, and what was simulated; a few tiles are under way."""
        waiting: deque[tuple[slice, Any]] = deque()
        for number, first in enumerate(range(0, len(strands), self.tile)):
            places = slice(first, min(first + self.tile, len(strands)))
            few = np.arange(first, first + self.tile)
            few = np.minimum(few, len(strands) - 1)  # the last strand fills up the last tile
            inputs = np.ascontiguousarray(x[few].T, self.scene.dtype), self._tile(strands[few])
            device = self.devices[number % len(self.devices)]
            waiting.append((places, self._evaluate(*jax.device_put(inputs, device))))
            if len(waiting) > 2 * len(self.devices):
                yield waiting.popleft()
        yield from waiting

    def evaluate(self, x: np.ndarray, strands: np.ndarray) -> "Squares":
        """Sums over the residuals of the named strands, in float64.

        Arguments:
            x: free numbers, shape (strands, n). strands: their places in the scene.
        """
        places = np.arange(len(strands))
        return shared(lambda few: self._evaluated(x[few], strands[few]), places, together=self.tile)

    def _evaluated(self, x: np.ndarray, strands: np.ndarray) -> "Squares":
        """`evaluate` for a process's share.

        The products are made here: in float32 they would lose what the data hardly determine.
        """
        n, count = x.shape[1], len(strands)
        square, slope, curvature = np.empty(count), np.empty((count, n)), np.empty((count, n, n))
        residual = np.empty(count)
        with np.errstate(all="ignore"):
            for places, arrays in self._tiles(x, strands):
                size = places.stop - places.start
                raw, jacobian = (np.asarray(a, float)[..., :size] for a in arrays)
                residual[places] = MM * np.sqrt(3 * np.mean(raw**2, axis=0))
                r = (raw * self.weights[:, None]).T[..., None]
                j = np.moveaxis(jacobian * self.weights[:, None], -1, 0)
                square[places] = (r**2).sum(axis=(1, 2))
                slope[places] = (j @ r)[..., 0]
                curvature[places] = j @ np.swapaxes(j, 1, 2)
        return Squares(square, slope, curvature, residual)


def has_strands(name: str, leaf: Any, strands: int) -> bool:
    """Whether a leaf's first axis is that of the strands."""
    if name.startswith("strands."):
        return len(leaf) == strands
    own = OWN_AXES.get(name, 0)
    return name.startswith(("bonds.", "fibre.")) and leaf.ndim > own and len(leaf) == strands
