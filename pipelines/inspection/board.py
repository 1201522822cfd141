"""The chequerboard of the tank as a dense plane, in single frames and fused."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

import uwsfm
from uwsfm.cloud import Cloud
from uwsfm.dense.depth_map import pixel_rows
from uwsfm.dense.maps import depth_maps
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import closest_points

ASSUMED_PX = 0.3


@dataclass(frozen=True)
class Plane:
    middle: np.ndarray
    normal: np.ndarray

    @classmethod
    def through(cls, points: np.ndarray) -> "Plane":
        middle = points.mean(axis=0)
        return cls(middle, np.linalg.svd(points - middle, full_matrices=False)[2][2])

    def heights(self, points: np.ndarray) -> np.ndarray:
        return (points - self.middle) @ self.normal


@dataclass(frozen=True)
class Frame:
    name: str
    completeness: float
    rms_mm: float
    """Along the line of sight, all pixels of the board that have a depth."""
    predicted_mm: float
    """RMS of the deviations from 0.3 px."""


def single_frames(out: Path, data: Path) -> list[Frame]:
    """Each depth map of the board against its own plane, nothing left out."""
    corners = np.load(data / "tank_corners.npz")
    camera = uwsfm.read_model(out).scene.cameras[0]
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    found = []
    for view, depth in depth_maps(out, data):
        rows = np.flatnonzero(corners["id"] == int(Path(view.name).stem))
        if not len(rows):
            continue
        mask = np.zeros(depth.ranges.shape, dtype=np.uint8)
        outline = cv2.convexHull(corners["L"][rows[0]].astype(np.float32))
        cv2.fillConvexPoly(mask, outline.astype(np.int32), 1)
        seen = (mask > 0) & np.isfinite(depth.ranges)
        flat = seen.ravel()
        points = (origins + depth.ranges.reshape(-1, 1) * dirs)[flat]
        # The plane of the middle 90 %: islands of wrong matches must not tilt it, and
        # count all the same.
        plane = Plane.through(points)
        for _ in range(3):
            far = np.abs(plane.heights(points))
            plane = Plane.through(points[far < np.percentile(far, 90)])
        error = plane.heights(points) / np.abs(dirs[flat] @ plane.normal)
        predicted = ASSUMED_PX * depth.sensitivity[seen]
        found.append(
            Frame(
                name=Path(view.name).name,
                completeness=float(np.count_nonzero(seen) / np.count_nonzero(mask)),
                rms_mm=1e3 * float(np.sqrt(np.mean(error**2))),
                predicted_mm=1e3 * float(np.sqrt(np.mean(predicted**2))),
            )
        )
    return found


@dataclass(frozen=True)
class Fused:
    num_points: int
    rms_mm: float
    stddev_mm: float
    """RMS of what the cloud says of its points."""
    bend_mm: float
    """Largest deviation of the best quadratic surface from its plane, on the board."""
    xy_mm: np.ndarray
    heights_mm: np.ndarray


def fused_board(out: Path, data: Path, cloud: Cloud) -> Fused:
    """The cloud between the outermost corners, against its plane."""
    corners = corners_in_world(out, data)
    plane = Plane.through(corners)
    axes = np.linalg.svd(corners - plane.middle)[2]
    outline = cv2.convexHull(((corners - plane.middle) @ axes[:2].T).astype(np.float32))
    local = (cloud.points - plane.middle) @ axes.T
    # Five centimetres: everything in front of the board and behind it counts.
    near = np.flatnonzero(np.abs(local[:, 2]) < 0.05)
    inside = [
        cv2.pointPolygonTest(outline, (float(x), float(y)), False) >= 0.0
        for x, y in local[near, :2]
    ]
    rows = near[inside]
    plane = Plane.through(cloud.points[rows])
    heights = plane.heights(cloud.points[rows])
    x, y = local[rows, :2].T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    quadratic = terms @ np.linalg.lstsq(terms, heights, rcond=None)[0]
    flat = terms[:, :3] @ np.linalg.lstsq(terms[:, :3], quadratic, rcond=None)[0]
    return Fused(
        num_points=len(rows),
        rms_mm=1e3 * float(np.sqrt(np.mean(heights**2))),
        stddev_mm=1e3 * float(np.sqrt(np.mean(cloud.stddev[rows] ** 2))),
        bend_mm=1e3 * float(np.max(np.abs(quadratic - flat))),
        xy_mm=1e3 * local[rows, :2],
        heights_mm=1e3 * heights,
    )


def corners_in_world(out: Path, data: Path) -> np.ndarray:
    """The board's corners (48, 3), medians over the frames."""
    model = uwsfm.read_model(out)
    scene, corners = model.scene, np.load(data / "tank_corners.npz")
    left, right = scene.cameras
    back = rigid3.inverse(scene.cam_from_rig[1])
    found = []
    for number, xy_left, xy_right in zip(
        corners["id"], corners["L"], corners["R"], strict=True
    ):
        name = f"{number:02d}.png"
        if name not in model.frame_names:
            continue
        world_from_rig = rigid3.inverse(
            scene.rig_from_world[model.frame_names.index(name)]
        )
        origins, dirs = left.ray_from_img(xy_left + 0.5)  # OpenCV -> COLMAP origin
        starts, ways = right.ray_from_img(xy_right + 0.5)
        points, _, _ = closest_points(
            origins, dirs, rigid3.transform(back, starts), rigid3.rotate(back, ways)
        )
        found.append(rigid3.transform(world_from_rig, points))
    return np.median(found, axis=0)
