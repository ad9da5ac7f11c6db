"""What each effect costs: operations against hand counts and unrolled programs, rows that add up,
and an effect that was left out against a scene that never had it. No times are compared."""

import csv
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxhair as jh
from jaxhair import bonds, rods
from jaxhair.__main__ import main
from jaxhair.cost import Part, PhaseCost, SceneCost, measured, measuring, operations, table
from jaxhair.cost.parts import ELASTICITY, ITSELF, REST_SHAPE, plan
from jaxhair.quaternion import from_vector_part
from jaxhair.simulate import advance, phase_end, prepare, start

STRANDS, POINTS = 3, 5
LOOP_COUNTERS = 0.01
"""Of the operations: XLA counts those that count a loop's trips and find its rows too."""

HAIR = jh.Strands.straight(np.eye(3), (0.0, 0.0, -1.0), length=0.12, points=POINTS)
HELD = (jh.Gravity(), jh.Hold())
SOLVERS = [jh.PositionBased(iterations=3, substeps=2), jh.Compliant(iterations=2), jh.Direct()]


def scene_of(*phases: tuple[Any, ...], solver: Any = SOLVERS[0]) -> jh.Scene:
    listed = tuple(jh.Phase(f"phase {i}", 0.1, effects) for i, effects in enumerate(phases))
    return jh.Scene(HAIR, phases=listed, solver=solver)


def bare(scene: jh.Scene) -> tuple[jh.Scene, Any]:
    """The scene as arrays without phases, and its first state."""
    scene = scene.as_arrays()
    return replace(scene, phases=()), start(scene)


def count(function: Callable[..., Any], *arguments: Any) -> float:
    return operations.counted(jax.make_jaxpr(function)(*arguments))


@pytest.fixture(scope="module")
def cost() -> SceneCost:
    """Of a scene whose second phase has an effect that the others never had."""
    floor = (*HELD, jh.Floor(-0.1))
    solver = jh.PositionBased(iterations=1)
    return measured(scene_of(HELD, floor, HELD, solver=solver), steps=1, repeat=2)


def test_operations_of_hand_counted_programs() -> None:
    x = jnp.ones(1000)

    def twice(x: Any, _: Any) -> Any:
        return x * x + 1.5, None

    def nested(x: Any) -> Any:
        return lax.scan(lambda x, _: lax.scan(twice, x, None, length=5), x, None, length=4)[0]

    square = jax.jit(lambda x: x * x)
    assert count(nested, x) == pytest.approx(4 * 5 * 2000, rel=LOOP_COUNTERS)
    assert count(jax.checkpoint(nested), x) == count(nested, x)
    assert count(lambda x: square(x) + square(2 * x), x) == 4000
    assert count(lambda x: (jnp.sqrt(x * x), 3 * x)[1], x) == 1000  # the root is in vain
    assert count(lambda x: x, x) == 0


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)
def test_operations_of_a_step_are_those_of_its_unrolled_program(solver: Any) -> None:
    """XLA's own count of the program without loops. That leaves out what the last round of a loop
    makes for a next one: the compliant solver's multipliers, the direct one's next block."""
    hair = jh.Strands.straight(np.ones((200, 3)), (0.0, 0.0, -1.0), length=0.12, points=POINTS)
    scene, state = bare(jh.Scene(hair, solver=solver))
    effects = (*HELD, jh.Floor(-0.1), jh.Cut(hydrogen=0.5, rate=0.1))
    setup = prepare(scene, effects)
    with jax.disable_jit():  # loops run in Python
        program = jax.make_jaxpr(lambda setup, s: advance(setup, s, 0, steps=1))(setup, state)
    assert not [e for e in program.jaxpr.eqns if e.primitive.name in ("scan", "while")]
    unrolled = jax.jit(jax.extend.core.jaxpr_as_fun(program)).lower(*program.in_avals)
    analysis = unrolled.cost_analysis()
    assert analysis is not None
    found = operations.of_a_step(scene, effects, state)
    last_round = 0.05 if solver.compliant else 0.0
    assert found == pytest.approx(analysis["flops"], rel=LOOP_COUNTERS + last_round)


