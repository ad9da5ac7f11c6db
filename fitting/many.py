"""Fits of many strands at once, each with numbers of its own.

Strands that do not touch do not know of each other: the derivatives of all strands in their own
n numbers take n tangents, whatever the number of strands. A tile of strands is simulated with its
derivatives by one compiled program; Levenberg and Marquardt's steps are taken outside, in float64,
with a damping for each strand.
"""

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from fitting import tiles
from fitting.constraints import Constraint
from fitting.levenberg_marquardt import levenberg_marquardt
from fitting.optimisers import Progress
from fitting.problem import checked
from fitting.targets import MM, Shape, Target
from fitting.tiles import TILE, Tiles
from jaxhair import HairContact, Scene, check
from jaxhair.checkpoints import Checkpoints
from jaxhair.effects import of_kind

SHARES = (0.05, 0.25, 0.5, 0.75, 0.95, 1.0)
"""Of the strands, at which distributions are shown."""


@dataclass(frozen=True)
class FitEach:
    """What a fit of each strand found. A strand that could not be fitted has a reason.

    Arguments:
        values: of each parameter, by the name it was freed with; shape (strands, ...).
        errors: standard errors of the values, of the same shapes; see `fit_each`.
        numbers, number_errors: free numbers x of each parameter, and their standard errors, of
            shape (strands, its free numbers).
        residual_mm: root mean square distance between simulated and wanted points [mm], shape
            (strands,), as all below.
        converged: whether a strand met the tolerance.
        reasons: why a strand could not be fitted; None where it was.
        steps: simulations that a strand took. seconds: of all, compilation included.
        intervals: of 95 %, shape (strands, 2), where they were made; see `fitting.widened`.
    """

    values: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    numbers: dict[str, np.ndarray]
    number_errors: dict[str, np.ndarray]
    residual_mm: np.ndarray
    converged: np.ndarray
    reasons: tuple[str | None, ...]
    steps: np.ndarray
    seconds: float
    intervals: dict[str, np.ndarray] | None = None

    @property
    def fitted(self) -> np.ndarray:
        """True where a strand has no reason why it could not be fitted, shape (strands,)."""
        return np.array([reason is None for reason in self.reasons])

    def summary(self) -> list[str]:
        """Time, quantiles of the residual, and of the numbers of those that were fitted."""
        fitted = self.fitted
        lines = [f"{self.seconds:.0f} s, at most {self.steps.max()} simulations a strand"]
        lines += [
            f"residual [mm] of this share of strands at most: {distribution(self.residual_mm)}"
        ]
        if not fitted.any():
            return lines
        rows: list[tuple[str, np.ndarray, np.ndarray]] = []
        for name, value in self.values.items():
            shown, errors = f"{name}", self.errors[name]
            if value[0].size > 4:  # a whole shape says nothing in a line
                shown, value, errors = f"{name}, x", self.numbers[name], self.number_errors[name]
            for label in np.ndindex(value.shape[1:]):
                end = f"[{','.join(map(str, label))}]" if label else ""
                rows.append((shown + end, *(x[fitted][:, *label] for x in (value, errors))))
        size = max((len(name) for name, _, _ in rows), default=0)
        lines.append(f"{'':{size}}  {'10 %':>9} {'median':>9} {'90 %':>9}  standard error (median)")
        for name, value, error in rows:
            low, middle, high = np.quantile(value, (0.1, 0.5, 0.9))
            lines.append(
                f"{name:{size}}  {low:9.3g} {middle:9.3g} {high:9.3g}  {np.median(error):.2g}"
            )
        return lines

    def __str__(self) -> str:
        lines = [f"{self.fitted.sum()} of {len(self.reasons)} strands fitted", *self.summary()]
        left = {i: reason for i, reason in enumerate(self.reasons) if reason is not None}
        return "\n".join([*lines, *not_fitted(left)])


