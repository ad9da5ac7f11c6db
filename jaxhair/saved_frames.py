"""Frames of a simulation in a checkpoint's folder, so that it goes on where it was killed."""

import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhair.checkpoints import Checkpoints, named, unnamed
from jaxhair.strands import State


class SavedFrames:
    """Frames that were saved before, and the state after them; or none, where there is no folder.

    Arguments:
        folder: of the checkpoint; None saves nothing.
        seconds: least wall time between two writes [s].
        work: all that the frames depend on.
        state: that the simulation starts from.
        observed: shapes and types of a frame, as `jax.eval_shape` gives them.

    Attributes:
        frames: those that were there, in order.
        state: after the last of them; where there are none, the start.

    Raises ValueError for what `Checkpoints` refuses, for parts that do not follow one another, and
    for types of frames that .npz files do not have.
    """

    def __init__(
        self,
        folder: str | os.PathLike[str] | None,
        seconds: float,
        work: Any,
        state: State,
        observed: Any,
    ) -> None:
        self.frames: list[Any] = []
        self.state = state
        self._folder: Checkpoints | None = None
        self._seconds, self._last, self._written = seconds, time.monotonic(), 0
        if folder is None:
            return
        for leaf in jax.tree.leaves(observed):
            if np.dtype(leaf.dtype).kind not in "biufc":
                wanted = "with a checkpoint it must be of a type that NumPy has"
                raise ValueError(f"observe returns an array of {leaf.dtype}; {wanted}")
        self._folder = Checkpoints(folder, work)
        for part in self._folder.parts:
            first, end = (int(i) for i in part["frames"])
            if first > len(self.frames):
                raise ValueError(
                    f"checkpoint {self._folder.folder} lacks frames from {len(self.frames)} on, "
                    "whose part is gone; delete the parts after it, or the folder"
                )
            # a part may repeat frames of the one before: see `save`
            del self.frames[first:]
            stacked = unnamed("observed", part, observed)
            for i in range(end - first):
                self.frames.append(jax.tree.map(lambda x, i=i: x[i], stacked))
            self.state = jax.tree.map(jnp.asarray, unnamed("state", part, state))
        self._written = len(self.frames)

    def save(self, frames: list[Any], state: State, *, now: bool = False) -> None:
        """Writes the frames that are not written yet, and the state after the last one, if it is
        time for it.

        Where Ctrl-C comes after the writing and before that is noted, the next part repeats it.
        """
        due = now or time.monotonic() - self._last >= self._seconds
        if self._folder is None or not due or len(frames) == self._written:
            return
        stacked = jax.tree.map(lambda *x: np.stack(x), *frames[self._written :])
        span = {"frames": np.array([self._written, len(frames)])}
        self._folder.add({**span, **named("observed", stacked), **named("state", state)})
        self._written, self._last = len(frames), time.monotonic()
