"""Measures of curls: helices whose numbers are known, straight, folded and noisy hair."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
from fitting import measures

EXACT = {"float64": 1e-9, "float32": 2e-4}
DTYPES = pytest.mark.parametrize("dtype", EXACT)


def helix(
    diameter: float, pitch: float, turns: float, points: int = 61, *, side: int = 1
) -> np.ndarray:
    """Points of a helix [m], shape (points, 3)."""
    angle = np.linspace(0, 2 * np.pi * turns, points)
    radius = diameter / 2
    across = np.cos(angle), side * np.sin(angle)
    return np.stack([radius * across[0], radius * across[1], pitch * angle / (2 * np.pi)], 1)


@DTYPES
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("diameter", "pitch"), [(0.02, 0.01), (0.05, 0.0), (0.01, 0.05)])
def test_a_helix_has_its_numbers(dtype: str, diameter: float, pitch: float, side: int) -> None:
    """A chain of points on a cylinder has exactly the cylinder's diameter, and the rest."""
    points = jnp.asarray(helix(diameter, pitch, 3.0, side=side)[None], dtype)
    found = jax.jit(measures.curl)(points)
    exact = EXACT[dtype]
    assert float(found.diameter[0]) == pytest.approx(diameter, rel=exact)
    assert float(found.curliness[0]) == pytest.approx(1 / diameter, rel=exact)
    assert float(found.pitch[0]) == pytest.approx(side * pitch, rel=exact, abs=exact * diameter)
    assert float(found.waves[0]) == pytest.approx(3.0, rel=exact)
    # the smooth helix: kappa = r / (r^2 + c^2), tau = c / (r^2 + c^2), to the chain's resolution
    radius, c = diameter / 2, pitch / (2 * np.pi)
    assert float(found.curvature[0]) == pytest.approx(radius / (radius**2 + c**2), rel=0.02)
    tau = side * c / (radius**2 + c**2)
    assert float(found.torsion[0]) == pytest.approx(tau, rel=0.02, abs=1e-2)
    np.testing.assert_allclose(measures.curvature(points)[0], found.curvature[0], rtol=0.01)
    np.testing.assert_allclose(measures.torsion(points)[0], tau, rtol=0.02, atol=2e-2)


def test_length_extent_index_and_retention() -> None:
    """An edge up, one across, one down: 3 long, its ends 1 apart; then half unrolled."""
    bent = np.array([[0, 0, 0], [0, 0, 1.0], [1, 0, 1], [1, 0, 0]])
    assert float(measures.length(bent)) == pytest.approx(3)
    assert float(measures.extent(bent)) == pytest.approx(1)
    assert float(measures.curl_index(bent)) == pytest.approx(3)
    longer = np.array([[0, 0, 0], [0, 0, 1.0], [0, 0, 2], [0, 0, 2]])
    assert float(measures.retention(bent, bent)) == pytest.approx(1)
    assert float(measures.retention(bent, np.linspace(0, [0, 0, 3.0], 4))) == pytest.approx(0)
    assert float(measures.retention(bent, longer)) == pytest.approx(0.5)


@DTYPES
def test_straight_hair(dtype: str) -> None:
    """No curl: an infinite diameter, no waves, an index of 1; also with rounding in its points."""
    line = jnp.asarray(np.linspace(0, [0.1, 0.2, -0.05], 30)[None], dtype)
    found = measures.curl(line)
    assert float(found.curvature[0]) < 0.05
    assert float(found.curliness[0]) < 0.05
    assert float(found.waves[0]) < 1e-3
    assert float(measures.curl_index(line)[0]) == pytest.approx(1, rel=1e-6)
    exact = jnp.asarray(np.linspace(0, [0, 0, 1.0], 9)[None], dtype)
    assert float(measures.curl_diameter(exact)[0]) == np.inf


@pytest.mark.parametrize(
    "shape",
    [
        np.linspace(0, [0, 0, 1.0], 9),
        np.zeros((9, 3)),
        np.repeat(np.linspace(0, [0, 0, 1.0], 3), 3, axis=0),
        np.array([[0, 0, i % 2] for i in range(9)], float),
    ],
    ids=["straight", "all points coincide", "two and three coincide", "folded"],
)
def test_slopes_are_finite_where_nothing_is_regular(shape: np.ndarray) -> None:
    for value in jax.tree.leaves(values_and_slopes(jnp.asarray(shape))):
        assert np.isfinite(value).all()


