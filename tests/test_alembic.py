"""Alembic files that are written: every frame, what readers look for, and the bytes' own order.

Blender reads them in test_blender.py.
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_export import recording

import jaxhair as jh
from jaxhair.__main__ import main
from jaxhair.alembic.archive_reading import Archive
from jaxhair.alembic.archive_writing import ACYCLIC, TYPES
from jaxhair.alembic.headers import Header

BASES = ("linear", "catmullRom")
FLOAT32 = 1e-7
DATA = 1 << 63


def wavy(counts: list[int] | None = None, **options: Any) -> jh.Recording:
    """The recording of test_export with coordinates that are float32 numbers of any kind."""
    of = recording(counts)
    positions = np.random.default_rng(0).normal(size=of.positions.shape).astype(np.float32)
    fractions = np.random.default_rng(1).uniform(size=of.fractions.shape)
    chosen: dict[str, Any] = {"scene": of.scene, "times": of.times, "phases": of.phases}
    chosen |= {"observed": {"positions": positions, "fractions": fractions}} | options
    return jh.Recording(**chosen)


def rows(of: jh.Recording, values: NDArray[Any]) -> NDArray[Any]:
    """All points' values, without the padding, shape (frames, all points, ...)."""
    return values[:, np.arange(values.shape[2]) < of.scene.strands.counts[:, None]]


class File:
    """What is in a file, by our reading of its bytes."""

    def __init__(self, path: Path) -> None:
        self.archive = Archive(path.read_bytes())
        self.objects = self.archive.objects()
        _, xform, curves = (self.archive.properties(o.properties) for o in self.objects)
        self.xform = self.archive.compound(xform, ".xform")
        self.groom = self.archive.compound(self.xform, ".arbGeomParams")
        self.curves = self.archive.compound(curves, ".geom")
        self.parameters = self.archive.compound(self.curves, ".arbGeomParams")

    def value(self, properties: dict[str, Header], name: str, time: float = 0.0) -> Any:
        """Values of a sample; each only once from one file."""
        header = properties[name]
        return self.archive.sample(properties, name, TYPES[header.type], header.extent, time)


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("counts", [None, [5, 3], [2, 5]], ids=["equal", "ragged", "two points"])
@pytest.mark.parametrize("frame", [0, 2, -1])
def test_every_frame_is_read_back_exactly(
    tmp_path: Path, basis: str, counts: list[int] | None, frame: int
) -> None:
    """Float32 numbers bit for bit, with the strands' numbers of points."""
    of = wavy(counts)
    jh.save(tmp_path / "a.abc", of, basis=basis)
    curves = jh.read_curves(tmp_path / "a.abc", frame=frame)
    used = of.scene.strands.counts
    assert curves.counts.tolist() == used.tolist()
    for found, want, n in zip(curves.to_list(), of.positions[frame], used, strict=True):
        assert np.array_equal(found, want[:n])
    with pytest.raises(ValueError, match=r"frame is 4; of the 4 frames .* from -4 to 3"):
        jh.read_curves(tmp_path / "a.abc", frame=4)


def test_another_unit_and_axis(tmp_path: Path) -> None:
    """A file in centimetres and Z up, for those who know it, is the same hair."""
    of = wavy()
    jh.save(tmp_path / "a.abc", of, unit=0.01, up="z")
    found = jh.read_curves(tmp_path / "a.abc", frame=2, unit=0.01, up="z").points
    assert found == pytest.approx(of.positions[2], abs=1e-6)
    file = File(tmp_path / "a.abc")
    assert file.value(file.curves, "P", 0.2) == pytest.approx(rows(of, of.positions)[2] / 0.01)
    assert file.value(file.curves, "width") == pytest.approx(80e-6 / 0.01)


def test_regular_frames_have_a_rate_and_others_times(tmp_path: Path) -> None:
    """A phase that ends between two frames has its own time."""
    jh.save(tmp_path / "a.abc", wavy())
    file = File(tmp_path / "a.abc")
    assert file.archive.times(1, 4) == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert file.archive._samplings[1][0] == pytest.approx(0.1)
    times = [0.0, 1 / 30, 2 / 30, 0.075]
    of = wavy(times=np.array(times))
    jh.save(tmp_path / "b.abc", of)
    file = File(tmp_path / "b.abc")
    assert file.archive.times(1, 4).tolist() == times
    assert file.archive._samplings[1][0] == ACYCLIC
    for frame in range(4):
        found = jh.read_curves(tmp_path / "b.abc", frame=frame).points
        assert np.array_equal(found, of.positions[frame])


