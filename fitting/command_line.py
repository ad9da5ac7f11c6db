"""What the commands that fit have in common."""

from typing import Any

from jaxhair.options import UNITS, one_of

STRAND_UNITS = {**UNITS, "inch": 0.0254}
"""Units that strand files may be in [m]."""


def add_strand_files(parser: Any) -> None:
    """Options on the unit and the axes of strand files."""
    add = parser.add_argument
    add(
        "--unit",
        help="of strand files (default: what a USD file says, m for others)",
        **one_of(*STRAND_UNITS),
    )
    add(
        "--up",
        help="axis of strand files that points up (default: what a USD file says, y for "
        "Alembic, z for others)",
        **one_of("y", "z"),
    )
