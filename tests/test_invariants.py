"""What must not change a simulation: place, signs, order, company, precision and transformation."""

from dataclasses import replace
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanics import stepped

from jaxhair import quaternion as quat
from jaxhair.bonds import Bonds, Cut, Reform
from jaxhair.contact import HairContact
from jaxhair.direct import Direct
from jaxhair.fibre import Fibre, PhysicalFibre
from jaxhair.forces import Drag, DryingWind, Gravity
from jaxhair.holding import Hold
from jaxhair.obstacles import Cylinder, Sphere
from jaxhair.scene import Phase, Scene, replace_leaves
from jaxhair.simulate import prepare, run, start, step
from jaxhair.solvers import Compliant, PositionBased
from jaxhair.strands import State, Strands

TOLERANCE = {"float64": 1e-11, "float32": 3e-5}  # positions [m], after 20 steps
ROUNDING = {"float64": 1e-15, "float32": 3e-7}
SLOW = pytest.mark.slow
DTYPES = pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=SLOW)])
SOLVERS: dict[str, Any] = {
    "paper": PositionBased(iterations=3),
    "sequential": PositionBased(iterations=3, sweep="sequential"),
    "compliant": Compliant(iterations=3),
    "direct": Direct(),
}
EACH = pytest.mark.parametrize("solver", SOLVERS)
TWO = pytest.mark.parametrize(  # the others in the slow run
    "solver", [s if s in ("paper", "direct") else pytest.param(s, marks=SLOW) for s in SOLVERS]
)
STEPS, DT = 20, 1 / 360


from_points = jax.jit(Strands.from_points)


def final(scene: Scene, steps: int = STEPS, velocities: object = None) -> State:
    """The state after some steps of the first phase; one compiled program for any number."""
    return _final(scene, jnp.int32(steps), velocities)


@jax.jit
def _final(scene: Scene, steps: jax.Array, velocities: object) -> State:
    scene = scene.as_arrays()
    state = start(scene)
    if velocities is not None:
        state = replace(state, velocities=velocities)
    return stepped(scene, state, steps)


