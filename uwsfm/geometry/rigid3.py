"""Rigid transforms as rows of seven numbers, vectorised over leading dimensions.

A pose ``b_from_a`` is ``[qx, qy, qz, qw, tx, ty, tz]`` (unit quaternion xyzw, then the
translation), as ``pycolmap.Rigid3d.params``: ``x_in_b = R(q) x_in_a + t``.

Perturbations act from the left with the tangent ordered ``[rotation, translation]``:
``perturb(b_from_a, [w, v])`` maps x to ``Exp(w) (R x + t) + v``. (jaxlie uses wxyz and
translation first, PoseLib perturbs from the right.)
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

IDENTITY: Array = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
IDENTITY.setflags(write=False)


def rotmat_from_quat(quat: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions xyzw (..., 4)."""
    quat = np.asarray(quat, dtype=np.float64)
    x, y, z, w = quat[..., 0], quat[..., 1], quat[..., 2], quat[..., 3]
    rotmat = np.empty((*quat.shape[:-1], 3, 3))
    rotmat[..., 0, 0] = 1 - 2 * (y * y + z * z)
    rotmat[..., 0, 1] = 2 * (x * y - z * w)
    rotmat[..., 0, 2] = 2 * (x * z + y * w)
    rotmat[..., 1, 0] = 2 * (x * y + z * w)
    rotmat[..., 1, 1] = 1 - 2 * (x * x + z * z)
    rotmat[..., 1, 2] = 2 * (y * z - x * w)
    rotmat[..., 2, 0] = 2 * (x * z - y * w)
    rotmat[..., 2, 1] = 2 * (y * z + x * w)
    rotmat[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return rotmat


def quat_from_rotmat(rotmat: ArrayLike) -> Array:
    """Unit quaternions xyzw (..., 4), with w >= 0, of rotation matrices (..., 3, 3).

    Bar-Itzhack (2000): the quaternion is the dominant eigenvector of a symmetric 4x4
    matrix, which is stable at every angle and finds the nearest rotation.
    """
    m = np.asarray(rotmat, dtype=np.float64)
    k = np.zeros((*m.shape[:-2], 4, 4))
    k[..., 0, 0] = m[..., 0, 0] - m[..., 1, 1] - m[..., 2, 2]
    k[..., 1, 1] = m[..., 1, 1] - m[..., 0, 0] - m[..., 2, 2]
    k[..., 2, 2] = m[..., 2, 2] - m[..., 0, 0] - m[..., 1, 1]
    k[..., 3, 3] = m[..., 0, 0] + m[..., 1, 1] + m[..., 2, 2]
    k[..., 1, 0] = m[..., 0, 1] + m[..., 1, 0]
    k[..., 2, 0] = m[..., 0, 2] + m[..., 2, 0]
    k[..., 2, 1] = m[..., 1, 2] + m[..., 2, 1]
    k[..., 3, 0] = m[..., 2, 1] - m[..., 1, 2]
    k[..., 3, 1] = m[..., 0, 2] - m[..., 2, 0]
    k[..., 3, 2] = m[..., 1, 0] - m[..., 0, 1]
    quat = np.linalg.eigh(k)[1][..., -1]  # eigh reads the lower triangle
    return np.where(quat[..., 3:] < 0, -quat, quat)


def from_rotmat(rotmat: ArrayLike, translation: ArrayLike) -> Array:
    """Pose rows (..., 7) of rotation matrices (..., 3, 3), translations (..., 3)."""
    quat = quat_from_rotmat(rotmat)
    shift = np.broadcast_to(np.asarray(translation, float), (*quat.shape[:-1], 3))
    return np.concatenate([quat, shift], axis=-1)


def multiply_quats(q: ArrayLike, p: ArrayLike) -> Array:
    """Hamilton product q p of quaternions xyzw (..., 4): R(q p) = R(q) R(p)."""
    q, p = np.asarray(q, dtype=np.float64), np.asarray(p, dtype=np.float64)
    qx, qy, qz, qw = q[..., 0], q[..., 1], q[..., 2], q[..., 3]
    px, py, pz, pw = p[..., 0], p[..., 1], p[..., 2], p[..., 3]
    return np.stack(
        [
            qw * px + pw * qx + (qy * pz - qz * py),
            qw * py + pw * qy + (qz * px - qx * pz),
            qw * pz + pw * qz + (qx * py - qy * px),
            qw * pw - (qx * px + qy * py + qz * pz),
        ],
        axis=-1,
    )


def rotate(b_from_a: ArrayLike, vector_in_a: ArrayLike) -> Array:
    """Rotate vectors (..., 3) by poses (..., 7); the translation is ignored."""
    pose = np.asarray(b_from_a, dtype=np.float64)
    rotmat = rotmat_from_quat(pose[..., :4])
    return np.einsum("...ij,...j->...i", rotmat, np.asarray(vector_in_a, float))


def transform(b_from_a: ArrayLike, x_in_a: ArrayLike) -> Array:
    """Transform points (..., 3) by poses (..., 7), broadcasting."""
    pose = np.asarray(b_from_a, dtype=np.float64)
    return rotate(pose, x_in_a) + pose[..., 4:]


def transform_indexed(
    b_from_a: ArrayLike, index: ArrayLike, x_in_a: ArrayLike
) -> Array:
    """Transform points (N, 3), each by one of a few poses (K, 7): ``index`` (N,)."""
    pose, index = np.asarray(b_from_a, dtype=np.float64), np.asarray(index)
    rotmat = rotmat_from_quat(pose[:, :4])[index]  # one for each pose, not each point
    turned = np.einsum("nij,nj->ni", rotmat, np.asarray(x_in_a, float))
    turned += pose[index, 4:]
    return turned


def compose(c_from_b: ArrayLike, b_from_a: ArrayLike) -> Array:
    """Poses c_from_a (..., 7), with the quaternion renormalised."""
    outer = np.asarray(c_from_b, dtype=np.float64)
    inner = np.asarray(b_from_a, dtype=np.float64)
    quat = multiply_quats(outer[..., :4], inner[..., :4])
    quat /= np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.concatenate([quat, transform(outer, inner[..., 4:])], axis=-1)


def inverse(b_from_a: ArrayLike) -> Array:
    """Poses a_from_b (..., 7)."""
    pose = np.asarray(b_from_a, dtype=np.float64)
    quat = pose[..., :4] * np.array([-1.0, -1.0, -1.0, 1.0])
    return np.concatenate([quat, -rotate(quat, pose[..., 4:])], axis=-1)


def quat_from_rotvec(rotvec: ArrayLike) -> Array:
    """Quaternions xyzw (..., 4) of rotation vectors (..., 3), exact near zero."""
    rotvec = np.asarray(rotvec, dtype=np.float64)
    half = 0.5 * np.linalg.norm(rotvec, axis=-1, keepdims=True)
    # sinc(x) = sin(pi x) / (pi x) is smooth at zero.
    return np.concatenate([0.5 * np.sinc(half / np.pi) * rotvec, np.cos(half)], -1)


def rotvec_from_quat(quat: ArrayLike) -> Array:
    """Rotation vectors (..., 3), angle in [0, pi], of unit quaternions (..., 4)."""
    quat = np.asarray(quat, dtype=np.float64)
    quat = np.where(quat[..., 3:] < 0, -quat, quat)
    sine = np.linalg.norm(quat[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, quat[..., 3:])
    scale = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-300), 2.0)
    return scale * quat[..., :3]


