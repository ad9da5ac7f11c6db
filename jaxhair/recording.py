"""Simulating a whole scene and recording frames of it."""

import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import check, diagnosis, tiles
from jaxhair.compiling import compile_together
from jaxhair.kernels import allowed
from jaxhair.progress import Progress
from jaxhair.pytree import pytree, static
from jaxhair.saved_frames import SavedFrames
from jaxhair.scene import Phase, Scene
from jaxhair.simulate import Setup, advance, blank, prepare, remembering_step, start
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

    def fractions_at_points(self) -> np.ndarray:
        """Bonded fractions at all points, shape (frames, strands, points, 4): ends have their
        neighbours', and a strand without inner points, which has no bonds, has 1."""
        fractions = np.asarray(self.fractions)
        inner, counts = fractions.shape[2], np.asarray(self.scene.strands.counts)
        if inner == 0:
            return np.ones_like(fractions, shape=(*fractions.shape[:2], 2, fractions.shape[3]))
        place = np.clip(np.arange(inner + 2) - 1, 0, np.maximum(counts - 3, 0)[:, None])
        found = np.take_along_axis(fractions, place[None, :, :, None], 2)
        return np.where((counts > 2)[:, None, None], found, np.ones((), found.dtype))

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
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 10.0,
    devices: int = 1,
) -> Recording:
    """Simulates a scene and records frames.

    Frames are taken at the start, then `fps` times a simulated second from the start of each
    phase on, and at the end of each phase.

    Arguments:
        fps: frames a second of simulated time; at most one a step is taken.
        observe: what to keep of a state, a function from `State` to any pytree of arrays.
        progress: show a progress bar on stderr.
        checkpoint: a folder in which frames are kept as the work goes on. The same call with the
            same scene goes on from there, however the work ended, to the same frames bit for bit
            (on the same kind of machine). One process at a time may use it.
        checkpoint_seconds: wall time between two writes to it [s].
        devices: over which the strands are spread; see `run`.

    Ctrl-C ends the simulation and returns the frames so far, with `complete` False. Under a JAX
    transformation all frames are computed in one traced program, and nothing is shown or kept.

    Raises ValueError for fps that are not above 0, for devices as `run` does and for a checkpoint
    that is of other work or damaged, and NotFinite at the first frame with values that are NaN or
    infinite.
    """
    check.instance("scene", scene, Scene)
    check.flag("progress", progress)
    check.not_negative("checkpoint_seconds", checkpoint_seconds)
    every = max(1, round(1 / (check.constant("fps", fps) * scene.dt)))
    devices = tiles.checked_devices(scene, devices)
    numbers = scene.as_arrays()
    times, names = _frame_times(scene, every)
    if check.traced(scene):
        if checkpoint is not None:
            raise ValueError(
                f"checkpoint is {checkpoint!r}; under a JAX transformation it must be None"
            )
        observed = _traced(numbers, observe, every, devices)
        return Recording(scene, jnp.asarray(times, scene.dtype), observed, tuple(names))
    saved = _saved_frames(checkpoint, float(checkpoint_seconds), numbers, observe, every, devices)
    frames, complete, failure = _interruptible(numbers, observe, every, progress, saved, devices)
    n = len(frames)
    recording = Recording(
        scene, np.asarray(times[:n]), _stacked(frames, observe, numbers), tuple(names[:n]), complete
    )
    if failure is not None:
        raise NotFinite(_message(scene, observe, n, times[n], names[n], failure), recording)
    return recording


def _stacked(frames: list[Any], observe: Callable[[State], Any], scene: Scene) -> Any:
    if frames:
        return jax.tree.map(lambda *x: np.stack(x), *frames)
    one = jax.eval_shape(observe, start(scene))
    return jax.tree.map(lambda x: np.empty((0, *x.shape), x.dtype), one)


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


def _traced(scene: Scene, observe: Callable[[State], Any], every: int, devices: int) -> Any:
    """All frames, as one traced program."""
    state = start(scene)
    parts = [jax.tree.map(lambda x: x[None], observe(state))]
    for phase in scene.phases:
        setup = prepare(scene, phase.effects, devices)
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


_prepare = jax.jit(prepare, static_argnums=2)


@partial(jax.jit, static_argnums=0)
def _frame(
    observe: Callable[[State], Any], setup: Setup, state: State, first: Array, steps: Array
) -> tuple[State, Any, Array]:
    """`steps` steps, what is observed then, and whether every number of the state is finite.

    The number of steps is not static, so that all frames of all phases with the same effects
    share one compiled program; it is a `while` loop, which has no reverse mode and needs none here.
    """

    def advanced(setup: Setup, state: State, first: Array, steps: Array) -> State:
        def one(number: Array, carry: tuple[State, Any]) -> tuple[State, Any]:
            state, memories = carry
            time = number.astype(state.positions.dtype) * setup.dt
            return remembering_step(setup, state, memories, time)

        return lax.fori_loop(first, first + steps, one, (state, blank(setup, state)))[0]

    with allowed():
        state = tiles.in_shares(advanced, setup, state, first, steps)
    finite = [jnp.isfinite(x).all() for x in jax.tree.leaves(state)]
    return state, observe(state), jnp.stack(finite).all()


