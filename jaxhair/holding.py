"""Hair that is held: roots and tips fixed or moved, and hair wound on a rod and kept there."""

from typing import Any

import jax.numpy as jnp
from jax import Array, lax

from jaxhair import check, rods
from jaxhair import quaternion as quat
from jaxhair.bonds import springs
from jaxhair.effects import HoldingEffect, PoseEffect
from jaxhair.pytree import pytree, static
from jaxhair.rods import Rod
from jaxhair.strands import State, column


@pytree
class Hold(HoldingEffect):
    """Holds one end of every strand, still or in a rigid motion.

    Arguments:
        part: "root" or "tip".
        clamped: the end's edge keeps its direction too; otherwise it turns freely.
        velocity: [m/s], shape (3,); None stands still.
        angular_velocity: [rad/s], shape (3,), about a centre that moves along; None does not turn.
        centre: of the turn at the start of the phase [m], shape (3,); the origin if None, which it
            must be where nothing turns.
    """

    each_strand_alone = True
    part: str = static(default="root")
    clamped: bool = static(default=True)
    velocity: Any = None
    angular_velocity: Any = None
    centre: Any = None

    def __post_init__(self) -> None:
        check.choice("Hold.part", self.part, ("root", "tip"))
        check.flag("Hold.clamped", self.clamped)
        for name in ("velocity", "angular_velocity", "centre"):
            if getattr(self, name) is not None:
                check.vector(f"Hold.{name}", getattr(self, name))
        if self.centre is not None and self.angular_velocity is None:
            wanted = "it must be None without angular_velocity, which turns about it"
            raise ValueError(f"Hold.centre is {check.short(self.centre)}; {wanted}")

    def held_points(self, rod: Rod) -> Array:
        """True at the first or last point of each strand."""
        return self._end(rod.point_exists(), rod.ragged)

    def held_edges(self, rod: Rod) -> Array:
        """True at the first or last edge of each strand, if it is clamped."""
        exists = rod.edge_exists()
        held = self._end(exists, rod.ragged)
        return held if self.clamped else jnp.zeros_like(held)

    def _end(self, exists: Array, ragged: bool) -> Array:
        none = jnp.zeros_like(exists)
        if self.part == "root":
            return jnp.concatenate([~none[:1], none[1:]])
        if not ragged:
            return jnp.concatenate([none[:-1], ~none[-1:]])
        after = jnp.concatenate([exists[1:], jnp.zeros_like(exists[:1])])
        return exists & ~after

    def moved(
        self, rod: Rod, positions: Array, orientations: Array, time: Array, dt: float
    ) -> tuple[Array, Array]:
        """x -> c + v dt + R(w dt)(x - c) with c = centre + v time, and q -> R(w dt) q."""
        if self.velocity is None and self.angular_velocity is None:
            return positions, orientations
        x, q = positions, orientations
        shift = 0.0 if self.velocity is None else column(self.velocity, x) * dt
        if self.angular_velocity is not None:
            turn = quat.from_rotation_vector(column(self.angular_velocity, x) * dt)
            centre = column((0, 0, 0) if self.centre is None else self.centre, x)
            if self.velocity is not None:
                centre = centre + time * column(self.velocity, x)
            x = centre + quat.rotate(jnp.broadcast_to(turn, (*x.shape[:1], 4, 1)), x - centre)
            turned = quat.unit(quat.multiply(turn, q))
            q = jnp.where(self.held_edges(rod), turned, q)
        return jnp.where(self.held_points(rod), x + shift, positions), q


@pytree
class Wound(PoseEffect):
    """Every strand is wound on a rod of its own from its first edge on, and kept there.

    The points lie on the rod's surface, on a helix: a state prepared without simulating the
    winding. With `climb` 0 each turn lies on the one before.

    Arguments:
        diameter: of the rod [m], larger than the longest edge.
        climb: angle between the helix and the rod's cross-section [rad], in [-pi/2, pi/2].
    """

    each_strand_alone = True
    diameter: Any
    climb: Any = 0.0

    def __post_init__(self) -> None:
        check.positive("Wound.diameter", self.diameter)
        check.number("Wound.climb", self.climb)
        climb = check.known(self.climb)
        if climb is not None and abs(climb) > jnp.pi / 2:
            raise ValueError(f"Wound.climb is {float(climb)}; it must be in [-pi/2, pi/2]")

    def pose(self, rod: Rod, state: State) -> tuple[Array, Array]:
        """q_(i+1) = q_i r with the vector part l cos(a) / D (cos(a), 0, sin(a)) of r.

        Equal edges of length l that turn so lie with their points on a cylinder of diameter D and
        climb at the angle a: a turn by phi moves a point across by D sin(phi / 2) = l cos(a).
        """
        length = (rod.lengths[:-1] + rod.lengths[1:]) / 2
        climb = jnp.asarray(self.climb, length.dtype)
        axis = column(jnp.stack([jnp.cos(climb), jnp.zeros_like(climb), jnp.sin(climb)]), length)
        sine = jnp.clip(length * jnp.cos(climb) / self.diameter, 0, 0.999)
        if rod.ragged:
            sine = jnp.where(rod.edge_exists()[1:], sine, 0)
        turn = jnp.concatenate([jnp.sqrt(1 - sine**2), sine * axis], axis=1)
        return _from_root(rod, state, turn)


@pytree
class Unloaded(PoseEffect):
    """Every strand takes, from its first edge on, the shape in which its bonds are free of stress.

    What hair comes to when no force acts on it: sum_j f_j b_j (Omega - Omega_j) = 0. The solvers
    take many steps to get there, as many more as the square of the number of points.
    """

    each_strand_alone = True

    def pose(self, rod: Rod, state: State) -> tuple[Array, Array]:
        """q_(i+1) = q_i r with the vector part sum_j f_j b_j Omega_j / sum_j f_j b_j of r.

        Where all bonds are cut the present shape stays.
        """
        free, share = springs(state.shapes, state.fractions, rod.influence)
        q = state.orientations
        present = rods.joints(q)
        square = jnp.minimum(quat.dot(free[:, 1:], free[:, 1:]), 0.999)
        turn = jnp.concatenate([jnp.sqrt(1 - square), free[:, 1:]], axis=1)
        return _from_root(rod, state, jnp.where(share == 0, present, turn))


def _from_root(rod: Rod, state: State, turn: Array) -> tuple[Array, Array]:
    """Positions and orientations from the root and the relative rotations at the inner points."""
    turn = jnp.broadcast_to(turn, (*turn.shape[:2], state.positions.shape[-1]))
    q = quat.swept_products(state.orientations[0], turn)
    return positions_along(state.positions[0], rod.lengths, q), q


def positions_along(root: Array, lengths: Array, orientations: Array) -> Array:
    """p_(i+1) = p_i + l_i R(q_i) e3, the points of a strand without stretch or shear.

    Arguments:
        root: p_0 [m], shape (3, strands). lengths: shape (points - 1, 1, strands or 1).
        orientations: shape (points - 1, 4, strands).
    """

    def advance(p: Array, step: Array) -> tuple[Array, Array]:
        p = p + step
        return p, p

    _, rest = lax.scan(advance, root, lengths * quat.tangent(orientations))
    return jnp.concatenate([root[None], rest])
