"""Pose of a rig from matches: exact, robust, as accurate as the noise allows."""

import numpy as np
import pycolmap
import pytest
from jacobians import check_jacobian, tilted

from uwsfm import DomePort, FlatPort, InputError, RefractiveCamera
from uwsfm.geometry import rigid3
from uwsfm.geometry.p3p import poses_from_three
from uwsfm.sfm.poses.absolute_pose import (
    AbsolutePoseOptions,
    checked,
    estimate_rig_pose,
)
from uwsfm.sfm.poses.rig_pose_kernel import normal_equations, pose_cost
from uwsfm.solver.losses import LOSS_CODES

SIZE = np.array([1920.0, 1080.0])


def camera(tilt_deg: float = 8.0, distance: float = 0.05) -> RefractiveCamera:
    """A thick port, far in front: no pinhole resembles it."""
    lens = pycolmap.Camera(
        model="OPENCV",
        width=1920,
        height=1080,
        params=[1297.0, 1297.0, 960.0, 540.0, -0.05, 0.02, 1e-4, -1e-4],
    )
    port = FlatPort(tilted(tilt_deg, 30.0), distance, 0.1, 1.52, 1.334)
    return RefractiveCamera(lens, port)


def one_camera():
    return [camera()], np.array([rigid3.IDENTITY])


def behind_a_dome():
    """Decentred by twice its thickness."""
    port = DomePort((0.01, -0.01, 0.02), 0.06, 0.01, 1.52, 1.334)
    return [camera().with_port(port)], np.array([rigid3.IDENTITY])


def four_cameras():
    """Looking around, 0.3 m apart, flat ports and a dome: no common centre."""
    turns = np.array([[0, 0, 0], [0, 0.5, 0], [0.4, 0, 0.3], [0, -0.6, 0.1]])
    shifts = 0.3 * np.array([[0, 0, 0], [-1, 0, 0], [0, -1, 0.5], [1, 1, 0]])
    poses = np.concatenate([rigid3.quat_from_rotvec(turns), shifts], axis=1)
    cameras = [camera(tilt, 0.02) for tilt in (0.0, 3.0, 6.0)]
    return [*cameras, *behind_a_dome()[0]], poses


def simulated(rig, rng, num=200, noise_px=0.0, wrong=0.0):
    """(arguments of `estimate_rig_pose`, true pose, which matches are right)."""
    cameras, cam_from_rig = rig
    index = np.sort(rng.integers(len(cameras), size=num))
    xy = rng.uniform(0.0, SIZE, (num, 2))
    points = np.empty((num, 3))
    for c, item in enumerate(cameras):
        origins, dirs = item.ray_from_img(xy[index == c])
        in_cam = origins + rng.uniform(0.5, 10.0, (len(dirs), 1)) * dirs
        points[index == c] = rigid3.transform(rigid3.inverse(cam_from_rig[c]), in_cam)
    pose = np.concatenate(
        [rigid3.quat_from_rotvec(rng.normal(size=3)), rng.normal(size=3)]
    )
    points = rigid3.transform(rigid3.inverse(pose), points)
    right = rng.random(num) >= wrong
    xy += noise_px * rng.standard_normal(xy.shape)
    xy[~right] = rng.uniform(0.0, SIZE, (np.count_nonzero(~right), 2))
    return (cameras, cam_from_rig, index, xy, points), pose, right


def offset(pose, truth) -> np.ndarray:
    """The tangent (6,) that `rigid3.perturb` takes from the truth to the pose."""
    delta = rigid3.compose(pose, rigid3.inverse(truth))
    rotvec = rigid3.rotvec_from_quat(delta[:4])
    turned = rigid3.perturb(truth, np.concatenate([rotvec, np.zeros(3)]))
    return np.concatenate([rotvec, pose[4:] - turned[4:]])


