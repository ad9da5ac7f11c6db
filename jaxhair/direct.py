"""The direct solver: Newton's method for all constraints of a strand at once."""

from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxhair import check, rods
from jaxhair import quaternion as quat
from jaxhair.block_tridiagonal import Blocks, Pair, solve
from jaxhair.pytree import pytree, static
from jaxhair.rods import Rod
from jaxhair.solvers import Solver
from jaxhair.strands import State


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
    (DOI 10.1111/cgf.13326), with forces as unknowns in place of all multipliers, and with the
    second derivative of a tension's direction, without which light strands under much tension
    would be unstable.

    Arguments:
        newton_steps: in each step.
        frame_inertia: what holds a frame back from turning, as a part of its edge's m l^2. It
            keeps strands solvable of which nothing else holds the twist.
        substeps: see `jaxhair.solvers.Solver`.
    """

    newton_steps: int = static(default=1)
    frame_inertia: Any = 1e-3
    substeps: int = static(default=1)
    compliant: ClassVar[bool] = True
    keeps_forces: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check.whole("solver.newton_steps", self.newton_steps, least=1)
        check.positive("solver.frame_inertia", self.frame_inertia)
        check.whole("solver.substeps", self.substeps, least=1)

    def solve(
        self, rod: Rod, state: State, positions: Array, orientations: Array, rest: Any, dt: float
    ) -> tuple[Array, Array, Array]:
        """Positions, orientations and forces [N]; see `Solver.solve`."""
        unit = Units.of(rod, dt)
        moving = state.positions + dt * state.velocities
        moving = jnp.where(rod.point_weights > 0, moving, positions)
        q = _turned(rod, moving / unit.length, orientations)
        assert state.forces is not None
        n = state.forces / unit.force
        for _ in range(self.newton_steps):
            joints = _joints(rod, unit, state.orientations, q, rest, dt)
            blocks, right = self._linearised(rod, unit, joints, positions / unit.length, q, n)
            n, phi = solve(blocks, right)
            q = quat.unit(quat.multiply(q, quat.from_rotation_vector(phi)))
        pull = _padded(n, 0, 1) - _padded(n, 1, 0)
        p = positions + unit.length * rod.point_weights * pull
        return p, q, n * unit.force

    def _linearised(
        self, rod: Rod, unit: "Units", joints: "_Joints", p: Array, q: Array, n: Array
    ) -> tuple[Blocks, Pair]:
        """The equations of the class, for new forces and rotations phi in the frames' own axes.

        R(q) e3 turns by d1 phi_2 - d2 phi_1; a tension T along it turns too, which adds l T to the
        stiffness about d1 and d2.
        """
        length, w, free = rod.lengths / unit.length, rod.point_weights, rod.edge_weights
        d1, d2, d3 = quat.axes(q)
        eye = jnp.eye(3, dtype=p.dtype)[None, :, :, None]
        across = jnp.asarray([1, 1, 0], p.dtype)[None, :, None]
        tension = jnp.maximum(quat.dot(n, d3), 0)
        diagonal = self.frame_inertia * length**3 + length * tension * across
        stiffness = _padded(joints.of_first, 0, 1) + _padded(joints.of_second, 1, 0)
        turned = jnp.stack([-d2, d1, jnp.zeros_like(d1)], axis=2)
        compliance, shared = w[:-1] + w[1:] + length * unit.compliance, w[1:-1]
        gap = length * d3 - (p[1:] - p[:-1])
        if rod.ragged:
            exists = rod.edge_exists().astype(p.dtype)
            compliance, shared, gap = compliance + 1 - exists, shared * exists[1:], gap * exists
        may_turn = free[:, None]
        blocks = Blocks(
            compliance=compliance,
            coupling=-length[:, None] * turned * may_turn,
            stiffness=(stiffness + diagonal[:, :, None] * eye) * may_turn + (1 - may_turn) * eye,
            next_compliance=shared,
            next_stiffness=joints.between * may_turn[:-1] * may_turn[1:],
        )
        moments = _padded(joints.on_first, 0, 1) + _padded(joints.on_second, 1, 0)
        return blocks, (gap, moments * free)


class Units(NamedTuple):
    """Units in which a rod's numbers are near 1: its mean edge, that edge's mass, the time step.

    length [m], force [N], and the unit of force over E A.
    """

    length: Array
    force: Array
    compliance: Array

    @classmethod
    def of(cls, rod: Rod, dt: float) -> "Units":
        material = rod.material
        assert material is not None, "a Scene allows this solver with a physical fibre only"
        length = material.unit_length
        force = material.linear_density * length**2 / dt**2
        return cls(length, force, force / material.axial_stiffness)


class _Joints(NamedTuple):
    """Stiffness of each inner point's bend and twist against rotations of the edge before it
    (first), of the edge after it (second), and between both; and the moments on the two edges."""

    of_first: Array
    of_second: Array
    between: Array
    on_first: Array
    on_second: Array


def _joints(rod: Rod, unit: Units, before: Array, q: Array, rest: Any, dt: float) -> _Joints:
    """Gauss-Newton of sum 4 B / h |Omega - shape|^2 / 2, with dOmega = a phi_2 - a' phi_1 and
    a = (r_w I + [Omega]x) / 2.

    before: orientations at the start of the step, for the material's damping.
    """
    shape, share = rest
    spring = share * rod.bending() / (unit.force * unit.length)
    r = rods.darboux(q[:-1], q[1:])
    r = quat.same_hemisphere(r, shape) * r
    moment = spring * (r - shape)[:, 1:]
    if rod.material is not None and rod.material.damping_time is not None:
        rate = rod.material.damping_time / dt
        old = rods.darboux(before[:-1], before[1:])
        old = quat.same_hemisphere(old, r) * old
        moment = moment + spring * rate * (r - old)[:, 1:]
        spring = spring * (1 + rate)
    w, x, y, z = (r[:, i] / 2 for i in range(4))
    rows = [[w, -z, y], [z, w, -x], [-y, x, w]]
    a = jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)
    a_t = jnp.swapaxes(a, 1, 2)
    spring = spring[:, :, None]
    return _Joints(
        of_first=_product(a, spring * a_t),
        of_second=_product(a_t, spring * a),
        between=_product(a, spring * a),
        on_first=jnp.sum(a * moment[:, None], axis=2),
        on_second=-jnp.sum(a_t * moment[:, None], axis=2),
    )


def _turned(rod: Rod, p: Array, q: Array) -> Array:
    """Frames turned, without twist, to where their edges point; held ones stay."""
    turn = quat.between(quat.tangent(q), quat.unit(p[1:] - p[:-1]))
    return jnp.where(rod.edge_weights > 0, quat.unit(quat.multiply(turn, q)), q)


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, :, None] * b[:, None], axis=2)


def _padded(x: Array, before: int, after: int) -> Array:
    """Rows of zeros before and after."""
    return jnp.pad(x, ((before, after), *((0, 0),) * (x.ndim - 1)))
