"""Keypoints of all images, numbered through, and the matches between them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from uwsfm._base.indices import renumbered
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.pinhole.mapping_database import indices_of


@dataclass(frozen=True, kw_only=True, eq=False)
class Correspondences:
    """What the images have in common.

    Image ``frame * num_cameras + camera`` holds keypoints ``first[image]`` to
    ``first[image + 1]``.
    """

    num_cameras: int
    num_frames: int
    first: IndexArray
    """(I + 1,)"""
    xy: Array
    """(N, 2) real pixels."""
    image: IndexArray
    """(N,) of each keypoint."""
    matches: IndexArray
    """(M, 2) keypoints, the first of the earlier image."""
    verified: NDArray[np.bool_]
    """(M,) matches that agree with one epipolar geometry of their two images."""

    @cached_property
    def frame(self) -> IndexArray:
        """(N,) of each keypoint."""
        return self.image // self.num_cameras

    @cached_property
    def camera(self) -> IndexArray:
        """(N,) of each keypoint."""
        return self.image % self.num_cameras

    @cached_property
    def camera_of_image(self) -> IndexArray:
        """(I,)"""
        return np.arange(len(self.first) - 1) % self.num_cameras

    def keypoints_of(self, frame: int) -> IndexArray:
        """All keypoints of a frame."""
        ends = self.first[[frame * self.num_cameras, (frame + 1) * self.num_cameras]]
        return np.arange(*ends)

    @cached_property
    def pair(self) -> IndexArray:
        """(M,) which two images each match joins, numbered from 0."""
        images = self.image[self.matches]
        keys = images[:, 0] * np.int64(len(self.first)) + images[:, 1]
        return renumbered(keys, (len(self.first) - 1) * len(self.first))[1]

    def keypoint_idx(self, keypoints: IndexArray) -> IndexArray:
        """Index of keypoints in their own images."""
        return keypoints - self.first[self.image[keypoints]]

    @cached_property
    def _by_frame(self) -> tuple[IndexArray, IndexArray]:
        """Ends of matches sorted by their frames, and where each frame starts."""
        frames = self.frame[self.matches].ravel()
        order = np.argsort(frames, kind="stable")
        start = np.zeros(self.num_frames + 1, dtype=np.int64)
        np.cumsum(np.bincount(frames, minlength=self.num_frames), out=start[1:])
        return order, start

    def ends_of(self, frame: int) -> IndexArray:
        """Which ends of matches are in a frame, rising: of match m, 2 m and 2 m + 1."""
        ends, start = self._by_frame
        return ends[start[frame] : start[frame + 1]]

    def matches_of(self, frame: int) -> IndexArray:
        """Indices of the matches that touch a frame, rising."""
        matches = self.ends_of(frame) >> 1
        return matches[np.diff(matches, prepend=-1) != 0]  # both ends may be in it

    @cached_property
    def linked_frames(self) -> csr_array:
        """`links` by any matches."""
        return self.links(np.ones(len(self.matches), dtype=bool))

    def links(self, chosen: NDArray[np.bool_]) -> csr_array:
        """(F, F) how many of some matches (M,) join two frames, in both directions;
        with itself, a frame has twice its matches."""
        ends = self.frame[self.matches[chosen]]
        a, b = np.concatenate([ends, ends[:, ::-1]]).T
        ones, shape = np.ones(len(a), dtype=np.int64), 2 * (self.num_frames,)
        return csr_array((ones, (a, b)), shape=shape)

    def tracks(
        self, matches: NDArray[np.bool_] | IndexArray
    ) -> tuple[IndexArray, IndexArray]:
        """Sets of keypoints that some of the matches connect.

        Args:
            matches: Mask (M,) or indices.

        Returns:
            Where each track starts (T + 1,), and the keypoints, track after track and
            rising within each.
        """
        ends = self.matches[matches]  # (m, 2)
        keypoints, node = renumbered(ends, len(self.xy))
        graph = coo_array(
            (np.ones(len(node), dtype=np.int8), (node[:, 0], node[:, 1])),
            shape=2 * (len(keypoints),),
        )
        _, track = connected_components(graph, directed=False)
        order = np.argsort(track, kind="stable")
        sizes = np.bincount(track)
        start = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        return start, keypoints[order]


def read_correspondences(
    features_path: Path, mapping_path: Path, frames: Frames, rig: Rig
) -> Correspondences:
    """Keypoints in real pixels, and the matches of `write_mapping_database`.

    Matches of pixels that the calibration in air did not reach are left out.
    """
    num_cameras, num_frames = len(frames.folders), len(frames.names)
    rows = []
    with opened(features_path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for f, c in np.ndindex(num_frames, num_cameras):
            xy = np.empty((0, 2))
            if frames.has_image(c, f):
                stored = database.read_keypoints(ids[frames.image_name(c, f)])
                xy = stored[:, :2].astype(np.float64).reshape(-1, 2)
            rows.append(xy)
    counts = np.array([len(xy) for xy in rows])
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def image_of(image_id: int) -> int:
        camera, frame = indices_of(frames, image_id)
        return frame * num_cameras + camera

    with opened(mapping_path) as database:
        good = {
            pair_id: geometry.inlier_matches
            for pair_id, geometry in zip(
                *database.read_two_view_geometries(), strict=True
            )
        }
        pairs, flags = [np.empty((0, 2), np.int64)], [np.empty(0, dtype=bool)]
        for pair_id, matches in sorted(
            zip(*database.read_all_matches(), strict=True), key=lambda row: row[0]
        ):
            a, b = (image_of(i) for i in pycolmap.pair_id_to_image_pair(pair_id))
            pairs.append(first[[a, b]] + matches.astype(np.int64))
            flags.append(in_rows(matches, good.get(pair_id, matches[:0])))
    xy, image = np.concatenate(rows), np.repeat(np.arange(len(rows)), counts)
    usable = np.ones(len(xy), dtype=bool)
    for index, camera in enumerate(rig.cameras):
        own = image % num_cameras == index
        usable[own] = camera.covers(xy[own])
    all_matches = np.concatenate(pairs)
    kept = usable[all_matches].all(axis=1)
    return Correspondences(
        num_cameras=num_cameras,
        num_frames=num_frames,
        first=first,
        xy=xy,
        image=image,
        matches=all_matches[kept],
        verified=np.concatenate(flags)[kept],
    )


def in_rows(matches: NDArray[np.uint32], some: NDArray[np.uint32]) -> NDArray:
    """Mask (m,) of the rows of ``matches`` (m, 2) that are in ``some``."""
    keys, known = (
        rows.reshape(-1, 2).astype(np.int64) @ [1 << 32, 1] for rows in (matches, some)
    )
    return np.isin(keys, known)
