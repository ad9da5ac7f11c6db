"""Fits of several experiments, strands and measures; how sure they are; several starts."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax
import numpy as np
import pytest

import fitting
import jaxhair as jh
from fitting import measures
from jaxhair import treatments

INFLUENCE: dict[str, fitting.Constraint] = {"bonds.influence": fitting.Simplex()}
ROD = "phases.*.Wound.diameter"
SET = "water set, unloaded"
PITCH = 4e-3


def water_set(rod: float, *, strands: int = 1, length: float = 0.1) -> jh.Scene:
    """Hair wound wet on a rod, dried and let go without weight: D = D_rod / f_hydrogen."""
    roots = np.zeros((strands, 3))
    hair = jh.Strands.straight(roots, (0.0, 0.0, -1.0), length=length, points=15)
    hair = jax.tree.map(lambda x: np.asarray(x, "float64"), hair)
    phases = treatments.water_set(rod_diameter=rod, climb=0.1, free=(jh.Hold(),))[:-1]
    return jh.Scene(hair, phases=phases)


def curl(diameter: float, error: float = 1e-4) -> fitting.Curl:
    return fitting.Curl(diameter=(diameter, error))


def hydrogen(found: fitting.Fit) -> float:
    return float(found.values["bonds.influence"][0])


def test_two_rods_share_the_hair() -> None:
    """Both want a set of 0.45; alike in structure, they are simulated together."""
    scenes = {"thin": water_set(20e-3), "thick": water_set(40e-3)}
    targets = {name: {SET: curl(rod / 0.45)} for name, rod in (("thin", 20e-3), ("thick", 40e-3))}
    found = fitting.fit(scenes, targets, INFLUENCE)
    assert found.converged
    assert hydrogen(found) == pytest.approx(0.45, abs=1e-4)
    assert set(found.misfits) == {f"thin/{SET}", f"thick/{SET}"}
    assert found.wanted == {}
    assert np.isnan(found.residual_mm)
    for name in scenes:
        leaf = jh.named_leaves(found.scenes[name])["bonds.influence"]
        np.testing.assert_allclose(leaf, found.values["bonds.influence"], rtol=1e-12)
    with pytest.raises(ValueError, match="2 scenes"):
        _ = found.scene
    text = str(found)
    assert "wanted 0.04444" in text
    assert "95 % interval" in text


def test_experiments_of_different_lengths_and_their_own_rods() -> None:
    """The hair is known; every experiment has a rod of its own to find."""
    scenes = {"short": water_set(25e-3), "long": water_set(25e-3, length=0.13)}
    targets = {"short": {SET: curl(50e-3)}, "long": {SET: curl(80e-3)}}
    free = {ROD: fitting.PerExperiment(fitting.Interval(9e-3, 60e-3))}
    found = fitting.fit(scenes, targets, free)
    assert list(found.values) == [f"short/{ROD}", f"long/{ROD}"]
    for name, diameter in (("short", 50e-3), ("long", 80e-3)):
        assert float(found.values[f"{name}/{ROD}"]) == pytest.approx(0.33 * diameter, rel=1e-3)
    only = fitting.fit(scenes, {"long": targets["long"]}, {f"long/{ROD}": fitting.Positive()})
    assert float(only.values[f"long/{ROD}"]) == pytest.approx(0.33 * 80e-3, rel=1e-3)
    leaves = jh.named_leaves(only.scenes["short"])
    assert float(leaves[f"phases.{SET.split(',')[0]}, wound.Wound.diameter"]) == 25e-3


def test_every_strand_has_its_own_influence() -> None:
    scene = water_set(20e-3, strands=3)
    sets = np.array([0.25, 0.45, 0.7])
    wanted = fitting.Curl(diameter=np.array([20e-3 / sets, np.full(3, 1e-4)]))
    free = {"bonds.influence": fitting.PerStrand(fitting.Simplex())}
    found = fitting.fit(scene, {SET: wanted}, free)
    np.testing.assert_allclose(found.values["bonds.influence"][:, 0], sets, atol=1e-3)
    np.testing.assert_allclose(found.values["bonds.influence"].sum(axis=1), 1, rtol=1e-12)
    assert "bonds.influence[2,hydrogen]" in found.uncertainty.labels


@cache
def two_unknowns() -> fitting.Fit:
    """A rod from the shape of its curls, with noise in their points."""
    return fitting.fit(water_set(20e-3), shapes(0), {ROD: fitting.Positive()})


@cache
def curled() -> np.ndarray:
    """Points on a rod of 24 mm, let go, shape (1, 15, 3)."""
    return np.asarray(jax.jit(jh.run)(water_set(24e-3))[SET].points)


def shapes(seed: int) -> dict[str, fitting.Target]:
    noise = np.random.default_rng(seed).normal(0, 1e-4, (1, 15, 3))
    return {SET: fitting.Shape(curled() + noise)}


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    """60 times noise: 95 % of 95 % intervals, and a scatter of 1; the program serves for all."""
    first = two_unknowns()
    inside, scatters = 0, []
    for seed in range(60):
        found = first.again(shapes(seed))
        low, high = found.uncertainty.interval(ROD)
        inside += low <= 24e-3 <= high
        scatters.append(found.uncertainty.scatter)
    assert 52 <= inside <= 60  # 57 are expected, with a standard deviation of 1.7
    assert np.mean(scatters) == pytest.approx(1, abs=0.05)
    assert first.again(shapes(0)).values[ROD] == pytest.approx(first.values[ROD], rel=1e-9)


def test_a_profile_agrees_with_the_interval_where_the_misfit_is_a_parabola() -> None:
    found = two_unknowns()
    along = fitting.profile(found, ROD, points=7)
    low, high = found.uncertainty.interval(ROD)
    width = high - low
    assert along.low == pytest.approx(low, abs=0.05 * width)
    assert along.high == pytest.approx(high, abs=0.05 * width)
    assert along.rises.min() == 0
    assert ROD in str(along)


def test_a_profile_of_what_is_not_determined_has_no_end() -> None:
    """Only hydrogen's share is seen: the other kinds may share the rest in any way."""
    found = fitting.fit(water_set(20e-3), {SET: curl(20e-3 / 0.45)}, INFLUENCE)
    assert len(found.undetermined) == 2
    low, high = found.uncertainty.interval("bonds.influence[ionic]")
    assert low < 0.1
    assert high > 0.45
    along = fitting.profile(found, "bonds.influence[ionic]", [0.1, 0.2, 0.3, 0.4])
    assert along.high == np.inf
    seen = fitting.profile(found, "bonds.influence[hydrogen]", points=5)
    assert seen.low == pytest.approx(0.45, abs=0.01)
    assert seen.high == pytest.approx(0.45, abs=0.01)


