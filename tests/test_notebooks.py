"""Notebooks and the Python of pages run from top to bottom."""

import copy
import os
import re
from pathlib import Path
from typing import Any

import jax
import matplotlib
import nbclient
import nbformat
import pytest

ROOT = Path(__file__).parent.parent
PAGES = sorted((ROOT / "notebooks").glob("*.md"))
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def blocks(path: Path) -> list[str]:
    """The Python in a page."""
    return re.findall(r"```python\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)


def run(code: str) -> None:
    """As a user runs it: float32, JAX's default promotion."""
    matplotlib.use("Agg")
    with (
        jax.enable_x64(False),
        jax.numpy_dtype_promotion("standard"),
        jax.numpy_rank_promotion("allow"),
    ):
        exec(compile(code, "<notebook>", "exec"), {"__name__": "__main__"})


@pytest.fixture
def kernels(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, str]:
    """The environment of a kernel: a user's without settings of Jupyter or JAX, compiling fast."""
    for name in ("JUPYTER_DATA_DIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
    for name in ("MPLBACKEND", "JAX_ENABLE_X64"):
        monkeypatch.delenv(name, raising=False)
    # The code is what a user runs; the machine code of XLA is not optimised. Compiling, which is
    # nearly all of the time, takes a third.
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=0")
    return dict(os.environ)


def kinds(cell: Any) -> set[tuple[str, ...]]:
    """Types of a cell's outputs: a stream's name, or the mime types of what is shown."""
    return {
        (o["output_type"], *([o["name"]] if "name" in o else sorted(o.get("data", {}))))
        for o in cell.get("outputs", [])
    }


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings(
    # Of Jupyter's client, not of ours: where it will look for settings, and its event loops.
    "ignore:Jupyter is migrating:DeprecationWarning",
    "ignore:.*TCP without encryption",
    "ignore:.*event loop:DeprecationWarning",
    "ignore:.*:ResourceWarning:zmq",
)
def test_notebook_runs(path: Path, kernels: dict[str, str], tmp_path: Path) -> None:
    """In a kernel of its own, warnings as errors; its outputs are of the kinds that are stored."""
    stored = nbformat.read(path, as_version=4)
    fresh = copy.deepcopy(stored)
    strict = "import warnings\nwarnings.simplefilter('error')"
    fresh.cells.insert(0, nbformat.v4.new_code_cell(strict))
    for cell in fresh.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    client = nbclient.NotebookClient(
        fresh,
        timeout=900,
        kernel_name="python3",
        extra_arguments=["--log-level=ERROR"],
        resources={"metadata": {"path": str(tmp_path)}},
    )
    client.execute(env=kernels)
    for old, new in zip(stored.cells, fresh.cells[1:], strict=True):
        assert kinds(new) == kinds(old), old.source
        assert ("stream", "stderr") not in kinds(new), new.outputs


def test_notebooks_have_small_outputs_and_no_errors() -> None:
    assert NOTEBOOKS
    for path in NOTEBOOKS:
        assert path.stat().st_size < 400_000, path.name
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
        code = [cell for cell in notebook.cells if cell.cell_type == "code"]
        assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1)), path.name
        outputs = [o for cell in code for o in cell.outputs]
        assert any("image/png" in o.get("data", {}) for o in outputs), path.name
        assert all(o["output_type"] != "error" for o in outputs), path.name
        texts = [o.get("text", "") + o.get("data", {}).get("text/plain", "") for o in outputs]
        assert not re.search(r"(^|[\s\"'])(/\w+){2}|[A-Z]:\\\\", "\n".join(texts)), path.name


def test_readme_python_runs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (code,) = blocks(ROOT / "README.md")
    run(code)
    assert (tmp_path / "perm.gif").stat().st_size > 10_000
    assert "converged" in capsys.readouterr().out


@pytest.mark.parametrize("path", [p for p in PAGES if blocks(p)], ids=lambda path: path.stem)
def test_python_of_pages_runs(path: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for code in blocks(path):
        run(code)


@pytest.mark.parametrize("path", [ROOT / "README.md", *PAGES], ids=lambda path: path.stem)
def test_links_of_pages_lead_somewhere(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    found = re.findall(r"\]\(([^)#]+)[^)]*\)|src=\"([^\"]+)\"", text)
    links = [a or b for a, b in found]
    assert links or path.stem not in ("README", "model")
    for link in links:
        assert (path.parent / link).exists(), link
