"""Strands in tiles and on two CPU devices: python tests/benchmarks/devices.py

Microseconds a step, the paper's solver with gravity, drag and a held root, float32; the least of
calls that take turns, compilation apart. Then the exponent of time against strands and points: 1
where time grows in proportion.
"""

from collections.abc import Callable
from typing import Any
from unittest import mock

import jax
import numpy as np
from measure import in_turn

import jaxhair as jh
from jaxhair import tiles
from jaxhair.kernels import allowed
from jaxhair.simulate import advance, prepare, start

SIZES = ((200, 9), (100, 17), (10_000, 9), (10_000, 16), (1_000, 100))
STRANDS = (100, 200, 500, 1_000, 2_000, 5_000, 10_000)
POINTS = (5, 9, 17, 33, 65, 129, 257, 500)
EFFECTS = (jh.Gravity(), jh.Drag(2.8), jh.Hold())
SECONDS = 4.0  # of each comparison


def steps(strands: int, points: int, devices: int, whole: bool) -> tuple[Callable[[], Any], int]:
    """A compiled simulation of some steps, and their number."""
    roots = np.random.default_rng(0).normal(size=(strands, 3)) * 0.1
    hair = jh.Strands.straight(roots, (1, 0, 0), length=0.03 * (points - 1), points=points)
    scene = jh.Scene(hair).as_arrays()
    number = max(4, min(100, 1_000_000 // (strands * points)))

    def end(scene: jh.Scene) -> Any:
        return advance(prepare(scene, EFFECTS, devices), start(scene), 0, steps=number)

    tiling = (lambda strands, *_: (1, strands)) if whole else tiles.tiling
    with mock.patch.object(tiles, "tiling", tiling), allowed():
        compiled = jax.jit(end).lower(scene).compile()
    if devices > 1:  # where the program wants them
        scene = jax.device_put(scene, compiled.input_shardings[0][0])
    return lambda: compiled(scene), number


def least(simulations: list[tuple[Callable[[], Any], int]]) -> np.ndarray:
    """Least time of a step [us] of each."""
    runs, numbers = zip(*simulations, strict=True)
    taken = in_turn(*runs, times=10_000, longest=SECONDS).min(axis=0)
    return 1e6 * taken / np.array(numbers)


def exponents(sizes: tuple[int, ...], taken: np.ndarray) -> str:
    slopes = np.diff(np.log(taken)) / np.diff(np.log(sizes))
    whole = np.polyfit(np.log(sizes), np.log(taken), 1)[0]
    return f"{whole:.2f}; between neighbours " + " ".join(f"{s:.2f}" for s in slopes)


def main() -> None:
    jax.config.update("jax_num_cpu_devices", 2)
    print(f"jax {jax.__version__}, {len(jax.devices())} x {jax.devices()[0].device_kind}")
    print("strands x points: us a step, and over that of one device, whole")
    for strands, points in SIZES:
        kinds = {"1, whole": (1, True), "1, tiles": (1, False)}
        kinds |= {"2, whole": (2, True), "2, tiles": (2, False)}
        taken = least([steps(strands, points, *kind) for kind in kinds.values()])
        for kind, x in zip(kinds, taken, strict=True):
            print(f"  {strands:6d} x {points:3d}  {kind}  {x:8.0f}  {x / taken[0]:.2f}", flush=True)
    for name, numbers, sizes in (
        ("strands, 9 points", STRANDS, [(n, 9) for n in STRANDS]),
        ("points, 64 strands", POINTS, [(64, n) for n in POINTS]),
    ):
        taken = least([steps(*size, 1, False) for size in sizes])
        each = ", ".join(f"{n}: {x:.0f} us" for n, x in zip(numbers, taken, strict=True))
        print(f"{name}  {each}\n  exponent {exponents(numbers, taken)}", flush=True)


if __name__ == "__main__":
    main()
