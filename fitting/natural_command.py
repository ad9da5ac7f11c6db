"""The command line: `python -m fitting natural head.hair --output DIR` fits natural strands."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fitting.many import SHARES, FitEach, quantiles
from fitting.measures import curl
from fitting.natural import REMEMBERED, STATE, UNLOADED, Natural, natural
from fitting.report import plain, versions
from jaxhair import BONDS, Curves, read_strands, write_curves
from jaxhair.command_line import OK, Mistake, Parser, status, wrote
from jaxhair.export import check_new_folder
from jaxhair.options import (
    Switch,
    add_checkpoint,
    add_json,
    add_output,
    add_quiet,
    add_strand_files,
    strand_files,
    whole,
)
from jaxhair.output import new_file
from jaxhair.progress import Progress

REPORT, PICTURE = "natural.json", "natural.png"
STRANDS = {state: f"{state}.hair" for state in (STATE, UNLOADED, REMEMBERED)}
STEPS = 30
"""Simulations of a fit, at most."""


def parser() -> Parser:
    """The command's parser."""
    top = Parser(
        "python -m fitting natural",
        "Finds for each strand of a file the shape that its bonds must remember for it to hang as "
        "it does; and, where the same strands were seen without weight too, its hydrogen bonds' "
        "influence and its cuticle's peeling rate, with their intervals. Says how near each strand "
        "comes, and which strands cannot be fitted and why.",
        [
            "python -m fitting natural head.hair --unit cm --up y --output natural",
            "python -m fitting natural hanging.hair --unloaded floating.hair --output natural",
        ],
        [
            f"Writes {REPORT}, {PICTURE} and, of the strands that were fitted, {STRANDS[STATE]} "
            f"(as simulated), {STRANDS[REMEMBERED]} (as they are remembered) and, with --unloaded, "
            f"{STRANDS[UNLOADED]}."
        ],
    )
    add = top.add_argument
    add("file", metavar="FILE", help="strands as they hang: .hair, .data, .npz, .abc or USD")
    add("--unloaded", metavar="FILE", help="the same strands without weight")
    add_strand_files(top, read=True)
    add("--strands", type=whole(1), help="how many to use at most, spread evenly (default: all)")
    add("--points", type=whole(4), help="points on a simulated strand (default: 17 to 65)")
    add(
        "--weight",
        action=Switch,
        default=True,
        help="FILE shows strands without weight, as modelled",
    )
    add_output(top, (REPORT, PICTURE, *STRANDS.values()))
    add_json(top)
    add_checkpoint(top)
    add_quiet(top)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return status(parser(), _natural, arguments)


def _natural(options: argparse.Namespace) -> int:
    if options.unloaded is not None and not options.weight:
        raise Mistake("--no-weight is for strands of one file; leave out it or --unloaded")
    files_are = strand_files(options)
    files = [options.file] + ([] if options.unloaded is None else [options.unloaded])
    seen = [read_strands(path, **files_are) for path in files]
    folder = Path(options.output)
    states = (STATE, REMEMBERED) if options.unloaded is None else (STATE, UNLOADED, REMEMBERED)
    names = (REPORT, PICTURE, *(STRANDS[state] for state in states))
    check_new_folder(folder, names, overwrite=options.overwrite)
    kept = None if options.checkpoint is None else Path(options.checkpoint)
    shown = not options.quiet
    with Progress("shapes to remember, at most", None, unit="strand", shown=shown) as bar:
        hair = natural(
            seen[0],
            unloaded=None if len(seen) == 1 else seen[1],
            points=options.points,
            weight=options.weight,
            strands=options.strands,
            seconds=0.5 if len(seen) == 1 else 1.5,
            progress=lambda done, left: bar.update(done - bar.done, total=done + left),
            checkpoint=None if kept is None else kept / "stiffness",
        )
    # strands that are fitted drop out, so that no simulation of all is slower than the one before
    with Progress("fitting, at most", STEPS, unit="simulation", shown=shown) as bar:
        found = hair.fit(
            progress=lambda step, mm: bar.update(step - bar.done, f"residual {mm:.4g} mm"),
            checkpoint=None if kept is None else kept / "fit",
        )
    written = write(
        hair,
        found,
        folder,
        **files_are,
        overwrite=options.overwrite,
        files=[str(path) for path in files],
    )
    report = written[0].read_text(encoding="utf-8").strip()
    print(report if options.json else hair.table(found))
    wrote(options, written)
    return OK


def write(
    hair: Natural,
    found: FitEach,
    folder: Path,
    *,
    unit: float = 1.0,
    up: Literal["y", "z"] = "z",
    overwrite: bool = False,
    **more: Any,
) -> list[Path]:
    """Writes `natural.json`, the fitted strands of each state and `natural.png`.

    The folder must exist. The picture needs the extra `pictures`; without it the rest is written.
    Returns the files.

    Arguments:
        unit, up: of the strand files, see `jaxhair.write_curves`.
        more: what else to put into the report.
    """
    simulated = hair.simulated(found)
    more = {**more, "unit_of_hair_files": unit, "up_of_hair_files": up}
    whole = as_json(hair, found, simulated[REMEMBERED], **more)
    with new_file(folder / REPORT, overwrite=overwrite) as temporary:
        temporary.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    paths = [folder / REPORT]
    for state, points in simulated.items() if found.fitted.any() else ():
        some = points[found.fitted]
        curves = Curves(some, np.full(len(some), some.shape[1]))
        write_curves(folder / STRANDS[state], curves, unit=unit, up=up, overwrite=overwrite)
        paths.append(folder / STRANDS[state])
    try:
        picture(folder / PICTURE, hair, found, overwrite=overwrite)
        paths.append(folder / PICTURE)
    except ImportError as error:
        print(f"no picture: {error}", file=sys.stderr)
    return paths


