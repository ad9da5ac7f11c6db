"""Simulating a whole scene and recording frames of it."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import check
from jaxhair.pytree import pytree, static
from jaxhair.scene import Phase, Scene
from jaxhair.simulate import Setup, advance, prepare, start, step
from jaxhair.strands import State


@pytree
class Recording:
    """Frames of a simulation.

    Arguments:
        scene: that was simulated.
        times: of the frames [s], shape (frames,).
        observed: what was observed of each frame's state, each array with a first axis of frames.
            By default a dict of "positions" [m], shape (frames, strands, points, 3), and
            "fractions", bonded, shape (frames, strands, points - 2, 4).
        phases: the phase that each frame belongs to; the first frame is the start, "".
        complete: False if the simulation was interrupted.
    """

    scene: Scene
    times: Any
    observed: Any
    phases: tuple[str, ...] = static()
    complete: bool = static(default=True)

    @property
    def positions(self) -> Any:
        """Points [m], shape (frames, strands, points, 3)."""
        return self.observed["positions"]

    @property
    def fractions(self) -> Any:
        """Bonded fractions, shape (frames, strands, points - 2, 4)."""
        return self.observed["fractions"]

    def end_of(self, phase: str) -> int:
        """Place of a phase's last frame. Raises ValueError if no frame is of that phase."""
        check.choice("phase", phase, tuple(dict.fromkeys(self.phases)))
        return len(self.phases) - 1 - self.phases[::-1].index(phase)


class NotFinite(ArithmeticError):
    """Values of a simulation became infinite or NaN; `recording` has the frames before."""

    def __init__(self, message: str, recording: Recording) -> None:
        super().__init__(message)
        self.recording = recording


def positions_and_fractions(state: State) -> dict[str, Array]:
    """What a recording holds if nothing else is asked for."""
    return {"positions": state.points, "fractions": jnp.moveaxis(state.fractions, -1, 0)}


def simulate(
    scene: Scene,
    *,
    fps: float = 30.0,
    observe: Callable[[State], Any] = positions_and_fractions,
    progress: bool = False,
) -> Recording:
    """Simulates a scene and records frames.

    Frames are taken at the start, then `fps` times a simulated second from the start of each
    phase on, and at the end of each phase.

    Arguments:
        fps: frames a second of simulated time; at most one a step is taken.
        observe: what to keep of a state, a function from `State` to any pytree of arrays.
        progress: show a progress bar on stderr.

    Ctrl-C ends the simulation and returns the frames so far, with `complete` False. Under a JAX
    transformation all frames are computed in one traced program, and nothing is shown.

    Raises ValueError for fps that are not above 0, and NotFinite if values became NaN or infinite.
    """
    check.instance("scene", scene, Scene)
    check.flag("progress", progress)
    every = max(1, round(1 / (check.constant("fps", fps) * scene.dt)))
    numbers = scene.as_arrays()
    times, names = _frame_times(scene, every)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(scene)):
        observed = _traced(numbers, observe, every)
        return Recording(scene, jnp.asarray(times, scene.dtype), observed, tuple(names))
    frames, complete = _interruptible(numbers, observe, every, progress)
    observed = jax.tree.map(lambda *x: np.stack(x), *frames)
    n = len(frames)
    recording = Recording(scene, np.asarray(times[:n]), observed, tuple(names[:n]), complete)
    _check_finite(recording)
    return recording


def _frame_steps(phase: Phase, every: int, dt: float) -> list[int]:
    """Numbers of steps between a phase's frames."""
    whole, rest = divmod(phase.steps(dt), every)
    return [every] * whole + ([rest] if rest else [])


def _frame_times(scene: Scene, every: int) -> tuple[list[float], list[str]]:
    times, names, count = [0.0], [""], 0
    for phase in scene.phases:
        for steps in _frame_steps(phase, every, scene.dt):
            count += steps
            times.append(count * scene.dt)
            names.append(phase.name)
    return times, names


