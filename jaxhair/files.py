"""Strand files: .hair, .data and .npz; and named arrays in .npz.

| ending  | content                                                                             |
| ------- | ----------------------------------------------------------------------------------- |
| `.hair` | Cem Yuksel's HAIR format; thickness, transparency and colours are not read          |
| `.data` | int32 strands; for each, int32 points and that many x y z as float32                |
| `.npz`  | `positions`, shape (strands, points, 3) or (frames, strands, points, 3), of which   |
|         | the last frame is read; optionally `counts`, the points of each strand              |

All are little-endian and written in float32. None of them says what its unit of length is or
which of its axes points up, so a reader must know: `unit` and `up` of the functions below.
"""

import os
import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxhair import check
from jaxhair.arrays import contents, numbers, unzip, zip_arrays
from jaxhair.output import new_file

Points = NDArray[Any]
Counts = NDArray[np.int64]
Reader = Callable[[bytes], tuple[Points, Counts]]  # points one after the other, shape (all, 3)
Writer = Callable[[Path, Points, Counts, float, str], None]  # padded points; counts, unit, up

_HAIR_HEADER = struct.Struct("<4sIIIIff3f88s")
_HAIR_BYTES = {"points": 12, "thickness": 4, "transparency": 4, "colours": 12}  # for each point
_MOST_SEGMENTS = 65535
_HAIR_DIAMETER = 80e-6  # [m]; a file must state one, and readers draw it
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
        _check_counts(counts, strands, least=1, most=most)
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
    unit: float = 1.0,
    up: Literal["y", "z"] = "z",
    skip_short: bool = False,
) -> Curves:
    """Strands of a .hair, .data or .npz file, in metres and Z up, in the order of the file.

    unit: length of the file's unit [m]: 0.01 for centimetres, 0.0254 for inches.
    up: the axis of the file that points up. From "y", (x, y, z) becomes (x, -z, y), a rotation.
    skip_short: leave out strands of no or one point, which files may hold (roots of bald places)
    but which have no direction to simulate. Without it they are refused.

    A file may hold no strands; then `points` has shape (0, 0, 3).

    Raises ValueError naming the file, what is wrong and what is allowed, where the file is
    truncated, of another format or inconsistent, or has coordinates that are not finite or strands
    as uneven as `Curves.from_list` refuses. No more memory is taken than the file's size warrants.
    FileNotFoundError and other OSError where it cannot be opened.
    """
    path = check.path("path", path)
    check.flag("skip_short", skip_short)
    points, counts = _read(path, unit, up)
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
        # before any arithmetic, in which a signalling NaN would raise a warning
        if not np.all(finite := np.isfinite(points)):
            row = int(np.argmin(finite.all(axis=1)))
            ends = np.cumsum(counts)
            strand = int(np.searchsorted(ends, row, side="right"))
            raise ValueError(
                f"point {row - int(ends[strand] - counts[strand])} of strand {strand} is "
                f"{points[row].tolist()}; coordinates must be finite"
            )
        return Curves(_padded(_metres(points, unit, up), counts), counts)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def read_strands(
    path: str | os.PathLike[str], *, unit: float = 1.0, up: Literal["y", "z"] = "z"
) -> list[NDArray[np.float64]]:
    """Every strand of a file as it is: points [m], Z up, each of shape (its points, 3).

    As `read_curves`, for those who sort strands out by themselves: strands may have no or one
    point, any coordinates, and be of very different lengths. Only a file that is truncated, of
    another format or inconsistent is refused.
    """
    path = check.path("path", path)
    points, counts = _read(path, unit, up)
    points, ends = _metres(points, unit, up), np.cumsum(counts)
    return [points[end - count : end] for count, end in zip(counts, ends, strict=True)]


