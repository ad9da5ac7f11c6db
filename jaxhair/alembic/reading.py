"""Reading the strands of an Alembic file from its bytes.

All its Curves that are visible, one after the other, in the place that the transforms above give
them. The file says neither unit nor axis; see `jaxhair.files`. Catmull-Rom curves are read at all
their points, as Blender and Unreal have them; Bezier and B-spline curves where segments meet.
Curves of NURBS, closed ones and instances are refused.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxhair import check
from jaxhair.alembic.archive_reading import Archive, Object
from jaxhair.alembic.archive_writing import TYPES
from jaxhair.alembic.headers import Header
from jaxhair.usd_child import on_curve

CURVES, XFORM = "AbcGeom_Curve_v", "AbcGeom_Xform_v"
KINDS = ("cubic", "linear", "NURBS")
WRAPS = ("nonperiodic", "periodic")
BASES = ("none", "bezier", "bspline", "catmullRom", "hermite", "power")
CHANNELS = {0: 3, 1: 3, 2: 4, 3: 16, 4: 1, 5: 1, 6: 1}
"""Numbers of scale, translation, rotation about an axis by degrees, matrix, and those about x, y
and z."""
_MOST_TIMES = 1_000_000
_SAME = 1e-9  # [s]

Properties = dict[str, Header]


def read(data: bytes, frame: int) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Points [the file's unit] of all strands, shape (all, 3), and counts.

    frame: counted among all times at which curves, or transforms above them, are sampled.

    Raises ValueError saying what is wrong, and what is allowed.
    """
    archive = Archive(data)
    objects = archive.objects()
    if not any(each.schema.startswith(CURVES) for each in objects):
        raise ValueError("it has no Curves; strands must be such")
    for i, each in enumerate(objects):
        if each.instance:
            raise ValueError(
                f"{_path(objects, i)} is an instance of another object, which is not read; make "
                "its instances real"
            )
    needed = _with_parents(objects)
    tops = {i: archive.properties(objects[i].properties) for i in needed}
    inner = {
        i: archive.compound(tops[i], ".geom" if _is_curves(objects[i]) else ".xform")
        for i in needed
    }
    time = _time(archive, objects, inner, frame)
    points, counts = [np.zeros((0, 3), "<f4")], [np.zeros(0, np.int64)]
    places: dict[int, NDArray[np.float64]] = {-1: np.eye(4)}
    known: dict[tuple[bytes, bytes], NDArray[np.float64]] = {}  # of transforms that are the same
    visible = {-1: True}
    for i in needed:
        parent = objects[i].parent
        try:
            visible[i] = visible[parent] and not _hidden(archive, tops[i], time)
            if not _is_curves(objects[i]):
                places[i] = _matrix(archive, inner[i], time, places[parent], known)
                continue
            places[i] = places[parent]
            if visible[i]:
                found, sizes = _strands(archive, inner[i], time)
                points.append(_moved(found, places[i]))
                counts.append(sizes)
        except ValueError as error:
            raise ValueError(f"{_path(objects, i)} is not readable: {error}") from None
    if len(points) == 1:
        raise ValueError("all its curves are invisible; some must be visible")
    return np.concatenate(points), np.concatenate(counts)


def _is_curves(of: Object) -> bool:
    return of.schema.startswith(CURVES)


def _hidden(archive: Archive, properties: Properties, time: float) -> bool:
    header = properties.get("visible")
    if header is None or header.type != TYPES.index("i1"):  # another program's own property
        return False
    shown = archive.sample(properties, "visible", "i1", header.extent, time)
    return shown is not None and bool(np.any(shown == 0))


def _path(objects: Sequence[Object], i: int) -> str:
    names: list[str] = []
    while i > 0 and len(names) < 20:
        names.append(objects[i].name)
        i = objects[i].parent
    return check.short("/" + "/".join(reversed(names)))


def _with_parents(objects: Sequence[Object]) -> list[int]:
    """Places of all curves and of what is above them, parents first."""
    found: set[int] = set()
    for i, each in enumerate(objects):
        place = i if _is_curves(each) else -1
        while place >= 0 and place not in found:
            found.add(place)
            place = objects[place].parent
    return sorted(found)


def _time(
    archive: Archive, objects: Sequence[Object], inner: dict[int, Properties], frame: int
) -> float:
    """The time of a frame [s]."""
    sampled = [
        (header, _is_curves(objects[i]))
        for i, properties in inner.items()
        for name in (("P", "nVertices") if _is_curves(objects[i]) else (".vals",))
        if (header := properties.get(name)) is not None
    ]
    # what never changes may be sampled at a time at which nothing else is
    used = [h for h, _ in sampled if h.changes] or [h for h, curves in sampled if curves]
    most: dict[int, int] = {}
    for header in used:
        most[header.sampling] = max(most.get(header.sampling, 0), header.count)
    if sum(most.values()) > _MOST_TIMES:
        raise ValueError(
            f"its curves have {sum(most.values())} samples; they must have at most {_MOST_TIMES}"
        )
    times = np.concatenate([np.zeros(0), *(archive.times(s, n) for s, n in most.items())])
    times = np.unique(times[np.isfinite(times)])
    times = times[np.diff(times, prepend=-np.inf) > _SAME]
    frames = max(1, len(times))
    if not -frames <= frame < frames:
        raise ValueError(
            f"frame is {frame}; of the {frames} frames that it has, it must be from {-frames} to "
            f"{frames - 1}"
        )
    return float(times[frame]) if len(times) else 0.0


