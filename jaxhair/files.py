"""Strand files: .hair, .data, .npz, Alembic and USD.

| ending  | content                                                                             |
| ------- | ----------------------------------------------------------------------------------- |
| `.hair` | Cem Yuksel's HAIR format; thickness, transparency and colours are not read          |
| `.data` | int32 strands; for each, int32 points and that many x y z as float32                |
| `.npz`  | `positions`, shape (strands, points, 3) or (frames, strands, points, 3), of which   |
|         | one frame is read; optionally `counts`, the points of each strand                   |
| `.abc`  | Alembic's Curves in one frame, see `jaxhair.alembic.reading`                        |
| `.usd`, | BasisCurves at one time, see `jaxhair.usd_reading`; needs the extra `usd`           |
| `.usda`,|                                                                                     |
| `.usdc` |                                                                                     |

All are written in float32, and the first four little-endian. Of these none says what its unit of
length is or which of its axes points up, so a reader must know: `unit` and `up` of the functions
below, by default metres, and Z up, but Y up in Alembic files, as Blender and Houdini write them
(Maya and Unreal count in centimetres). USD files say it; where one does not, by USD's rules it is
in centimetres and Y up.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxhair import check, usd_reading
from jaxhair.arrays import check_regular, contents, numbers
from jaxhair.file_formats import Counts, Points, check_counts, format_of, usual_up
from jaxhair.output import new_file

# Padding strands to one length can need far more memory than the file: refused above this many
# points, unless it is at most this many times the points of the strands.
_PADDED_POINTS = 10_000_000
_PADDED_RATIO = 100


@dataclass(frozen=True, eq=False)
class Curves:
    """Strands as polylines, Z up.

    points: [m], shape (strands, points, 3). Those of a strand beyond its count are no points of
    it: whatever is given there is replaced by its last point. Kept as a float64 copy.
    counts: number of points of each strand, shape (strands,), each from 1 to the size of `points`.

    Raises ValueError where a shape or type is wrong, a count is outside its range or a coordinate
    is not finite.
    """

    points: NDArray[np.float64]
    counts: NDArray[np.int64]

    def __post_init__(self) -> None:
        points = numbers("points", self.points, "fiu")
        with np.errstate(all="ignore"):  # a value too large for float64 is reported below
            points = points.astype(np.float64)
        counts = numbers("counts", self.counts, "iu")
        if points.ndim != 3 or points.shape[-1] != 3:
            raise ValueError(
                f"points has shape {points.shape}; it must have shape (strands, points, 3)"
            )
        strands, most, _ = points.shape
        check_counts(counts, strands, least=1, most=most)
        counts = counts.astype(np.int64)
        if np.any(counts < most):
            beyond = np.arange(most) >= counts[:, None]
            last = points[np.arange(strands), counts - 1]
            points = np.where(beyond[:, :, None], last[:, None, :], points)
        if not np.all(finite := np.isfinite(points)):
            strand, point, axis = (int(i) for i in np.argwhere(~finite)[0])
            value = points[strand, point, axis]
            raise ValueError(
                f"points has the value {value} at {(strand, point, axis)}; it must be finite"
            )
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "counts", counts)

    @classmethod
    def from_list(cls, strands: Iterable[ArrayLike]) -> "Curves":
        """Curves of the given strands: points [m], each of shape (its points, 3), at least one.

        Raises ValueError naming the strand that has another shape or a coordinate that is not
        finite; and where a few strands are so much longer than the others that padding all to
        one length would need over a hundred times the memory.
        """
        try:
            given = list(strands)
        except Exception:  # whatever a foreign object raises
            wanted = "it must be a list of arrays, one a strand"
            raise ValueError(f"strands is {check.short(strands)}; {wanted}") from None
        arrays = [numbers(f"strand {i}", s, "fiu") for i, s in enumerate(given)]
        for i, array in enumerate(arrays):
            if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
                raise ValueError(
                    f"strand {i} has shape {array.shape}; it must have shape (points, 3) with at "
                    "least one point"
                )
        counts = np.array([len(array) for array in arrays], dtype=np.int64)
        return cls(_padded(np.concatenate([np.zeros((0, 3)), *arrays]), counts), counts)

    def to_list(self) -> list[NDArray[np.float64]]:
        """Points [m] of each strand, shape (its points, 3), without the padding."""
        return [p[:n].copy() for p, n in zip(self.points, self.counts, strict=True)]


def read_curves(
    path: str | os.PathLike[str],
    *,
    unit: float | None = None,
    up: Literal["y", "z"] | None = None,
    skip_short: bool = False,
    frame: int = -1,
    time: float | None = None,
) -> Curves:
    """Strands of a .hair, .data, .npz, .abc or USD file, in metres, Z up, in the file's order.

    unit: length of the file's unit [m]: 0.01 for centimetres, 0.0254 for inches. By default what a
    USD file says, 1 for the others.
    up: the axis of the file that points up, by default what a USD file says, "y" for an .abc and
    "z" for the others. From "y", (x, y, z) becomes (x, -z, y), a rotation.
    skip_short: leave out strands of no or one point, which files may hold (roots of bald places)
    but which have no direction to simulate. Without it they are refused.
    frame: of an animated .npz, .abc or USD file, by default the last; below 0 it counts from the
    end.
    time: of a USD file [s], in place of a frame; between frames it interpolates.

    A file may hold no strands; then `points` has shape (0, 0, 3).

    Raises ValueError naming the file, what is wrong and what is allowed, where the file is
    truncated, of another format or inconsistent, or has coordinates that are not finite or strands
    as uneven as `Curves.from_list` refuses, or has no such frame. No more memory is taken than the
    file's size warrants. FileNotFoundError and other OSError where it cannot be opened,
    ImportError for a USD file without the extra `usd`.
    """
    path = check.path("path", path)
    check.flag("skip_short", skip_short)
    points, counts = _read(path, unit, up, frame, time)
    try:
        short = counts < 2
        if np.any(short):
            if not skip_short:
                raise ValueError(
                    f"{np.sum(short)} of its {len(counts)} strands have fewer than 2 points (the "
                    f"first is strand {np.argmax(short)}, of {counts[np.argmax(short)]}); a strand "
                    "must have at least 2 points; skip_short=True leaves the others out"
                )
            points, counts = points[np.repeat(~short, counts)], counts[~short]
        if not np.all(finite := np.isfinite(points)):
            row = int(np.argmin(finite.all(axis=1)))
            ends = np.cumsum(counts)
            strand = int(np.searchsorted(ends, row, side="right"))
            raise ValueError(
                f"point {row - int(ends[strand] - counts[strand])} of strand {strand} is "
                f"{points[row].tolist()}; coordinates must be finite"
            )
        return Curves(_padded(points, counts), counts)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_strands(
    path: str | os.PathLike[str],
    *,
    unit: float | None = None,
    up: Literal["y", "z"] | None = None,
    frame: int = -1,
    time: float | None = None,
) -> list[NDArray[np.float64]]:
    """Every strand of a file as it is: points [m], Z up, each of shape (its points, 3).

    As `read_curves`, for those who sort strands out by themselves: strands may have no or one
    point, any coordinates, and be of very different lengths. Only a file that is truncated, of
    another format or inconsistent is refused.
    """
    path = check.path("path", path)
    points, counts = _read(path, unit, up, frame, time)
    return [points[e - count : e] for count, e in zip(counts, np.cumsum(counts), strict=True)]


def _read(
    path: Path, unit: float | None, up: str | None, frame: int, time: float | None
) -> tuple[NDArray[np.float64], Counts]:
    """Points [m], Z up, shape (all points, 3), and counts of the strands."""
    reader, _ = format_of(path)
    check_unit(1.0 if unit is None else unit, "z" if up is None else up)
    check.whole("frame", frame, least=-1_000_000)
    if time is not None:
        check.number("time", time)
        if reader is not None or frame != -1:
            raise ValueError(
                f"time is {check.short(time)}; it must be left out unless the file is a USD file "
                "and no frame is given"
            )
    data = b"" if reader is None else contents(path)
    check_regular(path)
    try:
        if reader is None:
            points, counts, own_unit, own_up = usd_reading.read(path, frame=frame, time=time)
        else:
            points, counts = reader(data, int(frame))
            own_unit, own_up = 1.0, usual_up(path)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    return _metres(points, own_unit if unit is None else unit, up or own_up), counts


def _metres(points: Points, unit: float, up: str) -> NDArray[np.float64]:
    """Points of a file in metres and Z up."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is for others to judge
        points = points.astype(np.float64) * unit
        if up == "y":
            points = points[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
    return points


def to_unit(points: Points, unit: float, up: str) -> NDArray[Any]:
    """Points [m], Z up, in a file's unit and axes."""
    with np.errstate(over="ignore"):  # for others to judge
        points = points / unit
    return points[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0]) if up == "y" else points


