"""Arrays where one number is meant, and extreme values: refused as in test_checks.py."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from test_checks import HAIR, SCENE, Case, O, X, check_message, ones, straight, strands

import fitting
import jaxhair as jh
from jaxhair import scenes, treatments
from jaxhair.__main__ import main
from jaxhair.accuracy import table

NUMBERS_ONLY: list[Case] = [
    (lambda: jh.Drag((0.1, 0.2)), "Drag.time|(2,)|shape ()"),
    (lambda: jh.HairContact(radius=ones(2)), "HairContact.radius|(2,)|shape ()"),
    (lambda: jh.HairContact(strength=ones(2)), "HairContact.strength|(2,)|shape ()"),
    (lambda: jh.Sphere(O, ones(2)), "Sphere.radius|(2,)|shape ()"),
    (lambda: jh.Sphere(O, 1, friction=ones(2)), "Sphere.friction|(2,)|shape ()"),
    (lambda: jh.Cylinder(O, X, ones(2)), "Cylinder.radius|(2,)|shape ()"),
    (lambda: jh.Cylinder(O, X, 1, length=ones(2)), "Cylinder.length|(2,)|shape ()"),
    (lambda: jh.Wind(O, X, ones(2)), "Wind.strength|(2,)|shape ()"),
    (lambda: jh.Wind(O, X, 1.0, ones(2)), "Wind.width|(2,)|shape ()"),
    (lambda: jh.DryingWind(O, X, 1.0, drying=ones(2)), "DryingWind.drying|(2,)|shape ()"),
    (lambda: jh.Cut(hydrogen=ones(2)), "Cut.hydrogen|(2,)|shape ()"),
    (lambda: jh.Reform(ionic=1.0, rate=ones(2)), "Reform.rate|(2,)|shape ()"),
    (lambda: jh.Soften(ones(2)), "Soften.factor|(2,)|shape ()"),
    (lambda: jh.PositionBased(orientation_weight=ones(2)), "solver.orientation_weight|(2,)"),
    (lambda: jh.Direct(frame_inertia=ones(2)), "solver.frame_inertia|(2,)|shape ()"),
]

EXTREME: list[Case] = [
    (lambda: jh.Gravity((0, 0, -1e300)), "Gravity.acceleration|-1e+300 at (2,)|1e+18"),
    (lambda: jh.Gravity((0, 0, 10**400)), "Gravity.acceleration|number"),
    (lambda: jh.Gravity((True, False, True)), "Gravity.acceleration|True|number"),
    (lambda: jh.Drag(10**5000), "Drag.time|int|number"),
    (lambda: jh.Drag(1e-300), "Drag.time|1e-300|above 0, at least 1e-18"),
    (lambda: jh.Drag(np.longdouble(1)), "Drag.time|number"),
    (lambda: jh.Drag(np.ma.masked_array(0.1)), "Drag.time|number"),
    (lambda: jh.Drag(jax.random.key(0)), "Drag.time|number"),
    (lambda: jh.Bonds((1e-39, 0, 0, 0)), "bonds.influence|1e-39|at least 9e-19"),
    (lambda: jh.Bonds([[1], [1, 2]]), "bonds.influence|[[1], [1, 2]]|number"),
    (lambda: jh.Wind(O, (1e-200, 0, 0), 1.0), "Wind.target|differ from the blower"),
    (lambda: jh.Hold(centre=O), "Hold.centre|array([0., 0., 0.])|None without angular_velocity"),
    (lambda: jh.Hold(clamped=np.ones(2)), "Hold.clamped|array|True, False"),  # type: ignore
    (lambda: jh.Floor(velocity=range(2)), "Floor.velocity|(2,)|shape (3,)"),
    (lambda: jh.PositionBased(np.timedelta64(1, "s")), "solver.iterations|timedelta"),  # type: ignore
    (lambda: SCENE.phase(np.array(["a", "b"])), "phase|array|'only'"),  # type: ignore[arg-type]
    (lambda: jh.PositionBased(10**400), "solver.iterations|at most 100000"),
    (lambda: jh.Direct(10**6), "solver.newton_steps|1000000|at most 100"),
    (lambda: strands(positions=np.ones((2, 5, 3), np.float16)), "strands.positions|float16"),
    (lambda: strands(ragged=ones(2)), "strands.ragged|array|True, False"),
    (lambda: straight(points=10**9), "points|1000000000|at most 1000000"),
    (lambda: straight([O] * 200, points=10**6), "points|200 strands|at most 100000000"),
    (lambda: jh.Strands.straight([O], X, length=1, points=2, dtype="int8"), "dtype|'int8'|float32"),
    (lambda: jh.Strands.from_points(HAIR.positions, counts=[[1], [1, 2]]), "counts|number"),
    (lambda: jh.Phase("a" * 1000, 1.0), "phase.name|at most 100 characters"),
    (lambda: jh.Phase("a\nb", 1.0), "phase.name|printable"),
    (lambda: jax.eval_shape(lambda t: jh.Phase("a", t), 1.0), "phase 'a'.duration|not traced"),
    (lambda: replace(SCENE, dt=1e-12), "phase 'only'.duration|scene.dt|1e-12|at most 1e+07"),
    (lambda: jh.run(HAIR), "scene|Strands|of class Scene"),  # type: ignore
    (lambda: jh.simulate(None), "scene|None|of class Scene"),  # type: ignore
    (lambda: jh.save("a.npz", HAIR), "recording|Strands|of class Recording"),  # type: ignore
    (lambda: jh.save(5, HAIR), "output|5|path"),  # type: ignore
    (lambda: jh.named_leaves(HAIR), "scene|Strands|of class Scene"),  # type: ignore
    (lambda: jh.replace_leaves(SCENE, {"fibre.stiffness": "a"}), "fibre.stiffness|'a'|number"),
    (lambda: jh.replace_leaves(SCENE, {"fibre.stiffness": X}), "fibre.stiffness|(3,)|()"),
    (lambda: scenes.by_name("perm", seed="a"), "seed|'a'|whole number of at least 0"),
    (lambda: scenes.by_name("perm", seed=-1), "seed|-1|whole number of at least 0"),
    (lambda: scenes.by_name("perm", contact=None), "contact|None|True, False"),
    (lambda: treatments.perm(rod_diameter=0.1, free=jh.Hold()), "free|Hold|tuple"),
    (lambda: treatments.wound_treatment("a", None, rod_diameter=1), "cut|None|Cut"),  # type: ignore
    (lambda: jh.simulate(SCENE, progress=ones(2)), "progress|array|True, False"),  # type: ignore
    (lambda: fitting.fit(None, {}, {}), "scene|None|Scene"),  # type: ignore[arg-type]
    (lambda: fitting.fit(SCENE, {"only": 1}, {}), "targets['only']|1|Target"),  # type: ignore
    (lambda: fitting.Parameters(SCENE, {"a" * 500: fitting.Positive()}), "free names|one of"),
    (lambda: fitting.from_strands({"permed": 5}), "observed['permed']|5|Curves"),  # type: ignore
    (lambda: fitting.resampled(ones(1, 2), [2], 5), "points|(1, 2)|(strands, points, 3)"),
    (lambda: fitting.resampled(ones(1, 2, 3), [2], 0), "size|0|at least 2"),
    (lambda: fitting.helix(diameter=ones(2)), "helix.diameter|(2,)|shape ()"),
    (lambda: jh.cheapest(0.1, table=5), "table|5|path"),  # type: ignore[arg-type]
    (lambda: jh.read_curves(5), "path|5|path of a file"),  # type: ignore[arg-type]
    (lambda: jh.write_curves("a.hair", None), "curves|None|Curves"),  # type: ignore[arg-type]
    (lambda: jh.Curves.from_list(5), "strands|5|list of arrays"),  # type: ignore[arg-type]
]

ALL = [*NUMBERS_ONLY, *EXTREME]


@pytest.mark.parametrize(("call", "words"), ALL, ids=[words for _, words in ALL])
def test_message(call: Callable[[], Any], words: str) -> None:
    check_message(call, words)


FILES: list[tuple[str, bytes, str]] = [
    ("a.toml", b"a = " + b"[" * 5000, "not TOML"),
    ("a.toml", b"a = " + b"9" * 5000, "not TOML"),
    ("a.toml", b"[hair]\nrod_diameter = 0x" + b"f" * 300 + b"\n[[state]]", "hair: rod_diameter"),
    ("a.toml", b"title = 'a'\n[hair]\n" + b"x" * 5000 + b" = 1\n[[state]]", "is unknown"),
    ("a.csv", b"\xff", "accuracy.csv"),
    ("a.csv", table.PACKAGED.read_bytes() + b"x" * 200_000, "line"),
    ("a.hair", b"HAIR", "header"),
]


@pytest.mark.parametrize(("name", "content", "word"), FILES)
def test_a_file_is_named(name: str, content: bytes, word: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    readers: dict[str, Callable[[Path], Any]] = {
        ".toml": fitting.read,
        ".csv": lambda path: jh.cheapest(0.1, table=path),
        ".hair": jh.read_curves,
    }
    check_message(lambda: readers[path.suffix](path), f"{path}|{word}")


def test_zeros_that_unzip_to_much_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez_compressed(path, positions=np.zeros((700_000, 2, 3), np.float32))
    check_message(lambda: jh.read_curves(path), f"{path}|positions|a file so small")


@pytest.mark.parametrize(
    "arguments", ["simulate perm --output=--", "accuracy --output=--", "simulate perm --solver=--"]
)
def test_two_dashes_are_no_value(arguments: str) -> None:
    assert main(arguments.split()) == 2


def test_a_vector_may_hold_a_traced_number() -> None:
    slope = jax.grad(lambda g: jh.Gravity((0, 0.0, -g)).acceleration.sum())(9.8)
    assert slope == -1
