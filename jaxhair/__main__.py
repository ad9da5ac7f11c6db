"""The command line: `python -m jaxhair simulate perm --output perm.png`, `accuracy`, `cost`."""

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import jax

from jaxhair import check, scenes
from jaxhair.accuracy import command as accuracy
from jaxhair.cost import command as cost
from jaxhair.direct import Direct
from jaxhair.export import (
    COLORS,
    PICTURES,
    check_color,
    check_drawing,
    check_ending,
    check_new,
    save,
)
from jaxhair.recording import NotFinite, simulate
from jaxhair.scene import Scene
from jaxhair.solvers import SWEEPS, Compliant, PositionBased, Solver
from jaxhair.treatments import wash


def parser() -> argparse.ArgumentParser:
    """The command line's parser."""
    top = argparse.ArgumentParser(
        prog="python -m jaxhair", description="Simulates hair whose bonds break and re-form."
    )
    commands = top.add_subparsers(dest="command", required=True)
    run = commands.add_parser(
        "simulate",
        help="simulate one of the paper's scenes",
        description="Simulates a scene and writes arrays (.npz), the animation for other programs "
        "(.usdc, .usda, .usd), the last frame's strands (.hair, .data), a picture of it (.png), a "
        "movie (.gif, .mp4) or a web page to turn and play it (.html).",
        epilog="example: python -m jaxhair simulate perm --rod-diameter 60mm --output perm.gif",
    )
    _add_scene(run)
    run.add_argument("--output", required=True, metavar="FILE", help="file to write")
    run.add_argument("--overwrite", action="store_true", help="replace FILE if it exists")
    run.add_argument("--fps", type=float, default=30.0, help="frames a second (30)")
    run.add_argument(
        "--color-by",
        choices=COLORS,
        help="show a bonded fraction, blue 0 to red 1; in .html also strain, curvature",
    )
    run.add_argument("--size", type=int, default=800, help="of pictures, pixels (800)")
    run.add_argument(
        "--checkpoint",
        metavar="DIR",
        help="keep the frames in this folder every 10 seconds: however the work is interrupted, "
        "the same command goes on from there, to the same frames. Delete it when all is done",
    )
    run.add_argument(
        "--devices",
        type=int,
        default=1,
        help="spread the strands over so many devices: accelerators, or on a CPU the cores; not "
        "with hair against hair (1)",
    )
    run.add_argument("--quiet", action="store_true", help="show no progress")
    accuracy.add_command(commands)
    _add_scene(cost.add_command(commands))
    return top


def _add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the scene and its options, which `_scene` makes a scene of."""
    parser.add_argument("scene", choices=tuple(scenes.SCENES), help="which scene")
    parser.add_argument("--strands", type=int, help="number of strands (as in the paper)")
    parser.add_argument("--points", type=int, help="points on a strand (as in the paper)")
    parser.add_argument("--length", type=length, help="of a strand, such as 24cm (as in the paper)")
    parser.add_argument("--rod-diameter", type=length, help="perm only, such as 60mm (60mm)")
    parser.add_argument(
        "--prepared", action="store_true", help="perm only: start wound, skip the winding"
    )
    parser.add_argument("--no-contact", action="store_true", help="hairs pass through each other")
    parser.add_argument("--wash", action="store_true", help="wash the hair at the end")
    parser.add_argument(
        "--solver",
        choices=SOLVERS,
        default="paper",
        help="the paper's, with its k; or, with stiffnesses in pascal, compliant constraints "
        "(XPBD) or the direct solver (paper)",
    )
    parser.add_argument("--iterations", type=int, help="of paper or compliant in a step (5)")
    parser.add_argument("--sweep", choices=SWEEPS, help="order, of the same (red-black)")
    parser.add_argument("--newton-steps", type=int, help="of direct in a step (1)")
    parser.add_argument("--substeps", type=int, default=1, help="solves in a step (1)")
    parser.add_argument("--steps-per-second", type=float, default=360, help="time steps (360)")
    parser.add_argument("--seconds", type=float, help="stop after this simulated time")
    parser.add_argument("--seed", type=int, default=0, help="of the roots' places (0)")


SOLVERS: dict[str, type[Any]] = {
    "paper": PositionBased,
    "compliant": Compliant,
    "direct": Direct,
}

UNITS = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}


def length(text: str) -> float:
    """A length [m] from a text such as "17mm", "24 cm" or "0.24"."""
    number, unit = text.strip(), 1.0
    for ending, size in UNITS.items():
        if number.endswith(ending):
            number, unit = number.removesuffix(ending), size
            break
    try:
        return float(number) * unit
    except ValueError:
        message = f"{text!r} is no length; it must be a number with mm, cm or m, such as 17mm"
        raise argparse.ArgumentTypeError(message) from None


def parsed(top: argparse.ArgumentParser, arguments: Sequence[str] | None) -> argparse.Namespace:
    """The options; a value of "--", of which argparse makes an empty list, is a mistake."""
    options = top.parse_args(arguments)
    for name, value in vars(options).items():
        if value == []:
            top.error(f"argument --{name.replace('_', '-')}: expected a value")
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns 0, or 2 after a mistake in what was asked, or 1 if it failed."""
    options = parsed(parser(), arguments)
    try:
        if options.command == "accuracy":
            return accuracy.run(options)
        if options.command == "cost":
            return cost.run(options, _scene(options))
        return _simulate(options)
    except (ValueError, OSError, ImportError, NotFinite) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1 if isinstance(error, NotFinite) else 2


