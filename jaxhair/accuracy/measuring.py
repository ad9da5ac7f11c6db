"""Error, time and memory of a setting."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhair.accuracy.grid import Setting
from jaxhair.accuracy.problem import (
    PARAMETERS,
    Problem,
    Reference,
    common,
    gradient_error,
    precision,
    shape_error,
)
from jaxhair.scene import Scene
from jaxhair.simulate import phase_end, start

LARGEST_ERROR = 0.5
"""Over the length; above it a setting has failed."""

LARGEST_GRADIENT_ERROR = 1.0
"""Over the gradient's norm; above it a gradient, worse than none at all, has failed."""


@dataclass(frozen=True)
class Cost:
    """What a setting gives and takes, for its forward run or for its gradient.

    Arguments:
        status: "ok", or "failed" where values are not finite or the error is above
            `LARGEST_ERROR` or `LARGEST_GRADIENT_ERROR`.
        error: over the strand's length, or over the gradient's norm; infinite where values are.
        seconds_per_second: wall time per simulated second; NaN where the program did not run.
        compile_seconds: tracing included. memory: arguments, outputs and temporaries [bytes], or
            None where the compiler does not say.
    """

    status: str
    error: float
    seconds_per_second: float
    compile_seconds: float
    memory: int | None

    @property
    def ok(self) -> bool:
        """It has not failed."""
        return self.status == "ok"


@dataclass(frozen=True)
class Row:
    """A setting with its costs; gradient is None where it was not measured."""

    setting: Setting
    forward: Cost
    gradient: Cost | None = None

    def cost(self, gradient: bool) -> Cost | None:
        """Of the gradient, or of the forward run."""
        return self.gradient if gradient else self.forward


def measure(problem: Problem, reference: Reference, setting: Setting) -> Row:
    """Forward run and, if wanted, reverse-mode gradient of a setting."""
    with precision(setting.dtype):
        scene = problem.scene(
            setting.solver,
            points=setting.points,
            steps_per_second=setting.steps_per_second,
            dtype=setting.dtype,
        )
        forward = _cost(
            problem,
            lambda: _forward(scene),
            lambda x: shape_error(problem, reference, np.asarray(common(jnp.asarray(x)))),
            LARGEST_ERROR,
        )
        gradient = None
        if setting.gradient:
            at = jnp.zeros(len(PARAMETERS), scene.dtype)
            gradient = _cost(
                problem,
                lambda: _gradient(problem, scene, at),
                lambda g: gradient_error(reference, g),
                LARGEST_GRADIENT_ERROR,
            )
    return Row(setting, forward, gradient)


def _forward(scene: Scene) -> tuple[Callable[[], Any], int | None]:
    """A call that simulates a scene as `jaxhair.run` does, and the most memory of a phase."""
    bare, first = replace(scene, phases=()), start(scene)
    state, programs = first, []
    for phase in scene.phases:
        arguments = {"steps": phase.steps(scene.dt), "kernels": True}
        program = phase_end.lower(bare, phase.effects, state, **arguments).compile()
        programs.append((program, phase.effects))
        if phase is not scene.phases[-1]:
            state = program(bare, phase.effects, state)

    def call() -> Any:
        state = first
        for program, effects in programs:
            state = program(bare, effects, state)
        return state.positions

    sizes = [_memory(program) for program, _ in programs]
    return call, None if None in sizes else max(x for x in sizes if x is not None)


def _gradient(problem: Problem, scene: Scene, at: Any) -> tuple[Callable[[], Any], int | None]:
    """A call that gives the height's gradient, and the memory of its program."""
    program = jax.jit(jax.grad(problem.height)).lower(at, scene).compile()
    return lambda: program(at, scene), _memory(program)


def _cost(
    problem: Problem,
    made: Callable[[], tuple[Callable[[], Any], int | None]],
    error_of: Callable[[np.ndarray], float],
    largest: float,
) -> Cost:
    """Of what `made` compiles: a call and its memory."""
    begin = time.perf_counter()
    try:
        call, memory = made()
        compiled = time.perf_counter() - begin
        result, seconds = _timed(call)
    except jax.errors.JaxRuntimeError:  # such as too little memory
        nan = float("nan")
        return Cost("failed", float("inf"), nan, time.perf_counter() - begin, None)
    value = np.asarray(result)
    error = error_of(value) if np.all(np.isfinite(value)) else float("inf")
    status = "ok" if error <= largest else "failed"
    return Cost(status, error, seconds / problem.seconds, compiled, memory)


def _timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Result and median wall time [s] of a call after a first one; fewer calls if they are long."""
    times: list[float] = []
    for number in range(6):
        begin = time.perf_counter()
        result = call()
        result.block_until_ready()
        times.append(time.perf_counter() - begin)
        if number >= 1 and sum(times) > 1.5:
            break
    return result, float(np.median(times[1:]))


def _memory(program: Any) -> int | None:
    analysis = program.memory_analysis()
    if analysis is None:
        return None
    return int(
        analysis.argument_size_in_bytes
        + analysis.output_size_in_bytes
        + analysis.temp_size_in_bytes
    )
