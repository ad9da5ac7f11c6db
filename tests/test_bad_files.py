"""Bad files and bad commands, generated: a clear error, little memory, and nothing written.

How to make 2,000 of them stands in test_bad_input.py.
"""

import io
import struct
import tracemalloc
import zipfile
import zlib
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bad_values import check_refusal, examples
from hypothesis import event, given
from hypothesis import strategies as st

import fitting
import jaxhair as jh
from fitting.__main__ import main as fit_main
from jaxhair.__main__ import main as jaxhair_main
from jaxhair.accuracy import table
from jaxhair.arrays import read_arrays, write_arrays

PACKAGE = Path(fitting.__file__).parent
SPARE = 200e6
"""Bytes that reading may take besides 100 times a file's size: 16 MB in some copies as float64."""

A = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 10]])
CURVES = jh.Curves.from_list([A, A[:2], 2 * A])


def written(ending: str) -> bytes:
    """A valid file."""
    path = Path(f"valid{ending}")
    if ending == ".toml":
        return (PACKAGE / "data" / "measured_curls.toml").read_bytes()
    if ending == ".csv":
        return b"".join(table.PACKAGED.read_bytes().splitlines(keepends=True)[:4])
    if ending == ".arrays.npz":
        write_arrays(path, {"a": np.arange(6.0), "b": np.array("text")}, overwrite=True)
    else:
        jh.write_curves(path, CURVES, overwrite=True)
    return path.read_bytes()


