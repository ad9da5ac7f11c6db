"""Interrupted work goes on from its checkpoint to the same result, bit for bit; also if killed."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import fitting
import jaxhair as jh
from jaxhair import recording
from jaxhair.arrays import read_arrays
from jaxhair.checkpoints import Checkpoints

DT = 1 / 360


def scene(solver: Any = None, gravity: float = -9.8) -> jh.Scene:
    hair = jh.Strands.straight(np.eye(3)[:2], (1.0, 0.0, -1.0), length=0.1, points=5)
    air = (jh.Hold(), jh.Gravity((0.0, 0.0, gravity)), jh.Drag(0.1))
    phases = (jh.Phase("a", 10 * DT, air), jh.Phase("b", 7 * DT, air[:2]))
    return jh.Scene(hair, phases=phases, solver=solver or jh.PositionBased())


def assert_equal(one: Any, other: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def interrupt_after(monkeypatch: pytest.MonkeyPatch, frames: int) -> None:
    """Ctrl-C comes while the frame after so many new ones is computed."""
    true, count = recording._frame, 0

    def frame(*arguments: Any) -> Any:
        nonlocal count
        count += 1
        if count > frames:
            raise KeyboardInterrupt
        return true(*arguments)

    monkeypatch.setattr(recording, "_frame", frame)


@pytest.mark.parametrize("solver", [jh.PositionBased(), jh.Direct()])
@pytest.mark.parametrize("seconds", [0.0, 1e9])
def test_a_simulation_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, solver: Any, seconds: float
) -> None:
    """Interrupted after 0, 3, 1 and 4 frames, then finished; whether or not it wrote meanwhile."""
    options: dict[str, Any] = {"fps": 180, "checkpoint": tmp_path, "checkpoint_seconds": seconds}
    whole = jh.simulate(scene(solver), fps=180)
    done = 1
    for frames in (0, 3, 1, 4):
        with monkeypatch.context() as patch:
            interrupt_after(patch, frames)
            part = jh.simulate(scene(solver), **options)
        done += frames
        assert (part.complete, len(part.times)) == (False, done)
    rest = jh.simulate(scene(solver), **options)
    assert rest.complete
    assert_equal(rest, whole)
    monkeypatch.setattr(recording, "_frame", None)  # nothing is left to compute
    assert_equal(jh.simulate(scene(solver), **options), whole)


def test_other_work_is_refused(tmp_path: Path) -> None:
    jh.simulate(scene(), fps=90, checkpoint=tmp_path)
    for other, fps in ((scene(gravity=-9.9), 90), (scene(), 45)):
        with pytest.raises(ValueError, match="is of other work"):
            jh.simulate(other, fps=fps, checkpoint=tmp_path)
    with pytest.raises(ValueError, match="must be None"):
        jax.jit(lambda g: jh.simulate(scene(gravity=g), checkpoint=tmp_path).positions)(-9.8)


def test_damaged_parts_and_leftovers(tmp_path: Path) -> None:
    (tmp_path / ".new-0123.npz").write_bytes(b"half")
    jh.simulate(scene(), fps=90, checkpoint=tmp_path)
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["part-000000.npz"]
    path = tmp_path / "part-000000.npz"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match="delete the folder") as caught:
        jh.simulate(scene(), fps=90, checkpoint=tmp_path)
    assert "part-000000.npz" in str(caught.value)


def test_parts(tmp_path: Path) -> None:
    """In order; alone, a part replaces all before it."""
    folder = Checkpoints(tmp_path / "new", {"x": 1.0})
    for i in range(3):
        folder.add({"i": np.array(i)})
    assert [int(p["i"]) for p in Checkpoints(tmp_path / "new", {"x": 1.0}).parts] == [0, 1, 2]
    folder.add({"i": np.array(3)}, alone=True)
    assert [int(p["i"]) for p in Checkpoints(tmp_path / "new", {"x": 1.0}).parts] == [3]
    for other in ({"x": 1}, {"x": np.float32(1)}, {"y": 1.0}, {"x": 1.5}):
        with pytest.raises(ValueError, match="other work"):
            Checkpoints(tmp_path / "new", other)


def tiny_fit(checkpoint: Path | None, method: str, progress: Any = None) -> fitting.Fit:
    hair = jh.Strands.straight([[0.0, 0, 0]], (0, 0, -1.0), length=0.1, points=9)
    perm = jh.treatments.perm(rod_diameter=20e-3, climb=0.1, free=[jh.Hold()], seconds=5 * DT)
    free = {"phases.*.Wound.diameter": fitting.Interval(15e-3, 40e-3)}
    return fitting.fit(
        jh.Scene(hair, phases=perm),
        {"perm": fitting.helix(diameter=25e-3, pitch=8e-3)},
        free,
        method=method,
        steps=12,
        progress=progress,
        checkpoint=checkpoint,
    )


@pytest.mark.parametrize("method", ["levenberg-marquardt", "adam"])
def test_a_fit_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    monkeypatch.setattr(sys.modules["fitting.fit"], "JOURNAL_SECONDS", 0.0)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # for optax
        stopped_and_finished(tmp_path, method)


def stopped_and_finished(tmp_path: Path, method: str) -> None:
    """A fit that is stopped at its second and fifth simulation, and one that is not."""
    whole = tiny_fit(None, method)
    calls: list[int] = []

    def stop(step: int, residual: float) -> None:
        calls.append(step)
        if len(calls) in (2, 5):
            raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            tiny_fit(tmp_path, method, stop)
    found = tiny_fit(tmp_path, method, stop)
    assert_equal(found.values, whole.values)
    assert_equal(found.simulated, whole.simulated)
    assert (found.steps, found.residual_mm) == (whole.steps, whole.residual_mm)


WORK = """
import sys, time
sys.path.insert(0, {tests!r})
import numpy as np
import test_checkpoints as t
import jaxhair as jh
from jaxhair import recording
what, folder = sys.argv[1], sys.argv[2]
if what == "simulation":
    true = recording._frame
    def slow(*a):
        time.sleep(0.1)
        return true(*a)
    recording._frame = slow
    movie = jh.simulate(t.scene(), fps=360, checkpoint=folder, checkpoint_seconds=0.0)
    result = {{"x": movie.positions}}
