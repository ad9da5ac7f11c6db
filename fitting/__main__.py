"""The command line: `python -m fitting --output DIR` fits bond influences and cuticle wear."""

import argparse
import sys
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from fitting.command_line import STRAND_UNITS, add_strand_files, add_work, status
from fitting.constraints import Constraint, Positive, Simplex
from fitting.fit import fit
from fitting.measured import Measured, packaged, read
from fitting.optimisers import METHODS
from fitting.report import check_outputs, table, write
from fitting.strands import STATES, from_strands
from jaxhair import read_curves
from jaxhair.__main__ import length, parsed

FREE: dict[str, Constraint] = {"bonds.influence": Simplex(), "fibre.peeling_rate": Positive()}

COMMANDS = {
    "design": "fitting.design_command",
    "natural": "fitting.natural_command",
    "published": "fitting.published",
}
"""Commands besides the fit, each a module with a `main`."""


def parser() -> argparse.ArgumentParser:
    """The command line's parser."""
    top = argparse.ArgumentParser(
        prog="python -m fitting",
        description="Finds the bond influences f_j and the cuticle's peeling rate s with which "
        "hair takes the wanted curls. Without --target it fits curls measured on real hair that "
        "come with the package. Other commands: "
        + "; ".join(f"python -m fitting {name} --help" for name in COMMANDS)
        + ".",
        epilog="example: python -m fitting --target permed=a.hair washed=b.hair --output fitted",
    )
    top.add_argument("--output", required=True, metavar="DIR", help="folder for the results")
    top.add_argument(
        "--target",
        nargs="+",
        metavar="FILE",
        help="strands (.hair, .data, .npz, USD), each as FILE or STATE=FILE with a STATE of "
        f"{', '.join(STATES)} (in this order if not named); or one .toml of measured curls",
    )
    add_strand_files(top)
    top.add_argument("--rod-diameter", type=length, help="such as 17mm (0.6 of the curls')")
    top.add_argument("--strands", type=int, default=16, help="how many to use at most (16)")
    top.add_argument("--points", type=int, help="points on a simulated strand")
    top.add_argument("--weight", action="store_true", help="the target hangs under gravity")
    top.add_argument("--method", choices=METHODS, default=METHODS[0], help=f"({METHODS[0]})")
    top.add_argument("--steps", type=int, default=50, help="largest number of simulations (50)")
    add_work(top)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command, or the fit where none is named; returns 0, or 1 if it did not converge, or 2
    after a mistake in the request, or 130 after Ctrl-C."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in COMMANDS:
        return import_module(COMMANDS[given[0]]).main(given[1:])
    return status(_fit, parsed(parser(), given))


def _measured(options: argparse.Namespace) -> Measured:
    """What to fit."""
    if not options.target:
        return packaged()
    if len(options.target) == 1 and options.target[0].endswith(".toml"):
        return read(options.target[0])
    unit = None if options.unit is None else STRAND_UNITS[options.unit]
    observed: dict[str, Any] = {}
    unnamed = iter(STATES)
    for text in options.target:
        state, path = _state_and_path(text)
        if state is None:
            state = next((s for s in unnamed if s not in observed), None)
            if state is None:
                raise ValueError(f"--target has {len(options.target)} files; at most {len(STATES)}")
        if state in observed:
            raise ValueError(f"--target has {state!r} twice; states must differ")
        observed[state] = read_curves(path, unit=unit, up=options.up, skip_short=True)
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
            raise ValueError(f"--target names {state!r}; it must be one of {', '.join(STATES)}")
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
        print(f"Fitting: {measured.title}. The first simulation includes compilation.")

    began = time.monotonic()
    told: list[float] = []

    def progress(simulations: int, misfit: float, values: dict[str, np.ndarray]) -> None:
        spent = time.monotonic() - began
        told.append(spent)
        left = ""
        # other starts, and the line searches of L-BFGS, take simulations beyond the steps
        if 1 < simulations < options.steps and options.method != "l-bfgs":
            each = (spent - told[0]) / (simulations - 1)  # without compilation
            most = each * (options.steps - simulations)
            left = f", at most {most:.0f} s left"
        shown = "; ".join(
            f"{name} {' '.join(f'{x:.4g}' for x in np.ravel(value))}"
            for name, value in values.items()
        )
        print(
            f"  simulation {simulations:3d}: misfit {misfit:.4g} standard errors, {spent:.0f} s"
            f"{left}\n    {shown}",
            flush=True,
        )

    result = fit(
        measured.scene,
        measured.targets,
        FREE,
        method=options.method,
        steps=options.steps,
        progress=None if options.quiet else progress,
        checkpoint=options.checkpoint,
    )
    print(table(result))
    written = write(result, folder, overwrite=options.overwrite, target=measured.title)
    print("wrote " + ", ".join(str(path) for path in written))
    return 0 if result.converged else 1


if __name__ == "__main__":
    sys.exit(main())
