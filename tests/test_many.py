"""Fits of many strands at once: as good as one by one, and each strand by itself."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import fitting
import jaxhair as jh
from fitting import tiles
from fitting.many import FitEach, fit_each

ROD, STIFFNESS = "phases.*.Wound.diameter", "fibre.stiffness"
FREE: dict[str, fitting.Constraint] = {
    ROD: fitting.Interval(8e-3, 40e-3),
    STIFFNESS: fitting.Interval(1e-3, 0.2),
}
RODS, STIFF = np.array([16e-3, 20e-3, 26e-3]), np.array([0.01, 0.02, 0.04])
POINTS = 9
SOLVER = jh.PositionBased(sweep="sequential")  # compiles fastest


def scene(strands: int, rods: Any = 20e-3, stiffness: Any = 0.015) -> jh.Scene:
    """Hair of 8 cm that a water set has curled, pulled down for a tenth of a second."""
    roots = np.zeros((strands, 3))
    roots[:, 0] = 0.01 * np.arange(strands)
    hair = jh.Strands.straight(roots, (0, 0, -1.0), length=0.08, points=POINTS, dtype="float64")
    free = (jh.Hold(), jh.Gravity())
    phases = jh.treatments.water_set(rod_diameter=20e-3, climb=0.2, seconds=0.1, free=free)
    made = jh.Scene(hair, jh.Fibre(stiffness), phases=phases, solver=SOLVER)
    leaves, structure = jax.tree.flatten(made.as_arrays())
    for i, name in enumerate(jh.named_leaves(made)):
        if name.endswith("Wound.diameter"):
            leaves[i] = np.reshape(rods, (1, 1, -1))
    return jax.tree.unflatten(structure, leaves) if np.ndim(rods) else made


@cache
def observed() -> np.ndarray:
    """Three strands set on rods of their own, of hair with its own stiffness."""
    return np.asarray(jax.jit(jh.run)(scene(3, RODS, STIFF))["water set"].points)


@cache
def together() -> FitEach:
    """All three, with a tile that the last has to be filled up to."""
    return fit_each(scene(3), {"water set": fitting.Shape(observed())}, FREE, tile=2)


def test_each_strand_finds_its_own_truth() -> None:
    found = together()
    assert found.converged.all()
    assert found.reasons == (None, None, None)
    assert found.values[ROD] == pytest.approx(RODS, rel=1e-4)
    assert found.values[STIFFNESS] == pytest.approx(STIFF, rel=2e-2)
    assert np.all(found.residual_mm < 5e-3)


def test_it_agrees_with_fits_one_by_one() -> None:
    """Of targets that no numbers meet, so that the optimum is one of compromise."""
    rng = np.random.default_rng(0)
    wanted = observed() + rng.normal(0, 3e-4, observed().shape)
    found = fit_each(scene(3), {"water set": fitting.Shape(wanted)}, FREE, tolerance=1e-8)
    whole = scene(3)
    for i in (0, 2):
        hair = jax.tree.map(lambda x, i=i: x[i : i + 1], whole.strands)
        hair = replace(hair, lengths=whole.strands.lengths)
        target = {"water set": fitting.Shape(wanted[i : i + 1])}
        alone = fitting.fit(replace(whole, strands=hair), target, FREE, tolerance=1e-10)
        for name in FREE:
            assert found.values[name][i] == pytest.approx(float(alone.values[name]), rel=1e-3)
        assert found.residual_mm[i] == pytest.approx(alone.residual_mm, rel=1e-4)


def test_neither_order_nor_tiles_nor_a_strand_without_numbers_change_the_others() -> None:
    order = np.array([2, 0, 1])
    roots = scene(3).strands.positions[:, 0] - scene(3).strands.positions[order, 0]
    wanted = observed()[order] + np.asarray(roots)[:, None]
    bad = np.full((1, POINTS, 3), np.nan)
    bad_last = np.concatenate([wanted, bad])
    # as jax.tree rebuilds it, for a Shape refuses what is not finite
    target = jax.tree.map(lambda x: bad_last, fitting.Shape(np.zeros((4, POINTS, 3))))
    found = fit_each(scene(4), {"water set": target}, FREE, tile=3)
    for name in FREE:
        assert found.values[name][:3] == pytest.approx(together().values[name][order], rel=1e-6)
        assert found.errors[name][:3] == pytest.approx(together().errors[name][order], rel=1e-4)
        assert np.isnan(found.errors[name][3])
    assert found.steps[:3] == pytest.approx(together().steps[order])
    assert found.reasons == (None, None, None, "not finite at its start")
    assert list(found.converged) == [True, True, True, False]
    assert "3 of 4 strands fitted" in str(found)
    assert "strand 3: not finite" in str(found)


def test_standard_errors_are_those_of_repeated_measurements() -> None:
    """Sixty strands of the same hair, each measured with its own noise."""
    strands, noise = 60, 2e-4
    alike = np.repeat(observed()[1:2] - observed()[1:2, :1], strands, axis=0)
    rng = np.random.default_rng(3)
    wanted = alike + np.asarray(scene(strands).strands.positions)[:, :1]
    wanted += rng.normal(0, noise, wanted.shape)
    target = {"water set": fitting.Shape(wanted)}
    told: list[int] = []
    found = fit_each(
        scene(strands), target, FREE, noise_mm=1e3 * noise, progress=lambda n, mm: told.append(n)
    )
    assert found.converged.all()
    assert told == list(range(1, found.steps.max() + 1))
    for name, true in ((ROD, RODS[1]), (STIFFNESS, STIFF[1])):
        off = (found.values[name] - true) / found.errors[name]
        assert 0.75 < np.sqrt(np.mean(off**2)) < 1.25
        assert np.mean(np.abs(off) < 1.96) > 0.85


def test_a_fit_goes_on_from_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Interrupted in the 1st, 3rd and 4th simulation of all; one strand is not finite."""
    wanted = observed() + np.random.default_rng(0).normal(0, 3e-4, observed().shape)
    wanted[1] = np.nan
    target = jax.tree.map(lambda x: wanted, fitting.Shape(observed()))

    def found(checkpoint: Path | None, told: list[int]) -> FitEach:
        options: dict[str, Any] = {"tolerance": 1e-8, "tile": 2, "checkpoint": checkpoint}
        return fit_each(
            scene(3),
            {"water set": target},
            FREE,
            progress=lambda step, mm: told.append(step),
            **options,
        )

    whole = found(None, [])
    assert whole.reasons == (None, "not finite at its start", None)
    true = tiles.Tiles.evaluate
    for calls, done in ((0, []), (2, [1, 2]), (1, [2, 3])):
        left, told = [calls], list[int]()

        def evaluate(*arguments: Any, left: list[int] = left) -> Any:
            left[0] -= 1
            if left[0] < 0:
                raise KeyboardInterrupt
            return true(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(tiles.Tiles, "evaluate", evaluate)
            with pytest.raises(KeyboardInterrupt):
                found(tmp_path, told)
        assert told == done
    rest: list[int] = []
    for again in (found(tmp_path, rest), found(tmp_path, [])):
        same(again, whole)
    assert rest == list(range(3, whole.steps.max() + 1))
    assert len(list(tmp_path.iterdir())) == 1


def same(one: FitEach, other: FitEach) -> None:
    """Bit for bit, but for the time."""
    assert one.reasons == other.reasons
    for name in set(vars(one)) - {"seconds", "reasons"}:
        jax.tree.map(np.testing.assert_array_equal, getattr(one, name), getattr(other, name))


def test_a_folder_of_other_work_is_refused(tmp_path: Path) -> None:
    def run(start: jh.Scene, wanted: np.ndarray, **options: Any) -> None:
        target = {"water set": fitting.Shape(wanted)}
        one = {ROD: FREE[ROD], **options.pop("free", {})}
        fit_each(start, target, one, steps=1, checkpoint=tmp_path, **options)

    run(scene(2), observed()[:2])
    run(scene(2), observed()[:2])
    changes: list[tuple[Any, Any, dict[str, Any]]] = [
        (scene(2, stiffness=0.016), observed()[:2], {}),
        (scene(2), observed()[1:], {}),
        (scene(2), observed()[:2], {"free": {ROD: fitting.Interval(8e-3, 41e-3)}}),
        (scene(2), observed()[:2], {"tolerance": 1e-5}),
        (scene(2), observed()[:2], {"noise_mm": 0.2}),
    ]
    for start, wanted, options in changes:
        with pytest.raises(ValueError, match="other work"):
            run(start, wanted, **options)


class Scale(fitting.Constraint):
    """A shape times a number above 0."""

    def free(self, value: np.ndarray) -> np.ndarray:
        return np.zeros(1)

    def value(self, free: jax.Array, start: Any) -> jax.Array:
        return jax.numpy.asarray(start, free.dtype) * jax.numpy.exp(free[0])


def test_influences_and_whole_shapes_can_differ_between_strands() -> None:
    """The first state shows the scale of the natural shape, the second f_H by the set."""
    shape = np.zeros((2, POINTS - 2, 3))
    shape[:, :, 0] = 0.1
    start = scene(2)
    start = replace(
        start,
        strands=replace(start.strands, natural_shape=shape),
        phases=(jh.Phase("bent", 1e-6, (jh.Unloaded(),)), *start.phases[:3]),
    )
    influence = np.array([[0.5, 0.2, 0.2, 0.1], [0.2, 0.3, 0.3, 0.2]])
    own = replace(start, bonds=jh.Bonds(influence))
    scales = np.array([0.5, 1.2])
    own = replace(own, strands=replace(own.strands, natural_shape=shape * scales[:, None, None]))
    ends = jh.run(own)
    states = ("bent", "water set, unloaded")
    found = fit_each(
        start,
        {name: fitting.Shape(np.asarray(ends[name].points), align=True) for name in states},
        {"bonds.influence": fitting.Simplex(), "strands.natural_shape": Scale()},
    )
    assert found.converged.all()
    assert np.exp(found.numbers["strands.natural_shape"][:, 0]) == pytest.approx(scales, rel=1e-3)
    assert found.values["bonds.influence"][:, 0] == pytest.approx(influence[:, 0], abs=2e-3)
    assert found.values["bonds.influence"].sum(axis=1) == pytest.approx(1)
    assert found.values["strands.natural_shape"].shape == shape.shape
    # the shares of the others are not seen: they stay as they were to one another
    assert np.all(
        found.errors["bonds.influence"][:, 1] > 20 * found.errors["bonds.influence"][:, 0]
    )


def test_a_curl_out_of_reach_is_not_fitted_and_says_why() -> None:
    target = {"water set": fitting.helix(diameter=9e-3)}
    found = fit_each(scene(2), target, FREE, steps=4, bar_mm=0.5)
    assert not found.fitted.any()
    assert all(reason is not None for reason in found.reasons)
    assert np.isfinite(found.values[ROD]).all()


def test_the_table_names_ten_strands_and_counts_the_others() -> None:
    ones = np.ones(13)
    found = FitEach({"a": ones}, {"a": ones}, {}, {}, ones, ones > 0, ("lost",) * 13, ones, 1.0)
    lines = str(found).splitlines()
    assert lines[0].startswith("0 of 13 strands fitted")
    assert sum(line.endswith(": lost") for line in lines) == 10
    assert lines[-1] == "and 3 more could not be fitted"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"targets": {}}, ["targets", "at least one phase"]),
        ({"targets": {"nowhere": fitting.helix(diameter=1.0)}}, ["'nowhere'", "'water set'"]),
        ({"targets": {"water set": 3}}, ["targets['water set']", "Target"]),
        ({"targets": {"water set": fitting.Shape(np.zeros((3, 9, 3)))}}, ["(3, 9, 3)", "(2, 9, 3"]),
        ({"free": {}}, ["free", "at least one leaf"]),
        ({"free": {"bonds.colour": fitting.Positive()}}, ["'bonds.colour'", "bonds.influence"]),
        ({"free": {STIFFNESS: 3}}, [STIFFNESS, "constraint"]),
        ({"free": {STIFFNESS: fitting.Interval(0.5, 0.9)}}, [STIFFNESS, "0.015", "[0.5, 0.9]"]),
        ({"free": {"phases.*.climb": fitting.Unbounded()}}, ["climb", "cannot differ"]),
        ({"free": {"phases.*.acceleration": fitting.Unbounded()}}, ["accel", "cannot differ"]),
        (
            {"free": {ROD: fitting.Positive(), "phases.*d.Wound.diameter": fitting.Positive()}},
            ["twice"],
        ),
        ({"steps": 0}, ["steps", "0", "at least 1"]),
        ({"tile": 0}, ["tile", "0", "at least 1"]),
        ({"bar_mm": -1.0}, ["bar_mm", "-1.0", "above 0"]),
        ({"contact": True}, ["'water set'", "HairContact", "must not touch"]),
    ],
)
def test_bad_requests_are_refused(change: dict[str, Any], words: list[str]) -> None:
    start = scene(2)
    if change.pop("contact", False):
        last = start.phases[-1]
        last = replace(last, effects=(*last.effects, jh.HairContact()))
        start = replace(start, phases=(*start.phases[:-1], last))
    request: dict[str, Any] = {"targets": {"water set": fitting.helix(diameter=0.03)}, "free": FREE}
    with pytest.raises(ValueError) as error:
        fit_each(start, **{**request, **change})
    for word in words:
        assert word in str(error.value)


TWO_DEVICES = """
import jax, numpy as np, test_many
from unittest import mock
from fitting import Shape
from fitting.many import fit_each
assert len(jax.devices()) == 2
target = {"water set": Shape(test_many.observed())}
found = fit_each(test_many.scene(3), target, test_many.FREE, tile=1)
assert np.allclose(found.values[test_many.ROD], test_many.RODS, rtol=1e-4)
with mock.patch("jax.local_devices", lambda: jax.devices()[:1]):
    alone = fit_each(test_many.scene(3), target, test_many.FREE, tile=1)
test_many.same(found, alone)
"""


@pytest.mark.slow
def test_tiles_are_spread_over_devices_with_equal_results() -> None:
    """Bit for bit."""
    flags = "--xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_ENABLE_X64": "1"}
    folder = os.path.dirname(__file__)
    subprocess.run([sys.executable, "-c", TWO_DEVICES], env=environment, cwd=folder, check=True)
