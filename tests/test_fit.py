"""Fits: twin experiments, what the data determine, and the three optimisers."""

from typing import Any

import jax
import numpy as np
import pytest

import fitting
import jaxhair as jh
from jaxhair import treatments

NOISE = 1e-4  # m
INFLUENCE, RATE = 0.02, 0.1  # how near a twin experiment must come, the rate relative
FREE: dict[str, fitting.Constraint] = {
    "bonds.influence": fitting.Simplex(),
    "fibre.peeling_rate": fitting.Positive(),
}
STATES = ("water set", "acid set", "perm", "washed")


def experiment() -> jh.Scene:
    """One strand of 20 cm, treated three times and washed, hanging for half a second each time."""
    options: dict[str, Any] = {"rod_diameter": 20e-3, "climb": 0.15, "seconds": 0.5}
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.2, points=33)
    return jh.Scene(
        hair,
        jh.Fibre(stiffness=0.9, peeling_rate=1.0),
        jh.Bonds((0.25, 0.25, 0.25, 0.25)),
        (
            *treatments.water_set(**options),
            *treatments.wash(name="wash between", seconds=0.2),
            *treatments.acid_set(**options),
            *treatments.perm(**options),
            *treatments.wash(seconds=0.5),
        ),
    )


def observed(influence: np.ndarray, rate: float, seed: int) -> dict[str, fitting.Target]:
    """The states of hair with the given numbers, with noise."""
    truth = jh.replace_leaves(
        experiment(), {"bonds.influence": influence, "fibre.peeling_rate": rate}
    )
    ends = jax.jit(jh.run)(truth)
    rng = np.random.default_rng(seed)
    return {
        name: fitting.Shape(np.asarray(ends[name].points) + rng.normal(0, NOISE, (1, 33, 3)))
        for name in STATES
    }


@pytest.mark.parametrize(
    ("influence", "rate"),
    [
        pytest.param((0.33, 0.30, 0.20, 0.17), 0.33, id="table 1"),
        pytest.param((0.15, 0.45, 0.10, 0.30), 0.8, id="other hair", marks=pytest.mark.slow),
    ],
)
def test_four_states_determine_every_influence_and_the_peeling_rate(
    influence: tuple[float, ...], rate: float
) -> None:
    found = fitting.fit(experiment(), observed(np.array(influence), rate, seed=0), FREE)
    assert found.converged
    assert found.undetermined == ()
    assert found.residual_mm == pytest.approx(1e3 * NOISE * np.sqrt(3), rel=0.15)
    assert np.abs(found.values["bonds.influence"] - influence).max() < INFLUENCE
    assert found.values["fibre.peeling_rate"] == pytest.approx(rate, rel=RATE)
    assert found.values["bonds.influence"].sum() == pytest.approx(1)


def test_one_state_leaves_combinations_undetermined_and_names_them() -> None:
    """A perm shows f_H + f_I + 0.2 f_S; two combinations of influences keep that sum."""
    targets = observed(np.array([0.33, 0.30, 0.20, 0.17]), 0.33, seed=1)
    found = fitting.fit(experiment(), {"perm": targets["perm"]}, FREE)
    assert found.converged
    assert len(found.undetermined) == 2
    for direction in found.undetermined:
        change = np.array(
            [direction.change.get(f"bonds.influence[{kind}]", 0.0) for kind in jh.BONDS]
        )
        assert np.abs(change).max() == pytest.approx(1)
        assert change.sum() == pytest.approx(0, abs=0.03)
        # What the earlier water and acid sets left is washed out but for the ionic share, so the
        # perm's own sum is what is seen: it must not change along the direction.
        assert change @ [1, 1, 0.2, 0] == pytest.approx(0, abs=0.1)
    assert found.values["fibre.peeling_rate"] == pytest.approx(0.33, rel=0.5)
    assert "do not determine" in str(found)


@pytest.mark.parametrize("method", ["adam", pytest.param("l-bfgs", marks=pytest.mark.slow)])
def test_gradient_methods_find_the_same_curl(method: str) -> None:
    """The set of a water set is the hydrogen influence."""
    options: dict[str, Any] = {"rod_diameter": 30e-3, "seconds": 0.05, "free": (jh.Hold(),)}
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.1, points=12)
    scene = jh.Scene(hair, phases=treatments.water_set(**options)[:-1])
    target = fitting.helix(diameter=30e-3 / 0.45)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # for optax
        found = fitting.fit(
            scene,
            {"water set, unloaded": target},
            {"bonds.influence": fitting.Simplex()},
            method=method,
            steps=300,
            tolerance=1e-6,
        )
    assert found.values["bonds.influence"][0] == pytest.approx(0.45, abs=2e-3)
    assert found.residual_mm < 0.1


@jh.pytree
class Counted(fitting.Helix):
    """A helix that notes every simulation that is compared with it."""

    def residuals(self, state: jh.State, lengths: jax.Array) -> jax.Array:
        jax.debug.callback(lambda: COMPARED.append(1))
        return super().residuals(state, lengths)


