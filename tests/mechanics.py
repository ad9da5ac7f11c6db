"""Rods and measures that the tests of mechanics share. Lengths are divided by the rod's own."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxhair as jh
from jaxhair.simulate import phase_end, prepare, start, step

DATA = Path(__file__).parent / "data"
LENGTH = 0.1
FIBRE = jh.PhysicalFibre(peeling_rate=0.0)
BENDING = float(FIBRE.bending_stiffness[0])
TWISTING = float(FIBRE.twisting_stiffness)
LINEAR_DENSITY = float(FIBRE.density * FIBRE.area)
DIRECT = jh.Direct()


def reference(name: str) -> list[dict[str, float]]:
    """Rows of a published or closed-form table; cells that are no number are NaN."""

    def number(text: str) -> float:
        try:
            return float(text)
        except ValueError:
            return float("nan")

    with open(DATA / name, newline="", encoding="utf-8") as file:
        return [{k: number(v) for k, v in row.items()} for row in csv.DictReader(file)]


def rod(segments: int, dtype: Any = "float64") -> jh.Strands:
    """A horizontal rod along x. The held first edge lies half outside: a rod clamped at x = 0."""
    edge = LENGTH / (segments - 0.5)
    return jh.Strands.straight(
        [[-edge / 2, 0, 0]], (1.0, 0, 0), length=edge * segments, points=segments + 1, dtype=dtype
    )


def after(
    seconds: float, hair: jh.Strands, *effects: Any, state: Any = None, **options: Any
) -> jh.State:
    """The state after some time under effects; `options` are those of a Scene."""
    options = {"fibre": FIBRE, "solver": DIRECT, "dt": 0.02, **options}
    scene = jh.Scene(hair, phases=(jh.Phase("only", seconds, effects),), **options).as_arrays()
    state = start(scene) if state is None else state
    steps = scene.phases[0].steps(scene.dt)
    return phase_end(replace(scene, phases=()), scene.phases[0].effects, state, steps=steps)


def stepped(scene: jh.Scene, state: jh.State, steps: Any) -> jh.State:
    """The state after some steps of the first phase; one traced program for any number of them."""
    setup = prepare(scene, scene.phases[0].effects)

    def one(number: Any, state: jh.State) -> jh.State:
        return step(setup, state, number.astype(scene.dtype) * scene.dt)

    return lax.fori_loop(0, steps, one, state)


def tip(state: jh.State) -> np.ndarray:
    """Last point of the first strand, over the rod's length."""
    return np.asarray(state.points[0, -1], float) / LENGTH


def speed(state: jh.State) -> float:
    """Largest component of a velocity [m/s]."""
    return float(jnp.abs(state.velocities).max())


def stretch(state: jh.State, hair: jh.Strands) -> float:
    """Largest relative change of an edge's length."""
    edges = np.linalg.norm(np.diff(np.asarray(state.points, float), axis=1), axis=-1)
    lengths = np.asarray(hair.lengths, float)
    there = np.broadcast_to(lengths > 0, edges.shape)
    return float(np.abs(edges / np.where(there, lengths, 1) - 1)[there].max())


def order(errors: np.ndarray, ratio: float = 2.0) -> float:
    """Order of convergence by regression: errors at sizes that fall by `ratio` each."""
    return float(-np.polyfit(np.arange(len(errors)) * np.log(ratio), np.log(errors), 1)[0])