def not_fitted(reasons: Mapping[int, str], most: int = 10) -> list[str]:
    """Lines on strands that could not be fitted, from a strand's number to the reason."""
    lines = [f"strand {i}: {reason}" for i, reason in list(reasons.items())[:most]]
    if len(reasons) > most:
        lines.append(f"and {len(reasons) - most} more could not be fitted")
    return lines


def quantiles(values: np.ndarray) -> np.ndarray:
    """What `SHARES` of the values that are finite do not exceed; NaN where none is finite."""
    known = values[np.isfinite(values)]
    return np.quantile(known, SHARES) if known.size else np.full(len(SHARES), np.nan)


def distribution(values: np.ndarray) -> str:
    """`quantiles` as text."""
    pairs = zip(SHARES, quantiles(values), strict=True)
    return ", ".join(f"{share:.0%} {value:.3g}" for share, value in pairs)


def fit_each(
    scene: Scene,
    targets: Mapping[str, Target],
    free: Mapping[str, Constraint],
    *,
    steps: int = 30,
    tolerance: float = 1e-4,
    noise_mm: float = 0.1,
    prior_width: float = 3.0,
    bar_mm: float | None = None,
    tile: int | None = None,
    progress: Progress | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> FitEach:
    """The numbers of each strand with which it takes its wanted shape.

    For each strand the least F(x) = |r(x)|^2 / noise^2 + |x - x_0|^2 / prior_width^2, with the
    distances r of its points from the wanted ones and its free numbers x, which start at x_0.

    Standard errors are those of the linearised problem (Laplace): the covariance of x is the
    inverse of J' J / noise^2 + 1 / prior_width^2, where noise is at least what the residuals say,
    and a value's is D C D' with its derivative D in x.

    Arguments:
        scene: strands that do not touch, with the values to start from.
        targets: from the name of a phase to the shape wanted at its end.
        free: from a leaf's name to the constraint on every strand's own value. Leaves of the
            fibre, the bonds and the strands, and single numbers of effects; a name with `*` is
            one parameter in all leaves that match, such as "phases.*.Wound.diameter".
        steps: largest number of simulations, each with its derivatives.
        tolerance: a strand is fitted when a whole Newton step would lower F by less than this
            share of 1 + F / residuals: its numbers are then within sqrt(tolerance) standard errors.
        noise_mm: standard error of a target's points [mm], where it has none of its own.
        prior_width: see `fitting.fit`.
        bar_mm: a strand with a residual above it counts as not fitted [mm]; if not given, a
            twentieth of the strand's length.
        tile: strands that are simulated together.
        progress: called with the number of simulations so far and the residual of all [mm].
        checkpoint: a folder in which the strands are kept after each simulation of all; as for
            `fitting.fit`, the same fit goes on from there to the same result bit for bit.

    Tiles go to `jax.local_devices()` in turn. A strand that has converged is simulated no more.
    With `jax.distributed` each process, all of which must make the same call, simulates its share
    of the strands and gets the fits of all.

    Raises ValueError for an unknown phase or leaf, a leaf that cannot differ between strands,
    targets of other numbers than points, hair that touches hair, and a checkpoint that is of other
    work, damaged or of several processes.
    """
    check.instance("scene", scene, Scene)
    check.whole("steps", steps, least=1)
    tolerance = check.constant("tolerance", tolerance)
    noise_mm = check.constant("noise_mm", noise_mm)
    prior_width = check.constant("prior_width", prior_width)
    bars = _bars(scene, bar_mm)
    check.whole("tile", TILE if tile is None else tile, least=1)
    begin = time.perf_counter()
    parameters = tiles.freed(scene, free)
    problem = Tiles(scene, _checked(scene, targets), parameters, noise_mm, tile or TILE)
    start = np.concatenate([tiles.numbers(p) for p in parameters], axis=1)
    journal = None
    if checkpoint is not None:
        if jax.process_count() > 1:
            raise ValueError(
                f"checkpoint is {check.short(checkpoint)}; it must be None with several processes"
            )
        journal = Checkpoints(checkpoint, _work(problem, (steps, tolerance, prior_width)))
    found = levenberg_marquardt(
        problem,
        start,
        steps=steps,
        tolerance=tolerance,
        prior_width=prior_width,
        progress=progress or (lambda step, residual: None),
        journal=journal,
    )
    reasons = list(found.reasons)
    for i, (residual, bar) in enumerate(zip(found.sums.residual_mm, bars, strict=True)):
        if reasons[i] is None and residual > bar:
            reasons[i] = f"residual of {residual:.3g} mm, above {bar:.3g} mm"
    spread = np.maximum(1, found.sums.square / max(problem.residuals - start.shape[1], 1))
    normal = found.sums.curvature / spread[:, None, None] + np.eye(start.shape[1]) / prior_width**2
    with np.errstate(all="ignore"):
        covariance = _inverse(normal)
        estimated = estimates(parameters, found.x, covariance, scene.dtype)
    return FitEach(
        **estimated,
        residual_mm=found.sums.residual_mm,
        converged=found.converged,
        reasons=tuple(reasons),
        steps=found.steps,
        seconds=time.perf_counter() - begin,
    )


def estimates(
    parameters: Sequence[tiles.Freed], x: np.ndarray, covariance: np.ndarray, dtype: Any
) -> dict[str, dict[str, np.ndarray]]:
    """Values, numbers and their errors, by a parameter's name, as `FitEach` has them.

    Arguments:
        x: free numbers, shape (strands, n). covariance: theirs, shape (strands, n, n).
    """
    values, errors, numbers, number_errors = {}, {}, {}, {}
    begins = np.cumsum([0, *(p.size for p in parameters)])
    for p, first, last in zip(parameters, begins[:-1], begins[1:], strict=True):
        numbers[p.name] = x[:, first:last]
        own = covariance[:, first:last, first:last]
        number_errors[p.name] = np.sqrt(np.einsum("sii->si", own))
        values[p.name], errors[p.name] = tiles.values_and_errors(p, numbers[p.name], own, dtype)
    return {
        "values": values,
        "errors": errors,
        "numbers": numbers,
        "number_errors": number_errors,
    }


def _checked(scene: Scene, targets: Mapping[str, Target]) -> dict[str, Target]:
    by_phase = checked({"": scene}, targets)[""]
    for name, target in by_phase.items():
        if isinstance(target, Shape):
            wanted = (scene.strands.count, scene.strands.points, 3)
            check.shape(f"targets[{name!r}].strands", target.strands, wanted)
    for phase in scene.phases:
        if of_kind(phase.effects, HairContact):
            raise ValueError(
                f"phase {phase.name!r} has a HairContact; strands that are fitted each by itself "
                "must not touch"
            )
    return by_phase


def _work(problem: Tiles, settings: tuple[float, ...]) -> Any:
    """All that the strands depend on after each step."""
    return {
        "scene": problem.scene,
        "targets": problem.targets,
        "free": repr([(p.name, p.constraint) for p in problem.parameters]),
        "weights": problem.weights,
        "settings": repr(settings),
        # tells apart what the numbers do not: another effect, target or constraint of the same name
        "program": problem.program(),
    }


def _bars(scene: Scene, bar_mm: float | None) -> np.ndarray:
    """The largest residual of each strand that counts as fitted [mm]."""
    if bar_mm is not None:
        return np.full(scene.strands.count, check.constant("bar_mm", bar_mm))
    lengths = MM * np.asarray(scene.strands.lengths, float).sum(axis=1)
    return np.broadcast_to(lengths / 20, (scene.strands.count,))


def _inverse(a: np.ndarray) -> np.ndarray:
    """Of each strand's matrix; NaN where that is not finite."""
    finite = np.isfinite(a).all(axis=(1, 2))
    safe = np.where(finite[:, None, None], a, np.eye(a.shape[-1]))
    return np.where(finite[:, None, None], np.linalg.inv(safe), np.nan)
