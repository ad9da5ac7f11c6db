"""Measured curls and strands from files: what is built from them, and what a fit of them finds."""

from functools import cache

import jax
import numpy as np
import pytest

import fitting
import jaxhair as jh
from fitting import measures
from fitting.measured import Seen, from_text
from fitting.strands import curl_shape

FREE: dict[str, fitting.Constraint] = {
    "bonds.influence": fitting.Simplex(),
    "fibre.peeling_rate": fitting.Positive(),
}
SET = 1e-3

GOOD = """
[hair]
rod_diameter = 20e-3
length = 0.1
points = 21
natural_curl_diameter = 0.1
[[state]]
name = "a"
treatment = "water set"
set = 0.5
[[state]]
name = "b"
treatment = "perm"
wave_efficiency = 0.4
after_wash = true
"""


def test_diameters_follow_from_the_numbers_by_hand() -> None:
    """1/D = 1/0.1 + 0.5 (1/0.02 - 1/0.1) = 30 and D = 0.02 / 0.4."""
    measured = from_text(GOOD, name="good.toml")
    a, b = measured.targets["a"], measured.targets["b"]
    assert isinstance(a, fitting.Helix)
    assert isinstance(b, fitting.Helix)
    assert a.diameter == pytest.approx(1 / 30)
    assert b.diameter == pytest.approx(0.05)
    names = [phase.name for phase in measured.scene.phases]
    assert names.index("a") < names.index("b, before") < names.index("b")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[hair]", "[hair", ["x.toml", "not TOML"]),
        ("[hair]", "[fur]", ["x.toml", "[hair]"]),
        ("rod_diameter = 20e-3", "", ["rod_diameter", "None", "above 0"]),
        ("length = 0.1", "length = -0.1", ["length", "-0.1", "above 0"]),
        ("length = 0.1", 'length = "long"', ["length", "'long'"]),
        ("points = 21", "points = 2", ["points", "2", "at least 3", "1000"]),
        ("set = 0.5", "set = 1.5", ["state 1", "set", "1.5", "below 1"]),
        ("set = 0.5", "set = 0.5\nwave_efficiency = 0.5", ["state 1", "one of set"]),
        ("set = 0.5", "", ["state 1", "one of set"]),
        ('"water set"', '"magic"', ["state 1", "treatment", "'magic'", "acid set"]),
        ('name = "a"', "", ["state 1", "name"]),
        ("set = 0.5", "set = 0.5\ncolour = 1", ["state 1", "'colour'", "unknown"]),
        ('name = "b"', 'name = "a"', ["'a'", "must differ"]),
    ],
)
def test_wrong_entries_are_refused(old: str, new: str, words: list[str]) -> None:
    assert old in GOOD
    with pytest.raises(ValueError) as error:
        from_text(GOOD.replace(old, new, 1), name="x.toml")
    for word in words:
        assert word in str(error.value)


def test_the_packaged_curls_give_their_published_set() -> None:
    """Water set: f_H = 0.58. After the perm's wash the set S = (f_I + 0.2 f_S) / (1 - f_H) gives
    1/D = 1/Dn + S (1/Drod - 1/Dn) = 0.612 / Drod with Dn = 113.2 mm and Drod = 20 mm."""
    measured = fitting.packaged()
    found = fitting.fit(measured.scene, measured.targets, FREE)
    f = found.values["bonds.influence"]
    assert found.converged
    assert found.residual_mm < 0.05
    assert f[0] == pytest.approx(0.58, abs=SET)
    wanted = (0.612 / 20 - 1 / 113.2) / (1 / 20 - 1 / 113.2)
    assert (f[1] + 0.2 * f[2]) / (1 - f[0]) == pytest.approx(wanted, abs=SET)
    named = [set(direction.change) for direction in found.undetermined]
    assert {"fibre.peeling_rate"} in named
    assert any("bonds.influence[disulfide]" in names for names in named)


def helix(diameter: float, pitch: float, length: float, points: int, hand: int = 1) -> np.ndarray:
    climb = np.arctan2(pitch, np.pi * diameter)
    s = np.linspace(0, length, points)
    angle = 2 * np.cos(climb) / diameter * s
    round_ = diameter / 2 * np.stack([np.cos(angle), hand * np.sin(angle)], 1)
    return np.concatenate([round_, np.sin(climb) * s[:, None]], 1)


@cache
def curls(hand: int = 1) -> jh.Curves:
    return jh.Curves.from_list([helix(25e-3, 12e-3, 0.12, 80, hand) + shift for shift in (0, 0.1)])


@pytest.mark.parametrize("hand", [1, -1], ids=["right", "left"])
def test_curl_shape_of_a_helix(hand: int) -> None:
    diameter, climb = curl_shape(curls(hand), np.arange(2))
    assert diameter == pytest.approx(25e-3, rel=0.02)
    assert np.tan(climb) == pytest.approx(hand * 12 / (np.pi * 25), rel=0.02)


