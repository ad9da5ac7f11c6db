"""What all commands share, of this package and of `fitting`: options, settings files, exit codes.

A command is a module with `parser()`, which makes a `Parser`, and `main(arguments)`, which gives
that parser and the work to `status`. `dispatch` finds it by its name.
"""

import argparse
import os
import re
import sys
import textwrap
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import import_module
from typing import Any, NoReturn

from jaxhair import check
from jaxhair.recording import NotFinite

OK, FAILED, MISTAKE, INTERRUPTED = 0, 1, 2, 130
CODES = (
    "exit codes: 0 done; 1 the work failed or did not reach what was asked for; 2 a mistake in "
    "what was asked, or a file that cannot be read or written; 130 interrupted by Ctrl-C"
)

SWITCHES = (
    "A switch of the settings file is undone by the same name with --no- before it, or without: "
    "--no-quiet undoes quiet = true."
)

UNITS = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}


class Mistake(ValueError):
    """What was asked for on a command line cannot be."""


class _Help(argparse.RawDescriptionHelpFormatter):
    """Shows of a switch the name that changes something, not the one that undoes it."""

    def _format_action_invocation(self, action: argparse.Action) -> str:
        if isinstance(action, Switch):
            return action.option_strings[0]
        return super()._format_action_invocation(action)


class Parser(argparse.ArgumentParser):
    """A command's options, in the one style of all commands.

    Arguments:
        prog: how the command is called. description: what it does, one paragraph.
        examples: command lines, of which each does something worth doing.
        notes: paragraphs to show below the options.

    Mistakes raise `Mistake`. An option may come from the file of `--settings` too.
    """

    def __init__(
        self, prog: str, description: str, examples: Sequence[str], notes: Sequence[str] = ()
    ) -> None:
        shown = [_example(example) for example in examples]
        lines = ["examples:", *shown] if len(shown) > 1 else ["example:", *shown]
        paragraphs = [_filled(text) for text in (*notes, SWITCHES, CODES)]
        super().__init__(
            prog=prog,
            description=_filled(description),
            epilog="\n\n".join(["\n".join(lines), *paragraphs]),
            formatter_class=_Help,
            allow_abbrev=False,
        )
        self.add_argument(
            "--settings",
            metavar="FILE",
            help="read options from this TOML file, by their names without the dashes: strands = "
            "20, quiet = true. Options given here win over it",
        )

    def error(self, message: str) -> NoReturn:
        """Raises `Mistake`, with what argparse found in the words of this package."""
        message = re.sub(r"^argument (\S+?)(?:/\S+)?: (?=(is|has) )", r"\1 ", message)
        raise Mistake(message.removeprefix("argument "))

    def parsed(self, arguments: Sequence[str] | None = None) -> argparse.Namespace:
        """The options of a command line and of the settings file that it names."""
        before = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
        before.add_argument("--settings", nargs="?")
        given = list(sys.argv[1:] if arguments is None else arguments)
        flags = [flag for action in self._actions for flag in action.option_strings]
        for word in given[: given.index("--")] if "--" in given else given:
            flag = word.partition("=")[0]
            if flag.startswith("--") and " " not in flag and flag not in flags:
                raise Mistake(f"{check.short(flag)} is no option of this command"
                              f"{nearest(flag, flags)}")  # fmt: skip
        path = None
        if not {"-h", "--help"}.intersection(given):
            path = before.parse_known_args(given)[0].settings
        start = argparse.Namespace()
        for action, value in [] if path is None else self._from_file(path):
            setattr(start, action.dest, value)
            action.required = False
        options, left = self.parse_known_args(given, start)
        if left:
            raise Mistake(f"{check.short(left[0])} is more than this command takes")
        for name, value in vars(options).items():
            if value == []:  # what argparse makes of the value "--"
                self.error(f"--{name.replace('_', '-')}: expected a value")
        return options

    def _from_file(self, path: str) -> Iterator[tuple[argparse.Action, Any]]:
        """Options and their values, as the file has them."""
        try:
            with open(check.path("--settings", path), "rb") as file:
                settings = tomllib.load(file)
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise Mistake(f"--settings is {path}; it must be a TOML file: {error}") from None
        except OSError as error:
            raise Mistake(f"--settings is {path}, which is not read: {error.strerror}") from None
        actions = {
            (flag.removeprefix("--") or action.dest): action
            for action in self._actions
            for flag in (action.option_strings or [action.dest])
            if action.dest not in ("help", "settings")
        }
        seen: dict[str, str] = {}
        for key, value in settings.items():
            if key not in actions:
                raise Mistake(f"{path}: {check.short(key)} is no option of this command"
                              f"{nearest(key, actions)}")  # fmt: skip
            action = actions[key]
            if action.dest in seen:
                raise Mistake(f"{path}: {key} and {seen[action.dest]} are the same option")
            seen[action.dest] = key
            try:
                yield action, _value(action, key, value)
            except (argparse.ArgumentTypeError, ValueError) as error:
                raise Mistake(f"{path}: {key} {error}") from None


