"""What keeps the mapper's cost per frame from growing must not change its map."""

import numpy as np
from sfm_scenes import simulated_dive

from uwsfm.sfm.mapping.adjustment import adjust_locally, neighbours
from uwsfm.sfm.mapping.correspondences import Correspondences
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.mapping.observers import Chains
from uwsfm.sfm.mapping.registration import Ranking, register_next
from uwsfm.simulate.rigs import sample_rig

MAX_ERROR_PX = 3.0


def test_chains_know_who_sees_a_point(rng):
    num_keypoints, num_points = 200, 15
    chains, sees = Chains.empty(num_keypoints), {}
    for _ in range(60):
        chains = chains.with_room(num_points)
        free = [k for k in range(num_keypoints) if k not in sees]
        new = rng.permutation(free)[: rng.integers(0, 12)].astype(np.int64)
        points = rng.integers(0, num_points, len(new))
        chains.link(new, points)
        sees.update(zip(new.tolist(), points.tolist(), strict=True))
        old = rng.permutation(sorted(sees))[: rng.integers(0, 8)].astype(np.int64)
        chains.unlink(np.append(old, old[:1]))  # a second time does nothing
        for keypoint in old.tolist():
            del sees[keypoint]
        some = np.flatnonzero(rng.random(num_points) < 0.4)
        expected = sorted(k for k, p in sees.items() if p in some)
        assert chains.of_points(some).tolist() == expected
    expected = [sees.get(k, -1) for k in range(num_keypoints)]
    assert chains.point_of.tolist() == expected


def matched_dive(num_frames: int) -> tuple[GrowingMap, np.ndarray]:
    """A map without frames of a dive whose matches are right, and the true poses."""
    scene = simulated_dive(num_frames=num_frames, num_points=600).scene
    image = 2 * scene.frame_idx + scene.camera_idx
    order = np.argsort(image, kind="stable")
    point = scene.point_idx[order]
    by_point = np.argsort(point, kind="stable")
    matches = [
        (a, b)
        for k, a in enumerate(by_point)
        for b in by_point[k + 1 : k + 4]  # chains of four, so that tracks are joined
        if point[a] == point[b]
    ]
    of = Correspondences(
        num_cameras=2,
        num_frames=num_frames,
        first=np.searchsorted(image[order], np.arange(2 * num_frames + 1)),
        xy=scene.xy[order],
        image=image[order],
        matches=np.sort(np.array(matches), axis=1),
        verified=np.ones(len(matches), dtype=bool),
    )
    rig = sample_rig()
    growing = GrowingMap(
        of, rig.refractive_cameras(), scene.cam_from_rig, np.radians(1.5)
    )
    return growing, scene.rig_from_world


def test_a_map_that_grows_is_the_same_as_one_looked_at_as_a_whole():
    growing, poses = matched_dive(num_frames=9)
    growing.place(np.array([0, 1]), poses)
    growing.retriangulate(MAX_ERROR_PX)
    ranking = Ranking(growing)
    while True:
        anew = Ranking(growing)
        for verified in (True, False):
            expected = anew.frames(verified)
            np.testing.assert_array_equal(ranking.frames(verified), expected)
        added = register_next(growing, ranking, MAX_ERROR_PX, seed=0)
        if added is None:
            break
        free = neighbours(growing, added)
        _check_counts(growing, free, added)
        growing.filter(adjust_locally(growing, free), MAX_ERROR_PX)
        scene, seen = growing.scene()
        errors = np.linalg.norm(scene.residuals(), axis=1)
        assert errors.max() <= MAX_ERROR_PX
        counts = np.bincount(scene.point_idx)
        assert np.all(counts[counts > 0] >= 2)
        # Two ways to the same number, to rounding.
        given = growing.errors_px(seen, growing.point_of[seen])
        np.testing.assert_allclose(given, errors, atol=1e-9)
    assert growing.num_registered == 9


def _check_counts(growing: GrowingMap, free: np.ndarray, added: int) -> None:
    """The frames that move share most points with the new one."""
    scene, _ = growing.scene()
    mine = np.unique(scene.point_idx[scene.frame_idx == added])
    shared = np.isin(scene.point_idx, mine)
    counts = np.bincount(scene.frame_idx[shared], minlength=scene.num_frames)
    others = np.setdiff1d(np.arange(1, scene.num_frames), free)
    assert counts[free].min() >= counts[others].max(initial=0)


def test_points_that_only_the_two_cameras_of_a_frame_see_are_kept():
    growing, poses = matched_dive(num_frames=6)
    of = growing.correspondences
    growing.place(np.arange(6), poses)
    growing.finish_points(MAX_ERROR_PX)
    # Matches are right, and join the keypoints of a point to one track.
    start, keypoints = of.tracks(np.arange(len(of.matches)))
    track = np.repeat(np.arange(len(start) - 1), np.diff(start))
    frames = of.frame[keypoints]
    in_one_frame = np.flatnonzero(
        (np.diff(start) == 2) & (frames[start[:-1]] == frames[start[1:] - 1])
    )
    assert len(in_one_frame) > 20
    kept = growing.point_of[keypoints] >= 0
    # Noise of 0.4 px moves hardly any point by a third of its depth.
    assert np.mean(kept[np.isin(track, in_one_frame)]) > 0.95
    assert np.mean(kept) > 0.95
