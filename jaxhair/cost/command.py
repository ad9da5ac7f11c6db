"""`python -m jaxhair cost`: what each effect of a scene costs, as a table, JSON and a picture."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from jaxhair.command_line import OK, Parser, status, wrote
from jaxhair.cost import table
from jaxhair.cost.measuring import SceneCost, measured
from jaxhair.export import check_new_folder
from jaxhair.extras import optional
from jaxhair.options import Switch, add_json, add_output, add_quiet, whole
from jaxhair.output import new_file
from jaxhair.scene_options import NOTE, add_scene, listed, scene_of

FILES = ("cost.json", "cost.csv", "cost.png")


def parser() -> Parser:
    """The command's parser."""
    top = Parser(
        "python -m jaxhair cost",
        "Measures time, floating-point operations, memory and compilation of one time step in "
        "each phase of a scene, with and without each effect, the bonds' rest shape and the "
        "solver, and prints what each adds. With hair contact the scene is simulated first, and "
        "each phase measured from its own start; without, phases with the same kinds of effects "
        "are measured once. Nothing else should run meanwhile.",
        [
            "python -m jaxhair cost bed-hair --output cost",
            "python -m jaxhair cost perm --no-contact --solver direct --json",
        ],
        [NOTE, "In Python: from jaxhair.cost import measured; print(measured(scene))."],
    )
    add_scene(top)
    group = top.add_argument_group("the measurement")
    add = group.add_argument
    add("--steps", type=whole(1, 100_000), default=16,
        help="time steps in each timed call (default: %(default)d)")  # fmt: skip
    add("--repeat", type=whole(1), default=200,
        help="most calls of each program (default: %(default)d)")  # fmt: skip
    add("--gradients", action=Switch, help="measure derivatives of the whole step too")
    group = top.add_argument_group("the output")
    add_output(group, FILES, required=False)
    add_json(group)
    add_quiet(group)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return status(parser(), _cost, arguments)


def _cost(options: argparse.Namespace) -> int:
    scene = scene_of(options)
    if options.list:
        print(listed(scene))
        return OK
    folder = None if options.output is None else Path(options.output)
    if folder is not None:
        optional("matplotlib")
        check_new_folder(folder, FILES, overwrite=options.overwrite)
    cost = measured(
        scene,
        steps=options.steps,
        repeat=options.repeat,
        gradients=options.gradients,
        progress=not options.quiet,
    )
    print(json.dumps(table.as_json(cost), indent=2) if options.json else table.text(cost))
    if folder is not None:
        wrote(options, _write(cost, options.scene, folder, overwrite=options.overwrite))
    return OK


def _write(cost: SceneCost, name: str, folder: Path, *, overwrite: bool) -> list[Path]:
    from jaxhair.cost import figures

    paths = [folder / file for file in FILES]
    texts = (json.dumps(table.as_json(cost), indent=2) + "\n", table.as_csv(cost))
    for path, content in zip(paths, texts, strict=False):
        with new_file(path, overwrite=overwrite) as temporary:
            temporary.write_text(content, encoding="utf-8", newline="")
    figures.bars(paths[-1], cost, name=name, overwrite=overwrite)
    return paths


if __name__ == "__main__":
    sys.exit(main())
