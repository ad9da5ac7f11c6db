"""Values that a program computes once.

XLA's CPU compiler joins operations into loops, and gives each element of a loop all that it needs,
computed again: one of a product of quaternions needs all of both. Through products of products, as
derivatives are, that made gradients take 1.6 to 4 times as long (`tests/benchmarks/peers.py`).
`stored` ends a loop. How: a call of a function that returns its argument, marked as not to be
inlined. XLA's own barrier, `lax.optimization_barrier`, is gone before loops are joined.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any, TypeVar

import jax
from jax import Array
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxlib.mlir import ir
from jaxlib.mlir.dialects import func

from jaxhair import kernels

F = TypeVar("F", bound=Callable[..., Any])


@jax.custom_jvp
def stored(x: Array) -> Array:
    """x, computed once and kept; and so are its tangents and cotangents.

    To be put where something is taken apart or used several times, inside of loops first of all.
    Kernels store all by themselves. On other platforms than the CPU it is x.
    """
    return x if kernels.used() else _stored.bind(x)


@stored.defjvp
def _stored_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return _stored.bind(*primals), _stored.bind(*tangents)


def once(function: F) -> F:
    """`function`, a small one, with its results stored, inside of kernels and outside."""
    kernel = kernels.one_kernel(function)

    @wraps(function)
    def called(*arguments: Any) -> Any:
        if kernels.used():
            return kernel(*arguments)
        return jax.tree.map(stored, function(*arguments))

    return called  # type: ignore[return-value]


_stored = Primitive("stored")
_stored.def_impl(lambda x: x)
_stored.def_abstract_eval(lambda x: x)
ad.deflinear2(_stored, lambda ct, _: [ct if isinstance(ct, ad.Zero) else _stored.bind(ct)])
batching.defvectorized(_stored)
mlir.register_lowering(_stored, lambda _, x: [x])


def _called(context: mlir.LoweringRuleContext, x: ir.Value[Any]) -> Any:
    """The result of a call of a function that returns its argument."""
    module = context.module_context
    with ir.InsertionPoint.at_block_begin(module.module.body):
        kind = ir.FunctionType.get([x.type], [x.type])
        function: Any = func.FuncOp("stored", kind)
    function.attributes["sym_visibility"] = ir.StringAttr.get("private")
    name = module.symbol_table.insert(function)
    block = function.add_entry_block()
    with ir.InsertionPoint(block):
        func.ReturnOp(block.arguments)
    call = func.CallOp([x.type], ir.FlatSymbolRefAttr.get(name.value), [x])
    kernels.mark(call, {"inlineable": "false"})
    return call.results


mlir.register_lowering(_stored, _called, platform="cpu", cacheable=False)
