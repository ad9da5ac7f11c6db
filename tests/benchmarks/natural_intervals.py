"""Do the intervals of f_hydrogen and of the peeling rate s hold the truth, for noisy strands?

    python tests/benchmarks/natural_intervals.py                  # some minutes on 2 cores
    python tests/benchmarks/natural_intervals.py --strands 256 --noise 0.1

Curly and wavy strands of 5 to 20 cm with known f_hydrogen and s are simulated without weight and
hanging, as chains of 97 points and until they rest. Points of them every 2 to 5 mm, with noise in
each coordinate, are what `python -m fitting natural FILE --unloaded FILE2` would read.
"""

import argparse
import time

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

import jaxhair as jh
from fitting.clamped import rooted
from fitting.ends import in_tiles
from fitting.natural import STATE, UNLOADED, natural

POINTS = 97
STATES = (STATE, UNLOADED)
LOW, HIGH = (0.1, 1.0), (0.6, 8.0)
"""Of f_hydrogen and s [1/m]."""


def shape(rng: np.random.Generator, length: float) -> np.ndarray:
    """A chain [m] whose first edge has the root in its middle; its curvature and torsion change
    slowly."""
    edge = length / (POINTS - 1.5)
    s = edge * np.arange(POINTS - 1)
    diameter = rng.uniform(12e-3, 40e-3)
    size = rng.choice([1.9 / diameter, rng.uniform(5, 40), rng.uniform(0, 8)])

    def slow() -> np.ndarray:
        waves = np.arange(1, 5)[:, None]
        phases, sizes = rng.uniform(0, 2 * np.pi, (4, 1)), rng.normal(size=(4, 1)) / waves
        return (sizes * np.cos(np.pi * waves * s / length + phases)).sum(axis=0)

    curvature = size * (1 + 0.25 * slow())
    turned = np.cumsum(0.3 * size * rng.choice([-1, 1]) * (1 + 0.3 * slow())) * edge
    side = rng.uniform(0, 2 * np.pi)
    along = np.array([np.cos(side), np.sin(side), rng.uniform(-1.5, 0.3)])
    along /= np.linalg.norm(along)
    across = np.cross(along, rng.normal(size=3))
    across /= np.linalg.norm(across)
    rows = [along]
    for bend, angle in zip(curvature[1:] * edge, turned[1:], strict=True):
        other = np.cross(along, across)
        normal = np.cos(angle) * across + np.sin(angle) * other
        new = np.cos(bend) * along + np.sin(bend) * normal
        across = across - (across @ (along + new)) / (1 + along @ new) * new  # without twist
        across -= (across @ new) * new
        across /= np.linalg.norm(across)
        along = new
        rows.append(along)
    return edge * np.concatenate([np.zeros((1, 3)), np.cumsum(rows, axis=0)])


def truths(count: int, seed: int) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """Points [m] of each state, shape (strands, points, 3), f_hydrogen and s."""
    rng = np.random.default_rng(seed)
    lengths = rng.uniform(0.05, 0.20, count)
    shapes = np.stack([shape(rng, length) for length in lengths])
    hydrogen = rng.uniform(LOW[0], HIGH[0], count)
    rates = np.exp(rng.uniform(np.log(LOW[1]), np.log(HIGH[1]), count))
    others = np.array([0.30, 0.20, 0.17]) / 0.67
    influence = np.concatenate([hydrogen[:, None], (1 - hydrogen[:, None]) * others], axis=1)
    scene = jh.Scene(
        jh.Strands.from_points(jnp.asarray(shapes, "float32")),
        jh.PhysicalFibre(peeling_rate=rates),
        jh.Bonds(influence),
        (
            jh.Phase(UNLOADED, jh.treatments.AT_ONCE, (jh.Unloaded(),)),
            *jh.treatments.wash(name=STATE, seconds=3.0, unload=False),
        ),
        jh.Direct(),
        1 / 180,
    )
    tiles = [ends for _, ends in in_tiles(scene, STATES)]
    points = {state: rooted(np.concatenate([x[state] for x in tiles])) for state in STATES}
    return points, hydrogen, rates


def files(points: dict[str, np.ndarray], noise: float, seed: int) -> list[list[np.ndarray]]:
    """Points every 2 to 5 mm with noise [m], of each state and strand."""
    rng = np.random.default_rng(seed)
    spacing = rng.uniform(2e-3, 5e-3, len(points[STATE]))
    out: list[list[np.ndarray]] = []
    for state in STATES:
        out.append([])
        for x, apart in zip(points[state].astype(float), spacing, strict=True):
            s = np.append(0, np.linalg.norm(np.diff(x, axis=0), axis=1).cumsum())
            places = np.linspace(0, s[-1], max(int(s[-1] / apart), 8) + 1)
            given = CubicSpline(s, x)(places)
            out[-1].append(given + rng.normal(0, noise, given.shape))
    return out


def coverage(
    strands: int, noise: float, points: int | None = None, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, int]:
    """Of f_hydrogen and s: which intervals hold the truth, shape (2, fitted strands), how wide they
    are over the range of the truths, and how many strands were not fitted.

    Arguments:
        noise: of a coordinate [m]. points: on a simulated strand, see `natural`.
    """
    seen, hydrogen, rates = truths(strands, seed)
    hanging, unloaded = files(seen, noise, seed + 1)
    hair = natural(hanging, unloaded=unloaded, points=points, seconds=1.5)
    found = hair.fit()
    assert found.intervals is not None
    inside, widths = [], []
    true = np.stack([hydrogen, rates])[:, hair.used]
    for ends, value, low, high in zip(found.intervals.values(), true, LOW, HIGH, strict=True):
        inside.append((ends[:, 0] <= value) & (value <= ends[:, 1]))
        shown = np.clip(ends, low, high)
        widths.append((shown[:, 1] - shown[:, 0]) / (high - low))
    fitted = found.fitted
    return np.array(inside)[:, fitted], np.array(widths)[:, fitted], strands - int(fitted.sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--strands", type=int, default=64)
    parser.add_argument("--noise", type=float, nargs="+", default=[0.01, 0.1], help="mm")
    parser.add_argument("--points", type=int)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    for noise in options.noise:
        begin = time.perf_counter()
        inside, widths, left = coverage(options.strands, 1e-3 * noise, options.points, options.seed)
        print(f"noise {noise:g} mm: {left} of {options.strands} strands not fitted")
        for name, held, width in zip(("f_hydrogen", "s"), inside, widths, strict=True):
            print(
                f"  {name}: truth in {held.mean():.1%} of the 95 % intervals, which are "
                f"{np.median(width):.0%} of the truths' range wide (median)"
            )
        print(f"  {time.perf_counter() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
