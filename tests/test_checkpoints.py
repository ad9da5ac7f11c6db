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
import jax.numpy as jnp
import numpy as np
import pytest

import fitting
import jaxhair as jh
from fitting.__main__ import main as fit_main
from jaxhair import recording
from jaxhair.__main__ import main
from jaxhair.arrays import read_arrays
from jaxhair.checkpoints import Checkpoints
from jaxhair.effects import VelocityEffect

DT = 1 / 360


def scene(solver: Any = None, gravity: float = -9.8) -> jh.Scene:
    hair = jh.Strands.straight(np.eye(3)[:2], (1.0, 0.0, -1.0), length=0.1, points=5)
    air = (jh.Hold(), jh.Gravity((0.0, 0.0, gravity)), jh.Drag(0.1))
    phases = (jh.Phase("a", 10 * DT, air), jh.Phase("b", 7 * DT, air[:2]))
    return jh.Scene(hair, phases=phases, solver=solver or jh.PositionBased())


def assert_equal(one: Any, other: Any) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


class Frame:
    """`recording._frame`, during which Ctrl-C comes after so many calls."""

    def __init__(self, calls: int) -> None:
        self.true, self.left, self.lower = recording._frame, calls, recording._frame.lower

    def __call__(self, *arguments: Any) -> Any:
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return self.true(*arguments)


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
            patch.setattr(recording, "_frame", Frame(frames))
            part = jh.simulate(scene(solver), **options)
        done += frames
        assert (part.complete, len(part.times)) == (False, done)
    rest = jh.simulate(scene(solver), **options)
    assert rest.complete
    assert_equal(rest, whole)
    monkeypatch.setattr(recording, "_frame", Frame(0))  # nothing is left to compute
    assert_equal(jh.simulate(scene(solver), **options), whole)


def test_ctrl_c_between_writing_and_noting_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The frames that were just written are written again, and count once."""
    whole = jh.simulate(scene(), fps=180)
    true, options = Checkpoints.add, {"checkpoint": tmp_path, "checkpoint_seconds": 0.0}

    def add(self: Checkpoints, *arguments: Any) -> None:
        true(self, *arguments)
        if len(self._paths) == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "add", add)
        assert len(jh.simulate(scene(), fps=180, **options).times) == 4
    assert len(list(tmp_path.iterdir())) == 4
    assert_equal(jh.simulate(scene(), fps=180, **options), whole)


@jh.pytree
class Push(VelocityEffect):
    """Its source is edited below."""

    def velocity_change(self, rod: Any, state: jh.State, dt: float) -> Any:
        return jnp.full_like(state.velocities, 0.01)


def edited(self: Push, rod: Any, state: jh.State, dt: float) -> Any:
    return jnp.full_like(state.velocities, 0.02)


def test_other_work_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other numbers, options, effects of the same name, and what is observed."""
    jh.simulate(scene(), fps=90, checkpoint=tmp_path / "a")
    pushed = jh.Scene(scene().strands, phases=(jh.Phase("a", 5 * DT, (Push(),)),))
    jh.simulate(pushed, observe=lambda s: s.positions, checkpoint=tmp_path / "b")
    monkeypatch.setattr(Push, "velocity_change", edited)
    recording._frame.clear_cache()  # as in a new process
    for folder, other, options in (
        ("a", scene(gravity=-9.9), {"fps": 90}),
        ("a", scene(), {"fps": 45}),
        ("a", scene(), {"fps": 90, "observe": lambda s: s.positions}),
        ("b", pushed, {"observe": lambda s: s.positions}),
    ):
        with pytest.raises(ValueError, match=r"is of other work.*another folder, or be deleted"):
            jh.simulate(other, checkpoint=tmp_path / folder, **options)
    with pytest.raises(ValueError, match="must be None"):
        jax.jit(lambda g: jh.simulate(scene(gravity=g), checkpoint=tmp_path).positions)(-9.8)
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file", tmp_path / "file" / "inside", 3):
        with pytest.raises(ValueError, match=r"checkpoint is .* must be the path of a folder"):
            jh.simulate(scene(), checkpoint=path)


def zeros(state: jh.State) -> Any:
    return jnp.zeros((1 << 20,), state.positions.dtype)


def nothing(state: jh.State) -> Any:
    return {}


def short_floats(state: jh.State) -> Any:
    return state.positions.astype(jnp.bfloat16)


def test_whatever_is_observed(tmp_path: Path) -> None:
    """Numbers that a file would shrink by more than is believed; none at all; and others that
    files do not have, which are refused before any work is done."""
    for observe in (zeros, nothing):
        folder = tmp_path / observe.__name__
        whole = jh.simulate(scene(), fps=90, observe=observe, checkpoint=folder)
        again = jh.simulate(scene(), fps=90, observe=observe, checkpoint=folder)
        assert_equal(again, whole)
        assert len(again.times) == 6
    with pytest.raises(ValueError, match="observe returns an array of bfloat16"):
        jh.simulate(scene(), observe=short_floats, checkpoint=tmp_path / "short")


