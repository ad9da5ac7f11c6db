"""Hair against hair by looking at all pairs of points and edges: what `HairContact` must agree
with. Time grows with the square of the number of strands."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import HairContact, State
from jaxhair import quaternion as quat
from jaxhair.contact import Lists
from jaxhair.rods import Rod

CHUNK = 2**15  # pairs computed together


def velocity_change(contact: HairContact, rod: Rod, state: State, dt: float) -> Array:
    """dv = sum_j alpha (2r - D) / (2r) n dt over the edges j nearer than 2r (Eq. 18)."""
    x = state.positions
    strands = x.shape[-1]
    p = x[:, :, :, None]
    others = ~jnp.eye(strands, dtype=bool)
    exists = jnp.broadcast_to(rod.edge_exists(), (x.shape[0] - 1, 1, strands))

    def against_edge(total: Array, edge: Any) -> tuple[Array, None]:
        start, end, there = edge
        pushed = push(p, start, end, contact.radius)
        mask = others & there if rod.ragged else others
        return total + jnp.sum(jnp.where(mask[None, None], pushed, 0), axis=-1), None

    body = jax.checkpoint(against_edge, prevent_cse=False)
    total, _ = lax.scan(body, jnp.zeros_like(x), (x[:-1], x[1:], exists))
    return contact.strength * dt * total


def push(p: Array, start: Array, end: Array, radius: Any) -> Array:
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
    depth = jnp.maximum(1 - quat.safe_norm(apart) / (2 * radius), 0)
    return jnp.moveaxis(depth * quat.unit(apart), -2, 1)


def listed(state: State, strands: Any) -> Lists:
    """Lists of all points of some strands with all edges of all others.

    With them `HairContact.recalled_change` computes each pair as it always does, rounding
    included, so that nothing but the order of sums may differ from what lists of neighbours give.
    """
    points, _, count = state.positions.shape
    at = (np.arange(points)[:, None] * count + np.asarray(strands)).ravel()
    at, edges = np.meshgrid(at, np.arange((points - 1) * count), indexing="ij")
    of_others = at % count != edges % count
    at, edges = at[of_others], edges[of_others]
    left = -at.size % CHUNK
    at, edges = (
        jnp.asarray(np.pad(x, (0, left), constant_values=points * count), jnp.int32)
        for x in (at, edges)
    )
    x, number = state.positions, jnp.int32(at.size - left)
    order = jnp.arange(points * count, dtype=jnp.int32)
    return Lists(
        at.reshape(-1, CHUNK), edges.reshape(-1, CHUNK), number, order, order,
        jnp.full((), jnp.inf, x.dtype), x, jnp.int32(1),
    )  # fmt: skip
