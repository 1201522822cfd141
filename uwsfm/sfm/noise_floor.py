"""The noise floor of matches: what the best geometry of single image pairs leaves.

A map can be wrong as a whole and adjusted to the last digit: frames that moved
forward over a nearly flat scene have a second solution, and a lens or a port that does
not fit bends all poses. Each pair of images alone knows nothing of that. Two poses and
a lens of its own, adjusted to the matches of two images, leave hardly more than the
noise of the features; the same matches, under the poses, lenses and ports of the whole
model, must not leave much more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from uwsfm.calibration.priors import border_priors
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import IndexArray, Scene
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.tracks import match_gaps_px
from uwsfm.sfm.poses.relative_pose import MEDIAN_GAP, estimate_relative_pose
from uwsfm.sfm.poses.relative_pose_options import RelativePoseOptions
from uwsfm.sfm.scene_points import views_of
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.levenberg_marquardt import LevenbergMarquardtOptions, minimize
from uwsfm.solver.state import State

MIN_MATCHES = 60
"""Of a pair: five times what is adjusted to them."""
MAX_MATCHES = 250
"""Of a pair that are used: its noise is known to 5 per cent then."""
MAX_PAIRS = 40
"""Of images, drawn at random: 0.3 s on one core."""
CUT_STDDEVS = 3.5
"""Matches that miss their own pair's geometry by more are wrong."""
MAX_GAP_PX = 50.0
"""What a match counts for that the model puts behind a camera."""
MIN_NOISE_PX = 0.01
"""No image feature is better; exact data have a ratio of one."""
FREEDOM = {
    "refine_cam_from_rig": False,
    "refine_distances": False,
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
    "normal_stddev_deg": 5.0,
    "focal_stddev": 0.1,
    "principal_point_stddev_px": 30.0,
    "distortion_stddev": 0.3,
}
"""What a pair may adjust beside its poses, with priors that only keep it solvable:
lens and tilt of the port, which between them bend an image in any smooth way."""
GRID = 3
SUSPICIOUS = 1.5
"""Ratio above which pairs look for their poses themselves, which takes seconds."""
MAX_OWN_PAIRS = 12
OWN_ERROR_PX, OWN_NOISE_PX = 8.0, 1.0
"""Then: how many do, the tolerance, and the noise to begin with. The lens may be a
guess."""


class PairGaps(NamedTuple):
    """Gaps of the matches of two images."""

    model: Array
    """(n,) by the model, px."""
    best: Array
    """(n,) with the best geometry of the two alone; inf where none was found."""
    noise_px: float
    """Standard deviation of ``best``, from its median."""
    freedom: int
    """How many numbers were adjusted."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NoiseFloor:
    """Gaps of the water rays of matches, root mean square, px of one coordinate."""

    floor_px: float
    """With the best poses and lenses of each pair of images alone, corrected for what
    was adjusted."""
    model_px: float
    """Of the same matches, with the model's poses, lenses and ports."""
    regions: Array
    """(3, 3, 2) both by third of the image, rows from the top, columns from the left;
    NaN where there are too few."""
    num_pairs: int
    num_matches: int

    @property
    def ratio(self) -> float:
        """How many times larger than its floor the model's error is."""
        return self.model_px / max(self.floor_px, MIN_NOISE_PX)

    def summary(self) -> dict[str, float]:
        """For summary.json."""
        return {
            "floor_px": self.floor_px,
            "model_px": self.model_px,
            "num_pairs": self.num_pairs,
            "num_matches": self.num_matches,
        }


