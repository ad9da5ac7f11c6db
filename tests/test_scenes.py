"""The paper's three scenes: against the oracle, and what its figures 4 to 6 show."""

from dataclasses import replace

import jax
import numpy as np
import oracle
import pytest
from test_oracle import as_oracle, oracle_settings, outer

import jaxhair as jh
from jaxhair import Scene, State
from jaxhair.simulate import prepare, start, step

RELATIVE = 1e-10

SMALL = {"strands": 5, "points": 6}
SCENES = {
    "bed hair": lambda: jh.scenes.bed_hair(**SMALL),
    "blow dryer": lambda: jh.scenes.blow_dry(**SMALL),
    "perm": lambda: jh.scenes.perm(**SMALL, length=0.24, rod_diameter=0.08),
    "prepared perm": lambda: jh.scenes.perm(**SMALL, length=0.24, rod_diameter=0.08, winding=False),
    "washed perm": lambda: jh.scenes.perm(
        **SMALL, length=0.24, rod_diameter=0.08, winding=False
    ).then(*jh.treatments.wash(unload=False)),
}
one_step = jax.jit(step)


def assert_same(ours: State, theirs: oracle.Hair) -> None:
    for name, value in vars(outer(ours)).items():
        wanted = getattr(theirs, name)
        assert np.abs(value - wanted).max() <= RELATIVE * max(np.abs(wanted).max(), 1), name


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_the_oracle(name: str) -> None:
    """Fifty steps over all phases, each phase one step at least, compared at each phase's end.

    Where obstacles and held ends move, a longer time step takes them through their whole path.
    """
    scene = SCENES[name]()
    steps = [
        max(1, round(50 * p.steps(scene.dt) / (scene.duration / scene.dt))) for p in scene.phases
    ]
    steps[int(np.argmax(steps))] += 50 - sum(steps)
    assert sum(steps) == 50
    if "perm" not in name or name == "perm":
        scene = replace(scene, dt=scene.duration / 50)
    scene = scene.as_arrays()
    state = start(scene)
    theirs = outer(state)
    settings = oracle_settings(scene)
    bare = replace(scene, phases=())
    for phase, count in zip(scene.phases, steps, strict=True):
        setup = prepare(bare, phase.effects)
        effects = [as_oracle(effect) for effect in phase.effects]
        for number in range(count):
            time = np.float64(number * scene.dt)
            state = one_step(setup, state, time)
        theirs = oracle.run(theirs, settings, effects, count)
        assert_same(state, theirs)


@pytest.mark.parametrize("name", SCENES)
def test_first_step_of_every_phase_agrees_with_the_oracle(name: str) -> None:
    """From a state in mid-scene, at the paper's time step."""
    scene = SCENES[name]().as_arrays()
    ends = _runs(scene)
    before = start(scene)
    for phase in scene.phases:
        setup = prepare(replace(scene, phases=()), phase.effects)
        effects = [as_oracle(effect) for effect in phase.effects]
        theirs = oracle.step(outer(before), oracle_settings(scene), effects, 0.0)
        assert_same(one_step(setup, before, np.float64(0.0)), theirs)
        before = ends[phase.name]


def _runs(scene: Scene) -> dict[str, State]:
    return jh.run(scene)


def bend(points: np.ndarray) -> np.ndarray:
    """Total turn of each strand's edges [rad], shape (strands,)."""
    edges = np.diff(np.asarray(points), axis=1)
    edges /= np.linalg.norm(edges, axis=-1, keepdims=True)
    return np.arccos(np.clip((edges[:, 1:] * edges[:, :-1]).sum(-1), -1, 1)).sum(1)


def span(points: np.ndarray) -> np.ndarray:
    """Distance from root to tip over the strand's length, shape (strands,)."""
    points = np.asarray(points)
    length = np.linalg.norm(np.diff(points, axis=1), axis=-1).sum(1)
    return np.linalg.norm(points[:, -1] - points[:, 0], axis=1) / length


