"""Simulated dives as the front end meets them."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap

from uwsfm.colmap.model import Model
from uwsfm.jobs.demo import sample_dir
from uwsfm.rig.file import load_rig
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches
from uwsfm.simulate import ObservationOptions, Relief, SimulatedScene, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


def simulated_dive(
    rig: Rig | None = None,
    num_frames: int = 6,
    num_points: int = 1200,
    seed: int = 0,
    noise_px: float = 0.4,
) -> SimulatedScene:
    """What a rig with tilted ports sees on a varied dive, with the noise of SIFT."""
    return simulate_scene(
        rig or sample_rig(),
        rich_motion(num_frames),
        Relief(stddev=0.15, correlation_length=0.4, seed=seed),
        ObservationOptions(
            num_points=num_points, noise_px=noise_px, detection_rate=0.6, seed=seed
        ),
    )


def reduced_images(target: Path, scale: float, num_frames: int | None = None) -> None:
    """Images of the first frames of the sample, smaller."""
    for folder in ("left", "right"):
        (target / folder).mkdir(parents=True)
        sources = sorted((sample_dir() / "images" / folder).iterdir())
        for source in sources[:num_frames]:
            small = cv2.resize(
                cv2.imread(str(source)),
                None,
                fx=scale,
                fy=scale,
                interpolation=cv2.INTER_AREA,
            )
            cv2.imwrite(str(target / folder / source.with_suffix(".png").name), small)


def reduced_rig(scale: float) -> Rig:
    """The sample's rig, for `reduced_images`."""
    rig = load_rig(sample_dir() / "rig.yaml")
    cameras = []
    for item in rig.cameras:
        lens = item.camera
        camera = pycolmap.Camera(
            model=lens.model_name,
            width=lens.width,
            height=lens.height,
            params=lens.params,
            has_prior_focal_length=True,
        )
        camera.rescale(scale)
        cameras.append(replace(item, camera=camera))
    return replace(rig, cameras=tuple(cameras))


def model_of(rig: Rig, scene: Scene) -> Model:
    """A reconstruction with the observations of a scene as its keypoints."""
    keypoint_idx = np.zeros(scene.num_observations, dtype=np.int64)
    keypoints = []
    for camera in range(len(scene.cameras)):
        of_camera = []
        for frame in range(scene.num_frames):
            mine = (scene.camera_idx == camera) & (scene.frame_idx == frame)
            rows = np.nonzero(mine)[0]
            # One keypoint that no point uses comes first: indices are not rows.
            keypoint_idx[rows] = 1 + np.arange(len(rows))
            of_camera.append(np.vstack([[7.5, 8.5], scene.xy[rows]]))
        keypoints.append(tuple(of_camera))
    rng = np.random.default_rng(0)
    return Model(
        rig=rig,
        scene=scene,
        frame_names=tuple(f"{i:04}.jpg" for i in range(scene.num_frames)),
        keypoints=tuple(keypoints),
        keypoint_idx=keypoint_idx,
        colors=rng.integers(0, 255, (scene.num_points, 3), dtype=np.uint8),
    )


def same_frame_matches(scene: Scene) -> PairMatches:
    """Points that the first two cameras of a scene saw in the same frame."""
    keys = scene.frame_idx * scene.num_points + scene.point_idx
    first, second = (np.flatnonzero(scene.camera_idx == c) for c in (0, 1))
    _, in_a, in_b = np.intersect1d(keys[first], keys[second], return_indices=True)
    return PairMatches(
        camera_a=0,
        camera_b=1,
        frame_idx=scene.frame_idx[first[in_a]],
        xy_a=scene.xy[first[in_a]],
        xy_b=scene.xy[second[in_b]],
    )
