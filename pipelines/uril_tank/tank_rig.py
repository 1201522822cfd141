"""The rig file of the tank, as a user would write it."""

import json
from pathlib import Path

import numpy as np
import yaml

COVERED_PERCENTILE = 99.5
"""The in-air boards did not reach the image corners: the lens is trusted up to the
radius that this share of their corners lies within."""


def write_rig(data: Path, path: Path, *, whole_image: bool, free_rig: bool) -> None:
    """The rig file a user would write from the calibration in air."""
    lens = json.loads((data / "in_air_calibration.json").read_text())
    corners = np.load(data / "in_air_corners.npz")
    width, height = lens["image_size"]
    cameras = []
    for side in ("left", "right"):
        matrix = np.array(lens[f"K_{side}"])
        found = corners[f"land_v1_{side[0].upper()}"]
        radius = np.linalg.norm(found - matrix[:2, 2], axis=2)
        intrinsics: dict = {
            "opencv": {
                "width_px": width,
                "height_px": height,
                "camera_matrix": matrix.tolist(),
                "distortion": lens[f"D_{side}"],
                "pixel_origin": "opencv",
            }
        }
        if not whole_image:
            limit = float(np.percentile(radius, COVERED_PERCENTILE))
            intrinsics["valid_radius_px"] = round(limit, 1)
        camera = {
            "name": side,
            "images": side,
            "intrinsics": intrinsics,
            # Guesses: acrylic of 5 mm, the port straight and 15 mm from the camera.
            "port": {
                "type": "flat",
                "normal": [0.0, 0.0, 1.0],
                "distance_m": 0.015,
                "thickness_m": 0.005,
                "glass_index": 1.49,
                "refine": ["normal", "distance"],
            },
        }
        if side == "right":
            camera["cam_from_rig"] = {
                "rotation_matrix": lens["R"],
                "translation_m": [value / 1e3 for value in lens["T_mm"]],
            }
        cameras.append(camera)
    rig = {
        "version": 1,
        "water": {"refractive_index": 1.333},
        "refine_cam_from_rig": free_rig,
        "cameras": cameras,
    }
    path.write_text(yaml.safe_dump(rig, sort_keys=False, default_flow_style=None))
