"""Measured curls from a text file (TOML): the scenes that they were made in, and the targets.

A file has a table [hair] and one or more [[state]]; or several experiments on the same hair, each
an [[experiment]] with a name, what differs of [hair], how the hair was looked at (see `Seen`), and
its own [[experiment.state]].
"""

import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from fitting.curls import MEASURES, Curl
from fitting.targets import Helix, Target
from jaxhair import (
    Bonds,
    Cut,
    Direct,
    Drag,
    Gravity,
    Hold,
    Phase,
    PhysicalFibre,
    Scene,
    Strands,
    TipForce,
    Unloaded,
    check,
    treatments,
)
from jaxhair.arrays import contents, reason

FREE = (Hold(), Drag(0.1))
"""Curls are compared without weight: only their diameters were measured."""

CLIMB = 0.15
"""Angle of the winding [rad], so that turns of a curl stand beside each other."""

BRIEF: dict[str, Any] = {"seconds": 0.25, "free": FREE}

TREATMENTS: dict[Any, Callable[..., tuple[Phase, ...]]] = {
    "water set": treatments.water_set,
    "acid set": treatments.acid_set,
    "perm": treatments.perm,
}
HANGING: dict[str, Any] = {"seconds": 1.0, "free": treatments.HANGING}

FILE_KEYS = {"title", "hair", "state", "experiment"}
HAIR_KEYS = {"natural_curl_diameter", "rod_diameter", "length", "points"}
SEEN_KEYS = {"weight", "tip_mass", "hydrogen_left"}
EXPERIMENT_KEYS = {"name", "state"} | SEEN_KEYS | HAIR_KEYS
CURL_KEYS = {f"curl_{name}" for name in MEASURES}
STATE_KEYS = {
    "name",
    "treatment",
    "set",
    "wave_efficiency",
    "error",
    "conditions",
    "source",
    "after_wash",
    *CURL_KEYS,
    *(f"{key}_error" for key in CURL_KEYS),
}


@dataclass(frozen=True)
class Seen:
    """How the states of an experiment were looked at.

    Arguments:
        weight: the hair hangs under its weight, for a second.
        tip_mass: of a load at each hair's tip then [kg]. All experiments of a file that has one
            are of hair with the stiffness and weight of real hair, see `PhysicalFibre`.
        hydrogen_left: fraction of hydrogen bonds that damp air leaves. Which humidity leaves how
            many is not known here; free "phases.*, damp.Cut.hydrogen" to find it.
    """

    weight: bool = False
    tip_mass: float | None = None
    hydrogen_left: float | None = None

    @classmethod
    def of(cls, table: dict[str, Any], where: str) -> "Seen":
        """From an experiment's table. Raises ValueError for a wrong entry."""
        seen = cls(**{key: table[key] for key in SEEN_KEYS if key in table})
        check.flag(f"{where}: weight", seen.weight)
        if seen.tip_mass is not None:
            check.constant(f"{where}: tip_mass", seen.tip_mass)
            if not seen.weight:
                wanted = "it must be left out where weight is not true"
                raise ValueError(f"{where}: tip_mass is {seen.tip_mass}; {wanted}")
        if seen.hydrogen_left is not None:
            check.fraction(f"{where}: hydrogen_left", seen.hydrogen_left)
        return seen

    def phases(self, made: list[Phase]) -> list[Phase]:
        """A state's phases, of which the last is looked at, in these circumstances."""
        last = made[-1]
        damp: list[Phase] = []
        if self.hydrogen_left is not None:
            effects = (Unloaded(), Cut(hydrogen=self.hydrogen_left))
            damp = [Phase(f"{last.name}, damp", treatments.AT_ONCE, effects)]
        if self.tip_mass is not None:
            load = TipForce(self.tip_mass * np.asarray(Gravity().acceleration))
            last = replace(last, effects=(*last.effects, load))
        return [*made[:-1], *damp, last]


