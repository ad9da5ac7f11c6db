"""Hair against hair: a penalty that pushes apart what comes closer than two radii."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import check
from jaxhair import quaternion as quat
from jaxhair.effects import RememberingEffect
from jaxhair.neighbours import batch_here, near_pairs, places
from jaxhair.pytree import pytree, static
from jaxhair.rods import Rod
from jaxhair.stored import stored
from jaxhair.strands import State

FULL = 0.8
"""Share of the room in lists that a new skin is meant to fill."""
LEAST = 1e-3
"""Skins below this share of an edge's length are taken as none."""


@pytree
class Lists:
    """Pairs of points and edges that may touch, for as long as hair moves little.

    Arguments:
        points, edges: of `neighbours.Pairs` that were nearer than two radii and the skin when the
            lists were made, shape (chunks, pairs of a chunk). count: of such pairs, shape ().
        order: of `neighbours.Pairs`: along it points of a chunk lie close together in memory, too.
            back: the place in it of each point.
        skin: by how much hairs may have come nearer since [m], shape (); below 0 where there was no
            room even for what touched.
        positions: when the lists were made [m], shape (points, 3, strands).
        builds: how often lists were made, shape ().
    """

    points: Array
    edges: Array
    count: Array
    order: Array
    back: Array
    skin: Array
    positions: Array
    builds: Array

    def hold(self, positions: Array) -> Array:
        """Whether no pair that touches is missing, shape (). Never where a position is NaN."""
        moved = positions - self.positions
        # no two points have moved further against each other than the diagonal of all moves' box
        box = jnp.max(moved, axis=(0, 2)) - jnp.min(moved, axis=(0, 2))
        return jnp.sqrt(jnp.sum(box**2)) <= self.skin

    def fitting(self) -> Array:
        """By how much a skin may grow, or must shrink: pairs grow with about its square."""
        count = jnp.maximum(self.count, 1).astype(self.skin.dtype)
        return jnp.sqrt(FULL * self.points.size / count)


