"""What all commands share: options, settings files, numbers by name, errors, progress."""

import io
import json
import subprocess
import sys
from argparse import Namespace
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import jaxhair as jh
from fitting.__main__ import main as fit_main
from fitting.design import Unreachable
from jaxhair.__main__ import main
from jaxhair.command_line import Parser, status
from jaxhair.options import Switch
from jaxhair.progress import Progress, each
from jaxhair.recording import NotFinite
from jaxhair.scene_options import listed, replaced, scene_of

COMMANDS = {
    "jaxhair simulate": "jaxhair.simulate_command",
    "jaxhair accuracy": "jaxhair.accuracy.command",
    "jaxhair cost": "jaxhair.cost.command",
    "fitting": "fitting.fit_command",
    "fitting design": "fitting.design_command",
    "fitting natural": "fitting.natural_command",
    "fitting published": "fitting.published_command",
}
SMALL = ["perm", "--prepared", "--no-contact", "--strands", "2", "--length", "24cm"]


def parser(name: str) -> Parser:
    made: Parser = import_module(COMMANDS[name]).parser()
    return made


def run(name: str, *arguments: str) -> int:
    package, *command = name.split()
    return {"jaxhair": main, "fitting": fit_main}[package]([*command, *arguments])


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_the_same_style(name: str) -> None:
    """The same names in the same words, defaults told, and examples that the parser takes."""
    command = parser(name)
    flags = {flag: action for action in command._actions for flag in action.option_strings}
    assert {"--settings", "--output", "--overwrite", "--quiet"} <= flags.keys()
    assert ("--json" in flags) == (name != "jaxhair simulate")
    assert flags["--quiet"].help == "show no progress"
    for action in command._actions:
        assert action.help, action.dest
        if action.default is not None and not isinstance(action, Switch) and action.nargs != 0:
            assert "(default: " in action.help, action.dest
    text = command.format_help()
    assert "%" not in text.replace("1 %", "")
    assert "0 done; 1 the work failed" in " ".join(text.split())
    commands = text[text.index("example") :].replace("\\\n", " ").splitlines()[1:]
    commands = [line.strip() for line in commands if line.startswith("  python -m")]
    assert commands
    for line in commands:
        begin = f"python -m {name} "
        assert line.startswith(begin)
        words = [word.strip("'") for word in line.removeprefix(begin).split()]
        assert isinstance(command.parsed(words), Namespace)


@pytest.mark.parametrize("name", COMMANDS)
def test_mistakes_in_options_are_told_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = tmp_path / "s.toml"
    settings.write_text("overwrit = true", encoding="utf-8")
    for given, words in (
        (["--outptu", "x"], ["--outptu", "no option", "--output"]),
        (["--output"], ["--output", "expected one argument"]),
        (["--settings", str(tmp_path / "none.toml")], ["none.toml", "No such file"]),
        (["--settings", str(settings)], ["s.toml", "overwrit", "nearest is overwrite"]),
        (["--settings", str(tmp_path)], ["--settings"]),
    ):
        assert run(name, *given) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.startswith("error: ")
        assert printed.err.count("\n") == 1
        for word in words:
            assert word in printed.err


def test_commands_are_found_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "a command is missing; it must be one of 'simulate'" in capsys.readouterr().err
    assert main(["simulat"]) == 2
    assert "the nearest is simulate" in capsys.readouterr().err
    assert fit_main(["desing"]) == 2
    assert "the nearest is design" in capsys.readouterr().err
    assert main(["--help"]) == 0
    assert "accuracy" in capsys.readouterr().out


SETTINGS: dict[str, list[tuple[str, str]]] = {
    "jaxhair simulate": [
        ('scene = "perm"', "perm"),
        ("strands = 3", "--strands 3"),
        ('length = "24cm"', "--length 24cm"),
        ("rod-diameter = 0.05", "--rod-diameter 0.05"),
        ("seconds = 1", "--seconds 1"),
        ("contact = false", "--no-contact"),
        ("wash = true", "--wash"),
        ('checkpoint = "kept"', "--checkpoint kept"),
        ('set."phases.*.Drag.time" = 0.3', "--set phases.*.Drag.time=0.3"),
    ],
    "fitting": [
        ('output = "x"', "--output x"),
        ('target = ["permed=a.hair", "b.hair"]', "--target permed=a.hair b.hair"),
        ('method = "adam"', "--method adam"),
    ],
    "fitting design": [("no-check = true", "--no-check"), ("curl-diameter = 0.02",
                       "--curl-diameter 0.02"), ("weight = false", "")],
    "fitting natural": [('file = "a.hair"', "a.hair"), ('output = "x"', "--output x"),
                        ("points = 9", "--points 9")],
}  # fmt: skip


