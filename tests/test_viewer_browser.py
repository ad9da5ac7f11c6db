"""The viewer in a real Chromium without a network: what is done changes the picture, or does not.

Needs the packages of the extra `browser` and a Chromium, such as Debian's package `chromium`.
"""

import io
import shutil
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import jaxhair as jh
from jaxhair.pictures import View

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")

ARGUMENTS = (
    "--no-sandbox --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader "
    "--enable-unsafe-swiftshader"
)
WAIT = 120.0  # s, where the drawing is done by a busy processor
VIEW = View(distance=0.95, target=(0.08, 0.03, 0.1))  # all is seen beside the controls
BACKGROUND = np.array([233, 235, 238])
BAD_NAME = "</script><script>alert(1)</script><b>fall</b>"


def recording() -> jh.Recording:
    """8 strands that bend in the plane of the first view and lose their hydrogen bonds, beside a
    ball that moves; then the ball is gone."""
    across = np.array([-np.sin(-1.2), np.cos(-1.2), 0.0])  # to the right in the first view
    roots = np.linspace(-0.03, 0.03, 8)[:, None] * across + [0.0, 0.0, 0.2]
    points = np.empty((6, 8, 9, 3))
    along = np.linspace(0, 1, 9)
    for frame in range(6):
        side = 0.03 * frame * along**2
        points[frame] = roots[:, None] + side[:, None] * across
        points[frame, ..., 2] -= 0.2 * along
    fractions = np.ones((6, 8, 7, 4))
    fractions[..., 0] = np.linspace(1, 0, 6)[:, None, None]
    counts = [9, 9, 9, 5, 9, 9, 7, 2]
    ball = jh.Sphere((0.2, 0.1, 0.1), 0.03, velocity=(0.0, 0.0, -0.5))
    phases = (jh.Phase(BAD_NAME, 0.4, (jh.Hold(), ball)), jh.Phase("rest", 0.2, (jh.Hold(),)))
    of = jh.Scene(jh.Strands.from_points(points[0], counts=counts), phases=phases, dt=0.1)
    names = ("", *[BAD_NAME] * 3, "rest", "rest")
    times = np.array([0.0, 0.1, 0.2, 0.4, 0.5, 0.6])
    return jh.Recording(of, times, {"positions": points, "fractions": fractions}, names)


def wait(view: Any, what: str) -> None:
    """Until JavaScript is true; `wait_for_function` would need what the page's policy forbids."""
    end = time.monotonic() + WAIT
    while not view.evaluate(f"Boolean({what})"):
        assert time.monotonic() < end, what
        time.sleep(0.02)


@dataclass
class Opened:
    """A page, and what went wrong in it."""

    page: Any
    view: Any
    problems: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def picture(self) -> np.ndarray:
        """Pixels of the hair, when all is drawn, without the controls."""
        wait(self.view, "window.jaxhair && jaxhair.settled()")
        self.view.evaluate("() => new Promise((done) => requestAnimationFrame(done))")
        data = self.page.screenshot(timeout=1000 * WAIT)
        with Image.open(io.BytesIO(data)) as image:
            pixels = np.asarray(image.convert("RGB")).astype(int)
        return pixels[45:-75]

    def text(self, name: str) -> str:
        return str(self.view.inner_text(f"#{name}"))


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with playwright.sync_playwright() as started:
        chromium = started.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS.split())
        yield chromium
        chromium.close()


@pytest.fixture
def opened(browser: Any, tmp_path: Path) -> Iterator[Opened]:
    """The saved page, opened as a file, with no network."""
    path = tmp_path / "hair.html"
    jh.save(path, recording(), frame=0, view=VIEW)
    yield from open_page(browser, path)