def test_a_recording_of_one_frame_and_one_where_nothing_moves(tmp_path: Path) -> None:
    """Frames are as many as were recorded, and what is the same is stored once."""
    of = wavy()
    positions, fractions = (of.observed[name][:1] for name in ("positions", "fractions"))
    one = jh.Recording(
        of.scene, np.array([0.5]), {"positions": positions, "fractions": fractions}, ("",)
    )
    jh.save(tmp_path / "one.abc", one)
    assert np.array_equal(jh.read_curves(tmp_path / "one.abc").points, positions[0])
    still = {name: np.repeat(value[:1], 4, 0) for name, value in of.observed.items()}
    jh.save(tmp_path / "still.abc", wavy(observed=still))
    assert np.array_equal(jh.read_curves(tmp_path / "still.abc", frame=3).points, positions[0])
    sizes = [(tmp_path / name).stat().st_size for name in ("one.abc", "still.abc")]
    assert sizes[1] == sizes[0]


def test_bonds_colours_and_widths_are_of_each_point(tmp_path: Path) -> None:
    """Ends have their neighbours' bonds; two points have none between them."""
    of = wavy([5, 3])
    jh.save(tmp_path / "a.abc", of, color_by="ionic", width=1e-3)
    file = File(tmp_path / "a.abc")
    assert [*file.parameters] == ["groom_id", *(f"bonded_{b}" for b in jh.BONDS), "groom_color"]
    for kind, name in enumerate(jh.BONDS):
        want = of.fractions[1, ..., kind].astype(np.float32)
        a, b = want[0], want[1, 0]
        found = file.value(file.parameters, f"bonded_{name}", 0.1)
        assert np.array_equal(found[:, 0], [a[0], *a, a[-1], b, b, b])
    colors = file.value(file.parameters, "groom_color", 0.1)
    assert colors.shape == (8, 3)
    assert np.ptp(colors) > 0.1
    assert file.value(file.curves, "width").shape == (8, 1)
    assert file.value(file.parameters, "groom_id")[:, 0].tolist() == [0, 1]


def test_unreal_finds_what_it_looks_for(tmp_path: Path) -> None:
    """Versions as int16 on the topmost transform, and strands that are not guides."""
    jh.save(tmp_path / "a.abc", wavy())
    file = File(tmp_path / "a.abc")
    assert [o.name for o in file.objects] == ["", "hair", "strands"]
    assert [o.schema for o in file.objects[1:]] == ["AbcGeom_Xform_v3", "AbcGeom_Curve_v2"]
    assert [*file.groom] == ["groom_version_major", "groom_version_minor", "groom_tool"]
    assert file.value(file.groom, "groom_version_major").tolist() == [[1]]
    assert file.value(file.groom, "groom_version_minor").tolist() == [[5]]
    assert TYPES[file.groom["groom_version_minor"].type] == "<i2"
    assert b"jaxhair" in (tmp_path / "a.abc").read_bytes()
    assert not {"groom_guide", "groom_width"} & file.parameters.keys()


@pytest.mark.parametrize("basis", BASES)
def test_the_bounds_hold_the_hair(tmp_path: Path, basis: str) -> None:
    """With half a width around, in the file's axes."""
    of = wavy([5, 3])
    jh.save(tmp_path / "a.abc", of, basis=basis, up="z", width=0.5)
    file = File(tmp_path / "a.abc")
    box = file.value(file.curves, ".selfBnds", 0.2).reshape(2, 3)
    points = rows(of, of.positions)[2].astype(float)
    assert np.all(box[0] <= points.min(0) - 0.25 + FLOAT32)
    assert np.all(box[1] >= points.max(0) + 0.25 - FLOAT32)
    if basis == "linear":
        assert box == pytest.approx(np.stack([points.min(0) - 0.25, points.max(0) + 0.25]))


