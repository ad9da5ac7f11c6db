"""Two runs that must be related: mirrored, in other units, in pieces, with smaller steps; and what
a run must keep or lose: momentum, energy."""

import itertools
from dataclasses import replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from mechanics import order, stepped
from test_invariants import (
    DT,
    EACH,
    SOLVERS,
    TWO,
    as_dtype,
    assert_same,
    curly,
    final,
    from_points,
    scene_of_3,
)

from jaxhair import quaternion as quat
from jaxhair.bonds import Bonds, springs
from jaxhair.fibre import PhysicalFibre
from jaxhair.forces import Gravity
from jaxhair.holding import Hold
from jaxhair.scene import Phase, Scene
from jaxhair.simulate import prepare, run, start, step
from jaxhair.strands import State

TOLERANCE = 1e-11  # positions [m], after 20 steps in float64
PSEUDO = np.array([-1.0, 1.0, 1.0])  # of a rotation's vector in the frame, under a mirror's x -> -x


def mirrored(scene: Scene) -> Scene:
    """The scene in a mirror at x = 0. Frames stay right-handed by turning d1 around too."""
    flip = np.array([-1.0, 1.0, 1.0])

    def effect(e: Any) -> Any:
        parts = {}
        for name in ("acceleration", "velocity", "centre", "blower", "target"):
            if getattr(e, name, None) is not None:
                parts[name] = np.asarray(getattr(e, name)) * flip
        for name in ("angular_velocity", "axis"):  # an axis may point either way
            if getattr(e, name, None) is not None:
                parts[name] = -np.asarray(getattr(e, name)) * flip
        return replace(e, **parts)

    phases = tuple(replace(p, effects=tuple(effect(e) for e in p.effects)) for p in scene.phases)
    strands = replace(
        scene.strands,
        positions=np.asarray(scene.strands.positions) * flip,
        orientations=mirrored_frames(np.asarray(scene.strands.orientations), -1),
        natural_shape=np.asarray(scene.strands.natural_shape) * np.array([1.0, -1.0, -1.0]),
    )
    return replace(scene, strands=strands, phases=phases)


def mirrored_frames(q: Any, axis: int) -> np.ndarray:
    """R -> M R M with M = diag(-1, 1, 1): (w, x, y, z) -> (w, x, -y, -z)."""
    signs = np.array([1.0, 1.0, -1.0, -1.0])
    shape = [1] * np.ndim(q)
    shape[axis] = 4
    return np.asarray(q) * signs.reshape(shape)


@TWO
def test_mirror_image(solver: str) -> None:
    """The scene in a mirror ends in the mirror image."""
    scene = scene_of_3("float64", solver)
    end, other = final(scene), final(mirrored(scene))
    back = replace(
        other,
        positions=np.asarray(other.positions) * np.array([-1.0, 1.0, 1.0])[:, None],
        orientations=mirrored_frames(other.orientations, 1),
        shapes=np.asarray(other.shapes) * np.array([1.0, -1.0, -1.0])[:, None],
    )
    assert_same(end, back, TOLERANCE)
    assert np.abs(np.asarray(end.positions - other.positions)).max() > 1e-3


LENGTHS = ("acceleration", "velocity", "centre", "blower", "target", "width", "radius", "length")


def in_other_units(scene: Scene, length: float, mass: float) -> Scene:
    """The same scene with lengths and masses counted in other units; times stay."""

    def effect(e: Any) -> Any:
        parts = {
            name: np.asarray(getattr(e, name)) * length
            for name in (*LENGTHS, "strength")
            if getattr(e, name, None) is not None
        }
        if hasattr(e, "drying"):
            parts["drying"] = np.asarray(e.drying) / length
        return replace(e, **parts)

    fibre = {"peeling_rate": np.asarray(scene.fibre.peeling_rate) / length}
    if isinstance(scene.fibre, PhysicalFibre):
        for name in ("young_modulus", "shear_modulus"):
            fibre[name] = np.asarray(getattr(scene.fibre, name)) * mass / length
        for name in ("radius", "minor_radius"):
            fibre[name] = np.asarray(getattr(scene.fibre, name)) * length
        fibre["density"] = np.asarray(scene.fibre.density) * mass / length**3
    strands = replace(
        scene.strands,
        positions=np.asarray(scene.strands.positions) * length,
        lengths=np.asarray(scene.strands.lengths) * length,
    )
    phases = tuple(replace(p, effects=tuple(effect(e) for e in p.effects)) for p in scene.phases)
    return replace(scene, strands=strands, fibre=replace(scene.fibre, **fibre), phases=phases)


