"""How long a picture takes: python tests/benchmarks/drawing.py

Seconds a frame of a movie, 800 x 800 pixels, of curls that fill the picture; the first frame apart,
which has what all frames share.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jaxhair import pictures

STRANDS, POINTS, FRAMES = 200, 17, 5


def curls() -> np.ndarray:
    """Made-up waves that sink a millimetre a frame [m], shape (frames, strands, points, 3)."""
    random = np.random.default_rng(0)
    along = np.linspace(0, 1, POINTS)
    place = random.uniform(0, 2 * np.pi, (STRANDS, 1))
    radius = 0.08 * np.sqrt(random.uniform(0.04, 1, (STRANDS, 1)))
    x = radius * np.cos(place) + 0.02 * np.cos(18 * along) + 0.05 * along * np.cos(place)
    y = radius * np.sin(place) + 0.02 * np.sin(18 * along) + 0.05 * along * np.sin(place)
    z = np.broadcast_to(-0.3 * along, x.shape)
    sink = 1e-3 * np.arange(FRAMES)[:, None, None, None] * np.array([0.0, 0.0, -1.0])
    return np.stack([x, y, z], -1) - sink


def main() -> None:
    """Prints a row for each number of hairs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hairs", type=int, nargs="+", default=[2_000, 20_000])
    frames = curls()
    for hairs in parser.parse_args().hairs:
        ends = [time.perf_counter()]

        def told(work: range, ends: list[float] = ends) -> Iterator[int]:
            for index in work:
                yield index
                ends.append(time.perf_counter())

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.mp4"
            each = hairs // STRANDS
            pictures.movie(path, frames, fps=30, hairs_per_strand=each, progress=told)
        first, *others = np.diff(ends)
        print(f"{hairs:6d} hairs: first {first:.2f} s, then {np.median(others):.2f} s", flush=True)


if __name__ == "__main__":
    main()
