"""Perms by a physical fibre, and the compliant solver, against closed forms and measured sets."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanics import BENDING, FIBRE, LENGTH, LINEAR_DENSITY, after, reference, rod, speed, tip
from test_closed_forms import curl_diameter

import jaxhair as jh
from jaxhair import quaternion as quat
from jaxhair import rods
from jaxhair.simulate import prepare
from jaxhair.treatments import AT_ONCE

DIAMETER = 5e-3  # relative
SET = 1.5  # RMS, points of per cent
ROD = 17e-3
LOTIONS = [row for row in reference("perm_set.csv") if np.isfinite(row["set_measured_percent"])]


def permed(left: float, reformed: float, *free: Any, seconds: float = 3.0, **options: Any) -> Any:
    """Positions of hair whose only bonds are cut to `left` on a rod, re-formed and released."""
    hair = jh.Strands.straight(
        [[0.0, 0, 0]], (0.0, 0, -1.0), length=0.16, points=33, dtype="float64"
    )
    wound = jh.Wound(ROD, options.pop("climb", 0.0))
    phases = (
        jh.Phase("reduced", AT_ONCE, (wound, jh.Cut(disulfide=left))),
        jh.Phase("oxidised", AT_ONCE, (wound, jh.Reform(disulfide=reformed))),
        jh.Phase("released", seconds, (jh.Hold(), *free)),
    )
    bonds = jh.Bonds((0.0, 0.0, 1.0, 0.0))
    scene = jh.Scene(hair, FIBRE, bonds, phases, jh.Direct(), **options)
    return np.asarray(jh.run(scene)["released"].points[0])


def test_curl_and_set_of_the_measured_lotions() -> None:
    """S = 1 - E_re / E_ro, of the fractions that lotion and oxidation leave; D = D_rod / S."""
    assert len(LOTIONS) == 8
    missed = []
    for row in LOTIONS:
        left, reformed = row["E_re_percent"] / 100, row["E_ro_percent"] / 100
        diameters = curl_diameter(permed(left, reformed, jh.Drag(0.02), dt=0.01))
        s = 1 - left / reformed
        np.testing.assert_allclose(diameters, ROD / s, rtol=DIAMETER)
        missed.append(100 * ROD / diameters.mean() - row["set_measured_percent"])
    assert np.sqrt(np.mean(np.square(missed))) < SET


def test_a_wet_curl_hangs_longer_than_a_dry_one() -> None:
    """Water takes 60 % of the stiffness, and the same weight pulls more of the curl out."""
    free = jh.Gravity(), jh.Drag(0.1)
    options: dict[str, Any] = {"dt": 0.01, "climb": 0.1, "seconds": 6.0}
    dry = permed(0.2, 0.8, *free, **options)
    wet = permed(0.2, 0.8, *free, jh.Soften(0.4), **options)
    weightless = permed(0.2, 0.8, jh.Drag(0.1), **options)
    lengths = [-x[:, 2].min() for x in (weightless, dry, wet)]
    assert lengths[0] + 0.005 < lengths[1]
    assert lengths[1] + 0.005 < lengths[2] < 0.16


def test_bonds_and_cuticle_scale_bending_and_twisting() -> None:
    """(13) to (15): half of the bonds cut, or half of the cuticle's stiffness worn, sag alike."""
    load = 2.0 * BENDING / (LINEAR_DENSITY * LENGTH**3)
    effects = jh.Hold(), jh.Gravity((0, 0, -load)), jh.Drag(0.05)

    def sag(fibre: jh.PhysicalFibre, bonds: jh.Bonds) -> np.ndarray:
        return tip(after(8.0, rod(16), *effects, fibre=fibre, bonds=bonds))

    whole = jh.Bonds((0.25, 0.25, 0.25, 0.25))
    half = jh.Bonds((0.25, 0.25, 0.25, 0.25), (0.0, 1.0, 0.5, 0.5))
    soft = jh.PhysicalFibre(FIBRE.young_modulus / 2, FIBRE.shear_modulus / 2, peeling_rate=0.0)
    worn = jh.PhysicalFibre(cuticle_share=0.5, peeling_rate=1e6)
    wanted = sag(soft, whole)
    np.testing.assert_allclose(sag(FIBRE, half), wanted, atol=1e-6)
    np.testing.assert_allclose(sag(worn, whole), wanted, atol=1e-6)
    assert abs(wanted[2] - sag(FIBRE, whole)[2]) > 0.1


def test_compliant_constraints_converge_to_the_direct_solver() -> None:
    """Many iterations: the same rest, whatever their number and the sweep. Frames turn in the
    course of a step, by which the rest depends on dt; at this one it is within 0.02 %."""
    load = 4.0 * BENDING / (LINEAR_DENSITY * LENGTH**3)
    effects = jh.Hold(), jh.Gravity((0, 0, -load)), jh.Drag(0.05)
    options: dict[str, Any] = {"dt": 1 / 1440}
    wanted = tip(after(2.5, rod(6), *effects, **options))
    for iterations, sweep in ((200, "red-black"), (200, "sequential"), (400, "red-black")):
        solver = jh.Compliant(iterations, sweep, orientation_weight=3.0)
        found = tip(after(2.5, rod(6), *effects, solver=solver, **options))
        np.testing.assert_allclose(found, wanted, atol=2e-4)


