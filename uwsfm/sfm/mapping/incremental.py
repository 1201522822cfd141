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
from uwsfm.sfm.mapping.adjustment import (
    Housings,
    adjust_globally,
    adjust_locally,
    neighbours,
)
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.mapping.registration import register_next
from uwsfm.sfm.options import StartOptions

MIN_SEED_POINTS = 30
"""That the cameras of the first frame see together."""
MIN_FRAMES_FOR_HOUSINGS = 3
START_GAPS = 5.0
"""Times the median gap of the matches of single frames: the tolerance at the start."""
END_ERRORS = 6.0
"""Times the median error: the tolerance once the housings are adjusted."""
MIN_ERROR_PX = 4.0
MAX_ERROR_PX = 30.0
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
    with threadpool_limits(1, user_api="blas"):  # the same sums on every machine
        return _Maps(correspondences, rig, cam_from_rig, options, progress).all()


class _Maps:
    """One map after the other, until no frame is left to begin with."""

    def __init__(
        self,
        correspondences: Correspondences,
        rig: Rig,
        cam_from_rig: Array,
        options: StartOptions,
        progress: Progress,
    ) -> None:
        self.of = correspondences
        self.rig = rig
        self.cam_from_rig = cam_from_rig
        self.options = options
        self.progress = progress

    def all(self) -> list[GrowingMap]:
        max_error_px, seeds = self._seeds()
        left = np.ones(self.of.num_frames, dtype=bool)
        maps: list[GrowingMap] = []
        for frame in seeds:
            largest = max((m.num_registered for m in maps), default=1)
            if largest >= np.count_nonzero(left):
                break
            if not left[frame]:
                continue
            growing = self._empty()
            grower = _Grower(
                growing, self.rig, max_error_px, self.options.seed, self.progress
            )
            grower.begin_with_frame(frame)
            grower.grow()
            left &= ~growing.registered
            if growing.num_registered > 1:
                maps.append(growing)
        if not maps:
            raise UwsfmError(_why_empty(self.of, seeds))
        return sorted(maps, key=lambda m: -m.num_registered)

    def _empty(self) -> GrowingMap:
        return GrowingMap(
            self.of,
            self.rig.refractive_cameras(),
            self.cam_from_rig,
            np.radians(self.options.mapping.min_angle_deg),
        )

    def _seeds(self) -> tuple[float, list[int]]:
        """The tolerance at the start, px, and frames to begin with, best first."""
        of, growing = self.of, self._empty()
        frames = of.frame[of.matches]
        same_frame = np.flatnonzero(frames[:, 0] == frames[:, 1])
        growing.place(np.arange(of.num_frames), growing.rig_from_world)
        gaps = growing.gaps_px(same_frame)
        typical = np.nanmedian(gaps[of.verified[same_frame]])
        max_error_px = float(np.clip(START_GAPS * typical, MIN_ERROR_PX, MAX_ERROR_PX))
        linked = np.zeros(len(of.xy), dtype=bool)
        linked[of.matches[of.verified & (frames[:, 0] != frames[:, 1])]] = True
        useful = linked[of.matches[same_frame]].any(axis=1) & (gaps <= max_error_px)
        counts = np.bincount(frames[same_frame[useful], 0], minlength=of.num_frames)
        order = np.argsort(-counts, kind="stable")
        return max_error_px, order[counts[order] >= MIN_SEED_POINTS].tolist()


class _Grower:
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
        self.rig = rig
        self.max_error_px = max_error_px
        self.seed = seed
        self.progress = progress
        self.housings = Housings.of(rig, growing)
        self.housings_moved = False

    def begin_with_frame(self, frame: int) -> None:
        """A frame of a rig: its own matches, metric."""
        self.map.place(np.array([frame]), self.map.rig_from_world)
        self.map.retriangulate(self.max_error_px)

    def grow(self) -> None:
        """Register frames until none fits; what failed is tried again once everything
        has been adjusted."""
        growing, total = self.map, self.map.correspondences.num_frames
        last_global = 1
        while True:
            self.progress("mapping", growing.num_registered, total)
            added = register_next(growing, self.max_error_px, self.seed)
            count = growing.num_registered
            if added is None:
                if count < total and count > last_global:
                    self._adjust_all(rounds=2)
                    last_global = count
                    continue
                if count > last_global:
                    self._adjust_all(rounds=1)
                # The end: what only two images saw stays out.
                if count > 1:
                    growing.retriangulate(self.max_error_px, MIN_IMAGES)
                return
            elif count >= GROWTH * last_global:
                self._adjust_all(rounds=1)
                last_global = count
            else:
                adjust_locally(growing, neighbours(growing, added))
                growing.filter(self.max_error_px)

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


def _why_empty(of: Correspondences, seeds: list[int]) -> str:
    """The sentence for a map without a second frame."""
    if not seeds:
        return (
            "no map could be built: in no frame do the cameras share "
            f"{MIN_SEED_POINTS} points that other frames see too; do consecutive "
            "images overlap, is the water clear enough?"
        )
    return (
        f"no map could be built, though {len(seeds)} frames could begin one: did the "
        "rig move between the frames, and do the in-air intrinsics and cam_from_rig "
        "belong to these images?"
    )
