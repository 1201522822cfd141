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

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from uwsfm._base.progress import Progress, silent
from uwsfm.errors import UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
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
    PairSearch,
    frame_beginnings,
    start_tolerance_px,
)
from uwsfm.sfm.mapping.registration import Ranking, register_next
from uwsfm.sfm.noise_floor import map_floor
from uwsfm.sfm.options import StartOptions

MIN_FRAMES_FOR_HOUSINGS = 3
END_ERRORS = 6.0
"""Times the median error: the tolerance once the housings are adjusted."""
GROWTH = 1.25
"""Everything is adjusted when there are so many times more frames than last time."""
RENEWAL = 1.6
"""All tracks are made again when there are so many times more frames than last time."""
NUM_RIVALS = 3
"""Pairs that begin maps side by side."""
PROBE_FRAMES = 6
"""So large are those maps when the best is chosen: forward motion over a flat scene
fits two frames in two ways, three hardly, and six not at all."""
DOUBTFUL_RATIO = 1.5
"""Of a map's error and its noise floor: a right one stays below 1.1 if lens and ports
are right, and a wrong basin has 5 and more."""
MAX_AGAIN = 2
"""Times that a doubtful map is begun anew."""
SAME_ERROR = 1.2
"""Two maps whose errors differ by less are the same: then lens or rig do not fit."""


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
        progress: Called with the step "mapping", in frames; a map that begins anew,
            or is of the frames that are left, is a step of its own.

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
    with threadpool_limits(1, user_api="blas"):  # the same sums on every machine
        search = _Search(empty, rig, options, progress)
        maps = search.run()
    if not maps:
        raise UwsfmError(search.why_empty())
    return sorted(maps, key=lambda m: -m.num_registered)


class _Search:
    """Where to begin: frames of a rig one by one, pairs in competition."""

    def __init__(
        self, empty: GrowingMap, rig: Rig, options: StartOptions, progress: Progress
    ) -> None:
        self.empty = empty
        self.rig = rig
        self.seed = options.seed
        self.progress = progress
        self.step = "mapping"
        self.left = np.ones(empty.correspondences.num_frames, dtype=bool)
        self.num_tried = 0
        self.max_error_px = start_tolerance_px(empty)
        self.pairs = PairSearch(
            empty, self.left, self.max_error_px, options.scene_distance_m, self.seed
        )

    def run(self) -> list[GrowingMap]:
        """Maps of different frames."""
        maps: list[GrowingMap] = []
        best: GrowingMap | None = None
        num_again = 0
        for group in self._groups():
            self.num_tried += 1
            growing = self._grown(group)
            if growing.num_registered > 1:
                growing.floor = map_floor(
                    growing.correspondences,
                    growing.registered,
                    growing.cameras,
                    growing.cam_from_rig,
                    growing.rig_from_world,
                    self.seed,
                )
            best, rival = _better(best, growing)
            if self._in_doubt(best, rival) and num_again < MAX_AGAIN:
                num_again += 1
                self.step = f"mapping anew, as errors are large (start {num_again + 1})"
                continue
            best.num_starts, num_again = num_again + 1, 0
            self.step = "mapping what is left"
            self.left &= ~best.registered
            if best.num_registered > 1:
                maps.append(best)
            best = None
            largest = max((m.num_registered for m in maps), default=1)
            if largest >= np.count_nonzero(self.left):
                break
        if best is not None and best.num_registered > 1:
            maps.append(best)
        return maps

    def _in_doubt(self, best: GrowingMap, rival: GrowingMap | None) -> bool:
        """Whether another beginning may lead to a better map: what two beginnings led
        to is no matter of where they began."""
        if best.floor is None or best.floor.ratio < DOUBTFUL_RATIO:
            return False
        if rival is None or rival.floor is None:
            return True
        return rival.floor.model_px > SAME_ERROR * best.floor.model_px

    def _groups(self) -> Iterator[list[Beginning]]:
        """Beginnings that compete with each other."""
        for beginning in frame_beginnings(self.empty, self.left, self.max_error_px):
            yield [beginning]
        group: list[Beginning] = []
        for beginning in self.pairs.beginnings():
            group.append(beginning)
            if len(group) == NUM_RIVALS:
                yield group
                group = []
        if group:
            yield group

    def _grown(self, group: Sequence[Beginning]) -> GrowingMap:
        """The map of the beginning that explains most once all have grown a little."""
        growers, progress = [], forward_only(self.progress, self.step)
        for beginning in group:
            growing = self.empty.emptied()
            grower = Grower(growing, self.rig, self.max_error_px, self.seed, progress)
            grower.begin(beginning)
            if len(group) > 1:
                grower.grow(PROBE_FRAMES)
            growers.append(grower)
        winner = growers[0]
        if len(group) > 1:
            winner = max(growers, key=lambda g: explained(g.map, self.max_error_px))
        winner.finish()
        return winner.map

    def why_empty(self) -> str:
        """The sentence for no map at all."""
        if self.num_tried > 0:
            return (
                f"no map could be built, though there were {self.num_tried} ways to "
                "begin: did the rig move between the frames, and do the in-air "
                "intrinsics and cam_from_rig belong to these images?"
            )
        if self.pairs.num_matched:
            widest = np.degrees(self.pairs.widest_angle)
            return (
                f"no map could be built: {self.pairs.num_matched} pairs of frames have "
                "enough matches, but the camera hardly moved between them (the rays "
                f"to a point differ by {widest:.1f} degrees at most): add frames from "
                "other places, or check the intrinsics"
            )
        return (
            "no map could be built: neither do the cameras of a frame share "
            f"{MIN_POINTS} points that other frames see too, nor do two frames; do "
            "consecutive images overlap, is the water clear enough?"
        )