@pytest.mark.parametrize("iterations", [1, 3, 20])
def test_the_papers_k_is_one_compliant_projection_where_bending_acts_alone(
    iterations: int,
) -> None:
    """Two edges in line, the first held; a step leaves 1 - k of a small twist, whatever n."""
    hair = jh.Strands.straight([[0.0, 0, 0]], (0.0, 0, 1.0), length=0.02, points=3, dtype="float64")
    twist = 1e-4
    hair = jh.Strands(
        hair.positions, hair.orientations, hair.lengths, jnp.zeros((1, 1, 3)).at[0, 0, 2].set(twist)
    )
    left = []
    for solver in (jh.PositionBased(iterations), jh.Compliant(iterations)):
        state = after(AT_ONCE, hair, jh.Hold(), solver=solver, dt=1e-2)
        q = state.orientations
        left.append(1 - float(quat.relative(q[0], q[1])[3, 0]) / twist)
    phases = (jh.Phase("a", 1.0, (jh.Hold(),)),)
    scene = jh.Scene(hair, FIBRE, phases=phases, dt=1e-2).as_arrays()
    built = prepare(scene, scene.phases[0].effects).rod
    spring = float(built.bending()[0, 2, 0]) * 1e-4 / float(built.unit_mass()[0, 0, 0])
    k = spring * 0.03 / 0.01**2 / (1 + spring * 0.03 / 0.01**2)
    assert 0.05 < k < 0.95
    np.testing.assert_allclose(left, 1 - k, rtol=1e-6)


def test_substeps_are_steps_where_nothing_acts_but_elasticity() -> None:
    """Gravity spread over substeps is gravity in each: n substeps are n steps of dt / n."""
    hair = rod(8)
    for solver in (jh.PositionBased(), jh.Compliant(), jh.Direct()):
        many = type(solver)(substeps=4)
        effects = jh.Hold(), jh.Gravity()
        found = after(0.1, hair, *effects, solver=many, dt=0.01).points
        wanted = after(0.1, hair, *effects, solver=solver, dt=0.0025).points
        np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_fibres_may_differ_between_strands() -> None:
    """Three strands of three thicknesses move as each does alone."""
    hair = jh.Strands.straight(np.zeros((3, 3)), (1.0, 0, 0), length=0.1, points=9, dtype="float64")
    radii = np.array([30e-6, 40e-6, 60e-6])
    effects = jh.Hold(), jh.Gravity(), jh.Drag(0.1)
    together = np.asarray(
        after(0.3, hair, *effects, fibre=jh.PhysicalFibre(radius=radii), dt=1 / 360).points
    )
    for i, radius in enumerate(radii):
        one = jh.Strands.straight(
            np.zeros((1, 3)), (1.0, 0, 0), length=0.1, points=9, dtype="float64"
        )
        alone = after(0.3, one, *effects, fibre=jh.PhysicalFibre(radius=radius), dt=1 / 360).points
        np.testing.assert_allclose(together[i], alone[0], atol=1e-10)


def test_all_bonds_cut_leaves_a_limp_strand_finite() -> None:
    """No stiffness at all: values and derivatives stay finite, the strand hangs straight down."""
    hair = rod(12, "float32")
    bonds = jh.Bonds(fraction=(0.0, 0.0, 0.0, 0.0))
    effects = jh.Hold(clamped=False), jh.Gravity(), jh.Drag(0.1)
    state = after(8.0, hair, *effects, bonds=bonds, dt=1 / 360)
    assert speed(state) < 1e-3
    x = np.asarray(state.points[0])
    assert x[-1, 2] == pytest.approx(-float(np.sum(hair.lengths)), rel=1e-3)

    def height(fraction: Any) -> Any:
        cut = jh.Bonds(fraction=fraction * jnp.ones(4, "float32"))
        return after(0.05, hair, *effects, bonds=cut, dt=1 / 360).points[0, -1, 2]

    for slope in (jax.grad(height), jax.jacfwd(height)):
        assert np.isfinite(slope(jnp.float32(0)))


def test_spring_constants_of_joints() -> None:
    """4 B / h with h half of both edges beside the point, about d1, d2 and d3."""
    x = np.cumsum([[0.0, 0, 0], [0.01, 0, 0], [0.02, 0, 0], [0.03, 0, 0]], axis=0)
    scene = jh.Scene(jh.Strands.from_points(x[None]), FIBRE).as_arrays()
    built: rods.Rod = prepare(scene, ()).rod
    twisting = float(FIBRE.twisting_stiffness)
    wanted = [[4 * k / h for k in (BENDING, BENDING, twisting)] for h in (0.015, 0.025)]
    np.testing.assert_allclose(np.asarray(built.bending())[:, :, 0], wanted, rtol=1e-12)
