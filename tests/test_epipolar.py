"""Do water rays meet: the gap in pixels, and the matches that it tells apart."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from sfm_scenes import same_frame_matches, simulated_dive
from test_three_cameras import three_camera_rig

from uwsfm import InputError, calibrate
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.jobs.demo import sample_dir
from uwsfm.rig.file import load_rig
from uwsfm.sfm.frontend.features import extract_features
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.sfm.frontend.matching import match_features
from uwsfm.sfm.options import FeatureOptions, MatchOptions
from uwsfm.sfm.poses.epipolar import ray_gaps_px, relative_pose
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches
from uwsfm.sfm.rig_checks.stereo_scene import same_frame_scene, without_wrong_matches
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.simulate import Relief, SimulatedScene, simulate_scene
from uwsfm.simulate.observations import ObservationOptions
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion

RIG = sample_rig()
NORMALS_ONLY = {"refine_distances": False, "refine_cam_from_rig": False}


def pair_of(rig=RIG):
    """Two cameras, and the second's pose from the first."""
    poses = np.asarray(rig.cam_from_rig)
    return *rig.refractive_cameras(), relative_pose(poses, 0, 1)


@pytest.fixture(scope="module")
def exact() -> PairMatches:
    return same_frame_matches(simulated_dive(num_frames=2, num_points=300).truth)


def moved(pair: PairMatches, noise_px: float, rng) -> tuple[np.ndarray, np.ndarray]:
    noise = noise_px * rng.standard_normal((2, len(pair), 2))
    return pair.xy_a + noise[0], pair.xy_b + noise[1]


def brute_force_gaps(camera_a, camera_b, b_from_a, xy_a, xy_b, start):
    """The definition, point by point."""

    def misses(point, i):
        in_b = rigid3.transform(b_from_a, point)
        found_a, _ = camera_a.img_from_point(point[None])
        found_b, _ = camera_b.img_from_point(in_b[None])
        return np.concatenate([found_a[0] - xy_a[i], found_b[0] - xy_b[i]])

    tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14, "x_scale": 0.01}
    solutions = [
        least_squares(misses, point, args=(i,), **tight)
        for i, point in enumerate(start)
    ]
    return np.sqrt([2.0 * solution.cost for solution in solutions])


def test_rays_of_one_point_have_no_gap(exact):
    gaps = ray_gaps_px(*pair_of(), exact.xy_a, exact.xy_b)
    assert len(gaps) > 100
    # Projection and unprojection invert each other to 1e-12 px.
    assert gaps.max() < 1e-9


@pytest.mark.parametrize(
    # Sampson's approximation leaves the third power of the error.
    ("noise_px", "tolerance_px"),
    [(0.5, 1e-5), (3.0, 1e-3)],
)
def test_gap_is_the_least_move_of_both_pixels(exact, rng, noise_px, tolerance_px):
    xy_a, xy_b = (xy[:60] for xy in moved(exact, noise_px, rng))
    start = np.column_stack([0.001 * (xy_a - 300.0), np.ones(len(xy_a))])
    gaps = ray_gaps_px(*pair_of(), xy_a, xy_b)
    expected = brute_force_gaps(*pair_of(), xy_a, xy_b, start)
    assert expected.max() > 2.0 * noise_px
    np.testing.assert_allclose(gaps, expected, atol=tolerance_px)


def test_noise_makes_gaps_of_its_own_size(exact, rng):
    """Of four noisy coordinates, the point takes up three."""
    gaps = ray_gaps_px(*pair_of(), *moved(exact, 0.4, rng))
    stddev = 1.0 / np.sqrt(2 * len(gaps))  # of an estimated standard deviation
    assert np.sqrt(np.mean(gaps**2)) == pytest.approx(0.4, rel=4 * stddev)


def test_gap_does_not_depend_on_scale(exact, rng):
    camera_a, camera_b, b_from_a = pair_of()
    xy_a, xy_b = moved(exact, 2.0, rng)
    gaps = ray_gaps_px(camera_a, camera_b, b_from_a, xy_a, xy_b)
    larger = [
        camera.with_port(
            replace(
                camera.port,
                distance=3.0 * camera.port.distance,
                thickness=3.0 * camera.port.thickness,
            )
        )
        for camera in (camera_a, camera_b)
    ]
    pose = np.concatenate([b_from_a[:4], 3.0 * b_from_a[4:]])
    np.testing.assert_allclose(ray_gaps_px(*larger, pose, xy_a, xy_b), gaps, atol=1e-9)


def test_gap_is_the_same_seen_from_the_other_camera(exact, rng):
    camera_a, camera_b, b_from_a = pair_of()
    xy_a, xy_b = moved(exact, 2.0, rng)
    gaps = ray_gaps_px(camera_a, camera_b, b_from_a, xy_a, xy_b)
    turned = ray_gaps_px(camera_b, camera_a, rigid3.inverse(b_from_a), xy_b, xy_a)
    np.testing.assert_allclose(turned, gaps, atol=1e-9)


