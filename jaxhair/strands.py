"""Strands of hair: their geometry as a user gives it, and their state during a simulation.

A user's arrays have the strands first: (strands, points, 3). Inside, a `State` has them last,
(points, 3, strands), which makes a step 4 to 5 times faster: neighbouring strands then fill the
lanes of the processor's vector registers.
"""

from contextlib import suppress
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import check
from jaxhair import quaternion as quat
from jaxhair.pytree import pytree, static

BONDS = ("hydrogen", "ionic", "disulfide", "peptide")
"""The kinds of side-chain bonds, in the order of every array that has an axis of bonds."""

DTYPES = ("float32", "float64")
"""In which a simulation computes."""

MOST_POINTS = 10**8
"""Of all strands that are made together: 2.4 GB."""


def strands_last(x: Any) -> Array:
    """(strands, ...) to (..., strands)."""
    return jnp.moveaxis(jnp.asarray(x), 0, -1)


def strands_first(x: Any) -> Array:
    """(..., strands) to (strands, ...)."""
    return jnp.moveaxis(x, -1, 0)


def per_strand(x: Any) -> Array:
    """A number, or one for each strand, as an array of shape (1, 1, strands or 1)."""
    return jnp.reshape(jnp.asarray(x), (1, 1, -1))


def column(vector: Any, like: Array) -> Array:
    """A 3-vector in shape (1, 3, 1) and the dtype of an array of shape (points, 3, strands)."""
    return jnp.reshape(jnp.asarray(vector, like.dtype), (1, 3, 1))


