"""Estimates and frames of a report, as rows."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.indices import distinct
from uwsfm.calibration.parameter import Parameter
from uwsfm.calibration.parameters import (
    BASELINE,
    GLASS_INDEX,
    LENS,
    OF_PORTS,
    THICKNESS,
    WATER_INDEX,
)
from uwsfm.calibration.result import Covariance
from uwsfm.colmap.model import Model
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import kind_of_word
from uwsfm.report.words import (
    deviation,
    rounded,
    small_lengths,
    tilts_of,
    unit_of,
)
from uwsfm.results.refined import listed
from uwsfm.scene import IndexArray


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One number, as it is printed."""

    group: str
    """Camera, or what else the number is of."""
    name: str
    value: str
    stddev: str
    """From the images."""
    stddev_in_all: str
    """With the errors of what was given."""
    unit: str
    word: str
    """Whether the images determine it; "given", "held"."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """What is known of one frame."""

    name: str
    num_images: int
    """With a point of the result."""
    num_points: int
    num_observations: int
    mean_error_px: float
    rms_error_px: float
    position_stddev_m: float
    """Of the rig's centre relative to the first frame, in all, root sum of three
    axes."""
    rotation_stddev_deg: float


def estimates(summary: dict[str, Any]) -> tuple[Estimate, ...]:
    """Ports, placement and all that was refined beside them."""
    rows: list[Estimate] = []
    for index, camera in enumerate(summary["cameras"]):
        rows += _port(camera, summary)
        if index:
            rows += _placement(camera, summary)
    return (*rows, *_refined(summary))


_Both = tuple[float | None, float | None]
"""Standard deviations from the images and in all."""


def _port(camera: dict[str, Any], summary: dict[str, Any]) -> list[Estimate]:
    (unit, scale), group = small_lengths(summary), camera["name"]
    kind = kind_of_word(camera["port"])
    if not kind.refracts:
        return [_row(group, "port", kind.word, ("", ""), "", "given")]
    rows: list[Estimate] = []
    if kind.has("center"):
        both = zip(
            camera["center_stddev_m"], camera["center_stddev_in_all_m"], strict=True
        )
        word = camera["center_verdict"]
        rows += [
            _number(group, f"dome centre {axis}", value, stddevs, (unit, scale), word)
            for axis, value, stddevs in zip(
                "xyz", camera["center_m"], both, strict=True
            )
        ]
    if kind.has("normal"):
        word = camera["normal_verdict"]
        rows += [
            _number(group, f"port tilt {axis}", value, (own, total), ("deg", 1.0), word)
            for axis, (value, own, total) in zip("xy", tilts_of(camera), strict=True)
        ]
        for name, key in (("azimuth phi", "azimuth"), ("tilt theta", "tilt")):
            known = camera[f"{key}_stddev_deg"], camera[f"{key}_stddev_in_all_deg"]
            value = camera[f"{key}_deg"]
            rows.append(
                _number(group, f"port {name}", value, known, ("deg", 1.0), word)
            )
        known = camera["distance_stddev_m"], camera["distance_stddev_in_all_m"]
        word = camera["distance_verdict"]
        rows.append(
            _number(
                group, "port distance", camera["distance_m"], known, (unit, scale), word
            )
        )
    return rows + [
        _given(group, each, camera)
        for each in OF_PORTS
        if each.listed and each.of(kind)
        if not was_refined(summary, each, group)
    ]


def _placement(camera: dict[str, Any], summary: dict[str, Any]) -> list[Estimate]:
    pose, group = camera["cam_from_rig"], camera["name"]
    turn = np.degrees(rigid3.rotvec_from_quat(pose["rotation_xyzw"])).tolist()
    none = 3 * [None]  # of an earlier version
    known = (pose.get(f"turn_xyz_stddev{kind}_deg", none) for kind in ("", "_in_all"))
    rows = [
        _number(group, f"cam_from_rig turn {axis}", value, (own, total), ("deg", 1.0))
        for axis, value, own, total in zip("xyz", turn, *known, strict=True)
    ]
    place = pose["translation_m"], pose["translation_stddev_m"]
    small = small_lengths(summary)
    rows += [
        _number(group, f"cam_from_rig shift {axis}", value, (stddev, total), small)
        for axis, value, stddev, total in zip(
            "xyz", *place, pose["translation_stddev_in_all_m"], strict=True
        )
    ]
    return rows


def _refined(summary: dict[str, Any]) -> list[Estimate]:
    """What `refined_summary` lists: its names end in " of CAMERA" or stand alone."""
    rows = []
    for entry in summary["refined"]:
        parameter, name, group = listed(entry["name"])
        word = "not determined" if entry["stddev"] is None else "refined"
        rows.append(
            _number(
                group or "all",
                name,
                entry["value"],
                (entry["stddev"], entry["stddev_in_all"]),
                (parameter.unit.name, parameter.unit.per),
                entry.get("verdict", word),
            )
        )
    return rows


def was_refined(summary: dict[str, Any], parameter: Parameter, camera: str) -> bool:
    """Whether a number of a camera, or one that all cameras share, was refined."""
    return any(
        of is parameter and group in ("", camera)
        for of, _, group in (listed(entry["name"]) for entry in summary["refined"])
    )


def held_words(summary: dict[str, Any]) -> str:
    """What standard deviations from the images take as given."""
    refined = [listed(entry["name"])[0] for entry in summary["refined"]]
    lens = any(each in LENS for each in refined)
    held = ["what is held of the lens in air" if lens else "the lens in air"]
    glass = [each for each in (THICKNESS, GLASS_INDEX) if each not in refined]
    held += ["the glass"] if len(glass) == 2 else [f"the {p.name}" for p in glass]
    held += ["the water index"] if WATER_INDEX not in refined else []
    if summary["baseline_m"] is not None and BASELINE not in refined:
        held.append("the baseline")
    return " and ".join(filter(None, [", ".join(held[:-1]), held[-1]]))


def _number(
    group: str,
    name: str,
    value: float,
    stddevs: _Both,
    unit: tuple[str, float],
    word: str | None = None,
) -> Estimate:
    """Args:
    unit: its name, and how many of it a unit of the summary is.
    """
    if word is None:
        word = "held" if stddevs[0] is None else "refined"
    text, scale = unit
    value_text = rounded(value, stddevs[0] or stddevs[1], scale)
    own, total = (deviation(stddev, scale) for stddev in stddevs)
    return _row(group, name, value_text, (own, total), text, word)


def _given(group: str, parameter: Parameter, camera: dict[str, Any]) -> Estimate:
    assert parameter.accuracy is not None
    unit, value = parameter.unit, camera[parameter.accuracy.key]
    text = f"{unit.per * value:.6g}"
    return _row(group, parameter.name, text, ("-", "-"), unit.name, "given")


def _row(
    group: str, name: str, value: str, stddevs: tuple[str, str], unit: str, word: str
) -> Estimate:
    return Estimate(
        group=group,
        name=name,
        value=value,
        stddev=stddevs[0],
        stddev_in_all=stddevs[1],
        unit=unit,
        word=word,
    )


@dataclass(frozen=True, kw_only=True)
class BudgetLine:
    """One given number, and what one standard deviation of it would do."""

    name: str
    amount: str
    source: str
    """"given", "assumed" or "prior"."""
    effects: tuple[str, ...]
    """In the columns of `budget_columns`."""


def budget_columns(summary: dict[str, Any]) -> tuple[str, ...]:
    """What the error budget has columns of."""
    unit, columns = small_lengths(summary)[0], []
    for camera in summary["cameras"]:
        name = camera["name"]
        if "normal" in camera:
            columns += [f"{name}: tilt (deg)", f"{name}: distance ({unit})"]
        if "center_m" in camera:
            columns.append(f"{name}: centre ({unit})")
    return (*columns, "lengths (%)")


def lengths_note(summary: dict[str, Any]) -> str:
    """Why the budget has no errors of lengths; empty if it has."""
    if unit_of(summary) != "units":
        return ""
    return "Lengths have no errors here, because the scale is arbitrary."


def budget_lines(summary: dict[str, Any]) -> tuple[BudgetLine, ...]:
    """The error budget, the largest effect first and all together last."""
    scale = small_lengths(summary)[1]
    lines = []
    for row in summary.get("error_budget", ()):
        effects = []
        for camera, shift in zip(summary["cameras"], row["cameras"], strict=True):
            if "normal" in camera:
                effects.append(_effect(shift["tilt_deg"], 1.0))
                effects.append(_effect(shift["distance_m"], scale))
            if "center_m" in camera:
                effects.append(", ".join(_effect(v, scale) for v in shift["center_m"]))
        effects.append(_effect(row["scale"], 1e2))
        lines.append(
            BudgetLine(
                name=row["if"],
                amount=row["amount"],
                source=row["deviation"] or "",
                effects=tuple(effects),
            )
        )
    return tuple(lines)


def _effect(value: float | None, scale: float) -> str:
    return "-" if value is None else f"{scale * value:.3g}"


def frames(model: Model, covariance: Covariance) -> tuple[Frame, ...]:
    """One row per frame."""
    scene = model.scene
    errors = model.errors_px()
    known = np.isfinite(errors)
    index, count = scene.frame_idx[known], scene.num_frames
    seen = np.maximum(np.bincount(index, minlength=count), 1)
    mean = np.bincount(index, errors[known], minlength=count) / seen
    square = np.bincount(index, errors[known] ** 2, minlength=count) / seen
    observations = np.bincount(scene.frame_idx, minlength=count)
    points = _distinct(scene.frame_idx, scene.point_idx, count)
    images = _distinct(scene.frame_idx, scene.camera_idx, count)
    in_all = covariance.in_all
    turn, place = frame_stddevs(covariance.frames if in_all is None else in_all.frames)
    return tuple(
        Frame(
            name=name,
            num_images=int(images[f]),
            num_points=int(points[f]),
            num_observations=int(observations[f]),
            mean_error_px=float(mean[f]),
            rms_error_px=math.sqrt(square[f]),
            position_stddev_m=float(place[f]),
            rotation_stddev_deg=float(turn[f]),
        )
        for f, name in enumerate(model.frame_names)
    )


def frame_stddevs(frames: Array) -> tuple[Array, Array]:
    """Standard deviations (F,) of the frames' angles, degrees, and centres, metres, by
    the covariances (F, 6, 6) of their left tangents.

    The centre is -R^T t: a step v of the left tangent's translation moves it by -R^T v,
    which is as long, and one of its rotation not at all.
    """
    variances = np.einsum("faa->fa", frames)
    turn = np.degrees(np.sqrt(variances[:, :3].sum(axis=1)))
    return turn, np.sqrt(variances[:, 3:].sum(axis=1))


def _distinct(groups: IndexArray, values: IndexArray, count: int) -> NDArray[Any]:
    """How many different values each group has (count,)."""
    size = int(values.max(initial=0)) + 1
    pairs = distinct(groups * size + values)
    return np.bincount(pairs // size, minlength=count)
