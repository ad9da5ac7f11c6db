"""The command line: `python -m fitting design --curl-diameter 25mm --output DIR`."""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from fitting.design import Design, Unreachable, Wish, as_text, design
from fitting.targets import Helix, aligned_residuals
from jaxhair import BONDS, Curves, write_curves
from jaxhair.command_line import FAILED, OK, Mistake, Parser, status, told, wrote
from jaxhair.export import check_new, check_new_folder
from jaxhair.options import Switch, add_json, add_output, add_quiet, fraction, length, positive
from jaxhair.output import new_file
from jaxhair.progress import Progress

FILES = ("design.json", "designed.hair", "design.png")


STAGES = 4
"""Of a design, at most: the rod, another treatment, the finer simulation, what is uncertain."""


def parser() -> Parser:
    """The command's parser."""
    top = Parser(
        "python -m fitting design",
        "Finds the perm rod, and where no rod will do another treatment, that give a wanted curl; "
        "checks it in a finer simulation; says how the answer changes with what is not well known "
        "of a hair. A curl that cannot be had is refused with the nearest that can (exit code 1).",
        [
            "python -m fitting design --curl-diameter 25mm --length 20cm --after-wash "
            "--output designed",
            "python -m fitting design --curl-diameter 30mm --waves 2 --hair fitted/fit.json --json",
        ],
    )
    add = top.add_argument
    add("--curl-diameter", required=True, type=length, help="such as 25mm")
    add("--length", type=length, default=0.2, help="of the hair, such as 30cm (default: 20 cm)")
    add("--waves", type=positive, help="turns of the curl (default: any number)")
    add("--after-wash", action=Switch, help="the curl is that after a wash")
    add("--weight", action=Switch, help="the hair hangs under its weight")
    add(
        "--disulfide-left",
        type=fraction,
        default=0.8,
        help="fraction of disulfide bonds that the perm leaves, where a rod goes with it "
        "(default: %(default)g)",
    )
    add(
        "--hair",
        metavar="FILE",
        help="fit.json of an earlier fit, whose influences f_j to use (default: the paper's)",
    )
    add("--check", action=Switch, default=True, help="leave out the finer simulation")
    add_output(top, FILES, required=False)
    add_json(top)
    add_quiet(top)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code: 1 if the wish is not met."""
    return status(parser(), _design, arguments)


def _design(options: argparse.Namespace) -> int:
    influence = {} if options.hair is None else {"influence": _influence(options.hair)}
    wish = Wish(
        options.curl_diameter,
        options.length,
        options.waves,
        options.after_wash,
        options.weight,
        options.disulfide_left,
        **influence,
    )
    folder = None if options.output is None else Path(options.output)
    if folder is not None:
        check_new_folder(folder, FILES, overwrite=options.overwrite)
    with Progress("designing", STAGES, unit="stage", shown=not options.quiet) as bar:

        def progress(done: int, doing: str) -> None:
            bar.update(done - bar.done, doing)

        try:
            found = design(wish, verify=options.check, progress=progress)
        except Unreachable as error:
            bar.close()
            told(error)
            return FAILED
    print(json.dumps(as_json(found), indent=2) if options.json else as_text(found))
    if folder is not None:
        wrote(options, write(found, folder, overwrite=options.overwrite))
    return OK if found.met else FAILED


def _influence(path: str) -> tuple[float, ...]:
    """f_j of a fit's report. Raises ValueError where there are none."""
    try:
        numbers = json.loads(Path(path).read_text(encoding="utf-8"))["parameters"]
        return tuple(float(numbers[f"bonds.influence[{kind}]"]["value"]) for kind in BONDS)
    except (ValueError, KeyError, TypeError, RecursionError):
        raise Mistake(f"--hair is {path}; it must be a fit.json with bonds.influence") from None


def write(found: Design, folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Writes design.json, the designed strand and a picture; returns the files written."""
    paths = [folder / name for name in FILES]
    for path in paths:
        check_new(path, overwrite=overwrite)
    points = found.fit.simulated[found.wish.state]
    with new_file(paths[0], overwrite=overwrite) as temporary:
        temporary.write_text(json.dumps(as_json(found), indent=2) + "\n", encoding="utf-8")
    write_curves(paths[1], Curves(points, np.array([points.shape[1]])), overwrite=overwrite)
    try:
        from jaxhair import pictures

        wanted, simulated = _side_by_side(found, points[0])
        pictures.comparison(
            paths[2],
            [wanted[None]],
            [simulated[None]],
            labels=[f"{1e3 * found.wish.curl_diameter:.4g} mm wanted"],
            residuals=[f"curl of {1e3 * found.curl_diameter:.4g} mm"],
            overwrite=overwrite,
        )
    except ImportError as error:
        print(f"no picture: {error}", file=sys.stderr)
        return paths[:2]
    return paths


def as_json(found: Design) -> dict[str, Any]:
    """The design as plain data; lengths in metres."""
    finer = found.finer_curl_diameter
    return {
        "wish": asdict(found.wish),
        "rod_diameter": found.rod_diameter,
        "rod_error": found.rod_error,
        "disulfide_left": found.disulfide_left,
        "climb": found.climb,
        "curl_diameter": found.curl_diameter,
        "finer_curl_diameter": None if math.isnan(finer) else finer,
        "waves": found.waves,
        "met": found.met,
        "unmet": list(found.unmet),
        "rod_change_by_standard_error_of": found.sensitivities,
    }


def _side_by_side(found: Design, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A regular curl of the wanted diameter, and the designed strand moved onto it."""
    edges = np.linalg.norm(np.diff(points, axis=0), axis=1)
    pitch = math.pi * found.wish.curl_diameter * math.tan(found.climb)
    curl = Helix(found.wish.curl_diameter, max(pitch, 0.0))
    wanted = np.asarray(curl.points(jnp.asarray(edges)[:, None, None], 1))[:, :, 0]
    wanted = wanted - wanted.mean(axis=0)
    off = aligned_residuals(jnp.asarray(points), jnp.asarray(wanted, points.dtype))
    return wanted, wanted + np.asarray(off)


if __name__ == "__main__":
    sys.exit(main())
