"""Optimisers of a fit: SciPy's for least squares, optax's for gradients."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import Array
from scipy.optimize import least_squares

from fitting.problem import Problem
from jaxhair.checkpoints import Checkpoints, named, unnamed

Progress = Callable[[int, float], None]
FitProgress = Callable[[int, float, dict[str, np.ndarray]], None]

METHODS = ("levenberg-marquardt", "adam", "l-bfgs")
LOSSES = ("linear", "soft_l1", "huber", "cauchy")
JOURNAL_SECONDS = 2.0
"""Between two writes of an optimiser's state."""


class Optimum(NamedTuple):
    """Where an optimiser ended.

    free: free numbers, shape (n,). cost: half the sum of squared residuals, or of their losses.
    simulations: that it took, those of line searches too. converged. reason: why it ended there.
    """

    free: np.ndarray
    cost: float
    simulations: int
    converged: bool
    reason: str


REASONS = {
    0: "the largest number of simulations was reached",
    1: "the gradient vanished",
    2: "the residual fell no more",
    3: "the values changed no more",
    4: "the residual fell and the values changed no more",
}


def least_squares_from(
    problem: Problem,
    start: np.ndarray,
    *,
    steps: int,
    tolerance: float,
    loss: str = "linear",
    progress: FitProgress | None = None,
    extra: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] | None = None,
) -> Optimum:
    """SciPy's least squares, in float64 around a simulation of any precision.

    Levenberg and Marquardt's steps in a trust region that begins with 1 in free numbers, a factor
    of e in a positive one (MINPACK's begins with 100, and gets lost oftener: of 50 twin experiments
    8 in place of 6, in 1.5 times the time).

    A library that traces the whole optimisation compiles the simulation several times over; here
    it is one program, called from outside (measured on four states: 20 s against 113 s).

    Arguments:
        loss: of a residual; "linear" is its square.
        progress: called with the number of simulations so far, the data's root mean square
            residual in standard errors, and the values.
        extra: more residuals and their Jacobian.
    """
    taken, last, broken = 0, b"", False

    def evaluated(free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal taken, last, broken
        residuals, jacobian, _ = problem.evaluate(free)
        if free.tobytes() != last:  # SciPy asks twice for the start, and again for the Jacobian
            taken, last = taken + 1, free.tobytes()
            if progress is not None:
                misfit = rms(residuals[: problem.size])
                progress(taken, misfit, problem.parameters.arrays(free))
        broken = broken or not (np.isfinite(residuals).all() and np.isfinite(jacobian).all())
        residuals = np.where(np.isfinite(residuals), residuals, 1e6)
        if extra is not None:
            more = extra(free)
            residuals = np.concatenate([residuals, more[0]])
            jacobian = np.concatenate([jacobian, more[1]])
        return residuals, np.nan_to_num(jacobian)

    solution = least_squares(
        lambda free: evaluated(free)[0],
        np.asarray(start, float),
        jac=lambda free: evaluated(free)[1],
        method="trf",
        loss=loss,
        ftol=tolerance,
        xtol=tolerance,
        gtol=1e-12,
        max_nfev=steps,
    )
    reason = REASONS.get(int(solution.status), str(solution.message))
    if broken:
        reason += "; on the way values were not finite"
    return Optimum(solution.x, float(solution.cost), taken, solution.status > 0, reason)


def gradient_descent(
    problem: Problem,
    method: str,
    *,
    steps: int,
    tolerance: float,
    learning_rate: float,
    progress: FitProgress | None = None,
    journal: Checkpoints | None = None,
) -> Optimum:
    """Adam or L-BFGS on the mean square, until it falls no more by the relative tolerance.

    A step of Adam takes one simulation with its gradient, one of L-BFGS as many as its line search
    tries; the last of them is the next step's.

    Of a journal's parts the last one counts: the optimiser as it was after a number of steps.
    """

    def loss(free: Array) -> Array:
        return jnp.sum(problem.residuals(free, problem.states)[0] ** 2) / problem.size

    optimiser: optax.GradientTransformationExtraArgs
    if method == "adam":
        optimiser = optax.with_extra_args_support(optax.adam(learning_rate))
    else:
        optimiser = optax.lbfgs()

    def value_and_gradient(free: Array, memory: Any) -> tuple[Array, Array, Any]:
        """Also whether they were simulated: 1, or 0 if the line search left them."""
        if method == "adam":
            return *jax.value_and_grad(loss)(free), 1
        new = ~jnp.isfinite(optax.tree_utils.tree_get(memory, "value"))
        return *optax.value_and_grad_from_state(loss)(free, state=memory), new

    @jax.jit
    def update(free: Array, memory: Any) -> tuple[Array, Any, Array, Any]:
        value, gradient, simulated = value_and_gradient(free, memory)
        extra = {"value": value, "grad": gradient, "value_fn": loss}
        change, memory = optimiser.update(gradient, memory, free, **extra)
        tried = optax.tree_utils.tree_get(memory, "num_linesearch_steps", 0)
        return optax.apply_updates(free, change), strong(memory), value, (simulated, tried)

    def ended(free: Any, converged: bool, reason: str) -> Optimum:
        cost = least[-1] * problem.size / 2
        return Optimum(np.asarray(free, float), cost, taken, converged, reason)

    free = problem.start
    memory, taken = strong(optimiser.init(free)), 0
    best, least = free, [np.inf]  # lowest loss after each step; Adam's own goes up and down
    if journal is not None and journal.parts:
        newest = journal.parts[-1]
        kept = unnamed("optimiser", newest, (free, memory, best))
        free, memory, best = jax.tree.map(jnp.asarray, kept)
        least, taken = [float(x) for x in newest["least"]], int(newest["taken"])
    patience = 25 if method == "adam" else 3
    written = time.monotonic()
    for step in range(len(least), steps + 1):
        new, memory, value, simulated = update(free, memory)
        loss_now, taken = float(value), taken + sum(int(number) for number in simulated)
        if progress is not None:
            progress(taken, float(np.sqrt(loss_now)), problem.parameters.arrays(free))
        if not np.isfinite(loss_now):
            return ended(best, False, "values were not finite")
        if loss_now < least[-1]:
            best = free
        least.append(min(loss_now, least[-1]))
        if step > patience and least[-1] > (1 - tolerance) * least[-1 - patience]:
            return ended(best, True, REASONS[2])
        free = new
        if journal is not None and time.monotonic() - written > JOURNAL_SECONDS:
            state = named("optimiser", (free, memory, best))
            journal.add({**state, "least": np.array(least), "taken": np.array(taken)}, alone=True)
            written = time.monotonic()
    return ended(best, False, REASONS[0])


def strong(tree: Any) -> Any:
    """Arrays of the same dtypes that are not weakly typed: a loop that begins with weak ones is
    compiled twice."""
    return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), tree)


def rms(residuals: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(residuals)))) if residuals.size else 0.0