@pytest.mark.parametrize("hand", [1, -1], ids=["right", "left"])
def test_a_helix_is_fitted_with_the_set_that_it_needs(hand: int) -> None:
    measured = fitting.from_strands({"permed": curls(hand)}, rod_diameter=15e-3)
    found = fitting.fit(measured.scene, measured.targets, FREE)
    f = found.values["bonds.influence"]
    assert found.converged
    assert found.residual_mm < 0.3
    assert f[0] + f[1] + 0.2 * f[2] == pytest.approx(15 / 25, abs=0.02)


def test_strands_of_different_lengths_in_two_states() -> None:
    long, short = helix(25e-3, 8e-3, 0.12, 60), helix(25e-3, 8e-3, 0.09, 40)
    observed = {"washed": jh.Curves.from_list([long, short]), "permed": curls()}
    measured = fitting.from_strands(observed, points=15)
    names = [phase.name for phase in measured.scene.phases]
    assert names.index("permed") < names.index("washed")
    lengths = np.asarray(measured.scene.strands.lengths).sum(1)
    assert lengths[1] / lengths[0] == pytest.approx(0.75, rel=1e-3)


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        ({"observed": {}}, ["observed", "at least one"]),
        ({"observed": {"dyed": 1}}, ["'dyed'", "permed"]),
        ({"rod_diameter": 30e-3}, ["30.0 mm", "25.0 mm", "thinner"]),
        ({"rod_diameter": -1.0}, ["rod_diameter", "-1.0", "above 0"]),
        ({"strands": 0}, ["strands", "0", "at least 1"]),
        ({"points": 2}, ["points", "2", "at least 3"]),
        ({"observed": {"permed": "two points"}}, ["2 points", "3 or more"]),
        ({"observed": {"permed": "none"}}, ["no strand"]),
        ({"observed": {"permed": "two", "washed": "one"}}, ["different numbers", "2", "1"]),
    ],
)
def test_strands_that_cannot_be_used_are_refused(request_: dict, words: list[str]) -> None:
    samples = {
        "two": curls(),
        "one": jh.Curves.from_list([helix(25e-3, 8e-3, 0.1, 30)]),
        "two points": jh.Curves.from_list([np.array([[0.0, 0, 0], [0, 0, 0.1]])]),
        "none": jh.Curves(np.zeros((0, 3, 3)), np.zeros(0, int)),
    }
    observed = request_.get("observed", {"permed": "two"})
    request_ = {**request_, "observed": {s: samples.get(x, x) for s, x in observed.items()}}
    with pytest.raises(ValueError) as error:
        fitting.from_strands(**request_)
    for word in words:
        assert word in str(error.value)


def test_straight_strands_make_a_scene() -> None:
    line = np.linspace([0.0, 0, 0], [0, 0, -0.1], 20)
    measured = fitting.from_strands({"washed": jh.Curves.from_list([line])})
    assert measured.scene.strands.points >= 9


EXPERIMENTS = """
title = "the same hair on two rods"
[hair]
rod_diameter = 15e-3
length = 0.1
points = 15

[[experiment]]
name = "thin"
[[experiment.state]]
name = "water set"
treatment = "water set"
curl_diameter = 33.333e-3
curl_diameter_error = 0.1e-3

[[experiment]]
name = "thick"
rod_diameter = 20e-3
length = 0.12
[[experiment.state]]
name = "water set"
treatment = "water set"
curl_diameter = 44.444e-3
curl_diameter_error = 0.1e-3
"""


