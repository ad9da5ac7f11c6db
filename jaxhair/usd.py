"""Writing USD: a recording as animated BasisCurves with its obstacles, or strands that stand still.

    /hair             Xform, the default prim
    /hair/strands     BasisCurves; samples of points and extent in each frame, widths, displayColor
                      and, for each kind of bond, primvars:bonded_hydrogen and so on
    /hair/obstacles   Meshes; they are invisible in frames of phases that they are not in

Needs the extra `usd`. Reading is in usd_reading.py.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxhair import check, shading
from jaxhair.animated_curves import (
    bezier_points,
    boxes,
    inside,
    positions_of,
    time_codes,
    widths_of,
)
from jaxhair.extras import optional
from jaxhair.file_formats import HAIR_DIAMETER
from jaxhair.files import check_unit, to_unit
from jaxhair.output import new_file
from jaxhair.pictures import HAIR_COLOR, Color
from jaxhair.recording import Recording
from jaxhair.strands import BONDS
from jaxhair.usd_obstacles import Solid, solids, write_obstacles

BASES = ("catmullRom", "bezier", "linear")
STRANDS = "/hair/strands"


def write(
    path: str | os.PathLike[str],
    recording: Recording,
    *,
    basis: str = "catmullRom",
    width: float | None = None,
    color: Color = HAIR_COLOR,
    color_by: str | None = None,
    unit: float = 1.0,
    up: str = "z",
    overwrite: bool = False,
) -> None:
    """Writes all frames of a recording to a .usd, .usda or .usdc file, positions as float32.

    Arguments:
        basis: "catmullRom", pinned, through the points; "bezier", the same curve with handles,
            for programs that know no other; or "linear", straight from point to point.
        width: of the hairs as drawn [m]. By default a `PhysicalFibre`'s thickness, of each strand
            where they differ, or 80 um.
        color: RGB of the hair in [0, 1], as on a screen.
        color_by: kind of bond whose fraction is shown from blue (0) to red (1) instead.
        unit: of length in the file [m], its metersPerUnit. up: its axis that points up, "y" or "z".
        overwrite: replace a file that exists.

    There are as many time codes a second as frames in the median, and a frame is at its time
    times that number: at 0, 1, 2, ... where frames are regular. Where a phase ends between two
    frames, its last frame has a fractional code, so that every frame is there as simulated;
    players show whole codes and interpolate linearly.

    Raises ValueError for a recording without frames, and FileExistsError.
    """
    check.choice("basis", basis, BASES)
    check.shape("color", color, (3,))
    check.fraction("color", color, many=True)
    positions = positions_of(recording)
    counts = np.asarray(recording.scene.strands.counts)
    check_unit(unit, up)
    codes, rate = time_codes(np.asarray(recording.times, float))
    bonded = recording.fractions_at_points().astype(np.float32)
    colors = np.broadcast_to(shading.linear(np.asarray(color)), (1, 3))
    if color_by is not None:
        colors = shading.bonded_color(bonded[..., BONDS.index(color_by)])
    points = to_unit(positions, unit, up).astype(np.float32)
    with new_file(path, overwrite=overwrite) as temporary:
        stage = _stage(unit, up)
        _time(stage, codes, rate, recording)
        curves = _curves(stage, points, counts, codes, basis)
        widths = widths_of(recording.scene, width) / unit
        _set_widths(curves, widths, _sizes(counts, basis))
        _set_extents(curves, points, counts, codes, float(widths.max()))
        _set_primvars(curves, bonded, colors, counts, codes, basis)
        write_obstacles(stage, _placed(solids(recording), unit, up), codes)
        stage.GetRootLayer().Export(str(temporary))


def write_still(
    path: Path, points: np.ndarray, counts: np.ndarray, *, unit: float, up: str
) -> None:
    """Writes strands as they stand, pinned catmullRom: points in the file's unit and axes, float32,
    shape (strands, points, 3); counts of each strand, at least 2."""
    if np.any(wrong := counts < 2):
        i = int(np.argmax(wrong))
        raise ValueError(
            f"strand {i} has {counts[i]} point; in a USD file a strand must have at least 2"
        )
    stage = _stage(unit, up)
    curves = _curves(stage, points[None], counts, None, "catmullRom")
    width = HAIR_DIAMETER / unit
    _set_widths(curves, np.array([width]), counts)
    _set_extents(curves, points[None], counts, None, width)
    stage.GetRootLayer().Export(str(path))


def _stage(unit: float, up: str) -> Any:
    usd, geom = optional("pxr.Usd", "usd"), optional("pxr.UsdGeom", "usd")
    stage = usd.Stage.CreateInMemory()
    geom.SetStageMetersPerUnit(stage, float(unit))
    geom.SetStageUpAxis(stage, up.upper())
    root = geom.Xform.Define(stage, "/hair").GetPrim()
    stage.SetDefaultPrim(root)
    usd.ModelAPI(root).SetKind("component")
    return stage


def _time(stage: Any, codes: np.ndarray, rate: float, recording: Recording) -> None:
    vt = optional("pxr.Vt", "usd")
    stage.SetTimeCodesPerSecond(rate)
    stage.SetFramesPerSecond(rate)
    stage.SetStartTimeCode(float(codes[0]))
    stage.SetEndTimeCode(float(codes[-1]))
    times = np.asarray(recording.times, float)
    stage.GetRootLayer().customLayerData = {
        "jaxhair": {
            "phases": vt.StringArray(list(recording.phases)),
            "times": vt.DoubleArray.FromNumpy(np.ascontiguousarray(times)),
        }
    }


def _sizes(counts: np.ndarray, basis: str) -> np.ndarray:
    """Control points of each strand."""
    return 3 * counts - 2 if basis == "bezier" else counts


def samples(attribute: Any, values: Sequence[Any], codes: np.ndarray | None) -> None:
    """Sets an attribute's value of each frame, or the only one."""
    if codes is None or len(values) == 1:
        attribute.Set(values[0])
        return
    for code, value in zip(codes, values, strict=True):
        attribute.Set(value, float(code))


