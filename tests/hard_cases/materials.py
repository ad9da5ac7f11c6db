"""Hard cases of fibre, of bonds, and of what they remember."""

from dataclasses import replace
from typing import Any

import numpy as np

import jaxhair as jh
from hard_cases.catalogue import (
    HANGING,
    SOLVERS,
    WET,
    Setting,
    Start,
    hard,
    helix,
    moved,
    straight,
    swept,
    through,
    treated,
)

COIL = through(helix(radius=0.015))
KEPT = "a fraction at the end of its range is kept there: a kink"


@hard(breaks="nothing resists bending or twisting", fixed=("stiffness",))
def k_of_0(s: Setting) -> jh.Scene:
    soft = jh.PhysicalFibre(
        cuticle_share=1.0, peeling_rate=1e4
    )  # a modulus of 0 would not stretch back
    return s.scene(COIL, *HANGING, k=0.0, physical=soft)


@hard(
    breaks="bends must be right within a step: 1 - k is 0, and its logarithm infinite",
    fixed=("stiffness", "peeling_rate"),
)
def k_of_1(s: Setting) -> jh.Scene:
    unworn = jh.Fibre(1.0, peeling_rate=0.0)
    return s.scene(COIL, *HANGING, k=unworn, physical=jh.PhysicalFibre(3.89e15, 0.89e15))


def worn(s: Setting, rate: float) -> jh.Scene:
    """All of the stiffness is the cuticle's, which wears off at a rate [1/m]."""
    physical = jh.PhysicalFibre(cuticle_share=1.0, peeling_rate=rate)
    return s.scene(COIL, *HANGING, k=jh.Fibre(0.3, 1.0, rate), physical=physical)


@hard(breaks="s d is exactly 1 at a point", smooth="the cuticle ends in a kink")
def cuticle_gone_exactly_at_a_point(s: Setting) -> jh.Scene:
    return worn(s, 1 / float(np.asarray(COIL.lengths)[0, :4].sum()))


@hard(breaks="s d is far above 1: no stiffness is left")
def cuticle_gone_long_before_the_tip(s: Setting) -> jh.Scene:
    return worn(s, 1e4)


def unlike(s: Setting, k: Any, young: float, density: Any) -> jh.Scene:
    """Two strands of different stiffness and mass."""
    one = np.ones(2)
    physical = jh.PhysicalFibre(3.89 * young * one, 0.89 * young * one, density=density * one)
    return s.scene(COIL, *HANGING, k=jh.Fibre(k * one), physical=physical)


@hard(breaks="stiffnesses a million times apart beside each other", speed=20)
def stiffness_ratio_of_1e6(s: Setting) -> jh.Scene:
    return unlike(s, np.array([1e-7, 0.1]), np.array([1e6, 1e12]), 1320.0)


@hard(breaks="masses a million times apart beside each other", speed=20)
def mass_ratio_of_1e6(s: Setting) -> jh.Scene:
    return unlike(s, 0.05, 1e9, np.array([1.32, 1.32e6]))


@hard(breaks="along a strand every second bend is a million times softer than the next")
def bonded_share_ratio_of_1e6(s: Setting) -> jh.Scene:
    fraction = np.where(np.arange(7)[None, :, None] % 2, 1.0, 1e-6) * np.ones((2, 7, 4))
    return s.scene(COIL, *HANGING, k=1.0, bonds=jh.Bonds(fraction=fraction))


def lossy(s: Setting, thickness: float, damping: float) -> jh.Scene:
    """A fibre with a flat section and damping of its own, where the solver has these."""
    if not s.physical:
        return s.scene(COIL, *HANGING)
    fibre = jh.PhysicalFibre(radius=40e-6, minor_radius=thickness, damping_time=damping)
    return s.scene(COIL, *HANGING, physical=fibre)


@hard(breaks="a section 100 times as wide as it is thick: bending stiffnesses 10^4 apart")
def flat_ribbon(s: Setting) -> jh.Scene:
    return lossy(s, 0.4e-6, 0.01)


@hard(breaks="the damping is far stiffer than the spring that it damps")
def damped_for_1000_s(s: Setting) -> jh.Scene:
    return lossy(s, 40e-6, 1e3)


def weighted(s: Setting, orientation_weight: float, frame_inertia: float) -> jh.Scene:
    """Frames of another weight, in the sweeps, or inertia, in the direct solver."""
    name, value = "orientation_weight", orientation_weight
    if s.solver == "direct":
        name, value = "frame_inertia", frame_inertia
    return s.scene(COIL, *HANGING, solver=replace(SOLVERS[s.solver], **{name: value}))


@hard(breaks="frames that hardly turn")
def frames_of_great_inertia(s: Setting) -> jh.Scene:
    return weighted(s, 1e-4, 100.0)


