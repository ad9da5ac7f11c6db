"""Many smooth hairs out of a few angular strands, for pictures only.

The simulated strands are guide hairs; further hairs are interpolated between them, and Bezier
curves join the points of each.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from jaxhair import check

Array = np.ndarray


@dataclass(frozen=True)
class Interpolation:
    """Where further hairs grow about simulated strands: drawn once, then used for every frame.

    guide: strand that a hair follows, shape (hairs,); the first hair of each strand is itself.
    neighbours, weights: the strands that it leans towards and how much, shape (hairs, 2).
    offset: [m] by which it stands off in any case, shape (hairs, 3).
    clumping: how much of all that is gone at the tip, shape (hairs,).
    cut: part of the length missing at the tip, shape (hairs,).
    shade: factor of the colour, shape (hairs,).
    reach: [m] beyond which a strand pulls no harder.
    """

    guide: Array
    neighbours: Array
    weights: Array
    offset: Array
    clumping: Array
    cut: Array
    shade: Array
    reach: float

    @classmethod
    def between(cls, points: Array, hairs_per_strand: int, seed: int) -> "Interpolation":
        """points: one frame [m], shape (strands, points, 3)."""
        strands = len(points)
        length = float(np.median(np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(1)))
        index, distance = _nearest(points[:, 0], 6)
        spacing = float(np.median(distance[:, 0])) if strands > 1 else np.inf
        reach = max(min(3 * spacing, 0.1 * length), 1e-9)
        random = np.random.default_rng(seed)
        guide = np.repeat(np.arange(strands), hairs_per_strand)
        hairs = len(guide)
        extra = (np.arange(hairs) % hairs_per_strand != 0).astype(float)
        # The nearest strand counts most, so that hairs of one strand stay in its own surroundings.
        shares = np.sort(random.dirichlet([1, 1, 1], hairs), -1)[:, :2] * extra[:, None]
        chosen = np.argsort(random.random((hairs, index.shape[1])), -1)[:, :2]
        neighbours = np.take_along_axis(index[guide], chosen, -1)
        near = np.take_along_axis(distance[guide], chosen, -1) <= reach
        wisp = 0.006 * length * np.where(near.any(-1), 0.5, 1.0)
        direction = random.standard_normal((hairs, 3))
        return cls(
            guide=guide,
            neighbours=neighbours,
            weights=shares[:, : near.shape[1]] * near,
            offset=direction * (np.minimum(wisp, 0.3 * spacing) * extra)[:, None],
            clumping=random.uniform(0.1, 0.6, hairs),
            cut=np.abs(random.normal(0, 0.03, hairs)) * extra,
            shade=np.exp(random.normal(0, 0.18, hairs)),
            reach=reach,
        )

    def part(self, rows: slice) -> "Interpolation":
        """Some of the hairs."""
        each = {f.name: getattr(self, f.name)[rows] for f in fields(self) if f.name != "reach"}
        return replace(self, **each)

    def hairs(self, points: Array, counts: Array) -> Array:
        """All hairs [m], shape (hairs, points, 3)."""
        own = points[self.guide]
        place = np.arange(points.shape[1])
        along = np.minimum(place / np.maximum(counts[self.guide, None] - 1, 1), 1)
        lean = np.zeros_like(own)
        for k in range(self.neighbours.shape[1]):
            other = self.neighbours[:, k]
            # Past the tip of the shorter one, the hairs run on side by side.
            both = np.minimum(counts[self.guide], counts[other])[:, None] - 1
            upto = np.minimum(place, both)[..., None]
            apart = np.take_along_axis(points[other] - own, upto, 1)
            far = np.linalg.norm(apart, axis=-1, keepdims=True) / self.reach
            lean += self.weights[:, k, None, None] * apart / (1 + far**2) ** 0.5
        lean += self.offset[:, None] * np.minimum(0.35 + 2 * along, 1)[..., None]
        grown: Array = own + lean * (1 - self.clumping[:, None] * along**1.5)[..., None]
        return grown.astype(points.dtype)


def _nearest(places: Array, most: int) -> tuple[Array, Array]:
    """Indices and distances of the other places next to each, nearest first."""
    count = min(most, len(places) - 1)
    index = np.zeros((len(places), max(count, 1)), int)
    distance = np.full(index.shape, np.inf)
    for start in range(0, len(places) if count else 0, 512):
        rows = np.arange(start, min(start + 512, len(places)))
        square = np.sum((places[rows, None] - places) ** 2, -1)
        square[np.arange(len(rows)), rows] = np.inf
        near = np.argpartition(square, count - 1, -1)[:, :count]
        order = np.argsort(np.take_along_axis(square, near, -1), -1, kind="stable")
        index[rows] = np.take_along_axis(near, order, -1)
        distance[rows] = np.sqrt(np.take_along_axis(square, index[rows], -1))
    return index, distance


def used_points(counts: Array | None, points: Array) -> Array:
    """`counts`, checked, or else what they are where padding repeats the last point."""
    strands, most = points.shape[:2]
    if counts is None:
        moves = np.any(np.diff(points, axis=1) != 0, -1)
        return np.asarray(np.where(moves.any(1), most - np.argmax(moves[:, ::-1], 1), most))
    check.shape("counts", counts, (strands,))
    for count in counts:
        check.whole("counts", count, least=2)
        if count > most:
            raise ValueError(f"counts has the value {count}; it must be at most {most}")
    return np.asarray(counts)


def bezier(points: Array, counts: Array, pieces: int) -> tuple[Array, Array]:
    """Smooth curves through `points` and their derivatives.

    Between two points lies a cubic Bezier curve whose inner control points continue the chords
    (Catmull and Rom). points: shape (hairs, points, 3); counts: points in use, at least 2, shape
    (hairs,), beyond which a curve stays where it is. Both results have the shape (hairs,
    (points - 1) pieces + 1, 3).
    """
    last = (counts - 1)[:, None]
    place = np.arange(points.shape[1])

    def at(shift: int) -> Array:
        return np.take_along_axis(points, np.clip(place + shift, 0, last)[..., None], 1)

    here, before, after = at(0), at(-1), at(1)
    slope = (after - before) / 2
    # At the ends, the parabola through three points keeps the curl.
    curved = (last > 1)[..., None]
    first = np.where(curved, 2 * (after - here) - (at(2) - here) / 2, after - here)
    final = np.where(curved, 2 * (here - before) - (here - at(-2)) / 2, here - before)
    slope = np.where((place == 0)[:, None], first, slope)
    slope = np.where((place == last)[..., None], final, slope)
    start, end = here[:, :-1], here[:, 1:]
    control = np.stack([start, start + slope[:, :-1] / 3, end - slope[:, 1:] / 3, end], 2)
    t = (np.arange(pieces) / pieces).astype(points.dtype)
    value = _bernstein(3, t) @ control
    rate = 3 * _bernstein(2, t) @ np.diff(control, axis=2)
    shape = (len(points), -1, 3)
    curve = np.concatenate([value.reshape(shape), end[:, -1:]], 1)
    rate = np.concatenate([rate.reshape(shape), slope[:, -1:]], 1)
    if np.min(counts) < points.shape[1]:
        upto = np.minimum(np.arange(curve.shape[1]), last * pieces)[..., None]
        curve, rate = (np.take_along_axis(x, upto, 1) for x in (curve, rate))
    return curve, rate


def _bernstein(degree: int, t: Array) -> Array:
    """Bernstein polynomials at t, shape (n, degree + 1)."""
    return np.stack(
        [math.comb(degree, k) * t**k * (1 - t) ** (degree - k) for k in range(degree + 1)], -1
    )
