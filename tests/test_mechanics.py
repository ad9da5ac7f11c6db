"""Physical fibre and direct solver against the mechanics of rods: closed forms, tabulated values.

The tables of tests/data are boundary value problems solved numerically, see their README.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from jax import jit, lax
from mechanics import (
    BENDING,
    FIBRE,
    LENGTH,
    LINEAR_DENSITY,
    TWISTING,
    after,
    order,
    reference,
    rod,
    speed,
    tip,
)

import jaxhair as jh
from jaxhair import quaternion as quat
from jaxhair.effects import VelocityEffect
from jaxhair.rods import Rod
from jaxhair.simulate import prepare, step
from jaxhair.strands import strands_last

TIP = 5e-3  # of the rod's length, at 64 segments
ORDER = 1.8
ROLLED_UP = 2e-3
HELIX = 0.02
FREQUENCY = 0.02
SEGMENTS = (16, 32, 64)


def cantilever(load: float, segments: int, **options: Any) -> np.ndarray:
    """Tip under its own weight, w L^3 / B = load."""
    g = load * BENDING / (LINEAR_DENSITY * LENGTH**3)
    effects = jh.Hold(), jh.Gravity((0, 0, -g)), jh.Drag(0.05)
    return tip(after(15.0, rod(segments), *effects, **options))


@pytest.mark.parametrize("row", reference("heavy_cantilever.csv"))
def test_heavy_cantilever(row: dict[str, float]) -> None:
    found = cantilever(row["w_L3_over_B"], 64)
    wanted = row["tip_x_over_L"], row["tip_z_over_L"]
    assert np.hypot(*(found[[0, 2]] - wanted)) < TIP
    assert abs(found[1]) < 1e-12


@pytest.mark.parametrize("row", reference("tip_loaded_elastica.csv"))
def test_tip_loaded_elastica_and_its_order_of_convergence(row: dict[str, float]) -> None:
    force = row["P_L2_over_B"] * BENDING / LENGTH**2
    wanted = np.array([1 - row["shortening_over_L"], 0, -row["deflection_over_L"]])
    errors = []
    for segments in SEGMENTS:
        effects = jh.Hold(), jh.TipForce((0, 0, -force)), jh.Drag(0.02)
        errors.append(np.linalg.norm(tip(after(6.0, rod(segments), *effects)) - wanted))
    assert errors[-1] < TIP
    assert order(np.array(errors)) > ORDER


@jh.pytree
class TipMoment(VelocityEffect):
    """A couple about y on the last edge: two opposite forces across it at its ends."""

    moment: Any

    def velocity_change(self, rod: Rod, state: jh.State, dt: float) -> Any:
        x = state.positions
        along = quat.unit(x[-1] - x[-2])
        across = jnp.stack([-along[2], jnp.zeros_like(along[0]), along[0]])
        force = self.moment / rod.lengths[-1] * across
        weight = dt * rod.point_weights / rod.unit_mass()
        change = jnp.zeros_like(x).at[-1].set(force * weight[-1])
        return change.at[-2].set(-force * weight[-2])


def test_an_end_moment_rolls_a_rod_up_to_a_circle() -> None:
    """M L / B = 2 pi brings the tip back to the clamp; half of it opposite on the circle."""
    for turn, wanted in ((2 * np.pi, (0.0, 0.0)), (np.pi, (0.0, 2 / np.pi))):
        # A rod whose tip turns by the moment ends at the middle of its last edge.
        effects = jh.Hold(), TipMoment(turn * BENDING / LENGTH), jh.Drag(0.02)
        edge = LENGTH / 63
        hair = jh.Strands.straight(
            [[-edge / 2, 0, 0]], (1.0, 0, 0), length=LENGTH + edge, points=65, dtype="float64"
        )
        state = after(4.0, hair, *effects, dt=1 / 360)
        found = np.asarray(state.points[0, -2:]).mean(0) / LENGTH
        assert np.hypot(*(found[[0, 2]] - wanted)) < ROLLED_UP, turn
        assert speed(state) < 1e-7


@pytest.mark.parametrize(
    "ratio",
    [*(pytest.param(x, marks=pytest.mark.slow) for x in ("beta_1", "beta_2_3")), "beta_0_456"],
)
def test_hanging_helix(ratio: str) -> None:
    """Height of a naturally circular rod of 20 turns, by lambda = w L / (B kappa^2) and C / B."""
    beta = {"beta_1": 1.0, "beta_2_3": 2 / 3, "beta_0_456": 0.456}[ratio]
    rows = [row for row in reference("hanging_helix.csv") if 0.25 <= row["lambda"] <= 4]
    radius, turns, per_turn = 0.01, 20, 20
    angle = 2 * np.pi * np.arange(turns * per_turn + 1) / per_turn
    x = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    length = float(np.linalg.norm(np.diff(x, axis=0), axis=1).sum())
    weights = np.array([row["lambda"] for row in rows]) * BENDING / radius**2 / length
    # Light ones swing for long in thin air, heavy ones unwind slowly in thick air.
    for light, drag, seconds in ((True, 0.05, 100.0), (False, 1.0, 250.0)):
        chosen = np.array([row["lambda"] < 0.5 for row in rows]) == light
        # One scene: strands of different density, which changes their weight and nothing else.
        fibre = jh.PhysicalFibre(
            shear_modulus=beta * FIBRE.young_modulus / 2,
            peeling_rate=0.0,
            density=weights[chosen] / 9.8 / float(FIBRE.area),
        )
        hair = jh.Strands.from_points(np.tile(x, (int(chosen.sum()), 1, 1)))
        effects = jh.Hold(), jh.Gravity((0, 0, -9.8)), jh.Drag(drag)
        options: dict[str, Any] = {"dt": 0.05, "solver": jh.Direct(newton_steps=2)}
        state = after(seconds, hair, *effects, fibre=fibre, **options)
        heights = -np.asarray(state.points)[:, :, 2].min(axis=1) / length
        wanted = np.array([row[ratio] for row in rows])[chosen]
        np.testing.assert_allclose(heights, wanted, rtol=HELIX)


def test_first_bending_frequency() -> None:
    """f = 0.559591 sqrt(B / (rho A L^4)), from the zeros of the tip's swing."""
    g = 0.02 * BENDING / (LINEAR_DENSITY * LENGTH**3)
    hair = rod(32)
    bent = after(5.0, hair, jh.Hold(), jh.Gravity((0, 0, -g)), jh.Drag(0.02))
    closed = 0.559591 * np.sqrt(BENDING / (LINEAR_DENSITY * LENGTH**4))
    for dt in (2e-3, 1e-3, 5e-4):
        swing = recorded(hair, bent, dt, 1.2, lambda s: s.positions[-1, 2, 0])
        zero = np.nonzero(np.signbit(swing[:-1]) != np.signbit(swing[1:]))[0]
        times = (zero + swing[zero] / (swing[zero] - swing[zero + 1])) * dt
        assert len(times) >= 3
        assert 1 / (2 * np.diff(times).mean()) == pytest.approx(closed, rel=FREQUENCY)


