"""What made a simulation's values infinite or NaN: found by repeating the last steps one by one."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhair.bonds import changes
from jaxhair.effects import BondEffect, HoldingEffect, PositionEffect, VelocityEffect, of_kind
from jaxhair.scene import Phase, Scene, named_leaves
from jaxhair.simulate import Setup, step
from jaxhair.strands import State

ADVICE = {
    "Gravity": "take a smaller acceleration or a smaller dt",
    "TipForce": "take a smaller force or, with Direct, newton_steps=2",
    "Wind": "take a smaller strength or a smaller dt",
    "DryingWind": "take a smaller strength or a smaller dt",
    "HairContact": "take a smaller strength, a larger radius or a smaller dt",
    "Hold": "let it move slower, or take a smaller dt",
    "Floor": "let it move slower, or take a smaller dt",
    "Sphere": "let it move slower, or take a smaller dt",
    "Cylinder": "let it move slower, or take a smaller dt",
    "PositionBased": "take more iterations or substeps, or a smaller dt",
    "Compliant": "take more iterations or substeps, or a smaller dt",
    "Direct": "take newton_steps=2, more substeps or a smaller dt",
}
OTHERWISE = "look at what it returns there"


class Cause(NamedTuple):
    """Where and why: texts, "" where it is not known."""

    place: str
    reason: str


_step = jax.jit(step)


def cause(scene: Scene, phase: Phase, setup: Setup, state: State, first: int, steps: int) -> Cause:
    """The cause of values that are not finite after some steps.

    Arguments:
        scene, phase: what was simulated. setup: of the phase.
        state: the last good one. first: number of the step after it. steps: to repeat at most.
    """
    for name, value in named_leaves(scene).items():
        elsewhere = name.startswith("phases.") and not name.startswith(f"phases.{phase.name}.")
        numbers = np.ravel(np.asarray(value, float))
        wrong = numbers[~np.isfinite(numbers)]
        if wrong.size and not elsewhere:
            return Cause("", f"{name} has the value {wrong[0]}")
    length = jnp.sum(setup.rod.lengths, axis=0, keepdims=True)
    for number in range(first, first + steps):
        time = jnp.asarray(number * setup.dt, state.positions.dtype)
        after = _step(setup, state, time)
        moved = jnp.abs(after.positions - state.positions)
        far = (moved > length) & (setup.rod.point_weights > 0)
        wrong = ~jnp.isfinite(after.positions) | far
        if wrong.any():
            return _blame(setup, state, time, np.asarray(wrong))
        state = after
    return Cause("", "")


def _blame(setup: Setup, state: State, time: Any, wrong: np.ndarray) -> Cause:
    """Who made a step go wrong: the first that gives what is not finite, else the strongest."""
    strongest = ("", 0.0)
    for name, value in _parts(setup, state, time):
        x = np.asarray(value, float)
        if not np.isfinite(x).all():
            point, strand = _first(~np.isfinite(x))
            points = len(state.positions) - len(x)  # inner points start at 1
            return Cause(
                f"strand {strand}, point {point + (points + 1) // 2}",
                f"{name} gives values that are not finite there; {ADVICE.get(name, OTHERWISE)}",
            )
        if x.shape == state.positions.shape and (size := float(np.abs(x).max())) > strongest[1]:
            strongest = (name, size)
    point, strand = _first(wrong)
    place = f"strand {strand}, point {point}"
    length = float(np.asarray(setup.rod.lengths).sum(axis=0).max())
    name, size = strongest
    if size * setup.dt > length:
        text = f"{name} changes the velocity by {size:.2g} m/s in one step"
        return Cause(place, f"{text}; {ADVICE.get(name, OTHERWISE)}")
    solver = type(setup.solver).__name__
    fault = "moves a point by more than its strand's length in one step"
    return Cause(place, f"the solver, {solver}, {fault}; {ADVICE.get(solver, OTHERWISE)}")


def _first(wrong: np.ndarray) -> tuple[int, int]:
    """The strand, and its first point, with an entry of True: of (points, 3, strands) or
    (points, strands)."""
    at: np.ndarray = np.any(wrong, axis=1) if wrong.ndim == 3 else wrong
    strand = int(np.argmax(at.any(axis=0)))
    return int(np.argmax(at[:, strand])), strand


def _parts(setup: Setup, state: State, time: Any) -> Iterator[tuple[str, Any]]:
    """What each effect gives in a step, by the name of its class, in the step's order."""
    rod, effects, dt = setup.rod, setup.effects, setup.dt
    for bond in of_kind(effects, BondEffect):
        fractions, rises = changes([bond], rod, state, dt)
        yield type(bond).__name__, fractions.sum(axis=1) + sum(rises.values())
    p, q, v = state.positions, state.orientations, state.velocities
    for force in of_kind(effects, VelocityEffect):
        dv = force.velocity_change(rod, state, dt)
        yield type(force).__name__, dv
        v = v + dv
    p = p + jnp.where(rod.point_weights > 0, dt * v, 0)
    for holding in of_kind(effects, HoldingEffect):
        p, q = holding.moved(rod, p, q, time, dt)
        yield type(holding).__name__, jnp.where(jnp.isfinite(p), 0, p)
    for obstacle in of_kind(effects, PositionEffect):
        p = obstacle.projected(rod, p, state.positions, time, dt)
        yield type(obstacle).__name__, jnp.where(jnp.isfinite(p), 0, p)
