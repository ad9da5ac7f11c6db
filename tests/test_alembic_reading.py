"""Alembic files of others: transforms, several objects, all sorts of curves, and bad bytes.

They are put together by `jaxhair.alembic.archive_writing`; those of Blender are in
test_blender.py.
"""

import io
import struct
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxhair as jh
from jaxhair.alembic.archive_writing import ACYCLIC, Node, Property, Sampling, write_archive
from jaxhair.alembic.ogawa import EMPTY_DATA, HEADER, Writer
from jaxhair.alembic.writing import BASES, STILL

A = np.array([[0.0, 0, 3], [1, 0, 2], [1, 1, 1], [2, 1, 0]], np.float32)
B = 2 * A[:2] + 1
SCALE, MOVE, TURN, MATRIX, ABOUT_X = 0, 1, 2, 3, 4
FRAMES = (STILL, Sampling(0.5, (0.0,)), Sampling(ACYCLIC, (0.0, 0.25, 0.5)))


def curves(
    name: str = "hair",
    strands: Sequence[Any] = (A,),
    *,
    how: tuple[int, ...] = BASES["linear"],
    frames: Sequence[Sequence[Any]] | None = None,
    sampling: int = 0,
    more: tuple[Property, ...] = (),
    visible: int | None = None,
) -> Node:
    """An object with Curves: points of its strands, or those of each frame."""
    each = [strands] if frames is None else frames
    points = [np.concatenate([np.zeros((0, 3)), *of]).astype("<f4") for of in each]
    counts = [np.array([[len(s)] for s in of], "<i4").reshape(-1, 1) for of in each]
    geometry = (
        Property("P", points, sampling=sampling),
        Property("nVertices", counts, sampling=sampling),
        Property("curveBasisAndType", [np.array(how, "u1")], scalar=True),
        *more,
    )
    properties = [Property(".geom", compound=geometry)]
    if visible is not None:
        properties.append(Property("visible", [np.array([visible], "i1")], scalar=True))
    return Node(name, "schema=AbcGeom_Curve_v2;schemaBaseType=x", tuple(properties))


def placed(
    ops: Sequence[tuple[int, Sequence[float]]],
    *children: Node,
    inherits: bool = True,
    frames: Sequence[Sequence[float]] | None = None,
    name: str = "place",
) -> Node:
    """A transform of some operations, the first outermost, or their numbers in each frame."""
    values = frames or [[n for _, numbers in ops for n in numbers]]
    properties: tuple[Property, ...] = (
        Property(".inherits", [np.array([inherits])], scalar=True),
        Property(".ops", [np.array([kind << 4 for kind, _ in ops], "u1")], scalar=True),
        Property(".vals", np.array(values, "<f8"), scalar=True, sampling=1 if frames else 0),
    )
    compound = Property(".xform", compound=properties if ops else properties[:1])
    return Node(name, "schema=AbcGeom_Xform_v3;x=y", (compound,), children)


def written(path: Path, *nodes: Node) -> Path:
    """A file with these objects at its top."""
    with path.open("wb") as file:
        write_archive(file, Node("", children=nodes), FRAMES, "")
    return path


def read(path: Path, *nodes: Node, **options: Any) -> list[Any]:
    """Strands of a file of these objects, in its axes."""
    return jh.read_strands(written(path, *nodes), up="z", **options)


def assert_same(found: Sequence[Any], wanted: Sequence[Any]) -> None:
    assert [len(s) for s in found] == [len(s) for s in wanted]
    for a, b in zip(found, wanted, strict=True):
        assert np.asarray(a) == pytest.approx(np.asarray(b), abs=1e-12)


def test_several_objects_follow_each_other(tmp_path: Path) -> None:
    """Wherever they are, in the order of the file; other objects are passed by."""
    other = Node("mesh", "schema=AbcGeom_PolyMesh_v1")
    inner = placed([], curves("b", [B, A[:1], A[:0]]), other)
    assert_same(read(tmp_path / "a.abc", curves("a"), inner, other), [A, B, A[:1], A[:0]])


