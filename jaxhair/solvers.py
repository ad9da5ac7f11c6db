"""Solvers of a strand's elasticity: from predicted positions to admissible ones."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxhair import check, rods
from jaxhair.pytree import pytree, static
from jaxhair.rods import Rod

SWEEPS = ("red-black", "sequential")


def stiffness_per_iteration(stiffness: Array, iterations: int) -> Array:
    """k' = 1 - (1 - k)^(1/n) (Eq. 12), with n the solver's iterations in a step.

    After n of them 1 - k of an error is left. At k = 1 the value is 1 and the derivative, in
    truth infinite, is given as 0.

    Arguments:
        stiffness: k in [0, 1], any shape. iterations: n.
    """
    rigid = stiffness >= 1
    below = jnp.where(rigid, 0, stiffness)
    return jnp.where(rigid, 1, -jnp.expm1(jnp.log1p(-below) / iterations))


@pytree
class PositionBased:
    """The paper's solver: Gauss-Seidel projections of stretch-shear, then of bend-twist.

    Arguments:
        iterations: of both, n.
        sweep: "red-black" does the even edges and then the odd ones, all at once along the
            strand; "sequential" goes from root to tip as published.
        orientation_weight: w_q l^2 / w, without unit. It says how readily an edge's frame gives
            way to its points: large, and frames follow points; small, and points follow frames.
    """

    iterations: int = static(default=5)
    sweep: str = static(default="red-black")
    orientation_weight: Any = 0.03

    def __post_init__(self) -> None:
        check.whole("solver.iterations", self.iterations, least=1)
        check.choice("solver.sweep", self.sweep, SWEEPS)
        check.positive("solver.orientation_weight", self.orientation_weight)

    def solve(
        self, rod: Rod, positions: Array, orientations: Array, rest: Array
    ) -> tuple[Array, Array]:
        """Positions and orientations after n iterations.

        Arguments:
            positions: predicted [m], shape (points, 3, strands).
            orientations: shape (points - 1, 4, strands).
            rest: unit quaternions with vector part Omega_o, shape (points - 2, 4, strands).
        """
        w, free, length = rod.point_weights, rod.edge_weights, rod.lengths
        k = stiffness_per_iteration(rod.stiffness, self.iterations)
        if rod.ragged:
            length = jnp.where(rod.edge_exists(), length, 1)
            exists = rod.edge_exists().astype(length.dtype)
            k = k * exists[1:]
        wq = free * self.orientation_weight / length**2
        stretch = rods.stretch_shear_factors(w[:-1], w[1:], wq, length)
        if rod.ragged:
            stretch = tuple(g * exists for g in stretch)
        bend = rods.bend_twist_factors(wq[:-1], wq[1:], k)
        sweep = _red_black if self.sweep == "red-black" else _sequential
        return sweep(self.iterations, positions, orientations, length, stretch, rest, bend)


def _repeat(iteration: Callable[[Any], Any], x: Any, times: int) -> Any:
    """x after `times` iterations; in reverse mode each is computed again instead of stored."""
    body = jax.checkpoint(lambda x, _: (iteration(x), None), prevent_cse=False)
    return lax.scan(body, x, None, length=times)[0]


def _sequential(
    iterations: int, p: Array, q: Array, length: Array, stretch: Any, rest: Array, bend: Any
) -> tuple[Array, Array]:
    """Edges from root to tip, then inner points from root to tip."""

    def edge(p1: Array, at: Any) -> tuple[Array, Any]:
        p2, q, length, factors = at
        p1, p2, q = rods.stretch_shear(p1, p2, q, length, factors)
        return p2, (p1, q)

    def inner(q1: Array, at: Any) -> tuple[Array, Array]:
        q2, rest, factors = at
        q1, q2 = rods.bend_twist(q1, q2, rest, factors)
        return q2, q1

    def iteration(x: Any) -> Any:
        p, q = x
        tip, (p, q) = lax.scan(edge, p[0], (p[1:], q, length, stretch))
        last, head = lax.scan(inner, q[0], (q[1:], rest, bend))
        return jnp.concatenate([p, tip[None]]), jnp.concatenate([head, last[None]])

    return _repeat(iteration, (p, q), iterations)


def _red_black(
    iterations: int, p: Array, q: Array, length: Array, stretch: Any, rest: Array, bend: Any
) -> tuple[Array, Array]:
    """Even edges, odd edges, even inner points, odd inner points.

    Even and odd points live in arrays of their own during the iterations: strided slices inside
    them cost 1.7 times as much.
    """
    length2, stretch2, rest2, bend2 = (_halves(x) for x in (length, stretch, rest, bend))

    def iteration(x: Any) -> Any:
        (p0, p1), (q0, q1) = x
        p0, p1, q0 = _edges(p0, p1, q0, length2[0], stretch2[0])
        p1, p0_after, q1 = _edges(p1, p0[1:], q1, length2[1], stretch2[1])
        p0 = jnp.concatenate([p0[:1], p0_after])
        q0, q1 = _inner(q0, q1, rest2[0], bend2[0])
        q1, q0_after = _inner(q1, q0[1:], rest2[1], bend2[1])
        q0 = jnp.concatenate([q0[:1], q0_after])
        return (p0, p1), (q0, q1)

    p2, q2 = _repeat(iteration, (_halves(p), _halves(q)), iterations)
    return _woven(*p2), _woven(*q2)


def _halves(x: Any) -> tuple[Any, Any]:
    """The even and the odd rows of every array in x."""
    return jax.tree.map(lambda a: a[0::2], x), jax.tree.map(lambda a: a[1::2], x)


def _woven(even: Array, odd: Array) -> Array:
    """The rows even[0], odd[0], even[1], ...: the inverse of `_halves`."""
    n = odd.shape[0]
    pairs = jnp.stack([even[:n], odd], axis=1).reshape(2 * n, *even.shape[1:])
    return jnp.concatenate([pairs, even[n:]])


def _edges(first: Array, second: Array, q: Array, length: Array, factors: Any) -> Any:
    """Stretch-shear of edges from the rows of `first` to those of `second`; the longer one's last
    row, if it has no partner, stays."""
    n = q.shape[0]
    a, b, q = rods.stretch_shear(first[:n], second[:n], q, length, factors)
    return jnp.concatenate([a, first[n:]]), jnp.concatenate([b, second[n:]]), q


def _inner(first: Array, second: Array, rest: Array, factors: Any) -> Any:
    """Bend-twist between the rows of `first` and those of `second`."""
    n = rest.shape[0]
    a, b = rods.bend_twist(first[:n], second[:n], rest, factors)
    return jnp.concatenate([a, first[n:]]), jnp.concatenate([b, second[n:]])
