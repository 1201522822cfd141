"""Where the second camera is, when only its distance is known.

As Sedlazeck & Koch (BMVC 2011): the images are reconstructed without a rig, with
pinholes in which refraction is undone for far points (their 1.333 f, with Snell's law
and the lens distortion kept); the relative poses of the frames agree on a rig, whose
poses are then adjusted together with the radial distortion and the points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from uwsfm._base.progress import Progress, silent
from uwsfm.errors import UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.pinhole.mapper import map_images
from uwsfm.sfm.pinhole.mapping_database import (
    image_id_of,
    rig_config,
    write_mapping_database,
)
from uwsfm.sfm.rig_checks.pinhole_fit import VirtualPinhole, fit_virtual_pinhole

MIN_FRAMES = 3
MAX_FRAMES = 500  # each is compared with all the others
MAX_SPREAD = 0.2
"""Frames that differ more from the median, in radians or as a fraction of the
baseline, are left out."""
MAX_MAPPED_FRAMES = 10
"""Frames that the rig is derived from. Without a rig twice as many images have to be
mapped on one core, adjusted together again and again; the rig is the same in all of
them, and is refined with all frames later. Of the sample's 14 frames, 8 come as near
to the truth as all (0.48 and 0.46 degrees) for 0.6 of the mapper's time."""
STEP = "rig from baseline_m: "
"""Before the names of the steps, for the map that comes later has the same."""
FUNCTION_TOLERANCE = 1e-6
"""Relative decrease of the cost that ends the adjustment. COLMAP's is 0: all of its 100
iterations are made. The rig is only a start, wrong by tenths of a degree because the
ports are not known."""
LOSS_SCALE_PX = 2.0
"""Where the robust loss of the adjustment sets in; see `_adjust`."""


def rig_from_baseline(
    features_path: Path,
    work_dir: Path,
    frames: Frames,
    rig: Rig,
    options: StartOptions,
    progress: Progress = silent,
) -> Array:
    """Derive cam_from_rig (2, 7) of a stereo rig whose baseline length is known.

    Args:
        features_path: Database with keypoints and matches.
        work_dir: For a database of its own.
        frames: The images.
        rig: Two cameras, `Rig.cam_from_rig` None.
        options: As for the perspective start.
        progress: Called with the steps "verifying", "mapping" and "adjusting", after
            `STEP`.

    Raises:
        UwsfmError: too few frames show both cameras in one model.
    """
    few = connected_frames(features_path, frames, MAX_MAPPED_FRAMES)
    try:
        return _rig_of_frames(
            features_path, work_dir, few, rig, options, _named(STEP, progress)
        )
    except UwsfmError:
        if few is frames:
            raise
    name = f"{STEP[:-2]}, all frames: "
    return _rig_of_frames(
        features_path, work_dir, frames, rig, options, _named(name, progress)
    )


def _named(name: str, progress: Progress) -> Progress:
    return lambda step, done, total: progress(name + step, done, total)