def _strands(
    archive: Archive, properties: Properties, time: float
) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """Points and counts of one object's strands, in its own space."""
    for name in ("P", "nVertices"):
        if name not in properties:
            raise ValueError(f"it has no {name}; Curves must have it")
    points = archive.sample(properties, "P", "<f4", 3, time)
    sizes = archive.sample(properties, "nVertices", "<i4", 1, time)
    if points is None or sizes is None:
        points, sizes = np.zeros((0, 3), "<f4"), np.zeros((0, 1), "<i4")
    counts: NDArray[np.int64] = sizes[:, 0].astype(np.int64)
    if np.any(wrong := (counts < 0) | (counts > len(points))):
        i = int(np.argmax(wrong))
        raise ValueError(
            f"nVertices has the value {counts[i]} at {i}; it must be from 0 to {len(points)}"
        )
    if counts.sum() != len(points):
        raise ValueError(
            f"nVertices add up to {counts.sum()}; they must to the {len(points)} points"
        )
    how = archive.sample(properties, "curveBasisAndType", "u1", 4, time)
    kind, wrap, basis = (
        int(n) for n in (how[0, :3] if how is not None and len(how) else (0, 0, 0))
    )
    knots = archive.sample(properties, ".knots", "<f4", 1, time)
    name = _name(BASES, basis)
    if kind == 0 and (name == "none" or (knots is not None and len(knots))):
        kind = KINDS.index("NURBS")
    wrapped = _name(WRAPS, wrap)
    if name == "catmullRom" and wrapped == "nonperiodic":
        wrapped = "pinned"
    return on_curve(points, counts, kind=_name(KINDS, kind), basis=name, wrap=wrapped)


def _name(names: Sequence[str], number: int) -> str:
    return names[number] if number < len(names) else f"number {number}"


def _matrix(
    archive: Archive,
    properties: Properties,
    time: float,
    parent: NDArray[np.float64],
    known: dict[tuple[bytes, bytes], NDArray[np.float64]],
) -> NDArray[np.float64]:
    """The place of an object in the world: of points in rows, from the right.

    known: local matrices by their operations and numbers, to which a new one is added.
    """
    inherits = archive.sample(properties, ".inherits", "b1", 1, time)
    if inherits is not None and not np.all(inherits):
        parent = np.eye(4)
    ops = archive.sample(properties, ".ops", "u1", 0, time)
    values = archive.sample(properties, ".vals", "<f8", 0, time)
    if ops is None:
        return parent
    numbers = np.zeros(0) if values is None else values.reshape(-1).astype(float)
    key = (ops.tobytes(), numbers.tobytes())
    if key not in known:
        known[key] = _local(ops, numbers)
    with np.errstate(all="ignore"):  # what is not finite is for others to judge
        return known[key] @ parent


def _local(ops: NDArray[Any], numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """The matrix of some operations, the first outermost."""
    kinds = [int(op) >> 4 for op in ops.reshape(-1)]
    if unknown := sorted({*kinds} - CHANNELS.keys()):
        raise ValueError(f"it has a transform of kind {unknown[0]}; it must be from 0 to 6")
    needed = sum(CHANNELS[kind] for kind in kinds)
    if len(numbers) != needed:
        raise ValueError(f"its transforms have {len(numbers)} numbers; they must have {needed}")
    local = np.eye(4)
    with np.errstate(all="ignore"):
        for kind in kinds:
            count = CHANNELS[kind]
            local = _operation(kind, numbers[:count]) @ local
            numbers = numbers[count:]
    return local


def _operation(kind: int, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix = np.eye(4)
    if kind == 3:
        return numbers.reshape(4, 4)
    if kind == 0:
        matrix[:3, :3] = np.diag(numbers)
    elif kind == 1:
        matrix[3, :3] = numbers
    else:
        axis = np.eye(3)[kind - 4] if kind > 3 else numbers[:3]
        length = np.sqrt(np.sum(axis**2))
        matrix[:3, :3] = _rotation(axis / length if length > 0 else axis, np.radians(numbers[-1]))
    return matrix


def _rotation(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """About a unit vector [rad], of vectors in rows, from the right."""
    x, y, z = axis
    across = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    cosine, sine = np.cos(angle), np.sin(angle)
    return cosine * np.eye(3) + sine * across + (1 - cosine) * np.outer(axis, axis)


def _moved(points: NDArray[Any], place: NDArray[np.float64]) -> NDArray[Any]:
    if np.array_equal(place, np.eye(4)):
        return points
    with np.errstate(all="ignore"):
        moved: NDArray[np.float64] = points.astype(float) @ place[:3, :3] + place[3, :3]
    return moved
