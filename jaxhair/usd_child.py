"""Reads the strands of a USD file, as a program of its own, run by `jaxhair.usd_reading`.

A damaged .usdc file can make the USD library ask for all memory of the machine, or crash. Here it
takes only this process with it. Imports nothing of the package, which would take a second.
"""

import contextlib
import json
import math
import os
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

MOST_POINTS = 10**8
SPARE, RATIO = 2**31, 100  # bytes of memory, and those over the file's: files may refer to others


def on_curve(
    points: np.ndarray, counts: np.ndarray, *, kind: str, basis: str, wrap: str
) -> tuple[np.ndarray, np.ndarray]:
    """Of each curve the points that it passes through, where its segments meet.

    Arguments:
        points: control points of all curves one after the other, shape (all, 3).
        counts: control points of each curve.
        kind, basis, wrap: as USD has them: type, basis and wrap of BasisCurves.
    Returns points and counts. Curves of one control point stay as they are. Raises ValueError for
    a number of control points that no such curve has, and for what is not read.
    """
    if kind not in ("linear", "cubic"):
        raise ValueError(f"its type is {kind!r}; it must be 'linear' or 'cubic'")
    if wrap not in ("nonperiodic", "pinned"):
        raise ValueError(
            f"its wrap is {wrap!r}, closed curves, which no hair is; it must be 'nonperiodic' or "
            "'pinned'"
        )
    if kind == "linear":
        return points, counts
    if basis not in ("bezier", "bspline", "catmullRom"):
        raise ValueError(f"its basis is {basis!r}; it must be 'bezier', 'bspline' or 'catmullRom'")
    pinned = wrap == "pinned" and basis != "bezier"
    several = counts > 1
    wrong = several & (((counts - 1) % 3 != 0) if basis == "bezier" else (counts < 4))
    if not pinned and np.any(wrong):
        i = int(np.argmax(wrong))
        wanted = "1 more than a multiple of 3" if basis == "bezier" else "at least 4"
        raise ValueError(
            f"its curve {i}, {basis} and {wrap}, has {counts[i]} control points; it must have "
            f"{wanted}"
        )
    if pinned and basis == "catmullRom":
        return points, counts
    each = np.repeat(np.arange(len(counts)), counts)
    place = np.arange(len(points)) - (np.cumsum(counts) - counts)[each]
    last = counts[each] - 1
    if basis == "bezier":
        keep = place % 3 == 0
    else:
        inner = (place > 0) & (place < last)
        keep = inner | pinned | (last == 0)
        if basis == "bspline":
            at = np.flatnonzero(inner)
            smooth = points.astype(float)
            smooth[at] = (points[at - 1] + 4 * smooth[at] + points[at + 1]) / 6
            points = smooth
    return points[keep], np.bincount(each[keep], minlength=len(counts))