def test_experiments_from_a_file() -> None:
    """Both have a set of 0.45, on rods and hair of their own."""
    found = from_text(EXPERIMENTS, name="two.toml")
    assert found.states == ["thin/water set", "thick/water set"]
    assert isinstance(found.scene, dict)
    result = fitting.fit(found.scene, found.targets, {"bonds.influence": fitting.Simplex()})
    assert float(result.values["bonds.influence"][0]) == pytest.approx(0.45, abs=2e-3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "thick"', 'name = "thin"', "experiment 2: name is 'thin'"),
        ('name = "thick"', 'name = "a/b"', "no '/'"),
        ("curl_diameter_error = 0.1e-3", "", "curl_diameter_error"),
        ('name = "thin"', 'name = "thin"\nweight = 1', "weight"),
        ('name = "thin"', 'name = "thin"\ncolour = 1', "'colour' is unknown"),
        ("[[experiment.state]]", "[[experiment.other]]", "'other' is unknown"),
        ("[[experiment]]\n", '[[state]]\nname="a"\n[[experiment]]\n', "content"),
    ],
)
def test_wrong_experiments_are_refused(old: str, new: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        from_text(EXPERIMENTS.replace(old, new), name="two.toml")


SEEN = """
[hair]
rod_diameter = 12e-3
length = 0.1
points = 17
[[experiment]]
name = "dry"
[[experiment.state]]
name = "acid set"
treatment = "acid set"
set = 0.5
[[experiment]]
name = "other"
hydrogen_left = 0.4
[[experiment.state]]
name = "acid set"
treatment = "acid set"
set = 0.5
"""


def ends(text: str) -> dict[str, jh.State]:
    """How the acid set of each experiment is seen."""
    found = from_text(text, name="seen.toml")
    assert isinstance(found.scene, dict)
    return {name: jax.jit(jh.run)(scene)["acid set"] for name, scene in found.scene.items()}


def test_damp_air_takes_back_the_hydrogen_bonds_part_of_a_set() -> None:
    """D_rod / D = (x f_H + f_I) / (x f_H + f_I + f_S + f_P) with x of the hydrogen bonds left."""
    seen = ends(SEEN)
    for name, left in (("dry", 1.0), ("other", 0.4)):
        diameter = float(measures.curl(seen[name].points).diameter[0])
        assert 12e-3 / diameter == pytest.approx((left + 1) / (left + 3), rel=2e-3)


def test_a_load_at_the_tip_draws_a_curl_out() -> None:
    """A hair of 0.66 mg and a curl of B kappa^2 = 5 mg: loads of 1 mg and of 20 mg, when the hair
    is looked at and not before. What a load does to a rod is in test_mechanics."""
    masses = {"dry": 1e-6, "other": 20e-6}
    text = SEEN.replace('name = "dry"', f'name = "dry"\nweight = true\ntip_mass = {masses["dry"]}')
    text = text.replace("hydrogen_left = 0.4", f"weight = true\ntip_mass = {masses['other']}")
    scenes = from_text(text, name="seen.toml").scene
    assert isinstance(scenes, dict)
    for name, mass in masses.items():
        leaves = jh.named_leaves(scenes[name])
        loads = [leaf for leaf in leaves if "TipForce" in leaf]
        assert loads == ["phases.acid set.TipForce.force"]
        np.testing.assert_allclose(leaves[loads[0]], (0, 0, -9.8 * mass), rtol=1e-6)
        assert isinstance(scenes[name].fibre, jh.PhysicalFibre)
        assert isinstance(scenes[name].solver, jh.Direct)
    drawn = {name: float(measures.extent(end.points)[0]) / 0.1 for name, end in ends(text).items()}
    assert drawn["dry"] < 0.85
    assert 0.93 < drawn["other"] < 1


def test_a_small_load_at_the_tip_bends_a_level_hair_as_a_cantilever() -> None:
    """Beside its own weight's w L^4 / (8 E I): m g L^3 / (3 E I), less the second order's share of
    the slope^2. The first edge is held, and clamped in its middle."""
    length, mass, edges = 10e-3, 2e-7, 40
    edge = length / (edges - 0.5)
    hair = jh.Strands.straight(
        [[-edge / 2, 0, 0]], (1.0, 0, 0), length=edges * edge, points=edges + 1, dtype="float64"
    )
    fibre = jh.PhysicalFibre(peeling_rate=0.0)
    drop = []
    for load in (None, mass):
        phases = tuple(Seen(True, load).phases([jh.Phase("seen", 1.0, jh.treatments.HANGING)]))
        scene = jh.Scene(hair, fibre, phases=phases, solver=jh.Direct(newton_steps=2))
        drop.append(-float(jax.jit(jh.run)(scene)["seen"].points[0, -1, 2]))
    stiff = 3.89e9 * np.pi * 40e-6**4 / 4
    weight = 9.8 * 1320 * np.pi * 40e-6**2
    assert drop[0] == pytest.approx(weight * length**4 / 8 / stiff, rel=5e-3)
    assert drop[1] - drop[0] == pytest.approx(mass * 9.8 * length**3 / 3 / stiff, rel=5e-3)


@pytest.mark.parametrize(
    ("new", "words"),
    [
        ("hydrogen_left = 1.2", ["experiment 2", "hydrogen_left", "1.2", "[0, 1]"]),
        ('hydrogen_left = "60 %"', ["experiment 2", "hydrogen_left", "'60 %'"]),
        ("weight = true\ntip_mass = 0", ["experiment 2", "tip_mass", "0", "above 0"]),
        ("tip_mass = 1e-5", ["experiment 2", "tip_mass", "1e-05", "weight is not true"]),
        ("humidity = 0.4", ["experiment 2", "'humidity'", "hydrogen_left", "unknown"]),
    ],
)
def test_wrong_circumstances_are_refused(new: str, words: list[str]) -> None:
    with pytest.raises(ValueError) as error:
        from_text(SEEN.replace("hydrogen_left = 0.4", new), name="seen.toml")
    for word in words:
        assert word in str(error.value)
