"""USD files that are read: of any other program's making, odd, wrong or damaged."""

import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import jaxhair as jh
from fitting.__main__ import main as fit_main
from jaxhair import usd_child
from jaxhair.__main__ import main

pytest.importorskip("pxr", reason="needs usd-core")
from pxr import Gf, Usd, UsdGeom, Vt
from test_usd import A, wavy


def foreign(
    path: Path,
    points: NDArray[Any] = A,
    counts: tuple[int, ...] = (4,),
    *,
    kind: str = "linear",
    basis: str | None = None,
    wrap: str = "nonperiodic",
    prim: str = "/head/curves",
) -> Any:
    """A file of another's making, to be saved; its stage."""
    stage = Usd.Stage.CreateNew(str(path)) if not path.exists() else Usd.Stage.Open(str(path))
    UsdGeom.SetStageUpAxis(stage, "Z")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    parent = prim.rpartition("/")[0]
    if parent:
        UsdGeom.Xform.Define(stage, parent)
    curves = UsdGeom.BasisCurves.Define(stage, prim)
    curves.CreateTypeAttr(kind)
    curves.CreateWrapAttr(wrap)
    if basis is not None:
        curves.CreateBasisAttr(basis)
    curves.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(points, np.float32)))
    curves.CreateCurveVertexCountsAttr(list(counts))
    stage.Save()
    return stage


S = np.arange(7.0)[:, None] * [1.0, 0.0, 0.0] + [0.0, 1.0, 0.0] * (np.arange(7.0)[:, None] % 2)
INNER = (S[:-2] + 4 * S[1:-1] + S[2:]) / 6


@pytest.mark.parametrize(
    ("kind", "basis", "wrap", "want"),
    [
        ("linear", None, "nonperiodic", S),
        ("linear", "bezier", "nonperiodic", S),
        ("cubic", "bezier", "nonperiodic", S[::3]),
        ("cubic", "bezier", "pinned", S[::3]),
        ("cubic", "catmullRom", "pinned", S),
        ("cubic", "catmullRom", "nonperiodic", S[1:-1]),
        ("cubic", "bspline", "nonperiodic", INNER),
        ("cubic", "bspline", "pinned", np.concatenate([S[:1], INNER, S[-1:]])),
    ],
)
def test_foreign_curves_are_read_where_they_pass(
    tmp_path: Path, kind: str, basis: str, wrap: str, want: NDArray[Any]
) -> None:
    """The segments' ends by the basis matrices."""
    foreign(tmp_path / "a.usda", S, (7,), kind=kind, basis=basis, wrap=wrap)
    (strand,) = jh.read_strands(tmp_path / "a.usda")
    assert strand == pytest.approx(want, abs=1e-6)


def test_inches_and_y_up(tmp_path: Path) -> None:
    """What the file says, unless told otherwise."""
    path = tmp_path / "a.usda"
    stage = foreign(path)
    UsdGeom.SetStageUpAxis(stage, "Y")
    UsdGeom.SetStageMetersPerUnit(stage, 0.0254)
    stage.Save()
    x, y, z = A.T.astype(float)
    assert jh.read_strands(path)[0] == pytest.approx(0.0254 * np.stack([x, -z, y], 1))
    assert jh.read_strands(path, unit=1.0, up="z")[0] == pytest.approx(A)


def test_a_file_that_says_nothing_is_in_centimetres_and_y_up(tmp_path: Path) -> None:
    """As the USD library has it."""
    path = tmp_path / "a.usda"
    stage = foreign(path)
    stage.GetRootLayer().pseudoRoot.ClearInfo("metersPerUnit")
    stage.GetRootLayer().pseudoRoot.ClearInfo("upAxis")
    stage.Save()
    assert "metersPerUnit" not in path.read_text()
    x, y, z = A.T.astype(float)
    assert jh.read_strands(path)[0] == pytest.approx(0.01 * np.stack([x, -z, y], 1))


