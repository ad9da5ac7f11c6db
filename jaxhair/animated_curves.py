"""What files of animated curves hold besides points, in any format: times, widths and hulls."""

import numpy as np

from jaxhair import check
from jaxhair.fibre import PhysicalFibre
from jaxhair.file_formats import HAIR_DIAMETER
from jaxhair.recording import Recording
from jaxhair.scene import Scene


def positions_of(recording: Recording) -> np.ndarray:
    """Points of all frames [m]. Raises ValueError without a frame, or where they are not finite."""
    if len(recording.phases) == 0:
        raise ValueError("recording has 0 frames; it must have at least 1")
    positions = np.asarray(recording.positions)
    check.finite("positions", positions)
    return positions


def time_codes(times: np.ndarray) -> tuple[np.ndarray, float]:
    """Time codes of frames at some times [s], and how many there are a second."""
    if len(times) < 2:
        return times * 24.0, 24.0
    steps = np.diff(times)
    if not np.all(steps > 0):
        raise ValueError("times of a recording must grow from frame to frame")
    rate = 1 / float(np.median(steps))
    if abs(rate - round(rate)) < 1e-4 * rate:
        rate = float(round(rate))
    codes = times * rate
    whole = np.round(codes)
    # times are sums of time steps, whose rounding is no reason for a fractional code
    return np.where(np.abs(codes - whole) < 1e-3, whole, codes), rate


def bezier_points(points: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Control points of the Bezier curves that are the pinned Catmull-Rom curves through points.

    points: shape (..., strands, points, 3). Returns shape (..., strands, 3 points - 2, 3), of
    which a strand has 3 count - 2.
    """
    place, last = np.arange(points.shape[-2]), (counts - 1)[:, None]
    exact = points.astype(float)

    def at(shift: int) -> np.ndarray:
        index = np.clip(place + shift, 0, last)[..., None]
        index = np.broadcast_to(index, (*points.shape[:-1], 1))
        return np.take_along_axis(exact, index, -2)

    # USD's phantom points, 2 p_0 - p_1 before the first, make the ends' slopes those of the edges
    inner = (place > 0) & (place < last)
    slope = (at(1) - at(-1)) / np.where(inner, 2, 1)[..., None]
    start, end = exact[..., :-1, :], exact[..., 1:, :]
    handles = (start + slope[..., :-1, :] / 3, end - slope[..., 1:, :] / 3)
    parts = np.stack([start, *handles], -2).reshape(*points.shape[:-2], -1, 3)
    return np.concatenate([parts, exact[..., -1:, :]], -2).astype(points.dtype)


def inside(points: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Without the padding: from (frames, strands, points, ...) to (frames, all points, ...)."""
    mask = np.arange(points.shape[2]) < counts[:, None]
    kept: np.ndarray = np.ascontiguousarray(points[:, mask])
    return kept


def widths_of(scene: Scene, width: float | None) -> np.ndarray:
    """Widths of the hairs [m], shape (1,) or (strands,): `width` if given, or the fibre's."""
    if width is not None:
        check.positive("width", width)
        return np.array([float(width)])
    fibre = scene.fibre
    if not isinstance(fibre, PhysicalFibre):
        return np.array([HAIR_DIAMETER])
    minor = fibre.radius if fibre.minor_radius is None else fibre.minor_radius
    # an elliptical hair is as wide as the round one of its area
    widths = 2 * np.sqrt(np.asarray(fibre.radius, float) * np.asarray(minor, float)).reshape(-1)
    return widths[:1] if np.all(widths == widths[0]) else widths


def boxes(points: np.ndarray, counts: np.ndarray, width: float) -> np.ndarray:
    """Lowest and highest corner of each frame's hairs of a width, shape (frames, 2, 3).

    points: shape (frames, strands, points, 3), of at least one strand; in the width's unit.
    """
    # of the curve's hull, since a Catmull-Rom curve leaves that of its points
    hull = inside(bezier_points(points, counts), 3 * counts - 2)
    return np.stack([hull.min(1) - width / 2, hull.max(1) + width / 2], 1)
