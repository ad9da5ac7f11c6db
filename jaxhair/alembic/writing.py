"""Writing Alembic: a recording as animated curves, or strands that stand still.

    /hair             Xform, the identity; arbGeomParams groom_version_major, groom_version_minor
                      and groom_tool, where Unreal looks for them
    /hair/strands     Curves; samples of P and bounds in each frame, width of each point;
                      arbGeomParams groom_id and, of recordings, bonded_hydrogen and so on

An Alembic file says neither its unit of length nor which axis points up: metres and Y up unless
told, as Blender and Houdini have it; for Maya and Unreal, which count in centimetres, `unit=0.01`.
Obstacles are not written: Unreal refuses grooms with meshes.

Not written either: `groom_guide`, since Unreal does not render strands that are guides, and makes
guides of the others by itself; `groom_width`, since it scales `width` where it imports, not that.

Needs nothing but NumPy. Reading is in reading.py.
"""

import os
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from jaxhair import check, shading
from jaxhair.alembic.archive_writing import ACYCLIC, Node, Property, Sampling, write_archive
from jaxhair.animated_curves import boxes, inside, positions_of, time_codes, widths_of
from jaxhair.file_formats import HAIR_DIAMETER
from jaxhair.files import check_unit, to_unit
from jaxhair.output import new_file
from jaxhair.recording import Recording
from jaxhair.strands import BONDS

BASES = {"linear": (1, 0, 0, 0), "catmullRom": (0, 0, 3, 3)}  # type, not periodic, and basis twice
STILL = Sampling(1.0, (0.0,))
GROOM_VERSION = (1, 5)  # of Epic's "Alembic for Grooms"
_XFORM = "schema=AbcGeom_Xform_v3"
_CURVES = "schema=AbcGeom_Curve_v2;schemaBaseType=AbcGeom_GeomBase_v1"


def write(
    path: str | os.PathLike[str],
    recording: Recording,
    *,
    basis: str = "linear",
    width: float | None = None,
    color_by: str | None = None,
    unit: float = 1.0,
    up: str = "y",
    overwrite: bool = False,
) -> None:
    """Writes all frames of a recording to an .abc file, positions as float32.

    Arguments:
        basis: "linear", straight from point to point, which all programs draw through all points;
            or "catmullRom", which Blender draws smoothly through them, but others by RenderMan's
            rules, without the first and last edge.
        width: of the hairs as drawn [m]. By default a `PhysicalFibre`'s thickness, of each strand
            where they differ, or 80 um.
        color_by: kind of bond whose fraction is written as `groom_color` too, blue (0) to red (1).
        unit: of length in the file [m]. up: its axis that points up, "y" or "z".
        overwrite: replace a file that exists.

    Frames are at their times [s]: at a constant rate where they are regular, or each at its own.

    Raises ValueError for a recording without frames, and FileExistsError.
    """
    check.choice("basis", basis, tuple(BASES))
    positions = positions_of(recording)
    check_unit(unit, up)
    counts = np.asarray(recording.scene.strands.counts)
    times = np.asarray(recording.times, float)
    codes, rate = time_codes(times)
    regular = np.array_equal(codes - codes[0], np.arange(len(codes)))
    sampling = Sampling(1 / rate, (times[0],)) if regular else Sampling(ACYCLIC, tuple(times))
    bonded = recording.fractions_at_points().astype("<f4")
    added = [
        _parameter(f"bonded_{name}", inside(bonded[..., kind], counts)[..., None], sampling=1)
        for kind, name in enumerate(BONDS)
    ]
    if color_by is not None:
        colors = shading.bonded_color(bonded[..., BONDS.index(color_by)])
        values = inside(colors, counts).astype("<f4")
        added.append(_parameter("groom_color", values, sampling=1, interpretation="vector"))
    widths = np.broadcast_to(widths_of(recording.scene, width) / unit, counts.shape)
    points = to_unit(positions, unit, up).astype("<f4")
    hair = _hair(points, counts, widths, basis, added, sampling=1)
    with new_file(path, overwrite=overwrite) as temporary, temporary.open("wb") as file:
        _write(file, hair, (STILL, sampling), rate)


def write_still(path: Path, points: np.ndarray, counts: np.ndarray, *, unit: float) -> None:
    """Writes strands as they stand, linear: points in the file's unit and axes, float32, shape
    (strands, points, 3); counts of each strand, at least 1; unit [m]."""
    widths = np.full(counts.shape, HAIR_DIAMETER / unit)
    with path.open("wb") as file:
        _write(file, _hair(points[None], counts, widths, "linear", [], sampling=0), (STILL,), 24.0)


