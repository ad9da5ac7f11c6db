"""The direct solver: Newton's method for all constraints of a strand at once."""

from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxhair import check, hessian
from jaxhair import quaternion as quat
from jaxhair.block_tridiagonal import Blocks, Pair, solve, solve_again
from jaxhair.hessian import Units, padded
from jaxhair.pytree import pytree, static
from jaxhair.rods import Rod
from jaxhair.solvers import Solver
from jaxhair.stored import stored
from jaxhair.strands import State
from jaxhair.sums import POINTS, spread, summed


@pytree
class Direct(Solver):
    """An implicit Euler step of an elastic rod, by Newton steps that solve for a whole strand.

    With points p, frames q and the force n in each edge, the end of a step satisfies

        m_i (p_i - predicted p_i) / dt^2 = n_i - n_(i-1)
        (p_(i+1) - p_i) / l - R(q_i) e3 = n_i / (E A)
        the moments of bending and twisting, and l R(q) e3 x n, add up to 0 at each frame,

    linearised about frames that first turn on as their points' velocities have it. One Newton step
    leaves an error of second order in the rotation that is left; at rest none. Rotational inertia,
    a 10^-4th of the rest in a hair, is left out but for `frame_inertia`.
    After Deul, Kugelstadt, Weiler and Bender, Direct Position-Based Solver for Stiff Rods, 2018
    (DOI 10.1111/cgf.13326), with forces as unknowns in place of all multipliers, and with second
    derivatives of the energy (see `jaxhair.hessian`).

    Arguments:
        newton_steps: in each step.
        frame_inertia: what holds a frame back from twisting, as a part of its edge's m l^2, about
            (radius / l)^2 in truth. Where all bonds are cut, nothing else does. As frames have no
            speed of their own it acts as a friction, which grows as dt falls.
        substeps: see `jaxhair.solvers.Solver`.
    """

    newton_steps: int = static(default=1)
    frame_inertia: Any = 1e-5
    substeps: int = static(default=1)
    compliant: ClassVar[bool] = True
    keeps_forces: ClassVar[bool] = True

    @property
    def numbers(self) -> int:
        """Nine of a matrix."""
        return 9

    def __post_init__(self) -> None:
        check.whole("solver.newton_steps", self.newton_steps, least=1, most=100)
        check.positive("solver.frame_inertia", self.frame_inertia)
        check.whole("solver.substeps", self.substeps, least=1, most=100_000)

    def solve(
        self, rod: Rod, state: State, positions: Array, orientations: Array, rest: Any, dt: float
    ) -> tuple[Array, Array, Array]:
        """Positions, orientations and forces [N]; see `Solver.solve`."""
        unit = Units.of(rod, dt)
        start = state.positions / unit.length
        moving = jnp.where(
            rod.point_weights > 0, dt * state.velocities, positions - state.positions
        )
        q = _turned(rod, start, moving / unit.length, rod.lengths / unit.length, orientations)
        assert state.forces is not None
        n = state.forces / unit.force
        for _ in range(self.newton_steps):
            known = Known(rod, rest, state.orientations, positions / unit.length, q, n)
            n, phi = newton_step(known, jnp.asarray(self.frame_inertia, q.dtype), dt)
            q = quat.unit(stored(quat.multiply(stored(q), stored(_rotation(phi)))))
        p = positions / unit.length + _moved(rod, n)
        return unit.length * _shortened(rod, unit, p, n), q, n * unit.force


class Known(NamedTuple):
    """What a Newton step starts from, lengths and forces in `Units`.

    rod, rest: as in `Solver.solve`. before: orientations at the start of the time step.
    positions: predicted. orientations, forces: from which the step goes.
    """

    rod: Rod
    rest: Any
    before: Array
    positions: Array
    orientations: Array
    forces: Array


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def newton_step(known: Known, frame_inertia: Array, dt: Any) -> Pair:
    """The solution of the linearised equations: forces, and rotations of the frames in their own
    axes.

    Its derivative is that of the equations, `residual`, solved with the factors of the step: the
    matrix itself is never differentiated, which would cost five times as much.
    """
    return solve(*linearised(known, frame_inertia, dt))[0]


@newton_step.defjvp
def _newton_step_jvp(dt: Any, primals: Any, tangents: Any) -> tuple[Pair, Pair]:
    known, frame_inertia = primals
    x, factors = solve(*linearised(known, frame_inertia, dt))
    _, change = jax.jvp(lambda k, inertia: residual(k, inertia, dt, x), primals, tangents)
    return x, solve_again(factors, jax.tree.map(jnp.negative, change))


