"""Hair against hair: a penalty that pushes apart what comes closer than two radii."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import check
from jaxhair import quaternion as quat
from jaxhair.effects import VelocityEffect
from jaxhair.pytree import pytree, static
from jaxhair.rods import Rod
from jaxhair.strands import State


@pytree
class HairContact(VelocityEffect):
    """Penalty between the points of a strand and the edges of all others.

    Arguments:
        radius: r [m]; a simulated strand stands for a wisp, so this is the wisp's radius.
        strength: alpha, acceleration of two strands that coincide [m/s^2].
        in_gradients: False takes the pushes as given where derivatives are taken. Collisions are
            chaotic: through many of them a gradient says nothing of where a scene tends to, and
            a biased one that is smooth does (`tests/benchmarks/horizon.py` measures both).

    All pairs are looked at: time grows with the square of the number of strands.
    """

    radius: Any = 1e-3
    strength: Any = 20.0
    in_gradients: bool = static(default=True)

    def __post_init__(self) -> None:
        check.positive("HairContact.radius", self.radius)
        check.not_negative("HairContact.strength", self.strength)
        check.flag("HairContact.in_gradients", self.in_gradients)

    def velocity_change(self, rod: Rod, state: State, dt: float) -> Array:
        """dv = sum_j alpha (2r - D) / (2r) n dt over the edges j nearer than 2r (Eq. 18).

        D is the distance to the nearest point of the edge, clamped to its ends, and n points
        from there. Where they coincide, to the rounding of positions, there is no direction, and
        no push.
        """
        x = state.positions
        strands = x.shape[-1]
        p = x[:, :, :, None]
        others = ~jnp.eye(strands, dtype=bool)
        exists = jnp.broadcast_to(rod.edge_exists(), (x.shape[0] - 1, 1, strands))

        def against_edge(total: Array, edge: Any) -> tuple[Array, None]:
            start, end, there = edge
            push = self._push(p, start, end)
            mask = others & there if rod.ragged else others
            return total + jnp.sum(jnp.where(mask[None, None], push, 0), axis=-1), None

        body = jax.checkpoint(against_edge, prevent_cse=False)
        total, _ = lax.scan(body, jnp.zeros_like(x), (x[:-1], x[1:], exists))
        pushed = self.strength * dt * total
        return pushed if self.in_gradients else lax.stop_gradient(pushed)

    def _push(self, p: Array, start: Array, end: Array) -> Array:
        """(2r - D) / (2r) n of points (points, 3, strands, 1) from edges (3, strands)."""
        along = (end - start)[None, :, None, :]
        start = start[None, :, None, :]
        square = jnp.sum(along**2, axis=1, keepdims=True)
        place = jnp.sum((p - start) * along, axis=1, keepdims=True)
        place = jnp.clip(place / jnp.where(square == 0, 1, square), 0, 1)
        apart = p - (start + place * along)
        apart, p = jnp.moveaxis(apart, 1, -2), jnp.moveaxis(p, 1, -2)  # where the norms expect it
        rounding = 4 * np.finfo(p.dtype).eps * jnp.max(jnp.abs(p), axis=-2, keepdims=True)
        nowhere = jnp.all(jnp.abs(apart) <= rounding, axis=-2, keepdims=True)  # NaN is not
        apart = jnp.where(nowhere, 0, apart)
        depth = jnp.maximum(1 - quat.safe_norm(apart) / (2 * self.radius), 0)
        return jnp.moveaxis(depth * quat.unit(apart), -2, 1)
