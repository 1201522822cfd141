"""From a COLMAP model to the start of a refractive adjustment: one pose per frame."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.from_colmap.colmap_model import FoundModel, ImageModel, read_image_model
from uwsfm.sfm.from_colmap.model_rig import ModelRig, rig_of_model
from uwsfm.sfm.poses.absolute_pose import AbsolutePoseOptions, estimate_rig_pose

RESECTION = AbsolutePoseOptions(max_error_px=20.0, min_num_inliers=15)
"""Of a frame with a wrong pose: among points from pinholes' poses, which are some
pixels off."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tracks:
    """A scene to adjust, and where its observations come from."""

    scene: Scene
    frame_names: tuple[str, ...]
    """(F,)"""
    keypoints: tuple[tuple[Array, ...], ...]
    """[camera][frame] -> (n, 2) all keypoints of an image; none if it is not there."""
    keypoint_idx: IndexArray
    """(N,) which keypoint of its image each observation is."""
    model_idx: IndexArray
    """(N,) index of each observation in the `ImageModel`; -1: it is not from there."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelStart:
    """Where a COLMAP model lets the refractive adjustment start from."""

    model: ImageModel
    rig: ModelRig
    tracks: Tracks
    """Frames and points are those of ``model``, in metres: a pinhole's."""
    warnings: tuple[str, ...]
    summary: dict[str, Any]


def start_from_model(
    found: FoundModel,
    rig: Rig,
    scene_distance_m: float = 1.0,
    database: Path | None = None,
) -> ModelStart:
    """Read a COLMAP model, check it against a rig, and put it into metres.

    Args:
        found: The model.
        rig: Lenses in air, initial ports, and the baseline that gives the scale.
        scene_distance_m: Of the scene of a single camera, about; it sets the scale to
            start with.
        database: As of `read_image_model`.

    Raises:
        InputError: as `read_image_model` and `rig_of_model`.
    """
    model = read_image_model(found, rig, database)
    agreed = rig_of_model(model, rig, scene_distance_m)
    scene = Scene.from_arrays(
        cameras=rig.refractive_cameras(),
        cam_from_rig=agreed.cam_from_rig,
        rig_from_world=_frame_poses(model, agreed),
        points=agreed.scale * np.nan_to_num(model.points),
        camera_idx=model.camera_idx,
        frame_idx=model.frame_idx,
        point_idx=model.point_idx,
        xy=model.xy,
    )
    scene, lost = _resected(scene, np.any(agreed.doubtful, axis=0))
    kept = np.nonzero(~np.isin(model.frame_idx, lost))[0]
    if not len(kept):
        raise InputError(f"{found.folder}: no frame has a pose that its points support")
    warnings = [*model.warnings, *agreed.warnings]
    in_doubt = np.flatnonzero(np.any(agreed.doubtful, axis=0))
    if len(in_doubt):
        example = model.frame_names[in_doubt[0]]
        warnings.append(
            f"in {len(in_doubt)} frames, for instance {example}, the poses of the "
            "images contradict the rig of the other frames: their poses were "
            "found anew, and an image that was not taken at the same time as the "
            "others loses its observations"
        )
    if lost:
        names = ", ".join(model.frame_names[f] for f in lost[:10])
        warnings.append(
            f"{len(lost)} frames were left out, because the poses of their images "
            "contradict each other and the points of other frames support none: "
            f"{names}{' ...' if len(lost) > 10 else ''}"
        )
    errors = model.own_error_px
    return ModelStart(
        model=model,
        rig=agreed,
        tracks=Tracks(
            scene=_with_observations(scene, kept),
            frame_names=model.frame_names,
            keypoints=model.keypoints,
            keypoint_idx=model.keypoint_idx[kept],
            model_idx=kept,
        ),
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


def _frame_poses(model: ImageModel, agreed: ModelRig) -> Array:
    """(F, 7) rig_from_world, metres: the mean over the images of a frame."""
    rig_from_cam = rigid3.inverse(agreed.in_model)
    poses = rigid3.compose(rig_from_cam[:, None], model.cam_from_world)  # (C, F, 7)
    poses[..., 4:] *= agreed.scale
    found = np.empty(poses.shape[1:])
    for frame, there in enumerate(model.registered.T):
        mine = poses[there, frame]
        rotation = rigid3.rotmat_from_quat(mine[:, :4]).mean(axis=0)
        found[frame] = rigid3.from_rotmat(rotation, np.zeros(3))
        # Centres have a mean; translations swing with the rotation, far from zero.
        center = rigid3.inverse(mine)[:, 4:].mean(axis=0)
        found[frame, 4:] = -rigid3.rotate(found[frame], center)
    return found


def _resected(scene: Scene, in_doubt: NDArray[np.bool_]) -> tuple[Scene, list[int]]:
    """Find the poses of the frames in doubt (F,) from points that the others see.

    Returns:
        The scene, and the frames without a pose.
    """
    if not in_doubt.any():
        return scene, []
    origins, dirs = scene.water_rays()
    dirs[in_doubt[scene.frame_idx]] = np.nan
    points = triangulate_tracks(origins, dirs, scene.point_idx, scene.num_points)
    rig_from_world = scene.rig_from_world.copy()
    lost = []
    for frame in np.flatnonzero(in_doubt).tolist():
        rows = np.flatnonzero(scene.frame_idx == frame)
        found = estimate_rig_pose(
            scene.cameras,
            scene.cam_from_rig,
            scene.camera_idx[rows],
            scene.xy[rows],
            points[scene.point_idx[rows]],
            RESECTION,
        )
        if found is None:
            lost.append(frame)
        else:
            rig_from_world[frame] = found.rig_from_world
    return replace(scene, rig_from_world=rig_from_world), lost


def _with_observations(scene: Scene, rows: IndexArray) -> Scene:
    """Some of the observations, and all points."""
    return replace(
        scene,
        camera_idx=scene.camera_idx[rows],
        frame_idx=scene.frame_idx[rows],
        point_idx=scene.point_idx[rows],
        xy=scene.xy[rows],
    )
