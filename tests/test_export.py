"""Saving a recording: arrays, strands, pictures and movies."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import jaxhair as jh
from jaxhair.arrays import read_arrays
from jaxhair.export import ENDINGS, STRAND_FILES, check_drawing, meshes

FLOAT32 = 1e-7  # m, what writing strands in float32 may lose
EXACT = 1e-12
DT = 0.1
SPEED, RADIUS = -0.2, 0.02  # of the ball
SMALL: dict[str, Any] = {"size": (64, 64), "hairs_per_strand": 1, "scale_bar": False}
DRAWN = (".png", ".gif", ".mp4")


def scene(counts: list[int] | None = None) -> jh.Scene:
    """A ball falls for two steps, and then there is a floor for one."""
    line = np.linspace([0.0, 0.0, 0.3], [0.03, 0.0, 0.2], 5)
    hair = jh.Strands.from_points(np.stack([line, line + [0.0, 0.05, 0.0]]), counts=counts)
    ball = jh.Sphere((0.0, 0.0, 0.1), RADIUS, velocity=(0.0, 0.0, SPEED))
    return jh.Scene(
        hair,
        phases=(
            jh.Phase("fall", 2 * DT, (jh.Hold(), ball)),
            jh.Phase("rest", DT, (jh.Hold(), jh.Floor(-0.05))),
        ),
        dt=DT,
    )


def recording(counts: list[int] | None = None) -> jh.Recording:
    """Four frames in which the hair moves along x and hydrogen bonds break."""
    of = scene(counts)
    start = np.asarray(of.strands.positions)
    shift = np.arange(4)[:, None, None, None] * np.array([0.01, 0.0, 0.0])
    fractions = np.ones((4, 2, 3, 4))
    fractions[..., 0] = np.array([1.0, 0.7, 0.3, 0.0])[:, None, None]
    observed = {"positions": start[None] + shift, "fractions": fractions}
    return jh.Recording(of, DT * np.arange(4), observed, ("", "fall", "fall", "rest"))


def save(path: Path, of: jh.Recording | None = None, **options: Any) -> None:
    """Saves, with tiny pictures."""
    drawing = SMALL if path.suffix.lower() in DRAWN else {}
    jh.save(path, recording() if of is None else of, **{**drawing, **options})


def test_npz_has_every_array(tmp_path: Path) -> None:
    """The names, shapes and contents that the documentation lists."""
    save(tmp_path / "a.npz")
    arrays, of = read_arrays(tmp_path / "a.npz"), recording()
    assert np.array_equal(arrays["positions"], of.positions)
    assert np.array_equal(arrays["fractions"], of.fractions)
    assert arrays["positions"].shape == (4, 2, 5, 3)
    assert arrays["fractions"].shape == (4, 2, 3, 4)
    assert arrays["times"] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert arrays["phases"].tolist() == ["", "fall", "fall", "rest"]
    assert arrays["counts"].tolist() == [5, 5]
    assert arrays["bonds"].tolist() == ["hydrogen", "ionic", "disulfide", "peptide"]
    assert str(arrays["scene"]) == str(of.scene)


def test_npz_has_every_number_of_the_scene(tmp_path: Path) -> None:
    """Each leaf by its name, so that the scene can be made again."""
    save(tmp_path / "a.npz")
    arrays = read_arrays(tmp_path / "a.npz")
    leaves = jh.named_leaves(scene())
    stored = {n.removeprefix("parameter:"): a for n, a in arrays.items() if "parameter:" in n}
    assert stored.keys() == leaves.keys()
    for name, leaf in leaves.items():
        assert np.array_equal(stored[name], np.asarray(leaf)), name
    assert stored["phases.fall.Sphere.radius"] == RADIUS


@pytest.mark.parametrize("ending", [".hair", ".data", ".npz", ".HAIR"])
def test_the_last_frames_strands_are_read_back(tmp_path: Path, ending: str) -> None:
    """In metres and as they stand."""
    path = tmp_path / f"a{ending}"
    save(path)
    curves = jh.read_curves(path)
    assert curves.counts.tolist() == [5, 5]
    assert np.abs(curves.points - recording().positions[-1]).max() < FLOAT32


@pytest.mark.parametrize("ending", STRAND_FILES)
def test_strands_are_in_the_unit_and_axes_asked_for(tmp_path: Path, ending: str) -> None:
    """Written so, and not as if nothing had been said."""
    path = tmp_path / f"a{ending}"
    save(path, unit=0.01, up="y")
    want = recording().positions[-1]
    found = jh.read_curves(path, unit=1.0, up="z").points
    turned = want[..., [0, 2, 1]] * [100.0, 100.0, -100.0]
    assert np.abs(found - turned).max() < 100 * FLOAT32
    assert np.abs(jh.read_curves(path, unit=0.01, up="y").points - want).max() < FLOAT32


@pytest.mark.parametrize("ending", ENDINGS)
def test_options_that_a_format_does_not_have_are_refused(tmp_path: Path, ending: str) -> None:
    """Whatever the format."""
    with pytest.raises(TypeError, match="untit"):
        save(tmp_path / f"a{ending}", untit=0.01)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("frame", [0, 2, -1, -4])
def test_any_frame_can_be_chosen(tmp_path: Path, frame: int) -> None:
    """Counted from the start or from the end."""
    save(tmp_path / "a.data", frame=frame)
    points = jh.read_curves(tmp_path / "a.data").points
    assert np.abs(points - recording().positions[frame]).max() < FLOAT32


@pytest.mark.parametrize("ending", [".hair", ".data", ".npz"])
def test_strands_of_different_lengths_keep_their_counts(tmp_path: Path, ending: str) -> None:
    """No padding is written as hair."""
    path = tmp_path / f"a{ending}"
    save(path, recording([5, 3]))
    assert jh.read_curves(path).counts.tolist() == [5, 3]


@pytest.mark.parametrize("ending", [".png", ".gif", ".mp4"])
@pytest.mark.parametrize("counts", [None, [5, 3]], ids=["equal", "ragged"])
def test_pictures_and_movies_are_drawn(
    tmp_path: Path, ending: str, counts: list[int] | None
) -> None:
    """Of the asked size, and not empty."""
    path = tmp_path / f"a{ending}"
    save(path, recording(counts), color_by="hydrogen")
    if ending == ".mp4":
        data = path.read_bytes()
        assert data[4:8] == b"ftyp"
        assert len(data) > 1000
        return
    with Image.open(path) as image:
        assert image.size == (64, 64)
        assert getattr(image, "n_frames", 1) == (1 if ending == ".png" else 4)
        assert np.ptp(np.asarray(image.convert("L"))) > 50
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_bonds_are_shown_from_blue_to_red(tmp_path: Path) -> None:
    """Red where hydrogen bonds are whole, in the first frame, and blue in the last."""
    redness = []
    for frame in (0, -1):
        path = tmp_path / f"{frame}.png"
        save(path, frame=frame, color_by="hydrogen", hairs_per_strand=20)
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB")).astype(int)
        difference = (pixels[..., 0] - pixels[..., 2]).ravel()
        redness.append(difference[np.argmax(np.abs(difference))])
    assert redness[0] > 50
    assert redness[1] < -50


def test_strands_without_inner_points_can_be_coloured(tmp_path: Path) -> None:
    """Two points have no bonds between them."""
    hair = jh.Strands.straight([[0.0, 0.0, 0.0]], (0.0, 0.0, -1.0), length=0.1, points=2)
    observed = {
        "positions": np.asarray(hair.positions)[None],
        "fractions": np.zeros((1, 1, 0, 4)),
    }
    of = jh.Recording(jh.Scene(hair), np.zeros(1), observed, ("",))
    for ending in (".png", ".gif"):
        save(tmp_path / f"a{ending}", of, color_by="ionic")
        assert (tmp_path / f"a{ending}").stat().st_size > 100


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("a.xyz", {}, ["a.xyz", *ENDINGS]),
        ("npz", {}, ["'", "npz"]),
        ("a.npz", {"color_by": "metal"}, ["color_by", "'metal'", "hydrogen"]),
        ("a.npz", {"frame": 4}, ["frame", "4", "at most 3"]),
        ("a.hair", {"frame": -5}, ["frame", "-5", "-4"]),
        ("a.hair", {"frame": 0.5}, ["frame", "0.5", "whole"]),
        ("a.png", {"size": (3, 3)}, ["size", "3", "16"]),
        ("a.mp4", {"size": (65, 65)}, ["size", "65", "even"]),
        ("no/a.npz", {}, ["existing folder"]),
    ],
)
def test_wrong_requests_leave_nothing(
    tmp_path: Path, name: str, options: dict[str, Any], words: list[str]
) -> None:
    """Each names what is wrong and what is allowed."""
    with pytest.raises(ValueError) as error:
        save(tmp_path / name, **options)
    for word in words:
        assert word in str(error.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", ENDINGS)
def test_an_existing_file_is_kept_unless_told(tmp_path: Path, ending: str) -> None:
    """Byte for byte."""
    path = tmp_path / f"a{ending}"
    path.write_bytes(b"mine")
    with pytest.raises(FileExistsError, match="overwrite"):
        save(path)
    assert path.read_bytes() == b"mine"
    save(path, overwrite=True)
    assert path.stat().st_size > 100
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("phase", "time", "height"),
    [("", 0.0, 0.1), ("fall", 0.1, 0.08), ("fall", 0.2, 0.06), ("rest", 0.3, -0.05)],
)
def test_obstacles_stand_where_they_are_at_a_time(phase: str, time: float, height: float) -> None:
    """The ball on its way, each phase's time from its own start."""
    ((vertices, triangles),) = meshes(scene(), phase, time)
    assert (vertices[:, 2].max() + vertices[:, 2].min()) / 2 == pytest.approx(height, abs=EXACT)
    assert triangles.max() < len(vertices)
    if phase != "rest":
        distance = np.linalg.norm(vertices - [0.0, 0.0, height], axis=1)
        assert distance == pytest.approx(RADIUS)


