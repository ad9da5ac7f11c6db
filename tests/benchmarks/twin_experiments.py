"""Do fits find the truth, and are they as sure of it as they say?

    python tests/benchmarks/twin_experiments.py               # 50 truths, some minutes
    python tests/benchmarks/twin_experiments.py --truths 10

Hair with known influences f_j and peeling rate s is simulated in four states (water set, acid set,
perm, washed), noise is added to its points, and it is fitted from the same start each time. Then
data from models that are not the fit's own: another solver, resolution, or stiffness.
"""

import argparse
import time
from dataclasses import replace
from typing import Any

import jax
import numpy as np

import fitting
import jaxhair as jh
from jaxhair import treatments

NOISE = 1e-4
STATES = ("water set", "acid set", "perm", "washed")
FREE: dict[str, fitting.Constraint] = {
    "bonds.influence": fitting.Simplex(),
    "fibre.peeling_rate": fitting.Positive(),
}


def experiment(*, points: int = 33, **options: Any) -> jh.Scene:
    """One strand of 30 cm, treated three times and washed, hanging under its weight each time."""
    treated: dict[str, Any] = {"rod_diameter": 25e-3, "climb": 0.15, "seconds": 0.5}
    hair = jh.Strands.straight(np.zeros((1, 3)), (0.0, 0.0, -1.0), length=0.3, points=points)
    options = {"fibre": jh.Fibre(stiffness=0.9, peeling_rate=1.0), **options}
    return jh.Scene(
        hair,
        bonds=jh.Bonds((0.25, 0.25, 0.25, 0.25)),
        phases=(
            *treatments.water_set(**treated),
            *treatments.wash(name="wash between", seconds=0.2),
            *treatments.acid_set(**treated),
            *treatments.perm(**treated),
            *treatments.wash(seconds=0.5),
        ),
        **options,
    )


def truth(rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Influences of at least 0.05, and a peeling rate from 0.2 to 3 / m."""
    influence = 0.05 + 0.8 * rng.dirichlet(np.ones(4))
    return influence, float(np.exp(rng.uniform(np.log(0.2), np.log(3.0))))


def observed(
    scene: jh.Scene, influence: np.ndarray, rate: float, rng: np.random.Generator, size: int = 33
) -> dict[str, fitting.Target]:
    """The states of hair with the given numbers, with noise."""
    changed = jh.replace_leaves(
        scene, {"bonds.influence": influence, "fibre.peeling_rate": np.asarray(rate)}
    )
    ends = _run(changed)
    targets: dict[str, fitting.Target] = {}
    for name in STATES:
        points = np.asarray(ends[name].points, float)
        if points.shape[1] != size:
            points = fitting.resampled(points, np.full(len(points), points.shape[1]), size)
        targets[name] = fitting.Shape(points + rng.normal(0, NOISE, points.shape))
    return targets


_run = jax.jit(jh.run)


def values(found: fitting.Fit) -> np.ndarray:
    """f_j and s."""
    return np.append(found.values["bonds.influence"], found.values["fibre.peeling_rate"])


def twins(truths: int) -> fitting.Fit:
    """Prints how near fits come, and how often the truth is in their intervals."""
    rng = np.random.default_rng(0)
    scene = experiment()
    first: fitting.Fit | None = None
    off, inside, begin = [], [], time.perf_counter()
    for _ in range(truths):
        influence, rate = truth(rng)
        targets = observed(scene, influence, rate, rng)
        found = fitting.fit(scene, targets, FREE) if first is None else first.again(targets)
        first = first or found
        true = np.append(influence, rate)
        spread = found.uncertainty
        off.append(np.abs(values(found) - true) / np.append(np.ones(4), rate))
        inside.append((spread.low <= true) & (true <= spread.high))
    assert first is not None
    errors, covered = np.array(off), np.array(inside)
    print(f"{truths} truths, noise {1e3 * NOISE:g} mm, {time.perf_counter() - begin:.0f} s")
    print(f"f_j: error median {np.median(errors[:, :4]):.4f}, largest {errors[:, :4].max():.4f}")
    print(
        f"s: relative error median {np.median(errors[:, 4]):.4f}, largest {errors[:, 4].max():.4f}"
    )
    print(f"truth in the 95 % intervals: {100 * covered.mean():.1f} % of numbers")
    for label, share in zip(first.uncertainty.labels, covered.mean(axis=0), strict=True):
        print(f"  {label}: {100 * share:.0f} %")
    return first


def mismatched(first: fitting.Fit) -> None:
    """Prints the bias of fits to data that another model made."""
    rng = np.random.default_rng(2)
    influence, rate = np.array([0.33, 0.30, 0.20, 0.17]), 1.0
    fibre = jh.Fibre(stiffness=0.9, peeling_rate=1.0)
    models = {
        "the fit's own": experiment(),
        "twice the points": experiment(points=65),
        "half the time step": experiment(dt=1 / 720),
        "10 iterations": experiment(solver=jh.PositionBased(iterations=10)),
        "sequential sweep": experiment(solver=jh.PositionBased(sweep="sequential")),
        "stiffness 0.8 for 0.9": experiment(fibre=replace(fibre, stiffness=0.8)),
        "direct solver, dry hair": experiment(fibre=jh.PhysicalFibre(), solver=jh.Direct()),
    }
    print(f"{'data of':<26} {'f_H':>6} {'f_I':>6} {'f_S':>6} {'f_P':>6} {'s':>6} {'misfit':>7}")
    print(f"{'(truth)':<26}", *(f"{f:6.3f}" for f in influence), f"{rate:6.3f}")
    for name, scene in models.items():
        found = first.again(observed(scene, influence, rate, rng))
        shown = " ".join(f"{x:6.3f}" for x in values(found))
        print(f"{name:<26} {shown} {found.misfit:7.1f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--truths", type=int, default=50)
    truths = parser.parse_args().truths
    first = twins(truths)
    if truths:
        mismatched(first)


if __name__ == "__main__":
    main()