def _scene(options: argparse.Namespace) -> Scene:
    if options.strands is not None:
        check.whole("--strands", options.strands, least=1)
    check.whole("--seed", options.seed, least=0)
    chosen: dict[str, Any] = {
        "strands": options.strands,
        "points": options.points,
        "length": options.length,
        "rod_diameter": options.rod_diameter,
    }
    chosen = {name: value for name, value in chosen.items() if value is not None}
    if options.prepared:
        chosen["winding"] = False
    if options.scene != "perm":
        for name, flag in (("rod_diameter", "--rod-diameter"), ("winding", "--prepared")):
            if name in chosen:
                raise ValueError(f"{flag} is for the perm; the scene is {options.scene!r}")
    if options.steps_per_second <= 0:
        raise ValueError(f"--steps-per-second is {options.steps_per_second}; it must be above 0")
    scene = scenes.by_name(
        options.scene,
        seed=options.seed,
        contact=not options.no_contact,
        solver=_solver(options),
        dt=1 / options.steps_per_second,
        **chosen,
    )
    if options.wash:
        scene = scene.then(*wash(free=scene.phases[-1].effects, seconds=2.0, unload=False))
    return scene if options.seconds is None else scene.first(options.seconds)


def _solver(options: argparse.Namespace) -> Solver:
    """The solver that is asked for; options that it does not have are mistakes."""
    chosen: dict[str, Any] = {"substeps": options.substeps}
    direct = options.solver == "direct"
    for name, of in (
        ("iterations", "paper or compliant"),
        ("sweep", "paper or compliant"),
        ("newton_steps", "direct"),
    ):
        value = getattr(options, name)
        if value is None:
            continue
        if direct != (of == "direct"):
            flag = "--" + name.replace("_", "-")
            raise ValueError(f"{flag} is {value!r}; it must be left out unless --solver is {of}")
        chosen[name] = value
    solver: Solver = SOLVERS[options.solver](**chosen)
    return solver


def _split_cpu(devices: int) -> None:
    """Lets the CPU count as several devices, unless JAX has started or was told already."""
    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        with suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", devices)  # type: ignore[no-untyped-call]


def _simulate(options: argparse.Namespace) -> int:
    drawing: dict[str, Any] = {}
    if check_ending(options.output) in PICTURES:
        drawing["size"] = (options.size, options.size)
    check_color(options.output, options.color_by)
    check_new(options.output, overwrite=options.overwrite)
    check_drawing(options.output, options.size)
    check.whole("--devices", options.devices, least=1)
    if options.devices > 1:
        _split_cpu(options.devices)
    failed = False
    try:
        recording = simulate(
            _scene(options),
            fps=options.fps,
            progress=not options.quiet,
            checkpoint=options.checkpoint,
            devices=options.devices,
        )
    except NotFinite as error:
        failed, recording = True, error.recording
        print(f"error: {error}", file=sys.stderr)
    frames = len(recording.phases)
    if not recording.complete and not failed:
        if options.checkpoint is not None:  # an output would keep the same command from going on
            rest = f"in {options.checkpoint}; the same command goes on from there"
            print(f"interrupted: {frames} frames are kept {rest}", file=sys.stderr)
            return 130
        print(f"interrupted: {frames} frames are kept", file=sys.stderr)
    if frames > 0:
        try:
            save(
                options.output,
                recording,
                color_by=options.color_by,
                overwrite=options.overwrite,
                progress=not options.quiet,
                **drawing,
            )
        except (ValueError, OSError, ImportError) as error:
            if not failed:
                raise
            print(f"error: {error}", file=sys.stderr)
            return 1
        before, stream = (" before the failure", sys.stderr) if failed else ("", sys.stdout)
        print(
            f"{options.output}: {frames} frames{before}, {recording.times[-1]:.2f} s", file=stream
        )
    if failed:
        return 1
    return 0 if recording.complete else 130


if __name__ == "__main__":
    sys.exit(main())
