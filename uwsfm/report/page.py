"""The page: the template, filled with the numbers of a report."""

import base64
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.report.gather import Report
from uwsfm.report.halves import halves_of, halves_payload
from uwsfm.report.tables import budget_columns, budget_lines, held_words, lengths_note
from uwsfm.report.words import deviation, known_length_rows, position_words
from uwsfm.results.verdict_summary import plain
from uwsfm.trust.residuals import FEWEST, CameraResiduals, Profile, Residuals
from uwsfm.trust.verdict import LENS_SHARE

_BADGES = {
    "determined": "good",
    "weakly determined": "weak",
    "not determined": "bad",
    "arbitrary": "bad",
    "ran into zero": "bad",
    "fits": "good",
    "doubtful": "weak",
    "does not fit": "bad",
    "withheld": "bad",
}
_SIGNS = {"good": "●", "weak": "◐", "bad": "○"}
"""A shape beside the word: colour alone tells nothing to many."""


@dataclass(frozen=True, kw_only=True)
class Scales:
    """Of the plots of residuals, the same for all cameras, before and after."""

    map_px: float
    """Darkest colour of the maps."""
    factor: int
    """Lines of the maps are so many times as long as what they stand for."""
    profile_px: float


def page_of(report: Report) -> str:
    """The page as HTML, everything it needs in it."""
    from jinja2 import Environment, StrictUndefined  # heavy, so the next
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    assets = files("uwsfm.report") / "templates"

    def asset(name: str) -> str:
        return (assets / name).read_text(encoding="utf-8")

    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.globals["badge"] = lambda word, what="": Markup(_badge(word, what))
    template = environment.from_string(asset("report.html.j2"))
    scales = scales_of(report.residuals)
    summary = report.summary
    earlier = summary.get("steps_of_earlier_runs", ())
    return template.render(
        report=report,
        summary=summary,
        written=datetime.now(timezone.utc).strftime("%Y-%m-%d %H:%M UTC"),
        held=held_words(summary),
        systematic=_systematic_words(report),
        halves=halves_of(summary),
        known_lengths=known_length_rows(summary),
        budget=budget_lines(summary),
        budget_columns=budget_columns(summary),
        lengths_note=lengths_note(summary),
        positions=position_words(summary),
        view_caption=_view_caption(report),
        residual_words=[_residual_words(camera) for camera in report.residuals],
        pinhole_models=_pinhole_models(report),
        scales=scales,
        fewest=FEWEST,
        cost_unit=cost_unit(summary),
        last_solve=f"{summary['solves'][-1]['num_observations']} observations",
        frame_rows=_frame_rows(report),
        earlier_steps=earlier,
        total_s=max(
            sum(s for step, s in summary["timings_s"].items() if step not in earlier),
            1e-9,
        ),
        css=Markup(asset("report.css")),
        js=Markup(asset("report.js")),
        plotly=Markup(get_plotlyjs()),
        payload=Markup(_script_json(_payload(report, scales))),
    )


def _badge(word: str, what: str) -> str:
    """Words come from `uwsfm.calibration`, none from the user."""
    kind = _BADGES.get(word, "plain")
    sign = f"{_SIGNS[kind]} " if kind in _SIGNS else ""
    text = f"{what} {word}" if what else word
    return f'<span class="badge {kind}">{sign}{text}</span>'


def scales_of(cameras: Sequence[CameraResiduals]) -> Scales:
    """Wide enough for both models in all cameras, which are compared by eye."""
    models = [
        model
        for c in cameras
        for model in (c.pinhole, c.refractive)
        if model is not None
    ]
    lengths = [np.linalg.norm(model.cells_px, axis=2) for model in models]
    known = np.concatenate([length[np.isfinite(length)] for length in lengths])
    largest = float(np.percentile(known, 95.0)) if len(known) else 0.1
    cell = min(max(camera.size) / max(camera.counts.shape) for camera in cameras)
    profile = max(map(_largest, models))
    return Scales(
        map_px=max(largest, 1e-3),
        factor=max(1, round(_one_digit(0.9 * cell / max(largest, 1e-3)))),
        profile_px=1.1 * max(profile, 1e-3),
    )


def _largest(model: Residuals) -> float:
    profiles: Sequence[Profile] = (*model.by_radius, *model.by_depth)
    values = np.concatenate([np.abs(p.mean_px) + p.stderr_px for p in profiles])
    return float(np.nanmax(values, initial=0.0))


def _one_digit(value: float) -> float:
    power = 10.0 ** math.floor(math.log10(value))
    return power * math.floor(value / power)


def cost_unit(summary: dict[str, Any]) -> str:
    """Of the root of the cost per observation."""
    errors = {solve["error"] for solve in summary["solves"]}
    return "px" if errors == {"reprojection"} else "m"


def _view_caption(report: Report) -> str:
    view, parts = report.view, []
    shown, count = len(view.points), view.num_all_points
    parts.append(
        f"{count} points; frusta run as the cameras' rays do in the water. z is up: "
        "the plane through the points is level. Move the pointer to a point for its id "
        "and its place in the world; uwsfm measure takes both."
    )
    if shown + view.num_outlying < count:
        parts.append(f"{shown} of them, chosen at random, are drawn.")
    if view.num_outlying:
        parts.append(f"{view.num_outlying} lie far outside and are not drawn.")
    if view.frusta_step > 1:
        parts.append(
            f"Every {view.frusta_step}th frame has its cameras drawn, the trajectory "
            "has all."
        )
    if np.any(view.origin):
        place = ", ".join(f"{value:.0f}" for value in view.origin)
        parts.append(f"The axes begin at ({place}) {report.unit} of the world.")
    return " ".join(parts)


