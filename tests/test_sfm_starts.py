"""Where a map begins: two motions of a flat scene, pairs that know their depth."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from uwsfm import NoPort, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.mapping.incremental import map_incrementally
from uwsfm.sfm.mapping.initialization import PairSearch
from uwsfm.sfm.noise_floor import map_floor
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.poses.relative_pose import (
    RelativePoseOptions,
    estimate_rig_relative_poses,
)
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rig_from_world_looking_at

NOISE_PX = 0.3
RIG_FROM_WORLD = rigid3.IDENTITY[None]


def single_rig() -> Rig:
    """One camera, its lens calibrated in the water."""
    camera = replace(sample_rig().cameras[0], port=NoPort())
    lens = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=960, height=540, params=[620.0, 480.0, 270.0]
    )
    cameras = (replace(camera, camera=lens),)
    return Rig(cameras=cameras, cam_from_rig=None, baseline_m=None)


def forward_dive(relief_m: float, num_frames: int = 12, num_points: int = 900):
    """A camera that swims ahead, looking down at 40 degrees: as a diver films."""
    ahead = 0.12 * np.arange(num_frames)
    sway = 0.03 * np.sin(1.3 * np.arange(num_frames))
    centers = np.column_stack([sway, ahead, np.full(num_frames, -1.5) + 0.5 * sway])
    targets = centers + [0.0, 1.8, 1.5]
    return simulate_scene(
        single_rig(),
        rig_from_world_looking_at(centers, targets, 0.0),
        Relief(stddev=relief_m, correlation_length=0.4, seed=3),
        ObservationOptions(
            num_points=num_points, noise_px=NOISE_PX, detection_rate=0.7, seed=1
        ),
    )


def correspondences_of(scene: Scene) -> Correspondences:
    """The observations of one camera as keypoints, shared points as matches."""
    order = np.argsort(scene.frame_idx, kind="stable")
    point, frame = scene.point_idx[order], scene.frame_idx[order]
    by_point = np.lexsort((frame, point))
    matches = []
    for step in range(1, scene.num_frames):
        a, b = by_point[:-step], by_point[step:]
        same = point[a] == point[b]
        matches.append(np.column_stack([a[same], b[same]]))
    rows = np.concatenate(matches)
    return Correspondences(
        num_cameras=1,
        num_frames=scene.num_frames,
        first=np.searchsorted(frame, np.arange(scene.num_frames + 1)),
        xy=scene.xy[order],
        image=frame,
        matches=rows,
        verified=np.ones(len(rows), dtype=bool),
    )


def empty_map(of: Correspondences) -> GrowingMap:
    cameras = single_rig().refractive_cameras()
    return GrowingMap(of, cameras, RIG_FROM_WORLD, np.radians(1.5))


def shape_error(found: np.ndarray, true: np.ndarray) -> float:
    """RMS of camera centres after the best similarity, by their extent."""
    a, b = (rigid3.inverse(poses)[:, 4:] for poses in (found, true))
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    u, values, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = np.sum(values * np.diag(flip)) / np.sum(a * a)
    return float(np.linalg.norm(scale * a @ (u @ flip @ vt).T - b) / np.linalg.norm(b))


def test_a_plane_leaves_two_motions_and_one_is_right():
    scene = forward_dive(relief_m=0.0).scene
    of = correspondences_of(scene)
    empty = empty_map(of)
    ends = of.matches[(of.frame[of.matches] == [4, 6]).all(axis=1)]
    views = (of.camera[ends[:, 0]], of.xy[ends[:, 0]])
    views += (of.camera[ends[:, 1]], of.xy[ends[:, 1]])
    motions = estimate_rig_relative_poses(
        empty.cameras, RIG_FROM_WORLD, *views, RelativePoseOptions(seed=0)
    )
    assert len(motions) == 2
    true = rigid3.compose(
        scene.rig_from_world[6], rigid3.inverse(scene.rig_from_world[4])
    )
    turns = [
        np.degrees(
            rigid3.rotation_angle(rigid3.compose(m.b_from_a, rigid3.inverse(true)))
        )
        for m in motions
    ]
    # 0.3 px of 620 px over hundreds of matches: a few hundredths of a degree.
    assert min(turns) < 0.2 < 1.0 < max(turns)
    # Both explain the matches: nothing in two images can tell them apart.
    assert motions[1].noise_px < 1.5 * motions[0].noise_px


def test_pairs_to_begin_with_know_the_depth_of_their_points():
    """Neighbours have the most matches, and rays that hardly differ."""
    scene = forward_dive(relief_m=0.05).scene
    of = correspondences_of(scene)
    left = np.ones(of.num_frames, dtype=bool)
    search = PairSearch(empty_map(of), left, 8.0, 1.0, seed=0)
    a, b = next(search.beginnings()).frames
    assert b - a >= 3
    left[[a, b]] = False  # read again at each step
    assert not {a, b} & set(next(search.beginnings()).frames.tolist())


@pytest.mark.parametrize("seed", range(2))
def test_forward_over_a_nearly_flat_floor_ends_in_the_right_basin(seed):
    dive = forward_dive(relief_m=0.02)
    of = correspondences_of(dive.scene)
    options = StartOptions(seed=seed)
    growing = map_incrementally(of, single_rig(), RIG_FROM_WORLD, options)[0]
    assert growing.num_registered == of.num_frames
    assert growing.floor.ratio < 1.15
    # Centres to 0.5 % of the track; the second solution of a pair is 100 % off.
    assert shape_error(growing.rig_from_world, dive.truth.rig_from_world) < 0.01


def test_a_map_of_wrong_poses_is_far_above_its_floor():
    scene = forward_dive(relief_m=0.02).scene
    of, cameras = correspondences_of(scene), single_rig().refractive_cameras()
    everywhere = np.ones(of.num_frames, dtype=bool)
    turns = np.zeros((of.num_frames, 6))
    turns[:, 0] = np.radians(np.linspace(0.0, 3.0, of.num_frames))
    wrong = rigid3.perturb(scene.rig_from_world, turns)
    for poses, low, high in ((scene.rig_from_world, 0.9, 1.1), (wrong, 3.0, 1e3)):
        floor = map_floor(of, everywhere, cameras, RIG_FROM_WORLD, poses, 0)
        assert low < floor.ratio < high
        assert floor.floor_px == pytest.approx(NOISE_PX, rel=0.1)


def test_a_camera_that_only_turned_is_named():
    """Many matches and no motion: the water is clear, and the images overlap."""
    dive = forward_dive(relief_m=0.05, num_frames=4)
    centers = np.tile([0.0, 0.0, -1.5], (4, 1))
    targets = centers + [0.0, 1.8, 1.5] + 0.1 * np.eye(4, 3)
    poses = rig_from_world_looking_at(centers, targets, 0.0)
    turned = replace(dive.truth, rig_from_world=poses)
    xy, valid = turned.projections()
    rng = np.random.default_rng(0)
    noisy = replace(turned, xy=xy + NOISE_PX * rng.standard_normal(xy.shape))
    scene = noisy.select(valid)[0]
    with pytest.raises(UwsfmError, match=r"6 pairs .* hardly moved .* degrees at most"):
        map_incrementally(
            correspondences_of(scene), single_rig(), RIG_FROM_WORLD, StartOptions()
        )


def test_points_of_two_images_are_kept_where_their_neighbours_agree():
    scene = forward_dive(relief_m=0.05).scene
    of = correspondences_of(scene)
    growing = empty_map(of)
    growing.place(np.arange(of.num_frames), scene.rig_from_world)
    growing.retriangulate(4.0, min_images=3)
    before = len(growing.points)
    growing.add_pairs(4.0)
    assert len(growing.points) > before
    counts = np.bincount(growing.point_of[growing.point_of >= 0])
    assert counts.min() == 2 and len(counts) == len(growing.points)
    # The same with matches that lie on each other's epipolar lines: none is taken.
    keep = np.ones(len(of.matches), dtype=bool)
    pair = (of.frame[of.matches] == [0, 5]).all(axis=1)
    ends = of.matches[pair]
    odd = replace(
        of,
        matches=np.concatenate(
            [of.matches[keep & ~pair], np.column_stack([ends[:, 0], ends[::-1, 1]])]
        ),
        verified=np.ones(len(of.matches), dtype=bool),
    )
    wrong = empty_map(odd)
    wrong.place(np.arange(of.num_frames), scene.rig_from_world)
    wrong.retriangulate(50.0, min_images=3)
    wrong.add_pairs(50.0)
    errors = growing_errors(wrong)
    assert np.median(errors) < 1.0


def growing_errors(growing: GrowingMap) -> np.ndarray:
    """Pixel errors of all observations."""
    scene, _ = growing.scene()
    return np.linalg.norm(scene.residuals(), axis=1)