def rotvec_by_turn(rotvec: ArrayLike) -> Array:
    """(3, 3) derivative of a rotation vector (3,) by a small turn after the rotation:
    the inverse left Jacobian of SO(3), regular below a whole turn."""
    rotvec = np.asarray(rotvec, dtype=np.float64)
    angle = float(np.linalg.norm(rotvec))
    x, y, z = rotvec
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    half = 0.5 * angle
    # (1 - half cot half) / angle^2, whose limit at zero is 1 / 12.
    factor = 1.0 / 12.0
    if angle > 1e-4:  # where the difference has lost no digits that matter
        factor = (1.0 - half / np.tan(half)) / angle**2
    return np.asarray(np.eye(3) - 0.5 * cross + factor * cross @ cross)


def perturb(b_from_a: ArrayLike, delta: ArrayLike) -> Array:
    """Left perturbation of poses (..., 7) by tangents (..., 6) [rotation, translation].

    The rotation part turns the whole pose, the old translation included.
    """
    delta = np.asarray(delta, dtype=np.float64)
    step = np.concatenate([quat_from_rotvec(delta[..., :3]), delta[..., 3:]], axis=-1)
    return compose(step, b_from_a)


def rotation_angle(b_from_a: ArrayLike) -> Array:
    """Rotation angles (...) of poses (..., 7) or quaternions (..., 4), radians."""
    quat = np.asarray(b_from_a, dtype=np.float64)[..., :4]
    return np.linalg.norm(rotvec_from_quat(quat), axis=-1)


def matrix_rows(b_from_a: ArrayLike) -> Array:
    """Rows (..., 12) of the row-major matrices [R | t], as kernels read them."""
    pose = np.asarray(b_from_a, dtype=np.float64)
    rotmat = rotmat_from_quat(pose[..., :4])
    rows = np.concatenate([rotmat, pose[..., 4:, None]], axis=-1)
    return np.ascontiguousarray(rows.reshape(*pose.shape[:-1], 12))
