"""A textured plane, rendered along exact water rays: what dense stereo is tested on."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from sfm_scenes import model_of

from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import closest_points
from uwsfm.geometry.rigid3 import Array
from uwsfm.jobs.refine_model import refine_model
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.results.files import export_colmap
from uwsfm.rig.file import dump_rig
from uwsfm.scene import Scene
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


@dataclass(frozen=True)
class Plane:
    """Points X with <normal, X> = offset, painted with noise of two scales."""

    normal: Array
    offset: float
    texel: float
    """Metres; about a pixel."""

    def ranges(self, origins: Array, dirs: Array) -> Array:
        """Where rays (N, 3), (N, 3) meet the plane (N,)."""
        return (self.offset - origins @ self.normal) / (dirs @ self.normal)

    def image(self, camera: RefractiveCamera, cam_from_plane: Array) -> np.ndarray:
        """Grey image (H, W) of a camera, four rays per pixel."""
        half = (np.arange(2 * camera.width) + 0.5) / 2
        rows = (np.arange(2 * camera.height) + 0.5) / 2
        xy = np.stack(np.meshgrid(half, rows), axis=-1).reshape(-1, 2)
        origins, dirs = camera.ray_from_img(xy)
        plane_from_cam = rigid3.inverse(cam_from_plane)
        origins = rigid3.transform(plane_from_cam, origins)
        dirs = rigid3.rotate(plane_from_cam, dirs)
        points = origins + self.ranges(origins, dirs)[:, None] * dirs
        shape = 2 * camera.height, 2 * camera.width
        fine = np.zeros(shape, dtype=np.float32)
        for scale, paint in zip((2.0, 8.0), _paint(), strict=True):
            at = points[:, :2] / (scale * self.texel)
            at = (at % (len(paint) - 2)).astype(np.float32).reshape(*shape, 2)
            fine += cv2.remap(paint, at, None, cv2.INTER_LINEAR)
        gray = cv2.resize(fine, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return np.clip(gray, 0, 255).astype(np.uint8)


def _paint() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.uniform(0, 120, (1000, 1000)).astype(np.float32) for _ in range(2)]


@dataclass(frozen=True)
class DenseDive:
    out: Path
    images: Path
    truth: Scene
    plane: Plane


def dense_dive(folder: Path, num_frames: int = 3) -> DenseDive:
    """A refined stereo dive over a flat floor, small, with its images."""
    rig = sample_rig(image_scale=0.4)
    simulated = simulate_scene(
        rig,
        rich_motion(num_frames, altitude=1.5, extent=0.2),
        Relief(),
        ObservationOptions(num_points=200, noise_px=0.1),
    )
    truth = simulated.truth
    model = model_of(rig, truth)
    export_colmap(model, folder / "model")
    dump_rig(rig, folder / "rig.yaml")
    refine_model(folder / "model", folder / "rig.yaml", folder / "out", report=False)
    plane = Plane(np.array([0.0, 0.0, 1.0]), 0.0, 0.004)
    for frame, pose in enumerate(truth.rig_from_world):
        for c, camera in enumerate(truth.cameras):
            image = plane.image(camera, rigid3.compose(truth.cam_from_rig[c], pose))
            path = folder / "images" / model.image_name(c, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            # Lossless, whatever its name says: the model's names end in jpg.
            path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    return DenseDive(folder / "out", folder / "images", truth, plane)


def range_errors(scene: Scene, amounts_m, xy: Array, ranges: Array) -> Array:
    """By how much ranges (N,) along left pixels (N, 2) come out longer, if the ports of
    the two cameras are farther away by two amounts than they were when the points were
    seen."""
    left, right = scene.cameras
    pose = scene.cam_from_rig[1]
    origins, dirs = left.ray_from_img(xy)
    seen, _ = right.img_from_point(
        rigid3.transform(pose, origins + ranges[:, None] * dirs)
    )
    left, right = (
        camera.with_port(replace(camera.port, distance=camera.port.distance + amount))
        for camera, amount in zip(scene.cameras, amounts_m, strict=True)
    )
    origins, dirs = left.ray_from_img(xy)
    starts, ways = right.ray_from_img(seen)
    back = rigid3.inverse(pose)
    starts, ways = rigid3.transform(back, starts), rigid3.rotate(back, ways)
    return closest_points(origins, dirs, starts, ways)[1][:, 0] - ranges
