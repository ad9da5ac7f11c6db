"""Pictures and movies of hair: positions in metres in, .png, .gif and .mp4 out.

Simulated strands are few and angular. As in the paper (section 7.1), more hairs are interpolated
between them and the points of each are joined by Bezier curves; shading.py lights the result.
"""

import contextlib
import importlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxhair import check, raster, shading
from jaxhair.output import new_file
from jaxhair.raster import Array, Camera
from jaxhair.shading import Mesh

HAIR_COLOR = (0.36, 0.21, 0.12)
FIELD_OF_VIEW = math.radians(28)


@dataclass(frozen=True)
class View:
    """Where the picture is taken from; what is left out is chosen so that all hair is seen.

    azimuth: [rad] of the camera about the Z axis, from +X towards +Y.
    elevation: [rad] of the camera above the horizontal.
    target: point [m] in the middle of the picture, shape (3,).
    distance: [m] from the camera to the target.
    """

    azimuth: float = -1.2
    elevation: float = 0.25
    target: tuple[float, float, float] | None = None
    distance: float | None = None

    def __post_init__(self) -> None:
        for name in ("azimuth", "elevation"):
            check.shape(f"view.{name}", getattr(self, name), ())
            check.finite(f"view.{name}", getattr(self, name))
        if abs(self.elevation) > math.pi / 2:
            raise ValueError(
                f"view.elevation is {self.elevation!r}; it must be in [-pi/2, pi/2] (radians)"
            )
        if self.target is not None:
            check.vector("view.target", self.target)
        if self.distance is not None:
            check.shape("view.distance", self.distance, ())
            check.positive("view.distance", self.distance)


@dataclass(frozen=True)
class Interpolation:
    """Where further hairs grow about simulated strands: drawn once, then used for every frame.

    guide: strand that a hair follows, shape (hairs,); the first hair of each strand is itself.
    neighbours, weights: the strands that it leans towards and how much, shape (hairs, 2).
    offset: [m] by which it stands off in any case, shape (hairs, 3).
    clumping: how much of all that is gone at the tip, shape (hairs,).
    trimmed: part of the length cut off at the tip, shape (hairs,).
    shade: factor of the colour, shape (hairs,).
    reach: [m] beyond which a strand pulls no harder.
    """

    guide: Array
    neighbours: Array
    weights: Array
    offset: Array
    clumping: Array
    trimmed: Array
    shade: Array
    reach: float

    @classmethod
    def between(cls, points: Array, hairs_per_strand: int, seed: int) -> "Interpolation":
        """points: one frame [m], shape (strands, points, 3)."""
        strands = len(points)
        length = np.median(np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(1))
        index, distance = _nearest(points[:, 0], 6)
        spacing = float(np.median(distance[:, 0])) if strands > 1 else np.inf
        reach = min(3 * spacing, 0.1 * length)
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
            weights=shares * near,
            offset=direction * (np.minimum(wisp, 0.3 * spacing) * extra)[:, None],
            clumping=random.uniform(0.1, 0.6, hairs),
            trimmed=np.abs(random.normal(0, 0.03, hairs)) * extra,
            shade=np.exp(random.normal(0, 0.18, hairs)),
            reach=float(reach),
        )

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
        return own + lean * (1 - self.clumping[:, None] * along**1.5)[..., None]


def _nearest(places: Array, most: int) -> tuple[Array, Array]:
    """Indices and distances of the other places next to each, nearest first."""
    count = min(most, len(places) - 1)
    index = np.zeros((len(places), max(count, 1)), int)
    distance = np.full(index.shape, np.inf)
    for start in range(0, len(places) if count else 0, 512):
        rows = np.arange(start, min(start + 512, len(places)))
        square = np.sum((places[rows, None] - places) ** 2, -1)
        square[np.arange(len(rows)), rows] = np.inf
        index[rows] = np.argsort(square, -1, kind="stable")[:, :count]
        distance[rows] = np.sqrt(np.take_along_axis(square, index[rows], -1))
    return index, distance


