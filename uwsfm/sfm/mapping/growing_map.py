"""`GrowingMap`: frames, points and tracks while a reconstruction grows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.triangulation import Views, match_gaps_px, triangulate
from uwsfm.solver.state import State

Mask = NDArray[np.bool_]

MIN_PAIR_MATCHES = 15
MIN_PAIR_SHARE = 0.3
"""Two images that no pinhole geometry joined are joined if so many, and this share, of
their raw matches agree with the poses: by chance one in a hundred does."""


class GrowingMap:
    """Which frames are registered where, and which keypoints see which point.

    Args:
        correspondences: Keypoints and matches.
        cameras: With their present ports.
        cam_from_rig: (C, 7)
        min_angle: Between the rays of a point, radians.
    """

    def __init__(
        self,
        correspondences: Correspondences,
        cameras: Sequence[RefractiveCamera],
        cam_from_rig: Array,
        min_angle: float,
    ) -> None:
        self.correspondences = correspondences
        self.min_angle = min_angle
        num_frames, num_keypoints = correspondences.num_frames, len(correspondences.xy)
        self.registered = np.zeros(num_frames, dtype=bool)
        self.rig_from_world = np.tile(rigid3.IDENTITY, (num_frames, 1))
        self.points = np.empty((0, 3))
        self.point_of = np.full(num_keypoints, -1, dtype=np.int64)
        self._world_rays = np.full((2, num_keypoints, 3), np.nan)
        self._camera_rays = np.full((2, num_keypoints, 3), np.nan)
        self.cameras: tuple[RefractiveCamera, ...] = ()
        self.cam_from_rig = cam_from_rig
        self.set_cameras(cameras, cam_from_rig)

    def emptied(self) -> GrowingMap:
        """A map of the same images and cameras without frames."""
        return GrowingMap(
            self.correspondences, self.cameras, self.cam_from_rig, self.min_angle
        )

    @property
    def num_registered(self) -> int:
        return int(np.count_nonzero(self.registered))

    def set_cameras(
        self, cameras: Sequence[RefractiveCamera], cam_from_rig: Array
    ) -> None:
        """Change lenses, ports or the rig: all water rays move."""
        changed = tuple(cameras) != self.cameras
        self.cameras, self.cam_from_rig = tuple(cameras), cam_from_rig
        if changed:
            for c, camera in enumerate(self.cameras):
                rows = self.correspondences.camera == c
                self._camera_rays[:, rows] = camera.ray_from_img(
                    self.correspondences.xy[rows]
                )
        self.place(np.flatnonzero(self.registered), self.rig_from_world)

    def place(self, frames: IndexArray, rig_from_world: Array) -> None:
        """Register frames, or move them.

        Args:
            frames: (n,)
            rig_from_world: (F, 7) of which the rows of ``frames`` are read.
        """
        self.registered[frames] = True
        self.rig_from_world[frames] = rig_from_world[frames]
        of = self.correspondences
        for f in frames.tolist():
            for c in range(of.num_cameras):
                image = f * of.num_cameras + c
                rows = slice(of.first[image], of.first[image + 1])
                world_from_cam = rigid3.inverse(self.cam_from_world(image))
                origins, dirs = self._camera_rays[:, rows]
                self._world_rays[0, rows] = rigid3.transform(world_from_cam, origins)
                self._world_rays[1, rows] = rigid3.rotate(world_from_cam, dirs)

    def cam_from_world(self, image: int | IndexArray) -> Array:
        """Poses (..., 7) of registered images."""
        frame, camera = np.divmod(image, self.correspondences.num_cameras)
        return rigid3.compose(self.cam_from_rig[camera], self.rig_from_world[frame])

    def views(self) -> Views:
        """Rows for `triangulate`."""
        of = self.correspondences
        images = np.arange(of.num_frames * of.num_cameras)
        state = State.from_scene(self.scene()[0])
        return Views(
            cam_from_world=rigid3.matrix_rows(self.cam_from_world(images)),
            camera=images % of.num_cameras,
            lenses=state.lenses,
            ports=state.ports,
            image=of.image,
            xy=of.xy,
            origins=self._world_rays[0],
            dirs=self._world_rays[1],
        )

    def scene(self) -> tuple[Scene, IndexArray]:
        """All frames and the observations of points, and their keypoints (N',)."""
        of = self.correspondences
        seen = np.flatnonzero(self.point_of >= 0)
        scene = Scene(
            cameras=self.cameras,
            cam_from_rig=self.cam_from_rig,
            rig_from_world=self.rig_from_world,
            points=self.points,
            camera_idx=of.camera[seen],
            frame_idx=of.frame[seen],
            point_idx=self.point_of[seen],
            xy=of.xy[seen],
        )
        return scene, seen

    def counts(self) -> dict[str, float]:
        """For the report."""
        scene, _ = self.scene()
        return {
            "num_points": scene.num_points,
            "num_observations": scene.num_observations,
            "mean_error_px": float(
                np.nanmean(np.linalg.norm(scene.residuals(), axis=1))
            ),
        }

    def gaps_px(self, matches: IndexArray) -> Array:
        """By how many pixels the water rays of matches (n,) miss each other."""
        ends = self.correspondences.matches[matches]
        return match_gaps_px(self.views(), np.ascontiguousarray(ends))

    def consistent(self, matches: IndexArray, max_error_px: float) -> IndexArray:
        """Those of some matches between registered frames that agree with the poses.

        Pairs of images that the verification did not join have to earn it.
        """
        of = self.correspondences
        there = self.registered[of.frame[of.matches[matches]]].all(axis=1)
        matches = matches[there]
        good = self.gaps_px(matches) <= max_error_px
        pair = of.pair[matches]
        num_good, num_all, num_verified = (
            np.bincount(pair, weights=weights, minlength=pair.max(initial=-1) + 1)
            for weights in (good, None, of.verified[matches])
        )
        joined = num_verified > 0
        joined |= (num_good >= MIN_PAIR_MATCHES) & (
            num_good >= MIN_PAIR_SHARE * num_all
        )
        return matches[good & joined[pair]]

    def retriangulate(self, max_error_px: float, min_images: int = 2) -> None:
        """Find all points anew, from all matches that agree with the poses."""
        self.points = np.empty((0, 3))
        self.point_of[:] = -1
        everything = np.arange(len(self.correspondences.matches))
        matches = self.consistent(everything, max_error_px)
        self._add_tracks(matches, max_error_px, min_images)

    def extend(self, frame: int, max_error_px: float) -> None:
        """Let a registered frame see the points it matches, and find new ones."""
        of = self.correspondences
        matches = self.consistent(of.matches_of(frame), max_error_px)
        self._continue_tracks(frame, matches, max_error_px)
        new = np.all(self.point_of[of.matches[matches]] < 0, axis=1)
        self._add_tracks(matches[new], max_error_px)

    def _continue_tracks(
        self, frame: int, matches: IndexArray, max_error_px: float
    ) -> None:
        """Each keypoint takes the matched point that it is nearest to, within reach."""
        of = self.correspondences
        ends = of.matches[matches]
        ends = np.concatenate([ends, ends[:, ::-1]])
        ends = ends[(of.frame[ends[:, 0]] == frame) & (self.point_of[ends[:, 1]] >= 0)]
        keypoints, points = ends[:, 0], self.point_of[ends[:, 1]]
        errors = self.errors_px(keypoints, points)
        order = np.lexsort((points, keypoints, errors))
        order = order[errors[order] <= max_error_px]
        # The best of each keypoint, then the best of each point in an image.
        order = order[_firsts(keypoints[order])]
        image = of.image[keypoints[order]]
        order = order[_firsts(points[order] * np.int64(len(of.first)) + image)]
        self.point_of[keypoints[order]] = points[order]

    def errors_px(self, keypoints: IndexArray, points: IndexArray) -> Array:
        """True pixel errors (n,) of keypoints at points; inf if not visible."""
        of = self.correspondences
        in_cam = rigid3.transform(
            self.cam_from_world(of.image[keypoints]), self.points[points]
        )
        errors = np.full(len(keypoints), np.inf)
        for c, camera in enumerate(self.cameras):
            rows = np.flatnonzero(of.camera[keypoints] == c)
            xy, valid = camera.img_from_point(in_cam[rows])
            miss = np.linalg.norm(xy - of.xy[keypoints[rows]], axis=1)
            errors[rows] = np.where(valid, miss, np.inf)
        return errors

    def _add_tracks(
        self, matches: IndexArray, max_error_px: float, min_images: int = 2
    ) -> None:
        if len(matches) == 0:
            return
        start, keypoints = self.correspondences.tracks(matches)
        found = triangulate(
            self.views(), start, keypoints, max_error_px, self.min_angle, min_images
        )
        seen = found.point_of >= 0
        self.point_of[keypoints[seen]] = len(self.points) + found.point_of[seen]
        self.points = np.concatenate([self.points, found.points])

    def filter(self, max_error_px: float) -> None:
        """Drop observations that miss their point, and points seen once."""
        seen = np.flatnonzero(self.point_of >= 0)
        errors = self.errors_px(seen, self.point_of[seen])
        self.point_of[seen[errors > max_error_px]] = -1
        seen = np.flatnonzero(self.point_of >= 0)
        counts = np.bincount(self.point_of[seen], minlength=len(self.points))
        kept = counts >= 2
        new = np.where(kept, np.cumsum(kept) - 1, -1)
        self.point_of[seen] = new[self.point_of[seen]]
        self.points = self.points[kept]

    def visible(self, verified: bool) -> tuple[IndexArray, IndexArray]:
        """Keypoints of frames not yet registered, and the points they match (n,).

        Args:
            verified: By verified matches only, or by any.
        """
        of = self.correspondences
        ends = of.matches[of.verified] if verified else of.matches
        ends = np.concatenate([ends, ends[:, ::-1]])
        new = ~self.registered[of.frame[ends[:, 0]]]
        ends = ends[new & (self.point_of[ends[:, 1]] >= 0)]
        keys = ends[:, 0] * len(self.points) + self.point_of[ends[:, 1]]
        return np.divmod(np.unique(keys), len(self.points))


def _firsts(keys: IndexArray) -> IndexArray:
    """Sorted positions at which each key is met for the first time."""
    return np.sort(np.unique(keys, return_index=True)[1])
