"""Strands in tiles and on several devices move as they do all together."""

import os
import subprocess
import sys
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair import tiles
from jaxhair.effects import VelocityEffect
from jaxhair.simulate import advance, prepare, start

TOLERANCE = {"float32": 1e-6, "float64": 1e-12}  # of positions, of a length near 0.1 m
OF_GRADIENTS = {"float32": 1e-3, "float64": 1e-9}  # relative to the largest
STRANDS, POINTS, STEPS = 21, 5, 6
FAST = jh.PositionBased(sweep="sequential", iterations=1)  # compiles fastest
DTYPES = ("float32", "float64")


@jh.pytree
class Pull(VelocityEffect):
    """An effect of a user, with an acceleration for each strand."""

    each_strand_alone = True
    each: Any

    def velocity_change(self, rod: Any, state: Any, dt: float) -> Any:
        return jnp.broadcast_to(self.each * dt, state.positions.shape)


@jh.pytree
class PullOfAll(Pull):
    """It may couple strands, for it does not say that it does not."""


FREE = (
    jh.Hold(),
    jh.Gravity(),
    jh.Drag(0.5),
    jh.DryingWind((0.0, -0.3, 0.0), (0.0, 0.3, -0.05), 9.0),
    jh.Sphere((0.05, 0.0, -0.06), 0.03, 0.2),
    jh.Cut(hydrogen=0.3, rate=20.0),
)


def scene(dtype: str = "float64", solver: Any = None, ragged: bool = False, *more: Any) -> jh.Scene:
    """Curved strands, none like another, with values of their own wherever there may be some."""
    rng = np.random.default_rng(1)
    roots = 0.05 * rng.normal(size=(STRANDS, 1, 3))
    steps = np.array([0.01, 0.0, -0.02]) + 0.008 * rng.normal(size=(STRANDS, POINTS, 3))
    points = jnp.asarray(roots + np.cumsum(steps, axis=1), dtype)
    counts = rng.integers(2, POINTS + 1, size=STRANDS) if ragged else None
    solver = solver or FAST
    own = rng.uniform(0.5, 1.0, size=STRANDS)
    fibre = jh.PhysicalFibre(3e9 * own) if solver.compliant else jh.Fibre(0.5 * own)
    bonds = jh.Bonds(rng.uniform(0.1, 0.4, size=(STRANDS, 4)), (0.5, 1.0, 0.8, 1.0))
    phases = (jh.Phase("free", STEPS / 360, (*FREE, *more)),)
    hair = jh.Strands.from_points(points, counts=counts)
    return jh.Scene(hair, fibre, bonds, phases, solver).as_arrays()


def pull(dtype: str = "float64") -> Any:
    return Pull(jnp.linspace(0, 20, STRANDS, dtype=dtype).reshape(1, 1, -1))


def make_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tiles of 16 strands, of which two hold the scene's 21."""
    for name, value in {"LARGEST": 0, "FEWEST": 1, "MOST": 16}.items():
        monkeypatch.setattr(tiles, name, value)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    make_small(monkeypatch)


def end(scene: jh.Scene) -> jh.State:
    phase = scene.phases[0]
    setup = prepare(replace(scene, phases=()), phase.effects)
    return advance(setup, start(scene), 0, steps=phase.steps(scene.dt))


def loops(scene: jh.Scene) -> str:
    return str(jax.make_jaxpr(end)(scene))


CASES = {
    "paper's": (jh.PositionBased(), False),
    "ragged": (jh.PositionBased(), True),
    "compliant": (jh.Compliant(), False),
    "direct": (jh.Direct(), True),
}


