"""The viewer's page: what it holds, read back by other code than that which wrote it."""

import base64
import html
import json
import math
import zlib
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fitting
import jaxhair as jh
from jaxhair.__main__ import main
from jaxhair.export import COLORS
from jaxhair.strands import BONDS
from jaxhair.viewer import Viewer
from jaxhair.viewer_data import curvature, strain

DT = 0.1
BAD_NAME = "</script><script>alert(1)</script><!--"


def scene(counts: list[int] | None = None, name: str = "fall") -> jh.Scene:
    """A ball falls for two steps, and then there is a floor for one."""
    line = np.linspace([0.0, 0.0, 0.3], [0.03, 0.0, 0.2], 5)
    hair = jh.Strands.from_points(np.stack([line, line + [0.0, 0.05, 0.0]]), counts=counts)
    ball = jh.Sphere((0.0, 0.0, 0.1), 0.02, velocity=(0.0, 0.0, -0.2))
    floor = jh.Floor(-0.05)
    phases = (jh.Phase(name, 2 * DT, (jh.Hold(), ball)), jh.Phase("rest", DT, (jh.Hold(), floor)))
    return jh.Scene(hair, phases=phases, dt=DT)


def recording(counts: list[int] | None = None, name: str = "fall") -> jh.Recording:
    """Four frames in which the hair bends and stretches and hydrogen bonds break."""
    of = scene(counts, name)
    start = np.asarray(of.strands.positions)
    shift = np.random.default_rng(0).normal(0, 0.01, (4, *start.shape))
    shift[0] = 0
    fractions = np.ones((4, 2, 3, 4))
    fractions[..., 0] = np.array([1.0, 0.7, 0.3, 0.0])[:, None, None]
    observed = {"positions": start[None] + shift, "fractions": fractions}
    return jh.Recording(of, DT * np.arange(4), observed, ("", name, name, "rest"))


def large(frames: int, noise: float = 0.0) -> jh.Recording:
    """200 strands of 17 points whose curls wind up, each on its own way, and bonds that break one
    by one. With noise [m] of each coordinate, which no compression can shorten."""
    rng = np.random.default_rng(0)
    roots = rng.uniform(-0.1, 0.1, (200, 3)) + [0.0, 0.0, 0.5]
    hair = jh.Strands.straight(roots, (0.0, 0.0, -1.0), length=0.4, points=17)
    along = np.linspace(0, 1, 17)
    time = np.linspace(0, 1, frames)[:, None, None]
    angle = rng.uniform(15, 24, (1, 200, 1)) * along + time * rng.uniform(0, 6, (1, 200, 1))
    wide = 0.02 * time * along
    points = np.stack(
        [wide * np.cos(angle), wide * np.sin(angle), -0.4 * along * (1 - 0.3 * time) + 0 * angle],
        -1,
    )
    points = points + roots[None, :, None] + noise * rng.normal(size=points.shape)
    fractions = rng.uniform(0, 1, (frames, 200, 15, 4))
    observed = {"positions": points, "fractions": fractions}
    of = jh.Scene(hair, phases=(jh.Phase("curl", 2.0, (jh.Hold(),)),))
    return jh.Recording(of, np.linspace(0, 2, frames), observed, ("",) + ("curl",) * (frames - 1))


