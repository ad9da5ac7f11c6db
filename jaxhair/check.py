"""Checks of what a user passes in: each names the field, its value and what is allowed.

Values are looked at only where they are known: under a JAX transformation an array has a shape
but no value, and then only the shape is checked.
"""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np


def known(value: Any) -> np.ndarray | None:
    """`value` as a NumPy array, or None where it is traced and has no value yet."""
    if isinstance(value, jax.core.Tracer):
        return None
    try:
        return np.asarray(value)
    except Exception:  # a key array or a foreign object: the caller's shape check reports it
        return None


def _numbers(name: str, value: Any) -> np.ndarray | None:
    array = known(value)
    if array is None:
        return None
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} is {value!r}; it must be a number or an array of numbers")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{name} has {_offender(array, ~np.isfinite(array))}; it must be finite")
    return array


def _offender(array: np.ndarray, wrong: np.ndarray) -> str:
    """The first wrong entry, with its place."""
    if array.ndim == 0:
        return f"the value {array[()]}"
    place = tuple(int(i) for i in np.argwhere(wrong)[0])
    return f"the value {array[place]} at {place}"


def finite(name: str, value: Any) -> None:
    """Every entry of `value` is a finite number."""
    _numbers(name, value)


def positive(name: str, value: Any) -> None:
    """Every entry of `value` is above 0."""
    array = _numbers(name, value)
    if array is not None and np.any(array <= 0):
        raise ValueError(f"{name} has {_offender(array, array <= 0)}; it must be above 0")


def not_negative(name: str, value: Any) -> None:
    """Every entry of `value` is 0 or more."""
    array = _numbers(name, value)
    if array is not None and np.any(array < 0):
        raise ValueError(f"{name} has {_offender(array, array < 0)}; it must be 0 or more")


def fraction(name: str, value: Any) -> None:
    """Every entry of `value` is in [0, 1]."""
    array = _numbers(name, value)
    if array is not None and np.any(wrong := (array < 0) | (array > 1)):
        raise ValueError(f"{name} has {_offender(array, wrong)}; it must be in [0, 1]")


def shape(name: str, value: Any, allowed: tuple[int | str, ...]) -> None:
    """`value` has the shape `allowed`, where a string stands for any size above 0."""
    actual = np.shape(value)
    fits = len(actual) == len(allowed) and all(
        size > 0 if isinstance(want, str) else size == want
        for size, want in zip(actual, allowed, strict=True)
    )
    if not fits:
        text = ", ".join(str(want) for want in allowed) + ("," if len(allowed) == 1 else "")
        raise ValueError(f"{name} has shape {actual}; it must have shape ({text})")


def vector(name: str, value: Any) -> None:
    """`value` is a finite 3-vector."""
    shape(name, value, (3,))
    finite(name, value)


def direction(name: str, value: Any) -> None:
    """`value` is a finite 3-vector that is not zero."""
    vector(name, value)
    array = known(value)
    if array is not None and not np.any(array != 0):
        raise ValueError(f"{name} is {value!r}; it must not be the zero vector")


def choice(name: str, value: Any, allowed: Sequence[Any]) -> None:
    """`value` is one of `allowed`."""
    if value not in allowed:
        listed = ", ".join(repr(a) for a in allowed)
        raise ValueError(f"{name} is {value!r}; it must be one of {listed}")


def whole(name: str, value: Any, *, least: int) -> None:
    """`value` is an int of at least `least`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} is {value!r}; it must be a whole number of at least {least}")