@pytest.mark.parametrize(
    ("case", "dtype"), [*((case, "float64") for case in CASES), ("paper's", "float32")]
)
def test_tiles_change_nothing(case: str, dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = scene(dtype, *CASES[case], pull(dtype))
    whole = jax.jit(lambda s: end(s))(made)
    make_small(monkeypatch)
    assert tiles.tiling(STRANDS, POINTS) == (2, 16)
    cut = jax.jit(lambda s: end(s))(made)
    assert f"{POINTS},3,16]" in loops(made)
    whole, cut = (replace(x, velocities=made.dt * x.velocities) for x in (whole, cut))
    for a, b in zip(jax.tree.leaves(whole), jax.tree.leaves(cut), strict=True):
        assert b.shape == a.shape
        assert np.abs(a - b).max() <= TOLERANCE[dtype]


def height(scene: jh.Scene) -> jax.Array:
    last = end(scene)
    return jnp.sum(last.positions[:, 2] ** 2) + jnp.sum(last.fractions**2)


def derivatives(dtype: str) -> tuple[list[Any], Any]:
    """Of `height`: in reverse mode by all numbers, and forward along one direction."""
    made = scene(dtype, None, False, pull(dtype))
    along = jax.tree.map(
        lambda x: jnp.cos(jnp.arange(x.size, dtype=x.dtype)).reshape(x.shape), made
    )
    gradient = jax.jit(jax.grad(lambda s: height(s)))(made)
    tangent = jax.jit(lambda s, t: jax.jvp(height, (s,), (t,))[1])(made, along)
    return jax.tree.leaves(gradient), tangent


@pytest.mark.parametrize("dtype", DTYPES)
def test_derivatives_are_the_same(dtype: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what each strand has of its own and of what all share, in both modes."""
    whole, along = derivatives(dtype)
    make_small(monkeypatch)
    cut, along_cut = derivatives(dtype)
    for a, b in zip(whole, cut, strict=True):
        assert np.abs(a - b).max() <= OF_GRADIENTS[dtype] * max(np.abs(a).max(), 1e-6)
    assert np.allclose(along_cut, along, rtol=OF_GRADIENTS[dtype])


@pytest.mark.usefixtures("small")
def test_scenes_side_by_side() -> None:
    made = scene()

    def lowest(rate: Any) -> Any:
        return jnp.min(end(replace(made, bonds=jh.Bonds((1.0, rate, 1.0, 1.0)))).positions[:, 2])

    rates = jnp.array([0.2, 0.5])
    along = jax.jit(lambda x: jax.jvp(jax.vmap(lowest), (x,), (jnp.ones(2),)))(rates)
    one = jax.jit(lambda x: jax.jvp(lowest, (x,), (jnp.ones(()),)))
    each = [one(rate) for rate in rates]
    assert np.allclose(along, np.array(each).T, rtol=1e-9, atol=1e-15)


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("effect", [jh.HairContact(1e-2), PullOfAll(pull().each)])
def test_what_may_couple_strands_is_simulated_whole(effect: Any) -> None:
    made = scene("float64", None, False, effect)
    assert f"{POINTS},3,16]" not in loops(made)
    assert tiles.couples(made.phases[0].effects) is not None
    assert tiles.couples(scene("float64", None, False, pull()).phases[0].effects) is None


@pytest.mark.parametrize("points", [2, 9, 33, 100, 150, 500])
@pytest.mark.parametrize("numbers", [0, 2, 4, 9])
def test_tiles_hold_all_strands_and_no_more_than_one_is_filled_up(
    points: int, numbers: int
) -> None:
    for strands in (1, 16, 200, 257, 1000, 10_000):
        number, lanes = tiles.tiling(strands, points, numbers)
        if numbers * points * tiles.LANES <= tiles.LARGEST:
            assert numbers * points * lanes <= tiles.LARGEST
        if number == 1:
            assert lanes == strands
        else:
            assert lanes % tiles.LANES == 0
            assert number * lanes >= strands > (number - 2) * lanes
    assert tiles.tiling(200, 9) == (1, 200)


@pytest.mark.parametrize(
    ("devices", "words"),
    [
        (0, ["devices", "0", "at least 1"]),
        (2.0, ["devices", "2.0"]),
        (99, ["99", "at most", "jax"]),
    ],
)
def test_bad_numbers_of_devices(devices: Any, words: list[str]) -> None:
    for function in (jh.run, jh.simulate):
        with pytest.raises(ValueError) as error:
            function(scene(), devices=devices)
        assert all(word in str(error.value) for word in words)


DEVICES = """
import dataclasses, jax, numpy as np, pytest
import conftest, test_tiles
import jaxhair as jh
assert len(jax.devices()) == 4
made = test_tiles.scene("float64", None, True, test_tiles.pull())
made = made.then(dataclasses.replace(made.phases[0], name="next"))
one = jh.run(made)
for devices in (2, 4):  # at least 16 strands on each, so that 2 are used, one filled up
    for name, several in jh.run(made, devices=devices).items():
        for a, b in zip(jax.tree.leaves(one[name]), jax.tree.leaves(several), strict=True):
            assert a.shape == b.shape and np.abs(a - b).max() <= 1e-12 * max(1, np.abs(a).max())
several = jh.run(made, devices=2)["next"].positions
assert len(several.sharding.device_set) > 1
film, film_of_two = (jh.simulate(made, fps=180, devices=n) for n in (1, 2))
assert np.abs(film.positions - film_of_two.positions).max() <= 1e-12

def mean(scene, devices, frames):
    if frames:
        return jh.simulate(scene, fps=180, devices=devices).positions.mean()
    return jh.run(scene, devices=devices)["next"].positions.mean()

for frames in (False, True):
    a, b = (jax.jit(jax.grad(mean), static_argnums=(1, 2))(made, n, frames) for n in (1, 2))
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.abs(x - y).max() <= 1e-9 * max(np.abs(x).max(), 1e-6), (x, y)
contact = dataclasses.replace(made.phases[0], effects=(*test_tiles.FREE, jh.HairContact()))
for function in (jh.run, jh.simulate):
    with pytest.raises(ValueError, match="devices is 2.*HairContact.*couple"):
        function(dataclasses.replace(made, phases=(contact,)), devices=2)
"""


def with_devices(number: int, command: list[str]) -> subprocess.CompletedProcess[str]:
    flags = f"--xla_force_host_platform_device_count={number}" if number else ""
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    folder = os.path.dirname(__file__)
    return subprocess.run(
        [sys.executable, *command], env=environment, cwd=folder, capture_output=True, text=True
    )


def test_several_devices_change_nothing() -> None:
    done = with_devices(4, ["-c", DEVICES])
    assert done.returncode == 0, done.stderr


def test_the_command_makes_its_devices(tmp_path: Any) -> None:
    """Without being told by the environment, it finds two devices on a CPU."""
    command = ["-m", "jaxhair", "simulate", "perm", "--prepared", "--strands", "40", "--quiet"]
    command += ["--seconds", "0.02"]
    files = [tmp_path / f"{n}.npz" for n in (1, 2)]
    for n, file in enumerate(files, start=1):
        more = ["--no-contact", "--devices", str(n), "--output", str(file)]
        done = with_devices(0, [*command, *more])
        assert done.returncode == 0, done.stderr
    one, two = (np.load(file)["positions"] for file in files)
    assert np.abs(one - two).max() <= TOLERANCE["float32"]
    done = with_devices(0, [*command, "--devices", "2", "--output", str(tmp_path / "3.npz")])
    assert done.returncode == 2
    assert "HairContact" in done.stderr