def _write(file: BinaryIO, hair: Node, samplings: Sequence[Sampling], rate: float) -> None:
    metadata = f"FramesPerTimeUnit={rate:f};_ai_AlembicVersion=Alembic 1.8.3;_ai_Application="
    write_archive(file, Node("", children=(hair,)), samplings, metadata + _tool())


def _hair(
    points: np.ndarray,
    counts: np.ndarray,
    widths: np.ndarray,
    basis: str,
    added: Sequence[Property],
    *,
    sampling: int,
) -> Node:
    """The transform with the curves.

    Arguments:
        points: float32 in the file's unit, shape (frames, strands, points, 3).
        widths: of each strand, in the file's unit.
        added: further parameters of the curves.
        sampling: the place of that of the frames.
    """
    frames, strands = len(points), len(counts)
    inner = inside(points, counts)
    box = _boxes(points, inner, counts, widths, basis)
    basis_and_type = np.array(BASES[basis], "u1")
    curves = (
        Property(
            ".selfBnds",
            box.reshape(frames, 6).astype("<f8"),
            scalar=True,
            sampling=sampling,
            metadata="interpretation=box",
        ),
        Property(
            "P",
            inner,
            sampling=sampling,
            metadata="geoScope=vtx;interpretation=point",
        ),
        Property("nVertices", [_column(counts, "<i4")] * frames, sampling=sampling),
        Property("curveBasisAndType", [basis_and_type] * frames, scalar=True, sampling=sampling),
        # of each point, because neither Blender nor Unreal takes one width for all
        _parameter("width", [_column(np.repeat(widths, counts), "<f4")]),
        _compound(
            ".arbGeomParams",
            _parameter("groom_id", [_column(range(strands), "<i4")], "uni"),
            *added,
        ),
    )
    groom = (
        _parameter("groom_version_major", [_column([GROOM_VERSION[0]], "<i2")], "con"),
        _parameter("groom_version_minor", [_column([GROOM_VERSION[1]], "<i2")], "con"),
        _parameter("groom_tool", [_tool()], "con"),
    )
    inherits = Property(".inherits", [np.array([True])], scalar=True)
    return Node(
        "hair",
        f"{_XFORM};schemaObjTitle=AbcGeom_Xform_v3:.xform",
        (_compound(".xform", inherits, _compound(".arbGeomParams", *groom), metadata=_XFORM),),
        (
            Node(
                "strands",
                f"{_CURVES};schemaObjTitle=AbcGeom_Curve_v2:.geom",
                (_compound(".geom", *curves, metadata=_CURVES),),
            ),
        ),
    )


def _boxes(
    points: np.ndarray, inner: np.ndarray, counts: np.ndarray, widths: np.ndarray, basis: str
) -> np.ndarray:
    """Of each frame, shape (frames, 2, 3)."""
    if len(counts) == 0:
        return np.zeros((len(points), 2, 3))
    width = float(widths.max())
    if basis == "linear":
        half = np.array([[-width / 2], [width / 2]])
        return np.stack([inner.min(1), inner.max(1)], 1).astype(float) + half
    return boxes(points.astype(float), counts, width)


def _compound(name: str, *properties: Property, metadata: str = "") -> Property:
    return Property(name, metadata=metadata, compound=properties)


def _parameter(
    name: str,
    samples: Sequence[Any] | np.ndarray,
    scope: str = "vtx",
    *,
    sampling: int = 0,
    interpretation: str = "",
) -> Property:
    """A parameter of geometry: a value of each point ("vtx") or strand ("uni"), or one ("con")."""
    text = isinstance(samples[0], str)
    metadata = {
        "arrayExtent": 1,
        "geoScope": scope,
        "interpretation": interpretation,
        "isGeomParam": "true",
        "podExtent": 1 if text else samples[0].shape[1],
        "podName": "string" if text else f"{samples[0].dtype.name}_t",
    }
    written = ";".join(f"{key}={value}" for key, value in metadata.items() if value)
    return Property(name, samples, sampling=sampling, metadata=written)


def _column(values: Sequence[int] | np.ndarray, kind: str) -> np.ndarray:
    """One number in each row."""
    return np.asarray(values, kind)[:, None]


def _tool() -> str:
    try:
        return f"jaxhair {version('jaxhair')}"
    except PackageNotFoundError:  # a copy that is not installed
        return "jaxhair"
