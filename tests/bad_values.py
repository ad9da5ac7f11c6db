"""Values to pass where others are wanted, made by hypothesis, and what a refusal must be like.

HYPOTHESIS_PROFILE=full makes as many as the issue asks for, 2,000 and more, new ones each time;
without it a few, always the same.
"""

import os
import warnings
from array import array
from collections.abc import Iterable
from decimal import Decimal
from fractions import Fraction
from typing import Any

import jax
import numpy as np
from hypothesis import HealthCheck, event, settings
from hypothesis import strategies as st

FULL = os.environ.get("HYPOTHESIS_PROFILE") == "full"
MESSAGE = 400
"""Characters, more than any message has."""


def examples(few: int, many: int) -> settings:
    """Settings of a test: how many examples it gets, usually and in the full run."""
    return settings(
        max_examples=many if FULL else few,
        derandomize=not FULL,
        deadline=None,
        database=None,
        suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    )


def inside_itself() -> list[Any]:
    endless: list[Any] = []
    endless.append(endless)
    return endless


def nested(depth: int) -> list[Any]:
    deep: list[Any] = [1.0]
    for _ in range(depth):
        deep = [deep]
    return deep


def matrix() -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.matrix([[1.0, 2.0, 3.0]])


class Raises:
    """An object that answers nothing."""

    def __repr__(self) -> str:
        raise RuntimeError("no text")

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("no array")

    def __bool__(self) -> bool:
        raise RuntimeError("no truth")


class Text(str):
    """A subclass of a text."""


class Number(float):
    """A subclass of a number."""


ODD: dict[str, Any] = {
    "None": lambda: None,
    "True": lambda: True,
    "not a number": lambda: float("nan"),
    "infinity": lambda: float("-inf"),
    "1e400": lambda: 1e400,
    "1e300": lambda: 1e300,
    "1e-300": lambda: 1e-300,
    "1e19": lambda: 1e19,
    "0": lambda: 0,
    "-1": lambda: -1,
    "0.5": lambda: 0.5,
    "10^9": lambda: 10**9,
    "2^70": lambda: 2**70,
    "10^400": lambda: 10**400,
    "10^5000": lambda: 10**5000,
    "1j": lambda: 1j,
    "text": lambda: "1.0",
    "long text": lambda: "x." * 5000,
    "lines": lambda: "a\nb\r\n",
    "NUL": lambda: "\0",
    "half a character": lambda: "\ud800",
    "subclass of a text": lambda: Text("root"),
    "subclass of a number": lambda: Number(0.3),
    "bytes": lambda: b"1.0",
    "bytearray": lambda: bytearray(8),
    "memory": lambda: memoryview(b"12345678"),
    "list": list,
    "tuple": tuple,
    "dict": lambda: {"a": 1},
    "set": lambda: {1, 2},
    "object": object,
    "class": lambda: float,
    "class of arrays": lambda: np.ndarray,
    "function": lambda: len,
    "generator": lambda: (x for x in (1.0, 2.0)),
    "range": lambda: range(3),
    "ragged": lambda: [[1.0, 2.0], [3.0]],
    "inside itself": inside_itself,
    "100 deep": lambda: nested(100),
    "2000 deep": lambda: nested(2000),
    "truths": lambda: [True, False, True],
    "huge in a list": lambda: [10**400, 0, 0],
    "Nones": lambda: [None, None, None],
    "answers nothing": Raises,
    "decimal": lambda: Decimal("0.3"),
    "ratio": lambda: Fraction(1, 3),
    "array of the standard library": lambda: array("d", [1.0, 2.0, 3.0]),
    "empty array": lambda: np.zeros(0),
    "empty strands": lambda: np.zeros((0, 0, 3)),
    "date": lambda: np.datetime64("2020-01-01"),
    "time span": lambda: np.timedelta64(1, "s"),
    "dates": lambda: np.array(["2020-01-01"] * 3, "M8[D]"),
    "objects": lambda: np.array([1.0, None, 3.0], object),
    "objects that are numbers": lambda: np.array([1.0, 2.0, 3.0], object),
    "texts": lambda: np.array(["1", "2", "3"]),
    "records": lambda: np.zeros(3, [("a" * 200, "f8"), ("b", "i4")]),
    "masked": lambda: np.ma.masked_array([1.0, 2.0, 3.0], [0, 1, 0]),
    "masked number": lambda: np.ma.masked,
    "matrix": matrix,
    "16 bits": lambda: np.float16(0.3),
    "128 bits": lambda: np.longdouble(0.3),
    "128 bits in a list": lambda: [np.longdouble(0.3)] * 3,
    "unsigned": lambda: np.uint64(2**64 - 1),
    "key": lambda: jax.random.key(0),
    "shape of an array": lambda: jax.ShapeDtypeStruct((3,), np.float64),
    "JAX array": lambda: jax.numpy.ones((2, 2)),
    "JAX array of 16 bits": lambda: jax.numpy.ones(3, jax.numpy.bfloat16),
    "signalling": lambda: np.array([0x7F800001] * 3, np.uint32).view(np.float32),
}
"""What no caller means, by what it is; made anew each time."""


def changed(valid: Any, draw: st.DrawFn) -> Any:
    """A number or an array of numbers, with one thing wrong."""
    x = np.array(valid, float)
    how = draw(st.integers(0, 9))
    if how == 0:
        return x[None]
    if how == 1:
        return x.reshape(-1)[:-1]
    if how == 2:
        return np.repeat(np.atleast_1d(x), 2, axis=-1)
    if how == 3:
        with np.errstate(invalid="ignore"):
            return x * draw(st.sampled_from([-1.0, 0.0, 1e-30, 1e30, 1e300, np.nan, np.inf]))
    if how == 4:
        kinds = [complex, bool, object, "U8", np.float16, np.int64, np.longdouble, np.float32]
        return x.astype(draw(st.sampled_from(kinds)))
    if how == 5:
        return np.ma.masked_array(x, mask=x > 0)
    if how == 6:
        return jax.numpy.asarray(x[..., None])
    if x.size == 0:
        return None
    entry = draw(st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e19, 1e-300, -1.0]) | floats())
    x[tuple(draw(st.integers(0, n - 1)) for n in x.shape)] = entry
    return x.tolist() if how == 7 else x


def floats() -> st.SearchStrategy[float]:
    return st.floats(width=64)


@st.composite
def bad(draw: st.DrawFn, valid: Any) -> Any:
    """A value that is not, or most likely not, what a field wants whose valid value is given."""
    how = draw(st.integers(0, 5))
    if how <= 1:
        return ODD[draw(st.sampled_from(list(ODD)))]()
    number = isinstance(valid, int | float | list | tuple | np.ndarray | jax.Array)
    if how <= 3 and number and not isinstance(valid, bool):
        try:
            return changed(valid, draw)
        except (TypeError, ValueError):  # a tuple of effects
            return draw(floats())
    if how == 4:
        return draw(floats() | st.integers() | st.text(max_size=5) | st.binary(max_size=5))
    leaf = floats() | st.integers() | st.none() | st.booleans() | st.text(max_size=3)
    return draw(st.recursive(leaf, lambda inner: st.lists(inner, max_size=4), max_leaves=8))


def check_refusal(error: Exception, names: Iterable[str]) -> None:
    """A message of one line, not long, that names one of some things."""
    message = str(error)
    event("refused")
    if isinstance(error, OSError) and error.filename:  # the system's own message
        return
    assert "\n" not in message
    assert len(message) < MESSAGE
    assert any(name in message for name in names), message
