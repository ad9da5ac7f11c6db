"""Bad input, generated: each public constructor and function takes it or refuses it clearly.

About 2,000 examples, new ones each time: HYPOTHESIS_PROFILE=full python -m pytest
tests/test_bad_input.py tests/test_bad_files.py. Without it a seeded part of them.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from bad_values import bad, check_refusal, examples
from hypothesis import given
from hypothesis import strategies as st

import fitting
import jaxhair as jh
from jaxhair import scenes, treatments
from jaxhair.effects import Effect
from jaxhair.pictures import View
from jaxhair.solvers import Solver

DT = 1 / 360
O, X = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)  # noqa: E741
HAIR = jh.Strands.straight([O, X], (0.0, 0.0, -1.0), length=0.2, points=5, dtype="float64")
SCENE = jh.Scene(HAIR, phases=(jh.Phase("only", 2 * DT, (jh.Gravity(), jh.Hold())),))
CURL = np.stack([np.cos(np.arange(40) / 4), np.sin(np.arange(40) / 4), np.arange(40) / 20], 1)
CURVES = jh.Curves.from_list([CURL / 80, CURL / 80])
RECORDING = jh.Recording(
    SCENE,
    np.arange(2) * DT,
    {"positions": np.stack([HAIR.positions] * 2), "fractions": np.ones((2, 2, 3, 4))},
    ("", "only"),
)
TARGETS = {"only": fitting.helix(diameter=0.02)}
FREE = {"fibre.stiffness": fitting.Positive()}
EFFECT = {"rod_diameter": 0.06, "climb": 0.1, "seconds": 0.1, "free": (jh.Hold(),), "unload": True}
SIZE = {"strands": 2, "points": 5, "length": 0.2, "seed": 0, "contact": True, "dt": DT}
MOTION = {"velocity": X, "angular_velocity": X}


def leaf(value: Any) -> jh.Scene:
    return jh.replace_leaves(SCENE, {"fibre.stiffness": value})


def draw(**options: Any) -> None:
    jh.save("a.png", RECORDING, overwrite=True, **options)


def save(path: Any = "a.npz", recording: Any = RECORDING, **options: Any) -> None:
    jh.save(path, recording, **{"overwrite": True, **options})


def write(path: Any = "a.hair", curves: Any = CURVES, **options: Any) -> None:
    jh.write_curves(path, curves, **{"overwrite": True, **options})


def prepared(**options: Any) -> jh.Scene:
    return scenes.perm(winding=False, **options)


Case = tuple[Callable[..., Any], dict[str, Any]]
"""A public constructor or function, and valid arguments for it, one of which is made bad."""

CASES: dict[str, Case] = {
    "Strands": (jh.Strands, {n: np.asarray(v) for n, v in vars(HAIR).items() if n != "ragged"}),
    "Strands, ragged": (
        jh.Strands,
        {**vars(HAIR), "lengths": np.array([[0.05] * 4, [0.05] * 3 + [0.0]]), "ragged": True},
    ),
    "Strands.from_points": (
        jh.Strands.from_points,
        {"points": np.asarray(HAIR.positions), "counts": np.array([5, 4])},
    ),
    "Strands.straight": (
        jh.Strands.straight,
        {"roots": [O, X], "directions": X, "length": 0.2, "points": 5, "dtype": "float32"},
    ),
    "Curves": (jh.Curves, {"points": CURVES.points, "counts": np.array([3, 40])}),
    "Curves.from_list": (jh.Curves.from_list, {"strands": [CURL, CURL]}),
    "Fibre": (jh.Fibre, {"stiffness": 0.1, "cuticle_share": [0.5, 0.6], "peeling_rate": 0.3}),
    "PhysicalFibre": (
        jh.PhysicalFibre,
        {**vars(jh.PhysicalFibre()), "minor_radius": 3e-5, "damping_time": 0.01},
    ),
    "Bonds": (jh.Bonds, {"influence": (0.1, 0.2, 0.3, 0.4), "fraction": np.ones((2, 4))}),
    "Cut": (jh.Cut, {"hydrogen": 0.1, "ionic": 0.1, "disulfide": 0.1, "peptide": 1, "rate": 1.0}),
    "Reform": (jh.Reform, {"hydrogen": 1.0, "ionic": 1, "rate": 1.0}),
    "Soften": (jh.Soften, {"factor": 0.4}),
    "Gravity": (jh.Gravity, {"acceleration": X}),
    "TipForce": (jh.TipForce, {"force": X}),
    "Drag": (jh.Drag, {"time": 0.1}),
    "Wind": (jh.Wind, {"blower": O, "target": X, "strength": 1.0, "width": 0.1}),
    "DryingWind": (jh.DryingWind, {"blower": O, "target": X, "strength": 1.0, "drying": 0.1}),
    "HairContact": (jh.HairContact, {"radius": 1e-3, "strength": 2.0, "capacity": 3}),
    "Floor": (jh.Floor, {"height": 0.0, "friction": 0.1, "velocity": X}),
    "Sphere": (jh.Sphere, {"centre": O, "radius": 0.1, "friction": 0.1, **MOTION}),
    "Cylinder": (
        jh.Cylinder,
        {"centre": O, "axis": X, "radius": 0.1, "friction": 0.1, "length": 1.0, **MOTION},
    ),
    "Hold": (jh.Hold, {"part": "root", "clamped": True, **MOTION, "centre": O}),
    "Wound": (jh.Wound, {"diameter": 0.06, "climb": 0.1}),
    "Phase": (jh.Phase, {"name": "a", "duration": 0.1, "effects": (jh.Hold(), jh.Gravity())}),
    "Scene": (jh.Scene, dict(vars(SCENE))),
    "Scene.first": (SCENE.first, {"seconds": 0.005}),
    "Scene.phase": (SCENE.phase, {"name": "only"}),
    "PositionBased": (jh.PositionBased, dict(vars(jh.PositionBased()))),
    "Compliant": (jh.Compliant, dict(vars(jh.Compliant()))),
    "Direct": (jh.Direct, dict(vars(jh.Direct()))),
    "run": (jh.run, {"scene": SCENE}),
    "simulate": (jh.simulate, {"scene": SCENE, "fps": 100.0, "progress": False}),
    "named_leaves": (jh.named_leaves, {"scene": SCENE}),
    "replace_leaves": (jh.replace_leaves, {"scene": SCENE, "values": {"fibre.stiffness": 0.1}}),
    "a leaf": (leaf, {"value": 0.1}),
    "cheapest": (
        jh.cheapest,
        {"error": 0.1, "table": None, "points": 9, "dtype": "float32", "gradient": False},
    ),
    "save": (
        save,
        {"path": "a.npz", "recording": RECORDING, "frame": 0, "color_by": "ionic",
         "overwrite": True, "progress": False},
    ),
    "save a picture": (
        draw,
        {"size": (16, 16), "hairs_per_strand": 1, "color": X, "seed": 0, "view": View(),
         "scale_bar": False},
    ),
    "View": (View, {"azimuth": 1.0, "elevation": 0.1, "target": O, "distance": 1.0}),
    "read_curves": (
        jh.read_curves, {"path": "there.hair", "unit": 1.0, "up": "z", "skip_short": False}
    ),
    "read_strands": (jh.read_strands, {"path": "there.hair", "unit": 1.0, "up": "z"}),
    "write_curves": (
        write, {"path": "a.hair", "curves": CURVES, "unit": 1.0, "up": "z", "overwrite": True}
    ),
    "bed_hair": (scenes.bed_hair, {**SIZE, "dry": True}),
    "blow_dry": (scenes.blow_dry, {**SIZE, "strength": 400.0}),
    "perm": (scenes.perm, {**SIZE, "rod_diameter": 0.06, "treated": True, "disulfide_left": 0.8,
                           "seconds": 0.1, "winding": True}),
    "perm, prepared": (prepared, {"rod_diameter": 0.06, "disulfide_left": 0.8, "seconds": 0.1}),
    "by_name": (scenes.by_name, {"name": "perm"}),
    "treatments.water_set": (treatments.water_set, {**EFFECT, "name": "a"}),
    "treatments.acid_set": (treatments.acid_set, {**EFFECT, "name": "a"}),
    "treatments.perm": (treatments.perm, {**EFFECT, "name": "a", "disulfide_left": 0.8}),
    "treatments.wound_treatment": (
        treatments.wound_treatment, {**EFFECT, "name": "a", "cut": jh.Cut(hydrogen=0)}
    ),
    "treatments.wash": (
        treatments.wash, {"name": "a", "seconds": 0.1, "free": (jh.Hold(),), "unload": True}
    ),
    "Interval": (fitting.Interval, {"low": 0.1, "high": 0.2}),
    "helix": (
        fitting.helix,
        {"diameter": 0.1, "pitch": 0.1, "length": 0.1, "handedness": "right", "align": True},
    ),
    "Shape": (fitting.Shape, {"strands": np.asarray(HAIR.positions), "align": True}),
    "Parameters": (fitting.Parameters, {"scene": SCENE, "free": FREE}),
    "fit": (
        fitting.fit,
        {"scene": SCENE, "targets": TARGETS, "free": FREE, "method": "adam", "steps": 1,
         "tolerance": 0.1, "learning_rate": 0.1, "noise_mm": 0.1, "prior_width": 1.0,
         "prior": {"fibre.stiffness": (0.1, 0.1)}, "start_width": 1.0, "seed": 0, "level": 0.9},
    ),
    "Curl": (fitting.Curl, {"diameter": (0.02, 0.001), "waves": (3.0, 0.1)}),
    "Curvatures": (fitting.Curvatures, {"strands": np.asarray(HAIR.positions), "error": 1.0}),
    "PerStrand": (fitting.PerStrand, {"each": fitting.Positive()}),
    "resampled": (
        fitting.resampled, {"points": CURVES.points, "counts": CURVES.counts, "size": 5}
    ),
    "from_strands": (
        fitting.from_strands,
        {"observed": {"permed": CURVES}, "rod_diameter": 0.005, "strands": 2, "points": 30,
         "weight": False},
    ),
    "fitting.read": (fitting.read, {"path": "there.toml"}),
}  # fmt: skip

ALSO = {
    "length": ("velocity", "radius", "centre", "Floor.height", "points", "Wound.diameter"),
    "points": ("Wound.diameter", "lengths", "counts", "strand ", "rod_diameter"),
    "rod_diameter": ("Wound.diameter", "radius"),
    "diameter": ("Wound.diameter",),
    "duration": ("duration",),
    "seconds": ("duration",),
    "dt": ("duration",),
    "disulfide_left": ("Cut.disulfide",),
    "strength": ("DryingWind.strength",),
    "name": ("phase", "scene"),
    "value": ("fibre.stiffness",),
    "values": ("leaf", "fibre.stiffness"),
    "path": ("output", "there.hair", "existing folder", "ends in"),
    "recording": ("scene",),
    "roots": ("strands.positions",),
    "strands": ("strand 0", "strand 1", "points", "bonds", "fibre", "Wound"),
    "targets": ("phase",),
    "solver": ("fibre",),
    "high": ("low",),
    "low": ("high",),
    "observed": ("state",),
    "counts": ("points", "strand "),
    "table": ("no column",),
    "gradient": ("error",),
    "dtype": ("error",),
}
"""What a message may name instead of the argument."""


class Reached(Exception):
    """A fit was about to begin."""


@pytest.fixture(autouse=True)
def _in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files go to a folder of their own, and fits end before they begin."""
    monkeypatch.chdir(tmp_path)
    jh.write_curves("there.hair", CURVES)

    def reached(*_: Any, **__: Any) -> None:
        raise Reached

    monkeypatch.setattr(sys.modules["fitting.fit"], "Problem", reached)