@pytest.mark.parametrize("rig", [one_camera, behind_a_dome, four_cameras])
@pytest.mark.parametrize("wrong", [0.0, 0.6])
def test_exact_without_noise(rig, wrong, rng):
    args, truth, right = simulated(rig(), rng, wrong=wrong)
    found = estimate_rig_pose(*args)
    # Projection is exact to 1e-12 px, and a pixel is about 1e-3 rad and 10 mm.
    assert np.abs(offset(found.rig_from_world, truth)).max() < 1e-10
    assert found.inliers[right].all()
    assert found.errors_px[right].max() < 1e-8
    # A wrong match is an inlier by chance: pi 8^2 px of 2 Mpx.
    assert np.count_nonzero(found.inliers & ~right) <= 2


@pytest.mark.parametrize(
    ("index", "least"),
    # Six in one camera; three per camera; one each: no camera gives a sample.
    [([0] * 6, 1.0), ([0, 0, 0, 1, 1, 1], 1.0), ([0, 0, 1, 1, 2, 2, 3, 3], 0.9)],
)
def test_few_matches_are_enough(index, least, rng):
    rig = four_cameras()
    found = []
    for _ in range(20):
        args, truth, _ = simulated(rig, rng, num=400)
        rows = [np.flatnonzero(args[2] == c)[k] for k, c in enumerate(index)]
        few = [array[rows] for array in args[2:]]
        pose = estimate_rig_pose(*args[:2], *few)
        good = (
            pose is not None and np.abs(offset(pose.rig_from_world, truth)).max() < 1e-6
        )
        found.append(good)
    assert np.mean(found) >= least


@pytest.mark.parametrize("rig", [one_camera, four_cameras])
def test_errors_are_those_that_the_covariance_says(rig, rng):
    """Which is the Cramer-Rao bound: e^T C^-1 e is chi-square with 6 degrees."""
    squares = []
    for seed in range(60):
        args, truth, right = simulated(rig(), rng, noise_px=1.0, wrong=0.3)
        found = estimate_rig_pose(*args, AbsolutePoseOptions(seed=seed))
        error = offset(found.rig_from_world, truth)
        squares.append(error @ np.linalg.solve(found.covariance, error))
        # The median of 140 lengths has a standard deviation of 6 %.
        assert found.noise_px == pytest.approx(1.0, rel=0.25)
    # Of the mean: sqrt(12 / 60) = 0.45, four of them; and 0.3 for the noise, which is
    # estimated and enters inverted.
    assert np.mean(squares) == pytest.approx(6.0, abs=2.1)


def test_agrees_with_colmap_on_virtual_cameras(rng):
    """One pinhole per match, with its centre on the water ray: another solver."""
    args, _, _ = simulated(one_camera(), rng, noise_px=0.5)
    _, _, _, xy, points = args
    origins, dirs = args[0][0].ray_from_img(xy)
    tangents = dirs[:, :2] / dirs[:, 2:]
    focal = 1297.0 * 1.334
    cameras = [
        pycolmap.Camera(
            model="SIMPLE_PINHOLE",
            width=1920,
            height=1080,
            params=[focal, x - focal * u, y - focal * v],
        )
        for (x, y), (u, v) in zip(xy, tangents, strict=True)
    ]
    placed = [pycolmap.Rigid3d(pycolmap.Rotation3d(), -o) for o in origins]
    options = pycolmap.RANSACOptions(max_error=12.0, random_seed=1)
    answer = pycolmap.estimate_and_refine_generalized_absolute_pose(
        xy, points, list(range(len(xy))), placed, cameras, options
    )
    found = estimate_rig_pose(*args)
    apart = offset(np.array(answer["rig_from_world"].params), found.rig_from_world)
    # Both answer the same noise, weighted a little differently off the axis.
    assert (np.abs(apart) < 2.0 * np.sqrt(np.diag(found.covariance))).all()


