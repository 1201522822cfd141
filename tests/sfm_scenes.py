"""Simulated dives as the front end meets them: frames, databases, matches."""

from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap

from uwsfm.colmap import Model
from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.background import opened
from uwsfm.sfm.images import Frames
from uwsfm.sfm.same_frame import PairMatches
from uwsfm.simulate import ObservationOptions, Relief, SimulatedScene, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


def simulated_dive(
    rig: Rig | None = None,
    num_frames: int = 6,
    num_points: int = 1200,
    seed: int = 0,
) -> SimulatedScene:
    """What a rig with tilted ports sees on a varied dive, with the noise of SIFT."""
    return simulate_scene(
        rig or sample_rig(),
        rich_motion(num_frames),
        Relief(stddev=0.15, correlation_length=0.4, seed=seed),
        ObservationOptions(
            num_points=num_points, noise_px=0.4, detection_rate=0.6, seed=seed
        ),
    )


def frames_of(rig: Rig, num_frames: int, image_dir: Path) -> Frames:
    """Frames without image files."""
    return Frames(
        image_dir=image_dir,
        folders=tuple(camera.images for camera in rig.cameras),
        names=tuple(f"{index:04d}.png" for index in range(num_frames)),
        unmatched=(),
    )


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


def write_features(
    path: Path, scene: Scene, frames: Frames, *, wrong: float, seed: int = 0
) -> None:
    """A features database: observations as keypoints, shared points as matches.

    Images are numbered backwards: nothing may depend on COLMAP's identifiers.

    Args:
        path: of the database.
        scene: observations.
        frames: names of the images.
        wrong: fraction of wrong matches.
        seed: of the wrong matches.
    """
    rng = np.random.default_rng(seed)
    images = [
        (c, f) for f in range(len(frames.names)) for c in range(len(frames.folders))
    ]
    keypoint_of: dict[tuple[int, int], dict[int, int]] = {}
    image_id = {place: len(images) - i for i, place in enumerate(images)}
    with opened(path) as database, pycolmap.DatabaseTransaction(database):
        for c, camera in enumerate(scene.cameras):
            lens = pycolmap.Camera(
                camera_id=c + 1,
                model=camera.camera.model_name,
                width=camera.width,
                height=camera.height,
                params=camera.camera.params,
            )
            database.write_camera(lens, use_camera_id=True)
        for c, f in images:
            rows = np.flatnonzero((scene.camera_idx == c) & (scene.frame_idx == f))
            points = scene.point_idx[rows].tolist()
            keypoint_of[c, f] = dict(zip(points, range(len(rows)), strict=True))
            name, new_id = frames.image_name(c, f), image_id[c, f]
            image = pycolmap.Image(name=name, camera_id=c + 1, image_id=new_id)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(new_id, scene.xy[rows].astype(np.float32))
        for a, b in combinations(images, 2):
            common = sorted(keypoint_of[a].keys() & keypoint_of[b].keys())
            if len(common) < 15:
                continue
            rows = [(keypoint_of[a][p], keypoint_of[b][p]) for p in common]
            matches = np.array(rows, dtype=np.uint32)
            bad = np.flatnonzero(rng.random(len(matches)) < wrong)
            matches[bad, 1] = matches[np.roll(bad, 1), 1]  # still one to one
            database.write_matches(image_id[a], image_id[b], matches)


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
