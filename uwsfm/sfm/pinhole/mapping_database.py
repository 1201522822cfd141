"""The database the mapper works on: virtual pinholes, a fixed rig, verified matches.

The features' database stays as it is; this one is derived from it whenever the rig or
its ports change, in seconds. Identifiers follow from the order of cameras and frames,
so that they do not depend on which thread finished first.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm._base.disk import require_room
from uwsfm._base.files import replaced_file
from uwsfm._base.progress import Progress, silent
from uwsfm.errors import UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.sfm.frontend.background import opened, remove_database, run_with_database
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.rig_checks.pinhole_fit import VirtualPinhole

COPIED_SHARE = 0.25
"""Of the database of features: a keypoint has 24 bytes, a descriptor 128."""
OFF_IMAGE = -1.0  # where keypoints without a water ray are put; they have no matches


def image_id_of(frames: Frames, camera_idx: int, frame_idx: int) -> int:
    """The COLMAP identifier of an image, from 1."""
    return frame_idx * len(frames.folders) + camera_idx + 1


def indices_of(frames: Frames, image_id: int) -> tuple[int, int]:
    """Camera and frame index of a COLMAP image identifier."""
    frame_idx, camera_idx = divmod(image_id - 1, len(frames.folders))
    return camera_idx, frame_idx


def virtual_rig(cam_from_rig: Array, pinholes: Sequence[VirtualPinhole]) -> Array:
    """Poses (C, 7) of the virtual cameras in the virtual rig.

    The frame of the virtual rig is the first virtual camera: that of the real rig,
    moved to the virtual centre.
    """
    rig_from_virtual_rig = rigid3.inverse(pinholes[0].virtual_from_cam)
    shifts = np.stack([pinhole.virtual_from_cam for pinhole in pinholes])
    poses = rigid3.compose(
        shifts, rigid3.compose(cam_from_rig, rig_from_virtual_rig[None])
    )
    poses[0] = rigid3.IDENTITY
    return poses


def write_mapping_database(
    features_path: Path,
    mapping_path: Path,
    frames: Frames,
    cameras: Sequence[RefractiveCamera],
    pinholes: Sequence[VirtualPinhole],
    cam_from_rig: Array | None,
    options: StartOptions,
    progress: Progress = silent,
    model: str = "PINHOLE",
) -> None:
    """Derive the mapper's database, and verify its matches.

    Args:
        features_path: Database with keypoints and raw matches.
        mapping_path: Written, whole or not at all.
        frames: The images.
        cameras: The real cameras.
        pinholes: Their virtual pinholes.
        cam_from_rig: Poses (C, 7) of the real cameras; None: no rig, every image is
            free.
        options: Those of the verification are used.
        progress: Called with the step "verifying".
        model: Of the virtual cameras, "PINHOLE" or "RADIAL" (no distortion yet).

    Raises:
        UwsfmError: no pair of images is left with verified matches.
    """
    remove_database(mapping_path)
    # Keypoints, matches, and those of them that are verified; descriptors stay behind.
    needed = COPIED_SHARE * features_path.stat().st_size
    require_room(mapping_path.parent, needed, "verifying matches")
    with replaced_file(mapping_path) as partial:
        with (
            opened(features_path) as source,
            opened(partial) as target,
            pycolmap.DatabaseTransaction(target),
        ):
            for c, pinhole in enumerate(pinholes):
                camera = _camera(pinhole, model)
                camera.camera_id = c + 1
                target.write_camera(camera, use_camera_id=True)
            _copy(source, target, frames, cameras, pinholes)
            configs = []
            if cam_from_rig is not None:
                poses = virtual_rig(cam_from_rig, pinholes)
                configs = [rig_config(frames, poses)]
            pycolmap.apply_rig_config(configs, target)
        # COLMAP's threads write what they verified; it cannot be more than there is.
        require_room(mapping_path.parent, partial.stat().st_size, "verifying matches")
        _verify(partial, options, progress)
        with opened(partial) as target:
            if target.num_inlier_matches() == 0:
                raise UwsfmError(
                    f"no two images of {frames.image_dir} have enough matches that fit "
                    f"one geometry (at least {options.verification.min_num_inliers}): "
                    "do consecutive images overlap, is the water clear enough?"
                )


def _camera(pinhole: VirtualPinhole, model: str) -> pycolmap.Camera:
    camera = pinhole.camera()
    if model == "PINHOLE":
        return camera
    radial = pycolmap.Camera(
        model=model,
        width=camera.width,
        height=camera.height,
        params=[pinhole.focal_px, *pinhole.principal_point, 0.0, 0.0],
    )
    radial.has_prior_focal_length = True
    return radial


def _copy(
    source: pycolmap.Database,
    target: pycolmap.Database,
    frames: Frames,
    cameras: Sequence[RefractiveCamera],
    pinholes: Sequence[VirtualPinhole],
) -> None:
    """Images, keypoints moved to the virtual pinholes, and matches that have rays."""
    new_id: dict[int, int] = {}
    has_ray: dict[int, NDArray[np.bool_]] = {}
    source_id = {i.name: i.image_id for i in source.read_all_images()}
    for f in range(len(frames.names)):
        for c, (camera, pinhole) in enumerate(zip(cameras, pinholes, strict=True)):
            if not frames.has_image(c, f):
                continue
            name, image_id = frames.image_name(c, f), image_id_of(frames, c, f)
            old = source_id[name]
            xy = source.read_keypoints(old)[:, :2].astype(np.float64)
            virtual = pinhole.img_from_real_img(camera, xy.reshape(-1, 2))
            valid = finite_rows(virtual)
            new_id[old], has_ray[old] = image_id, valid
            virtual[~valid] = OFF_IMAGE
            image = pycolmap.Image(name=name, camera_id=c + 1, image_id=image_id)
            target.write_image(image, use_image_id=True)
            target.write_keypoints(image_id, virtual.astype(np.float32))
    for pair_id, matches in zip(*source.read_all_matches(), strict=True):
        old_a, old_b = pycolmap.pair_id_to_image_pair(pair_id)
        if len(matches) == 0 or old_a not in new_id or old_b not in new_id:
            continue
        good = has_ray[old_a][matches[:, 0]] & has_ray[old_b][matches[:, 1]]
        ids, matches = (new_id[old_a], new_id[old_b]), matches[good]
        if ids[0] > ids[1]:
            ids, matches = ids[::-1], np.ascontiguousarray(matches[:, ::-1])
        # Sorted: RANSAC draws rows, and theirs depends on the old identifiers.
        target.write_matches(*ids, matches[np.argsort(matches[:, 0], kind="stable")])


def rig_config(frames: Frames, cam_from_rig: Array) -> pycolmap.RigConfig:
    """COLMAP's description of a rig with poses (C, 7)."""
    config = pycolmap.RigConfig()
    sensors = []
    for c, pose in enumerate(cam_from_rig):
        sensor = pycolmap.RigConfigCamera()
        # The slash: COLMAP compares beginnings, and "cam1" is one of "cam10/".
        sensor.image_prefix = f"{frames.folders[c]}/"
        sensor.ref_sensor = c == 0
        if c > 0:
            rotation = pycolmap.Rotation3d(pose[:4])
            sensor.cam_from_rig = pycolmap.Rigid3d(rotation, pose[4:])
        sensors.append(sensor)
    config.cameras = sensors
    return config


def _verify(path: Path, options: StartOptions, progress: Progress) -> None:
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.min_num_inliers = options.verification.min_num_inliers
    geometry.ransac.max_error = options.verification.max_error_px
    geometry.ransac.max_num_trials = options.verification.max_num_trials
    geometry.ransac.random_seed = options.seed
    geometry.detect_watermark = False  # a sled in view is no watermark: use masks
    verifier = pycolmap.GeometricVerifierOptions()
    verifier.num_threads = options.threads

    def verify(token: pycolmap.CancellationToken) -> None:
        pycolmap.geometric_verification(
            path,
            verifier_options=verifier,
            two_view_geometry_options=geometry,
            cancellation_token=token,
        )

    with opened(path) as database:
        total = database.num_matched_image_pairs()
    run_with_database(
        path,
        verify,
        lambda database: progress(
            "verifying", database.num_verified_image_pairs(), total
        ),
    )
    progress("verifying", total, total)
