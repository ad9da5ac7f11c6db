"""Pictures: what the interpolated hairs, the curves, the light and the z-buffer must satisfy."""

import inspect
import math
import sys

import numpy as np
import pytest

pytest.importorskip("matplotlib")
pytest.importorskip("imageio_ffmpeg")

import imageio_ffmpeg
from PIL import Image

from jaxhair import figures, interpolation, pictures, raster, shading
from jaxhair.pictures import View

SMALL = {"size": (120, 100), "hairs_per_strand": 4, "scale_bar": False}
GREEN = (0.0, 1.0, 0.0)  # nothing else in a picture is green


def hanging(strands=12, points=9, length=0.2, radius=0.03):
    """Hair that hangs from a disc and spreads a little, shape (strands, points, 3) [m]."""
    turn = np.arange(strands) * 2.4
    roots = radius * np.sqrt((np.arange(strands) + 0.5) / strands)
    down = np.linspace(0, length, points)
    x, y = roots * np.cos(turn), roots * np.sin(turn)
    spread = 1 + 2 * down / length
    return np.stack([np.outer(x, spread), np.outer(y, spread), np.tile(-down, (strands, 1))], -1)


def curl(points, turns=2.0, radius=0.01, pitch=0.02):
    angle = np.linspace(0, 2 * np.pi * turns, points)
    z = -pitch * angle / (2 * np.pi)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)[None]


def ball(centre, radius, n=16):
    polar, turn = np.meshgrid(
        np.linspace(0, np.pi, n + 1), np.linspace(0, 2 * np.pi, 2 * n + 1), indexing="ij"
    )
    sphere = np.stack(
        [np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], -1
    )
    i, j = (k.ravel() for k in np.meshgrid(np.arange(n), np.arange(2 * n), indexing="ij"))
    a, b = i * (2 * n + 1) + j, (i + 1) * (2 * n + 1) + j
    triangles = np.concatenate([np.stack([a, b, b + 1], -1), np.stack([a, b + 1, a + 1], -1)])
    return np.asarray(centre) + radius * sphere.reshape(-1, 3), triangles


def floor(height, size=1.0):
    corners = [(-size, -size, height), (size, -size, height), (size, size, height)]
    return np.array([*corners, (-size, size, height)]), np.array([(0, 1, 2), (0, 2, 3)])


def green(image):
    """Which pixels show green hair."""
    image = image.astype(int)
    return image[..., 1] > 1.3 * np.maximum(image[..., 0], image[..., 2]) + 5


# ---------------------------------------------------------------------- interpolated hairs


def spacing_of(roots):
    apart = np.linalg.norm(roots[:, None] - roots, axis=-1)
    return np.median(np.min(apart + np.where(np.eye(len(roots)) > 0, np.inf, 0), -1))


def test_interpolated_roots_stay_between_their_neighbours():
    points = hanging(strands=60)
    added = interpolation.Interpolation.between(points, 8, seed=3)
    hairs = added.hairs(points, np.full(60, 9))
    assert hairs.shape == (480, 9, 3)
    roots = points[:, 0]
    off = np.linalg.norm(hairs[:, 0] - roots[added.guide], axis=-1)
    assert np.max(off) < 3 * spacing_of(roots)
    assert np.median(off[off > 0]) > 0.05 * spacing_of(roots)
    assert np.max(np.linalg.norm(hairs[:, 0, :2], axis=-1)) < 0.03 + spacing_of(roots)


def test_first_hair_of_each_strand_is_the_strand():
    points = hanging()
    added = interpolation.Interpolation.between(points, 5, seed=0)
    np.testing.assert_array_equal(added.hairs(points, np.full(12, 9))[::5], points)
    np.testing.assert_array_equal(added.cut[::5], 0)


@pytest.mark.parametrize("apart", [0.1, 1.0])
def test_far_strands_are_not_blended(apart):
    here, there = hanging(strands=10, radius=0.01), hanging(strands=10, radius=0.01)
    points = np.concatenate([here, there + [apart, 0, 0]])
    added = interpolation.Interpolation.between(points, 20, seed=1)
    x = added.hairs(points, np.full(20, 9))[..., 0]
    assert np.all((x < 0.04) | (x > apart - 0.04))