def test_frames_before_a_failure_are_kept(tmp_path: Path) -> None:
    bad = jh.replace_leaves(scene(), {"phases.b.Gravity.acceleration": np.full(3, np.nan)})
    for _ in range(2):
        with pytest.raises(jh.NotFinite) as caught:
            jh.simulate(bad, fps=90, checkpoint=tmp_path, checkpoint_seconds=1e9)
        assert len(caught.value.recording.times) == 4
        assert [p.name for p in tmp_path.iterdir()] == ["part-000000000.npz"]


def test_damaged_parts_and_leftovers(tmp_path: Path) -> None:
    (tmp_path / ".new-0123.npz").write_bytes(b"half")
    jh.simulate(scene(), fps=90, checkpoint=tmp_path)
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["part-000000000.npz"]
    path = tmp_path / "part-000000000.npz"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match="delete this file and the parts after it") as caught:
        jh.simulate(scene(), fps=90, checkpoint=tmp_path)
    assert "part-000000000.npz" in str(caught.value)
    path.unlink()
    jh.simulate(scene(), fps=90, checkpoint=tmp_path, checkpoint_seconds=0.0)
    path.unlink()
    with pytest.raises(ValueError, match="lacks frames from 0 on"):
        jh.simulate(scene(), fps=90, checkpoint=tmp_path)


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


def tiny_fit(
    checkpoint: Path | str | None, method: str, progress: Any = None, steps: int = 12
) -> fitting.Fit:
    """Which gravity bends a strand so far? One phase, because the time goes into compiling."""
    air = (jh.Hold(), jh.Gravity((0.0, 0.0, -9.8)))
    hair = jh.Strands.straight([[0.0, 0, 0]], (1.0, 0, 0), length=0.1, points=4)
    swing = jh.Scene(hair, phases=(jh.Phase("a", 8 * DT, air),))
    wanted = [[[0.0, 0, 0], [0.033, 0, 0], [0.066, 0.001, -0.001], [0.099, 0.003, -0.003]]]
    return fitting.fit(
        swing,
        {"a": fitting.Shape(wanted)},
        {"phases.a.Gravity.acceleration": fitting.Unbounded()},
        method=method,
        steps=steps,
        progress=progress,
        checkpoint=checkpoint,
        learning_rate=1.0,
    )


def tiny_fit_each(checkpoint: str | None) -> fitting.FitEach:
    """How stiff is each of some strands that sag?"""
    roots = 0.01 * np.arange(9.0).reshape(3, 3)
    hair = jh.Strands.straight(roots, (1.0, 0, 0), length=0.1, points=4)
    sagging = (jh.Phase("a", 8 * DT, (jh.Hold(), jh.Gravity())),)
    truth = jh.Scene(hair, jh.Fibre(np.array([0.02, 0.1, 0.4])), phases=sagging)
    wanted = np.asarray(jh.run(truth)["a"].points) + 1e-4 * np.sin(np.arange(36.0)).reshape(3, 4, 3)
    return fitting.fit_each(
        jh.Scene(hair, phases=sagging),
        {"a": fitting.Shape(wanted)},
        {"fibre.stiffness": fitting.Interval(1e-3, 0.9)},
        tolerance=1e-9,
        tile=2,
        checkpoint=checkpoint,
    )


@pytest.mark.parametrize(
    "method",
    [
        "levenberg-marquardt",
        pytest.param("adam", marks=pytest.mark.slow),
        pytest.param("l-bfgs", marks=pytest.mark.slow),
    ],
)
def test_a_fit_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    monkeypatch.setattr(sys.modules["fitting.optimisers"], "JOURNAL_SECONDS", 0.0)
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):  # for optax
        stopped_and_finished(tmp_path, method)


def stopped_and_finished(tmp_path: Path, method: str) -> None:
    """A fit that is stopped at its second and fifth simulation, and one that is not."""
    whole = tiny_fit(None, method)
    calls: list[int] = []

    def stop(step: int, *_: Any) -> None:
        calls.append(step)
        if len(calls) in (2, 5):
            raise KeyboardInterrupt

    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            tiny_fit(tmp_path, method, stop)
    found = tiny_fit(tmp_path, method, stop)
    assert_equal(found.values, whole.values)
    assert_equal(found.simulated, whole.simulated)
    for name in ("steps", "residual_mm", "residuals_mm", "converged", "undetermined", "settings"):
        assert getattr(found, name) == getattr(whole, name)
    with pytest.raises(ValueError, match="is of other work"):
        tiny_fit(tmp_path, method, steps=11)


