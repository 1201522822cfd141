"""COLMAP models as other programs leave them: free poses, pinholes, no rig."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pycolmap
from sfm_scenes import model_of

from uwsfm.colmap.model import Model
from uwsfm.geometry import rigid3
from uwsfm.sfm.frontend.background import quiet_colmap
from uwsfm.sfm.refine import refine_scene
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion

AIR_TO_WATER = 1.333
NUM_FRAMES = 10


class Dive:
    """A simulated dive, what the user knows of its rig, and its optimum."""

    def __init__(self) -> None:
        self.true_rig = sample_rig()
        options = ObservationOptions(
            num_points=400, noise_px=0.3, outlier_ratio=0.02, seed=2
        )
        relief = Relief(stddev=0.2)
        simulated = simulate_scene(
            self.true_rig, rich_motion(NUM_FRAMES), relief, options
        )
        self.truth = simulated.truth
        self.rig = nominal_rig(self.true_rig)
        self.model = model_of(self.rig, simulated.scene)
        self.optimum = refine_scene(perturbed(simulated.scene), self.rig).calibration


@cache
def simulated_dive() -> Dive:
    return Dive()


def self_calibrated(
    model: Model,
    *,
    cameras: str = "folder",
    lens: str = "SIMPLE_RADIAL",
    without: Callable[[int, int], bool] = lambda camera, frame: False,
    num_junk: int = 0,
) -> pycolmap.Reconstruction:
    """What COLMAP makes of refractive pixels: each image free, lenses from the water.

    Args:
        model: Observations, and the poses that bundle adjustment starts from.
        cameras: "shared", "folder" or "image".
        lens: COLMAP's model; focal length and distortion are refined.
        without: (camera, frame) of images that are not registered.
        num_junk: Points that join pixels of the same images at random.
    """
    found = pycolmap.Reconstruction()
    scene = model.scene
    for c, refractive in enumerate(scene.cameras):
        for f in range(scene.num_frames):
            if without(c, f):
                continue
            image_id = 1 + f * len(scene.cameras) + c  # frame by frame
            camera_id = {"shared": 1, "folder": c + 1, "image": image_id}[cameras]
            if not found.exists_camera(camera_id):
                size = refractive.width, refractive.height
                focal = AIR_TO_WATER * refractive.lens[0]
                camera = pycolmap.Camera.create_from_model_name(
                    camera_id, lens, focal, *size
                )
                found.add_camera_with_trivial_rig(camera)
            image = pycolmap.Image(
                name=model.image_name(c, f),
                keypoints=model.keypoints[c][f],
                camera_id=camera_id,
                image_id=image_id,
            )
            pose = rigid3.compose(scene.cam_from_rig[c], scene.rig_from_world[f])
            rotation = pycolmap.Rotation3d(pose[:4])
            found.add_image_with_trivial_frame(
                image, pycolmap.Rigid3d(rotation, pose[4:])
            )
    _add_points(found, model, num_junk)
    _adjust(found)
    return found


def _add_points(found: pycolmap.Reconstruction, model: Model, num_junk: int) -> None:
    scene, rng = model.scene, np.random.default_rng(1)
    ids = 1 + scene.frame_idx * len(scene.cameras) + scene.camera_idx
    there = np.isin(ids, found.reg_image_ids())
    rows_of = [
        np.flatnonzero(there & (scene.point_idx == p)) for p in range(scene.num_points)
    ]
    spare = set(rng.permutation(scene.num_points)[:num_junk].tolist())
    loose = np.concatenate([rows_of[p] for p in spare]) if spare else np.empty(0, int)
    tracks = [rows for p, rows in enumerate(rows_of) if p not in spare]
    tracks += np.array_split(rng.permutation(loose), max(num_junk, 1))
    for rows in tracks:
        if len(np.unique(ids[rows])) < 2:
            continue
        track = pycolmap.Track()
        for row in rows:
            track.add_element(int(ids[row]), int(model.keypoint_idx[row]))
        point = scene.points[scene.point_idx[rows[0]]]
        found.add_point3D(point, track, np.array([10, 20, 30], dtype=np.uint8))


def _adjust(found: pycolmap.Reconstruction) -> None:
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 2.0
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = 30
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in found.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, found).solve()
    found.update_point_3d_errors()


def moved(found: pycolmap.Reconstruction, scale: float) -> pycolmap.Reconstruction:
    """Turned, shifted and scaled, as no gauge is a model's own."""
    turn = pycolmap.Rotation3d(np.array([0.5, -0.5, 0.5, 0.5]))
    found.transform(pycolmap.Sim3d(scale, turn, np.array([3.0, -20.0, 7.0])))
    return found


def write(
    found: pycolmap.Reconstruction, folder: Path, *, text: bool = False, old: bool
) -> Path:
    """Write a model; ``old``: as COLMAP 3.x does, without rigs and frames."""
    folder.mkdir(parents=True)
    if text:
        found.write_text(str(folder))
    else:
        found.write_binary(str(folder))
    if old:
        for name in ("rigs", "frames"):
            (folder / f"{name}.{'txt' if text else 'bin'}").unlink()
    return folder


def stock_model(
    images: Path, folder: Path, max_num_features: int = 8192
) -> pycolmap.Reconstruction:
    """SIMPLE_RADIAL, a camera per folder, exhaustive: what the GUI does unasked.

    Args:
        images: Holds the folders left and right.
        folder: Receives database.db.
        max_num_features: Per image; the default is COLMAP's.
    """
    database, out = folder / "database.db", folder / "models"
    out.mkdir()
    names = [
        f"{side}/{path.name}"
        for side in ("left", "right")
        for path in sorted((images / side).iterdir())
    ]
    one = {"num_threads": 1}  # more would give another model each time
    extraction = pycolmap.FeatureExtractionOptions(one)
    extraction.sift.max_num_features = max_num_features
    with quiet_colmap():
        pycolmap.extract_features(
            database,
            images,
            image_names=names,
            camera_mode=pycolmap.CameraMode.PER_FOLDER,
            extraction_options=extraction,
        )
        pycolmap.match_exhaustive(
            database, matching_options=pycolmap.FeatureMatchingOptions(one)
        )
        options = pycolmap.IncrementalPipelineOptions({**one, "random_seed": 0})
        models = pycolmap.incremental_mapping(database, images, out, options)
    return max(models.values(), key=lambda model: model.num_reg_images())
