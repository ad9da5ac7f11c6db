"""The step, and the loops that repeat it."""

import math
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxhair import bonds as bond
from jaxhair import check, rods, tiles
from jaxhair.effects import (
    BondEffect,
    Effect,
    HoldingEffect,
    PoseEffect,
    PositionEffect,
    Recalled,
    RememberingEffect,
    StiffnessEffect,
    VelocityEffect,
    of_kind,
)
from jaxhair.fibre import Fibre, PhysicalFibre, material, stiffness
from jaxhair.kernels import allowed, one_kernel
from jaxhair.pytree import pytree, static
from jaxhair.quaternion import from_vector_part
from jaxhair.rods import Rod
from jaxhair.scene import Scene
from jaxhair.solvers import Solver
from jaxhair.stored import stored
from jaxhair.strands import State, Strands, strands_last


@pytree
class Setup:
    """What a step needs besides the state: the same for all steps of a phase.

    devices: that the strands are spread over.
    """

    rod: Rod
    effects: tuple[Effect, ...]
    solver: Solver
    dt: float = static()
    devices: int = static(default=1)


def step(setup: Setup, state: State, time: Array) -> State:
    """One time step, in the order of the paper's figure 1.

    Arguments:
        setup: of the phase, from `prepare`.
        state: at the start of the step.
        time: of the step's start, within the phase [s], shape ().
    """
    rod, effects, dt = setup.rod, setup.effects, setup.dt
    # 1. External forces, and the bonds that break. 2a. Interactions that change velocities.
    fractions, rises = bond.changes(of_kind(effects, BondEffect), rod, state, dt)
    change = [stored(e.velocity_change(rod, state, dt)) for e in of_kind(effects, VelocityEffect)]
    state = replace(state, fractions=fractions)
    if of_kind(effects, PoseEffect):
        state = posed(setup, state)
    elif setup.solver.substeps == 1:
        state = moved(setup, state, change, time, dt)
    else:
        n = setup.solver.substeps
        for_each = [dv / n for dv in change]

        def substep(state: State, number: Array) -> tuple[State, None]:
            return moved(setup, state, for_each, time + number * (dt / n), dt / n), None

        state, _ = lax.scan(substep, state, jnp.arange(n, dtype=state.positions.dtype))
    # 5. The bonds that re-form remember the present shape.
    if rises:
        state = bond.reformed(state, rises, rods.joints(state.orientations))
    return state


Memories = tuple[Any, ...]
"""Of the effects of a phase that remember, in their order."""


def blank(setup: Setup, state: State) -> Memories:
    """Before the first step."""
    return tuple(e.blank(setup.rod, state) for e in of_kind(setup.effects, RememberingEffect))


def remembering_step(
    setup: Setup, state: State, memories: Memories, time: Array
) -> tuple[State, Memories]:
    """One time step, as one kernel where it fits, and the memories that served in it.

    Searching memories does not fit into a kernel, and what users add may not: see `one_kernel`.
    """
    effects: list[Effect] = []
    kept: list[Any] = []
    still = bool(of_kind(setup.effects, PoseEffect))  # where velocities change nothing
    for effect in setup.effects:
        if isinstance(effect, RememberingEffect):
            if still:
                kept.append(memories[len(kept)])
                continue
            kept.append(effect.remembered(setup.rod, state, memories[len(kept)]))
            effect = Recalled(effect.recalled_change(setup.rod, state, setup.dt, kept[-1]))
        effects.append(effect)
    setup = replace(setup, effects=tuple(effects))
    own = all(type(x).__module__.startswith("jaxhair.") for x in (*effects, setup.solver))
    return (_kernel if own else step)(setup, state, time), tuple(kept)


_kernel = one_kernel(step)


