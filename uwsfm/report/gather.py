"""All numbers of a report, as plain data."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm.calibration.result import Covariance
from uwsfm.colmap.model import Model
from uwsfm.report.left_files import left_files
from uwsfm.report.tables import Estimate, Frame, estimates, frames
from uwsfm.report.view import View, view_of
from uwsfm.report.words import Conclusions, small_lengths, unit_of, verdict_of
from uwsfm.results.verdict_summary import plain
from uwsfm.trust.residuals import FEWEST, CameraResiduals, camera_residuals

PAGE, FOLDER, NUMBERS = "report.html", "report", "report.json"


@dataclass(frozen=True, kw_only=True)
class Coverage:
    """Where in its images a camera has features and observations."""

    name: str
    num_images: int
    features_per_image: float
    """Median."""
    observations_per_image: float
    """Median; of points of the result."""
    empty_share: float
    """Of the image's area without `FEWEST` observations in all images together."""


@dataclass(frozen=True, kw_only=True)
class Report:
    """What the page and the pictures show."""

    title: str
    unit: str
    """Of lengths: "m" or "units"."""
    small_unit: str
    """Of small lengths: "mm", or "units" as well."""
    small_scale: float
    """How many of it a unit is."""
    verdict: Conclusions
    estimates: tuple[Estimate, ...]
    view: View
    residuals: tuple[CameraResiduals, ...]
    coverage: tuple[Coverage, ...]
    frames: tuple[Frame, ...]
    summary: dict[str, Any]
    other_files: tuple[tuple[str, str], ...]
    """Path in the output folder, and what it is."""


def gather(
    model: Model, covariance: Covariance, summary: dict[str, Any], out: Path
) -> Report:
    """Measure everything that a report shows.

    Args:
        model: The result.
        covariance: Of its scene.
        summary: What summary.json holds.
        out: The output folder.
    """
    names = [camera.name for camera in model.rig.cameras]
    residuals = tuple(camera_residuals(model.scene, names))
    small_unit, small_scale = small_lengths(summary)
    return Report(
        title="/".join(out.resolve().parts[-2:]),
        unit=unit_of(summary),
        small_unit=small_unit,
        small_scale=small_scale,
        verdict=verdict_of(summary),
        estimates=estimates(summary),
        view=view_of(model, covariance),
        residuals=residuals,
        coverage=tuple(_coverage(model, names.index(r.name), r) for r in residuals),
        frames=frames(model, covariance),
        summary=summary,
        other_files=left_files(out, FOLDER, small_unit, small_scale),
    )


def _coverage(model: Model, camera: int, found: CameraResiduals) -> Coverage:
    scene = model.scene
    mine = scene.frame_idx[scene.camera_idx == camera]
    seen = np.bincount(mine, minlength=scene.num_frames)
    there = [model.has_image(camera, frame) for frame in range(scene.num_frames)]
    features = [len(points) for points in model.keypoints[camera] if len(points)]
    return Coverage(
        name=found.name,
        num_images=int(np.count_nonzero(there)),
        features_per_image=float(np.median(features)),
        observations_per_image=float(np.median(seen[there])),
        empty_share=float(np.mean(found.counts < FEWEST)),
    )


def numbers_of(report: Report) -> dict[str, Any]:
    """What report.json holds: everything but the cloud itself."""
    fields = {
        name: plain(getattr(report, name))
        for name in ("title", "unit", "verdict", "estimates", "residuals")
    }
    return {
        **fields,
        "coverage": plain(report.coverage),
        "frames": plain(report.frames),
        "convergence": report.summary["solves"],
        "timings_s": report.summary["timings_s"],
        "versions": report.summary["versions"],
        "command": report.summary.get("command"),
    }