@pytree
class Strands:
    """The strands of a scene as they start and as they want to be.

    A strand has points and, between them, edges. The frame of an edge is a unit quaternion q
    (w x y z) whose R(q) e3 points along the edge, from root to tip. `natural_shape` is the vector
    part of conj(q_i) q_(i+1), half the sine of the bend and twist from an edge to the next: what
    all bonds remember before any treatment. Make one with `from_points`
    or `straight`.

    Arguments:
        positions: points [m], shape (strands, points, 3); at least two points.
        orientations: frames of the edges, unit quaternions, shape (strands, points - 1, 4).
        lengths: rest lengths of the edges [m], shape (strands, points - 1), or
            (1, points - 1) where all strands share them.
        natural_shape: shape (strands, points - 2, 3), norm at most 1.
        ragged: strands have different numbers of points. A missing edge has rest length 0.

    Raises ValueError where a shape, a length, a quaternion or a natural shape is not as above.
    """

    positions: Any
    orientations: Any
    lengths: Any
    natural_shape: Any
    ragged: bool = static(default=False)

    def __post_init__(self) -> None:
        check.shape("strands.positions", self.positions, ("strands", "points", 3))
        strands, points, _ = np.shape(self.positions)
        if points < 2:
            raise ValueError(
                f"strands.positions has {points} point a strand; it must have 2 or more"
            )
        check.finite("strands.positions", self.positions)
        dtype = str(jnp.asarray(self.positions).dtype)
        if dtype not in DTYPES:
            wanted = f"it must be one of {check.listed(DTYPES)}"
            raise ValueError(f"strands.positions is of dtype {dtype}; {wanted}")
        check.shape("strands.orientations", self.orientations, (strands, points - 1, 4))
        check.finite("strands.orientations", self.orientations)
        check.flag("strands.ragged", self.ragged)
        rows = 1 if check.size("strands.lengths", self.lengths)[:1] == (1,) else strands
        check.shape("strands.lengths", self.lengths, (rows, points - 1))
        if self.ragged:
            check.not_negative("strands.lengths", self.lengths, many=True)
            self._check_missing_edges()
        else:
            check.positive("strands.lengths", self.lengths, many=True)
        check.shape("strands.natural_shape", self.natural_shape, (strands, points - 2, 3))
        check.finite("strands.natural_shape", self.natural_shape)
        self._check_norms()

    def _check_norms(self) -> None:
        q = check.known(self.orientations)
        if q is not None and np.any(np.abs(np.linalg.norm(q, axis=-1) - 1) > 1e-3):
            worst = np.linalg.norm(q, axis=-1).ravel()
            worst = worst[np.argmax(np.abs(worst - 1))]
            raise ValueError(f"strands.orientations has a norm of {worst}; it must be 1")
        shape = check.known(self.natural_shape)
        if shape is not None and shape.size:
            norm = np.linalg.norm(shape, axis=-1).max()
            if norm > 1 + 1e-6:
                raise ValueError(
                    f"strands.natural_shape has a norm of {norm}; it must be at most 1"
                )

    def _check_missing_edges(self) -> None:
        """Edges are missing at the tip only, and never all."""
        lengths = check.known(self.lengths)
        if lengths is None:
            return
        exists = lengths > 0
        wrong = ~exists
        wrong[:, 1:] &= exists[:, 1:].any(axis=1, keepdims=True) & (
            exists[:, ::-1].cumsum(axis=1)[:, ::-1][:, 1:] > 0
        )
        if wrong.any():
            place = tuple(int(i) for i in np.argwhere(wrong)[0])
            raise ValueError(
                f"strands.lengths has the value {lengths[place]} at {place}; it must be above 0 up "
                "to a strand's last edge"
            )

    @property
    def count(self) -> int:
        """Number of strands."""
        return int(np.shape(self.positions)[0])

    @property
    def points(self) -> int:
        """Number of points of the longest strand."""
        return int(np.shape(self.positions)[1])

    @property
    def counts(self) -> np.ndarray:
        """Number of points of each strand, shape (strands,). Needs known lengths."""
        edges = (np.asarray(self.lengths) > 0).sum(axis=1)
        return np.asarray(np.broadcast_to(edges + 1, (self.count,)))

    @staticmethod
    def from_points(points: Any, *, counts: Any = None) -> "Strands":
        """Strands through given points, which are also their natural shape.

        The frames are carried along without twist (parallel transport) from the root, whose frame
        is the shortest rotation from e3 to the first edge.

        Arguments:
            points: [m], shape (strands, points, 3). Float32 or float64 is kept.
            counts: points of each strand where they differ, shape (strands,); what stands
                behind a strand's last point is ignored.

        Raises ValueError for a wrong shape, a value that is not finite, a count outside
        [2, points] or two neighbouring points that coincide.
        """
        check.shape("points", points, ("strands", "points", 3))
        check.finite("points", points)
        positions = jnp.asarray(points)
        if str(positions.dtype) not in DTYPES:
            positions = positions.astype(jnp.zeros(()).dtype)
        strands, size, _ = positions.shape
        if size < 2:
            raise ValueError(f"points has {size} point a strand; it must have 2 or more")
        ragged, exists, last = counts is not None, None, None
        if ragged:
            check.shape("counts", counts, (strands,))
            n = np.asarray(None if isinstance(counts, jax.core.Tracer) else counts)
            if n.dtype.kind not in "iu" or np.any((n < 2) | (n > size)):
                wanted = f"each must be a whole number in [2, {size}]"
                raise ValueError(f"counts is {check.short(n)}; {wanted}")
            last = np.asarray(n - 1, np.int32)
            exists = (np.arange(size - 1)[:, None] < last)[:, None]
        positions, q, lengths, shape = _framed(positions, last)
        _check_apart(strands_last(lengths)[:, None], exists)
        return Strands(positions, q, lengths, shape, ragged)

    @staticmethod
    def straight(
        roots: Any, directions: Any, *, length: float, points: int, dtype: Any = None
    ) -> "Strands":
        """Straight strands of equal length.

        Arguments:
            roots: first points [m], shape (strands, 3).
            directions: from root to tip, shape (strands, 3) or (3,), not zero.
            length: of a strand [m]. points: on a strand, 2 or more.
            dtype: float32 or float64; JAX's default if not given.
        """
        check.shape("roots", roots, ("strands", 3))
        strands, _ = np.shape(roots)
        check.finite("roots", roots)
        if check.size("directions", directions) != (3,):
            check.shape("directions", directions, (strands, 3))
        check.finite("directions", directions)
        toward = check.known(directions)
        if toward is not None and np.any(np.abs(toward).max(axis=-1) < check.SMALLEST):
            raise ValueError(f"directions has a zero vector; none of {np.shape(directions)} may be")
        check.positive("length", length)
        check.whole("points", points, least=2)
        if points * strands > MOST_POINTS:
            wanted = f"all strands together must have at most {MOST_POINTS}"
            raise ValueError(f"points is {points} for {strands} strands; {wanted}")
        dtype = _floating(dtype)
        roots, directions = jnp.asarray(roots, dtype), jnp.asarray(directions, dtype)
        length = length if check.traced(length) else float(length)
        return Strands(*_straight(roots, directions, length, points))