@pytest.mark.parametrize("name", CASES)
@examples(few=4, many=30)
@given(data=st.data())
def test_refused_or_used(name: str, data: st.DataObject) -> None:
    """A ValueError that names the field, or an object with which a scene can be run."""
    make, valid = CASES[name]
    field = data.draw(st.sampled_from(list(valid)), "field")
    value = data.draw(bad(valid[field]), "value")
    try:
        made = make(**{**valid, field: value})
        scene = scene_with(made)
    except (ValueError, OSError) as error:
        check_refusal(error, (field, *ALSO.get(field, ())))
        return
    except (Reached, jh.NotFinite):
        return
    if scene is None or not small(scene):
        return
    jax.eval_shape(jh.run, scene)
    if plausible(scene) and same_program(scene, scene_with(make(**valid))):
        ends = jh.run(scene)
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(ends))


def scene_with(made: Any) -> jh.Scene | None:
    """A scene in which something that was made is used; None for what is no part of a scene."""
    physical = isinstance(made, jh.TipForce | jh.PhysicalFibre | jh.Compliant | jh.Direct)
    parts: dict[str, Any] = {"strands": HAIR, "phases": SCENE.phases}
    parts["solver"] = jh.Direct() if physical else jh.PositionBased()
    if isinstance(made, jh.Strands):
        return jh.Scene(made, phases=SCENE.phases)
    if isinstance(made, Effect):
        parts["phases"] = (jh.Phase("only", 2 * DT, (made,)),)
    elif isinstance(made, jh.Phase):
        parts["phases"] = (made,)
    elif isinstance(made, tuple) and all(isinstance(x, jh.Phase) for x in made):
        parts["phases"] = made
    elif isinstance(made, jh.Fibre | jh.PhysicalFibre):
        parts["fibre"] = made
    elif isinstance(made, jh.Bonds):
        parts["bonds"] = made
    elif isinstance(made, Solver):
        parts["solver"] = made
    else:
        return made if isinstance(made, jh.Scene) else None
    return jh.Scene(**parts)


def small(scene: jh.Scene) -> bool:
    """It is traced in no time."""
    counts = scene.strands.count * scene.strands.points, getattr(scene.solver, "newton_steps", 1)
    return counts[0] < 1000 and counts[1] < 4


def plausible(scene: jh.Scene) -> bool:
    """Its numbers are such as a world has, and its steps few."""
    sizes = [np.abs(np.asarray(x, float)) for x in jax.tree.leaves(scene)]
    moderate = all(
        np.all((x == 0) | ((x > 1e-6) & (x < 1e6)) | ((x > 1e8) & (x < 1e10))) for x in sizes
    )
    return moderate and 1e-4 < scene.dt < 1 and scene.duration < 100 * scene.dt


def same_program(scene: jh.Scene, other: jh.Scene | None) -> bool:
    """They differ in numbers only, so that one is compiled if the other is."""

    def program(scene: jh.Scene | None) -> Any:
        return jax.tree.structure(scene), [np.shape(x) for x in jax.tree.leaves(scene)]

    return program(scene) == program(other)
