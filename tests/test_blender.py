"""Our USD and Alembic files in Blender itself, without a window, and its Alembic files in ours.

Skipped unless JAXHAIR_BLENDER_PYTHON names an interpreter that has the `bpy` wheel:

    python3.11 -m venv blender && blender/bin/pip install bpy==5.0.1
    JAXHAIR_BLENDER_PYTHON=blender/bin/python python -m pytest tests/test_blender.py

The wheel is of one version of Python, has 370 MB, and on Linux needs X11's libraries though it
opens no window: `apt-get install libxrender1 libxi6 libxkbcommon0 libsm6 libgl1 libxxf86vm1
libxfixes3`.
"""

import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import jaxhair as jh

BLENDER = os.environ.get("JAXHAIR_BLENDER_PYTHON")
CLIENT = Path(__file__).with_name("blender_client.py")
HAIR = Path(__file__).with_name("blender_hair.py")
pytestmark = pytest.mark.skipif(not BLENDER, reason="JAXHAIR_BLENDER_PYTHON is not set")
pytest.importorskip("pxr", reason="needs usd-core")

RATE = 10.0
TIMES = np.array([0.0, 0.1, 0.2, 0.225, 0.3, 0.4])
PHASES = ("", "fall", "fall", "fall", "rest", "rest")


def recording(counts: list[int] | None = None) -> jh.Recording:
    """Curls that sway while a ball passes; then there is a floor."""
    points = np.linspace(0.0, 1.0, 33)
    turn = 14 * points
    random = np.random.default_rng(0)
    roots = random.uniform(-0.05, 0.05, (40, 1, 3)) * [1.0, 1.0, 0.1]
    curl = 0.012 * np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1) * points[:, None] ** 0.5
    strands = roots + curl + points[:, None] * [0.0, 0.0, -0.2]
    sway = np.sin(8 * TIMES)[:, None, None, None] * points[:, None] ** 2 * [0.05, 0.0, 0.0]
    positions = (strands[None] + sway).astype(np.float32)
    fractions = np.ones((len(TIMES), 40, 31, 4))
    fractions[..., 0] = np.linspace(1.0, 0.0, 31)
    ball = jh.Sphere((-0.12, 0.0, -0.1), 0.03, velocity=(0.2, 0.0, 0.4))
    phases = (jh.Phase("fall", 0.225, (ball,)), jh.Phase("rest", 0.175, (jh.Floor(-0.22),)))
    hair = jh.Strands.from_points(positions[0], counts=counts)
    scene = jh.Scene(hair, phases=phases, dt=0.025)
    return jh.Recording(scene, TIMES, {"positions": positions, "fractions": fractions}, PHASES)


def blender(file: Path, folder: Path, *, picture: str = "") -> dict[str, Any]:
    """What it finds at the frames' time codes."""
    output = folder / "found.npz"
    codes = [repr(float(t)) for t in RATE * TIMES]
    command = [str(BLENDER), str(CLIENT), str(file), str(output), picture, *codes]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    with np.load(output) as arrays:
        return dict(arrays)


@pytest.mark.parametrize("basis", ["catmullRom", "bezier", "linear"])
@pytest.mark.parametrize("ragged", [False, True], ids=["equal", "ragged"])
def test_blender_has_our_positions(tmp_path: Path, basis: str, ragged: bool) -> None:
    """Of every frame bit for bit as float32, at fractional time codes too."""
    counts = [33, 20, 2, 3] * 10 if ragged else None
    of = recording(counts)
    jh.save(tmp_path / "hair.usdc", of, basis=basis)
    found = blender(tmp_path / "hair.usdc", tmp_path)
    used = of.scene.strands.counts
    assert found["counts"].tolist() == used.tolist()
    want = of.positions[:, np.arange(33) < used[:, None]]
    assert np.array_equal(found["positions"], want)
    assert found["radius"] == pytest.approx(40e-6)
    assert found["bonded"][:3] == pytest.approx([1.0, 1.0, 29 / 30])
    assert found["range"].tolist() == [0, 4]


def test_blender_has_units_and_axes(tmp_path: Path) -> None:
    """Centimetres and Y up become metres and Z up."""
    of = recording()
    jh.save(tmp_path / "hair.usdc", of, unit=0.01, up="y")
    found = blender(tmp_path / "hair.usdc", tmp_path)
    want = of.positions.reshape(len(TIMES), -1, 3)
    assert found["positions"] == pytest.approx(want, abs=1e-6)


