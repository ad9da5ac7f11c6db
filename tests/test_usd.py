"""USD files: written as the USD library's own schemas and validators have them, and read back."""

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
from jaxhair.usd_child import on_curve

pytest.importorskip("pxr", reason="needs usd-core")
from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, UsdValidation, Vt
from test_export import recording, scene

ENDINGS = (".usda", ".usdc", ".usd")
BASES = ("catmullRom", "bezier", "linear")
A = np.array([[0.0, 0, 3], [1, 0, 2], [1, 1, 1], [2, 1, 0]], np.float32)
FLOAT32 = 1e-7


def wavy(counts: list[int] | None = None, **options: Any) -> jh.Recording:
    """The recording of test_export with coordinates that are float32 numbers of any kind."""
    of = recording(counts)
    shape = of.positions.shape
    positions = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    fractions = np.random.default_rng(1).uniform(size=of.fractions.shape)
    chosen: dict[str, Any] = {"scene": of.scene, "times": of.times, "phases": of.phases}
    chosen |= options
    return jh.Recording(observed={"positions": positions, "fractions": fractions}, **chosen)


def saved(path: Path, of: jh.Recording, **options: Any) -> tuple[Any, Any]:
    """The stage and its curves."""
    jh.save(path, of, **options)
    stage = Usd.Stage.Open(str(path))
    return stage, UsdGeom.BasisCurves(stage.GetPrimAtPath("/hair/strands"))


def rows(of: jh.Recording, values: NDArray[Any]) -> NDArray[Any]:
    """All points' values, without the padding, shape (frames, all points, ...)."""
    return values[:, np.arange(values.shape[2]) < of.scene.strands.counts[:, None]]


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


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("counts", [None, [5, 3], [2, 5]], ids=["equal", "ragged", "two points"])
def test_every_frame_is_read_back_exactly(
    tmp_path: Path, ending: str, basis: str, counts: list[int] | None
) -> None:
    """By the USD library: float32 numbers bit for bit, at the frames' time codes."""
    of = wavy(counts)
    _, curves = saved(tmp_path / f"a{ending}", of, basis=basis)
    want = rows(of, of.positions)
    sizes = np.array(curves.GetCurveVertexCountsAttr().Get())
    assert curves.GetPointsAttr().GetTimeSamples() == [0.0, 1.0, 2.0, 3.0]
    for frame in range(4):
        points = np.array(curves.GetPointsAttr().Get(frame))
        through, found = on_curve(
            points,
            sizes,
            kind=curves.GetTypeAttr().Get(),
            basis=curves.GetBasisAttr().Get(),
            wrap=curves.GetWrapAttr().Get(),
        )
        assert found.tolist() == of.scene.strands.counts.tolist()
        assert through.dtype == np.float32
        assert np.array_equal(through, want[frame])


@pytest.mark.parametrize("frame", [0, 2, -1])
@pytest.mark.parametrize("ending", [".usda", ".usdc"])
def test_our_reader_gives_a_frame(tmp_path: Path, ending: str, frame: int) -> None:
    """With the strands' numbers of points."""
    of = wavy([5, 3])
    path = tmp_path / f"a{ending}"
    jh.save(path, of)
    curves = jh.read_curves(path, frame=frame)
    assert curves.counts.tolist() == [5, 3]
    for found, want, n in zip(curves.to_list(), of.positions[frame], (5, 3), strict=True):
        assert np.array_equal(found, want[:n])


def test_a_time_between_frames_interpolates(tmp_path: Path) -> None:
    """Linearly, as players do."""
    of = wavy()
    jh.save(tmp_path / "a.usdc", of)
    points = jh.read_curves(tmp_path / "a.usdc", time=0.15).points
    assert points == pytest.approx((of.positions[1] + of.positions[2]) / 2, abs=4 * FLOAT32)


