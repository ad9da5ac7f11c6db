"""Generated scenes, valid and wild: every value and forward derivative stays finite.

An ordinary run takes 40 of them; 600 with HYPOTHESIS_PROFILE=full and the slow ones. All have the
same effects, with numbers over many orders of magnitude, so that one compiled program a solver
serves all. One that fails becomes a case of `tests/hard_cases`.
"""

from typing import Any

import jax
import numpy as np
import pytest
from bad_values import examples
from hard_cases.catalogue import Setting
from hard_cases.running import direction
from hypothesis import given
from hypothesis import strategies as st
from mechanics import stepped

import jaxhair as jh
from jaxhair.simulate import start

STEPS, SLOPES = 60, 8
UNIT = 1e-5  # of quaternions' norms


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers over orders of magnitude."""
    return st.floats(np.log10(low), np.log10(high)).map(lambda e: float(10**e))


def vectors(size: float) -> st.SearchStrategy[Any]:
    """Vectors up to a size, now and then exactly along an axis or 0."""
    parts = st.one_of(st.just(0.0), st.floats(-size, size))
    return st.tuples(parts, parts, parts)


UNIT_RANGE = st.one_of(st.just(0.0), st.just(1.0), st.floats(0, 1))


@st.composite
def scenes(draw: Any, solver: str) -> jh.Scene:
    """A scene of two strands of six points with every effect, float32."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    edges = rng.normal(size=(2, 5, 3)) + np.array(draw(vectors(3.0)))
    edges /= np.linalg.norm(edges, axis=-1, keepdims=True)
    edges *= 10 ** rng.uniform(np.log10(draw(powers(1e-3, 0.05))), np.log10(0.05), (2, 5, 1))
    gap = np.array(draw(vectors(0.01)))
    points = np.concatenate([np.zeros((2, 1, 3)), edges], axis=1).cumsum(1) + [[0 * gap], [gap]]
    blower, target = np.array(draw(vectors(0.3))), np.array(draw(vectors(0.3)))
    if np.allclose(blower, target):
        target = blower + np.array([1.0, 0.0, 0.0])
    effects = (
        jh.Hold(
            velocity=draw(vectors(10.0)), angular_velocity=draw(vectors(100.0)), centre=(0, 0, 0)
        ),
        jh.Gravity(draw(vectors(100.0))),
        jh.Drag(draw(powers(1e-3, 1e3))),
        jh.DryingWind(blower, target, draw(powers(1e-2, 1e4)), draw(powers(1e-3, 1.0))),
        jh.HairContact(draw(powers(1e-5, 1e-2)), draw(powers(1e-1, 1e4))),
        jh.Cut(hydrogen=draw(UNIT_RANGE), rate=draw(powers(1e-3, 1e6))),
        jh.Reform(
            hydrogen=draw(UNIT_RANGE), disulfide=draw(UNIT_RANGE), rate=draw(powers(1e-3, 1e6))
        ),
        jh.Soften(draw(UNIT_RANGE)),
        jh.Floor(draw(st.floats(-0.2, 0.1)), draw(powers(1e-2, 1e3))),
        jh.Sphere(draw(vectors(0.1)), draw(powers(1e-3, 0.2)), draw(powers(1e-2, 1e3))),
        jh.Cylinder(draw(vectors(0.1)), (0.0, 1.0, 0.0), draw(powers(1e-3, 0.1)), 0.3),
    )
    physical = jh.PhysicalFibre(
        draw(powers(1e7, 1e12)),
        draw(powers(1e7, 1e12)),
        draw(powers(1e-5, 3e-4)),
        draw(powers(1e-5, 3e-4)),
        draw(powers(1e2, 1e4)),
        cuticle_share=draw(UNIT_RANGE),
        peeling_rate=draw(powers(1e-2, 1e2)),
    )
    fibre = jh.Fibre(draw(UNIT_RANGE), draw(UNIT_RANGE), draw(powers(1e-2, 1e2)))
    influence = np.array([draw(UNIT_RANGE) for _ in range(4)])
    influence[rng.integers(4)] = 1.0
    bonds = jh.Bonds(influence, np.array([draw(UNIT_RANGE) for _ in range(4)]))
    hair = jax.jit(jh.Strands.from_points)(points)
    return Setting(solver, "float32").scene(hair, *effects, k=fibre, physical=physical, bonds=bonds)


@jax.jit
def outcome(scene: jh.Scene, along: Any) -> Any:
    """The state after `STEPS` steps; and after `SLOPES` its derivative along a direction in the
    numbers of the scene, which grows without bound where strands collide chaotically."""

    def end(scene: jh.Scene, steps: int) -> jh.State:
        return stepped(scene, start(scene), steps)

    return end(scene, STEPS), jax.jvp(lambda scene: end(scene, SLOPES), (scene,), (along,))[1]


@pytest.mark.parametrize(
    "solver", ["paper", "direct", pytest.param("compliant", marks=pytest.mark.slow)]
)
def test_generated_scenes_stay_finite(solver: str) -> None:
    @examples(20, 200)
    @given(scene=scenes(solver))
    def holds(scene: jh.Scene) -> None:
        arrays = scene.as_arrays()
        state, slope = outcome(arrays, direction(arrays, ()))
        for path, leaf in jax.tree_util.tree_leaves_with_path({"value": state, "slope": slope}):
            assert np.all(np.isfinite(leaf)), jax.tree_util.keystr(path)
        norms = np.linalg.norm(np.asarray(state.orientations, float), axis=1)
        assert np.abs(norms - 1).max() < UNIT
        assert np.all((state.fractions >= -1e-6) & (state.fractions <= 1 + 1e-6))

    holds()
