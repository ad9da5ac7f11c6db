"""Smooth curves through noisy points: against a helix that they are points of."""

import numpy as np
import pytest

from fitting.clamped import Seen, chains, off_mm, rooted
from fitting.smoothing import smoothed

LENGTH, DIAMETER, CLIMB = 0.1, 14e-3, 0.9
EXACT = 1e-5  # of the length, of points without noise every 5 mm
SHARES = np.linspace(0, 1, 2001)


def helix(points: int) -> np.ndarray:
    """A curl's points at equal steps of arc length [m]."""
    s = np.linspace(0, LENGTH, points)
    angle = 2 * np.cos(CLIMB) / DIAMETER * s
    x, y = DIAMETER / 2 * np.cos(angle), DIAMETER / 2 * np.sin(angle)
    return np.stack([x, y, -np.sin(CLIMB) * s], axis=1)


def noisy(strands: int, points: int, noise: float) -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [helix(points) + rng.normal(0, noise, (points, 3)) for _ in range(strands)]


def lengths(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.diff(x, axis=-2), axis=-1).sum(axis=-1)


@pytest.mark.parametrize("points", [20, 40, 80, 300])
def test_points_without_noise_are_read_exactly(points: int) -> None:
    """Where a polyline is too short by up to 0.35 %."""
    curves, noise = smoothed([helix(points)])
    assert noise < 1e-9
    found = curves[0].at(SHARES, curves[0].likely(0, np.random.default_rng(0)))[0]
    assert np.abs(found - helix(len(SHARES))).max() < EXACT * LENGTH
    assert lengths(found) == pytest.approx(LENGTH, rel=EXACT)


@pytest.mark.parametrize(("points", "rough"), [(20, 0.35), (40, 0.1), (80, 0.1)])
def test_noise_is_found_and_lengthens_no_strand(points: int, rough: float) -> None:
    """Of 0.1 mm, with which a polyline of 80 points is too long by 1.2 %. From 20 points, every
    half radian of the curl, noise is hardly told from the strand's own roughness."""
    strands, size = 50, 1e-4
    curves, noise = smoothed(noisy(strands, points, size))
    assert noise == pytest.approx(size, rel=rough)
    rng = np.random.default_rng(1)
    found = np.array([c.at(SHARES, c.likely(0, rng))[0] for c in curves])
    off = lengths(found) / LENGTH - 1
    assert abs(off.mean()) < 1e-3 + 3 * off.std() / np.sqrt(strands)


def test_likely_curves_differ_from_the_likeliest_as_that_does_from_the_truth() -> None:
    """Root mean squares at the root, the middle and the tip, of 100 strands."""
    curves, _ = smoothed(noisy(100, 40, 1e-4))
    rng = np.random.default_rng(1)
    shares = np.array([0.0, 0.5, 1.0])
    found = np.array([c.at(shares, c.likely(8, rng)) for c in curves])
    wrong = np.sqrt(np.mean((found[:, 0] - helix(3)) ** 2, axis=(0, 2)))
    said = np.sqrt(np.mean((found[:, 1:] - found[:, :1]) ** 2, axis=(0, 1, 3)))
    assert said == pytest.approx(wrong, rel=0.15)


@pytest.mark.parametrize("points", [3, 4, 5, 6, 7])
def test_few_points_are_a_curve_too(points: int) -> None:
    curves, _ = smoothed([helix(points) * 1e-2])
    found = curves[0].at(np.array([0.0, 1.0]), curves[0].likely(2, np.random.default_rng(0)))
    assert found[0] == pytest.approx(1e-2 * helix(points)[[0, -1]], abs=1e-2 * DIAMETER)
    assert np.isfinite(found).all()


def test_a_straight_strand() -> None:
    line = np.linspace(0, 0.1, 30)[:, None] * np.array([0.6, 0.0, -0.8])
    rng = np.random.default_rng(0)
    curves, noise = smoothed([line, line + rng.normal(0, 1e-5, line.shape)])
    assert noise < 2e-5
    x = chains(curves, 17)[0]
    assert (
        np.abs(x[0, 1:] - x[0, :1] - np.arange(1, 17)[:, None] * (x[0, 1] - x[0, 0])).max() < 1e-8
    )
    assert rooted(x)[0, [0, -1]] == pytest.approx(line[[0, -1]], abs=1e-8)


def test_chains_have_their_root_in_the_middle_of_the_first_edge_along_the_strand() -> None:
    seen = Seen.of([helix(60)], [helix(60)[:, [1, 2, 0]] + 1.0])
    for points in (17, 33):
        hanging, unloaded = seen.chains(points, draws=3)
        assert hanging.shape == (4, 1, points, 3)
        roots = rooted(unloaded)[:, 0, 0]
        curvature, step = 2 * np.cos(CLIMB) ** 2 / DIAMETER, LENGTH / (points - 1.5)
        off_root = np.linalg.norm(roots - helix(60)[0, [1, 2, 0]] - 1.0, axis=1)
        assert off_root == pytest.approx(np.full(4, curvature * step**2 / 8), rel=0.05)
        assert rooted(hanging)[:, 0, 0] == pytest.approx(roots)
        chain = unloaded[0, 0]
        edge = np.diff(chain, axis=0)
        tangent = np.array([np.cos(CLIMB), -np.sin(CLIMB), 0])
        assert edge[0] / np.linalg.norm(edge[0]) == pytest.approx(tangent, abs=1e-3)
        size = np.linalg.norm(edge, axis=1)
        assert size == pytest.approx(np.full(points - 1, size.mean()), rel=1e-3)
        # chords of the circle that a helix is across its axis: (h cos)^2 / 8 r off in their middles
        sagitta = 1e3 * (size[1] * np.cos(CLIMB)) ** 2 / (4 * DIAMETER)
        off = off_mm([helix(60)[:, [1, 2, 0]] + 1.0], chain[None])[0]
        assert off == pytest.approx(sagitta * np.sqrt(8 / 15), rel=0.1)


def test_distance_from_a_chain_is_that_of_the_nearest_points() -> None:
    """A straight chain with points beside it and one beyond its tip."""
    chain = np.zeros((1, 5, 3))
    chain[0, :, 2] = -np.arange(5) * 1e-2
    x = np.array([[1e-3, 0, -0.01], [0, 2e-3, -0.023], [0, 0, -0.042]])
    assert off_mm([x], chain)[0] == pytest.approx(np.sqrt((1 + 4 + 4) / 3))
