"""What the direct solver costs beside the paper's: python tests/benchmarks/solvers.py

Ratios of times within one run, taken in turn, float32, medians; compilation apart. Both solvers
have the same physical fibre and hang from their roots.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import in_turn

import jaxhair as jh
from jaxhair.simulate import phase_end, start
from jaxhair.treatments import AT_ONCE

SIZES = ((1, 33), (64, 33), (200, 33))
EDGE = 5e-3
SOLVERS = {
    "paper's, 5 iterations": jh.PositionBased(),
    "compliant, 5 iterations": jh.Compliant(),
    "direct": jh.Direct(),
    "direct, 2 Newton steps": jh.Direct(newton_steps=2),
}


def hair(strands: int, points: int) -> jh.Strands:
    return jh.Strands.straight(
        np.zeros((strands, 3)), (0.0, 0.1, -1.0), length=EDGE * (points - 1), points=points
    )


def steps(strands: int, points: int, solver: Any, count: int) -> Callable[[], Any]:
    """Some steps of hanging strands, as a call."""
    hang = jh.Phase("hang", 1.0, (jh.Hold(), jh.Gravity(), jh.Drag(0.1)))
    scene = jh.Scene(hair(strands, points), jh.PhysicalFibre(), phases=(hang,), solver=solver)
    scene = scene.as_arrays()
    bare, state = replace(scene, phases=()), start(scene)
    return lambda: phase_end(bare, scene.phases[0].effects, state, steps=count, kernels=True)


def released(strands: int) -> tuple[Callable[[Any], Any], Any]:
    """The final shape of permed strands after 120 steps, by 5 numbers, and where to take it.

    Called outside of a `jit`, it has kernels, as a simulation has.
    """
    rod, kinds = jh.Wound(20e-3, 0.1), {"hydrogen": 1.0, "ionic": 1.0, "disulfide": 1.0}
    phases = (
        jh.Phase("wound", AT_ONCE, (rod, jh.Cut(hydrogen=0.0, ionic=0.0, disulfide=0.8))),
        jh.Phase("set", AT_ONCE, (rod, jh.Reform(**kinds))),
        jh.Phase("released", 120 / 360, (jh.Hold(), jh.Gravity(), jh.Drag(0.1))),
    )
    scene = jh.Scene(hair(strands, 33), phases=phases, solver=jh.Direct()).as_arrays()
    f, e = jnp.asarray(scene.bonds.influence), jnp.asarray(scene.fibre.young_modulus)

    def shape(x: Any) -> Any:
        values = {
            "bonds.influence": f * jnp.exp(x[:4]),
            "fibre.young_modulus": e * jnp.exp(x[4]),
        }
        return jh.run(jh.replace_leaves(scene, values))["released"].positions

    return shape, jnp.zeros(5, scene.dtype)


def main() -> None:
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}")
    print("\ntime of a step: us, and the median of the ratios to the paper's solver")
    for strands, points in SIZES:
        runs = [steps(strands, points, solver, 50) for solver in SOLVERS.values()]
        taken = in_turn(*runs, times=21).T
        for name, x in zip(SOLVERS, taken, strict=True):
            ratio = np.median(x / taken[0])
            print(
                f"  {strands:3d} x {points}  {name:<24} {1e6 * np.median(x) / 50:7.0f} {ratio:5.2f}"
            )
    print("\nderivatives of a permed shape, 33 points, 120 steps: ratios to the forward run")
    for strands in (1, 64):
        shape, at = released(strands)
        jacobian = jax.jit(jax.jacfwd(shape))
        gradient = jax.jit(jax.grad(lambda x, shape=shape: jnp.sum(shape(x) ** 2)))
        forward, *derivatives = in_turn(
            lambda f=shape, at=at: f(at),
            lambda f=jacobian, at=at: f(at),
            lambda f=gradient, at=at: f(at),
            times=11,
        ).T
        names = ("Jacobian for 5 parameters", "reverse-mode gradient")
        for name, x in zip(names, derivatives, strict=True):
            print(f"  {strands:3d} strands  {name:<26} {np.median(x / forward):5.2f}")


if __name__ == "__main__":
    main()