def test_the_commands_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same command again, after Ctrl-C: no output is in its way."""
    monkeypatch.setattr("jaxhair.simulate_command.scene_of", lambda options: scene())
    path, folder = tmp_path / "perm.npz", tmp_path / "kept"
    command = ["simulate", "perm", "--fps", "90", "--quiet", "--output", str(path)]
    command += ["--checkpoint", str(folder)]
    with monkeypatch.context() as patch:
        patch.setattr(recording, "_frame", Frame(2))
        assert main(command) == 130
    assert "3 frames are kept" in capsys.readouterr().err
    assert not path.exists()
    assert main(command) == 0
    assert_equal(read_arrays(path)["positions"], jh.simulate(scene(), fps=90).positions)

    def interrupted(*_: Any, **options: Any) -> None:
        assert options["checkpoint"] == str(folder)
        raise KeyboardInterrupt

    monkeypatch.setattr("fitting.fit_command.fit", interrupted)
    command = ["--output", str(tmp_path / "fitted"), "--checkpoint", str(folder), "--quiet"]
    assert fit_main(command) == 130
    assert capsys.readouterr().err == f"interrupted; the same command goes on from {folder}\n"


WORK = """
import os, sys, time
sys.path.insert(0, {tests!r})
import conftest
import numpy as np
import test_checkpoints as t
from jaxhair.arrays import write_arrays

save, link = np.savez, os.link

def slowly_saved(path, **arrays):
    print("writes", flush=True)
    save(path, **arrays)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    time.sleep(0.04)
    path.write_bytes(whole)
    time.sleep(0.02)

def slowly_linked(*paths):
    link(*paths)
    time.sleep(0.02)

np.savez, os.link = slowly_saved, slowly_linked
write_arrays(sys.argv[3], t.work(sys.argv[1], sys.argv[2]))
"""


def work(what: str, folder: str | None) -> dict[str, Any]:
    """What is done in a process of its own, and killed: most of the time it is writing."""
    if what == "simulation":
        options: dict[str, Any] = {"checkpoint": folder, "checkpoint_seconds": 0.0}
        movie = jh.simulate(scene(), fps=360, **options)
        return {"positions": movie.positions, "fractions": movie.fractions}
    if what == "fit each":
        each = tiny_fit_each(folder)
        return {"residuals": each.residual_mm, "steps": each.steps, **each.values}
    found = tiny_fit(folder, "levenberg-marquardt")
    return {"simulated": found.simulated["a"], "steps": found.steps, **found.values}


def killed_and_finished(tmp_path: Path, what: str, kills: int, seed: int) -> None:
    """A process is killed so many times at random moments, then left to finish."""
    environment = {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    program = WORK.format(tests=str(Path(__file__).parent))
    whole = {name: np.asarray(x) for name, x in work(what, None).items()}
    folder, result = tmp_path / "folder", tmp_path / "result.npz"
    rng, killed, newest = random.Random(seed), 0, -1
    while True:
        command = [sys.executable, "-c", program, what, str(folder), str(result)]
        with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            if killed < kills:
                # mostly once it has begun to write; there is no line if nothing is left to do
                if rng.random() < 0.2:
                    time.sleep(rng.uniform(0, 4))
                elif process.stdout.readline():
                    time.sleep(rng.uniform(0, 0.25))
                process.send_signal(signal.SIGKILL)
            process.wait()
        killed += process.returncode == -signal.SIGKILL
        for path in (*folder.glob("[!.]*"), *tmp_path.glob("*.npz")):
            read_arrays(path)  # whole
        numbers = [int(path.stem.removeprefix("part-")) for path in folder.glob("[!.]*")]
        assert max(numbers, default=-1) >= newest  # and none is lost
        newest = max(numbers, default=-1)
        if not result.exists():
            assert process.returncode == -signal.SIGKILL
            continue
        found = read_arrays(result)
        assert found.keys() == whole.keys()
        for name in whole:
            np.testing.assert_array_equal(found[name], whole[name])
        if killed >= kills:
            break
        newest = -1
        for path in (result, *folder.iterdir()):  # it was faster: once more
            path.unlink()
    assert not list(folder.glob(".*"))  # nothing is left of what was killed


@pytest.mark.parametrize(
    "what", ["simulation", "fit", pytest.param("fit each", marks=pytest.mark.slow)]
)
def test_killed_twice(tmp_path: Path, what: str) -> None:
    killed_and_finished(tmp_path, what, 2, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["simulation", "fit", "fit each"])
def test_killed_15_times(tmp_path: Path, what: str) -> None:
    killed_and_finished(tmp_path, what, 15, seed=2)


def test_a_refused_folder_is_left_as_it_is(tmp_path: Path) -> None:
    """What another process may be writing there is not removed."""
    Checkpoints(tmp_path, {"x": 1.0}).add({"i": np.array(0)})
    (tmp_path / ".new-0123.npz").write_bytes(b"half")
    with pytest.raises(ValueError, match="other work"):
        Checkpoints(tmp_path, {"x": 2.0})
    assert (tmp_path / ".new-0123.npz").exists()
    Checkpoints(tmp_path, {"x": 1.0})
    assert not (tmp_path / ".new-0123.npz").exists()
