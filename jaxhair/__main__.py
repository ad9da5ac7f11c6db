"""The command line: `python -m jaxhair simulate perm --output perm.png`, `accuracy`, `cost`."""

import sys
from collections.abc import Sequence

from jaxhair.command_line import Command, dispatch

COMMANDS = {
    "simulate": Command("simulate one of the paper's scenes", "jaxhair.simulate_command"),
    "accuracy": Command(
        "measure what accuracy costs, for every setting of the solvers", "jaxhair.accuracy.command"
    ),
    "cost": Command("measure what each effect of a scene costs", "jaxhair.cost.command"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit code."""
    description = "Simulates hair whose bonds break and re-form."
    return dispatch("python -m jaxhair", description, COMMANDS, arguments)


if __name__ == "__main__":
    sys.exit(main())
