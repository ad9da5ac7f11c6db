"""Both command lines: what they write and print, and how they refuse."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import jaxhair as jh
from fitting.__main__ import main as fit_main
from jaxhair.__main__ import main as simulate_main
from jaxhair.options import length

PERM = (
    "simulate perm --prepared --no-contact --strands 2 --points 9 --length 24cm "
    "--rod-diameter 7cm --seconds 0.1 --quiet --output"
)


def curls(path: Path) -> Path:
    """One helix of 25 mm in a file."""
    angle = np.linspace(0, 9, 40)
    x = np.stack([12.5e-3 * np.cos(angle), 12.5e-3 * np.sin(angle), 1e-3 * angle], 1)
    jh.write_curves(path, jh.Curves.from_list([x]))
    return path


def test_simulate_writes_arrays(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "perm.npz"
    assert simulate_main([*PERM.split(), str(path)]) == 0
    assert "perm.npz" in capsys.readouterr().out
    with np.load(path) as arrays:
        assert arrays["positions"].shape[1:] == (2, 9, 3)
        assert np.all(np.isfinite(arrays["positions"]))
        assert arrays["fractions"].shape[1:] == (2, 7, 4)
        assert len(arrays["times"]) == len(arrays["positions"])
        assert arrays["parameter:fibre.peeling_rate"] == pytest.approx(0.33)


@pytest.mark.parametrize(
    ("more", "solver", "physical"),
    [
        ("--solver paper --substeps 2", jh.PositionBased(substeps=2), False),
        (
            "--solver compliant --iterations 3 --sweep sequential",
            jh.Compliant(iterations=3, sweep="sequential"),
            True,
        ),
        ("--solver direct --newton-steps 2", jh.Direct(newton_steps=2), True),
    ],
)
def test_simulate_with_another_solver(
    more: str, solver: object, physical: bool, tmp_path: Path
) -> None:
    path = tmp_path / "perm.npz"
    assert simulate_main([*PERM.split(), str(path), *more.split()]) == 0
    with np.load(path) as arrays:
        assert np.all(np.isfinite(arrays["positions"]))
        assert ("parameter:fibre.young_modulus" in arrays.files) == physical
        assert str(solver) in str(arrays["scene"])


def test_simulate_in_a_process_of_its_own(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "jaxhair", *PERM.split(), str(tmp_path / "perm.hair")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert jh.read_curves(tmp_path / "perm.hair").points.shape == (2, 9, 3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--output", "OUT/x.xyz"], ["x.xyz", ".npz"]),
        (["--output", "OUT/there.npz"], ["there.npz", "exists", "--overwrite"]),
        (["--output", "OUT/nowhere/x.npz"], ["nowhere", "existing folder"]),
        (["--output", "OUT/x.npz", "--seconds", "0"], ["seconds", "above 0"]),
        (["--output", "OUT/x.npz", "--strands", "0"], ["strands", "at least 1"]),
        (["--output", "OUT/x.npz", "--iterations", "0"], ["iterations", "at least 1"]),
        (["--output", "OUT/x.npz", "--rod-diameter", "2cm"], ["--rod-diameter", "bed-hair"]),
        (["--output", "OUT/x.npz", "--steps-per-second", "0"], ["--steps-per-second"]),
        (["--output", "OUT/x.npz", "--substeps", "0"], ["substeps", "at least 1"]),
        (["--output", "OUT/x.npz", "--newton-steps", "2"], ["--newton-steps", "direct"]),
        (
            ["--output", "OUT/x.npz", "--solver", "direct", "--iterations", "5"],
            ["--iterations", "paper or compliant"],
        ),
        (
            ["--output", "OUT/x.npz", "--solver", "direct", "--sweep", "red-black"],
            ["--sweep", "paper or compliant"],
        ),
        (
            ["--output", "OUT/x.npz", "--solver", "direct", "--newton-steps", "0"],
            ["--newton-steps", "at least 1"],
        ),
    ],
)
def test_simulate_refuses(
    arguments: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "there.npz").write_bytes(b"mine")
    filled = [a.replace("OUT", str(tmp_path)) for a in arguments]
    assert simulate_main(["simulate", "bed-hair", "--quiet", *filled]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error
    assert [p.name for p in tmp_path.iterdir()] == ["there.npz"]
    assert (tmp_path / "there.npz").read_bytes() == b"mine"


def test_lengths() -> None:
    assert length("17mm") == pytest.approx(17e-3)
    assert length("24 cm") == pytest.approx(0.24)
    assert length("0.5") == 0.5


def test_fit_of_strands_writes_report_strands_and_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target, folder = curls(tmp_path / "a.hair"), tmp_path / "fitted"
    arguments = ["--target", f"permed={target}", "--points", "15", "--output", str(folder)]
    assert fit_main(arguments) == 0
    printed = capsys.readouterr().out
    assert "bonds.influence[hydrogen]" in printed
    assert "do not determine" in printed
    report = json.loads((folder / "fit.json").read_text(encoding="utf-8"))
    names = {f"bonds.influence[{kind}]" for kind in jh.BONDS} | {"fibre.peeling_rate"}
    assert set(report["parameters"]) == names
    assert all(isinstance(p["value"], float) for p in report["parameters"].values())
    assert report["residual_mm"] < 1
    assert report["converged"] is True
    assert report["undetermined"]
    assert report["settings"]["method"] == "levenberg-marquardt"
    assert report["versions"]["jax"]
    files = {"fit.json", "fit.png", "fitted-permed.hair"}
    assert {p.name for p in folder.iterdir()} == files
    before = (folder / "fit.json").read_bytes()
    assert fit_main(arguments) == 2
    assert "exists" in capsys.readouterr().err
    assert (folder / "fit.json").read_bytes() == before


@pytest.mark.parametrize(
    ("target", "words"),
    [
        (["OUT/missing.hair"], ["missing.hair"]),
        (["OUT/foreign.hair"], ["foreign.hair"]),
        (["OUT/short.hair"], ["short.hair"]),
        (["OUT/bad.toml"], ["bad.toml"]),
        (["dyed=OUT/a.hair"], ["'dyed'", "permed"]),
        (["permed=OUT/a.hair", "permed=OUT/a.hair"], ["'permed'", "twice"]),
    ],
)
def test_fit_refuses(
    target: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = curls(tmp_path / "a.hair").read_bytes()
    (tmp_path / "foreign.hair").write_bytes(b"not hair at all" * 20)
    (tmp_path / "short.hair").write_bytes(whole[:-5])
    (tmp_path / "bad.toml").write_text("[[[", encoding="utf-8")
    filled = [t.replace("OUT", str(tmp_path)) for t in target]
    assert fit_main(["--target", *filled, "--output", str(tmp_path / "fitted")]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error
    assert not (tmp_path / "fitted").exists()
