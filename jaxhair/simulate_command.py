"""`python -m jaxhair simulate`: a scene as arrays, strands, a picture or a movie."""

import argparse
import os
import sys
from collections.abc import Sequence
from contextlib import suppress

import jax

from jaxhair.command_line import FAILED, INTERRUPTED, OK, Mistake, Parser, status, told
from jaxhair.export import (
    COLORS,
    ENDINGS,
    PICTURES,
    STRAND_FILES,
    check_color,
    check_drawing,
    check_ending,
    check_new,
    save,
)
from jaxhair.options import (
    Switch,
    add_checkpoint,
    add_quiet,
    add_strand_files,
    one_of,
    positive,
    strand_files,
    whole,
)
from jaxhair.recording import NotFinite, simulate
from jaxhair.scene_options import NOTE, add_scene, listed, scene_of


def parser() -> Parser:
    """The command's parser."""
    top = Parser(
        "python -m jaxhair simulate",
        "Simulates one of the paper's scenes and writes what the output's ending says: arrays "
        "(.npz), the animation for other programs (.usdc, .abc), strands of the last frame "
        "(.hair), a picture of it (.png), a movie (.mp4) or a page to turn and play it (.html).",
        [
            "python -m jaxhair simulate perm --prepared --no-contact --output perm.png",
            "python -m jaxhair simulate bed-hair --strands 50 --seconds 2 --output bed-hair.gif",
            "python -m jaxhair simulate blow-dry --list",
            "python -m jaxhair simulate perm --set fibre.peeling_rate=0.5 --set "
            "'phases.*.Gravity.acceleration=0,0,-1.6' --output moon.npz",
        ],
        [NOTE],
    )
    add_scene(top)
    group = top.add_argument_group("the output")
    add = group.add_argument
    add("--output", metavar="FILE", help=f"file to write, with the ending {', '.join(ENDINGS)}")
    add("--overwrite", action=Switch, help="replace FILE if it exists")
    add("--fps", type=positive, default=30.0, help="frames a second (default: %(default)g)")
    add(
        "--color-by",
        help="show a bonded fraction, blue 0 to red 1; a web page also strain or curvature",
        **one_of(*COLORS),
    )
    add("--size", type=whole(1), default=800, help="of pictures, pixels (default: %(default)d)")
    add_strand_files(group, read=False)
    group = top.add_argument_group("the work")
    add_checkpoint(group)
    group.add_argument(
        "--devices",
        type=whole(1),
        default=1,
        help="spread the strands over so many devices: accelerators, or on a CPU the cores; not "
        "with hair against hair (default: %(default)d)",
    )
    add_quiet(group)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return status(parser(), _simulate, arguments)


def _split_cpu(devices: int) -> None:
    """Lets the CPU count as several devices, unless JAX has started or was told already."""
    if "xla_force_host_platform_device_count" not in os.environ.get("XLA_FLAGS", ""):
        with suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", devices)  # type: ignore[no-untyped-call]


def _simulate(options: argparse.Namespace) -> int:
    if options.list:
        print(listed(scene_of(options)))
        return OK
    if options.output is None:
        raise Mistake(f"--output is missing; it must be a file with the ending "
                      f"{', '.join(ENDINGS)}")  # fmt: skip
    ending = check_ending(options.output)
    of_format = strand_files(options)
    if of_format and ending not in STRAND_FILES:
        allowed = f"be left out unless the file is one of {', '.join(STRAND_FILES)}"
        raise Mistake(f"--{next(iter(of_format))} is given for a {ending} file; it must {allowed}")
    if ending in PICTURES:
        of_format["size"] = (options.size, options.size)
    check_color(options.output, options.color_by)
    check_new(options.output, overwrite=options.overwrite)
    check_drawing(options.output, options.size)
    if options.devices > 1:
        _split_cpu(options.devices)
    failed = False
    try:
        recording = simulate(
            scene_of(options),
            fps=options.fps,
            progress=not options.quiet,
            checkpoint=options.checkpoint,
            devices=options.devices,
        )
    except NotFinite as error:
        failed, recording = True, error.recording
        told(error)
    frames = len(recording.phases)
    if not recording.complete and not failed:
        if options.checkpoint is not None:  # an output would keep the same command from going on
            rest = f"in {options.checkpoint}; the same command goes on from there"
            print(f"interrupted: {frames} frames are kept {rest}", file=sys.stderr)
            return INTERRUPTED
        print(f"interrupted: {frames} frames are kept", file=sys.stderr)
    if frames > 0:
        try:
            save(
                options.output,
                recording,
                color_by=options.color_by,
                overwrite=options.overwrite,
                progress=not options.quiet,
                **of_format,
            )
        except (ValueError, OSError, ImportError) as error:
            if not failed:
                raise
            told(error)
            return FAILED
        before, stream = (" before the failure", sys.stderr) if failed else ("", sys.stdout)
        print(
            f"{options.output}: {frames} frames{before}, {recording.times[-1]:.2f} s", file=stream
        )
    if failed:
        return FAILED
    return OK if recording.complete else INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