def test_a_lone_strand_becomes_a_wisp():
    points = curl(33)
    added = interpolation.Interpolation.between(points, 30, seed=0)
    off = added.hairs(points, np.array([33])) - points
    length = np.linalg.norm(np.diff(points[0], axis=0), axis=-1).sum()
    assert 0 < np.max(np.linalg.norm(off, axis=-1)) < 0.04 * length
    assert np.ptp(off[1:, 8], axis=0).min() > 0


def test_neighbours_that_part_are_not_bridged():
    points = hanging(strands=2, radius=0.002)
    points[0, :, 0] -= 0.3 * np.linspace(0, 1, 9) ** 2
    added = interpolation.Interpolation.between(points, 50, seed=0)
    tips = added.hairs(points, np.full(2, 9))[:, -1, 0]
    near = np.min(np.abs(tips[:, None] - points[:, -1, 0]), -1)
    assert np.max(near) < 0.1 * np.ptp(points[:, -1, 0])


def test_blending_with_a_shorter_strand_does_not_shorten():
    points = hanging(strands=2, radius=0.002)
    points[1, 5:] = points[1, 4]
    counts = interpolation.used_points(None, points)
    np.testing.assert_array_equal(counts, [9, 5])
    added = interpolation.Interpolation.between(points, 20, seed=0)
    long = added.hairs(points, counts)[:20]
    np.testing.assert_allclose(long[:, -1, 2], points[0, -1, 2], atol=4e-3)


# ---------------------------------------------------------------------- Bezier curves


def test_curve_passes_through_the_points():
    points = np.random.default_rng(0).normal(size=(3, 7, 3))
    curve, _ = interpolation.bezier(points, np.full(3, 7), 6)
    np.testing.assert_allclose(curve[:, ::6], points, atol=1e-14)


def test_curve_derivative_agrees_with_differences():
    points = np.random.default_rng(1).normal(size=(2, 5, 3))
    pieces = 400
    curve, rate = interpolation.bezier(points, np.full(2, 5), pieces)
    central = (curve[:, 2:] - curve[:, :-2]) * pieces / 2
    inner = np.arange(1, curve.shape[1] - 1) % pieces != 0  # curvature jumps at the points
    np.testing.assert_allclose(rate[:, 1:-1][:, inner], central[:, inner], atol=2e-4)


def test_straight_hair_stays_straight_and_even():
    points = np.linspace(0, 1, 5)[None, :, None] * [1.0, -2.0, 3.0]
    curve, rate = interpolation.bezier(points, np.array([5]), 4)
    np.testing.assert_allclose(curve[0], np.linspace(0, 1, 17)[:, None] * [1, -2, 3], atol=1e-15)
    np.testing.assert_allclose(rate[0], np.tile([0.25, -0.5, 0.75], (17, 1)), atol=1e-15)


@pytest.mark.parametrize("points", [2, 3])
def test_short_strands_have_curves(points):
    strand = hanging(strands=4, points=points)
    curve, _ = interpolation.bezier(strand, np.full(4, points), 3)
    np.testing.assert_allclose(curve[:, ::3], strand, atol=1e-15)


def test_smooth_curl_is_rounder_than_its_points():
    points = curl(17)  # 8 points a turn
    curve, _ = interpolation.bezier(points, np.array([17]), 8)
    radius = np.linalg.norm(curve[0, :, :2], axis=-1)
    chord = 0.01 * (1 - np.cos(np.pi / 8))
    assert np.max(np.abs(radius - 0.01)) < 0.2 * chord


def test_curve_ends_at_the_last_point_in_use():
    points = curl(9)
    padded = np.concatenate([points, np.repeat(points[:, -1:], 3, 1)], 1)
    plain, _ = interpolation.bezier(points, np.array([9]), 5)
    with_padding, _ = interpolation.bezier(padded, np.array([9]), 5)
    np.testing.assert_allclose(with_padding[:, :41], plain, atol=1e-15)
    np.testing.assert_array_equal(with_padding[:, 41:], np.repeat(points[:, -1:], 15, 1))


# ---------------------------------------------------------------------- light


def angle(degrees):
    """A direction at this angle from a hair along Z."""
    return np.array([math.sin(math.radians(degrees)), 0.0, math.cos(math.radians(degrees))])


