"""Relative pose from matches: exact, robust, and honest about the length."""

import numpy as np
import pycolmap
import pytest
from jacobians import check_jacobian, tilted
from test_sfm_absolute_pose import SIZE, camera, four_cameras, offset

from uwsfm import DomePort, InputError, RefractiveCamera
from uwsfm.geometry import rigid3
from uwsfm.geometry.unit_vector import angle_between, tangent_basis
from uwsfm.models.projection import JAC_SIZE
from uwsfm.sfm.poses.epipolar import ray_gaps_px
from uwsfm.sfm.poses.kernel_rows import near_rays, rays_in_rig, rig_rows
from uwsfm.sfm.poses.relative_pose import (
    RelativePoseOptions,
    estimate_relative_pose,
    estimate_rig_relative_poses,
)
from uwsfm.sfm.poses.relative_pose_kernel import gap_with_jac, gaps

WIDE = np.array([0.02, 0.25, 0.05, -1.2, 0.1, 0.3])
"""A motion [rotation, translation] over a scene at 3 m."""


def pose_of(tangent) -> np.ndarray:
    return rigid3.perturb(rigid3.IDENTITY, tangent)


def two_views(rig, motion, rng, num=200, depth=(2.0, 4.0), noise_px=0.0, wrong=0.0):
    """(arguments of `estimate_rig_relative_poses`, pose, which matches are right)."""
    cameras, cam_from_rig = rig
    pose = pose_of(motion)
    index_a, xy_a, index_b, xy_b = [], [], [], []
    for a, camera_a in enumerate(cameras):
        pixels = rng.uniform(0.0, SIZE, (4000, 2))
        origins, dirs = camera_a.ray_from_img(pixels)
        in_cam = origins + rng.uniform(*depth, (len(dirs), 1)) * dirs
        in_rig = rigid3.transform(rigid3.inverse(cam_from_rig[a]), in_cam)
        for b, camera_b in enumerate(cameras):
            in_b = rigid3.transform(rigid3.compose(cam_from_rig[b], pose), in_rig)
            seen, valid = camera_b.img_from_point(in_b)
            with np.errstate(invalid="ignore"):
                valid &= ((seen > 0.0) & (seen < SIZE)).all(axis=1)
            xy_a.append(pixels[valid])
            xy_b.append(seen[valid])
            index_a.append(np.full(np.count_nonzero(valid), a))
            index_b.append(np.full(np.count_nonzero(valid), b))
    arrays = [np.concatenate(x) for x in (index_a, xy_a, index_b, xy_b)]
    chosen = rng.choice(len(arrays[0]), num, replace=False)
    index_a, xy_a, index_b, xy_b = (array[chosen] for array in arrays)
    right = rng.random(num) >= wrong
    for xy in (xy_a, xy_b):
        xy += noise_px * rng.standard_normal(xy.shape)
        xy[~right] = rng.uniform(0.0, SIZE, (np.count_nonzero(~right), 2))
    return (cameras, cam_from_rig, index_a, xy_a, index_b, xy_b), pose, right


def one_camera():
    return [camera()], np.array([rigid3.IDENTITY])


def image_pair(args):
    """Arguments of `estimate_relative_pose`."""
    return args[0][0], args[0][0], args[3], args[5]


def kernel_matches(args):
    cameras, poses, index_a, xy_a, index_b, xy_b = args
    rows = []
    for index, xy in ((index_a, xy_a), (index_b, xy_b)):
        rays, _ = near_rays(cameras, index, xy)
        rows += [index, xy, rays_in_rig(rays, index, poses)]
    return tuple(rows), rig_rows(cameras, poses)[0]


def errors_deg(pose, truth) -> tuple[float, float]:
    turn = rigid3.rotation_angle(rigid3.compose(pose, rigid3.inverse(truth)))
    return np.degrees(turn), np.degrees(angle_between(pose[4:], truth[4:]))


