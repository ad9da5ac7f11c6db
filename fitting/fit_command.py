"""`python -m fitting --output DIR`: fits bond influences and cuticle wear to curls."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fitting.constraints import Constraint, Positive, Simplex
from fitting.fit import fit
from fitting.measured import Measured, packaged, read
from fitting.optimisers import METHODS
from fitting.report import check_outputs, table, write
from fitting.strands import STATES, from_strands
from jaxhair import read_curves
from jaxhair.command_line import FAILED, OK, Command, Mistake, Parser, status, wrote
from jaxhair.options import (
    Switch,
    add_checkpoint,
    add_json,
    add_output,
    add_quiet,
    add_strand_files,
    length,
    one_of,
    strand_files,
    whole,
)
from jaxhair.progress import Progress

FREE: dict[str, Constraint] = {"bonds.influence": Simplex(), "fibre.peeling_rate": Positive()}

COMMANDS = {
    "design": Command("the rod and the treatment for a wanted curl", "fitting.design_command"),
    "natural": Command("the shapes that strands of a file remember", "fitting.natural_command"),
    "published": Command("nine published perms, predicted", "fitting.published_command"),
}
"""Commands besides the fit."""


def parser() -> Parser:
    """The command's parser."""
    others = [f"  {name:<10} {command.summary}" for name, command in COMMANDS.items()]
    top = Parser(
        "python -m fitting",
        "Finds the bond influences f_j and the cuticle's peeling rate s with which hair takes the "
        "wanted curls. Without --target it fits curls measured on real hair that come with the "
        "package.",
        [
            "python -m fitting --output fitted",
            "python -m fitting --target permed=a.hair washed=b.hair --unit cm --output fitted",
            "python -m fitting --target curls.toml --method l-bfgs --json --output fitted",
        ],
    )
    top.epilog = "\n".join(["other commands, each with --help:", *others, "", str(top.epilog)])
    add = top.add_argument
    add(
        "--target",
        nargs="+",
        metavar="FILE",
        help="strands (.hair, .data, .npz, .abc, USD), each as FILE or STATE=FILE with a STATE of "
        f"{', '.join(STATES)} (in this order if not named); or one .toml of measured curls "
        "(default: the packaged curls)",
    )
    add_strand_files(top, read=True)
    add("--rod-diameter", type=length, help="such as 17mm (default: 0.6 of the curls' diameter)")
    add("--strands", type=whole(1), default=16,
        help="how many to use at most (default: %(default)d)")  # fmt: skip
    add("--points", type=whole(1), help="points on a simulated strand (default: enough for curls)")
    add("--weight", action=Switch, help="the target hangs under gravity")
    add("--method", default=METHODS[0], help="optimiser (default: %(default)s)", **one_of(*METHODS))
    add("--steps", type=whole(1), default=50,
        help="largest number of simulations (default: %(default)d)")  # fmt: skip
    add_output(top, ("fit.json", "fit.png", "fitted-STATE.hair"))
    add_json(top)
    add_checkpoint(top)
    add_quiet(top)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code: 1 if the fit did not converge."""
    return status(parser(), _fit, arguments)


def _measured(options: argparse.Namespace) -> Measured:
    """What to fit."""
    if not options.target:
        return packaged()
    if len(options.target) == 1 and options.target[0].endswith(".toml"):
        return read(options.target[0])
    files_are = strand_files(options)
    observed: dict[str, Any] = {}
    unnamed = iter(STATES)
    for text in options.target:
        state, path = _state_and_path(text)
        if state is None:
            state = next((s for s in unnamed if s not in observed), None)
            if state is None:
                raise Mistake(f"--target has {len(options.target)} files; at most {len(STATES)}")
        if state in observed:
            raise Mistake(f"--target has {state!r} twice; states must differ")
        observed[state] = read_curves(path, skip_short=True, **files_are)
    return from_strands(
        observed,
        rod_diameter=options.rod_diameter,
        strands=options.strands,
        points=options.points,
        weight=options.weight,
    )


def _state_and_path(text: str) -> tuple[str | None, str]:
    """STATE=FILE, or a FILE, even one whose name has a "="."""
    state, equals, path = text.partition("=")
    if equals and not Path(text).exists():
        if state not in STATES:
            raise Mistake(f"--target names {state!r}; it must be one of {', '.join(STATES)}")
        return state, path
    return None, text


def _fit(options: argparse.Namespace) -> int:
    folder = Path(options.output)
    if not options.overwrite and (folder / "fit.json").exists():
        raise FileExistsError(
            f"{folder / 'fit.json'} exists: --output must be another folder, or add --overwrite"
        )
    measured = _measured(options)
    folder.mkdir(parents=True, exist_ok=True)
    check_outputs(folder, measured.states, overwrite=options.overwrite)
    if not options.quiet:
        said = f"Fitting: {measured.title}. The first simulation includes compilation."
        print(said, file=sys.stderr, flush=True)
    # other starts, and the line searches of L-BFGS, take simulations beyond the steps
    most = None if options.method == "l-bfgs" else options.steps
    with Progress("fitting, at most", most, unit="simulation", shown=not options.quiet) as bar:

        def progress(simulations: int, misfit: float, values: dict[str, np.ndarray]) -> None:
            total = None if most is None else max(most, simulations)
            said = f"misfit {misfit:.4g} standard errors"
            bar.update(simulations - bar.done, said, total=total)

        result = fit(
            measured.scene,
            measured.targets,
            FREE,
            method=options.method,
            steps=options.steps,
            progress=None if options.quiet else progress,
            checkpoint=options.checkpoint,
        )
    written = write(result, folder, overwrite=options.overwrite, target=measured.title)
    print(written[0].read_text(encoding="utf-8").strip() if options.json else table(result))
    wrote(options, written)
    return OK if result.converged else FAILED
