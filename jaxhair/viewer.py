"""A recording to turn, zoom and play, in a notebook or as a web page in one file.

The page draws with WebGL 2 by code of its own (data/viewer_*.js, 30 kB). three.js was measured
beside it: version 0.187, only the parts that are needed and minified, is 560 kB, which every view
of a notebook would hold again, and npm's package has no minified file, so that a bundler would be
needed to make one. The shaders, which are most of the code, would be the same.
"""

import html
import json
import warnings
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from jaxhair import check, pictures, viewer_data
from jaxhair.export import meshes
from jaxhair.interpolation import Interpolation
from jaxhair.raster import View
from jaxhair.recording import Recording

MOST_HAIRS = 10_000
"""Drawn, unless more are asked for."""

SCRIPTS = ("viewer_data.js", "viewer_drawing.js", "viewer_page.js")


@dataclass(frozen=True, repr=False)
class Viewer:
    """What `view` returns; a notebook shows it.

    page: HTML that needs nothing else. height: in a notebook [pixels].
    note: what was left out to keep the page small, or "".
    """

    page: str
    height: int
    note: str

    def _repr_html_(self) -> str:
        # In a frame of its own nothing of the page meets the notebook's, and `sandbox` without
        # allow-same-origin keeps it from the notebook's data.
        return (
            f'<iframe title="hair" sandbox="allow-scripts" srcdoc="{html.escape(self.page)}" '
            f'style="width: 100%; height: {self.height}px; border: 0"></iframe>'
        )

    def __repr__(self) -> str:
        note = f", {self.note}" if self.note else ""
        return f"Viewer of {len(self.page) / 1e6:.2f} MB{note}: shown by a notebook that is trusted"


