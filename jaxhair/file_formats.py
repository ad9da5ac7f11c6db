"""The bytes of strand files, .hair, .data and .npz; what they hold stands in `jaxhair.files`.

Alembic files are those of `jaxhair.alembic`; USD files are written by usd.py and read by
usd_reading.py.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from jaxhair import check
from jaxhair.arrays import numbers, unzip, zip_arrays

Points = NDArray[Any]
Counts = NDArray[np.int64]
Reader = Callable[[bytes, int], tuple[Points, Counts]]  # frame; all points, shape (all, 3)
Writer = Callable[[Path, Points, Counts, float, str], None]  # padded points; counts, unit, up

_HAIR_HEADER = struct.Struct("<4sIIIIff3f88s")
_HAIR_BYTES = {"points": 12, "thickness": 4, "transparency": 4, "colours": 12}  # for each point
_MOST_SEGMENTS = 65535
HAIR_DIAMETER = 80e-6  # [m]; a file must state one, and readers draw it


def check_counts(counts: NDArray[Any], strands: int, *, least: int, most: int) -> None:
    if counts.shape != (strands,):
        raise ValueError(f"counts has shape {counts.shape}; it must have shape ({strands},)")
    if np.any(wrong := (counts < least) | (counts > most)):
        i = int(np.argmax(wrong))
        raise ValueError(
            f"counts has the value {counts[i]} at {i}; it must be from {least} to {most}"
        )


def _within(points: Points, counts: Counts) -> Points:
    """Points of all strands one after the other, shape (all points, 3): without the padding."""
    if len(counts) == 0:  # where the size of the other axis means nothing, and may be huge
        return np.zeros((0, 3), points.dtype)
    inside: Points = points[np.arange(points.shape[1]) < counts[:, None]]
    return inside


def _expect_size(what: str, size: int, data: bytes) -> None:
    if size != len(data):
        raise ValueError(f"the file has {len(data)} bytes; with {what} it must have {size}")


def _check_frame(frame: int, frames: int) -> None:
    if not -frames <= frame < frames:
        raise ValueError(
            f"frame is {frame}; of the {frames} frames that the file has, it must be from "
            f"{-frames} to {frames - 1}"
        )


def _read_hair(data: bytes, frame: int) -> tuple[Points, Counts]:
    _check_frame(frame, 1)
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
        *(HAIR_DIAMETER / unit, 0.0, 1.0, 1.0, 1.0),
        f"jaxhair: 1 unit = {unit:g} m, {up} up".encode("ascii"),
    )
    flat = _within(points, counts)
    path.write_bytes(header + (counts - 1).astype("<u2").tobytes() + flat.tobytes())


def _read_data(data: bytes, frame: int) -> tuple[Points, Counts]:
    _check_frame(frame, 1)
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


def _read_npz(data: bytes, frame: int) -> tuple[Points, Counts]:
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
    _check_frame(frame, shape[0] if len(shape) == 4 else 1)
    points = points[frame] if len(shape) == 4 else points
    strands, most, _ = points.shape
    counts = numbers("counts", arrays.get("counts", np.full(strands, most)), "iu")
    check_counts(counts, strands, least=0, most=most)
    counts = counts.astype(np.int64)
    return _within(points, counts), counts


def _write_npz(path: Path, points: Points, counts: Counts, unit: float, up: str) -> None:
    zip_arrays(path, {"positions": points, "counts": counts.astype("<i4")})


def _write_usd(path: Path, points: Points, counts: Counts, unit: float, up: str) -> None:
    from jaxhair.usd import write_still

    write_still(path, points, counts, unit=unit, up=up)


def _read_abc(data: bytes, frame: int) -> tuple[Points, Counts]:
    from jaxhair.alembic.reading import read

    return read(data, frame)


def _write_abc(path: Path, points: Points, counts: Counts, unit: float, up: str) -> None:
    from jaxhair.alembic.writing import write_still

    write_still(path, points, counts, unit=unit)


_FORMATS: dict[str, tuple[Reader | None, Writer]] = {
    ".hair": (_read_hair, _write_hair),
    ".data": (_read_data, _write_data),
    ".npz": (_read_npz, _write_npz),
    ".abc": (_read_abc, _write_abc),
    **dict.fromkeys((".usd", ".usda", ".usdc"), (None, _write_usd)),
}


def format_of(path: Path) -> tuple[Reader | None, Writer]:
    """Reader and writer of the format that the ending of `path` stands for; USD files, which may
    refer to other files, are not read from bytes."""
    ending = path.suffix.lower()
    if ending not in _FORMATS:
        wanted = f"it must end in one of {', '.join(_FORMATS)}"
        raise ValueError(f"{check.short(path.name)} ends in {check.short(ending)}; {wanted}")
    return _FORMATS[ending]


def usual_up(path: Path) -> str:
    """The axis that points up in files that do not say it, where a user does not either."""
    return "y" if path.suffix.lower() == ".abc" else "z"
