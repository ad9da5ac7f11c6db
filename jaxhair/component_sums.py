"""The sum of a vector's components, on a CPU added one by one where XLA would not.

From jaxlib 0.11 on XLA's CPU compiler gives sums along an axis to a library (YNNPACK) once arrays
are large, which takes many times as long for three or four components: a Jacobian of 64 strands of
33 points took 4 times as long (`tests/benchmarks/solvers.py`). Added one by one, sums would be
computed again in every loop that needs them, and so are stored.
"""

from functools import reduce
from typing import Any

import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxlib import version

from jaxhair.stored import stored

ONE_BY_ONE = tuple(int(x) for x in version.__version__.split(".")[:2]) >= (0, 11)
"""Whether components are added one by one: with older versions gradients would take longer."""


def component_sum(x: Array) -> Array:
    """The sum over the component axis, the last but one, which is kept with size 1."""
    return stored(one_by_one(x)) if ONE_BY_ONE else jnp.sum(x, axis=-2, keepdims=True)


def one_by_one(x: Array) -> Array:
    """`component_sum`, added one by one on a CPU; its derivatives are those of a sum."""
    total: Array = _one_by_one.bind(jnp.asarray(x))
    return total


def _sum(x: Array) -> Array:
    return jnp.sum(x, axis=-2, keepdims=True)


def _added(x: Array) -> Array:
    return reduce(jnp.add, lax.split(x, (1,) * x.shape[-2], axis=x.ndim - 2))


# A primitive, for its derivative in reverse mode to be that of a sum: a broadcast, and not parts
# that are joined.
_one_by_one = Primitive("component_sum")
_one_by_one.def_impl(_added)
_one_by_one.def_abstract_eval(lambda x: x.update(shape=(*x.shape[:-2], 1, x.shape[-1])))


def _transposed(cotangent: Any, x: Any) -> Any:
    zero = isinstance(cotangent, ad.Zero)
    return [ad.Zero(x.aval) if zero else jnp.broadcast_to(cotangent, x.aval.shape)]


ad.deflinear2(_one_by_one, _transposed)


def _batched(arguments: Any, axes: Any) -> Any:
    return _one_by_one.bind(jnp.moveaxis(arguments[0], axes[0], 0)), 0


batching.primitive_batchers[_one_by_one] = _batched
mlir.register_lowering(_one_by_one, mlir.lower_fun(_sum, multiple_results=False))
mlir.register_lowering(_one_by_one, mlir.lower_fun(_added, multiple_results=False), platform="cpu")