def test_rays_that_cannot_meet_are_no_match():
    """Crossed eyes: the rays meet behind the cameras; and a pixel that is not one."""
    camera_a, camera_b, b_from_a = pair_of()
    xy_a = np.array([[100.0, 300.0], [np.nan, 300.0]])
    xy_b = np.array([[700.0, 300.0], [400.0, 300.0]])
    assert np.isnan(ray_gaps_px(camera_a, camera_b, b_from_a, xy_a, xy_b)).all()


# ---- Single pairs -------------------------------------------------------------------


def true_points(simulated: SimulatedScene, camera_idx, xy) -> np.ndarray:
    """The true point of each observation (N,), found by its pixel."""
    scene = simulated.scene
    known = np.column_stack([scene.camera_idx, scene.xy.astype(np.float32)])
    names = dict(zip(map(tuple, known.tolist()), scene.point_idx, strict=True))
    return np.array(
        [
            names[key]
            for key in map(tuple, np.column_stack([camera_idx, xy.astype(np.float32)]))
        ]
    )


def is_right(simulated: SimulatedScene, scene) -> np.ndarray:
    """Mask (P,): all observations of the point are of one true point."""
    points = true_points(simulated, scene.camera_idx, scene.xy)
    first = np.zeros(scene.num_points, dtype=np.int64)
    first[scene.point_idx] = points
    right = np.ones(scene.num_points, dtype=bool)
    np.logical_and.at(right, scene.point_idx, first[scene.point_idx] == points)
    return right


@pytest.mark.parametrize("num_frames", [1, 3])
def test_wrong_matches_go_and_right_ones_stay_though_ports_are_guesses(
    tmp_path, num_frames
):
    """Ports tilted by 2 and 1 degrees, taken for straight: gaps of 4 px and more."""
    simulated = simulated_dive(RIG, num_frames, 500 * num_frames)
    frames = frames_of(RIG, num_frames, tmp_path)
    path = tmp_path / "features.db"
    write_features(path, simulated.scene, frames, wrong=0.3)
    given = nominal_rig(RIG, distance_scale=1.0)
    pair = same_frame_matches(simulated.scene)
    gaps = ray_gaps_px(*pair_of(given), pair.xy_a, pair.xy_b)
    assert np.median(gaps) > 4.0

    scene = same_frame_scene(given, frames, path)
    right = is_right(simulated, scene)
    assert right.sum() > 0.98 * 0.7 * len(pair)
    # 30 % were wrong; those left lie along the epipolar curves by chance.
    assert np.count_nonzero(~right) <= 0.01 * len(pair)
    assert scene.cameras[0].port == given.cameras[0].port
    np.testing.assert_array_equal(scene.cam_from_rig, given.cam_from_rig)

    found = calibrate(scene, **NORMALS_ONLY).scene
    sure = without_wrong_matches(found)
    assert np.count_nonzero(~is_right(simulated, sure)) <= np.count_nonzero(~right)
    # Gaps are normal, of 0.4 px: 5 medians are 3.4 standard deviations.
    assert sure.num_points > 0.99 * right.sum()
    assert np.isfinite(sure.points).all()


def test_a_feature_that_three_cameras_share_is_one_point(tmp_path):
    rig = three_camera_rig()
    simulated = simulate_scene(
        rig,
        rich_motion(2),
        Relief(stddev=0.15),
        ObservationOptions(num_points=500, noise_px=0.3),
    )
    frames = frames_of(rig, 2, tmp_path)
    path = tmp_path / "features.db"
    write_features(path, simulated.scene, frames, wrong=0.0)
    scene = same_frame_scene(nominal_rig(rig), frames, path)
    counts = np.bincount(scene.point_idx)
    assert set(counts) == {2, 3}
    assert is_right(simulated, scene).all()
    views = np.column_stack([scene.camera_idx, scene.xy])
    assert len(np.unique(views, axis=0)) == len(views)


def test_a_baseline_length_alone_is_refused(tmp_path):
    unplaced = replace(RIG, cam_from_rig=None)
    with pytest.raises(InputError, match="cam_from_rig"):
        same_frame_scene(unplaced, frames_of(RIG, 1, tmp_path), tmp_path / "none.db")


def test_normals_from_one_rendered_pair(tmp_path):
    """The paper's first calibration, from images: distances known, normals straight."""
    rig = load_rig(sample_dir() / "rig.yaml")
    truth = sample_rig().refractive_cameras()
    ports = [
        replace(item.port, distance=camera.port.distance)
        for item, camera in zip(rig.cameras, truth, strict=True)
    ]
    rig = rig.with_geometry(rig.cam_from_rig, ports)
    frames = find_frames(sample_dir() / "images", rig)
    first = replace(frames, names=frames.names[:1])
    path = tmp_path / "features.db"
    extract_features(first, rig, path, FeatureOptions(), num_threads=2)
    match_features(first, path, MatchOptions(), num_threads=2)

    result = calibrate(same_frame_scene(rig, first, path), **NORMALS_ONLY)

    assert result.summary.num_points > 1000
    assert result.covariance.determined
    for port, camera, known in zip(
        result.scene.ports, truth, result.covariance.cameras, strict=True
    ):
        error = np.degrees(unit_vector.angle_between(port.normal, camera.port.normal))
        # The bound of 1700 points at 0.15 px is 0.03 degrees, and 0.03 and 0.04 it is.
        assert error < 0.1
        assert error < 4.0 * known.normal_stddev_deg < 0.2