def test_operations_of_effects_counted_by_hand() -> None:
    """Gravity adds a vector to each point; a floor is dearer, and contact by far the dearest."""
    scene, state = bare(scene_of(solver=jh.PositionBased()))
    parts = plan(scene, (*HELD, jh.Floor(-0.1)), state).operations
    assert parts["Gravity"] == pytest.approx(3 * STRANDS * POINTS, abs=5)
    assert parts["Floor"] > parts["Gravity"]
    contact = plan(scene, (*HELD, jh.HairContact()), state).operations["HairContact"]
    assert contact > 10 * parts["Floor"]


def test_operations_of_the_solver_and_of_the_rest_shape_alone() -> None:
    """What is left out of a step is what these functions take by themselves."""
    scene, state = bare(scene_of(solver=jh.PositionBased()))
    rod, q = prepare(scene, HELD).rod, state.orientations
    parts = plan(scene, HELD, state).operations

    def rest(state: Any, q: Any) -> Any:
        r = rods.darboux(q[:-1], q[1:])
        return from_vector_part(bonds.rest_shape(state.shapes, state.fractions, rod.influence, r))

    def solve(p: Any, q: Any, rest: Any) -> Any:
        return scene.solver.solve(rod, state, p, q, rest, scene.dt)

    alone = count(rest, state, q)
    assert parts[REST_SHAPE] == pytest.approx(alone, rel=0.05)
    alone = count(solve, state.positions, q, q[1:])
    assert parts[ELASTICITY] == pytest.approx(alone, rel=0.05)


@pytest.mark.parametrize("solver", SOLVERS, ids=lambda s: type(s).__name__)
def test_operations_of_parts_add_up(solver: Any) -> None:
    scene, state = bare(scene_of(solver=solver))
    found = plan(scene, (*HELD, jh.Drag(0.1), jh.Floor(-0.1)), state)
    parts = dict(found.operations)
    whole = parts.pop("whole")
    assert set(parts) == set(found.parts)
    assert all(value >= 0 for value in parts.values())
    assert sum(parts.values()) == pytest.approx(whole, rel=0.02)


def test_an_effect_left_out_is_the_program_of_a_scene_that_never_had_it() -> None:
    """The same machine program and operations, so the same time but for noise."""
    scene, state = bare(scene_of(solver=jh.Compliant(iterations=2)))
    never, _ = bare(scene_of(HELD, solver=jh.Compliant(iterations=2)))
    taken_out = plan(scene, (jh.Gravity(), jh.Floor(-0.1), jh.Hold()), state)
    assert taken_out.first == ""
    variant = taken_out.variants["Floor"]
    programs = [
        phase_end.lower(s, effects, state, steps=4).compile().as_text()
        for s, effects in ((variant.scene, variant.effects), (never, HELD))
    ]
    assert programs[0] == programs[1]
    without = taken_out.operations["whole"] - taken_out.operations["Floor"]
    assert without == operations.of_a_step(never, HELD, state)


def test_rows(cost: SceneCost) -> None:
    """Phases with the same kinds of effects are one; each has a row for every part."""
    held, floor = cost.phases
    assert held.phases == ("phase 0", "phase 2")
    assert floor.phases == ("phase 1",)
    assert (held.steps, floor.steps) == (72, 36)
    own = [ITSELF, REST_SHAPE, ELASTICITY]
    assert [part.name for part in held.parts] == [*own, "Gravity", "Hold"]
    assert [part.name for part in floor.parts] == [*own, "Gravity", "Hold", "Floor"]
    for phase in cost.phases:
        assert phase.first == ""
        assert phase.rest == phase.whole.seconds
        assert phase.noise >= 0
        assert all(math.isfinite(part.seconds) for part in phase.parts)
        assert phase.whole.seconds > 0
        assert phase.whole.compile_seconds > 0
        assert isinstance(phase.whole.memory, int)
        assert phase.total_operations == pytest.approx(phase.whole.operations, rel=0.02)
        rest = table.shared(phase)
        total = phase.total_seconds + rest.seconds
        assert total == pytest.approx(phase.whole.seconds)
        assert phase.derivatives == ()
    without = floor.whole.operations - floor.parts[-1].operations
    assert without == held.whole.operations
    assert cost.times_real_time == pytest.approx(cost.scene.duration / cost.seconds)


