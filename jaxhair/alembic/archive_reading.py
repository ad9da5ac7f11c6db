"""The objects, properties and samples of an Alembic file's bytes, of which nothing is trusted.

What they are stands in archive_writing.py, which writes them. No part of a file is read twice but
samples, which may be shared, and of those not many times the file's size in all.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from jaxhair.alembic.archive_writing import ACYCLIC, ELSEWHERE, FORMAT, SCALAR, TYPES
from jaxhair.alembic.headers import (
    COMPOUND,
    Cursor,
    Header,
    read_header,
    read_indexed,
    read_samplings,
)
from jaxhair.alembic.ogawa import EMPTY_GROUP, Container, is_data

_KEY = 16  # bytes before each sample
_HASHES = 32  # bytes after the headers of objects
# samples that are read may have so many times the file's bytes, and these
_SHARED, _SPARE = 2, 2**20
_SAME_TIME = 1e-6  # of a cycle, what rounding may take from a time


@dataclass(frozen=True)
class Object:
    """An object of the hierarchy.

    parent: its place in the list of all objects, -1 of the top. schema: "" if it says none.
    properties: reference of their group.
    """

    name: str
    parent: int
    schema: str
    instance: bool
    properties: int


class Archive:
    """An Alembic file. Raises ValueError, as its methods do, where it is damaged or another."""

    def __init__(self, data: bytes) -> None:
        self._container = Container(data)
        self._left = _SHARED * len(data) + _SPARE
        root = self._container.root()
        if len(root) != 6:
            raise ValueError(f"its root group has {len(root)} children; it must have 6")
        layout, _, top, _, samplings, metadata = (int(each) for each in root)
        number = bytes(self._container.data(layout))
        if number != struct.pack("<i", FORMAT):
            raise ValueError(
                f"the version of its layout is {number[:4]!r}; it must be {FORMAT} as int32"
            )
        self._top = top
        self._samplings = read_samplings(self._cursor(samplings, "time samplings"))
        self._metadata = read_indexed(self._cursor(metadata, "indexed metadata"))

    def objects(self) -> list[Object]:
        """All objects, each after its parent, in the order of the file."""
        found: list[Object] = []
        waiting = [(self._top, "", "", -1)]
        while waiting:
            reference, name, metadata, parent = waiting.pop()
            group = self._container.group(reference)
            properties = int(group[0]) if len(group) and not is_data(int(group[0])) else EMPTY_GROUP
            schema, instance = _said(metadata)
            place = len(found)
            found.append(Object(name, parent, schema, instance, properties))
            if len(group) and is_data(int(group[-1])):
                headers = self._object_headers(int(group[-1]))
                if len(headers) > len(group) - 2:
                    raise ValueError(
                        f"an object has {len(group) - 2} children and headers of {len(headers)}; "
                        "there must be as many"
                    )
                children = zip(group[1:], headers, strict=False)
                waiting += reversed([(int(child), *header, place) for child, header in children])
        return found

    def properties(self, reference: int) -> dict[str, Header]:
        """Those in a group, by name."""
        group = self._container.group(reference)
        if len(group) == 0 or not is_data(int(group[-1])):
            return {}
        found = {}
        cursor = self._cursor(int(group[-1]), "headers of properties")
        for child in group[:-1]:
            if cursor.done:
                break
            header = read_header(cursor, int(child))
            found[header.name] = header
        if not cursor.done:
            raise ValueError(
                f"there are more headers than {len(group) - 1} properties; there must be as many"
            )
        return found

    def compound(self, properties: dict[str, Header], name: str) -> dict[str, Header]:
        """Properties of the compound of a name; none if there is no such."""
        header = properties.get(name)
        return self.properties(header.group) if header and header.kind == COMPOUND else {}

    def sample(
        self, properties: dict[str, Header], name: str, kind: str, extent: int, time: float
    ) -> NDArray[np.generic] | None:
        """The sample that stands at a time, the last one not after it.

        Arguments:
            kind: the type that it must have, as in TYPES. extent: numbers in a value, 0 for any.
            time: [s].
        Returns shape (values, extent), or None where there is no such property or no sample.
        """
        header = properties.get(name)
        if header is None or header.kind == COMPOUND or header.count == 0:
            return None
        if header.type != TYPES.index(kind) or extent not in (0, header.extent):
            found = TYPES[header.type] if header.type < len(TYPES) else "text"
            raise ValueError(
                f"{name} has values of {header.extent} numbers of type {found}; they must be of "
                f"{extent or 'some'} of type {kind}"
            )
        place = self._stored(header, time) * (1 if header.kind == SCALAR else 2)
        group = self._container.group(header.group)
        if place >= len(group):
            raise ValueError(f"{name} has no sample {place}; it must have all that it says")
        data = self._container.data(int(group[place]))
        size = np.dtype(kind).itemsize * header.extent
        if 0 < len(data) < _KEY or (len(data) and (len(data) - _KEY) % size):
            raise ValueError(
                f"a sample of {name} has {len(data)} bytes; it must have {_KEY} and a multiple of "
                f"{size}"
            )
        self._left -= len(data)
        if self._left < 0:
            raise ValueError(
                f"its curves share data: they have more than {_SHARED} times its bytes; they must "
                "have fewer"
            )
        return np.frombuffer(data[_KEY:], kind).reshape(-1, header.extent)

    def times(self, sampling: int, count: int) -> NDArray[np.float64]:
        """When samples are [s], shape (count,)."""
        cycle, stored = self._sampling(sampling)
        if cycle >= ACYCLIC:
            if count > len(stored):
                raise ValueError(
                    f"a property has {count} samples at {len(stored)} times; there must be a time "
                    "for each"
                )
            return stored[:count]
        place = np.arange(count)
        with np.errstate(all="ignore"):  # such times are left out where they are read
            return stored[place % len(stored)] + cycle * (place // len(stored))

    def _stored(self, header: Header, time: float) -> int:
        """Place of the sample at a time among those that are stored."""
        if not header.changes:
            return 0
        index = min(max(self._before(header, time), 0), header.count - 1)
        # samples before the first change and after the last are stored once
        return min(max(index - header.first + 1, 0), header.last - header.first + 1)

    def _before(self, header: Header, time: float) -> int:
        cycle, stored = self._sampling(header.sampling)
        if cycle >= ACYCLIC:
            return int(np.searchsorted(stored, time + _SAME_TIME, "right")) - 1
        with np.errstate(all="ignore"):  # a cycle may be very short
            cycles = np.floor((time - stored[0]) / cycle + _SAME_TIME)
        if not 0 <= cycles <= header.count:
            return header.count if cycles > 0 else 0
        rest = time - cycles * cycle
        within = np.searchsorted(stored, rest + _SAME_TIME * cycle, "right") - 1
        return int(cycles) * len(stored) + int(within)

    def _sampling(self, place: int) -> tuple[float, NDArray[np.float64]]:
        if place >= len(self._samplings):
            raise ValueError(
                f"a property has time sampling {place}; it must be one of {len(self._samplings)}"
            )
        return self._samplings[place]

    def _cursor(self, reference: int, what: str) -> Cursor:
        data = self._container.data(reference)
        self._container.spend(len(data))
        return Cursor(data, what)

    def _object_headers(self, reference: int) -> list[tuple[str, str]]:
        """Names and metadata."""
        cursor = self._cursor(reference, "headers of objects")
        cursor.end -= _HASHES
        found = []
        while not cursor.done:
            name = cursor.text(cursor.number(4))
            index = cursor.number(1)
            metadata = cursor.text(cursor.number(4)) if index == ELSEWHERE else self._said_at(index)
            found.append((name, metadata))
        return found

    def _said_at(self, index: int) -> str:
        if index >= len(self._metadata):
            raise ValueError(
                f"a header has metadata {index}; it must be one of {len(self._metadata)}"
            )
        return self._metadata[index]


def _said(metadata: str) -> tuple[str, bool]:
    """The schema, and whether the object is an instance of another."""
    said = metadata.split(";")
    schemas = [each.removeprefix("schema=") for each in said if each.startswith("schema=")]
    return (schemas[0] if schemas else ""), "isInstance=1" in said