def test_transforms_of_parents_prims_instances_and_visibility(tmp_path: Path) -> None:
    """Two prims and two instances are joined, each at its place; the hidden one is left out."""
    path = tmp_path / "a.usda"
    stage = foreign(path)
    head = UsdGeom.Xformable(stage.GetPrimAtPath("/head"))
    turn = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0, 0, 1), 90))
    head.AddTransformOp().Set(turn * Gf.Matrix4d().SetTranslate(Gf.Vec3d(0, 0, 5)))
    stage.Save()
    stage = foreign(path, A[:3], (2, 1), prim="/hidden/curves")
    UsdGeom.Imageable(stage.GetPrimAtPath("/hidden/curves")).MakeInvisible()
    stage.Save()
    stage = foreign(path, A[:3], (2, 1), prim="/other")
    for i in range(2):
        copy = UsdGeom.Xform.Define(stage, f"/copy{i}")
        copy.GetPrim().GetReferences().AddInternalReference("/head")
        copy.GetPrim().SetInstanceable(True)
        copy.AddTranslateOp(opSuffix="away").Set(Gf.Vec3d(10.0 * (i + 1), 0, 0))
        copy.SetXformOpOrder([copy.GetOrderedXformOps()[-1]])
    stage.Save()
    strands = jh.read_strands(path)
    x, y, z = A.T.astype(float)
    turned = np.stack([-y, x, z + 5], 1)
    assert strands[0] == pytest.approx(turned)
    assert [len(s) for s in strands[1:3]] == [2, 1]
    assert strands[2][0] == pytest.approx(A[2])
    assert strands[3] == pytest.approx(A + [10.0, 0, 0])
    assert strands[4] == pytest.approx(A + [20.0, 0, 0])
    assert len(strands) == 5


def test_short_strands_and_changing_counts(tmp_path: Path) -> None:
    """Strands of one point, in a file whose hair is cut on the way."""
    path = tmp_path / "a.usda"
    stage = foreign(path, A, (1, 3))
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/head/curves"))
    for code, n in ((0.0, 3), (24.0, 2)):
        curves.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(A[: n + 1]), code)
        curves.GetCurveVertexCountsAttr().Set([1, n], code)
    stage.Save()
    assert [len(s) for s in jh.read_strands(path)] == [1, 2]
    assert [len(s) for s in jh.read_strands(path, frame=0)] == [1, 3]
    assert jh.read_curves(path, skip_short=True, time=0.5).counts.tolist() == [3]
    with pytest.raises(ValueError, match=r"strand 0, of 1.*skip_short"):
        jh.read_curves(path)


def test_moving_parents_are_frames(tmp_path: Path) -> None:
    """Hair that stands still on a head that moves."""
    path = tmp_path / "a.usda"
    stage = foreign(path)
    move = UsdGeom.Xformable(stage.GetPrimAtPath("/head")).AddTranslateOp()
    for code in (0.0, 5.0, 10.0):
        move.Set(Gf.Vec3d(code, 0, 0), code)
    stage.Save()
    assert jh.read_strands(path, frame=1)[0] == pytest.approx(A + [5.0, 0, 0])
    assert jh.read_strands(path)[0] == pytest.approx(A + [10.0, 0, 0])


