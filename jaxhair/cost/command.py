"""`python -m jaxhair cost`: what each effect of a scene costs, as a table, JSON and a picture."""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from jaxhair.cost import table
from jaxhair.cost.measuring import SceneCost, measured
from jaxhair.export import check_new_folder
from jaxhair.extras import optional
from jaxhair.output import new_file
from jaxhair.scene import Scene

FILES = ("cost.json", "cost.csv", "cost.png")


def add_command(commands: Any) -> argparse.ArgumentParser:
    """Add the command to those of a parser; returns its own, to add the scene's options to."""
    parser: argparse.ArgumentParser = commands.add_parser(
        "cost",
        help="measure what each effect of a scene costs",
        description="Measures time, floating-point operations, memory and compilation of one time "
        "step in each phase of a scene, with and without each effect, the bonds' rest shape and "
        "the solver, and prints what each adds. Phases with the same kinds of effects are "
        "measured once. Nothing else should run meanwhile.",
        epilog="example: python -m jaxhair cost bed-hair --output cost. In Python: "
        "from jaxhair.cost import measured; print(measured(scene))",
    )
    parser.add_argument("--json", action="store_true", help="print JSON in place of the table")
    parser.add_argument(
        "--output", metavar="DIR", help=f"write {', '.join(FILES)} into this folder"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files in DIR")
    parser.add_argument("--steps", type=int, default=16, help="in each timed call (16)")
    parser.add_argument("--repeat", type=int, default=200, help="most calls of each program (200)")
    parser.add_argument(
        "--gradients", action="store_true", help="measure derivatives of the whole step too"
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")
    return parser


def run(options: argparse.Namespace, scene: Scene) -> int:
    """Runs the command; returns 0, or 130 if it was interrupted."""
    folder = None if options.output is None else Path(options.output)
    if folder is not None:
        optional("matplotlib")
        check_new_folder(folder, FILES, overwrite=options.overwrite)
    try:
        cost = measured(
            scene,
            steps=options.steps,
            repeat=options.repeat,
            gradients=options.gradients,
            progress=not options.quiet,
        )
    except KeyboardInterrupt:
        print("interrupted: nothing is kept", file=sys.stderr)
        return 130
    print(json.dumps(table.as_json(cost), indent=2) if options.json else table.text(cost))
    if folder is not None:
        written = _write(cost, options.scene, folder, overwrite=options.overwrite)
        print("wrote " + ", ".join(map(str, written)), file=sys.stderr if options.json else None)
    return 0


def _write(cost: SceneCost, name: str, folder: Path, *, overwrite: bool) -> list[Path]:
    from jaxhair.cost import figures

    paths = [folder / file for file in FILES]
    texts = (json.dumps(table.as_json(cost), indent=2) + "\n", table.as_csv(cost))
    for path, content in zip(paths, texts, strict=False):
        with new_file(path, overwrite=overwrite) as temporary:
            temporary.write_text(content, encoding="utf-8", newline="")
    figures.bars(paths[-1], cost, name=name, overwrite=overwrite)
    return paths
