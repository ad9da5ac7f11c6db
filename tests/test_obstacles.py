"""Obstacles where no direction leads out: at a ball's centre and on a rod's axis."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair.obstacles import Cylinder, Obstacle, Sphere
from jaxhair.simulate import prepare
from jaxhair.strands import strands_last

INSIDE = [
    pytest.param(Sphere((0.1, 0.2, 0.3), 0.05), id="ball"),
    pytest.param(Cylinder((0.1, 0.2, 0.3), (1.0, 2.0, -1.0), 0.05), id="rod"),
]


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("obstacle", INSIDE)
def test_some_way_out_of_the_middle(obstacle: Obstacle, dtype: str) -> None:
    """The depth is the radius, the normal a unit vector, and slopes are finite."""
    middle = jnp.zeros((1, 3, 1), dtype)
    surface = jax.jit(obstacle.surface)
    distance, normal = surface(middle)
    np.testing.assert_allclose(np.ravel(distance), -0.05, rtol=1e-6)
    assert np.linalg.norm(np.ravel(normal)) == pytest.approx(1, abs=1e-6)
    for slope in jax.jit(jax.jacrev(obstacle.surface))(middle):
        assert np.isfinite(slope).all()


def test_held_points_stay_where_they_are() -> None:
    """Of two points inside a ball the held one is not moved."""
    hair = jh.Strands.straight([(0.1, 0.2, 0.3)], (1.0, 0, 0), length=0.02, points=3)
    rod = prepare(jh.Scene(hair).as_arrays(), (jh.Hold(clamped=False),)).rod
    x = strands_last(jnp.asarray(hair.positions))
    ball = Sphere((0.1, 0.19, 0.3), 0.05)
    moved = jax.jit(ball.projected)(rod, x, x, jnp.zeros(()), 1.0)
    np.testing.assert_array_equal(moved[0], x[0])
    assert np.all(jnp.abs(moved[1:] - x[1:]).max(axis=1) > 1e-3)