def _saved_frames(
    folder: str | os.PathLike[str] | None,
    seconds: float,
    scene: Scene,
    observe: Callable[[State], Any],
    every: int,
    devices: int,
) -> SavedFrames:
    """What a checkpoint's folder has of this simulation."""
    state, work, observed = start(scene), None, None
    if folder is not None:
        # The programs tell apart what the numbers do not: other effects or another `observe` of
        # the same name, and another state of this package.
        at, bare, programs = jnp.int32(0), replace(scene, phases=()), []
        for phase in scene.phases:
            setup = _prepare(bare, phase.effects, devices)
            programs.append(_frame.lower(observe, setup, state, at, at).as_text())
        observed = jax.eval_shape(observe, state)
        work = {"scene": scene, "steps": every, "programs": programs, "observed": str(observed)}
    return SavedFrames(folder, seconds, work, state, observed)


Failure = tuple[Phase | None, Setup | None, State, int, int]
"""Of `jaxhair.diagnosis.cause`: phase and setup, state before, first step and number of steps."""


def _interruptible(
    scene: Scene,
    observe: Callable[[State], Any],
    every: int,
    progress: bool,
    saved: SavedFrames,
    devices: int,
) -> tuple[list[Any], bool, Failure | None]:
    """Frame by frame, with a progress bar, until the end, Ctrl-C or a value that is not finite."""
    total = sum(phase.steps(scene.dt) for phase in scene.phases)
    bar = Progress("simulating", total, unit="step", shown=progress)
    bare = replace(scene, phases=())
    frames = saved.frames or [jax.tree.map(np.asarray, jax.jit(observe)(saved.state))]
    # how many frames, and the state after them, in one object: Ctrl-C may come at any statement
    kept = (len(frames), saved.state)
    if not _finite((frames[0], saved.state)):
        return [], False, (None, None, saved.state, 0, 0)
    number = 0
    try:
        if devices == 1:  # on several, states are spread over them only once they are simulated
            _compile(scene, observe, every, saved.state, len(frames))
        for phase in scene.phases:
            setup, first = None, 0
            for steps in _frame_steps(phase, every, scene.dt):
                number += 1
                if number >= kept[0]:
                    setup = setup or _prepare(bare, phase.effects, devices)
                    before = kept[1]
                    state, observed, sound = _frame(
                        observe, setup, before, jnp.int32(first), jnp.int32(steps)
                    )
                    frame = jax.tree.map(np.asarray, observed)
                    if not (sound and _finite(frame)):
                        return frames[: kept[0]], False, (phase, setup, before, first, steps)
                    del frames[kept[0] :]
                    frames.append(frame)
                    kept = (len(frames), state)
                    saved.save(frames, state)
                first += steps
                bar.update(steps)
    except KeyboardInterrupt:
        return frames[: kept[0]], False, None
    finally:
        saved.save(frames[: kept[0]], kept[1], now=True)
        bar.close()
    return frames, True, None


def _compile(
    scene: Scene, observe: Callable[[State], Any], every: int, state: State, done: int
) -> None:
    """Compiles the programs of all phases that have frames after the first `done`."""
    bare, number, calls, at = replace(scene, phases=()), 1, [], jnp.int32(0)
    for phase in scene.phases:
        number += len(_frame_steps(phase, every, scene.dt))
        if number > done:
            calls.append((observe, _prepare(bare, phase.effects, 1), state, at, at))
    compile_together(_frame, calls)


def _finite(tree: Any) -> bool:
    leaves = (np.asarray(leaf) for leaf in jax.tree.leaves(tree))
    return all(np.isfinite(x).all() for x in leaves if np.issubdtype(x.dtype, np.inexact))


def _message(
    scene: Scene,
    observe: Callable[[State], Any],
    frame: int,
    seconds: float,
    phase: str,
    failure: Failure,
) -> str:
    """What NotFinite says, in one line of less than 500 characters."""
    of_phase, setup, state, first, steps = failure

    def one(state: State, number: int) -> State:  # the same program, so the same numbers
        assert setup is not None
        return _frame(observe, setup, state, jnp.int32(number), jnp.int32(1))[0]

    try:
        place, reason = diagnosis.cause(scene, of_phase, setup, state, one, first, steps)
    # the failure itself must be heard of, whatever else fails, and its frames kept after Ctrl-C
    except (Exception, KeyboardInterrupt) as error:
        place, reason = "", f"its cause was not found ({type(error).__name__})"
    where = f", {place}" if place else ""
    start = f"values are not finite from frame {frame} on (t = {seconds:g} s, phase {phase!r}"
    end = "the frames before are in this error's .recording"
    room = max(499 - len(start + where + end) - len("): ; "), 60)
    return f"{start}{where}): {' '.join(reason.split())[:room]}; {end}"