@pytest.mark.parametrize(
    ("light", "eye", "power", "diffuse", "specular"),
    [
        (90, 90, 40, 1.0, 1.0),  # light and eye square to the hair
        (45, 135, 40, math.sqrt(0.5), 1.0),  # the eye on the cone of reflection
        (45, 45, 40, math.sqrt(0.5), 0.0),  # 90 degrees off the cone
        (30, 90, 2, 0.5, 0.25),  # 60 degrees off the cone
        (0, 90, 3, 0.0, 0.0),  # light along the hair
    ],
)
def test_kajiya_kay_by_hand(light, eye, power, diffuse, specular):
    result = shading.kajiya_kay(angle(0), angle(light), angle(eye), power)
    np.testing.assert_allclose(result, (diffuse, specular), atol=1e-7)


def test_kajiya_kay_is_round():
    """It depends on nothing but the angles to the hair."""
    tangent, light = angle(0), angle(50)
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    one = shading.kajiya_kay(tangent, light, angle(110), 5.0)
    other = shading.kajiya_kay(tangent, light, turned @ angle(110), 5.0)
    np.testing.assert_allclose(one, other, atol=1e-15)


def test_bonded_colors_run_from_blue_to_red():
    low, middle, high = shading.bonded_color(np.array([0.0, 0.5, 1.0]))
    assert low[2] > 5 * low[0]
    assert high[0] > 5 * high[2]
    np.testing.assert_allclose(middle, (low + high) / 2, atol=1e-7)


@pytest.mark.parametrize(("fraction", "strong", "weak"), [(0.0, 2, 0), (1.0, 0, 2)])
def test_bonded_fraction_colors_the_hair(fraction, strong, weak):
    points = hanging()
    image = pictures.draw(points, bonded=np.full(points.shape[:2], fraction), **SMALL).astype(int)
    empty = pictures.draw(points, **SMALL).astype(int)
    hair = np.ptp(empty, -1) > 30
    assert hair.sum() > 200
    assert np.mean(image[hair][:, strong] - image[hair][:, weak]) > 40


def test_bonded_fraction_varies_along_the_hair():
    points = hanging()
    bonded = np.tile(np.linspace(0, 1, 9), (12, 1))
    image = pictures.draw(points, bonded=bonded, view=View(elevation=0.0), **SMALL).astype(int)
    redness = image[..., 0] - image[..., 2]
    assert redness[20:30].min() < -40
    assert redness[70:80].max() > 40


def test_srgb_and_back():
    color = np.array([0.0, 0.02, 0.2, 1.0])
    np.testing.assert_allclose(shading.srgb(shading.linear(color)), np.round(255 * color))


def test_hair_shades_the_floor_and_hair_behind_it():
    points = hanging(strands=60)
    options = {**SMALL, "view": View(elevation=0.5)}
    bare = pictures.draw(points, **options).astype(int)
    image = pictures.draw(points, meshes=[floor(-0.21)], **options).astype(int)
    ground = image[-30:].sum(-1)
    assert ground.min() < 0.8 * np.median(ground)
    assert np.any(image != bare)
    light = raster.Camera(np.array([0.0, 0, 2]), raster.axes_towards(0, np.pi / 2), 1e3, (512, 512))
    column = np.zeros((100, 3))
    column[:, 2] = np.linspace(0.2, -0.2, 100)
    shadows = shading.Shadows(light, column, np.full(100, 0.004), 0.003, np.zeros((0, 3, 3)))
    lit = shadows.light_at(column, on_hair=True)
    assert lit[0] > 0.95
    assert lit[-1] < 0.7 * lit[0]
    assert np.all(np.diff(lit) < 1e-6)


def test_a_mesh_shades_what_is_behind_it_only():
    light = raster.Camera(np.array([0.0, 0, 2]), raster.axes_towards(0, np.pi / 2), 1e3, (512, 512))
    hair = np.array([[0.0, 0, 0.2], [0.0, 0, -0.2]])
    vertices, triangles = ball((0, 0, 0), 0.05)
    shadows = shading.Shadows(light, hair, np.zeros(2), 1e-3, vertices[triangles])
    places = np.array([[0, 0, 0.1], [0, 0, -0.1], [0.15, 0, -0.1], [0, 0, 5], [9.0, 0, 0]])
    lit = shadows.light_at(places, on_hair=False)
    np.testing.assert_allclose(lit, [1, 0, 1, 1, 1], atol=1e-3)


# ---------------------------------------------------------------------- what hides what


