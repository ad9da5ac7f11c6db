"""Options that all commands have in common: switches, kinds of values, names and words."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from typing import Any

from jaxhair import check

UNITS = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
STRAND_UNITS = {**UNITS, "inch": 0.0254}
"""Units that strand files may be in [m]."""


class Switch(argparse.Action):
    """An option that is on or off: `--wash` and `--no-wash`.

    Arguments:
        option_strings: its positive name alone. default: whether it is on if it is not given.
    """

    def __init__(
        self, option_strings: Sequence[str], dest: str, default: bool = False, **more: Any
    ) -> None:
        (name,) = option_strings
        both = [name, "--no-" + name.removeprefix("--")]
        shown = both[::-1] if default else both  # first the one that changes something
        super().__init__(shown, dest, nargs=0, default=default, **more)

    def when(self, flag: str) -> bool:
        """Whether one of the two names turns it on."""
        return flag == min(self.option_strings, key=len)

    def __call__(
        self, parser: object, options: argparse.Namespace, values: object, flag: str | None = None
    ) -> None:
        setattr(options, self.dest, self.when(flag or ""))


class Assignments(argparse.Action):
    """An option NAME=VALUE that may be given several times; a later one of a name wins."""

    def __call__(
        self, parser: object, options: argparse.Namespace, values: Any, flag: str | None = None
    ) -> None:
        setattr(options, self.dest, [*(getattr(options, self.dest) or []), values])


def nearest(name: str, names: Sequence[str] | Mapping[str, Any]) -> str:
    """The end of a message on an unknown name: the nearest known ones, or all."""
    found = get_close_matches(name, list(names), n=2, cutoff=0.6)
    found = [n for n in found if not ("no-" in n and n.replace("no-", "", 1) in found)]
    if found:
        return f"; the nearest {'is' if len(found) == 1 else 'are'} {', '.join(found)}"
    return f"; it must be one of {check.listed(names)}"


# The kinds of values that options have: each says what is allowed where a text is not.


def _parsed(make: Callable[[str], Any], test: Callable[[Any], None]) -> Callable[[str], Any]:
    def parse(text: str) -> Any:
        value: Any = text
        with suppress(ValueError):  # the test says what it must be
            value = make(text)
        try:
            test(value)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error).strip()) from None
        return value

    return parse


def whole(least: int, most: int = 1_000_000) -> Callable[[str], Any]:
    """A whole number from `least` to `most`."""
    return _parsed(int, lambda value: check.whole("", value, least=least, most=most))


positive = _parsed(float, lambda value: check.positive("", value))
"""A number above 0."""

fraction = _parsed(float, lambda value: check.fraction("", value))
"""A number in [0, 1]."""


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
        wanted = "a length: a number with um, mm, cm or m, such as 17mm"
        message = f"is {check.short(text)}; it must be {wanted}"
        raise argparse.ArgumentTypeError(message) from None


def one_of(*names: str) -> dict[str, Any]:
    """Arguments of `add_argument` for an option with these values."""

    def parse(text: str) -> str:
        if text not in names:
            near = get_close_matches(text, names, n=1, cutoff=0.5)
            hint = f"; the nearest is {near[0]}" if near else ""
            raise argparse.ArgumentTypeError(
                f"is {check.short(text)}; it must be one of {check.listed(names)}{hint}"
            )
        return text

    return {"type": parse, "choices": names}


# Options that several commands have, under the same names and in the same words.


def add_output(parser: Any, files: Sequence[str], *, required: bool = True) -> None:
    """Add `--output`, a folder, and `--overwrite`.

    Arguments:
        files: those that are written, for the help. required: else nothing is written without.
    """
    parser.add_argument(
        "--output",
        required=required,
        metavar="DIR",
        help=f"write {', '.join(files)} into this folder, made if it is not there"
        + ("" if required else " (default: write no files)"),
    )
    parser.add_argument("--overwrite", action=Switch, help="replace files that exist")


def add_strand_files(parser: Any, *, read: bool) -> None:
    """Add `--unit` and `--up` of strand files that are read, or written."""
    said = "what a USD file says, " if read else ""
    files = "strand files" if read else "a .hair, .data, .abc or USD file"
    add = parser.add_argument
    add(
        "--unit",
        help=f"of lengths in {files} (default: {said}m)",
        **one_of(*STRAND_UNITS),
    )
    add(
        "--up",
        help=f"axis of {files} that points up (default: {said}y for Alembic, z for others)",
        **one_of("y", "z"),
    )


def strand_files(options: Any) -> dict[str, Any]:
    """What `--unit` and `--up` say of strand files, as arguments unit [m] and up; without what was
    not given."""
    unit = None if options.unit is None else STRAND_UNITS[options.unit]
    given = {"unit": unit, "up": options.up}
    return {name: value for name, value in given.items() if value is not None}


def add_checkpoint(parser: Any) -> None:
    """Add `--checkpoint`."""
    parser.add_argument(
        "--checkpoint",
        metavar="DIR",
        help="keep the work in this folder as it goes on: however it is interrupted, the same "
        "command goes on from there, to the same result. Delete it when all is done",
    )


def add_json(parser: Any) -> None:
    """Add `--json`."""
    parser.add_argument(
        "--json", action=Switch, help="print JSON in place of the table; all else goes to stderr"
    )


def add_quiet(parser: Any) -> None:
    """Add `--quiet`."""
    parser.add_argument("--quiet", action=Switch, help="show no progress")
