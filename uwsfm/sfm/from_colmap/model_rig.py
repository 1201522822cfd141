"""The rig in a COLMAP model: do its free poses agree on one, and with the rig file?

A model without rig has an arbitrary scale and a relative pose of the cameras in every
frame. Wrong signs, swapped folders and files paired wrongly are quiet there: each image
fits, and nothing else is asked of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.sfm.from_colmap.colmap_model import ImageModel
from uwsfm.sfm.rig_checks.baseline import MAX_FRAMES, robust_average
from uwsfm.sfm.rig_checks.rig_check import (
    MAX_TURN_DEG,
    check_rig,
    check_rotation,
    turn_causes,
)
from uwsfm.sfm.rig_checks.rig_rotation import MIN_RIG_MATCHES, correct_rotations
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches

MAX_SPREAD_DEG = 5.0
"""Median turn of a frame's relative pose against the others'. Free poses of one rig
differ by tenths of a degree; frames paired wrongly, by the motion between them."""
MAX_SPREAD = 1.0
"""The same of the translation, as a fraction of the baseline: with a focal length of
its own per image, distances slide by more than a short baseline (0.27 in a tank)."""
DOUBTFUL_DEG, DOUBTFUL = 15.0, 1.5
"""A frame farther from the others than that has a wrong pose in one of its images."""
MAX_DIRECTION_DEG = 20.0
"""Between the baselines of model and rig file."""
PLAUSIBLY_METRIC = 2.0
"""A model whose baseline is within this factor of the rig's may have been metric."""
NOTABLE_SCALE = 0.05
"""As a fraction: a metric model this much off is worth a word."""
MAX_SCALE_RATIO = 1.5
"""Between the scales that the baselines of a rig of three or more give."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelRig:
    """What a model and a rig file make of the rig together."""

    cam_from_rig: Array
    """(C, 7) metres, to start from: for the real cameras behind their ports."""
    in_model: Array
    """(C, 7) as the poses of the model agree on it, in its unit and for its pinholes;
    from the rig file for cameras that no frame shows with the reference."""
    scale: float
    """Metres per unit of the model."""
    doubtful: NDArray[np.bool_]
    """(C, F) images whose pose contradicts that of the reference in their frame."""
    warnings: tuple[str, ...] = ()
    summary: dict[str, Any] = field(default_factory=dict)


def rig_of_model(
    model: ImageModel, rig: Rig, scene_distance_m: float = 1.0
) -> ModelRig:
    """Average the relative poses of a model, check them, and give them a scale.

    Args:
        model: Its poses.
        rig: Its poses are checked; a baseline alone is completed from the model.
        scene_distance_m: Median depth that the points of a single camera are put at,
            which has no baseline.

    Raises:
        InputError: relative poses that scatter, a rig file that contradicts them, or no
            frame that tells the scale; says what to change.
    """
    if len(rig.cameras) == 1:
        return _single_camera(model, scene_distance_m)
    found = [_Pairs.of(model, rig, camera) for camera in range(1, len(rig.cameras))]
    for pairs in found:
        pairs.require_rigid(model, rig)
    scale, warnings = _scale(found, model, rig)
    in_model = _in_model(found, rig, scale)
    metric = _scaled(in_model, scale)
    start, notes = _checked_start(metric, found, model, rig)
    doubtful = np.zeros(model.registered.shape, dtype=bool)
    for pairs in found:
        doubtful[pairs.camera, pairs.frames[pairs.far]] = True
    return ModelRig(
        cam_from_rig=start,
        in_model=in_model,
        scale=scale,
        doubtful=doubtful,
        warnings=(*warnings, *notes),
        summary={
            "scale_m": scale,
            "baselines": [pairs.length for pairs in found],
            "num_frames_with_both": [len(pairs.frames) for pairs in found],
            "rig_spread_deg": [pairs.spread_deg for pairs in found],
            "rig_spread_of_baseline": [pairs.spread for pairs in found],
        },
    )


def _single_camera(model: ImageModel, scene_distance_m: float) -> ModelRig:
    in_cam = rigid3.transform(
        model.cam_from_world[0, model.frame_idx], model.points[model.point_idx]
    )
    depth = float(np.nanmedian(in_cam[:, 2]))
    if not depth > 0.0:
        raise InputError(f"{model.folder}: most points lie behind the camera")
    scale = scene_distance_m / depth
    return ModelRig(
        cam_from_rig=rigid3.IDENTITY[None],
        in_model=rigid3.IDENTITY[None],
        scale=scale,
        doubtful=np.zeros(model.registered.shape, dtype=bool),
        warnings=(
            f"one camera has no baseline: lengths of the model were multiplied by "
            f"{scale:.4g} to start with, which puts its points {scene_distance_m:g} m "
            "away (median)",
        ),
        summary={"scale_m": scale, "scene_distance_m": scene_distance_m},
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Pairs:
    """Frames that show a camera together with the reference."""

    camera: int
    frames: NDArray[np.int64]
    """(n,) frame index"""
    average: Array | None
    """(7,) cam_from_rig in the unit of the model; None if there is no frame."""
    turn_deg: Array
    """(n,) how far each frame's is from the average."""
    shift: Array
    """(n,) the same of the translation, of the baseline."""

    @classmethod
    def of(cls, model: ImageModel, rig: Rig, camera: int) -> _Pairs:
        frames = np.nonzero(model.registered[0] & model.registered[camera])[0]
        if not len(frames):
            nothing = np.empty(0)
            return cls(
                camera=camera,
                frames=frames,
                average=None,
                turn_deg=nothing,
                shift=nothing,
            )
        poses = rigid3.compose(
            model.cam_from_world[camera, frames],
            rigid3.inverse(model.cam_from_world[0, frames]),
        )
        average = robust_average(poses[:: -(-len(poses) // MAX_FRAMES)])
        length = np.linalg.norm(average[4:])
        if not length > 0.0:
            raise InputError(
                f"{model.folder}: the cameras {rig.cameras[0].name!r} and "
                f"{rig.cameras[camera].name!r} are at the same place: the model has no "
                "baseline"
            )
        between = rigid3.compose(poses, rigid3.inverse(average))
        return cls(
            camera=camera,
            frames=frames,
            average=average,
            turn_deg=np.degrees(rigid3.rotation_angle(between)),
            shift=np.linalg.norm(poses[:, 4:] - average[4:], axis=1) / length,
        )

    @property
    def length(self) -> float | None:
        """Of the baseline, in the unit of the model."""
        return None if self.average is None else float(np.linalg.norm(self.average[4:]))

    @property
    def spread_deg(self) -> float | None:
        return float(np.median(self.turn_deg)) if len(self.frames) else None

    @property
    def spread(self) -> float | None:
        return float(np.median(self.shift)) if len(self.frames) else None

    @property
    def far(self) -> NDArray[np.bool_]:
        """Mask (n,) of the frames whose pose is wrong in one of the images."""
        return (self.turn_deg > DOUBTFUL_DEG) | (self.shift > DOUBTFUL)

    def require_rigid(self, model: ImageModel, rig: Rig) -> None:
        distance = np.maximum(self.turn_deg / MAX_SPREAD_DEG, self.shift / MAX_SPREAD)
        if len(self.frames) < 2 or not np.median(distance) > 1.0:
            return
        names = rig.cameras[0].name, rig.cameras[self.camera].name
        worst = int(distance.argmax())
        raise InputError(
            f"{model.folder}: the pose of {names[1]!r} against {names[0]!r} changes "
            f"from frame to frame, by {self.spread_deg:.1f} degrees and "
            f"{self.spread:.0%} of the baseline (median; worst in "
            f"{model.frame_names[self.frames[worst]]}: {self.turn_deg[worst]:.1f} "
            f"degrees, {self.shift[worst]:.0%}): are the cameras fixed to each other, "
            "and were images of equal names taken at the same time?"
        )


def _scale(
    found: Sequence[_Pairs], model: ImageModel, rig: Rig
) -> tuple[float, list[str]]:
    """Metres per unit of the model, and what to say about it."""
    lengths = [
        float(np.linalg.norm(rig.cam_from_rig[pairs.camera, 4:]))
        if rig.cam_from_rig is not None
        else float(rig.baseline_m or 0.0)
        for pairs in found
    ]
    ratios = [
        length / pairs.length
        for length, pairs in zip(lengths, found, strict=True)
        if pairs.length is not None
    ]
    if not ratios:
        raise InputError(
            f"{model.folder}: no frame has a registered image of "
            f"{rig.cameras[0].name!r} and one of another camera under the same name: "
            "the baseline cannot give the model its scale (images of one frame have "
            f"equal names{_suffix_hint(model)})"
        )
    if max(ratios) > MAX_SCALE_RATIO * min(ratios):
        raise InputError(
            f"{model.folder}: the baselines of the model are not in proportion to "
            "those of the rig file, whose lengths ask for scales of "
            f"{', '.join(f'{ratio:.3g}' for ratio in ratios)}: check translation_m"
        )
    scale = float(np.median(ratios))
    if abs(scale - 1.0) <= NOTABLE_SCALE:
        return scale, []
    note = (
        f"lengths of the model were multiplied by {scale:.4g}, so that its baseline is "
        "that of the rig file"
    )
    if 1.0 / PLAUSIBLY_METRIC < scale < PLAUSIBLY_METRIC:
        note += ": if the model was in metres, one of the two is wrong"
    return scale, [note]


def _suffix_hint(model: ImageModel) -> str:
    """Two frames that would be one but for the suffixes of their images, or ''."""
    of_stem: dict[str, str] = {}
    for name in model.frame_names:
        other = of_stem.setdefault(PurePosixPath(name).stem, name)
        if other != name:
            return (
                f"; {other} and {name} differ by their suffix only: save all images "
                "in one format, or rename them in the model"
            )
    return ""


def _in_model(found: Sequence[_Pairs], rig: Rig, scale: float) -> Array:
    """(C, 7) in the unit of the model; from the rig file where the model has none."""
    poses = [rigid3.IDENTITY]
    for pairs in found:
        if pairs.average is not None:
            poses.append(pairs.average)
        else:  # a rig of two without a common frame was refused for its scale
            assert rig.cam_from_rig is not None
            poses.append(_scaled(rig.cam_from_rig, 1.0 / scale)[pairs.camera])
    return np.stack(poses)


def _checked_start(
    metric: Array, found: Sequence[_Pairs], model: ImageModel, rig: Rig
) -> tuple[Array, list[str]]:
    """Where the real cameras start from: the rig file's poses if they are not refuted.

    What the cameras see in the same frame decides, not the poses of the model, which
    are those of pinholes; unless they share too little.
    """
    if rig.cam_from_rig is None:
        return metric, [
            "cam_from_rig was derived from the poses of the model: the rig file gives "
            "a baseline length only"
        ]
    matches = same_frame_matches(model, rig)
    enough = any(len(pair) >= MIN_RIG_MATCHES for pair in matches)
    notes, poses = [], np.asarray(rig.cam_from_rig)
    if enough:
        check_rig(rig, poses, matches)
        rotation = correct_rotations(rig.refractive_cameras(), poses, matches)
        check_rotation(rig, poses, rotation, matches)
        causes = turn_causes(rig, poses, rotation, matches)
        notes = rotation.warnings(rig, causes)
        if rig.refine_cam_from_rig:
            poses = rotation.cam_from_rig
    for pairs in found:
        sentence = _contradiction(pairs, rig)
        if sentence and not enough:
            raise InputError(f"{model.folder}: {sentence}")
        if sentence:
            notes.append(f"{sentence}, though the images fit the rig file")
    return poses, notes


def same_frame_matches(model: ImageModel, rig: Rig) -> list[PairMatches]:
    """Pixels of the points that two cameras see in the same frame, by pair, as far as
    the calibrations in air reached."""
    keys = model.frame_idx * len(model.points) + model.point_idx
    rows = []
    for index, camera in enumerate(rig.cameras):
        own = np.flatnonzero(model.camera_idx == index)
        rows.append(own[camera.covers(model.xy[own])])
    found = []
    for a, b in combinations(range(len(rows)), 2):
        _, in_a, in_b = np.intersect1d(
            keys[rows[a]], keys[rows[b]], return_indices=True
        )
        row_a, row_b = rows[a][in_a], rows[b][in_b]
        found.append(
            PairMatches(
                camera_a=a,
                camera_b=b,
                frame_idx=model.frame_idx[row_a],
                xy_a=model.xy[row_a],
                xy_b=model.xy[row_b],
            )
        )
    return found


def _contradiction(pairs: _Pairs, rig: Rig) -> str:
    """By how much the poses of the model contradict the rig file, or ''."""
    if pairs.average is None or rig.cam_from_rig is None:
        return ""
    given = rig.cam_from_rig[pairs.camera]
    turn, swing = _differences(pairs.average, given)
    if turn <= MAX_TURN_DEG and swing <= MAX_DIRECTION_DEG:
        return ""
    name = rig.cameras[pairs.camera].name
    sentence = (
        f"cam_from_rig of {name!r} in the rig file is turned by {turn:.1f} degrees "
        f"against the poses of the model, and its baseline by {swing:.0f}"
    )
    turn, swing = _differences(pairs.average, rigid3.inverse(given))
    if turn <= MAX_TURN_DEG and swing <= MAX_DIRECTION_DEG:
        sentence += (
            ": probably it is inverted (x_in_cam = R x_in_rig + translation_m), or the "
            f"folders {rig.cameras[0].images!r} and "
            f"{rig.cameras[pairs.camera].images!r} are swapped"
        )
    return sentence


def _differences(pose_a: Array, pose_b: Array) -> tuple[float, float]:
    """Degrees between the rotations of two poses (7,), and between their baselines."""
    turn = rigid3.rotation_angle(rigid3.compose(pose_a, rigid3.inverse(pose_b)))
    a, b = (rigid3.inverse(pose)[4:] for pose in (pose_a, pose_b))
    swing = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    return float(np.degrees(turn)), float(np.degrees(swing))


def _scaled(poses: Array, scale: float) -> Array:
    scaled = np.array(poses)
    scaled[..., 4:] *= scale
    return scaled
