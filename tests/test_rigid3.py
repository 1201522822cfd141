"""Poses as rows: conventions against scipy and pycolmap, digits at the edges."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from uwsfm.geometry import rigid3


@pytest.fixture
def poses(rng):
    quats = rng.normal(size=(50, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return np.concatenate([quats, rng.normal(size=(50, 3))], axis=1)


def test_rows_mean_what_pycolmap_means_by_them(poses, rng):
    x = rng.normal(size=3)
    first, second = (
        pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4]), pose[4:]) for pose in poses[:2]
    )
    np.testing.assert_array_equal(first.params, poses[0])
    np.testing.assert_allclose(rigid3.transform(poses[0], x), first * x, atol=1e-14)
    both = first * second
    np.testing.assert_allclose(
        rigid3.transform(rigid3.compose(poses[0], poses[1]), x), both * x, atol=1e-14
    )
    np.testing.assert_allclose(
        rigid3.matrix_rows(poses[0]).reshape(3, 4), first.matrix(), atol=1e-15
    )


def test_rotations_agree_with_scipy(poses):
    scipy_rotation = Rotation.from_quat(poses[:, :4])
    matrices = rigid3.rotmat_from_quat(poses[:, :4])
    np.testing.assert_allclose(matrices, scipy_rotation.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(
        rigid3.rotvec_from_quat(poses[:, :4]), scipy_rotation.as_rotvec(), atol=1e-14
    )
    np.testing.assert_allclose(
        rigid3.rotation_angle(poses), scipy_rotation.magnitude(), atol=1e-14
    )
    back = rigid3.from_rotmat(matrices, poses[:, 4:])
    same_sign = poses[:, :4] * np.where(poses[:, 3:4] < 0, -1.0, 1.0)
    np.testing.assert_allclose(back[:, :4], same_sign, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-6, 1.0, np.pi - 1e-9, np.pi])
def test_rotation_vectors_keep_their_digits_at_every_angle(angle):
    rotvec = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    quat = rigid3.quat_from_rotvec(rotvec)
    assert np.linalg.norm(quat) == pytest.approx(1.0, abs=1e-15)
    back = rigid3.rotvec_from_quat(quat)
    # At pi both signs are the same rotation.
    sign = -1.0 if angle == np.pi and back @ rotvec < 0 else 1.0
    np.testing.assert_allclose(sign * back, rotvec, rtol=1e-14, atol=0.0)
    matrix = rigid3.rotmat_from_quat(quat)
    again = rigid3.quat_from_rotmat(matrix)
    # Half-turns: the eigenvector has both signs, w is zero.
    assert abs(again @ quat) == pytest.approx(1.0, abs=1e-14)


def test_inverse_undoes_and_broadcasting_is_per_row(poses, rng):
    x = rng.normal(size=(50, 3))
    there = rigid3.transform(poses, x)
    back = rigid3.transform(rigid3.inverse(poses), there)
    np.testing.assert_allclose(back, x, atol=1e-14)
    one = rigid3.transform(poses[3], x)
    np.testing.assert_allclose(one[3], there[3], atol=1e-15)


def test_perturbation_acts_from_the_left_rotation_first(poses, rng):
    x, delta = rng.normal(size=3), rng.normal(size=6)
    turn = Rotation.from_rotvec(delta[:3])
    moved = rigid3.transform(rigid3.perturb(poses[0], delta), x)
    expected = turn.apply(rigid3.transform(poses[0], x)) + delta[3:]
    np.testing.assert_allclose(moved, expected, atol=1e-14)
    unmoved = rigid3.perturb(poses[0], np.zeros(6))
    np.testing.assert_allclose(unmoved, poses[0], atol=1e-16)


def test_points_by_few_poses_are_those_by_their_own(rng):
    poses = rigid3.perturb(np.tile(rigid3.IDENTITY, (4, 1)), rng.normal(size=(4, 6)))
    index, points = rng.integers(0, 4, 50), rng.normal(size=(50, 3))
    np.testing.assert_allclose(
        rigid3.transform_indexed(poses, index, points),
        rigid3.transform(poses[index], points),
        atol=1e-14,  # a few roundings of numbers near one
    )