def bezier(points: Array, counts: Array, pieces: int) -> tuple[Array, Array]:
    """Smooth curves through `points` and their derivatives.

    Between two points lies a cubic Bezier curve whose inner control points continue the chords
    (Catmull and Rom). points: shape (hairs, points, 3); counts: points in use, shape (hairs,);
    both results have the shape (hairs, (points - 1) pieces + 1, 3).
    """
    last = (np.maximum(counts, 2) - 1)[:, None]
    place = np.arange(points.shape[1])

    def at(index: Array) -> Array:
        return np.take_along_axis(points, np.clip(index, 0, last)[..., None], 1)

    # Mirrored end points would end straight; a parabola through the last three keeps the curl.
    here, before, after = at(place + 0 * last), at(place - 1 + 0 * last), at(place + 1 + 0 * last)
    slope = (after - before) / 2
    curved = (last > 1)[..., None]
    first = np.where(curved, 2 * (after - here) - (at(place + 2 + 0 * last) - here) / 2, after - here)
    final = np.where(
        curved, 2 * (here - before) - (here - at(place - 2 + 0 * last)) / 2, here - before
    )
    slope = np.where((place == 0)[:, None], first, slope)
    slope = np.where((place == last)[..., None], final, slope)
    start, end = here[:, :-1], here[:, 1:]
    control = np.stack([start, start + slope[:, :-1] / 3, end - slope[:, 1:] / 3, end], 2)
    t = np.arange(pieces) / pieces
    value = _bernstein(3, t) @ control
    rate = 3 * _bernstein(2, t) @ np.diff(control, axis=2)
    shape = (len(points), -1, 3)
    curve = np.concatenate([value.reshape(shape), end[:, -1:]], 1)
    return curve, np.concatenate([rate.reshape(shape), slope[:, -1:]], 1)


def _bernstein(degree: int, t: Array) -> Array:
    """Bernstein polynomials at t, shape (n, degree + 1)."""
    return np.stack(
        [math.comb(degree, k) * t**k * (1 - t) ** (degree - k) for k in range(degree + 1)], -1
    )


class _Artist:
    """What stays the same from one frame of a movie to the next."""

    def __init__(
        self,
        frames: Array,
        meshes: Sequence[Sequence[Mesh]],
        *,
        counts: Array | None,
        hairs_per_strand: int,
        view: View,
        size: tuple[int, int],
        color: tuple[float, float, float],
        seed: int,
        bar: bool,
        bonded: bool,
    ) -> None:
        check.whole("hairs_per_strand", hairs_per_strand, least=1)
        check.whole("seed", seed, least=0)
        check.shape("size", size, (2,))
        for side in size:
            check.whole("size", side, least=16)
        check.shape("color", color, (3,))
        check.fraction("color", color)
        if counts is None:
            counts = np.full(frames.shape[1], frames.shape[2])
        check.shape("counts", counts, (frames.shape[1],))
        for count in np.ravel(counts):
            check.whole("counts", count, least=2)
            if count > frames.shape[2]:
                raise ValueError(f"counts has the value {count}; it must be at most {frames.shape[2]}")
        self.counts = np.asarray(counts)
        self.color = shading.linear(np.asarray(color))
        self.stage = _stage(frames, meshes, view, size)
        self.interpolation = Interpolation.between(frames[0], hairs_per_strand, seed)
        self.notes = _notes(self.stage, bar=bar, bonded=bonded) if bar or bonded else None

    def draw(self, points: Array, bonded: Array | None, meshes: Sequence[Mesh]) -> Array:
        camera = self.stage.camera
        grown = self.interpolation
        counts = self.counts[grown.guide]
        coarse = grown.hairs(points, counts=self.counts)
        depth = max(float(np.min(camera.project(points)[..., 2])), 0.1 * self.stage.radius)
        longest = np.max(np.linalg.norm(np.diff(points, axis=1), axis=-1)) / depth * camera.focal
        pieces = int(np.clip(np.ceil(longest / 5), 1, 16))
        curves, rates = bezier(coarse, counts, pieces)
        steps = np.arange(curves.shape[1])
        ends = (counts - 1) * pieces * (1 - grown.trimmed)
        drawn = steps[:-1] < np.ceil(ends)[:, None]
        if bonded is None:
            colors = np.broadcast_to(self.color, curves.shape)
        else:
            index, part = np.divmod(steps, pieces)
            after = np.minimum(index + 1, points.shape[1] - 1)
            rise = (bonded[:, after] - bonded[:, index]) * (part / pieces)
            colors = shading.bonded_color((bonded[:, index] + rise)[grown.guide])
        colors = colors * grown.shade[:, None, None]
        norm = np.linalg.norm(rates, axis=-1, keepdims=True)
        hairs = shading.Hairs(
            points=curves.astype(np.float32),
            tangents=(rates / np.maximum(norm, 1e-30)).astype(np.float32),
            colors=colors.astype(np.float32),
            drawn=drawn,
            thickness=2,
            width=2*self.width,
        )
        image = shading.srgb(shading.render(self.stage, hairs, shading.Surfaces(meshes)))
        if self.notes is not None:
            ink, alpha = self.notes
            image = np.round(image * (1 - alpha) + ink * alpha).astype(np.uint8)
        return image

    @property
    def width(self) -> float:
        """[m] across one line, at the centre of the scene."""
        camera = self.stage.camera
        distance = float(np.linalg.norm(camera.position - self.stage.centre))
        return distance / camera.focal / shading.SUPERSAMPLING


