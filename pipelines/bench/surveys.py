"""The scenes that are solved: surveys with loops, from a pool to a field."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm.colmap.model import Model
from uwsfm.models.ports.port import NoPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.simulate.perturbations import Perturbation, perturbed
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.surveys import SURVEYS, SurveySpec, simulate_survey

NOISE_PX = 0.5
SPECS = {
    12: SurveySpec(num_frames=12, num_points=400, detection_rate=0.76),
    20: SURVEYS["pool"],
    100: replace(SURVEYS["reef"], num_frames=100, num_points=19_000),
    500: SURVEYS["reef"],
    2000: replace(
        SURVEYS["field"], num_frames=2000, num_points=120_000, detection_rate=0.75
    ),
    5000: SURVEYS["field"],
}
"""By the number of frames; 12 is the smallest survey, for a quick look."""

START = Perturbation(
    rotation_stddev_deg=1.0,
    translation_stddev=0.03,
    cam_rotation_stddev_deg=1.0,
    baseline_direction_stddev_deg=1.0,
    point_stddev=0.05,
)
"""Straight ports at half their distance, as the paper starts; the rest as a mapper
leaves it at worst."""


def make(num_frames: int, folder: str) -> None:
    """Write a survey's true scene with its noisy observations, if it is missing."""
    path = _path(num_frames, folder)
    if not path.exists():
        scene = simulate_survey(SPECS[num_frames], noise_px=NOISE_PX).scene
        with replaced_file(path) as partial:
            partial.write_bytes(pickle.dumps(scene))


def load(num_frames: int, folder: str) -> Scene:
    make(num_frames, folder)
    return pickle.loads(_path(num_frames, folder).read_bytes())


def _path(num_frames: int, folder: str) -> Path:
    return Path(folder) / f"survey-{num_frames}.pickle"


def start_of(scene: Scene) -> Scene:
    return perturbed(scene, START)


def with_cameras(scene: Scene, cameras: tuple[RefractiveCamera, ...]) -> Scene:
    """The same poses, points and noise, seen by other cameras; less what they miss."""
    noise = -scene.residuals()
    clean = replace(scene, cameras=cameras, xy=np.zeros_like(scene.xy)).residuals()
    seen = np.isfinite(clean).all(axis=1) & np.isfinite(noise).all(axis=1)
    changed = replace(scene, cameras=cameras, xy=clean + noise)
    return changed.select(seen)[0]


def as_pinholes(scene: Scene) -> Scene:
    """The scene without water: what a pinhole program fits without model error."""
    cameras = [RefractiveCamera(c.camera, NoPort()) for c in scene.cameras]
    return with_cameras(scene, tuple(cameras))


def as_model(scene: Scene) -> Model:
    """A scene whose observations are the keypoints of its images."""
    rig = _first_cameras(paper_rig(), len(scene.cameras))
    rig = rig.with_geometry(scene.cam_from_rig, scene.ports)
    image = scene.camera_idx * scene.num_frames + scene.frame_idx
    order = np.argsort(image, kind="stable")
    num_images = len(scene.cameras) * scene.num_frames
    starts = np.searchsorted(image[order], np.arange(num_images + 1))
    keypoint_idx = np.empty(len(image), dtype=np.int64)
    keypoint_idx[order] = np.arange(len(image)) - starts[image[order]]
    images = [scene.xy[order[a:b]] for a, b in zip(starts, starts[1:], strict=False)]
    count = scene.num_frames
    return Model(
        rig=_with_lenses(rig, scene),
        scene=scene,
        frame_names=tuple(f"{frame:05d}.png" for frame in range(count)),
        keypoints=tuple(
            tuple(images[c * count : (c + 1) * count])
            for c in range(len(scene.cameras))
        ),
        keypoint_idx=keypoint_idx,
        colors=np.full((scene.num_points, 3), 128, dtype=np.uint8),
    )


def of_one_camera(scene: Scene) -> Scene:
    """What the first camera saw, of points that it saw twice."""
    mine = scene.camera_idx == 0
    counts = np.bincount(scene.point_idx[mine], minlength=scene.num_points)
    alone = replace(
        scene, cameras=scene.cameras[:1], cam_from_rig=scene.cam_from_rig[:1]
    )
    return alone.select(mine & (counts[scene.point_idx] >= 2))[0]


def _first_cameras(rig: Rig, count: int) -> Rig:
    if count == len(rig.cameras):
        return rig
    return Rig(cameras=rig.cameras[:count], cam_from_rig=None, baseline_m=None)


def _with_lenses(rig: Rig, scene: Scene) -> Rig:
    cameras = [
        replace(camera, camera=refractive.camera)
        for camera, refractive in zip(rig.cameras, scene.cameras, strict=True)
    ]
    return replace(rig, cameras=tuple(cameras))
