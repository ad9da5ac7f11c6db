"""Natural strands from files on disk: what the command finds, writes, refuses and goes on from."""

import json
import platform
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from natural_head import FAULTS, STYLES, head

import fitting
import jaxhair as jh
from fitting.__main__ import main
from fitting.clamped import rooted
from fitting.polylines import cleaned, evenly
from jaxhair.checkpoints import Checkpoints

CURLS = [5e-3 * np.stack([np.cos(a) - 1, np.sin(a), -a], 1) for a in [np.linspace(0, 9, 60)] * 3]


def report(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "natural.json").read_text(encoding="utf-8"))
    return found


def rms_mm(one: np.ndarray, other: np.ndarray) -> float:
    return float(1e3 * np.sqrt(np.mean(np.sum((one - other) ** 2, axis=-1))))


def test_a_head_of_hanging_strands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Good strands are fitted, the others listed; residuals are those of the files written."""
    monkeypatch.setattr("jaxhair.progress.SECONDS", 0.0)  # between two lines
    made, kinds = head(200, seed=4, faults=0.08, longest=0.08)
    assert {*kinds} == {*STYLES, *FAULTS}
    assert len({len(x) for x in made}) > 20
    path, folder = tmp_path / "head.hair", tmp_path / "fitted"
    jh.write_curves(path, jh.Curves.from_list(made))
    command = ["natural", str(path), "--points", "33", "--output", str(folder)]
    assert main(command) == 0
    printed, told = capsys.readouterr()
    found = report(folder)

    reasons = {row["strand"]: row["reason"] for row in found["not_fitted"]}
    words = {"one point": "1 points, fewer than 3", "one place": "no length", "tangle": "degrees"}
    assert reasons.keys() == {i for i, kind in enumerate(kinds) if kind in words}
    for i, reason in reasons.items():
        assert words[kinds[i]] in reason
    first = min(reasons)
    assert f"strand {first}: {reasons[first]}\n" in printed
    assert f"{len(made) - len(reasons)} of 200 strands fitted" in printed
    assert "shapes to remember, at most: " in told
    assert " s left, residual " in told

    rows = found["each"]
    assert [row["strand"] for row in rows] == list(range(200))
    fitted = [row for row in rows if row["reason"] is None]
    assert [row["place_in_hair_files"] for row in fitted] == list(range(len(fitted)))
    curves = {n: jh.read_curves(folder / f"{n}.hair").points for n in ("natural", "remembered")}
    for row in fitted:
        given = cleaned(made[row["strand"]].astype(np.float32))
        assert not isinstance(given, str)
        seen = evenly([given], 33)[0][0]
        simulated = curves["natural"][row["place_in_hair_files"]]
        assert rms_mm(simulated, seen) == pytest.approx(row["residual_mm"], abs=2e-4)
        assert row["residual_mm"] / row["length"] == pytest.approx(1e3 * row["residual_of_length"])
        assert row["residual_of_length"] < 0.01
    residuals = [row["residual_mm"] for row in fitted]
    assert found["residual_mm"] == pytest.approx(np.quantile(residuals, found["shares"]))
    assert f"100% {max(residuals):.3g}\n" in printed

    # weight draws hair down from what it remembers
    assert np.mean(curves["remembered"][:, -1, 2] > curves["natural"][:, -1, 2]) > 0.95
    remembered = fitting.measures.curl(curves["remembered"])
    assert [row["remembered_curvature"] for row in fitted] == pytest.approx(
        np.asarray(remembered.curvature), rel=0.02, abs=0.5
    )
    assert (folder / "natural.png").stat().st_size > 10_000
    assert len(list(folder.iterdir())) == 4

    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    assert main(command) == 2
    assert "exists" in capsys.readouterr().err
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before


def test_a_data_file_in_its_own_unit_and_axes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With a strand of no point and one that is not finite, which `read_curves` refuses."""
    made, _ = head(40, seed=2, faults=0.0, longest=0.06)
    made[3], made[7] = np.zeros((0, 3)), np.array([[0, 0, 0], [np.nan, 0, 0], [0, 0, 1.0]])
    in_file = [100 * x[:, [0, 2, 1]] * [1, 1, -1] for x in made]  # centimetres, Y up
    data = struct.pack("<i", len(made))
    for x in in_file:
        data += struct.pack("<i", len(x)) + x.astype("<f4").tobytes()
    path, folder = tmp_path / "head.data", tmp_path / "fitted"
    path.write_bytes(data)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    command = "--unit cm --up y --no-weight --points 33 --quiet --output"
    assert main(["natural", str(path), *command.split(), str(folder)]) == 0
    said = capsys.readouterr().err
    assert "no picture: pictures need matplotlib" in said
    assert report(folder)["versions"]["python"] == platform.python_version()
    assert "simulation" not in said
    assert {p.name for p in folder.iterdir()} == {
        "natural.json", "natural.hair", "remembered.hair"
    }  # fmt: skip
    found = report(folder)
    assert found["not_fitted"] == [
        {"strand": 3, "reason": "0 points, fewer than 3"},
        {"strand": 7, "reason": "not finite"},
    ]
    written = jh.read_curves(folder / "natural.hair").points
    good = [x for i, x in enumerate(in_file) if i not in (3, 7)]
    assert len(written) == len(good)
    for simulated, given in zip(written, good, strict=True):
        assert rms_mm(simulated, evenly([given], 33)[0][0]) < 10  # of a hundredth of a mm