def test_transforms_are_applied(tmp_path: Path) -> None:
    """Scaled, turned and moved: the first operation of a transform is the outermost."""
    ops = [(MOVE, (1, 2, 3)), (ABOUT_X, (90,)), (SCALE, (1, 2, 3))]
    scaled = A * [1, 2, 3]
    want = np.stack([scaled[:, 0], -scaled[:, 2], scaled[:, 1]], 1) + [1, 2, 3]
    assert_same(read(tmp_path / "a.abc", placed(ops, curves())), [want])
    turned = [(MOVE, (1, 2, 3)), (TURN, (2, 0, 0, 90)), (SCALE, (1, 2, 3))]
    assert_same(read(tmp_path / "b.abc", placed(turned, curves())), [want])


@pytest.mark.parametrize("axis", range(3))
def test_rotations_follow_the_right_hand(tmp_path: Path, axis: int) -> None:
    """Of the next axis towards the one after it, about an axis by its name or as a vector."""
    ahead, after = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
    for op in ((ABOUT_X + axis, (90.0,)), (TURN, (*np.eye(3)[axis], 90.0))):
        found = read(tmp_path / "a.abc", placed([op], curves(strands=[[ahead, after]])))
        assert_same(found, [[after, -ahead]])


def test_transforms_within_transforms(tmp_path: Path) -> None:
    """The inner first; one that does not inherit starts anew."""
    matrix = np.array([[0, 2, 0, 0], [-2, 0, 0, 0], [0, 0, 2, 0], [5, 0, 0, 1]], float)
    inner = placed([(MATRIX, matrix.reshape(-1))], curves())
    want = A @ matrix[:3, :3] + matrix[3, :3]
    assert_same(read(tmp_path / "a.abc", placed([(MOVE, (0, 0, 7))], inner)), [want + [0, 0, 7]])
    alone = placed([(MATRIX, matrix.reshape(-1))], curves(), inherits=False)
    assert_same(read(tmp_path / "b.abc", placed([(MOVE, (0, 0, 7))], alone)), [want])


def test_frames_are_all_times_at_which_something_changes(tmp_path: Path) -> None:
    """What is sampled at other times stands as it was."""
    moving = placed([(MOVE, ())], curves("a"), frames=[(0, 0, 0), (0, 0, 1)])  # at 0 and 0.5
    changing = curves("b", frames=[[B], [2 * B], [A, B]], sampling=2)  # at 0, 0.25 and 0.5
    path = written(tmp_path / "a.abc", moving, changing)
    up = np.array([0, 0, 1])
    for frame, want in enumerate(([A, B], [A, 2 * B], [A + up, A, B])):
        assert_same(jh.read_strands(path, up="z", frame=frame), want)
        assert_same(jh.read_strands(path, up="z", frame=frame - 3), want)
    with pytest.raises(ValueError, match=r"frame is -4; of the 3 frames .* from -3 to 2"):
        jh.read_strands(path, frame=-4)


@pytest.mark.parametrize("order", [(0, 0, 1, 1), (0, 1, 1, 0), (0, 1, 0, 0), (0, 0, 0, 0)])
def test_frames_that_repeat(tmp_path: Path, order: tuple[int, ...]) -> None:
    """Those before the first change and after the last are not stored."""
    frames = [[(A, 2 * A)[which]] for which in order]
    path = written(tmp_path / "a.abc", curves(frames=frames, sampling=1))
    for frame, want in enumerate(frames):
        assert_same(jh.read_strands(path, up="z", frame=frame), want)


def test_cyclic_times(tmp_path: Path) -> None:
    """Some times that repeat, as with samples at the opening of a shutter."""
    cyclic = (STILL, Sampling(1.0, (0.0, 0.3)))
    moving = curves(frames=[[n * A] for n in range(1, 6)], sampling=1)
    with (tmp_path / "a.abc").open("wb") as file:
        write_archive(file, Node("", children=(moving,)), cyclic, "")
    for frame in range(5):
        found = jh.read_strands(tmp_path / "a.abc", up="z", frame=frame)
        assert_same(found, [(frame + 1) * A])


def test_invisible_curves_are_left_out(tmp_path: Path) -> None:
    """Of -1, deferred, 0, hidden, and 1, visible."""
    shown = [curves("abc"[n + 1], [(n + 2) * A], visible=n) for n in (-1, 0, 1)]
    assert_same(read(tmp_path / "a.abc", *shown), [A, 3 * A])
    with pytest.raises(ValueError, match=r"all its curves are invisible; some must be visible"):
        read(tmp_path / "b.abc", curves(visible=0))