@pytest.mark.parametrize("wrong", [0.0, 0.5])
def test_exact_without_noise_length_included(wrong, rng):
    """Refraction alone gives the length of the motion, if nothing is uncertain."""
    args, truth, right = two_views(one_camera(), WIDE, rng, wrong=wrong)
    found = estimate_relative_pose(*image_pair(args))
    assert max(errors_deg(found.b_from_a, truth)) < 1e-6
    assert found.length_determined
    assert np.linalg.norm(found.b_from_a[4:]) == pytest.approx(
        np.linalg.norm(truth[4:]), rel=1e-4
    )
    assert found.inliers[right].all()
    # By chance a wrong match lies along its curve: 8 px of 1080, and meets in front.
    assert np.count_nonzero(found.inliers & ~right) <= 4


def test_rig_gives_the_length(rng):
    """Cameras that see what another one saw fix it; noise leaves a per mille."""
    args, truth, right = two_views(
        four_cameras(), [0.02, 0.1, 0.05, -0.3, 0.1, 0.2], rng, noise_px=0.3, wrong=0.3
    )
    found, *_ = estimate_rig_relative_poses(*args)
    assert found.length_determined
    error = offset(found.b_from_a, truth)
    square = error @ np.linalg.solve(found.covariance, error)
    assert square < 22.5  # 99.9 % of chi-square with 6 degrees
    assert np.linalg.norm(error[3:]) < 0.01
    assert np.count_nonzero(found.inliers & right) > 0.99 * np.count_nonzero(right)


def test_errors_are_those_that_the_covariance_says(rng):
    """With the length held where it truly is: chi-square with 5 degrees."""
    squares = []
    for _ in range(40):
        args, truth, _ = two_views(one_camera(), WIDE, rng, noise_px=0.7, wrong=0.3)
        options = RelativePoseOptions(length_m=float(np.linalg.norm(truth[4:])))
        found = estimate_relative_pose(*image_pair(args), options)
        error = offset(found.b_from_a, truth)
        assert np.linalg.norm(found.b_from_a[4:]) == pytest.approx(options.length_m)
        # Turns, and moves across the motion.
        free = np.eye(6)[:, :5]
        free[3:, 3:] = tangent_basis(truth[4:] / np.linalg.norm(truth[4:]))
        error = free.T @ error
        covariance = free.T @ found.covariance @ free
        squares.append(error @ np.linalg.solve(covariance, error))
        # Of a median of 140 gaps: 7 %.
        assert found.noise_px == pytest.approx(0.7, rel=0.3)
    # Of the mean: sqrt(10 / 40) = 0.5, four of them, and 0.3 for the estimated noise.
    assert np.mean(squares) == pytest.approx(5.0, abs=2.3)


def test_a_length_that_noise_hides_is_called_unknown(rng):
    """A port close to the lens, and half a pixel: the motion has no length."""
    thin = camera(0.0, 0.002)
    thin = thin.with_port(type(thin.port)(tilted(0.0, 0.0), 0.002, 0.002, 1.52, 1.334))
    args, truth, _ = two_views(
        ([thin], np.array([rigid3.IDENTITY])), WIDE, rng, noise_px=0.5
    )
    found = estimate_relative_pose(*image_pair(args))
    assert not found.length_determined
    # 200 matches at half a pixel.
    assert max(errors_deg(found.b_from_a, truth)) < 0.3


@pytest.mark.parametrize(
    ("depth", "motion"),
    [
        # Near: at 0.3 m the rays of one camera are 20 px apart from any pinhole's.
        ((0.3, 0.5), [0.0, 0.1, 0.0, -0.1, 0.02, 0.0]),
        # A sea floor without relief, seen from above.
        ((1.0, 1.001), [0.02, 0.05, 0.1, -0.3, 0.1, 0.02]),
        # Forwards.
        ((1.0, 3.0), [0.02, 0.01, 0.1, 0.02, 0.01, -0.5]),
    ],
    ids=["near", "plane", "forwards"],
)
def test_hard_geometry(depth, motion, rng):
    args, truth, right = two_views(
        one_camera(), motion, rng, depth=depth, noise_px=0.3, wrong=0.3
    )
    found = estimate_relative_pose(*image_pair(args))
    assert np.count_nonzero(found.inliers & right) > 0.98 * np.count_nonzero(right)
    error = offset(found.b_from_a, truth)
    assert error[:3] @ np.linalg.solve(found.covariance[:3, :3], error[:3]) < 16.3