@dataclass(frozen=True)
class Measured:
    """Scenes that repeat experiments, and what was measured in them: arguments of `fitting.fit`.

    A single scene and its targets by state; or several by the experiment's name.
    """

    title: str
    scene: Scene | dict[str, Scene]
    targets: dict[str, Any]

    @property
    def states(self) -> list[str]:
        """Names of the states, as in `Fit`."""
        if isinstance(self.scene, Scene):
            return list(self.targets)
        return [f"{name}/{state}" for name, states in self.targets.items() for state in states]


def packaged() -> Measured:
    """The curls that come with the package, see data/measured_curls.toml for their sources."""
    text = files("fitting").joinpath("data/measured_curls.toml").read_text(encoding="utf-8")
    return from_text(text, name="measured_curls.toml")


def read(path: str | Path) -> Measured:
    """The curls of a file of the same form. Raises ValueError for a wrong or missing entry."""
    file = check.path("path", path)
    try:
        text = contents(file).decode("utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not TOML: {error}") from error
    return from_text(text, name=str(file))


def from_text(text: str, *, name: str) -> Measured:
    """As `read`, from the file's text; `name` stands in error messages."""
    try:
        table = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # of numbers and lists too large for Python, too
        raise ValueError(f"{name} is not TOML: {reason(error)}") from error
    try:
        return _measured(table, name)
    except ValueError as error:
        raise ValueError(f"{name}, {error}") from error


def _measured(table: dict[str, Any], name: str) -> Measured:
    hair = table.get("hair")
    states, experiments = table.get("state"), table.get("experiment")
    listed = states if experiments is None else experiments
    whole = isinstance(hair, dict) and isinstance(listed, list) and listed
    if not whole or (states is not None and experiments is not None):
        raise ValueError(
            "content: it must have a table [hair] and one or more [[state]] or [[experiment]]"
        )
    assert isinstance(hair, dict)
    assert isinstance(listed, list)
    _check_keys(table, FILE_KEYS, "content")
    _check_keys(hair, HAIR_KEYS, "hair")
    title = table.get("title", name)
    check.instance("title", title, str)
    if experiments is None:
        return Measured(title, *_experiment(hair, listed, "", Seen(), {}))
    scenes: dict[str, Scene] = {}
    targets: dict[str, dict[str, Target]] = {}
    loaded = any(isinstance(table, dict) and "tip_mass" in table for table in listed)
    # one hair, one model of it: a load in newtons needs moduli, and more than one Newton step
    model: dict[str, Any] = {}
    if loaded:
        model = {"fibre": PhysicalFibre(), "solver": Direct(newton_steps=2)}
    for number, experiment in enumerate(listed):
        where = f"experiment {number + 1}"
        if not isinstance(experiment, dict):
            raise ValueError(f"{where}: it is {check.short(experiment)}; it must be a table")
        _check_keys(experiment, EXPERIMENT_KEYS, where)
        label = experiment.get("name", "")
        check.text(f"{where}: name", label)
        seen = Seen.of(experiment, where)
        if "/" in label or label in scenes:
            wanted = "it must have no '/', and differ from others"
            raise ValueError(f"{where}: name is {label!r}; {wanted}")
        own = experiment.get("state")
        if not isinstance(own, list) or not own:
            raise ValueError(f"{where}: it must have one or more [[experiment.state]]")
        changed = {**hair, **{key: experiment[key] for key in HAIR_KEYS if key in experiment}}
        scenes[label], targets[label] = _experiment(changed, own, f"{where}, ", seen, model)
    return Measured(title, scenes, targets)


