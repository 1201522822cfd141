"""Points from tracks with wrong keypoints, and gaps of many matches at once."""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import simulated_dive

from uwsfm.geometry import rigid3
from uwsfm.scene import Scene
from uwsfm.sfm.mapping import tracks
from uwsfm.sfm.mapping.tracks import match_gaps_px, triangulate
from uwsfm.sfm.mapping.triangulation import Views
from uwsfm.sfm.poses.epipolar import ray_gaps_px
from uwsfm.solver.state import State

MIN_ANGLE = np.radians(1.5)
MAX_ERROR_PX = 4.0


@pytest.fixture(scope="module")
def scene() -> Scene:
    """Exact observations; the row of an observation is its keypoint."""
    truth = simulated_dive(num_points=300).truth
    order = np.lexsort((truth.point_idx, truth.camera_idx, truth.frame_idx))
    return replace(
        truth,
        camera_idx=truth.camera_idx[order],
        frame_idx=truth.frame_idx[order],
        point_idx=truth.point_idx[order],
        xy=truth.xy[order],
    )


def views_of(scene: Scene) -> Views:
    """Image ``frame * 2 + camera``."""
    images = np.arange(2 * scene.num_frames)
    poses = rigid3.compose(
        scene.cam_from_rig[images % 2], scene.rig_from_world[images // 2]
    )
    state = State.from_scene(scene)
    origins, dirs = scene.water_rays()
    return Views(
        cam_from_world=rigid3.matrix_rows(poses),
        camera=images % 2,
        lenses=state.lenses,
        ports=state.ports,
        image=2 * scene.frame_idx + scene.camera_idx,
        xy=scene.xy,
        origins=origins,
        dirs=dirs,
    )


def often_seen(scene: Scene, count: int) -> list[np.ndarray]:
    """Keypoints of points that at least five images see."""
    tracks = [np.flatnonzero(scene.point_idx == p) for p in range(scene.num_points)]
    return [track for track in tracks if len(track) >= 5][:count]


def find(scene: Scene, track: np.ndarray, min_images: int = 2):
    start = np.array([0, len(track)])
    return triangulate(
        views_of(scene), start, track, MAX_ERROR_PX, MIN_ANGLE, min_images
    )


def test_exact_tracks_give_their_points(scene):
    tracks = often_seen(scene, 50)
    start = np.cumsum([0, *(len(track) for track in tracks)])
    keypoints = np.concatenate(tracks)
    found = triangulate(views_of(scene), start, keypoints, MAX_ERROR_PX, MIN_ANGLE)
    expected = np.repeat(np.arange(50), np.diff(start))
    np.testing.assert_array_equal(found.point_of, expected)
    points = scene.points[[scene.point_idx[track[0]] for track in tracks]]
    # Gauss-Newton stops where the cost, 1e-18 px^2, falls no more.
    np.testing.assert_allclose(found.points, points, atol=1e-8)


def test_two_points_that_a_wrong_match_joined_come_apart(scene):
    one, other = often_seen(scene, 2)
    track = np.sort(np.concatenate([one, other]))
    found = find(scene, track)
    assert len(found.points) == 2
    labels = [found.point_of[np.isin(track, part)] for part in (one, other)]
    assert [len(np.unique(part)) for part in labels] == [1, 1]
    assert labels[0][0] != labels[1][0]


def test_wrong_keypoints_are_left_out_and_the_point_does_not_move(scene):
    track = often_seen(scene, 1)[0]
    wrong = track[:2]
    xy = scene.xy.copy()
    xy[wrong] += [60.0, -45.0]
    found = find(replace(scene, xy=xy), track)
    right = ~np.isin(track, wrong)
    assert len(np.unique(found.point_of[right])) == 1
    assert not np.any(np.isin(found.point_of[~right], found.point_of[right]))
    point = found.points[found.point_of[right][0]]
    truth = scene.points[scene.point_idx[track[0]]]
    np.testing.assert_allclose(point, truth, atol=1e-8)


def test_an_image_sees_a_point_once(scene):
    """A detector may find one corner twice, a pixel apart: the nearer one counts."""
    track = often_seen(scene, 1)[0]
    doubled = np.append(scene.xy, scene.xy[track[-1:]] + 1.0, axis=0)
    rows = np.append(np.arange(len(scene.xy)), track[-1])
    scene = replace(
        scene,
        xy=doubled,
        camera_idx=scene.camera_idx[rows],
        frame_idx=scene.frame_idx[rows],
        point_idx=scene.point_idx[rows],
    )
    found = find(scene, np.append(track, len(rows) - 1))
    np.testing.assert_array_equal(found.point_of, [0] * len(track) + [-1])


def test_parallel_rays_and_too_few_images_give_no_point(scene):
    track = often_seen(scene, 1)[0]
    same_place = np.repeat(track[:1], 2)  # one image, twice: no baseline
    assert len(find(scene, same_place).points) == 0
    assert len(find(scene, track[:2]).points) == 1
    assert len(find(scene, track[:2], min_images=3).points) == 0


def test_points_and_gaps_do_not_depend_on_the_number_of_threads(scene, monkeypatch):
    lists = often_seen(scene, 200)
    start = np.concatenate([[0], np.cumsum([len(track) for track in lists])])
    keypoints = np.concatenate(lists)
    pairs = np.array([(track[0], track[-1]) for track in lists])
    views, found = views_of(scene), []
    monkeypatch.setattr(tracks, "MIN_CHUNK", 20)
    for count in (1, 5):
        monkeypatch.setattr(tracks, "num_threads", lambda count=count: count)
        points = tracks.triangulate(views, start, keypoints, 2.0, np.radians(1.5))
        found.append((*points, match_gaps_px(views, pairs)))
    assert len(found[0][0]) > 100
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_gaps_agree_with_the_two_view_geometry(scene):
    """For noisy and for grossly wrong matches alike, in true pixels."""
    rng = np.random.default_rng(1)
    noisy = replace(scene, xy=scene.xy + rng.normal(0.0, 2.0, scene.xy.shape))
    pairs = rng.integers(0, scene.num_observations, (1000, 2))
    image = 2 * scene.frame_idx + scene.camera_idx
    same = np.array([(track[0], track[-1]) for track in often_seen(scene, 100)])
    pairs = np.concatenate([pairs, same])
    pairs = pairs[image[pairs[:, 0]] != image[pairs[:, 1]]]
    gaps = match_gaps_px(views_of(noisy), pairs)
    poses = rigid3.compose(
        noisy.cam_from_rig[noisy.camera_idx], noisy.rig_from_world[noisy.frame_idx]
    )
    compared = 0
    for (a, b), gap in zip(pairs.tolist(), gaps, strict=True):
        expected = ray_gaps_px(
            noisy.cameras[noisy.camera_idx[a]],
            noisy.cameras[noisy.camera_idx[b]],
            rigid3.compose(poses[b], rigid3.inverse(poses[a])),
            noisy.xy[a : a + 1],
            noisy.xy[b : b + 1],
        )[0]
        if np.isfinite(expected) and expected < 5.0:
            assert gap == pytest.approx(expected, rel=1e-6, abs=1e-9)
            compared += 1
    assert compared > 100