def write_curves(
    path: str | os.PathLike[str],
    curves: Curves,
    *,
    unit: float = 1.0,
    up: Literal["y", "z"] | None = None,
    overwrite: bool = False,
) -> None:
    """Write strands to a .hair, .data, .npz, .abc or USD file in a unit and axes, as float32.

    unit: length of the file's unit [m]: 0.01 for centimetres, 0.0254 for inches.
    up: the axis of the file that points up, by default "y" in an .abc, "z" in the others. With "y",
    (x, y, z) becomes (x, z, -y), a rotation.

    The file appears when it is complete; see `jaxhair.output.new_file` for what is raised where
    it exists or its folder does not. Raises ValueError where the ending is another, a coordinate
    is too large for float32, or a strand has more than 65,536 points and the file is a .hair, or
    fewer than 2 and it is a USD file.
    """
    path = check.path("path", path)
    _, writer = format_of(path)
    axis = usual_up(path) if up is None else up
    check_unit(unit, axis)
    check.instance("curves", curves, Curves)
    check.flag("overwrite", overwrite)
    points = to_unit(curves.points, unit, axis)
    if np.any(large := np.abs(points) > np.finfo(np.float32).max):
        place = tuple(int(i) for i in np.argwhere(large)[0])
        raise ValueError(
            f"{path}: points has the value {points[place]} at {place} in the file's unit; it must "
            "fit into float32"
        )
    with new_file(path, overwrite=overwrite) as temporary:
        writer(temporary, points.astype("<f4"), curves.counts, unit, axis)