def test_curves_are_read_where_segments_meet(tmp_path: Path) -> None:
    """Catmull-Rom at all points, whose ends Alembic does not tell."""
    both = {"linear": [A], "catmullRom": [A]}
    for basis, want in both.items():
        assert_same(read(tmp_path / "a.abc", curves(how=BASES[basis])), want)
    assert_same(read(tmp_path / "a.abc", curves(how=(0, 0, 1, 1))), [A[[0, 3]]])
    smooth = (A[:-2] + 4 * A[1:-1] + A[2:]) / 6
    found = read(tmp_path / "a.abc", curves(how=(0, 0, 2, 2)))
    assert found[0] == pytest.approx(smooth, abs=1e-6)
    assert_same(read(tmp_path / "a.abc", curves(how=(1, 0, 3, 3))), [A])  # Blender's hair


def test_the_default_is_metres_and_y_up(tmp_path: Path) -> None:
    """As Blender and Houdini write; with `unit` and `up` others."""
    path = written(tmp_path / "a.abc", curves())
    turned = A[:, [0, 2, 1]] * [1, -1, 1]
    assert_same(jh.read_strands(path), [turned])
    assert_same(jh.read_strands(path, unit=0.01), [0.01 * turned])
    assert_same(jh.read_curves(path, unit=0.01, up="z").to_list(), [0.01 * A.astype(float)])
    with pytest.raises(ValueError, match=r"time is 0\.5; it must be left out unless .* USD"):
        jh.read_strands(path, time=0.5)


KNOTS = Property(".knots", [np.arange(8, dtype="<f4")[:, None]])
REFUSED: dict[str, tuple[tuple[Node, ...], list[str]]] = {
    "no objects": ((), ["it has no Curves"]),
    "no curves": ((placed([], Node("mesh")),), ["it has no Curves; strands must be such"]),
    "variable order": ((curves(how=(2, 0, 0, 0)),), ["/hair", "'NURBS'", "'linear' or 'cubic'"]),
    "no basis": ((curves(how=(0, 0, 0, 0)),), ["/hair", "'NURBS'"]),
    "knots": ((curves(how=(0, 0, 2, 2), more=(KNOTS,)),), ["/hair", "'NURBS'"]),
    "closed": ((curves(how=(1, 1, 0, 0)),), ["'periodic'", "closed", "'nonperiodic'"]),
    "hermite": ((curves(how=(0, 0, 4, 4)),), ["'hermite'", "'bezier', 'bspline'"]),
    "unknown": ((curves(how=(0, 0, 99, 99)),), ["'number 99'", "'bezier', 'bspline'"]),
    "too few": ((curves(strands=[A[:3]], how=(0, 0, 1, 1)),), ["curve 0", "3 control points"]),
    "instance": ((curves(), Node("copy", "isInstance=1")), ["'/copy'", "instances real"]),
    "operation": ((placed([(9, (1.0,))], curves()),), ["'/place'", "kind 9", "from 0 to 6"]),
    "numbers": ((placed([(MOVE, (1.0,))], curves()),), ["'/place'", "have 1 numbers", "3"]),
}


@pytest.mark.parametrize("how", REFUSED)
def test_what_cannot_be_read_is_refused_with_the_reason(tmp_path: Path, how: str) -> None:
    """Naming the file, the object, what is wrong and what is allowed."""
    nodes, words = REFUSED[how]
    with pytest.raises(ValueError) as error:
        read(tmp_path / "odd.abc", *nodes)
    for word in ["odd.abc", "must" if how != "instance" else "make", *words]:
        assert word in str(error.value)
    assert len(str(error.value)) < 400


def test_counts_must_fit_the_points(tmp_path: Path) -> None:
    """Each by itself and together."""
    for counts, words in (
        ([5], "value 5 at 0"),
        ([-1, 5], "value -1 at 0"),
        ([1, 2], "add up to 3"),
    ):
        node = curves()
        (geometry,) = node.properties
        assert geometry.compound is not None
        points, sizes, *rest = geometry.compound
        sizes = replace(sizes, samples=[np.array(counts, "<i4")[:, None]])
        wrong = replace(geometry, compound=(points, sizes, *rest))
        with pytest.raises(ValueError, match=f"nVertices .*{words}.* must"):
            read(tmp_path / "a.abc", replace(node, properties=(wrong,)))


