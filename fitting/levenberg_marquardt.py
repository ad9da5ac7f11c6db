"""Levenberg and Marquardt's steps of many strands at once, each with a damping of its own."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from fitting.optimisers import Progress
from fitting.tiles import Squares, Tiles
from jaxhair.checkpoints import Checkpoints

FIRST_DAMPING, LARGEST_DAMPING = 1e-3, 1e12
"""Relative to the diagonal of the normal equations."""


@dataclass
class Found:
    """Where the strands are after some steps, and how each ended; all of shape (strands, ...).

    Arguments:
        x: free numbers. sums: at x. damping: mu. growth: of the damping after a failed step.
        steps: simulations that a strand took. reasons: why a strand could not be fitted, or None.
    """

    x: np.ndarray
    sums: Squares
    damping: np.ndarray
    growth: np.ndarray
    converged: np.ndarray
    steps: np.ndarray
    reasons: list[str | None]

    def as_arrays(self) -> dict[str, np.ndarray]:
        """For a checkpoint."""
        arrays = {name: value for name, value in vars(self).items() if name != "sums"}
        reasons = np.array([reason or "" for reason in self.reasons])
        return {**arrays, **self.sums._asdict(), "reasons": reasons}

    @staticmethod
    def from_arrays(arrays: dict[str, np.ndarray]) -> "Found":
        """What `as_arrays` gave."""
        reasons = [str(reason) or None for reason in arrays["reasons"]]
        sums = Squares(*(arrays[name].copy() for name in Squares._fields))
        names = ("x", "damping", "growth", "converged", "steps")
        return Found(sums=sums, reasons=reasons, **{name: arrays[name].copy() for name in names})


def levenberg_marquardt(
    problem: Tiles,
    start: np.ndarray,
    *,
    steps: int,
    tolerance: float,
    prior_width: float,
    progress: Progress,
    journal: Checkpoints | None = None,
) -> Found:
    """Steps d of (A + mu diag A) d = -g, with the damping mu of each strand by its gain ratio
    (Nielsen, Damping parameter in Marquardt's method, 1999).

    Of a journal's parts the last one counts: the strands after a number of steps.
    """
    count, n = start.shape
    everyone = np.arange(count)
    if journal is not None and journal.parts:
        first, now = int(journal.parts[-1]["step"]), Found.from_arrays(journal.parts[-1])
    else:
        first, now = 1, _begun(problem, start)
        _keep(journal, 1, now)
    progress(first, _rms(now.sums.residual_mm))
    for step in range(first + 1, steps + 1):
        at = everyone[_open(now)]
        total, g, a = _whole(now, start, at, prior_width)
        enough = tolerance * (1 + total / problem.residuals)
        newton = _solved(a, -g)
        near = -(g * newton).sum(axis=1) <= enough
        now.converged[at[near]] = True
        at, total, g, a, enough = (x[~near] for x in (at, total, g, a, enough))
        if not at.size:
            break
        diagonal = np.einsum("sii->si", a)
        d = _solved(a + now.damping[at, None, None] * diagonal[:, :, None] * np.eye(n), -g)
        # no further at once than is plausible at all
        d /= np.maximum(np.abs(d).max(axis=1, keepdims=True) / prior_width, 1)
        expected = -2 * (g * d).sum(axis=1) - np.einsum("si,sij,sj->s", d, a, d)
        new = problem.evaluate(now.x[at] + d, at)
        prior = ((now.x[at] + d - start[at]) ** 2).sum(axis=1) / prior_width**2
        with np.errstate(all="ignore"):
            gain = np.where(new.finite, (total - new.square - prior) / expected, -np.inf)
        better = gain > 1e-3
        good, bad = at[better], at[~better]
        now.x[good] += d[better]
        for old, value in zip(now.sums, new, strict=True):
            old[good] = value[better]
        now.steps[at] = step
        now.damping[good] *= np.maximum(1 / 3, 1 - (2 * np.minimum(gain[better], 1) - 1) ** 3)
        now.growth[good] = 2
        now.damping[bad] *= now.growth[bad]
        now.growth[bad] *= 2
        # what is left to gain is less than the simulation's rounding
        now.converged[bad] = ((expected < 100 * enough) & new.finite)[~better]
        for i in bad[now.damping[bad] > LARGEST_DAMPING]:
            now.reasons[i] = "no step lowers its residual"
        _keep(journal, step, now)
        progress(step, _rms(now.sums.residual_mm))
    for i in everyone[_open(now)]:
        now.reasons[i] = f"not converged in {steps} steps"
    return now


def _begun(problem: Tiles, start: np.ndarray) -> Found:
    """All strands at their start."""
    count = len(start)
    now = Found(
        start.copy(),
        problem.evaluate(start, np.arange(count)),
        np.full(count, FIRST_DAMPING),
        np.full(count, 2.0),
        np.zeros(count, bool),
        np.ones(count, int),
        [None] * count,
    )
    for i in np.flatnonzero(~now.sums.finite):
        now.reasons[i] = "not finite at its start"
    return now


def _keep(journal: Checkpoints | None, step: int, now: Found) -> None:
    if journal is not None:
        journal.add({**now.as_arrays(), "step": np.array(step)}, alone=True)


def _open(now: Found) -> np.ndarray:
    """True where a strand has neither converged nor failed."""
    return ~now.converged & np.array([reason is None for reason in now.reasons])


def _whole(now: Found, start: np.ndarray, at: np.ndarray, prior_width: float) -> tuple[Any, ...]:
    """F, half its gradient g and half its second derivatives A of some strands, prior included."""
    away, weight = now.x[at] - start[at], 1 / prior_width**2
    return (
        now.sums.square[at] + weight * (away**2).sum(axis=1),
        now.sums.slope[at] + weight * away,
        now.sums.curvature[at] + weight * np.eye(start.shape[1]),
    )


def _solved(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """x of a x = b for each strand."""
    return np.linalg.solve(a, b[..., None])[..., 0]


def _rms(residual_mm: np.ndarray) -> float:
    """Of all strands whose residual is known; NaN if none is."""
    known = residual_mm[np.isfinite(residual_mm)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")
