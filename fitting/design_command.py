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

from fitting.design import Design, Wish, as_text, design
from fitting.targets import Helix, aligned_residuals
from jaxhair import BONDS, Curves, write_curves
from jaxhair.__main__ import length, parsed
from jaxhair.export import check_new
from jaxhair.output import new_file

FILES = ("design.json", "designed.hair", "design.png")


def parser() -> argparse.ArgumentParser:
    """The command line's parser."""
    top = argparse.ArgumentParser(
        prog="python -m fitting design",
        description="Finds the perm rod, and where no rod will do another treatment, that give a "
        "wanted curl; checks it in a finer simulation; says how the answer changes with what is "
        "not well known of a hair. A curl that cannot be had is refused with the nearest that can.",
        epilog="example: python -m fitting design --curl-diameter 25mm --length 20cm --after-wash "
        "--output designed",
    )
    top.add_argument("--curl-diameter", required=True, type=length, help="such as 25mm")
    top.add_argument("--length", type=length, default=0.2, help="of the hair (20cm)")
    top.add_argument("--waves", type=float, help="turns of the curl (any)")
    top.add_argument("--after-wash", action="store_true", help="the curl is that after a wash")
    top.add_argument("--weight", action="store_true", help="the hair hangs under its weight")
    top.add_argument(
        "--disulfide-left",
        type=float,
        default=0.8,
        help="fraction of disulfide bonds that the perm leaves, where a rod goes with it (0.8)",
    )
    top.add_argument(
        "--hair", metavar="FILE", help="fit.json of an earlier fit, whose influences f_j to use"
    )
    top.add_argument("--no-check", action="store_true", help="leave out the finer simulation")
    top.add_argument("--output", metavar="DIR", help=f"folder for {', '.join(FILES)}")
    top.add_argument("--overwrite", action="store_true", help="replace files in DIR")
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Designs, prints and writes; returns 0, or 1 if the wish is not met, or 2 if it cannot be or
    after a mistake in the request."""
    options = parsed(parser(), arguments)
    try:
        folder = None if options.output is None else Path(options.output)
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            for name in FILES:
                check_new(folder / name, overwrite=options.overwrite)
        wish = Wish(
            options.curl_diameter,
            options.length,
            options.waves,
            options.after_wash,
            options.weight,
            options.disulfide_left,
            **({} if options.hair is None else {"influence": _influence(options.hair)}),
        )
        found = design(wish, verify=not options.no_check)
        print(as_text(found))
        if folder is not None:
            written = write(found, folder, overwrite=options.overwrite)
            print("wrote " + ", ".join(str(path) for path in written))
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0 if found.met else 1


def _influence(path: str) -> tuple[float, ...]:
    """f_j of a fit's report. Raises ValueError where there are none."""
    try:
        numbers = json.loads(Path(path).read_text(encoding="utf-8"))["parameters"]
        return tuple(float(numbers[f"bonds.influence[{kind}]"]["value"]) for kind in BONDS)
    except (ValueError, KeyError, TypeError, RecursionError):
        raise ValueError(f"--hair is {path}; it must be a fit.json with bonds.influence") from None


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
        print(f"no picture: {error}")
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