def test_derivatives() -> None:
    """They have times, memory and no count of operations, which JSON can say too."""
    found = measured(scene_of((jh.Wound(0.06),)), steps=1, repeat=1, gradients=True)
    forward, reverse = found.phases[0].derivatives
    assert (forward.name, reverse.name) == ("forward mode", "reverse mode")
    for part in (forward, reverse):
        assert part.seconds > 0
        assert isinstance(part.memory, int)
        assert math.isnan(part.operations)
    assert "NaN" not in json.dumps(table.as_json(found))
    assert "reverse mode" in str(found)


def test_effects_of_one_class_and_a_pose() -> None:
    """The second Hold has a number; a pose takes the place of solver and velocities."""
    scene, state = bare(scene_of())
    two = plan(scene, (jh.Hold(), jh.Hold("tip")), state)
    assert list(two.parts)[-2:] == ["Hold", "Hold2"]
    wound = plan(scene, (jh.HairContact(), jh.Wound(0.06), jh.Cut(hydrogen=0.0)), state)
    assert list(wound.parts) == [ITSELF, "HairContact", "Wound", "Cut"]
    parts = dict(wound.operations)
    whole = parts.pop("whole")
    assert parts["HairContact"] == 0
    assert parts["Wound"] > 0.5 * whole
    assert parts["Cut"] > 0
    assert sum(parts.values()) == pytest.approx(whole, rel=0.02)


