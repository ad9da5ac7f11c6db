"""Solvers of a strand's elasticity: from predicted positions to admissible ones.

Three, of one interface (`Solver`): the paper's position-based one, compliant constraints (XPBD),
and the direct solver of `jaxhair.direct`, the one to choose for a physical fibre.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxhair import check, rods
from jaxhair.kernels import one_kernel
from jaxhair.pytree import pytree, static
from jaxhair.rods import Rod
from jaxhair.stored import stored
from jaxhair.strands import State

SWEEPS = ("red-black", "sequential")


class Solver:
    """What the step asks of a solver.

    compliant: it takes bonds as springs, `jaxhair.bonds.springs`, and needs a physical fibre;
        otherwise it takes the rest shape of (Eq. 15) and works with both kinds of fibre.
    keeps_forces: the forces in the edges are part of the state.
    recomputes: in reverse mode it computes its iterations again, so that a step stores little.
    substeps: how often in a time step the strands are predicted and solved, each time over
        dt / substeps; external forces, contact and bonds are computed once a step.
    """

    compliant: ClassVar[bool]
    keeps_forces: ClassVar[bool] = False
    recomputes: ClassVar[bool] = False
    substeps: int

    @property
    def numbers(self) -> int:
        """Of a point, in the largest array of the loops that are compiled as kernels; 0: none."""
        return 0

    @abstractmethod
    def solve(
        self, rod: Rod, state: State, positions: Array, orientations: Array, rest: Any, dt: float
    ) -> tuple[Array, Array, Array | None]:
        """Positions, orientations and, if they are kept, forces at the end of a step.

        Arguments:
            state: at the start of the step.
            positions: predicted [m], shape (points, 3, strands); held points are where they go.
            orientations: of the start, shape (points - 1, 4, strands); held edges moved too.
            rest: unit quaternions with vector part Omega_o, shape (points - 2, 4, strands); for a
                compliant solver the pair that `jaxhair.bonds.springs` gives.
            dt: of the step, or of a substep [s].
        """


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
class _Sweeping(Solver):
    """Gauss-Seidel: constraints are projected one after another, several times over."""

    recomputes: ClassVar[bool] = True
    iterations: int = static(default=5)
    sweep: str = static(default="red-black")
    orientation_weight: Any = 0.03
    substeps: int = static(default=1)

    def __post_init__(self) -> None:
        check.whole("solver.iterations", self.iterations, least=1, most=100_000)
        check.choice("solver.sweep", self.sweep, SWEEPS)
        check.positive("solver.orientation_weight", self.orientation_weight)
        check.whole("solver.substeps", self.substeps, least=1, most=100_000)

    @property
    def numbers(self) -> int:
        """Four of a quaternion, and half of them where even and odd edges have their own."""
        return 2 if self.sweep == "red-black" else 4

    def _swept(self, edge: Any, inner: Any, *arguments: Any) -> tuple[Array, Array]:
        sweep = _red_black if self.sweep == "red-black" else _sequential
        return sweep(self.iterations, _of_stored(edge), _of_stored(inner), *arguments)

    def _weights(self, rod: Rod) -> tuple[Array, Array]:
        """Lengths without zeros, and w_q of the edges' frames."""
        length = jnp.where(rod.edge_exists(), rod.lengths, 1) if rod.ragged else rod.lengths
        return length, rod.edge_weights * self.orientation_weight / length**2


@pytree
class PositionBased(_Sweeping):
    """The paper's solver: Gauss-Seidel projections of stretch-shear, then of bend-twist.

    With a physical fibre, k is the share of a violation that one compliant projection of its
    constraint takes away, k (w1 + w2) / (k (w1 + w2) + h / (4 B dt^2)): right where a joint bends
    by itself, and only roughly right in a strand.

    Arguments:
        iterations: of both, n.
        sweep: "red-black" does the even edges and then the odd ones, all at once along the
            strand; "sequential" goes from root to tip as published.
        orientation_weight: w_q l^2 / w, without unit. It says how readily an edge's frame gives
            way to its points: large, and frames follow points; small, and points follow frames.
        substeps: see `Solver`.
    """

    compliant: ClassVar[bool] = False

    def solve(
        self, rod: Rod, state: State, positions: Array, orientations: Array, rest: Any, dt: float
    ) -> tuple[Array, Array, None]:
        """Positions and orientations after n iterations; see `Solver.solve`."""
        w = rod.point_weights
        length, wq = self._weights(rod)
        k = rod.stiffness
        if rod.material is not None:
            spring = _relative_springs(rod, dt) * (wq[:-1] + wq[1:])
            k = spring / (1 + spring)
        k = stiffness_per_iteration(k, self.iterations)
        stretch = rods.stretch_shear_factors(w[:-1], w[1:], wq, length)
        if rod.ragged:
            exists = rod.edge_exists().astype(length.dtype)
            stretch = tuple(g * exists for g in stretch)
            k = k * exists[1:]
        bend = rods.bend_twist_factors(wq[:-1], wq[1:], k)

        def edge(p1: Array, p2: Array, q: Array, none: None, at: Any) -> Any:
            return *rods.stretch_shear(p1, p2, q, *at), none

        def inner(q1: Array, q2: Array, none: None, at: Any) -> Any:
            return *rods.bend_twist(q1, q2, *at), none

        constants = (length, stretch), (rest, bend)
        return *self._swept(edge, inner, positions, orientations, (None, None), constants), None


