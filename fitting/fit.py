"""Fitting the numbers of a scene to wanted shapes."""

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from scipy.optimize import least_squares

from fitting.determined import Direction, undetermined
from fitting.parameters import Constraint, Parameters
from fitting.targets import Target
from jaxhair import Scene, check, run
from jaxhair.checkpoints import Checkpoints, named, unnamed
from jaxhair.strands import strands_first, strands_last

Progress = Callable[[int, float], None]

METHODS = ("levenberg-marquardt", "adam", "l-bfgs")
JOURNAL_SECONDS = 2.0
"""Between two writes of an optimiser's state."""

MM = 1e3
"""Millimetres in a metre: residuals are fitted in mm."""


@dataclass(frozen=True)
class Fit:
    """What a fit found.

    Arguments:
        values: of each parameter, by the name it was freed with.
        residual_mm: root mean square distance between simulated and wanted points [mm].
        residuals_mm: the same for each state.
        converged: whether the optimiser met its tolerance.
        undetermined: combinations of numbers that the data do not determine; empty if all are.
        singular_values: of the residuals' Jacobian in the free numbers [mm].
        scene: with the values put in.
        simulated, wanted: points [m] of each state, shape (strands, points, 3); the simulated
            ones moved onto the wanted ones where the target asks for that.
        steps: of the optimiser. seconds: that it took, compilation included.
    """

    values: dict[str, np.ndarray]
    residual_mm: float
    residuals_mm: dict[str, float]
    converged: bool
    undetermined: tuple[Direction, ...]
    singular_values: np.ndarray
    scene: Scene
    simulated: dict[str, np.ndarray]
    wanted: dict[str, np.ndarray]
    steps: int
    seconds: float
    settings: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        from fitting.report import table

        return table(self)


class Problem:
    """Residuals, and their Jacobian, as functions of the free numbers."""

    def __init__(
        self, parameters: Parameters, targets: Mapping[str, Target], prior_mm: float = 0.0
    ) -> None:
        self.parameters = parameters
        self.targets = dict(targets)
        self.prior_mm = prior_mm
        self.start = parameters.packed()
        self._evaluate = jax.jit(self._residuals_and_jacobian)
        self._last: tuple[bytes, Any] = (b"", None)
        self._journal: Checkpoints | None = None
        self._known: dict[bytes, Any] = {}

    def keep_in(self, journal: Checkpoints) -> None:
        """Keeps every evaluation, and takes those that were kept before instead of simulating."""
        self._journal = journal
        for part in journal.parts:
            states = {name: part[f"state {name}"] for name in self.targets}
            self._known[part["point"].tobytes()] = (part["residuals"], part["jacobian"], states)

    def program(self) -> str:
        """The compiled program, as text."""
        return str(self._evaluate.lower(self.start).as_text())

    @property
    def size(self) -> int:
        """Number of residuals that come from the data."""
        scene = self.parameters.scene
        return 3 * scene.strands.points * scene.strands.count * len(self.targets)

    def states(self, free: Array) -> dict[str, Array]:
        """Of each state the residuals [m], shape (points, 3, strands)."""
        scene = self.parameters.apply(free)
        ends = run(scene)
        return {
            name: target.residuals(ends[name], self.lengths)
            for name, target in self.targets.items()
        }

    @property
    def lengths(self) -> Array:
        """Rest lengths [m], shape (points - 1, 1, strands or 1)."""
        scene = self.parameters.scene
        return strands_last(jnp.asarray(scene.strands.lengths, scene.dtype))[:, None]

    def residuals(self, free: Array) -> tuple[Array, dict[str, Array]]:
        """All residuals [mm], shape (n,), and those of each state [m].

        The last ones are the prior's: what a free number's distance from its start weighs.
        """
        states = self.states(free)
        prior = self.prior_mm * (free - self.start)
        return jnp.concatenate([*(MM * r.ravel() for r in states.values()), prior]), states

    def _residuals_and_jacobian(self, free: Array) -> Any:
        """One primal run, and its derivative in all directions at once."""
        residuals, derivative, states = jax.linearize(self.residuals, free, has_aux=True)
        directions = jnp.eye(free.size, dtype=free.dtype)
        return residuals, jax.vmap(derivative, out_axes=-1)(directions), states

    def evaluate(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
        """Residuals [mm], their Jacobian, shape (n, free numbers), and residuals by state [m].

        One compiled program for all; the last result is kept, since optimisers ask for the
        residuals and for the Jacobian of the same point one after the other.
        """
        point = jnp.asarray(free, self.parameters.scene.dtype)
        key = np.asarray(point).tobytes()
        if self._last[0] != key:
            self._last = (key, self._known.get(key) or self._simulated(point))
        found: tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]] = self._last[1]
        return found

    def _simulated(self, point: Array) -> tuple[Any, Any, Any]:
        """What `evaluate` gives, simulated, and kept if there is a journal."""
        residuals, jacobian, states = jax.tree.map(np.asarray, self._evaluate(point))
        residuals, jacobian = residuals.astype(float), jacobian.astype(float)
        if self._journal is not None:
            arrays = {"point": np.asarray(point), "residuals": residuals, "jacobian": jacobian}
            self._journal.add(arrays | {f"state {name}": x for name, x in states.items()})
        return residuals, jacobian, states