def _curves(
    stage: Any, points: np.ndarray, counts: np.ndarray, codes: np.ndarray | None, basis: str
) -> Any:
    geom, vt = optional("pxr.UsdGeom", "usd"), optional("pxr.Vt", "usd")
    curves = geom.BasisCurves.Define(stage, STRANDS)
    curves.CreateTypeAttr("linear" if basis == "linear" else "cubic")
    if basis != "linear":
        curves.CreateBasisAttr(basis)
    curves.CreateWrapAttr("pinned" if basis == "catmullRom" else "nonperiodic")
    sizes = _sizes(counts, basis)
    curves.CreateCurveVertexCountsAttr(vt.IntArray.FromNumpy(sizes.astype(np.int32)))
    control = bezier_points(points, counts) if basis == "bezier" else points
    rows = [vt.Vec3fArray.FromNumpy(row) for row in inside(control, sizes)]
    attribute = curves.CreatePointsAttr()
    if codes is None:
        attribute.Set(rows[0])
    else:  # a sample even of a single frame, which has a time
        for code, row in zip(codes, rows, strict=True):
            attribute.Set(row, float(code))
    return curves


def _set_widths(curves: Any, widths: np.ndarray, sizes: np.ndarray) -> None:
    vt = optional("pxr.Vt", "usd")
    constant = len(widths) == 1
    each = widths if constant else np.repeat(widths, sizes)
    curves.CreateWidthsAttr(vt.FloatArray.FromNumpy(each.astype(np.float32)))
    curves.SetWidthsInterpolation("constant" if constant else "vertex")


def _set_extents(
    curves: Any, points: np.ndarray, counts: np.ndarray, codes: np.ndarray | None, width: float
) -> None:
    if len(counts) == 0:
        return
    vt = optional("pxr.Vt", "usd")
    box = boxes(points, counts, width).astype(np.float32)
    samples(curves.CreateExtentAttr(), [vt.Vec3fArray.FromNumpy(b) for b in box], codes)


def _set_primvars(
    curves: Any,
    bonded: np.ndarray,
    colors: np.ndarray,
    counts: np.ndarray,
    codes: np.ndarray,
    basis: str,
) -> None:
    """Bonded fractions and colour: one for each point, which bezier curves call varying."""
    geom, sdf = optional("pxr.UsdGeom", "usd"), optional("pxr.Sdf", "usd")
    vt = optional("pxr.Vt", "usd")
    each = "varying" if basis == "bezier" else "vertex"
    api = geom.PrimvarsAPI(curves)
    for kind, name in enumerate(BONDS):
        primvar = api.CreatePrimvar(f"bonded_{name}", sdf.ValueTypeNames.FloatArray, each)
        rows = _changing(inside(bonded[..., kind], counts))
        samples(primvar.GetAttr(), [vt.FloatArray.FromNumpy(row) for row in rows], codes)
    color = curves.CreateDisplayColorPrimvar("constant" if colors.ndim == 2 else each)
    rows = colors[None] if colors.ndim == 2 else _changing(inside(colors, counts))
    values = [vt.Vec3fArray.FromNumpy(np.ascontiguousarray(row, np.float32)) for row in rows]
    samples(color.GetAttr(), values, codes)


def _changing(rows: np.ndarray) -> np.ndarray:
    """All frames, or only the first where all are equal."""
    return rows[:1] if np.array_equal(rows, np.broadcast_to(rows[:1], rows.shape)) else rows


def _placed(found: Sequence[Solid], unit: float, up: str) -> list[Solid]:
    return [solid.moved(lambda v: to_unit(v, unit, up).astype(np.float32)) for solid in found]
