"""Freed numbers, their constraints, and what a Jacobian determines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxhair as jh
from fitting.determined import undetermined

HAIR = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.1, points=12)
SCENE = jh.Scene(HAIR, phases=jh.treatments.perm(rod_diameter=20e-3))
CASES = {
    "simplex": (fitting.Simplex(), np.array([0.4, 0.3, 0.2, 0.1])),
    "positive": (fitting.Positive(), np.array([0.33])),
    "interval": (fitting.Interval(-1.0, 3.0), np.array([2.5, 0.0])),
    "unbounded": (fitting.Unbounded(), np.array([-7.0, 1e3])),
}


@pytest.mark.parametrize(("constraint", "value"), CASES.values(), ids=CASES)
def test_there_and_back(constraint: fitting.Constraint, value: np.ndarray) -> None:
    free = constraint.free(value)
    assert np.asarray(constraint.value(jnp.asarray(free), value)) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("size", [-700.0, 0.0, 700.0])
def test_bounds_hold_and_slopes_are_finite_far_out(size: float) -> None:
    for name in ("simplex", "interval"):
        constraint, value = CASES[name]
        free = jnp.full(constraint.free(value).shape, size)
        found = np.asarray(constraint.value(free, value))
        slope = jax.jacfwd(lambda x, c=constraint, v=value: c.value(x, v))(free)
        assert np.all(np.isfinite(found))
        assert np.all(np.isfinite(slope))
        if name == "simplex":
            assert found.sum() == pytest.approx(1)
            assert found.min() >= 0
        else:
            assert found.min() >= -1
            assert found.max() <= 3


@pytest.mark.parametrize(
    ("constraint", "value"),
    [
        (fitting.Simplex(), np.array([0.5, -0.5])),
        (fitting.Simplex(), np.array([0.0, 0.0])),
        (fitting.Positive(), np.array([0.0])),
        (fitting.Interval(0.0, 1.0), np.array([1.5])),
    ],
)
def test_a_start_outside_is_refused(constraint: fitting.Constraint, value: np.ndarray) -> None:
    with pytest.raises(ValueError, match="must be"):
        constraint.free(value)


def test_an_empty_interval_is_refused() -> None:
    with pytest.raises(ValueError, match=r"high is 1\.0; it must be above low, 1\.0"):
        fitting.Interval(1.0, 1.0)


def test_parameters_pack_label_and_apply() -> None:
    parameters = fitting.Parameters(
        SCENE,
        {
            "bonds.influence": fitting.Simplex(),
            "phases.*.Wound.diameter": fitting.Interval(1e-2, 3e-2),
            "fibre.peeling_rate": fitting.Positive(),
        },
    )
    free = parameters.packed()
    assert free.shape == (3 + 1 + 1,)
    assert parameters.labels() == [
        *(f"bonds.influence[{kind}]" for kind in jh.BONDS),
        "phases.*.Wound.diameter",
        "fibre.peeling_rate",
    ]
    changed = parameters.apply(free.at[3].add(0.5))[""]
    leaves = jh.named_leaves(changed)
    assert leaves["phases.perm, wound.Wound.diameter"] == leaves["phases.perm, set.Wound.diameter"]
    assert 20e-3 < float(leaves["phases.perm, set.Wound.diameter"]) < 3e-2
    assert np.asarray(leaves["bonds.influence"]) == pytest.approx([0.33, 0.30, 0.20, 0.17])


def test_leaves_that_start_apart_cannot_be_one_parameter() -> None:
    scene = SCENE.then(*jh.treatments.water_set(rod_diameter=30e-3))
    with pytest.raises(ValueError, match="start with different values"):
        fitting.Parameters(scene, {"phases.*.Wound.diameter": fitting.Positive()})


def free_pair() -> tuple[fitting.Parameters, jax.Array]:
    parameters = fitting.Parameters(
        SCENE, {"fibre.stiffness": fitting.Unbounded(), "fibre.peeling_rate": fitting.Unbounded()}
    )
    return parameters, parameters.packed()


@pytest.mark.parametrize(
    ("jacobian", "directions"),
    [
        ([[1.0, 0], [0, 2], [3, 1]], []),
        ([[1.0, 0], [2, 0], [3, 0]], [{"fibre.peeling_rate": 1.0}]),
        ([[1.0, 1], [2, 2], [3, 3]], [{"fibre.stiffness": 1.0, "fibre.peeling_rate": -1.0}]),
        ([[1.0, 1]], [{"fibre.stiffness": 1.0, "fibre.peeling_rate": -1.0}]),
    ],
    ids=["all seen", "one unseen", "only the sum seen", "fewer data than numbers"],
)
def test_undetermined_directions(jacobian: list, directions: list[dict[str, float]]) -> None:
    found, singular = undetermined(*free_pair(), np.array(jacobian), noise=0.01)
    assert len(singular) == 2
    assert len(found) == len(directions)
    for direction, wanted in zip(found, directions, strict=True):
        assert direction.uncertainty > 1e10
        sign = (
            1 if direction.change["fibre.peeling_rate"] * wanted["fibre.peeling_rate"] > 0 else -1
        )
        change = {name: sign * value for name, value in direction.change.items()}
        assert change == pytest.approx(wanted)


def test_noise_decides_what_is_determined() -> None:
    jacobian = np.diag([1.0, 0.1])
    assert undetermined(*free_pair(), jacobian, noise=0.02)[0] == ()
    found, _ = undetermined(*free_pair(), jacobian, noise=0.05)
    assert [d.change for d in found] == [{"fibre.peeling_rate": 1.0}]
    assert found[0].uncertainty == pytest.approx(0.5)


def test_a_jacobian_that_is_not_finite_determines_nothing() -> None:
    found, _ = undetermined(*free_pair(), np.array([[np.nan, 1.0]]), noise=0.1)
    assert found[0].uncertainty == np.inf
    assert set(found[0].change) == {"fibre.stiffness", "fibre.peeling_rate"}
