"""What hair should look like: curls given by numbers, or strands."""

from abc import abstractmethod
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import Curves, State, check, pytree
from jaxhair.pytree import static
from jaxhair.strands import strands_last

MM = 1e3
"""Millimetres in a metre."""


class Target:
    """What is wanted of a scene's strands at the end of a phase.

    error: standard error of every residual, in the residuals' unit; None where they are points
        whose error is that of the whole fit.
    """

    error: Any

    @abstractmethod
    def residuals(self, state: State, lengths: Array) -> Array:
        """Simulated numbers less wanted ones, of any shape.

        Arguments:
            lengths: rest lengths of the scene's edges [m], shape (points - 1, 1, strands or 1).
        """


class PointTarget(Target):
    """The wanted points of a scene's strands."""

    align: bool

    @abstractmethod
    def points(self, lengths: Array, strands: int) -> Array:
        """Wanted points [m], shape (points, 3, strands).

        Arguments:
            lengths: rest lengths of the scene's edges [m], shape (points - 1, 1, strands or 1).
        """

    def residuals(self, state: State, lengths: Array) -> Array:
        """Simulated points less wanted ones [m], shape (points, 3, strands).

        With `align`, each strand is first moved rigidly to where it fits best.
        """
        simulated = state.positions
        wanted = self.points(lengths, simulated.shape[-1]).astype(simulated.dtype)
        if not self.align:
            return simulated - wanted
        per_strand = jax.vmap(aligned_residuals, in_axes=-1, out_axes=-1)
        return per_strand(simulated, wanted)


@pytree
class Helix(PointTarget):
    """A regular curl, the same for all strands, in any position.

    Arguments:
        diameter: [m]. pitch: rise in a turn [m], 0 or more.
        length: of hair [m]; where the scene's strands are longer the curl goes on.
        handedness: "right" or "left".
        error: standard error of a point's coordinates [m]; None is the fit's.
    """

    diameter: Any
    pitch: Any = 0.0
    length: Any = None
    handedness: str = static(default="right")
    align: bool = static(default=True)
    error: Any = None

    def __post_init__(self) -> None:
        check.positive("helix.diameter", self.diameter)
        check.not_negative("helix.pitch", self.pitch)
        if self.length is not None:
            check.positive("helix.length", self.length)
        check.choice("helix.handedness", self.handedness, ("right", "left"))
        check.flag("helix.align", self.align)
        if self.error is not None:
            check.positive("helix.error", self.error)

    def points(self, lengths: Array, strands: int) -> Array:
        """Points on the helix, apart by the rest lengths measured straight, as a strand's are.

        With the climb a, tan(a) = pitch / (pi D), an edge l turns by phi, D sin(phi / 2) =
        l cos(a), and rises by l sin(a).
        """
        diameter = jnp.asarray(self.diameter, lengths.dtype)
        climb = jnp.arctan2(jnp.asarray(self.pitch, lengths.dtype), jnp.pi * diameter)
        edges = jnp.broadcast_to(lengths[:, 0], (lengths.shape[0], strands))
        edges = jnp.concatenate([jnp.zeros_like(edges[:1]), edges])
        turn = 2 * jnp.arcsin(jnp.clip(edges * jnp.cos(climb) / diameter, 0, 0.999))
        angle, rise = jnp.cumsum(turn, axis=0), jnp.cumsum(edges * jnp.sin(climb), axis=0)
        side = 1 if self.handedness == "right" else -1
        radius = diameter / 2
        return jnp.stack([radius * jnp.cos(angle), side * radius * jnp.sin(angle), rise], axis=1)


def helix(**options: Any) -> Helix:
    """A curl by its diameter [m], and if wanted pitch [m], length [m] and handedness."""
    return Helix(**options)


@pytree
class Shape(PointTarget):
    """Given strands.

    Arguments:
        strands: points [m], shape (strands, points, 3), as many as in the scene; see `resampled`.
        align: compare shapes only, moving each strand rigidly to where it fits best.
        error: standard error of a point's coordinates [m]; None is the fit's.
    """

    strands: Any
    align: bool = static(default=False)
    error: Any = None

    def __post_init__(self) -> None:
        check.shape("target.strands", self.strands, ("strands", "points", 3))
        check.finite("target.strands", self.strands)
        check.flag("target.align", self.align)
        if self.error is not None:
            check.positive("target.error", self.error)

    def points(self, lengths: Array, strands: int) -> Array:
        """The given points."""
        wanted = (strands, lengths.shape[0] + 1, 3)
        check.shape("target.strands", self.strands, wanted)
        return strands_last(self.strands)


def resampled(points: Any, counts: Any, size: int) -> np.ndarray:
    """Strands with `size` points at equal steps of arc length.

    Arguments:
        points: [m], shape (strands, points, 3). counts: of each strand's points, shape (strands,).
    Returns shape (strands, size, 3). Raises ValueError for a strand without length.
    """
    check.whole("size", size, least=2)
    curves = Curves(points, counts)
    check.finite("points", curves.points)
    out = np.empty((len(curves.counts), size, 3))
    for i, x in enumerate(curves.to_list()):
        along = np.concatenate([[0.0], np.linalg.norm(np.diff(x, axis=0), axis=1).cumsum()])
        if along[-1] < check.SMALLEST:
            raise ValueError(f"strand {i} has length {along[-1]}; it must be above 0")
        wanted = np.linspace(0, along[-1], size)
        out[i] = np.stack([np.interp(wanted, along, x[:, axis]) for axis in range(3)], 1)
    return out


def aligned_residuals(points: Array, wanted: Array) -> Array:
    """Residuals of one strand after the rigid motion that makes their squares least (Kabsch).

    points and wanted: shape (points, 3). The motion itself is not differentiated. Its first-order
    response is instead removed from the derivative by projection, which is exact for small
    residuals, and gives the exact gradient of the sum of squares for any.
    """
    x = points - jnp.mean(points, axis=0, keepdims=True)
    y = lax.stop_gradient(wanted - jnp.mean(wanted, axis=0, keepdims=True))
    u, _, vt = jnp.linalg.svd(lax.stop_gradient(x).T @ y)
    reflect = jnp.linalg.det(u @ vt)
    rotation = (u * jnp.stack([jnp.ones_like(reflect), jnp.ones_like(reflect), reflect])[None]) @ vt
    moved = x @ lax.stop_gradient(rotation)
    modes = lax.stop_gradient(_rigid_modes(lax.stop_gradient(moved)))
    residual = moved - y
    change = (residual - lax.stop_gradient(residual)).ravel()
    return residual - (modes @ (modes.T @ change)).reshape(residual.shape)


def _rigid_modes(x: Array) -> Array:
    """Orthonormal displacements of a strand that turn it, shape (3 points, 3); x is centred.

    A straight strand cannot be turned about itself: that mode is 0.
    """
    turns = jnp.stack([jnp.cross(axis, x).ravel() for axis in jnp.eye(3, dtype=x.dtype)], axis=1)
    u, s, _ = jnp.linalg.svd(turns, full_matrices=False)
    return u * (s > 1e-4 * s[:1])[None].astype(x.dtype)