def view(
    recording: Recording,
    *,
    color_by: str | None = None,
    frame: int = -1,
    hairs_per_strand: int | None = None,
    view: View | None = None,
    color: pictures.Color = pictures.HAIR_COLOR,
    seed: int = 0,
    height: int = 480,
    max_megabytes: float = 4.0,
) -> Viewer:
    """The recording as an object that a notebook shows: to turn, zoom, play and colour.

    Drag turns, shift or the right button with drag moves, the wheel zooms; two fingers do both.
    Space plays, arrows go from frame to frame, R goes back to the first view. It needs no network
    and is kept by notebooks that are saved or made into HTML (`jupyter nbconvert --to html`).
    `jaxhair.save("perm.html", recording)` writes the same page as a file.

    Arguments:
        color_by: what the colour shows first: a kind of bond (its fraction), "strain" (an edge's
            length over its rest length, less 1), "curvature" [1/m]; None is plain hair.
        frame: shown first; the last.
        hairs_per_strand: hairs drawn for each strand; by default 10, or fewer where that would
            be more than 10,000 hairs.
        view: where from at first; by default `jaxhair.pictures.View()`.
        color: RGB of the hair in [0, 1], as on a screen; by default brown.
        seed: of the random numbers that place the interpolated hairs.
        height: in a notebook [pixels].
        max_megabytes: of the notebook's output [10^6 bytes]. A longer recording is shown with
            every so many of its frames; then a warning is given and the page says so.

    The page has the strands' points in 16 bits an axis: off by at most half of 1/65535 of the
    extent of all hair in all frames along that axis, 4 um for hair that moves within 0.5 m. Values
    shown as colours have 8 bits, off by at most 1/510 of the colour bar. Strain and curvature end
    at the bar's ends: 99 % of the values lie within.

    Raises ValueError for other options, for a recording that has no frame or whose `observed` has
    no "positions", and where not even one frame fits into max_megabytes.
    """
    check.instance("recording", recording, Recording)
    points, counts = viewer_data.hair(recording)
    frames, strands, _, _ = points.shape
    colored = viewer_data.colored(recording, points)
    if color_by is not None:
        check.choice("color_by", color_by, tuple(colored))
    check.whole("frame", frame, least=-frames, most=frames - 1)
    if hairs_per_strand is None:
        hairs_per_strand = min(10, max(1, MOST_HAIRS // strands))
    check.whole("hairs_per_strand", hairs_per_strand, least=1)
    if view is not None:
        check.instance("view", view, View)
    check.shape("color", color, (3,))
    check.fraction("color", color, many=True)
    check.whole("seed", seed, least=0, most=2**63)
    check.whole("height", height, least=100, most=10_000)
    check.positive("max_megabytes", max_megabytes)

    low, step = viewer_data.box(points)
    origin = low + step * viewer_data.STEPS / 2
    fixed: dict[str, Any] = {
        "strands": strands,
        "points": points.shape[2],
        "low": (low - origin).tolist(),
        "step": step.tolist(),
        "origin": origin.tolist(),
        "color": [float(x) for x in color],
        "colorBy": color_by,
        "view": _camera(view or View(), origin),
        "fields": {
            name: {"low": of.low, "high": of.high, "unit": of.unit, "edges": of.edges}
            for name, of in colored.items()
        },
    }
    grown = Interpolation.between(points[0], hairs_per_strand, seed)
    same = {"counts": counts.astype("<u4"), **viewer_data.of_hairs(grown)}
    fixed["reach"] = grown.reach

    def page(kept: np.ndarray, note: str) -> str:
        arrays = dict(same)
        whole = viewer_data.quantised(points[kept], low, step)
        arrays |= viewer_data.of_frames("positions", whole)
        for name, of in levels.items():
            arrays |= viewer_data.of_frames(name, of[kept])
        shapes, placed = viewer_data.obstacles(recording, kept, origin)
        index, data = viewer_data.packed(arrays | shapes)
        header = fixed | {
            "frame": int(np.argmin(np.abs(kept - frame % frames))),
            "times": np.round(np.asarray(recording.times, float)[kept], 6).tolist(),
            "phases": [recording.phases[i] for i in kept],
            "box": _shown(recording, points, kept, origin),
            "obstacles": placed,
            "arrays": index,
            "note": note,
        }
        return _page(header, data)

    levels = {name: of.levels() for name, of in colored.items()}
    kept, note = np.arange(frames), ""
    whole_size = 0.0
    while True:
        found = Viewer(page(kept, note), height, note)
        size = len(found._repr_html_().encode()) / 1e6
        whole_size = whole_size or size
        if size <= max_megabytes:
            break
        if len(kept) == 1:
            raise ValueError(
                f"max_megabytes is {max_megabytes!r}; it must be at least {size:.3g}, what one "
                "frame takes"
            )
        fewer = int(len(kept) * min(0.97 * max_megabytes / size, 1))
        fewer = min(max(fewer, 1), len(kept) - 1)
        kept = np.unique(np.round(np.linspace(0, frames - 1, fewer)).astype(int))
        if fewer == 1:
            kept = np.array([frame % frames])
        note = (
            f"{len(kept)} of {frames} frames: all of them take {whole_size:.3g} MB, and "
            f"max_megabytes is {max_megabytes:g}"
        )
    if note:
        warnings.warn(note, UserWarning, stacklevel=2)
    return found


def _camera(view: View, origin: np.ndarray) -> dict[str, Any]:
    target = None if view.target is None else (np.asarray(view.target, float) - origin).tolist()
    distance = None if view.distance is None else float(view.distance)
    angles = {"azimuth": float(view.azimuth), "elevation": float(view.elevation)}
    return {**angles, "target": target, "distance": distance}


def _shown(
    recording: Recording, points: np.ndarray, kept: np.ndarray, origin: np.ndarray
) -> list[list[float]]:
    """Lowest and highest corner of what must be seen at first, from `origin`."""
    there = [meshes(recording.scene, recording.phases[i], float(recording.times[i])) for i in kept]
    return [(corner - origin).tolist() for corner in pictures.box(points[kept], there, np.eye(3))]


def _page(header: dict[str, Any], data: str) -> str:
    """The template with all parts in it."""
    folder = files("jaxhair") / "data"

    def text(name: str) -> str:
        return (folder / name).read_text(encoding="utf-8")

    # In a script nothing may look like the script's end, so no < is left as it is.
    safe = json.dumps(header, allow_nan=False).replace("<", "\\u003c").replace(">", "\\u003e")
    parts = {
        "STYLE": text("viewer.css"),
        "HEADER": safe.replace("&", "\\u0026"),
        "DATA": data,
        "SCRIPT": "\n".join(text(name) for name in SCRIPTS),
    }
    pieces = text("viewer.html").split("%%")  # once: what is put in is not looked at again
    return "".join(parts.get(piece, piece) for piece in pieces)
