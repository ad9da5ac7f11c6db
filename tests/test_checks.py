"""Bad input to every public constructor: a ValueError of one line with field, value and allowed."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import jaxhair as jh
from jaxhair import scenes, treatments

NAN = float("nan")
HAIR = jh.Strands.straight([(0.0, 0, 0), (1, 0, 0)], (0.0, 0, -1), length=0.2, points=5)
SCENE = jh.Scene(HAIR, phases=(jh.Phase("only", 0.1),))
O, X = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)  # noqa: E741
NUMBER = "must be a number"


def strands(**arrays: Any) -> jh.Strands:
    return replace(HAIR, **arrays)


def straight(roots: Any = (O,), directions: Any = X, length: Any = 0.2, points: Any = 5) -> Any:
    return jh.Strands.straight(roots, directions, length=length, points=points)


def ragged(*lengths: float) -> jh.Strands:
    return strands(lengths=np.array([lengths, [0.05] * 4]), ragged=True)


def one(*effects: Any) -> jh.Scene:
    return jh.Scene(HAIR, phases=(jh.Phase("only", 0.1, effects),))


def ones(*shape: int) -> np.ndarray:
    return np.ones(shape)


Case = tuple[Callable[[], Any], str]
"""A call, and what its message must contain, parts separated by |."""

STRANDS: list[Case] = [
    (lambda: strands(positions=ones(2, 5)), "strands.positions|(2, 5)|(strands, points, 3)"),
    (lambda: strands(positions=ones(2, 1, 3)), "strands.positions|1 point|2 or more"),
    (lambda: strands(positions=ones(0, 5, 3)), "strands.positions|(0, 5, 3)|(strands, points, 3)"),
    (lambda: strands(positions=NAN * ones(2, 5, 3)), "strands.positions|nan at (0, 0, 0)|finite"),
    (lambda: strands(positions="hair"), "strands.positions|shape ()|(strands, points, 3)"),
    (lambda: strands(positions=None), "strands.positions|shape ()|(strands, points, 3)"),
    (lambda: strands(orientations=ones(2, 4, 3)), "strands.orientations|(2, 4, 3)|(2, 4, 4)"),
    (lambda: strands(orientations=ones(2, 4, 4)), "strands.orientations|norm of 2|must be 1"),
    (lambda: strands(orientations=0 * ones(2, 4, 4)), "strands.orientations|norm of 0|must be 1"),
    (lambda: strands(orientations=NAN * ones(2, 4, 4)), "strands.orientations|nan|finite"),
    (lambda: strands(lengths=0 * ones(1, 4)), "strands.lengths|0.0 at (0, 0)|above 0"),
    (lambda: strands(lengths=-ones(2, 4)), "strands.lengths|-1.0 at (0, 0)|above 0"),
    (lambda: strands(lengths=ones(3, 4)), "strands.lengths|(3, 4)|(2, 4)"),
    (lambda: strands(lengths=ones(1, 3)), "strands.lengths|(1, 3)|(1, 4)"),
    (lambda: strands(lengths=np.inf * ones(1, 4)), "strands.lengths|inf|finite"),
    (lambda: strands(natural_shape=ones(2, 3)), "strands.natural_shape|(2, 3)|(2, 3, 3)"),
    (lambda: strands(natural_shape=ones(2, 3, 3)), "strands.natural_shape|1.73|at most 1"),
    (lambda: strands(natural_shape=NAN * ones(2, 3, 3)), "strands.natural_shape|nan|finite"),
    (lambda: ragged(0.05, 0.05, -0.05, 0), "strands.lengths|-0.05 at (0, 2)|0 or more"),
    (lambda: jh.Strands.from_points(0 * ones(2, 5, 3)), "points 0 and 1 of strand 0|apart"),
    (lambda: jh.Strands.from_points(ones(2, 1, 3)), "points|1 point|2 or more"),
    (lambda: jh.Strands.from_points(ones(5, 3)), "points|(5, 3)|(strands, points, 3)"),
    (lambda: jh.Strands.from_points([]), "points|(0,)|(strands, points, 3)"),
    (lambda: jh.Strands.from_points(NAN * ones(2, 5, 3)), "points|nan at (0, 0, 0)|finite"),
    (lambda: jh.Strands.from_points("hair"), "points|shape ()|(strands, points, 3)"),
    (lambda: jh.Strands.from_points(HAIR.positions, counts=(5,)), "counts|(1,)|(2,)"),
    (lambda: jh.Strands.from_points(HAIR.positions, counts=(5, 1)), "counts|[5, 1]|in [2, 5]"),
    (lambda: jh.Strands.from_points(HAIR.positions, counts=(6, 5)), "counts|[6, 5]|in [2, 5]"),
    (lambda: jh.Strands.from_points(HAIR.positions, counts=(5, 2.5)), "counts|2.5|whole number"),
    (lambda: straight(roots=O), "roots|(3,)|(strands, 3)"),
    (lambda: straight(roots=[]), "roots|(0,)|(strands, 3)"),
    (lambda: straight(roots=[(NAN, 0, 0)]), "roots|nan at (0, 0)|finite"),
    (lambda: straight(directions="down"), "directions|shape ()|(1, 3)"),
    (lambda: straight(length=-0.2), "length|-0.2|above 0"),
    (lambda: straight(length="long"), f"length|'long'|{NUMBER}"),
    (lambda: straight(points=1), "points|1|whole number of at least 2"),
    (lambda: straight(points=2.5), "points|2.5|whole number"),
    (lambda: straight(points=True), "points|True|whole number"),
]

MATERIAL: list[Case] = [
    (lambda: jh.Fibre(stiffness=1.5), "fibre.stiffness|1.5|[0, 1]"),
    (lambda: jh.Fibre(stiffness=NAN), "fibre.stiffness|nan|finite"),
    (lambda: jh.Fibre(stiffness="stiff"), f"fibre.stiffness|'stiff'|{NUMBER}"),
    (lambda: jh.Fibre(stiffness=None), f"fibre.stiffness|None|{NUMBER}"),
    (lambda: jh.Fibre(stiffness=True), f"fibre.stiffness|True|{NUMBER}"),
    (lambda: jh.Fibre(stiffness=[0.1, -0.2]), "fibre.stiffness|-0.2 at (1,)|[0, 1]"),
    (lambda: jh.Fibre(cuticle_share=2), "fibre.cuticle_share|2|[0, 1]"),
    (lambda: jh.Fibre(peeling_rate=-1), "fibre.peeling_rate|-1|0 or more"),
    (lambda: jh.Bonds(influence=(1, 1, 1)), "bonds.influence|(3,)|(4,)"),
    (lambda: jh.Bonds(influence=(1, 1, 1, -1)), "bonds.influence|-1.0 at (3,)|0 or more"),
    (
        lambda: jh.Bonds(influence=(0, 0, 0, 0)),
        "bonds.influence|[0.0, 0.0, 0.0, 0.0]|at least 9e-19",
    ),
    (lambda: jh.Bonds(influence=(1, 1, 1, NAN)), "bonds.influence|nan|finite"),
    (lambda: jh.Bonds(influence=("a", "b", "c", "d")), f"bonds.influence|'a'|{NUMBER}"),
    (lambda: jh.Bonds(influence=None), "bonds.influence|shape ()|(4,)"),
    (lambda: jh.Bonds(fraction=(1, 1, 1, 2)), "bonds.fraction|2.0 at (3,)|[0, 1]"),
    (lambda: jh.Bonds(fraction=1.0), "bonds.fraction|shape ()|(4,)"),
    (lambda: jh.PhysicalFibre(young_modulus=0), "fibre.young_modulus|0|above 0"),
    (lambda: jh.PhysicalFibre(shear_modulus=-1.0), "fibre.shear_modulus|-1.0|above 0"),
    (lambda: jh.PhysicalFibre(radius="thick"), f"fibre.radius|'thick'|{NUMBER}"),
    (lambda: jh.PhysicalFibre(minor_radius=0.0), "fibre.minor_radius|0.0|above 0"),
    (lambda: jh.PhysicalFibre(density=NAN), "fibre.density|nan|finite"),
    (lambda: jh.PhysicalFibre(cuticle_share=1.5), "fibre.cuticle_share|1.5|[0, 1]"),
    (lambda: jh.PhysicalFibre(peeling_rate=-1), "fibre.peeling_rate|-1|0 or more"),
    (lambda: jh.PhysicalFibre(damping_time=-0.1), "fibre.damping_time|-0.1|0 or more"),
    (lambda: jh.Direct(newton_steps=0), "solver.newton_steps|0|at least 1"),
    (lambda: jh.Direct(frame_inertia=0.0), "solver.frame_inertia|0.0|above 0"),
    (lambda: jh.Direct(substeps=0), "solver.substeps|0|at least 1"),
    (lambda: jh.Compliant(substeps=1.5), "solver.substeps|1.5|whole number"),  # type: ignore
    (lambda: jh.PositionBased(0), "solver.iterations|0|at least 1"),
    (lambda: jh.PositionBased(True), "solver.iterations|True|whole number"),
    (lambda: jh.PositionBased(2.5), "solver.iterations|2.5|whole number"),  # type: ignore
    (lambda: jh.PositionBased("5"), "solver.iterations|'5'|whole number"),  # type: ignore
    (lambda: jh.PositionBased(sweep="random"), "solver.sweep|'random'|'red-black', 'sequential'"),
    (lambda: jh.PositionBased(orientation_weight=0), "solver.orientation_weight|0|above 0"),
    (lambda: jh.PositionBased(orientation_weight=NAN), "solver.orientation_weight|nan|finite"),
]

EFFECTS: list[Case] = [
    (lambda: jh.Cut(), "Cut|one of hydrogen, ionic, disulfide, peptide"),
    (lambda: jh.Cut(rate=1.0), "Cut|one of hydrogen, ionic, disulfide, peptide"),
    (lambda: jh.Cut(hydrogen=1.5), "Cut.hydrogen|1.5|[0, 1]"),
    (lambda: jh.Cut(hydrogen="all"), f"Cut.hydrogen|'all'|{NUMBER}"),
    (lambda: jh.Cut(hydrogen=0, rate=-1), "Cut.rate|-1|0 or more"),
    (lambda: jh.Reform(), "Reform|one of hydrogen, ionic, disulfide, peptide"),
    (lambda: jh.Reform(ionic=-0.1), "Reform.ionic|-0.1|[0, 1]"),
    (lambda: jh.Reform(ionic=1, rate=NAN), "Reform.rate|nan|finite"),
    (lambda: jh.Soften(2.0), "Soften.factor|2.0|[0, 1]"),
    (lambda: jh.Gravity(9.8), "Gravity.acceleration|shape ()|(3,)"),
    (lambda: jh.Gravity((0, 0, NAN)), "Gravity.acceleration|nan at (2,)|finite"),
    (lambda: jh.Gravity(("a", "b", "c")), f"Gravity.acceleration|'a'|{NUMBER}"),
    (lambda: jh.Drag(0), "Drag.time|0|above 0"),
    (lambda: jh.Drag("slow"), f"Drag.time|'slow'|{NUMBER}"),
    (lambda: jh.Wind(X, X, 1.0), "Wind.target|1., 0., 0.|differ from the blower"),
    (lambda: jh.Wind((0, 0), X, 1.0), "Wind.blower|(2,)|(3,)"),
    (lambda: jh.Wind(O, (NAN, 0, 0), 1.0), "Wind.target|nan|finite"),
    (lambda: jh.Wind(O, X, -1.0), "Wind.strength|-1.0|0 or more"),
    (lambda: jh.Wind(O, X, 1.0, 0.0), "Wind.width|0.0|above 0"),
    (lambda: jh.DryingWind(O, O, 1.0), "DryingWind.target|0., 0., 0.|differ from the blower"),
    (lambda: jh.DryingWind(O, X, 1.0, drying=-1), "DryingWind.drying|-1|0 or more"),
    (lambda: jh.HairContact(0), "HairContact.radius|0|above 0"),
    (lambda: jh.HairContact(strength=-1), "HairContact.strength|-1|0 or more"),
    (lambda: jh.Floor("low"), f"Floor.height|'low'|{NUMBER}"),
    (lambda: jh.Floor((1, 2)), "Floor.height|(2,)|shape ()"),
    (lambda: jh.Floor(friction=-1), "Floor.friction|-1|0 or more"),
    (lambda: jh.Floor(velocity=1.0), "Floor.velocity|shape ()|(3,)"),
    (lambda: jh.Sphere((0, 0), 1.0), "Sphere.centre|(2,)|(3,)"),
    (lambda: jh.Sphere(O, 0), "Sphere.radius|0|above 0"),
    (lambda: jh.Sphere(O, 1, angular_velocity=(1, 2)), "Sphere.angular_velocity|(2,)|(3,)"),
    (lambda: jh.Cylinder(O, O, 1.0), "Cylinder.axis|0., 0., 0.|not zero"),
    (lambda: jh.Cylinder(O, X, -1), "Cylinder.radius|-1|above 0"),
    (lambda: jh.Cylinder(O, X, 1, length=0), "Cylinder.length|0|above 0"),
    (lambda: jh.Cylinder(O, X, 1, -1), "Cylinder.friction|-1|0 or more"),
    (lambda: jh.Hold("middle"), "Hold.part|'middle'|'root', 'tip'"),
    (lambda: jh.Hold(velocity=1.0), "Hold.velocity|shape ()|(3,)"),
    (lambda: jh.Hold(centre=(0, NAN, 0)), "Hold.centre|nan at (1,)|finite"),
    (lambda: jh.Wound(-1), "Wound.diameter|-1|above 0"),
    (lambda: jh.Wound(0.1, climb=3.0), "Wound.climb|3.0|[-pi/2, pi/2]"),
    (lambda: jh.Wound(0.1, climb="steep"), f"Wound.climb|'steep'|{NUMBER}"),
]

SCENES: list[Case] = [
    (lambda: jh.Phase("", 1.0), "phase.name|''|text without '.'"),
    (lambda: jh.Phase("a.b", 1.0), "phase.name|'a.b'|text without '.'"),
    (lambda: jh.Phase(1, 1.0), "phase.name|1|text"),  # type: ignore[arg-type]
    (lambda: jh.Phase("a", 0), "phase 'a'.duration|0|above 0"),
    (lambda: jh.Phase("a", NAN), "phase 'a'.duration|nan|finite"),
    (lambda: jh.Phase("a", "long"), f"phase 'a'.duration|'long'|{NUMBER}"),  # type: ignore
    (lambda: jh.Phase("a", 1.0, (jh.Gravity,)), "phase 'a'.effects|Gravity|of class Effect"),  # type: ignore
    (lambda: SCENE.then(jh.Phase("only", 1.0)), "scene.phases|'only' twice|must differ"),
    (lambda: one(jh.Wound(0.05)), "phase 'only'|Wound.diameter|0.05 m|shorter"),
    (lambda: jh.Scene(HAIR, jh.Fibre([0.1] * 3)), "fibre.stiffness|(3,)|(2,)"),
    (lambda: jh.Scene(HAIR, bonds=jh.Bonds(ones(3, 4))), "bonds.influence|(3, 4)|(2, 4)"),
    (lambda: jh.Scene(HAIR, bonds=jh.Bonds(ones(2, 4, 4))), "bonds.influence|(2, 4, 4)|(2, 3, 4)"),
    (lambda: jh.Scene(HAIR, dt=0), "scene.dt|0|above 0"),
    (lambda: jh.Scene(HAIR, dt=NAN), "scene.dt|nan|finite"),
    (lambda: SCENE.phase("wind"), "phase|'wind'|'only'"),
    (lambda: SCENE.first(-1), "seconds|-1|above 0"),
    (lambda: jh.replace_leaves(SCENE, {"fibre.colour": 1}), "leaf|'fibre.colour'|fibre.stiffness"),
    (lambda: jh.simulate(SCENE, fps=0), "fps|0|above 0"),
    (lambda: jh.simulate(SCENE, fps=NAN), "fps|nan|finite"),
    (lambda: jh.simulate(SCENE, fps="fast"), f"fps|'fast'|{NUMBER}"),  # type: ignore[arg-type]
    (lambda: jh.simulate(SCENE, fps=(1, 2)), "fps|(2,)|shape ()"),  # type: ignore[arg-type]
    (lambda: scenes.by_name("afro"), "scene|'afro'|'bed-hair', 'blow-dry', 'perm'"),
    (lambda: scenes.by_name("bed-hair", strands=0), "strands|0|at least 1"),
    (lambda: scenes.by_name("bed-hair", points=1), "points|1|at least 2"),
    (lambda: scenes.by_name("blow-dry", length=0), "length|0|above 0"),
    (lambda: scenes.by_name("blow-dry", strength=-1), "DryingWind.strength|-1|0 or more"),
    (lambda: scenes.by_name("perm", rod_diameter=0), "rod_diameter|0|above 0"),
    (lambda: scenes.by_name("perm", disulfide_left=2), "Cut.disulfide|2|[0, 1]"),
    (lambda: scenes.by_name("perm", rod_diameter=0.01, winding=False), "Wound.diameter|0.01 m"),
    (lambda: treatments.perm(rod_diameter=0), "Wound.diameter|0|above 0"),
    (lambda: treatments.wash(seconds=-1), "duration|-1|above 0"),
]

WRONG_KIND: list[Case] = [
    (lambda: strands(positions=[[X, O], [X]]), "strands.positions"),
    (lambda: strands(positions=ones(2, 5, 3) > 0), f"strands.positions|{NUMBER}"),
    (lambda: strands(positions=np.ones((2, 5, 3), int)), "strands.positions|int"),
    (lambda: ragged(0.05, 0, 0.05, 0.05), "strands.lengths|(0, 1)"),
    (lambda: ragged(0, 0, 0, 0), "strands.lengths|(0, 0)"),
    (lambda: jh.Strands.from_points([[X, O], [X]]), "points"),
    (lambda: jh.Strands.from_points([[["1", "2", "3"]] * 2]), f"points|'1'|{NUMBER}"),
    (lambda: straight(directions=O), "directions|zero"),
    (lambda: straight(directions=(NAN, 0, 0)), "directions|nan|finite"),
    (lambda: straight(directions=("a", "b", "c")), f"directions|'a'|{NUMBER}"),
    (lambda: straight(length=(0.1, 0.2)), "length|(2,)|shape ()"),
    (lambda: jh.Hold(clamped="no"), "Hold.clamped|'no'|True"),  # type: ignore
    (lambda: jh.Wound(0.1, climb=(0.1, 0.2)), "Wound.climb|(2,)|shape ()"),
    (lambda: one(jh.Wound((0.1, 0.2))), "Wound.diameter|(2,)|shape ()"),
    (lambda: jh.Phase("a", 1.0, jh.Gravity()), "phase 'a'.effects|Gravity|tuple"),  # type: ignore
    (lambda: jh.Phase("a", 1.0, None), "phase 'a'.effects|None|tuple"),  # type: ignore[arg-type]
    (lambda: jh.Scene(None), "scene.strands|None|Strands"),  # type: ignore[arg-type]
    (lambda: jh.Scene(HAIR, 0.5), "scene.fibre|0.5|Fibre"),  # type: ignore[arg-type]
    (lambda: jh.Scene(HAIR, jh.Fibre(), solver=jh.Direct()), "scene.fibre|Direct|PhysicalFibre"),
    (lambda: jh.Scene(HAIR, jh.PhysicalFibre(radius=[1e-4] * 3)), "fibre.radius|(3,)|(2,)"),
    (lambda: one(jh.TipForce((0, 0, -1e-6))), "phase 'only'|TipForce|PhysicalFibre"),
    (lambda: jh.Scene(HAIR, jh.PhysicalFibre(damping_time=0.1)), "damping_time|0.1|PositionBased"),
    (lambda: jh.TipForce((0, 0)), "TipForce.force|(2,)|(3,)"),
    (lambda: jh.Scene(HAIR, bonds=(1, 1, 1, 1)), "scene.bonds|Bonds"),  # type: ignore[arg-type]
    (lambda: jh.Scene(HAIR, solver="fast"), "scene.solver|'fast'"),  # type: ignore[arg-type]
    (lambda: jh.Scene(HAIR, phases=jh.Phase("a", 1)), "scene.phases|tuple"),  # type: ignore
    (lambda: jh.Scene(HAIR, phases=("a",)), "scene.phases|'a'|Phase"),  # type: ignore[arg-type]
    (lambda: jh.Scene(HAIR, dt="short"), f"scene.dt|'short'|{NUMBER}"),  # type: ignore[arg-type]
    (lambda: jh.Scene(HAIR, dt=None), f"scene.dt|None|{NUMBER}"),  # type: ignore[arg-type]
    (lambda: jh.Scene(HAIR).phase("a"), "phase|'a'|no phases"),
    (lambda: SCENE.first(1e-9), "seconds|1e-09"),
    (lambda: scenes.by_name("perm", strands=0), "strands is 0|at least 1"),
    (lambda: scenes.by_name("perm", strands=2.5), "strands|2.5|whole number"),
    (lambda: scenes.by_name("blow-dry", strands=-2), "strands|-2|at least 1"),
    (lambda: scenes.by_name("blow-dry", strands="a"), "strands|'a'|whole number"),
    (lambda: scenes.by_name("bed-hair", length="a"), f"length|'a'|{NUMBER}"),
]

ALL = {"strands": STRANDS, "material": MATERIAL, "effects": EFFECTS, "scenes": SCENES}
ALL["wrong kind"] = WRONG_KIND


def check_message(call: Callable[[], Any], words: str) -> None:
    """The call raises a ValueError whose message has the words."""
    with pytest.raises(ValueError) as caught:
        call()
    message = str(caught.value)
    for word in words.split("|"):
        assert word in message
    assert "\n" not in message
    assert len(message) < 400


@pytest.mark.parametrize(
    ("call", "words"),
    [pytest.param(*case, id=f"{group} {case[1]}") for group in ALL for case in ALL[group]],
)
def test_message(call: Callable[[], Any], words: str) -> None:
    check_message(call, words)


def test_good_input_is_good() -> None:
    """The same numbers at their limits pass."""
    jh.Fibre(0.0, 1.0, 0.0)
    jh.Fibre(1, 0, 0)
    jh.Bonds((0, 0, 0, 1), (0, 1, 0, 1))
    jh.Cut(peptide=0, rate=0)
    jh.Wound(0.1, climb=-np.pi / 2)
    jh.Floor(np.float32(-1), friction=0)
    straight(points=2)
    one(jh.Wound(0.0501))
    assert jh.Bonds(ones(2, 3, 4)).influence.shape == (2, 3, 4)
    assert SCENE.phase("only").steps(1 / 360) == 36