def damaged(path: Path, how: str) -> None:
    """Writes a file that cannot be read."""
    options: dict[str, dict[str, Any]] = {
        "periodic": {"wrap": "periodic"},
        "segmented": {"wrap": "segmented"},
        "hermite": {"kind": "cubic", "basis": "hermite"},
        "quadratic": {"kind": "quadratic"},
        "counts": {"counts": (3,)},
        "negative": {"counts": (5, -1)},
        "bezier": {"kind": "cubic", "basis": "bezier", "counts": (2, 2)},
        "bspline": {"kind": "cubic", "basis": "bspline", "counts": (1, 3)},
    }
    if how == "nurbs":
        stage = foreign(path)
        UsdGeom.NurbsCurves.Define(stage, "/head/nurbs")
        stage.Save()
    elif how == "instancer":
        stage = foreign(path, prim="/many/hair")
        UsdGeom.PointInstancer.Define(stage, "/many")
        stage.Save()
    elif how == "hidden":
        stage = foreign(path)
        UsdGeom.Imageable(stage.GetPrimAtPath("/head/curves")).MakeInvisible()
        stage.Save()
    elif how == "unit":
        stage = foreign(path)
        stage.GetRootLayer().pseudoRoot.SetInfo("metersPerUnit", -1.0)
        stage.Save()
    elif how == "empty stage":
        Usd.Stage.CreateNew(str(path)).Save()
    elif how == "missing layer":
        path.write_text("#usda 1.0\n(\n    subLayers = [@./no.usda@]\n)\n")
    elif how == "type":
        foreign(path)
        text = path.read_text()
        path.write_text(text.replace("point3f[] points = [", 'string points = "a" # ['))
    elif how == "syntax":
        foreign(path)
        path.write_text(path.read_text()[:-3] + "(((")
    elif how == "nothing":
        path.write_bytes(b"")
    elif how == "bytes":
        path.write_bytes(struct.pack("<64I", *range(64)))
    else:
        foreign(path, **options[how])


REFUSED = {
    "periodic": ["/head/curves", "periodic", "nonperiodic"],
    "segmented": ["segmented", "nonperiodic"],
    "hermite": ["hermite", "bspline"],
    "quadratic": ["quadratic", "cubic"],
    "counts": ["curveVertexCounts", "3", "4 points"],
    "negative": ["curveVertexCounts", "-1", "0 or more"],
    "bezier": ["curve 0", "2 control points", "multiple of 3"],
    "bspline": ["curve 1", "3 control points", "at least 4"],
    "nurbs": ["/head/nurbs", "NurbsCurves", "convert"],
    "instancer": ["/many", "PointInstancer"],
    "hidden": ["invisible"],
    "unit": ["metersPerUnit", "-1"],
    "empty stage": ["no BasisCurves"],
    "missing layer": ["no BasisCurves", "no.usda"],
    "type": ["/head/curves", "points", "type"],
    "syntax": ["not readable as USD"],
    "nothing": ["not readable as USD"],
    "bytes": ["not readable as USD"],
}


@pytest.mark.parametrize("how", REFUSED)
def test_what_cannot_be_read_is_refused_with_the_reason(tmp_path: Path, how: str) -> None:
    """Naming the file, what is wrong and what is allowed."""
    path = tmp_path / "odd.usda"
    damaged(path, how)
    with pytest.raises(ValueError) as error:
        jh.read_strands(path)
    for word in [path.name, *REFUSED[how]]:
        assert word in str(error.value)
    assert len(str(error.value)) < 600


def crate() -> bytes:
    path = Path("valid.usdc")
    jh.write_curves(path, jh.Curves.from_list([A, A[:2], 2 * A]), overwrite=True)
    return path.read_bytes()


@pytest.mark.parametrize("seed", range(8))
def test_damaged_crates_do_not_take_this_process_with_them(
    tmp_path: Path, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Truncated, or with bits turned over; the USD library has crashed on such."""
    monkeypatch.chdir(tmp_path)
    data, random = bytearray(crate()), np.random.default_rng(seed)
    if seed % 2:
        data = data[: random.integers(len(data))]
    else:
        for place in random.integers(len(data) // 2, len(data), 4):
            data[place] ^= 1 << int(random.integers(8))
    Path("damaged.usdc").write_bytes(data)
    refusal = ""
    try:
        assert np.all(np.isfinite(jh.read_curves("damaged.usdc").points))
    except ValueError as error:
        refusal = str(error)
    assert not refusal or "damaged.usdc" in refusal


def test_a_claim_of_endless_points_takes_no_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A length in the file that says 2^40 points is refused."""
    monkeypatch.chdir(tmp_path)
    data = crate()
    raw = struct.pack("<Q", 10)  # the points' length stands before them
    place = data.index(raw + A[0].tobytes()[:12])
    for size in (2**31, 2**40, 2**62):
        Path("huge.usdc").write_bytes(data[:place] + struct.pack("<Q", size) + data[place + 8 :])
        with pytest.raises(ValueError, match=r"huge\.usdc"):
            jh.read_strands("huge.usdc")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"frame": 1}, ["frame", "1", "from -1 to 0"]),
        ({"frame": 0.5}, ["frame", "0.5", "whole"]),
        ({"time": "now"}, ["time", "'now'"]),
        ({"time": 1.0, "frame": 0}, ["time", "1.0", "no frame"]),
    ],
)
def test_wrong_frames_and_times(tmp_path: Path, options: Any, words: list[str]) -> None:
    """In words."""
    foreign(tmp_path / "a.usda")
    with pytest.raises(ValueError) as error:
        jh.read_strands(tmp_path / "a.usda", **options)
    for word in words:
        assert word in str(error.value)