def recorded(
    hair: jh.Strands, state: jh.State, dt: float, seconds: float, observe: Any, **options: Any
) -> np.ndarray:
    """What is observed of each step of a rod that only its clamp holds."""
    options = {"fibre": FIBRE, "solver": jh.Direct(), **options}
    scene = jh.Scene(hair, dt=dt, phases=(jh.Phase("free", 1.0, (jh.Hold(),)),), **options)
    scene = scene.as_arrays()
    setup = prepare(scene, scene.phases[0].effects)

    def one(state: jh.State, _: Any) -> Any:
        state = step(setup, state, jnp.zeros((), scene.dtype))
        return state, observe(state)

    return np.asarray(jit(lambda s: lax.scan(one, s, None, length=round(seconds / dt))[1])(state))


@pytest.mark.parametrize("time", [pytest.param(0.01, marks=pytest.mark.slow), 0.03])
def test_damping_is_a_time_and_does_not_depend_on_dt(time: float) -> None:
    """Tip's swing falls by exp(-w^2 T / 2) a second: the ratio of damping is w T / 2.

    What the time step damps besides is the same without a damping time, and is taken off.
    """
    g = 0.02 * BENDING / (LINEAR_DENSITY * LENGTH**3)
    hair = rod(16)
    bent = after(5.0, hair, jh.Hold(), jh.Gravity((0, 0, -g)), jh.Drag(0.02))
    w = 2 * np.pi * 0.559591 * np.sqrt(BENDING / (LINEAR_DENSITY * LENGTH**4))
    for dt in (1e-3, 5e-4):
        decay = []
        for fibre in (FIBRE, jh.PhysicalFibre(peeling_rate=0.0, damping_time=time)):
            z = recorded(hair, bent, dt, 1.2, lambda s: s.positions[-1, 2, 0], fibre=fibre)
            top = np.nonzero((np.abs(z[1:-1]) > np.abs(z[:-2])) & (np.abs(z[1:-1]) > np.abs(z[2:])))
            peaks = top[0][-3:] + 1
            decay.append(-np.polyfit(peaks * dt, np.log(np.abs(z[peaks])), 1)[0])
        assert decay[1] - decay[0] == pytest.approx(w**2 * time / 2, rel=0.05)


