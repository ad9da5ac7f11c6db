"""Sets of admissible values.

A constraint maps free numbers, in which the optimiser moves without bounds, to admissible values.
"""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxhair import check

LARGEST_SHAPE = 0.8
"""Of |Omega|, half the sine of a turn, that a strand may remember: a turn of 106 degrees."""


class Constraint:
    """A set of admissible values."""

    @abstractmethod
    def free(self, value: np.ndarray) -> np.ndarray:
        """Free numbers of an admissible value, shape (n,). Raises ValueError for another value."""

    @abstractmethod
    def value(self, free: Array, start: np.ndarray) -> Array:
        """The value for free numbers, of the shape of the starting value."""

    def bounds(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Ends of each number's range, of the shape of the starting value; infinite if none."""
        return np.full(start.shape, -np.inf), np.full(start.shape, np.inf)


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

    def bounds(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(start.shape), np.full(start.shape, start.sum())


@dataclass(frozen=True)
class Positive(Constraint):
    """Numbers above 0: v = exp(x)."""

    def free(self, value: np.ndarray) -> np.ndarray:
        if np.any(value <= 0):
            raise ValueError(f"value is {check.short(value)}; it must be above 0")
        return np.log(value.ravel())

    def value(self, free: Array, start: np.ndarray) -> Array:
        return jnp.exp(free).reshape(start.shape)

    def bounds(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(start.shape), np.full(start.shape, np.inf)


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

    def bounds(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full(start.shape, self.low), np.full(start.shape, self.high)


@dataclass(frozen=True)
class Unbounded(Constraint):
    """Any numbers: v = x."""

    def free(self, value: np.ndarray) -> np.ndarray:
        return value.ravel()

    def value(self, free: Array, start: np.ndarray) -> Array:
        return free.reshape(start.shape)


@dataclass(frozen=True)
class Scale(Constraint):
    """The starting value times one number above 0, k = exp(x): for `strands.natural_shape`.

    Shapes Omega stay at most `LARGEST_SHAPE` in size, or as large as they start.
    """

    def free(self, value: np.ndarray) -> np.ndarray:
        return np.zeros(1)

    def value(self, free: Array, start: Any) -> Array:
        start = jnp.asarray(start, free.dtype)
        scaled = start * jnp.exp(free[0])
        square = jnp.sum(scaled**2, axis=-1, keepdims=True)
        most = jnp.maximum(jnp.sum(start**2, axis=-1, keepdims=True), LARGEST_SHAPE**2)
        over = square > most
        return scaled * jnp.where(over, jnp.sqrt(most / jnp.where(over, square, 1)), 1)


@dataclass(frozen=True)
class Share(Constraint):
    """One of several numbers against all others: their sum stays, and the others' ratios.

    For influences: a single state rarely shows more than one. v = sum / (1 + exp(-x)).

    Arguments:
        place: of the number.
    """

    place: int

    def free(self, value: np.ndarray) -> np.ndarray:
        if value.ndim != 1 or not 0 <= self.place < value.size or np.any(value < 0):
            raise ValueError(f"value is {check.short(value)}; it must be a list of numbers >= 0")
        own, whole = value[self.place], value.sum()
        if own == whole:
            raise ValueError(f"value is {check.short(value)}; another number must be above 0")
        share = np.clip(own / whole, 1e-6, 1 - 1e-6)
        return np.array([np.log(share / (1 - share))])

    def value(self, free: Array, start: Any) -> Array:
        start = jnp.asarray(start, free.dtype)
        whole, others = jnp.sum(start), start.at[self.place].set(0)
        share = jax.nn.sigmoid(free[0])
        rest = others * ((1 - share) * whole / jnp.sum(others))
        return rest.at[self.place].set(share * whole)

    def bounds(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(start.shape), np.full(start.shape, start.sum())


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

    def bounds(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        low, high = zip(*(self.each.bounds(one) for one in start), strict=True)
        return np.stack(low), np.stack(high)


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

    def bounds(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self.each.bounds(start)
