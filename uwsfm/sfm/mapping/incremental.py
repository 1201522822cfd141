"""The incremental mapper: refraction in every step.

A frame of a rig is a metric map by itself: its cameras' matches, intersected from the
water rays. The next frame is the one that sees most of the map; its pose follows from
water rays, its matches continue the tracks and begin new ones. The frames around it are
adjusted at once, everything from time to time, and with it the housings: the tolerance,
in true pixels, starts from how badly the first guesses of the ports fit, and tightens
as they improve. After each global adjustment the tracks are made again from all
matches that agree with the poses by now, so that no early mistake stays.
"""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_limits

from uwsfm._progress import Progress, silent
from uwsfm.errors import UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.mapping.adjustment import (
    Housings,
    adjust_globally,
    adjust_locally,
    neighbours,
)
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.mapping.initialization import (
    MAX_ERROR_PX,
    MIN_ERROR_PX,
    MIN_POINTS,
    Beginning,
    beginnings,
    start_tolerance_px,
)
from uwsfm.sfm.mapping.registration import Ranking, register_next
from uwsfm.sfm.options import StartOptions

MIN_FRAMES_FOR_HOUSINGS = 3
END_ERRORS = 6.0
"""Times the median error: the tolerance once the housings are adjusted."""
MIN_IMAGES = 3
"""That see a point of the finished map."""
GROWTH = 1.25
"""Everything is adjusted when there are so many times more frames than last time."""


def map_incrementally(
    correspondences: Correspondences,
    rig: Rig,
    cam_from_rig: Array,
    options: StartOptions,
    progress: Progress = silent,
) -> list[GrowingMap]:
    """Register the frames of a rig.

    Args:
        correspondences: Keypoints and matches.
        rig: Lenses, initial ports, and what of them may be refined.
        cam_from_rig: (C, 7) that fits the initial ports.
        options: Those of the mapping are used, and the seed.
        progress: Called with the step "mapping", in frames.

    Returns:
        Maps of different frames, the largest first.

    Raises:
        UwsfmError: nothing could be reconstructed.
    """
    empty = GrowingMap(
        correspondences,
        rig.refractive_cameras(),
        cam_from_rig,
        np.radians(options.mapping.min_angle_deg),
    )
    num_frames = correspondences.num_frames
    left = np.ones(num_frames, dtype=bool)
    maps: list[GrowingMap] = []
    num_tried = 0
    with threadpool_limits(1, user_api="blas"):  # the same sums on every machine
        tolerance = start_tolerance_px(empty)
        ways = beginnings(
            empty, left, tolerance, options.scene_distance_m, options.seed
        )
        for beginning in ways:
            num_tried += 1
            growing = empty.emptied()
            Grower(growing, rig, tolerance, options.seed, progress).grow(beginning)
            left &= ~growing.registered
            if growing.num_registered > 1:
                maps.append(growing)
            largest = max((m.num_registered for m in maps), default=1)
            if largest >= np.count_nonzero(left):
                break
    if not maps:
        raise UwsfmError(_why_empty(num_tried))
    return sorted(maps, key=lambda m: -m.num_registered)


class Grower:
    """Grows one map."""

    def __init__(
        self,
        growing: GrowingMap,
        rig: Rig,
        max_error_px: float,
        seed: int,
        progress: Progress,
    ) -> None:
        self.map = growing
        self.ranking = Ranking(growing)
        self.rig = rig
        self.max_error_px = max_error_px
        self.seed = seed
        self.progress = progress
        self.housings = Housings.of(rig, growing)
        self.housings_moved = False

    def grow(self, beginning: Beginning) -> None:
        """Register frames until none fits; what failed is tried again once everything
        has been adjusted."""
        growing, total = self.map, self.map.correspondences.num_frames
        self._place(beginning.frames, beginning.rig_from_world)
        growing.retriangulate(self.max_error_px)
        if growing.num_registered > 1:
            self._adjust_all(rounds=2)
        last_global = growing.num_registered
        while True:
            self.progress("mapping", growing.num_registered, total)
            added = None
            if growing.num_registered < total:
                added = register_next(
                    growing, self.ranking, self.max_error_px, self.seed
                )
            count = growing.num_registered
            if added is not None and count < GROWTH * last_global:
                points = adjust_locally(growing, neighbours(growing, added))
                growing.filter(points, self.max_error_px)
            elif count > last_global:
                self._adjust_all(rounds=1 if added is not None else 2)
                last_global = count
            else:
                break
        if growing.num_registered > 1:
            growing.retriangulate(self.max_error_px, MIN_IMAGES)

    def _place(self, frames: IndexArray, rig_from_world: Array) -> None:
        poses = self.map.rig_from_world.copy()
        poses[frames] = rig_from_world
        self.map.place(frames, poses)

    def _adjust_all(self, rounds: int) -> None:
        growing = self.map
        housings = None
        if growing.num_registered >= MIN_FRAMES_FOR_HOUSINGS:
            housings = self.housings
        if housings is not None and not self.housings_moved:
            self.housings_moved, rounds = True, 2
            # Turned until now, to make up for the ports that may move from here on.
            if not self.rig.refine_cam_from_rig and self.rig.cam_from_rig is not None:
                growing.set_cameras(growing.cameras, self.rig.cam_from_rig)
        for _ in range(rounds):
            adjust_globally(growing, housings)
            if housings is not None:
                scene, _ = growing.scene()
                errors = np.linalg.norm(scene.residuals(), axis=1)
                self.max_error_px = float(
                    np.clip(
                        END_ERRORS * np.nanmedian(errors), MIN_ERROR_PX, MAX_ERROR_PX
                    )
                )
            growing.retriangulate(self.max_error_px)


def _why_empty(num_tried: int) -> str:
    """The sentence for no map at all."""
    if num_tried == 0:
        return (
            "no map could be built: neither do the cameras of a frame share "
            f"{MIN_POINTS} points that other frames see too, nor do two frames; do "
            "consecutive images overlap, is the water clear enough?"
        )
    return (
        f"no map could be built, though there were {num_tried} ways to begin: did the "
        "rig move between the frames, and do the in-air intrinsics and cam_from_rig "
        "belong to these images?"
    )
