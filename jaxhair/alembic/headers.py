"""Headers in an Alembic file's bytes: of properties, time samplings and metadata.

Each function raises ValueError where they end too early or say what cannot be.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaxhair import check
from jaxhair.alembic.archive_writing import (
    ARRAY,
    CHANGES,
    CONSTANT,
    ELSEWHERE,
    EXTENT,
    METADATA,
    SAMPLING,
    SCALAR,
    SIZE_HINT,
    TYPE,
)

COMPOUND = 0


@dataclass(frozen=True)
class Header:
    """What a file says of a property: its kind, COMPOUND, SCALAR or ARRAY, the place in TYPES and
    number of each value's numbers, number of samples, the first and last that differ from the one
    before, the place of its time sampling and the reference of its group."""

    name: str
    kind: int
    type: int
    extent: int
    count: int
    first: int
    last: int
    sampling: int
    group: int

    @property
    def changes(self) -> bool:
        """Whether not all samples are the same."""
        return self.last > 0


class Cursor:
    """Numbers and text one after the other."""

    def __init__(self, data: memoryview, what: str) -> None:
        self._data, self._what, self._at = data, what, 0
        self.end = len(data)

    @property
    def done(self) -> bool:
        return self._at >= self.end

    def bytes(self, count: int) -> memoryview:
        left = self.end - self._at
        if count > left:
            raise ValueError(
                f"its {self._what} end after {max(left, 0)} of {count} bytes; all must be there"
            )
        self._at += count
        return self._data[self._at - count : self._at]

    def number(self, size: int) -> int:
        return int.from_bytes(self.bytes(size), "little")

    def text(self, count: int) -> str:
        return str(self.bytes(count), "utf-8", "replace")

    def floats(self, count: int) -> NDArray[np.float64]:
        return np.frombuffer(self.bytes(8 * count), "<f8")


def read_header(cursor: Cursor, group: int) -> Header:
    """The header of a property whose group has this reference."""
    info = cursor.number(4)
    hint = info >> SIZE_HINT & 3
    if hint > 2:
        raise ValueError(f"a property's header has the size hint {hint}; it must be 0 to 2")
    size = 1 << hint
    kind = ARRAY if info & ARRAY else info & SCALAR
    count = first = last = sampling = 0
    if kind != COMPOUND:
        count = cursor.number(size)
        if info & CHANGES:
            first, last = cursor.number(size), cursor.number(size)
        elif not info & CONSTANT and count > 1:
            first, last = 1, count - 1
        sampling = cursor.number(size) if info & SAMPLING else 0
    name = cursor.text(cursor.number(size))
    if info >> METADATA & ELSEWHERE == ELSEWHERE:
        cursor.text(cursor.number(size))
    if not (first <= last < max(count, 1) and (first > 0 or last == 0)):
        raise ValueError(
            f"{check.short(name)} has {count} samples that change from {first} to {last}; "
            "these must be among them"
        )
    extent = info >> EXTENT & 0xFF
    if kind != COMPOUND and extent == 0:
        raise ValueError(f"{check.short(name)} has values of 0 numbers; it must be at least 1")
    return Header(name, kind, info >> TYPE & 15, extent, count, first, last, sampling, group)


def read_samplings(cursor: Cursor) -> list[tuple[float, NDArray[np.float64]]]:
    """Of each time sampling the time per cycle and the times in it [s]."""
    found = []
    while not cursor.done:
        cursor.number(4)  # of samples, at most
        (cycle,) = cursor.floats(1)
        times = cursor.floats(cursor.number(4))
        if not (cycle > 0 and np.all(np.isfinite(times)) and np.all(times[1:] > times[:-1])):
            raise ValueError("a time sampling has times that do not grow; they must")
        if len(times) == 0:
            raise ValueError("a time sampling has no times; it must have at least 1")
        found.append((float(cycle), times))
    return found


def read_indexed(cursor: Cursor) -> list[str]:
    """The metadata that headers have by their place, of which the first are none."""
    found = [""]
    while not cursor.done:
        found.append(cursor.text(cursor.number(1)))
    return found