@pytest.mark.parametrize("name", SETTINGS)
def test_settings_are_options(name: str, tmp_path: Path) -> None:
    """A file and a command line that say the same are the same, to checkpoints too."""
    path = tmp_path / "s.toml"
    path.write_text("\n".join(line for line, _ in SETTINGS[name]), encoding="utf-8")
    given = [word for _, words in SETTINGS[name] for word in words.split()]
    from_file = vars(parser(name).parsed(["--settings", str(path)]))
    from_options = vars(parser(name).parsed(given))
    assert from_file.pop("settings") == str(path)
    assert from_options.pop("settings") is None
    assert from_file == from_options
    assert {k: type(v) for k, v in from_file.items()} == {
        k: type(v) for k, v in from_options.items()
    }


def test_options_win_over_settings(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    text = 'scene = "perm"\nstrands = 3\nwash = true\ncontact = false\nfps = 10\n[set]\n'
    path.write_text(text + "fibre.stiffness = 1\nsolver.orientation_weight = 0.1")
    more = ["bed-hair", "--strands", "4", "--no-wash", "--contact", "--set", "fibre.stiffness=0.5"]
    for given in ([*more, "--settings", str(path)], [f"--settings={path}", *more]):
        found = parser("jaxhair simulate").parsed(given)
        assert (found.scene, found.strands, found.wash, found.contact) == (
            "bed-hair",
            4,
            False,
            True,
        )
        assert found.fps == 10.0
        assert found.set == [
            "fibre.stiffness=1", "solver.orientation_weight=0.1", "fibre.stiffness=0.5"
        ]  # fmt: skip
        assert scene_of(found).fibre.stiffness == 0.5


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("strands = 2.5", "strands is '2.5'; it must be a whole number"),
        ("strands = true", "strands is True; it must be a number or a text"),
        ("strands = [1, 2]", "strands is [1, 2]; it must be a number or a text"),
        ('wash = "yes"', "wash is 'yes'; it must be true or false"),
        ("fps = 0", "fps has the value 0.0; it must be above 0"),
        ('length = "2 feet"', "length is '2 feet'; it must be a length"),
        ('scene = "afro"', "scene is 'afro'; it must be one of 'bed-hair'"),
        ('sweep = "red"', "the nearest is red-black"),
        ("set = 3", "set is 3; it must be a table"),
        ("solver.name = 3", "solver is {'name': 3}"),
        ("contact = true\nno-contact = true", "the same option"),
        ('settings = "other.toml"', "'settings' is no option"),
        ("help = true", "'help' is no option"),
        ("rod_diameter = 1", "the nearest is rod-diameter"),
        ("strands = ", "it must be a TOML file"),
    ],
)
def test_wrong_settings_are_refused(
    text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text, encoding="utf-8")
    assert main(["simulate", "perm", "--settings", str(path), "--list"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert "s.toml" in error
    assert words in error
    assert error.count("\n") == 1


def test_numbers_are_listed_and_set_by_name(capsys: pytest.CaptureFixture[str]) -> None:
    """What `--list` prints can be given to `--set`, and each number comes back as it was given."""
    command = ["simulate", *SMALL, "--list"]
    assert main(command) == 0
    plain = dict(line.split("=") for line in capsys.readouterr().out.splitlines())
    scene = scene_of(parser("jaxhair simulate").parsed([*SMALL, "--list"]))
    assert plain.keys() == jh.named_leaves(scene).keys()
    short = {k: v for k, v in plain.items() if "(" not in v}
    assert "fibre.peeling_rate" in short
    assert listed(replaced(scene, [f"{k}={v}" for k, v in short.items()])) == listed(scene)

    given = ["fibre.peeling_rate=0.5", "phases.*.Gravity.acceleration=0,0,-1.6"]
    given += ["bonds.influence=0.1,0.2,0.3,0.4"]
    assert main([*command, *(word for text in given for word in ("--set", text))]) == 0
    changed = dict(line.split("=") for line in capsys.readouterr().out.splitlines())
    gravity = [name for name in plain if name.endswith("Gravity.acceleration")]
    assert gravity
    expected = plain | {"fibre.peeling_rate": "0.5", "bonds.influence": "0.1,0.2,0.3,0.4"}
    assert changed == expected | dict.fromkeys(gravity, "0.0,0.0,-1.6")
    by_hand = replace(scene, fibre=replace(scene.fibre, peeling_rate=0.5))
    assert listed(replaced(scene, given[:1])) == listed(by_hand)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("fibre.stiffness", "NAME=VALUE"),
        ("fibre.peling_rate=1", "nearest is fibre.peeling_rate"),
        ("*.nothing=1", "'*.nothing', which the scene does not have"),
        ("fibre.stiffness=soft", "--set fibre.stiffness is 'soft'; it must be a number"),
        ("fibre.stiffness=1,2", "--set fibre.stiffness is '1,2'; it must be a number"),
        ("bonds.influence=1", "it must be 4 numbers, separated by commas"),
        ("fibre.peeling_rate=-1", "fibre.peeling_rate has the value -1.0; it must be 0 or more"),
        ("fibre.stiffness=nan", "fibre.stiffness has the value nan"),
        ("phases.*.Drag.time=0", "drag.time has the value 0.0; it must be above 0"),
    ],
)
@pytest.mark.parametrize("command", ["simulate", "cost"])
def test_wrong_numbers_are_refused(
    command: str, text: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, *SMALL, "--list", "--set", text]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert words.lower() in error.lower()
    assert error.count("\n") == 1


