"""`GrowingMap`: frames, points and tracks while a reconstruction grows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from uwsfm._base.indices import distinct, renumbered
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.observers import Chains, errors_px
from uwsfm.sfm.mapping.tracks import match_gaps_px, triangulate
from uwsfm.sfm.mapping.triangulation import Views
from uwsfm.sfm.noise_floor import NoiseFloor

MIN_IMAGES = 3
"""That see a point of the finished map without having to ask its neighbours."""
NUM_NEIGHBOURS = 5
MAX_DEPTH_RATIO = 1.5
"""Of a point that only two images see and its neighbours': on a reef 0.02 % of the
points that more images see are farther off, and wrong matches are at any depth."""
Mask = NDArray[np.bool_]

MIN_PAIR_MATCHES = 15
MIN_PAIR_SHARE = 0.3
"""Two images that no pinhole geometry joined are joined if so many, and this share, of
their raw matches agree with the poses: by chance one in a hundred does."""


class GrowingMap:
    """Which frames are registered where, and which keypoints see which point.

    While frames are added, points that lost their keypoints keep their row; none has
    after `retriangulate`.

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
        self.chains = Chains.empty(num_keypoints)
        self.changes = np.zeros(num_frames, dtype=np.int64)
        """(F,) counts how often what a frame may see has changed."""
        self.floor: NoiseFloor | None = None
        """Of the finished map; None if too few matches tell."""
        self.num_starts = 1
        """Beginnings that were tried until this one was taken."""
        self._poses = np.zeros((num_frames * correspondences.num_cameras, 12))
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
    def point_of(self) -> IndexArray:
        """(N,) the point that each keypoint sees, or -1."""
        return self.chains.point_of

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
            self._lenses = np.array([camera.lens for camera in self.cameras])
            self._ports = np.array([camera.port.row for camera in self.cameras])
            for c, camera in enumerate(self.cameras):
                rows = np.flatnonzero(self.correspondences.camera == c)
                rays = camera.ray_from_img(self.correspondences.xy[rows])
                self._camera_rays[0, rows], self._camera_rays[1, rows] = rays
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
        images = frames[:, None] * of.num_cameras + np.arange(of.num_cameras)
        images = images.ravel()
        poses = self.cam_from_world(images)
        self._poses[images] = rigid3.matrix_rows(poses)
        for image, world_from_cam in zip(
            images.tolist(), rigid3.inverse(poses), strict=True
        ):
            rows = slice(of.first[image], of.first[image + 1])
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
        return Views(
            cam_from_world=self._poses,
            camera=of.camera_of_image,
            lenses=self._lenses,
            ports=self._ports,
            image=of.image,
            xy=of.xy,
            origins=self._world_rays[0],
            dirs=self._world_rays[1],
        )

    def scene(self) -> tuple[Scene, IndexArray]:
        """All frames and the observations of points, and their keypoints (N',)."""
        seen = np.flatnonzero(self.point_of >= 0)
        return self.scene_of(seen), seen

    def scene_of(self, keypoints: IndexArray) -> Scene:
        """All frames and points, and the observations of some keypoints (n,)."""
        of = self.correspondences
        return Scene(
            cameras=self.cameras,
            cam_from_rig=self.cam_from_rig,
            rig_from_world=self.rig_from_world,
            points=self.points,
            camera_idx=of.camera[keypoints],
            frame_idx=of.frame[keypoints],
            point_idx=self.point_of[keypoints],
            xy=of.xy[keypoints],
        )

    def points_of(self, frames: IndexArray) -> IndexArray:
        """The points that some frames see, rising."""
        of = self.correspondences
        seen = np.concatenate([self.point_of[of.keypoints_of(f)] for f in frames])
        return distinct(seen[seen >= 0])

    def counts(self) -> dict[str, Any]:
        """For the report."""
        scene, _ = self.scene()
        return {
            "num_starts": self.num_starts,
            "noise_floor": None if self.floor is None else self.floor.summary(),
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
        first, second = self.registered[of.frame[of.matches[matches].T]]
        matches = matches[first & second]
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
        self.chains = Chains.empty(len(self.point_of))
        self.changes += 1
        everything = np.arange(len(self.correspondences.matches))
        matches = self.consistent(everything, max_error_px)
        self._add_tracks(matches, max_error_px, min_images)

    def finish_points(self, max_error_px: float) -> None:
        """Find the points of a map that grows no more: all that are well seen, and
        those of two images, of one frame or of two, that fit in between them."""
        self.retriangulate(max_error_px, MIN_IMAGES)
        self.add_pairs(max_error_px)

    def add_pairs(self, max_error_px: float) -> None:
        """Find points that two images see only, where points around them agree.

        Two images always agree on their epipolar line, at whatever depth: the points
        next to it in the first image show which depths are likely.
        """
        of, seen = self.correspondences, np.flatnonzero(self.point_of >= 0)
        matches = self.consistent(np.arange(len(of.matches)), max_error_px)
        new = np.all(self.point_of[of.matches[matches]] < 0, axis=1)
        num_points = len(self.points)
        self._add_tracks(matches[new], max_error_px)
        alone = np.flatnonzero(self.point_of >= num_points)
        odd = np.zeros(len(self.points), dtype=bool)
        for image in distinct(of.image[alone]).tolist():
            mine, sure = (rows[of.image[rows] == image] for rows in (alone, seen))
            if len(sure) < NUM_NEIGHBOURS:
                odd[self.point_of[mine]] = True
                continue
            _, near = cKDTree(of.xy[sure]).query(of.xy[mine], k=NUM_NEIGHBOURS)
            likely = np.median(self._depths(image, sure)[near], axis=1)
            ratio = self._depths(image, mine) / likely
            strange = ~((ratio > 1.0 / MAX_DEPTH_RATIO) & (ratio < MAX_DEPTH_RATIO))
            odd[self.point_of[mine[strange]]] = True
        self.chains.unlink(alone[odd[self.point_of[alone]]])
        self._drop_empty_points()

    def _drop_empty_points(self) -> None:
        """Number the points that keypoints see anew."""
        seen = np.flatnonzero(self.point_of >= 0)
        used, point_of = renumbered(self.point_of[seen], len(self.points))
        self.points = self.points[used]
        self.chains = Chains.empty(len(self.point_of)).with_room(len(used))
        self._see(seen, point_of)

    def _depths(self, image: int, keypoints: IndexArray) -> Array:
        """Of the points (n,) that keypoints of an image see."""
        points = self.points[self.point_of[keypoints]]
        return rigid3.transform(self.cam_from_world(image), points)[:, 2]

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
        self._see(keypoints[order], points[order])

    def _see(self, keypoints: IndexArray, points: IndexArray) -> None:
        self.chains.link(keypoints, points)
        self._note_change(keypoints)

    def _note_change(self, keypoints: IndexArray) -> None:
        """What frames that match these keypoints could see is not known any more."""
        of = self.correspondences
        frames = distinct(of.frame[keypoints])
        self.changes[distinct(of.linked_frames[frames].indices)] += 1

    def errors_px(self, keypoints: IndexArray, points: IndexArray) -> Array:
        """True pixel errors (n,) of keypoints at points; inf if not visible."""
        return errors_px(self.views(), keypoints, self.points[points])

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
        old = len(self.points)
        self.points = np.concatenate([self.points, found.points])
        self.chains = self.chains.with_room(len(self.points))
        self._see(keypoints[seen], old + found.point_of[seen])

    def filter(self, points: IndexArray, max_error_px: float) -> None:
        """Drop observations that miss some points (n,), and such of them as are seen
        once."""
        seen = self.chains.of_points(points)
        bad = seen[self.errors_px(seen, self.point_of[seen]) > max_error_px]
        self.chains.unlink(bad)
        left = self.chains.of_points(points)
        seen_by = self.point_of[left]
        alone = left[np.bincount(seen_by)[seen_by] < 2]
        self.chains.unlink(alone)
        self._note_change(np.concatenate([bad, alone]))

    def visible(
        self, frames: IndexArray, verified: bool
    ) -> tuple[IndexArray, IndexArray]:
        """Keypoints of frames that are not registered, and the points they match (n,).

        Args:
            frames: Different ones.
            verified: By verified matches only, or by any.
        """
        of = self.correspondences
        rows = [of.ends_of(f) for f in frames.tolist()]
        ends = np.concatenate([*rows, np.empty(0, dtype=np.int64)])
        if verified:
            ends = ends[of.verified[ends >> 1]]
        keypoints = of.matches.reshape(-1)
        points = self.point_of[keypoints[ends ^ 1]]  # of the other ends
        seen = points >= 0
        keys = keypoints[ends[seen]] * len(self.points) + points[seen]
        return np.divmod(distinct(keys), max(len(self.points), 1))


def _firsts(keys: IndexArray) -> IndexArray:
    """Sorted positions at which each key is met for the first time."""
    return np.sort(np.unique(keys, return_index=True)[1])