def test_field_of_view_beyond_any_pinhole(rng):
    """A fisheye behind a dome: directions up to the plane of the camera and past it."""
    lens = pycolmap.Camera(
        model="OPENCV_FISHEYE",
        width=1920,
        height=1080,
        params=[560.0, 560.0, 960.0, 540.0, 0.0, 0.0, 0.0, 0.0],
    )
    port = DomePort((0.002, 0.001, -0.01), 0.06, 0.01, 1.49, 1.34)
    rig = [RefractiveCamera(lens, port)], np.array([rigid3.IDENTITY])
    args, truth, right = two_views(rig, WIDE, rng, noise_px=0.3, wrong=0.3)
    found = estimate_relative_pose(*image_pair(args))
    assert np.count_nonzero(found.inliers & right) > 0.98 * np.count_nonzero(right)
    error = offset(found.b_from_a, truth)[:3]
    # 99.9 % of chi-square with 3 degrees.
    assert error @ np.linalg.solve(found.covariance[:3, :3], error) < 16.3


def test_gap_is_that_of_the_epipolar_module(rng):
    args, truth, _ = two_views(one_camera(), WIDE, rng, num=50, noise_px=2.0, wrong=0.2)
    matches, rig = kernel_matches(args)
    found = np.empty(50)
    gaps(rigid3.matrix_rows(truth), matches, rig, found)
    expected = ray_gaps_px(args[0][0], args[0][0], truth, args[3], args[5])
    finite = np.isfinite(expected)
    np.testing.assert_array_equal(np.isfinite(found), finite)
    np.testing.assert_allclose(np.abs(found[finite]), expected[finite], atol=1e-8)


def test_jacobian_through_the_manifold(rng):
    """Exact where the gap is zero."""
    args, truth, _ = two_views(four_cameras(), WIDE, rng, num=8)
    matches, rig = kernel_matches(args)
    jac, rows, row = np.empty((2, JAC_SIZE)), np.empty((4, 3)), np.empty(6)
    for i in range(8):

        def gap(pose, i=i):
            at = rigid3.matrix_rows(pose)
            return np.array(gap_with_jac(i, at, matches, rig, jac, rows, row)[1])

        gap(truth)
        check_jacobian(gap, rigid3.perturb, truth, row.copy(), step=1e-5)


def test_same_seed_same_bytes(rng):
    args, _, _ = two_views(one_camera(), WIDE, rng, noise_px=0.5, wrong=0.3)
    one, two = (estimate_relative_pose(*image_pair(args)) for _ in range(2))
    assert one.b_from_a.tobytes() == two.b_from_a.tobytes()


def test_no_pose_where_there_is_none(rng):
    args, _, _ = two_views(one_camera(), WIDE, rng, wrong=1.0)
    options = RelativePoseOptions(min_num_inliers=40, max_trials=500)
    assert estimate_relative_pose(*image_pair(args), options) is None
    few = (*args[:2], *(array[:7] for array in args[2:]))
    assert estimate_rig_relative_poses(*few) == []


def test_input_is_checked(rng):
    args, _, _ = two_views(one_camera(), WIDE, rng, num=20)
    lens = args[0][0]
    with pytest.raises(InputError, match=r"\(19, 2\)"):
        estimate_relative_pose(lens, lens, args[3], args[5][:19])
    with pytest.raises(InputError, match="camera_idx"):
        estimate_rig_relative_poses(*args[:2], args[2] + 1, *args[3:])
    with pytest.raises(InputError, match="length_m"):
        RelativePoseOptions(length_m=-1.0)
