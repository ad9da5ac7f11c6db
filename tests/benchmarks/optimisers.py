"""Levenberg-Marquardt, Adam and L-BFGS on the same fits: python tests/benchmarks/optimisers.py

Two fits: the 5 numbers of a twin experiment (four states, 30 cm of hair), and an influence for each
kind of bond of each of `--strands` strands, seen hanging after a water set and a perm.

An evaluation is a simulation with its derivatives: the Jacobian in all free numbers by forward
mode for Levenberg-Marquardt, the gradient by reverse mode for the others, once for every point that
L-BFGS's line search tries. Its cost in forward runs is measured beside; times the evaluations it
gives the forward runs of a fit. Times are those of the optimiser, without that of the result's
Jacobian: compilation until the first evaluation ends, less the mean time of one; then all others.
"""

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from twin_experiments import FREE, experiment, observed

import fitting
import jaxhair as jh
from fitting.optimisers import METHODS
from jaxhair import treatments

STEPS = {"levenberg-marquardt": 50, "adam": 1000, "l-bfgs": 300}
NOISE = 1e-4


def few() -> tuple[Any, Any, Any]:
    """Scene, targets and free numbers of a twin experiment."""
    scene = experiment()
    truth = np.array([0.33, 0.30, 0.20, 0.17]), 1.0
    return scene, observed(scene, *truth, np.random.default_rng(1)), FREE


def many(strands: int, seed: int) -> tuple[Any, Any, Any]:
    """Scene, targets and free numbers of strands with influences of their own."""
    hair = jh.Strands.straight(np.zeros((strands, 3)), (0.0, 0.0, -1.0), length=0.1, points=15)
    options: dict[str, Any] = {"rod_diameter": 20e-3, "climb": 0.1, "seconds": 0.25}
    phases = (*treatments.water_set(**options), *treatments.perm(**options))
    scene = jh.Scene(hair, phases=phases)
    rng = np.random.default_rng(seed)
    influence = 0.05 + 0.8 * rng.dirichlet(np.ones(4), strands)
    ends = jax.jit(jh.run)(jh.Scene(hair, bonds=jh.Bonds(influence), phases=phases))
    targets = {}
    for name in ("water set", "perm"):
        points = np.asarray(ends[name].points, float)
        targets[name] = fitting.Shape(points + rng.normal(0, NOISE, points.shape))
    return scene, targets, {"bonds.influence": fitting.PerStrand(fitting.Simplex())}


def fitted(method: str, case: tuple[Any, Any, Any]) -> tuple[fitting.Fit, int, float, float]:
    """The fit, its steps, and the seconds of compiling and of running."""
    told = [(0, time.perf_counter())]
    found = fitting.fit(
        *case,
        method=method,
        steps=STEPS[method],
        retries=0,
        progress=lambda number, *_: told.append((number, time.perf_counter())),
    )
    first, last = told[1], told[-1]
    each = (last[1] - first[1]) / max(1, last[0] - first[0])
    compiling = first[1] - told[0][1] - first[0] * each
    return found, len(told) - 1, compiling, last[0] * each


def costs(found: fitting.Fit) -> dict[str, float]:
    """Of an evaluation in forward runs: the Jacobian's and the gradient's."""
    problem = found.problem
    free = jnp.asarray(found.free, problem.start.dtype)

    def forward(free: Any, targets: Any) -> Any:
        return problem.residuals(free, targets)[0]

    def loss(free: Any, targets: Any) -> Any:
        return jnp.sum(forward(free, targets) ** 2)

    run = shortest(jax.jit(forward), free, problem.states)
    gradient = shortest(jax.jit(jax.value_and_grad(loss)), free, problem.states) / run
    jacobian = shortest(jax.jit(problem._residuals_and_jacobian), free, problem.states) / run
    print(f"a forward run: {1e3 * run:.0f} ms, {free.size} free numbers")
    return {"levenberg-marquardt": jacobian, "adam": gradient, "l-bfgs": gradient}


def shortest(function: Callable[..., Any], *arguments: Any) -> float:
    """Seconds of the fastest of five calls."""
    jax.block_until_ready(function(*arguments))
    seconds = []
    for _ in range(5):
        begin = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def compared(name: str, case: tuple[Any, Any, Any]) -> None:
    """Prints a line for each method."""
    runs = {method: fitted(method, case) for method in METHODS}
    cost = costs(runs[METHODS[0]][0])
    _, _, compiling, running = runs[METHODS[0]]
    print(f"{name}; {METHODS[0]} compiles in {compiling:.1f} s and runs in {running:.1f} s")
    print(
        f"{'':<20} {'steps':>6} {'evaluations':>12} {'forward runs':>13} {'compilation':>12} "
        f"{'run':>6} {'misfit':>7}  end"
    )
    for method, (found, steps, compile_time, run_time) in runs.items():
        print(
            f"{method:<20} {steps:6d} {found.steps:12d} {found.steps * cost[method]:13.0f} "
            f"{compile_time / compiling:12.1f} {run_time / running:6.1f} {found.misfit:7.3f}  "
            f"{found.reason}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--strands", type=int, default=32)
    parser.add_argument("--seed", type=int, default=3, help="of the strands' influences")
    options = parser.parse_args()
    compared("5 numbers, four states", few())
    name = f"4 influences of {options.strands} strands, two states"
    compared(name, many(options.strands, options.seed))


if __name__ == "__main__":
    main()
