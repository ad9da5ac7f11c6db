"""The direct solver: Newton's method for all constraints of a strand at once."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jax import Array

from jaxhair import check, hessian
from jaxhair import quaternion as quat
from jaxhair.block_tridiagonal import Blocks, Pair, solve
from jaxhair.hessian import Units
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
            joints = hessian.joints(rod, unit, state.orientations, q, rest, dt)
            blocks, right = self._linearised(rod, unit, joints, positions / unit.length, q, n)
            n, phi = solve(blocks, right)
            q = quat.unit(quat.multiply(q, quat.from_rotation_vector(phi)))
        pull = hessian.padded(n, 0, 1) - hessian.padded(n, 1, 0)
        p = positions + unit.length * rod.point_weights * pull
        return p, q, n * unit.force

    def _linearised(
        self, rod: Rod, unit: Units, joints: hessian.Joints, p: Array, q: Array, n: Array
    ) -> tuple[Blocks, Pair]:
        """The equations of the class, for new forces and rotations phi in the frames' own axes.

        R(q) e3 turns by d1 phi_2 - d2 phi_1.
        """
        length, w, free = rod.lengths / unit.length, rod.point_weights, rod.edge_weights
        d1, d2, d3 = quat.axes(q)
        inertia = self.frame_inertia * length**3 * jnp.ones((1, 3, 1), p.dtype)
        eye = jnp.eye(3, dtype=p.dtype)[None, :, :, None]
        stiffness = hessian.padded(joints.of_first, 0, 1) + hessian.padded(joints.of_second, 1, 0)
        stiffness = stiffness + inertia[:, :, None] * eye + hessian.of_force(length * n, d1, d2, d3)
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
            stiffness=stiffness * may_turn + (1 - may_turn) * eye,
            next_compliance=shared,
            next_stiffness=joints.between * may_turn[:-1] * may_turn[1:],
        )
        moments = hessian.padded(joints.on_first, 0, 1) + hessian.padded(joints.on_second, 1, 0)
        return blocks, (gap, moments * free)


def _turned(rod: Rod, p: Array, q: Array) -> Array:
    """Frames turned, without twist, to where their edges point; held ones stay."""
    turn = quat.between(quat.tangent(q), quat.unit(p[1:] - p[:-1]))
    return jnp.where(rod.edge_weights > 0, quat.unit(quat.multiply(turn, q)), q)