@pytest.mark.parametrize("side", ["front", "behind"])
def test_an_obstacle_hides_hair_behind_it(side):
    points = hanging()
    y = -0.2 if side == "front" else 0.2
    view = View(azimuth=-math.pi / 2, elevation=0.0, target=(0, 0, -0.1), distance=0.8)
    mesh = ball((0, y, -0.1), 0.03)
    options = {**SMALL, "color": GREEN, "view": view}
    free = green(pictures.draw(points, **options))
    held = green(pictures.draw(points, meshes=[mesh], **options))
    middle = (slice(47, 54), slice(57, 64))
    assert free[middle].sum() > 10
    if side == "front":
        assert not held[middle].any()
    else:
        assert held[middle].sum() > 10
    assert held[:30].sum() > 0.8 * free[:30].sum()


def test_plane_has_the_right_depth_even_behind_the_eye():
    eye = np.array([0.3, -0.4, 1.0])
    axes = raster.axes_towards(0.7, 0.6)
    camera = raster.Camera(eye, axes, 60.0, (40, 30))
    vertices, triangles = floor(0.0, 50.0)  # reaches far behind the camera
    buffer = raster.triangles(camera, vertices[triangles], 1e-3)
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(30) + 0.5)
    rays = np.stack([(x - 20) / 60, (y - 15) / 60, np.ones_like(x)], -1) @ axes
    expected = -eye[2] / rays[..., 2]
    assert np.all(expected > 0)
    np.testing.assert_allclose(raster.depth_of(buffer).reshape(30, 40), expected, rtol=1e-5)
    points = camera.unproject(x.ravel(), y.ravel(), expected.ravel())
    np.testing.assert_allclose(points[:, 2], 0, atol=1e-5)


@pytest.mark.parametrize("cells", [3, 150])
def test_triangles_of_any_size_leave_no_gap(cells):
    """A jagged sheet, as few triangles with one pixel loop each or as many small ones."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.linspace(-1, 1, cells + 1), np.linspace(-1, 1, cells + 1))
    sheet = np.stack([x, y, rng.uniform(-0.2, 0.2, x.shape) / cells], -1)
    a, b, c, d = sheet[:-1, :-1], sheet[:-1, 1:], sheet[1:, 1:], sheet[1:, :-1]
    corners = np.concatenate([np.stack(t, 2).reshape(-1, 3, 3) for t in ((a, b, c), (a, c, d))])
    camera = raster.Camera(
        np.array([0, 0, 2.0]), raster.axes_towards(0, np.pi / 2), 200, (150, 150)
    )
    depth = raster.depth_of(raster.triangles(camera, corners, 0.1))
    assert np.all(np.abs(depth - 2) < 0.25)


@pytest.mark.parametrize("thickness", [1, 2, 3])
def test_lines_across_the_border_are_those_of_a_wider_picture(thickness):
    """They reach the picture's rows and columns nowhere but where they cross it."""
    rng = np.random.default_rng(4)
    places = rng.integers(-10 * 64, 50 * 64, (600, 3)).astype(np.float32) / 64
    places[:, 2] = rng.uniform(1, 2, 600)
    places[:, :2] *= places[:, 2:]
    drawn = np.arange(600) % 2 == 0
    buffers = {}
    for border in (0, 20):
        size = (40 + 2 * border, 30 + 2 * border)
        camera = raster.Camera(np.zeros(3), np.eye(3), 60.0, size)
        buffer = raster.empty_buffer(camera)
        shifted = places + np.float32(border) * np.c_[places[:, 2:], places[:, 2:], np.zeros(600)]
        raster.lines(camera, shifted.astype("f4"), drawn, buffer, bias=0.0, thickness=thickness)
        buffers[border] = buffer.reshape(size[::-1])
    inside = buffers[20][20:-20, 20:-20]
    assert np.mean(inside != raster.empty_buffer(camera)[0]) > 0.9
    np.testing.assert_array_equal(buffers[0], inside)


def test_view_axes_are_right_handed_and_look_at_the_target():
    for azimuth, elevation in ((0.0, 0.0), (-1.2, 0.3), (2.0, np.pi / 2)):
        axes = raster.axes_towards(azimuth, elevation)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(raster.axes_towards(0, 0), [[0, 1, 0], [0, 0, -1], [-1, 0, 0]])