def test_obstacles_move_with_their_phase_not_with_the_scene() -> None:
    """A ball that sets off in the second phase starts from its centre there."""
    ball = jh.Sphere((0.0, 0.0, 1.0), RADIUS, velocity=(1.0, 0.0, 0.0))
    late = scene().then(jh.Phase("late", DT, (ball,)))
    ((vertices, _),) = meshes(late, "late", 4 * DT)
    assert (vertices[:, 0].max() + vertices[:, 0].min()) / 2 == pytest.approx(DT, abs=EXACT)
    assert meshes(late, "no such phase", 0.0) == []


@pytest.mark.parametrize(
    ("path", "size", "words"),
    [("a.png", 15, ["size", "15", "16"]), ("a.mp4", 65, ["65", "even"])],
)
def test_drawing_is_checked_before_the_work(path: str, size: int, words: list[str]) -> None:
    """What a simulation would be lost for is said before it."""
    with pytest.raises(ValueError) as error:
        check_drawing(path, size)
    for word in words:
        assert word in str(error.value)


def test_missing_packages_are_named_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures need an extra; arrays and strands do not."""

    def no_packages(name: str) -> Callable[[], None]:
        raise ImportError(name)

    monkeypatch.setattr("jaxhair.extras.importlib.import_module", no_packages)
    with pytest.raises(ImportError, match=r"jaxhair\[pictures\]"):
        check_drawing("a.gif", 64)
    check_drawing("a.npz", 1)
    check_drawing("a.hair", 1)
