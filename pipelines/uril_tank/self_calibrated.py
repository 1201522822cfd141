"""Stock COLMAP on the same features: OPENCV cameras calibrated in the water, no rig."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from uwsfm.colmap.model import Model
from uwsfm.geometry import rigid3
from uwsfm.rig.rig import Rig

# One thread: with more, the same seed gives another model each time.
NUM_THREADS = 1


@dataclass(frozen=True)
class SelfCalibrated:
    """COLMAP's largest model."""

    model: pycolmap.Reconstruction
    rig: Rig

    @cached_property
    def cameras(self) -> list[pycolmap.Camera]:
        """Left and right, as calibrated in the water."""
        found = {}
        for image_id in self.model.reg_image_ids():
            image = self.model.images[image_id]
            found[image.name.split("/")[0]] = self.model.cameras[image.camera_id]
        return [found[camera.images] for camera in self.rig.cameras]

    @property
    def mean_error(self) -> float:
        """Mean reprojection error of all observations, px."""
        return float(np.mean(list(self._errors.values())))

    @cached_property
    def right_from_left(self) -> np.ndarray:
        """Mean relative pose (7,) of the pairs, scaled to the rig's baseline."""
        poses = {
            self.model.images[i].name: self.model.images[i].cam_from_world().params
            for i in self.model.reg_image_ids()
        }
        left, right = (camera.images for camera in self.rig.cameras)
        pairs = np.array(
            [
                rigid3.compose(
                    poses[name.replace(left, right, 1)], rigid3.inverse(pose)
                )
                for name, pose in poses.items()
                if name.startswith(left) and name.replace(left, right, 1) in poses
            ]
        )
        mean = Rotation.from_quat(pairs[:, :4]).mean().as_quat()
        shift = np.median(pairs[:, 4:], axis=0)
        shift *= self.rig.baseline_m / np.linalg.norm(shift)
        return np.concatenate([mean, shift])

    @cached_property
    def _errors(self) -> dict[tuple[str, int], float]:
        """Reprojection error of each observation, by image name and keypoint."""
        errors = {}
        for point in self.model.points3D.values():
            for element in point.track.elements:
                image = self.model.images[element.image_id]
                camera = self.model.cameras[image.camera_id]
                in_cam = image.cam_from_world() * point.xyz
                pixel = camera.img_from_cam(in_cam)
                offset = pixel - image.points2D[element.point2D_idx].xy
                key = (image.name, element.point2D_idx)
                errors[key] = float(np.linalg.norm(offset))
        return errors

    def _common(self, model: Model) -> list[tuple[float, float]]:
        """(ours, COLMAP's) errors of the observations both models keep."""
        scene, ours = model.scene, model.errors_px()
        names = [
            model.image_name(c, f)
            for c, f in zip(scene.camera_idx, scene.frame_idx, strict=True)
        ]
        keys = zip(names, model.keypoint_idx.tolist(), strict=True)
        return [
            (error, self._errors[key])
            for key, error in zip(keys, ours, strict=True)
            if key in self._errors
        ]

    def num_common(self, model: Model) -> int:
        return len(self._common(model))

    def common_error(self, model: Model) -> float:
        return float(np.mean([ours for ours, _ in self._common(model)]))

    def common_own_error(self, model: Model) -> float:
        return float(np.mean([theirs for _, theirs in self._common(model)]))


def run(data: Path, work: Path, out: Path, rig: Rig) -> SelfCalibrated:
    """Map the images with COLMAP's defaults from the features in a workspace."""
    out.mkdir(parents=True, exist_ok=True)
    database_path = out / "database.db"
    database_path.unlink(missing_ok=True)
    log_level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 2
    with (
        pycolmap.Database.open(work / "database.db") as features,
        pycolmap.Database.open(database_path) as database,
    ):
        _copy(features, database)
    pairs = out / "pairs.txt"
    names = [
        f"{camera.images}/{path.name}"
        for camera in rig.cameras
        for path in sorted((data / camera.images).glob("*.png"))
    ]
    pairs.write_text(
        "".join(f"{a} {b}\n" for i, a in enumerate(names) for b in names[:i])
    )
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    pycolmap.verify_matches(database_path, pairs, verification)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads, options.random_seed = NUM_THREADS, 0
    options.extract_colors = False
    models = pycolmap.incremental_mapping(database_path, data, out, options)
    pycolmap.logging.minloglevel = log_level
    return SelfCalibrated(max(models.values(), key=lambda m: m.num_reg_images()), rig)


def _copy(features: pycolmap.Database, database: pycolmap.Database) -> None:
    """Cameras as COLMAP would guess them, images, keypoints and raw matches."""
    for camera in features.read_all_cameras():
        guess = pycolmap.Camera.create_from_model_name(
            camera.camera_id,
            "OPENCV",
            1.2 * max(camera.width, camera.height),
            camera.width,
            camera.height,
        )
        database.write_camera(guess, use_camera_id=True)
    images = features.read_all_images()
    for image in images:
        copy = pycolmap.Image(name=image.name, camera_id=image.camera_id)
        copy.image_id = image.image_id
        database.write_image(copy, use_image_id=True)
        database.write_keypoints(
            image.image_id, features.read_keypoints(image.image_id)
        )
    pycolmap.apply_rig_config([], database)
    for i, a in enumerate(images):
        for b in images[:i]:
            if features.exists_matches(a.image_id, b.image_id):
                matches = features.read_matches(a.image_id, b.image_id)
                database.write_matches(a.image_id, b.image_id, matches)
