"""Sums along an axis, on a CPU added one by one where XLA would not.

From jaxlib 0.11 on XLA's CPU compiler gives sums along an axis to a library (YNNPACK) once arrays
are large, which takes many times as long for three or four components, and keeps the loop that they
are in from being compiled as one kernel: a Jacobian of 64 strands of 33 points took 4 times as long
(`tests/benchmarks/solvers.py`). Added one by one, sums would be computed again in every loop that
needs them, and so are stored.

A vector times a scalar has such a sum in its derivative in reverse mode, by the scalar: with the
scalar `spread` it is added one by one, too.
"""

from functools import partial
from typing import Any

import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxlib import version

from jaxhair.stored import stored

ONE_BY_ONE = tuple(int(x) for x in version.__version__.split(".")[:2]) >= (0, 11)
"""Whether sums are added one by one: with older versions gradients would take longer."""

COMPONENTS, POINTS = -2, -3
"""Axes of arrays of shape (points, components, strands)."""


def summed(x: Array, axis: int = COMPONENTS) -> Array:
    """The sum over an axis, which is kept with size 1."""
    return stored(one_by_one(x, axis)) if ONE_BY_ONE else jnp.sum(x, axis=axis, keepdims=True)


def spread(x: Array, size: int, axis: int = COMPONENTS) -> Array:
    """x, whose axis has size 1, as often as `size` says.

    In reverse mode its derivative is `summed`, which that of a plain broadcast is not.
    """
    if not ONE_BY_ONE:
        return _everywhere(x, size=size, axis=axis)
    every: Array = _spread.bind(jnp.asarray(x), size=size, axis=_from_the_end(x, axis))
    return every


def one_by_one(x: Array, axis: int = COMPONENTS) -> Array:
    """`summed`, added one by one on a CPU; its derivatives are those of a sum."""
    total: Array = _one_by_one.bind(jnp.asarray(x), axis=_from_the_end(x, axis))
    return total


def _from_the_end(x: Array, axis: int) -> int:
    """The axis as a number below 0, which it keeps where `jax.vmap` puts others before it."""
    return axis % x.ndim - x.ndim


def _sized(x: Any, size: int, axis: int) -> tuple[int, ...]:
    """The shape of x, with another size of an axis."""
    place = axis % x.ndim
    return (*x.shape[:place], size, *x.shape[place + 1 :])


def _sum(x: Array, *, axis: int) -> Array:
    return jnp.sum(x, axis=axis, keepdims=True)


def _added(x: Array, *, axis: int) -> Array:
    """The first half and the second, and again, until one is left."""
    axis %= x.ndim
    while (size := x.shape[axis]) > 1:
        half = size // 2
        odd = (1,) if size % 2 else ()
        first, second, *rest = lax.split(x, (half, half, *odd), axis=axis)
        x = jnp.concatenate([first + second, *rest], axis=axis)
    return x


def _everywhere(x: Array, *, size: int, axis: int) -> Array:
    return jnp.broadcast_to(x, _sized(x, size, axis))


# Primitives, for the derivative in reverse mode of each to be the other.
_one_by_one = Primitive("sum_one_by_one")
_spread = Primitive("spread")
_one_by_one.def_impl(_added)
_spread.def_impl(_everywhere)
_one_by_one.def_abstract_eval(lambda x, axis: x.update(shape=_sized(x, 1, axis)))
_spread.def_abstract_eval(lambda x, size, axis: x.update(shape=_sized(x, size, axis)))


def _of_sum(cotangent: Any, x: Any, *, axis: int) -> Any:
    zero = isinstance(cotangent, ad.Zero)
    return [ad.Zero(x.aval) if zero else spread(cotangent, x.aval.shape[axis], axis)]


def _of_spread(cotangent: Any, x: Any, *, size: int, axis: int) -> Any:
    zero = isinstance(cotangent, ad.Zero)
    return [ad.Zero(x.aval) if zero else stored(one_by_one(cotangent, axis))]


ad.deflinear2(_one_by_one, _of_sum)
ad.deflinear2(_spread, _of_spread)


def _batched(primitive: Primitive, arguments: Any, axes: Any, **options: Any) -> Any:
    return primitive.bind(jnp.moveaxis(arguments[0], axes[0], 0), **options), 0


for _primitive in (_one_by_one, _spread):
    batching.primitive_batchers[_primitive] = partial(_batched, _primitive)
mlir.register_lowering(_spread, mlir.lower_fun(_everywhere, multiple_results=False))
mlir.register_lowering(_one_by_one, mlir.lower_fun(_sum, multiple_results=False))
mlir.register_lowering(_one_by_one, mlir.lower_fun(_added, multiple_results=False), platform="cpu")
