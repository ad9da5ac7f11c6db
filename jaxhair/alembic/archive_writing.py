"""Objects, properties and samples of Alembic files, in the Ogawa container (AbcCoreOgawa).

    root      versions of this layout and of the library, top object, archive's metadata, time
              samplings, indexed metadata
    object    group of its properties, child objects, and the children's headers with two hashes
    compound  properties, and their headers
    property  its samples; of an array each with its dimensions

Written once are samples that are the same bytes, and of a property only those from its first to
its last change. Reading is in archive_reading.py.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from hashlib import blake2b
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from jaxhair.alembic.ogawa import EMPTY_DATA, Writer

TYPES = ("b1", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
"""Of numbers, in the order of Alembic's PlainOldDataType."""
STRING = len(TYPES)
FORMAT, LIBRARY = 0, 10803  # of the layout, and of the library that writes the same bytes
ACYCLIC = float(np.finfo(float).max) / 32  # time per cycle where all times are stored
ELSEWHERE = 0xFF  # index of metadata that stand at the header itself

SCALAR, ARRAY = 1, 2  # bits of the uint32 with which a property's header begins
SIZE_HINT, TYPE, SAMPLING, CHANGES, SAME_SIZE, CONSTANT = 2, 4, 0x100, 0x200, 0x400, 0x800
EXTENT, METADATA = 12, 20


@dataclass(frozen=True)
class Sampling:
    """When samples are: `times` [s] of one cycle, repeated each `cycle` [s]; ACYCLIC if all."""

    cycle: float
    times: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Property:
    """Samples of one type; a compound has other properties in place of them.

    samples: of a scalar each its numbers, shape (extent,); of an array shape (values, extent), or
        of text a str, an array of one.
    sampling: place of its `Sampling`; the first is of what has no time.
    """

    name: str
    samples: Sequence[Any] | NDArray[Any] = ()
    scalar: bool = False
    sampling: int = 0
    metadata: str = ""
    compound: tuple["Property", ...] | None = None


@dataclass(frozen=True, eq=False)
class Node:
    """An object with its properties and children."""

    name: str
    metadata: str = ""
    properties: tuple[Property, ...] = ()
    children: tuple["Node", ...] = ()


def write_archive(file: BinaryIO, top: Node, samplings: Sequence[Sampling], metadata: str) -> None:
    """Writes an archive to an empty file.

    top: of which only the children have a name that readers show.
    samplings: the first must be that of properties without a time.
    metadata: of the archive, `name=value` with ; between.
    """
    _Archive(file, samplings).write(top, metadata)