def test_the_stage_says_its_units_axis_and_times(tmp_path: Path) -> None:
    """Metres, Z up, and ten frames a second."""
    stage, curves = saved(tmp_path / "a.usda", wavy())
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 3.0)
    assert stage.GetTimeCodesPerSecond() == 10.0
    assert stage.GetDefaultPrim().GetPath() == "/hair"
    assert curves.GetBasisAttr().Get() == "catmullRom"
    assert curves.GetWrapAttr().Get() == "pinned"
    own = stage.GetRootLayer().customLayerData["jaxhair"]
    assert list(own["phases"]) == ["", "fall", "fall", "rest"]


def test_irregular_times_keep_their_place(tmp_path: Path) -> None:
    """A phase that ends between two frames has a fractional time code there."""
    of = wavy(times=np.array([0.0, 1 / 30, 2 / 30, 0.075]))
    stage, curves = saved(tmp_path / "a.usda", of)
    assert stage.GetTimeCodesPerSecond() == 30.0
    assert curves.GetPointsAttr().GetTimeSamples() == pytest.approx([0.0, 1.0, 2.0, 2.25])
    assert stage.GetEndTimeCode() == pytest.approx(2.25)


def test_another_unit_and_axis(tmp_path: Path) -> None:
    """A file in inches and Y up shows the same hair in the world."""
    of = wavy()
    stage, curves = saved(tmp_path / "a.usdc", of, unit=0.0254, up="y")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.0254
    x, y, z = rows(of, of.positions)[2][3] / 0.0254
    assert np.array(curves.GetPointsAttr().Get(2))[3] == pytest.approx([x, z, -y], rel=1e-6)
    assert curves.GetWidthsAttr().Get()[0] == pytest.approx(80e-6 / 0.0254)
    found = jh.read_curves(tmp_path / "a.usdc", frame=2).points
    assert found == pytest.approx(of.positions[2], abs=1e-6)


@pytest.mark.parametrize("basis", BASES)
def test_bonds_are_primvars_of_the_right_size(tmp_path: Path, basis: str) -> None:
    """A number for each point: ends have their neighbours', two points have no bonds."""
    of = wavy([5, 3])
    _, curves = saved(tmp_path / "a.usda", of, basis=basis, color_by="ionic")
    api = UsdGeom.PrimvarsAPI(curves)
    for kind, name in enumerate(jh.BONDS):
        primvar = api.GetPrimvar(f"bonded_{name}")
        want = of.fractions[1, ..., kind].astype(np.float32)
        a, b = want[0], want[1, 0]
        assert np.array_equal(primvar.Get(1), [a[0], *a, a[-1], b, b, b])
        each = primvar.GetInterpolation()
        assert each == ("varying" if basis == "bezier" else "vertex")
        assert curves.ComputeUniformDataSize(1) == 2
        size = curves.ComputeVaryingDataSize(1) if basis == "bezier" else 8
        assert len(primvar.Get(1)) == size == 8
    color = curves.GetDisplayColorPrimvar()
    shown, bonded = np.array(color.Get(1)), np.array(api.GetPrimvar("bonded_ionic").Get(1))
    assert np.array_equal(np.argsort(shown[:, 0]), np.argsort(bonded))  # red grows with bonds
    assert np.array_equal(np.argsort(-shown[:, 2]), np.argsort(bonded))  # and blue falls


def test_plain_hair_has_one_colour_and_still_bonds_one_sample(tmp_path: Path) -> None:
    """Linear RGB, as displayColor is."""
    _, curves = saved(tmp_path / "a.usda", recording(), color=(0.5, 0.0, 1.0))
    color = curves.GetDisplayColorPrimvar()
    assert color.GetInterpolation() == "constant"
    assert np.array(color.Get()) == pytest.approx(np.array([[0.21404, 0.0, 1.0]]), abs=1e-4)
    peptide = UsdGeom.PrimvarsAPI(curves).GetPrimvar("bonded_peptide").GetAttr()
    assert peptide.GetNumTimeSamples() == 0
    assert set(peptide.Get()) == {1.0}


