"""On a GPU, if JAX has one, otherwise on the CPU: python tests/benchmarks/accelerator.py [PARTS]

Throughput from 100 to 1,000,000 strands of 32 points beside the memory's bandwidth, agreement with
the CPU, hair contact, derivatives, the paper's scenes. Float32, the least of some calls,
compilation apart, programs compiled side by side.
"""

import argparse
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxhair as jh
from jaxhair.simulate import phase_end, prepare, start

sys.path.insert(0, str(Path(__file__).parents[1]))
from contact import patch, pushes
from measure import in_turn

POINTS = 32
SIZES = (100, 1_000, 10_000, 100_000, 1_000_000)
SOLVERS = {
    "red-black": jh.PositionBased(),
    "sequential": jh.PositionBased(sweep="sequential"),
    "direct": jh.Direct(),
}


def scene(strands: int, points: int, solver: Any, dtype: str = "float32") -> jh.Scene:
    """Strands that fall from level, their hydrogen bonds re-forming."""
    roots = 0.01 * np.random.default_rng(0).normal(size=(strands, 3))
    length = 0.01 * (points - 1)
    hair = jh.Strands.straight(roots, (1, 0, 0), length=length, points=points, dtype=dtype)
    effects = (jh.Gravity(), jh.Hold(), jh.Reform(hydrogen=1.0, rate=0.5), jh.Drag(2.8))
    return jh.Scene(hair, phases=(jh.Phase("fall", 1.0, effects),), solver=solver)


def stepping(built: jh.Scene, steps: int) -> Callable[[], Any]:
    """Some steps of a scene's last phase, compiled."""
    built = built.as_arrays()
    effects, bare, state = built.phases[-1].effects, replace(built, phases=()), start(built)
    run = partial(phase_end, steps=steps, kernels=True)
    program = jax.jit(run).lower(bare, effects, state).compile()
    return partial(program, bare, effects, state)


def side_by_side(makers: dict[Any, Callable[[], Any]]) -> dict[Any, Any]:
    """What each returns, computed at once in threads: compilation uses one core a program."""
    with ThreadPoolExecutor() as pool:
        futures = {key: pool.submit(make) for key, make in makers.items()}
        return {key: future.result() for key, future in futures.items()}


def bandwidth() -> float:
    """Bytes a second that a large copy reads and writes."""
    x = jnp.ones(2**28 if jax.default_backend() != "cpu" else 2**25, "float32")
    double = jax.jit(lambda x: 2 * x)
    return 2 * x.nbytes / in_turn(lambda: double(x), times=10).min()


