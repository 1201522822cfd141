"""From a COLMAP model to the start of a refractive adjustment: one pose per frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.colmap_model import FoundModel, ImageModel, read_image_model
from uwsfm.sfm.model_rig import ModelRig, rig_of_model

SUPPORT_PX = 20.0
"""True error of an observation that supports the pose of its frame: a pinhole's pose is
wrong by some pixels, a wrong one by hundreds."""
MIN_SUPPORT = 15
"""Observations that a frame needs to keep its pose."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelStart:
    """Where a COLMAP model lets the refractive adjustment start from."""

    model: ImageModel
    rig: ModelRig
    scene: Scene
    """Metres; its frames are those of ``model``, its points as well: a pinhole's."""
    kept: IndexArray
    """(N,) index of each observation of ``scene`` in ``model``."""
    warnings: tuple[str, ...]
    summary: dict[str, Any]


def start_from_model(found: FoundModel, rig: Rig) -> ModelStart:
    """Read a COLMAP model, check it against a rig, and put it into metres.

    Raises:
        InputError: as `read_image_model` and `rig_of_model`.
    """
    model = read_image_model(found, rig)
    agreed = rig_of_model(model, rig)
    poses = _candidates(model, agreed)
    trusted = model.registered & ~agreed.doubtful
    trusted[0] &= ~agreed.doubtful.any(axis=0)
    scene = Scene.from_arrays(
        cameras=rig.refractive_cameras(),
        cam_from_rig=agreed.cam_from_rig,
        rig_from_world=_mean_poses(poses, trusted),
        points=agreed.scale * np.nan_to_num(model.points),
        camera_idx=model.camera_idx,
        frame_idx=model.frame_idx,
        point_idx=model.point_idx,
        xy=model.xy,
    )
    scene, lost = _settled(scene, poses, agreed.doubtful)
    kept = np.nonzero(~np.isin(model.frame_idx, lost))[0]
    if not len(kept):
        raise InputError(f"{found.folder}: no frame has a pose that its points support")
    warnings = [*model.warnings, *agreed.warnings]
    if lost:
        names = ", ".join(model.frame_names[f] for f in lost[:10])
        warnings.append(
            f"{len(lost)} frames were left out, because neither of their images has a "
            f"pose that its points support: {names}{' ...' if len(lost) > 10 else ''}"
        )
    errors = model.own_error_px
    return ModelStart(
        model=model,
        rig=agreed,
        scene=_with_observations(scene, kept),
        kept=kept,
        warnings=tuple(warnings),
        summary={
            "path": str(found.folder),
            "num_images": int(model.registered.sum()),
            "num_frames": len(model.frame_names),
            "num_points": len(model.points),
            "num_observations": len(model.xy),
            "lens_models": sorted(model.lens_models),
            "median_error_px": float(np.nanmedian(errors)),
            "num_doubtful_images": int(agreed.doubtful.sum()),
            **agreed.summary,
        },
    )


def _candidates(model: ImageModel, agreed: ModelRig) -> Array:
    """(C, F, 7) rig_from_world, metres, as each image alone would have it."""
    rig_from_cam = rigid3.inverse(agreed.in_model)
    poses = rigid3.compose(rig_from_cam[:, None], model.cam_from_world)
    poses[..., 4:] *= agreed.scale
    return poses


def _mean_poses(poses: Array, use: NDArray[np.bool_]) -> Array:
    """(F, 7) mean over the images used; the identity where there is none."""
    found = np.tile(rigid3.IDENTITY, (poses.shape[1], 1))
    for frame in np.nonzero(use.any(axis=0))[0]:
        mine = poses[use[:, frame], frame]
        rotation = rigid3.rotmat_from_quat(mine[:, :4]).mean(axis=0)
        center = rigid3.inverse(mine)[:, 4:].mean(axis=0)
        turn = rigid3.from_rotmat(rotation, np.zeros(3))
        found[frame] = turn
        found[frame, 4:] = -rigid3.rotate(turn, center)
    return found


def _settled(
    scene: Scene, poses: Array, doubtful: NDArray[np.bool_]
) -> tuple[Scene, list[int]]:
    """Give each doubtful frame the pose of the image that its points support.

    The points are those that the other frames see.

    Returns:
        The scene, and the frames that no image's pose fits.
    """
    in_doubt = np.any(doubtful, axis=0)
    if not in_doubt.any():
        return scene, []
    origins, dirs = scene.water_rays()
    dirs[in_doubt[scene.frame_idx]] = np.nan
    points = triangulate_tracks(origins, dirs, scene.point_idx, scene.num_points)
    rig_from_world = scene.rig_from_world.copy()
    lost = []
    for frame in np.nonzero(in_doubt)[0].tolist():
        part, used = scene.select(scene.frame_idx == frame)
        part = replace(part, points=points[used])
        support = [
            _support(part, frame, pose) if np.isfinite(pose).all() else 0
            for pose in poses[:, frame]
        ]
        best = int(np.argmax(support))
        if support[best] < MIN_SUPPORT:
            lost.append(frame)
        else:
            rig_from_world[frame] = poses[best, frame]
    return replace(scene, rig_from_world=rig_from_world), lost


def _support(scene: Scene, frame: int, pose: Array) -> int:
    """How many observations agree with a pose (7,) of their frame."""
    poses = scene.rig_from_world.copy()
    poses[frame] = pose
    residuals = replace(scene, rig_from_world=poses).residuals()
    return int(np.count_nonzero(np.sum(residuals**2, axis=1) <= SUPPORT_PX**2))


def _with_observations(scene: Scene, rows: IndexArray) -> Scene:
    """Some of the observations, and all points."""
    return replace(
        scene,
        camera_idx=scene.camera_idx[rows],
        frame_idx=scene.frame_idx[rows],
        point_idx=scene.point_idx[rows],
        xy=scene.xy[rows],
    )
