"""Fits from several starts, and the optima that they lead to."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.optimisers import FitProgress, Optimum, least_squares_from, rms
from fitting.problem import Problem

GOOD = 2.0
"""Misfit in standard errors that is taken for a fit of the right kind of model."""

SAME = 0.1
"""Distance in standard deviations at which two optima are one."""


@dataclass(frozen=True)
class Basin:
    """A least residual that some starts of a fit led to.

    Arguments:
        values: of each parameter there. misfit: see `Fit`. starts: how many led there.
    """

    values: dict[str, np.ndarray]
    misfit: float
    starts: int


def from_all_starts(
    problem: Problem, settings: dict[str, Any], progress: FitProgress | None
) -> list[Optimum]:
    """Optima from the given start and from others about it, the best first."""
    options = {name: settings[name] for name in ("steps", "tolerance", "loss")}
    rng = np.random.default_rng(settings["seed"])
    first = np.asarray(problem.start, float)
    found: list[Optimum] = []
    taken = 0

    def told(number: int, misfit: float, values: dict[str, np.ndarray]) -> None:
        if progress is not None:
            progress(taken + number, misfit, values)

    for number in range(settings["starts"] + settings["retries"]):
        good = found and np.sqrt(2 * min(o.cost for o in found) / problem.size) < GOOD
        if number >= settings["starts"] and good:
            break
        away = rng.normal(0, settings["start_width"], first.shape)
        start = first + (away if number else 0)
        found.append(least_squares_from(problem, start, progress=told, **options))
        taken += found[-1].simulations
    return sorted(found, key=lambda optimum: optimum.cost)


def basins(problem: Problem, found: list[Optimum], covariance: np.ndarray) -> tuple[Basin, ...]:
    """Optima that are apart by more than the data allow, with how many starts led to each."""
    values, vectors = np.linalg.eigh(covariance) if np.isfinite(covariance).all() else (None, None)
    groups: list[list[Optimum]] = []
    for optimum in found:
        for group in groups:
            step = optimum.free - group[0].free
            if values is not None and vectors is not None:
                step = (vectors.T @ step) / np.sqrt(np.maximum(values, np.finfo(float).tiny))
            if np.linalg.norm(step) < SAME * np.sqrt(len(step)):
                group.append(optimum)
                break
        else:
            groups.append([optimum])
    found_basins = []
    for group in groups:
        residuals, _, _ = problem.evaluate(group[0].free)
        at = problem.parameters.arrays(group[0].free)
        found_basins.append(Basin(at, rms(residuals[: problem.size]), len(group)))
    return tuple(found_basins)