def check_unit(unit: float, up: str) -> None:
    # the bounds catch mistakes, and keep a product of float32 and unit far from float64's limits
    if isinstance(unit, bool | np.timedelta64) or not isinstance(
        unit, int | float | np.integer | np.floating
    ):
        wanted = "it must be a number, the file's unit in metres"
        raise ValueError(f"unit is {check.short(unit)}; {wanted}")
    value = float(unit) if isinstance(unit, np.floating) else unit  # float16 has no such bounds
    if not 1e-12 <= value <= 1e12:
        raise ValueError(f"unit is {check.short(unit)}; it must be from 1e-12 to 1e12 metres")
    check.choice("up", up, ("y", "z"))


def _padded(points: Points, counts: Counts) -> Points:
    """Shape (strands, points, 3): all strands as long as the longest, by repeating last points."""
    if len(counts) == 0:
        return np.zeros((0, 0, 3))
    longest = int(np.argmax(counts))
    most = int(counts[longest])
    if len(counts) * most > max(_PADDED_POINTS, _PADDED_RATIO * len(points)):
        raise ValueError(
            f"strand {longest} has {most} points, the mean of the {len(counts)} strands is "
            f"{len(points) / len(counts):.3g}; the longest strand must have at most "
            f"{_PADDED_RATIO} times the mean"
        )
    first = np.cumsum(counts) - counts
    padded: Points = points[first[:, None] + np.minimum(np.arange(most), counts[:, None] - 1)]
    return padded
