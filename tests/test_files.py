"""Strand files: exact round trips, bytes as the formats define them, and refusal of all else."""

import io
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from jaxhair.alembic.writing import write_still
from jaxhair.arrays import read_arrays, write_arrays
from jaxhair.files import Curves, read_curves, read_strands, to_unit, write_curves

ENDINGS = [".hair", ".data", ".npz", ".abc"]


def strands(*sizes, seed=0):
    """Strands of these numbers of points, with coordinates that float32 holds exactly."""
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(n, 3)).astype(np.float32) for n in sizes]


def npz(path, **arrays):
    np.savez(path, **arrays)
    return path


def hair_bytes(segments, points, *, arrays=3, default=0, counts=None, extra=b""):
    """A .hair file, put together from the format's description."""
    strands, total = counts or (len(segments), len(points))
    header = b"HAIR" + struct.pack("<4I", strands, total, arrays, default)
    header += struct.pack("<2f3f", 80e-6, 0, 1, 1, 1)
    header += b"jaxhair: 1 unit = 1 m, z up".ljust(88, b"\0")
    assert len(header) == 128
    data = b"".join(struct.pack("<H", s) for s in segments) if arrays & 1 else b""
    return header + data + b"".join(struct.pack("<3f", *p) for p in points) + extra


def data_bytes(*lists):
    data = struct.pack("<i", len(lists))
    for points in lists:
        data += struct.pack("<i", len(points))
        data += b"".join(struct.pack("<3f", *p) for p in points)
    return data


A = [(1, 2, 3), (4, 5, 6)]
B = [(-1, 0.5, 0.25), (0, 0, 8), (7, 7, 7)]


def assert_same(curves, lists):
    assert len(curves.counts) == len(lists)
    for got, wanted in zip(curves.to_list(), lists, strict=True):
        np.testing.assert_array_equal(got, wanted)


# --- Curves


def test_curves_pads_with_the_last_point():
    curves = Curves.from_list([A, B])
    assert curves.points.shape == (2, 3, 3)
    assert curves.points.dtype == np.float64
    assert curves.counts.dtype == np.int64
    np.testing.assert_array_equal(curves.counts, [2, 3])
    np.testing.assert_array_equal(curves.points[0, 2], A[-1])
    assert_same(curves, [A, B])


def test_curves_replaces_what_is_beyond_a_strand():
    points = np.full((2, 4, 3), np.nan)
    points[0, :2] = A
    points[1, :3] = B
    curves = Curves(points, np.array([2, 3], dtype=np.uint8))
    assert np.all(np.isnan(points[:, 3])), "the caller's array is not touched"
    np.testing.assert_array_equal(curves.points[0], [A[0], A[1], A[1], A[1]])
    np.testing.assert_array_equal(curves.points[1], [*B, B[-1]])


def test_curves_keeps_a_copy():
    points, counts = np.zeros((1, 2, 3)), np.array([2])
    curves = Curves(points, counts)
    curves.to_list()[0][:] = 1
    points[:], counts[:] = 1, 1
    assert np.all(curves.points == 0)
    assert curves.counts[0] == 2


@pytest.mark.parametrize("shape", [(0, 0, 3), (0, 10**12, 3)])
def test_curves_of_no_strands(shape):
    assert Curves(np.zeros(shape), np.zeros(0, dtype=int)).to_list() == []
    assert Curves.from_list([]).points.shape == (0, 0, 3)


def test_curves_of_one_point_are_legal():
    assert_same(Curves.from_list([[(1, 2, 3)], A]), [[(1, 2, 3)], A])