@pytest.mark.parametrize("view", [View(), View(azimuth=2.0, elevation=1.2), View(elevation=-1.0)])
@pytest.mark.parametrize("size", [(120, 80), (60, 140)])
def test_all_hair_is_in_the_picture(view, size):
    options = {**SMALL, "size": size, "view": view, "color": GREEN}
    hair = green(pictures.draw(hanging(), **options))
    rows, columns = np.flatnonzero(hair.any(1)), np.flatnonzero(hair.any(0))
    assert rows[0] > 0
    assert rows[-1] < size[1] - 1
    assert columns[0] > 0
    assert columns[-1] < size[0] - 1
    # and fills most of it one way
    assert max(np.ptp(rows) / size[1], np.ptp(columns) / size[0]) > 0.5


# ---------------------------------------------------------------------- draw


def test_draw_gives_bytes_and_repeats_itself():
    points = hanging()
    image = pictures.draw(points, size=(90, 70))
    assert image.shape == (70, 90, 3)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, pictures.draw(points, size=(90, 70)))
    assert np.any(image != pictures.draw(points, size=(90, 70), seed=1))


def test_scale_bar_is_drawn():
    points = hanging()
    with_bar = pictures.draw(points, size=(200, 200))
    without = pictures.draw(points, size=(200, 200), scale_bar=False)
    changed = np.any(with_bar != without, -1)
    assert changed.any()
    assert not changed[:150].any()


@pytest.mark.parametrize(
    ("most", "length"), [(0.034, 0.02), (0.2, 0.2), (0.19, 0.1), (0.7, 0.5), (0.0015, 0.001)]
)
def test_scale_bar_has_a_round_length(most, length):
    assert pictures._round_length(most) == pytest.approx(length)


def test_strands_may_have_fewer_points():
    points = hanging()
    points[:, 6:] = points[:, 5:6]
    explicit = pictures.draw(points, counts=np.full(12, 6), **SMALL)
    np.testing.assert_array_equal(pictures.draw(points, **SMALL), explicit)
    np.testing.assert_array_equal(pictures.draw(points[:, :6], **SMALL), explicit)


@pytest.mark.parametrize(
    "points",
    [hanging(strands=1), hanging(strands=2, points=2), np.zeros((3, 4, 3)), hanging(strands=1) * 0],
)
def test_odd_hair_is_drawn(points):
    assert pictures.draw(points, meshes=[floor(-0.3)], **SMALL).shape == (100, 120, 3)


def test_eye_inside_the_hair():
    view = View(target=(0, 0, -0.1), distance=0.01)
    image = pictures.draw(hanging(), meshes=[floor(-0.2), ball((0, 0, 0), 0.3)], view=view, **SMALL)
    assert image.shape == (100, 120, 3)


BAD = [
    ({"points": np.zeros((3, 4))}, "points has shape", "strands, points, 3"),
    ({"points": np.zeros((3, 1, 3))}, "points has 1 point", "2 or more"),
    ({"points": np.full((2, 3, 3), np.nan)}, "points has the value nan", "finite"),
    ({"counts": [9] * 11}, r"counts has shape \(11,\)", r"\(12,\)"),
    ({"counts": [10] * 12}, "counts has the value 10", "at most 9"),
    ({"counts": [1] * 12}, "counts is 1", "at least 2"),
    ({"bonded": np.zeros((12, 8))}, r"bonded has shape \(12, 8\)", r"\(12, 9\)"),
    ({"bonded": np.full((12, 9), 1.5)}, "bonded has the value 1.5", r"\[0, 1\]"),
    ({"hairs_per_strand": 0}, "hairs_per_strand is 0", "at least 1"),
    ({"size": (800, 8)}, "size is 8", "at least 16"),
    ({"size": 800}, r"size has shape \(\)", r"\(2,\)"),
    ({"color": (1, 2, 0)}, "color has the value 2", r"\[0, 1\]"),
    ({"seed": -1}, "seed is -1", "at least 0"),
    ({"meshes": [(np.zeros((3, 3)), [(0, 1, 3)])]}, "value 3", r"\[0, 2\]"),
    ({"meshes": [(np.zeros((3, 3)), [(0, 1.5, 2)])]}, "value 1.5", "whole number"),
    ({"meshes": [(np.zeros((3, 2)), [(0, 1, 2)])]}, r"vertices .* \(3, 2\)", "vertices, 3"),
    ({"meshes": [(np.zeros((3, 3)), [(0, 1)])]}, r"triangles .* \(1, 2\)", "triangles, 3"),
    ({"meshes": [(np.zeros((3, 3)),)]}, "1 parts", "2, vertices and triangles"),
]