def _rig_of_frames(
    features_path: Path,
    work_dir: Path,
    frames: Frames,
    rig: Rig,
    options: StartOptions,
    progress: Progress,
) -> Array:
    """`rig_from_baseline`, with all the frames that are given."""
    cameras = rig.refractive_cameras()
    pinholes = tuple(fit_virtual_pinhole(camera, None) for camera in cameras)
    database_path = work_dir / "free.db"
    write_mapping_database(
        features_path,
        database_path,
        frames,
        cameras,
        pinholes,
        None,
        options,
        progress,
        model="RADIAL",
    )
    models = map_images(database_path, frames, options, free=True, progress=progress)
    relative = _relative_poses(models[0], frames)
    if len(relative) < MIN_FRAMES:
        raise UwsfmError(
            f"only {len(relative)} frames show both cameras in one model, at least "
            f"{MIN_FRAMES} are needed to derive cam_from_rig from baseline_m: give "
            "cam_from_rig in the rig file"
        )
    average = robust_average(relative[:: -(-len(relative) // MAX_FRAMES)])
    progress("adjusting", 0, None)
    adjusted = _adjust(models[0], database_path, frames, average)
    return with_baseline(adjusted, pinholes, rig.baseline_m or 0.0)


def connected_frames(features_path: Path, frames: Frames, count: int) -> Frames:
    """As many frames, whose images have many matches with each other.

    Grown from the pair of frames with the most, by the frame that adds the most; first
    come frames whose own cameras match, for only these show the rig.

    Args:
        features_path: Database with raw matches.
        frames: All there are; no more than ``count``: all of them.
        count: How many to choose.
    """
    total = len(frames.names)
    if total <= count:
        return frames
    place = {name: index for index, name in enumerate(frames.names)}
    with opened(features_path) as database:
        images = database.read_all_images()
        pairs, numbers = database.read_num_matches()
    frame_of = {i.image_id: place.get(i.name.rpartition("/")[2]) for i in images}
    matches = np.zeros((total, total))
    for pair, number in zip(pairs, numbers, strict=True):
        a, b = (frame_of[i] for i in pycolmap.pair_id_to_image_pair(pair))
        if a is not None and b is not None:
            matches[a, b] += number
            matches[b, a] += number * (a != b)
    own = np.diag(matches).copy()
    np.fill_diagonal(matches, 0.0)
    ties = np.where(own[:, None] * own > 0.0, matches, 0.0)
    chosen = sorted(divmod(int(np.argmax(ties)), total))
    while len(chosen) < count:
        gain = ties[chosen].sum(axis=0)
        gain[chosen] = -1.0
        chosen.append(int(np.argmax(gain)))
    return replace(frames, names=tuple(frames.names[f] for f in sorted(chosen)))


def _relative_poses(model: pycolmap.Reconstruction, frames: Frames) -> Array:
    """Second camera from first (n, 7), of the frames with both."""
    poses = []
    for f in range(len(frames.names)):
        ids = image_id_of(frames, 0, f), image_id_of(frames, 1, f)
        if all(model.exists_image(i) and model.images[i].has_pose for i in ids):
            first, second = (model.images[i].cam_from_world().params for i in ids)
            poses.append(rigid3.compose(second, rigid3.inverse(first)))
    return np.array(poses).reshape(-1, 7)


def robust_average(poses: Array) -> Array:
    """One pose (7,) for poses (n, 7) that should be equal; outliers are left out.

    The middle one has the least median difference to all the others; the mean is taken
    over those near it.
    """
    turn = rigid3.rotation_angle(
        rigid3.compose(poses[:, None], rigid3.inverse(poses)[None])
    )
    shift = np.linalg.norm(poses[:, None, 4:] - poses[None, :, 4:], axis=-1)
    length = np.median(np.linalg.norm(poses[:, 4:], axis=1))
    difference = np.hypot(turn, shift / length)  # (n, n)
    middle = int(np.argmin(np.median(difference, axis=1)))
    near = poses[difference[middle] <= MAX_SPREAD]
    rotation = rigid3.rotmat_from_quat(near[:, :4]).mean(axis=0)
    return rigid3.from_rotmat(rotation, near[:, 4:].mean(axis=0))


def _adjust(
    model: pycolmap.Reconstruction, database_path: Path, frames: Frames, pose: Array
) -> Array:
    """Bundle adjustment of rig poses, relative pose, distortion and points (7,).

    Everything is in the units of the model. The loss is robust: a wrong match that
    fitted while every image was free may lie 60 px off once the rig holds; two such
    observations among 4600 turned the baseline by 4 degrees under a quadratic loss.
    """
    poses = np.stack([rigid3.IDENTITY, pose])
    with opened(database_path) as database:
        pycolmap.apply_rig_config([rig_config(frames, poses)], database, model)
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length = False
        options.refine_extra_params = True
        options.refine_sensor_from_rig = True
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = LOSS_SCALE_PX
        options.ceres.solver_options.num_threads = 1  # the same sums in every run
        options.ceres.solver_options.function_tolerance = FUNCTION_TOLERANCE
        options.print_summary = False
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in model.reg_image_ids():
            config.add_image(image_id)
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        # pycolmap.bundle_adjustment would reset the log level of the whole process.
        pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    (rig,) = (r for r in model.rigs.values() if r.num_sensors() == 2)
    (sensor_from_rig,) = rig.non_ref_sensors.values()
    return np.array(sensor_from_rig.params)


def with_baseline(
    pose: Array, pinholes: Sequence[VirtualPinhole], baseline_m: float
) -> Array:
    """Poses (2, 7) of the real cameras, from the virtual second one in any unit.

    The virtual centres lie apart from the real ones by known lengths c, so the unit s
    follows from |s t + c1 - R c0| = baseline.
    """
    fixed = pinholes[1].center_in_cam - rigid3.rotate(pose, pinholes[0].center_in_cam)
    t = pose[4:]
    a, b, c = t @ t, t @ fixed, fixed @ fixed - baseline_m**2
    scale = (-b + np.sqrt(b * b - a * c)) / a
    poses = np.stack([rigid3.IDENTITY, pose])
    poses[1, 4:] = scale * t + fixed
    return poses
