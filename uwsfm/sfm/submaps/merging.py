"""From submaps to one map: places by what neighbours share, tracks by all matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from uwsfm._base.progress import Progress, silent
from uwsfm.errors import UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.joint_alignment import Link, Placement, align_jointly
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import port_from_row, rows_with
from uwsfm.models.ports.row import AXIS
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.mapping.incremental import Grower, forward_only
from uwsfm.sfm.mapping.initialization import (
    MAX_ERROR_PX,
    MIN_ERROR_PX,
    START_GAPS,
    Beginning,
)
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.submaps.submap import Submap

MIN_SHARED = {True: 1, False: 2}
"""Frames that two maps must share, whether the rig is a metre or not."""


@dataclass(frozen=True, kw_only=True)
class Merged:
    """A survey in one map."""

    map: GrowingMap
    sizes: list[int]
    """Frames of each submap."""
    others: list[int]
    """Numbers of frames of the groups that nothing joins to it."""
    num_links: int
    seam_px: float
    """By how much matches across the seams missed each other before the adjustment,
    median, true pixels."""

    def summary(self) -> dict[str, Any]:
        """For the report."""
        return {
            "num_frames": self.sizes,
            "num_links": self.num_links,
            "seam_px": self.seam_px,
        }


def merge_submaps(
    correspondences: Correspondences,
    submaps: Sequence[Submap],
    rig: Rig,
    cam_from_rig: Array,
    options: StartOptions,
    progress: Progress = silent,
) -> Merged:
    """Place submaps, make the tracks again from all matches, and adjust everything.

    Args:
        correspondences: Of the whole survey.
        submaps: Maps of parts that overlap.
        rig: As of `map_incrementally`.
        cam_from_rig: (C, 7) that fits the initial ports.
        options: Those of the mapping are used, and the seed.
        progress: Called with the step "merging".

    Raises:
        UwsfmError: there is no submap.
    """
    if not submaps:
        raise UwsfmError(
            "no part of the survey could be mapped: do consecutive images overlap, and "
            "do the in-air intrinsics and cam_from_rig belong to these images?"
        )
    progress("merging", 0, None)
    metric = len(rig.cameras) > 1
    links = shared_places(submaps, MIN_SHARED[metric])
    placement = align_jointly(
        len(submaps), links, with_scale=not metric, seed=options.seed
    )
    sizes = [
        len(np.unique(np.concatenate([submaps[k].frames for k in members])))
        for members in _members(placement)
    ]
    chosen = _members(placement)[int(np.argmax(sizes))]
    growing = GrowingMap(
        correspondences,
        rig.refractive_cameras(),
        cam_from_rig,
        np.radians(options.mapping.min_angle_deg),
    )
    with threadpool_limits(1, user_api="blas"):
        report = forward_only(progress, "mapping")
        grower = Grower(growing, rig, MAX_ERROR_PX, options.seed, report)
        progress("merging", 1, 1)
        _set_housings(growing, [submaps[k] for k in chosen])
        beginning, source = _poses(placement, submaps, chosen)
        seam_px = _seam_px(growing, beginning, source)
        grower.max_error_px = min(max(START_GAPS * seam_px, MIN_ERROR_PX), MAX_ERROR_PX)
        grower.begin(beginning)
        grower.finish()
    return Merged(
        map=growing,
        sizes=[len(submap.frames) for submap in submaps],
        others=sorted((s for s in sizes if s != max(sizes)), reverse=True),
        num_links=len(links),
        seam_px=seam_px,
    )


def _members(placement: Placement) -> list[IndexArray]:
    """The maps of each group."""
    groups = range(int(placement.group.max()) + 1)
    return [np.flatnonzero(placement.group == group) for group in groups]


def shared_places(submaps: Sequence[Submap], min_frames: int) -> list[Link]:
    """Points that two submaps have from the same keypoint, and rigs of shared frames.

    Args:
        submaps: Maps.
        min_frames: That two maps have to share.
    """
    links = []
    for a, b in combinations(range(len(submaps)), 2):
        one, two = submaps[a], submaps[b]
        _, *rows = np.intersect1d(
            one.frames, two.frames, assume_unique=True, return_indices=True
        )
        if len(rows[0]) < min_frames:
            continue
        _, *seen = np.intersect1d(
            one.keypoints, two.keypoints, assume_unique=True, return_indices=True
        )
        points = np.column_stack([one.point_of[seen[0]], two.point_of[seen[1]]])
        in_a, in_b = np.unique(points, axis=0).T
        centers = [
            rigid3.inverse(submap.rig_from_world[row])[:, 4:]
            for submap, row in zip((one, two), rows, strict=True)
        ]
        links.append(
            Link(
                a,
                b,
                np.concatenate([centers[0], one.points[in_a]]),
                np.concatenate([centers[1], two.points[in_b]]),
            )
        )
    return links


def _set_housings(growing: GrowingMap, submaps: Sequence[Submap]) -> None:
    """The mean of the submaps' ports, lenses and rigs, by their observations."""
    counts = np.array([len(submap.keypoints) for submap in submaps], dtype=np.float64)

    def mean(rows: Sequence[Array]) -> Array:
        return np.average(np.array(rows), axis=0, weights=counts)

    ports, lenses = mean([s.ports for s in submaps]), mean([s.lenses for s in submaps])
    lengths = np.linalg.norm(ports[:, AXIS], axis=1)
    normals = rows_with(ports, "normal") & (lengths > 0.0)
    ports[normals, AXIS] /= lengths[normals, None]
    rotations = mean([rigid3.rotmat_from_quat(s.cam_from_rig[:, :4]) for s in submaps])
    shifts = mean([s.cam_from_rig[:, 4:] for s in submaps])
    # The mean of directions is shorter than they are, and the baseline is held.
    baselines = [np.linalg.norm(s.cam_from_rig[:, 4:], axis=1) for s in submaps]
    shifts[1:] *= (mean(baselines)[1:] / np.linalg.norm(shifts[1:], axis=1))[:, None]
    growing.set_cameras(
        [
            camera.with_port(port_from_row(port)).with_lens(lens)
            for camera, port, lens in zip(growing.cameras, ports, lenses, strict=True)
        ],
        rigid3.from_rotmat(rotations, shifts),
    )