# Compiled as one program each: half a second the first time; operation by operation, three.


@jax.jit
def _framed(positions: Array, last: Array | None) -> tuple[Array, Array, Array, Array]:
    """Arrays of `Strands` through points; behind the `last` of each strand they repeat it."""
    if last is not None:
        places = jnp.arange(positions.shape[1], dtype=last.dtype)
        place = jnp.minimum(places[None], last[:, None])
        positions = jnp.take_along_axis(positions, place[..., None], axis=1)
    x = strands_last(positions)
    edges = x[1:] - x[:-1]
    lengths, tangents = quat.safe_norm(edges), quat.unit(edges)
    if last is not None:  # missing edges go straight on, which keeps their frames unit
        place = jnp.minimum(places[: len(edges), None], last[None] - 1)
        tangents = jnp.take_along_axis(tangents, place[:, None], axis=0)

    def carried(q: Array, turn: Array) -> tuple[Array, Array]:
        q = quat.unit(quat.multiply(turn, q))
        return q, q

    root = quat.between(_e3_like(tangents[0]), tangents[0])
    _, others = lax.scan(carried, root, quat.between(tangents[:-1], tangents[1:]))
    q = jnp.concatenate([root[None], others])
    r = quat.relative(q[:-1], q[1:])
    shape = r[:, 1:] * jnp.where(r[:, :1] < 0, -1, 1).astype(r.dtype)
    return positions, strands_first(q), strands_first(lengths[:, 0]), strands_first(shape)


@partial(jax.jit, static_argnames="points")
def _straight(
    roots: Array, directions: Array, length: Any, points: int
) -> tuple[Array, Array, Array, Array]:
    """Arrays of `Strands` that are straight."""
    start, dtype = strands_last(roots), roots.dtype
    t = quat.unit(strands_last(jnp.broadcast_to(directions, roots.shape)))
    along = jnp.linspace(0.0, length, points).astype(dtype)
    x = start[None] + along[:, None, None] * t[None]
    q = quat.between(_e3_like(t), t)
    q = jnp.broadcast_to(q[None], (points - 1, *q.shape))
    lengths = jnp.full((1, points - 1), length / (points - 1), dtype)
    shape = jnp.zeros((t.shape[-1], points - 2, 3), dtype)
    return strands_first(x), strands_first(q), lengths, shape


def _floating(dtype: Any) -> Any:
    """A dtype of `DTYPES`, by default JAX's."""
    if dtype is None:
        return jnp.zeros(()).dtype
    with suppress(Exception):  # whatever NumPy raises where it is no dtype at all
        if np.dtype(dtype).name in DTYPES:
            return np.dtype(dtype)
    raise ValueError(f"dtype is {check.short(dtype)}; it must be one of {check.listed(DTYPES)}")


def _e3_like(t: Array) -> Array:
    return jnp.zeros_like(t).at[2].set(1)


def _check_apart(lengths: Array, exists: np.ndarray | None) -> None:
    known = check.known(lengths)
    if known is None:
        return
    there = np.ones(known.shape, bool) if exists is None else exists
    if np.any(wrong := (known < check.SMALLEST) & there):
        edge, _, strand = (int(i) for i in np.argwhere(wrong)[0])
        raise ValueError(
            f"points {edge} and {edge + 1} of strand {strand} coincide; "
            "neighbouring points must be apart"
        )


@pytree
class State:
    """All that changes during a simulation; strands on the last axis.

    Arguments:
        positions: p [m], shape (points, 3, strands).
        velocities: v [m/s], shape (points, 3, strands).
        orientations: q of the edges, shape (points - 1, 4, strands).
        shapes: what each kind of bond remembers, Omega_j, shape (points - 2, 4, 3, strands).
        fractions: bonded fraction b_j of each kind in [0, 1], shape (points - 2, 4, strands).
        forces: in the edges, above 0 along the edge where it is pulled [N], shape
            (points - 1, 3, strands); None with solvers that do not keep them.
    """

    positions: Array
    velocities: Array
    orientations: Array
    shapes: Array
    fractions: Array
    forces: Array | None = None

    @property
    def points(self) -> Array:
        """Positions [m] with the strands first, shape (strands, points, 3)."""
        return strands_first(self.positions)