def open_page(browser: Any, path: Path, **options: Any) -> Iterator[Opened]:
    size = {"width": 480, "height": 420}
    context = browser.new_context(viewport=size, offline=True, **options)
    page = context.new_page()
    found = Opened(page, page)
    page.on("console", lambda m: found.problems.append(m.text) if m.type != "log" else None)
    page.on("pageerror", lambda error: found.problems.append(str(error)))
    page.on("dialog", lambda dialog: (found.problems.append("dialog"), dialog.dismiss()))
    page.on("request", lambda request: found.requests.append(request.url))
    page.goto(path.as_uri())
    wait(page, "window.jaxhair")
    yield found
    context.close()
    # ANGLE tells how slow the waiting of `adapt` is on a processor; no fault of the page
    assert [p for p in found.problems if "ReadPixels" not in p] == []
    assert found.requests == [path.as_uri()]


def hair_of(pixels: np.ndarray) -> np.ndarray:
    """Where something brown is."""
    found: np.ndarray = pixels[..., 0] - pixels[..., 2] > 15
    return found


def changed(a: np.ndarray, b: np.ndarray) -> float:
    """Part of the pixels that differ."""
    return float(np.mean(np.abs(a - b).max(-1) > 8))


def test_nothing_changes_unless_something_is_done(opened: Opened) -> None:
    """Hair is seen, on a light background, and stays as it is."""
    first = opened.picture()
    assert 0.005 < hair_of(first).mean() < 0.5
    assert np.all(np.abs(first[:10] - BACKGROUND) <= 1)
    opened.page.wait_for_timeout(400)
    assert np.array_equal(first, opened.picture())
    opened.page.mouse.move(200, 200)
    assert np.array_equal(first, opened.picture())


def test_drag_turns_and_reset_turns_back(opened: Opened) -> None:
    first = opened.picture()
    drag(opened, 120, 0)
    turned = opened.picture()
    assert changed(first, turned) > 0.005
    drag(opened, 0, 60)
    assert changed(turned, opened.picture()) > 0.005
    opened.page.click("#reset")
    assert np.array_equal(first, opened.picture())


def drag(opened: Opened, x: float, y: float, button: str = "left") -> None:
    mouse = opened.page.mouse
    mouse.move(240, 200)
    mouse.down(button=button)
    mouse.move(240 + x, 200 + y, steps=3)
    mouse.up(button=button)


@pytest.mark.parametrize("how", ["shift", "right"])
def test_pan_moves_the_hair_as_far_as_the_pointer(opened: Opened, how: str) -> None:
    """As far, in pixels, because the hair is in the plane that is moved."""
    before = hair_of(opened.picture())
    if how == "shift":
        opened.page.keyboard.down("Shift")
    drag(opened, 40, -20, "right" if how == "right" else "left")
    if how == "shift":
        opened.page.keyboard.up("Shift")
    after = hair_of(opened.picture())
    moved = [np.mean(np.nonzero(after)[k]) - np.mean(np.nonzero(before)[k]) for k in (1, 0)]
    assert moved == pytest.approx([40, -20], abs=3)


def test_wheel_zooms(opened: Opened) -> None:
    """Nearer, the hair is larger; the scale bar stays true."""
    before = hair_of(opened.picture())
    length = scale(opened)
    opened.page.mouse.move(240, 200)
    opened.page.mouse.wheel(0, -200)
    after = hair_of(opened.picture())
    factor = np.exp(0.3)
    assert np.ptp(np.nonzero(after)[0]) > 1.15 * np.ptp(np.nonzero(before)[0])
    assert scale(opened) == pytest.approx(factor * length, rel=0.02)
    opened.page.mouse.wheel(0, 200)
    assert scale(opened) == pytest.approx(length, rel=0.02)


def scale(opened: Opened) -> float:
    """Pixels a centimetre, as the scale bar says."""
    opened.picture()
    number, unit = opened.text("scale").split()
    width = opened.view.evaluate("document.querySelector('#scale i').style.width")
    return float(width.removesuffix("px")) / float(number) / {"cm": 1, "mm": 0.1}[unit]


