"""Pictures and movies of hair: positions in metres in, .png, .gif and .mp4 out.

Simulated strands are few and angular. As in the paper (section 7.1), more hairs are interpolated
between them and the points of each are joined by Bezier curves (interpolation.py), and the result
is lit after Kajiya and Kay (shading.py). Needs the extra `pictures`.
"""

import itertools
import math
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from jaxhair import check, raster, shading
from jaxhair.extras import optional
from jaxhair.figures import PathLike, check_suffix, comparison, figure
from jaxhair.interpolation import Interpolation, bezier, used_points
from jaxhair.output import new_file
from jaxhair.raster import Array, Camera, View
from jaxhair.shading import Mesh

__all__ = ["View", "comparison", "draw", "movie", "picture"]

Color = tuple[float, float, float]
Progress = Callable[[range], Iterable[int]]

HAIR_COLOR: Color = (0.42, 0.25, 0.14)
FIELD_OF_VIEW = math.radians(28)


class Options(TypedDict, total=False):
    """How hair is drawn, wherever it is drawn.

    hairs_per_strand: hairs drawn for each strand, by default 10.
    view: where from; by default `View()`.
    size: width and height in pixels, by default (800, 800).
    color: RGB of the hair in [0, 1], as on a screen; by default brown.
    seed: of the random numbers that place the interpolated hairs, by default 0.
    scale_bar: whether to draw one, by default True; it is right at the middle of the scene.
    """

    hairs_per_strand: int
    view: View
    size: tuple[int, int]
    color: Color
    seed: int
    scale_bar: bool


def draw(
    points: Array,
    *,
    counts: Array | None = None,
    bonded: Array | None = None,
    meshes: Sequence[Mesh] = (),
    **options: Unpack[Options],
) -> Array:
    """The picture as bytes, shape (height, width, 3).

    points: [m], Z up, shape (strands, points, 3).
    counts: points of each strand, shape (strands,); without it they end where the padding, which
        repeats the last point, begins.
    bonded: bonded fraction in [0, 1], shape (strands, points), shown from blue (0) to red (1) in
        place of the hair colour.
    meshes: obstacles, pairs of vertices [m], shape (n, 3), and triangles, shape (m, 3).
    options: see `Options`.
    """
    fractions = None if bonded is None else np.asarray(bonded)[None]
    frames = np.asarray(points)[None]
    return _Scene("points", frames, counts, fractions, [meshes], **options).image(0)


def picture(path: PathLike, points: Array, *, overwrite: bool = False, **options: Any) -> None:
    """Write a .png file of what `draw(points, **options)` returns."""
    check_suffix(path, ".png")
    with new_file(path, overwrite=overwrite) as temporary:
        optional("PIL.Image").fromarray(draw(points, **options)).save(temporary)


def movie(
    path: PathLike,
    frames: Array,
    *,
    fps: float,
    counts: Array | None = None,
    bonded: Array | None = None,
    meshes: Sequence[Sequence[Mesh]] | None = None,
    overwrite: bool = False,
    progress: Progress = iter,
    **options: Unpack[Options],
) -> None:
    """Write a movie as a .gif or an .mp4 file; the camera stands still.

    frames: positions [m], shape (frames, strands, points, 3).
    fps: frames a second, at most 50 for a .gif.
    bonded: bonded fraction, shape (frames, strands, points).
    meshes: obstacles of each frame.
    progress: called with the range of frames to draw; returns them one by one, as tqdm does.
    counts: points of each strand, as for `draw`.
    options: see `Options`.
    A .gif shows a frame that equals the one before
    by waiting longer, so it can hold fewer frames.
    """
    suffix = check_suffix(path, ".gif", ".mp4")
    check.positive("fps", fps)
    if suffix == ".gif" and fps > 50:
        raise ValueError(f"fps is {fps!r}; it must be at most 50 for a .gif")
    scene = _Scene("frames", np.asarray(frames), counts, bonded, meshes, **options)
    width, height = scene.stage.camera.size
    if suffix == ".mp4" and (width % 2 or height % 2):
        raise ValueError(f"size is {(width, height)}; both must be even for an .mp4")
    with new_file(path, overwrite=overwrite) as temporary:
        if suffix == ".gif":
            _write_gif(temporary, scene, fps, progress)
        else:
            _write_mp4(temporary, scene, fps, progress)


def _write_mp4(path: Path, scene: "_Scene", fps: float, progress: Progress) -> None:
    writer = optional("imageio_ffmpeg").write_frames(
        str(path), scene.stage.camera.size, fps=fps, quality=8, macro_block_size=2
    )
    try:
        with _no_fork():
            writer.send(None)
        for index in progress(range(scene.count)):
            writer.send(np.ascontiguousarray(scene.image(index)))
    finally:
        writer.close()


