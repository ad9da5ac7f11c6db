"""What accuracy costs: the reference is honest, the tables and choices are right, the command."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair.__main__ import main
from jaxhair.accuracy import command, grid, problem, table
from jaxhair.accuracy.grid import Plan, Setting
from jaxhair.accuracy.measuring import Cost, Row, measure
from jaxhair.accuracy.problem import Problem, Reference, reference
from jaxhair.accuracy.stretch import stretch

TINY = Problem(strands=2, seconds=0.05)
SETTINGS = (
    Setting(jh.Direct(), 9, 80),
    Setting(jh.PositionBased(iterations=2), 9, 80, "float64", gradient=True),
)
PLAN = Plan(TINY, SETTINGS, 17, 320, 2, (5,), ())


def made_up(error: float, seconds: float, *, gradient: Cost | None = None, **setting: Any) -> Row:
    """A row that nobody measured."""
    failed = not error <= 0.5
    cost = Cost("failed" if failed else "ok", error, seconds, 1.0, 1000)
    return Row(Setting(**{"solver": jh.Direct(), **setting}), cost, gradient)


def given(shape: Any = 0.0, gradient: Any = 1.0) -> Reference:
    """A reference that nobody computed."""
    return Reference(np.full((9, 3), shape), np.full(3, gradient), 1e-3, 1e-2, 17, 320, 2)


@pytest.mark.parametrize(("levels", "points", "rate"), [(2, 33, 640), (3, 65, 1280)])
@pytest.mark.parametrize("second", [-0.3, 0.0, 0.3])
def test_the_reference_s_bound_holds_for_errors_of_known_order(
    levels: int, points: int, rate: int, second: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of first order in both, with terms of second order and a mixed one."""

    def made_up_level(_: Problem, points: int, rate: int) -> tuple[Any, Any]:
        h, k = 8 / (points - 1), 80 / rate
        error = 0.1 * (h + k + second * (h**2 + k**2) + 0.1 * h * k)
        return np.full((9, 3), 0.24 * error), np.array([1 + error, 1.0, 1.0])

    monkeypatch.setattr(problem, "_shape_and_gradient", made_up_level)
    found = reference(TINY, points=points, steps_per_second=rate, levels=levels)
    assert problem.shape_error(TINY, found, np.zeros((9, 3, 1))) <= found.bound + 1e-12
    assert problem.gradient_error(found, np.ones(3)) <= found.gradient_bound + 1e-12


@pytest.mark.slow
def test_the_reference_s_bound_holds_against_a_finer_one() -> None:
    finer = reference(TINY, points=65, steps_per_second=1280, levels=2)
    coarse = reference(TINY, points=33, steps_per_second=640, levels=2)
    assert problem.shape_error(TINY, coarse, finer.shape[:, :, None]) < coarse.bound


@pytest.mark.slow
def test_the_reference_s_gradient_is_that_of_forward_mode() -> None:
    _, gradient = problem._shape_and_gradient(TINY, 9, 80)
    solver = jh.Direct(newton_steps=2, frame_inertia=1e-6)
    direction = np.array([1.0, 2.0, 3.0])
    with problem.precision("float64"):
        scene = TINY.scene(solver, points=9, steps_per_second=80, dtype="float64", strands=1)
        at = jnp.zeros(3, scene.dtype)
        _, slope = jax.jvp(lambda x: TINY.height(x, scene), (at,), (jnp.asarray(direction),))
    assert float(slope) == pytest.approx(gradient @ direction, rel=1e-4)


def test_failed_settings_are_kept_as_failed() -> None:
    setting = replace(SETTINGS[1], gradient=False)
    away = measure(TINY, given(shape=1.0), setting)
    assert away.forward.status == "failed"
    assert 0.5 < away.forward.error < np.inf
    nowhere = measure(TINY, given(shape=np.nan), setting)
    assert nowhere.forward.status == "failed"
    assert table.pareto([away, nowhere], gradient=False) == []


def test_the_pareto_front_of_points() -> None:
    points = [(0.1, 1.0), (0.2, 2.0), (0.05, 2.0), (0.05, 3.0), (0.01, 9.0), (np.inf, 0.1)]
    rows = [made_up(error, seconds) for error, seconds in points]
    front = table.pareto(rows, gradient=False)
    assert [(r.forward.error, r.forward.seconds_per_second) for r in front] == [
        (0.1, 1.0),
        (0.05, 2.0),
        (0.01, 9.0),
    ]
    assert table.pareto(rows, gradient=True) == []