def refusal(path: Path, data: bytes) -> str:
    """Why a file of these bytes is refused."""
    path.write_bytes(data)
    with pytest.raises(ValueError) as error:
        jh.read_strands(path)
    assert path.name in str(error.value)
    assert "must" in str(error.value)
    assert len(str(error.value)) < 400
    return str(error.value)


def test_other_containers_are_refused(tmp_path: Path) -> None:
    """HDF5, a file that is not complete, and later versions."""
    path = tmp_path / "a.abc"
    good = written(path, curves()).read_bytes()
    assert "HDF5" in refusal(path, b"\x89HDF\r\n\x1a\n" + bytes(100))
    assert "not finished" in refusal(path, good[:5] + b"\0" + good[6:])
    assert "0.1" in refusal(path, good[:6] + b"\0\2" + good[8:])
    assert "version of its layout" in refusal(path, good[:24] + b"\1" + good[25:])
    assert "starts with b'solid'" in refusal(path, b"solid" + good[5:])


def archive(top: int | None, *, build: Any = None) -> bytes:
    """A file whose top object is at a place, or what `build` writes as it."""
    with io.BytesIO() as file:
        writer = Writer(file)
        versions = [writer.data(struct.pack("<i", n)) for n in (0, 10803)]
        reference = build(writer) if top is None else top
        times = writer.data(struct.pack("<IdId", 0, 1.0, 1, 0.0))
        metadata = writer.data(b"\x17schema=AbcGeom_Xform_v3", b"\x17schema=AbcGeom_Curve_v2")
        root = [*versions, reference, EMPTY_DATA, times, metadata]
        writer.root(writer.group(root))
        return file.getvalue()


def headers(names: Sequence[str], metadata: int = 1) -> bytes:
    """Of child objects."""
    each = [struct.pack("<I", len(n)) + n.encode() + bytes([metadata]) for n in names]
    return b"".join(each) + bytes(32)


def test_metadata_may_stand_at_the_header(tmp_path: Path) -> None:
    """Where there are too many for the list, or they are long: of objects and of properties."""

    def text(size: int, *parts: str) -> bytes:
        return b"".join(len(p).to_bytes(size, "little") + p.encode() for p in parts)

    def build(writer: Writer) -> int:
        sample = [writer.data(bytes(16), A.tobytes()), EMPTY_DATA]
        count = [writer.data(bytes(16), struct.pack("<i", len(A))), EMPTY_DATA]
        basis = [writer.data(bytes(16), bytes([1, 0, 0, 0]))]
        children = [writer.group(each) for each in (sample, count, basis)]
        info = [2 | 10 << 4 | 3 << 12, 2 | 6 << 4 | 1 << 12, 1 | 1 << 4 | 4 << 12]
        names = ("P", "nVertices", "curveBasisAndType")
        said = b"".join(
            # a size hint of 2 bytes, constant, and metadata behind the name
            struct.pack("<IH", bits | 1 << 2 | 0x800 | 0xFF << 20, 1) + text(2, name, "x" * 300)
            for bits, name in zip(info, names, strict=True)
        )
        geometry = writer.group([*children, writer.data(said)])
        header = struct.pack("<I", 0xFF << 20) + text(1, ".geom", "")
        inside = writer.group([geometry, writer.data(header)])
        hair = writer.group([inside, writer.data(headers([]))])
        metadata = "y=" + "z" * 300 + ";schema=AbcGeom_Curve_v2"
        header = text(4, "hair") + b"\xff" + text(4, metadata) + bytes(32)
        return writer.group([0, hair, writer.data(header)])

    (tmp_path / "a.abc").write_bytes(archive(None, build=build))
    assert_same(jh.read_strands(tmp_path / "a.abc", up="z"), [A])


def test_times_must_be_there_for_all_samples(tmp_path: Path) -> None:
    """Where they are not at a constant rate."""
    moving = curves(frames=[[n * A] for n in range(4)], sampling=2)
    with pytest.raises(ValueError, match="4 samples at 3 times; there must be a time for each"):
        read(tmp_path / "a.abc", moving)