@pytest.mark.slow
def test_hanging_and_unloaded_files_show_hydrogen_and_wear(tmp_path: Path) -> None:
    """Of strands simulated with numbers of their own."""
    start = fitting.natural(CURLS, unloaded=CURLS, points=17, seconds=1.5)
    influence = np.array([[0.5, 0.2, 0.2, 0.1], [0.2, 0.3, 0.3, 0.2], [0.35, 0.3, 0.2, 0.15]])
    rates = np.array([3.0, 6.0, 4.0])
    fibre = replace(start.scene.fibre, peeling_rate=rates)
    ends = jh.run(replace(start.scene, bonds=jh.Bonds(influence), fibre=fibre))
    for name in ("natural", "unloaded"):
        points = rooted(np.asarray(ends[name].points))
        jh.write_curves(tmp_path / f"{name}.hair", jh.Curves.from_list(points), unit=0.01)
    command = ["natural", str(tmp_path / "natural.hair"), "--points", "17", "--unit", "cm"]
    command += ["--unloaded", str(tmp_path / "unloaded.hair"), "--output", str(tmp_path / "out")]
    assert main(command) == 0
    rows = report(tmp_path / "out")["each"]
    assert [row["reason"] for row in rows] == [None] * 3
    assert [row["bonds.influence[hydrogen]"] for row in rows] == pytest.approx(
        influence[:, 0], abs=0.02
    )
    for row, rate in zip(rows, rates, strict=True):
        off = row["fibre.peeling_rate"] - rate
        assert abs(off) < max(3 * row["fibre.peeling_rate error"], 0.1 * rate)
        assert row["residual_mm"] < 0.1
        for name in ("bonds.influence[hydrogen]", "fibre.peeling_rate"):
            low, high = row[f"{name} interval"]
            assert low < row[name] < high
    assert len(jh.read_curves(tmp_path / "out" / "unloaded.hair").counts) == 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.hair"], ["nowhere.hair"]),
        (["curls.txt"], ["curls.txt", ".hair"]),
        (["half.hair"], ["half.hair", "bytes"]),
        (["points.hair"], ["no strand that can be simulated", "strand 0", "fewer than 3"]),
        (["curls.hair", "--strands", "0"], ["--strands", "0", "at least 1"]),
        (["curls.hair", "--points", "3"], ["--points", "3", "at least 4"]),
        (["curls.hair", "--no-weight", "--unloaded", "curls.hair"], ["--no-weight", "--unloaded"]),
        (["curls.hair", "--unloaded", "points.hair"], ["3 strands", "1 unloaded"]),
        (["curls.hair", "--output", "curls.hair"], ["curls.hair"]),
        (["curls.hair", "--output", "full"], ["natural.png", "exists", "--overwrite"]),
    ],
)
def test_mistakes(
    arguments: list[str],
    words: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    jh.write_curves("curls.hair", jh.Curves.from_list(CURLS))
    jh.write_curves("points.hair", jh.Curves.from_list([[[0.0, 0.0, 0.0]]]))
    Path("half.hair").write_bytes(Path("curls.hair").read_bytes()[:300])
    Path("full").mkdir()
    Path("full/natural.png").write_bytes(b"mine")
    before = {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()}
    output = [] if "--output" in arguments else ["--output", "out"]
    assert main(["natural", *arguments, *output]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error
    assert {p: p.read_bytes() for p in Path().rglob("*") if p.is_file()} == before


@pytest.mark.slow
def test_ctrl_c_and_going_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Interrupted while it is found out how stiff strands are, and in the fit: no output, and the
    same numbers as without."""
    made, _ = head(12, seed=1, faults=0.0, longest=0.08)
    path, kept = tmp_path / "head.hair", tmp_path / "kept"
    jh.write_curves(path, jh.Curves.from_list(made))
    command = ["natural", str(path), "--points", "33", "--output"]
    assert main([*command, str(tmp_path / "whole")]) == 0
    command += [str(tmp_path / "out"), "--checkpoint", str(kept)]
    capsys.readouterr()
    true = Checkpoints.add

    def interrupted(name: str) -> Any:
        def add(self: Checkpoints, *arguments: Any, **more: Any) -> None:
            true(self, *arguments, **more)
            if self.folder.name == name:
                raise KeyboardInterrupt

        return add

    for name in ("stiffness", "fit"):
        with monkeypatch.context() as patch:
            patch.setattr(Checkpoints, "add", interrupted(name))
            assert main(command) == 130
        last = capsys.readouterr().err.splitlines()[-1]
        assert last == f"interrupted; the same command goes on from {kept}"
        assert len(list((kept / name).iterdir())) == 1
        assert not list((tmp_path / "out").iterdir())
    assert main(command) == 0
    for name in ("natural.hair", "remembered.hair"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    one, other = (report(tmp_path / name) for name in ("out", "whole"))
    assert one["each"] == other["each"]
    command[command.index("--points") + 1] = "32"
    assert main([*command, "--overwrite"]) == 2
    assert "other work" in capsys.readouterr().err
