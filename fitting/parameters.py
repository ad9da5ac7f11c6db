"""Which numbers of a scene a fit may change, and within what bounds.

A constraint maps free numbers, in which the optimiser moves without bounds, to admissible values.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase

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
        return jax.nn.softmax(jnp.append(free, jnp.zeros(1, free.dtype))) * float(start.sum())


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


def labels(name: str, shape: tuple[int, ...]) -> list[str]:
    """A name for every single number of a parameter, in the order of `numpy.ravel`."""
    if shape == ():
        return [name]
    if name == "bonds.influence" and shape == (len(BONDS),):
        return [f"{name}[{kind}]" for kind in BONDS]
    return [f"{name}[{','.join(map(str, place))}]" for place in np.ndindex(shape)]


class Parameters:
    """The freed numbers of a scene, packed into one vector and put back.

    Arguments:
        scene: with the values to start from.
        free: from a leaf's name (see `jaxhair.named_leaves`) to its constraint. A name with `*`
            frees all leaves that match as one shared parameter, such as
            "phases.*.Wound.diameter"; they must start with the same value.

    Raises ValueError for a name that matches nothing, leaves of one name that differ, or a start
    outside its constraint.
    """

    def __init__(self, scene: Scene, free: Mapping[str, Constraint]) -> None:
        check.instance("scene", scene, Scene)
        check.instance("free", free, Mapping)
        if not free:
            raise ValueError("free is empty; it must name at least one leaf of the scene")
        leaves = named_leaves(scene)
        self.scene = scene
        self.constraints = dict(free)
        self.leaves: dict[str, list[str]] = {}
        self.start: dict[str, np.ndarray] = {}
        for name, constraint in free.items():
            shown = check.short(name)
            if not isinstance(constraint, Constraint):
                wanted = "it must be a constraint"
                raise ValueError(f"free[{shown}] is {check.short(constraint)}; {wanted}")
            matches = [leaf for leaf in leaves if isinstance(name, str) and fnmatchcase(leaf, name)]
            if name in leaves:
                matches = [name]
            if not matches:
                raise ValueError(f"free names {shown}; it must be one of {check.listed(leaves)}")
            values = [np.asarray(leaves[leaf], float) for leaf in matches]
            if any(v.shape != values[0].shape or np.any(v != values[0]) for v in values):
                raise ValueError(f"free names {shown}, whose leaves start with different values")
            self.leaves[name], self.start[name] = matches, values[0]
            try:
                constraint.free(values[0])
            except ValueError as error:
                raise ValueError(f"free names {shown}, whose {error}") from error

    def packed(self) -> Array:
        """The free numbers to start from, shape (n,), in the scene's dtype."""
        parts = [c.free(self.start[name]).ravel() for name, c in self.constraints.items()]
        return jnp.asarray(np.concatenate(parts), self.scene.dtype)

    def values(self, free: Array) -> dict[str, Array]:
        """Each parameter's value for free numbers of shape (n,)."""
        values, begin = {}, 0
        for name, constraint in self.constraints.items():
            size = constraint.free(self.start[name]).size
            values[name] = constraint.value(free[begin : begin + size], self.start[name])
            begin += size
        return values

    def apply(self, free: Array) -> Scene:
        """The scene with the values for free numbers of shape (n,)."""
        values = self.values(free)
        return replace_leaves(
            self.scene, {leaf: values[name] for name in values for leaf in self.leaves[name]}
        )

    def labels(self) -> list[str]:
        """A name for every single number: "bonds.influence[hydrogen]", "fibre.peeling_rate"."""
        return [label for name, value in self.start.items() for label in labels(name, value.shape)]

    def flat_values(self, free: Array) -> Array:
        """All values in one vector, in the order of `labels`."""
        return jnp.concatenate([jnp.ravel(v) for v in self.values(free).values()])
