"""What may be chosen of a calibration, by name: light, for the command line."""

from typing import Literal

Strategy = Literal["joint", "nested"]
ErrorName = Literal[
    "reprojection", "virtual_camera", "virtual_camera_tangential", "point_3d"
]

DEFAULT_ERRORS: dict[str, ErrorName] = {
    "joint": "reprojection",
    "nested": "virtual_camera",
}
"""Strategies, and what they minimise (nested: in its outer loop) by default."""