@pytest.mark.parametrize(("change", "value", "allowed"), BAD)
def test_bad_input_is_named(change, value, allowed):
    arguments = {"points": hanging(), **SMALL, **change}
    with pytest.raises(ValueError, match=f"{value}.*must (be|have).*{allowed}"):
        pictures.draw(arguments.pop("points"), **arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"elevation": 30.0}, r"view.elevation is 30.0; it must be in \[-pi/2, pi/2\]"),
        ({"azimuth": math.inf}, "view.azimuth has the value inf"),
        ({"target": (0, 0)}, r"view.target has shape \(2,\)"),
        ({"distance": 0.0}, "view.distance has the value 0.0; it must be above 0"),
    ],
)
def test_bad_view_is_named(change, message):
    with pytest.raises(ValueError, match=message):
        View(**change)


def test_options_are_documented():
    known = inspect.signature(pictures._Scene.__init__).parameters.values()
    assert {p.name for p in known if p.kind == p.KEYWORD_ONLY} == set(
        pictures.Options.__annotations__
    )
    for name in pictures.Options.__annotations__:
        assert f"    {name}: " in inspect.getdoc(pictures.Options).replace("\n", "\n    ")


# ---------------------------------------------------------------------- files


def swinging(frames=4):
    shift = np.linspace(-0.1, 0.1, frames)[:, None, None, None] * [1.0, 0, 0]
    return hanging() + shift


def test_picture_is_what_draw_gives(tmp_path):
    path = tmp_path / "hair.png"
    pictures.picture(path, hanging(), **SMALL)
    with Image.open(path) as image:
        np.testing.assert_array_equal(np.asarray(image), pictures.draw(hanging(), **SMALL))


def write_picture(path, **options):
    pictures.picture(path, hanging(), **SMALL, **options)


def write_movie(path, **options):
    pictures.movie(path, swinging(2), fps=10, **SMALL, **options)


def write_comparison(path, **options):
    pictures.comparison(path, hanging(2), hanging(2), labels=["dry"], **options)


@pytest.mark.parametrize(
    ("write", "name"),
    [
        (write_picture, "a.png"),
        (write_movie, "a.gif"),
        (write_movie, "a.mp4"),
        (write_comparison, "a.png"),
    ],
)
def test_existing_files_are_replaced_only_when_told(write, name, tmp_path):
    path = tmp_path / name
    path.write_bytes(b"mine")
    with pytest.raises(FileExistsError):
        write(path)
    assert path.read_bytes() == b"mine"
    write(path, overwrite=True)
    assert len(path.read_bytes()) > 1000
    assert list(tmp_path.iterdir()) == [path]


def gif_frames(path):
    with Image.open(path) as image:
        frames, durations = [], []
        for index in range(image.n_frames):
            image.seek(index)
            frames.append(np.asarray(image.convert("RGB")))
            durations.append(image.info["duration"])
    return np.array(frames), durations


def test_gif_frames_size_and_time(tmp_path):
    path = tmp_path / "hair.gif"
    pictures.movie(path, swinging(5), fps=30, color=GREEN, **SMALL)
    frames, durations = gif_frames(path)
    assert frames.shape == (5, 100, 120, 3)
    assert sum(durations) == pytest.approx(5 / 30 * 1e3, abs=5)
    # The camera stands still: the hair moves across the picture.
    middle = [np.mean(np.nonzero(green(frame))[1]) for frame in frames]
    assert np.all(np.diff(middle) > 3)


def mp4_facts(path):
    reader = imageio_ffmpeg.read_frames(str(path))
    facts = next(reader)
    reader.close()
    return facts, imageio_ffmpeg.count_frames_and_secs(str(path))[0]


def test_mp4_frames_size_and_time(tmp_path):
    path = tmp_path / "hair.mp4"
    bonded = np.random.default_rng(0).random((7, 12, 9))
    meshes = [[floor(-0.21)], *[[floor(-0.21), ball((0, 0, 0.03), 0.02)]] * 6]
    seen = []

    def progress(indices):
        for index in indices:
            seen.append(index)
            yield index

    options = {**SMALL, "size": (122, 98)}
    pictures.movie(
        path, swinging(7), fps=10, bonded=bonded, meshes=meshes, progress=progress, **options
    )
    facts, count = mp4_facts(path)
    assert facts["size"] == (122, 98)
    assert facts["fps"] == pytest.approx(10)
    assert count == 7
    assert seen == list(range(7))


