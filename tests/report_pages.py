"""A report of a small result made by hand, and its page taken apart."""

import json
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
from hand_made import summary
from hand_made_result import result_of, small_model

from uwsfm.colmap.model import Model
from uwsfm.report.gather import Report, gather


class Tables(HTMLParser):
    """The tables of a page by the label of what holds them: rows of cells."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: dict[str, list[list[str]]] = {}
        self._label, self._in_cell = "", False
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "div" and "scroll" in attributes.get("class", ""):
            self._label = attributes["aria-label"]
            self.found[self._label] = []
        elif tag == "tr" and self._label:
            self.found[self._label].append([])
        elif tag in ("td", "th") and self._label:
            self.found[self._label][-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._in_cell = False
        elif tag == "table":
            self._label = ""

    def handle_data(self, data):
        if self._in_cell:
            self.found[self._label][-1][-1] += data.strip()


def text_of(page: str) -> str:
    body = page[page.index("<body>") : page.index('<script type="application/json"')]
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]*>", " ", body)))


def payload_of(page: str) -> dict:
    """What the script of a page draws from."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    return json.loads(found.group(1))


def model_that_misses() -> Model:
    """Observations of the left camera off by (3, 4) px, the right's by (0, 12)."""
    model = small_model()
    scene = model.scene
    exact, _ = scene.projections()
    off = np.array([[3.0, 4.0], [0.0, 12.0]])[scene.camera_idx]
    return replace(model, scene=replace(scene, xy=exact - off))


def report_of(model: Model, out: Path) -> Report:
    """The report of a model, with the covariances and the summary made by hand."""
    out.mkdir()
    return gather(model, result_of(model.scene).covariance, summary(), out)