@pytest.mark.parametrize(
    ("points", "counts", "words"),
    [
        (np.zeros((2, 3)), [2, 2], ["points", "(2, 3)", "(strands, points, 3)"]),
        (np.zeros((2, 3, 2)), [2, 2], ["points", "(2, 3, 2)", "(strands, points, 3)"]),
        ([[[0, 0, 0]], [[0, 0, 0]] * 2], [1, 2], ["points", "must be an array"]),
        (np.full((1, 2, 3), "a"), [2], ["points", "<U1", "real numbers"]),
        (np.zeros((1, 2, 3), complex), [2], ["points", "complex", "real numbers"]),
        (np.zeros((1, 2, 3), bool), [2], ["points", "bool", "real numbers"]),
        (np.zeros((2, 3, 3)), [3], ["counts", "(1,)", "(2,)"]),
        (np.zeros((2, 3, 3)), 3, ["counts", "()", "(2,)"]),
        (np.zeros((2, 3, 3)), [3, 0], ["counts", "0 at 1", "from 1 to 3"]),
        (np.zeros((2, 3, 3)), [4, 3], ["counts", "4 at 0", "from 1 to 3"]),
        (np.zeros((2, 3, 3)), [-1, 3], ["counts", "-1 at 0", "from 1 to 3"]),
        (np.zeros((2, 3, 3)), [2.0, 3.0], ["counts", "float64", "whole numbers"]),
    ],
)
def test_curves_refuses(points, counts, words):
    with pytest.raises(ValueError) as raised:
        Curves(points, counts)
    for word in words:
        assert word in str(raised.value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_curves_refuses_what_is_not_finite(value):
    points = np.zeros((2, 3, 3))
    points[1, 2, 1] = value
    with pytest.raises(ValueError, match=rf"points.*{value} at \(1, 2, 1\).*finite"):
        Curves(points, [3, 3])
    assert Curves(points, [3, 2]).counts[1] == 2


@pytest.mark.skipif(np.finfo(np.longdouble).max == np.finfo(float).max, reason="no wider type")
def test_curves_refuses_what_float64_cannot_hold():
    with pytest.raises(ValueError, match="finite"):
        Curves(np.full((1, 2, 3), np.longdouble("1e400")), [2])


@pytest.mark.parametrize("strand", [np.zeros((2, 2)), np.zeros(3), np.zeros((0, 3)), 1.0])
def test_from_list_refuses_other_shapes(strand):
    with pytest.raises(ValueError, match=r"strand 1 has shape .*\(points, 3\)"):
        Curves.from_list([A, strand])


def test_from_list_refuses_strands_too_uneven_to_pad():
    short = np.zeros((1, 3))
    assert len(Curves.from_list([*[short] * 99, np.zeros((500, 3))]).counts) == 100
    with pytest.raises(ValueError, match=r"strand 20000 has 20001 points.*at most 100 times"):
        Curves.from_list([*[short] * 20000, np.zeros((20001, 3))])


# --- round trips


@pytest.mark.parametrize("ending", [*ENDINGS, ".HAIR"])
@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("sizes", [(), (2,), (5, 5, 5), (2, 17, 3, 9)])
def test_round_trip_is_exact(tmp_path, ending, up, sizes):
    path = tmp_path / f"a{ending}"
    wanted = strands(*sizes)
    write_curves(path, Curves.from_list(wanted), up=up)
    curves = read_curves(str(path), up=up)
    assert_same(curves, wanted)
    assert curves.points.shape == (len(sizes), max(sizes, default=0), 3)
    for strand, size in zip(curves.points, sizes, strict=True):
        assert np.all(strand[size:] == strand[size - 1])


@pytest.mark.parametrize("ending", ENDINGS)
def test_round_trip_keeps_extreme_values(tmp_path, ending):
    info = np.finfo(np.float32)
    values = [info.max, -info.max, info.tiny, info.smallest_subnormal, 0.0, -0.0]
    wanted = [np.array(values, dtype=np.float32).reshape(2, 3)]
    write_curves(tmp_path / f"a{ending}", Curves.from_list(wanted))
    got = read_curves(tmp_path / f"a{ending}").to_list()
    np.testing.assert_array_equal(np.signbit(got), np.signbit(wanted))
    assert_same(read_curves(tmp_path / f"a{ending}"), wanted)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(
    "unit", [0.01, 0.0254, 1e3, 1e-12, 1e12, np.float32(0.5), np.float16(0.5), 2]
)
@pytest.mark.parametrize("up", ["y", "z"])
def test_round_trip_in_another_unit(tmp_path, ending, unit, up):
    wanted = strands(4, 7)
    write_curves(tmp_path / f"a{ending}", Curves.from_list(wanted), unit=unit, up=up)
    got = read_curves(tmp_path / f"a{ending}", unit=unit, up=up)
    for a, b in zip(got.to_list(), wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=2**-23)


@pytest.mark.parametrize("ending", ENDINGS)
def test_unit_and_axis(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    write_curves(path, Curves.from_list([A]), up="z")
    scaled = read_curves(path, unit=0.01, up="z").points[0]
    np.testing.assert_allclose(scaled, np.multiply(A, 0.01))
    turned = [(1, -3, 2), (4, -6, 5)]
    np.testing.assert_array_equal(read_curves(path, up="y").points[0], turned)
    write_curves(tmp_path / f"b{ending}", Curves.from_list([A]), unit=0.5, up="y")
    np.testing.assert_array_equal(
        read_curves(tmp_path / f"b{ending}", up="z").points[0], [(2, 6, -4), (8, 12, -10)]
    )


@pytest.mark.parametrize("ending", ENDINGS)
def test_alembic_is_y_up_by_default_and_the_others_z_up(tmp_path, ending):
    path, up = tmp_path / f"a{ending}", "y" if ending == ".abc" else "z"
    write_curves(path, Curves.from_list([A]))
    assert_same(read_curves(path), [A])
    assert_same(read_curves(path, up=up), [A])
    assert not np.array_equal(read_curves(path, up="z" if up == "y" else "y").points[0], A)


def test_the_change_of_axes_is_a_rotation(tmp_path):
    path = tmp_path / "a.data"
    path.write_bytes(data_bytes(np.eye(3)))
    rotation = read_curves(path, up="y").points[0].T
    np.testing.assert_array_equal(rotation @ rotation.T, np.eye(3))
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_array_equal(rotation @ [0, 1, 0], [0, 0, 1])


@pytest.mark.parametrize("ending", ENDINGS)
def test_many_strands(tmp_path, ending):
    wanted = Curves(strands(20_000 * 25)[0].reshape(20_000, 25, 3), np.full(20_000, 25))
    write_curves(tmp_path / f"a{ending}", wanted)
    np.testing.assert_array_equal(read_curves(tmp_path / f"a{ending}").points, wanted.points)


# --- bytes


def test_hair_bytes(tmp_path):
    write_curves(tmp_path / "a.hair", Curves.from_list([A, B]))
    assert (tmp_path / "a.hair").read_bytes() == hair_bytes([1, 2], A + B)


def test_hair_states_unit_axis_and_thickness(tmp_path):
    write_curves(tmp_path / "a.hair", Curves.from_list([A]), unit=0.01, up="y")
    data = (tmp_path / "a.hair").read_bytes()
    assert data[40:128].rstrip(b"\0") == b"jaxhair: 1 unit = 0.01 m, y up"
    assert struct.unpack("<f", data[20:24])[0] == pytest.approx(0.008)


def test_data_bytes(tmp_path):
    write_curves(tmp_path / "a.data", Curves.from_list([A, B]))
    assert (tmp_path / "a.data").read_bytes() == data_bytes(A, B)


def test_npz_arrays(tmp_path):
    write_curves(tmp_path / "a.npz", Curves.from_list([A, B]))
    with np.load(tmp_path / "a.npz") as arrays:
        assert set(arrays) == {"positions", "counts"}
        assert arrays["positions"].dtype == np.dtype("<f4")
        assert arrays["counts"].dtype == np.dtype("<i4")
        np.testing.assert_array_equal(arrays["positions"], [[*A, A[-1]], B])
        np.testing.assert_array_equal(arrays["counts"], [2, 3])


@pytest.mark.parametrize("bits", range(32))
def test_hair_with_any_combination_of_arrays(tmp_path, bits):
    path = tmp_path / "a.hair"
    points = A + A
    rest = sum(size * len(points) for bit, size in ((4, 4), (8, 4), (16, 12)) if bits & bit)
    path.write_bytes(hair_bytes([1, 1], points, arrays=bits, default=1, extra=b"\xff" * rest))
    if bits & 2:
        assert_same(read_curves(path), [A, A])
    else:
        with pytest.raises(ValueError, match=r"a\.hair.*array bits.*bit 1 \(points\) must be set"):
            read_curves(path)


def test_hair_segments_up_to_the_limit(tmp_path):
    longest = np.linspace(0, 1, 65536 * 3, dtype=np.float32).reshape(-1, 3)
    write_curves(tmp_path / "a.hair", Curves.from_list([longest, A]))
    assert_same(read_curves(tmp_path / "a.hair"), [longest, A])
    longer = Curves.from_list([A, np.zeros((65537, 3))])
    with pytest.raises(ValueError, match=r"strand 1 has 65536 segments.*at most 65535"):
        write_curves(tmp_path / "b.hair", longer)
    assert [p.name for p in tmp_path.iterdir()] == ["a.hair"]
    write_curves(tmp_path / "b.data", longer)


@pytest.mark.parametrize(
    "dtype", ["f2", "f4", "f8", ">f4", ">f8", "i1", "i4", "u2", ">i8", np.longdouble]
)
@pytest.mark.parametrize("order", ["C", "F"])
def test_npz_of_other_types(tmp_path, dtype, order):
    points = np.arange(24).reshape(2, 4, 3).astype(dtype, order=order)
    path = npz(tmp_path / "a.npz", positions=points, counts=np.array([4, 3], dtype=">u2"))
    assert_same(read_curves(path), [np.arange(12).reshape(4, 3), np.arange(12, 21).reshape(3, 3)])


def test_npz_without_counts_and_with_other_arrays(tmp_path):
    path = npz(tmp_path / "a.npz", positions=np.array([A, A]), times=np.zeros(3))
    assert_same(read_curves(path), [A, A])


def test_npz_of_frames_gives_the_last(tmp_path):
    frames = np.array([[A, A], [A[::-1], A]])
    assert_same(read_curves(npz(tmp_path / "a.npz", positions=frames)), [A[::-1], A])
    counted = npz(tmp_path / "b.npz", positions=np.array([[B, B]]), counts=[2, 3])
    assert_same(read_curves(counted), [B[:2], B])


def test_npz_beyond_the_counts_may_be_anything(tmp_path):
    points = np.full((1, 3, 3), np.nan, np.float32)
    points[0, :2] = A
    assert_same(read_curves(npz(tmp_path / "a.npz", positions=points, counts=[2])), [A])


# --- short strands


def short_file(path):
    """Strands of 2, 1 and 3 points, and where the format allows it one of none."""
    if path.suffix == ".hair":
        path.write_bytes(hair_bytes([1, 0, 2], [*A, (9, 9, 9), *B]))
    elif path.suffix == ".data":
        path.write_bytes(data_bytes(A, [(9, 9, 9)], B, []))
    elif path.suffix == ".abc":
        points = np.zeros((4, 3, 3), "<f4")
        points[0, :2], points[1, 0], points[2] = A, 9, B
        write_still(path, to_unit(points, 1.0, "y").astype("<f4"), np.array([2, 1, 3, 0]), unit=1.0)
    else:
        points = np.zeros((4, 3, 3))
        points[0, :2], points[1, 0], points[2] = A, 9, B
        npz(path, positions=points, counts=[2, 1, 3, 0])
    return path


@pytest.mark.parametrize("ending", ENDINGS)
def test_short_strands(tmp_path, ending):
    path = short_file(tmp_path / f"a{ending}")
    number = "1 of its 3" if ending == ".hair" else "2 of its 4"
    with pytest.raises(ValueError) as raised:
        read_curves(path)
    for word in (
        *(str(path), number, "fewer than 2 points", "strand 1, of 1"),
        *("at least 2", "skip_short=True"),
    ):
        assert word in str(raised.value)
    assert_same(read_curves(path, skip_short=True), [A, B])


@pytest.mark.parametrize("ending", ENDINGS)
def test_only_short_strands(tmp_path, ending):
    write_curves(tmp_path / f"a{ending}", Curves.from_list([[(1, 2, 3)]] * 3))
    with pytest.raises(ValueError, match="3 of its 3 strands"):
        read_curves(tmp_path / f"a{ending}")
    assert read_curves(tmp_path / f"a{ending}", skip_short=True).points.shape == (0, 0, 3)


def test_what_is_left_out_need_not_be_finite(tmp_path):
    (tmp_path / "a.data").write_bytes(data_bytes([(np.nan, 0, 0)], A))
    assert_same(read_curves(tmp_path / "a.data", skip_short=True), [A])


# --- refusals


@pytest.mark.parametrize("name", ["a.obj", "a", "a.hair.gz", "hair"])
def test_other_endings(tmp_path, name):
    for call in (
        lambda: read_curves(tmp_path / name),
        lambda: write_curves(tmp_path / name, Curves.from_list([A])),
    ):
        with pytest.raises(ValueError, match=r"ends in .*must end in one of \.hair, \.data, \.npz"):
            call()


@pytest.mark.parametrize("unit", [0, -1, np.nan, np.inf, 1e13, 1e-13, True, "cm", (), 1j])
def test_unit_is_checked(tmp_path, unit):
    with pytest.raises(ValueError, match=r"unit is .*; it must be"):
        read_curves(tmp_path / "a.hair", unit=unit)
    with pytest.raises(ValueError, match=r"unit is .*; it must be"):
        write_curves(tmp_path / "a.hair", Curves.from_list([A]), unit=unit)


@pytest.mark.parametrize("up", ["x", "Z", "", 1])
def test_up_is_checked(tmp_path, up):
    with pytest.raises(ValueError, match=r"up is .*one of 'y', 'z'"):
        read_curves(tmp_path / "a.hair", up=up)
    with pytest.raises(ValueError, match=r"up is .*one of 'y', 'z'"):
        write_curves(tmp_path / "a.hair", Curves.from_list([A]), up=up)


@pytest.mark.parametrize("ending", ENDINGS)
def test_missing_files_and_folders(tmp_path, ending):
    with pytest.raises(FileNotFoundError):
        read_curves(tmp_path / f"a{ending}")
    (tmp_path / f"a{ending}").mkdir()
    with pytest.raises(ValueError, match="cannot be read: it must be a regular file"):
        read_curves(tmp_path / f"a{ending}")


def written(path):
    write_curves(path, Curves.from_list([A, B]))
    return path.read_bytes()


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_truncation_is_refused(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    data = written(path)
    for size in range(len(data)):
        path.write_bytes(data[:size])
        with pytest.raises(ValueError) as raised:
            read_curves(path)
        assert str(path) in str(raised.value)
        assert "must" in str(raised.value)


@pytest.mark.parametrize("ending", [".hair", ".data"])
def test_bytes_after_the_end_are_refused(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    data = written(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(ValueError, match=f"has {len(data) + 1} bytes.*must have {len(data)}"):
        read_curves(path)


FOREIGN = [
    b"",
    b"\0" * 3,
    b"\xff" * 500,
    b"HAIR",
    b"HAIR" + b"\xff" * 500,
    b"PK\x03\x04" + b"\0" * 200,
    b"PK\x05\x06" + b"\0" * 18,
    b"PK\x05\x06" + b"\xff" * 18,
    b"\x89PNG\r\n\x1a\n" + bytes(range(256)),
    b"#usda 1.0\n" * 40,
]


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("data", FOREIGN)
def test_foreign_files_are_refused(tmp_path, ending, data):
    path = tmp_path / f"a{ending}"
    path.write_bytes(data)
    with pytest.raises(ValueError) as raised:
        read_curves(path)
    assert str(path) in str(raised.value)
    assert "must" in str(raised.value)


def read_or_refused(path):
    """Curves of the file, or None where it is refused as it should be."""
    try:
        return read_curves(path)
    except ValueError as error:
        refusal = str(error)
    assert str(path) in refusal
    assert "must" in refusal
    return None


@pytest.mark.parametrize("ending", ENDINGS)
def test_damaged_files_are_refused_or_read(tmp_path, ending):
    """Any change of bytes gives strands or a ValueError, never another exception or a warning."""
    path = tmp_path / f"a{ending}"
    data = written(path)
    rng = np.random.default_rng(1)
    changes = [(i, v) for i in range(len(data)) for v in (0, 1, 0x7F, 0xFF)]
    changes += [(int(i), int(v)) for i, v in rng.integers((len(data), 256), size=(1000, 2))]
    changes = changes[:: 5 if ending == ".abc" else 1]  # whose file is the longest
    for place, value in changes:
        changed = bytearray(data)
        changed[place] = value
        path.write_bytes(changed)
        curves = read_or_refused(path)
        assert curves is None or np.all(np.isfinite(curves.points))


@pytest.mark.parametrize("counts", [(2**32 - 1, 2**32 - 1), (2**32 - 1, 2), (1, 2**32 - 1)])
@pytest.mark.parametrize("default", [0, 1, 2**32 - 1])
@pytest.mark.parametrize("arrays", [2, 3, 31])
def test_huge_counts_in_hair(tmp_path, counts, default, arrays):
    (tmp_path / "a.hair").write_bytes(
        hair_bytes([1], A, arrays=arrays, default=default, counts=counts)
    )
    with pytest.raises(ValueError, match=r"a\.hair.*must"):
        read_curves(tmp_path / "a.hair")


def test_hair_counts_must_agree(tmp_path):
    path = tmp_path / "a.hair"
    path.write_bytes(hair_bytes([1, 2], A + A))
    with pytest.raises(ValueError, match=r"header has 4 points; .* must be 5"):
        read_curves(path)
    path.write_bytes(hair_bytes([1, 1], A + A, arrays=2, default=2))
    with pytest.raises(ValueError, match=r"header has 4 points; .* must be 6"):
        read_curves(path)
    path.write_bytes(hair_bytes([], [], arrays=2, default=2**32 - 1, counts=(2**32 - 1, 0)))
    with pytest.raises(ValueError, match=r"header has 0 points; .* must be"):
        read_curves(path)


@pytest.mark.parametrize("bits", [0x23, 0x80000003])
def test_hair_of_a_later_format(tmp_path, bits):
    (tmp_path / "a.hair").write_bytes(hair_bytes([1], A, arrays=bits))
    with pytest.raises(ValueError, match=f"array bits are {bits:#x}.*bits 5 to 31 must be 0"):
        read_curves(tmp_path / "a.hair")


@pytest.mark.parametrize("count", [-1, -(2**31), 3, 2**31 - 1])
def test_wrong_counts_in_data(tmp_path, count):
    path = tmp_path / "a.data"
    path.write_bytes(struct.pack("<i", count) + bytes(8))
    with pytest.raises(ValueError, match=f"number of strands is {count}.*from 0 to 2"):
        read_curves(path)
    path.write_bytes(data_bytes(A) + struct.pack("<i", count) + bytes(24))
    path.write_bytes(struct.pack("<i", 2) + path.read_bytes()[4:])
    with pytest.raises(ValueError, match=f"strand 1 has {count} points.*from 0 to 2"):
        read_curves(path)


def test_data_that_ends_between_strands(tmp_path):
    (tmp_path / "a.data").write_bytes(struct.pack("<i", 2) + data_bytes(A)[4:])
    with pytest.raises(ValueError, match=r"ends before strand 1.*hold 2 strands"):
        read_curves(tmp_path / "a.data")


@pytest.mark.parametrize("ending", ENDINGS)
def test_strands_too_uneven_to_pad(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    short, long = 20000, 30001
    if ending == ".hair":
        counts = np.array([1] * short + [long - 1], "<u2")
        total = 2 * short + long
        data = hair_bytes([], [], counts=(short + 1, total))
        path.write_bytes(data + counts.tobytes() + bytes(12 * total))
    elif ending == ".data":
        data = struct.pack("<i", short + 1) + (struct.pack("<i", 2) + bytes(24)) * short
        path.write_bytes(data + struct.pack("<i", long) + bytes(12 * long))
    else:
        pytest.skip("it is written from padded strands")
    with pytest.raises(ValueError, match=f"strand {short} has {long} points.*at most 100 times"):
        read_curves(path)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize(
    "value", [np.nan, np.inf, -np.inf, "signalling"], ids=["nan", "inf", "-inf", "signalling"]
)
def test_values_that_are_not_finite(tmp_path, ending, value):
    path = tmp_path / f"a{ending}"
    points = np.array([A, A, A], dtype="<f4")
    if value == "signalling":
        points.view("<u4")[1, 1, 2] = 0x7F800001
    else:
        points[1, 1, 2] = value
    if ending == ".npz":
        npz(path, positions=points)
    else:
        write_curves(path, Curves.from_list([A, A, A]), up="z")
        data = path.read_bytes()
        good, bad = np.array(A, "<f4").tobytes(), points[1].tobytes()
        first, rest = data.split(good, 1)
        path.write_bytes(first + good + rest.replace(good, bad, 1))
    with pytest.raises(ValueError) as raised:
        read_curves(path, up="z")
    for word in (str(path), "point 1 of strand 1 is [4.0, 5.0, ", "finite"):
        assert word in str(raised.value)


def test_npz_values_beyond_float64(tmp_path):
    path = npz(tmp_path / "a.npz", positions=np.full((1, 2, 3), 1e300))
    with pytest.raises(ValueError, match=r"a\.npz.*finite"):
        read_curves(path, unit=1e12)


@pytest.mark.parametrize(
    ("arrays", "words"),
    [
        ({"points": np.array([A])}, ["no array 'positions'"]),
        ({"positions": np.zeros((2, 3))}, ["positions", "(2, 3)", "(strands, points, 3)"]),
        ({"positions": np.zeros((1, 2, 2))}, ["(1, 2, 2)", "(frames, strands, points, 3)"]),
        ({"positions": np.zeros((1, 1, 1, 2, 3))}, ["(1, 1, 1, 2, 3)", "must have shape"]),
        ({"positions": np.float32(3)}, ["positions", "()", "must have shape"]),
        ({"positions": np.zeros((0, 1, 2, 3))}, ["(0, 1, 2, 3)", "at least one point and frame"]),
        ({"positions": np.zeros((5, 0, 3))}, ["(5, 0, 3)", "at least one point and frame"]),
        ({"positions": np.zeros((1, 2, 3), "U3")}, ["positions", "<U3", "real numbers"]),
        ({"positions": np.zeros((1, 2, 3), complex)}, ["positions", "complex", "real numbers"]),
        ({"positions": np.array([A]), "counts": [3]}, ["counts", "3 at 0", "from 0 to 2"]),
        ({"positions": np.array([A]), "counts": [-1]}, ["counts", "-1 at 0", "from 0 to 2"]),
        ({"positions": np.array([A]), "counts": [2, 2]}, ["counts", "(2,)", "(1,)"]),
        ({"positions": np.array([A]), "counts": [2.0]}, ["counts", "float64", "whole numbers"]),
        ({"positions": np.array([A], object)}, ["'positions'", "object", "run code"]),
    ],
)
def test_wrong_arrays_in_npz(tmp_path, arrays, words):
    path = npz(tmp_path / "a.npz", **arrays)
    with pytest.raises(ValueError) as raised:
        read_curves(path)
    for word in (str(path), *words):
        assert word in str(raised.value)


def npy(shape, *, descr="<f4", data=b"", version=1, header=None):
    """A .npy file with any header."""
    text = header or repr({"descr": descr, "fortran_order": False, "shape": shape})
    size = struct.pack("<H" if version == 1 else "<I", len(text))
    return b"\x93NUMPY" + bytes([version, 0]) + size + text.encode() + data


def zipped(path, entries, compression=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in entries.items():
            archive.writestr(name, data)
    return path


@pytest.mark.parametrize(
    "shape",
    [(2**40, 2**40, 3), (2**62, 4, 3), (10**30, 2, 3), (-1, 2, 3), (-1, -2, 3), (10**9, 2, 3)],
)
@pytest.mark.parametrize("version", [1, 2])
def test_huge_shapes_in_npz(tmp_path, shape, version):
    path = zipped(
        tmp_path / "a.npz", {"positions.npy": npy(shape, data=bytes(24), version=version)}
    )
    for read in (read_curves, read_arrays):
        with pytest.raises(ValueError, match=r"a\.npz: array 'positions'.*do not fit"):
            read(path)


@pytest.mark.parametrize(
    "shape", [(10**15, 0, 3), (0, 10**15, 3), (10**15, 0, 2, 3), (10**30, 0, 3), (0, 10**30, 3)]
)
def test_huge_shapes_without_bytes_in_npz(tmp_path, shape):
    path = zipped(tmp_path / "a.npz", {"positions.npy": npy(shape)})
    curves = read_or_refused(path)
    assert curves is None or len(curves.counts) == 0


@pytest.mark.parametrize(
    "entry",
    [
        b"",
        b"not an array",
        npy((1, 2, 3), data=bytes(23)),
        npy((1, 2, 3), data=bytes(25)),
        npy((1, 2, 3), data=bytes(24), version=3),
        npy((1, 2, 3), data=bytes(24), version=9),
        npy((1, 2, 3), descr="|O", data=bytes(48)),
        npy((1, 2, 3), descr=[("a", "<f4"), ("b", "|O")], data=bytes(72)),
        npy((1, 2, 3), descr="nonsense", data=bytes(24)),
        npy((1, 2, 3), header="{'descr': '<f4', 'fortran_order': False, 'shape': (1L,)}"),
        npy((1, 2, 3), header="(" * 9000),
        npy((1, 2, 3), header="-" * 9000 + "1"),
        npy((1, 2, 3), header="[" * 20000),
    ],
)
def test_entries_that_are_no_arrays_of_numbers(tmp_path, entry):
    path = zipped(tmp_path / "a.npz", {"positions.npy": entry})
    for read in (read_curves, read_arrays):
        with pytest.raises(
            ValueError, match=r"a\.npz: array 'positions' is not readable .*must be"
        ):
            read(path)


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions(tmp_path, compression):
    entry = npy((1, 2, 3), data=np.array([A], "<f4").tobytes())
    path = zipped(tmp_path / "a.npz", {"positions.npy": entry}, compression)
    with pytest.raises(ValueError, match=r"compression.*must be none or deflate"):
        read_curves(path)


def test_a_zip_that_claims_more_than_it_can_hold(tmp_path):
    path = zipped(tmp_path / "a.npz", {"positions.npy": npy((10**8, 1, 3), data=bytes(24))})
    data = path.read_bytes()
    size = len(npy((10**8, 1, 3))) + 24
    claimed = struct.pack("<I", len(npy((10**8, 1, 3))) + 12 * 10**8)
    path.write_bytes(data.replace(struct.pack("<I", size), claimed))
    with pytest.raises(ValueError, match="cannot hold"):
        read_curves(path)


def test_entries_that_overlap(tmp_path):
    entry = npy((1, 2, 3), data=np.array([A], "<f4").tobytes())
    path = tmp_path / "a.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("positions.npy", entry)
        for i in range(9):
            copy = zipfile.ZipInfo(f"{i}.npy")
            first = archive.infolist()[0]
            copy.header_offset = first.header_offset
            copy.CRC, copy.compress_size, copy.file_size = first.CRC, len(entry), len(entry)
            archive.filelist.append(copy)
    with pytest.raises(ValueError, match="entries overlap"):
        read_curves(path)


@pytest.mark.parametrize(
    "name", ["counts.hair", "segments.hair", "a.data", "size.npz", "shape.npz"]
)
def test_huge_counts_take_no_memory(tmp_path, name):
    path = tmp_path / name
    if name == "counts.hair":
        path.write_bytes(hair_bytes([1], A, counts=(2**31, 2**31)))
    elif name == "segments.hair":
        path.write_bytes(hair_bytes([], A, arrays=2, default=2**32 - 1, counts=(2**32 - 1, 2)))
    elif name == "a.data":
        path.write_bytes(struct.pack("<ii", 1, 2**31 - 1) + bytes(24))
    elif name == "size.npz":
        zipped(path, {"positions.npy": npy((10**8, 2, 3), data=bytes(24))})
    else:
        zipped(path, {"positions.npy": npy((10**15, 0, 3))})
    tracemalloc.start()
    try:
        with pytest.raises(ValueError):
            read_curves(path)
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_compressible_arrays_are_read(tmp_path):
    write_arrays(tmp_path / "a.npz", {"zeros": np.zeros((1000, 4000), np.float32)})
    assert (tmp_path / "a.npz").stat().st_size < 20_000
    assert read_arrays(tmp_path / "a.npz")["zeros"].shape == (1000, 4000)


# --- writing


@pytest.mark.parametrize("ending", ENDINGS)
def test_an_existing_file_is_kept(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    path.write_text("old")
    with pytest.raises(FileExistsError, match=f"a{ending} exists.*overwrite=True"):
        write_curves(path, Curves.from_list([A]))
    assert path.read_text() == "old"
    write_curves(path, Curves.from_list([A]), overwrite=True)
    assert_same(read_curves(path), [A])
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("ending", ENDINGS)
def test_the_folder_must_exist(tmp_path, ending):
    with pytest.raises(ValueError, match="existing folder"):
        write_curves(tmp_path / "missing" / f"a{ending}", Curves.from_list([A]))


@pytest.mark.parametrize("ending", ENDINGS)
def test_values_too_large_for_the_file(tmp_path, ending):
    for value, unit in ((1e39, 1), (3.5e38, 1), (1e30, 1e-9), (1e308, 1e-12)):
        curves = Curves.from_list([A, [(0, 0, 0), (0, -value, 0)]])
        with pytest.raises(ValueError, match=r"points has the value .* at \(1, 1, 1\).*float32"):
            write_curves(tmp_path / f"a{ending}", curves, unit=unit, up="z")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("existing", [False, True])
def test_an_interrupted_write_leaves_what_was_there(tmp_path, monkeypatch, ending, existing):
    path = tmp_path / f"a{ending}"
    if existing:
        path.write_text("old")

    def interrupted(*_):
        (partial,) = (p for p in tmp_path.iterdir() if p != path)
        assert partial.suffix == ending
        raise KeyboardInterrupt

    real = io.open

    def opened(file, mode="r", *args, **options):
        stream = real(file, mode, *args, **options)
        if "w" not in mode:
            return stream
        stream.close()
        return interrupted()

    monkeypatch.setattr(io, "open", opened)
    with pytest.raises(KeyboardInterrupt):
        write_curves(path, Curves.from_list([A]), overwrite=existing)
    monkeypatch.undo()
    assert list(tmp_path.iterdir()) == ([path] if existing else [])
    if existing:
        assert path.read_text() == "old"


# --- arrays

ARRAYS = {
    "positions": np.arange(24, dtype=np.float32).reshape(2, 4, 3),
    "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    "big": np.arange(3, dtype=">i8"),
    "flags": np.array([True, False]),
    "scalar": np.array(2.5),
    "complex": np.array([1 + 2j]),
    "names": np.array(["root", "先端"]),
    "bytes": np.array([b"ab", b"c"]),
    "none": np.zeros((0, 3)),
    "file": np.array(1),
    "allow_pickle": np.array(2),
    "a/b c": np.array(3),
    "毛髪": np.array(4),
}


def test_arrays_round_trip(tmp_path):
    write_arrays(tmp_path / "a.npz", ARRAYS)
    arrays = read_arrays(str(tmp_path / "a.npz"))
    assert list(arrays) == list(ARRAYS)
    with np.load(tmp_path / "a.npz") as loaded:
        for name, wanted in ARRAYS.items():
            np.testing.assert_array_equal(arrays[name], wanted)
            np.testing.assert_array_equal(loaded[name], wanted)
            assert arrays[name].dtype == wanted.dtype
            assert arrays[name].flags.writeable


def test_arrays_of_numpy_files_and_none(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.arange(3))
    np.testing.assert_array_equal(read_arrays(tmp_path / "a.npz")["a"], [0, 1, 2])
    write_arrays(tmp_path / "b.npz", {})
    assert read_arrays(tmp_path / "b.npz") == {}
    write_arrays(tmp_path / "c.npz", {"list": [1, 2], "number": 3.0})
    assert read_arrays(tmp_path / "c.npz")["list"].tolist() == [1, 2]


def test_every_truncation_of_arrays_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    write_arrays(path, {"a": np.arange(3)})
    data = path.read_bytes()
    for size in range(len(data)):
        path.write_bytes(data[:size])
        with pytest.raises(ValueError, match=r"a\.npz.*must be"):
            read_arrays(path)


@pytest.mark.parametrize("data", FOREIGN[:6])
def test_foreign_arrays_are_refused(tmp_path, data):
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(ValueError, match=r"a\.npz.*must be a complete \.npz file"):
        read_arrays(tmp_path / "a.npz")


def test_a_zip_of_other_things_is_refused(tmp_path):
    path = zipped(tmp_path / "a.npz", {"readme.txt": b"hello"})
    with pytest.raises(ValueError, match=r"a\.npz: array 'readme\.txt' is not readable"):
        read_arrays(path)


def test_write_arrays_refuses(tmp_path):
    for name in ("a.txt", "a", "a.npy"):
        with pytest.raises(ValueError, match=r"ends in .*ending in \.npz"):
            write_arrays(tmp_path / name, {})
    for key in ("", 3, "a\0b"):
        with pytest.raises(ValueError, match=r"array is named .*string"):
            write_arrays(tmp_path / "a.npz", {key: np.zeros(2)})
    for value in (None, np.array([{}]), [[1], [1, 2]], np.zeros(2, "V4"), np.array(0, "M8[s]")):
        with pytest.raises(ValueError, match=r"array 'a' .*must be an array"):
            write_arrays(tmp_path / "a.npz", {"a": value})
    assert list(tmp_path.iterdir()) == []


def test_write_arrays_keeps_an_existing_file(tmp_path):
    path = tmp_path / "a.npz"
    path.write_text("old")
    with pytest.raises(FileExistsError, match="exists"):
        write_arrays(path, {"a": 1})
    assert path.read_text() == "old"
    write_arrays(path, {"a": 1}, overwrite=True)
    assert read_arrays(path)["a"] == 1


def test_strands_as_they_are(tmp_path):
    """Empty strands, single points, NaN and very different lengths, which `read_curves` refuses."""
    longest = np.arange(3 * 4000, dtype="<f4").reshape(-1, 3)
    strands = [np.zeros((0, 3)), [[1, 2, 3]], A, [[1, np.nan, 3], [4, 5, np.inf]], longest]
    data, path = data_bytes(*strands), tmp_path / "a.data"
    path.write_bytes(data)
    found = read_strands(path, unit=0.01, up="y")
    assert len(found) == len(strands)
    for got, wanted in zip(found, strands, strict=True):
        x, y, z = np.reshape(wanted, (-1, 3)).T
        np.testing.assert_allclose(got, 0.01 * np.stack([x, -z, y], axis=1))
    with pytest.raises(ValueError, match="fewer than 2 points"):
        read_curves(path)
    path.write_bytes(data[:-1])
    with pytest.raises(ValueError, match=r"a\.data.*strand 4 has 4000 points"):
        read_strands(path)
    write_curves(tmp_path / "b.hair", Curves.from_list([]))
    assert read_strands(tmp_path / "b.hair") == []
