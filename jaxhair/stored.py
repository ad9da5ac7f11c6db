"""Values that a program computes once.

XLA's CPU compiler joins operations to loops, in which each element is given all that it needs,
computed again: a product of quaternions, up to 16 times over where one is taken of another. Chains
of them, as derivatives are, took up to ten times as long as they need.
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
    """x, computed once and kept where several things are computed of it.

    In derivatives the same goes for tangents and cotangents. Kernels store all by themselves, and
    platforms other than the CPU choose by themselves.
    """
    return x if kernels.used() else _stored.bind(x)


@stored.defjvp
def _stored_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    return _stored.bind(primals[0]), _stored.bind(tangents[0])


_stored = Primitive("stored")
_stored.def_impl(lambda x: x)
_stored.def_abstract_eval(lambda x: x)
ad.deflinear2(_stored, lambda cotangent, _: [stored_cotangent(cotangent)])
batching.defvectorized(_stored)
mlir.register_lowering(_stored, lambda _, x: [x])


def once(function: F) -> F:
    """`function` with its results stored: a small one that kernels and derivatives call often."""
    as_kernel = kernels.one_kernel(function)

    @wraps(function)
    def called(*arguments: Any) -> Any:
        if kernels.used():
            return as_kernel(*arguments)
        return jax.tree.map(stored, function(*arguments))

    return called  # type: ignore[return-value]


def stored_cotangent(x):
    return x if isinstance(x, ad.Zero) else _stored.bind(x)


def _called(context: mlir.LoweringRuleContext, x: ir.Value) -> ir.OpResultList:
    """The result of a function that returns its argument, and is not inlined."""
    module = context.module_context
    with ir.InsertionPoint.at_block_begin(module.module.body):
        kind = ir.FunctionType.get([x.type], [x.type])
        function = func.FuncOp("stored", kind, visibility="private")
    name = module.symbol_table.insert(function)
    block = function.add_entry_block()
    with ir.InsertionPoint(block):
        func.ReturnOp(block.arguments)
    call = func.CallOp([x.type], ir.FlatSymbolRefAttr.get(name.value), [x])
    mark = {"inlineable": ir.StringAttr.get("false")}
    call.operation.attributes["mhlo.frontend_attributes"] = ir.DictAttr.get(mark)
    return call.results


mlir.register_lowering(_stored, _called, platform="cpu", cacheable=False)
