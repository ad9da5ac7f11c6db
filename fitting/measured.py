"""Measured curls from a text file (TOML): the scene that they were made in, and the targets."""

import math
import tomllib
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from fitting.targets import Helix, Target
from jaxhair import Bonds, Drag, Hold, Phase, Scene, Strands, treatments

FREE = (Hold(), Drag(0.1))
"""Curls are compared without weight: only their diameters were measured."""

CLIMB = 0.15
"""Angle of the winding [rad], so that turns of a curl stand beside each other."""

BRIEF: dict[str, Any] = {"seconds": 0.25, "free": FREE}

TREATMENTS = ("water set", "acid set", "perm")
FILE_KEYS = {"title", "hair", "state"}
HAIR_KEYS = {"natural_curl_diameter", "rod_diameter", "length", "points"}
STATE_KEYS = {
    "name",
    "treatment",
    "set",
    "wave_efficiency",
    "error",
    "conditions",
    "source",
    "after_wash",
}


@dataclass(frozen=True)
class Measured:
    """A scene that repeats an experiment, and the curls that were measured in it."""

    title: str
    scene: Scene
    targets: dict[str, Target]


def packaged() -> Measured:
    """The curls that come with the package, see data/measured_curls.toml for their sources."""
    text = files("fitting").joinpath("data/measured_curls.toml").read_text(encoding="utf-8")
    return from_text(text, name="measured_curls.toml")


def read(path: str | Path) -> Measured:
    """The curls of a file of the same form. Raises ValueError for a wrong or missing entry."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not TOML: {error}") from error
    return from_text(text, name=str(path))


def from_text(text: str, *, name: str) -> Measured:
    """As `read`, from the file's text; `name` stands in error messages."""
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ValueError(f"{name} is not TOML: {error}") from error
    hair = table.get("hair")
    states = table.get("state")
    if not isinstance(hair, dict) or not isinstance(states, list) or not states:
        raise ValueError(f"{name} must have a table [hair] and one or more [[state]]")
    _check_keys(table, FILE_KEYS, name)
    _check_keys(hair, HAIR_KEYS, f"{name}, hair")
    rod = _number(hair, "rod_diameter", f"{name}, hair")
    length = _number(hair, "length", f"{name}, hair")
    points = hair.get("points", 25)
    if not isinstance(points, int) or not 3 <= points <= 1000:
        raise ValueError(f"{name}, hair: points is {points!r}; it must be in [3, 1000]")
    natural = 0.0  # as all curls here, by the inverse of its diameter [1/m]
    if "natural_curl_diameter" in hair:
        natural = 1 / _number(hair, "natural_curl_diameter", f"{name}, hair")
    phases: list[Phase] = []
    targets: dict[str, Target] = {}
    for number, state in enumerate(states):
        where = f"{name}, state {number + 1}"
        label, made = _phases(state, rod, where)
        if label in targets:
            raise ValueError(f"{where}: name is {label!r} again; names must differ")
        phases += treatments.wash(name=f"{label}, wash before", **BRIEF) if number else ()
        phases += made
        diameter = 1 / _inverse_diameter(state, 1 / rod, natural, where)
        targets[label] = Helix(diameter, math.pi * diameter * math.tan(CLIMB))
    equal = Bonds((0.25, 0.25, 0.25, 0.25))
    try:
        scene = Scene(curly(length, points, natural), bonds=equal, phases=tuple(phases))
    except ValueError as error:
        raise ValueError(f"{name}, hair: {error}") from error
    return Measured(str(table.get("title", name)), scene, targets)


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


def _phases(state: Any, rod: float, where: str) -> tuple[str, list[Phase]]:
    """The state's name and the phases that lead to it, on the hair as it is then."""
    if not isinstance(state, dict):
        raise ValueError(f"{where}: it is {state!r}; it must be a table")
    _check_keys(state, STATE_KEYS, where)
    name, treatment = state.get("name"), state.get("treatment")
    washed = state.get("after_wash", False)
    if not isinstance(name, str) or not name or "." in name:
        raise ValueError(f"{where}: name is {name!r}; it must be a text without '.'")
    if treatment not in TREATMENTS:
        raise ValueError(f"{where}: treatment is {treatment!r}; it must be one of {TREATMENTS}")
    make = {
        "water set": treatments.water_set,
        "acid set": treatments.acid_set,
        "perm": treatments.perm,
    }[treatment]
    if not isinstance(washed, bool):
        raise ValueError(f"{where}: after_wash is {washed!r}; it must be true or false")
    label = f"{name}, before" if washed else name
    phases = list(make(name=label, rod_diameter=rod, climb=CLIMB, **BRIEF))
    if washed:
        phases += treatments.wash(name=name, **BRIEF)
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
        raise ValueError(f"{where}: {sorted(unknown)[0]!r} is unknown; known are {sorted(known)}")


def _number(table: dict[str, Any], key: str, where: str) -> float:
    value = table.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value < math.inf:
        raise ValueError(f"{where}: {key} is {value!r}; it must be a number above 0")
    return float(value)