def moved(
    setup: Setup, state: State, velocity_changes: list[Array], time: Array, dt: float
) -> State:
    """The strands' motion in a step or a substep of it, under the changes of velocity given."""
    rod, effects, solver = setup.rod, setup.effects, setup.solver
    p, q, v = state.positions, state.orientations, sum(velocity_changes, state.velocities)
    # 2b. Prediction; held points move; obstacles.
    p = p + jnp.where(rod.point_weights > 0, dt * v, 0)
    for holding in of_kind(effects, HoldingEffect):
        p, q = jax.tree.map(stored, holding.moved(rod, p, q, time, dt))
    for obstacle in of_kind(effects, PositionEffect):
        p = stored(obstacle.projected(rod, p, state.positions, time, dt))
    # 3. The rest shape that the bonds make.
    rest: Any
    if solver.compliant:
        rest = bond.springs(state.shapes, state.fractions, rod.influence)
    else:
        r = rods.joints(q)
        rest = from_vector_part(bond.rest_shape(state.shapes, state.fractions, rod.influence, r))
    # 4. Elasticity, and the velocity that follows from it.
    p, q, forces = solver.solve(rod, state, p, q, rest, dt)
    return State(p, (p - state.positions) / dt, q, state.shapes, state.fractions, forces)


def posed(setup: Setup, state: State) -> State:
    """The state at rest in the pose that effects prescribe."""
    p, q = state.positions, state.orientations
    for pose in of_kind(setup.effects, PoseEffect):
        p, q = pose.pose(setup.rod, state)
    still = jax.tree.map(jnp.zeros_like, (state.velocities, state.forces))
    return State(p, still[0], q, state.shapes, state.fractions, still[1])


def prepare(scene: Scene, effects: tuple[Effect, ...], devices: int = 1) -> Setup:
    """What stays the same during a phase with the given effects."""
    strands = scene.strands
    lengths = strands_last(strands.lengths)[:, None]
    ones = jnp.ones((strands.points, 1, 1), lengths.dtype)
    rod = Rod(
        lengths=lengths,
        point_weights=ones,
        edge_weights=ones[1:],
        stiffness=ones[2:],
        influence=bond.per_inner_point(scene.bonds.influence),
        ragged=strands.ragged,
    )
    points_free, edges_free = jnp.ones_like(ones, bool), jnp.ones_like(ones[1:], bool)
    if strands.ragged:
        points_free, edges_free = rod.point_exists(), rod.edge_exists()
    for holding in of_kind(effects, HoldingEffect):
        points_free = points_free & ~holding.held_points(rod)
        edges_free = edges_free & ~holding.held_edges(rod)
    k = stiffness(scene.fibre, rod.distance())
    for soft in of_kind(effects, StiffnessEffect):
        k = soft.scaled(k)
        if isinstance(scene.fibre, Fibre):  # a share, which a traced factor could lead astray
            k = jnp.clip(k, 0, 1)
    weights = points_free.astype(lengths.dtype)
    of_fibre = None
    if isinstance(scene.fibre, PhysicalFibre):
        of_fibre = material(scene.fibre, lengths)
        own = jnp.where(points_free, rod.point_lengths(), 1)
        weights = weights * of_fibre.unit_length / own
    rod = replace(
        rod,
        point_weights=weights,
        edge_weights=edges_free.astype(lengths.dtype),
        stiffness=k,
        material=of_fibre,
    )
    return Setup(rod, effects, scene.solver, scene.dt, devices)


def start(scene: Scene) -> State:
    """The state before the first step: at rest, every bond remembering the natural shape."""
    return _start(scene.strands, scene.bonds.fraction, scene.solver.keeps_forces)


@partial(jax.jit, static_argnames="keeps_forces")
def _start(strands: Strands, fraction: Any, keeps_forces: bool) -> State:
    positions = strands_last(strands.positions)
    shape = strands_last(strands.natural_shape)
    shapes = jnp.broadcast_to(shape[:, None], (shape.shape[0], 4, *shape.shape[1:]))
    fractions = bond.per_inner_point(fraction)
    return State(
        positions,
        jnp.zeros_like(positions),
        strands_last(strands.orientations),
        shapes,
        jnp.broadcast_to(fractions, (shape.shape[0], 4, shape.shape[2])),
        jnp.zeros_like(positions[1:]) if keeps_forces else None,
    )