def test_the_scale_bar_is_as_long_as_the_hair_says(opened: Opened) -> None:
    """The longest strand hangs 20 cm at first, seen from 0.25 rad above."""
    rows = np.nonzero(hair_of(opened.picture()).any(1))[0]
    assert np.ptp(rows) / scale(opened) == pytest.approx(20 * np.cos(0.25), rel=0.06)


def test_scrubbing_shows_the_frame_its_time_and_its_phase(opened: Opened) -> None:
    first = opened.picture()
    assert opened.text("time") == "0.00 s, start, frame 1 of 6"
    opened.page.fill("#frame", "3")
    third = opened.picture()
    assert opened.text("time") == f"0.40 s, {BAD_NAME}, frame 4 of 6"
    assert changed(first, third) > 0.005
    columns = [np.mean(np.nonzero(hair_of(x))[1]) for x in (first, third)]
    assert columns[1] > columns[0] + 5  # it has bent to the right
    opened.page.fill("#frame", "0")
    assert np.array_equal(first, opened.picture())


def test_keys(opened: Opened) -> None:
    """Arrows, Home and End; space plays to the end and then from the start."""
    first = opened.picture()
    press = opened.page.keyboard.press
    press("ArrowRight")
    press("ArrowRight")
    assert opened.text("time").endswith("frame 3 of 6")
    press("ArrowLeft")
    assert opened.text("time").endswith("frame 2 of 6")
    press("Home")
    assert np.array_equal(first, opened.picture())
    press(" ")
    assert opened.text("play") == "pause"
    wait(opened.view, "jaxhair.state.frame === 5")
    assert opened.text("play") == "play"
    last = opened.picture()
    assert changed(first, last) > 0.005
    press("Home")
    press("End")
    assert np.array_equal(last, opened.picture())
    opened.page.click("#play")
    wait(opened.view, "jaxhair.state.frame < 5")
    opened.page.click("#play")
    drag(opened, 50, 0)
    press("r")
    press("Home")
    assert np.array_equal(first, opened.picture())


def test_colours_show_the_values(opened: Opened) -> None:
    """Bonds are red where whole, in the first frame, and blue where cut, in the last."""
    plain = opened.picture()
    opened.page.select_option("#field", "hydrogen")
    whole = opened.picture()
    there = hair_of(plain)
    assert opened.text("bar").split() == ["0", "1", "bonded", "fraction"]
    assert np.median((whole[..., 0] - whole[..., 2])[there]) > 40
    opened.page.keyboard.press("Tab")
    opened.page.fill("#frame", "5")
    cut = opened.picture()
    differs = np.abs(cut - BACKGROUND).max(-1) > 60
    assert np.median((cut[..., 0] - cut[..., 2])[differs]) < -40
    for name in ("peptide", "strain", "curvature"):
        opened.page.select_option("#field", name)
        assert changed(cut, opened.picture()) > 0.002, name
        assert "%" in opened.text("bar") or name != "strain"
    opened.page.select_option("#field", "")
    opened.page.fill("#frame", "0")
    assert np.array_equal(plain, opened.picture())
    assert not opened.page.is_visible("#bar")


def test_obstacles_are_seen_in_their_phases_where_they_are(opened: Opened) -> None:
    """The ball, grey, sinks from frame to frame and is gone in the last phase."""

    def rows(frame: int) -> np.ndarray:
        opened.page.fill("#frame", str(frame))
        pixels = opened.picture()
        grey = (np.ptp(pixels, axis=-1) < 25) & (pixels.mean(-1) > 110)
        seen = grey & (np.abs(pixels - BACKGROUND).max(-1) > 20)
        return np.asarray(np.nonzero(seen[:, 320:])[0])  # right of the hair

    first, later = rows(0), rows(2)
    assert len(first) > 500
    assert np.mean(later) > np.mean(first) + 10
    assert len(rows(5)) == 0


