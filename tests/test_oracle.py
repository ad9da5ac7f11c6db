"""The JAX step against a slow oracle in plain NumPy, and against the peer programs' reference."""

from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import peer_scene
import pytest

from jaxhair import strands as st
from jaxhair.bonds import Bonds, Cut, Reform
from jaxhair.contact import HairContact
from jaxhair.fibre import Fibre, Soften
from jaxhair.forces import Drag, DryingWind, Gravity, Wind
from jaxhair.holding import Hold, Wound
from jaxhair.obstacles import Cylinder, Floor, Sphere
from jaxhair.scene import Phase, Scene
from jaxhair.simulate import advance, prepare, step
from jaxhair.solvers import PositionBased
from jaxhair.strands import State, Strands

DATA = Path(__file__).parent / "data"
RELATIVE = {"one step": 1e-10, "fifty steps": 1e-10}
PEERS = 1e-5  # m


def random_hair(strands: int, points: int, ragged: bool, seed: int = 1) -> tuple[Strands, State]:
    """Curly strands close together, moving; each kind of bond has its own shape and fraction."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, 0.4, (strands, points - 1, 3)) + np.array([0.6, 0.0, -0.5])
    steps *= 0.02 * rng.uniform(0.7, 1.3, (strands, points - 1, 1))
    x = np.concatenate([rng.normal(0, 0.004, (strands, 1, 3)), steps], 1).cumsum(1)
    counts = rng.integers(3, points + 1, strands) if ragged else None
    hair = Strands.from_points(x, counts=counts)
    inner = (points - 2, 4)
    natural = np.moveaxis(np.asarray(hair.natural_shape), 0, -1)[:, None]
    shapes = natural + rng.normal(0, 0.15, (*inner, 3, strands))
    q = st.strands_last(hair.orientations)
    q = q * jnp.asarray(rng.choice([-1.0, 1.0], (points - 1, 1, strands)))
    velocities = rng.normal(0, 0.3, (points, 3, strands))
    if ragged:
        there = np.arange(points)[:, None] < counts
        velocities = velocities * there[:, None]
    return hair, State(
        st.strands_last(hair.positions),
        jnp.asarray(velocities),
        q,
        jnp.asarray(shapes),
        jnp.asarray(rng.uniform(0.1, 0.9, (*inner, strands))),
    )


def as_oracle(effect: object) -> dict:
    """An effect as the oracle's dict."""
    values = {f.name: getattr(effect, f.name) for f in fields(effect)}  # type: ignore[arg-type]
    for name in ("in_gradients", "capacity"):  # the oracle has values only, and looks at all pairs
        values.pop(name, None)
    if isinstance(effect, DryingWind):
        values["rate"] = values.pop("drying")
    if "amount" in values:
        values["amount"] = np.moveaxis(np.asarray(values["amount"]), -1, 0)
        return {"kind": "Exchange", **values}
    return {"kind": type(effect).__name__, **{k: v for k, v in values.items() if v is not None}}


def outer(state: State) -> oracle.Hair:
    kept = [np.moveaxis(np.asarray(x), -1, 0) for x in vars(state).values() if x is not None]
    return oracle.Hair(*kept)


def oracle_settings(scene: Scene) -> oracle.Settings:
    strands, points = scene.strands.count, scene.strands.points
    return oracle.Settings(
        lengths=np.broadcast_to(np.asarray(scene.strands.lengths), (strands, points - 1)),
        influence=np.asarray(scene.bonds.influence),
        stiffness=float(scene.fibre.stiffness),
        cuticle_share=float(scene.fibre.cuticle_share),
        peeling_rate=float(scene.fibre.peeling_rate),
        dt=scene.dt,
        iterations=scene.solver.iterations,
        sweep=scene.solver.sweep,
        orientation_weight=float(scene.solver.orientation_weight),
    )


@partial(jax.jit, static_argnums=2)
def simulated(scene: Scene, state: State, steps: int) -> State:
    scene = scene.as_arrays()
    setup = prepare(scene, scene.phases[0].effects)
    if steps == 1:
        return step(setup, state, jnp.zeros((), scene.dtype))
    return advance(setup, state, 0, steps=steps)