def advance(setup: Setup, state: State, first: Array | int, *, steps: int) -> State:
    """The state after `steps` steps, of which the first has the number `first` in its phase.

    All steps of a tile of strands, then those of the next: see `jaxhair.tiles`.
    """
    advanced = partial(_advanced, steps=steps)
    if steps == 1 and setup.devices == 1:  # one step for each tile gains nothing
        return advanced(setup, state, jnp.asarray(first))
    return tiles.in_shares(advanced, setup, state, jnp.asarray(first))


FEW = 64
"""Steps whose states are all stored in reverse mode."""


def _advanced(setup: Setup, state: State, first: Array, *, steps: int) -> State:
    """`advance` for strands that are simulated together.

    Two nested scans: in reverse mode about 2 sqrt(steps) states are stored, and each step is
    computed a second and third time instead; the third time only where the solver's iterations
    are not. Of `FEW` steps all states are stored: a forward run and a fifth of the compilation
    less.
    """

    def one(carry: Any, number: Array) -> tuple[Any, None]:
        state, memories = carry
        time = number.astype(state.positions.dtype) * setup.dt
        return remembering_step(setup, state, memories, time), None

    each = one if setup.solver.recomputes else jax.checkpoint(one, prevent_cse=False)

    def many(carry: Any, numbers: Array) -> tuple[Any, None]:
        return lax.scan(each, carry, numbers)

    if steps == 1:  # such as a phase of a treatment; a third of the time to compile
        return one((state, blank(setup, state)), first)[0][0]
    numbers = first + jnp.arange(steps)
    carry = state, blank(setup, state)
    if steps <= FEW:
        return many(carry, numbers)[0][0]
    inner = _near_square_root(steps)
    outer = steps // inner
    blocks = numbers[: outer * inner].reshape(outer, inner)
    carry, _ = lax.scan(jax.checkpoint(many, prevent_cse=False), carry, blocks)
    if outer * inner < steps:
        carry, _ = many(carry, numbers[outer * inner :])
    return carry[0]


def _near_square_root(steps: int) -> int:
    """A divisor near the square root, so that no steps are left over, or else the root itself."""
    root = math.isqrt(steps)
    for size in range(root, max(root // 4, 1) - 1, -1):
        if steps % size == 0:
            return size
    return root


@partial(jax.jit, static_argnames=("steps", "devices", "kernels"))
def phase_end(
    scene: Scene,
    effects: tuple[Effect, ...],
    state: State,
    *,
    steps: int,
    devices: int = 1,
    kernels: bool = False,
) -> State:
    """The state after a phase. Phases that differ only in numbers share the compiled program.

    Arguments:
        scene: as arrays, without its phases, whose names would be compiled in.
        kernels: see `jaxhair.kernels.allowed`.
    """
    with allowed(kernels):
        return advance(prepare(scene, effects, devices), state, 0, steps=steps)


def run(scene: Scene, *, devices: int = 1) -> dict[str, State]:
    """The state at the end of each phase, by the phase's name.

    devices: of `jax.devices()`, over which the strands are spread; with `jax.distributed` all of
        them, or 1, each process's own.

    Raises ValueError for more devices than there are, and for several where an effect, such as
    `HairContact`, couples strands.

    A pure function: `jax.jit`, `grad`, `jvp` and `vmap` work on it, in any leaf of the scene.
    Without an outer `jit`, phases with the same effects are compiled once, and on a CPU into
    kernels, with which a step takes half to a third of the time; see `jaxhair.kernels`.
    """
    check.instance("scene", scene, Scene)
    devices = tiles.checked_devices(scene, devices)
    scene = scene.as_arrays()
    state = start(scene)
    kernels = not check.traced((scene, state))
    bare = replace(scene, phases=())
    ends = {}
    for phase in scene.phases:
        steps = phase.steps(scene.dt)
        state = phase_end(bare, phase.effects, state, steps=steps, devices=devices, kernels=kernels)
        ends[phase.name] = state
    return ends
