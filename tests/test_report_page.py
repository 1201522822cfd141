"""The page in a real browser: it draws, asks the network for nothing, fits screens."""

import shutil

import pytest

from uwsfm.report.files import PAGE

pytestmark = pytest.mark.slow  # seconds per page: WebGL without a graphics card

NO_CARD = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


CORNERS = """
(() => {
  const plot = document.querySelector("#cloud"), scene = plot._fullLayout.scene._scene;
  const { model, view, projection } = scene.glplot.cameraParams;
  const times = (m, v) => [0, 1, 2, 3].map(
    (row) => v.reduce((sum, value, k) => sum + m[4 * k + row] * value, 0));
  const ranges = JSON.parse(document.getElementById("data").textContent).view.ranges;
  return [...Array(8).keys()].map((n) => {
    const corner = ranges.map((range, k) => scene.dataScale[k] * range[n >> k & 1]);
    const seen = times(projection, times(view, times(model, [...corner, 1])));
    return Math.min(
      plot.clientWidth / 2 * (1 - Math.abs(seen[0]) / seen[3]),
      plot.clientHeight / 2 * (1 - Math.abs(seen[1]) / seen[3]));
  });
})()
"""
"""Pixels between the corners of the 3-D axes and the border."""


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
    assert 45.0 < min(opened.js(CORNERS)) < 55.0  # room for labels, and no more
    ink = opened.js("document.querySelector('#cost')._fullLayout.font.color")
    paper = opened.js("getComputedStyle(document.body).backgroundColor")
    bright = sum(int(value) for value in paper[4:-1].split(",")) > 3 * 128
    assert bright == (scheme == "light")
    assert (int(ink[1:3], 16) < 128) == bright


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
