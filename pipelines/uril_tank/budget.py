"""What errors of the given numbers would do to the estimates: solved again."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

import uwsfm
from uwsfm.colmap import Model
from uwsfm.models.refractive import RefractiveCamera


def _changed(camera: RefractiveCamera, name: str) -> RefractiveCamera:
    lens, port = camera.camera, camera.port
    params = np.array(lens.params, dtype=float)
    if name == "focal length +0.1 %":
        params[:2] *= 1.001
    elif name == "principal point +1 px in x":
        params[2] += 1.0
    elif name == "principal point +1 px in y":
        params[3] += 1.0
    elif name == "water index +0.001":
        port = replace(port, n_water=port.n_water + 0.001)
    elif name == "glass +1 mm":
        port = replace(port, thickness=port.thickness + 1e-3)
    else:
        raise ValueError(name)
    changed = pycolmap.Camera(
        model=lens.model_name, width=lens.width, height=lens.height, params=params
    )
    return RefractiveCamera(changed, port)


def error_budget(model: Model, refine_cam_from_rig: bool) -> str:
    """Shifts of tilts and distances when a given number is wrong in both cameras."""
    options = {"loss": "l2", "refine_cam_from_rig": refine_cam_from_rig}
    base = uwsfm.calibrate(model.scene, **options).scene
    lines = [
        "| if this were so | left: tilt deg | distance mm | right: tilt | distance |",
        "|---|---|---|---|---|",
    ]
    for name in (
        "focal length +0.1 %",
        "principal point +1 px in x",
        "principal point +1 px in y",
        "water index +0.001",
        "glass +1 mm",
    ):
        cameras = tuple(_changed(camera, name) for camera in base.cameras)
        moved = uwsfm.calibrate(replace(base, cameras=cameras), **options).scene
        cells = []
        for old, new in zip(base.ports, moved.ports, strict=True):
            tilt = np.degrees(np.arccos(min(1.0, np.dot(old.normal, new.normal))))
            cells += [f"{tilt:.2f}", f"{1e3 * (new.distance - old.distance):+.1f}"]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def recalibration(data: Path) -> str:
    """How far a second calibration from the same boards in air is from the first."""
    lens = json.loads((data / "in_air_calibration.json").read_text())
    corners = np.load(data / "in_air_corners.npz")
    columns, rows = corners["board_inner"]
    grid = np.zeros((rows * columns, 3), np.float32)
    grid[:, :2] = float(corners["square_mm"]) * np.mgrid[:columns, :rows].T.reshape(
        -1, 2
    )
    parts = []
    for side in ("left", "right"):
        found = corners[f"land_v1_{side[0].upper()}"]
        views = [view.reshape(-1, 1, 2) for view in found]
        _, matrix, *_ = cv2.calibrateCamera(
            [grid] * len(views),
            views,
            tuple(lens["image_size"]),
            None,
            None,
            flags=cv2.CALIB_FIX_K3,
        )
        given = np.array(lens[f"K_{side}"])
        focal = 100.0 * (matrix[0, 0] / given[0, 0] - 1.0)
        shift = matrix[:2, 2] - given[:2, 2]
        parts.append(
            f"{side}: focal length {focal:+.1f} %, principal point "
            f"({shift[0]:+.1f}, {shift[1]:+.1f}) px"
        )
    return "A new calibration from the same boards in air: " + "; ".join(parts)