def _poses(
    placement: Placement, submaps: Sequence[Submap], chosen: IndexArray
) -> tuple[Beginning, IndexArray]:
    """Each frame where the submap has it that knows it best; and which one that is."""
    best: dict[int, tuple[int, int, Array]] = {}
    for k in chosen.tolist():
        submap = submaps[k]
        world_from_map = placement.world_from_map[k]
        poses = submap.rig_from_world.copy()
        poses[:, 4:] *= placement.scale[k]
        poses = rigid3.compose(poses, rigid3.inverse(world_from_map))
        for frame, count, pose in zip(
            submap.frames.tolist(), submap.num_seen.tolist(), poses, strict=True
        ):
            if frame not in best or count > best[frame][0]:
                best[frame] = (count, k, pose)
    frames = np.array(sorted(best), dtype=np.int64)
    source = np.array([best[f][1] for f in frames.tolist()], dtype=np.int64)
    poses = np.array([best[f][2] for f in frames.tolist()])
    return Beginning(frames=frames, rig_from_world=poses), source


def _seam_px(growing: GrowingMap, beginning: Beginning, source: IndexArray) -> float:
    """Median gap of the verified matches between frames of different submaps."""
    of = growing.correspondences
    poses = growing.rig_from_world.copy()
    poses[beginning.frames] = beginning.rig_from_world
    growing.place(beginning.frames, poses)
    owner = np.full(of.num_frames, -1)
    owner[beginning.frames] = source
    ends = owner[of.frame[of.matches]]
    across = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1]) & of.verified
    if not np.any(across):
        return 0.0
    return float(np.median(growing.gaps_px(np.flatnonzero(across))))
