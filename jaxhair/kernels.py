"""Computations that a CPU runs as one kernel.

XLA's CPU runtime starts a kernel for each fused operation, some microseconds each: for a few
hundred strands more than the work in it. A call with the frontend attribute `xla_cpu_small_call`,
which XLA gives to calls of its own, is compiled as a single function instead, loops included. It
cannot hold everything: `_fits` says what. What does not fit, and other platforms, are left as they
were. Measured at 200 strands of 9 points: see `tests/benchmarks/peers.py`.
"""

from collections.abc import Callable
from functools import cache, partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxlib.mlir import ir

F = TypeVar("F", bound=Callable[..., Any])

LARGEST = 3 * 2**13
"""Elements of an array in a kernel; XLA splits work on 2**15 and more among threads, which it
cannot do inside."""

ATTRIBUTES = {"xla_cpu_small_call": "true", "inlineable": "false"}

INSIDE = frozenset(
    f"{dialect}.{name}"
    for dialect, names in {
        "func": "return",
        "chlo": "acos asin atan square",
        "stablehlo": """abs add and atan2 broadcast_in_dim cbrt ceil clamp compare concatenate
            constant convert cosine divide dynamic_slice dynamic_update_slice exponential
            exponential_minus_one floor iota is_finite log log_plus_one maximum minimum multiply
            negate not or pad power reduce remainder reshape return reverse round_nearest_even rsqrt
            select sign sine slice sqrt subtract tan tanh transpose while xor""",
    }.items()
    for name in names.split()
)
"""Operations known to work: no sorting, scattering, gathering, matrix products or library calls."""


def one_kernel(function: F) -> F:
    """`function`, a pure one of pytrees of arrays, compiled on a CPU as one kernel where it fits.

    Its derivatives are compiled so too, forward and reverse. Values are the same to rounding.
    """
    jitted = jax.jit(function)

    def called(*arguments: Any) -> Any:
        if not _understood():
            return function(*arguments)
        return jax.tree.map(_leaves.bind, jitted(*arguments))

    return called  # type: ignore[return-value]


# An identity. Compiling it marks the call that its value comes from.
_leaves = Primitive("leaves_kernel")
_leaves.def_impl(lambda x: x)
_leaves.def_abstract_eval(lambda x: x)
ad.deflinear2(_leaves, lambda ct, _: (ct,))
batching.defvectorized(_leaves)
mlir.register_lowering(_leaves, lambda ctx, x: [x], cacheable=False)


def _mark(ctx: mlir.LoweringRuleContext, value: ir.Value) -> list[ir.Value]:
    """Marks the call that made the value, if it fits into a kernel."""
    call = value.owner
    if isinstance(call, ir.Operation | ir.OpView) and call.operation.name == "func.call":
        attributes = call.operation.attributes
        if "mhlo.frontend_attributes" not in attributes and _fits(ctx.module_context, call):
            marks = {name: ir.StringAttr.get(text) for name, text in ATTRIBUTES.items()}
            attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(marks)
    return [value]


mlir.register_lowering(_leaves, _mark, platform="cpu", cacheable=False)


def _fits(module: mlir.ModuleContext, call: Any) -> bool:
    """Whether all operations in a call are known to work inside a kernel, on arrays small enough."""
    name = ir.FlatSymbolRefAttr(call.operation.attributes["callee"]).value
    return all(_works(module, op) for op in module.symbol_table[name].operation.regions[0].blocks[0])


def _works(module: mlir.ModuleContext, op: Any) -> bool:
    op = op.operation
    if op.name == "func.call":
        return _fits(module, op)
    sizes = op.results if op.name != "stablehlo.reduce" else (*op.results, *op.operands)
    if op.name not in INSIDE or any(_elements(x.type) > LARGEST for x in sizes):
        return False
    inner = [o for region in op.regions for block in region.blocks for o in block]
    return all(_works(module, o) for o in inner)


def _elements(kind: ir.Type) -> int:
    size = 1
    for extent in ir.RankedTensorType(kind).shape:
        size *= extent
    return size


@cache
def _understood() -> bool:
    return jax.default_backend() == "cpu"
