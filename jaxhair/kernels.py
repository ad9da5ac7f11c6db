"""Computations that a CPU runs as one kernel.

XLA's CPU runtime starts a kernel for every fused operation, and gives each element of a fusion all
that it needs, computed again: for a few hundred strands both take longer than the work itself.
`one_kernel` has a function compiled as one kernel, loops included, with its results stored. A
function inside of which another is called so computes what that one gives once. A step takes a
third of the time that it took without (`tests/benchmarks/peers.py`), and compiles faster.

How: a call with the frontend attribute `xla_cpu_small_call`, which XLA gives to small loops by
itself, is compiled as a single function. Not everything works inside; `_fits` knows what does.
What does not fit is left as it was, and so are other platforms, other versions of XLA than those
tested, the transposed functions of reverse mode (XLA was seen to abort on those), and everything
under the environment variable JAXHAIR_KERNELS=off.
"""

import os
from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import jax
from jax import Array
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


def one_kernel(function: F) -> F:
    """`function`, a pure one of pytrees of arrays, compiled on a CPU as one kernel if it fits.

    Values and derivatives are those of the function, to rounding.
    """
    compiled = jax.jit(function)

    @wraps(function)
    def called(*arguments: Any) -> Any:
        if not used():
            return function(*arguments)
        return jax.tree.map(_result_of_kernel, compiled(*arguments))

    return called  # type: ignore[return-value]


def used() -> bool:
    """Whether functions are compiled as kernels here."""
    on = os.environ.get("JAXHAIR_KERNELS", "on") != "off"
    return on and jax.default_backend() == "cpu" and version.__version__ in TESTED


# An identity. To lower it is to mark the call that its value comes from.
_identity = Primitive("result_of_kernel")
_identity.def_impl(lambda x: x)
_identity.def_abstract_eval(lambda x: x)
ad.deflinear2(_identity, lambda cotangent, _: (cotangent,))
batching.defvectorized(_identity)
mlir.register_lowering(_identity, lambda context, x: [x], cacheable=False)


def _result_of_kernel(x: Array) -> Array:
    result: Array = _identity.bind(x)
    return result


def _mark(context: mlir.LoweringRuleContext, value: ir.Value[Any]) -> list[ir.Value[Any]]:
    """Marks the call that made a value, if it fits into a kernel."""
    call = value.owner
    if isinstance(call, ir.Operation | ir.OpView) and call.operation.name == "func.call":
        attributes = call.operation.attributes
        if "mhlo.frontend_attributes" not in attributes and _fits(context.module_context, call):
            marks: dict[str, ir.Attribute] = {
                n: ir.StringAttr.get(x) for n, x in _ATTRIBUTES.items()
            }
            attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(marks)
    return [value]


mlir.register_lowering(_identity, _mark, platform="cpu", cacheable=False)


def _fits(module: mlir.ModuleContext, call: Any) -> bool:
    """Whether all in a call is known to work inside a kernel, on arrays small enough."""
    callee = ir.FlatSymbolRefAttr(call.operation.attributes["callee"]).value
    return all(_works(module, op) for op in module.symbol_table[callee].regions[0].blocks[0])


def _works(module: mlir.ModuleContext, op: Any) -> bool:
    op = op.operation
    if op.name == "func.call":
        return _fits(module, op)
    arrays = (*op.results, *op.operands) if op.name == "stablehlo.reduce" else op.results
    if op.name not in INSIDE or any(_elements(x.type) > LARGEST for x in arrays):
        return False
    return all(_works(module, o) for region in op.regions for block in region for o in block)


def _elements(kind: ir.Type) -> int:
    size = 1
    for extent in ir.RankedTensorType(kind).shape:
        size *= extent
    return size