def test_bed_hair_stays_bent_where_it_dried_on_the_pillow() -> None:
    """Figure 4: with hydrogen bonds re-formed the bend stays after rising; without it goes."""
    dried = _runs(jh.scenes.bed_hair(strands=16, contact=False))
    wet = _runs(jh.scenes.bed_hair(strands=16, contact=False, dry=False))
    assert np.all(np.asarray(dried["asleep"].fractions[:, 0]) > 0.99)
    assert np.all(np.asarray(wet["morning"].fractions[:, 0]) == 0)
    assert bend(dried["asleep"].points).min() > 0.5
    kept, lost = bend(dried["morning"].points), bend(wet["morning"].points)
    assert np.median(kept) > 1.25 * np.median(lost)
    natural = np.asarray(start(jh.scenes.bed_hair(strands=16)).shapes)
    assert np.abs(natural).max() == 0
    hydrogen = np.asarray(dried["morning"].shapes[:, 0])
    assert np.linalg.norm(hydrogen, axis=1).max() > 0.1


def test_hair_near_the_wind_dries_more_and_curls_more() -> None:
    """Figure 5: hydrogen fraction and remembered curl fall with the distance from the axis."""
    scene = jh.scenes.blow_dry(strands=40, contact=False)
    ends = _runs(scene)
    distance = np.abs(np.asarray(scene.strands.positions)[:, 0, 0])
    hydrogen = np.asarray(ends["hang"].fractions[:, 0]).mean(0)
    near, far = distance < 0.03, distance > 0.09
    assert near.sum() >= 5
    assert far.sum() >= 5
    assert hydrogen[near].mean() > 1.7 * hydrogen[far].mean()
    assert np.all((hydrogen >= 0) & (hydrogen <= 1))
    curl = bend(ends["hang"].points)
    assert curl[near].mean() > 1.8 * curl[far].mean()


@pytest.mark.parametrize("winding", [True, False], ids=["wound by a rod", "prepared"])
def test_perm_curls_and_without_it_the_hair_is_straight(winding: bool) -> None:
    """Figure 6."""
    options = {"strands": 4, "contact": False, "winding": winding, "seconds": 17.0}
    permed = _runs(jh.scenes.perm(**options))["released"]
    plain = _runs(jh.scenes.perm(**options, treated=False))["released"]
    assert span(permed.points).max() < 0.85
    assert bend(permed.points).min() > 2.0
    assert span(plain.points).min() > 0.99
    assert bend(plain.points).max() < 0.1


def test_scenes_have_the_papers_numbers() -> None:
    """Table 1."""
    for make, strands, length in (
        (jh.scenes.bed_hair, 200, 0.24),
        (jh.scenes.blow_dry, 200, 0.24),
        (jh.scenes.perm, 100, 0.48),
    ):
        scene = make()
        assert scene.strands.count == strands
        assert np.asarray(scene.strands.lengths).sum() == pytest.approx(length)
        assert (scene.strands.points - 1) / length / 100 == pytest.approx(0.33, rel=0.02)
        assert scene.dt == pytest.approx(1 / 360)
        assert scene.solver.iterations == 5
        assert scene.fibre.stiffness == 0.05
        assert scene.fibre.peeling_rate == 0.33
        assert np.asarray(scene.bonds.influence) == pytest.approx([0.33, 0.30, 0.20, 0.17])


def test_first_keeps_the_beginning_of_a_scene() -> None:
    scene = jh.scenes.bed_hair(strands=2)
    assert [p.name for p in scene.first(1.5).phases] == ["lie down", "asleep"]
    assert scene.first(1.5).duration == pytest.approx(1.5)
    assert scene.first(99.0).duration == pytest.approx(scene.duration)


def test_a_simulated_winding_stays_on_the_rod() -> None:
    """All that was taken up lies about the rod at the end; its edges cut 3.5 mm deep into it."""
    radius = 0.03
    scene = jh.scenes.perm(strands=2, points=33, rod_diameter=2 * radius, contact=False)
    wind = scene.phases[0]
    points = jh.run(replace(scene, phases=(wind,)))[wind.name].points[:, 16:]
    axis = np.array([radius, 2 * radius + 0.8 * 0.48])
    distance = np.linalg.norm(np.asarray(points)[..., [0, 2]] - axis, axis=-1)
    assert distance.min() > 0.7 * radius
    assert distance.max() < 1.2 * radius
