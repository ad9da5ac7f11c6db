"""`simulate`: which frames it takes, what it keeps, and how it ends early."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair import recording
from jaxhair.compiling import compile_together
from jaxhair.effects import VelocityEffect

SAME = 1e-12  # eager against traced and against `run`, float64 [m]
DT = 0.01
FPS = 1 / (3 * DT)  # a frame each three steps


@jh.pytree
class Fails(VelocityEffect):
    """Gravity under which strand 1 breaks, and becomes NaN, above a speed [m/s]."""

    speed: Any

    def velocity_change(self, rod: Any, state: jh.State, dt: float) -> jax.Array:
        fast = -state.velocities[:, 2:] > self.speed
        second = jnp.arange(state.velocities.shape[-1]) == 1
        fall = jnp.zeros_like(state.velocities).at[:, 2].set(-9.8 * dt)
        return jnp.where(fast & second[None, None], jnp.nan, fall)


def scene_of(*effects: tuple) -> jh.Scene:
    """Two strands of three points, and a phase of 7 steps for each tuple of effects."""
    hair = jh.Strands.straight(np.eye(3)[:2], (1.0, 0, 0), length=0.1, points=3)
    phases = tuple(jh.Phase("abc"[i], 7 * DT, e) for i, e in enumerate(effects))
    return jh.Scene(hair, phases=phases, dt=DT)


def falling(g: float = 9.8) -> jh.Scene:
    return scene_of(
        (jh.Hold(), jh.Gravity((0, 0, -g)), jh.Reform(hydrogen=1.0)),
        (jh.Hold(), jh.Gravity((0, g, 0)), jh.Reform(hydrogen=1.0)),
    )


@cache
def eager() -> jh.Recording:
    return jh.simulate(falling(), fps=FPS)


def test_frames() -> None:
    """At the start, every three steps of each phase from its start on, and at each phase's end."""
    movie, steps = eager(), np.array([0, 3, 6, 7, 10, 13, 14])
    np.testing.assert_allclose(movie.times, steps * DT, rtol=1e-14)
    assert movie.phases == ("", "a", "a", "a", "b", "b", "b")
    assert (movie.end_of("a"), movie.end_of("b"), movie.end_of("")) == (3, 6, 0)
    assert movie.positions.shape == (7, 2, 3, 3)
    assert movie.fractions.shape == (7, 2, 1, 4)
    assert movie.complete
    assert isinstance(movie.positions, np.ndarray)
    np.testing.assert_array_equal(movie.positions[0], falling().strands.positions)
    with pytest.raises(ValueError, match=r"phase is 'c'; it must be one of '', 'a', 'b'"):
        movie.end_of("c")


def test_at_most_one_frame_a_step() -> None:
    movie = jh.simulate(falling(), fps=1e9)
    np.testing.assert_allclose(movie.times, np.arange(15) * DT, rtol=1e-14)
    np.testing.assert_array_equal(movie.positions[[0, 3, 6, 7, 10, 13, 14]], eager().positions)


def test_a_scene_without_phases_has_its_first_frame() -> None:
    movie = jh.simulate(scene_of())
    assert (movie.times.tolist(), movie.phases, movie.complete) == ([0.0], ("",), True)


def test_same_as_run() -> None:
    for name, state in jh.run(falling()).items():
        frame = eager().end_of(name)
        np.testing.assert_allclose(eager().positions[frame], state.points, rtol=0, atol=SAME)
        fractions = np.moveaxis(np.asarray(state.fractions), -1, 0)
        np.testing.assert_allclose(eager().fractions[frame], fractions, rtol=0, atol=SAME)


def tip_and_speed(state: jh.State) -> tuple[jax.Array, dict[str, jax.Array]]:
    return state.points[:, -1], {"speed": jnp.abs(state.velocities).max()}


def test_custom_observation() -> None:
    """Any pytree of arrays, with a first axis of frames."""
    tip, rest = jh.simulate(falling(), fps=FPS, observe=tip_and_speed).observed
    np.testing.assert_allclose(tip, eager().positions[:, :, -1], rtol=0, atol=SAME)
    assert rest["speed"].shape == (7,)
    assert rest["speed"][0] == 0 < rest["speed"][1]


def test_under_jit() -> None:
    """One traced program gives the frames, times and phases of the loop from frame to frame."""
    movie = jax.jit(lambda scene: jh.simulate(scene, fps=FPS))(falling())
    np.testing.assert_allclose(movie.positions, eager().positions, rtol=0, atol=SAME)
    np.testing.assert_allclose(movie.fractions, eager().fractions, rtol=0, atol=SAME)
    np.testing.assert_allclose(movie.times, eager().times, rtol=1e-14)
    assert (movie.phases, movie.complete) == (eager().phases, True)


def swing(g: Any) -> Any:
    """All points of all frames of one phase under a gravity g."""
    scene = scene_of((jh.Hold(), jh.Gravity((0, 0, -9.8))))
    name = "phases.a.Gravity.acceleration"
    scene = jh.replace_leaves(scene, {name: g * jnp.asarray([0.0, 0.0, -1.0])})
    return jh.simulate(scene, fps=1 / (7 * DT)).positions


def test_under_vmap_and_grad() -> None:
    """Several gravities at once are the gravities one by one; the slope is their difference."""
    gs = jnp.asarray([9.8, 9.8 + 1e-4, 9.8 - 1e-4])
    together = jax.jit(jax.vmap(swing))(gs)
    apart = np.stack([swing(g) for g in gs])
    np.testing.assert_allclose(together, apart, rtol=0, atol=SAME)
    slope = jax.jit(jax.grad(lambda g: swing(g)[-1, 0, -1, 2]))(gs[0])
    difference = (apart[1] - apart[2])[-1, 0, -1, 2] / 2e-4
    assert float(slope) == pytest.approx(difference, rel=1e-6)
    assert difference < -1e-5


