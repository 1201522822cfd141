"""What may be chosen of a calibration, by name: light, for the command line."""

from typing import Literal

Strategy = Literal["joint", "nested"]
ErrorName = Literal[
    "reprojection", "virtual_camera", "virtual_camera_tangential", "point_3d"
]
Refinable = Literal["water-index", "focal", "principal-point", "distortion"]
"""What may be refined besides ports and poses: ``refine_...`` of `CalibrateOptions`."""

DEFAULT_ERRORS: dict[str, ErrorName] = {
    "joint": "reprojection",
    "nested": "virtual_camera",
}
"""Strategies, and what they minimise (nested: in its outer loop) by default."""

PRIORS = (
    "distance_stddev_m",
    "normal_stddev_deg",
    "center_stddev_m",
    "water_index_stddev",
    "focal_stddev",
    "principal_point_stddev_px",
    "distortion_stddev",
)
"""Fields of `CalibrateOptions` that say how well a refined number is known before."""
