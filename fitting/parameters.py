"""Which numbers of a scene a fit may change."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fitting.constraints import Constraint, PerExperiment, PerStrand
from jaxhair import Scene, check, named_leaves, replace_leaves
from jaxhair.scene import matching
from jaxhair.strands import BONDS

NEAR_A_BOUND = 1e-3
"""Share of a range at which a value counts as being at its end."""

OWN_AXES = {"bonds.influence": 1, "bonds.fraction": 1}
"""Axes of a leaf besides that of the strands, where that is not the only one."""


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
        check_free(free)
        leaves = {name: named_leaves(scene) for name, scene in self.scenes.items()}
        self.each: list[Parameter] = []
        for name, constraint in free.items():
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
        check_alike(name, values)
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

    def arrays(self, free: Any) -> dict[str, np.ndarray]:
        """`values`, outside of a program."""
        values = self.values(jnp.asarray(free, self.dtype))
        return {name: np.asarray(value) for name, value in values.items()}

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

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Ends of the numbers' ranges, in the order of `labels`; infinite where there are none."""
        each = [p.constraint.bounds(p.start) for p in self.each]
        low, high = (np.concatenate([np.ravel(pair[i]) for pair in each]) for i in (0, 1))
        return low, high

    def at_bounds(self, free: Array) -> tuple[str, ...]:
        """Labels of the numbers at an end of a range that has two."""
        values = np.asarray(self.flat_values(free), float)
        low, high = self.bounds()
        margin = NEAR_A_BOUND * np.where(np.isfinite(high - low), high - low, 0)
        at = (values < low + margin) | (values > high - margin)
        return tuple(label for label, out in zip(self.labels(), at, strict=True) if out)


def check_free(free: Any) -> None:
    """Raises ValueError for what is no mapping of constraints, or an empty one."""
    check.instance("free", free, Mapping)
    if not free:
        raise ValueError("free is empty; it must name at least one leaf of the scene")
    for name, constraint in free.items():
        if not isinstance(constraint, Constraint):
            shown = f"free[{check.short(name)}] is {check.short(constraint)}"
            raise ValueError(f"{shown}; it must be a constraint")


def check_alike(name: str, values: Sequence[np.ndarray]) -> None:
    """Raises ValueError where values to start from differ."""
    if any(v.shape != values[0].shape or np.any(v != values[0]) for v in values):
        shown = check.short(name)
        raise ValueError(f"free names {shown}, whose leaves start with different values")


def unknown(name: Any, leaves: Iterable[str]) -> ValueError:
    """That `free` names no leaf."""
    return ValueError(f"free names {check.short(name)}; it must be one of {check.listed(leaves)}")


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
    matches = [(at, found) for at in where for found in matching(wanted, where[at])]
    if not matches:
        raise unknown(name, dict.fromkeys(leaf for of_scene in where.values() for leaf in of_scene))
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
    if value.ndim == OWN_AXES.get(leaf, 0):
        return np.broadcast_to(value, (strands, *value.shape)).copy()
    if value.shape[0] != strands:
        raise ValueError(f"free names {leaf!r}, whose first axis is not that of the strands")
    return value
