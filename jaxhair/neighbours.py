"""Which edges of other strands are near which points, found in time linear in their number.

Points are sorted along a curve that fills space (Hilbert's), so that each 32 of them in a row, a
block, lie close together, and so do the edges that start at them. Boxes around blocks, and around
32 blocks, tell which blocks are near each other; only between those are distances computed.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxhair.sums import summed

BLOCK = 32
"""Points in a block, and blocks in a group: the bits of a word, one for each edge of a block."""


class Batch(NamedTuple):
    """What is worked on together.

    groups: pairs of groups whose blocks are compared. blocks: pairs of blocks whose distances are
    computed. pairs: pairs of a point and an edge that are listed. pushes: pairs whose contact is
    computed.
    """

    groups: int
    blocks: int
    pairs: int
    pushes: int


IN_CACHE = Batch(1, 64, 512, 2**13)
"""For a CPU, where a batch should stay in cache."""
WIDE = Batch(128, 2**13, 2**17, 2**20)
"""For a GPU, where a batch should fill the device: on an H200 the contact of 20,000 strands takes
a hundredth of the time that it takes in batches for a CPU
(`tests/benchmarks/accelerator.py contact`)."""


def batch_here() -> Batch:
    """What suits JAX's device."""
    return IN_CACHE if jax.default_backend() == "cpu" else WIDE


class Pairs(NamedTuple):
    """Pairs of a point and an edge that are near each other, in no particular order.

    points, edges: places, along the curve, of the points and of the points where the edges start,
        shape (capacity,); behind the last pair, the number of places, which is no place.
    number: of pairs that are near, also of those that found no room, shape ().
    order: the point at each place, shape (places,); behind the last one, the number of points.
    """

    points: Array
    edges: Array
    number: Array
    order: Array