def assert_agrees(scene: Scene, state: State, steps: int, relative: float) -> None:
    """Every part of the state agrees with the oracle's, relative to its largest entry."""
    ours = outer(simulated(scene, state, steps))
    oracle_effects = [as_oracle(effect) for effect in scene.phases[0].effects]
    theirs = oracle.run(outer(state), oracle_settings(scene), oracle_effects, steps)
    exists = np.asarray(oracle_settings(scene).lengths) > 0
    there = {
        "positions": np.concatenate([exists[:, :1], exists], 1),
        "velocities": np.concatenate([exists[:, :1], exists], 1),
        "orientations": exists,
        "shapes": exists[:, 1:],
        "fractions": exists[:, 1:],
    }
    for name, mask in there.items():
        a, b = getattr(ours, name)[mask], getattr(theirs, name)[mask]
        assert a.shape == b.shape
        if a.size:
            assert np.abs(a - b).max() <= relative * max(np.abs(b).max(), 1e-3), name


ROOT = Hold()
EFFECTS = {
    "nothing": (),
    "gravity": (ROOT, Gravity()),
    "drag": (ROOT, Drag(0.05)),
    "wind": (ROOT, Wind((0.0, -0.3, 0.1), (0.05, 0.3, -0.1), 60.0)),
    "drying wind": (ROOT, DryingWind((0.0, -0.3, 0.1), (0.05, 0.3, -0.1), 60.0, drying=0.05)),
    "contact": (ROOT, HairContact(radius=4e-3, strength=80.0)),
    "cut": (ROOT, Cut(hydrogen=0.0, disulfide=0.4)),
    "cut slowly": (ROOT, Cut(hydrogen=0.2, ionic=0.0, rate=3.0)),
    "reform": (ROOT, Reform(hydrogen=1.0, peptide=0.5)),
    "reform slowly": (ROOT, Reform(hydrogen=1.0, ionic=0.9, rate=2.0)),
    "cut and reform": (ROOT, Cut(ionic=0.1), Reform(ionic=1.0, hydrogen=0.95)),
    "soften": (ROOT, Soften(0.4), Gravity()),
    "tip held": (ROOT, Hold("tip", clamped=False), Gravity()),
    "root moved": (Hold(velocity=(0.2, -0.1, 0.3)), Gravity()),
    "root turned": (
        Hold(velocity=(0.0, 0.1, 0.0), angular_velocity=(0.3, 2.0, -1.0), centre=(0.1, 0.0, 0.05)),
    ),
    "tip turned": (
        ROOT,
        Hold("tip", angular_velocity=(0.0, 3.0, 0.0), centre=(0.05, 0.0, -0.1)),
    ),
    "floor": (ROOT, Gravity(), Floor(-0.03, friction=0.4)),
    "rising floor": (ROOT, Floor(-0.05, friction=0.2, velocity=(0.1, 0.0, 0.8))),
    "sphere": (ROOT, Gravity(), Sphere((0.04, 0.0, -0.06), 0.03, friction=0.3)),
    "spinning sphere": (
        ROOT,
        Sphere(
            (0.04, 0.0, -0.06),
            0.03,
            0.5,
            velocity=(0.1, 0.0, 0.1),
            angular_velocity=(1.0, 4.0, 0.0),
        ),
    ),
    "cylinder": (
        ROOT,
        Cylinder((0.05, 0.0, -0.05), (0.2, 1.0, 0.1), 0.02, friction=0.6, length=0.05),
    ),
    "rolling cylinder": (
        ROOT,
        Cylinder(
            (0.05, 0.0, -0.05),
            (0.0, 1.0, 0.0),
            0.02,
            0.6,
            velocity=(-0.1, 0.0, 0.1),
            angular_velocity=(0.0, 9.0, 0.0),
        ),
    ),
    "wound": (Wound(0.06, climb=0.2), Cut(hydrogen=0.0), Reform(ionic=1.0)),
    "everything": (
        ROOT,
        Gravity(),
        Drag(0.2),
        DryingWind((0.0, -0.3, 0.1), (0.05, 0.3, -0.1), 40.0),
        HairContact(radius=3e-3, strength=20.0),
        Soften(0.7),
        Cut(ionic=0.2, rate=2.0),
        Reform(disulfide=1.0, rate=1.0),
        Floor(-0.06, friction=0.3),
        Sphere((0.04, 0.0, -0.06), 0.025, friction=0.3),
        Cylinder((0.0, 0.02, -0.02), (0.0, 1.0, 0.0), 0.01, friction=0.2),
    ),
}


