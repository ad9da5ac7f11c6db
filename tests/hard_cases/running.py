"""Runs a hard case: its values over a second, and its derivatives over a few steps."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

import jaxhair as jh
from hard_cases.catalogue import Start
from jaxhair import quaternion as quat
from jaxhair.kernels import allowed
from jaxhair.simulate import Setup, blank, prepare, remembering_step


class Extremes(NamedTuple):
    """Largest values at any time so far; NaN once anything was not finite."""

    speed: Array
    quaternion: Array
    fraction: Array
    shape: Array


def _extremes(setup: Setup, state: jh.State) -> Extremes:
    free = setup.rod.point_weights > 0
    unit = jnp.abs(quat.safe_norm(state.orientations) - 1)
    beyond = jnp.maximum(state.fractions - 1, -state.fractions)
    return Extremes(
        speed=jnp.max(jnp.where(free, quat.safe_norm(state.velocities), 0)),
        quaternion=jnp.max(unit),
        fraction=jnp.max(beyond, initial=-1),
        shape=jnp.max(quat.safe_norm(state.shapes), initial=0),
    )


@jax.jit
def _run(scene: jh.Scene, state: jh.State, steps: Array) -> tuple[jh.State, Extremes]:
    setup = prepare(scene, scene.phases[0].effects)

    def one(number: Array, carry: Any) -> Any:
        state, memories, extremes = carry
        time = number.astype(scene.dtype) * scene.dt
        state, memories = remembering_step(setup, state, memories, time)
        return state, memories, jax.tree.map(jnp.maximum, extremes, _extremes(setup, state))

    with allowed():  # as `jh.simulate` does
        at_start = state, blank(setup, state), _extremes(setup, state)
        state, _, extremes = lax.fori_loop(0, steps, one, at_start)
    return state, extremes


def run(case: Start, steps: int) -> tuple[jh.State, Extremes]:
    """The state after some steps, and the extremes on the way."""
    return jax.tree.map(np.asarray, _run(case.scene.as_arrays(), case.state, jnp.int32(steps)))


def _outcome(scene: jh.Scene, state: jh.State, steps: int) -> Array:
    """One smooth number made of all that the state has after some steps."""
    setup = prepare(scene, scene.phases[0].effects)

    def one(carry: Any, number: Array) -> tuple[Any, None]:
        return remembering_step(setup, *carry, number * scene.dt), None

    numbers, carry = jnp.arange(steps, dtype=scene.dtype), (state, blank(setup, state))
    (state, _), _ = lax.scan(jax.checkpoint(one, prevent_cse=False), carry, numbers)
    total = jnp.zeros((), scene.dtype)
    for i, part in enumerate((state.positions, state.orientations, state.shapes, state.fractions)):
        weights = jnp.cos(1.0 + i + jnp.arange(part.size, dtype=scene.dtype)).reshape(part.shape)
        total = total + jnp.sum(weights * part)
    return total


# Compiled without optimisation, which takes half the time, jax 0.10.1 gives NaN here where it gives
# none with, nor operation by operation.
@partial(jax.jit, static_argnames="steps")
def along(at: Any, direction: Any, steps: int) -> tuple[Array, Array]:
    """The outcome and its forward-mode derivative along a direction."""
    return jax.jvp(lambda x: _outcome(*x, steps), (at,), (direction,))


@partial(jax.jit, static_argnames="steps")
def gradient(at: Any, steps: int) -> Any:
    """The outcome's reverse-mode gradient in every number of scene and state."""
    return jax.grad(lambda x: _outcome(*x, steps))(at)


def arrays(case: Start) -> tuple[jh.Scene, jh.State]:
    """What is differentiated: every number of the scene, and of the state."""
    return case.scene.as_arrays(), case.state


def direction(at: Any, fixed: tuple[str, ...], seed: int = 0) -> Any:
    """A random direction in which every number changes at the rate of its size."""
    rng = np.random.default_rng(seed)

    def each(path: Any, x: Array) -> Array:
        name = jax.tree_util.keystr(path)
        # forces in hair are a few uN; what is 0 otherwise is measured against 0.1
        size = 1e-6 if name.endswith("forces") else np.where(x == 0, 0.1, np.abs(x))
        rate = np.asarray(rng.uniform(-1, 1, x.shape)) * size
        return jnp.asarray(0 * rate if name.endswith(fixed) and fixed else rate, x.dtype)

    return jax.tree_util.tree_map_with_path(each, at)


def shifted(at: Any, direction: Any, by: float) -> Any:
    """at + by direction."""
    return jax.tree.map(lambda x, d: x + jnp.asarray(by, x.dtype) * d, at, direction)


def product(gradient: Any, direction: Any) -> tuple[float, float]:
    """gradient . direction, and the sum of the absolute terms: what rounding is relative to."""
    parts = jax.tree.map(
        lambda g, d: np.asarray(g, float) * np.asarray(d, float), gradient, direction
    )
    flat = np.concatenate([x.ravel() for x in jax.tree.leaves(parts)])
    return float(flat.sum()), float(np.abs(flat).sum())
