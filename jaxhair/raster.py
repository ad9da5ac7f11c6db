"""Views, cameras, and a z-buffer for triangles and lines. Plain NumPy, no graphics driver.

Places on an image are in pixels: x to the right, y downwards, the centre of the first pixel at
(0.5, 0.5). A z-buffer is an array of unsigned 64-bit integers, shape (height * width,): in the
upper half of an entry the bits of the depth, in the lower half the name of what is seen there.
"""

import itertools
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from jaxhair import check

S = TypeVar("S")
T = TypeVar("T")
Array = np.ndarray
NOTHING = 0xFFFFFFFF  # the name of what is seen where nothing is


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
            check.number(f"view.{name}", getattr(self, name))
        if abs(self.elevation) > math.pi / 2:
            raise ValueError(
                f"view.elevation is {self.elevation!r}; it must be in [-pi/2, pi/2] (radians)"
            )
        if self.target is not None:
            check.vector("view.target", self.target)
        if self.distance is not None:
            check.positive("view.distance", self.distance)


@dataclass(frozen=True)
class Camera:
    """Pinhole camera.

    position: [m], shape (3,).
    axes: unit vectors to the right, downwards and forwards, the rows of a (3, 3) array.
    focal: focal length in pixels.
    size: width and height of the image in pixels.
    """

    position: Array
    axes: Array
    focal: float
    size: tuple[int, int]

    def project(self, points: Array) -> Array:
        """Homogeneous places (x w, y w, w) of `points`, both of shape (..., 3); w is depth [m]."""
        lens = np.array([[self.focal, 0, 0], [0, self.focal, 0], [*self.half, 1]])
        matrix = (self.axes.T @ lens).astype(np.float32)
        offset = points - self.position.astype(points.dtype)
        return np.asarray(offset.astype(np.float32, copy=False) @ matrix)

    @property
    def half(self) -> tuple[float, float]:
        """The place that the camera looks at, in pixels."""
        return self.size[0] / 2, self.size[1] / 2

    def unproject(self, x: Array, y: Array, depth: Array) -> Array:
        """The points [m], shape (n, 3), at the places x, y and depths [m] of shape (n,)."""
        place = np.stack([x - self.half[0], y - self.half[1], np.full_like(x, self.focal)], -1)
        rays = place.astype(np.float32) @ (self.axes / self.focal).astype(np.float32)
        points: Array = rays * depth[:, None] + self.position.astype(np.float32)
        return points


def axes_towards(azimuth: float, elevation: float) -> Array:
    """Axes of a camera that stands in the direction (azimuth, elevation) [rad] and looks back."""
    (ca, sa), (ce, se) = (np.cos(azimuth), np.sin(azimuth)), (np.cos(elevation), np.sin(elevation))
    right, forward = np.array([-sa, ca, 0.0]), -np.array([ce * ca, ce * sa, se])
    return np.stack([right, np.cross(forward, right), forward])


def _key(depth: Array, identity: Array) -> Array:
    """Depth above, identity below: the smaller of two keys is the nearer surface.

    The bits of positive floats have the order of the floats, so one `np.minimum.at` both tests
    depth and keeps what was seen.
    """
    bits = np.ascontiguousarray(depth, np.float32).view(np.uint32).astype(np.uint64)
    return (bits << np.uint64(32)) | identity.astype(np.uint64)


def depth_of(keys: Array) -> Array:
    return (keys >> np.uint64(32)).astype(np.uint32).view(np.float32)


def empty_buffer(camera: Camera) -> Array:
    far = np.full(1, np.finfo(np.float32).max, np.float32)
    return np.repeat(_key(far, np.array([NOTHING])), camera.size[0] * camera.size[1])


