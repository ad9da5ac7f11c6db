"""Published perms: fitted fractions, simulated sets and the command that compares them."""

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from fitting import published, published_command
from fitting.published import FILES, INFLUENCE, Lotion

DATA = Path(__file__).parent / "data" / "perm_set.csv"
SHARE = 1e-5
"""Of the set: rounding in single precision, and what three seconds of motion leave."""

REST = 3e-4
"""The same over all sets down to 0, where hair moves longer."""

PAPERS_OWN = {
    "A-S": 93.5,
    "A-N": 80.4,
    "A-W": 64.1,
    "B-S": 92.4,
    "B-N": 85.1,
    "B-W": 71.4,
    "C-S": 87.6,
    "C-N": 54.5,
}
"""The set that the paper computes from the moduli [%], the column S_o of its Table II."""


@cache
def made() -> list[Lotion]:
    """The packaged lotions, predicted."""
    return published.predictions(published.lotions())


def predicted() -> list[Lotion]:
    """Those of which a set could be predicted."""
    return [b for b in made() if b.set_predicted_percent is not None]


def test_the_packaged_data_are_those_of_the_tests() -> None:
    """Comments name the source; the rest is the same file."""
    text = (Path(published.__file__).parent / "data" / "perm_set.csv").read_text()
    lines = text.splitlines()
    comments = [line for line in lines if line.startswith("#")]
    assert lines[: len(comments)] == comments
    assert "Journal of Cosmetic Science 66 (2015) 40, Table II" in "".join(comments)
    assert lines[len(comments) :] == DATA.read_text().splitlines()


def test_modulus_by_hand() -> None:
    """In water 37 of table 1's parts are left; with peptide bonds apart 17 of 37 stay uncut."""
    left = jnp.asarray([0.0, 0.25, 1.0])
    np.testing.assert_allclose(published.modulus(left), [0, 25, 100], rtol=1e-6)
    apart = (0.33, 0.30, 0.20, 0.17)
    wanted = [100 * 0.17 / 0.37, 100 * (0.05 + 0.17) / 0.37, 100]
    np.testing.assert_allclose(published.modulus(left, apart), wanted, rtol=1e-6)


def test_fractions_by_hand() -> None:
    """A-N: 15.5 % and 79.1 % of the modulus are 0.155 and 0.791 of the covalent bonds."""
    np.testing.assert_allclose(published.fitted([15.5, 79.1]), [0.155, 0.791], atol=1e-5)
    # With peptide bonds apart, 0.2 b + 0.17 = 0.791 * 0.37; what is below 46 % has no solution.
    low, high = published.fitted([15.5, 79.1], (0.33, 0.30, 0.20, 0.17))
    assert low == pytest.approx(0, abs=1e-3)
    assert high == pytest.approx((0.791 * 0.37 - 0.17) / 0.2, abs=1e-5)


@pytest.mark.parametrize("influence", [INFLUENCE, (2.0, 0.1, 0.7, 0.0)], ids=["table 1", "other"])
def test_the_simulated_set_is_the_closed_form(influence: tuple[float, ...]) -> None:
    """S = 1 - E_re / E_ro for two parallel networks, whatever the influences."""
    found = made() if influence == INFLUENCE else published.predictions(made(), influence)
    whole = [b for b in found if b.e_ro_percent is not None]
    assert len(whole) == 8
    for b in whole:
        assert b.e_ro_percent is not None
        closed = 100 * (1 - b.e_re_percent / b.e_ro_percent)
        assert b.set_predicted_percent == pytest.approx(closed, abs=100 * SHARE), b.lotion
        assert b.set_predicted_percent == pytest.approx(PAPERS_OWN[b.lotion], abs=0.051), b.lotion


