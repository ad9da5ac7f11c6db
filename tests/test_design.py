"""Designs of curls against the closed form D = D_rod / S, and in a finer simulation."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fitting
from fitting.__main__ import main

FRESH = 0.33 + 0.30 + 0.2 * 0.20  # table 1: S after a perm that leaves 80 % of the disulfide bonds
FINER = 0.03


@cache
def of_25_mm() -> fitting.Design:
    return fitting.design(fitting.Wish(25e-3, length=0.12))


def test_the_rod_is_that_of_the_closed_form_and_of_a_finer_simulation() -> None:
    found = of_25_mm()
    assert found.met
    assert found.rod_diameter == pytest.approx(FRESH * 25e-3, rel=1e-3)
    assert found.disulfide_left == pytest.approx(0.8)
    assert found.curl_diameter == pytest.approx(25e-3, rel=1e-3)
    assert found.finer_curl_diameter == pytest.approx(25e-3, rel=FINER)


def test_how_the_rod_changes_with_the_hair() -> None:
    """dS / S for f_j 10 % larger, with S = (f_H + f_I + 0.2 f_S) / sum f."""
    found = of_25_mm()
    kinds = zip(
        ("hydrogen", "ionic", "disulfide", "peptide"),
        (0.33, 0.30, 0.20, 0.17),
        (1.0, 1.0, 0.2, 0.0),
        strict=True,
    )
    for kind, f, part in kinds:
        change = 0.1 * f * (part - FRESH) / FRESH * found.rod_diameter
        named = found.sensitivities[f"bonds.influence[{kind}]"]
        assert named == pytest.approx(change, rel=0.02, abs=1e-6)
    assert found.rod_error == pytest.approx(
        np.sqrt(sum(x**2 for x in found.sensitivities.values()))
    )


@pytest.mark.slow
def test_a_curl_with_a_number_of_waves() -> None:
    """1.5 turns of 30 mm in 20 cm of hair rise by sqrt((L / 1.5)^2 - (pi D)^2) each."""
    found = fitting.design(fitting.Wish(30e-3, waves=1.5, after_wash=True), verify=False)
    assert found.waves == pytest.approx(1.5, rel=0.02)
    assert found.curl_diameter == pytest.approx(30e-3, rel=2e-3)
    pitch = np.sqrt((0.2 / 1.5) ** 2 - (np.pi * 30e-3) ** 2)
    assert abs(np.tan(found.climb)) == pytest.approx(pitch / (np.pi * 30e-3), rel=0.05)


def test_a_curl_that_cannot_be_had_is_refused_with_the_nearest() -> None:
    """The thinnest rod of 3 mm, and every bond but the peptide ones re-formed: S = 0.83."""
    with pytest.raises(fitting.Unreachable, match=r"nearest that can be had is 3\.6") as refused:
        fitting.design(fitting.Wish(2e-3, length=0.05), verify=False)
    assert refused.value.nearest == pytest.approx(3e-3 / 0.83, rel=0.01)


def test_the_command_writes_and_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fitting.design_command.design", lambda *_, **__: of_25_mm())
    (tmp_path / "fit.json").write_text(
        json.dumps(
            {
                "parameters": {
                    f"bonds.influence[{kind}]": {"value": 0.25}
                    for kind in ("hydrogen", "ionic", "disulfide", "peptide")
                }
            }
        )
    )
    arguments = ["design", "--curl-diameter", "25mm", "--hair", str(tmp_path / "fit.json")]
    assert main([*arguments, "--output", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().out
    assert "a rod of 16.7 mm" in printed
    assert "bonds.influence[ionic] (+10 %)" in printed
    report = json.loads((tmp_path / "out" / "design.json").read_text())
    assert report["rod_diameter"] == pytest.approx(FRESH * 25e-3, rel=1e-3)
    assert (tmp_path / "out" / "designed.hair").exists()
    assert (tmp_path / "out" / "design.png").read_bytes().startswith(b"\x89PNG")
    assert main([*arguments, "--output", str(tmp_path / "out")]) == 2
    assert "exists" in capsys.readouterr().err
    assert main(["design", "--curl-diameter", "25mm", "--hair", str(tmp_path / "none")]) == 2


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({"curl_diameter": 0.0}, "curl_diameter"),
        ({"length": 0.01}, "at least half a turn"),
        ({"waves": 5.0}, "at most 2.55"),
        ({"disulfide_left": 1.5}, "disulfide_left"),
        ({"influence": (1.0, 1.0)}, "influence"),
        ({"after_wash": 1}, "after_wash"),
    ],
)
def test_wrong_wishes_are_refused(numbers: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        fitting.Wish(**{"curl_diameter": 25e-3, **numbers})


@pytest.mark.slow
@pytest.mark.parametrize("weight", [False, True], ids=["free", "hanging"])
@pytest.mark.parametrize("diameter", [8e-3, 12e-3, 20e-3, 35e-3, 55e-3, 80e-3])
def test_designs_from_8_to_80_mm_hold_in_a_finer_simulation(diameter: float, weight: bool) -> None:
    found = fitting.design(fitting.Wish(diameter, length=0.3, weight=weight))
    assert found.finer_curl_diameter == pytest.approx(diameter, rel=FINER)
