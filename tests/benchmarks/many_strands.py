"""Fits of many strands at once: python tests/benchmarks/many_strands.py

Strands of 20 cm and 32 points, each permed on a rod of its own, of hair of its own stiffness, worn
by its own peeling rate; seen as they hang after the perm with 0.1 mm of noise. From their shapes
all three numbers of each strand are found again. `--tiles` times an evaluation for some tiles,
with which `fitting.tiles.TILE` was chosen.
"""

import argparse
import time
from typing import Any

import jax
import numpy as np

import fitting
import jaxhair as jh
from fitting import tiles
from fitting.many import FitEach, fit_each

NOISE = 1e-4  # m
ROD, RATE, MODULUS = "phases.*.Wound.diameter", "fibre.peeling_rate", "fibre.young_modulus"
FREE: dict[str, fitting.Constraint] = {
    ROD: fitting.Interval(8e-3, 40e-3),
    RATE: fitting.Positive(),
    MODULUS: fitting.Positive(),
}


def experiment(strands: int, points: int, seconds: float) -> jh.Scene:
    """Straight hair that is permed on 18 mm rods and hangs."""
    roots = np.zeros((strands, 3))
    roots[:, 1] = 2e-3 * np.arange(strands)
    hair = jh.Strands.straight(roots, (0.0, 0.0, -1.0), length=0.2, points=points, dtype="float32")
    phases = jh.treatments.perm(rod_diameter=18e-3, climb=0.2, seconds=seconds)
    fibre = jh.PhysicalFibre(peeling_rate=1.0)
    return jh.Scene(hair, fibre, phases=phases, solver=jh.Direct(), dt=1 / 180)


def truths(strands: int, seed: int = 0) -> dict[str, np.ndarray]:
    """What is to be found again."""
    rng = np.random.default_rng(seed)
    return {
        ROD: rng.uniform(14e-3, 24e-3, strands),
        RATE: rng.uniform(0.5, 2.5, strands),
        MODULUS: 3.89e9 * np.exp(rng.normal(0, 0.2, strands)),
    }


def observed(scene: jh.Scene, truth: dict[str, np.ndarray], seed: int = 1) -> np.ndarray:
    """Points at the end of the perm with noise [m], shape (strands, points, 3)."""
    leaves, structure = jax.tree.flatten(scene.as_arrays())
    names = list(jh.named_leaves(scene))
    for i, name in enumerate(names):
        if name in truth:
            leaves[i] = truth[name].astype(np.float32)
        elif name.endswith("Wound.diameter"):
            leaves[i] = truth[ROD].astype(np.float32).reshape(1, 1, -1)
    ends = jax.jit(lambda leaves: jh.run(jax.tree.unflatten(structure, leaves)))(leaves)
    points = np.asarray(ends["perm"].points, float)
    return points + np.random.default_rng(seed).normal(0, NOISE, points.shape)


def recovered(found: FitEach, truth: dict[str, np.ndarray]) -> None:
    """Prints how near the truth the values are, and how often within their intervals."""
    for name, true in truth.items():
        off = found.values[name] - true
        inside = np.abs(off) < 1.96 * found.errors[name]
        relative = np.quantile(np.abs(off / true)[found.fitted], (0.5, 0.95))
        print(
            f"{name}: off by {relative[0]:.2%} (median), {relative[1]:.2%} (95 %); "
            f"{inside[found.fitted].mean():.1%} of 95 % intervals hold the truth"
        )


def timed_tiles(scene: jh.Scene, targets: Any) -> None:
    """Prints the time of an evaluation of all strands for some sizes of tiles."""
    parameters = tiles.freed(scene, FREE)
    start = np.concatenate([tiles.numbers(p) for p in parameters], axis=1)
    everyone = np.arange(len(start))
    for tile in (8, 16, 32, 64, 128, 256):
        problem = tiles.Tiles(scene, targets, parameters, 0.1, tile)
        begin = time.perf_counter()
        problem.evaluate(start[:tile], everyone[:tile])
        compiled = time.perf_counter()
        problem.evaluate(start, everyone)
        seconds = time.perf_counter() - compiled
        print(
            f"tile {tile}: first {compiled - begin:.1f} s, then {seconds:.2f} s, "
            f"{1e3 * seconds / len(start):.2f} ms a strand",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--strands", type=int, default=1000)
    parser.add_argument("--points", type=int, default=32)
    parser.add_argument("--seconds", type=float, default=1.0, help="that the hair hangs")
    parser.add_argument("--tile", type=int)
    parser.add_argument("--tiles", action="store_true", help="time tiles instead of fitting")
    options = parser.parse_args()
    scene = experiment(options.strands, options.points, options.seconds)
    truth = truths(options.strands)
    targets = {"perm": fitting.Shape(observed(scene, truth))}
    if options.tiles:
        timed_tiles(scene, targets)
        return
    begin = time.perf_counter()
    found = fit_each(
        scene,
        targets,
        FREE,
        tile=options.tile,
        progress=lambda step, mm: print(
            f"{time.perf_counter() - begin:6.1f} s: simulation {step}, residual {mm:.3f} mm",
            flush=True,
        ),
    )
    print(found)
    recovered(found, truth)
    print("steps:", np.bincount(found.steps))


if __name__ == "__main__":
    main()