class Scripts(HTMLParser):
    """Texts of the elements of a page: scripts by their id, and attributes of an iframe."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.scripts: list[tuple[str | None, str]] = []
        self.frame: dict[str, str | None] = {}
        self.inside: str | None = None
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.inside = tag
        if tag == "script":
            self.scripts.append((dict(attrs).get("id"), ""))
        if tag == "iframe":
            self.frame = dict(attrs)

    def handle_endtag(self, tag: str) -> None:
        self.inside = None

    def handle_data(self, data: str) -> None:
        if self.inside == "script":
            name, text = self.scripts[-1]
            self.scripts[-1] = (name, text + data)


def read(page: str) -> dict[str, Any]:
    """The header of a page, its arrays, the points [m] and the values of each field."""
    scripts = dict(Scripts(page).scripts)
    of: dict[str, Any] = json.loads(scripts["header"])
    data = zlib.decompress(base64.b64decode(scripts["data"], validate=True))
    arrays = {}
    for entry in of["arrays"]:
        kind, count = np.dtype(entry["type"]).newbyteorder("<"), math.prod(entry["shape"])
        found = np.frombuffer(data, kind, count, entry["offset"])
        arrays[entry["name"]] = found.reshape(entry["shape"])
    added = arrays["positions_low"] + 256 * arrays["positions_high"].astype(np.int64)
    whole = np.cumsum(added, 0) % 65536
    of["positions"] = np.array(of["origin"]) + of["low"] + np.array(of["step"]) * whole
    of["values"] = {}
    for name, about in of["fields"].items():
        levels = np.cumsum(arrays[name].astype(np.int64), 0) % 256
        of["values"][name] = about["low"] + levels / 255 * (about["high"] - about["low"])
    of["arrays"] = arrays
    return of


def half_a_step(points: np.ndarray) -> np.ndarray:
    """The stated error of a coordinate [m]."""
    return np.asarray((np.ptp(points, axis=(0, 1, 2)) / 65535 / 2) * (1 + 1e-6) + 1e-15)


def test_points_are_read_back_within_half_a_step() -> None:
    of = recording()
    found = read(jh.view(of).page)
    error = np.abs(found["positions"] - of.positions)
    assert np.all(error <= half_a_step(of.positions))
    assert error.max() > 0
    assert found["times"] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert found["phases"] == ["", "fall", "fall", "rest"]
    assert found["arrays"]["counts"].tolist() == [5, 5]


def test_hair_far_from_the_origin_is_as_exact() -> None:
    of = recording()
    moved = of.positions + np.array([100.0, -50.0, 7.0])
    far = jh.Recording(of.scene, of.times, of.observed | {"positions": moved}, of.phases)
    error = np.abs(read(jh.view(far).page)["positions"] - moved)
    assert np.all(error <= half_a_step(of.positions) + 1e-13)


def test_values_are_read_back_within_a_colour() -> None:
    """Fractions exactly in range; strain and curvature up to the ends of the bar."""
    of = recording()
    found = read(jh.view(of).page)
    assert set(found["values"]) == set(COLORS)
    for kind, name in enumerate(BONDS):
        assert np.abs(found["values"][name] - of.fractions[..., kind]).max() <= 0.5 / 255 + 1e-12
    edges = np.linalg.norm(np.diff(of.positions, axis=2), axis=-1)
    exact = {
        "strain": edges / np.asarray(of.scene.strands.lengths) - 1,
        "curvature": np.asarray(fitting.measures.curvature(of.positions)),
    }
    for name, values in exact.items():
        low, high = found["fields"][name]["low"], found["fields"][name]["high"]
        error = np.abs(found["values"][name] - np.clip(values, low, high))
        assert error.max() <= 0.5 * (high - low) / 255 * (1 + 1e-9)
        assert np.mean((values >= low) & (values <= high)) >= 0.9
    assert found["fields"]["strain"]["low"] == -found["fields"]["strain"]["high"]


def test_curvature_and_strain_of_a_circle() -> None:
    """1 / radius, but for the angle's difference from its chord; and no strain."""
    angle = np.linspace(0, 3, 61)
    circle = 0.02 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    assert curvature(circle) == pytest.approx(50.0, rel=2e-4)
    lengths = np.linalg.norm(np.diff(circle, axis=0), axis=-1)
    assert strain(1.1 * circle[None], lengths[None]) == pytest.approx(0.1)


def test_strands_of_different_lengths_end_where_they_end() -> None:
    """What is past a tip is the tip, whatever the recording has there."""
    of = recording([5, 3])
    wild = np.array(of.positions)
    wild[:, 1, 3:] = 1e3
    found = read(
        jh.view(jh.Recording(of.scene, of.times, of.observed | {"positions": wild}, of.phases)).page
    )
    assert found["arrays"]["counts"].tolist() == [5, 3]
    assert np.all(np.ptp(found["positions"][:, 1, 2:], axis=1) == 0)
    used = wild[:, 1, :3]
    assert np.abs(found["positions"][:, 1, :3] - used).max() < 1e-5
    assert np.all(np.abs(found["values"]["strain"][:, 1, 2:]) < 0.005)
    assert np.all(found["values"]["curvature"][:, 1, 1:] == 0)