@hard(
    breaks="frames that turn at a touch",
    except_for=swept("frames that follow without resisting hold no length", stretch=40.0),
)
def frames_of_little_inertia(s: Setting) -> jh.Scene:
    return weighted(s, 1e4, 1e-9)


@hard(breaks="no bond holds: the sum of f_j b_j is 0", fixed=("fractions", "influence"))
def all_bonds_cut(s: Setting) -> jh.Scene:
    return s.scene(COIL, *HANGING, bonds=jh.Bonds(fraction=(0.0, 0.0, 0.0, 0.0)))


@hard(
    breaks="bonds cut but for next to nothing: the slope of 1 / (sum of f_j b_j) overflows",
    smooth="the shape free of stress jumps where the last bond is cut",
)
def cut_but_for_next_to_nothing(s: Setting) -> jh.Scene:
    nothing = float(np.finfo(s.dtype).tiny) ** 0.8
    return s.scene(COIL, *HANGING, bonds=jh.Bonds(fraction=(0.0, 0.0, 0.0, nothing)))


@hard(
    breaks="bonds that have all but not formed: the slope of db_j / (b_j + db_j) overflows",
    smooth="the remembered shape jumps where the first bond forms",
)
def formed_by_next_to_nothing(s: Setting) -> jh.Scene:
    nothing = float(np.finfo(s.dtype).tiny) ** 0.8
    return s.scene(COIL, *treated(0.0, 2 * nothing), bonds=jh.Bonds(fraction=(nothing, 1, 1, 1)))


@hard(breaks="one f_j is 0")
def one_influence_0(s: Setting) -> jh.Scene:
    return s.scene(COIL, *HANGING, bonds=jh.Bonds((0.0, 0.3, 0.2, 0.17)))


@hard(
    breaks="all f_j but one are 0, and that bond is cut",
    fixed=("influence", "fractions"),
)
def only_the_cut_bond_counts(s: Setting) -> jh.Scene:
    return s.scene(COIL, *HANGING, bonds=jh.Bonds((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 1.0, 1.0)))


@hard(breaks="the square of the sum of the f_j is near float32's smallest number")
def influences_of_1e_minus_18(s: Setting) -> jh.Scene:
    return s.scene(COIL, *HANGING, bonds=jh.Bonds((3e-18, 3e-18, 2e-18, 1e-18)))


@hard(
    breaks="two kinds remember opposite half turns, of which the mean is straight",
    smooth="where both are equally near, the nearer of q and -q changes",
    speed=20,
)
def bonds_of_opposite_memory(s: Setting) -> Start:
    scene = s.scene(straight(), *HANGING, bonds=jh.Bonds((0.5, 0.5, 0.0, 0.0)))
    shapes = np.zeros(moved(scene).state.shapes.shape)
    shapes[:, 0, 0], shapes[:, 1, 0] = 1.0, -1.0
    return moved(scene, shapes=shapes)


@hard(
    breaks="a bond is cut and re-formed in every step",
    holds="the hydrogen bonds end whole",
    smooth=KEPT,
    check=lambda start, end: np.testing.assert_allclose(end.fractions[:, 0], 1.0),
)
def bond_cut_and_formed_in_every_step(s: Setting) -> jh.Scene:
    return s.scene(COIL, *treated(0.0, 1.0))


@hard(
    breaks="b + db = 0: no bond is there and none forms, a weight of 0 / 0",
    holds="the hydrogen bonds stay cut",
    smooth=KEPT,
    check=lambda start, end: np.testing.assert_array_equal(end.fractions[:, 0], 0.0),
)
def nothing_re_forms(s: Setting) -> jh.Scene:
    return s.scene(COIL, *treated(0.0, 0.0), bonds=jh.Bonds(fraction=(0.0, 1.0, 1.0, 1.0)))


@hard(breaks="bonds fade and form at once", smooth=True)
def half_cut_and_half_formed(s: Setting) -> jh.Scene:
    return s.scene(COIL, *treated(0.2, 0.9, rate=1.0), bonds=WET)


@hard(breaks="the stiffness is multiplied by 0", smooth=KEPT, fixed=("factor",))
def softened_to_nothing(s: Setting) -> jh.Scene:
    return s.scene(COIL, *treated(1.0, 0.0, softened=0.0))


@hard(
    breaks="a rod as thick as an edge is long: bends near the half turn",
    smooth=KEPT,
    steps=3,
)
def wound_on_the_thinnest_rod(s: Setting) -> jh.Scene:
    return s.scene(straight(), jh.Wound(0.0301), *treated(0.0, 1.0)[3:5])


@hard(breaks="the shape free of stress where no bond is whole", fixed=("fractions",), steps=3)
def unloaded_with_all_bonds_cut(s: Setting) -> jh.Scene:
    return s.scene(COIL, jh.Unloaded(), bonds=jh.Bonds(fraction=(0.0, 0.0, 0.0, 0.0)))