def test_blender_has_colours_and_obstacles_and_draws(tmp_path: Path) -> None:
    """The ball where it is in its phase, and hair from red to blue.

    Blender 5.0 does not import samples of visibility: it shows both obstacles in all frames.
    """
    of = recording()
    jh.save(tmp_path / "hair.usdc", of, color_by="hydrogen", width=2e-3)
    picture = os.environ.get("JAXHAIR_BLENDER_PICTURE") or str(tmp_path / "hair.png")
    found = blender(tmp_path / "hair.usdc", tmp_path, picture=picture)
    assert found["meshes"].tolist() == ["Floor", "Sphere"]
    heights = found["heights"][:4, 1]
    assert heights == pytest.approx(-0.1 + 0.4 * TIMES[:4], abs=1e-6)
    root, tip = found["colors"][0][0], found["colors"][0][32]
    assert root[0] > 0.5 > root[2]
    assert tip[2] > 0.5 > tip[0]
    with Image.open(picture) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    red = (pixels[..., 0] - pixels[..., 2]) > 60
    blue = (pixels[..., 2] - pixels[..., 0]) > 60
    rows = np.arange(len(pixels))[:, None]
    assert min(red.sum(), blue.sum()) > 300
    assert np.mean(rows[red.any(1)]) < np.mean(rows[blue.any(1)])  # the roots are above


@pytest.mark.parametrize("basis", ["linear", "catmullRom"])
@pytest.mark.parametrize("ragged", [False, True], ids=["equal", "ragged"])
def test_blender_has_our_positions_of_alembic(tmp_path: Path, basis: str, ragged: bool) -> None:
    """Of every frame bit for bit as float32, at irregular times too, and Z up again."""
    counts = [33, 20, 2, 3] * 10 if ragged else None
    of = recording(counts)
    jh.save(tmp_path / "hair.abc", of, basis=basis)
    found = blender(tmp_path / "hair.abc", tmp_path)
    used = of.scene.strands.counts
    assert found["counts"].tolist() == used.tolist()
    assert np.array_equal(found["positions"], of.positions[:, np.arange(33) < used[:, None]])
    assert found["radius"] == pytest.approx(40e-6)
    assert found["range"].tolist() == [0, 4]


def test_blender_has_regular_frames_and_still_strands(tmp_path: Path) -> None:
    """At a constant rate from the start; and one frame at all times."""
    of = recording()
    chosen = [0, 1, 2, 4, 5]
    observed = {name: values[chosen] for name, values in of.observed.items()}
    regular = jh.Recording(of.scene, TIMES[chosen], observed, tuple(PHASES[i] for i in chosen))
    jh.save(tmp_path / "hair.abc", regular, unit=0.01)
    found = blender(tmp_path / "hair.abc", tmp_path)
    want = 100 * of.positions.reshape(len(TIMES), -1, 3)
    assert found["positions"][chosen] == pytest.approx(want[chosen], abs=1e-5)
    assert found["radius"] == pytest.approx(40e-4)
    still = jh.Curves.from_list(
        [of.positions[0, 0], of.positions[0, 1, :1], of.positions[0, 2, :9]]
    )
    jh.write_curves(tmp_path / "still.abc", still)
    found = blender(tmp_path / "still.abc", tmp_path)
    assert found["counts"].tolist() == [33, 1, 9]
    for points in found["positions"]:
        assert np.array_equal(points, np.concatenate(still.to_list()).astype(np.float32))


def test_we_read_what_blender_writes_of_our_hair(tmp_path: Path) -> None:
    """USD into Blender, and out of it as Alembic: its whole frames."""
    of = recording([33, 20, 2, 3] * 10)
    jh.save(tmp_path / "hair.usdc", of)
    blender(tmp_path / "hair.usdc", tmp_path, picture=str(tmp_path / "out.abc"))
    for frame, ours in enumerate([0, 1, 2, 4, 5]):
        curves = jh.read_curves(tmp_path / "out.abc", frame=frame)
        assert curves.counts.tolist() == of.scene.strands.counts.tolist()
        for found, want in zip(curves.to_list(), of.positions[ours], strict=True):
            assert found == pytest.approx(want[: len(found)], abs=1e-6)


@pytest.mark.parametrize("kind", ["CATMULL_ROM", "POLY", "BEZIER", "NURBS"])
def test_we_read_blenders_own_hair(tmp_path: Path, kind: str) -> None:
    """Curves of each kind below objects that are turned, scaled and moved; no NURBS."""
    command = [
        str(BLENDER),
        str(HAIR),
        kind,
        str(tmp_path / "hair.abc"),
        str(tmp_path / "hair.npy"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    if kind == "NURBS":
        with pytest.raises(ValueError, match=r"strands' is not readable: its type is 'NURBS'"):
            jh.read_strands(tmp_path / "hair.abc")
        return
    for frame, want in enumerate(np.load(tmp_path / "hair.npy")):
        found = jh.read_strands(tmp_path / "hair.abc", frame=frame)
        assert [len(strand) for strand in found] == [5, 7]
        # Blender's matrices are of float32, here with entries up to 10
        assert np.concatenate(found) == pytest.approx(want, abs=1e-5)
