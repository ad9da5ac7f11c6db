"""Strands of USD files, read in another process; how stands in usd_child.py.

Of each BasisCurves the points are read that its curves pass through, where segments meet: of a
bezier curve every third control point, not its handles; of a bspline the points between segments.
HermiteCurves are read as their points. The transforms of parents are applied, several prims are
joined in the order of the file, instances are read each at its place, and what is invisible is
left out. NurbsCurves, periodic curves and PointInstancers of curves are refused.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from jaxhair import usd_child
from jaxhair.extras import optional
from jaxhair.file_formats import Counts, Points

SECONDS = 600
"""After which a file is given up."""

START = (
    "import os, runpy, sys; sys.path += sys.argv.pop().split(os.pathsep); "
    "runpy.run_path(sys.argv.pop(1), run_name='__main__')"
)
"""Finds packages where this process does, but none of its own modules in place of Python's."""


def read(path: Path, *, frame: int, time: float | None) -> tuple[Points, Counts, float, str]:
    """Points in the file's unit and axes, shape (all points, 3), counts of the strands, the unit
    [m] and the axis, "y" or "z", that points up.

    Arguments:
        frame: counted among all times that curves or their places are sampled at.
        time: [s], in place of a frame; between two samples it interpolates linearly.

    Raises ValueError saying what is wrong, OSError where the file cannot be opened, and
    ImportError without the extra `usd`.
    """
    with path.open("rb"):
        pass
    given = [os.path.abspath(path), str(frame), "" if time is None else repr(float(time))]
    command = [sys.executable, "-P", "-c", START, usd_child.__file__, *given]
    try:
        done = subprocess.run(
            [*command, os.pathsep.join(p for p in sys.path if p)],
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},  # each thread takes memory
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=SECONDS,
        )
    except subprocess.TimeoutExpired:
        raise ValueError(
            f"it is not read within {SECONDS} s; it must be a valid USD file"
        ) from None
    line, _, data = done.stdout.partition(b"\n")
    if done.returncode == 1:  # Python's own; a crash has another
        why = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
        raise RuntimeError(f"the process that reads USD files does not start: {why}")
    if done.returncode != 0 or not line:
        raise ValueError(
            "it is damaged: the USD library crashed over it, or asked for more memory than "
            "such a file may need; it must be a valid USD file"
        )
    head = json.loads(line)
    if "missing" in head:
        optional("pxr.Usd", "usd")
        raise ImportError(head["missing"])
    if "error" in head:
        raise ValueError(head["error"])
    size = 24 * head["points"]
    points = np.frombuffer(data[:size], "<f8").reshape(-1, 3)
    return points, np.frombuffer(data[size:], "<i8"), head["unit"], head["up"]
