"""The rig that mapping begins with: checked, turned to fit its images, as pinholes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.rig_checks.pinhole_fit import VirtualPinhole, fit_virtual_pinhole
from uwsfm.sfm.rig_checks.rig_check import check_rig, check_rotation, turn_causes
from uwsfm.sfm.rig_checks.rig_rotation import (
    RigRotation,
    correct_rotations,
    scene_depths,
)
from uwsfm.sfm.rig_checks.stereo_matches import (
    PairMatches,
    read_same_frame_matches,
    read_successive_matches,
)

NEAR_TO_FAR = (0.7, 1.0, 1.4)
"""Depths of the scene of a single camera, by its distance: nothing measures them."""


@dataclass(frozen=True, kw_only=True)
class FixedRig:
    """The rig as a mapper begins with it."""

    given: Array
    """(C, 7) cam_from_rig before any turn."""
    rotation: RigRotation
    depths: Array
    pinholes: tuple[VirtualPinhole, ...]
    num_matches: int
    turn_causes: Mapping[int, str]
    """As of `rig_check.turn_causes`."""


def fix_rig(
    rig: Rig,
    poses: Array,
    frames: Frames,
    features_path: Path,
    scene_distance_m: float,
) -> FixedRig:
    """Check the rig against its images, turn it to fit them, and fit the pinholes.

    Args:
        rig: Lenses and initial ports.
        poses: (C, 7) of its cameras.
        frames: The images.
        features_path: Database with keypoints and raw matches.
        scene_distance_m: Of the scene of a single camera, about.

    Raises:
        InputError: the rig contradicts the matches.
    """
    cameras = rig.refractive_cameras()
    pairs = read_same_frame_matches(features_path, frames, rig)

    def shifted(shift: int) -> list[PairMatches]:
        return read_same_frame_matches(features_path, frames, rig, shift)

    def successive() -> list[PairMatches]:
        return read_successive_matches(features_path, frames, rig)

    if len(cameras) > 1:
        check_rig(rig, poses, pairs, shifted, successive)
    rotation = correct_rotations(cameras, poses, pairs)
    causes: Mapping[int, str] = {}
    if len(cameras) > 1:
        check_rotation(rig, poses, rotation, pairs, shifted)
        causes = turn_causes(rig, poses, rotation, pairs, shifted)
        depths = scene_depths(cameras, rotation.cam_from_rig, pairs)
    else:
        depths = scene_distance_m * np.array([NEAR_TO_FAR])
    pinholes = tuple(
        fit_virtual_pinhole(camera, depths[c]) for c, camera in enumerate(cameras)
    )
    return FixedRig(
        given=poses,
        rotation=rotation,
        depths=depths,
        pinholes=pinholes,
        num_matches=sum(len(pair) for pair in pairs),
        turn_causes=causes,
    )


def turned_to(fixed: FixedRig, cam_from_rig: Array) -> FixedRig:
    """The same, with the turns (C,) that a mapper which moves the ports ended with."""
    turns = rigid3.compose(cam_from_rig, rigid3.inverse(fixed.given))
    turn_deg = np.degrees(rigid3.rotation_angle(turns))
    return replace(fixed, rotation=replace(fixed.rotation, turn_deg=turn_deg))


def mapping_summary(
    rig: Rig,
    frames: Frames,
    fixed: FixedRig,
    registered: Set[str],
    others: Sequence[int],
) -> dict[str, Any]:
    """What there is to say of any mapper.

    Args:
        rig: Its names.
        frames: All of them.
        fixed: The rig as the mapper began with it.
        registered: Names of frames.
        others: Numbers of frames of the smaller models.
    """
    missing = [name for name in frames.names if name not in registered]
    warnings = frames.warnings() + fixed.rotation.warnings(rig, fixed.turn_causes)
    if missing:
        warnings.append(
            f"{len(missing)} of {len(frames.names)} frames could not be registered: "
            f"{', '.join(missing[:10])}{' ...' if len(missing) > 10 else ''}"
        )
    if others:
        warnings.append(
            f"smaller models were left out ({len(others)}), of "
            f"{', '.join(str(size) for size in others[:10])} frames"
        )
    focal = float(np.mean([pinhole.focal_px for pinhole in fixed.pinholes]))
    return {
        "num_frames": len(frames.names),
        "num_registered_frames": len(registered),
        "unregistered_frames": missing,
        "other_model_frames": list(others),
        "num_same_frame_matches": fixed.num_matches,
        "depth_percentiles_m": fixed.depths.tolist(),
        "rig_turn_deg": fixed.rotation.turn_deg.tolist(),
        "same_frame_misfit_px": {
            "before_turn": focal * fixed.rotation.misfit_before,
            "after_turn": focal * fixed.rotation.misfit_after,
        },
        "pinhole_rms_px": [pinhole.rms_px for pinhole in fixed.pinholes],
        "pinhole_max_px": [pinhole.max_px for pinhole in fixed.pinholes],
        "warnings": warnings,
    }
