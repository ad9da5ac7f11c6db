"""What is installed and given away: files of wheel and sdist, imports, metadata."""

import csv
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
HEAVY = ("matplotlib", "scipy", "optax", "PIL", "imageio_ffmpeg", "blackjax", "tqdm", "fitting")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def printed(program: str) -> list[str]:
    """The words that a program prints in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_the_import_takes_what_it_needs() -> None:
    """Not what only fits, pictures or progress need; nor does a command's name."""
    program = """
import sys, jax
before = {*sys.modules}
import jaxhair, jaxhair.__main__
print(*{name.partition(".")[0] for name in {*sys.modules} - before})
"""
    imported = {*printed(program)}
    assert "jaxhair" in imported
    assert not imported.intersection(HEAVY)


def test_the_core_needs_no_extra() -> None:
    """Every module is imported where packages of the extras are not there."""
    extras = {"matplotlib", "PIL", "imageio_ffmpeg", "blackjax"}
    program = f"""
import importlib, pkgutil, sys
for name in {sorted(extras)}:
    sys.modules[name] = None  # as if it were not installed
import fitting, jaxhair
names = []
for package in (jaxhair, fitting):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        importlib.import_module(module.name)
        names.append(module.name)
print(*names)
"""
    assert {"jaxhair.pictures", "fitting.posterior"} <= {*printed(program)}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel and the sdist."""
    pytest.importorskip("hatchling", reason="wheels are built by hatchling, of the extra test")
    folder = tmp_path_factory.mktemp("built")
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def sources(folder: Path) -> set[str]:
    """All files of the packages, as they are in the repository."""
    return {
        str(path.relative_to(folder))
        for package in ("jaxhair", "fitting")
        for path in (folder / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_wheel_and_sdist_hold_the_packages_and_nothing_else(built: Path) -> None:
    (wheel,), (sdist,) = built.glob("*.whl"), built.glob("*.tar.gz")
    wanted = sources(ROOT)
    assert {"jaxhair/py.typed", "fitting/py.typed", "jaxhair/data/accuracy.csv"} <= wanted
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
        assert names == wanted
        (licence,) = (name for name in archive.namelist() if name.endswith("licenses/LICENSE"))
        assert archive.read(licence) == (ROOT / "LICENSE").read_bytes()
        text = archive.read("jaxhair/data/accuracy.csv").decode()
        assert len(list(csv.reader(text.splitlines()))) > 10
    with tarfile.open(sdist) as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers()}
    top = {"CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md", "pyproject.toml"}
    assert names == wanted | top | {"PKG-INFO", ".gitignore"}


def test_metadata_are_whole(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        found = message_from_bytes(archive.read(name))
    one = {"Name": "jaxhair", "License-Expression": "MIT", "License-File": "LICENSE"}
    one |= {"Version": PROJECT["version"], "Summary": PROJECT["description"]}
    assert {key: found[key] for key in one} == one
    assert found["Author"]
    assert "hair" in found["Keywords"]
    assert "Typing :: Typed" in found.get_all("Classifier", [])
    assert {*found.get_all("Provides-Extra", [])} == {*PROJECT["optional-dependencies"]}
    core = [need for need in found.get_all("Requires-Dist", []) if "extra ==" not in need]
    assert {re.split("[^a-z]", need)[0] for need in core} == {
        "jax", "numpy", "optax", "scipy", "tqdm"
    }  # fmt: skip


def test_versions_agree() -> None:
    """Of the package, its citation and its changes."""
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.findall(r"^version: (.*)$", citation, re.M) == [PROJECT["version"]]
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    first = re.findall(r"^## ([0-9.]+)", changes, re.M)[0]
    assert first == PROJECT["version"]
