"""What a job checks before it reads an image: the rig, and options without effect."""

from pathlib import Path

import numpy as np

from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.errors import InputError
from uwsfm.rig import Rig
from uwsfm.rig_file import load_rig
from uwsfm.trust.reason import DOES_NOT_FIT


def checked_rig(rig: Rig | str | Path) -> Rig:
    """A rig, or that of a rig file, whose lenses can be projected.

    Raises:
        InputError: the file or a lens is wrong, or the rig is the estimate of a result
            that does not fit its images.
    """
    file = ""
    if not isinstance(rig, Rig):
        file, rig = f"{rig}: ", load_rig(rig)
    if rig.verdict == DOES_NOT_FIT:
        raise InputError(
            f"{file}verdict: does not fit: this rig is the estimate of a result that "
            "does not fit its images, so its numbers are wrong; find the mistake in "
            "that result with uwsfm check, and start from the rig file of that"
        )
    for camera, refractive in zip(rig.cameras, rig.refractive_cameras(), strict=True):
        try:
            _ = refractive.lens
        except InputError as error:
            raise InputError(f"camera {camera.name!r}: {error}") from None
    return rig


def scene_distance(rig: Rig, given_m: float | None) -> float:
    """How far away the scene of a single camera is, about, metres; 1 if nobody knows.

    Raises:
        InputError: it is not positive, or the rig has a baseline, which tells.
    """
    if given_m is None:
        return 1.0
    if len(rig.cameras) > 1:
        raise InputError(
            "--scene-distance (scene_distance_m) has no effect: the baseline of the "
            "rig gives the scale; leave this option out"
        )
    if not 0.0 < given_m < np.inf:
        raise InputError(
            "--scene-distance (scene_distance_m) must be positive and finite, "
            f"got {given_m}"
        )
    return given_m


def require_effect(options: CalibrateOptions) -> None:
    """Refuse what is known of a number that is not refined."""
    refined = {
        "distance_stddev_m": ("the distance of a port", options.refine_distances),
        "normal_stddev_deg": ("the normal of a port", options.refine_normals),
        "center_stddev_m": ("the centre of a dome", options.refine_centers),
        "water_index_stddev": ("the water index", options.refine_water_index),
        "focal_stddev": ("the focal length", options.refine_focal),
        "principal_point_stddev_px": (
            "the principal point",
            options.refine_principal_point,
        ),
        "distortion_stddev": ("the distortion", options.refine_distortion),
    }
    for name, (what, wanted) in refined.items():
        if getattr(options, name) is not None and not np.any(wanted):
            raise InputError(f"{name} has no effect: {what} is not refined")
    lens = (
        options.refine_focal,
        options.refine_principal_point,
        options.refine_distortion,
    )
    correlated = options.given is not None and options.given.correlated_prior
    if correlated and not any(np.any(flags) for flags in lens):
        raise InputError(
            "accuracy.lens_prior: correlated has no effect: no lens parameter is "
            "refined; add --refine focal, say, or leave this key out"
        )