else:
    found = t.tiny_fit(folder, "levenberg-marquardt", lambda *_: time.sleep(0.3))
    result = {{"x": found.simulated["perm"], "steps": np.array(found.steps)}}
from jaxhair.arrays import write_arrays
write_arrays(sys.argv[3], result)
"""


def killed_and_finished(tmp_path: Path, what: str, kills: int, seed: int) -> None:
    """A process is killed so many times at random moments, then left to finish."""
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    program = WORK.format(tests=str(Path(__file__).parent))

    def started(folder: str, result: str) -> subprocess.Popen[bytes]:
        paths = [str(tmp_path / folder), str(tmp_path / result)]
        return subprocess.Popen([sys.executable, "-c", program, what, *paths], env=environment)

    begin = time.monotonic()
    assert started("undisturbed", "whole.npz").wait() == 0
    assert started("undisturbed", "again.npz").wait() == 0  # now from its cache
    usual = time.monotonic() - begin
    rng, done = random.Random(seed), 0
    while done < kills:
        process = started("folder", "result.npz")
        try:
            process.wait(timeout=rng.uniform(0.3, 0.5 * usual))
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
        done += 1
        for path in tmp_path.glob("folder/part-*"):
            read_arrays(path)
        if (tmp_path / "result.npz").exists():  # it was faster: once more
            read_arrays(tmp_path / "result.npz")
            (tmp_path / "result.npz").unlink()
            for path in tmp_path.glob("folder/*"):
                path.unlink()
    assert started("folder", "result.npz").wait() == 0
    assert_equal(read_arrays(tmp_path / "result.npz"), read_arrays(tmp_path / "whole.npz"))


@pytest.mark.parametrize("what", ["simulation", "fit"])
def test_killed_twice(tmp_path: Path, what: str) -> None:
    killed_and_finished(tmp_path, what, 2, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["simulation", "fit"])
def test_killed_15_times(tmp_path: Path, what: str) -> None:
    killed_and_finished(tmp_path, what, 15, seed=2)