def test_every_set_is_read_off_the_curl() -> None:
    """Uncut hair comes back straight; hair that loses all bonds keeps the rod's curl."""
    left = np.linspace(0, 1, 8)  # as many as there are lotions, for the same compiled program
    scenes = [published.experiment(b, max(b, 0.7)) for b in left]
    wanted = 100 * (1 - left / np.maximum(left, 0.7))
    np.testing.assert_allclose(published.simulated_sets(scenes), wanted, atol=100 * REST)


def test_measured_sets(capsys: pytest.CaptureFixture[str]) -> None:
    """Every lotion within 2.2 points of the set that was measured, 1.3 in the mean square."""
    with capsys.disabled():
        print("\n" + published.table(made()))
    assert [b.lotion for b in predicted()] == list(PAPERS_OWN)
    for b in predicted():
        assert b.difference is not None
        assert abs(b.difference) < 2.2, b.lotion
    figures = published.summary(made())
    assert 1.2 < figures["root_mean_square_difference_points"] < 1.3
    assert figures["mean_difference_points"] == pytest.approx(-0.78, abs=0.01)
    assert figures["largest_difference_points"] == pytest.approx(2.12, abs=0.01)
    assert figures["correlation"] > 0.997


def test_summary_by_hand() -> None:
    """Differences of 3 and -1 points: root mean square sqrt 5, mean 1."""
    rows = [
        Lotion("a", 1.0, 2.0, 50.0, set_predicted_percent=53.0),
        Lotion("b", 1.0, 2.0, 60.0, set_predicted_percent=59.0),
        Lotion("c", 1.0),
    ]
    wanted = [5**0.5, 1.0, 3.0, 1.0]
    assert list(published.summary(rows).values()) == pytest.approx(wanted)


def test_the_ninth_is_listed_with_its_reason() -> None:
    """C-W has no E_ro: its cut is known, its set is not, and it says why."""
    ninth = made()[8]
    assert ninth.row() == {
        "lotion": "C-W",
        "e_re_percent": 56.5,
        "e_ro_percent": None,
        "set_measured_percent": None,
        "cut_to": pytest.approx(0.565, abs=1e-5),
        "re_formed_to": None,
        "set_predicted_percent": None,
        "difference_points": None,
        "note": "not predicted: E_ro could not be read",
    }
    line = published.table(made()).splitlines()[9]
    assert line.startswith("C-W")
    assert line.endswith("not predicted: E_ro could not be read")
    assert "nan" not in published.table(made())


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It writes three files that agree, refuses to replace them, and does with --overwrite."""
    folder = tmp_path / "new" / "results"
    assert published_command.main(["--output", str(folder)]) == 0
    assert published.table(made()) in capsys.readouterr().out
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    assert (folder / "published.png").read_bytes().startswith(b"\x89PNG")
    report = json.loads((folder / "published.json").read_text())
    assert report["lotions"] == [b.row() for b in made()]
    assert report["correlation"] == published.summary(made())["correlation"]
    assert "Table II" in report["source"]
    with (folder / "published.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert rows == [
        {k: "" if v is None else str(v) for k, v in row.items()} for row in report["lotions"]
    ]
    for name in FILES:
        for other in FILES:
            (folder / other).unlink(missing_ok=True)
        (folder / name).write_text("mine")
        assert published_command.main(["--output", str(folder)]) == 2
        said = capsys.readouterr()
        assert name in said.err
        assert "--overwrite" in said.err
        assert not said.out  # refused before any work
        assert [path.name for path in folder.iterdir()] == [name]
        assert (folder / name).read_text() == "mine"
    assert published_command.main(["--output", str(folder), "--overwrite"]) == 0
    assert sorted(path.name for path in folder.iterdir()) == sorted(FILES)
    assert (folder / "published.png").read_bytes().startswith(b"\x89PNG")


def test_without_matplotlib_the_rest_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """And the command says what is missing."""
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    rows = [replace(b) for b in made()]
    assert [p.name for p in published.write(rows, tmp_path)] == list(FILES[:2])
    assert "jaxhair[pictures]" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILES[:2])