def test_ctrl_c_keeps_the_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    frame, calls = recording._frame, []

    def interrupted(*arguments: Any) -> Any:
        calls.append(arguments)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return frame(*arguments)

    monkeypatch.setattr(recording, "_frame", interrupted)
    movie = jh.simulate(falling(), fps=FPS)
    assert not movie.complete
    assert movie.phases == eager().phases[:5]
    np.testing.assert_array_equal(movie.times, eager().times[:5])
    np.testing.assert_array_equal(movie.positions, eager().positions[:5])
    assert movie.end_of("b") == 4


def test_ctrl_c_before_the_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(recording, "_frame", interrupted)
    movie = jh.simulate(falling(), fps=FPS)
    assert (movie.complete, movie.phases, len(movie.positions)) == (False, ("",), 1)


@pytest.mark.parametrize(
    ("steps", "frame", "words"),
    [
        # After n steps the speed is n g dt; NaN comes in the first step that starts above.
        (4.5, 2, "from frame 2 on (t = 0.06 s, phase 'a', strand 1, point 0): Fails"),
        (6.5, 4, "from frame 4 on (t = 0.1 s, phase 'b', strand 1, point 0): Fails"),
    ],
)
def test_values_that_are_not_finite(steps: float, frame: int, words: str) -> None:
    """The error names the first bad frame, its phase and strand, and has the frames before."""
    bad = Fails(steps * 9.8 * DT)
    with pytest.raises(jh.NotFinite) as caught:
        jh.simulate(scene_of((bad,), (bad,)), fps=FPS)
    assert words in str(caught.value)
    kept = caught.value.recording
    assert not kept.complete
    assert len(kept.times) == len(kept.phases) == len(kept.positions) == frame
    assert np.isfinite(kept.positions).all()
    assert kept.positions[-1, 0, 0, 2] < -1e-3  # strand 0 falls


def test_under_jit_nothing_is_checked() -> None:
    """All frames are there, the bad ones too."""
    bad = Fails(4.5 * 9.8 * DT)
    movie = jax.jit(lambda scene: jh.simulate(scene, fps=FPS))(scene_of((bad,)))
    np.testing.assert_array_equal(
        np.isfinite(movie.positions).all((1, 2, 3)), [True, True, False, False]
    )


def test_not_finite_without_positions() -> None:
    """What is observed may be anything."""
    bad = Fails(4.5 * 9.8 * DT)
    with pytest.raises(jh.NotFinite, match=r"frame 2 on \(t = 0.06 s, phase 'a', strand 1"):
        jh.simulate(scene_of((bad,), (bad,)), fps=FPS, observe=tip_and_speed)


def middle(state: jh.State) -> dict[str, jax.Array]:
    return {"positions": state.points.mean((0, 1))}


def test_not_finite_with_other_positions() -> None:
    """Positions of a shape of the user's own do not spoil the error."""
    bad = Fails(4.5 * 9.8 * DT)
    with pytest.raises(jh.NotFinite, match="from frame 2 on"):
        jh.simulate(scene_of((bad,), (bad,)), fps=FPS, observe=middle)


@pytest.mark.parametrize("progress", [False, True])
def test_progress(progress: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """A bar on stderr, only when asked for."""
    movie = jh.simulate(falling(), fps=FPS, progress=progress)
    printed = capsys.readouterr()
    assert printed.out == ""
    assert ("14/14" in printed.err) == progress
    assert (printed.err == "") != progress
    np.testing.assert_array_equal(movie.positions, eager().positions)


def test_float32_times_and_values() -> None:
    """A float32 scene is recorded in float32."""
    scene = falling()
    scene = jax.tree.map(lambda x: np.asarray(x, "float32"), scene)
    movie = jh.simulate(scene, fps=FPS)
    assert movie.positions.dtype == np.float32
    np.testing.assert_allclose(movie.positions, eager().positions, rtol=0, atol=1e-5)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_phases_are_compiled_before_they_are_simulated(
    dtype: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Side by side, each program once, as it is called: the calls compile nothing more."""
    compiled: list[int] = []

    def together(program: Any, calls: Any) -> None:
        calls = list(calls)
        compile_together(program, calls)
        compiled.append(len(calls))
        caplog.clear()

    monkeypatch.setattr(recording, "compile_together", together)
    with jax.enable_x64(dtype == "float64"), jax.log_compiles():
        hold, reform = jh.Hold(), jh.Reform(hydrogen=1.0)
        movie = jh.simulate(scene_of((hold, jh.Gravity()), (hold, reform), (hold, jh.Gravity())))
    assert movie.positions.dtype == dtype
    assert compiled == [3]
    assert not [m for m in caplog.messages if "_frame" in m and "compil" in m.lower()]


def test_programs_that_are_compiled_together(caplog: pytest.LogCaptureFixture) -> None:
    """One for all calls that share it, and none where there is only one."""

    @jax.jit
    def doubled(x: Any) -> Any:
        return 2 * x

    def compiling() -> int:
        return sum("Compiling jit(doubled)" in m for m in caplog.messages)

    one, two = jnp.ones(3), jnp.ones(5)
    with jax.log_compiles():
        compile_together(doubled, [(one,), (2 * one,)])
        assert compiling() == 0
        compile_together(doubled, [(one,), (two,), (2 * one,)])
        caplog.clear()
        np.testing.assert_array_equal(doubled(one), 2)
        np.testing.assert_array_equal(doubled(two), 2)
        assert compiling() == 0
        doubled(jnp.ones(7))
        assert compiling() == 1
