"""Wall time of writing and reading files: `python tests/benchmarks/files.py`.

60 frames of 200 strands of 9 points; formats of one frame hold the last. `jaxhair.read_curves`
reads one frame; of USD files it starts another process, which takes most of its time. The last row
is all frames by the USD library itself, as other programs read them. Prints the best and the
median of some calls.
"""

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import jaxhair as jh
from jaxhair.arrays import read_arrays

FRAMES, STRANDS, POINTS = 60, 200, 9
WANTED = 1.0  # s, each way


def recording() -> jh.Recording:
    """Made-up positions and bonded fractions that change in every frame."""
    random = np.random.default_rng(0)
    shape = (FRAMES, STRANDS, POINTS, 3)
    walk = np.cumsum(random.normal(size=shape, scale=0.01), axis=2).astype(np.float32)
    ball = jh.Sphere((0.0, 0.0, 0.0), 0.05, velocity=(0.1, 0.0, 0.0))
    scene = jh.Scene(jh.Strands.from_points(walk[0]), phases=(jh.Phase("move", 2.0, (ball,)),))
    fractions = random.uniform(size=(FRAMES, STRANDS, POINTS - 2, 4)).astype(np.float32)
    observed = {"positions": walk, "fractions": fractions}
    return jh.Recording(scene, np.arange(FRAMES) / 30, observed, ("", *["move"] * (FRAMES - 1)))


def timed(work: Callable[[], Any], repeats: int) -> tuple[float, float]:
    """Best and median [s]."""
    taken = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        taken.append(time.perf_counter() - begin)
    return min(taken), float(np.median(taken))


def all_frames(path: Path) -> None:
    """Reads every sample of the points and bonded fractions of a USD file."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/hair/strands"))
    bonds = UsdGeom.PrimvarsAPI(curves).GetPrimvar("bonded_hydrogen").GetAttr()
    for attribute in (curves.GetPointsAttr(), bonds):
        for code in attribute.GetTimeSamples():
            np.array(attribute.Get(code))


def main() -> None:
    """Prints a row for each format."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5, help="calls of each (5)")
    repeats = parser.parse_args().repeats
    of = recording()
    print(f"{FRAMES} frames x {STRANDS} strands x {POINTS} points; seconds, best and median")
    print(f"{'':22}{'write':>16}{'read':>16}{'bytes':>12}")
    with tempfile.TemporaryDirectory() as folder:
        for ending, options in (
            (".npz", {}),
            (".usdc", {}),
            (".usdc", {"basis": "bezier"}),
            (".usdc", {"color_by": "hydrogen"}),
            (".usda", {}),
            (".abc", {}),
            (".hair", {}),
            (".data", {}),
        ):
            path = Path(folder) / f"a{ending}"
            chosen: dict[str, Any] = {**options, "overwrite": True}
            jh.save(path, of, **chosen)  # which imports what is needed
            written = timed(lambda p=path, o=chosen: jh.save(p, of, **o), repeats)
            read = read_arrays if ending == ".npz" else jh.read_curves
            found = timed(lambda p=path, r=read: r(p), repeats)
            name = " ".join([ending, *options.values()])
            times = "".join(f"{best:8.3f}{median:8.3f}" for best, median in (written, found))
            slow = "" if max(*written, *found) < WANTED else "  more than a second"
            print(f"{name:22}{times}{path.stat().st_size:12,}{slow}")
        best, median = timed(lambda: all_frames(Path(folder) / "a.usdc"), repeats)
        print(f"{'.usdc, all frames':38}{best:8.3f}{median:8.3f}")


if __name__ == "__main__":
    main()