@pytree
class HairContact(RememberingEffect):
    """Penalty between the points of a strand and the edges of all others.

    Arguments:
        radius: r [m]; a simulated strand stands for a wisp, so this is the wisp's radius.
        strength: alpha, acceleration of two strands that coincide [m/s^2].
        in_gradients: False takes the pushes as given where derivatives are taken. Collisions are
            chaotic: through many of them a gradient says nothing of where a scene tends to, and
            a biased one that is smooth does (`tests/benchmarks/horizon.py` measures both).
        capacity: edges near a point, in the mean over all points, for which there is room. Time
            and memory grow with it; with too little, near edges are looked for more often.

    Pairs that may touch are kept in lists until hairs have moved against each other, so that time
    grows with the number of points and not with its square. Where points touch more than `capacity`
    edges, in the mean, all pushes are NaN, and `jaxhair.simulate` raises an error that says so.
    Under `jax.vmap` lists are made in every step.
    """

    radius: Any = 1e-3
    strength: Any = 20.0
    in_gradients: bool = static(default=True)
    capacity: int = static(default=16)

    def __post_init__(self) -> None:
        check.positive("HairContact.radius", self.radius)
        check.not_negative("HairContact.strength", self.strength)
        check.flag("HairContact.in_gradients", self.in_gradients)
        check.whole("HairContact.capacity", self.capacity, least=1)

    def recalled_change(self, rod: Rod, state: State, dt: float, memory: Lists) -> Array:
        """dv = sum_j alpha (2r - D) / (2r) n dt over the edges j nearer than 2r (Eq. 18).

        D is the distance to the nearest point of the edge, clamped to its ends, and n points
        from there. Where they coincide, to the rounding of positions, there is no direction, and
        no push. NaN everywhere if the lists do not hold.
        """
        x, strands, size = _flat(state.positions), state.positions.shape[2], len(memory.order)
        starts, ends = (
            stored(x.at[:, n].get(mode="clip")) for n in (memory.order, memory.order + strands)
        )

        def added(total: tuple[Array, ...], at: Array, edge: Array) -> tuple[Array, ...]:
            p, start, end = (
                y.at[:, n].get(mode="clip") for y, n in ((starts, at), (starts, edge), (ends, edge))
            )
            push = quat.components(stored(jnp.where(at < size, self._push(p, start, end), 0)))
            return tuple(
                t.at[at].add(one[0], mode="drop") for t, one in zip(total, push, strict=True)
            )

        def with_chunk(total: tuple[Array, ...], pairs: tuple[Array, Array]) -> tuple[Any, None]:
            at, edge = pairs  # those behind the last pair are left out
            return lax.cond(at[0] < size, added, lambda total, *_: total, total, at, edge), None

        body = jax.checkpoint(with_chunk, prevent_cse=False)
        total, _ = lax.scan(body, (jnp.zeros_like(starts[0]),) * 3, (memory.points, memory.edges))
        holds = memory.hold(lax.stop_gradient(state.positions))
        pushed = self.strength * dt * jnp.where(holds, stored(jnp.stack(total)), jnp.nan)
        pushed = jnp.moveaxis(pushed[:, memory.back].reshape(3, -1, strands), 0, 1)
        return pushed if self.in_gradients else lax.stop_gradient(pushed)

    def _push(self, p: Array, start: Array, end: Array) -> Array:
        """(2r - D) / (2r) n of points from edges, each of shape (3, pairs)."""
        x, y, z = quat.components(jnp.abs(p))
        rounding = 4 * np.finfo(p.dtype).eps * jnp.maximum(jnp.maximum(x, y), z)
        along, p = stored(end - start), stored(p - start)
        square = quat.dot(along, along)
        place = jnp.clip(quat.dot(p, along) / jnp.where(square == 0, 1, square), 0, 1)
        apart = stored(p - place * along)  # of small numbers: where hair is has no rounding here
        nowhere = jnp.all(jnp.abs(apart) <= rounding, axis=-2, keepdims=True)  # NaN is not
        apart = stored(jnp.where(nowhere, 0, apart))
        depth = jnp.maximum(1 - quat.safe_norm(apart) / (2 * self.radius), 0)
        return depth * quat.unit(apart)

    def blank(self, rod: Rod, state: State) -> Lists:
        """Lists that hold nowhere."""
        points, _, strands = state.positions.shape
        room = points * strands * min(self.capacity, (points - 1) * max(strands - 1, 1))
        chunks = -(-room // batch_here().pushes)
        size = places(points * strands)
        none = jnp.full((chunks, -(-room // chunks)), size, jnp.int32)
        x, number = lax.stop_gradient(state.positions), jnp.arange(size, dtype=jnp.int32)
        return Lists(
            none,
            none,
            jnp.int32(none.size + 1),
            number,
            number[: points * strands],
            -jnp.ones_like(x[0, 0, 0]),
            x,
            jnp.int32(0),
        )

    def remembered(self, rod: Rod, state: State, memory: Lists) -> Lists:
        """The lists as they are, if they hold, or new ones."""
        # which edges are near is no number: no derivative goes through it
        rod, x = lax.stop_gradient((rod, state.positions))
        radius = lax.stop_gradient(jnp.asarray(self.radius, x.dtype))
        return lax.cond(memory.hold(x), lambda: memory, lambda: _renewed(memory, rod, x, radius))

    def fault(self, rod: Rod, state: State) -> str:
        """That more edges touch points than there is room for."""
        lists = self.remembered(rod, state, self.blank(rod, state))
        if lists.count <= lists.points.size:
            return ""
        mean = int(lists.count) / state.positions[:, 0].size
        return (
            f"finds {mean:.1f} edges within two radii of a point, in the mean, and "
            f"HairContact.capacity is {self.capacity}; set it to {int(mean) + 1} or more, or take "
            "a smaller radius"
        )


def _renewed(memory: Lists, rod: Rod, x: Array, radius: Array) -> Lists:
    """New lists, with the widest skin that there is room for, as far as the last skin tells."""
    points, _, strands = x.shape
    starts, ends = x, jnp.concatenate([x[1:], jnp.full_like(x[:1], jnp.nan)])
    if rod.ragged:
        exists = rod.edge_exists()
        starts = jnp.where(rod.point_exists(), starts, jnp.nan)
        ends = jnp.where(jnp.concatenate([exists, ~exists[:1]]), ends, jnp.nan)
    of_strands = jnp.tile(jnp.arange(strands, dtype=jnp.int32), points)
    rounding = 32 * np.finfo(x.dtype).eps * jnp.max(jnp.abs(x))
    room, builds = memory.points.size, memory.builds + 1

    def tried(carry: tuple[Array, Lists]) -> tuple[Array, Lists]:
        skin, _ = carry
        reach = 2 * radius + skin + rounding
        pairs = near_pairs(_flat(starts), _flat(ends), of_strands, reach, room)
        at, edges = (numbers.reshape(memory.points.shape) for numbers in pairs[:2])
        none = (pairs.number > room) & (skin == 0)
        far = ~jnp.isfinite(reach**2)  # so large are positions that no distance can be told
        kept = jnp.where(none | far, -1, skin)
        lists = Lists(at, edges, pairs.number, pairs.order, memory.back, kept, x, builds)
        smaller = skin * jnp.minimum(lists.fitting(), 0.7)
        return jnp.where(smaller < LEAST * edge, 0, smaller), lists

    def too_many(carry: tuple[Array, Lists]) -> Array:
        return (carry[1].count > room) & (carry[1].skin >= 0)

    edge = jnp.mean(rod.lengths, where=rod.lengths > 0)
    skin = memory.skin * jnp.minimum(memory.fitting(), 1.5)
    skin = jnp.clip(skin, LEAST * edge, edge / 2)  # boxes around edges are no smaller
    skin = jnp.where(memory.builds == 0, edge / 4, skin)
    untried = replace(memory, count=jnp.int32(room + 1), skin=jnp.zeros_like(skin))
    lists = lax.while_loop(too_many, tried, (skin, untried))[1]
    every = jnp.arange(len(lists.order), dtype=jnp.int32)
    back = jnp.zeros_like(lists.back).at[lists.order].set(every, mode="drop")
    return replace(lists, back=back)


def _flat(x: Array) -> Array:
    """(points, components, strands) to (components, points of all strands)."""
    return jnp.moveaxis(x, 1, 0).reshape(x.shape[1], -1)