def curly(strands: int, points: int, seed: int = 5) -> np.ndarray:
    """Points of curly strands close together, (strands, points, 3)."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(0, 0.003, (strands, 1, 3))
    edges = 0.012 * (rng.normal(0, 0.3, (strands, points - 1, 3)) + np.array([0.7, 0.1, -0.6]))
    return np.concatenate([roots, edges], 1).cumsum(1)


def with_everything(strands: Strands, solver: str = "paper") -> Scene:
    """A scene with every effect that has no direction of its own, and numbers of each strand."""
    rng = np.random.default_rng(1)
    count = strands.count
    effects = (
        Hold(velocity=(0.1, -0.2, 0.1), angular_velocity=(1.0, 2.0, -3.0), centre=(0.01, 0, 0.02)),
        Gravity((1.0, 2.0, -9.0)),
        Drag(0.3),
        DryingWind((0.0, -0.3, 0.1), (0.05, 0.3, -0.1), 60.0, drying=0.05),
        HairContact(radius=4e-3, strength=80.0),
        Cut(hydrogen=0.1, ionic=0.0, rate=3.0),
        Reform(disulfide=1.0, rate=2.0),
        Sphere((0.04, 0.0, -0.06), 0.02, 0.3, angular_velocity=(1.0, 4.0, 0.0)),
        Cylinder((0.05, 0.02, -0.04), (0.2, 1.0, 0.1), 0.02, 0.6, 0.1, velocity=(0.0, 0.1, 0.1)),
    )
    fibre: Any = Fibre(rng.uniform(0.2, 0.6, count), peeling_rate=rng.uniform(1, 3, count))
    if SOLVERS[solver].compliant:
        young, rate = rng.uniform(2e9, 6e9, count), rng.uniform(1, 3, count)
        fibre = PhysicalFibre(young, minor_radius=30e-6, peeling_rate=rate, damping_time=1e-3)
    return Scene(
        strands,
        fibre,
        Bonds(rng.uniform(0.1, 1, (count, 4)), rng.uniform(0.3, 0.9, (count, 4))),
        (Phase("only", 1.0, effects),),
        SOLVERS[solver],
    )


@cache
def scene_of_3(dtype: str, solver: str = "paper") -> Scene:
    strands = from_points(jnp.asarray(curly(3, 6)))
    return as_dtype(with_everything(strands, solver), dtype)


def as_dtype(scene: Scene, dtype: str) -> Scene:
    return jax.tree.map(lambda x: np.asarray(x, dtype), scene)


def changed(scene: Scene, **parts: object) -> Scene:
    """The scene with some arrays of its strands replaced."""
    return replace(scene, strands=replace(scene.strands, **parts))


def per_strand(scene: Scene, change: object) -> Scene:
    """A function applied to every array that has strands as its first axis."""

    def each(part: object, *names: str) -> object:
        return replace(part, **{name: change(getattr(part, name)) for name in names})  # type: ignore

    own = [name for name, value in vars(scene.fibre).items() if np.ndim(value) == 1]
    return replace(
        scene,
        strands=each(scene.strands, "positions", "orientations", "lengths", "natural_shape"),
        fibre=each(scene.fibre, *own),
        bonds=each(scene.bonds, "influence", "fraction"),
    )


def assert_same(one: State, other: State, tolerance: float) -> None:
    """Positions, fractions, remembered shapes and frames (up to their sign) agree."""
    for name in ("positions", "fractions", "shapes"):
        a, b = (np.asarray(getattr(state, name), float) for state in (one, other))
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance, err_msg=name)
    a, b = np.asarray(one.orientations, float), np.asarray(other.orientations, float)
    np.testing.assert_allclose(np.abs(np.sum(a * b, 1)), 1, rtol=0, atol=tolerance)


@EACH
def test_the_scene_does_something(solver: str) -> None:
    """Its strands move, meet, bend, dry and touch: an invariance of nothing would be no test."""
    scene = scene_of_3("float64", solver)
    end = final(scene)
    begin = start(scene.as_arrays())
    assert np.abs(end.positions - begin.positions).max() > 5e-3
    assert np.abs(end.fractions - begin.fractions)[:, [0, 1, 2]].min() > 1e-3
    assert np.abs(end.shapes - begin.shapes).max() > 1e-3
    for name in ("HairContact.strength", "Sphere.radius", "Cylinder.radius"):
        without = replace_leaves(scene, {f"phases.only.{name}": np.float64(1e-9)})
        assert np.abs(final(without).positions - end.positions).max() > 1e-5, name


@EACH
@DTYPES
def test_rigid_motion(dtype: str, solver: str) -> None:
    """The scene turned and shifted ends turned and shifted."""
    scene = scene_of_3("float64", solver)
    turn = np.array([0.5, -0.1, 0.7, 0.5])
    turn, shift = turn / np.linalg.norm(turn), np.array([0.2, -0.1, 0.3])
    w, x, y, z = turn
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(3) + 2 * w * skew + 2 * skew @ skew

    def placed(p: object) -> np.ndarray:
        return np.asarray(p) @ matrix.T + shift

    def moved(effect: object) -> object:
        turned = {
            name: np.asarray(getattr(effect, name)) @ matrix.T
            for name in ("acceleration", "velocity", "angular_velocity", "axis")
            if getattr(effect, name, None) is not None
        }
        points = {
            name: placed(getattr(effect, name))
            for name in ("centre", "blower", "target")
            if getattr(effect, name, None) is not None
        }
        return replace(effect, **turned, **points)  # type: ignore[type-var]

    q = np.asarray(scene.strands.orientations)
    turned_q = quat.multiply(jnp.asarray(turn)[None, :, None], jnp.moveaxis(q, 0, -1))
    phase = replace(scene.phases[0], effects=tuple(map(moved, scene.phases[0].effects)))
    other = changed(
        replace(scene, phases=(phase,)),
        positions=placed(scene.strands.positions),
        orientations=np.moveaxis(np.asarray(turned_q), -1, 0),
    )
    end, other_end = final(as_dtype(scene, dtype)), final(as_dtype(other, dtype))
    back = np.einsum("pik,ij->pjk", np.asarray(other_end.positions) - shift[:, None], matrix)
    back_q = quat.multiply(
        quat.conjugate(jnp.asarray(turn, dtype)[None, :, None]), other_end.orientations
    )
    other_end = replace(other_end, positions=back, orientations=back_q)
    assert_same(end, other_end, TOLERANCE[dtype])


@EACH
@DTYPES
def test_signs_of_frames(dtype: str, solver: str) -> None:
    """q and -q are the same frame: not one bit may differ."""
    scene = scene_of_3(dtype, solver)
    q = scene.strands.orientations
    signs = np.random.default_rng(3).choice(np.asarray([-1, 1], dtype), (*q.shape[:2], 1))
    end, other = final(scene), final(changed(scene, orientations=signs * q))
    for name in ("positions", "velocities", "fractions", "shapes"):
        np.testing.assert_array_equal(getattr(end, name), getattr(other, name))
    np.testing.assert_array_equal(np.abs(end.orientations), np.abs(other.orientations))


@EACH
@DTYPES
def test_order_of_strands(dtype: str, solver: str) -> None:
    order = [2, 0, 1]
    end = final(scene_of_3(dtype, solver))
    other = final(per_strand(scene_of_3(dtype, solver), lambda x: x[order]))
    assert_same(jax.tree.map(lambda x: x[..., order], end), other, TOLERANCE[dtype])


@EACH
@DTYPES
def test_frames_stay_unit(dtype: str, solver: str) -> None:
    norm = np.linalg.norm(np.asarray(final(scene_of_3(dtype, solver)).orientations, float), axis=1)
    np.testing.assert_allclose(norm, 1, rtol=0, atol=ROUNDING[dtype])


@TWO
def test_float32_is_close_to_float64(solver: str) -> None:
    end = final(scene_of_3("float32", solver))
    assert_same(final(scene_of_3("float64", solver)), end, TOLERANCE["float32"])
    assert end.positions.dtype == "float32"


@TWO
def test_a_strand_far_away(solver: str) -> None:
    """A fourth strand, out of reach of all others, changes nothing of theirs."""
    scene = scene_of_3("float64", solver)
    four = per_strand(scene, lambda x: np.concatenate([x, x[:1]]))
    positions = np.array(four.strands.positions)
    positions[3] += 5.0
    end = final(changed(four, positions=positions))
    assert_same(final(scene), jax.tree.map(lambda x: x[..., :3], end), TOLERANCE["float64"])


def test_scenes_at_once_and_one_by_one() -> None:
    """vmap over whole scenes."""
    scene = scene_of_3("float64")
    scenes = [scene, jax.tree.map(lambda x: x * 1.01, scene)]
    scenes[1] = changed(scenes[1], orientations=scene.strands.orientations)
    together = jax.vmap(final)(jax.tree.map(lambda *x: jnp.stack(x), *scenes))
    for i, one in enumerate(scenes):
        assert_same(final(one), jax.tree.map(lambda x, i=i: x[i], together), TOLERANCE["float64"])


AIR = (
    Hold(),
    Hold("tip", clamped=False),
    Gravity(),
    DryingWind((0.0, -0.3, 0.1), (0.05, 0.3, -0.1), 60.0, drying=0.05),
    Cut(ionic=0.3),
)
WET = Bonds(fraction=(0.5, 1.0, 1.0, 1.0))


def test_ragged_and_separate() -> None:
    """A strand of 4 points beside one of 6 moves as it does alone; both of its ends are held."""
    points, phases = curly(2, 6), (Phase("only", 1.0, AIR),)
    strands = jax.jit(partial(Strands.from_points, counts=(6, 4)))(points)
    both = final(Scene(strands, bonds=WET, phases=phases))
    alone = final(Scene(from_points(points[1:, :4]), bonds=WET, phases=phases))
    sizes = State(4, 4, 3, 2, 2)  # type: ignore[arg-type]
    assert_same(alone, jax.tree.map(lambda x, size: x[:size, ..., 1:], both, sizes), 1e-11)
    np.testing.assert_array_equal(both.positions[4:, :, 1], points[1, [3, 3]])


def test_without_jit() -> None:
    """One step operation by operation, and compiled."""
    scene = Scene(from_points(curly(2, 6)[1:, :4]), bonds=WET, phases=(Phase("only", 1.0, AIR),))
    arrays = scene.as_arrays()
    by_hand = step(prepare(arrays, arrays.phases[0].effects), start(arrays), jnp.zeros(()))
    assert_same(by_hand, final(scene, 1), 1e-13)


@pytest.mark.parametrize(("dtype", "hold"), [("float64", ()), ("float32", (Hold(),))])
def test_rest_stays_at_rest(dtype: str, hold: tuple) -> None:
    """A curly strand that no force acts on does not creep, in 100 steps not by 100 roundings."""
    strands = from_points(jnp.asarray(curly(2, 6), dtype))
    end = final(
        as_dtype(Scene(strands, Fibre(0.5), phases=(Phase("only", 1.0, hold),)), dtype), 100
    )
    moved = np.abs(np.moveaxis(np.asarray(end.positions), -1, 0) - np.asarray(strands.positions))
    assert moved.max() < 10 * 0.1 * ROUNDING[dtype]


def test_momentum_of_a_free_strand() -> None:
    """The elastic solve moves no centre of mass: all points weigh the same."""
    rng = np.random.default_rng(2)
    scene = Scene(from_points(curly(2, 6)), Fibre(0.5), phases=(Phase("only", 1.0),))
    scene = as_dtype(scene, "float64")
    velocities = rng.normal(0, 0.5, (6, 3, 2))
    end = final(scene, STEPS, velocities)
    np.testing.assert_allclose(end.velocities.mean(0), velocities.mean(0), atol=1e-12)
    assert np.abs(end.velocities - velocities).max() > 0.1


def test_run_is_the_steps() -> None:
    """`run` of two phases is one after the other, and the time of each phase starts at 0."""
    spin = Hold(velocity=(0.1, 0.0, 0.0), angular_velocity=(0.0, 5.0, 0.0))
    phases = tuple(Phase(f"g = {g}", 6 * DT, (spin, Gravity((g, 0, 0)))) for g in (3, -9))
    scene = Scene(from_points(curly(2, 6)), phases=phases).as_arrays()
    ends, state, advanced = run(scene), start(scene), jax.jit(step)
    assert list(ends) == ["g = 3", "g = -9"]
    for phase in scene.phases:
        setup = jax.jit(prepare)(scene, phase.effects)
        for i in range(6):
            state = advanced(setup, state, jnp.asarray(i * DT))
        assert_same(ends[phase.name], state, TOLERANCE["float64"])