def test_what_is_known_before_counts_by_its_error() -> None:
    """The mean of two measurements of one number, weighted by their precisions."""
    error, known = 0.5e-3, (0.40, 0.01)
    free = {"bonds.influence": fitting.Simplex()}
    mean = np.array([known[0], 0.2, 0.2, 0.2])
    deviation = np.array([known[1], 1.0, 1.0, 1.0])
    found = fitting.fit(
        water_set(20e-3),
        {SET: curl(20e-3 / 0.45, error)},
        free,
        prior={"bonds.influence": (mean, deviation)},
        prior_width=100.0,
    )
    measured = 0.45**2 * error / 20e-3  # standard error of f = D_rod / D
    weight = known[1] ** -2 / (known[1] ** -2 + measured**-2)
    assert hydrogen(found) == pytest.approx(0.45 + weight * (0.40 - 0.45), abs=1e-3)


def test_a_robust_loss_does_not_follow_wrong_points() -> None:
    points = curled() + np.random.default_rng(0).normal(0, 1e-4, (1, 15, 3))
    points[0, 5] += 0.02
    targets = {SET: fitting.Shape(points)}
    free = {ROD: fitting.Positive()}
    plain = fitting.fit(water_set(20e-3), targets, free)
    robust = fitting.fit(water_set(20e-3), targets, free, loss="cauchy")
    good = float(two_unknowns().values[ROD])  # the same noise without the wrong point
    assert abs(float(robust.values[ROD]) - good) < 2e-6
    assert abs(float(plain.values[ROD]) - good) > 2e-5
    assert "too simple" in str(plain)


