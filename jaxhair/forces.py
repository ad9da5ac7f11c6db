"""External forces, as changes of velocity over a step: gravity, a tip force, drag and wind."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxhair import check
from jaxhair import quaternion as quat
from jaxhair.effects import BondEffect, VelocityEffect
from jaxhair.pytree import pytree
from jaxhair.rods import Rod
from jaxhair.strands import State, column


@pytree
class Gravity(VelocityEffect):
    """dv = g dt.

    Arguments:
        acceleration: g [m/s^2], shape (3,).
    """

    each_strand_alone = True
    acceleration: Any = (0.0, 0.0, -9.80)

    def __post_init__(self) -> None:
        check.vector("Gravity.acceleration", self.acceleration)

    def velocity_change(self, rod: Rod, state: State, dt: float) -> Array:
        """g dt at every point."""
        g = column(self.acceleration, state.positions)
        return jnp.broadcast_to(g * dt, state.positions.shape)


@pytree
class TipForce(VelocityEffect):
    """dv = F dt / m at the last point: a weight or a pull at the tip. Needs a `PhysicalFibre`.

    Arguments:
        force: F [N], shape (3,); a weight of 1 mg is (0, 0, -9.8e-6).
    """

    each_strand_alone = True
    force: Any

    def __post_init__(self) -> None:
        check.vector("TipForce.force", self.force)

    def velocity_change(self, rod: Rod, state: State, dt: float) -> Array:
        """F dt / m at each strand's last point, 0 elsewhere."""
        mass = rod.unit_mass()
        here = rod.point_exists()
        last = here & ~jnp.concatenate([here[1:], jnp.zeros_like(here[:1])])
        at_tip = jnp.where(last, rod.point_weights, 0) / mass
        change = column(self.force, state.positions) * dt * at_tip
        return jnp.broadcast_to(change, state.positions.shape)


@pytree
class Drag(VelocityEffect):
    """dv = -(1 - exp(-dt / T)) v: velocities fade by a factor e in the time T.

    Arguments:
        time: T [s], above 0. The result over a second does not depend on dt.
    """

    each_strand_alone = True
    time: Any = 0.1

    def __post_init__(self) -> None:
        check.positive("Drag.time", self.time)

    def velocity_change(self, rod: Rod, state: State, dt: float) -> Array:
        """-(1 - exp(-dt / T)) v."""
        return jnp.expm1(-dt / self.time) * state.velocities


@pytree
class Wind(VelocityEffect):
    """A stream of air that is strongest on its axis and across the hair.

    Arguments:
        blower: a point on the axis, where the air comes from [m], shape (3,).
        target: where it goes to [m], shape (3,), not the blower.
        strength: alpha, acceleration on the axis across the hair [m/s^2].
        width: the length by which the distance from the axis is counted [m]; the paper's 1 cm.
    """

    each_strand_alone = True
    blower: Any
    target: Any
    strength: Any
    width: Any = 0.01

    def __post_init__(self) -> None:
        name = type(self).__name__
        check.vector(f"{name}.blower", self.blower)
        check.vector(f"{name}.target", self.target)
        blower, target = check.known(self.blower), check.known(self.target)
        if (
            blower is not None
            and target is not None
            and np.abs(blower - target).max() < check.SMALLEST
        ):
            given = check.short(self.target)
            raise ValueError(f"{name}.target is {given}; it must differ from the blower")
        check.not_negative(f"{name}.strength", self.strength)
        check.positive(f"{name}.width", self.width)

    def velocity_change(self, rod: Rod, state: State, dt: float) -> Array:
        """dv_w = alpha sin(theta) / (d / width + 1) w dt (Eq. 17).

        w is the wind's direction, theta its angle with the edge that starts at the point, d the
        point's distance from the axis. sin(theta) is the norm of the edge's part across the wind,
        which has no infinite slope where the edge is parallel to it.
        """
        x = state.positions
        blower = column(self.blower, x)
        w = quat.unit(column(self.target, x) - blower)
        sine = quat.safe_norm(_across(rod.tangents(x), w))
        distance = quat.safe_norm(_across(x - blower, w))
        return self.strength * dt * sine / (distance / self.width + 1) * w


def _across(vectors: Array, unit: Array) -> Array:
    """The part of vectors (points, 3, strands) that is perpendicular to a unit vector (1, 3, 1)."""
    return vectors - quat.dot(vectors, unit) * unit


@pytree
class DryingWind(Wind, BondEffect):
    """Wind that dries the hair: hydrogen bonds re-form where it blows.

    Arguments: those of `Wind`, and
        drying: rise of the hydrogen fraction for each m/s that the wind adds to the velocity
            [s/m]; the paper's 0.003.
    """

    each_strand_alone = True
    drying: Any = 0.003

    def __post_init__(self) -> None:
        Wind.__post_init__(self)
        check.not_negative("DryingWind.drying", self.drying)

    @property
    def kinds_cut(self) -> tuple[str, ...]:
        return ()

    @property
    def kinds_formed(self) -> tuple[str, ...]:
        return ("hydrogen",)

    def fraction_change(
        self, kind: str, fraction: Array, rod: Rod, state: State, dt: float
    ) -> Array:
        """db = 0.003 |dv_w| while b < 1 (Eq. 19); dv_w carries dt, so the rate does not."""
        speed = quat.safe_norm(self.velocity_change(rod, state, dt))[1:-1, 0]
        return self.drying * speed