@contextmanager
def _no_fork() -> Iterator[None]:
    """Lets imageio-ffmpeg start its program without running Python in a forked process, which can
    hang beside JAX's threads; Ctrl-C then reaches that program too."""
    name = "IMAGEIO_FFMPEG_NO_PREVENT_SIGINT"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before


def _write_gif(path: Path, scene: "_Scene", fps: float, progress: Progress) -> None:
    image = optional("PIL.Image")
    count = scene.count
    # One palette for all frames, or the background would flicker.
    few = [scene.image(index) for index in sorted({0, count // 2, count - 1})]
    if scene.bonded is not None:
        # Fractions between those of the few frames need colours too.
        light = np.linspace(0.15, 1.15, few[0].shape[0] // 3)[:, None, None]
        few.append(shading.srgb(light * shading.bonded_color(np.linspace(0, 1, few[0].shape[1]))))
    palette = image.fromarray(np.concatenate(few)).quantize(256)

    def coded() -> Iterator[Any]:
        for index in progress(range(count)):
            frame = image.fromarray(scene.image(index))
            yield frame.quantize(palette=palette, dither=image.Dither.NONE)

    # A .gif counts in hundredths of a second; rounding the ends keeps the total right.
    ends = [round(100 * index / fps) for index in range(count + 1)]
    durations = [10 * (end - start) for start, end in itertools.pairwise(ends)]
    frames = coded()
    options = {"append_images": frames, "duration": durations, "loop": 0}
    with path.open("wb") as file:
        next(frames).save(file, "GIF", save_all=True, **options)


class _Scene:
    """What is the same in all frames of a movie, and the images, drawn when asked for."""

    def __init__(
        self,
        name: str,
        frames: Array,
        counts: Array | None,
        bonded: Array | None,
        meshes: Sequence[Sequence[Mesh]] | None,
        *,
        hairs_per_strand: int = 10,
        view: View | None = None,
        size: tuple[int, int] = (800, 800),
        color: Color = HAIR_COLOR,
        seed: int = 0,
        scale_bar: bool = True,
    ) -> None:
        # One picture is a movie of one frame; messages speak of what the caller gave.
        one = name == "points"
        given = frames[0] if one else frames
        shape: tuple[int | str, ...] = ("strands", "points", 3)
        check.shape(name, given, shape if one else ("frames", *shape))
        check.finite(name, given)
        if frames.shape[2] < 2:
            raise ValueError(f"{name} has 1 point a strand; it must have 2 or more")
        check.whole("hairs_per_strand", hairs_per_strand, least=1)
        check.whole("seed", seed, least=0, most=2**63)
        check.flag("scale_bar", scale_bar)
        if view is not None:
            check.instance("view", view, View)
        check.shape("size", size, (2,))
        for side in size:
            check.whole("size", side, least=16)
        check.shape("color", color, (3,))
        check.fraction("color", color, many=True)
        if bonded is not None:
            bonded = np.asarray(bonded)
            given = bonded[0] if one else bonded
            check.shape("bonded", given, frames.shape[one:-1])
            check.fraction("bonded", given, many=True)
        self.count = len(frames)
        self.frames = frames
        self.bonded = bonded
        self.meshes = _checked_meshes(meshes, len(frames))
        self.used = used_points(counts, frames[0])
        self.color = shading.linear(np.asarray(color))
        self.stage = _stage(frames, self.meshes, view or View(), (int(size[0]), int(size[1])))
        self.interpolation = Interpolation.between(frames[0], hairs_per_strand, seed)
        self.notes = _notes(self.stage, bar=scale_bar, bonded=bonded is not None)

    def image(self, index: int) -> Array:
        """Bytes, shape (height, width, 3)."""
        surfaces = shading.Surfaces(self.meshes[index])
        image = shading.srgb(shading.render(self.stage, self._hairs(index), surfaces))
        ink, opacity = self.notes
        noted: Array = np.round(image * (1 - opacity) + ink * opacity).astype(np.uint8)
        return noted

    def _hairs(self, index: int) -> shading.Hairs:
        camera, added = self.stage.camera, self.interpolation
        points = self.frames[index].astype(np.float32)
        used = self.used[added.guide]
        # Curves are cut into pieces of about five pixels, so that no corner shows; nobody looks
        # at one of very many hairs.
        piece = 5 * max(1, (len(used) / 2000) ** 0.25)
        depth = max(float(np.min(camera.project(points)[..., 2])), 0.1 * self.stage.radius)
        longest = np.max(np.linalg.norm(np.diff(points, axis=1), axis=-1)) / depth * camera.focal
        pieces = int(np.clip(np.ceil(longest / piece), 1, 16))

        def grown(rows: slice) -> tuple[Array, Array]:
            hairs = added.part(rows).hairs(points, self.used)
            curves, rates = bezier(hairs, used[rows], pieces)
            return curves.astype(np.float32), shading.unit(rates).astype(np.float32)

        parts = [slice(first, first + 512) for first in range(0, len(used), 512)]
        found = raster.in_threads(grown, parts)
        curves, tangents = (np.concatenate(x) for x in zip(*found, strict=True))
        steps = np.arange(curves.shape[1])
        ends = np.ceil((used - 1) * pieces * (1 - added.cut))
        colors = np.broadcast_to(self.color, curves.shape)
        if self.bonded is not None:
            place = np.arange(points.shape[1]) * pieces
            rows = [np.interp(steps, place, row) for row in self.bonded[index]]
            colors = shading.bonded_color(np.array(rows))[added.guide]
        # One pixel of 800 where hairs are many, up to two where they are few.
        pixels = min((2000 / len(used)) ** 0.25, 2) * min(camera.size) / 800
        thickness = max(1, round(shading.SUPERSAMPLING * pixels))
        pixel = np.linalg.norm(camera.position - self.stage.centre) / camera.focal
        return shading.Hairs(
            points=curves,
            tangents=tangents,
            colors=(colors * added.shade[:, None, None]).astype(np.float32),
            drawn=steps[:-1] < ends[:, None],
            # A highlight washes out the colours that show the bonds.
            gloss=0.30 if self.bonded is None else 0.08,
            thickness=thickness,
            width=float(pixel) * thickness / shading.SUPERSAMPLING,
        )


def _checked_meshes(
    meshes: Sequence[Sequence[Mesh]] | None, frames: int
) -> Sequence[Sequence[Mesh]]:
    if meshes is None:
        return [()] * frames
    if len(meshes) != frames:
        raise ValueError(f"meshes has {len(meshes)} entries; it must have {frames}, one a frame")
    checked: dict[int, Mesh] = {}  # a mesh that stands still is often one object in all frames
    for frame in meshes:
        for mesh in frame:
            if id(mesh) not in checked:
                checked[id(mesh)] = _checked_mesh(mesh)
    return [[checked[id(mesh)] for mesh in frame] for frame in meshes]


def _checked_mesh(mesh: Mesh) -> Mesh:
    if len(mesh) != 2:
        raise ValueError(f"a mesh has {len(mesh)} parts; it must have 2, vertices and triangles")
    vertices, triangles = (np.asarray(part) for part in mesh)
    check.shape("vertices of a mesh", vertices, ("vertices", 3))
    check.finite("vertices of a mesh", vertices)
    check.shape("triangles of a mesh", triangles, ("triangles", 3))
    wrong = (triangles < 0) | (triangles >= len(vertices)) | (triangles % 1 != 0)
    if np.any(wrong):
        raise ValueError(
            f"triangles of a mesh have the value {triangles[wrong][0]}; "
            f"it must be a whole number in [0, {len(vertices) - 1}]"
        )
    return vertices.astype(float), triangles.astype(int)


def _stage(
    frames: Array, meshes: Sequence[Sequence[Mesh]], view: View, size: tuple[int, int]
) -> shading.Stage:
    """The camera for `view` and a light, such that all hair of all frames is seen and lit."""
    towards = raster.axes_towards(view.azimuth, view.elevation)
    low, high = box(frames, meshes, towards)
    radius = max(float(np.linalg.norm(high - low)) / 2, 1e-4)
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


def box(frames: Array, meshes: Sequence[Sequence[Mesh]], axes: Array) -> tuple[Array, Array]:
    """Lowest and highest coordinates along `axes` of all hair and of the smaller obstacles."""
    hair = [frame.reshape(-1, 3) @ axes.T for frame in frames]
    low = np.min([places.min(0) for places in hair], 0)
    high = np.max([places.max(0) for places in hair], 0)
    # A head belongs into the picture; a floor or a long rod may leave it.
    largest = np.max(high - low)
    for frame in meshes:
        for vertices, _ in frame:
            places = vertices @ axes.T
            if np.max(np.ptp(places, axis=0)) <= largest:
                low, high = np.minimum(low, places.min(0)), np.maximum(high, places.max(0))
    return low, high


def _notes(stage: shading.Stage, *, bar: bool, bonded: bool) -> tuple[Array, Array]:
    """Ink (bytes) and its opacity: a scale bar, and what the colours blue to red mean."""
    camera = stage.camera
    width, height = camera.size
    drawing, canvas = figure(width / 100, height / 100, dpi=100, facecolor="none")
    unit = min(width, height) / 800
    style: dict[str, Any] = {"color": "0.15", "fontsize": 11 * unit, "ha": "center"}
    axes = drawing.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, height))
    axes.axis("off")
    depth = float((stage.centre - camera.position) @ camera.axes[2])
    if bar and depth > 0:
        scale = camera.focal / depth
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
    power: float = 10 ** math.floor(math.log10(most))
    return power * max(step for step in (1, 2, 5) if step * power <= most)