def forward_only(progress: Progress, step: str) -> Callable[[int, int], None]:
    """Reports of maps that grow side by side: the largest so far counts."""
    most = 0

    def report(count: int, total: int) -> None:
        nonlocal most
        most = max(most, count)
        progress(step, most, total)

    return report


def explained(growing: GrowingMap, max_error_px: float) -> float:
    """How much of the verified matches between its frames a map explains, from 0 to 1,
    frames that it lacks of `PROBE_FRAMES` included."""
    of = growing.correspondences
    inside = growing.registered[of.frame[of.matches]].all(axis=1) & of.verified
    if growing.num_registered < 2 or not np.any(inside):
        return 0.0
    gaps = np.nan_to_num(growing.gaps_px(np.flatnonzero(inside)), nan=np.inf)
    fit = 1.0 - np.minimum(gaps / max_error_px, 1.0) ** 2
    return float(np.mean(fit)) * min(growing.num_registered / PROBE_FRAMES, 1.0)


def _better(
    best: GrowingMap | None, other: GrowingMap
) -> tuple[GrowingMap, GrowingMap | None]:
    """The map of two that agrees with more of the matches, and the other one."""
    if best is None:
        return other, None
    scores = [
        explained(growing, MIN_ERROR_PX) * growing.num_registered
        for growing in (best, other)
    ]
    return (best, other) if scores[0] >= scores[1] else (other, best)


class Grower:
    """Grows one map."""

    def __init__(
        self,
        growing: GrowingMap,
        rig: Rig,
        max_error_px: float,
        seed: int,
        progress: Callable[[int, int], None],
    ) -> None:
        self.map = growing
        self.ranking = Ranking(growing)
        self.rig = rig
        self.max_error_px = max_error_px
        self.seed = seed
        self.progress = progress
        self.housings = Housings.of(rig, growing)
        self.housings_moved = False
        self.last_global = 0
        self.last_renewal = 0

    def begin(self, beginning: Beginning) -> None:
        """Place the first frames."""
        self._place(beginning.frames, beginning.rig_from_world)
        self.map.retriangulate(self.max_error_px)
        if self.map.num_registered > 1:
            self._adjust_all(rounds=2)
        self.last_global = self.map.num_registered

    def grow(self, num_frames: int) -> None:
        """Register frames until there are so many or none fits; what failed is tried
        again once everything has been adjusted."""
        growing, total = self.map, self.map.correspondences.num_frames
        while True:
            self.progress(growing.num_registered, total)
            added = None
            if growing.num_registered < num_frames:
                added = register_next(
                    growing, self.ranking, self.max_error_px, self.seed
                )
            count = growing.num_registered
            if added is not None and count < GROWTH * self.last_global:
                points = adjust_locally(growing, neighbours(growing, added))
                growing.filter(points, self.max_error_px)
            elif count > self.last_global:
                self._adjust_all(rounds=1 if added is not None else 2)
                self.last_global = count
            else:
                break

    def finish(self) -> None:
        """Register all frames that fit, and find the points of the finished map."""
        growing = self.map
        self.grow(growing.correspondences.num_frames)
        if growing.num_registered > 1:
            growing.finish_points(self.max_error_px)

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
        for left in reversed(range(rounds)):
            adjust_globally(growing, housings)
            if housings is not None:
                scene, _ = growing.scene()
                errors = np.linalg.norm(scene.residuals(), axis=1)
                self.max_error_px = float(
                    np.clip(
                        END_ERRORS * np.nanmedian(errors), MIN_ERROR_PX, MAX_ERROR_PX
                    )
                )
            self._renew_tracks(at_once=rounds > 1, last=rounds > 1 and left == 0)

    def _renew_tracks(self, at_once: bool, last: bool) -> None:
        """After an adjustment: all tracks anew if the map has grown by much since that
        was done, or ``at_once``; else without what does not fit any more. After the
        ``last`` one a map with all frames is left to `finish`."""
        growing, count = self.map, self.map.num_registered
        if last and count == growing.correspondences.num_frames:
            return
        if not at_once and count < RENEWAL * self.last_renewal:
            growing.filter(np.arange(len(growing.points)), self.max_error_px)
            return
        self.last_renewal = count
        growing.retriangulate(self.max_error_px)