@EACH
def test_other_units(solver: str) -> None:
    """In inches and pounds the same happens."""
    scene = scene_of_3("float64", solver)
    inch, pound = 1 / 0.0254, 1 / 0.4536
    end, other = final(scene), final(in_other_units(scene, inch, pound))
    back = replace(other, positions=np.asarray(other.positions) / inch)
    assert_same(end, back, TOLERANCE)


@TWO
def test_a_phase_in_two_pieces(solver: str) -> None:
    """20 steps, or 8 and 12 with the same effects; nothing that moves of itself."""
    scene = scene_of_3("float64", solver)
    still = tuple(
        replace(
            e,
            velocity=None,
            angular_velocity=None,
            **({"centre": None} if isinstance(e, Hold) else {}),
        )
        if hasattr(e, "velocity")
        else e
        for e in scene.phases[0].effects
    )

    def ends(*steps: int) -> dict[str, State]:
        phases = tuple(Phase(f"part {i}", n * DT, still) for i, n in enumerate(steps))
        return run(replace(scene, phases=phases))

    whole, pieces = ends(20), ends(8, 12)
    assert_same(whole["part 0"], pieces["part 1"], TOLERANCE)


@EACH
def test_momentum_of_a_free_strand(solver: str) -> None:
    """Elasticity moves no centre of mass, whatever the points weigh."""
    points = curly(2, 6) * np.linspace(1.0, 2.0, 6)[:, None]
    scene = Scene(from_points(points), solver=SOLVERS[solver], phases=(Phase("only", 1.0),))
    scene = as_dtype(scene, "float64")
    rod = prepare(scene.as_arrays(), ()).rod
    mass = np.broadcast_to(1 / np.asarray(rod.point_weights), (6, 1, 2))
    velocities = np.random.default_rng(2).normal(0, 0.5, (6, 3, 2))
    end = final(scene, 20, velocities)
    before, after = (np.sum(mass * np.asarray(v), axis=0) for v in (velocities, end.velocities))
    np.testing.assert_allclose(after, before, atol=1e-11 * np.abs(mass).sum())
    assert np.abs(np.asarray(end.velocities) - velocities).max() > 0.1


def energy(scene: Scene, state: State) -> float:
    """Kinetic, of weight, of bending and twisting, and of stretch and shear: a direct strand's
    energy [J]; 4 B / h |Omega - Omega_o|^2 / 2 and E A l |gamma|^2 / 2."""
    setup = prepare(scene, scene.phases[0].effects)
    rod = setup.rod
    assert rod.material is not None
    free = rod.point_weights > 0
    mass = jnp.where(free, rod.unit_mass() / jnp.where(free, rod.point_weights, 1), 0)
    gravity = jnp.asarray((0.0, 0.0, -9.8))[None, :, None]
    moving = mass * (quat.dot(state.velocities, state.velocities) / 2)
    weight = -mass * quat.dot(gravity, state.positions)
    shape, share = springs(state.shapes, state.fractions, rod.influence)
    q = state.orientations
    r = quat.relative(q[:-1], q[1:])
    bent = (quat.same_hemisphere(r, shape) * r - shape)[:, 1:]
    elastic = share * rod.bending() * bent**2 / 2
    stretched = (state.positions[1:] - state.positions[:-1]) / rod.lengths - quat.tangent(q)
    axial = rod.material.axial_stiffness * rod.lengths * stretched**2 / 2
    return float(sum(jnp.sum(x) for x in (moving, weight, elastic, axial)))


