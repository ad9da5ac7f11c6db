"""The Ogawa container, in which Alembic files are: groups of groups and data, by their places.

    b"Ogawa", 0xff when the file is complete, version 0 1, place of the root group
    group   number of children and that many references, to groups or, with the highest bit, data
    data    number of bytes, and those

All numbers are little-endian uint64. A reference is the place of a group or data in the file, and 0
an empty one. What groups mean stands in archive_writing.py.
"""

import struct
from collections.abc import Sequence
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

HEADER = b"Ogawa\xff\x00\x01"
START = len(HEADER) + 8  # of the first group or data
EMPTY_GROUP, EMPTY_DATA = 0, 1 << 63
_HDF5 = b"\x89HDF"

References = NDArray[np.uint64]


class Writer:
    """Writes a container to a file that is empty: what is inside a group before the group.

    Each method returns the reference of what it has written.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._end = START
        file.write(HEADER + bytes(8))

    def data(self, *parts: bytes) -> int:
        """Bytes, one part after the other."""
        if not any(parts):
            return EMPTY_DATA
        return EMPTY_DATA | self._write(struct.pack("<Q", sum(map(len, parts))), *parts)

    def group(self, children: Sequence[int]) -> int:
        """The group of these references."""
        if not children:
            return EMPTY_GROUP
        return self._write(struct.pack(f"<{len(children) + 1}Q", len(children), *children))

    def root(self, reference: int) -> None:
        """Makes a group the root, which ends the writing."""
        self._file.seek(len(HEADER))
        self._file.write(struct.pack("<Q", reference))

    def _write(self, *parts: bytes) -> int:
        place = self._end
        for part in parts:
            self._file.write(part)
            self._end += len(part)
        return place


class Container:
    """The bytes of a container, of which nothing is trusted.

    Raises ValueError, as its methods do, for what is no container, incomplete or damaged.
    """

    def __init__(self, data: bytes) -> None:
        if data[:4] == _HDF5:
            raise ValueError(
                "the file is Alembic in HDF5, the container of before 2013; it must be in Ogawa, "
                "as all programs write it now"
            )
        if len(data) < START or data[:5] != HEADER[:5]:
            raise ValueError(
                f"the file has {len(data)} bytes and starts with {data[:5]!r}; an Alembic file "
                f"must have at least {START} and start with {HEADER[:5]!r}"
            )
        if data[5] != HEADER[5]:
            raise ValueError(
                "the file was not finished by the program that wrote it; its byte 5 must be 0xff"
            )
        if data[6:8] != HEADER[6:]:
            raise ValueError(f"the file's version of Ogawa is {data[6]}.{data[7]}; it must be 0.1")
        self._data = memoryview(data)
        self.size = len(data)
        self._spare = len(data)
        (self._root,) = struct.unpack_from("<Q", data, len(HEADER))

    def root(self) -> References:
        """References in the root group."""
        return self.group(self._root)

    def group(self, reference: int) -> References:
        """The references in a group."""
        if is_data(reference):
            raise ValueError(f"the reference {reference:#x} is to data where it must be to a group")
        if reference == EMPTY_GROUP:
            return np.zeros(0, np.uint64)
        count = self._count(reference, 8, "references")
        self.spend(8 + 8 * count)
        return np.frombuffer(self._data, "<u8", count, reference + 8)

    def data(self, reference: int) -> memoryview:
        """The bytes of data."""
        if not is_data(reference):
            raise ValueError(f"the reference {reference:#x} is to a group where it must be to data")
        place = reference & ~EMPTY_DATA
        if place == 0:
            return self._data[:0]
        return self._data[place + 8 : place + 8 + self._count(place, 1, "bytes of data")]

    def spend(self, count: int) -> None:
        """Counts bytes that each file reads once, and whose sum its size thus bounds.

        Groups that are inside themselves or overlap would take endless time, or its square.
        """
        self._spare -= count
        if self._spare < 0:
            raise ValueError(
                "some of the file's groups overlap or are inside themselves; each must have bytes "
                "and one place of its own"
            )

    def _count(self, place: int, size: int, what: str) -> int:
        """The number at a place, of things of some bytes each that must follow it in the file."""
        if not START <= place <= self.size - 8:
            raise ValueError(
                f"a reference in it is to byte {place}; in a file of {self.size} bytes it must be "
                f"from {START} to {self.size - 8}"
            )
        (count,) = struct.unpack_from("<Q", self._data, place)
        most = (self.size - place - 8) // size
        if count > most:
            raise ValueError(
                f"at byte {place} it says that {count} {what} follow; in {self.size} bytes it must "
                f"be at most {most}"
            )
        return int(count)


def is_data(reference: int) -> bool:
    """Whether a reference is to data, not to a group."""
    return reference & EMPTY_DATA != 0