def test_several_starts_find_both_ways_to_wind() -> None:
    """Hair wound up or down the rod has the same diameter and number of turns."""
    scene = water_set(20e-3)
    name = "phases.*.Wound.climb"
    end = jax.jit(jh.run)(jh.replace_leaves(scene, climbing(scene, 0.5)))[SET].points
    truth = measures.curl(end)
    target = fitting.Curl(
        diameter=(float(truth.diameter[0]), 1e-5), waves=(float(truth.waves[0]), 1e-3)
    )
    found = fitting.fit(
        scene, {SET: target}, {name: fitting.Interval(-1.4, 1.4)}, starts=6, start_width=1.0
    )
    assert len(found.basins) == 2
    ends = sorted(float(basin.values[name]) for basin in found.basins)
    np.testing.assert_allclose(ends, (-0.5, 0.5), atol=0.01)
    assert sum(basin.starts for basin in found.basins) == 6
    assert "Different starts" in str(found)


def climbing(scene: jh.Scene, angle: float) -> dict[str, Any]:
    return {n: np.asarray(angle) for n in jh.named_leaves(scene) if n.endswith("Wound.climb")}


def test_ends_of_ranges_are_reported() -> None:
    found = fitting.fit(water_set(20e-3), {SET: curl(50e-3)}, {ROD: fitting.Interval(10e-3, 25e-3)})
    assert found.at_bounds == ()
    far = fitting.fit(
        water_set(20e-3),
        {SET: curl(200e-3)},
        {ROD: fitting.Interval(10e-3, 25e-3)},
        prior_width=100.0,
    )
    assert far.at_bounds == (ROD,)
    assert "at its bound" in str(far)


def test_a_fit_that_is_stopped_says_so() -> None:
    found = fitting.fit(water_set(20e-3), {SET: curl(90e-3)}, {ROD: fitting.Positive()}, steps=1)
    assert not found.converged
    assert "largest number of simulations" in found.reason
    assert found.reason in str(found)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scene": {}}, "scene is"),
        ({"scene": {"a/b": water_set(20e-3)}}, "no '/'"),
        ({"scene": {"a": water_set(20e-3)}}, "experiment of targets"),
        ({"free": {"else/fibre.stiffness": fitting.Positive()}}, "must be one of"),
        ({"free": {ROD: fitting.Positive(), f"{ROD}*": fitting.Positive()}}, "twice"),
        ({"free": {ROD: fitting.PerStrand(fitting.Positive())}}, "must be a number of the fibre"),
        ({"prior": {"rod": (1.0, 1.0)}}, "a name of prior"),
        ({"prior": {ROD: (1.0, 0.0)}}, "above 0"),
        ({"prior": {ROD: 1.0}}, "a mean and a standard deviation"),
        ({"prior": {ROD: (np.ones(2), 1.0)}}, "shape"),
        ({"loss": "square"}, "loss"),
        ({"starts": 2, "method": "adam"}, "levenberg-marquardt"),
        ({"level": 1.5}, "level"),
    ],
)
def test_bad_requests_are_refused(change: dict[str, Any], words: str) -> None:
    request: dict[str, Any] = {
        "scene": water_set(20e-3),
        "targets": {SET: curl(50e-3)},
        "free": {ROD: fitting.Positive()},
    }
    with pytest.raises(ValueError, match=words):
        fitting.fit(**{**request, **change})


def test_other_observations_must_be_of_the_same_states() -> None:
    found = two_unknowns()
    with pytest.raises(ValueError, match="other states or kinds"):
        found.again({SET: curl(50e-3)})
    by_adam = replace(found, settings={**found.settings, "method": "adam"})
    with pytest.raises(ValueError, match="levenberg-marquardt"):
        by_adam.again(shapes(0))
