"""A step's time beside other programs': python tests/benchmarks/peers.py PEERS [--python PYTHON]

PEERS is the folder of the peers' programs, each of which simulates the same scene: strands clamped
at their roots, gravity, 5 iterations, a rest shape of four bonds, of which two kinds re-form.
PYTHON is an interpreter that has numba, if this one does not. Microseconds a step, the least of
many runs, float32, compilation apart; ratios to vectorised Numba on as many threads. Also a
reverse-mode gradient, forward run included, beside that of Warp's tape if PYTHON has warp-lang.
"""

import argparse
import re
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from measure import in_turn

import jaxhair as jh
from jaxhair.simulate import phase_end, start

SIZES = ((200, 9), (100, 17), (10_000, 9), (1_000, 100))
SOLVERS = {
    "red-black": jh.PositionBased(),
    "sequential": jh.PositionBased(sweep="sequential"),
    "direct": jh.Direct(),
}
GRADIENTS = ((200, 9), (64, 33))
STEPS = 60  # that a gradient goes back
SECONDS = 3.0  # of each comparison
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


def ours(strands: int, points: int, solver: Any, devices: int) -> tuple[float, float]:
    """Microseconds a step, and seconds of tracing and compiling."""
    built = scene(strands, points, solver).as_arrays()
    effects, state, bare = built.phases[0].effects, start(built), replace(built, phases=())
    steps = int(np.clip(400_000 / (strands * points), 20, 100))
    begin = time.perf_counter()
    run = jax.jit(partial(phase_end, steps=steps, devices=devices, kernels=True))
    program = run.lower(bare, effects, state).compile()
    compilation = time.perf_counter() - begin
    given = bare, effects, state
    if devices > 1:  # where the program wants them
        given = jax.device_put(given, program.input_shardings[0])
    taken = in_turn(lambda: program(*given), longest=SECONDS).min()
    return 1e6 * float(taken) / steps, compilation


def our_gradient(strands: int, points: int, solver: Any) -> tuple[float, float]:
    """Microseconds a step of a forward run, and of one with the gradient in what is remembered."""
    built = scene(strands, points, solver).as_arrays()
    effects, state, bare = built.phases[0].effects, start(built), replace(built, phases=())
    along = np.random.default_rng(1).normal(size=state.positions.shape).astype(np.float32)

    def loss(shapes: Any) -> Any:
        end = phase_end(bare, effects, replace(state, shapes=shapes), steps=STEPS)
        return jnp.sum(along * end.positions)

    gradient = jax.jit(jax.value_and_grad(loss))
    taken = in_turn(
        lambda: phase_end(bare, effects, state, steps=STEPS, kernels=True),
        lambda: gradient(state.shapes),
        longest=2 * SECONDS,
    )
    forward, both = 1e6 * taken.min(axis=0) / STEPS
    return float(forward), float(both)


def printed(python: str, program: Path, options: list[str], pattern: str) -> float | None:
    """The number that a peer prints where the pattern says; None where it does not run."""
    command = [python, str(program), *options]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = re.search(pattern, done.stdout)
    return float(found.group(1)) if found else None


def written(options: argparse.Namespace, strands: int, points: int, folder: str) -> str:
    """The file with the peers' scene, for the peers to read."""
    file, program = str(Path(folder) / "scene.bin"), str(options.peers / "scene" / "scene.py")
    command = [options.python, program, "write", str(strands), str(points), file]
    subprocess.run(command, check=True)
    return file


def steps(options: argparse.Namespace, strands: int, points: int) -> None:
    """Times of a step of all programs."""
    base = {}
    with tempfile.TemporaryDirectory() as folder:
        file = written(options, strands, points, folder)
        for name, program in OTHERS.items():
            for threads in (1, 2):
                path = options.peers / "numba" / program
                more = [file, "--threads", str(threads)]
                taken = printed(options.python, path, more, r"min ([\d.]+)")
                if taken is not None:
                    base.setdefault(threads, taken)
                    print(f"  {name + f', {threads} threads':<34} {taken:9.1f}")
    for name, solver in SOLVERS.items():
        for devices in (1, 2):
            taken, compilation = ours(strands, points, solver, devices)
            ratio = f"  {taken / base[devices]:5.2f} of Numba's" if devices in base else ""
            title = f"{name}, {devices} devices"
            print(f"  {title:<34} {taken:9.1f}{ratio}, compiled in {compilation:.1f} s", flush=True)


def gradients(options: argparse.Namespace, strands: int, points: int) -> None:
    """Times of a step of a gradient, forward run included."""
    with tempfile.TemporaryDirectory() as folder:
        file = written(options, strands, points, folder)
        path = options.peers / "warp" / "wp_rods.py"
        more = [file, "--mode", "grad", "--steps", str(STEPS)]
        warp = printed(options.python, path, more, r"forward\+backward ([\d.]+)")
    if warp is not None:
        print(f"  {'Warp':<34} {warp:9.1f}")
    for name, solver in SOLVERS.items():
        forward, taken = our_gradient(strands, points, solver)
        ratio = "" if warp is None else f"  {taken / warp:5.2f} of Warp"
        print(f"  {name:<34} {taken:9.1f}  {taken / forward:5.1f} forward runs{ratio}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("peers", type=Path, help="folder with scene/ and numba/")
    parser.add_argument("--python", default=sys.executable, help="an interpreter with numba")
    parser.add_argument("--only", choices=("steps", "gradients"))
    options = parser.parse_args()
    jax.config.update("jax_num_cpu_devices", 2)
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}; microseconds a step")
    for strands, points in SIZES if options.only != "gradients" else ():
        print(f"\n{strands:,} strands of {points} points")
        steps(options, strands, points)
    for strands, points in GRADIENTS if options.only != "steps" else ():
        print(f"\ngradient, {strands:,} strands of {points} points, {STEPS} steps")
        gradients(options, strands, points)


if __name__ == "__main__":
    main()
