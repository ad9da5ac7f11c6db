"""When values become infinite or NaN: the error says where, when, by whom, and what to do."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair import diagnosis
from jaxhair.__main__ import main
from jaxhair.effects import VelocityEffect

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


@EACH
@pytest.mark.parametrize(
    ("effect", "words"),
    [
        (jh.Gravity((0.0, 0.0, -1e18)), "Gravity|smaller acceleration"),
        (jh.HairContact(1e-3, 1e18), "HairContact|smaller strength"),
        (jh.Wind((0.0, 1.0, 0.0), (0.0, -1.0, 0.0), 1e18), "Wind|smaller strength"),
    ],
    ids=["gravity", "contact", "wind"],
)
def test_effects_of_absurd_strength(effect: Any, words: str, solver: Any) -> None:
    """Named where they break the values; or the run stays finite, as some solvers make it."""
    text = ""
    try:
        movie = jh.simulate(scene(effect, solver=solver), fps=72)
    except jh.NotFinite as error:
        text = str(error)
    if not text:
        assert np.isfinite(movie.positions).all()
        return
    for word in words.split("|"):
        assert word in text


def test_a_number_that_is_not_finite() -> None:
    for name in ("fibre.stiffness", "phases.wild.Drag.time"):
        text, kept = failure(jh.replace_leaves(scene(), {name: float("nan")}))
        assert f"{name} has the value nan" in text
        assert ("phase 'wild'" in text) == name.startswith("phases")
        assert len(kept.times) >= 1


def test_a_diagnosis_that_fails_hides_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: Any) -> Any:
        raise RuntimeError

    monkeypatch.setattr(diagnosis, "cause", broken)
    text, _ = failure(scene(Breaks(1, 4)))
    assert "its cause was not found (RuntimeError)" in text


def test_the_command_keeps_the_frames_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("jaxhair.__main__._scene", lambda options: scene(Breaks(1, 4)))
    path = tmp_path / "broken.npz"
    assert main(["simulate", "perm", "--fps", "72", "--quiet", "--output", str(path)]) == 1
    printed = capsys.readouterr()
    assert printed.err.startswith("error: values are not finite from frame")
    with np.load(path) as arrays:
        assert np.isfinite(arrays["positions"]).all()
        assert len(arrays["positions"]) >= 3