@dataclass
class _Archive:
    """What has been written so far."""

    file: BinaryIO
    samplings: Sequence[Sampling]
    samples: dict[bytes, int] = field(default_factory=dict)  # references by key
    metadata: dict[str, int] = field(default_factory=dict)
    most: dict[int, int] = field(default_factory=dict)  # samples in each sampling

    def write(self, top: Node, metadata: str) -> None:
        self.container = Writer(self.file)
        data = self.container.data
        versions = [data(struct.pack("<i", number)) for number in (FORMAT, LIBRARY)]
        found, _ = self._object(top)
        times = [
            struct.pack("<Id", self.most.get(i, 0), sampling.cycle)
            + struct.pack(f"<I{len(sampling.times)}d", len(sampling.times), *sampling.times)
            for i, sampling in enumerate(self.samplings)
        ]
        indexed = [bytes([len(text)]) + text.encode() for text in self.metadata]
        self.container.root(
            self.container.group(
                [*versions, found, data(metadata.encode()), data(*times), data(*indexed)]
            )
        )

    def _object(self, node: Node) -> tuple[int, bytes]:
        """Reference, and a digest of all that is in it."""
        properties, own = self._compound(node.properties)
        children = [self._object(child) for child in node.children]
        header = b"".join(
            struct.pack("<I", len(child.name)) + child.name.encode() + self._indexed(child.metadata)
            for child in node.children
        )
        inner = _digest(*(digest for _, digest in children)) if children else bytes(16)
        last = self.container.data(header, own, inner)
        group = self.container.group([properties, *(reference for reference, _ in children), last])
        return group, _digest(own, inner)

    def _compound(self, properties: Sequence[Property]) -> tuple[int, bytes]:
        if not properties:
            return self.container.group([]), _digest()
        written = [self._property(each) for each in properties]
        headers = b"".join(header for _, header, _ in written)
        group = [reference for reference, _, _ in written] + [self.container.data(headers)]
        return self.container.group(group), _digest(*(digest for _, _, digest in written))

    def _property(self, of: Property) -> tuple[int, bytes, bytes]:
        """Reference, header and digest."""
        info = 0
        numbers: list[int] = []
        if of.compound is not None:
            group, digest = self._compound(of.compound)
        else:
            group, digest, info, numbers = self._samples(of)
        largest = max(len(of.metadata), len(of.name), *numbers, 0)
        hint = int(largest > 0xFF) + int(largest > 0xFFFF)
        index = self._indexed(of.metadata)
        info |= hint << SIZE_HINT | index[0] << METADATA
        header = struct.pack("<I", info)
        header += b"".join(n.to_bytes(1 << hint, "little") for n in (*numbers, len(of.name)))
        return group, header + of.name.encode(), _digest(header, of.name.encode(), digest)

    def _samples(self, of: Property) -> tuple[int, bytes, int, list[int]]:
        """Reference, digest, and what the header says of the samples."""
        keys = [_digest(_encoded(sample)) for sample in of.samples]
        changes = [i for i in range(1, len(keys)) if keys[i] != keys[i - 1]]
        first, last = (changes[0], changes[-1]) if changes else (0, 0)
        children = []
        for i in (0, *range(first, last + 1)) if changes else (0,):
            children.append(self._sample(keys[i], of.samples[i]))
            if not of.scalar:
                children.append(self._dimensions(of.samples[i]))
        sizes = {1 if isinstance(sample, str) else len(sample) for sample in of.samples}
        count = len(of.samples)
        self.most[of.sampling] = max(
            self.most.get(of.sampling, 0), count if last else min(count, 1)
        )
        text = isinstance(of.samples[0], str)
        kind = STRING if text else TYPES.index(of.samples[0].dtype.str.replace("|", ""))
        extent = 1 if text else of.samples[0].shape[-1]
        info = SCALAR if of.scalar else ARRAY | (SCALAR if sizes == {1} else 0)
        info |= kind << TYPE | extent << EXTENT | (SAME_SIZE if len(sizes) == 1 else 0)
        numbers = [count]
        if last == 0:
            info |= CONSTANT
        elif (first, last) != (1, count - 1):
            info |= CHANGES
            numbers += [first, last]
        if of.sampling:
            info |= SAMPLING
            numbers.append(of.sampling)
        return self.container.group(children), _digest(*keys), info, numbers

    def _sample(self, key: bytes, sample: Any) -> int:
        data = b"" if key in self.samples else _encoded(sample)
        if data:
            self.samples[key] = self.container.data(key, data)
        return self.samples.get(key, EMPTY_DATA)

    def _dimensions(self, sample: Any) -> int:
        """Those of text; numbers' follow from their bytes."""
        return self.container.data(struct.pack("<Q", 1) if isinstance(sample, str) else b"")

    def _indexed(self, metadata: str) -> bytes:
        """One byte that stands for metadata, 0 for none; all of ours are short and few."""
        if not metadata:
            return b"\0"
        return bytes([self.metadata.setdefault(metadata, len(self.metadata)) + 1])


def _encoded(sample: Any) -> bytes:
    """A sample's bytes: of numbers, or of text with its end."""
    if isinstance(sample, str):
        return sample.encode() + b"\0"
    values: NDArray[Any] = sample
    return values.tobytes()


def _digest(*parts: bytes) -> bytes:
    """16 bytes that differ where the parts do.

    The library has SpookyHash there. Readers compare such keys, of samples or objects, with each
    other and never with the bytes, so that any digest does.
    """
    found = blake2b(digest_size=16)
    for part in parts:
        found.update(part)
    return found.digest()
