"""Which numbers of a scene a fit may change, and within what bounds.

A constraint maps free numbers, in which the optimiser moves without bounds, to admissible values.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxhair import Scene, check, named_leaves, replace_leaves
from jaxhair.strands import BONDS


class Constraint:
    """A set of admissible values."""

    @abstractmethod
    def free(self, value: np.ndarray) -> np.ndarray:
        """Free numbers of an admissible value, shape (n,). Raises ValueError for another value."""

    @abstractmethod
    def value(self, free: Array, start: np.ndarray) -> Array:
        """The value for free numbers, of the shape of the starting value."""


@dataclass(frozen=True)
class Simplex(Constraint):
    """Numbers of at least 0 whose sum stays: x_j = log(v_j / v_last). For influences."""

    def free(self, value: np.ndarray) -> np.ndarray:
        if value.ndim != 1 or np.any(value < 0) or value.sum() <= 0:
            raise ValueError(f"value is {check.short(value)}; it must be a list of numbers >= 0")
        positive = np.maximum(value, 1e-6 * value.sum())
        return np.log(positive[:-1] / positive[-1])

    def value(self, free: Array, start: np.ndarray) -> Array:
        whole = jnp.sum(jnp.asarray(start, free.dtype))
        return jax.nn.softmax(jnp.append(free, jnp.zeros(1, free.dtype))) * whole


@dataclass(frozen=True)
class Positive(Constraint):
    """Numbers above 0: v = exp(x)."""

    def free(self, value: np.ndarray) -> np.ndarray:
        if np.any(value <= 0):
            raise ValueError(f"value is {check.short(value)}; it must be above 0")
        return np.log(value.ravel())

    def value(self, free: Array, start: np.ndarray) -> Array:
        return jnp.exp(free).reshape(start.shape)


@dataclass(frozen=True)
class Interval(Constraint):
    """Numbers between two bounds: v = low + (high - low) / (1 + exp(-x))."""

    low: float
    high: float

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            check.number(name, getattr(self, name))
            object.__setattr__(self, name, float(getattr(self, name)))
        if not self.low < self.high:
            raise ValueError(f"high is {self.high}; it must be above low, {self.low}")

    def free(self, value: np.ndarray) -> np.ndarray:
        if np.any((value < self.low) | (value > self.high)):
            wanted = f"it must be in [{self.low}, {self.high}]"
            raise ValueError(f"value is {check.short(value)}; {wanted}")
        share = np.clip((value.ravel() - self.low) / (self.high - self.low), 1e-6, 1 - 1e-6)
        return np.log(share / (1 - share))

    def value(self, free: Array, start: np.ndarray) -> Array:
        inside = self.low + (self.high - self.low) * jax.nn.sigmoid(free)
        # rounding may lead past the upper bound
        return jnp.minimum(inside, self.high).reshape(start.shape)


@dataclass(frozen=True)
class Unbounded(Constraint):
    """Any numbers: v = x."""

    def free(self, value: np.ndarray) -> np.ndarray:
        return value.ravel()

    def value(self, free: Array, start: np.ndarray) -> Array:
        return free.reshape(start.shape)


@dataclass(frozen=True)
class PerStrand(Constraint):
    """A value of its own for every strand, each in the same set. For leaves that may have a first
    axis of strands: "fibre.peeling_rate", "bonds.influence", "bonds.fraction" and the like.

    For more than a few strands use `fit_each`, which is faster by as many times.
    """

    each: Constraint

    def __post_init__(self) -> None:
        check.instance("each", self.each, Constraint)

    def free(self, value: np.ndarray) -> np.ndarray:
        return np.concatenate([self.each.free(one) for one in value])

    def value(self, free: Array, start: np.ndarray) -> Array:
        rows = free.reshape(len(start), -1)
        return jnp.stack([self.each.value(*row) for row in zip(rows, start, strict=True)])


@dataclass(frozen=True)
class PerExperiment(Constraint):
    """A value of its own in every experiment, each in the same set."""

    each: Constraint

    def __post_init__(self) -> None:
        check.instance("each", self.each, Constraint)

    def free(self, value: np.ndarray) -> np.ndarray:
        return self.each.free(value)

    def value(self, free: Array, start: np.ndarray) -> Array:
        return self.each.value(free, start)


def labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """A name for every single number of a parameter, in the order of `numpy.ravel`."""
    if shape == ():
        return [name]
    last: tuple[Any, ...] = tuple(range(shape[-1]))
    if name.endswith(("bonds.influence", "bonds.fraction")) and shape[-1] == len(BONDS):
        last = BONDS
    places = ((*place, end) for place in np.ndindex(shape[:-1]) for end in last)
    return [f"{name}[{','.join(map(str, place))}]" for place in places]


@dataclass(frozen=True)
class Parameter:
    """Numbers that are fitted, and where they stand.

    Arguments:
        name: that it is shown by. constraint: on its value. start: value to start from.
        places: experiment and leaf that the value is put into.
    """

    name: str
    constraint: Constraint
    start: np.ndarray
    places: tuple[tuple[str, str], ...]

    @property
    def size(self) -> int:
        """How many free numbers it has."""
        return int(self.constraint.free(self.start).size)


class Parameters:
    """The freed numbers of scenes, packed into one vector and put back.

    Arguments:
        scene: with the values to start from: one, or several experiments by their names.
        free: from a leaf's name (see `jaxhair.named_leaves`) to its constraint. A name with `*`
            frees all leaves that match as one shared parameter, such as
            "phases.*.Wound.diameter"; they must start with the same value. In several experiments
            the leaves of all that have them are shared, unless the constraint is `PerExperiment`;
            "experiment/leaf" frees those of one.

    Raises ValueError for a name that matches nothing, leaves of one name that differ, or a start
    outside its constraint.
    """

    def __init__(self, scene: Scene | Mapping[str, Scene], free: Mapping[str, Constraint]) -> None:
        self.scenes = by_name(scene)
        check.instance("free", free, Mapping)
        if not free:
            raise ValueError("free is empty; it must name at least one leaf of the scene")
        leaves = {name: named_leaves(scene) for name, scene in self.scenes.items()}
        self.each: list[Parameter] = []
        for name, constraint in free.items():
            if not isinstance(constraint, Constraint):
                wanted = "it must be a constraint"
                shown = f"free[{check.short(name)}]"
                raise ValueError(f"{shown} is {check.short(constraint)}; {wanted}")
            places = _places(name, leaves)
            if isinstance(constraint, PerExperiment):
                for experiment in dict.fromkeys(place[0] for place in places):
                    own = [place for place in places if place[0] == experiment]
                    shown = f"{experiment}/{name}" if experiment else name
                    self.each.append(self._parameter(shown, constraint.each, own, leaves))
            else:
                self.each.append(self._parameter(name, constraint, places, leaves))
        taken: set[tuple[str, str]] = set()
        for parameter in self.each:
            if twice := taken.intersection(parameter.places):
                leaf = next(iter(twice))[1]
                raise ValueError(f"free names {leaf!r} twice; it must be freed once")
            taken.update(parameter.places)

    def _parameter(
        self,
        name: str,
        constraint: Constraint,
        places: Sequence[tuple[str, str]],
        leaves: Mapping[str, Mapping[str, Any]],
    ) -> Parameter:
        shown = check.short(name)
        values = []
        for experiment, leaf in places:
            value = np.asarray(leaves[experiment][leaf], float)
            if isinstance(constraint, PerStrand):
                scene = self.scenes[experiment]
                value = _for_strands(value, leaf, scene.strands.count)
                self.scenes[experiment] = _with_leaf(scene, leaf, value)
            values.append(value)
        if any(v.shape != values[0].shape or np.any(v != values[0]) for v in values):
            raise ValueError(f"free names {shown}, whose leaves start with different values")
        try:
            constraint.free(values[0])
        except ValueError as error:
            raise ValueError(f"free names {shown}, whose {error}") from error
        return Parameter(name, constraint, values[0], tuple(places))

    @property
    def dtype(self) -> Any:
        """Of the free numbers: that of the scenes."""
        return np.result_type(*(scene.dtype for scene in self.scenes.values()))

    def packed(self) -> Array:
        """The free numbers to start from, shape (n,), in the scene's dtype."""
        parts = [p.constraint.free(p.start).ravel() for p in self.each]
        return jnp.asarray(np.concatenate(parts), self.dtype)

    def values(self, free: Array) -> dict[str, Array]:
        """Each parameter's value for free numbers of shape (n,)."""
        values, begin = {}, 0
        for p in self.each:
            values[p.name] = p.constraint.value(free[begin : begin + p.size], p.start)
            begin += p.size
        return values

    def apply(self, free: Array) -> dict[str, Scene]:
        """The scenes with the values for free numbers of shape (n,), by experiment; one scene
        alone has the name ""."""
        values = self.values(free)
        put: dict[str, dict[str, Array]] = {name: {} for name in self.scenes}
        for p in self.each:
            for experiment, leaf in p.places:
                put[experiment][leaf] = values[p.name]
        return {name: replace_leaves(scene, put[name]) for name, scene in self.scenes.items()}

    def labels(self) -> list[str]:
        """A name for every single number: "bonds.influence[hydrogen]", "fibre.peeling_rate"."""
        return [label for p in self.each for label in labels(p.name, p.start.shape)]

    def flat_values(self, free: Array) -> Array:
        """All values in one vector, in the order of `labels`."""
        return jnp.concatenate([jnp.ravel(v) for v in self.values(free).values()])


