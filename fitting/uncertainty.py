"""How sure a fit is: covariance, intervals, correlations (Laplace's approximation)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import norm

from fitting.parameters import Parameters


@dataclass(frozen=True)
class Uncertainty:
    """How far the data leave the numbers of a fit uncertain.

    Arguments:
        labels: of the numbers. values: fitted ones, shape (n,).
        low, high: ends of the intervals, shape (n,). level: that the truth is in one by.
        covariance: of the free numbers, shape (free numbers, free numbers).
        correlations: between the numbers, shape (n, n); 0 with a number that cannot move.
        scatter: root mean square residual of the data in standard errors: 1 where the model and
            the given errors are right. Where it is larger, so are the intervals, by as much.
    """

    labels: tuple[str, ...]
    values: np.ndarray
    low: np.ndarray
    high: np.ndarray
    level: float
    covariance: np.ndarray
    correlations: np.ndarray
    scatter: float

    def interval(self, label: str) -> tuple[float, float]:
        """The interval of one number. Raises ValueError for an unknown label."""
        if label not in self.labels:
            raise ValueError(f"label is {label!r}; it must be one of {', '.join(self.labels)}")
        i = self.labels.index(label)
        return float(self.low[i]), float(self.high[i])

    def strongest_correlations(self, count: int = 5) -> list[tuple[str, str, float]]:
        """Pairs of different numbers, the most correlated first."""
        n = len(self.labels)
        pairs = [(i, j) for i in range(n) for j in range(i)]
        pairs.sort(key=lambda pair: -abs(self.correlations[pair]))
        return [
            (self.labels[j], self.labels[i], float(self.correlations[i, j]))
            for i, j in pairs[:count]
        ]


def laplace(
    parameters: Parameters,
    free: np.ndarray,
    jacobian: np.ndarray,
    *,
    data: int,
    scatter: float,
    level: float = 0.95,
) -> Uncertainty:
    """covariance = (J^T J / max(1, scatter)^2 + prior)^-1, and the intervals that follow from it.

    An interval is made where the number has no bounds, and taken back through the constraint, so
    that it never leaves the admissible values: in the logarithm of a positive number, in
    log(p / (1 - p)) for a share p of a simplex or of an interval.

    Arguments:
        free: fitted free numbers, shape (n,).
        jacobian: of the residuals in standard errors, shape (m, n); the data's rows come first.
        data: how many these are. scatter: see `Uncertainty`.
    """
    free = np.asarray(free, float)
    by_data, by_prior = jacobian[:data], jacobian[data:]
    precision = by_data.T @ by_data / max(1.0, scatter) ** 2 + by_prior.T @ by_prior
    covariance = _inverse(precision)
    point = jnp.asarray(free, parameters.dtype)
    values = np.asarray(parameters.flat_values(point), float)
    slopes = np.asarray(jax.jacfwd(parameters.flat_values)(point), float)
    with np.errstate(invalid="ignore"):
        spread = slopes @ covariance @ slopes.T
    deviation = np.sqrt(np.maximum(np.diag(spread), 0))
    times = float(norm.ppf((1 + level) / 2))
    low, high = _ends(parameters, values, deviation, times)
    size = np.outer(deviation, deviation)
    known = (size > 0) & np.isfinite(size)
    correlations = np.where(known, spread / np.where(known, size, 1), 0.0)
    np.fill_diagonal(correlations, 1.0)
    return Uncertainty(
        tuple(parameters.labels()), values, low, high, level, covariance, correlations, scatter
    )


def _inverse(precision: np.ndarray) -> np.ndarray:
    """Of a symmetric matrix; what nothing determines gets an infinite, or very large, variance."""
    if not np.isfinite(precision).all():
        return np.diag(np.full(len(precision), np.inf))
    values, vectors = np.linalg.eigh(precision)
    floor = np.finfo(float).eps * max(values.max(initial=0), np.finfo(float).tiny)
    return (vectors / np.maximum(values, floor)) @ vectors.T


def _ends(
    parameters: Parameters, values: np.ndarray, deviation: np.ndarray, times: float
) -> tuple[np.ndarray, np.ndarray]:
    """Values less and plus so many standard deviations, each within its range."""
    bottom, top = parameters.bounds()
    step = times * deviation
    low, high = values - step, values + step
    half = np.isfinite(bottom) & ~np.isfinite(top)
    above = np.maximum(values[half] - bottom[half], np.finfo(float).tiny)
    factor = np.exp(np.minimum(step[half] / above, 700))
    low[half], high[half] = bottom[half] + above / factor, bottom[half] + above * factor
    both = np.isfinite(bottom) & np.isfinite(top)
    width = (top - bottom)[both]
    share = np.clip((values - bottom)[both] / width, 1e-12, 1 - 1e-12)
    logit, moved = np.log(share / (1 - share)), step[both] / width / (share * (1 - share))
    for end, sign in ((low, -1), (high, 1)):
        at = np.clip(logit + sign * moved, -700, 700)
        end[both] = bottom[both] + width / (1 + np.exp(-at))
    return low, high