def test_hairs_are_those_of_pictures() -> None:
    """Every strand itself first, then the hairs between."""
    found = read(jh.view(recording(), hairs_per_strand=3).page)
    rows = found["arrays"]["hairs"]
    assert rows[:, 0].tolist() == [0, 1, 0, 1, 0, 1]
    assert np.all(rows[:2, 3:8] == 0)
    assert np.all(np.any(rows[2:, 5:8] != 0, axis=1))
    assert read(jh.view(large(2)).page)["arrays"]["hairs"].shape == (2000, 11)


def test_obstacles_are_there_in_their_phases_where_they_are() -> None:
    """A ball at the start and while it falls, its shape stored once; then the floor."""
    found = read(jh.view(recording()).page)
    places = found["obstacles"]
    assert [[shape for shape, *_ in frame] for frame in places] == [[0], [0], [0], [1]]
    heights = [frame[0][3] + found["origin"][2] for frame in places]
    assert heights == pytest.approx([0.1, 0.08, 0.06, -0.05], abs=1e-6)
    ball = found["arrays"]["shape0_vertices"]
    assert np.linalg.norm(ball, axis=-1) == pytest.approx(0.02, abs=1e-6)
    assert found["arrays"]["shape0_triangles"].max() < len(ball)
    assert "shape2_vertices" not in found["arrays"]


def test_names_cannot_leave_their_place(tmp_path: Path) -> None:
    """A phase's name is text, whatever is in it."""
    of = recording(name=BAD_NAME)
    page = jh.view(of).page
    assert BAD_NAME not in page
    names = [name for name, _ in Scripts(page).scripts]
    assert names == ["header", "data", None]
    assert read(page)["phases"] == ["", BAD_NAME, BAD_NAME, "rest"]
    inner = Scripts(jh.view(of)._repr_html_()).frame["srcdoc"]
    assert inner == page


def test_a_notebook_gets_a_frame_of_its_own() -> None:
    found = jh.view(recording(), height=333)
    shown = found._repr_html_()
    assert shown.count("<") == 2  # the iframe and its end
    frame = Scripts(shown).frame
    assert frame["sandbox"] == "allow-scripts"
    assert "333px" in str(frame["style"])
    assert html.unescape(str(frame["srcdoc"])) == found.page
    assert "MB" in repr(found)
    assert len(repr(found)) < 200


def test_the_page_asks_for_nothing() -> None:
    """No address of another place, and a policy that forbids to ask."""
    page = jh.view(recording()).page
    assert "http:" not in page
    assert "https:" not in page
    assert "default-src 'none'" in page


def test_size_of_200_strands_in_60_frames() -> None:
    """Below 4 MB even where nothing can be compressed."""
    for noise in (0.0, 0.01):
        assert len(jh.view(large(60, noise))._repr_html_()) < 4e6


def test_frames_are_left_out_with_a_word() -> None:
    """The first and last are kept; those between at even distances."""
    of = large(60)
    whole = len(jh.view(of)._repr_html_()) / 1e6
    with pytest.warns(UserWarning, match=r"of 60 frames.*max_megabytes is 1"):
        less = jh.view(of, max_megabytes=1.0)
    assert len(less._repr_html_()) <= 1e6 < whole * 1e6
    found = read(less.page)
    kept = len(found["times"])
    assert 10 < kept < 60
    assert (found["times"][0], found["times"][-1]) == (0.0, 2.0)
    gaps = np.diff(found["times"]) / (2 / 59)
    assert np.ptp(np.round(gaps)) <= 1
    assert found["note"].startswith(f"{kept} of 60 frames")
    assert less.note == found["note"]
    assert found["note"] in repr(less)
    with pytest.raises(ValueError, match=r"max_megabytes is 0.01; .* at least 0\.\d+"):
        jh.view(of, max_megabytes=0.01)


def test_one_frame_may_be_left() -> None:
    """The one that is asked for."""
    of = large(60)
    enough = 1.05 * len(jh.view(large(1))._repr_html_()) / 1e6
    with pytest.warns(UserWarning, match="1 of 60 frames"):
        found = read(jh.view(of, frame=30, max_megabytes=enough).page)
    assert found["times"] == pytest.approx([60 / 59], abs=1e-6)