def noise_floor(
    scene: Scene, matches: IndexArray | None = None, seed: int = 0
) -> NoiseFloor | None:
    """Compare a model with the best two-view geometries of its matches.

    Args:
        scene: Cameras, poses and observations of the model; its points are not used.
        matches: (M, 2) rows of observations of one point in two images; None: those
            that the tracks imply.
        seed: Of the draw of pairs and matches.

    Returns:
        None if no two images share `MIN_MATCHES`.
    """
    if matches is None:
        matches = matches_of_tracks(scene)
    random = np.random.default_rng(seed)
    pairs = _pairs(scene, matches, random)
    found = _pooled(scene, [(rows, _pair_gaps(scene, rows)) for rows in pairs])
    if found is None or found.ratio < SUSPICIOUS:
        return found
    # The poses of a wrong map may lead its pairs astray, too: they look for their own.
    some = pairs[:: -(-len(pairs) // MAX_OWN_PAIRS)]
    alone = [(rows, _pair_gaps(scene, rows, own_start=True)) for rows in some]
    return _pooled(scene, alone)


def map_floor(
    of: Correspondences,
    registered: NDArray[np.bool_],
    cameras: Sequence[RefractiveCamera],
    cam_from_rig: Array,
    rig_from_world: Array,
    seed: int,
) -> NoiseFloor | None:
    """`noise_floor` of the verified matches between the frames of a map.

    Args:
        of: Keypoints and matches.
        registered: (F,) frames of the map.
        cameras, cam_from_rig, rig_from_world: Of the map, as in a `Scene`.
        seed: Of the draw of pairs and matches.
    """
    inside = registered[of.frame[of.matches]].all(axis=1) & of.verified
    keypoints = Scene(
        cameras=tuple(cameras),
        cam_from_rig=cam_from_rig,
        rig_from_world=rig_from_world,
        points=np.empty((0, 3)),
        camera_idx=of.camera,
        frame_idx=of.frame,
        point_idx=np.zeros(len(of.xy), dtype=np.int64),
        xy=of.xy,
    )
    return noise_floor(keypoints, of.matches[inside], seed)


def _pooled(
    scene: Scene, pairs: Sequence[tuple[IndexArray, PairGaps | None]]
) -> NoiseFloor | None:
    """All pairs in one, without the matches that are wrong in their own pair."""
    model, floor, places = [], [], []
    for rows, gaps in pairs:
        if gaps is None:
            continue
        good = gaps.best <= CUT_STDDEVS * gaps.noise_px
        num_good = max(int(np.count_nonzero(good)), gaps.freedom + 1)
        share = 1.0 - gaps.freedom / num_good
        model.append(np.minimum(gaps.model[good], MAX_GAP_PX))
        floor.append(gaps.best[good] / np.sqrt(share))
        places.append(_cells(scene, rows[good, 0]))
    if not model:
        return None
    ours, best, cells = map(np.concatenate, (model, floor, places))
    regions = np.full((GRID * GRID, 2), np.nan)
    for cell in range(GRID * GRID):
        inside = cells == cell
        if np.count_nonzero(inside) >= MIN_MATCHES:
            regions[cell] = _rms(best[inside]), _rms(ours[inside])
    return NoiseFloor(
        floor_px=_rms(best),
        model_px=_rms(ours),
        regions=regions.reshape(GRID, GRID, 2),
        num_pairs=len(model),
        num_matches=len(ours),
    )


def matches_of_tracks(scene: Scene) -> IndexArray:
    """Pairs (M, 2) of observations of one point: each with the next three, by image."""
    image = scene.frame_idx * len(scene.cameras) + scene.camera_idx
    order = np.lexsort((image, scene.point_idx))
    point = scene.point_idx[order]
    pairs = []
    for step in (1, 2, 3):
        same = point[step:] == point[:-step]
        pairs.append(np.stack([order[:-step][same], order[step:][same]], axis=1))
    matches = np.concatenate(pairs)
    return matches[image[matches[:, 0]] != image[matches[:, 1]]]


def gaps_px(scene: Scene, matches: IndexArray) -> Array:
    """By how many pixels the water rays of matches (M, 2) miss each other, (M,)."""
    return match_gaps_px(views_of(scene), np.ascontiguousarray(matches))


def _pairs(
    scene: Scene, matches: IndexArray, random: np.random.Generator
) -> list[IndexArray]:
    """Matches (n, 2) of some pairs of images, those of the lower image first."""
    image = scene.frame_idx * len(scene.cameras) + scene.camera_idx
    ends = image[matches]
    swapped = ends[:, 0] > ends[:, 1]
    matches = np.where(swapped[:, None], matches[:, ::-1], matches)
    keys = ends.min(axis=1) * np.int64(image.max(initial=0) + 1) + ends.max(axis=1)
    order = np.argsort(keys, kind="stable")
    _, first, counts = np.unique(keys[order], return_index=True, return_counts=True)
    usable = np.flatnonzero(counts >= MIN_MATCHES)
    if len(usable) > MAX_PAIRS:
        usable = np.sort(random.choice(usable, MAX_PAIRS, replace=False))
    some = []
    for k in usable:
        rows = order[first[k] : first[k] + counts[k]]
        if len(rows) > MAX_MATCHES:
            rows = np.sort(random.choice(rows, MAX_MATCHES, replace=False))
        some.append(matches[rows])
    return some


def _pair_gaps(
    scene: Scene, rows: IndexArray, own_start: bool = False
) -> PairGaps | None:
    """What two images alone can do about their matches (n, 2).

    Args:
        scene: As of `noise_floor`.
        rows: Matches of two images.
        own_start: Search the relative pose by RANSAC, too, and keep the better end.

    Returns:
        None if too few matches can be used.
    """
    given = _two_views(scene, rows)
    model = np.nan_to_num(gaps_px(given, _ends(len(rows))), nan=MAX_GAP_PX)
    ends = [_adjusted(given, float(np.median(model)))]
    if own_start and (turned := _own_poses(given)) is not None:
        ends.append(_adjusted(turned, OWN_NOISE_PX))
    found = [end for end in ends if end is not None]
    if not found:
        return None
    best, freedom = min(found, key=lambda end: float(np.median(end[0])))
    noise = max(float(np.median(best)) / MEDIAN_GAP, MIN_NOISE_PX)
    return PairGaps(model=model, best=best, noise_px=noise, freedom=freedom)


def _adjusted(pair: Scene, noise_px: float) -> tuple[Array, int] | None:
    """Gaps (n,) at the best poses and lenses of two views, and how many numbers those
    are. Matches whose rays do not meet in front at the start have infinite ones."""
    num_matches = pair.num_points
    usable = np.isfinite(pair.residuals()).all(axis=1).reshape(2, -1).all(axis=0)
    if np.count_nonzero(usable) < MIN_MATCHES:
        return None
    part, _ = pair.select(np.tile(usable, 2))
    settings = CalibrateOptions.parsed(FREEDOM)
    nothing = np.zeros(len(part.cameras), dtype=bool)
    columns = settings.border_columns(part.cameras, nothing)
    layout, state = build_layout(part, columns), State.from_scene(part)
    best = np.full(num_matches, np.inf)
    scale = max(noise_px, MIN_NOISE_PX)
    for _ in range(2):  # once more with the noise that the first one leaves
        options = LevenbergMarquardtOptions(
            loss="cauchy",
            loss_scale_px=2.0 * scale,
            max_iterations=15,
            min_relative_decrease=1e-3,
        )
        priors = border_priors(part, settings, columns, scale)
        state = minimize(layout, state, options, priors).state
        gaps = gaps_px(state.to_scene(part), _ends(part.num_points))
        scale = max(float(np.median(gaps)) / MEDIAN_GAP, MIN_NOISE_PX)
    best[usable] = np.nan_to_num(gaps, nan=np.inf)
    # Rotation and direction of the motion; its length is open.
    return best, 5 + int(columns.max(initial=HELD)) + 1


def _own_poses(pair: Scene) -> Scene | None:
    """Two views with the relative pose that their matches give; None if they do not."""
    first, second = pair.cameras[0], pair.cameras[-1]
    xy_a, xy_b = pair.xy.reshape(2, -1, 2)
    options = RelativePoseOptions(max_error_px=OWN_ERROR_PX)
    found = estimate_relative_pose(first, second, xy_a, xy_b, options)
    if found is None:
        return None
    poses = np.stack([rigid3.IDENTITY, found.b_from_a])
    return _triangulated(replace(pair, rig_from_world=poses))


def _ends(num_matches: int) -> IndexArray:
    """(n, 2) rows of the two views that `_two_views` puts one after the other."""
    return np.arange(2 * num_matches).reshape(2, -1).T


def _two_views(scene: Scene, rows: IndexArray) -> Scene:
    """Two images as frames of their own: n points, all observations of the first image
    before those of the second. No rig ties them."""
    a, b = rows[0]
    cameras = np.unique(scene.camera_idx[[a, b]])
    poses = [
        rigid3.compose(
            scene.cam_from_rig[scene.camera_idx[k]],
            scene.rig_from_world[scene.frame_idx[k]],
        )
        for k in (a, b)
    ]
    num, keypoints = len(rows), rows.T.ravel()
    pair = Scene(
        cameras=tuple(scene.cameras[c] for c in cameras),
        cam_from_rig=np.tile(rigid3.IDENTITY, (len(cameras), 1)),
        rig_from_world=np.stack(poses),
        points=np.empty((num, 3)),
        camera_idx=np.searchsorted(cameras, scene.camera_idx[keypoints]),
        frame_idx=np.repeat(np.arange(2), num),
        point_idx=np.tile(np.arange(num), 2),
        xy=scene.xy[keypoints],
    )
    return _triangulated(pair)


def _triangulated(pair: Scene) -> Scene:
    origins, dirs = pair.water_rays()
    points = triangulate_tracks(origins, dirs, pair.point_idx, pair.num_points)
    return replace(pair, points=points)


def _cells(scene: Scene, rows: IndexArray) -> IndexArray:
    """Which third of its image each observation is in, 0 to 8."""
    sizes = np.array([(c.width, c.height) for c in scene.cameras])
    place = GRID * scene.xy[rows] / sizes[scene.camera_idx[rows]]
    column, row = np.clip(place.astype(np.int64), 0, GRID - 1).T
    return row * GRID + column


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