@pytree
class Compliant(_Sweeping):
    """XPBD: the same projections of compliant constraints, with a physical fibre.

    Each constraint has a multiplier, which grows to its force over the iterations
    (Macklin, Mueller and Chentanez, XPBD, 2016; DOI 10.1145/2994258.2994272):
    d lambda = -(C + alpha lambda) / (sum w |grad C|^2 + alpha), alpha = compliance / dt^2.
    It converges as slowly as the paper's. Converged, the shape at rest does not depend on the
    iterations any more; on dt it does, in the first order, because frames turn on the way.

    Arguments: those of `PositionBased`.
    """

    compliant: ClassVar[bool] = True

    def solve(
        self, rod: Rod, state: State, positions: Array, orientations: Array, rest: Any, dt: float
    ) -> tuple[Array, Array, None]:
        """Positions and orientations after n iterations; see `Solver.solve`."""
        w = rod.point_weights
        length, wq = self._weights(rod)
        shape, share = rest
        spring = share * _relative_springs(rod, dt)
        spring, shape = rods.damped(rod, spring, shape, state.orientations, dt)
        # alpha of stretch and shear, 1 / (E A l) in the units of the weights
        unit_mass = rod.unit_mass()
        assert rod.material is not None
        alpha = unit_mass / (rod.material.axial_stiffness * length * dt**2)
        stretch = rods.stretch_shear_factors(w[:-1], w[1:], wq, length, alpha * length**2)
        whole = rods.stretch_shear_whole(w[:-1], w[1:], wq, length, alpha * length**2)
        if rod.ragged:
            stretch = tuple(g * rod.edge_exists().astype(length.dtype) for g in stretch)

        def edge(p1: Array, p2: Array, q: Array, multiplier: Array, at: Any) -> Any:
            length, stretch, alpha, whole = at
            gamma = rods.stretch_shear_violation(p1, p2, q, length) + alpha * multiplier
            moved = rods.stretch_shear_moved(p1, p2, q, gamma, stretch)
            return *moved, multiplier - gamma * length**2 / whole

        def inner(q1: Array, q2: Array, multiplier: Array, at: Any) -> Any:
            rest, w1, w2, spring = at
            c = rods.bend_twist_violation(rods.darboux(q1, q2), rest)
            change = (spring * c + multiplier) / (1 + spring * (w1 + w2))
            return *rods.bend_twist_moved(q1, q2, change, (w1, w2)), multiplier - change

        like = positions[1:], shape[:, 1:]
        multipliers = tuple(jnp.zeros_like(x) for x in like)
        constants = (length, stretch, alpha, whole), (shape, wq[:-1], wq[1:], spring)
        return *self._swept(edge, inner, positions, orientations, multipliers, constants), None


def _relative_springs(rod: Rod, dt: float) -> Array:
    """4 B dt^2 / (h m) with the mass m of an edge of mean length: (points - 2, 3, ...) [m^2]."""
    return rod.bending() * dt**2 / rod.unit_mass()


# Sweeps. `edge` and `inner` project a constraint: they take the two things it joins (and the
# frame between two points), its multiplier or None, and its constants, and return what they took,
# moved. `m` are the multipliers of edges and of inner points, `at` their constants.


def _of_stored(project: Callable[..., Any]) -> Callable[..., Any]:
    """A projection whose arguments, but for its constants, are stored."""
    return lambda *x: project(*jax.tree.map(stored, x[:-1]), x[-1])


def _repeat(iteration: Callable[[Any, Any], Any], x: Any, at: Any, times: int) -> Any:
    """x after `times` iterations; in reverse mode each is computed again instead of stored."""
    iteration = one_kernel(iteration)
    body = jax.checkpoint(lambda x, _: (iteration(x, at), None), prevent_cse=False)
    return lax.scan(body, x, None, length=times)[0]


