"""Frozen dataclasses that JAX can look into: arrays are leaves, choices are static."""

import dataclasses
from collections.abc import Iterable
from contextlib import suppress
from typing import Any, TypeVar, dataclass_transform

import jax
import jax.numpy as jnp
import numpy as np

T = TypeVar("T")


def static(**options: Any) -> Any:
    """Field that is a choice, not a number: part of the compiled program, not a leaf."""
    return dataclasses.field(metadata={"static": True}, **options)


@dataclass_transform(frozen_default=True, field_specifiers=(static, dataclasses.field))
def pytree(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and a pytree.

    JAX rebuilds pytrees from tracers, batched arrays and placeholders, for which the checks of
    `__post_init__` make no sense. `jax.tree_util.register_dataclass` would run them; here the
    fields are set without calling the constructor, so only what a user builds is checked.

    A list or tuple of numbers, or what else NumPy takes for one, becomes an array: one leaf.
    """
    _gather_numbers(cls)
    cls = dataclasses.dataclass(frozen=True)(cls)
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    data = tuple(f.name for f in fields if not f.metadata.get("static"))
    meta = tuple(f.name for f in fields if f.metadata.get("static"))

    def flatten_with_keys(x: T) -> tuple[tuple[tuple[Any, Any], ...], tuple[Any, ...]]:
        children = tuple((jax.tree_util.GetAttrKey(name), getattr(x, name)) for name in data)
        return children, tuple(getattr(x, name) for name in meta)

    def flatten(x: T) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
        return tuple(getattr(x, n) for n in data), tuple(getattr(x, n) for n in meta)

    def unflatten(aux: tuple[Any, ...], children: Iterable[Any]) -> T:
        x = object.__new__(cls)
        for name, value in zip(data, children, strict=True):
            object.__setattr__(x, name, value)
        for name, value in zip(meta, aux, strict=True):
            object.__setattr__(x, name, value)
        return x

    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten, flatten)
    return cls


def _gather_numbers(cls: type) -> None:
    """Let the constructor turn lists and tuples of numbers into arrays before it checks them."""
    checks = getattr(cls, "__post_init__", None)

    def post_init(self: Any) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not field.metadata.get("static") and not isinstance(value, _LEAVES):
                object.__setattr__(self, field.name, _gathered(value))
        if checks is not None:
            checks(self)

    cls.__post_init__ = post_init  # type: ignore[attr-defined]


_LEAVES = jax.Array, np.ndarray, np.generic, int, float, complex, str, bytes


def _gathered(value: Any) -> Any:
    """`value` as an array if it is a list of numbers or of a foreign class of arrays."""
    try:
        array = np.asarray(value)
    except jax.errors.TracerArrayConversionError:
        with suppress(Exception):
            return jnp.asarray(value)
        return value
    except Exception:  # lists of different lengths, or of foreign objects: left for the checks
        return value
    return array.astype(float) if array.dtype.kind in "fiu" and array.size else value