COMPARED: list[int] = []


@pytest.mark.parametrize(("method", "later"), [("levenberg-marquardt", 0), ("l-bfgs", 1)])
def test_all_simulations_are_counted(method: str, later: int) -> None:
    """Those of a line search too. The result's Jacobian takes another one, if it is not kept."""
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.1, points=7)
    scene = jh.Scene(hair, phases=treatments.water_set(rod_diameter=30e-3)[:-1])
    told: list[int] = []
    COMPARED.clear()
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # for optax
        found = fitting.fit(
            scene,
            {"water set, unloaded": Counted(80e-3, 0.0)},
            {"bonds.influence": fitting.Simplex()},
            method=method,
            steps=4,
            retries=0,
            progress=lambda simulations, *_: told.append(simulations),
        )
    jax.effects_barrier()
    assert len(COMPARED) == found.steps + later
    assert told[-1] == found.steps
    assert (found.steps > len(told)) == (method == "l-bfgs")


def test_a_rod_shared_by_phases_is_one_parameter() -> None:
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.1, points=21)
    phases = treatments.perm(rod_diameter=15e-3, climb=0.2, seconds=0.02, free=(jh.Hold(),))
    scene = jh.Scene(hair, phases=phases)
    pitch = np.pi * 30e-3 * np.tan(0.2)
    found = fitting.fit(
        scene,
        {"perm": fitting.helix(diameter=30e-3, pitch=pitch)},
        {"phases.*.Wound.diameter": fitting.Interval(8e-3, 40e-3)},
    )
    # D = D_rod / S with S = 0.33 + 0.30 + 0.2 * 0.20 = 0.67
    assert found.values["phases.*.Wound.diameter"] == pytest.approx(0.67 * 30e-3, rel=1e-3)
    assert found.residual_mm < 0.01
    names = [n for n in jh.named_leaves(found.scene) if n.endswith("Wound.diameter")]
    leaves = jh.named_leaves(found.scene)
    assert len(names) == 2
    assert leaves[names[0]] == leaves[names[1]]


def test_an_unreachable_curl_is_met_as_well_as_can_be() -> None:
    """A curl tighter than the rod: the residual says so, and all is finite."""
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.1, points=15)
    scene = jh.Scene(
        hair, phases=treatments.perm(rod_diameter=30e-3, seconds=0.02, free=(jh.Hold(),))
    )
    found = fitting.fit(
        scene, {"perm": fitting.helix(diameter=15e-3)}, {"bonds.influence": fitting.Simplex()}
    )
    assert found.residual_mm > 1
    assert np.all(np.isfinite(found.values["bonds.influence"]))


def test_progress_is_told_of_every_simulation() -> None:
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.1, points=12)
    scene = jh.Scene(
        hair, phases=treatments.water_set(rod_diameter=30e-3, seconds=0.02, free=(jh.Hold(),))
    )
    told: list[tuple[int, float, dict[str, np.ndarray]]] = []
    found = fitting.fit(
        scene,
        {"water set": fitting.helix(diameter=80e-3)},
        {"bonds.influence": fitting.Simplex()},
        progress=lambda *now: told.append(now),
    )
    assert [step for step, *_ in told] == list(range(1, found.steps + 1))
    assert told[-1][1] < told[0][1]
    np.testing.assert_allclose(told[0][2]["bonds.influence"], scene.bonds.influence, rtol=1e-6)
    np.testing.assert_allclose(told[-1][2]["bonds.influence"], found.values["bonds.influence"])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"targets": {}}, ["targets", "at least one phase"]),
        ({"targets": {"nowhere": fitting.helix(diameter=1.0)}}, ["'nowhere'", "'water set'"]),
        ({"free": {}}, ["free", "at least one leaf"]),
        ({"free": {"bonds.colour": fitting.Positive()}}, ["'bonds.colour'", "bonds.influence"]),
        ({"free": {"bonds.influence": 3}}, ["bonds.influence", "constraint"]),
        ({"free": {"fibre.stiffness": fitting.Interval(0.5, 1.0)}}, ["0.05", "[0.5, 1.0]"]),
        ({"method": "magic"}, ["method", "'magic'", "levenberg-marquardt"]),
        ({"steps": 0}, ["steps", "0", "at least 1"]),
        ({"tolerance": -1.0}, ["tolerance", "-1.0", "above 0"]),
    ],
)
def test_bad_requests_are_refused(change: dict[str, Any], words: list[str]) -> None:
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.1, points=12)
    scene = jh.Scene(hair, phases=treatments.water_set(rod_diameter=30e-3))
    request: dict[str, Any] = {
        "targets": {"water set": fitting.helix(diameter=80e-3)},
        "free": {"bonds.influence": fitting.Simplex()},
    }
    with pytest.raises(ValueError) as error:
        fitting.fit(scene, **{**request, **change})
    for word in words:
        assert word in str(error.value)
