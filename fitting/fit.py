"""Fitting the numbers of a scene, or of several experiments, to what hair was seen to do."""

import os
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fitting.constraints import Constraint
from fitting.determined import Direction, undetermined
from fitting.optimisers import (
    LOSSES,
    METHODS,
    FitProgress,
    Optimum,
    gradient_descent,
    rms,
)
from fitting.parameters import Parameters, by_name
from fitting.problem import Problem, checked
from fitting.starts import Basin, basins, from_all_starts
from fitting.targets import MM, PointTarget
from fitting.uncertainty import Uncertainty, laplace
from jaxhair import Scene, check
from jaxhair.checkpoints import Checkpoints
from jaxhair.strands import strands_first


@dataclass(frozen=True)
class Fit:
    """What a fit found.

    States are named by their phase, or "experiment/phase" where there are several experiments.

    Arguments:
        values: of each parameter, by the name it was freed with.
        uncertainty: intervals, covariance and correlations of every number.
        residual_mm: root mean square distance between simulated and wanted points [mm]; NaN
            where no state wants points.
        residuals_mm: the same for each state that does.
        misfit: root mean square residual in standard errors. misfits: the same of each state.
        converged: whether the optimiser met its tolerance. reason: why it ended.
        at_bounds: numbers that ended at an end of their range.
        undetermined: combinations of numbers that the data do not determine; empty if all are.
        singular_values: of the residuals' Jacobian in the free numbers [standard errors].
        basins: least residuals that different starts led to, the best first.
        scenes: with the values put in, by experiment; a single one has the name "".
        simulated, wanted: points [m] of each state, shape (strands, points, 3); the simulated
            ones moved onto the wanted ones where the target asks for that. A state that wants
            other numbers has none in `wanted`.
        steps: simulations with their derivatives that it took, those of line searches too.
        seconds: compilation included.
        problem: that was solved, for `fitting.profile`.
    """

    values: dict[str, np.ndarray]
    uncertainty: Uncertainty
    residual_mm: float
    residuals_mm: dict[str, float]
    misfit: float
    misfits: dict[str, float]
    converged: bool
    reason: str
    at_bounds: tuple[str, ...]
    undetermined: tuple[Direction, ...]
    singular_values: np.ndarray
    basins: tuple[Basin, ...]
    scenes: dict[str, Scene]
    simulated: dict[str, np.ndarray]
    wanted: dict[str, np.ndarray]
    steps: int
    seconds: float
    free: np.ndarray = field(repr=False)
    problem: Problem = field(repr=False, compare=False)
    settings: dict[str, Any] = field(default_factory=dict)

    @property
    def scene(self) -> Scene:
        """The only experiment's scene. Raises ValueError where there are several."""
        if len(self.scenes) != 1:
            raise ValueError(f"the fit has {len(self.scenes)} scenes; take one from .scenes")
        return next(iter(self.scenes.values()))

    def again(self, targets: Mapping[str, Any], *, progress: FitProgress | None = None) -> "Fit":
        """The same fit, of other observations of the same states, without compiling it again.

        Arguments: those of `fit`. Raises ValueError for targets of other states or kinds, and for
        a fit by gradient descent.
        """
        if self.settings["method"] != METHODS[0]:
            raise ValueError(f"method is {self.settings['method']!r}; it must be {METHODS[0]!r}")
        scenes = self.problem.parameters.scenes
        problem = self.problem.with_targets(checked(scenes, targets))
        return _solved(problem, self.settings, progress)

    def __str__(self) -> str:
        from fitting.report import table

        return table(self)