def _experiment(
    hair: dict[str, Any], states: list[Any], where: str, seen: Seen, model: dict[str, Any]
) -> tuple[Scene, dict[str, Target]]:
    """The scene of an experiment, all states one after the other, and its targets."""
    rod = _number(hair, "rod_diameter", f"{where}hair")
    length = _number(hair, "length", f"{where}hair")
    points = hair.get("points", 25)
    check.whole(f"{where}hair: points", points, least=3, most=1000)
    natural = 0.0  # as all curls here, by the inverse of its diameter [1/m]
    if "natural_curl_diameter" in hair:
        natural = 1 / _number(hair, "natural_curl_diameter", f"{where}hair")
    rest = HANGING if seen.weight else BRIEF
    phases: list[Phase] = []
    targets: dict[str, Target] = {}
    for number, state in enumerate(states):
        at = f"{where}state {number + 1}"
        label, made = _phases(state, rod, rest, at)
        if label in targets:
            raise ValueError(f"{at}: name is {label!r} again; names must differ")
        phases += treatments.wash(name=f"{label}, wash before", **rest) if number else ()
        phases += seen.phases(made)
        targets[label] = _target(state, rod, natural, at)
    equal = Bonds((0.25, 0.25, 0.25, 0.25))
    try:
        strands = curly(length, points, natural)
        return Scene(strands, bonds=equal, phases=tuple(phases), **model), targets
    except ValueError as error:
        raise ValueError(f"{where}hair: {error}") from error


def _target(state: dict[str, Any], rod: float, natural: float, where: str) -> Target:
    """What was measured: numbers of the curl with their errors, or its set."""
    given = sorted(CURL_KEYS & state.keys())
    if not given:
        diameter = 1 / _inverse_diameter(state, 1 / rod, natural, where)
        return Helix(diameter, math.pi * diameter * math.tan(CLIMB))
    numbers = {}
    for key in given:
        value = _number(state, key, where)
        error = _number(state, f"{key}_error", where)
        numbers[key.removeprefix("curl_")] = (value, error)
    return Curl(**numbers)


def curly(length: float, points: int, inverse_diameter: float) -> Strands:
    """One strand that starts straight down and naturally curls, with 1 / diameter [1/m]."""
    hair = Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=length, points=points)
    sine = length / (points - 1) * math.cos(CLIMB) * inverse_diameter
    if not 0 <= sine < 1:
        raise ValueError(
            f"1 / diameter is {inverse_diameter}; edges must be shorter than diameters"
        )
    shape = sine * jnp.asarray([math.cos(CLIMB), 0.0, math.sin(CLIMB)], hair.lengths.dtype)
    return replace(hair, natural_shape=jnp.broadcast_to(shape, hair.natural_shape.shape))


def _phases(state: Any, rod: float, rest: dict[str, Any], where: str) -> tuple[str, list[Phase]]:
    """The state's name and the phases that lead to it, on the hair as it is then."""
    if not isinstance(state, dict):
        raise ValueError(f"{where}: it is {check.short(state)}; it must be a table")
    _check_keys(state, STATE_KEYS, where)
    name, treatment = state.get("name", ""), state.get("treatment")
    washed = state.get("after_wash", False)
    check.text(f"{where}: name", name)
    check.choice(f"{where}: treatment", treatment, tuple(TREATMENTS))
    make = TREATMENTS[treatment]
    check.flag(f"{where}: after_wash", washed)
    label = f"{name}, before" if washed else name
    phases = list(make(name=label, rod_diameter=rod, climb=CLIMB, **rest))
    if washed:
        phases += treatments.wash(name=name, **rest)
    return name, phases


def _inverse_diameter(state: dict[str, Any], rod: float, natural: float, where: str) -> float:
    """1 / diameter of the measured curl, from those of the rod and of the natural hair [1/m]."""
    given = [key for key in ("set", "wave_efficiency") if key in state]
    if len(given) != 1:
        raise ValueError(f"{where}: it must have one of set and wave_efficiency, and has {given}")
    value = _number(state, given[0], where)
    if value >= 1:
        raise ValueError(f"{where}: {given[0]} is {value}; it must be below 1")
    return value * rod if given[0] == "wave_efficiency" else natural + value * (rod - natural)


def _check_keys(table: dict[str, Any], known: set[str], where: str) -> None:
    if unknown := set(table) - known:
        shown = check.short(sorted(unknown)[0])
        raise ValueError(f"{where}: {shown} is unknown; known are {check.listed(sorted(known))}")


def _number(table: dict[str, Any], key: str, where: str) -> float:
    return check.constant(f"{where}: {key}", table.get(key))