@pytest.mark.parametrize(
    ("radius", "want"), [(30e-6, [60e-6]), (np.array([30e-6, 50e-6]), [60e-6] * 5 + [100e-6] * 3)]
)
def test_widths_are_the_fibres(tmp_path: Path, radius: Any, want: list[float]) -> None:
    """One for all, or one for each point where strands differ."""
    of = scene([5, 3])
    fibre = jh.PhysicalFibre(radius=radius)
    of = jh.Scene(of.strands, fibre=fibre, phases=of.phases, solver=jh.Direct(), dt=of.dt)
    _, curves = saved(tmp_path / "a.usda", wavy([5, 3], scene=of))
    assert np.array(curves.GetWidthsAttr().Get()) == pytest.approx(want)
    assert curves.GetWidthsInterpolation() == ("constant" if len(want) == 1 else "vertex")


@pytest.mark.parametrize("basis", BASES)
def test_extents_hold_the_curve(tmp_path: Path, basis: str) -> None:
    """At least those that the USD library computes of the points and widths."""
    _, curves = saved(tmp_path / "a.usda", wavy([5, 3]), basis=basis)
    for frame in range(4):
        low, high = np.array(curves.GetExtentAttr().Get(frame))
        least = UsdGeom.Boundable.ComputeExtentFromPlugins(curves, frame)
        assert np.all(low <= np.array(least[0]) + FLOAT32)
        assert np.all(high >= np.array(least[1]) - FLOAT32)


def test_bezier_is_the_same_curve_as_pinned_catmull_rom(tmp_path: Path) -> None:
    """At the middle of each segment, by the basis matrices of the USD documentation."""
    of = wavy()
    _, curves = saved(tmp_path / "a.usda", of, basis="bezier")
    control = np.array(curves.GetPointsAttr().Get(0)).reshape(2, 13, 3).astype(float)
    p = of.positions[0].astype(float)
    first, last = 2 * p[:, :1] - p[:, 1:2], 2 * p[:, -1:] - p[:, -2:-1]
    p = np.concatenate([first, p, last], 1)
    middle = (-p[:, :-3] + 9 * p[:, 1:-2] + 9 * p[:, 2:-1] - p[:, 3:]) / 16
    b = control
    bezier = (b[:, 0:-1:3] + 3 * b[:, 1::3] + 3 * b[:, 2::3] + b[:, 3::3]) / 8
    assert bezier == pytest.approx(middle, abs=1e-6)


def test_obstacles_move_and_are_seen_in_their_phases(tmp_path: Path) -> None:
    """The ball of the fall moves, then there is the floor."""
    stage, _ = saved(tmp_path / "a.usdc", recording())
    ball = UsdGeom.Mesh(stage.GetPrimAtPath("/hair/obstacles/Sphere"))
    floor = UsdGeom.Mesh(stage.GetPrimAtPath("/hair/obstacles/Floor"))
    seen = [[m.ComputeVisibility(t) for t in range(4)] for m in (ball, floor)]
    assert seen == [["inherited"] * 3 + ["invisible"], ["invisible"] * 3 + ["inherited"]]
    for frame, height in enumerate([0.1, 0.08, 0.06]):
        z = np.array(ball.GetPointsAttr().Get(frame))[:, 2]
        assert (z.max() + z.min()) / 2 == pytest.approx(height, abs=FLOAT32)
    assert floor.GetPointsAttr().GetNumTimeSamples() == 0
    valid, why = UsdGeom.Mesh.ValidateTopology(
        ball.GetFaceVertexIndicesAttr().Get(),
        ball.GetFaceVertexCountsAttr().Get(),
        len(ball.GetPointsAttr().Get(0)),
    )
    assert valid, why


