"""The same fit and simulation on several devices and processes of this machine:

    python tests/benchmarks/scale_out.py --processes 2 --devices 2

starts the processes, joins them by `jax.distributed`, and compares with one process of one device:
the stiffness of 50 falling strands fitted by `fitting.fit_each`, and their film on all devices,
both with uneven shares. On several machines, call `jax.distributed.initialize()` in each, and the
same functions.
"""

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import fitting
import jaxhair as jh


def fits_and_film(strands: int) -> dict[str, np.ndarray]:
    """What every process must agree on."""
    hair = jh.Strands.straight(np.zeros((strands, 3)), (1, 0, 0), length=0.1, points=9)
    falling = jh.Phase("fall", 0.1, (jh.Gravity(), jh.Drag(2.8), jh.Hold()))
    scene = jh.Scene(hair, phases=(falling,))
    stiffness = np.linspace(0.02, 0.2, strands)
    made = jh.run(replace(scene, fibre=replace(scene.fibre, stiffness=stiffness)))
    wanted = np.asarray(made["fall"].points)
    begin = time.perf_counter()
    found = fitting.fit_each(
        scene,
        {"fall": fitting.Shape(wanted, align=False)},
        {"fibre.stiffness": fitting.Interval(0.0, 0.5)},
        tile=8,
    )
    fitted = time.perf_counter()
    film = jh.simulate(scene, fps=30, devices=jax.device_count())
    return {
        "numbers": np.concatenate([x.ravel() for x in found.numbers.values()]),
        "film": np.asarray(film.positions),
        "seconds": np.array([fitted - begin, time.perf_counter() - fitted]),
    }


def one_of(arguments: argparse.Namespace) -> None:
    """A process of those that the command starts."""
    jax.config.update("jax_num_cpu_devices", arguments.devices)
    if arguments.processes > 1:
        jax.config.update("jax_cpu_collectives_implementation", "gloo")
        address = f"127.0.0.1:{arguments.port}"
        jax.distributed.initialize(address, arguments.processes, arguments.rank)
    np.savez(arguments.result, **fits_and_film(arguments.strands))


def started(
    processes: int, devices: int, strands: int, folder: Path
) -> list[dict[str, np.ndarray]]:
    """What each of the processes found."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    results = [folder / f"{processes}-{devices}-{rank}.npz" for rank in range(processes)]
    options = ["--processes", processes, "--devices", devices, "--strands", strands, "--port", port]
    running = []
    for rank, result in enumerate(results):
        command = [sys.executable, __file__, *options, "--rank", rank, "--result", result]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        running.append(subprocess.Popen([str(x) for x in command], env=environment))
    try:
        if max(process.wait(timeout=600) for process in running) > 0:
            raise SystemExit("a process failed")
    finally:
        for process in running:
            process.kill()
    return [dict(np.load(result)) for result in results]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--devices", type=int, default=2, help="of each process")
    parser.add_argument("--strands", type=int, default=50)
    for hidden in ("--rank", "--port", "--result"):
        parser.add_argument(
            hidden, type=str if hidden == "--result" else int, help=argparse.SUPPRESS
        )
    arguments = parser.parse_args()
    if arguments.result:
        return one_of(arguments)
    with tempfile.TemporaryDirectory() as folder:
        (one,) = started(1, 1, arguments.strands, Path(folder))
        several = started(arguments.processes, arguments.devices, arguments.strands, Path(folder))
    for name in ("numbers", "film"):
        apart = max(float(np.abs(found[name] - one[name]).max()) for found in several)
        print(f"{name}: at most {apart:.1e} from one process's ({np.abs(one[name]).max():.2g})")
        if apart > 1e-6:
            raise SystemExit(f"{name} differ by more than 1e-6")
    for name, *taken in zip(("fit", "film"), one["seconds"], several[0]["seconds"], strict=True):
        print(f"{name}: {taken[0]:.1f} s in one process, {taken[1]:.1f} s in all")


if __name__ == "__main__":
    main()
