"""The page in a real browser: it draws, asks the network for nothing, fits screens."""

import shutil

import numpy as np
import pytest

from uwsfm.report.files import PAGE

pytestmark = pytest.mark.slow  # seconds per page: WebGL without a graphics card

NO_CARD = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


SEEN = """
(() => {
  const plot = document.querySelector("#cloud"), scene = plot._fullLayout.scene._scene;
  const { model, view, projection } = scene.glplot.cameraParams;
  const times = (m, v) => [0, 1, 2, 3].map(
    (row) => v.reduce((sum, value, k) => sum + m[4 * k + row] * value, 0));
  return plot.data.map((trace) => Array.from(trace.x, (_, i) => {
    const place = ["x", "y", "z"].map((name, k) => scene.dataScale[k] * trace[name][i]);
    const seen = times(projection, times(view, times(model, [...place, 1])));
    return [plot.clientWidth / 2 * (1 + seen[0] / seen[3]),
            plot.clientHeight / 2 * (1 - seen[1] / seen[3])];
  }));
})()
"""
"""Where Plotly draws the vertices of each trace, pixels from the left and the top."""


@pytest.fixture(scope="module")
def chromium():
    api = pytest.importorskip("playwright.sync_api")
    program = shutil.which("chromium") or shutil.which("chromium-browser")
    if program is None:
        pytest.skip("no Chromium is installed")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=NO_CARD)
        yield browser
        browser.close()


class Opened:
    """A report in a window, and what happened while it was drawn."""

    def __init__(self, chromium, path, width: int, scheme: str) -> None:
        self.page = chromium.new_page(
            viewport={"width": width, "height": 900}, color_scheme=scheme
        )
        self.page.set_default_timeout(120_000)  # busy machines draw slowly
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.address = path.resolve().as_uri()
        self.page.goto(self.address)
        self.page.wait_for_selector("html[data-drawn=yes]")

    def _console(self, message) -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def js(self, code: str):
        return self.page.evaluate(code)


@pytest.fixture
def opened(chromium, dive_result, request):
    found = Opened(chromium, dive_result.out / PAGE, *request.param)
    yield found
    found.page.close()


SCREENS = [(w, s) for w in (1280, 400) for s in ("light", "dark")]


@pytest.mark.parametrize("opened", SCREENS, ids=str, indirect=True)
def test_it_draws_offline_on_every_screen(opened, request):
    width, scheme = request.node.callspec.params["opened"]
    assert opened.errors == []
    fetched = [r for r in opened.requests if not r.startswith(("data:", "blob:"))]
    assert fetched == [opened.address]
    assert opened.js("document.documentElement.scrollWidth") <= width
    # Every figure has its drawing: those of flat pages a svg, the cloud a canvas.
    assert opened.js(
        "[...document.querySelectorAll('.plot')].every("
        "p => p.querySelector('svg.main-svg') !== null)"
    )
    assert opened.js("document.querySelector('#cloud canvas') !== null")
    assert_fills_its_frame(opened)
    lost = "[...document.querySelectorAll('.scroll')].filter("
    lost += "e => e.scrollWidth > e.clientWidth).map(e => e.ariaLabel)"
    assert opened.js(lost) == []  # no column off the right edge
    ink = opened.js("document.querySelector('#cost')._fullLayout.font.color")
    paper = opened.js("getComputedStyle(document.body).backgroundColor")
    bright = sum(int(value) for value in paper[4:-1].split(",")) > 3 * 128
    assert bright == (scheme == "light")
    assert (int(ink[1:3], 16) < 128) == bright


def assert_fills_its_frame(opened):
    """All that is drawn is in the frame, and touches a margin of 9 % of its shorter
    side (the rest of what is drawn is thinned out: a few pixels); up is up."""
    seen = [np.array(trace, dtype=float) for trace in opened.js(SEEN)]
    size = opened.js("(({clientWidth: w, clientHeight: h}) => [w, h])(cloud)")
    places = np.concatenate(seen)
    places = places[np.isfinite(places).all(axis=1)]
    low, high = places.min(axis=0), places.max(axis=0)
    margin = min(*low, *(size - high)) / min(size)
    assert margin == pytest.approx(0.09, abs=0.015)
    # One side is filled, and the other has what is drawn in its middle.
    assert np.max((high - low) / size) > 0.75
    assert (low + high) / 2 == pytest.approx(np.array(size) / 2, abs=0.03 * max(size))
    assert seen[-1][:, 1].max() < np.median(seen[0][:, 1])  # the cameras, the points


@pytest.mark.parametrize("opened", [(1280, "light")], ids=str, indirect=True)
def test_a_point_shows_its_id_and_its_place_in_the_world(opened, dive_result):
    """To be typed: `uwsfm measure --from 12` or `--from X,Y,Z`."""
    trace = "document.querySelector('#cloud').data[0]"
    assert "text" in opened.js(f"{trace}.hovertemplate")
    points = dive_result.result.model.scene.points
    for index, label in enumerate(opened.js(f"{trace}.text")):
        name, place = label.split("<br>")
        assert name == f"point {index + 1}"
        xyz = [float(number) for number in place.split(",")]
        assert xyz == pytest.approx(points[index], abs=2e-4)  # four digits of metres


@pytest.mark.parametrize("opened", [(1280, "light")], ids=str, indirect=True)
def test_it_obeys_mouse_and_keyboard(opened, dive_result):
    page = opened.page
    assert opened.js("document.querySelector('#cloud').data[0].x.length") == (
        dive_result.result.model.scene.num_points
    )
    colours = "document.querySelector('#cloud').data[0].marker"
    assert opened.js(f"{colours}.color[0]").startswith("#")
    page.check("input[value=stddev]")
    assert opened.js(f"{colours}.showscale && {colours}.color[0] > 0")
    page.uncheck("input[value=points]")
    assert opened.js("document.querySelector('#cloud').data[0].visible") is False
    eye = "document.querySelector('#cloud').layout.scene.camera.eye.x"
    before = opened.js(eye)
    page.focus("#cloud")
    page.keyboard.press("ArrowLeft")
    assert opened.js(eye) != before
    page.click("#home")
    assert opened.js(eye) == pytest.approx(before)
    column = "[...document.querySelectorAll('.sortable tbody tr')].map(r => %s)"
    values = column % "Number(r.cells[3].dataset.value)"
    page.click(".sortable th:nth-child(4) button")
    found = opened.js(values)
    assert found == sorted(found)
    page.click(".sortable th:nth-child(4) button")
    assert opened.js(values) == found[::-1]
    assert opened.errors == []