def test_only_usd_files_have_times(tmp_path: Path) -> None:
    """And .npz files have frames, others one."""
    of = wavy()
    jh.save(tmp_path / "a.npz", of)
    jh.save(tmp_path / "a.hair", of)
    assert np.array_equal(jh.read_curves(tmp_path / "a.npz", frame=1).points, of.positions[1])
    with pytest.raises(ValueError, match=r"frame is 1.*from -1 to 0"):
        jh.read_curves(tmp_path / "a.hair", frame=1)
    with pytest.raises(ValueError, match=r"time is 1\.0"):
        jh.read_curves(tmp_path / "a.npz", time=1.0)
    with pytest.raises(FileNotFoundError):
        jh.read_curves(tmp_path / "no.usda")


def test_a_fit_takes_it_as_its_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`python -m fitting --target permed=released.usd`, in the unit that the file says."""
    seen: list[Any] = []

    def reached(observed: Any, **_: Any) -> Any:
        seen.append(observed)
        raise ValueError("reached")

    monkeypatch.setattr("fitting.fit_command.from_strands", reached)
    path = tmp_path / "released.usd"
    strand = np.linspace([0.0, 0, 0.3], [0.0, 0, 0], 9)
    jh.write_curves(path, jh.Curves.from_list([strand]), unit=0.01, up="y")
    assert fit_main(["--target", f"permed={path}", "--output", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err == "error: reached\n"
    assert seen[0]["permed"].points[0] == pytest.approx(strand, abs=1e-7)


def test_the_other_process_loads_no_package_of_ours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It starts in a fraction of the second that JAX takes; and a user's own module that is named
    like one of Python's is not loaded in its place."""
    code = (
        "import sys, runpy, json; runpy.run_path(sys.argv[1]); "
        "print(json.dumps([m for m in sys.modules if m.split('.')[0] in ('jax', 'jaxhair')]))"
    )
    command = [sys.executable, "-P", "-c", code, usd_child.__file__]
    done = subprocess.run(command, capture_output=True, check=True)
    assert json.loads(done.stdout) == []
    (tmp_path / "json.py").write_text("raise SystemExit(3)")
    monkeypatch.syspath_prepend(str(tmp_path))
    foreign(tmp_path / "a.usda")
    assert len(jh.read_strands(tmp_path / "a.usda")) == 1


def test_without_the_extra_the_command_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """When reading as when writing, before the work."""
    path = tmp_path / "a.usda"
    foreign(path)
    empty = tmp_path / "pxr"
    empty.mkdir()
    (empty / "__init__.py").write_text("raise ImportError('no pxr')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(ImportError, match=r"USD files need pxr: pip install .jaxhair\[usd\]"):
        jh.read_strands(path)
    with pytest.raises(ImportError, match=r"jaxhair\[usd\]"):
        jh.save(tmp_path / "b.usda", wavy())
    assert main(["simulate", "perm", "--output", str(tmp_path / "b.usdc")]) == 2
    assert not (tmp_path / "b.usda").exists()
