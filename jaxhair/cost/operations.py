"""Floating-point operations of a step, as traced.

XLA counts them in the program before it optimises, so that the number depends on no machine and
adds up. It counts the body of a loop once, whatever the trips; here they are multiplied in. A loop
whose length depends on values, of which JAX knows no number of trips, counts once.
"""

from collections.abc import Iterator
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, jaxpr_as_fun
from jax.interpreters import partial_eval

from jaxhair.effects import Effect
from jaxhair.scene import Scene
from jaxhair.simulate import Setup, advance, prepare
from jaxhair.strands import State


def of_a_step(scene: Scene, effects: tuple[Effect, ...], state: State) -> float:
    """Operations of one step of a phase, without those that prepare the phase.

    Arguments:
        scene: as arrays. state: that its steps take; both only by their shapes.
    """
    setup = jax.eval_shape(prepare, scene, effects)

    def one(setup: Setup, state: State) -> State:
        return advance(setup, state, 0, steps=1)

    return counted(jax.make_jaxpr(one)(setup, state))


def counted(program: ClosedJaxpr) -> float:
    """Operations of a traced program, without what its results do not need."""
    jaxpr, _ = partial_eval.dce_jaxpr(
        program.jaxpr, [True] * len(program.jaxpr.outvars), instantiate=True
    )
    return _counted(ClosedJaxpr(jaxpr, program.consts))


def _counted(program: ClosedJaxpr) -> float:
    analysis = jax.jit(jaxpr_as_fun(program)).lower(*program.in_avals).cost_analysis()
    # Some devices' compilers do not count, and some programs have nothing to count.
    once = float("nan") if analysis is None else float(analysis.get("flops", 0.0))
    return once + _repetitions(program)


def _repetitions(program: ClosedJaxpr) -> float:
    """What the loops of a program do after their first trip."""
    total = 0.0
    for equation in program.jaxpr.eqns:
        for inner in _inside(equation.params):
            total += _repetitions(inner)
            if equation.primitive.name == "scan":
                total += (equation.params["length"] - 1) * _counted(inner)
    return total


def _inside(parameters: dict[str, Any]) -> Iterator[ClosedJaxpr]:
    """The programs that an operation holds."""
    for value in parameters.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, ClosedJaxpr):
                yield item
            elif isinstance(item, Jaxpr):
                yield ClosedJaxpr(item, ())
