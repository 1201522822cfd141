"""What errors of the given numbers would do, and how large such errors are."""

import json
from pathlib import Path

import cv2
import numpy as np

from uwsfm import CalibrationResult, error_budget


def budget_table(calibration: CalibrationResult) -> str:
    """Shifts of tilts and distances when a given number is wrong by one deviation."""
    *rows, total = error_budget(calibration)
    lines = [
        "| if this were wrong | by | left: tilt deg | distance mm | right: tilt "
        "| distance |",
        "|---|---|---|---|---|---|",
    ]
    for row in (*rows, total):
        cells = []
        sign = "" if row is total else "+"
        for shift in row.shifts:
            cells += [f"{shift.tilt_deg:.2f}", f"{1e3 * shift.distance_m:{sign}.1f}"]
        lines.append(f"| {row.name} | {row.amount} | {' | '.join(cells)} |")
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
