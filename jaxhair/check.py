"""Checks of what a user passes in: each names the field, its value and what is allowed.

Values are looked at only where they are known: under a JAX transformation an array has a shape
but no value, and then only the shape is checked.
"""

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from reprlib import Repr
from typing import Any

import jax
import numpy as np

LARGEST, SMALLEST = 1e18, 1e-18
"""Bounds of every number, and of those above 0: the squares of others do not fit into float32."""

_REPR = Repr()
_REPR.maxlist = _REPR.maxtuple = _REPR.maxdict = _REPR.maxset = 4
_REPR.maxstring = _REPR.maxlong = _REPR.maxother = 60


def traced(tree: Any) -> bool:
    """Whether some number of a pytree belongs to a program that JAX traces."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def known(value: Any) -> np.ndarray | None:
    """Numbers as a float64 array, or None where they are traced and have no value yet."""
    return None if isinstance(value, jax.core.Tracer) else np.asarray(value, float)


def short(value: Any) -> str:
    """`value` in one short line."""
    try:
        text = " ".join(_REPR.repr(value).split())
    except Exception:  # such as an int of too many digits
        text = f"of class {type(value).__name__}"
    return text if len(text) <= 60 else text[:57] + "..."


def listed(allowed: Iterable[Any]) -> str:
    """What is allowed, in one line that is not long."""
    text = ", ".join(repr(a) for a in allowed)
    return text if len(text) <= 200 else text[:197] + "..."


NUMBERS = "a number or an array of numbers"


def _other(name: str, value: Any, wanted: str) -> ValueError:
    return ValueError(f"{name} is {short(value)}; it must be {wanted}")


def numbers(name: str, value: Any, wanted: str = NUMBERS) -> np.ndarray | None:
    """Real numbers of any value as a float64 array, or None where they are traced."""
    if isinstance(value, jax.core.Tracer):
        return None
    try:
        array = np.asarray(value)
    except Exception:  # lists of different lengths, and whatever a foreign object raises
        raise _other(name, value, wanted) from None
    masked = isinstance(value, np.ma.MaskedArray)
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8 or masked:
        raise _other(name, value, wanted)
    with np.errstate(invalid="ignore"):  # a signalling NaN
        return array.astype(float)


def _finite(name: str, value: Any, wanted: str = NUMBERS) -> np.ndarray | None:
    """Finite numbers as a float64 array, or None where they are traced."""
    array = numbers(name, value, wanted)
    if array is not None and np.any(wrong := ~(np.abs(array) <= LARGEST)):
        wanted = f"it must be finite, and at most {LARGEST:g} in size"
        raise ValueError(f"{name} has {_offender(array, wrong)}; {wanted}")
    return array


def _offender(array: np.ndarray, wrong: np.ndarray) -> str:
    """The first wrong entry, with its place."""
    if array.ndim == 0:
        return f"the value {array[()]}"
    place = tuple(int(i) for i in np.argwhere(wrong)[0])
    return f"the value {array[place]} at {place}"


def _in_range(name: str, value: Any, many: bool, low: float, high: float, wanted: str) -> None:
    if not many:
        shape(name, value, ())
    array = _finite(name, value, f"a number, {wanted}")
    if array is not None and np.any(wrong := (array < low) | (array > high)):
        raise ValueError(f"{name} has {_offender(array, wrong)}; it must be {wanted}")


def finite(name: str, value: Any) -> None:
    """Every entry of `value` is a finite number."""
    _finite(name, value)


def positive(name: str, value: Any, *, many: bool = False) -> None:
    """`value` is a number above 0, or an array of such if there may be many."""
    _in_range(name, value, many, SMALLEST, LARGEST, f"above 0, at least {SMALLEST:g}")


def not_negative(name: str, value: Any, *, many: bool = False) -> None:
    """`value` is a number of 0 or more, or an array of such if there may be many."""
    _in_range(name, value, many, 0, LARGEST, "0 or more")


def fraction(name: str, value: Any, *, many: bool = False) -> None:
    """`value` is a number in [0, 1], or an array of such if there may be many."""
    _in_range(name, value, many, 0, 1, "in [0, 1]")


def size(name: str, value: Any) -> tuple[int, ...]:
    """The shape of `value`."""
    try:
        found = np.shape(value)
    except Exception:
        found = None
    if not isinstance(found, tuple):  # a class has something else of this name
        raise _other(name, value, NUMBERS)
    return found


def shape(name: str, value: Any, allowed: tuple[int | str, ...]) -> None:
    """`value` has the shape `allowed`, where a string stands for any size above 0."""
    actual = size(name, value)
    fits = len(actual) == len(allowed) and all(
        n > 0 if isinstance(want, str) else n == want
        for n, want in zip(actual, allowed, strict=True)
    )
    if not fits:
        text = ", ".join(str(want) for want in allowed) + ("," if len(allowed) == 1 else "")
        raise ValueError(f"{name} has shape {actual}; it must have shape ({text})")


def number(name: str, value: Any) -> None:
    """`value` is one finite number."""
    shape(name, value, ())
    _finite(name, value)


def constant(name: str, value: Any) -> float:
    """`value`, a number above 0 that is known while a program is traced."""
    positive(name, value)
    if isinstance(value, jax.core.Tracer):
        raise _other(name, value, "a number that is not traced")
    return float(value)


def vector(name: str, value: Any) -> None:
    """`value` is a finite 3-vector."""
    shape(name, value, (3,))
    finite(name, value)


def direction(name: str, value: Any) -> None:
    """`value` is a finite 3-vector that is not zero."""
    vector(name, value)
    array = known(value)
    if array is not None and np.abs(array).max() < SMALLEST:
        raise _other(name, value, "a vector that is not zero")


def instance(name: str, value: Any, kind: type) -> None:
    """`value` is of a class."""
    if not isinstance(value, kind):
        raise _other(name, value, f"of class {kind.__name__}")


def several(name: str, value: Any, kind: type) -> tuple[Any, ...]:
    """`value` as a tuple, all of whose entries are of a class."""
    if not isinstance(value, list | tuple):
        raise _other(name, value, f"a tuple, whose entries are of class {kind.__name__}")
    for entry in value:
        instance(f"an entry of {name}", entry, kind)
    return tuple(value)


def choice(name: str, value: Any, allowed: Sequence[Any]) -> None:
    """`value` is one of `allowed`, and of the same class."""
    if not any(isinstance(value, type(a)) and value == a for a in allowed):
        raise _other(name, value, f"one of {listed(allowed)}")


def flag(name: str, value: Any) -> None:
    """`value` is True or False."""
    choice(name, value, (True, False))


def whole(name: str, value: Any, *, least: int, most: int = 1_000_000) -> None:
    """`value` is an int from `least` to `most`."""
    integer = isinstance(value, int | np.integer) and not isinstance(value, bool | np.timedelta64)
    if not integer or not least <= value <= most:
        raise _other(name, value, f"a whole number of at least {least} and at most {most}")


def path(name: str, value: Any) -> Path:
    """`value` as a path."""
    with suppress(TypeError, UnicodeEncodeError):
        found = Path(value)
        if found.name and b"\0" not in os.fsencode(found):
            return found
    raise _other(name, value, "the path of a file")


def text(name: str, value: Any) -> None:
    """`value` is a name that fits into one line, and that leaves can go by."""
    fits = isinstance(value, str) and 0 < len(value) <= 100 and value.isprintable()
    if not fits or "." in value:
        raise _other(name, value, "a printable text without '.', of at most 100 characters")