@pytest.mark.parametrize("touching", [True, False])
def test_with_hair_contact_each_phase_is_measured_from_its_own_start(
    touching: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without it phases of the same effects are measured once, from the scene's start."""
    given = []

    def noted(bench: Any, scene: jh.Scene, phases: Any, gradients: bool) -> None:
        given.append(([phase.name for phase in phases], bench.state))

    monkeypatch.setattr(measuring, "_phase_cost", noted)
    effects = (*HELD, jh.HairContact(0.02)) if touching else HELD
    scene = scene_of(effects, effects, solver=jh.PositionBased(iterations=1))
    measured(scene)
    names, states = zip(*given, strict=True)
    assert names == ((["phase 0"], ["phase 1"]) if touching else (["phase 0", "phase 1"],))
    assert np.array_equal(states[0].points, scene.strands.positions)
    if touching:
        end = jh.run(scene)["phase 0"].points
        np.testing.assert_allclose(states[1].points, end, atol=1e-6)
        assert np.max(np.abs(end - states[0].points)) > 1e-4  # it moved


def test_a_scene_that_breaks_is_not_measured() -> None:
    crowded = (*HELD, jh.HairContact(1.0, capacity=1))
    with pytest.raises(jh.NotFinite, match="set it to"):
        measured(scene_of(crowded, HELD), steps=1, repeat=1)


def test_the_dearest_effect_is_left_out_before_the_others() -> None:
    scene, state = bare(jh.scenes.bed_hair(strands=40))
    found = plan(scene, (jh.Gravity(), jh.HairContact(), jh.Hold()), state)
    assert (found.first, found.rest) == ("HairContact", "rest")
    assert found.parts["HairContact"] == ("whole", "rest")
    assert found.parts["Gravity"] == ("rest", "Gravity")
    kinds = {
        name: [type(e).__name__ for e in variant.effects]
        for name, variant in found.variants.items()
    }
    assert kinds["rest"] == ["Gravity", "Hold"]
    assert kinds["Gravity"] == ["Hold"]
    assert kinds["Hold"] == ["Gravity"]
    assert kinds[ITSELF] == []


def phase_cost(*seconds: float, whole: float, first: str = "", rest: float = 0.0) -> PhaseCost:
    parts = tuple(Part(f"part {i}", s, 1.0, None, 0.0) for i, s in enumerate(seconds))
    return PhaseCost(
        ("phase",), 1, Part("whole", whole, 2.0, None, 0.0), parts, first, rest or whole, 0.0
    )


@pytest.mark.parametrize(
    ("phase", "share", "of_rest", "within"),
    [
        (phase_cost(3.0, 2.0, whole=5.0), 1.0, 1.0, True),
        (phase_cost(3.0, 1.3, whole=5.0), 0.86, 0.86, True),
        (phase_cost(3.0, 1.2, whole=5.0), 0.84, 0.84, False),
        (phase_cost(3.0, 2.8, whole=5.0), 1.16, 1.16, False),
        (phase_cost(99.0, 0.5, whole=100.0, first="part 0", rest=1.0), 0.995, 0.5, False),
    ],
)
def test_the_bar_is_shown(phase: PhaseCost, share: float, of_rest: float, within: bool) -> None:
    """A sum that is off by more than 15 per cent is said to be."""
    assert phase.share == pytest.approx(share)
    assert phase.share_of_rest == pytest.approx(of_rest)
    assert phase.adds_up == within
    words = table.adding_up(phase)
    assert f"{share:.0%}" in words
    assert ("NOT within 85% to 115%" in words) != within


COMMAND = "cost bed-hair --strands 2 --points 5 --no-contact --seconds 0.1 --steps 1 --repeat 1"


def test_the_command_prints_json_and_writes_files(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    cost: SceneCost,
) -> None:
    arguments = [*COMMAND.split(), "--output", str(tmp_path / "cost")]
    assert main([*arguments, "--json"]) == 0
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    assert "cost.json" in printed.err
    (phase,) = found["phases"]
    assert phase["phases"] == ["lie down"]
    names = [ITSELF, REST_SHAPE, ELASTICITY, "Gravity", "Drag", "Hold", "Sphere", "Floor"]
    assert [part["name"] for part in phase["parts"]] == names
    total = sum(part["seconds"] for part in phase["parts"])
    assert total + phase["shared_or_rounding"]["seconds"] == pytest.approx(
        phase["whole"]["seconds"]
    )
    assert found["scene"]["strands"] == 2
    assert found["machine"]["jax"] == jax.__version__
    files = {name: (tmp_path / "cost" / name).read_bytes() for name in
             ("cost.json", "cost.csv", "cost.png")}  # fmt: skip
    assert len(list((tmp_path / "cost").iterdir())) == len(files)
    assert json.loads(files["cost.json"]) == found
    lines = list(csv.DictReader(files["cost.csv"].decode().splitlines()))
    assert [line["part"] for line in lines] == [*names, "shared or rounding", "whole"]
    assert float(lines[0]["seconds_per_step"]) == phase["parts"][0]["seconds"]
    assert files["cost.png"].startswith(b"\x89PNG")

    assert main(arguments) == 2  # the files are there
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert "cost.json exists" in error
    assert "--overwrite" in error
    assert all((tmp_path / "cost" / name).read_bytes() == old for name, old in files.items())
    monkeypatch.setattr("jaxhair.cost.command.measured", lambda *_, **__: cost)
    assert main([*arguments, "--overwrite", "--quiet"]) == 0
    printed = capsys.readouterr()
    assert printed.err == ""
    assert "shared or rounding" in printed.out
    assert "times real time" in printed.out
    assert (tmp_path / "cost" / "cost.json").read_bytes() != files["cost.json"]


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("--steps 0", ["steps", "at least 1"]),
        ("--repeat 0", ["repeat", "at least 1"]),
        ("--rod-diameter 2cm", ["--rod-diameter", "bed-hair"]),
        ("--output OUT/file", ["file"]),
    ],
)
def test_the_command_refuses(
    more: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_bytes(b"mine")
    assert main([*COMMAND.split(), *more.replace("OUT", str(tmp_path)).split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    for word in words:
        assert word in error
    assert (tmp_path / "file").read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"scene": scene_of()}, "phases"),
        ({"scene": "perm"}, "scene"),
        ({"steps": 0}, "steps"),
        ({"repeat": 1.5}, "repeat"),
        ({"gradients": 1}, "gradients"),
        ({"progress": None}, "progress"),
    ],
)
def test_measured_refuses(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        measured(**({"scene": scene_of(HELD)} | arguments))


def test_an_interruption_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("jaxhair.cost.command.measured", interrupted)
    assert main([*COMMAND.split(), "--output", str(tmp_path)]) == 130
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "interrupted" in printed.err
    assert not list(tmp_path.iterdir())


def test_help(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["cost", "--help"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    for option in ("--json", "--output", "--steps", "--repeat", "--gradients", "--solver", "perm"):
        assert option in text