def _stage(
    frames: Array, meshes: Sequence[Sequence[Mesh]], view: View, size: tuple[int, int]
) -> shading.Stage:
    towards = raster.axes_towards(view.azimuth, view.elevation)
    boxes = [_box(frames, meshes, axes) for axes in (towards, np.eye(3))]
    (low, high), (floor, roof) = boxes
    radius = max(float(np.linalg.norm(roof - floor)) / 2, 1e-4)
    centre = towards.T @ ((low + high) / 2)
    target = centre if view.target is None else np.asarray(view.target, float)
    focal = min(size) / 2 / math.tan(FIELD_OF_VIEW / 2)
    reach = np.maximum(high - towards @ target, towards @ target - low)
    distance = view.distance
    if distance is None:
        across = max(reach[0] / size[0], reach[1] / size[1]) * 2 * focal * 1.12
        distance = max(float(across + reach[2]), radius)
    camera = Camera(target - distance * towards[2], towards, focal, size)
    # The light comes over the left shoulder of the camera.
    lamp = raster.axes_towards(view.azimuth - 0.75, min(0.35 * view.elevation + 0.75, 1.4))
    far = 6 * radius
    light = Camera(centre - far * lamp[2], lamp, 250 * far / radius, (512, 512))
    return shading.Stage(camera, light, centre, radius)


def _box(frames: Array, meshes: Sequence[Sequence[Mesh]], axes: Array) -> tuple[Array, Array]:
    """Lowest and highest coordinates along `axes` of all hair and of what stands near it."""
    hair = [frame.reshape(-1, 3) @ axes.T for frame in frames]
    low = np.min([places.min(0) for places in hair], 0)
    high = np.max([places.max(0) for places in hair], 0)
    grown = 0.3 * np.max(high - low)
    least, most = low - grown, high + grown
    for frame in meshes:
        for vertices, _ in frame:
            places = vertices @ axes.T
            near = places[np.all((places >= least) & (places <= most), -1)]
            low, high = np.min([low, *near], 0), np.max([high, *near], 0)
    return low, high


def _notes(stage: shading.Stage, *, bar: bool, bonded: bool) -> tuple[Array, Array]:
    """Ink (bytes) and its opacity: a scale bar, and what the colours blue to red mean."""
    camera = stage.camera
    width, height = camera.size
    figure, canvas = _figure(width / 100, height / 100)
    unit = min(width, height) / 800
    style: dict[str, Any] = {"color": "0.15", "fontsize": 11 * unit, "ha": "center"}
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    if bar:
        scale = camera.focal / float((stage.centre - camera.position) @ camera.axes[2])
        length = _round_length(0.18 * width / scale)
        start, end, y = 28 * unit, 28 * unit + length * scale, 28 * unit
        axes.plot([start, end], [y, y], color="0.15", linewidth=2 * unit, solid_capstyle="butt")
        text = f"{1e2 * length:g} cm" if length >= 0.01 else f"{1e3 * length:g} mm"
        axes.text((start + end) / 2, y + 8 * unit, text, va="bottom", **style)
    if bonded:
        left, right, y = width - 188 * unit, width - 28 * unit, 28 * unit
        ramp = shading.srgb(shading.bonded_color(np.linspace(0, 1, 64)))[None]
        axes.imshow(ramp, extent=(left, right, y - 4 * unit, y + 4 * unit), aspect="auto")
        axes.set(xlim=(0, width), ylim=(0, height))
        axes.text((left + right) / 2, y + 8 * unit, "bonded fraction", va="bottom", **style)
        for x, text in ((left, "0"), (right, "1")):
            axes.text(x, y - 6 * unit, text, va="top", **style)
    canvas.draw()
    ink = np.asarray(canvas.buffer_rgba(), float)
    return ink[..., :3], ink[..., 3:] / 255


def _round_length(most: float) -> float:
    """The largest of 1, 2, 5, 10, ... times a power of ten that is at most `most`."""
    power = 10 ** math.floor(math.log10(most))
    return power * max(step for step in (1, 2, 5) if step * power <= most)


def _figure(width: float, height: float) -> tuple[Any, Any]:
    """A matplotlib figure [inch] and its canvas, apart from pyplot and its global state."""
    figure = _optional("matplotlib.figure").Figure((width, height), dpi=100, facecolor="none")
    return figure, _optional("matplotlib.backends.backend_agg").FigureCanvasAgg(figure)


def _optional(module: str) -> Any:
    """A module that only pictures need."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f'pictures need {module.partition(".")[0]}: pip install "jaxhair[pictures]"'
        ) from error


def draw(points, *, counts=None, bonded=None, meshes=(), hairs_per_strand=10, view=View(), size=(800,800), color=HAIR_COLOR, seed=0, scale_bar=True):
    points=np.asarray(points)
    a=_Artist(points[None],[meshes],counts=counts,hairs_per_strand=hairs_per_strand,view=view,size=size,color=color,seed=seed,bar=scale_bar,bonded=bonded is not None)
    return a.draw(points,bonded,meshes)