def test_a_strand_of_two_points_is_shown() -> None:
    """It has no bonds, none of them cut, and no bend."""
    hair = jh.Strands.straight([[0.0, 0.0, 0.0]], (0.0, 0.0, -1.0), length=0.1, points=2)
    observed = {
        "positions": np.asarray(hair.positions)[None],
        "fractions": np.zeros((1, 1, 0, 4)),
    }
    of = jh.Recording(jh.Scene(hair), np.zeros(1), observed, ("",))
    found = read(jh.view(of, color_by="ionic").page)
    assert found["values"]["ionic"].tolist() == [[[1.0]]]
    assert found["values"]["curvature"].tolist() == [[[0.0]]]
    assert found["colorBy"] == "ionic"


def test_bonds_that_were_not_recorded_are_not_offered() -> None:
    of = recording()
    less = jh.Recording(of.scene, of.times, {"positions": of.positions}, of.phases)
    assert set(read(jh.view(less).page)["values"]) == {"strain", "curvature"}
    with pytest.raises(ValueError, match="color_by is 'ionic'; it must be one of 'strain'"):
        jh.view(less, color_by="ionic")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"color_by": "metal"}, ["color_by", "'metal'", "curvature"]),
        ({"frame": 4}, ["frame", "4", "at most 3"]),
        ({"hairs_per_strand": 0}, ["hairs_per_strand", "0", "at least 1"]),
        ({"view": 3}, ["view", "3", "View"]),
        ({"color": (2.0, 0.0, 0.0)}, ["color", "2.0", "[0, 1]"]),
        ({"seed": -1}, ["seed", "-1"]),
        ({"height": 5}, ["height", "5", "100"]),
        ({"max_megabytes": 0}, ["max_megabytes", "0"]),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ValueError) as error:
        jh.view(recording(), **options)
    for word in words:
        assert word in str(error.value)


def test_recordings_that_cannot_be_shown_are_refused() -> None:
    of = recording()

    def changed(**parts: Any) -> jh.Recording:
        return jh.Recording(of.scene, of.times, of.observed | parts, of.phases)

    spoilt = np.array(of.positions)
    spoilt[1, 0, 2, 0] = np.nan
    for wrong, words in (
        (jh.Recording(of.scene, of.times, of.positions, of.phases), "observed"),
        (changed(positions=spoilt), r"positions.*nan at \(1, 0, 2, 0\)"),
        (changed(positions=of.positions[:0]), r"positions has shape \(0, 2, 5, 3\)"),
        (changed(fractions=of.fractions[:, :1]), "fractions has shape"),
        (jh.Recording(of.scene, of.times[:3], of.observed, of.phases), "times has shape"),
        (jh.Recording(of.scene, of.times, of.observed, of.phases[:3]), "phases has 3"),
    ):
        with pytest.raises(ValueError, match=words):
            jh.view(wrong)
    with pytest.raises(ValueError, match="recording"):
        jh.view(np.zeros((2, 2, 3)))  # type: ignore[arg-type]


def test_save_writes_the_page(tmp_path: Path) -> None:
    """With the options of `view`."""
    path = tmp_path / "a.html"
    jh.save(path, recording(), color_by="strain", frame=1, hairs_per_strand=2)
    found = read(path.read_text(encoding="utf-8"))
    assert (found["colorBy"], found["frame"]) == ("strain", 1)
    assert len(found["arrays"]["hairs"]) == 4
    assert isinstance(jh.view(recording()), Viewer)
    with pytest.raises(ValueError, match="color_by is 'strain'"):
        jh.save(tmp_path / "a.png", recording(), color_by="strain")
    assert [p.name for p in tmp_path.iterdir()] == ["a.html"]


def test_the_command_line_writes_the_page(tmp_path: Path) -> None:
    command = "simulate perm --prepared --no-contact --strands 2 --points 9 --length 24cm"
    more = "--seconds 0.1 --quiet --color-by curvature --output"
    path = tmp_path / "perm.html"
    assert main([*command.split(), *more.split(), str(path)]) == 0
    assert read(path.read_text(encoding="utf-8"))["colorBy"] == "curvature"


def test_the_command_line_refuses_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "perm.png"
    assert main(["simulate", "perm", "--color-by", "strain", "--output", str(path)]) == 2
    assert "color_by is 'strain'" in capsys.readouterr().err