@pytest.mark.parametrize("still", [False, True])
def test_groups_and_data_fill_the_file_without_overlap(tmp_path: Path, still: bool) -> None:
    """Every byte belongs to one group or data, and what is inside stands before it."""
    path = tmp_path / "a.abc"
    if still:
        jh.write_curves(path, jh.Curves.from_list([np.eye(3), np.eye(3)[:1]]))
    else:
        jh.save(path, wavy([5, 3]), color_by="ionic")
    data = path.read_bytes()
    assert data[:8] == b"Ogawa\xff\x00\x01"
    (root,) = struct.unpack_from("<Q", data, 8)
    ends = {0: 16}  # of what begins at a place
    waiting = [root]
    while waiting:
        reference = waiting.pop()
        place = reference & ~DATA
        if place == 0:
            continue
        (count,) = struct.unpack_from("<Q", data, place)
        if reference & DATA:
            ends[place] = place + 8 + count
            continue
        ends[place] = place + 8 + 8 * count
        children = struct.unpack_from(f"<{count}Q", data, place + 8)
        assert all(child & ~DATA < place for child in children)
        waiting += children
    assert sorted(ends)[1:] == sorted(ends.values())[:-1]
    assert max(ends.values()) == len(data)


def test_equal_samples_have_equal_keys_and_others_not(tmp_path: Path) -> None:
    """Readers keep samples by their keys."""
    of = wavy()
    of.observed["positions"][2] = of.observed["positions"][0]
    jh.save(tmp_path / "a.abc", of, up="z")
    data = (tmp_path / "a.abc").read_bytes()
    places = [data.count(frame.tobytes()) for frame in rows(of, of.positions)]
    assert places == [1, 1, 1, 1]
    keys = {data[data.index(p := frame.tobytes()) - 16 :][:16] for frame in rows(of, of.positions)}
    assert p
    assert len(keys) == 3
    assert np.array_equal(
        jh.read_curves(tmp_path / "a.abc", frame=2, up="z").points, of.positions[0]
    )


def test_the_same_recording_gives_the_same_bytes(tmp_path: Path) -> None:
    """No clock and no chance is in them."""
    for name in ("a.abc", "b.abc"):
        jh.save(tmp_path / name, wavy())
    assert (tmp_path / "a.abc").read_bytes() == (tmp_path / "b.abc").read_bytes()


@pytest.mark.parametrize("sizes", [(), (1,), (1, 2, 9)])
def test_strands_that_stand_still(tmp_path: Path, sizes: tuple[int, ...]) -> None:
    """None, of one point, and of several."""
    random = np.random.default_rng(0)
    strands = [random.normal(size=(n, 3)).astype(np.float32) for n in sizes]
    jh.write_curves(tmp_path / "a.abc", jh.Curves.from_list(strands))
    found = jh.read_strands(tmp_path / "a.abc")
    assert len(found) == len(sizes)
    for a, b in zip(found, strands, strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"basis": "bezier"}, ["basis", "'bezier'", "'linear', 'catmullRom'"]),
        ({"width": 0.0}, ["width", "0.0"]),
        ({"unit": 0.0}, ["unit", "0.0", "1e-12"]),
        ({"up": "x"}, ["up", "'x'", "'y', 'z'"]),
        ({"color_by": "metal"}, ["color_by", "'metal'", "hydrogen"]),
    ],
)
def test_wrong_options_leave_nothing(
    tmp_path: Path, options: dict[str, Any], words: list[str]
) -> None:
    """In words."""
    with pytest.raises(ValueError) as error:
        jh.save(tmp_path / "a.abc", wavy(), **options)
    for word in words:
        assert word in str(error.value)
    assert list(tmp_path.iterdir()) == []


def test_the_command_writes_alembic(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`python -m jaxhair simulate perm --unit cm --output perm.abc`."""
    path = tmp_path / "perm.abc"
    size = ["--strands", "2", "--points", "17", "--no-contact", "--seconds", "0.1"]
    command = ["simulate", "perm", "--prepared", *size, "--quiet", "--unit", "cm"]
    assert main([*command, "--output", str(path)]) == 0
    found = jh.read_curves(path, unit=0.01)
    assert len(found.counts) == 2
    edges = np.linalg.norm(np.diff(found.points, axis=1), axis=-1)
    assert edges.sum(1) == pytest.approx(0.48, rel=0.05)
    assert capsys.readouterr().err == ""
    assert main([*command, "--output", str(tmp_path / "perm.png")]) == 2
    assert "--unit is given for a .png file" in capsys.readouterr().err
