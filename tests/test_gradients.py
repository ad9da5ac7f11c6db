"""Derivatives of a final curl, end to end, in both modes, against central differences."""

import importlib
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair.treatments import AT_ONCE

FREE_OF_CONTACT = 1e-6  # relative, 300 steps
IN_CONTACT = 1e-4  # relative, 50 steps
MODES = 1e-9  # forward against reverse, relative

STEPS = 1 / 360
BLOCKS = 8  # steps, beyond which states are kept in blocks here
RUNNING = importlib.import_module("jaxhair.simulate")  # hidden by the function of that name


def hair(strands: int = 2) -> jh.Strands:
    roots = np.zeros((strands, 3)) + np.array([0.0, 0.004, 0.0]) * np.arange(strands)[:, None]
    return jh.Strands.straight(roots, (0.0, 0.1, -1.0), length=0.24, points=9, dtype="float64")


def perm(numbers: dict[str, Any], contact: bool) -> jh.Scene:
    """Wound, treated, released into the wind: 300 steps, or 50 with contact and obstacles."""
    rod = jh.Wound(2 * numbers["rod_radius"], 0.1)
    wind = jh.DryingWind((0.0, -0.3, -0.1), (0.05, 0.3, -0.1), numbers["wind"])
    free: tuple[Any, ...] = (jh.Hold(), jh.Gravity(), jh.Drag(0.2), wind)
    steps = 298
    if contact:
        steps = 48
        free += (
            jh.HairContact(radius=4e-3, strength=20.0),
            jh.Sphere((0.0, 0.05, -0.06), 0.04, 0.3),
            jh.Floor(-0.1, 0.4),
        )
    return jh.Scene(
        hair(),
        jh.Fibre(numbers["stiffness"], peeling_rate=numbers["peeling_rate"]),
        jh.Bonds(numbers["influence"]),
        (
            jh.Phase("wound", AT_ONCE, (rod, jh.Cut(hydrogen=0.2, ionic=0.0, disulfide=0.8))),
            jh.Phase("set", AT_ONCE, (rod, jh.Reform(ionic=1.0, disulfide=1.0))),
            jh.Phase("released", steps * STEPS, free),
        ),
    )


START: dict[str, Any] = {
    "influence": np.array([0.33, 0.30, 0.20, 0.17]),
    "peeling_rate": 0.9,
    "stiffness": 0.3,
    "rod_radius": 0.035,
    "wind": 60.0,
}


@partial(jax.jit, static_argnums=1)
def tip(numbers: dict[str, Any], contact: bool) -> jax.Array:
    """A smooth function of the final curl: tips and middles of the strands."""
    points = jh.run(perm(numbers, contact))["released"].points
    weights = jnp.arange(1.0, 1.0 + points.size).reshape(points.shape) / points.size
    return jnp.sum(jnp.sin(20 * points) * weights)


def as_arrays() -> dict[str, Any]:
    return {name: jnp.asarray(value) for name, value in START.items()}


def central(f: Callable[[dict[str, Any]], Any], name: str, step: float) -> np.ndarray:
    """Fourth-order central differences in every entry of one number."""
    value = np.asarray(START[name], float)
    slopes = np.zeros(value.shape)
    for place in np.ndindex(value.shape):
        shift = np.zeros(value.shape)
        shift[place] = step * abs(value[place])
        at = {
            k: float(f({**as_arrays(), name: jnp.asarray(value + k * shift)}))
            for k in (-2, -1, 1, 2)
        }
        slopes[place] = (8 * (at[1] - at[-1]) - (at[2] - at[-2])) / (12 * shift[place])
    return slopes


@pytest.mark.parametrize(
    "contact",
    [pytest.param(False, id="free", marks=pytest.mark.slow), pytest.param(True, id="contact")],
)
def test_gradients_agree_with_central_differences_and_between_modes(
    contact: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(RUNNING, "FEW", BLOCKS)
    f = partial(tip, contact=contact)
    reverse = jax.jit(jax.grad(lambda n: tip(n, contact)))(as_arrays())
    forward = jax.jit(jax.jacfwd(lambda n: tip(n, contact)))(as_arrays())
    tolerance = IN_CONTACT if contact else FREE_OF_CONTACT
    for name in START:
        scale = np.abs(reverse[name]).max()
        assert scale > 0, name
        assert np.abs(forward[name] - reverse[name]).max() <= MODES * scale, name
        step = 1e-6 if contact else 1e-4
        found = central(f, name, step)
        assert np.abs(found - np.asarray(reverse[name])).max() <= tolerance * scale, name


def test_simulated_winding_has_finite_gradients() -> None:
    scene = jh.scenes.perm(
        strands=2, points=9, length=0.24, rod_diameter=0.07, seconds=0.2, contact=False
    )

    def loss(values: dict[str, Any]) -> jax.Array:
        changed = jh.replace_leaves(scene, values)
        return jnp.sum(jh.run(changed)["released"].points ** 2)

    start = {"bonds.influence": jnp.asarray([0.33, 0.3, 0.2, 0.17]), "fibre.stiffness": 0.05}
    slopes = jax.jit(jax.jacfwd(loss))(start)
    assert all(np.all(np.isfinite(g)) and np.any(g != 0) for g in slopes.values())


def test_contact_may_be_left_out_of_gradients() -> None:
    """Values stay bit for bit; the gradient is that of a run with the pushes given."""
    hair = jh.Strands.straight(
        [[0.0, 0, 0], [0.0, 1e-3, 0]], (0.0, 0, -1.0), length=0.2, points=5, dtype="float64"
    )

    def end(strength: Any, in_gradients: bool) -> jax.Array:
        contact = jh.HairContact(2e-3, strength, in_gradients)
        phase = jh.Phase("only", 10 * STEPS, (jh.Hold(), contact))
        return jh.run(jh.Scene(hair, phases=(phase,)))["only"].points[1, -1, 1]

    values, slopes = zip(
        *(jax.value_and_grad(partial(end, in_gradients=b))(20.0) for b in (True, False)),
        strict=True,
    )
    assert end(20.0, True) == end(20.0, False) > 1e-3
    np.testing.assert_allclose(values, end(20.0, True), rtol=1e-12)  # as another program rounds
    assert slopes[0] > 1e-9
    assert slopes[1] == 0


@pytest.mark.slow  # compilation of long scans takes half a minute
def test_memory_of_reverse_mode_grows_as_the_root_of_the_steps() -> None:
    """As XLA plans it; at most steps^0.6, of which states that are kept make 0.5."""
    start = jh.Scene(hair(64), solver=jh.PositionBased(iterations=1)).as_arrays()
    effects = (jh.Gravity(), jh.Drag(2.8), jh.Hold())

    def height(scene: jh.Scene, steps: int) -> jax.Array:
        phase = jh.Phase("fall", steps * STEPS, effects)
        return jnp.sum(jh.run(replace(scene, phases=(phase,)))["fall"].positions[:, 2])

    few, many = 16**2, 64**2
    planned = [
        jax.jit(jax.grad(height), static_argnums=1).lower(start, n).compile().memory_analysis()
        for n in (few, many)
    ]
    sizes = [plan.temp_size_in_bytes for plan in planned]
    assert sizes[0] > 1e5
    assert np.log(sizes[1] / sizes[0]) / np.log(many / few) <= 0.6
