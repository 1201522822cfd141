"""Each mistake that people make, undone: a rig and observations to try.

Those of the rig file alone are in `uwsfm.sfm.rig_mistakes`, where refusals find them;
here are the others: what is wrong with the images, and numbers that are set free.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.rig_mistakes import Correction, corrected_pixels, corrections

SHIFTS = (1, -1, 2, -2, 3, -3)
"""Frames that one camera may be late or early."""
MIN_FRAMES_LEFT = 3
"""On each side of a frame from which on something changed."""


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One explanation: a rig, observations, and what may move."""

    code: str
    what: str
    """Half a sentence: what would then be true."""
    remedy: str
    rig: Rig
    seen: Callable[[Scene], Scene] = lambda scene: scene
    """The observations put right, and poses to start from."""
    options: dict[str, Any] = field(default_factory=dict)
    """Further fields of `CalibrateOptions`."""


def trials(rig: Rig, num_frames: int) -> Iterator[Trial]:
    """Every mistake, singly.

    Args:
        rig: As given.
        num_frames: Of the observations.
    """
    for correction in corrections(rig):
        yield _of_correction(correction)
    yield from _free_lenses(rig)
    yield from shifts(rig, 0, num_frames)


def _of_correction(correction: Correction) -> Trial:
    return Trial(
        code=correction.code,
        what=correction.what,
        remedy=correction.remedy,
        rig=correction.rig,
        seen=lambda scene: _corrected(scene, correction),
    )


def _corrected(scene: Scene, correction: Correction) -> Scene:
    if correction.exchanged is False and correction.flipped is None:
        return scene
    sizes = np.array([(c.width, c.height) for c in scene.cameras])
    camera, xy = corrected_pixels(correction, sizes, scene.camera_idx, scene.xy)
    poses = scene.rig_from_world
    if correction.exchanged:
        poses = rigid3.compose(scene.cam_from_rig[1], poses)
    if correction.flipped is not None:
        poses = _mirrored(poses, correction.flipped)
    return replace(scene, camera_idx=camera, xy=xy, rig_from_world=poses)


def _mirrored(poses: Array, axis: int) -> Array:
    """Poses (F, 7) in a world that is mirrored as the images are."""
    signs = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    signs[axis] = 1.0
    signs[4 + axis] = -1.0
    return poses * signs


FOCAL = {"refine_focal": True, "focal_stddev": 0.5}
CENTER = {"refine_principal_point": True, "principal_point_stddev_px": 200.0}
LENS = {
    **FOCAL,
    **CENTER,
    "refine_distortion": True,
    "distortion_stddev": 0.5,
}
"""Priors that hold nothing but what no image shows."""


def _free_lenses(rig: Rig) -> Iterator[Trial]:
    names = " and ".join(repr(camera.name) for camera in rig.cameras)
    yield Trial(
        code="focal",
        what=f"another focal length of {names}",
        remedy="check fx and fy: were they calibrated with this zoom, focus and video "
        "mode, and at this image size?",
        rig=rig,
        options=FOCAL,
    )
    yield Trial(
        code="principal_point",
        what=f"another principal point of {names}",
        remedy="check cx and cy: was the lens calibrated with another crop, image size "
        "or pixel origin?",
        rig=rig,
        options=CENTER,
    )


def shifts(rig: Rig, first: int, num_frames: int) -> Iterator[Trial]:
    """One camera late or early by some frames, from a frame on."""
    since = f" from frame {first + 1} on" if first else ""
    for camera in range(1, len(rig.cameras)):
        name = rig.cameras[camera].name
        for shift in SHIFTS:
            if num_frames - first - abs(shift) < MIN_FRAMES_LEFT:
                continue
            way = "late" if shift < 0 else "early"
            count = f"{abs(shift)} frame{'s' if abs(shift) > 1 else ''}"
            yield Trial(
                code="frames_shifted",
                what=f"the images of {name!r} are {count} {way}{since}",
                remedy="pair the images anew: images of equal names must be taken "
                "together, and one may be missing",
                rig=rig,
                seen=lambda scene, c=camera, k=shift: shifted(scene, c, k, first),
            )


def shifted(scene: Scene, camera: int, shift: int, first: int) -> Scene:
    """A scene in which the images of one camera belong to other frames."""
    late = (scene.camera_idx == camera) & (scene.frame_idx >= first)
    frame = np.where(late, scene.frame_idx + shift, scene.frame_idx)
    inside = (frame >= 0) & (frame < scene.num_frames)
    moved = replace(scene, frame_idx=np.clip(frame, 0, scene.num_frames - 1))
    return moved.select(inside)[0]