def read(path: str, frame: int, time: float | None) -> tuple[dict[str, Any], Any, Any]:
    """Unit and axis of a file, points [its unit] in the world, and counts of all strands."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(path)
    unit, up = UsdGeom.GetStageMetersPerUnit(stage), str(UsdGeom.GetStageUpAxis(stage)).lower()
    if not (math.isfinite(unit) and 1e-12 <= unit <= 1e12):
        raise ValueError(f"its metersPerUnit is {unit}; it must be from 1e-12 to 1e12")
    if up not in ("y", "z"):
        raise ValueError(f"its upAxis is {up!r}; it must be 'Y' or 'Z'")
    prims = list(_curves(stage))
    if not prims:
        why = [str(e).partition("\n")[0][:200] for e in stage.GetCompositionErrors()[:1]]
        raise ValueError("; ".join(["it has no BasisCurves; strands must be such", *why]))
    code = _code(stage, prims, frame, time)
    places = UsdGeom.XformCache(code)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for prim in prims:
        if UsdGeom.Imageable(prim).ComputeVisibility(code) == UsdGeom.Tokens.invisible:
            continue
        if prim.IsA(UsdGeom.NurbsCurves):
            raise ValueError(
                f"{prim.GetPath()} is of NurbsCurves, which are not read; convert them to "
                "BasisCurves, or hide them"
            )
        try:
            points, counts = _strands(prim, code)
        except ValueError as error:
            raise ValueError(f"{prim.GetPath()} is not readable: {error}") from None
        matrix = np.array(places.GetLocalToWorldTransform(prim))
        if not np.array_equal(matrix, np.eye(4)):
            points = points.astype(float) @ matrix[:3, :3] + matrix[3, :3]
        found.append((points, counts))
        if sum(len(p) for p, _ in found) > MOST_POINTS:
            raise ValueError(f"it has more than {MOST_POINTS:.0e} points; it must have fewer")
    if not found:
        raise ValueError("all its curves are invisible; some must be visible")
    points = np.concatenate([p.astype(float) for p, _ in found])
    return {"unit": unit, "up": up}, points, np.concatenate([c for _, c in found])


def _curves(stage: Any) -> Iterator[Any]:
    """All prims that are curves, of instances too."""
    from pxr import Usd, UsdGeom

    everywhere = Usd.TraverseInstanceProxies(Usd.PrimDefaultPredicate)
    walk = iter(Usd.PrimRange.Stage(stage, everywhere))
    for prim in walk:
        if prim.IsA(UsdGeom.PointInstancer):
            walk.PruneChildren()
            if any(p.IsA(UsdGeom.Curves) for p in Usd.PrimRange(prim, everywhere)):
                raise ValueError(
                    f"{prim.GetPath()} is a PointInstancer of curves, which is not read; make its "
                    "instances real"
                )
        elif prim.IsA(UsdGeom.Curves):
            yield prim


def _code(stage: Any, prims: list[Any], frame: int, time: float | None) -> Any:
    """The time code of a frame, counted among all times at which curves or their places are
    sampled, or of a time [s]."""
    from pxr import Usd, UsdGeom

    if time is not None:
        return Usd.TimeCode(time * stage.GetTimeCodesPerSecond())
    samples: set[float] = set()
    done = set()
    for prim in prims:
        curves = UsdGeom.Curves(prim)
        for attribute in (curves.GetPointsAttr(), curves.GetCurveVertexCountsAttr()):
            samples.update(attribute.GetTimeSamples())
        place = prim
        while place and place.GetPath() not in done:
            done.add(place.GetPath())
            if place.IsA(UsdGeom.Xformable):
                samples.update(UsdGeom.Xformable(place).GetTimeSamples())
            place = place.GetParent()
    codes = sorted(samples)
    frames = max(1, len(codes))
    if not -frames <= frame < frames:
        raise ValueError(
            f"frame is {frame}; of the {frames} frames that it has, it must be from {-frames} to "
            f"{frames - 1}"
        )
    return Usd.TimeCode(codes[frame]) if codes else Usd.TimeCode.Default()


def _strands(prim: Any, code: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points and counts of one prim's strands, in its own space."""
    from pxr import UsdGeom

    curves = UsdGeom.Curves(prim)
    points = _array("points", curves.GetPointsAttr().Get(code), "fiu", (3,))
    counts = _array("curveVertexCounts", curves.GetCurveVertexCountsAttr().Get(code), "iu", ())
    counts = counts.astype(np.int64)
    if np.any(counts < 0):
        raise ValueError(f"curveVertexCounts has the value {counts.min()}; it must be 0 or more")
    if counts.sum() != len(points):
        raise ValueError(
            f"curveVertexCounts add up to {counts.sum()}; they must to the {len(points)} points"
        )
    if not prim.IsA(UsdGeom.BasisCurves):  # HermiteCurves pass through their points
        return points, counts
    basis = UsdGeom.BasisCurves(prim)
    kind, name, wrap = (
        str(attribute.Get(code))
        for attribute in (basis.GetTypeAttr(), basis.GetBasisAttr(), basis.GetWrapAttr())
    )
    return on_curve(points, counts, kind=kind, basis=name, wrap=wrap)


def _array(name: str, value: Any, kinds: str, each: tuple[int, ...]) -> np.ndarray:
    if value is None:
        return np.zeros((0, *each), "f4" if "f" in kinds else "i4")
    array = np.array(value)
    if array.size == 0:
        array = array.reshape(0, *each)
    if array.dtype.kind not in kinds or array.shape[1:] != each or array.ndim != 1 + len(each):
        raise ValueError(f"{name} is of another type; it must be as BasisCurves have it")
    return array


def _limit_memory(path: str) -> None:
    with contextlib.suppress(ImportError, OSError, ValueError):  # not every system can
        import resource

        most = SPARE + RATIO * os.path.getsize(path)
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main() -> None:
    """Writes one line of JSON, and then points as float64 and counts as int64."""
    path, frame, time = sys.argv[1:]
    answer = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # the library prints too
    _limit_memory(path)
    parts: list[bytes] = []
    try:
        head, points, counts = read(path, int(frame), float(time) if time else None)
        parts = [points.astype("<f8").tobytes(), counts.astype("<i8").tobytes()]
        head |= {"points": len(points), "strands": len(counts)}
    except ImportError as error:
        head = {"missing": str(error)}
    except ValueError as error:
        head = {"error": str(error)}
    except Exception as error:  # whatever the library raises
        text = next((s for s in map(str.strip, str(error).splitlines()) if s), "")
        text = text.partition(" : ")[2] or text  # after the place in the library's source
        head = {"error": f"it is not readable as USD ({type(error).__name__}: {text[:200]})"}
    with answer:
        answer.write(json.dumps(head).encode() + b"\n")
        answer.writelines(parts)


if __name__ == "__main__":
    main()