@pytest.mark.parametrize(
    ("sweep", "ragged"), [("sequential", False), ("red-black", True)], ids=["equal", "ragged"]
)
@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS)
def test_one_step_of_every_effect(effects: tuple, sweep: str, ragged: bool) -> None:
    strands, state = random_hair(4, 7, ragged)
    scene = Scene(
        strands,
        Fibre(0.4, peeling_rate=3.0),
        phases=(Phase("only", 1 / 360, effects),),
        solver=PositionBased(iterations=3, sweep=sweep, orientation_weight=0.7),
    )
    assert_agrees(scene, state, 1, RELATIVE["one step"])


@pytest.mark.parametrize("points", [2, 3, 4, 5])
@pytest.mark.parametrize("sweep", ["red-black", "sequential"])
def test_short_strands(points: int, sweep: str) -> None:
    strands, state = random_hair(3, points, ragged=False)
    scene = Scene(
        strands,
        phases=(Phase("only", 1 / 360, (ROOT, Gravity(), Floor(-0.01))),),
        solver=PositionBased(sweep=sweep),
    )
    assert_agrees(scene, state, 3, RELATIVE["one step"])


@pytest.mark.parametrize("sweep", ["red-black", "sequential"])
@pytest.mark.parametrize("name", ["drying wind", "everything", "root turned", "rolling cylinder"])
def test_fifty_steps(name: str, sweep: str) -> None:
    strands, state = random_hair(3, 6, ragged=True, seed=3)
    state = replace(state, velocities=0.1 * state.velocities)
    scene = Scene(
        strands,
        Fibre(0.4),
        phases=(Phase("only", 50 / 360, EFFECTS[name]),),
        solver=PositionBased(sweep=sweep),
    )
    assert_agrees(scene, state, 50, RELATIVE["fifty steps"])


@pytest.mark.parametrize(
    ("strands", "points", "steps", "contact", "file"),
    [
        (200, 9, 60, False, "ref_200_9_60.npy"),
        (100, 17, 60, False, "ref_100_17_60.npy"),
        (200, 9, 20, True, "refpen_200_9_20.npy"),
    ],
)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_peers_reference(
    strands: int, points: int, steps: int, contact: bool, file: str, dtype: str
) -> None:
    """Sequential order and unit weights: w_q = 1 / m^2 is an orientation weight of l^2."""
    numbers = peer_scene.numbers(strands, points)
    amount = jnp.moveaxis(jnp.asarray(numbers["exchange"], dtype), 0, -1)
    effects = [
        Hold(),
        Gravity((0.0, 0.0, -9.8)),
        Drag(-1 / 360 / np.log(0.999)),
        peer_scene.ExchangeOut(amount),
        peer_scene.ExchangeIn(amount),
    ]
    if contact:  # the references's 2000 (2 r - D) is alpha (2 r - D) / (2 r) with r = 5 mm
        effects.append(HairContact(radius=5e-3, strength=20.0))
    hair = Strands(
        jnp.asarray(numbers["positions"], dtype),
        jnp.asarray(numbers["orientations"], dtype),
        jnp.full((1, points - 1), peer_scene.EDGE, dtype),
        jnp.zeros((strands, points - 2, 3), dtype),
    )
    scene = Scene(
        hair,
        Fibre(0.05, peeling_rate=0.0),
        Bonds(numbers["influence"]),
        (Phase("only", steps / 360, effects),),
        PositionBased(sweep="sequential", orientation_weight=peer_scene.EDGE**2),
    )
    final = simulated(scene, peer_scene.as_state(numbers, dtype), steps)
    assert np.abs(np.asarray(final.points) - np.load(DATA / file)).max() < PEERS
