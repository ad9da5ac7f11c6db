"""What made a simulation's values infinite or NaN: found by repeating the last steps one by one."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxhair.bonds import changes, rest_shape
from jaxhair.effects import (
    BondEffect,
    HoldingEffect,
    PoseEffect,
    PositionEffect,
    RememberingEffect,
    StiffnessEffect,
    VelocityEffect,
    of_kind,
)
from jaxhair.quaternion import relative
from jaxhair.scene import Phase, Scene, named_leaves
from jaxhair.simulate import Setup, moved
from jaxhair.strands import BONDS, State

ADVICE = {
    "Gravity": "take a smaller acceleration or a smaller dt",
    "TipForce": "take a smaller force, a smaller dt or, with Direct, newton_steps=2",
    "Drag": "take a longer time",
    "Wind": "take a smaller strength or a smaller dt",
    "HairContact": "take a smaller strength, a larger radius or a smaller dt",
    "Hold": "let it move slower, or take a smaller dt",
    "Obstacle": "let it move slower, or take a smaller dt",
    "Cut": "take fractions in [0, 1] and a smaller rate",
    "Reform": "take fractions in [0, 1] and a smaller rate",
    "Soften": "take a factor in [0, 1]",
    "Wound": "take a diameter well above the longest edge",
    "Unloaded": "take influences and fractions whose products do not sum to 0",
    "Bonds": "take influences of 0 or more whose sum is above 0",
    "PositionBased": "take more iterations or substeps, another orientation_weight or a smaller dt",
    "Compliant": "take more iterations or substeps, a larger orientation_weight or a smaller dt",
    "Direct": "take newton_steps=2, more substeps or a smaller dt",
}
"""What to change, by class; a class without advice has that of the class it derives from."""


class Cause(NamedTuple):
    """Where and why, as texts; the place is "" where it is not known."""

    place: str
    reason: str


class Part(NamedTuple):
    """What a part of a step gives.

    who: an effect, the scene's bonds, or None for what all velocities lead to.
    value: array of any type, rows of points, edges or inner points first and strands last.
    shift: by how much it moves a point more [m], shape (points, strands); None if not at all.
    """

    who: Any
    value: Array
    shift: Array | None = None


def cause(
    scene: Scene,
    phase: Phase | None,
    setup: Setup | None,
    state: State,
    one: Callable[[State, int], State],
    first: int,
    steps: int,
) -> Cause:
    """The cause of values that are not finite after some steps.

    Arguments:
        scene: as the user made it. phase, setup: of these steps; None where none was done.
        state: the last good one. one: does a step, given the state and the step's number.
        first: number of the step after the state. steps: to repeat at most.
    """
    wrong, before, number = _wrong(state), state, first
    while setup is not None and not wrong.any() and number < first + steps:
        before, state = state, one(state, number)
        wrong = _wrong(state) | _runs_away(setup, before, state)
        number += 1
    place = _place(wrong) if wrong.any() else ""
    if leaf := _leaf_not_finite(scene, phase):
        return Cause(place, leaf)
    if not place:
        return Cause("", "what `observe` returns is not finite, though all of the state is")
    if setup is None or phase is None:
        return Cause(place, "it is so from the start; look at the strands")
    time = jnp.asarray((number - 1) * setup.dt, state.positions.dtype)
    # with the numbers as the user gave them
    phase = scene.phase(phase.name)
    runs_away = not _wrong(state).any()
    return _blame(scene, phase, setup, before, time, wrong, runs_away=runs_away)


def _leaf_not_finite(scene: Scene, phase: Phase | None) -> str:
    """The first number of the scene, as far as it matters in a phase, that is not finite."""
    for name, value in named_leaves(scene).items():
        if name.startswith("phases.") and (phase is None or name.split(".")[1] != phase.name):
            continue
        given = np.asarray(value)
        with np.errstate(over="ignore"):
            wrong = np.argwhere(~np.isfinite(given.astype(scene.dtype)))
        if len(wrong):
            place = tuple(int(i) for i in wrong[0])
            where = f" at {place}" if place else ""
            return (
                f"{name} has the value {given[place]:g}{where}; it must be finite in {scene.dtype}"
            )
    return ""


def _blame(
    scene: Scene,
    phase: Phase,
    setup: Setup,
    state: State,
    time: Any,
    wrong: np.ndarray,
    *,
    runs_away: bool,
) -> Cause:
    """Who made a step go wrong: the first that gives what is not finite, else the strongest."""
    who: list[Any] = []
    start = state
    state, time, wrong = _bad_substep(setup, start, time, wrong)

    def arrays(
        setup: Setup, start: State, state: State, time: Any
    ) -> list[tuple[Array, Array | None]]:
        parts = _parts(scene, setup, start, state, time)
        given = {id(e): of_user for e, of_user in zip(setup.effects, phase.effects, strict=True)}
        who.extend(given.get(id(part.who), part.who) for part in parts)
        return [(part.value, part.shift) for part in parts]

    # traced, as effects are in use: one that only works so must not fail here
    found = jax.tree.map(np.asarray, jax.jit(arrays)(setup, start, state, time))
    length = np.asarray(setup.rod.lengths).sum(axis=0)[0]
    strongest, most, overflow = None, 0.0, False
    for culprit, (value, shift) in zip(who, found, strict=True):
        bad = ~np.isfinite(value)
        overflow = bool(bad.any())
        if overflow and culprit is not None:
            place = _place(_by_point(bad, len(state.positions)))
            if isinstance(culprit, RememberingEffect) and (
                fault := culprit.fault(setup.rod, start)
            ):
                return Cause(place, f"{_name(culprit)} {fault}")
            fault = "gives values that are not finite there"
            return Cause(place, f"{_name(culprit)} {fault}; {_advice(culprit)}")
        if overflow:
            break
        if shift is not None:
            with np.errstate(over="ignore"):
                share = float((shift.astype("float64") / length).max())
            if share > most:
                strongest, most = culprit, share
    place = _place(wrong)
    if strongest is not None and (most > 1 or overflow):
        times = f"{most:.2g} times" if np.isfinite(most) else "far more than"
        text = f"moves a point by {times} its strand's length in one step"
        return Cause(place, f"{_name(strongest)} {text}; {_advice(strongest)}")
    fault = "gives values that are not finite"
    if runs_away:
        fault = "moves a point by more than its strand's length in one step"
    advice = _advice(scene.solver, scene.fibre, scene.bonds, scene.strands)
    return Cause(place, f"the solver, {_name(scene.solver)}, {fault}; {advice}")


def _bad_substep(
    setup: Setup, start: State, time: Any, wrong: np.ndarray
) -> tuple[State, Any, np.ndarray]:
    """The substep in which a step goes wrong: the state before it, its time and what is wrong."""
    state, n = start, setup.solver.substeps
    if n == 1 or of_kind(setup.effects, PoseEffect):  # a pose is taken in one go
        return state, time, wrong
    for number in range(n):
        at = time + number * (setup.dt / n)
        after = _substep(setup, start, state, at)
        if (bad := _wrong(after) | _runs_away(setup, start, after)).any():
            return state, at, bad
        state = after
    return start, time, wrong  # it is the bonds that re-form at the step's end


@jax.jit
def _substep(setup: Setup, start: State, state: State, time: Any) -> State:
    """The state after a substep, given the state at the start of its step too."""
    rod, effects, dt, n = setup.rod, setup.effects, setup.dt, setup.solver.substeps
    fractions, _ = changes(of_kind(effects, BondEffect), rod, start, dt)
    change = [e.velocity_change(rod, start, dt) / n for e in of_kind(effects, VelocityEffect)]
    return moved(setup, replace(state, fractions=fractions), change, time, dt / n)


def _parts(scene: Scene, setup: Setup, start: State, state: State, time: Any) -> list[Part]:
    """What each part of a step gives, in the step's order.

    Arguments:
        start: of the step. state, time: of the substep looked at.
    """
    rod, effects, dt = setup.rod, setup.effects, setup.dt
    parts = [
        Part(e, e.scaled(jnp.ones_like(rod.stiffness))) for e in of_kind(effects, StiffnessEffect)
    ]
    for bond in of_kind(effects, BondEffect):
        for kind in (*bond.kinds_cut, *bond.kinds_formed):
            before = start.fractions[:, BONDS.index(kind)]
            parts.append(Part(bond, bond.fraction_change(kind, before, rod, start, dt)))
    fractions, _ = changes(of_kind(effects, BondEffect), rod, start, dt)
    state = replace(state, fractions=fractions)
    if poses := of_kind(effects, PoseEffect):
        return [*parts, *(Part(e, x) for e in poses for x in e.pose(rod, state))]
    p, q, v = state.positions, state.orientations, state.velocities
    for force in of_kind(effects, VelocityEffect):
        change = force.velocity_change(rod, start, dt)
        # drag, large where the velocity is, makes nothing faster
        faster = _size(start.velocities + change) - _size(start.velocities)
        shift = dt * jnp.where(rod.point_weights[:, 0] > 0, faster, 0)
        parts.append(Part(force, jnp.broadcast_to(change, v.shape), shift))
        v = v + change / setup.solver.substeps
    dt = dt / setup.solver.substeps
    p = p + jnp.where(rod.point_weights > 0, dt * v, 0)
    parts.append(Part(None, p))
    for holding in of_kind(effects, HoldingEffect):
        before, (p, q) = p, holding.moved(rod, p, q, time, dt)
        parts += [Part(holding, p, _size(p - before)), Part(holding, q)]
    for obstacle in of_kind(effects, PositionEffect):
        before, p = p, obstacle.projected(rod, p, state.positions, time, dt)
        parts.append(Part(obstacle, p, _size(p - before)))
    shape = rest_shape(state.shapes, state.fractions, rod.influence, relative(q[:-1], q[1:]))
    return [*parts, Part(scene.bonds, shape)]


def _size(x: Array) -> Array:
    """The largest component of vectors (points, 3, strands): a norm whose squares fit."""
    return jnp.max(jnp.abs(x), axis=1)


def _name(who: Any) -> str:
    return type(who).__name__[:60]


def _advice(*whose: Any) -> str:
    """What to change in the first of them: what its constructor refuses, else what its class is
    known for."""
    for who in whose:
        try:
            replace(who)
        except ValueError as error:
            return str(error)
        except Exception:  # a constructor of the user's
            continue
    for kind in type(whose[0]).__mro__:
        if kind.__name__ in ADVICE:
            return ADVICE[kind.__name__]
    return "look at what it returns there"


def _wrong(state: State) -> np.ndarray:
    """Where a number of a state is not finite, shape (points, strands)."""
    points = len(state.positions)
    masks = [_by_point(~np.isfinite(np.asarray(x)), points) for x in jax.tree.leaves(state)]
    return np.logical_or.reduce(masks)


def _runs_away(setup: Setup, before: State, after: State) -> np.ndarray:
    """Where a free point moves by more than its strand's length in a step, shape (points, strands).

    In a pose that an effect prescribes it may.
    """
    moved = np.asarray(_size(after.positions - before.positions))
    rod, free = setup.rod, not of_kind(setup.effects, PoseEffect)
    far: np.ndarray = moved > np.asarray(rod.lengths).sum(axis=0)[0]
    return far & (np.asarray(rod.point_weights)[:, 0] > 0) & free


def _by_point(wrong: np.ndarray, points: int) -> np.ndarray:
    """By point and strand what is by point, by edge (of its second point) or by inner point."""
    rows = np.logical_or.reduce(wrong, axis=tuple(range(1, wrong.ndim - 1)))
    above = (points - len(rows) + 1) // 2
    return np.pad(rows, ((above, points - len(rows) - above), (0, 0)))


def _place(wrong: np.ndarray) -> str:
    """The first strand, and the first point of it, of shape (points, strands)."""
    strand = int(np.argmax(wrong.any(axis=0)))
    return f"strand {strand}, point {int(np.argmax(wrong[:, strand]))}"
