"""Wanted shapes: helices, given strands, and their rigid alignment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import fitting
from fitting.targets import aligned_residuals
from jaxhair.strands import strands_last

EXACT = 1e-12
SLOPE = 1e-6  # relative, of derivatives against central differences


def helix_points(edges: int, edge: float, **options: object) -> np.ndarray:
    lengths = jnp.full((edges, 1, 1), edge)
    return np.asarray(fitting.helix(**options).points(lengths, 1))[:, :, 0]


@pytest.mark.parametrize("handedness", ["right", "left"])
def test_helix_has_the_diameter_pitch_edges_and_handedness_asked_for(handedness: str) -> None:
    diameter, pitch, edge = 25e-3, 8e-3, 2e-3
    x = helix_points(60, edge, diameter=diameter, pitch=pitch, handedness=handedness)
    assert np.hypot(x[:, 0], x[:, 1]) == pytest.approx(diameter / 2, abs=EXACT)
    assert np.linalg.norm(np.diff(x, axis=0), axis=1) == pytest.approx(edge, abs=EXACT)
    turn = np.unwrap(np.arctan2(x[:, 1], x[:, 0]))
    rise = (x[-1, 2] - x[0, 2]) / (abs(turn[-1] - turn[0]) / (2 * np.pi))
    assert rise == pytest.approx(pitch, rel=(edge / diameter) ** 2)
    a, b, c = np.diff(x, axis=0)[:3]
    assert np.sign(np.cross(a, b) @ c) == (1 if handedness == "right" else -1)


def curl() -> np.ndarray:
    return helix_points(20, 3e-3, diameter=20e-3, pitch=10e-3)


@pytest.mark.parametrize("seed", range(4))
def test_a_rigidly_moved_strand_has_no_residual(seed: int) -> None:
    rotation = Rotation.random(random_state=seed).as_matrix()
    moved = curl() @ rotation.T + np.array([0.3, -0.2, 0.1])
    found = aligned_residuals(jnp.asarray(moved), jnp.asarray(curl()))
    assert np.abs(found).max() < EXACT


def test_a_mirror_image_keeps_a_residual() -> None:
    mirrored = curl() * np.array([1.0, 1.0, -1.0])
    found = aligned_residuals(jnp.asarray(mirrored), jnp.asarray(curl()))
    assert np.sqrt(np.mean(np.asarray(found) ** 2)) > 1e-4


def test_alignment_agrees_with_scipy() -> None:
    rng = np.random.default_rng(0)
    x = curl() + rng.normal(0, 1e-3, curl().shape)
    found = aligned_residuals(jnp.asarray(x), jnp.asarray(curl()))
    a, b = curl() - curl().mean(0), x - x.mean(0)
    _, distance = Rotation.align_vectors(a, b)
    assert np.linalg.norm(found) == pytest.approx(distance, rel=1e-9)


@pytest.mark.parametrize("size", [1e-4, 5e-3], ids=["small residual", "large residual"])
def test_slope_of_the_squares_is_exact(size: float) -> None:
    rng = np.random.default_rng(1)
    x, direction = curl() + rng.normal(0, size, curl().shape), rng.normal(0, 1, curl().shape)

    def squares(step: float) -> jax.Array:
        return jnp.sum(
            aligned_residuals(jnp.asarray(x) + step * direction, jnp.asarray(curl())) ** 2
        )

    h = 1e-6
    central = (squares(h) - squares(-h)) / (2 * h)
    assert jax.grad(squares)(0.0) == pytest.approx(float(central), rel=SLOPE)
    assert jax.jvp(squares, (0.0,), (1.0,))[1] == pytest.approx(float(central), rel=SLOPE)


def test_rigid_motion_is_no_change_in_the_derivative() -> None:
    """What a fit must not mistake for a change of shape."""
    x = jnp.asarray(curl())
    spin = jnp.cross(jnp.asarray([[0.2, -1.0, 0.5]]), x) + jnp.asarray([[1.0, 2.0, 3.0]])
    _, change = jax.jvp(lambda p: aligned_residuals(p, jnp.asarray(curl())), (x,), (spin,))
    assert np.abs(change).max() < 1e-9


def test_straight_strands_are_safe_in_value_and_derivative() -> None:
    x = jnp.stack([jnp.zeros(9), jnp.zeros(9), jnp.linspace(0, 0.1, 9)], axis=1)
    for wanted in (x, jnp.asarray(curl()[:9])):
        value, slope = jax.value_and_grad(
            lambda p, wanted=wanted: jnp.sum(aligned_residuals(p, wanted) ** 2)
        )(x)
        assert np.isfinite(value)
        assert np.all(np.isfinite(slope))


def test_resampled_keeps_ends_and_takes_equal_steps() -> None:
    line = np.array([[[0.0, 0, 0], [0, 0, 1], [0, 0, 4], [9, 9, 9]]])
    found = fitting.resampled(line, [3], 5)[0]
    assert found[:, 2] == pytest.approx([0, 1, 2, 3, 4])
    assert np.abs(found[:, :2]).max() == 0
    with pytest.raises(ValueError, match=r"strand 0 has length 0\.0; it must be above 0"):
        fitting.resampled(np.zeros((1, 3, 3)), [3], 4)


def test_a_shape_of_another_size_is_refused() -> None:
    target = fitting.Shape(np.zeros((2, 7, 3)))
    with pytest.raises(ValueError, match=r"target\.strands has shape \(2, 7, 3\)"):
        target.points(jnp.ones((8, 1, 1)), 2)
    same = fitting.Shape(np.arange(24.0).reshape(2, 4, 3)).points(jnp.ones((3, 1, 1)), 2)
    assert np.array_equal(same, strands_last(np.arange(24.0).reshape(2, 4, 3)))
