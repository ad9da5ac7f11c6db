"""Profile likelihood: how the misfit rises as one number is held and all others are fitted anew.

Laplace's interval takes the misfit for a parabola; where it is none, as with numbers that the data
hardly determine, the profile says what the data really allow.
"""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import chi2

from fitting.fit import Fit
from fitting.optimisers import METHODS, least_squares_from
from fitting.uncertainty import laplace
from jaxhair import check

WIDE = 0.9973
"""Level of the interval that a profile spans: three standard errors."""

HELD = 1e-4
"""Part of its standard error by which a held number may move."""


@dataclass(frozen=True)
class Profile:
    """The misfit along one number.

    Arguments:
        label: of the number. values: that it was held at, shape (n,), ascending.
        rises: of chi squared over its least, shape (n,).
        low, high: ends of the interval in which it rises by less than the level's quantile;
            infinite where it does not rise as far within the values.
        level: that the truth is in the interval by.
    """

    label: str
    values: np.ndarray
    rises: np.ndarray
    low: float
    high: float
    level: float

    def __str__(self) -> str:
        lines = [f"{self.label}: {self.low:.4g} to {self.high:.4g} ({100 * self.level:g} %)"]
        lines += [
            f"  {v:12.5g}  chi squared +{r:.3g}"
            for v, r in zip(self.values, self.rises, strict=True)
        ]
        return "\n".join(lines)


def profile(found: Fit, label: str, values: Any = None, *, points: int = 9) -> Profile:
    """Holds one number of a fit at some values and fits the others anew.

    Arguments:
        found: a fit by least squares; its compiled program is used.
        label: of the number, such as "bonds.influence[hydrogen]".
        values: to hold it at; from 3 standard errors below to 3 above if not given, within its
            range. points: how many then.

    Raises ValueError for an unknown label, or a fit by gradient descent.
    """
    spread = found.uncertainty
    check.choice("label", label, spread.labels)
    check.whole("points", points, least=3)
    if found.settings["method"] != METHODS[0]:
        raise ValueError(f"method is {found.settings['method']!r}; it must be {METHODS[0]!r}")
    place = spread.labels.index(label)
    best = float(spread.values[place])
    if values is None:
        _, jacobian, _ = found.problem.evaluate(found.free)
        wide = laplace(
            found.problem.parameters,
            found.free,
            jacobian,
            data=found.problem.size,
            scatter=spread.scatter,
            level=WIDE,
        )
        values = np.linspace(*wide.interval(label), points)
    check.finite("values", values)
    held = np.unique(np.append(np.ravel(values), best))
    parameters, problem = found.problem.parameters, found.problem
    scale = HELD * max(abs(spread.high[place] - spread.low[place]) / 4, 1e-9 * max(abs(best), 1e-9))

    @jax.jit
    def value_and_slope(free: Any) -> Any:
        def value(free: Any) -> Any:
            return parameters.flat_values(free)[place]

        return value(free), jax.grad(value)(free)

    def fitted_at(value: float, start: np.ndarray) -> tuple[float, np.ndarray]:
        def extra(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            now, slope = value_and_slope(jnp.asarray(free, parameters.dtype))
            return (
                np.array([(float(now) - value) / scale]),
                np.asarray(slope, float)[None] / scale,
            )

        options = {name: found.settings[name] for name in ("steps", "tolerance", "loss")}
        optimum = least_squares_from(problem, start, extra=extra, **options)
        residuals = problem.evaluate(optimum.free)[0]
        return float(np.sum(residuals**2)), optimum.free

    chi = np.empty(len(held))
    middle = int(np.searchsorted(held, best))
    for order in (range(middle, len(held)), range(middle, -1, -1)):
        free = found.free  # each starts from its neighbour
        for i in order:
            chi[i], free = fitted_at(float(held[i]), free)
    rises = (chi - chi.min()) / max(1.0, spread.scatter) ** 2
    ends = _ends(held, rises, int(np.argmin(chi)), float(chi2.ppf(spread.level, 1)))
    return Profile(label, held, rises, *ends, spread.level)


def _ends(values: np.ndarray, rises: np.ndarray, least: int, limit: float) -> tuple[float, float]:
    """Where the rises cross the limit on both sides of the least, by the roots' straight lines."""
    found = []
    for order, none in (
        (range(least, 0, -1), -np.inf),
        (range(least, len(values) - 1), np.inf),
    ):
        end = none
        for i in order:
            j = i - 1 if none < 0 else i + 1
            if rises[i] <= limit < rises[j]:
                roots = np.sqrt(rises[i]), np.sqrt(rises[j])
                share = (np.sqrt(limit) - roots[0]) / (roots[1] - roots[0])
                end = float(values[i] + share * (values[j] - values[i]))
                break
        found.append(end)
    return found[0], found[1]
