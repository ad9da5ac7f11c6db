"""`python -m jaxhair accuracy`: measures settings and writes tables and pictures of them."""

import argparse
import csv
import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax

from jaxhair.accuracy import grid, table
from jaxhair.accuracy.grid import Plan
from jaxhair.accuracy.measuring import Row, measure
from jaxhair.accuracy.problem import PARAMETERS, Reference, reference
from jaxhair.accuracy.stretch import Stretch, stretch
from jaxhair.command_line import INTERRUPTED, OK, Parser, status, wrote
from jaxhair.export import check_new_folder
from jaxhair.extras import optional
from jaxhair.options import Switch, add_json, add_output, add_quiet, whole
from jaxhair.output import new_file
from jaxhair.progress import each

FILES = ("accuracy.csv", "accuracy.json", "stretch.csv", "accuracy.png", "theory.png")
BASE_ITERATIONS = 5
"""With which the substeps are swept."""


def parser() -> Parser:
    """The command's parser."""
    top = Parser(
        "python -m jaxhair accuracy",
        "Measures error, time and memory of solvers, iterations, substeps, time steps, points "
        "and dtypes on a perm that springs off its rod, for the final shape and for a "
        "reverse-mode gradient, against a fine reference whose own error is bounded. Writes "
        "work-precision diagrams (accuracy.png), their numbers (accuracy.csv, accuracy.json) and "
        "how the paper's solver stretches a hanging strand (theory.png, stretch.csv), and prints "
        "the cheapest settings for some errors. Nothing else should run meanwhile. Ctrl-C keeps "
        "what was measured.",
        [
            "python -m jaxhair accuracy --quick --output quick",
            "python -m jaxhair accuracy --strands 200 --output accuracy",
        ],
        [
            'In Python, jaxhair.cheapest(0.01, table="accuracy/accuracy.csv") gives the settings '
            "for an error of 1 %."
        ],
    )
    add_output(top, FILES)
    add = top.add_argument
    add("--quick", action=Switch, help="a few settings, coarser reference")
    add("--strands", type=whole(1), default=64,
        help="number of strands that are timed together (default: %(default)d)")  # fmt: skip
    add_json(top)
    add_quiet(top)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return status(parser(), _accuracy, arguments)


def _accuracy(options: argparse.Namespace) -> int:
    plan = grid.plan(strands=options.strands, quick=options.quick)
    optional("matplotlib")
    folder = Path(options.output)
    check_new_folder(folder, FILES, overwrite=options.overwrite)
    results = _measured(plan, progress=not options.quiet)
    if results.reference is None or not results.rows:
        print("interrupted: nothing was measured yet", file=sys.stderr)
        return INTERRUPTED
    written = _write(plan, results, folder, overwrite=options.overwrite)
    if options.json:
        whole = {**description(plan, results), "settings": table.as_json(results.rows)}
        print(json.dumps(whole, indent=2))
    else:
        print(_report(plan, results))
    wrote(options, written)
    if not results.complete:
        kept = f"{len(results.rows)} of {len(plan.settings)} settings"
        print(f"interrupted: {kept} are kept", file=sys.stderr)
    return OK if results.complete else INTERRUPTED


@dataclass
class Results:
    """What has been measured so far."""

    reference: Reference | None = None
    rows: list[Row] = field(default_factory=list)
    stretches: list[Stretch] = field(default_factory=list)
    complete: bool = False


def _measured(plan: Plan, *, progress: bool) -> Results:
    """All that is planned, or, after Ctrl-C, what was measured before it."""
    results = Results()
    wanted = {(n, 1): None for n in plan.iterations}
    wanted |= {(BASE_ITERATIONS, m): None for m in plan.substeps}
    try:
        if progress:
            print("Computing the reference.", file=sys.stderr, flush=True)
        results.reference = reference(
            plan.problem,
            points=plan.points,
            steps_per_second=plan.steps_per_second,
            levels=plan.levels,
        )
        if progress:
            print(results.reference, file=sys.stderr, flush=True)
        for setting in each(plan.settings, "measuring", unit="setting", shown=progress, said=str):
            results.rows.append(measure(plan.problem, results.reference, setting))
        title = "iterations and substeps of a hanging strand"
        for iterations, substeps in each(
            list(wanted), title, unit="setting", shown=progress, said=str
        ):
            results.stretches.append(stretch(iterations, substeps))
    except KeyboardInterrupt:
        return results
    results.complete = True
    return results


def _write(plan: Plan, results: Results, folder: Path, *, overwrite: bool) -> list[Path]:
    """The files' paths."""
    from jaxhair.accuracy import figures

    assert results.reference is not None
    paths = {name: folder / name for name in FILES}
    table.write(paths["accuracy.csv"], results.rows, overwrite=overwrite)
    table.write_json(paths["accuracy.json"], description(plan, results), overwrite=overwrite)
    figures.accuracy(
        paths["accuracy.png"], results.rows, plan.problem, results.reference, overwrite=overwrite
    )
    if results.stretches:
        with (
            new_file(paths["stretch.csv"], overwrite=overwrite) as temporary,
            temporary.open("w", encoding="utf-8", newline="") as file,
        ):
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("iterations", "substeps", "stretch_relative", "theory_relative"))
            for s in results.stretches:
                writer.writerow((s.iterations, s.substeps, f"{s.measured:.6g}", f"{s.theory:.6g}"))
        figures.theory(paths["theory.png"], results.stretches, overwrite=overwrite)
    else:
        del paths["stretch.csv"], paths["theory.png"]
    return list(paths.values())


def description(plan: Plan, results: Results) -> dict[str, Any]:
    """What the table was measured on and against, for accuracy.json."""
    found, problem = results.reference, plan.problem
    assert found is not None
    return {
        "problem": {
            "what": "hair wound on a rod, permed there and released under gravity",
            "strands": problem.strands,
            "length_m": problem.length,
            "rod_diameter_m": problem.rod_diameter,
            "seconds": problem.seconds,
        },
        "reference": {
            "what": str(found),
            "bound_relative_to_length": found.bound,
            "gradient_bound_relative": found.gradient_bound,
            "points": found.points,
            "steps_per_second": found.steps_per_second,
            "levels": found.levels,
            "seconds": found.seconds,
            "shape_m": found.shape.tolist(),
            "gradient": dict(zip(PARAMETERS, found.gradient.tolist(), strict=True)),
        },
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "complete": results.complete,
    }


def _report(plan: Plan, results: Results) -> str:
    """The cheapest settings for some errors."""
    rows, found = results.rows, results.reference
    failed = sum(not row.forward.ok for row in rows)
    lines = [
        f"{found}",
        f"{len(rows)} settings, of which {failed} failed; {plan.problem.strands} strands; "
        f"{os.cpu_count()} cores, jax {jax.__version__}",
        "",
        "Cheapest for the shape (error over the length, wall seconds per simulated second)",
        table.recommended(rows, gradient=False),
    ]
    if any(row.gradient is not None for row in rows):
        lines += [
            "",
            "Cheapest for the gradient (error over its norm)",
            table.recommended(rows, gradient=True),
        ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