@pytest.mark.parametrize("solver", [jh.Direct(), jh.Direct(newton_steps=2)])
def test_twist_is_linear_and_does_not_leak_into_bending(solver: jh.Direct) -> None:
    """Both ends clamped, the tip turned about the rod's axis by a third of a turn."""
    hair, angle = rod(16), 2 * np.pi / 3
    spin = jh.Hold("tip", angular_velocity=(angle, 0.0, 0.0))
    state = after(1.0, hair, jh.Hold(), spin, dt=0.01, solver=solver)
    state = after(2.0, hair, jh.Hold(), jh.Hold("tip"), dt=0.01, solver=solver, state=state)
    q = state.orientations
    omega = np.asarray(quat.relative(q[:-1], q[1:]))[:, 1:, 0]
    np.testing.assert_allclose(omega[:, :2], 0, atol=1e-12)
    np.testing.assert_allclose(2 * np.arcsin(np.abs(omega[:, 2])), angle / 15, rtol=1e-9)
    x = np.asarray(state.points[0])
    np.testing.assert_allclose(x, np.asarray(hair.positions[0]), atol=1e-12)


def test_stiffness_of_an_elliptical_section() -> None:
    """E pi a b^3 / 4 about d1, E pi a^3 b / 4 about d2, G pi a^3 b^3 / (a^2 + b^2); round: G/2."""
    a, b = 50e-6, 30e-6
    oval = jh.PhysicalFibre(radius=a, minor_radius=b, peeling_rate=0.0)
    about_1, about_2 = oval.bending_stiffness
    assert float(about_1) == pytest.approx(3.89e9 * np.pi * a * b**3 / 4)
    assert float(about_2) == pytest.approx(3.89e9 * np.pi * a**3 * b / 4)
    assert float(oval.twisting_stiffness) == pytest.approx(
        0.89e9 * np.pi * a**3 * b**3 / (a**2 + b**2)
    )
    assert pytest.approx(3.89e9 * np.pi * 40e-6**4 / 4) == BENDING
    assert pytest.approx(0.89e9 * np.pi * 40e-6**4 / 2) == TWISTING
    # Small loads bend it across its flat side more, as the moments of inertia say.
    force = 0.02 * float(about_1) / LENGTH**2
    sag = []
    for pull in ((0, 0, -force), (0, -force, 0)):
        hair = rod(16)
        state = after(6.0, hair, jh.Hold(), jh.TipForce(pull), jh.Drag(0.02), fibre=oval)
        sag.append(np.abs(tip(state)[1:]).max())
    frame = np.asarray(quat.axes(strands_last(rod(16).orientations))[0])[0, :, 0]
    ratio = (a / b) ** 2
    expected = ratio if abs(frame[1]) > abs(frame[2]) else 1 / ratio
    assert sag[0] / sag[1] == pytest.approx(expected, rel=1e-3)


def test_results_do_not_depend_on_dt_newton_steps_or_substeps() -> None:
    """The shape at rest is that of the equations: 12 digits of it."""
    found = [
        cantilever(8.0, 16, dt=dt, solver=solver)
        for dt, solver in (
            (0.02, jh.Direct()),
            (1 / 360, jh.Direct()),
            (0.02, jh.Direct(newton_steps=3)),
            (0.02, jh.Direct(substeps=4)),
            (0.02, jh.Direct(frame_inertia=1e-5)),
        )
    ]
    np.testing.assert_allclose(found, np.tile(found[0], (len(found), 1)), atol=1e-10)


def test_order_of_convergence_of_the_heavy_cantilever() -> None:
    """Against the finest, since the table has four digits: second order in the segment's length."""
    fine = cantilever(16.0, 256)
    errors = [np.linalg.norm(cantilever(16.0, n) - fine) for n in SEGMENTS]
    assert order(np.array(errors)) > ORDER