@pytest.mark.parametrize("name", ["a.gif", "a.mp4"])
def test_an_interrupted_movie_leaves_nothing(name, tmp_path):
    def stop(indices):
        yield 0
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_movie(tmp_path / name, progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("a.avi", {}, "a.avi'; its name must end in .gif or .mp4"),
        ("a.gif", {"fps": 60}, "fps is 60; it must be at most 50"),
        ("a.gif", {"fps": 0}, r"fps has the value 0\.0; it must be above 0"),
        ("a.mp4", {"size": (121, 100)}, r"size is \(121, 100\); both must be even"),
        ("a.gif", {"meshes": [[]]}, "meshes has 1 entries; it must have 2"),
        ("a.gif", {"bonded": np.zeros((1, 12, 9))}, r"bonded has shape .* \(2, 12, 9\)"),
        ("a.gif", {"frames": hanging()}, "frames has shape .*frames, strands, points, 3"),
    ],
)
def test_bad_movie_is_named(name, change, message, tmp_path):
    arguments = {"frames": swinging(2), "fps": 10, **SMALL, **change}
    with pytest.raises(ValueError, match=message):
        pictures.movie(tmp_path / name, **arguments)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("write", "name", "module"),
    [
        (write_picture, "a.png", "matplotlib.figure"),
        (write_movie, "a.mp4", "imageio_ffmpeg"),
        (write_movie, "a.gif", "PIL.Image"),
        (write_comparison, "a.png", "matplotlib.figure"),
    ],
)
def test_missing_extra_says_what_to_install(write, name, module, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r'pip install "jaxhair\[pictures\]"'):
        write(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------- target against fit


def colored(path, color):
    """How many pixels have this colour."""
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    return int(np.sum(np.all(np.abs(pixels - wanted) < 12, -1))), pixels.shape


@pytest.mark.parametrize("axis", [2, 0])
def test_comparison_shows_both(axis, tmp_path):
    strands = np.roll(curl(65), axis - 2, -1)
    path = tmp_path / "fit.png"
    pictures.comparison(path, strands, strands + 0.004, labels=["perm"], residuals=["4 mm"])
    for color in (figures.TARGET_COLOR, figures.FITTED_COLOR):
        assert colored(path, color)[0] > 500


def test_comparison_has_a_panel_for_each_state(tmp_path):
    states = [curl(33, radius=radius) for radius in (0.005, 0.008, 0.01)]
    pictures.comparison(tmp_path / "one.png", states[2], states[2], labels=["c"])
    pictures.comparison(tmp_path / "three.png", states, states, labels=["a", "b", "c"])
    _, one = colored(tmp_path / "one.png", "#000000")
    _, three = colored(tmp_path / "three.png", "#000000")
    assert three[1] == pytest.approx(3 * one[1], abs=5)
    assert three[0] == one[0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fitted": hanging(3)}, r"fitted has the shapes .* must be those of target"),
        ({"target": np.full((2, 9, 3), np.inf)}, "target has the value inf"),
        ({"target": np.zeros((2, 9, 2))}, r"target has shape \(2, 9, 2\)"),
        ({"target": []}, "target is empty"),
        ({"labels": ["a", "b"]}, r"labels is \['a', 'b'\]; it must be a list of 1 texts"),
        ({"labels": "a"}, "labels is 'a'; it must be a list"),
        ({"residuals": []}, r"residuals is \[\]; it must be a list of 1 texts"),
        ({"counts": [9]}, r"counts has shape \(1,\)"),
        ({"path": "a.pdf"}, "a.pdf'; its name must end in .png"),
    ],
)
def test_bad_comparison_is_named(change, message, tmp_path):
    arguments = {
        "path": "a.png",
        "target": hanging(2),
        "fitted": hanging(2),
        "labels": ["dry"],
        **change,
    }
    path = tmp_path / arguments.pop("path")
    with pytest.raises(ValueError, match=message):
        pictures.comparison(path, **arguments)
    assert list(tmp_path.iterdir()) == []
