"""What the viewer's page holds of a recording: few bytes, which a browser unpacks by itself.

Arrays are put one after another, compressed by zlib and written in base64. What changes little
from frame to frame is stored as differences of whole numbers, which compress.
"""

import base64
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxhair import check
from jaxhair.export import meshes
from jaxhair.interpolation import Interpolation
from jaxhair.recording import Recording
from jaxhair.strands import BONDS

Array = np.ndarray

STEPS = 65535
"""Steps of a position along an axis of the box: 16 bits."""

LEVELS = 255
"""Steps of a value that is shown as a colour: 8 bits."""


@dataclass(frozen=True)
class Colored:
    """Values that the hair's colour can show, (frames, strands, points - 2 or points - 1).

    low, high: the values at the ends of the colour bar; values beyond are shown like these.
    edges: whether there is a value for each edge, or for each inner point.
    """

    values: Array
    low: float
    high: float
    unit: str
    edges: bool = False

    def levels(self) -> Array:
        """From 0 at `low` to 255 at `high`, uint8."""
        part = (self.values - self.low) / (self.high - self.low)
        return np.round(LEVELS * np.clip(part, 0, 1)).astype(np.uint8)


def hair(recording: Recording) -> tuple[Array, Array]:
    """Points [m], (frames, strands, points, 3), float64, those past a strand's tip being the tip;
    and the number of points of each strand.

    Raises ValueError where the recording observed something else, or has no frame.
    """
    observed = recording.observed
    if not isinstance(observed, dict) or "positions" not in observed:
        found = sorted(map(str, observed)) if isinstance(observed, dict) else observed
        raise ValueError(
            f"recording.observed is {check.short(found)}; it must have positions, as it has where "
            "`simulate` is not told what to observe"
        )
    shape = np.shape(recording.scene.strands.positions)
    check.shape("recording.positions", observed["positions"], ("frames", *shape))
    check.finite("recording.positions", observed["positions"])
    points = np.asarray(observed["positions"], float)
    frames = len(points)
    check.shape("recording.times", recording.times, (frames,))
    if len(recording.phases) != frames:
        raise ValueError(
            f"recording.phases has {len(recording.phases)} names; it must have {frames}, one a "
            "frame"
        )
    counts = recording.scene.strands.counts
    upto = np.minimum(np.arange(shape[1]), counts[:, None] - 1)
    return points[:, np.arange(shape[0])[:, None], upto], counts


def colored(recording: Recording, points: Array) -> dict[str, Colored]:
    """By the names of `jaxhair.export.COLORS`; without bonds if they were not recorded."""
    found = {}
    fractions = recording.observed.get("fractions")
    if fractions is not None:
        frames, strands, most, _ = points.shape
        check.shape("recording.fractions", fractions, (frames, strands, most - 2, len(BONDS)))
        check.finite("recording.fractions", fractions)
        fractions = np.asarray(fractions, float)
        if most == 2:  # no bonds between the two points, none cut: as in pictures
            fractions = np.ones((frames, strands, 1, len(BONDS)))
        for kind, name in enumerate(BONDS):
            found[name] = Colored(fractions[..., kind], 0.0, 1.0, "bonded fraction")
    stretched = strain(points, np.asarray(recording.scene.strands.lengths, float))
    most = _round_up(np.quantile(np.abs(stretched), 0.99), least=1e-5)
    found["strain"] = Colored(stretched, -most, most, "strain", edges=True)
    bent = curvature(points)
    found["curvature"] = Colored(
        bent, 0.0, _round_up(np.quantile(bent, 0.99), least=0.1), "curvature [1/m]"
    )
    return found


def strain(points: Array, lengths: Array) -> Array:
    """Length of each edge over its rest length, less 1; 0 where there is no edge.

    points: [m], (frames, strands, points, 3). lengths: [m], (strands or 1, points - 1).
    """
    edges = np.linalg.norm(np.diff(points, axis=-2), axis=-1)
    there = lengths > 0
    return np.where(there, edges / np.where(there, lengths, 1) - 1, 0.0)


def curvature(points: Array) -> Array:
    """Angle between the edges at an inner point over their mean length [1/m], as
    `fitting.measures.curvature`; 0 past the tip. Where there is no inner point, (..., 1) zeros."""
    edges = np.diff(points, axis=-2)
    if edges.shape[-2] < 2:
        return np.zeros((*edges.shape[:-2], 1))
    before, after = edges[..., :-1, :], edges[..., 1:, :]
    sine = np.linalg.norm(np.cross(before, after), axis=-1)
    angle = np.arctan2(sine, np.sum(before * after, -1))
    first, second = np.linalg.norm(before, axis=-1), np.linalg.norm(after, axis=-1)
    there = (first > 0) & (second > 0)
    return np.where(there, 2 * angle / np.where(there, first + second, 1), 0.0)


