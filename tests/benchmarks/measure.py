"""The figures that the README quotes: python tests/benchmarks/measure.py

Stretch of hanging strands, time of a step of each scene with and without contact, and what
derivatives cost against a forward run. Float32, medians, compilation apart.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxhair as jh
from jaxhair.simulate import phase_end, start


def in_turn(
    *runs: Callable[[], Any], times: int = 200, longest: float = np.inf, least: int = 4
) -> np.ndarray:
    """Wall times of calls [s], shape (times, runs), after one of each that compiles.

    They take turns, because a ratio of two should not tell what else the machine did meanwhile.

    Arguments:
        times: each call is made. longest: that all may take [s], once each was made `least` times.
    """
    for run in runs:
        jax.block_until_ready(run())
    taken: list[list[float]] = []
    since = time.perf_counter()
    while len(taken) < times and (len(taken) < least or time.perf_counter() - since < longest):
        taken.append([])
        for run in runs:
            begin = time.perf_counter()
            jax.block_until_ready(run())
            taken[-1].append(time.perf_counter() - begin)
    return np.array(taken)


def seconds(run: Callable[[], Any], times: int = 5) -> float:
    """Median wall time of a call, after one that compiles."""
    return float(np.median(in_turn(run, times=times)))


def stretch(points: int, edge: float, iterations: int) -> float:
    """How much too long a strand hangs after 3 s, relative."""
    length = edge * (points - 1)
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=length, points=points)
    phase = jh.Phase("hang", 3.0, jh.treatments.HANGING)
    scene = jh.Scene(hair, phases=(phase,), solver=jh.PositionBased(iterations=iterations))
    x = np.asarray(jh.run(scene)["hang"].points[0])
    return float(np.linalg.norm(np.diff(x, axis=0), axis=1).sum() / length - 1)


def step_time(scene: jh.Scene, phase: jh.Phase, steps: int) -> float:
    """Seconds a step in one phase of a scene."""
    scene = scene.as_arrays()
    bare, state = replace(scene, phases=()), start(scene)
    return seconds(lambda: phase_end(bare, phase.effects, state, steps=steps, kernels=True)) / steps


def main() -> None:
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}")
    print("\nstretch of a hanging strand")
    for points, edge in ((9, 30e-3), (33, 5e-3)):
        for iterations in (5, 20):
            found = 100 * stretch(points, edge, iterations)
            print(f"  {points:3d} points {1e3 * edge:.0f} mm apart, {iterations:2d} iterations: "
                  f"{found:.2f} %")  # fmt: skip
    print("\ntime of a step [us], without and with contact")
    for name, make in jh.scenes.SCENES.items():
        times = []
        for contact in (False, True):
            scene = make(contact=contact)
            times.append(1e6 * step_time(scene, scene.phases[-1], 40))
        strands = f"{scene.strands.count} x {scene.strands.points}"
        print(f"  {name:<9} {strands:>9}: {times[0]:8.0f} {times[1]:8.0f}")
    print("\ncost of derivatives, in forward runs (200 x 9, 120 steps, no contact)")
    scene = jh.scenes.perm(strands=200, points=9, length=0.24, contact=False, seconds=1 / 3)
    scene = replace(scene, phases=scene.phases[-1:]).as_arrays()

    def loss(influence: Any) -> Any:
        changed = jh.replace_leaves(scene, {"bonds.influence": influence})
        return jnp.sum(jh.run(changed)["released"].positions ** 2)

    at = jnp.asarray(scene.bonds.influence)
    forward = seconds(lambda: loss(at))  # outside of a `jit`, with kernels, as a simulation is
    programs = {
        "reverse": jax.jit(jax.grad(loss)),
        "forward, 4 parameters": jax.jit(jax.jacfwd(loss)),
    }
    for name, program in programs.items():
        print(f"  {name}: {seconds(lambda program=program: program(at)) / forward:.1f}")


if __name__ == "__main__":
    main()