def by_name(scene: Scene | Mapping[str, Scene]) -> dict[str, Scene]:
    """Scenes by experiment; a single one has the name ""."""
    if isinstance(scene, Scene):
        return {"": scene}
    if not isinstance(scene, Mapping) or not scene:
        wanted = "it must be of class Scene, or several of them by their names"
        raise ValueError(f"scene is {check.short(scene)}; {wanted}")
    for name, one in scene.items():
        check.text("an experiment's name in scene", name)
        if "/" in name:
            raise ValueError(f"an experiment's name in scene is {name!r}; it must have no '/'")
        check.instance(f"scene[{name!r}]", one, Scene)
    return dict(scene)


def _places(name: Any, leaves: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Experiment and leaf of all that a name means."""
    experiment, slash, leaf = name.partition("/") if isinstance(name, str) else ("", "", "")
    one = bool(slash) and experiment in leaves
    where = {experiment: leaves[experiment]} if one else leaves
    wanted = leaf if one else name
    exact = [(at, wanted) for at, of_scene in where.items() if wanted in of_scene]
    matches = exact or [
        (at, found)
        for at, of_scene in where.items()
        for found in of_scene
        if isinstance(wanted, str) and fnmatchcase(found, wanted)
    ]
    if not matches:
        allowed = dict.fromkeys(found for of_scene in where.values() for found in of_scene)
        shown = check.short(name)
        raise ValueError(f"free names {shown}; it must be one of {check.listed(allowed)}")
    return matches


def _with_leaf(scene: Scene, name: str, value: np.ndarray) -> Scene:
    """The scene with a leaf of another shape."""
    names = list(named_leaves(scene))
    leaves, structure = jax.tree.flatten(scene)
    leaves[names.index(name)] = jnp.asarray(value, scene.dtype)
    changed: Scene = jax.tree.unflatten(structure, leaves)
    return changed


def _for_strands(value: np.ndarray, leaf: str, strands: int) -> np.ndarray:
    """The value of a leaf for each strand."""
    if not leaf.startswith(("fibre.", "bonds.")):
        raise ValueError(
            f"free names {leaf!r} for every strand; it must be a number of the fibre or the bonds"
        )
    own = {"bonds.influence": 1, "bonds.fraction": 1}.get(leaf, 0)
    if value.ndim == own:
        return np.broadcast_to(value, (strands, *value.shape)).copy()
    if value.shape[0] != strands:
        raise ValueError(f"free names {leaf!r}, whose first axis is not that of the strands")
    return value
