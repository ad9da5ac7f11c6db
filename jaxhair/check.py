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
    return None if isinstance(value, jax.core.Tracer) else np.asarray(value)


def _short(value: Any) -> str:
    """`value` in one short line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


def _numbers(name: str, value: Any) -> np.ndarray | None:
    if isinstance(value, jax.core.Tracer):
        return None
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        array = np.asarray(None)
    if array.dtype.kind not in "fiu":
        wanted = "it must be a number or an array of numbers"
        raise ValueError(f"{name} is {_short(value)}; {wanted}")
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
    try:
        actual = np.shape(value)
    except ValueError:  # lists of different lengths
        _numbers(name, value)
        raise
    fits = len(actual) == len(allowed) and all(
        size > 0 if isinstance(want, str) else size == want
        for size, want in zip(actual, allowed, strict=True)
    )
    if not fits:
        text = ", ".join(str(want) for want in allowed) + ("," if len(allowed) == 1 else "")
        raise ValueError(f"{name} has shape {actual}; it must have shape ({text})")


def number(name: str, value: Any) -> None:
    """`value` is one finite number."""
    shape(name, value, ())
    _numbers(name, value)


def vector(name: str, value: Any) -> None:
    """`value` is a finite 3-vector."""
    shape(name, value, (3,))
    finite(name, value)


def direction(name: str, value: Any) -> None:
    """`value` is a finite 3-vector that is not zero."""
    vector(name, value)
    array = known(value)
    if array is not None and not np.any(array != 0):
        raise ValueError(f"{name} is {_short(value)}; it must not be the zero vector")


def instance(name: str, value: Any, kind: type) -> None:
    """`value` is of a class."""
    if not isinstance(value, kind):
        raise ValueError(f"{name} is {_short(value)}; it must be of class {kind.__name__}")


def several(name: str, value: Any, kind: type) -> tuple[Any, ...]:
    """`value` as a tuple, all of whose entries are of a class."""
    if not isinstance(value, list | tuple):
        wanted = f"a tuple, whose entries are of class {kind.__name__}"
        raise ValueError(f"{name} is {_short(value)}; it must be {wanted}")
    for entry in value:
        instance(f"an entry of {name}", entry, kind)
    return tuple(value)


def choice(name: str, value: Any, allowed: Sequence[Any]) -> None:
    """`value` is one of `allowed`."""
    if value not in allowed:
        listed = ", ".join(repr(a) for a in allowed)
        raise ValueError(f"{name} is {value!r}; it must be one of {listed}")


def whole(name: str, value: Any, *, least: int) -> None:
    """`value` is an int of at least `least`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < least:
        raise ValueError(f"{name} is {value!r}; it must be a whole number of at least {least}")
