"""What changed midway: the zoom of a lens, or which images belong together."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm.geometry.rigid3 import Array
from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.trust.mistakes import FOCAL, MIN_FRAMES_LEFT, Trial, shifts
from uwsfm.trust.trials import Fit, adjusted

NUM_COARSE = 7
"""Frames from which on a zoom may have changed, before their neighbours are tried."""
ZOOM_HANDICAP = 4.0
"""Two focal lengths for each camera, and every track cut in two: a lot is freed."""
MIN_ZOOM = 0.006
"""Relative: a smaller change of the focal length is none."""
CLEAR_CHANGE = 3.0
"""By how many times the errors of one camera grow where its images are no more those of
the frame."""


@dataclass(frozen=True, kw_only=True)
class ZoomTrial(Trial):
    """Focal lengths of their own before and after a frame."""

    def fit(self, scene: Scene, options: dict[str, Any]) -> Fit | None:
        halves = []
        for late in (False, True):
            part = _in_frames(scene, (scene.frame_idx >= self.first) == late)
            half = adjusted(part, self.rig, **{**options, **FOCAL})
            if half is None:
                return None
            halves.append(half)
        before, after = (_focals(half) for half in halves)
        if np.abs(after / before - 1.0).max() < MIN_ZOOM:
            return None
        return replace(
            halves[0],
            squares=np.concatenate([half.squares for half in halves]),
            unknowns=sum(half.unknowns for half in halves),
            turn_deg=max(half.turn_deg for half in halves),
            focals=(before, after),
        )


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


def _zoom_words(fit: Fit) -> str:
    assert fit.focals is not None
    before, after = fit.focals
    return f" ({', '.join(f'{ratio:.3f} times' for ratio in after / before)})"


def _focals(fit: Fit) -> Array:
    return np.array([camera.lens[0] for camera in fit.scene.cameras])


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
