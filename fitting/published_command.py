"""`python -m fitting published`: the set of published perms, predicted and compared."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fitting.published import FILES, lotions, predictions, table, write
from jaxhair.command_line import OK, Parser, status, wrote
from jaxhair.export import check_new_folder
from jaxhair.options import add_json, add_output, add_quiet


def parser() -> Parser:
    """The command's parser."""
    top = Parser(
        "python -m fitting published",
        "Predicts the set of nine published perm lotions: fits the bonds that each cuts and "
        "re-forms to the hair's measured moduli, simulates the perm, and compares the curl with "
        "the set that was measured.",
        [
            "python -m fitting published --output published",
            "python -m fitting published --output published --overwrite --json",
        ],
    )
    add_output(top, FILES)
    add_json(top)
    add_quiet(top)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return status(parser(), _published, arguments)


def _published(options: argparse.Namespace) -> int:
    folder = Path(options.output)
    check_new_folder(folder, FILES, overwrite=options.overwrite)
    rows = lotions()
    if not options.quiet:  # one program for all, which takes seconds: no bar
        said = f"Simulating the perms of {len(rows)} lotions."
        print(said, file=sys.stderr, flush=True)
    made = predictions(rows)
    written = write(made, folder, overwrite=options.overwrite)
    print(written[0].read_text(encoding="utf-8").strip() if options.json else table(made))
    wrote(options, written)
    return OK


if __name__ == "__main__":
    sys.exit(main())