def _read(path: Path, unit: float, up: str) -> tuple[Points, Counts]:
    """Points in the file's unit and axes, shape (all points, 3), and counts of the strands."""
    reader, _ = _format(path)
    _check_unit(unit, up)
    data = contents(path)
    try:
        return reader(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _metres(points: Points, unit: float, up: str) -> Points:
    """Points of a file in metres and Z up."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is for others to judge
        points = points.astype(np.float64) * unit
        if up == "y":
            points = points[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])
    return points


def write_curves(
    path: str | os.PathLike[str],
    curves: Curves,
    *,
    unit: float = 1.0,
    up: Literal["y", "z"] = "z",
    overwrite: bool = False,
) -> None:
    """Write strands to a .hair, .data or .npz file in the given unit and axes, as float32.

    unit: length of the file's unit [m]: 0.01 for centimetres, 0.0254 for inches.
    up: the axis of the file that points up. With "y", (x, y, z) becomes (x, z, -y), a rotation.

    The file appears when it is complete; see `jaxhair.output.new_file` for what is raised where
    it exists or its folder does not. Raises ValueError where the ending is another, a coordinate
    is too large for float32, or a strand has more than 65,536 points and the file is a .hair.
    """
    path = check.path("path", path)
    _, writer = _format(path)
    _check_unit(unit, up)
    check.instance("curves", curves, Curves)
    check.flag("overwrite", overwrite)
    with np.errstate(over="ignore"):  # reported below
        points = curves.points / unit
    if up == "y":
        points = points[..., [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    if np.any(large := np.abs(points) > np.finfo(np.float32).max):
        place = tuple(int(i) for i in np.argwhere(large)[0])
        raise ValueError(
            f"{path}: points has the value {points[place]} at {place} in the file's unit; it must "
            "fit into float32"
        )
    with new_file(path, overwrite=overwrite) as temporary:
        writer(temporary, points.astype("<f4"), curves.counts, unit, up)


def _check_counts(counts: NDArray[Any], strands: int, *, least: int, most: int) -> None:
    if counts.shape != (strands,):
        raise ValueError(f"counts has shape {counts.shape}; it must have shape ({strands},)")
    if np.any(wrong := (counts < least) | (counts > most)):
        i = int(np.argmax(wrong))
        raise ValueError(
            f"counts has the value {counts[i]} at {i}; it must be from {least} to {most}"
        )


def _check_unit(unit: float, up: str) -> None:
    # the bounds catch mistakes, and keep a product of float32 and unit far from float64's limits
    if isinstance(unit, bool | np.timedelta64) or not isinstance(
        unit, int | float | np.integer | np.floating
    ):
        wanted = "it must be a number, the file's unit in metres"
        raise ValueError(f"unit is {check.short(unit)}; {wanted}")
    if not 1e-12 <= unit <= 1e12:
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


def _within(points: Points, counts: Counts) -> Points:
    """Points of all strands one after the other, shape (all points, 3): without the padding."""
    if len(counts) == 0:  # where the size of the other axis means nothing, and may be huge
        return np.zeros((0, 3), points.dtype)
    inside: Points = points[np.arange(points.shape[1]) < counts[:, None]]
    return inside


def _expect_size(what: str, size: int, data: bytes) -> None:
    if size != len(data):
        raise ValueError(f"the file has {len(data)} bytes; with {what} it must have {size}")


def _read_hair(data: bytes) -> tuple[Points, Counts]:
    if len(data) < _HAIR_HEADER.size or data[:4] != b"HAIR":
        raise ValueError(
            f"the file has {len(data)} bytes and starts with {data[:4]!r}; a .hair file must have "
            f"a header of {_HAIR_HEADER.size} bytes starting with b'HAIR'"
        )
    _, strands, total, arrays, default_segments, *_ = _HAIR_HEADER.unpack_from(data)
    if arrays >= 32 or not arrays & 2:
        raise ValueError(
            f"the header's array bits are {arrays:#x}; bit 1 (points) must be set and bits 5 to 31 "
            "must be 0"
        )
    size = _HAIR_HEADER.size + (2 * strands if arrays & 1 else 0)
    for bit, each in enumerate(_HAIR_BYTES.values(), start=1):
        size += each * total if arrays & 1 << bit else 0
    _expect_size(f"{strands} strands, {total} points and array bits {arrays:#x}", size, data)
    offset = _HAIR_HEADER.size
    if arrays & 1:
        counts = np.frombuffer(data, "<u2", strands, offset).astype(np.int64) + 1
        needed = int(counts.sum())
        offset += 2 * strands
    else:
        needed = strands * (default_segments + 1)
    if needed != total:
        raise ValueError(f"the header has {total} points; for its segments it must be {needed}")
    if not arrays & 1:
        # only now: strands is at most total, which fits the file
        counts = np.full(strands, default_segments + 1, dtype=np.int64)
    return np.frombuffer(data, "<f4", 3 * total, offset).reshape(total, 3), counts


def _write_hair(path: Path, points: Points, counts: Counts, unit: float, up: str) -> None:
    if np.any(wrong := counts - 1 > _MOST_SEGMENTS):
        i = int(np.argmax(wrong))
        raise ValueError(
            f"strand {i} has {counts[i] - 1} segments; in a .hair file a strand must have at most "
            f"{_MOST_SEGMENTS}"
        )
    header = _HAIR_HEADER.pack(
        *(b"HAIR", len(counts), counts.sum(), 0b11, 0),
        *(_HAIR_DIAMETER / unit, 0.0, 1.0, 1.0, 1.0),
        f"jaxhair: 1 unit = {unit:g} m, {up} up".encode("ascii"),
    )
    flat = _within(points, counts)
    path.write_bytes(header + (counts - 1).astype("<u2").tobytes() + flat.tobytes())


def _read_data(data: bytes) -> tuple[Points, Counts]:
    if len(data) < 4:
        raise ValueError(f"the file has {len(data)} bytes; a .data file must have at least 4")
    (strands,) = struct.unpack_from("<i", data)
    # each strand takes at least the 4 bytes of its count
    most = (len(data) - 4) // 4
    if not 0 <= strands <= most:
        raise ValueError(
            f"the number of strands is {strands}; in {len(data)} bytes it must be from 0 to {most}"
        )
    counts = np.zeros(strands, dtype=np.int64)
    parts = [np.zeros((0, 3), "<f4")]
    offset = 4
    for i in range(strands):
        if offset + 4 > len(data):
            raise ValueError(f"the file ends before strand {i}; it must hold {strands} strands")
        (count,) = struct.unpack_from("<i", data, offset)
        offset += 4
        most = (len(data) - offset) // 12
        if not 0 <= count <= most:
            raise ValueError(
                f"strand {i} has {count} points; in the bytes that follow it must be from 0 to "
                f"{most}"
            )
        parts.append(np.frombuffer(data, "<f4", 3 * count, offset).reshape(count, 3))
        counts[i] = count
        offset += 12 * count
    _expect_size(f"{strands} strands of {counts.sum()} points in all", offset, data)
    return np.concatenate(parts), counts


def _write_data(path: Path, points: Points, counts: Counts, unit: float, up: str) -> None:
    with path.open("wb") as file:
        file.write(struct.pack("<i", len(counts)))
        for strand, count in zip(points, counts, strict=True):
            file.write(struct.pack("<i", count) + strand[:count].tobytes())


def _read_npz(data: bytes) -> tuple[Points, Counts]:
    arrays = unzip(data, ("positions", "counts"))
    if "positions" not in arrays:
        raise ValueError("the file has no array 'positions'; strands must be in one of that name")
    points = numbers("positions", arrays["positions"], "fiu")
    shape = points.shape
    # strands without points take no bytes, so their number would not be bounded by the file
    if len(shape) not in (3, 4) or shape[-1] != 3 or shape[-2] == 0 < shape[-3] or 0 in shape[:-3]:
        raise ValueError(
            f"positions has shape {shape}; it must have shape (strands, points, 3) or "
            "(frames, strands, points, 3), with at least one point and frame"
        )
    points = points[-1] if len(shape) == 4 else points
    strands, most, _ = points.shape
    counts = numbers("counts", arrays.get("counts", np.full(strands, most)), "iu")
    _check_counts(counts, strands, least=0, most=most)
    counts = counts.astype(np.int64)
    return _within(points, counts), counts


def _write_npz(path: Path, points: Points, counts: Counts, unit: float, up: str) -> None:
    zip_arrays(path, {"positions": points, "counts": counts.astype("<i4")})


_FORMATS: dict[str, tuple[Reader, Writer]] = {
    ".hair": (_read_hair, _write_hair),
    ".data": (_read_data, _write_data),
    ".npz": (_read_npz, _write_npz),
}


def _format(path: Path) -> tuple[Reader, Writer]:
    """Reader and writer of the format that the ending of `path` stands for."""
    ending = path.suffix.lower()
    if ending not in _FORMATS:
        wanted = f"it must end in one of {', '.join(_FORMATS)}"
        raise ValueError(f"{check.short(path.name)} ends in {check.short(ending)}; {wanted}")
    return _FORMATS[ending]