@pytest.fixture
def csv_file(tmp_path: Path) -> Path:
    path = tmp_path / "accuracy.csv"
    gradient = Cost("ok", 0.02, 8.0, 2.0, None)
    rows = [
        made_up(0.1, 1.0, solver=jh.PositionBased(iterations=20, substeps=4), points=9),
        made_up(0.01, 2.0, points=17, steps_per_second=90, gradient=gradient),
        made_up(0.004, 3.0, points=65, dtype="float64"),
        made_up(0.9, 0.1, solver=jh.Compliant()),
    ]
    table.write(path, rows, overwrite=False)
    assert table.read(path) == [replace(r, setting=s.setting) for r, s in zip(
        rows, table.read(path), strict=True)]  # fmt: skip
    return path


def test_cheapest_picks_the_row(csv_file: Path) -> None:
    rough = jh.cheapest(0.1, table=csv_file)
    assert isinstance(rough.solver, jh.PositionBased)
    assert (rough.solver.iterations, rough.solver.substeps, rough.points) == (20, 4, 9)
    fine = jh.cheapest(0.0101, table=csv_file)
    assert (fine.points, fine.dt, fine.dtype, fine.error) == (17, 1 / 90, "float32", 0.01)
    assert fine.seconds_per_second == 2.0
    text = "jh.Direct(newton_steps=1), 17 points, dt = 1/90 s, float32: error 1.00% of the length"
    assert str(fine).startswith(text)
    assert jh.cheapest(0.5, table=csv_file, dtype="float64").points == 65
    assert jh.cheapest(0.5, table=csv_file, points=65).error == 0.004
    slope = jh.cheapest(0.05, table=csv_file, gradient=True)
    assert (slope.error, slope.seconds_per_second, slope.memory) == (0.02, 8.0, None)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"error": 1e-3}, ["0.001", "0.004", "best measured"]),
        ({"error": 1e-3, "gradient": True}, ["0.02"]),
        ({"error": 1e-3, "points": 17}, ["0.01", "points"]),
        ({"error": 0.5, "points": 100}, ["none is measured", "points"]),
        ({"error": 0}, ["error", "above 0"]),
        ({"error": 0.1, "dtype": "float16"}, ["dtype", "float32"]),
        ({"error": 0.1, "points": 1.5}, ["points", "whole number"]),
    ],
)
def test_cheapest_refuses(csv_file: Path, arguments: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ValueError) as refused:
        jh.cheapest(**arguments, table=csv_file)
    for word in words:
        assert word in str(refused.value)


def test_tables_of_another_kind_are_refused(csv_file: Path) -> None:
    text = csv_file.read_text(encoding="utf-8")
    for broken, words in (
        ("a,b\n1,2\n", ["'solver'"]),
        (text.replace("Compliant", "Magic"), ["line 5", "Magic", "Direct"]),
        (text.replace("float64,base,ok", "float64,base,fine"), ["line 4", "fine"]),
        (text.replace(",90,", ",often,"), ["line 3", "often"]),
    ):
        csv_file.write_text(broken, encoding="utf-8")
        with pytest.raises(ValueError) as refused:
            jh.cheapest(0.1, table=csv_file)
        for word in ("accuracy.csv", *words):
            assert word in str(refused.value)


def test_the_packaged_table_answers() -> None:
    choice = jh.cheapest(0.1)
    assert choice.error <= 0.1
    hair = jh.Strands.straight([[0, 0, 0]], (0, 0, -1), length=0.2, points=choice.points)
    jh.Scene(hair, solver=choice.solver, dt=choice.dt)
    described = json.loads(table.PACKAGED.with_suffix(".json").read_text(encoding="utf-8"))
    assert described["reference"]["bound_relative_to_length"] < choice.error


@pytest.mark.parametrize("quick", [True, False])
def test_what_the_command_measures(quick: bool) -> None:
    plan = grid.plan(strands=3, quick=quick)
    assert plan.problem.strands == 3
    assert len({str(s) for s in plan.settings}) == len(plan.settings)
    # --quick leaves the gradient of one solver out: each is compiled for long.
    left_out = {jh.Compliant} if quick else set()
    with_gradient = {type(s.solver) for s in plan.settings if s.gradient}
    assert with_gradient == set(grid.SOLVERS.values()) - left_out
    for s in plan.settings:
        assert s.turned in grid.TURNED
        assert (s.points - 1) % 8 == 0
        assert s.steps_per_second * plan.problem.seconds % 1 == 0


