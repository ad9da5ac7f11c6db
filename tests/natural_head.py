"""A file of natural-looking strands: python tests/natural_head.py head.hair

Strands grow from the scalp, bend down and are straight, wavy, curly or frizzy, 3 to 45 cm long,
with a point every 2 to 5 mm, wrong by 0.05 mm. About one in a hundred is what files also hold: a
single point, points all in one place, points given twice, a tangle.
"""

import argparse
from pathlib import Path

import numpy as np

import jaxhair as jh

HEAD = 0.09  # radius [m]
NOISE = 5e-5  # of a point [m]
STYLES = ("straight", "waves", "curls", "frizz")
FAULTS = ("one point", "one place", "twice", "tangle")


def strand(rng: np.random.Generator, style: str, longest: float) -> np.ndarray:
    """Points [m] of one strand, shape (points, 3)."""
    height, side = rng.uniform(-0.1, 1.0), rng.uniform(0, 2 * np.pi)
    outward = np.array([np.cos(side), np.sin(side), 0.0])
    root = HEAD * (np.sqrt(1 - height**2) * outward + height * np.array([0.0, 0.0, 1.0]))
    spacing, length = rng.uniform(2e-3, 5e-3), rng.uniform(0.03, longest)
    s = np.linspace(0, length, max(int(length / spacing), 8) + 1)
    # from some way off the scalp's tangent down to the vertical
    first = np.arccos(height) - rng.uniform(0.3, 0.9)
    slope = np.pi / 2 - (np.pi / 2 - first) * np.exp(-s / rng.uniform(0.03, 0.08))
    along = np.cos(slope)[:, None] * outward - np.sin(slope)[:, None] * np.array([0.0, 0.0, 1.0])
    across = np.array([-outward[1], outward[0], 0.0])
    normal = np.cross(along, across)
    phase = rng.uniform(0, 2 * np.pi)
    if style == "curls":
        diameter, pitch = rng.uniform(8e-3, 25e-3), rng.uniform(15e-3, 40e-3)
        turns = s / np.hypot(np.pi * diameter, pitch) * 2 * np.pi
        x, y = diameter / 2 * np.cos(turns + phase), diameter / 2 * np.sin(turns + phase)
        down = pitch / np.hypot(np.pi * diameter, pitch)
    elif style == "waves":
        x = rng.uniform(1e-3, 6e-3) * np.sin(2 * np.pi * s / rng.uniform(0.03, 0.08) + phase)
        y, down = 0 * s, 0.95
    elif style == "frizz":
        several = range(1, 9)
        size = 1.5e-3 * rng.normal(size=(2, len(several))) / np.sqrt(several)
        shift = rng.uniform(0, 2 * np.pi, (2, len(several)))
        waves = [np.sin(2 * np.pi * k * s[:, None, None] / 0.12 + shift) for k in several]
        x, y = sum(w[:, :, i] * size[:, i] for i, w in enumerate(waves)).T
        down = 0.95
    else:
        x, y, down = 0 * s, 0 * s, 1.0
    grown = 1 - np.exp(-s / 0.02)  # nothing at the root, which is in the skin
    steps = np.diff(s)[:, None] * (along[1:] + along[:-1]) / 2 * down
    middle = root + np.concatenate([np.zeros((1, 3)), steps.cumsum(axis=0)])
    return middle + (grown * x)[:, None] * normal + (grown * y)[:, None] * across


def head(
    strands: int, seed: int = 0, faults: float = 0.01, longest: float = 0.45
) -> tuple[list[np.ndarray], list[str]]:
    """Points [m] of strands, and what each is: one of `STYLES`, or of `FAULTS` with this share."""
    rng = np.random.default_rng(seed)
    made, kinds = [], []
    for _ in range(strands):
        kind = str(rng.choice(STYLES))
        x = strand(rng, kind, longest)
        x[1:] += rng.normal(0, NOISE, x[1:].shape)
        if rng.random() < faults:
            kind = str(rng.choice(FAULTS))
            x = {
                "one point": x[:1],
                "one place": np.repeat(x[:1], len(x), axis=0),
                "twice": np.repeat(x, 2, axis=0),
                "tangle": x[:1] + rng.normal(0, 0.05, x.shape),
            }[kind]
        made.append(x)
        kinds.append(kind)
    return made, kinds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("file", type=Path, help="to write: .hair or .data")
    parser.add_argument("--strands", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--overwrite", action="store_true")
    options = parser.parse_args()
    made, kinds = head(options.strands, options.seed)
    curves = jh.Curves.from_list(made)
    jh.write_curves(options.file, curves, overwrite=options.overwrite)
    found = ", ".join(f"{kinds.count(kind)} {kind}" for kind in (*STYLES, *FAULTS))
    print(f"{len(made)} strands of {curves.counts.mean():.0f} points: {found}")


if __name__ == "__main__":
    main()