@cache
def swinging(solver: str) -> tuple[Scene, tuple[float, ...]]:
    """A curly strand swings from its root without drag: its energy after each of 200 steps."""
    hair = from_points(curly(1, 9))
    phases = (Phase("only", 1.0, (Hold(), Gravity((0.0, 0.0, -9.8)))),)
    scene = Scene(
        hair,
        PhysicalFibre(),
        Bonds(),
        phases,
        replace(SOLVERS[solver], **({} if solver == "direct" else {"iterations": 30})),
        dt=1 / 720,
    ).as_arrays()
    setup, state = prepare(scene, scene.phases[0].effects), start(scene)
    advanced = jax.jit(step)
    found = [energy(scene, state)]
    for i in range(200):
        state = advanced(setup, state, jnp.asarray(i * scene.dt))
        found.append(energy(scene, state))
    return scene, tuple(found)


def test_energy_never_grows_without_input() -> None:
    """The direct solver's energy falls in every step, to rounding of what is in the motion."""
    _, found = swinging("direct")
    fallen = found[0] - found[-1]
    assert fallen > 0
    assert np.diff(found).max() <= 1e-3 * fallen


@EACH
def test_kinetic_energy_never_passes_what_was_put_in(solver: str) -> None:
    """A bent strand let loose without weight: points never move faster than its stress, at its
    largest, can make them; and the motion dies away."""
    hair = from_points(curly(2, 9))
    straight = replace(hair, natural_shape=0 * np.asarray(hair.natural_shape))
    phases = (Phase("only", 1.0, (Hold(),)),)
    scene = as_dtype(Scene(straight, solver=SOLVERS[solver], phases=phases), "float64")

    def squares(steps: int) -> float:
        return float(np.sum(np.asarray(final(scene, steps).velocities) ** 2))

    early = max(squares(n) for n in (1, 2, 4, 8, 16, 32, 64))
    assert early > 0
    for late in (500, 1000, 2000):
        assert squares(late) < early
    assert squares(4000) < 0.05 * early


def ends_by_dt(scene: Scene, halvings: int) -> list[np.ndarray]:
    """Positions at the end, with dt halved again and again."""
    found = []
    for i in range(halvings):
        finer = as_dtype(replace(scene, dt=scene.dt / 2**i), "float64").as_arrays()
        steps = finer.phases[0].steps(finer.dt)
        found.append(np.asarray(jax.jit(stepped)(finer, start(finer), steps).positions))
    return found


def test_halving_dt_halves_the_error_of_a_motion() -> None:
    """Of a curly strand that swings: implicit Euler is of the first order."""
    phases = (Phase("only", 0.1, (Hold(), Gravity((0.0, 0.0, -9.8)))),)
    hair = from_points(curly(1, 9))
    scene = Scene(hair, PhysicalFibre(), phases=phases, solver=SOLVERS["direct"], dt=1 / 1440)
    ends = ends_by_dt(scene, 4)
    errors = [np.abs(a - b).max() for a, b in itertools.pairwise(ends)]
    assert errors[0] > 1e-5
    assert 0.85 < order(np.array(errors)) < 1.2


@EACH
def test_halving_dt_of_a_fall(solver: str) -> None:
    """A curly strand falls by g t (t + dt) / 2, whatever its elasticity does."""
    phases = (Phase("only", 0.1, (Gravity((0.0, 0.0, -9.8)),)),)
    scene = Scene(from_points(curly(1, 9)), phases=phases, solver=SOLVERS[solver], dt=0.01)
    before = np.asarray(start(as_dtype(scene, "float64").as_arrays()).positions)
    for i, end in enumerate(ends_by_dt(scene, 2)):
        fallen = np.broadcast_to([[0.0], [0.0], [-9.8 * 0.1 * (0.1 + 0.01 / 2**i) / 2]], (9, 3, 1))
        np.testing.assert_allclose(end - before, fallen, atol=TOLERANCE)
