"""What the commands that fit have in common."""

import argparse
import sys
from collections.abc import Callable

from jaxhair.__main__ import UNITS

STRAND_UNITS = {**UNITS, "inch": 0.0254}
"""Units that strand files may be in [m]."""


def add_strand_files(parser: argparse.ArgumentParser) -> None:
    """Options on the unit and the axes of strand files."""
    add = parser.add_argument
    add(
        "--unit",
        choices=tuple(STRAND_UNITS),
        help="of strand files (what a USD file says, m for others)",
    )
    add("--up", choices=("y", "z"), help="axis of strand files (what a USD file says, z)")


def add_work(parser: argparse.ArgumentParser) -> None:
    """Options on how long work is kept and shown."""
    add = parser.add_argument
    add("--overwrite", action="store_true", help="replace files in DIR")
    add(
        "--checkpoint",
        metavar="DIR",
        help="keep the work in this folder as it goes on: however it is interrupted, the same "
        "command goes on from there, to the same result. Delete it when all is done",
    )
    add("--quiet", action="store_true", help="show no progress")


def status(work: Callable[[argparse.Namespace], int], options: argparse.Namespace) -> int:
    """What the work returns; or 2 after a mistake in the request, 130 after Ctrl-C, which are told
    on the standard error."""
    try:
        return work(options)
    except KeyboardInterrupt:
        kept = f"; the same command goes on from {options.checkpoint}"
        print(f"interrupted{kept if options.checkpoint else ''}", file=sys.stderr)
        return 130
    except (ValueError, OSError, ImportError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
