"""The same images without refraction: the best pinholes, cv2.stereoRectify, the same
matcher.

The pinholes are calibrated in the water on the observations of the refractive model:
focal lengths, principal points, four distortion parameters each, rotation and direction
of the baseline, whose length is the true one.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap

from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.dense.depth_map import pixel_rows
from uwsfm.dense.lookup import sampled
from uwsfm.dense.match import match_tiles, num_disparities, refine
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import NoPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import Scene


def best_pinholes(scene: Scene) -> tuple[Scene, float]:
    """The scene with pinholes, adjusted, and its RMS in pixels."""
    cameras = []
    for camera in scene.cameras:
        lens = camera.lens[:8].copy()  # fx, fy, cx, cy, k1, k2, p1, p2
        lens[:2] *= camera.port.n_water
        pinhole = pycolmap.Camera(
            model="OPENCV", width=camera.width, height=camera.height, params=lens
        )
        cameras.append(RefractiveCamera(pinhole, NoPort()))
    result = calibrate(
        replace(scene, cameras=tuple(cameras)),
        refine_focal=True,
        refine_principal_point=True,
        refine_distortion=True,
    )
    return result.scene, result.summary.rms_px


@dataclass(frozen=True)
class RectifiedPinholes:
    """What cv2.stereoRectify makes of two pinholes."""

    scene: Scene
    near: float
    far: float

    def points(self, left, right) -> tuple[np.ndarray, np.ndarray]:
        """Points (H, W, 3) in the left pinhole and disparities' sensitivity (H, W)."""
        matrices, distortions = zip(
            *(_opencv(camera) for camera in self.scene.cameras), strict=True
        )
        pose = self.scene.cam_from_rig[1]
        rotmat = rigid3.rotmat_from_quat(pose[:4])
        camera = self.scene.cameras[0]
        size = camera.width, camera.height
        turns = cv2.stereoRectify(
            matrices[0], distortions[0], matrices[1], distortions[1], size, rotmat,
            pose[4:].reshape(3, 1), flags=cv2.CALIB_ZERO_DISPARITY, alpha=-1,
        )  # fmt: skip
        turn_left, turn_right, new_left, new_right = turns[:4]
        focal, base = new_left[0, 0], float(np.linalg.norm(pose[4:]))
        # Room on the left for the largest disparity; zero is the smallest.
        smallest = np.floor(focal * base / self.far) - 3
        count = num_disparities(focal * base / self.near + 3 - smallest)
        margin = count + 60
        wide = size[0] + margin + 60, size[1] + 120
        new_left[:2, 2] += margin, 60
        new_right[:2, 2] += margin + smallest, 60
        images = []
        for image, k, d, turn, new in (
            (left, matrices[0], distortions[0], turn_left, new_left),
            (right, matrices[1], distortions[1], turn_right, new_right),
        ):
            maps = cv2.initUndistortRectifyMap(k, d, turn, new, wide, cv2.CV_32FC1)
            images.append(
                cv2.remap(
                    image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
                )
            )
        start = match_tiles(*images, count, 1e9)
        disparity, _ = refine(*images, start, np.zeros_like(start))
        xy = pixel_rows(camera, 0, camera.height) - 0.5  # OpenCV's pixel origin
        uv = cv2.undistortPoints(
            xy[:, None], matrices[0], distortions[0], None, turn_left, new_left
        )[:, 0]
        at = uv.astype(np.float32).reshape(camera.height, camera.width, 2)
        seen = sampled(disparity, at).reshape(-1) + smallest
        depth = focal * base / seen
        # The shift of the baseline's sign: the rectified x axis runs to the right one.
        slopes = (uv - new_left[:2, 2]) / focal
        points = depth[:, None] * np.column_stack([slopes, np.ones(len(uv))])
        shape = camera.height, camera.width
        return (points @ turn_left).reshape(*shape, 3), (
            depth**2 / focal / base
        ).reshape(shape)


def _opencv(camera: RefractiveCamera) -> tuple[np.ndarray, np.ndarray]:
    fx, fy, cx, cy, *distortion = camera.camera.params
    # OpenCV counts from the centre of the first pixel.
    matrix = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    return matrix, np.array(distortion)


def aligned(
    found: list[np.ndarray], true: list[np.ndarray], dirs: np.ndarray
) -> Iterator[np.ndarray]:
    """Errors (H, W) of found points along the true lines of sight.

    One rigid motion for all frames takes the pinhole's frame to the camera's: its
    centre and axes are its own, and its points are what matters.
    """
    pairs = [
        (f.reshape(-1, 3)[::37], t[::37]) for f, t in zip(found, true, strict=True)
    ]
    a, b = (np.concatenate(part) for part in zip(*pairs, strict=True))
    keep = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    for _ in range(5):
        mean_a, mean_b = a[keep].mean(axis=0), b[keep].mean(axis=0)
        u, _, vt = np.linalg.svd((b[keep] - mean_b).T @ (a[keep] - mean_a))
        turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        error = np.linalg.norm((a - mean_a) @ turn.T + mean_b - b, axis=1)
        keep = error < 4.0 * np.nanmedian(error)
    for f, t in zip(found, true, strict=True):
        moved = (f.reshape(-1, 3) - mean_a) @ turn.T + mean_b
        yield np.einsum("ni,ni->n", moved - t, dirs).reshape(f.shape[:2])
