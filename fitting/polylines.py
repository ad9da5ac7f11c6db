"""Strands as files have them: cleaned, or refused with the reason, and resampled."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from fitting.targets import MM, resampled
from jaxhair import Curves, check

SHARPEST = np.pi / 2
"""Turn [rad] at a point of a file's strand from which on the points do not say what the curl is."""


def listed(curves: Any) -> list[Any]:
    """The strands of `Curves`, or of a list of arrays."""
    if isinstance(curves, Curves):
        return list(curves.to_list())
    check.instance("curves", curves, Sequence)
    return list(curves)


def cleaned(given: Any) -> np.ndarray | str:
    """Points without those that repeat the one before, or why they are no strand."""
    try:
        x = np.asarray(given, float)
    except (TypeError, ValueError):
        return "no points"
    if x.ndim != 2 or x.shape[1] != 3:
        return f"points of shape {x.shape}, not (points, 3)"
    if not np.all(np.abs(x) < check.LARGEST):
        return "not finite"
    edges = np.linalg.norm(np.diff(x, axis=0), axis=1)
    if edges.sum() < check.SMALLEST:
        return "no length" if len(x) > 2 else f"{len(x)} points, fewer than 3"
    x = x[np.append(True, edges > 1e-6 * edges.sum())]
    if len(x) < 3:
        return f"{len(x)} different points, fewer than 3"
    angles = turns(x)
    if angles.max() > SHARPEST:
        place = int(np.argmax(angles)) + 1
        return (
            f"turns by {np.degrees(angles.max()):.0f} degrees at its point {place}: "
            "points too far apart"
        )
    return x


def turns(x: np.ndarray) -> np.ndarray:
    """Angles between the edges of one strand [rad], shape (points - 2,)."""
    t = np.diff(x, axis=0)
    across = np.linalg.norm(np.cross(t[:-1], t[1:]), axis=1)
    return np.arctan2(across, (t[:-1] * t[1:]).sum(axis=1))


def evenly(strands: Sequence[np.ndarray], points: int) -> tuple[np.ndarray, np.ndarray]:
    """Strands at equal steps of arc length, and by how much they miss the points given.

    Returns points [m], shape (strands, points, 3), and the root mean square distance [mm] of each
    strand's given points from the chain at the same share of the arc length, shape (strands,).
    """
    out, off = np.empty((len(strands), points, 3)), np.empty(len(strands))
    for i, x in enumerate(strands):  # one by one, since padding may take far more memory
        out[i] = resampled(x[None], [len(x)], points)[0]
        along = np.linalg.norm(np.diff(x, axis=0), axis=1).cumsum()
        places = np.append(0, along / along[-1]) * (points - 1)
        chain = [np.interp(places, np.arange(points), out[i, :, axis]) for axis in range(3)]
        off[i] = MM * np.sqrt(np.mean(np.sum((np.stack(chain, axis=1) - x) ** 2, axis=1)))
    return out, off
