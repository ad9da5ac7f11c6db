"""How hair is lit: Kajiya-Kay shading, soft shadows, and the image put together.

Colours are linear RGB until `srgb`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxhair import raster
from jaxhair.raster import Array, Camera

Mesh = tuple[Array, Array]

SUPERSAMPLING = 2
MESH_COLOR = np.array([0.50, 0.47, 0.45], np.float32)
BACKGROUND = np.array([[0.80, 0.82, 0.84], [0.55, 0.56, 0.57]], np.float32)  # top, bottom
BONDED_COLORS = np.array([[0.03, 0.10, 0.85], [0.85, 0.04, 0.03]], np.float32)  # at 0, at 1


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", a, b))  # several times as fast as np.sum


def kajiya_kay(tangent: Array, to_light: Array, to_eye: Array, power: float) -> tuple[Array, Array]:
    """Light scattered by a thin fibre, after Kajiya and Kay (1989).

    Diffuse: sin(t, l). Specular: cos(a)^power with a the angle between the eye and the cone into
    which a cylinder reflects, cos(a) = sin(t, l) sin(t, e) - (t.l)(t.e), where l and e both
    point away from the fibre. All three arguments are unit vectors of shape (..., 3).
    """
    along_light = _dot(tangent, to_light)
    along_eye = _dot(tangent, to_eye)
    diffuse = np.sqrt(np.clip(1 - along_light**2, 0, 1))
    sin_eye = np.sqrt(np.clip(1 - along_eye**2, 0, 1))
    cone = np.clip(diffuse * sin_eye - along_light * along_eye, 0, 1)
    return diffuse, cone**power


def bonded_color(bonded: Array) -> Array:
    """Blue at 0 to red at 1, shape (..., 3)."""
    low, high = BONDED_COLORS
    color: Array = low + bonded[..., None] * (high - low)
    return color


def srgb(linear: Array) -> Array:
    """Linear RGB as bytes for a screen."""
    x = np.clip(linear, 0, 1)
    curve = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    color: Array = np.round(255 * curve).astype(np.uint8)
    return color


def linear(color: Array) -> Array:
    """Linear RGB of a screen colour in [0, 1]."""
    x = np.asarray(color, np.float32)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _sample(grid: Array, *places: Array) -> Array:
    """Multilinear look-up in `grid` at places in cells (the first centre at 0), clamped."""
    result = np.zeros(places[0].shape, grid.dtype)
    lower = []
    for axis, place in enumerate(places):
        p = np.clip(place, 0, grid.shape[axis] - 1.001)
        floor = p.astype(np.int32)
        lower.append((floor, (p - floor).astype(np.float32)))
    flat = grid.ravel()
    for corner in range(2 ** len(places)):
        weight: Array | float = 1.0
        index: Array | int = 0
        for axis, (floor, rest) in enumerate(lower):
            up = corner >> axis & 1
            index = index * grid.shape[axis] + floor + up
            weight = weight * (rest if up else 1 - rest)
        result += flat[index] * weight
    return result


def _blur(grid: Array) -> Array:
    """Binomial blur over the first two axes."""
    for axis in (0, 1):
        grid = (np.roll(grid, 1, axis) + 2 * grid + np.roll(grid, -1, axis)) / 4
    return grid


class Shadows:
    """Light that gets through the hair and past the meshes to a point.

    The hair is a cloud in front of the light, its optical depth summed layer by layer (deep
    opacity maps, Yuksel and Keyser 2008); a mesh hides what lies behind it by exponential shadow
    maps (Annen et al. 2008), which blur without many samples.
    """

    LAYERS, CELL, SHARPNESS = 32, 4, 600.0

    def __init__(
        self, light: Camera, points: Array, lengths: Array, width: float, corners: Array
    ) -> None:
        """points [m], shape (n, 3), each stands for a hair of `lengths` [m] and `width` [m]."""
        self.light = light
        places = light.project(points)
        depth = places[:, 2]
        self.front = float(depth.min())
        self.layer = max(float(depth.max()) - self.front, 1e-6) / (self.LAYERS - 3)
        cells = (light.size[1] // self.CELL, light.size[0] // self.CELL, self.LAYERS)

        def cell(places: Array) -> Array:
            column, row, layer = (
                np.clip(np.round(p).astype(np.int64), 0, n - 1)
                for p, n in zip(self._cells(places), (cells[1], cells[0], cells[2]), strict=True)
            )
            return np.asarray((row * cells[1] + column) * cells[2] + layer)

        parts = np.split(places, range(2**16, len(places), 2**16))
        index = np.concatenate(raster.in_threads(cell, parts))
        area = (float(depth.min() + depth.max()) / 2 / light.focal * self.CELL) ** 2
        cloud = np.bincount(index, lengths * width / area, np.prod(cells))
        cloud = _blur(cloud.reshape(cells))
        self.cloud = (np.cumsum(cloud, -1) - cloud).astype(np.float32)
        self.total = np.ascontiguousarray(cloud.sum(-1).astype(np.float32))
        self.hidden: Array | None = None
        if len(corners):
            buffer = raster.triangles(light, corners, 0.05 * self.front)
            first = np.exp(self._relative(raster.depth_of(buffer).astype(np.float64)))
            self.hidden = np.log(_blur(_blur(first.reshape(light.size[::-1]))))

    def _relative(self, depth: Array) -> Array:
        return self.SHARPNESS * (np.minimum(depth / self.front, 2) - 1)

    def _cells(self, places: Array) -> tuple[Array, Array, Array]:
        x, y = (places[:, k] / places[:, 2] / self.CELL - 0.5 for k in (0, 1))
        return x, y, (places[:, 2] - self.front) / self.layer + 1

    def light_at(self, points: Array, *, on_hair: bool) -> Array:
        """The part of the light in [0, 1], shape (n,), that reaches `points` [m], (n, 3)."""
        places = self.light.project(points)
        x, y, layer = self._cells(places)
        if on_hair:
            # One layer nearer the light, or a thin sheet of hair would shade itself.
            thickness = _sample(self.cloud, y, x, layer - 1)
        else:
            behind = np.clip(layer / self.LAYERS * 4 - 0.5, 0, 1)
            thickness = _sample(self.total, y, x) * behind
        result = np.exp(-thickness)
        if self.hidden is not None:
            # A hair that touches a surface is not behind it.
            depth = places[:, 2] * np.float64(0.996 if on_hair else 1.0)
            first = _sample(self.hidden, self.CELL * y + 1.5, self.CELL * x + 1.5)
            result *= np.exp(np.minimum(first - self._relative(depth), 0))
        rows, columns = self.total.shape
        inside = (places[:, 2] > 0) & (x > 0) & (y > 0) & (x < columns - 1) & (y < rows - 1)
        return np.where(inside, result, 1).astype(np.float32)


@dataclass(frozen=True)
class Hairs:
    """Smooth lines to draw.

    points: [m], shape (hairs, vertices, 3).
    tangents: unit vectors along the hairs, the same shape.
    colors: linear RGB, the same shape.
    drawn: which of the edges between vertices to draw, shape (hairs, vertices - 1).
    gloss: of the highlight against the light.
    thickness: of a line, in pixels / SUPERSAMPLING.
    width: [m] of a line in the middle of the scene.
    """

    points: Array
    tangents: Array
    colors: Array
    drawn: Array
    gloss: float
    thickness: int
    width: float


class Surfaces:
    """All triangles of a scene, with normals that vary over the round parts.

    corners: [m], shape (triangles, 3, 3).
    """

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        corners, normals, slopes = ([np.zeros((0, *shape))] for shape in ((3, 3), (3,), (3, 3)))
        for vertices, triangles in meshes:
            corner = vertices[triangles]
            cross = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            mean = np.zeros_like(vertices)
            np.add.at(mean, triangles.ravel(), np.repeat(cross, 3, 0))
            face, mean = unit(cross)[:, None], unit(mean)[triangles]
            # A round surface is shaded round; an edge stays sharp.
            normal = np.where(np.sum(face * mean, -1, keepdims=True) > 0.8, mean, face)
            flat = np.all(np.abs(normal - face) < 1e-6, (1, 2))
            opposite = np.roll(corner, -2, 1) - np.roll(corner, -1, 1)
            twice = np.maximum(np.linalg.norm(cross, axis=-1), 1e-30)[:, None, None]
            gradient = np.cross(face, opposite) / twice  # of the barycentric coordinates
            corners.append(corner)
            normals.append(normal[:, 0])
            slopes.append(np.einsum("mki,mkj,m->mij", normal, gradient, ~flat))
        self.corners = np.concatenate(corners)
        self._normals = np.concatenate(normals).astype(np.float32)
        self._slopes = np.concatenate(slopes).astype(np.float32)

    def normals_at(self, points: Array, which: Array) -> Array:
        """Unit normals, shape (n, 3), at `points` [m] of the triangles `which`."""
        normals = self._normals[which]
        curved = np.flatnonzero(np.any(self._slopes != 0, (1, 2))[which])
        offset = points[curved] - self.corners[which[curved], 0].astype(np.float32)
        normals[curved] += np.einsum("nij,nj->ni", self._slopes[which[curved]], offset)
        return unit(normals)


def unit(vectors: Array) -> Array:
    """`vectors` of shape (..., 3) scaled to length 1; zero stays zero."""
    length = np.sqrt(_dot(vectors, vectors))[..., None]
    scaled: Array = vectors / np.maximum(length, length.dtype.type(1e-30))
    return scaled


def background(size: tuple[int, int]) -> Array:
    """A quiet gradient, shape (height, width, 3)."""
    down = np.linspace(0, 1, size[1], dtype=np.float32)[:, None, None]
    return np.broadcast_to(BACKGROUND[0] * (1 - down) + BACKGROUND[1] * down, (*size[::-1], 3))


@dataclass(frozen=True)
class Stage:
    """Where the eye and the light stand.

    centre: [m], shape (3,), and radius [m]: of what is shown; surfaces fade away outside it.
    """

    camera: Camera
    light: Camera
    centre: Array
    radius: float


def render(stage: Stage, hairs: Hairs, surfaces: Surfaces) -> Array:
    """The image, linear RGB of shape (height, width, 3)."""
    camera, light, radius = stage.camera, stage.light, stage.radius
    fine = Camera(
        camera.position,
        camera.axes,
        camera.focal * SUPERSAMPLING,
        (camera.size[0] * SUPERSAMPLING, camera.size[1] * SUPERSAMPLING),
    )
    edges = np.diff(hairs.points, axis=1)
    edges = np.sqrt(_dot(edges, edges)) * hairs.drawn
    lengths = np.pad(edges, ((0, 0), (0, 1))) / 2 + np.pad(edges, ((0, 0), (1, 0))) / 2
    vertices = hairs.points.reshape(-1, 3)
    shadows = Shadows(light, vertices, lengths.ravel(), hairs.width, surfaces.corners)

    image = background(fine.size).reshape(-1, 3).copy()
    if len(surfaces.corners):
        buffer = raster.triangles(fine, surfaces.corners, 0.02 * radius)
        _paint_surfaces(image, buffer, fine, stage, surfaces, shadows)
        buffer |= np.uint64(raster.NOTHING)
    else:
        buffer = raster.empty_buffer(fine)

    places = fine.project(vertices)
    drawn = np.pad(hairs.drawn, ((0, 0), (0, 1))).ravel()
    raster.lines(fine, places, drawn, buffer, bias=0.01 * radius, thickness=hairs.thickness)
    names = (buffer & np.uint64(raster.NOTHING)).astype(np.int64)
    seen = np.flatnonzero(names != raster.NOTHING)
    first, along = np.divmod(names[seen], 64)
    mix = (along / np.float32(63))[:, None].astype(np.float32)
    # most hairs are behind others: only what is seen is lit
    lit = np.zeros(len(vertices), bool)
    lit[first] = lit[first + 1] = True
    row = np.cumsum(lit) - 1
    colors = _lit(camera, light, hairs, np.flatnonzero(lit), shadows)
    image[seen] = colors[row[first]] * (1 - mix) + colors[row[first + 1]] * mix

    n = SUPERSAMPLING
    grid = image.reshape(camera.size[1], n, camera.size[0], n, 3)
    coarse = np.zeros_like(grid[:, 0, :, 0])
    for i, j in np.ndindex(n, n):
        coarse += grid[:, i, :, j]
    return coarse / np.float32(n * n)


def _lit(camera: Camera, light: Camera, hairs: Hairs, which: Array, shadows: Shadows) -> Array:
    """Colours of some of all vertices as seen, shape (vertices, 3)."""

    def part(few: Array) -> Array:
        points, tangents = (x.reshape(-1, 3)[few] for x in (hairs.points, hairs.tangents))
        to_eye = unit(camera.position.astype(np.float32) - points)
        lit = shadows.light_at(points, on_hair=True)
        diffuse, glint = kajiya_kay(tangents, -light.axes[2].astype(np.float32), to_eye, 40.0)
        # Light from behind the camera, so that no side of a lock is black.
        fill, _ = kajiya_kay(tangents, -camera.axes[2].astype(np.float32), to_eye, 1.0)
        body = 0.10 + 0.22 * fill * (0.35 + 0.65 * lit) + 0.95 * diffuse * lit
        own = hairs.colors.reshape(-1, 3)[few]
        return np.asarray(own * body[:, None] + (hairs.gloss * glint * lit)[:, None])

    parts = np.split(which, range(2**15, len(which), 2**15))
    return np.concatenate(raster.in_threads(part, parts))


def _paint_surfaces(
    image: Array,
    buffer: Array,
    camera: Camera,
    stage: Stage,
    surfaces: Surfaces,
    shadows: Shadows,
) -> None:
    """Paint what `buffer`, seen by the fine `camera`, holds into `image` (pixels, 3) in place."""
    n = SUPERSAMPLING
    columns = camera.size[0]
    grid = buffer.reshape(-1, n, columns // n, n).transpose(0, 2, 1, 3).reshape(-1, n * n)
    names = (grid & np.uint64(raster.NOTHING)).astype(np.int64)
    row, column = np.divmod(np.arange(len(grid)), columns // n)
    # Inside a triangle one sample a pixel will do; along its edges every one counts.
    uniform = np.all(names == names[:, :1], -1)
    whole = np.flatnonzero(uniform & (names[:, 0] != raster.NOTHING))
    split, part = np.nonzero((names != raster.NOTHING) & ~uniform[:, None])
    if not len(whole) + len(split):
        return
    x = np.concatenate([n * column[whole] + n / 2, n * column[split] + part % n + 0.5])
    y = np.concatenate([n * row[whole] + n / 2, n * row[split] + part // n + 0.5])
    depth = raster.depth_of(grid)
    depth = np.concatenate([depth[whole].mean(-1), depth[split, part]])
    which = np.concatenate([names[whole, 0], names[split, part]])
    points = camera.unproject(x, y, depth)
    normals = surfaces.normals_at(points, which)
    to_eye = unit(camera.position.astype(np.float32) - points)
    normals *= np.sign(np.sum(normals * to_eye, -1, keepdims=True))
    lit = shadows.light_at(points, on_hair=False)
    direct = np.clip(normals @ -stage.light.axes[2].astype(np.float32), 0, 1) * lit
    color = MESH_COLOR * (0.34 + 0.14 * normals[:, 2:] + 0.95 * direct[:, None])
    away = np.linalg.norm(points - stage.centre.astype(np.float32), axis=-1) / stage.radius
    fade = np.clip((away - 1.1) / 1.4, 0, 1)[:, None]
    fade = fade * fade * (3 - 2 * fade)
    first = n * row * columns + n * column
    index = [first[whole] + i // n * columns + i % n for i in range(n * n)]
    edge = first[split] + part // n * columns + part % n
    for place, rows in [(i, slice(len(whole))) for i in index] + [(edge, slice(len(whole), None))]:
        image[place] = color[rows] + fade[rows] * (image[place] - color[rows])
