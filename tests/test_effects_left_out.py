"""An effect that a phase does not list leaves no operation behind, and neither does an option that
is None. Programs are compared as lowered text; nothing is compiled here."""

import re
from collections import Counter
from dataclasses import fields, is_dataclass, replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair import bonds, contact, effects, fibre, forces, holding, obstacles
from jaxhair import quaternion as quat
from jaxhair.simulate import prepare, start, step
from jaxhair.strands import BONDS, column

ALWAYS = (jh.Drag(0.1),)
HAIR = jh.Strands.straight(np.eye(3)[:2], (0.0, 0.0, -1.0), length=0.12, points=5)
WET = jh.Bonds(fraction=(0.5, 0.6, 0.7, 0.8))
AXIS, SPIN = (0.0, 1.0, 0.0), (1.0, 2.0, 3.0)

EFFECTS: dict[str, Any] = {
    "Gravity": jh.Gravity(),
    "Drag": jh.Drag(0.3),
    "TipForce": jh.TipForce((0.0, 0.0, -1e-6)),
    "Wind": jh.Wind((0, 0, 0), (1, 0, 0), 9.0),
    "DryingWind": jh.DryingWind((0, 0, 0), (1, 0, 0), 9.0),
    "HairContact": jh.HairContact(),
    "Cut": jh.Cut(hydrogen=0.0),
    "Reform": jh.Reform(hydrogen=1.0),
    "Soften": jh.Soften(0.5),
    "Hold": jh.Hold(),
    "Wound": jh.Wound(0.06),
    "Unloaded": jh.Unloaded(),
    "Floor": jh.Floor(-0.1),
    "Sphere": jh.Sphere((0, 0, -0.1), 0.05),
    "Cylinder": jh.Cylinder((0, 0, -0.1), AXIS, 0.05),
}


def scene_of(**phases: tuple) -> jh.Scene:
    steps = tuple(jh.Phase(name, 0.1, effects) for name, effects in phases.items())
    return jh.Scene(HAIR, jh.PhysicalFibre(), WET, steps)


def lowered(scene: jh.Scene, phase: str) -> str:
    """The program of a step of a phase, with all that is prepared for it, as lowered text."""
    scene = scene.as_arrays()
    effects = scene.phase(phase).effects

    def whole(scene: jh.Scene, effects: Any, state: jh.State, time: jax.Array) -> jh.State:
        return step(prepare(scene, effects), state, time)

    bare = replace(scene, phases=())
    return jax.jit(whole).lower(bare, effects, start(scene), jnp.zeros(())).as_text()


def operations(*effects: Any) -> Counter[str]:
    """How often each operation occurs in the program of a step with these effects."""
    text = lowered(scene_of(only=(*ALWAYS, *effects)), "only")
    return Counter(re.findall(r"(?<!#)\b(?:stablehlo|func|chlo)\.[\w.]+", text))


def jaxpr(*effects: Any) -> Any:
    """The traced step with these effects, and its State of inputs and of outputs."""
    scene = scene_of(only=(*ALWAYS, *effects)).as_arrays()
    setup, state = prepare(scene, scene.phases[0].effects), start(scene)
    closed = jax.make_jaxpr(lambda state: step(setup, state, jnp.zeros(())))(state)
    tree = jax.tree.structure(state)
    return (
        closed.jaxpr,
        jax.tree.unflatten(tree, closed.jaxpr.invars),
        jax.tree.unflatten(tree, closed.jaxpr.outvars),
    )


@cache
def never() -> str:
    """The program of a scene that never had any effect but ALWAYS."""
    return lowered(scene_of(only=ALWAYS), "only")


def test_the_table_names_every_effect() -> None:
    modules = (bonds, contact, fibre, forces, holding, obstacles)
    known = {
        name
        for module in modules
        for name, cls in vars(module).items()
        if isinstance(cls, type) and issubclass(cls, effects.Effect) and is_dataclass(cls)
    }
    assert known == set(EFFECTS)
    assert all(type(effect).__name__ == name for name, effect in EFFECTS.items())


@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_that_was_taken_out(name: str) -> None:
    """The scene without it, and the phases that never had it, are the scene that never had it."""
    scene = scene_of(before=ALWAYS, during=(*ALWAYS, EFFECTS[name]), after=ALWAYS)
    assert lowered(scene, "during") != never()
    assert lowered(scene, "after") == never()
    phases = tuple(replace(phase, effects=ALWAYS) for phase in scene.phases)
    assert lowered(replace(scene, phases=phases), "during") == never()


def test_no_effect_at_all() -> None:
    """Less is traced than with any effect, and no bond changes."""
    least = lowered(scene_of(only=()), "only").count("\n")
    assert least < never().count("\n")


@pytest.mark.parametrize("name", ["Hold", "Floor", "Sphere", "Cylinder", "Cut", "Reform"])
def test_an_option_that_is_none_is_no_leaf(name: str) -> None:
    """A number that is not given is not an input of the program."""
    effect = EFFECTS[name]
    given = [f.name for f in fields(effect) if not f.metadata.get("static")]
    given = [field for field in given if getattr(effect, field) is not None]
    assert len(jax.tree.leaves(effect)) == len(given) < len(fields(effect))


def first_row(exists: jax.Array) -> jax.Array:
    none = jnp.zeros_like(exists)
    return jnp.concatenate([~none[:1], none[1:]])


class PlainHold(effects.HoldingEffect):
    """Roots held still, written without options."""

    def held_points(self, rod: Any) -> jax.Array:
        return first_row(rod.point_exists())

    def held_edges(self, rod: Any) -> jax.Array:
        return first_row(rod.edge_exists())

    def moved(self, rod: Any, positions: Any, orientations: Any, time: Any, dt: float) -> Any:
        return positions, orientations