def _round_up(value: float, least: float) -> float:
    """The least 1, 1.5, 2, 3, 5, 7 or 10 times a power of ten that is not below `value`."""
    value = max(float(value), least)
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(s * power for s in (1, 1.5, 2, 3, 5, 7, 10) if s * power >= value * 0.999))


def box(points: Array) -> tuple[Array, Array]:
    """Lowest corner of the box that has all points, and the size of a step along each axis [m]."""
    low, high = points.min((0, 1, 2)), points.max((0, 1, 2))
    return low, np.maximum(high - low, 1e-9) / STEPS


def quantised(points: Array, low: Array, step: Array) -> Array:
    """Points in steps from the box's lowest corner, uint16."""
    return np.clip(np.round((points - low) / step), 0, STEPS).astype(np.uint16)


def of_frames(name: str, whole: Array) -> dict[str, Array]:
    """An array of frames of whole numbers as one that compresses: the first frame, and then what
    is added to the frame before (modulo 256 or 65536); 16 bits in two arrays of 8."""
    added = whole.copy()
    added[1:] -= whole[:-1]
    if added.dtype == np.uint8:
        return {name: added}
    parts = {"low": added & 255, "high": added >> 8}
    return {f"{name}_{part}": x.astype(np.uint8) for part, x in parts.items()}


def of_hairs(grown: Interpolation) -> dict[str, Array]:
    """How hairs are interpolated between strands, one row of numbers a hair: see
    `Interpolation`; the order is that of viewer_data.js. The strands themselves come first, then
    another hair of each, and so on: the first of them stand for all."""
    hairs, strands = len(grown.guide), int(grown.guide[-1]) + 1
    pairs = [np.zeros((hairs, 2)), np.zeros((hairs, 2))]
    for pair, given in zip(pairs, (grown.neighbours, grown.weights), strict=True):
        pair[:, : given.shape[1]] = given
    columns = [grown.guide[:, None], *pairs, grown.offset]
    columns += [x[:, None] for x in (grown.clumping, grown.cut, grown.shade)]
    rows = np.concatenate(columns, 1).reshape(strands, hairs // strands, -1)
    return {"hairs": np.swapaxes(rows, 0, 1).reshape(hairs, -1).astype("<f4")}


def obstacles(
    recording: Recording, frames: Array, origin: Array
) -> tuple[dict[str, Array], list[list[list[float]]]]:
    """Shapes of the obstacles, once each, and for every frame the shapes that are there.

    frames: which frames of the recording. origin: [m], from which places are measured.
    Returns arrays shape<i>_vertices and shape<i>_triangles, and for each frame [i, x, y, z], the
    shape and where its middle is.
    """
    arrays: dict[str, Array] = {}
    known: dict[tuple[bytes, bytes], int] = {}
    placed = []
    for frame in frames:
        there = []
        seconds = float(recording.times[frame])
        for vertices, triangles in meshes(recording.scene, recording.phases[frame], seconds):
            middle = (vertices.min(0) + vertices.max(0)) / 2
            own = np.asarray(vertices - middle)
            key = (np.round(own, 7).tobytes(), triangles.tobytes())
            shape = known.setdefault(key, len(known))
            arrays.setdefault(f"shape{shape}_vertices", own.astype("<f4"))
            arrays.setdefault(f"shape{shape}_triangles", triangles.astype("<u4"))
            there.append([shape, *(round(float(x), 7) for x in middle - origin)])
        placed.append(there)
    return arrays, placed


def packed(arrays: dict[str, Array]) -> tuple[list[dict[str, Any]], str]:
    """Where each array is in the bytes, and the bytes, compressed, in base64."""
    index, parts, offset = [], [], 0
    for name, array in arrays.items():
        data = np.ascontiguousarray(array).tobytes()
        data += bytes(-len(data) % 4)  # a browser wants numbers of 4 bytes at multiples of 4
        index.append(
            {"name": name, "type": array.dtype.name, "shape": array.shape, "offset": offset}
        )
        parts.append(data)
        offset += len(data)
    return index, base64.b64encode(zlib.compress(b"".join(parts), 6)).decode("ascii")