def places(points: int) -> int:
    """Places along the curve that some points have in whole groups of blocks."""
    return -(-points // BLOCK**2) * BLOCK**2


def near_pairs(
    starts: Array,
    ends: Array,
    strands: Array,
    reach: Array,
    capacity: int,
    batch: Batch | None = None,
) -> Pairs:
    """The pairs of a point and an edge of another strand whose distance is less than `reach`.

    Arguments:
        starts: points [m], shape (3, points); NaN where there is none.
        ends: of the edge that starts at each point [m], shape (3, points); NaN where there is none.
        strands: number of the strand of each point, shape (points,).
        reach: [m], shape ().
        batch: what is worked on together; by default what suits JAX's device.
    """
    batch = batch or batch_here()
    size = starts.shape[1]
    order = jnp.argsort(_along_the_curve(starts)).astype(jnp.int32)
    groups = places(size) // BLOCK**2
    order = jnp.pad(order, (0, places(size) - size), constant_values=size)

    def blocks(x: Array, nothing: Any) -> Array:
        """(components, points) to (components, blocks, block)."""
        x = x.at[:, order].get(mode="fill", fill_value=nothing)
        return x.reshape(len(x), -1, BLOCK)

    p, q = blocks(starts, jnp.nan), blocks(ends, jnp.nan)
    own = blocks(strands[None], -1)[0]
    of_points, of_edges = _box(p, p), _box(p, q)
    along = q - p
    square = summed(along**2, 0)
    across = along / jnp.where(square == 0, 1, square)
    pairs_of_groups, many_groups = _listed(_near(_whole(of_points), _whole(of_edges), reach))
    at_once = min(batch.groups, groups**2)
    blocks_at_once = min(batch.blocks, at_once * BLOCK**2)

    def of_groups(number: Array, found: Pairs) -> Pairs:
        """With the pairs of the points of one group and the edges of another, of some of them."""
        numbers = jnp.asarray(number, jnp.int32) * at_once + jnp.arange(at_once, dtype=jnp.int32)
        numbers = jnp.where(numbers < many_groups, numbers, groups**2)
        pairs = pairs_of_groups.at[numbers].get(mode="fill", fill_value=groups**2)
        first, second = jnp.divmod(pairs, groups)  # behind the last: no group
        near = _near(_of_groups(of_points, first), _of_groups(of_edges, second), reach)
        tiles, many = _listed(near)

        def some(carry: tuple[Array, Pairs]) -> tuple[Array, Pairs]:
            done, found = carry
            number = done + jnp.arange(blocks_at_once, dtype=done.dtype)
            tile = tiles[jnp.minimum(number, len(tiles) - 1)]
            pair, place = jnp.divmod(tile, BLOCK**2)
            a, b = jnp.divmod(place, BLOCK)
            a, b = first[pair] * BLOCK + a, second[pair] * BLOCK + b
            apart = p[:, a, None] - p[:, b, :, None]  # (3, tiles, edges, points)
            place = jnp.clip(summed(apart * across[:, b, :, None], 0), 0, 1)
            square = summed((apart - place * along[:, b, :, None]) ** 2, 0)[0]
            near = (square < reach**2) & (own[a, None] != own[b, :, None])
            words = _words(near)
            words = jnp.where((number < many)[:, None], words, 0)
            return done + blocks_at_once, _with(found, words, a, b, batch.pairs)

        start = jnp.zeros_like(many), found
        return lax.while_loop(lambda carry: carry[0] < many, some, start)[1]

    none = jnp.full(capacity + batch.pairs, len(order), jnp.int32)
    found = Pairs(none, none, jnp.zeros((), jnp.int32), order)
    found = lax.fori_loop(0, -(-many_groups // at_once), of_groups, found)
    inside = jnp.arange(capacity, dtype=jnp.int32) < found.number
    points, edges = (jnp.where(inside, x[:capacity], len(order)) for x in found[:2])
    return Pairs(points, edges, found.number, order)


def _listed(true: Array) -> tuple[Array, Array]:
    """The places of what is true in a flattened mask, then zeros; and how many are true."""
    true = true.ravel()
    ends = jnp.cumsum(true, dtype=jnp.int32)
    numbers = jnp.arange(true.size, dtype=jnp.int32)
    # as `jnp.nonzero` finds them, which takes twice as long to compile
    to = jnp.where(true, ends - 1, true.size)
    return jnp.zeros_like(ends).at[to].set(numbers, mode="drop"), ends[-1]


def _along_the_curve(points: Array) -> Array:
    """Where along Hilbert's curve points (3, points) are, by Skilling's algorithm.

    J. Skilling, Programming the Hilbert curve, 2004 (DOI 10.1063/1.1751381); 10 bits a coordinate.
    """
    low = jnp.nanmin(points, axis=1, keepdims=True)
    extent = jnp.nanmax(points - low)
    at = (points - low) * jnp.where(extent > 0, 1023 / jnp.where(extent > 0, extent, 1), 0)

    def turned(number: Array, x: tuple[Array, ...]) -> tuple[Array, ...]:
        bit = jnp.int32(512) >> jnp.asarray(number, jnp.int32)
        first, rest = x[0], list(x)
        for axis in range(3):
            here = first if axis == 0 else rest[axis]
            is_set = (here & bit) != 0
            swapped = jnp.where(is_set, 0, (first ^ here) & (bit - 1))
            first = first ^ jnp.where(is_set, bit - 1, swapped)
            rest[axis] = here ^ swapped
        return first, *rest[1:]

    x, y, z = lax.fori_loop(0, 9, turned, tuple(jnp.where(jnp.isfinite(at), at, 0).astype("int32")))
    y = x ^ y
    z = y ^ z
    flipped = z >> 1  # a bit of it is whether the higher ones of z that are set are odd in number
    for shift in (1, 2, 4, 8):
        flipped = flipped ^ (flipped >> shift)
    bits = jnp.stack([x, y, z]) ^ flipped[None]
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        bits = (bits | (bits << shift)) & mask
    return (bits[0] << 2) | (bits[1] << 1) | bits[2]


Box = tuple[Array, Array]
"""Lowest and highest coordinates, each of shape (3, boxes)."""


def _box(p: Array, q: Array) -> Box:
    """Boxes around segments (3, boxes, segments), of which those with NaN do not count."""
    there = ~jnp.isnan(p + q)
    low = jnp.min(jnp.where(there, jnp.minimum(p, q), jnp.inf), axis=-1)
    return low, jnp.max(jnp.where(there, jnp.maximum(p, q), -jnp.inf), axis=-1)


def _whole(boxes: Box) -> Box:
    """Boxes around groups of boxes."""
    low, high = (x.reshape(3, -1, BLOCK) for x in boxes)
    return low.min(axis=-1), high.max(axis=-1)


def _of_groups(boxes: Box, groups: Array) -> Box:
    """Boxes of blocks of some groups, shape (3, groups, BLOCK); empty ones where there is none."""
    low, high = (x.reshape(3, -1, BLOCK) for x in boxes)
    return (
        low.at[:, groups].get(mode="fill", fill_value=jnp.inf),
        high.at[:, groups].get(mode="fill", fill_value=-jnp.inf),
    )


def _near(a: Box, b: Box, reach: Array) -> Array:
    """Whether boxes (3, ..., boxes) are nearer than `reach`, shape (..., boxes of a, boxes of b).
    Empty ones are not."""
    (low_a, high_a), (low_b, high_b) = a, b
    above = low_b[..., None, :] - high_a[..., None]
    below = low_a[..., None] - high_b[..., None, :]
    return jnp.sum(jnp.maximum(jnp.maximum(above, below), 0) ** 2, axis=0) < reach**2


def _words(true: Array) -> Array:
    """What is true of 32 edges in the bits of a word: (tiles, edges, points) to (tiles, points)."""
    bits = jnp.uint32(1) << jnp.arange(BLOCK, dtype=jnp.uint32)
    return jnp.sum(jnp.where(true, bits[None, :, None], jnp.uint32(0)), axis=1, dtype=jnp.uint32)


def _with(found: Pairs, words: Array, a: Array, b: Array, at_once: int) -> Pairs:
    """With the pairs that words of bits (tiles, BLOCK) name, of points in blocks a, edges in b."""
    capacity = len(found.points) - at_once
    words = words.ravel()
    ends = jnp.cumsum(lax.population_count(words).astype(jnp.int32))
    many = ends[-1]

    def some(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        done, points, edges = carry
        number = done + jnp.arange(at_once, dtype=jnp.int32)
        word = jnp.searchsorted(ends, number, side="right").astype(jnp.int32)
        word = jnp.minimum(word, len(words) - 1)
        before = ends[word] - lax.population_count(words[word]).astype(jnp.int32)
        tile, point = jnp.divmod(word, BLOCK)
        edge = _bit(words[word], number - before)
        at = jnp.minimum(found.number + done, capacity)
        points = lax.dynamic_update_slice(points, a[tile] * BLOCK + point, (at,))
        edges = lax.dynamic_update_slice(edges, b[tile] * BLOCK + edge, (at,))
        return done + at_once, points, edges

    carry = jnp.zeros((), jnp.int32), found.points, found.edges
    _, points, edges = lax.while_loop(lambda carry: carry[0] < many, some, carry)
    return Pairs(points, edges, found.number + many, found.order)


def _bit(word: Array, number: Array) -> Array:
    """The place of the bit of a word that is set and has so many others that are set below it."""
    place = jnp.zeros_like(number)
    for width in (16, 8, 4, 2, 1):
        low = word & jnp.uint32(2**width - 1)
        below = lax.population_count(low).astype(number.dtype)
        above = number >= below
        number = jnp.where(above, number - below, number)
        place = jnp.where(above, place + width, place)
        word = jnp.where(above, word >> jnp.uint32(width), low)
    return place
