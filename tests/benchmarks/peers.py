"""A step's time beside other programs': python tests/benchmarks/peers.py PEERS [--python PYTHON]

PEERS is the folder of the peers' programs, each of which simulates the same scene: strands clamped
at their roots, gravity, 5 iterations, a rest shape of four bonds, of which two kinds re-form.
PYTHON is an interpreter that has numba, if this one does not. Microseconds a step, the least of
many runs, float32, compilation apart; ratios to vectorised Numba on as many threads.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import jaxhair as jh
from jaxhair.simulate import phase_end, start

SIZES = ((200, 9), (100, 17), (10_000, 9), (1_000, 100))
WIDTH = {"xla_cpu_prefer_vector_width": 512}
SOLVERS = {
    "red-black": jh.PositionBased(),
    "sequential": jh.PositionBased(sweep="sequential"),
    "direct": jh.Direct(),
}
OTHERS = {"numba, vectorised": "nb_flat.py", "numba, plain": "nb_rods.py"}


def scene(strands: int, points: int, solver: Any) -> jh.Scene:
    """The peers' scene."""
    roots = 0.01 * np.random.default_rng(0).normal(size=(strands, 3))
    length = 0.03 * (points - 1)
    hair = jh.Strands.straight(roots.astype(np.float32), (1, 0, 0), length=length, points=points)
    rising = jh.Reform(hydrogen=1.0, disulfide=1.0, rate=0.5)
    effects = (jh.Gravity(), jh.Hold(), rising, jh.Drag(2.8))
    bonds = jh.Bonds((1.0, 0.5, 0.3, 0.2), fraction=(0.9, 0.5, 0.99, 0.8))
    return jh.Scene(hair, bonds=bonds, phases=(jh.Phase("fall", 1.0, effects),), solver=solver)


def ours(strands: int, points: int, solver: Any, options: dict[str, Any]) -> tuple[float, float]:
    """Microseconds a step, and seconds of tracing and compiling."""
    built = scene(strands, points, solver).as_arrays()
    effects, state, bare = built.phases[0].effects, start(built), replace(built, phases=())
    steps = int(np.clip(400_000 / (strands * points), 20, 100))
    begin = time.perf_counter()
    run = jax.jit(lambda *x: phase_end(*x, steps=steps, kernels=True), compiler_options=options)
    program = run.lower(bare, effects, state).compile()
    compilation = time.perf_counter() - begin
    times = []
    while len(times) < 5 or (len(times) < 200 and sum(times) < 3):
        begin = time.perf_counter()
        jax.block_until_ready(program(bare, effects, state))
        times.append(time.perf_counter() - begin)
    return 1e6 * min(times[1:]) / steps, compilation


def theirs(python: str, program: Path, file: Path, threads: int) -> float | None:
    """Microseconds a step as a peer prints it; None where it does not run."""
    command = [python, str(program), str(file), "--threads", str(threads)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = re.search(r"min ([\d.]+)", done.stdout)
    return float(found.group(1)) if found else None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("peers", type=Path, help="folder with scene/ and numba/")
    parser.add_argument("--python", default=sys.executable, help="an interpreter with numba")
    options = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}; microseconds a step")
    for strands, points in SIZES:
        print(f"\n{strands:,} strands of {points} points")
        base = {}
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "scene.bin"
            write = [options.python, str(options.peers / "scene" / "scene.py"), "write"]
            subprocess.run([*write, str(strands), str(points), str(file)], check=True)
            for name, program in OTHERS.items():
                for threads in (1, 2):
                    path = options.peers / "numba" / program
                    taken = theirs(options.python, path, file, threads)
                    if taken is not None:
                        base.setdefault(threads, taken)
                        print(f"  {name + f', {threads} threads':<34} {taken:9.1f}")
        for name, solver in SOLVERS.items():
            for more, compiled in (("", {}), (", vectors of 512 bits", WIDTH)):
                taken, compilation = ours(strands, points, solver, compiled)
                ratios = [f"{taken / x:5.2f} of numba on {n}" for n, x in base.items()]
                print(
                    f"  {name + more:<34} {taken:9.1f}  compiled in {compilation:4.1f} s  "
                    + "  ".join(ratios)
                )


if __name__ == "__main__":
    main()
