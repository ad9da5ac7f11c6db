"""The step under pytest-benchmark, to save figures and compare them between commits:

    pip install -e '.[test,benchmark]'
    python -m pytest tests/benchmarks/bench_step.py --benchmark-autosave
    python -m pytest tests/benchmarks/bench_step.py --benchmark-compare

A round is `STEPS` steps; `us_a_step` and `compilation_s` are in the saved file. No test by itself.
Ratios to other programs are taken in turn within one run, by `peers.py`.
"""

import time
from dataclasses import replace
from typing import Any

import jax
import pytest
from peers import SIZES, SOLVERS, scene

from jaxhair.simulate import phase_end, start

STEPS = 20


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize(("strands", "points"), SIZES)
def test_step(benchmark: Any, strands: int, points: int, solver: str) -> None:
    benchmark.group = f"{strands} x {points}"
    with jax.enable_x64(False):
        built = scene(strands, points, SOLVERS[solver]).as_arrays()
        bare, effects, state = replace(built, phases=()), built.phases[0].effects, start(built)
        begin = time.perf_counter()
        program = phase_end.lower(bare, effects, state, steps=STEPS, kernels=True).compile()
        benchmark.extra_info["compilation_s"] = time.perf_counter() - begin
        end = benchmark(lambda: jax.block_until_ready(program(bare, effects, state)))
    benchmark.extra_info["us_a_step"] = 1e6 * benchmark.stats.stats.min / STEPS
    assert end.positions.shape == (points, 3, strands)