def bomb(size: int, header: bytes | None = None) -> bytes:
    """A .npz file of zeros, or of one with another header."""
    start = {"descr": "<f4", "fortran_order": False, "shape": (size // 24, 2, 3)}
    with io.BytesIO() as entry, io.BytesIO() as file:
        if header is None:
            np.lib.format.write_array_header_1_0(entry, start)
        else:
            entry.write(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
        entry.write(bytes(size // 24 * 24))
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("positions.npy", entry.getbuffer())
        return file.getvalue()


BOMBS: dict[str, Callable[[], bytes]] = {
    "zeros": lambda: bomb(100_000_000),
    "fewer zeros": lambda: bomb(12_000_000),
    "nested header": lambda: bomb(0, b"[" * 9000),
    "long header": lambda: bomb(0, b"{'descr': '" + b"x" * 50000 + b"'}"),
    "many entries": lambda: many_entries(2000),
    "gzip": lambda: zlib.compress(bytes(10**6)),
}

TOML: list[str] = [
    "a = " + "[" * 5000,
    "a = " + "{a=" * 5000,
    "[" + ".".join("a" * 2000) + "]",
    "title = " + "9" * 5000,
    "[hair]\nrod_diameter = 0x" + "f" * 5000,
    "title = 1979-05-27",
    "title = ['" + "a" * 5000 + "']",
    "x" * 5000 + " = 1",
    "[hair]\n" + "x" * 5000 + " = 1\n[[state]]",
]


def many_entries(count: int) -> bytes:
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w") as archive:
            for i in range(count):
                archive.writestr(f"{i}" + "x" * 200, b"")
        return file.getvalue()


EXTREMES = [
    struct.pack(kind, value)
    for kind, value in (
        ("<I", 2**32 - 1), ("<I", 2**31 - 1), ("<i", -1), ("<I", 0), ("<H", 65535),
        ("<f", np.nan), ("<f", np.inf), ("<f", 3e38), ("<I", 0x7F800001), ("<d", np.nan),
        ("<d", 1e300), ("<q", -1), ("<Q", 2**64 - 1),
    )
]  # fmt: skip
NUMBERS = ["nan", "-inf", "1e400", "1e-320", "-1", "0", "10000000000000000000000", "true", "'a'",
           "[1, 2]", "0x" + "f" * 300, "1979-05-27", '"""\n\n"""', "{ a = 1 }"]  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, ending: str) -> bytes:
    """Bytes that are a valid file no more, or hardly."""
    how = draw(st.integers(0, 5))
    if how == 0:
        return draw(st.binary(max_size=300))
    if how == 1 and ending.endswith(".npz"):
        return BOMBS[draw(st.sampled_from(list(BOMBS)))]()
    data = bytearray(written(ending))
    if ending in (".toml", ".csv") and how <= 2:
        if ending == ".toml" and how == 1:
            return draw(st.sampled_from(TOML)).encode()
        text = data.decode()
        words = ("20e-3", "0.12", "25", "113.2e-3", "0.58", '"perm"', "true", "9", "1", "ok", ",")
        word = draw(st.sampled_from([w for w in words if w in text]))
        new = draw(st.sampled_from(NUMBERS) | st.text(max_size=4).filter(encodes))
        return text.replace(word, new, draw(st.integers(1, 3))).encode()
    if how <= 3:
        return bytes(data[: draw(st.integers(0, len(data)))])
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, len(data) - 1))
        if how == 4:
            data[place] ^= 1 << draw(st.integers(0, 7))
        else:
            new = draw(st.sampled_from(EXTREMES))
            # other formats have all that matters at their start
            place = (place if ending == ".abc" else min(place, 200)) // 4 * 4
            data[place : place + len(new)] = new
    return bytes(data)


def encodes(text: str) -> bool:
    return text.isprintable()  # half a character is not


def curves(path: Path) -> jh.Curves:
    """With both functions: what one reads, so does the other, or refuses it for its strands."""
    strands = jh.read_strands(path)
    found = jh.read_curves(path)
    assert [len(x) for x in strands] == found.counts.tolist()
    return found


READERS: dict[str, Callable[[Path], Any]] = {
    ".hair": curves,
    ".data": curves,
    ".npz": curves,
    ".abc": curves,
    ".arrays.npz": read_arrays,
    ".toml": fitting.read,
    ".csv": lambda path: jh.cheapest(0.5, table=path),
}


@pytest.mark.parametrize("ending", READERS)
@examples(few=12, many=100)
@given(data=st.data())
def test_damaged_files(
    ending: str, data: st.DataObject, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A ValueError that names the file, or what it holds; and memory as its size warrants."""
    monkeypatch.chdir(tmp_path)
    content = data.draw(damaged(ending), "content")
    path = tmp_path / f"damaged{ending}"
    path.write_bytes(content)
    tracemalloc.start()
    try:
        found = READERS[ending](path)
        if isinstance(found, jh.Curves):
            assert np.all(np.isfinite(found.points))
            assert found.counts.min(initial=2) >= 2
    except ValueError as error:
        check_refusal(error, [path.name] if ending != ".csv" else [path.name, "error is"])
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 100 * len(content) + SPARE


SIMULATE = {
    "--output": "out/x.npz", "--strands": "1", "--points": "3", "--length": "24cm",
    "--rod-diameter": "6cm", "--solver": "paper", "--iterations": "1", "--sweep": "red-black",
    "--newton-steps": "1", "--substeps": "1", "--steps-per-second": "360", "--seconds": "0.01",
    "--fps": "30", "--seed": "0", "--color-by": "ionic", "--size": "16",
}  # fmt: skip
ACCURACY = {"--output": "out", "--strands": "1"}
FIT = {
    "--output": "out", "--target": "there.hair", "--unit": "m", "--up": "z",
    "--rod-diameter": "1mm", "--strands": "1", "--points": "9", "--method": "adam", "--steps": "1",
}  # fmt: skip
COMMANDS: dict[str, tuple[Callable[[list[str]], int], list[str], dict[str, str]]] = {
    "simulate": (jaxhair_main, ["simulate", "perm", "--quiet"], SIMULATE),
    "accuracy": (jaxhair_main, ["accuracy", "--quiet", "--quick"], ACCURACY),
    "fitting": (fit_main, ["--quiet"], FIT),
}
WORDS = [
    "", " ", "nan", "inf", "-inf", "-1", "0", "1e400", "1e300", "1e-300", "9" * 30, "9" * 300,
    "0.5", "a" * 300, "17 bananas", "1e300mm", "\u0663", "out/missing/x.npz", "out", "/dev/null",
    "there.hair", "there.hair/x.npz", "x.npz", "x.xyz", "\0.npz", "\ud800.hair", "--", "permed=",
    "washed=there.hair", "broken.toml", ".", "..",
]  # fmt: skip


class Reached(Exception):
    """The work was about to begin."""


@pytest.mark.parametrize("name", COMMANDS)
@examples(few=15, many=120)
@given(data=st.data())
def test_bad_commands(
    name: str,
    data: st.DataObject,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """2 and one line that says why, or the command begins its work; and nothing is written."""

    def reached(*_: Any, **__: Any) -> None:
        raise Reached

    with monkeypatch.context() as patched:
        patched.chdir(tmp_path)
        for module, function in (
            ("jaxhair.simulate_command", "simulate"),
            ("jaxhair.accuracy.command", "_measured"),
            ("fitting.fit_command", "fit"),
        ):
            patched.setattr(import_module(module), function, reached)
        (tmp_path / "out").mkdir(exist_ok=True)
        jh.write_curves("there.hair", CURVES, overwrite=True)
        Path("broken.toml").write_bytes(b"[[[")
        main, fixed, valid = COMMANDS[name]
        chosen = dict(data.draw(st.lists(st.sampled_from(list(valid.items())), max_size=4)))
        chosen["--output"] = valid["--output"]
        for option in data.draw(st.lists(st.sampled_from(list(valid)), min_size=1, max_size=2)):
            chosen[option] = data.draw(st.sampled_from(WORDS) | st.text(max_size=6), option)
        before = files(tmp_path)
        capsys.readouterr()
        code: Any = 2
        try:
            code = main([*fixed, *(f"{option}={value}" for option, value in chosen.items())])
        except SystemExit as stop:
            code = stop.code
        except Reached:
            return
        finally:
            assert files(tmp_path) == before
        event("refused")
        assert code == 2
        lines = capsys.readouterr().err.splitlines()
        if lines:
            assert len(lines) == 1
            assert lines[0].startswith("error: ")
            assert len(lines[0]) < 600


def files(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
