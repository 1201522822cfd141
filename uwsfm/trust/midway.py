"""What changed midway: the zoom of a lens, or which images belong together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.models.lens_row import CENTER, FX
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.trust.mistakes import FOCAL, FREE, MIN_FRAMES_LEFT, Trial, shifts
from uwsfm.trust.trials import Fit, adjusted

NUM_COARSE = 7
"""Frames from which on a zoom may have changed, before their neighbours are tried."""
ZOOM_HANDICAP = 2.0 * FREE
"""Two focal lengths for each camera."""
POWERS = (0.7, 1.4)
"""Of a change of zoom that are tried after it."""
MIN_ZOOM = 0.006
"""Relative: a smaller change of the focal length is none."""
CLEAR_CHANGE = 3.0
"""By how many times the errors of one camera grow where its images are no more those of
the frame."""


@dataclass(frozen=True, kw_only=True)
class ZoomTrial(Trial):
    """Focal lengths of their own before and after a frame, everything else as one."""

    ratios: tuple[float, ...] = ()
    """(C,) after over before; empty: as the two parts of the dive have them, each
    adjusted alone. Their ports then move as well, so that is only a start."""

    def fit(self, scene: Scene, options: dict[str, Any]) -> Fit | None:
        free = {**options, **FOCAL}
        ratios = np.array(self.ratios or self._of_parts(scene, free))
        if np.abs(ratios - 1.0).max(initial=0.0) < MIN_ZOOM:
            return None
        late = scene.frame_idx >= self.first
        factor = np.where(late, ratios[scene.camera_idx], 1.0)
        lenses = np.array([camera.lens for camera in self.rig.refractive_cameras()])
        center = lenses[scene.camera_idx, CENTER]
        xy = center + (scene.xy - center) / factor[:, None]
        fit = adjusted(replace(scene, xy=xy), self.rig, **free)
        if fit is None:
            return None
        before = np.array([camera.lens[FX] for camera in fit.scene.cameras])
        squares = fit.squares * factor**2  # of the pixels that were given
        return replace(fit, squares=squares, focals=(before, ratios * before))

    def _of_parts(self, scene: Scene, options: dict[str, Any]) -> list[float]:
        late = scene.frame_idx >= self.first
        parts = [
            adjusted(_in_frames(scene, rows), self.rig, **options)
            for rows in (~late, late)
        ]
        before, after = (
            [] if part is None else [camera.lens[FX] for camera in part.scene.cameras]
            for part in parts
        )
        if not before or not after:
            return []
        return [b / a for a, b in zip(before, after, strict=True)]


def zoom_trial(rig: Rig, first: int, first_name: str) -> ZoomTrial:
    """Another zoom from a frame on."""
    return ZoomTrial(
        code="zoom_changed",
        what=f"the focal length is another one from frame {first_name} on",
        remedy="reconstruct the frames before and after it with a lens of their own, "
        "and hold zoom and focus in the next dive",
        rig=rig,
        first=first,
        handicap=ZOOM_HANDICAP,
        estimate=_zoom_words,
    )


def nearby_zooms(trial: ZoomTrial, fit: Fit) -> list[ZoomTrial]:
    """Less of a change, more of it, and that of one camera alone."""
    assert fit.focals is not None
    before, after = fit.focals
    ratios = after / before
    count = len(ratios)
    several = [ratios**power for power in POWERS]
    if count > 1:
        every = float(np.exp(np.mean(np.log(ratios))))
        several += [np.full(count, every**power) for power in (1.0, *POWERS)]
        several += [np.where(np.arange(count) == c, ratios, 1.0) for c in range(count)]
    return [replace(trial, ratios=tuple(some.tolist())) for some in several]


def _zoom_words(fit: Fit) -> str:
    assert fit.focals is not None
    before, after = fit.focals
    return f" ({', '.join(f'{ratio:.3f} times' for ratio in after / before)})"


def coarse_firsts(num_frames: int) -> list[int]:
    """Frames (from 0) from which on the zoom may have changed: some of them."""
    last = num_frames - MIN_FRAMES_LEFT
    if last < MIN_FRAMES_LEFT:
        return []
    places = np.linspace(MIN_FRAMES_LEFT, last, min(NUM_COARSE, last - 1))
    return np.unique(places.round().astype(int)).tolist()


def fine_firsts(first: int, num_frames: int) -> list[int]:
    """Those between the best of `coarse_firsts` and its neighbours there."""
    coarse = coarse_firsts(num_frames)
    best = coarse.index(first)
    low = coarse[max(best - 1, 0)]
    high = coarse[min(best + 1, len(coarse) - 1)]
    return [first for first in range(low + 1, high) if first not in coarse]


def _in_frames(scene: Scene, keep: NDArray[np.bool_]) -> Scene:
    """Some frames and what they see twice."""
    counts = np.bincount(scene.point_idx[keep], minlength=scene.num_points)
    part, _ = scene.select(keep & (counts[scene.point_idx] >= 2))
    frames, frame_idx = np.unique(part.frame_idx, return_inverse=True)
    return replace(
        part,
        rig_from_world=part.rig_from_world[frames],
        frame_idx=frame_idx.astype(np.int64),
    )


def shifts_since(
    rig: Rig, scene: Scene, fit: Fit, frame_names: Sequence[str]
) -> Iterator[Trial]:
    """One camera late or early from a frame on, if its errors jump at one.

    Args:
        rig: As given.
        scene: The observations that ``fit`` is of.
        fit: Of the rig as given.
        frame_names: Of the scene's frames.
    """
    for camera in range(1, len(rig.cameras)):
        first = _jump(scene, fit, camera)
        if first is None:
            continue
        for start in (first - 1, first, first + 1):
            if MIN_FRAMES_LEFT <= start <= scene.num_frames - MIN_FRAMES_LEFT:
                yield from shifts(rig, scene.num_frames, start, frame_names[start])


def _jump(scene: Scene, fit: Fit, camera: int) -> int | None:
    """The frame at which the errors of one camera grow most; None if they do not."""
    errors = np.full(scene.num_frames, np.nan)
    for frame in range(scene.num_frames):
        rows = (scene.frame_idx == frame) & (scene.camera_idx == camera)
        if rows.any():
            errors[frame] = 0.5 * np.log(np.median(fit.squares[rows]) + 1e-6)
    rises = [
        (float(np.nanmean(errors[f:]) - np.nanmean(errors[:f])), f)
        for f in coarse_range(scene.num_frames)
        if np.isfinite(errors[f:]).any() and np.isfinite(errors[:f]).any()
    ]
    if not rises or max(rises)[0] < np.log(CLEAR_CHANGE):
        return None
    return max(rises)[1]


def coarse_range(num_frames: int) -> range:
    """Frames from which on something may have changed."""
    return range(MIN_FRAMES_LEFT, num_frames - MIN_FRAMES_LEFT + 1)