def fit(
    scene: Scene | Mapping[str, Scene],
    targets: Mapping[str, Any],
    free: Mapping[str, Constraint],
    *,
    method: str = "levenberg-marquardt",
    steps: int = 50,
    tolerance: float = 1e-4,
    learning_rate: float = 0.05,
    noise_mm: float = 0.1,
    prior_width: float = 3.0,
    prior: Mapping[str, tuple[Any, Any]] | None = None,
    loss: str = "linear",
    starts: int = 1,
    retries: int = 3,
    start_width: float = 1.0,
    seed: int = 0,
    level: float = 0.95,
    progress: FitProgress | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Fit:
    """The numbers of scenes with which hair does what was observed.

    The least sum of squared residuals over all states, each in its standard errors.

    Arguments:
        scene: with the values to start from; or several experiments by their names, such as the
            same hair on different rods, which are fitted at once.
        targets: from the name of a phase to what is wanted at its end, or, with several
            experiments, from an experiment's name to such a mapping. One state of the hair
            rarely determines all influences: observe it in several.
        free: from a leaf's name to its constraint, see `Parameters`.
        method: "levenberg-marquardt" with forward-mode Jacobians for few parameters; "adam" or
            "l-bfgs" with reverse-mode gradients for many.
        steps: largest number of the optimiser's steps, each a simulation with its derivatives, or
            as many as the line search of L-BFGS tries.
        tolerance: relative, at which a fit has converged.
        learning_rate: of Adam, in free numbers.
        noise_mm: standard error of points [mm] whose target gives none.
        prior_width: how far, in free numbers, a parameter may plausibly be from its start: the
            standard deviation of a Gaussian prior. It keeps what the data do not determine near
            the start, and hardly moves what they do: 3 is a factor of 20 in a positive number.
        prior: what is known of a parameter's values: mean and standard deviation, by its name.
        loss: "linear" for squares; "soft_l1", "huber" or "cauchy" where some data may be wrong.
        starts: how often to fit, from the given start and from others scattered about it.
        retries: how many more starts to try, as long as the misfit is above 2: curls may fit
            wrongly, a turn off, where the misfit is least nearby only.
        start_width: standard deviation of these in free numbers. seed: of their random numbers.
        level: of the intervals.
        progress: called with the number of simulations so far, the misfit in standard errors and
            the values, as in `Fit.values`.
        checkpoint: a folder in which the work is kept as it goes on. The same fit goes on from
            there, however it ended, to the same result bit for bit (on the same kind of machine).
            One process at a time may use it.

    Raises ValueError for an unknown phase, leaf or method, and for a checkpoint that is of other
    work or damaged.
    """
    check.choice("method", method, METHODS)
    check.choice("loss", loss, LOSSES)
    check.whole("steps", steps, least=1)
    check.whole("starts", starts, least=1)
    check.whole("retries", retries, least=0)
    check.whole("seed", seed, least=0)
    tolerance = check.constant("tolerance", tolerance)
    noise_mm = check.constant("noise_mm", noise_mm)
    prior_width = check.constant("prior_width", prior_width)
    start_width = check.constant("start_width", start_width)
    learning_rate = check.constant("learning_rate", learning_rate)
    check.fraction("level", level)
    if method != METHODS[0] and (loss != "linear" or starts > 1):
        raise ValueError(f"method is {method!r}; with loss or starts it must be {METHODS[0]!r}")
    wanted = checked(by_name(scene), targets)
    parameters = Parameters(scene, free)
    problem = Problem(
        parameters,
        wanted,
        noise=noise_mm / MM,
        prior_width=prior_width,
        prior=_known_before(prior, parameters),
    )
    settings = {
        "method": method,
        "steps": steps,
        "tolerance": tolerance,
        "noise_mm": noise_mm,
        "prior_width": prior_width,
        "prior": {name: repr(known) for name, known in problem.prior.items()},
        "loss": loss,
        "starts": starts,
        "retries": retries,
        "start_width": start_width,
        "seed": seed,
        "level": float(level),
        "free": {name: repr(constraint) for name, constraint in free.items()},
    }
    journal = None
    if checkpoint is not None:
        journal = Checkpoints(checkpoint, _work(problem, {**settings, "rate": learning_rate}))
    if method == METHODS[0]:
        if journal is not None:
            problem.keep_in(journal)
        return _solved(problem, settings, progress)
    begin = time.perf_counter()
    found = gradient_descent(
        problem,
        method,
        steps=steps,
        tolerance=tolerance,
        learning_rate=learning_rate,
        progress=progress,
        journal=journal,
    )
    return _result(problem, [found], time.perf_counter() - begin, settings)


def _solved(problem: Problem, settings: dict[str, Any], progress: FitProgress | None) -> Fit:
    """By least squares from all starts."""
    begin = time.perf_counter()
    found = from_all_starts(problem, settings, progress)
    return _result(problem, found, time.perf_counter() - begin, settings)


def _known_before(
    prior: Mapping[str, tuple[Any, Any]] | None, parameters: Parameters
) -> dict[str, tuple[Any, Any]]:
    """Checks a prior: mean and standard deviation of named parameters."""
    names = [p.name for p in parameters.each]
    known: dict[str, tuple[Any, Any]] = {}
    if prior is None:
        return known
    check.instance("prior", prior, Mapping)
    for name, terms in prior.items():
        check.choice("a name of prior", name, names)
        if not isinstance(terms, tuple | list) or len(terms) != 2:
            wanted = "it must be a mean and a standard deviation"
            raise ValueError(f"prior[{name!r}] is {check.short(terms)}; {wanted}")
        mean, deviation = terms
        check.finite(f"prior[{name!r}][0]", mean)
        check.positive(f"prior[{name!r}][1]", deviation, many=True)
        shape = parameters.each[names.index(name)].start.shape
        for term in terms:
            if check.size(f"prior[{name!r}]", term) not in ((), shape):
                check.shape(f"prior[{name!r}]", term, shape)
        known[name] = (np.asarray(mean, float), np.asarray(deviation, float))
    return known


def _work(problem: Problem, settings: dict[str, Any]) -> Any:
    """All that a fit's result depends on."""
    numbers = [
        problem.wanted(name) if isinstance(target, PointTarget) else jax.tree.leaves(target)
        for name, target in problem.states.items()
    ]
    return {
        "scene": list(problem.parameters.scenes.values()),
        "wanted": numbers,
        "states": repr([(name, type(t).__name__) for name, t in problem.states.items()]),
        "settings": repr(settings),
        # tells apart what the numbers do not: another effect, target or constraint of the same name
        "program": problem.program(),
    }


def _result(
    problem: Problem, found: list[Optimum], seconds: float, settings: dict[str, Any]
) -> Fit:
    parameters, best = problem.parameters, found[0]
    free = jnp.asarray(best.free, problem.start.dtype)
    residuals, jacobian, states = problem.evaluate(best.free)
    misfit = rms(residuals[: problem.size])
    directions, singular = undetermined(
        parameters, free, jacobian[: problem.size], noise=max(1.0, misfit)
    )
    spread = laplace(
        parameters, best.free, jacobian, data=problem.size, scatter=misfit, level=settings["level"]
    )
    wanted, simulated, residuals_mm = {}, {}, {}
    squares: list[np.ndarray] = []
    states = {name: states[name] for name in problem.states}  # in the order that they were given in
    for name, state in states.items():
        simulated[name] = np.asarray(strands_first(state["points"]))
        points = problem.wanted(name)
        if points is None:
            continue
        target = problem.states[name]
        off = state["residuals"] * float(problem.noise if target.error is None else target.error)
        wanted[name] = np.asarray(strands_first(points))
        simulated[name] = wanted[name] + np.asarray(strands_first(off))
        residuals_mm[name] = MM * np.sqrt(3) * rms(off)
        squares.append(off.ravel())
    all_mm = MM * np.sqrt(3) * rms(np.concatenate(squares)) if squares else np.nan
    return Fit(
        values=parameters.arrays(free),
        uncertainty=spread,
        residual_mm=float(all_mm),
        residuals_mm={name: float(value) for name, value in residuals_mm.items()},
        misfit=misfit,
        misfits={name: rms(state["residuals"]) for name, state in states.items()},
        converged=best.converged and bool(np.isfinite(misfit)),
        reason=best.reason if np.isfinite(misfit) else "values were not finite",
        at_bounds=parameters.at_bounds(free),
        undetermined=directions,
        singular_values=singular,
        basins=basins(problem, found, spread.covariance),
        scenes=parameters.apply(free),
        simulated=simulated,
        wanted=wanted,
        steps=sum(optimum.simulations for optimum in found),
        seconds=seconds,
        free=np.asarray(best.free, float),
        problem=problem,
        settings=settings,
    )