def fit(
    scene: Scene,
    targets: Mapping[str, Target],
    free: Mapping[str, Constraint],
    *,
    method: str = "levenberg-marquardt",
    steps: int = 50,
    tolerance: float = 1e-4,
    learning_rate: float = 0.05,
    noise_mm: float = 0.1,
    prior_width: float = 3.0,
    progress: Progress | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Fit:
    """The numbers of a scene with which its hair takes the wanted shapes.

    The least sum of squared distances between simulated and wanted points over all states.

    Arguments:
        scene: with the values to start from.
        targets: from the name of a phase to the shape wanted at its end. One state of the hair
            rarely determines all influences: observe it in several.
        free: from a leaf's name to its constraint, see `Parameters`.
        method: "levenberg-marquardt" with forward-mode Jacobians for few parameters; "adam" or
            "l-bfgs" with reverse-mode gradients for many.
        steps: largest number of the optimiser's steps, each a simulation with its derivatives.
        tolerance: relative, at which a fit has converged.
        learning_rate: of Adam, in free numbers.
        noise_mm: error of the target's points [mm], at least which is assumed where the result
            says what the data do not determine.
        prior_width: how far, in free numbers, a parameter may plausibly be from its start: the
            standard deviation of a Gaussian prior. It keeps what the data do not determine near
            the start, and hardly moves what they do: 3 is a factor of 20 in a positive number.
        progress: called with the number of simulations so far and the residual [mm].
        checkpoint: a folder in which the work is kept as it goes on. The same fit goes on from
            there, however it ended, to the same result bit for bit (on the same kind of machine).
            One process at a time may use it.

    Raises ValueError for an unknown phase, leaf or method, and for a checkpoint that is of other
    work or damaged.
    """
    check.choice("method", method, METHODS)
    check.whole("steps", steps, least=1)
    tolerance = check.constant("tolerance", tolerance)
    noise_mm = check.constant("noise_mm", noise_mm)
    prior_width = check.constant("prior_width", prior_width)
    learning_rate = check.constant("learning_rate", learning_rate)
    check.instance("scene", scene, Scene)
    check.instance("targets", targets, Mapping)
    if not targets:
        raise ValueError("targets is empty; it must name at least one phase")
    for name, target in targets.items():
        scene.phase(name)
        check.instance(f"targets[{name!r}]", target, Target)
    problem = Problem(Parameters(scene, free), targets, noise_mm / prior_width)
    settings = {
        "method": method,
        "steps": steps,
        "tolerance": tolerance,
        "noise_mm": noise_mm,
        "prior_width": prior_width,
        "free": {name: repr(constraint) for name, constraint in free.items()},
    }
    journal = None
    if checkpoint is not None:
        journal = Checkpoints(checkpoint, _work(problem, {**settings, "rate": learning_rate}))
    begin = time.perf_counter()
    if method == "levenberg-marquardt":
        if journal is not None:
            problem.keep_in(journal)
        best, taken, converged = _levenberg_marquardt(problem, steps, tolerance, progress)
    else:
        best, taken, converged = _gradient_descent(
            problem, method, steps, tolerance, learning_rate, progress, journal
        )
    seconds = time.perf_counter() - begin
    return _result(problem, best, taken, converged, seconds, noise_mm, settings)


def _work(problem: Problem, settings: dict[str, Any]) -> Any:
    """All that a fit's result depends on."""
    scene = problem.parameters.scene
    wanted = [t.points(problem.lengths, scene.strands.count) for t in problem.targets.values()]
    return {
        "scene": scene,
        "wanted": wanted,
        "states": repr([(name, t.align) for name, t in problem.targets.items()]),
        "settings": repr(settings),
        # tells apart what the numbers do not: another effect, target or constraint of the same name
        "program": problem.program(),
    }


def _levenberg_marquardt(
    problem: Problem, steps: int, tolerance: float, progress: Progress | None
) -> tuple[np.ndarray, int, bool]:
    """MINPACK's Levenberg-Marquardt, in float64 around a simulation of any precision.

    A library that traces the whole optimisation compiles the simulation several times over; here
    it is one program, called from outside (measured on four states: 20 s against 113 s).
    """
    taken, last = 0, b""

    def residuals(free: np.ndarray) -> np.ndarray:
        nonlocal taken, last
        found = problem.evaluate(free)[0]
        if free.tobytes() != last:  # SciPy asks twice for the start
            taken, last = taken + 1, free.tobytes()
            if progress is not None:
                progress(taken, _rms(found[: problem.size]))
        return np.where(np.isfinite(found), found, 1e6)

    def jacobian(free: np.ndarray) -> np.ndarray:
        return np.nan_to_num(problem.evaluate(free)[1])

    start = np.asarray(problem.parameters.packed(), float)
    solution = least_squares(
        residuals,
        start,
        jac=jacobian,
        method="lm",
        ftol=tolerance,
        xtol=tolerance,
        gtol=1e-12,
        max_nfev=steps,
    )
    return solution.x, taken, bool(solution.status > 0)


def _gradient_descent(
    problem: Problem,
    method: str,
    steps: int,
    tolerance: float,
    learning_rate: float,
    progress: Progress | None,
    journal: Checkpoints | None,
) -> tuple[np.ndarray, int, bool]:
    """Adam or L-BFGS on the mean square, until it falls no more by the relative tolerance.

    Of a journal's parts the last one counts: the optimiser as it was after a number of steps.
    """

    def loss(free: Array) -> Array:
        return jnp.sum(problem.residuals(free)[0] ** 2) / problem.size

    optimiser: optax.GradientTransformationExtraArgs
    if method == "adam":
        optimiser = optax.with_extra_args_support(optax.adam(learning_rate))
    else:
        optimiser = optax.lbfgs()
    value_and_gradient = jax.value_and_grad(loss)

    @jax.jit
    def update(free: Array, memory: Any) -> tuple[Array, Any, Array]:
        value, gradient = value_and_gradient(free)
        extra = {"value": value, "grad": gradient, "value_fn": loss}
        change, memory = optimiser.update(gradient, memory, free, **extra)
        return optax.apply_updates(free, change), memory, value

    free = problem.parameters.packed()
    memory = optimiser.init(free)
    best, least = free, [np.inf]  # lowest loss after each step; Adam's own goes up and down
    if journal is not None and journal.parts:
        newest = journal.parts[-1]
        kept = unnamed("optimiser", newest, (free, memory, best))
        free, memory, best = jax.tree.map(jnp.asarray, kept)
        least = [float(x) for x in newest["least"]]
    patience = 25 if method == "adam" else 3
    written = time.monotonic()
    for step in range(len(least), steps + 1):
        new, memory, value = update(free, memory)
        loss_now = float(value)
        if progress is not None:
            progress(step, float(np.sqrt(3 * loss_now)))
        if not np.isfinite(loss_now):
            return np.asarray(best), step, False
        if loss_now < least[-1]:
            best = free
        least.append(min(loss_now, least[-1]))
        if step > patience and least[-1] > (1 - tolerance) * least[-1 - patience]:
            return np.asarray(best), step, True
        free = new
        if journal is not None and time.monotonic() - written > JOURNAL_SECONDS:
            state = named("optimiser", (free, memory, best))
            journal.add({**state, "least": np.array(least)}, alone=True)
            written = time.monotonic()
    return np.asarray(best), steps, False


def _rms(residuals: np.ndarray) -> float:
    """Root mean square distance of points, from all coordinates' residuals."""
    return float(np.sqrt(3 * np.mean(residuals**2)))


def _result(
    problem: Problem,
    best: np.ndarray,
    taken: int,
    converged: bool,
    seconds: float,
    noise_mm: float,
    settings: dict[str, Any],
) -> Fit:
    parameters, scene = problem.parameters, problem.parameters.scene
    free = jnp.asarray(best, scene.dtype)
    residuals, jacobian, states = problem.evaluate(best)
    residual, jacobian = _rms(residuals[: problem.size]), jacobian[: problem.size]
    directions, singular = undetermined(
        parameters, free, jacobian, noise_mm=max(noise_mm, residual / np.sqrt(3))
    )
    wanted, simulated = {}, {}
    for name, target in problem.targets.items():
        points = target.points(problem.lengths, scene.strands.count)
        wanted[name] = np.asarray(strands_first(points))
        if target.align:
            wanted[name] = wanted[name] - wanted[name].mean(axis=1, keepdims=True)
        simulated[name] = wanted[name] + np.asarray(strands_first(states[name]))
    return Fit(
        values={name: np.asarray(v) for name, v in parameters.values(free).items()},
        residual_mm=residual,
        residuals_mm={name: _rms(MM * states[name]) for name in problem.targets},
        converged=converged and bool(np.isfinite(residual)),
        undetermined=directions,
        singular_values=singular,
        scene=parameters.apply(free),
        simulated=simulated,
        wanted=wanted,
        steps=taken,
        seconds=seconds,
        settings=settings,
    )