def _pinhole_models(report: Report) -> str:
    models = {c.model for c in report.residuals if c.pinhole is not None}
    others = sorted(models - {"OPENCV"})
    return "COLMAP's OPENCV" + "".join(f" or {model}" for model in others)


def _residual_words(camera: CameraResiduals) -> str:
    ours = camera.refractive
    noise = f"{ours.rms_px:.3g} px RMS"
    if camera.pinhole is None:
        return (
            "There is no pinhole to compare with: this camera has no port, too few "
            "observations, or some that no fitted pinhole projects. "
            f"uwsfm leaves {noise}, of which "
            f"{_systematic(ours.systematic_px)} is systematic.{_freed_words(camera)}"
        )
    theirs = camera.pinhole
    text = (
        f"The pinhole leaves {theirs.rms_px:.3g} px RMS, of which "
        f"{_systematic(theirs.systematic_px)} is systematic by place in the image and "
        f"depth; uwsfm leaves {noise}, of which {_systematic(ours.systematic_px)}."
    )
    if camera.least_central_px is not None:
        rms, most = camera.least_central_px
        text += (
            " Any lens with a single centre, however distorted and exact at the median "
            f"depth, is off by {rms:.2g} px RMS and up to {most:.2g} px at the 10th "
            "and 90th percentile of depth."
        )
    return f"{text}{_freed_words(camera)}"


def _freed_words(camera: CameraResiduals) -> str:
    """What becomes of systematic residuals if the lens may change."""
    freed, ours = camera.freed, camera.refractive
    if freed is None:
        return ""
    text = (
        " Fitted in the same way, lens and placement free behind the port as it is, "
        f"uwsfm's model leaves {freed.rms_px:.3g} px RMS, of which "
        f"{_systematic(freed.systematic_px)}"
    )
    if freed.systematic_px < LENS_SHARE * ours.systematic_px:
        return f"{text}: it is the lens, as given, that does not fit."
    return f"{text}: it is not the lens alone that does not fit."


def _systematic_words(report: Report) -> str:
    """Cameras of which the same is said are told together."""
    cameras: dict[str, list[str]] = {}
    for camera in report.residuals:
        value = camera.refractive.systematic_px
        part = _systematic(value) if math.isfinite(value) else "unknown"
        cameras.setdefault(part, []).append(camera.name)
    parts = [f"{part} in {' and '.join(names)}" for part, names in cameras.items()]
    return (
        "Its systematic part, which repeats at the same place in the image and the "
        f"same depth, is {', '.join(parts)}."
    )


def _systematic(value: float) -> str:
    if not math.isfinite(value):
        return "an unknown part"
    return f"{value:.2g} px" if value >= 0.005 else "less than 0.005 px"


@dataclass(frozen=True)
class _Row:
    name: str
    cells: list[tuple[str, str]]
    """What is sorted by, and what is shown."""


def _frame_rows(report: Report) -> list[_Row]:
    rows = []
    for frame in report.frames:
        counts = (frame.num_images, frame.num_points, frame.num_observations)
        cells = [(str(count), str(count)) for count in counts]
        for error in (frame.mean_error_px, frame.rms_error_px):
            cells.append((f"{error:.6g}", f"{error:.3f}"))
        for value, scale in (
            (frame.position_stddev_m, report.small_scale),
            (frame.rotation_stddev_deg, 1.0),
        ):
            known = math.isfinite(value)
            cells.append(
                (f"{value:.6g}", deviation(value, scale)) if known else ("", "-")
            )
        rows.append(_Row(frame.name, cells))
    return rows


def _payload(report: Report, scales: Scales) -> dict[str, Any]:
    """What the script of the page draws from."""
    return {
        "unit": report.unit,
        "small_unit": report.small_unit,
        "cost_unit": cost_unit(report.summary),
        "solves": report.summary["solves"],
        "residuals": plain(report.residuals),
        "scales": plain(scales),
        "view": _view_payload(report),
        **halves_payload(report.summary),
    }


def _view_payload(report: Report) -> dict[str, Any]:
    view, stddev = report.view, report.small_scale * report.view.stddev_m
    places = np.concatenate([view.points, view.trajectory, *view.frusta])
    low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
    room = 0.03 * max(float((high - low).max()), 1e-6)
    low, high = low - room, high + room
    span = high - low
    return {
        "points": _packed(view.points),
        "colors": base64.b64encode(view.colors.tobytes()).decode("ascii"),
        "error": _packed(view.error_px),
        "stddev": _packed(stddev),
        "limits": {"error": _limits(view.error_px), "stddev": _limits(stddev)},
        "frusta": [_packed(lines) for lines in view.frusta],
        "trajectory": _packed(view.trajectory),
        "names": [frame.name for frame in report.frames],
        "ids": _packed(view.point_idx + 1, "<u4"),
        "axes": view.axes.tolist(),
        "origin": view.origin.tolist(),
        "ranges": np.stack([low, high], axis=1).tolist(),
        "aspect": (span / span.max()).tolist(),
    }


def _packed(values: ArrayLike, kind: str = "<f4") -> str:
    """32-bit numbers, little-endian, as text."""
    return base64.b64encode(np.asarray(values, dtype=kind).tobytes()).decode("ascii")


def _limits(values: ArrayLike) -> list[float]:
    """From zero to what all but a few stay below."""
    known = np.asarray(values, dtype=np.float64)
    known = known[np.isfinite(known)]
    return [0.0, float(np.percentile(known, 95.0)) if len(known) else 1.0]


def _script_json(data: dict[str, Any]) -> str:
    """JSON that may stand inside a script element, whatever its texts are."""
    text = json.dumps(data, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c")