def test_high_density_has_more_pixels(browser: Any, tmp_path: Path) -> None:
    path = tmp_path / "hair.html"
    jh.save(path, recording())
    for opened in open_page(browser, path, device_scale_factor=2):
        size = opened.view.evaluate(
            '(({width, height}) => [width, height])(document.querySelector("canvas"))'
        )
        assert size[0] == 960
        assert 0.005 < hair_of(opened.picture()).mean() < 0.5


def test_a_lost_picture_is_drawn_again_on_a_click(opened: Opened) -> None:
    """Browsers drop the oldest where many are open."""
    first = opened.picture()
    lose = "document.querySelector('canvas').getContext('webgl2')"
    opened.view.evaluate(f"{lose}.getExtension('WEBGL_lose_context').loseContext()")
    opened.view.wait_for_selector("#message:not([hidden])")
    assert "Click" in opened.text("message")
    opened.page.click("#message")
    assert np.array_equal(first, opened.picture())


def test_without_webgl_or_scripts_the_page_says_so(browser: Any, tmp_path: Path) -> None:
    path = tmp_path / "hair.html"
    jh.save(path, recording())
    context = browser.new_context(offline=True)
    context.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page = context.new_page()
    page.goto(path.as_uri())
    page.wait_for_selector("#message:not([hidden])")
    assert "WebGL 2" in page.inner_text("#message")
    page.keyboard.press("ArrowLeft")
    assert page.inner_text("#time").endswith("frame 5 of 6")
    context.close()
    context = browser.new_context(offline=True, java_script_enabled=False)
    page = context.new_page()
    page.goto(path.as_uri())
    assert "JavaScript" in page.inner_text("#noscript")
    context.close()


def test_what_is_left_out_is_said(browser: Any, tmp_path: Path) -> None:
    path = tmp_path / "hair.html"
    with pytest.warns(UserWarning, match="of 6 frames"):
        jh.save(path, recording(), max_megabytes=0.0477)
    for opened in open_page(browser, path):
        assert "of 6 frames" in opened.text("note")


def test_in_a_notebook_made_into_html(browser: Any, tmp_path: Path) -> None:
    """Two views in one page that know nothing of each other, turned with the pointer."""
    nbconvert = pytest.importorskip("nbconvert")
    nbformat = pytest.importorskip("nbformat")
    cells = []
    for color_by in (None, "hydrogen"):
        shown = jh.view(recording(), frame=0, color_by=color_by, height=300)
        data = {"text/html": shown._repr_html_(), "text/plain": repr(shown)}
        output = nbformat.v4.new_output("display_data", data=data)
        cells.append(nbformat.v4.new_code_cell("jh.view(recording)", outputs=[output]))
    notebook = nbformat.v4.new_notebook(cells=cells)
    again = nbformat.reads(nbformat.writes(notebook), as_version=4)
    exporter = nbconvert.HTMLExporter()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # IPython, to highlight the code, may not be there
        page_text, _ = exporter.from_notebook_node(again)
    path = tmp_path / "notebook.html"
    path.write_text(page_text, encoding="utf-8")

    page = browser.new_context(viewport={"width": 600, "height": 800}, offline=True).new_page()
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(path.as_uri())
    frames = page.locator("iframe")
    assert frames.count() == 2

    def pictures() -> list[np.ndarray]:
        found = []
        for k in range(2):
            inside = frames.nth(k).element_handle().content_frame()
            wait(inside, "window.jaxhair && jaxhair.settled()")
            with Image.open(io.BytesIO(frames.nth(k).screenshot(timeout=1000 * WAIT))) as image:
                found.append(np.asarray(image.convert("RGB")).astype(int)[45:-75])
        return found

    first = pictures()
    assert all(np.abs(x - BACKGROUND).max(-1).max() > 60 for x in first)
    box = frames.nth(1).bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 100, y, steps=3)
    page.mouse.up()
    second = pictures()
    assert np.array_equal(first[0], second[0])
    assert changed(first[1], second[1]) > 0.005
    assert page.evaluate("window.jaxhair === undefined")
    assert problems == []
    page.context.close()
