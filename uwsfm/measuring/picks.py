"""What people point at: a point's number, a place in the world, or pixels.

As text, on the command line and in measurements.yaml:

    1234                                             point id of sparse/
    0.12,-0.40,1.85                                  place of a cloud, metres
    left/01.png:412.5,300+right/01.png:380.1,311.9   one spot, clicked in two images
    left/01.png:412.5,300                            ... in one, on the surface there

In the file also as a number, a list of three, or a list of clicks as in lengths.yaml;
text with commas between quotes.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from uwsfm.inputs.lengths_file import Click
from uwsfm.rig.problems import first_problem

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_CLICK = re.compile(
    rf"(?P<image>[^:]+):\s*(?P<x>{_NUMBER})\s*,\s*(?P<y>{_NUMBER})\s*(?:\+|$)\s*"
)
_FORMS = (
    "write a point id (1234), a place (0.1,-0.4,1.9) or pixels "
    "(left/01.png:412.5,300+right/01.png:380.1,311.9)"
)
IN_YAML = "; in YAML between quotes"


@dataclass(frozen=True)
class PointPick:
    """A point of the model."""

    point_id: int

    def __str__(self) -> str:
        return f"point {self.point_id}"


@dataclass(frozen=True)
class WorldPick:
    """A place in the world, of a cloud."""

    xyz: tuple[float, float, float]

    def __str__(self) -> str:
        return "({:.4g}, {:.4g}, {:.4g})".format(*self.xyz)


@dataclass(frozen=True)
class PixelPick:
    """One spot, clicked in images."""

    clicks: tuple[Click, ...]

    def __str__(self) -> str:
        first = self.clicks[0]
        more = f" +{len(self.clicks) - 1}" if len(self.clicks) > 1 else ""
        x, y = first.xy
        return f"{first.image} ({x:g}, {y:g}){more}"


Pick = PointPick | WorldPick | PixelPick


def parsed_pick(value: Any) -> Pick:
    """A pick in any of its forms.

    Raises:
        ValueError: it has none; one sentence.
    """
    if isinstance(value, (PointPick, WorldPick, PixelPick)):
        return value
    if isinstance(value, str):
        return _from_text(value.strip())
    if isinstance(value, int) and not isinstance(value, bool):
        return PointPick(value)
    if isinstance(value, (list, tuple)) and value:
        if all(isinstance(item, dict) for item in value):
            return _of_clicks([_click(item) for item in value])
        if len(value) == 3 and all(_is_number(item) for item in value):
            x, y, z = map(float, value)
            return WorldPick((x, y, z))
    raise ValueError(f"{value!r} is no pick: {_FORMS}{IN_YAML}")


def _is_number(value: Any) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and math.isfinite(value)


def _from_text(text: str) -> Pick:
    if re.fullmatch(r"\d+", text):
        return PointPick(int(text))
    parts = text.split(",")
    if len(parts) == 3 and all(re.fullmatch(_NUMBER, p.strip()) for p in parts):
        return parsed_pick([float(part) for part in parts])
    clicks, at = [], 0
    while at < len(text):
        found = _CLICK.match(text, at)
        if found is None:
            raise ValueError(f"{text!r} is no pick: {_FORMS}{IN_YAML}")
        xy = [float(found["x"]), float(found["y"])]
        clicks.append(_click({"image": found["image"].strip(), "xy": xy}))
        at = found.end()
    if not clicks or text.endswith("+"):
        raise ValueError(f"{text!r} is no pick: {_FORMS}{IN_YAML}")
    return _of_clicks(clicks)


def _click(item: dict) -> Click:
    try:
        return Click.model_validate(item)
    except ValidationError as error:
        raise ValueError(first_problem(error, {"": Click})) from None


def _of_clicks(clicks: list[Click]) -> PixelPick:
    images = [click.image for click in clicks]
    for image in images:
        if images.count(image) > 1:
            raise ValueError(f"{image} is clicked twice: click a spot once per image")
    return PixelPick(tuple(clicks))