def _traced(scene: Scene, observe: Callable[[State], Any], every: int) -> Any:
    """All frames, as one traced program."""
    state = start(scene)
    parts = [jax.tree.map(lambda x: x[None], observe(state))]
    for phase in scene.phases:
        setup = prepare(scene, phase.effects)
        whole, rest = divmod(phase.steps(scene.dt), every)

        def frame(state: State, first: Array, setup: Setup = setup) -> tuple[State, Any]:
            state = advance(setup, state, first, steps=every)
            return state, observe(state)

        state, observed = lax.scan(frame, state, every * jnp.arange(whole))
        parts.append(observed)
        if rest:
            state = advance(setup, state, every * whole, steps=rest)
            parts.append(jax.tree.map(lambda x: x[None], observe(state)))
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


_prepare = jax.jit(prepare)


@partial(jax.jit, static_argnums=0)
def _frame(
    observe: Callable[[State], Any], setup: Setup, state: State, first: Array, steps: Array
) -> tuple[State, Any]:
    """`steps` steps and what is observed then.

    The number of steps is not static, so that all frames of all phases with the same effects
    share one compiled program; it is a `while` loop, which has no reverse mode and needs none here.
    """

    def one(number: Array, state: State) -> State:
        return step(setup, state, number.astype(state.positions.dtype) * setup.dt)

    state = lax.fori_loop(first, first + steps, one, state)
    return state, observe(state)


def _interruptible(
    scene: Scene, observe: Callable[[State], Any], every: int, progress: bool
) -> tuple[list[Any], bool]:
    """Frame by frame, with a progress bar, until the end or Ctrl-C."""
    total = sum(phase.steps(scene.dt) for phase in scene.phases)
    bar = _bar(total, progress)
    state, bare = start(scene), replace(scene, phases=())
    frames = [jax.tree.map(np.asarray, observe(state))]
    try:
        for phase in scene.phases:
            setup = _prepare(bare, phase.effects)
            first = 0
            for steps in _frame_steps(phase, every, scene.dt):
                state, observed = _frame(observe, setup, state, jnp.int32(first), jnp.int32(steps))
                frames.append(jax.tree.map(np.asarray, observed))
                first += steps
                bar.update(steps)
    except KeyboardInterrupt:
        return frames, False
    finally:
        bar.close()
    return frames, True


class _NoBar:
    def update(self, steps: int) -> None: ...

    def close(self) -> None: ...


def _bar(total: int, progress: bool) -> Any:
    if not progress:
        return _NoBar()
    from tqdm import tqdm

    return tqdm(total=total, unit="step", desc="simulating")


def _check_finite(recording: Recording) -> None:
    """Raises NotFinite naming the first frame and strand with a NaN or an infinity."""
    frames = len(recording.phases)
    finite = np.ones(frames, bool)
    for leaf in jax.tree.leaves(recording.observed):
        if np.issubdtype(leaf.dtype, np.floating):
            finite &= np.isfinite(leaf).reshape(frames, -1).all(axis=1)
    if finite.all():
        return
    bad = int(np.argmin(finite))
    where = ""
    if isinstance(recording.observed, dict) and "positions" in recording.observed:
        positions = np.asarray(recording.positions[bad])
        strands = recording.scene.strands
        if positions.shape == (strands.count, strands.points, 3):
            wrong = ~np.isfinite(positions).all(axis=(1, 2))
            where = f", strand {int(np.argmax(wrong))}" if wrong.any() else ""
    kept = Recording(
        recording.scene,
        recording.times[:bad],
        jax.tree.map(lambda x: x[:bad], recording.observed),
        recording.phases[:bad],
        complete=False,
    )
    raise NotFinite(
        f"values are not finite from frame {bad} on (t = {recording.times[bad]:g} s, phase "
        f"{recording.phases[bad]!r}{where}); the frames before are in this error's .recording",
        kept,
    )
