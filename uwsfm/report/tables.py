"""Estimates and frames of a report, as rows."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm._indices import distinct
from uwsfm.calibration.problem import Covariance
from uwsfm.colmap import Model
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.report.words import (
    deviation,
    rounded,
    small_lengths,
    tilts_deg,
)
from uwsfm.scene import IndexArray


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """One number, as it is printed."""

    group: str
    """Camera, or what else the number is of."""
    name: str
    value: str
    stddev: str
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
    """Of the rig's centre relative to the first frame, root sum of three axes."""
    rotation_stddev_deg: float


def estimates(summary: dict[str, Any]) -> tuple[Estimate, ...]:
    """Ports, placement and all that was refined beside them."""
    rows: list[Estimate] = []
    for index, camera in enumerate(summary["cameras"]):
        rows += _port(camera, summary)
        if index:
            rows += _placement(camera, summary)
    return (*rows, *_refined(summary))


def _port(camera: dict[str, Any], summary: dict[str, Any]) -> list[Estimate]:
    (unit, scale), group = small_lengths(summary), camera["name"]
    if camera["port"] == "none":
        return [_row(group, "port", "none", "", "", "given")]
    if camera["port"] == "dome":
        rows = [
            _number(group, f"dome centre {axis}", value, stddev, unit, word, scale)
            for axis, value, stddev, word in zip(
                "xyz",
                camera["center_m"],
                camera["center_stddev_m"],
                [camera["center_verdict"]] * 3,
                strict=True,
            )
        ]
        rows.append(_given(group, "dome radius", 1e3 * camera["radius_m"], "mm"))
    else:
        stddev, word = camera["normal_stddev_deg"], camera["normal_verdict"]
        rows = [
            _number(group, f"port tilt {axis}", value, stddev, "deg", word)
            for axis, value in zip("xy", tilts_deg(camera["normal"]), strict=True)
        ]
        distance, stddev = camera["distance_m"], camera["distance_stddev_m"]
        word = camera["distance_verdict"]
        rows.append(
            _number(group, "port distance", distance, stddev, unit, word, scale)
        )
    rows.append(_given(group, "glass thickness", 1e3 * camera["thickness_m"], "mm"))
    rows.append(_given(group, "glass index", camera["glass_index"], ""))
    if not any(row["name"].startswith("water index") for row in summary["refined"]):
        rows.append(_given(group, "water index", camera["water_index"], ""))
    return rows


def _placement(camera: dict[str, Any], summary: dict[str, Any]) -> list[Estimate]:
    pose, group = camera["cam_from_rig"], camera["name"]
    (unit, scale), turn_stddev = small_lengths(summary), pose["rotation_stddev_deg"]
    turn = np.degrees(rigid3.rotvec_from_quat(pose["rotation_xyzw"])).tolist()
    rows = [
        _number(group, f"cam_from_rig turn {axis}", value, turn_stddev, "deg")
        for axis, value in zip("xyz", turn, strict=True)
    ]
    place = pose["translation_m"], pose["translation_stddev_m"]
    rows += [
        _number(group, f"cam_from_rig shift {axis}", value, stddev, unit, scale=scale)
        for axis, value, stddev in zip("xyz", *place, strict=True)
    ]
    return rows


def _refined(summary: dict[str, Any]) -> list[Estimate]:
    """What `refined_summary` lists: its names end in " of CAMERA" or stand alone."""
    rows = []
    for entry in summary["refined"]:
        name, _, group = entry["name"].partition(" of ")
        scale, unit = 1.0, ""
        if group.endswith(" (m)"):
            group, scale, unit = group[:-4], 1e3, "mm"
        if name in ("f", "fx", "fy", "cx", "cy"):
            unit = "px"
        rows.append(
            _number(
                group or "all",
                name,
                entry["value"],
                entry["stddev"],
                unit,
                "not determined" if entry["stddev"] is None else "refined",
                scale,
            )
        )
    return rows


def _number(
    group: str,
    name: str,
    value: float,
    stddev: float | None,
    unit: str,
    word: str | None = None,
    scale: float = 1.0,
) -> Estimate:
    if word is None:
        word = "held" if stddev is None else "refined"
    value_text, text = rounded(value, stddev, scale), deviation(stddev, scale)
    return _row(group, name, value_text, text, unit, word)


def _given(group: str, name: str, value: float, unit: str) -> Estimate:
    return _row(group, name, f"{value:.6g}", "-", unit, "given")


def _row(
    group: str, name: str, value: str, stddev: str, unit: str, word: str
) -> Estimate:
    return Estimate(
        group=group, name=name, value=value, stddev=stddev, unit=unit, word=word
    )


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
    turn, place = frame_stddevs(covariance)
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


def frame_stddevs(covariance: Covariance) -> tuple[Array, Array]:
    """Standard deviations (F,) of the frames' angles, degrees, and centres, metres.

    The centre is -R^T t: a step v of the left tangent's translation moves it by -R^T v,
    which is as long, and one of its rotation not at all.
    """
    variances = np.einsum("faa->fa", covariance.frames)
    turn = np.degrees(np.sqrt(variances[:, :3].sum(axis=1)))
    return turn, np.sqrt(variances[:, 3:].sum(axis=1))


def _distinct(groups: IndexArray, values: IndexArray, count: int) -> NDArray[Any]:
    """How many different values each group has (count,)."""
    size = int(values.max(initial=0)) + 1
    pairs = distinct(groups * size + values)
    return np.bincount(pairs // size, minlength=count)
