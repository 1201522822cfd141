"""What a job checks before it reads an image: the rig, and options without effect."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from uwsfm.calibration.parameters import PARAMETERS
from uwsfm.calibration.problem import LENS_REFINED, CalibrateOptions
from uwsfm.errors import InputError
from uwsfm.options.jobs import CalibrateHousingOptions, ReconstructOptions
from uwsfm.rig.file import load_rig
from uwsfm.rig.rig import Rig
from uwsfm.trust.reason import DOES_NOT_FIT

FromImages = TypeVar("FromImages", ReconstructOptions, CalibrateHousingOptions)


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
    """Rough distance of a single camera's scene, metres; 1 if none is given.

    Raises:
        InputError: the rig has a baseline, which determines it.
    """
    if given_m is None:
        return 1.0
    if len(rig.cameras) > 1:
        raise InputError(
            "--scene-distance (scene_distance_m) has no effect: the baseline of the "
            "rig gives the scale; leave this option out"
        )
    return given_m


def at_scene_distance(options: FromImages, rig: Rig) -> FromImages:
    """Options whose front end begins at the distance of the scene that is given.

    Raises:
        InputError: as `scene_distance`.
    """
    given_m = options.constraints.scene_distance_m
    if given_m is None:
        return options
    front_end = replace(
        options.front_end, scene_distance_m=scene_distance(rig, given_m)
    )
    return replace(options, front_end=front_end)


def require_effect(fields: Mapping[str, Any]) -> None:
    """Refuse what is known of a number that is not refined.

    Args:
        fields: of `CalibrateOptions`, by name.

    Raises:
        InputError: one has no effect, or `CalibrateOptions` refuses it.
    """
    options = CalibrateOptions.parsed(dict(fields))
    for each in PARAMETERS:
        if each.prior is None or each.refine is None:
            continue
        wanted = np.any(getattr(options, each.refine.field))
        if options.prior(each) is not None and not wanted:
            raise InputError(
                f"{each.prior.field} has no effect: the {each.name} is not refined"
            )
    correlated = options.given is not None and options.given.correlated_prior
    if correlated and not any(np.any(getattr(options, name)) for name in LENS_REFINED):
        raise InputError(
            "accuracy.lens_prior: correlated has no effect: no lens parameter is "
            "refined; add --refine focal, say, or leave this key out"
        )