@pytest.mark.parametrize("changes", [(3, 2), (2, 4), (0, 2), (255, 255)])
def test_changes_must_be_among_the_samples(tmp_path: Path, changes: tuple[int, int]) -> None:
    """The first and the last sample that differ from the one before."""
    path = written(tmp_path / "a.abc", curves(frames=[[A], [A], [B, A], [B, A]], sampling=1))
    data, claim = path.read_bytes(), bytes([4, 2, 2, 1, 1]) + b"P"
    assert data.count(claim) == 1
    wrong = data.replace(claim, bytes([4, *changes, 1, 1]) + b"P")
    assert f"4 samples that change from {changes[0]} to {changes[1]}" in refusal(path, wrong)


def test_an_object_inside_itself_is_refused(tmp_path: Path) -> None:
    """Without an endless loop."""

    def build(writer: Writer) -> int:
        header = writer.data(headers(["again"]))
        place = writer._end
        return writer.group([0, place, header])

    assert "inside themselves" in refusal(tmp_path / "a.abc", archive(None, build=build))


def test_objects_that_share_their_children_are_refused(tmp_path: Path) -> None:
    """60 levels, each with the next one twice, would be 2^60 objects."""

    def build(writer: Writer) -> int:
        below = writer.group([0, writer.data(headers([]))])
        for _ in range(60):
            below = writer.group([0, below, below, writer.data(headers(["a", "b"]))])
        return below

    assert "overlap" in refusal(tmp_path / "a.abc", archive(None, build=build))


def test_deep_nesting_is_read(tmp_path: Path) -> None:
    """20,000 levels, and a wrong one below them is named in short."""

    def build(writer: Writer) -> int:
        below = writer.group([EMPTY_DATA, writer.data(headers([]))])
        below = writer.group([0, below, writer.data(headers(["c"], 2))])
        for _ in range(20_000):
            below = writer.group([0, below, writer.data(headers(["name"]))])
        return below

    assert "has no P" in refusal(tmp_path / "a.abc", archive(None, build=build))


@pytest.mark.parametrize("place", [1, 15, 10**6, 2**62, 2**63 - 1])
def test_places_outside_the_file_are_refused(tmp_path: Path, place: int) -> None:
    """And those in its header."""
    assert f"to byte {place}" in refusal(tmp_path / "a.abc", archive(place))


def test_huge_counts_are_refused(tmp_path: Path) -> None:
    """Of children of a group and of bytes of data."""
    data = archive(0)
    (root,) = struct.unpack_from("<Q", data, len(HEADER))
    for count in (7, 2**32, 2**61, 2**64 - 1):
        wrong = data[:root] + struct.pack("<Q", count) + data[root + 8 :]
        assert f"says that {count} references follow" in refusal(tmp_path / "a.abc", wrong)
        wrong = data[:16] + struct.pack("<Q", max(count, 10**6)) + data[24:]
        assert "bytes of data follow" in refusal(tmp_path / "a.abc", wrong)


def test_a_claim_of_endless_frames_takes_no_memory(tmp_path: Path) -> None:
    """Samples that are not stored, because nothing changes in them."""
    path = tmp_path / "a.abc"
    many = 70_000  # which take 4 bytes
    data = written(tmp_path / "a.abc", curves(frames=[[A]] * many, sampling=1)).read_bytes()
    claim = struct.pack("<III", many, 1, 1) + b"P"
    assert data.count(claim) == 1
    data = data.replace(claim, struct.pack("<III", 2**32 - 1, 1, 1) + b"P")
    tracemalloc.start()
    assert "4294967295 samples; they must have at most 1000000" in refusal(path, data)
    assert tracemalloc.get_traced_memory()[1] < 50e6
    tracemalloc.stop()


def test_shared_samples_are_bounded(tmp_path: Path) -> None:
    """The same large data in very many objects are refused, in a few they are read."""
    points = np.random.default_rng(0).normal(size=(20_000, 3))
    few = [curves(f"c{i}", [points]) for i in range(3)]
    assert len(read(tmp_path / "a.abc", *few)) == 3
    many = [curves(f"c{i}", [points]) for i in range(300)]
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"a\.abc: .*share data.*must have fewer"):
        read(tmp_path / "a.abc", *many)
    assert tracemalloc.get_traced_memory()[1] < 100e6
    tracemalloc.stop()
