"""Gradients over long times, and what contact does to them: python tests/benchmarks/horizon.py

First table: root mean square derivative of a permed strand's points [m] in the logarithm of five
numbers (f_j, s, stiffness, rod diameter, together) after so many steps of a damped motion.
Second table: derivative of the mean height of four strands, 1 s after their release, in the rod's
diameter, over 61 diameters from 27 to 33 mm. "slope" is that of a line through the values, "mean"
the mean derivative, "roughness" the derivatives' scatter about a parabola over their mean.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxhair as jh

DIAMETERS = ("phases.perm, wound.Wound.diameter", "phases.perm, set.Wound.diameter")
STEPS = (20, 100, 200, 500, 1000, 2000)
CONTACTS: dict[str, tuple[Any, ...]] = {
    "no contact": (),
    "ball": (jh.Sphere((0.03, 0.0, -0.12), 0.04, 0.3),),
    "hair": (jh.HairContact(3e-3, 20.0),),
    "hair, in_gradients=False": (jh.HairContact(3e-3, 20.0, in_gradients=False),),
    "soft hair": (jh.HairContact(3e-3, 5.0),),
    "soft hair, in_gradients=False": (jh.HairContact(3e-3, 5.0, in_gradients=False),),
}


def permed(solver: Any, contact: tuple[Any, ...], *, strands: int, steps: int) -> jh.Scene:
    """Strands of 24 cm and 17 points released from a 30 mm rod, in air."""
    roots = np.zeros((strands, 3))
    roots[:, 1] = 0.003 * np.arange(strands)
    hair = jh.Strands.straight(roots, (0.02, 0, -1.0), length=0.24, points=17, dtype="float64")
    free = (jh.Hold(), jh.Gravity(), jh.Drag(0.2), *contact)
    phases = jh.treatments.perm(
        rod_diameter=0.03, climb=0.1, seconds=steps / 360, free=free, unload=False
    )
    return jh.Scene(hair, phases=phases, solver=solver)


def norms(solver: Any) -> list[float]:
    """Of the derivative after each number of steps."""
    scene = permed(solver, (), strands=1, steps=max(STEPS))
    stiffness = "fibre.young_modulus" if solver.compliant else "fibre.stiffness"
    names = ("bonds.influence", "fibre.peeling_rate", stiffness, *DIAMETERS)
    leaves = jh.named_leaves(scene)
    at = {name: jnp.asarray(leaves[name], float) for name in names}

    def points(logarithms: dict[str, Any]) -> Any:
        values = {name: at[name] * jnp.exp(logarithms[name]) for name in names}
        values[DIAMETERS[1]] = values[DIAMETERS[0]]
        return jh.simulate(jh.replace_leaves(scene, values), fps=18).positions

    zero = jax.tree.map(jnp.zeros_like, at)
    slopes = jax.tree.leaves(jax.jit(jax.jacfwd(points))(zero))
    square = sum(np.sum(np.asarray(s) ** 2, axis=tuple(range(1, s.ndim))) for s in slopes)
    count = slopes[0].shape[1] * slopes[0].shape[2]
    return [float(np.sqrt(square[2 + n // 20] / count)) for n in STEPS]


def roughness(solver: Any, contact: tuple[Any, ...]) -> tuple[float, float, float]:
    """Slope of the values, mean derivative, and the derivatives' scatter over their mean."""
    scene = permed(solver, contact, strands=4, steps=360)

    def height(diameter: Any) -> Any:
        changed = jh.replace_leaves(scene, dict.fromkeys(DIAMETERS, diameter))
        return jnp.mean(jh.run(changed)["perm"].points[..., 2])

    at = jnp.linspace(0.027, 0.033, 61)
    both = jax.jit(jax.vmap(lambda d: jax.jvp(height, (d,), (jnp.ones(()),))))(at)
    values, slopes = (np.asarray(x) for x in both)
    rest = slopes - np.polyval(np.polyfit(at, slopes, 2), at)
    mean = float(slopes.mean())
    return float(np.polyfit(at, values, 1)[0]), mean, float(rest.std() / abs(mean))


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    print(f"{'steps':>32s}" + "".join(f"{n:>10d}" for n in STEPS))
    for solver in (jh.PositionBased(), jh.Compliant(), jh.Direct()):
        print(f"{type(solver).__name__:>32s}" + "".join(f"{x:10.3g}" for x in norms(solver)))
    print(f"\n{'Direct, contact':>32s}{'slope':>10s}{'mean':>10s}{'roughness':>11s}")
    for name, contact in CONTACTS.items():
        slope, mean, rough = roughness(jh.Direct(), contact)
        print(f"{name:>32s}{slope:10.3g}{mean:10.3g}{rough:11.2g}")


if __name__ == "__main__":
    main()