def _value(action: argparse.Action, key: str, value: Any) -> Any:
    """A value of a settings file, checked as the same text on the command line is."""
    if isinstance(action, Switch):
        if not isinstance(value, bool):
            raise ValueError(f"is {check.short(value)}; it must be true or false")
        return value == action.when(f"--{key}")
    if isinstance(action, Assignments):
        if not isinstance(value, dict):
            raise ValueError(f"is {check.short(value)}; it must be a table of NAME = VALUE")
        return [f"{name}={_text(content)}" for name, content in _flat(value)]
    if action.nargs == "+":
        values = value if isinstance(value, list) else [value]
        if not values:
            raise ValueError("is empty; it must have at least one entry")
        return [_checked(action, entry) for entry in values]
    return _checked(action, value)


def _checked(action: argparse.Action, value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise ValueError(f"is {check.short(value)}; it must be a number or a text")
    of_type: Any = action.type or str
    return of_type(str(value))


def _flat(table: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Names with dots and values: TOML takes `fibre.stretch = 1` for a table in a table."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{before}{key}.")
        else:
            yield f"{before}{key}", value


def _text(value: Any) -> str:
    """A number or a list of numbers as the command line has it."""
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)


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


def _example(command: str) -> str:
    """A command in lines that can be copied into a shell."""
    lines = textwrap.wrap(
        command, 92, break_long_words=False, break_on_hyphens=False, subsequent_indent="  "
    )
    return "  " + " \\\n  ".join(lines)


def _filled(text: str) -> str:
    return textwrap.fill(text, 96, break_on_hyphens=False, break_long_words=False)


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


def wrote(options: argparse.Namespace, paths: Sequence[Any]) -> None:
    """Say which files were written, on stderr where stdout has JSON."""
    said = "wrote " + ", ".join(str(path) for path in paths)
    print(said, file=sys.stderr if options.json else sys.stdout)


def status(
    parser: Parser,
    work: Callable[[argparse.Namespace], int],
    arguments: Sequence[str] | None = None,
) -> int:
    """Parse the arguments and do the work: what it returns, or the code of what it raised.

    What is raised for a mistake, for values that are not finite or by Ctrl-C is told in one line
    on the standard error.
    """
    options = argparse.Namespace()
    try:
        options = parser.parsed(arguments)
        code = work(options)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        kept = getattr(options, "checkpoint", None)
        goes_on = f"; the same command goes on from {kept}" if kept else ": nothing is kept"
        print(f"interrupted{goes_on}", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # whoever read the output has had enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (ValueError, OSError, ImportError, NotFinite) as error:
        told(error)
        return FAILED if isinstance(error, NotFinite) else MISTAKE


def told(error: BaseException) -> None:
    """Tell an error in one line."""
    print(f"error: {' '.join(str(error).split())}", file=sys.stderr)


@dataclass(frozen=True)
class Command:
    """Arguments: what it does, in a few words; the module with its `main`."""

    summary: str
    module: str


def dispatch(
    prog: str,
    description: str,
    commands: Mapping[str, Command],
    arguments: Sequence[str] | None = None,
) -> int:
    """Run the command that the first argument names, and return its exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in commands:
        main: Callable[[Sequence[str]], int] = import_module(commands[given[0]].module).main
        return main(given[1:])
    if given and given[0] in ("-h", "--help"):
        listed = [f"  {name:<10} {command.summary}" for name, command in commands.items()]
        print(f"usage: {prog} COMMAND [options]", _filled(description), sep="\n\n", end="\n\n")
        print("commands:", *listed, sep="\n", end="\n\n")
        print(f"{prog} COMMAND --help tells the options, with examples.", end="\n\n")
        print(_filled(CODES))
        return OK
    if not given:
        told(Mistake(f"a command is missing; it must be one of {check.listed(commands)}"))
    else:
        told(Mistake(f"{check.short(given[0])} is no command{nearest(given[0], commands)}"))
    return MISTAKE
