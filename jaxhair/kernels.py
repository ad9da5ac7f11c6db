"""Computations that a CPU runs as one kernel.

XLA's CPU runtime starts a kernel for every fused operation, and gives each element of a fusion all
that it needs, computed again: for a few hundred strands both take longer than the work itself.
`one_kernel` has a function compiled as one kernel, loops included, with its results stored. A
function inside of which another is called so computes what that one gives once. A step takes a
third of the time that it took without (`tests/benchmarks/peers.py`), and compiles faster.

How: a call with the frontend attribute `xla_cpu_small_call`, which XLA gives to small loops by
itself, is compiled as a single function. Not everything works inside; `_fits` knows what does.
What does not fit is left as it was, and so are derivatives; other platforms; other versions of XLA
than those tested; everything under the environment variable JAXHAIR_KERNELS=off; and whatever is
not inside of `allowed`. XLA was seen to abort the process on some programs with kernels, such as a
loop that a user writes around a simulation: they are for programs that are the library's own from
the outermost `jit` on, which its tests go through. Derivatives in forward mode were tried, too:
Jacobians took a third to two thirds of the time, and one of 64 strands whose small functions alone
were kernels ended the process ("All or none of the slices should have an explicit index").
"""

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxlib import version
from jaxlib.mlir import ir

F = TypeVar("F", bound=Callable[..., Any])

LARGEST = 3 * 2**13
"""Elements of the largest array in a kernel: XLA splits work on 2**15 and more between threads, or
gives it to a library, which it can do only outside."""

TESTED = ("0.10.1",)
"""Versions of jaxlib on which `tests/test_kernels.py` passes."""

INSIDE = frozenset(
    f"{dialect}.{name}"
    for dialect, names in {
        "func": "return",
        "chlo": "acos asin atan square",
        "stablehlo": """abs add and atan2 broadcast_in_dim ceil clamp compare concatenate constant
            convert cosine divide dynamic_slice dynamic_update_slice exponential
            exponential_minus_one floor iota is_finite log log_plus_one maximum minimum multiply
            negate not or pad power reduce remainder reshape return reverse rsqrt select sign sine
            slice sqrt subtract tan tanh transpose while""",
    }.items()
    for name in names.split()
)
"""Operations known to work: no sorting, scattering, gathering, matrix products or library calls."""

_ATTRIBUTES = {"xla_cpu_small_call": "true", "inlineable": "false"}
_FRONTEND = "mhlo.frontend_attributes"


def one_kernel(function: F) -> F:
    """`function`, a pure one of pytrees of arrays, compiled on a CPU as one kernel if it fits.

    Values are those of the function, to rounding, and derivatives its own.
    """

    @wraps(function)
    def with_touched(*arguments: Any) -> Any:
        return function(*arguments), _touched(arguments)

    compiled = jax.jit(with_touched)

    @wraps(function)
    def called(*arguments: Any) -> Any:
        if not used():
            return function(*arguments)
        results, touched = compiled(*arguments)
        leaves, structure = jax.tree.flatten(results)
        return jax.tree.unflatten(structure, _results.bind(*leaves, *touched, count=len(leaves)))

    return called  # type: ignore[return-value]


def _touched(arguments: Any) -> list[Array]:
    """The first element of each array. XLA aborts where it finds that a kernel does not need an
    argument, which a result in its own right prevents."""
    arrays = [jnp.asarray(x) for x in jax.tree.leaves(arguments)]
    return [lax.slice(x, (0,) * x.ndim, (1,) * x.ndim) for x in arrays if x.size]


_allowed = ContextVar("_allowed", default=False)


@contextmanager
def allowed(yes: bool = True) -> Iterator[None]:
    """While a program is traced inside, functions are compiled as kernels."""
    before = _allowed.set(yes)
    try:
        yield
    finally:
        _allowed.reset(before)


def used() -> bool:
    """Whether functions are compiled as kernels here."""
    on = _allowed.get() and os.environ.get("JAXHAIR_KERNELS", "on") != "off"
    return on and jax.default_backend() == "cpu" and version.__version__ in TESTED


# The results of a kernel, of those and its touched arguments. To lower it is to mark the call.
_results = Primitive("results_of_kernel")
_results.multiple_results = True
_results.def_impl(lambda *x, count: x[:count])
_results.def_abstract_eval(lambda *x, count: x[:count])


def _jvp(primals: Any, tangents: Any, *, count: int) -> Any:
    return list(primals[:count]), list(tangents[:count])


ad.primitive_jvps[_results] = _jvp  # derivatives are not marked
batching.primitive_batchers[_results] = lambda x, axes, count: (
    _results.bind(*x, count=count),
    axes[:count],
)
mlir.register_lowering(_results, lambda _, *x, count: x[:count], cacheable=False)


def mark(call: Any, attributes: dict[str, str]) -> None:
    """Gives a call of a lowered program the attributes that XLA's CPU compiler reads."""
    marks: dict[str, ir.Attribute] = {n: ir.StringAttr.get(x) for n, x in attributes.items()}
    call.operation.attributes[_FRONTEND] = ir.DictAttr.get(marks)


def _marked(context: mlir.LoweringRuleContext, *values: ir.Value[Any], count: int) -> Any:
    """Marks the call that made the values, if it fits into a kernel."""
    call = values[0].owner
    if isinstance(call, ir.Operation | ir.OpView) and call.operation.name == "func.call":
        unmarked = _FRONTEND not in call.operation.attributes
        if unmarked and _fits(context.module_context, call, True):
            mark(call, _ATTRIBUTES)
    return values[:count]


mlir.register_lowering(_results, _marked, platform="cpu", cacheable=False)


def _fits(module: mlir.ModuleContext, call: Any, touched: bool = False) -> bool:
    """Whether all in a call is known to work inside a kernel, on arrays small enough.

    touched: all arguments must be touched, as those of a kernel itself are.
    """
    callee = ir.FlatSymbolRefAttr(call.operation.attributes["callee"]).value
    body = module.symbol_table[callee].regions[0].blocks[0]
    if touched and not all(_is_result(x) for x in body.arguments):
        return False
    return all(_works(module, op) for op in body)


def _is_result(x: ir.Value[Any]) -> bool:
    """Whether an argument, or a part of it, is a result of its function."""
    users = [use.owner for use in x.uses]
    through = ("stablehlo.slice", "stablehlo.reshape")
    return any(
        user.operation.name == "func.return"
        or (user.operation.name in through and _is_result(user.operation.results[0]))
        for user in users
    )


def _works(module: mlir.ModuleContext, op: Any) -> bool:
    op = op.operation
    if op.name == "func.call":
        return _fits(module, op)
    arrays = (*op.results, *op.operands) if op.name == "stablehlo.reduce" else op.results
    if op.name not in INSIDE or not all(_sized(x) for x in arrays):
        return False
    return all(_works(module, o) for region in op.regions for block in region for o in block)


def _sized(x: ir.Value[Any]) -> bool:
    return math.prod(ir.RankedTensorType(x.type).shape) <= LARGEST