def linearised(known: Known, frame_inertia: Array, dt: Any) -> tuple[Blocks, Pair]:
    """The equations of `Direct` as a matrix and a right side, for forces and rotations phi.

    R(q) e3 turns by d1 phi_2 - d2 phi_1.
    """
    rod, p = known.rod, known.positions
    unit = Units.of(rod, dt)
    length, w, may_turn = rod.lengths / unit.length, rod.point_weights, rod.edge_weights[:, None]
    d1, d2, d3 = quat.axes(known.orientations)
    bends = hessian.joints(rod, unit, known.before, known.orientations, known.rest, dt)
    of_first, of_second, between = hessian.joint_matrices(bends)
    eye = jnp.eye(3, dtype=p.dtype)[None, :, :, None]
    stiffness = (
        padded(of_first, 0, 1)
        + padded(of_second, 1, 0)
        + frame_inertia * length[:, None] ** 3 * eye
        + hessian.pull_matrix(hessian.pulls(length * known.forces, d1, d2, d3))
    )
    gap = length * d3 - (p[1:] - p[:-1])
    compliance, shared = w[:-1] + w[1:] + length * unit.compliance, w[1:-1]
    if rod.ragged:
        exists = rod.edge_exists().astype(p.dtype)
        compliance, shared, gap = compliance + 1 - exists, shared * exists[1:], gap * exists
    blocks = Blocks(
        compliance=compliance,
        coupling=length[:, None] * jnp.stack([d2, -d1, jnp.zeros_like(d1)], axis=2) * may_turn,
        stiffness=stiffness * may_turn + (1 - may_turn) * eye,
        next_compliance=shared,
        next_stiffness=between * may_turn[:-1] * may_turn[1:],
    )
    on_first, on_second = hessian.acting(bends, bends.moment)
    moments = padded(on_first, 0, 1) + padded(on_second, 1, 0)
    return blocks, (gap, -moments * rod.edge_weights)


def residual(known: Known, frame_inertia: Array, dt: Any, x: Pair) -> Pair:
    """By how much forces and rotations x miss the equations: matrix times x, less the right side.

    Written with vectors alone, because it is what is differentiated.
    """
    (n, phi), rod = x, known.rod
    unit = Units.of(rod, dt)
    length = rod.lengths / unit.length
    p = known.positions + _moved(rod, n)
    d1, d2, d3 = (stored(d) for d in quat.axes(stored(known.orientations)))
    turned = d3 + d1 * phi[:, 1:2] - d2 * phi[:, :1]
    gap = p[1:] - p[:-1] - length * turned - length * unit.compliance * n
    bends = hessian.joints(rod, unit, known.before, known.orientations, known.rest, dt)
    first, second = hessian.joint_moments(bends, phi[:-1], phi[1:])
    pulled = hessian.pulls(length * known.forces, d1, d2, d3)
    arm = jnp.concatenate([quat.dot(n, d2), -quat.dot(n, d1), jnp.zeros_like(phi[:, :1])], axis=1)
    moments = (
        padded(first, 0, 1)
        + padded(second, 1, 0)
        + frame_inertia * length**3 * phi
        + hessian.pull_moments(pulled, phi)
        + length * arm
    )
    if rod.ragged:
        gap = jnp.where(rod.edge_exists(), gap, -n)
    return gap, jnp.where(rod.edge_weights > 0, moments, phi)


def _moved(rod: Rod, n: Array) -> Array:
    """By how much forces n move the points: their weight times n_i - n_(i-1)."""
    return rod.point_weights * (padded(n, 0, 1) - padded(n, 1, 0))


def _shortened(rod: Rod, unit: Units, p: Array, n: Array) -> Array:
    """Points whose edges are at most a tenth longer than their forces make them.

    A Newton step turns edges along tangents: one that turns far is too long behind it, and would
    fly back faster than it came. Such edges are shortened along the strand, away from held points
    or, in a free strand, without moving its centre of mass. In motion that a time step resolves
    nothing is changed.
    """
    edge = p[1:] - p[:-1]
    allowed = rod.lengths / unit.length * (1.1 + unit.compliance * quat.safe_norm(n))
    excess = quat.scaled(quat.unit(edge), jnp.maximum(quat.safe_norm(edge) - allowed, 0))
    pulled = padded(lax.associative_scan(jnp.add, excess), 1, 0)  # `cumsum` fits no kernel
    w = rod.point_weights
    free = w > 0
    mass = jnp.where(free, 1 / jnp.where(free, w, 1), 1e6)
    if rod.ragged:
        mass = jnp.where(rod.point_exists(), mass, 0)
    mean = summed(mass * pulled, POINTS) / summed(mass, POINTS)
    return p + jnp.where(free, spread(mean, len(p), POINTS) - pulled, 0)


def _rotation(phi: Array) -> Array:
    """The rotation by atan |phi| about phi: where the tangent that a frame is turned along leads.

    (1 + sqrt(1 + |phi|^2), phi), made unit; phi has shape (edges, 3, strands).
    """
    real = 1 + jnp.sqrt(1 + quat.dot(phi, phi))
    return quat.unit(jnp.concatenate([real, phi], axis=1))


def _turned(rod: Rod, p: Array, change: Array, length: Array, q: Array) -> Array:
    """Frames turned, without twist, to where their edges point after a change of the points; held
    ones stay.

    Of the change what is across the edge counts: an edge that shrinks fast must not turn around.
    An edge shorter than half its rest length says less and less of its direction, and none of it
    where its points coincide: what is missing to the half is taken from the frame's own axis.
    """
    q = stored(q)
    axis = stored(quat.tangent(q))
    across = change[1:] - change[:-1]
    edge = stored(p[1:] - p[:-1] + across - quat.scaled(axis, quat.dot(across, axis)))
    missing = jnp.maximum(length / 2 - quat.safe_norm(edge), 0)
    turn = quat.between(axis, stored(quat.unit(stored(edge + quat.scaled(axis, missing)))))
    return jnp.where(rod.edge_weights > 0, quat.unit(stored(quat.multiply(stored(turn), q))), q)