def test_the_work_of_a_settings_file_goes_on_from_options(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A checkpoint of the one is the other's."""
    monkeypatch.chdir(tmp_path)
    Path("s.toml").write_text(
        "prepared = true\ncontact = false\nstrands = 1\npoints = 9\nlength = 0.24\n"
        "seconds = 0.02\nfps = 100\n"
        'quiet = true\ncheckpoint = "kept"\nset = {fibre.peeling_rate = 0.5}'
    )
    assert main(["simulate", "perm", "--settings", "s.toml", "--output", "a.npz"]) == 0
    before = {p.name: p.read_bytes() for p in Path("kept").iterdir()}
    command = "simulate perm --prepared --no-contact --strands 1 --points 9 --length 24cm --quiet"
    command += (
        " --seconds 0.02 --fps 100 --checkpoint kept --output b.npz --set fibre.peeling_rate="
    )
    assert main(f"{command}0.5".split()) == 0
    with np.load("a.npz") as one, np.load("b.npz") as other:
        assert np.array_equal(one["positions"], other["positions"])
    assert {p.name: p.read_bytes() for p in Path("kept").iterdir()} == before
    assert main(f"{command}0.6 --overwrite".split()) == 2


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (ValueError("x is 3;\n it must be 4"), 2, "error: x is 3; it must be 4\n"),
        (FileNotFoundError("no file"), 2, "error: no file\n"),
        (ImportError("pip install it"), 2, "error: pip install it\n"),
        (NotFinite("not finite", None), 1, "error: not finite\n"),  # type: ignore[arg-type]
        (KeyboardInterrupt(), 130, "interrupted: nothing is kept\n"),
    ],
)
def test_exit_codes(
    error: BaseException, code: int, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(options: Namespace) -> int:
        raise error

    assert status(Parser("x", "x", ["x"]), work, []) == code
    assert capsys.readouterr().err == words


def test_a_curl_that_cannot_be_had_is_a_failure(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def design(*_: Any, **__: Any) -> None:
        raise Unreachable("the nearest is 3 mm", 3e-3)

    monkeypatch.setattr("fitting.design_command.design", design)
    assert fit_main(["design", "--curl-diameter", "1mm", "--quiet"]) == 1
    assert capsys.readouterr().err == "error: the nearest is 3 mm\n"


def test_a_reader_that_has_enough_is_no_error() -> None:
    """As `head` is of a long list."""
    program = """
import sys
from jaxhair.command_line import Parser, status

def work(options):
    print("a\\n" * 99999)
    return 0

sys.exit(status(Parser("x", "x", ["x"]), work, []))
"""
    command = [sys.executable, "-c", program]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        assert process.stdout.read(2) == b"a\n"
        process.stdout.close()
        assert process.stderr.read() == b""
        assert process.wait(60) == 1


class Clock:
    """A clock that goes on only when it is told to."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


def test_progress_without_a_terminal_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also where a test, or a user, has imported what kernels are made of."""
    import ipykernel.zmqshell  # noqa: F401

    clock = Clock()
    monkeypatch.setattr("jaxhair.progress.time", clock)
    with Progress("working", 40, unit="step") as bar:
        for i in range(40):
            clock.now += 8.0 if i == 0 else 1.0  # the first compiles
            bar.update(1, f"error {i}")
    assert capsys.readouterr().err.splitlines() == [
        "working: 3/40 steps, 10 s, about 37 s left, error 2",
        "working: 13/40 steps, 20 s, about 27 s left, error 12",
        "working: 23/40 steps, 30 s, about 17 s left, error 22",
        "working: 33/40 steps, 40 s, about 7 s left, error 32",
        "working: 40/40 steps, 47 s, error 39",
    ]
    with Progress("working", 3, unit="step") as bar:
        clock.now += 10
        bar.update(3)
    assert capsys.readouterr().err == "working: 3/3 steps, 10 s\n"  # not said again at the end
    assert list(each([1, 2], "working", unit="step", shown=False)) == [1, 2]
    assert capsys.readouterr().err == ""


def test_progress_on_a_terminal_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    assert list(each("abc", "working", unit="step", shown=True, said=str)) == ["a", "b", "c"]
    shown = sys.stderr.getvalue()  # type: ignore[attr-defined]
    assert "working: 100%" in shown
    assert "3/3" in shown
    assert "<" in shown  # elapsed < left
    assert "\r" in shown


def test_json_is_all_that_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from fitting import published

    rows = [row for row in published.lotions() if row.e_ro_percent is not None]
    made = [
        replace(row, set_predicted_percent=40.0 + i, cut_to=0.5, re_formed_to=0.5)
        for i, row in enumerate(rows)
    ]
    monkeypatch.setattr("fitting.published_command.predictions", lambda rows: made)
    assert fit_main(["published", "--output", str(tmp_path / "out"), "--json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["lotions"] == [row.row() for row in made]
    assert "wrote" in printed.err