class PlainObstacle(effects.PositionEffect):
    """An obstacle that stands still, written without options."""

    def projected(self, rod: Any, positions: Any, previous: Any, time: Any, dt: float) -> Any:
        distance, normal = self.surface(positions - column(self.centre, positions))
        depth = jnp.maximum(-distance, 0)
        outside = positions + depth * normal
        slip = outside - previous
        slip = slip - quat.dot(slip, normal) * normal
        size = quat.safe_norm(slip)
        stop = self.friction * depth
        sticks = size <= stop
        left = jnp.where(sticks, 0, 1 - stop / jnp.where(sticks, 1, size))
        slowed = outside - (1 - left) * slip
        return jnp.where((depth > 0) & (rod.point_weights > 0), slowed, positions)


class PlainCut(effects.BondEffect):
    """Hydrogen bonds cut to a fraction, written without options."""

    kinds_cut, kinds_formed = ("hydrogen",), ()

    def fraction_change(self, kind: str, fraction: Any, rod: Any, state: Any, dt: float) -> Any:
        return self.hydrogen - fraction


def plain(cls: type, base: type, *names: str) -> type:
    """A pytree class with the numbers of `base` but without its options."""
    body = {"__annotations__": dict.fromkeys(names, Any)}
    if base is not object:
        body["surface"] = base.surface
    return jh.pytree(type(f"Plain{base.__name__}", (cls,), body))


PLAIN: dict[str, tuple[Any, Any]] = {
    "Hold": (jh.Hold(), jh.pytree(PlainHold)()),
    "Cut": (jh.Cut(hydrogen=0.25), plain(PlainCut, object, "hydrogen")(0.25)),
    "Sphere": (
        jh.Sphere((0.0, 0, -0.1), 0.05, 0.3),
        plain(PlainObstacle, jh.Sphere, "centre", "radius", "friction")((0.0, 0, -0.1), 0.05, 0.3),
    ),
    "Cylinder": (
        jh.Cylinder((0.0, 0, -0.1), AXIS, 0.05, 0.3),
        plain(PlainObstacle, jh.Cylinder, "centre", "axis", "radius", "friction", "length")(
            (0.0, 0, -0.1), AXIS, 0.05, 0.3, None
        ),
    ),
}


@pytest.mark.parametrize("name", PLAIN)
def test_an_option_that_is_none_leaves_no_operation(name: str) -> None:
    """The same operations as an effect that knows no such option, and fewer than with it."""
    effect, reference = PLAIN[name]
    assert operations(effect) == operations(reference)


MOTIONS = {
    "Hold.velocity": (jh.Hold(), {"velocity": SPIN}),
    "Hold.angular_velocity": (jh.Hold(), {"angular_velocity": SPIN}),
    "Floor.velocity": (EFFECTS["Floor"], {"velocity": SPIN}),
    "Sphere.velocity": (EFFECTS["Sphere"], {"velocity": SPIN}),
    "Sphere.angular_velocity": (EFFECTS["Sphere"], {"angular_velocity": SPIN}),
    "Cylinder.velocity": (EFFECTS["Cylinder"], {"velocity": SPIN}),
    "Cylinder.angular_velocity": (EFFECTS["Cylinder"], {"angular_velocity": SPIN}),
    "Cylinder.length": (EFFECTS["Cylinder"], {"length": 0.1}),
    "Cut.rate": (EFFECTS["Cut"], {"rate": 1.0}),
    "Cut.ionic": (EFFECTS["Cut"], {"ionic": 1.0}),
    "Reform.rate": (EFFECTS["Reform"], {"rate": 1.0}),
    "Reform.ionic": (EFFECTS["Reform"], {"ionic": 1.0}),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_an_option_that_is_given_adds_operations(name: str) -> None:
    effect, option = MOTIONS[name]
    without, with_it = operations(effect), operations(replace(effect, **option))
    assert with_it.total() > without.total()


@pytest.mark.parametrize("effect", [jh.Cut, jh.Reform])
def test_only_the_named_kinds_are_updated(effect: Any) -> None:
    """Each kind that is named takes as many operations more as the one before."""
    named = [dict.fromkeys(BONDS[:n], 0.5) for n in range(1, len(BONDS) + 1)]
    counts = [operations(effect(**kinds)).total() for kinds in named]
    more = np.diff(counts)
    assert more.min() > 0
    assert np.ptp(more[:-1]) <= 2  # with the last, no kind has to be taken over
    assert operations().total() < counts[0]


NO_BONDS = [n for n, e in EFFECTS.items() if not isinstance(e, effects.BondEffect)]


@pytest.mark.parametrize("name", NO_BONDS)
def test_bonds_pass_through_untouched(name: str) -> None:
    """Without a bond effect, shapes and fractions that come out are the variables that went in."""
    _, before, after = jaxpr(EFFECTS[name])
    assert after.shapes is before.shapes
    assert after.fractions is before.fractions


def test_what_is_cut_leaves_remembered_shapes_untouched() -> None:
    _, before, after = jaxpr(jh.Cut(hydrogen=0.0))
    assert after.shapes is before.shapes
    assert after.fractions is not before.fractions


@pytest.mark.parametrize("listed", [(), (jh.Hold(), jh.Gravity()), (jh.Cut(hydrogen=0.0),)])
def test_nothing_is_traced_in_vain(listed: tuple) -> None:
    """Every operation that is traced is needed by the step's result."""
    traced, _, _ = jaxpr(*listed)
    used, in_vain = {id(v) for v in traced.outvars}, []
    for equation in reversed(traced.eqns):
        if any(id(v) in used for v in equation.outvars):
            used |= {id(v) for v in equation.invars}
        else:
            in_vain.append(str(equation.primitive))
    assert not in_vain
