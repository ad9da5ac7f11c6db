"""Simulating a whole scene and recording frames of it."""

import os
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import check, diagnosis
from jaxhair.checkpoints import Checkpoints, named, unnamed
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
    checkpoint: str | os.PathLike[str] | None = None,
    checkpoint_seconds: float = 10.0,
) -> Recording:
    """Simulates a scene and records frames.

    Frames are taken at the start, then `fps` times a simulated second from the start of each
    phase on, and at the end of each phase.

    Arguments:
        fps: frames a second of simulated time; at most one a step is taken.
        observe: what to keep of a state, a function from `State` to any pytree of arrays.
        progress: show a progress bar on stderr.
        checkpoint: a folder in which frames are kept as the work goes on. The same call with the
            same scene goes on from there, however the work ended, to the same frames bit for bit.
        checkpoint_seconds: wall time between two writes to it [s].

    Ctrl-C ends the simulation and returns the frames so far, with `complete` False. Under a JAX
    transformation all frames are computed in one traced program, and nothing is shown or kept.

    Raises ValueError for fps that are not above 0 and for a checkpoint of other work, and
    NotFinite if values became NaN or infinite.
    """
    check.instance("scene", scene, Scene)
    check.flag("progress", progress)
    check.number("checkpoint_seconds", checkpoint_seconds)
    check.not_negative("checkpoint_seconds", checkpoint_seconds)
    every = max(1, round(1 / (check.constant("fps", fps) * scene.dt)))
    numbers = scene.as_arrays()
    times, names = _frame_times(scene, every)
    if any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(scene)):
        if checkpoint is not None:
            raise ValueError(
                f"checkpoint is {checkpoint!r}; under a JAX transformation it must be None"
            )
        observed = _traced(numbers, observe, every)
        return Recording(scene, jnp.asarray(times, scene.dtype), observed, tuple(names))
    saver = _Saver(checkpoint, float(checkpoint_seconds), numbers, observe, every)
    frames, complete, failure = _interruptible(numbers, observe, every, progress, saver)
    n = len(frames)
    recording = Recording(
        scene,
        np.asarray(times[:n]),
        jax.tree.map(lambda *x: np.stack(x), *frames),
        tuple(names[:n]),
        complete,
    )
    if failure is not None:
        raise NotFinite(_message(n, times[n], names[n], failure), recording)
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


class _Saver:
    """Keeps frames in a checkpoint's folder, and what was kept there before; or keeps nothing."""

    def __init__(
        self,
        folder: str | os.PathLike[str] | None,
        seconds: float,
        scene: Scene,
        observe: Callable[[State], Any],
        every: int,
    ) -> None:
        self._seconds, self._last = seconds, time.monotonic()
        self._folder: Checkpoints | None = None
        self.frames: list[Any] = []
        self.state: State = start(scene)
        self._written = 0
        if folder is None:
            return
        name = f"{getattr(observe, '__module__', '')}.{getattr(observe, '__qualname__', observe)}"
        self._folder = Checkpoints(folder, {"scene": scene, name: every})
        like = jax.eval_shape(observe, self.state)
        for part in self._folder.parts:
            stacked = unnamed("observed", part, like)
            count = len(jax.tree.leaves(stacked)[0])
            self.frames += [jax.tree.map(lambda x, i=i: x[i], stacked) for i in range(count)]
            self.state = jax.tree.map(jnp.asarray, unnamed("state", part, self.state))
        self._written = len(self.frames)

    def keep(self, frames: list[Any], state: State, *, now: bool = False) -> None:
        """Writes the frames that are not written yet, and the state after the last one, if it is
        time for it."""
        due = now or time.monotonic() - self._last >= self._seconds
        if self._folder is None or not due or len(frames) == self._written:
            return
        stacked = jax.tree.map(lambda *x: np.stack(x), *frames[self._written :])
        self._folder.add({**named("observed", stacked), **named("state", state)})
        self._written, self._last = len(frames), time.monotonic()


Failure = tuple[Scene, Phase, Setup, State, int, int]
"""Arguments of `jaxhair.diagnosis.cause`."""


def _interruptible(
    scene: Scene, observe: Callable[[State], Any], every: int, progress: bool, saver: _Saver
) -> tuple[list[Any], bool, Failure | None]:
    """Frame by frame, with a progress bar, until the end, Ctrl-C or a value that is not finite."""
    total = sum(phase.steps(scene.dt) for phase in scene.phases)
    bar = _bar(total, progress)
    bare = replace(scene, phases=())
    frames = saver.frames or [jax.tree.map(np.asarray, observe(saver.state))]
    # how many frames, and the state after them, in one object: Ctrl-C may come at any statement
    kept = (len(frames), saver.state)
    number = 0
    try:
        for phase in scene.phases:
            setup, first = None, 0
            for steps in _frame_steps(phase, every, scene.dt):
                number += 1
                if number >= kept[0]:
                    setup = setup or _prepare(bare, phase.effects)
                    before = kept[1]
                    state, observed = _frame(
                        observe, setup, before, jnp.int32(first), jnp.int32(steps)
                    )
                    frame = jax.tree.map(np.asarray, observed)
                    if not _finite(frame):
                        return frames, False, (scene, phase, setup, before, first, steps)
                    del frames[kept[0] :]
                    frames.append(frame)
                    kept = (len(frames), state)
                    saver.keep(frames, state)
                first += steps
                bar.update(steps)
    except KeyboardInterrupt:
        return frames[: kept[0]], False, None
    finally:
        saver.keep(frames[: kept[0]], kept[1], now=True)
        bar.close()
    return frames, True, None


def _finite(frame: Any) -> bool:
    return all(
        bool(np.isfinite(leaf).all())
        for leaf in jax.tree.leaves(frame)
        if np.issubdtype(leaf.dtype, np.inexact)
    )


class _NoBar:
    def update(self, steps: int) -> None: ...

    def close(self) -> None: ...


def _bar(total: int, progress: bool) -> Any:
    if not progress:
        return _NoBar()
    from tqdm import tqdm

    return tqdm(total=total, unit="step", desc="simulating")


def _message(frame: int, seconds: float, phase: str, failure: Failure) -> str:
    """What NotFinite says, in one line."""
    try:
        place, reason = diagnosis.cause(*failure)
    except Exception as error:  # the failure itself must be heard of, whatever else fails
        place, reason = "", f"its cause was not found ({type(error).__name__})"
    where = f", {place}" if place else ""
    return (
        f"values are not finite from frame {frame} on (t = {seconds:g} s, phase {phase!r}{where}): "
        f"{reason or 'its cause was not found'}; the frames before are in this error's .recording"
    )