def test_an_obstacle_that_stays_is_one_mesh(tmp_path: Path) -> None:
    """Through both phases, and always visible; a second one that jumps is another."""
    head = jh.Sphere((0.0, 0.0, 0.0), 0.1)
    of = scene()
    phases = tuple(
        jh.Phase(p.name, p.duration, (head, jh.Floor(z)))
        for p, z in zip(of.phases, (0.0, -1.0), strict=True)
    )
    of = jh.Scene(of.strands, phases=phases, dt=of.dt)
    stage, _ = saved(tmp_path / "a.usda", wavy(scene=of))
    meshes = [p.GetName() for p in stage.GetPrimAtPath("/hair/obstacles").GetChildren()]
    assert meshes == ["Sphere", "Floor", "Floor_2"]
    head_prim = UsdGeom.Mesh(stage.GetPrimAtPath("/hair/obstacles/Sphere"))
    assert not head_prim.GetVisibilityAttr().HasAuthoredValue()


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("ending", [".usda", ".usdc"])
def test_all_of_the_validators_pass(tmp_path: Path, basis: str, ending: str) -> None:
    """Every one that the USD library has, on a file of the richest kind."""
    stage, _ = saved(tmp_path / f"a{ending}", wavy([5, 3]), basis=basis, color_by="hydrogen")
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [(e.GetName(), e.GetMessage()) for e in errors] == []
    bare = Usd.Stage.CreateInMemory()  # of which they must find something
    assert UsdValidation.ValidationContext(validators).Validate(bare) != []


def test_the_library_itself_can_package_it(tmp_path: Path) -> None:
    """As .usdz, which follows every reference."""
    saved(tmp_path / "a.usdc", wavy())
    path = tmp_path / "a.usdz"
    assert UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(tmp_path / "a.usdc")), str(path))
    stage = Usd.Stage.Open(str(path))
    assert stage.GetPrimAtPath("/hair/strands").IsA(UsdGeom.BasisCurves)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("sizes", [(), (2,), (2, 17, 3, 9)])
@pytest.mark.parametrize("up", ["y", "z"])
def test_strands_alone_are_written_too(
    tmp_path: Path, ending: str, sizes: tuple[int, ...], up: Any
) -> None:
    """Without an animation, in any unit, and read back without telling it again."""
    random = np.random.default_rng(0)
    lists = [random.normal(size=(n, 3)).astype(np.float32) for n in sizes]
    path = tmp_path / f"a{ending}"
    jh.write_curves(path, jh.Curves.from_list(lists), unit=0.5, up=up)
    found = jh.read_curves(path).to_list()
    assert len(found) == len(lists)
    for strand, want in zip(found, lists, strict=True):
        assert np.array_equal(strand, want)


def test_strands_of_one_point_cannot_be_written(tmp_path: Path) -> None:
    """No curve has one."""
    with pytest.raises(ValueError, match=r"strand 1 has 1 point.*at least 2"):
        jh.write_curves(tmp_path / "a.usda", jh.Curves.from_list([A, A[:1]]))
    assert list(tmp_path.iterdir()) == []


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


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"basis": "bspline"}, ["basis", "'bspline'", "catmullRom"]),
        ({"width": 0.0}, ["width", "above 0"]),
        ({"color": (2.0, 0.0, 0.0)}, ["color", "2.0"]),
        ({"unit": 0.0}, ["unit", "0.0"]),
        ({"up": "x"}, ["up", "'x'"]),
    ],
)
def test_wrong_requests_write_nothing(tmp_path: Path, options: Any, words: list[str]) -> None:
    """Each names what is wrong."""
    with pytest.raises(ValueError) as error:
        jh.save(tmp_path / "a.usdc", wavy(), **options)
    for word in words:
        assert word in str(error.value)
    assert list(tmp_path.iterdir()) == []


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


def test_the_command_line_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`python -m jaxhair simulate perm --output perm.usdc`."""
    path = tmp_path / "perm.usdc"
    small = ["--strands", "2", "--points", "17", "--prepared", "--no-contact", "--seconds", "0.1"]
    assert main(["simulate", "perm", *small, "--quiet", "--output", str(path)]) == 0
    assert "perm.usdc: 6 frames" in capsys.readouterr().out
    assert jh.read_curves(path).points.shape == (2, 17, 3)


def test_a_fit_takes_it_as_its_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """`python -m fitting --target permed=released.usd`, in the unit that the file says."""
    seen: list[Any] = []

    def reached(observed: Any, **_: Any) -> Any:
        seen.append(observed)
        raise ValueError("reached")

    monkeypatch.setattr("fitting.__main__.from_strands", reached)
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
