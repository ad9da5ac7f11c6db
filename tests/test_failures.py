"""When values become infinite or NaN: the error says where, when, by whom, and what to do."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair import diagnosis
from jaxhair.__main__ import main
from jaxhair.effects import (
    BondEffect,
    PoseEffect,
    PositionEffect,
    StiffnessEffect,
    VelocityEffect,
)

DT = 1 / 360
SOLVERS = [jh.PositionBased(), jh.Compliant(), jh.Direct()]
EACH = pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)


def scene(*effects: Any, solver: Any = SOLVERS[0], dt: float = DT) -> jh.Scene:
    """Two strands of 6 points, 10 steps in a first phase and 20 under the effects."""
    hair = jh.Strands.straight(
        [[0.0, 0, 0], [0.0, 5e-4, 0]], (1.0, 0.0, -1.0), length=0.1, points=6, dtype="float32"
    )
    air = (jh.Hold(), jh.Gravity(), jh.Drag(0.1))
    phases = (jh.Phase("calm", 10 * dt, air), jh.Phase("wild", 20 * dt, (*air, *effects)))
    return jh.Scene(hair, phases=phases, solver=solver, dt=dt)


def failure(scene: jh.Scene, **options: Any) -> tuple[str, jh.Recording]:
    with pytest.raises(jh.NotFinite) as caught:
        jh.simulate(scene, fps=72, **options)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 500
    return text, caught.value.recording


@jh.pytree
class Breaks(VelocityEffect):
    """NaN at one point of one strand."""

    strand: Any
    point: Any

    def velocity_change(self, rod: Any, state: jh.State, dt: float) -> Any:
        x = state.positions
        point, strand = (jnp.arange(n, dtype=x.dtype) for n in (x.shape[0], x.shape[2]))
        here = (point == self.point)[:, None, None] & (strand == self.strand)[None, None, :]
        return jnp.where(here, jnp.nan, jnp.zeros_like(x))


@EACH
def test_an_effect_of_the_users(solver: Any) -> None:
    """Frame, phase, strand, point and class are named; the frames before are those of a run in
    which nothing breaks."""
    text, kept = failure(scene(Breaks(1, 4), solver=solver))
    assert "from frame 3 on" in text
    assert "phase 'wild', strand 1, point 4" in text
    assert "Breaks gives values that are not finite there; look at what it returns" in text
    assert not kept.complete
    whole = jh.simulate(scene(Breaks(7, 4), solver=solver), fps=72)
    assert len(kept.times) == 3 < len(whole.times)
    np.testing.assert_array_equal(kept.positions, whole.positions[:3])


@jh.pytree
class BreaksLater(PositionEffect):
    """NaN at point 2 of strand 1 from a time within the phase on."""

    since: Any

    def projected(self, rod: Any, positions: Any, previous: Any, time: Any, dt: float) -> Any:
        point, strand = (jnp.arange(positions.shape[axis]) for axis in (0, 2))
        here = (point == 2)[:, None, None] & (strand == 1)[None, None, :]
        return jnp.where(here & (time >= self.since), jnp.nan, positions)


@EACH
def test_an_effect_that_breaks_after_a_while(solver: Any) -> None:
    """In the tenth step, in the second frame of its phase: among five that are repeated."""
    text, kept = failure(scene(BreaksLater(8.5 * DT), solver=solver))
    assert "from frame 4 on" in text
    assert "phase 'wild', strand 1, point 2): BreaksLater gives" in text
    assert len(kept.times) == 4
    assert np.isfinite(kept.positions).all()


def test_an_effect_that_breaks_in_a_later_substep() -> None:
    """In the second of four substeps: it is blamed and not the solver, and at its own point."""
    solver = jh.PositionBased(substeps=4)
    text, kept = failure(scene(BreaksLater(8.2 * DT), solver=solver))
    assert "from frame 4 on" in text
    assert "phase 'wild', strand 1, point 2): BreaksLater gives" in text
    assert len(kept.times) == 4


@jh.pytree
class BadPose(PoseEffect):
    """NaN at point 3. It moves all points far, which is no fault of a pose."""

    def pose(self, rod: Any, state: jh.State) -> Any:
        p = state.positions.at[3].set(jnp.nan) + jnp.asarray(9.0, state.positions.dtype)
        return p, state.orientations


@jh.pytree
class PoseOfBonds(PoseEffect):
    """NaN once no bond of the first inner point is left."""

    def pose(self, rod: Any, state: jh.State) -> Any:
        cut = state.fractions[0].sum() == 0
        return state.positions.at[1].multiply(jnp.where(cut, jnp.nan, 1)), state.orientations


CUT = jh.Cut(hydrogen=0.0, ionic=0.0, disulfide=0.0, peptide=0.0)


def test_a_pose_under_bonds_that_break_in_the_same_step() -> None:
    """It is judged by what it was given: the state after the cut. It knows no substeps."""
    text, _ = failure(scene(PoseOfBonds(), CUT, solver=jh.PositionBased(substeps=4)))
    assert "strand 0, point 1): PoseOfBonds gives values" in text


@jh.pytree
class BadBond(BondEffect):
    """NaN at the second inner point."""

    kinds_cut = ("hydrogen",)
    kinds_formed = ()

    def fraction_change(self, kind: str, fraction: Any, rod: Any, state: Any, dt: float) -> Any:
        return jnp.zeros_like(fraction).at[1].set(jnp.nan)


@jh.pytree
class BadStiffness(StiffnessEffect):
    """NaN at the last inner point."""

    def scaled(self, stiffness: Any) -> Any:
        return stiffness.at[-1].set(jnp.nan)


@pytest.mark.parametrize(
    ("effect", "point"), [(BadPose(), 3), (BadBond(), 2), (BadStiffness(), 4)], ids=str
)
def test_effects_of_other_kinds(effect: Any, point: int) -> None:
    text, _ = failure(scene(effect, solver=jh.Direct()))
    name = type(effect).__name__
    assert f"strand 0, point {point}): {name} gives values that are not finite there" in text


@jh.pytree
class Snaps(jh.PositionBased):
    """A solver that turns the third edge of strand 1 into NaN."""

    def solve(self, *arguments: Any) -> Any:
        p, q, none = super().solve(*arguments)
        return p, q.at[2, :, 1].set(jnp.nan), none


def test_a_solver() -> None:
    """It has the advice of the solver that it derives from; an edge is named by its far point."""
    text, _ = failure(scene(solver=Snaps()))
    assert "strand 1, point 3): the solver, Snaps, gives values that are not finite" in text
    assert "take more iterations" in text


@jh.pytree
class Kicks(VelocityEffect):
    """A speed [m/s] along z."""

    speed: Any

    def velocity_change(self, rod: Any, state: jh.State, dt: float) -> Any:
        return jnp.zeros_like(state.velocities).at[:, 2].set(self.speed)


@jh.pytree
class KicksMore(Kicks):
    """Another one."""


def test_effects_that_are_finite_each_but_not_together() -> None:
    """The sum overflows: the strongest is named, also where lengths are too short for the number
    of them to fit into float32."""
    both = scene(Kicks(2e38), KicksMore(3e38))
    for size, times in ((1.0, "8.3e+36"), (5e-3, "1.7e+39")):
        hair = both.strands
        short = replace(hair, positions=size * hair.positions, lengths=size * hair.lengths)
        text, kept = failure(replace(both, strands=short))
        assert f"KicksMore moves a point by {times} times its strand's length in one step" in text
        assert len(kept.times) == 3


@pytest.mark.parametrize(
    ("effect", "leaf", "solver"),
    [
        (None, "Gravity.acceleration", SOLVERS[2]),
        (jh.HairContact(1e-3, 1.0), "HairContact.strength", SOLVERS[0]),
        (jh.HairContact(1e-3, 1.0), "HairContact.strength", SOLVERS[1]),
        (jh.Wind((0.0, 1.0, 0.0), (0.0, -1.0, 0.0), 1.0), "Wind.strength", SOLVERS[2]),
    ],
)
def test_effects_of_absurd_strength(effect: Any, leaf: str, solver: Any) -> None:
    """Stronger than constructors let pass, and near what float32 holds."""
    absurd = scene(*([effect] if effect else []), solver=solver)
    strength = np.array(3e38) if effect else np.array([0, 0, -3e38])
    text, _ = failure(jh.replace_leaves(absurd, {f"phases.wild.{leaf}": strength}))
    assert f"{leaf.partition('.')[0]} moves a point by" in text
    assert f"{leaf} has the value {'' if effect else '-'}3e+38" in text
    assert "it must be finite, and at most 1e+18" in text


def test_a_number_that_is_not_finite() -> None:
    for name in ("fibre.stiffness", "phases.wild.Drag.time"):
        text, kept = failure(jh.replace_leaves(scene(), {name: float("nan")}))
        assert f"strand 0, point 0): {name} has the value nan; it must be finite" in text
        assert ("phase 'wild'" in text) == name.startswith("phases")
        assert len(kept.times) >= 1


def test_a_number_that_a_constructor_would_refuse() -> None:
    """It is finite, and what comes of it is not."""
    text, _ = failure(jh.replace_leaves(scene(), {"bonds.influence": np.zeros(4)}))
    assert "bonds.influence is [0.0, 0.0, 0.0, 0.0]; one must be at least 9e-19" in text


def test_a_start_that_is_not_finite() -> None:
    """No frame is good; with or without phases."""
    positions = np.array(scene().strands.positions)
    positions[1, 3, 0] = np.nan
    bad = jh.replace_leaves(scene(), {"strands.positions": positions})
    for each in (bad, jh.Scene(bad.strands)):
        text, kept = failure(each)
        assert "from frame 0 on (t = 0 s, phase '', strand 1, point 3)" in text
        assert "strands.positions has the value nan at (1, 3, 0)" in text
        assert kept.positions.shape == (0, 2, 6, 3)


def test_a_state_that_is_not_finite_though_what_is_observed_is() -> None:
    text, kept = failure(scene(Breaks(1, 4)), observe=lambda state: state.positions[0, :, 0])
    assert "from frame 3 on" in text
    assert "strand 1, point 4): Breaks" in text
    assert len(kept.observed) == 3


def test_an_observation_that_is_not_finite_though_the_state_is() -> None:
    def mean_height(state: jh.State) -> Any:
        return jnp.log(state.positions[-1, 2, 0] + 0.08)

    text, _ = failure(scene(jh.Gravity((0.0, 0.0, -1e4))), observe=mean_height)
    assert "what `observe` returns is not finite, though all of the state is" in text


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_a_diagnosis_that_fails_hides_nothing(
    monkeypatch: pytest.MonkeyPatch, error: type[BaseException]
) -> None:
    """Neither does one that Ctrl-C ends."""

    def broken(*_: Any) -> Any:
        raise error

    monkeypatch.setattr(diagnosis, "cause", broken)
    text, kept = failure(scene(Breaks(1, 4)))
    assert f"its cause was not found ({error.__name__})" in text
    assert len(kept.times) == 3


def test_the_command_keeps_the_frames_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("jaxhair.simulate_command.scene_of", lambda options: scene(Breaks(1, 4)))
    path = tmp_path / "broken.npz"
    assert main(["simulate", "perm", "--fps", "72", "--quiet", "--output", str(path)]) == 1
    printed = capsys.readouterr()
    assert printed.err.startswith("error: values are not finite from frame 3")
    assert printed.err.count("\n") == 2
    assert "broken.npz: 3 frames before the failure" in printed.err
    assert printed.out == ""
    with np.load(path) as arrays:
        assert np.isfinite(arrays["positions"]).all()
        assert len(arrays["positions"]) >= 3


def test_the_command_cannot_keep_the_frames_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both errors are told, and the code is that of the first."""

    def full(*_: Any, **__: Any) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("jaxhair.simulate_command.scene_of", lambda options: scene(Breaks(1, 4)))
    monkeypatch.setattr("jaxhair.simulate_command.save", full)
    path = tmp_path / "broken.npz"
    assert main(["simulate", "perm", "--fps", "72", "--quiet", "--output", str(path)]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("error: values are not finite from frame 3")
    assert second == "error: no space left"