def test_gradient_and_hessian_through_the_manifold(rng):
    args, truth, _ = simulated(four_cameras(), rng, num=40, noise_px=1.0)
    matches, rig = checked(*args)
    pose = rigid3.perturb(truth, rng.normal(scale=1e-3, size=6))
    use = np.ones(40, dtype=bool)
    loss, scale = LOSS_CODES["cauchy"], 2.0

    def cost(at):
        return np.array(
            pose_cost(rigid3.matrix_rows(at), matches, use, rig, loss, scale)
        )

    hessian, grad = np.empty((6, 6)), np.empty(6)
    row = rigid3.matrix_rows(pose)
    value = normal_equations(row, matches, use, rig, loss, scale, hessian, grad)
    assert value == pytest.approx(float(cost(pose)), rel=1e-12)
    check_jacobian(cost, rigid3.perturb, pose, grad, step=1e-5)


def test_what_cannot_be_seen_is_an_outlier(rng):
    """Points behind the camera, inside the housing, unknown; pixels of nothing."""
    args, truth, _ = simulated(one_camera(), rng, num=60)
    cameras, poses, index, xy, points = args
    to_world = rigid3.inverse(truth)
    points[:10] = rigid3.transform(to_world, [0.0, 0.0, -1.0])
    points[10:20] = rigid3.transform(to_world, [0.0, 0.0, 0.01])
    points[20] = np.nan
    xy[21] = np.nan
    found = estimate_rig_pose(cameras, poses, index, xy, points)
    np.testing.assert_array_equal(found.inliers, np.arange(60) > 21)
    assert np.isinf(found.errors_px[:21]).all()
    assert np.abs(offset(found.rig_from_world, truth)).max() < 1e-9


def test_same_seed_same_bytes(rng):
    args, _, _ = simulated(one_camera(), rng, noise_px=1.0, wrong=0.3)
    one, two = estimate_rig_pose(*args), estimate_rig_pose(*args)
    assert one.rig_from_world.tobytes() == two.rig_from_world.tobytes()


def test_no_pose_where_there_is_none(rng):
    args, _, _ = simulated(one_camera(), rng, wrong=1.0)
    options = AbsolutePoseOptions(max_trials=500, min_num_inliers=10)
    assert estimate_rig_pose(*args, options) is None
    few = (*args[:2], *(array[:5] for array in args[2:]))
    assert estimate_rig_pose(*few) is None


def test_points_on_a_line_leave_the_turn_around_it_unknown(rng):
    args, truth, _ = simulated(one_camera(), rng, num=20)
    line = np.column_stack([np.zeros((20, 2)), np.linspace(1.0, 3.0, 20)])
    line[:, 0] = 0.1 * line[:, 2]
    xy, _ = args[0][0].img_from_point(line)
    points = rigid3.transform(rigid3.inverse(truth), line)
    found = estimate_rig_pose(*args[:3], xy, points)
    assert found is None or np.isinf(found.covariance).all()


def test_three_ray_poses_without_compilation(rng):
    args, truth, _ = simulated(one_camera(), rng, num=3)
    origins, dirs = args[0][0].ray_from_img(args[3])
    rays = np.column_stack([origins - 0.1 * dirs, dirs])
    compiled, plain = np.zeros((4, 12)), np.zeros((4, 12))
    num = poses_from_three(rays, args[4], 0, 1, 2, np.empty((4, 3)), compiled)
    same = poses_from_three.py_func(rays, args[4], 0, 1, 2, np.empty((4, 3)), plain)
    assert num == same > 0
    np.testing.assert_allclose(compiled, plain, rtol=1e-9, atol=1e-12)
    errors = np.abs(compiled[:num] - rigid3.matrix_rows(truth)).max(axis=1)
    assert errors.min() < 1e-6


def test_input_is_checked(rng):
    args, _, _ = simulated(one_camera(), rng, num=10)
    cameras, poses, index, xy, points = args
    with pytest.raises(InputError, match=r"points.shape=\(9, 3\)"):
        estimate_rig_pose(cameras, poses, index, xy, points[:9])
    with pytest.raises(InputError, match="camera_idx"):
        estimate_rig_pose(cameras, poses, index + 1, xy, points)
    with pytest.raises(InputError, match="confidence"):
        AbsolutePoseOptions(confidence=1.0)