def triangles(camera: Camera, corners: Array, near: float) -> Array:
    """Z-buffer, shape (height * width,), of triangles with `corners` [m], shape (m, 3, 3).

    Olano and Greer (1997): with the homogeneous corners as rows of M, (x, y, 1) M^-1 are the
    barycentric coordinates over depth. They are all positive inside, on this side of the eye
    only, so nothing has to be clipped.
    """
    buffer = empty_buffer(camera)
    v = camera.project(corners).astype(np.float64)
    inverse = np.stack([np.cross(v[:, (k + 1) % 3], v[:, (k + 2) % 3]) for k in range(3)], -1)
    volume = np.sum(v[:, 0] * inverse[..., 0], -1)
    scale = np.prod(np.linalg.norm(v, axis=-1), -1)
    width, height = camera.size
    whole = np.any(v[..., 2] <= near, -1)
    flat = v[..., :2] / np.where(whole[:, None], 1.0, v[..., 2])[..., None]
    edge = np.array([width, height])
    low = np.where(whole[:, None], 0, np.clip(np.floor(flat.min(1)), 0, edge)).astype(int)
    high = np.where(whole[:, None], edge, np.clip(np.ceil(flat.max(1)), 0, edge)).astype(int)
    seen = np.all(high > low, -1) & (abs(volume) > 1e-12 * scale) & np.any(v[..., 2] > near, -1)
    inverse /= np.where(seen, volume, 1.0)[:, None, None]
    span = np.max(high - low, -1)
    block = np.where(span <= 64, 2 ** np.ceil(np.log2(np.maximum(span, 1))), 0).astype(int)
    # Many small triangles at a time, in blocks of one size; large ones one by one.
    for size in np.unique(block[seen]):
        which = np.flatnonzero(seen & (block == size))
        step = max(1, 2**20 // size**2) if size else 1
        for start in range(0, len(which), step):
            few = which[start : start + step]
            spans = (size, size) if size else tuple(high[few[0]] - low[few[0]])
            right, down = (np.arange(n, dtype=np.float32) for n in spans)
            x, y = low[few, 0, None] + np.arange(spans[0]), low[few, 1, None] + np.arange(spans[1])
            corner = np.pad(low[few] + 0.5, ((0, 0), (0, 1)), constant_values=1)
            first = np.einsum("ni,nik->kn", corner, inverse[few]).astype(np.float32)
            by_x, by_y = inverse[few, :2].transpose(1, 2, 0)[..., None, None].astype(np.float32)
            weights = by_x * right + (by_y * down[:, None] + first[..., None, None])
            per_depth = weights.sum(0)
            # Rounding must leave no gap between triangles that share an edge.
            inside = np.all(weights >= -1e-5 * per_depth, 0)
            inside &= (per_depth > 0) & (per_depth < 1 / near)
            inside &= (x < width)[:, None, :] & (y < height)[:, :, None]
            place = np.broadcast_to(y[:, :, None] * width + x[:, None, :], inside.shape)[inside]
            name = np.broadcast_to(few[:, None, None], inside.shape)[inside]
            np.minimum.at(buffer, place, _key(1 / per_depth[inside], name))
    return buffer


def lines(
    camera: Camera, places: Array, drawn: Array, buffer: Array, *, bias: float, thickness: int
) -> None:
    """Draw lines from one vertex to the next, `thickness` pixels across, into `buffer` in place.

    places: homogeneous places of vertices, shape (n, 3). drawn: whether there is a line from a
    vertex to the next, shape (n,). What is seen is named by 64 i + k for the line from vertex i at
    the fraction k / 63 of its length.
    bias: [m] by which a line is drawn nearer than it is.
    """
    width, height = camera.size
    w = np.ascontiguousarray(places[:, 2])
    ahead = w > max(bias, 1e-6) * 2
    x, y = (places[:, k] / np.where(ahead, w, 1) for k in (0, 1))
    onscreen = drawn[:-1] & ahead[:-1] & ahead[1:]
    beside = (thickness - 1) / 2  # pixels that a line reaches beyond itself
    for place, most in ((x, width), (y, height)):
        onscreen &= np.maximum(place[:-1], place[1:]) >= -beside
        onscreen &= np.minimum(place[:-1], place[1:]) < most + beside
    kept = np.flatnonzero(onscreen)
    longer = np.maximum(np.abs(np.diff(x)), np.abs(np.diff(y)))[kept]
    # Lines of as many samples come together, and then samples lie lines last: loops are long.
    samples = np.ceil(longer).clip(1, min(4 * max(width, height), 65535)).astype(np.uint16)
    order = np.argsort(samples, kind="stable")
    kept, samples = kept[order], samples[order].astype(np.int64)
    shifts = np.arange(thickness, dtype=np.float32) - np.float32((thickness - 1) / 2)

    def sample(few: slice) -> None:
        n, first = samples[few.start], kept[few]
        along = ((np.arange(n) + np.float32(0.5)) / np.float32(n)).astype(np.float32)[:, None]
        (px, dx), (py, dy), (pw, dw) = ((p[first], p[first + 1] - p[first]) for p in (x, y, w))
        across, down = px + along * dx, py + along * dy
        key = _key(pw - np.float32(bias) + along * dw, first * 64 + (along * 63).astype(np.int64))
        steep = (np.abs(dy) > np.abs(dx)).astype(np.float32)
        for shift in shifts:
            at, line = across, down
            if shift:
                at, line = at + shift * steep, line + shift * (1 - steep)
            column, row = np.floor(at).astype(np.int32), np.floor(line).astype(np.int32)
            place = row * np.int32(width) + column
            ok = (column.view(np.uint32) < width) & (row.view(np.uint32) < height)
            if ok.all():
                np.minimum.at(buffer, place.ravel(), key.ravel())
            else:
                np.minimum.at(buffer, place[ok], key[ok])

    # in one thread: np.minimum.at lets no other run
    ends = [0, *(np.flatnonzero(np.diff(samples, append=-1)) + 1)]
    for begin, end in itertools.pairwise(ends):
        step = max(1, 2**15 // int(samples[begin]))  # what stays in cache
        for k in range(begin, end, step):
            sample(slice(k, min(k + step, end)))


def in_threads(work: Callable[[S], T], parts: Sequence[S]) -> list[T]:
    """What `work` returns for each part. NumPy computes in several threads at a time."""
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        return list(pool.map(work, parts))
