"""The full posterior: against Laplace's where it is Gaussian, and against a grid where it is not.

Tolerances are four standard errors of the draws' means and deviations.
"""

import sys
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_experiments import ROD, SET, curl, curled, water_set

import fitting
from fitting.posterior import Posterior, _log_density, _root

CLIMB = "phases.*.Wound.climb"


def drawn(found: fitting.Fit, **options: Any) -> Posterior:
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # for blackjax
        return fitting.posterior(found, **options)


@cache
def gaussian() -> tuple[fitting.Fit, Posterior, list[tuple[int, int]]]:
    """A rod and its winding from points with noise: hundreds of standard errors from any bound."""
    noise = np.random.default_rng(0).normal(0, 1e-4, (1, 15, 3))
    targets = {SET: fitting.Shape(curled() + noise)}
    free = {ROD: fitting.Positive(), CLIMB: fitting.Unbounded()}
    found = fitting.fit(water_set(20e-3), targets, free)
    told: list[tuple[int, int]] = []
    drawing = drawn(
        found, draws=400, warm_up=100, progress=lambda done, all_: told.append((done, all_))
    )
    return found, drawing, told


def test_a_gaussian_posterior_is_laplaces() -> None:
    found, drawing, _ = gaussian()
    spread = found.uncertainty
    assert drawing.labels == spread.labels == (ROD, CLIMB)
    assert drawing.draws[ROD].shape == (4, 400)
    free = np.stack([np.log(drawing.draws[ROD]), drawing.draws[CLIMB]], axis=-1).reshape(-1, 2)
    deviation = np.sqrt(np.diag(spread.covariance))
    off = (free.mean(axis=0) - found.free) / deviation
    assert (drawing.effective > 300).all()
    assert (np.abs(off) < 4 / np.sqrt(drawing.effective)).all()
    ratio = free.std(axis=0) / deviation
    assert (np.abs(ratio - 1) < 4 / np.sqrt(2 * drawing.effective)).all()
    together = np.corrcoef(free.T)[0, 1]
    assert together == pytest.approx(spread.correlations[0, 1], abs=4 / np.sqrt(300))
    for label in drawing.labels:
        width = np.subtract(*spread.interval(label)[::-1])
        np.testing.assert_allclose(
            drawing.interval(label), spread.interval(label), atol=0.15 * width
        )


def test_a_posterior_says_how_it_was_drawn() -> None:
    _, drawing, told = gaussian()
    assert told == [(number, 500) for number in range(1, 501)]
    assert (np.abs(drawing.rhat - 1) < 0.02).all()
    assert 0.6 < drawing.acceptance < 0.99
    assert drawing.divergences == 0
    assert drawing.simulations >= 4 * 500
    text = str(drawing)
    assert ROD in text
    assert "0 divergences" in text
    with pytest.raises(ValueError, match="label"):
        drawing.interval("elsewhere")


def test_a_posterior_that_is_no_gaussian_is_the_grids() -> None:
    """A diameter known to a fifth, and a rod that is within its range: the upper end counts."""
    free = {ROD: fitting.Interval(10e-3, 25e-3)}
    found = fitting.fit(water_set(20e-3), {SET: curl(60e-3, 12e-3)}, free)
    problem = found.problem
    grid = jnp.linspace(-12.0, 18.0, 3001)[:, None]
    residuals = jax.jit(jax.vmap(lambda x: problem.residuals(x, problem.states)[0]))(grid)
    mass = np.exp(-0.5 * np.sum(np.asarray(residuals) ** 2, axis=1))
    rods = np.asarray(jax.vmap(problem.parameters.flat_values)(grid))[:, 0]
    below = (np.cumsum(mass) - mass / 2) / mass.sum()  # share of the posterior below each rod
    drawing = drawn(found, draws=1000, warm_up=200, seed=3)
    assert drawing.effective[0] > 400
    for share in (0.025, 0.16, 0.5, 0.84, 0.975):
        end = np.quantile(drawing.draws[ROD], share)
        error = np.sqrt(share * (1 - share) / drawing.effective[0])
        assert np.interp(end, rods, below) == pytest.approx(share, abs=4 * error)
    ends = [np.interp(end, rods, below) for end in found.uncertainty.interval(ROD)]
    assert max(abs(ends[0] - 0.025), abs(ends[1] - 0.975)) > 0.015  # Laplace's is another


def test_both_modes_give_the_same_slope() -> None:
    """Forward-mode Jacobians for a fit by least squares, reverse mode for one by gradients."""
    found, _, _ = gaussian()
    by_adam = replace(found, settings={**found.settings, "method": "adam"})
    root = _root(found.uncertainty.covariance)
    place = jnp.asarray([0.7, -1.3])
    found_both = []
    for one in (found, by_adam):
        density = _log_density(one, lambda place: jnp.asarray(found.free + root @ place))
        found_both.append(jax.jit(jax.value_and_grad(density))(place))
    (value, slope), (value_by_adam, slope_by_adam) = found_both
    assert float(value) == pytest.approx(float(value_by_adam), rel=1e-9)
    np.testing.assert_allclose(slope, slope_by_adam, rtol=1e-6)
    np.testing.assert_allclose(slope, -place, rtol=0.05)  # of a Gaussian in standard deviations


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"draws": 3}, "draws is 3; it must be"),
        ({"chains": 1}, "chains is 1; it must be"),
        ({"warm_up": 0}, "warm_up is 0; it must be"),
        ({"seed": -1}, "seed is -1; it must be"),
    ],
)
def test_bad_requests_are_refused(options: dict[str, Any], words: str) -> None:
    found, _, _ = gaussian()
    with pytest.raises(ValueError, match=words):
        fitting.posterior(found, **options)


def test_fits_without_a_posterior_are_refused() -> None:
    found, _, _ = gaussian()
    robust = replace(found, settings={**found.settings, "loss": "cauchy"})
    with pytest.raises(ValueError, match="loss is 'cauchy'; it must be 'linear'"):
        fitting.posterior(robust)
    spread = replace(found.uncertainty, covariance=np.full((2, 2), np.inf))
    with pytest.raises(ValueError, match="covariance is not finite"):
        fitting.posterior(replace(found, uncertainty=spread))
    with pytest.raises(ValueError, match="found is 3"):
        fitting.posterior(3)  # type: ignore[arg-type]


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    found, _, _ = gaussian()
    for name in [n for n in sys.modules if n.partition(".")[0] == "blackjax"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "blackjax", None)
    with pytest.raises(ImportError, match=r"jaxhair\[posterior\]"):
        fitting.posterior(found)