def as_json(hair: Natural, found: FitEach, remembered: np.ndarray, **more: Any) -> dict[str, Any]:
    """The fit as plain data, in SI units but for residuals in mm.

    Arguments:
        remembered: points of the shape that each strand remembers [m], shape (strands, points, 3).
        more: what else to put in.
    """
    rows = [{"strand": i, "reason": reason} for i, reason in hair.left.items()]
    rows += _rows(hair, found, remembered)
    mm, of_length = found.residual_mm, hair.of_length(found)
    return {
        **more,
        "strands": len(rows),
        "fitted": int(found.fitted.sum()),
        "points": hair.scene.strands.points,
        "shares": list(SHARES),
        "residual_mm": plain(quantiles(mm)),
        "residual_of_length": plain(quantiles(of_length)),
        "resampling_mm": plain(quantiles(hair.resampling_mm)),
        "not_fitted": [
            {"strand": i, "reason": reason} for i, reason in hair.reasons(found).items()
        ],
        "each": sorted(rows, key=lambda row: int(row["strand"])),
        "seconds": found.seconds,
        "versions": versions(),
    }


def _rows(hair: Natural, found: FitEach, remembered: np.ndarray) -> list[dict[str, Any]]:
    """What was found of each strand that was simulated."""
    curls = curl(remembered)
    shape = "strands.natural_shape"
    scale = np.exp(found.numbers[shape][:, 0])  # as `Scale` has it
    columns: dict[str, np.ndarray] = {
        "length": hair.lengths,
        "residual_mm": found.residual_mm,
        "residual_of_length": hair.of_length(found),
        "resampling_mm": hair.resampling_mm,
        "stiffness_over_a_single_hairs": hair.stiffer,
        "remembered_curvature": np.asarray(curls.curvature),
        "remembered_torsion": np.asarray(curls.torsion),
        "shape_scale": scale,
        "shape_scale_error": scale * found.number_errors[shape][:, 0],
    }
    for name in ("fibre.peeling_rate", "bonds.influence"):
        if name in found.values:
            value, error = found.values[name], found.errors[name]
            kinds = BONDS if value.ndim == 2 else (None,)
            for j, kind in enumerate(kinds):
                label = name if kind is None else f"{name}[{kind}]"
                columns[label] = value if kind is None else value[:, j]
                columns[f"{label} error"] = error if kind is None else error[:, j]
    for label, ends in (found.intervals or {}).items():
        columns[f"{label} interval"] = ends  # null: without end
    places = np.where(found.fitted, np.cumsum(found.fitted) - 1, -1)
    return [
        {
            "strand": int(number),
            "reason": found.reasons[i],
            "place_in_hair_files": int(places[i]) if found.fitted[i] else None,
            "converged": bool(found.converged[i]),
            "simulations": int(found.steps[i]),
            **{name: plain(column[i]) for name, column in columns.items()},
        }
        for i, number in enumerate(hair.used)
    ]


def picture(path: Path, hair: Natural, found: FitEach, *, overwrite: bool = False) -> None:
    """Draws how the residuals are distributed: counts above, cumulated below (.png)."""
    from jaxhair.figures import FITTED_COLOR, TARGET_COLOR, figure

    drawing, _ = figure(7.0, 6.4, dpi=150, layout="constrained")
    count, total = int(found.fitted.sum()), len(hair.used) + len(hair.left)
    drawing.suptitle(f"{count} of {total} strands fitted", fontweight="bold")
    top, below = drawing.subplots(2, 1, sharex=True)
    drawn = (
        ("residual of the fit", found.residual_mm, FITTED_COLOR),
        ("off the file's points by resampling", hair.resampling_mm, TARGET_COLOR),
    )
    known = [np.sort(x[np.isfinite(x) & (x > 0)]) for _, x, _ in drawn]
    ends = np.concatenate([*known, [1e-3, 1.0]])
    bins = np.geomspace(ends.min(), ends.max(), 60)
    for (label, _, color), x in zip(drawn, known, strict=True):
        top.hist(x, bins, color=color, alpha=0.7, label=label)
        below.step(x, 100 * np.arange(1, len(x) + 1) / max(len(x), 1), color=color, where="post")
    top.set(xscale="log", ylabel="strands")
    top.yaxis.get_major_locator().set_params(integer=True)
    top.legend(frameon=False)
    below.set(xlabel="root mean square distance of a strand's points [mm]", ylim=(0, 102))
    below.set_ylabel("share of strands at or below [%]")
    for axes in (top, below):
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
    with new_file(path, overwrite=overwrite) as temporary:
        drawing.savefig(temporary)


if __name__ == "__main__":
    sys.exit(main())
