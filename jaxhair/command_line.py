"""What all commands share, of this package and of `fitting`: parser, settings files, exit codes.

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
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NoReturn

from jaxhair import check
from jaxhair.options import Assignments, Switch, nearest
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


def _example(command: str) -> str:
    """A command in lines that can be copied into a shell."""
    lines = textwrap.wrap(
        command, 92, break_long_words=False, break_on_hyphens=False, subsequent_indent="  "
    )
    return "  " + " \\\n  ".join(lines)


def _filled(text: str) -> str:
    return textwrap.fill(text, 96, break_on_hyphens=False, break_long_words=False)


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