def _sequential(
    iterations: int, edge: Any, inner: Any, p: Array, q: Array, m: Any, at: Any
) -> tuple[Array, Array]:
    """Edges from root to tip, then inner points from root to tip.

    In one sweep, since an inner point waits for nothing but the two edges beside it: behind each
    edge comes the inner point before it. In reverse mode an edge is computed again: to store what
    its derivative needs would take longer (gradients took 1.1 times as long).
    """

    def next_edge(before: Any, here: Any) -> tuple[Any, Any]:
        p1, q1 = before
        p2, q2, m_edge, m_inner, at_edge, at_inner = here
        p1, p2, q2, m_edge = edge(p1, p2, q2, m_edge, at_edge)
        q1, q2, m_inner = inner(q1, q2, m_inner, at_inner)
        return (p2, q2), (p1, q1, m_edge, m_inner)

    def iteration(x: Any, at: Any) -> Any:
        p, q, (of_edges, of_inner) = x
        of_first, of_others = _first_and_others(at[0])
        first, others = _first_and_others(of_edges)
        root, p1, q1, first = edge(p[0], p[1], q[0], first, of_first)
        rows = (p[2:], q[1:], others, of_inner, of_others, at[1])
        each = jax.checkpoint(next_edge, prevent_cse=False)
        (tip, last), (p, q, others, of_inner) = lax.scan(each, (p1, q1), rows)
        of_edges = jax.tree.map(lambda x, rest: jnp.concatenate([x[None], rest]), first, others)
        p, q = jnp.concatenate([root[None], p, tip[None]]), jnp.concatenate([q, last[None]])
        return p, q, (of_edges, of_inner)

    return _repeat(iteration, (p, q, m), at, iterations)[:2]


def _first_and_others(x: Any) -> tuple[Any, Any]:
    """The first row and the others of every array in x."""
    return jax.tree.map(lambda a: a[0], x), jax.tree.map(lambda a: a[1:], x)


def _red_black(
    iterations: int, edge: Any, inner: Any, p: Array, q: Array, m: Any, at: Any
) -> tuple[Array, Array]:
    """Even edges, odd edges, even inner points, odd inner points.

    Even and odd points live in arrays of their own during the iterations: strided slices inside
    them cost 1.7 times as much.
    """
    start = _halves(p), _halves(q), tuple(_halves(x) for x in m)

    def iteration(x: Any, at: Any) -> Any:
        at_edges, at_inner = at
        (p0, p1), (q0, q1), ((e0, e1), (i0, i1)) = x
        p0, p1, q0, e0 = _edges(edge, p0, p1, q0, e0, at_edges[0])
        p1, p0_after, q1, e1 = _edges(edge, p1, p0[1:], q1, e1, at_edges[1])
        p0 = jnp.concatenate([p0[:1], p0_after])
        q0, q1, i0 = _inner(inner, q0, q1, i0, at_inner[0])
        q1, q0_after, i1 = _inner(inner, q1, q0[1:], i1, at_inner[1])
        q0 = jnp.concatenate([q0[:1], q0_after])
        return (p0, p1), (q0, q1), ((e0, e1), (i0, i1))

    halves = tuple(_halves(x) for x in at)
    p2, q2, _ = _repeat(iteration, start, halves, iterations)
    return _woven(*p2), _woven(*q2)


def _halves(x: Any) -> tuple[Any, Any]:
    """The even and the odd rows of every array in x."""
    return jax.tree.map(lambda a: a[0::2], x), jax.tree.map(lambda a: a[1::2], x)


def _woven(even: Array, odd: Array) -> Array:
    """The rows even[0], odd[0], even[1], ...: the inverse of `_halves`."""
    n = odd.shape[0]
    pairs = jnp.stack([even[:n], odd], axis=1).reshape(2 * n, *even.shape[1:])
    return pairs if len(even) == n else jnp.concatenate([pairs, even[n:]])


def _edges(edge: Any, first: Array, second: Array, q: Array, m: Any, at: Any) -> Any:
    """Edges from the rows of `first` to those of `second`; the longer one's last row, if it has
    no partner, stays."""
    n = q.shape[0]
    a, b, q, m = edge(first[:n], second[:n], q, m, at)
    return _followed(a, first), _followed(b, second), q, m


def _inner(inner: Any, first: Array, second: Array, m: Any, at: Any) -> Any:
    """Inner points between the rows of `first` and those of `second`."""
    n = at[0].shape[0]
    a, b, m = inner(first[:n], second[:n], m, at)
    return _followed(a, first), _followed(b, second), m


def _followed(rows: Array, all_rows: Array) -> Array:
    """Rows, and behind them those of another array that they do not replace."""
    n = rows.shape[0]
    return rows if n == all_rows.shape[0] else jnp.concatenate([rows, all_rows[n:]])