@jax.jit
def values_and_slopes(points: jax.Array) -> list[jax.Array]:
    """Of every measure, in both modes."""
    functions: list[Callable[[jax.Array], jax.Array]] = [
        lambda x: measures.curl(x).curliness,
        lambda x: measures.curl(x).pitch,
        lambda x: measures.curl(x).waves,
        measures.length,
        measures.extent,
        measures.curvature,
        measures.torsion,
        lambda x: measures.retention(x, x),
    ]
    made = (lambda f: f, jax.jacrev, jax.jacfwd)
    return [make(function)(points) for function in functions for make in made]


def test_slopes_agree_with_central_differences() -> None:
    rng = np.random.default_rng(0)
    points = jnp.asarray(helix(0.02, 0.01, 2.0, 21) + rng.normal(0, 1e-4, (21, 3)))
    away = jnp.asarray(rng.normal(size=(21, 3)))

    @jax.jit
    def along(h: float) -> measures.Curl:
        return measures.curl(points + h * away)

    _, slopes = jax.jvp(along, (0.0,), (1.0,))
    above, below = along(1e-7), along(-1e-7)
    for name in ("curvature", "torsion", "curliness", "diameter", "pitch", "waves"):
        slope, *around = (float(getattr(x, name)) for x in (slopes, above, below))
        found = (around[0] - around[1]) / 2e-7
        assert found == pytest.approx(slope, rel=1e-5), name


def test_missing_points_change_nothing() -> None:
    """A shorter strand repeats its last point."""
    short = helix(0.02, 0.01, 2.0, 21)
    padded = np.concatenate([short, np.repeat(short[-1:], 5, axis=0)])
    for a, b in zip(measures.curl(short), measures.curl(padded), strict=True):
        assert float(a) == pytest.approx(float(b), rel=1e-12)


def test_leading_axes() -> None:
    frames = np.stack([[helix(0.02, 0.01, 2.0)] * 3, [helix(0.03, 0.01, 2.0)] * 3])
    assert measures.curl_diameter(frames).shape == (2, 3)
    assert measures.curvature(frames).shape == (2, 3, 59)
    np.testing.assert_allclose(measures.curl_diameter(frames)[1], 0.03, rtol=1e-9)


@pytest.mark.parametrize("wrong", [np.zeros((2, 3)), np.zeros((5, 2)), np.full((5, 3), np.nan)])
def test_wrong_points_are_refused(wrong: np.ndarray) -> None:
    with pytest.raises(ValueError, match="points has"):
        measures.curl(wrong)


def test_curl_targets_are_met_where_points_have_the_numbers() -> None:
    """Residuals are 0 there, and one standard error off by the error given."""
    points = jnp.asarray(np.stack([helix(0.02, 0.01, 2.0)] * 2))
    state = type("Simulated", (), {"positions": jnp.moveaxis(points, 0, -1)})()
    lengths = jnp.ones((60, 1, 1))
    target = fitting.Curl(diameter=(0.02, 1e-3), pitch=(0.01, 1e-3), waves=(2.0, 0.1))
    np.testing.assert_allclose(target.residuals(state, lengths), 0, atol=1e-6)
    off = fitting.Curl(diameter=(0.0201, 1e-4), waves=np.array([[2.1, 2.2], [0.1, 0.1]]))
    np.testing.assert_allclose(off.residuals(state, lengths), (1, -1, -2), rtol=0.02)
    assert off.compared(np.asarray(points))["diameter"] == pytest.approx((0.02, 0.0201, 1e-4))
    curvatures = fitting.Curvatures(np.asarray(points))
    np.testing.assert_allclose(curvatures.residuals(state, lengths), 0, atol=1e-9)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ({}, "must have one of diameter"),
        ({"diameter": 0.02}, "shape"),
        ({"diameter": (0.02, 0.0)}, "above 0"),
        ({"waves": (np.nan, 1.0)}, "finite"),
    ],
)
def test_wrong_curls_are_refused(numbers: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        fitting.Curl(**numbers)
