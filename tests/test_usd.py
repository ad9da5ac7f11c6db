"""USD files that are written: as the USD library's own schemas and validators have them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import jaxhair as jh
from jaxhair.__main__ import main
from jaxhair.usd_child import on_curve

pytest.importorskip("pxr", reason="needs usd-core")
from pxr import Sdf, Usd, UsdGeom, UsdUtils, UsdValidation
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


def test_the_command_line_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`python -m jaxhair simulate perm --output perm.usdc`."""
    path = tmp_path / "perm.usdc"
    small = ["--strands", "2", "--points", "17", "--prepared", "--no-contact", "--seconds", "0.1"]
    assert main(["simulate", "perm", *small, "--quiet", "--output", str(path)]) == 0
    assert "perm.usdc: 6 frames" in capsys.readouterr().out
    assert jh.read_curves(path).points.shape == (2, 17, 3)