def test_the_stretch_of_the_paper_s_solver_is_that_of_theory() -> None:
    """Of order -1 in iterations and -2 in substeps; its size within 5 %."""
    base, iterations, substeps = stretch(5), stretch(20), stretch(5, 4)
    assert np.log(iterations.measured / base.measured) / np.log(4) == pytest.approx(-1, abs=0.05)
    assert np.log(substeps.measured / base.measured) / np.log(4) == pytest.approx(-2, abs=0.05)
    for found in (base, iterations, substeps):
        assert found.measured == pytest.approx(found.theory, rel=0.05)


def arguments(folder: Path, *more: str) -> list[str]:
    return ["accuracy", "--output", str(folder), "--quiet", *more]


def test_the_command_writes_tables_and_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(grid, "plan", lambda **options: PLAN)
    folder = tmp_path / "accuracy"
    assert main(arguments(folder)) == 0
    printed = capsys.readouterr().out
    assert "Cheapest for the shape" in printed
    assert "Cheapest for the gradient" in printed
    assert "its own error is below" in printed
    assert {p.name for p in folder.iterdir()} == set(command.FILES)
    read = np.genfromtxt(
        folder / "accuracy.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
    )
    assert read.dtype.names == table.COLUMNS
    assert list(read["solver"]) == ["Direct", "PositionBased"]
    assert np.all(np.isfinite(read["error_relative"]))
    rows = table.read(folder / "accuracy.csv")
    assert rows[0].gradient is None
    assert rows[1].gradient is not None
    described = json.loads((folder / "accuracy.json").read_text(encoding="utf-8"))
    assert described["complete"] is True
    assert described["reference"]["bound_relative_to_length"] > 0
    assert set(described["reference"]["gradient"]) == set(problem.PARAMETERS)
    stretches = np.genfromtxt(folder / "stretch.csv", delimiter=",", names=True)
    assert stretches["substeps"] == 1
    assert stretches["stretch_relative"] == pytest.approx(stretches["theory_relative"], rel=0.05)
    before = (folder / "accuracy.csv").read_bytes()
    assert main(arguments(folder)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert "--overwrite" in error
    assert (folder / "accuracy.csv").read_bytes() == before


def test_an_interrupt_keeps_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [made_up(0.1, 1.0), made_up(0.01, 2.0)]
    calls = iter(rows)

    def interrupted(*_: Any) -> Row:
        for row in calls:
            return row
        raise KeyboardInterrupt

    plan = replace(PLAN, settings=[row.setting for row in rows] * 2)
    monkeypatch.setattr(grid, "plan", lambda **options: plan)
    monkeypatch.setattr(command, "measure", interrupted)
    monkeypatch.setattr(command, "reference", lambda *_, **__: given())
    folder = tmp_path / "accuracy"
    assert main(arguments(folder)) == 130
    assert "2 of 4 settings are kept" in capsys.readouterr().err
    assert {p.name for p in folder.iterdir()} == {"accuracy.csv", "accuracy.json", "accuracy.png"}
    assert [r.forward.error for r in table.read(folder / "accuracy.csv")] == [0.1, 0.01]
    described = json.loads((folder / "accuracy.json").read_text(encoding="utf-8"))
    assert described["complete"] is False
    assert main(arguments(tmp_path / "nothing")) == 130
    assert "nothing was measured" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("more", "words"),
    [(["--strands", "0"], ["--strands", "at least 1"]), ([], ["stretch.csv", "exists"])],
)
def test_the_command_refuses(
    more: list[str], words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "stretch.csv").write_bytes(b"mine")
    assert main(arguments(tmp_path, *more)) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error
    assert [p.name for p in tmp_path.iterdir()] == ["stretch.csv"]
    assert (tmp_path / "stretch.csv").read_bytes() == b"mine"


def test_problems_refuse_points_and_steps_that_do_not_fit() -> None:
    for points, rate, word in ((10, 80, "points is 10"), (9, 70, "steps_per_second is 70")):
        with pytest.raises(ValueError, match=word):
            TINY.scene(jh.Direct(), points=points, steps_per_second=rate, dtype="float32")