def throughput(sizes: tuple[int, ...], most: float = 2.0) -> None:
    """Prints the time of a step, and of reading and writing the state once as a share of it."""
    copied = bandwidth()
    print(f"\na copy reads and writes {copied / 1e9:.0f} GB/s")
    print("   strands  solver      us a step  ns a point  at 1/360 s  share of bandwidth")
    keys = [(n, name) for n in sizes for name in SOLVERS]
    steps = {n: max(4, min(120, 4_000_000 // n)) for n in sizes}
    begin = time.perf_counter()
    runs = side_by_side({(n, name): partial(made, n, name, steps[n]) for n, name in keys})
    print(f"   ({len(keys)} programs traced and compiled in {time.perf_counter() - begin:.0f} s)")
    for n, name in keys:
        run = runs.pop((n, name))
        taken = in_turn(run, times=20, least=3, longest=most).min() / steps[n]
        state = sum(x.nbytes for x in jax.tree.leaves(run()))
        print(
            f"  {n:8d}  {name:<10}  {1e6 * taken:9.0f}  {1e9 * taken / n / POINTS:10.3f}"
            f"  {1 / 360 / taken:9.2f}x  {2 * state / copied / taken:8.1%}",
            flush=True,
        )


def made(strands: int, solver: str, steps: int) -> Callable[[], Any]:
    return stepping(scene(strands, POINTS, SOLVERS[solver]), steps)


def agreement() -> None:
    """Prints how far a device's results are from the CPU's, over the strands' length."""
    print("\ndifference from the CPU after 100 steps of 200 x 32, over the length")
    for dtype in ("float32", "float64"):
        with jax.enable_x64(dtype == "float64"):
            for name, solver in SOLVERS.items():
                built = scene(200, POINTS, solver, dtype)
                here = np.asarray(stepping(built, 100)().positions)
                with jax.default_device(jax.devices("cpu")[0]):
                    there = np.asarray(stepping(built, 100)().positions)
                apart = np.abs(here - there).max() / (0.01 * (POINTS - 1))
                print(f"  {name:<10}  {dtype}  {apart:.1e}", flush=True)


def touching(sizes: tuple[int, ...], steps: int = 60) -> None:
    """Prints what hair contact alone costs, at one density."""
    print(f"\ncontact alone, {steps} steps of strands of 9 points at one density")
    print("  strands   ms a step   steps a list")
    for strands in sizes:
        built = patch(strands)
        setup, state = prepare(built, built.phases[0].effects), start(built)
        found = pushes(setup, state, steps)
        taken = in_turn(partial(pushes, setup, state, steps), times=3).min() / steps
        print(
            f"  {strands:7d}   {1e3 * taken:9.2f}   {steps / int(found[2].builds):.1f}", flush=True
        )


def derivatives() -> None:
    """Prints what derivatives of a final shape cost, in forward runs."""
    print("\nderivatives of the shape after 120 steps, in forward runs")
    for strands, points in ((200, 9), (64, 33), (10_000, 32)):
        for name in ("red-black", "direct"):
            built = scene(strands, points, SOLVERS[name]).as_arrays()

            def loss(influence: Any, built: jh.Scene = built) -> Any:
                changed = jh.replace_leaves(built, {"bonds.influence": influence})
                bare, state = replace(changed, phases=()), start(changed)
                end = phase_end(bare, changed.phases[0].effects, state, steps=120)
                return jnp.sum(end.positions**2)

            at = jnp.asarray(built.bonds.influence)
            programs = {"plain": loss, "reverse": jax.grad(loss), "forward": jax.jacfwd(loss)}
            compiled = side_by_side({k: jax.jit(f).lower(at).compile for k, f in programs.items()})
            calls = [partial(f, at) for f in compiled.values()]
            plain, reverse, forward = in_turn(*calls, times=5).min(axis=0)
            print(
                f"  {strands:6d} x {points}  {name:<10}  run {1e3 * plain:7.1f} ms, reverse "
                f"{reverse / plain:.1f}, forward in 4 numbers {forward / plain:.1f}",
                flush=True,
            )


def scenes() -> None:
    """Prints the time of a step in the last phase of the paper's scenes."""
    print("\nthe paper's scenes, last phase: us a step (times real time at 1/360 s)")
    for name, make in jh.scenes.SCENES.items():
        taken = in_turn(stepping(make(), 60), times=3).min() / 60
        print(f"  {name:<9}  {1e6 * taken:6.0f}  {1 / 360 / taken:.1f}x", flush=True)


PARTS = {
    "throughput": lambda most: throughput(tuple(n for n in SIZES if n <= most)),
    "agreement": lambda most: agreement(),
    "contact": lambda most: touching(tuple(n for n in (200, 2_000, 20_000, 200_000) if n <= most)),
    "derivatives": lambda most: derivatives(),
    "scenes": lambda most: scenes(),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="which; all by default")
    parser.add_argument("--most", type=int, default=1_000_000, help="most strands")
    options = parser.parse_args()
    device = jax.devices()[0]
    print(f"jax {jax.__version__}, {device.platform}: {device.device_kind}")
    for name in options.parts or PARTS:
        begin = time.perf_counter()
        PARTS[name](options.most)
        print(f"  ({name}: {time.perf_counter() - begin:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
