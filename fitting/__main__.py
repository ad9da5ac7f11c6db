"""The command line: `python -m fitting --output DIR` fits; `design`, `natural`, `published`."""

import sys
from collections.abc import Sequence

from fitting import fit_command
from fitting.fit_command import COMMANDS
from jaxhair.command_line import dispatch


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command, or the fit where none is named; returns its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and not given[0].startswith("-"):
        return dispatch("python -m fitting", "", COMMANDS, given)
    return fit_command.main(given)


if __name__ == "__main__":
    sys.exit(main())
