"""Line drawings with matplotlib, apart from pyplot and its global state."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxhair import check
from jaxhair.extras import optional
from jaxhair.interpolation import bezier, used_points
from jaxhair.output import new_file
from jaxhair.raster import Array

PathLike = str | os.PathLike[str]

TARGET_COLOR, FITTED_COLOR = "#9aa5b1", "#b5331d"


def figure(width: float, height: float, **options: Any) -> tuple[Any, Any]:
    """A matplotlib figure [inch] and its canvas."""
    result = optional("matplotlib.figure").Figure((width, height), **options)
    return result, optional("matplotlib.backends.backend_agg").FigureCanvasAgg(result)


def check_suffix(path: PathLike, *allowed: str) -> str:
    """The suffix of `path` in lower case, which must be one of `allowed`."""
    suffix = Path(path).suffix.lower()
    if suffix not in allowed:
        raise ValueError(f"path is {str(path)!r}; its name must end in {' or '.join(allowed)}")
    return suffix


def comparison(
    path: PathLike,
    target: Array | Sequence[Array],
    fitted: Array | Sequence[Array],
    *,
    labels: Sequence[str],
    residuals: Sequence[str] | None = None,
    counts: Array | None = None,
    overwrite: bool = False,
) -> None:
    """Write target against fit as a .png file: two projections of each state, side by side.

    target, fitted: positions [m], shape (strands, points, 3), or one such array for each state.
    labels: name of each state.
    residuals: text below each state, such as "residual 0.3 mm".
    counts: points of each strand, shape (strands,), where they differ.
    """
    check_suffix(path, ".png")
    pairs = _paired(target, fitted)
    for name, texts in (("labels", labels), ("residuals", residuals)):
        if texts is not None and (isinstance(texts, str) or len(texts) != len(pairs)):
            raise ValueError(f"{name} is {texts!r}; it must be a list of {len(pairs)} texts")
    everything = np.concatenate([1e3 * part.reshape(-1, 3) for pair in pairs for part in pair])
    low, high = everything.min(0), everything.max(0)
    # Room about the hair, and a panel that can be read even where all hair is in one plane.
    least = 0.2 * max(float(np.max(high - low)), 1e-3)
    spread = np.maximum(1.08 * (high - low), least)
    low, high = (low + high - spread) / 2, (low + high + spread) / 2
    tall = spread[2] >= spread[0]
    planes = [(0, 2), (1, 2)] if tall else [(0, 2), (0, 1)]
    ratios = [spread[plane[0 if tall else 1]] for plane in planes]
    inch = (4.2 / spread[2]) if tall else (4.2 / spread[0])
    across, along = (sum(ratios) if tall else spread[0]), (spread[2] if tall else sum(ratios))
    panel = (max(across * inch + 1.7, 2.6), along * inch + 1.8)
    drawing, _ = figure(panel[0] * len(pairs), panel[1], dpi=150, layout="constrained")
    drawing.set_facecolor("white")
    states = np.ravel(drawing.subfigures(1, len(pairs)))
    for index, (state, pair) in enumerate(zip(states, pairs, strict=True)):
        state.suptitle(labels[index], fontweight="bold")
        if residuals is not None:
            state.supxlabel(residuals[index], fontsize="medium", color="0.35")
        if tall:
            panels = state.subplots(1, 2, sharey=True, width_ratios=ratios)
        else:
            panels = state.subplots(2, 1, sharex=True, height_ratios=ratios)
        for axes, plane in zip(panels, planes, strict=True):
            _compare(axes, pair, plane, counts)
            axes.set(xlim=(low[plane[0]], high[plane[0]]), ylim=(low[plane[1]], high[plane[1]]))
            axes.set_aspect("equal")
            first = axes is panels[0]
            if tall or not first:
                axes.set_xlabel(f"{'xyz'[plane[0]]} [mm]")
            if first or not tall:
                axes.set_ylabel(f"{'xyz'[plane[1]]} [mm]")
    handles = [
        optional("matplotlib.lines").Line2D([], [], color=color, linewidth=3, label=text)
        for color, text in ((TARGET_COLOR, "target"), (FITTED_COLOR, "fit"))
    ]
    drawing.legend(handles=handles, loc="outside lower center", ncols=2, frameon=False)
    with new_file(path, overwrite=overwrite) as temporary:
        drawing.savefig(temporary)


def _paired(
    target: Array | Sequence[Array], fitted: Array | Sequence[Array]
) -> list[tuple[Array, Array]]:
    """Target and fit of each state."""
    states = []
    for name, value in (("target", target), ("fitted", fitted)):
        if not len(value):
            raise ValueError(f"{name} is empty; it must have one state or more")
        arrays = [np.asarray(value)] if np.ndim(value[0]) == 2 else [np.asarray(v) for v in value]
        for array in arrays:
            check.shape(name, array, ("strands", "points", 3))
            check.finite(name, array)
        states.append(arrays)
    if [a.shape for a in states[0]] != [a.shape for a in states[1]]:
        raise ValueError(
            f"fitted has the shapes {[a.shape for a in states[1]]}; "
            f"they must be those of target, {[a.shape for a in states[0]]}"
        )
    return list(zip(*states, strict=True))


def _compare(
    axes: Any, pair: tuple[Array, Array], plane: tuple[int, int], counts: Array | None
) -> None:
    """Draw the projections of target and fit on `plane`."""
    thin = min(1.0, (20 / len(pair[0])) ** 0.5)
    for points, color, width in zip(pair, (TARGET_COLOR, FITTED_COLOR), (4.0, 1.3), strict=True):
        used = used_points(counts, points)
        curves, _ = bezier(1e3 * points, used, 8)
        lines = [curve[: 8 * (n - 1) + 1, plane] for curve, n in zip(curves, used, strict=True)]
        collection = optional("matplotlib.collections").LineCollection
        axes.add_collection(
            collection(lines, color=color, linewidth=width * thin, capstyle="round")
        )
    axes.grid(color="0.92")
    axes.set_axisbelow(True)
    axes.locator_params(nbins=4)
    axes.tick_params(labelsize="small")
