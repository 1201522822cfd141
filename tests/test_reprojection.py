"""The residual of the bundle adjustment, and its Jacobian by the rig and the camera."""

import numpy as np
import pytest
from jacobians import (
    CAMERA_IDS,
    EXAMPLE_CAMERAS,
    EXAMPLE_PORTS,
    check_jacobian,
    port_blocks,
)

from uwsfm import RefractiveCamera, Status
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.models.lens import lens_row, param_slots, with_limit
from uwsfm.models.projection import JAC_SIZE
from uwsfm.residuals.border import BORDER_SIZE, FIRST_LENS
from uwsfm.residuals.reprojection import residual, residual_with_jac
from uwsfm.solver.state import translation_arm


@pytest.mark.parametrize("camera", EXAMPLE_CAMERAS, ids=CAMERA_IDS)
@pytest.mark.parametrize("port", EXAMPLE_PORTS.values(), ids=EXAMPLE_PORTS.keys())
def test_jacobian_of_the_rig_pose_the_camera_pose_and_the_housing(camera, port, rng):
    """Blocks: point in the rig, its frame's pose, rotation, direction and length of
    cam_from_rig, every block of the port, and the lens."""
    quat = rigid3.quat_from_rotvec(0.2 * rng.normal(size=3))
    cam_from_rig = np.concatenate([quat, 0.2 * rng.normal(size=3)])
    xy = 0.6 * np.array([camera.width, camera.height])
    origins, dirs = RefractiveCamera(camera, port).ray_from_img(xy[None])
    in_cam = origins[0] + 1.5 * dirs[0]
    point = rigid3.transform(rigid3.inverse(cam_from_rig), in_cam)
    lens = lens_row(camera.model_name, camera.params)
    start = (point, cam_from_rig, port.row, lens)

    def error(x):
        cam = rigid3.matrix_rows(x[1])
        status, *pixels = residual(*x[0], xy, cam, with_limit(x[3]), x[2])
        assert status == Status.VALID
        return np.array(pixels)

    j_rig, j_border = np.empty((2, 3)), np.empty((2, BORDER_SIZE))
    status, *pixels = residual_with_jac(
        *point,
        xy,
        rigid3.matrix_rows(cam_from_rig),
        translation_arm(cam_from_rig[4:]),
        lens,
        port.row,
        True,
        np.empty((2, JAC_SIZE)),
        j_rig,
        j_border,
    )
    assert status == Status.VALID
    np.testing.assert_array_equal(pixels, error(start))
    assert np.abs(pixels).max() < 1e-9  # the point is on the pixel's ray

    def check(jac, plus, step=1e-4):
        check_jacobian(error, plus, start, jac, step=step, size=camera.width)

    check(j_rig, lambda x, d: (x[0] + d, *x[1:]))
    # rig_from_world, as the solver expands it: M = [-[q]x I].
    pose = np.column_stack([np.cross(point, j_rig), j_rig])
    check(pose, lambda x, d: (rigid3.perturb([0, 0, 0, 1, *x[0]], d)[4:], *x[1:]))
    check(j_border[:, 0:3], _with_rotation)
    check(j_border[:, 3:6], _with_translation)
    # From the border's order to that of `port_blocks`: the water index is last there.
    of_port = j_border[:, [6, 7, 8, 10, 11, 9, 12]]
    for columns, plus, step in port_blocks(port):
        check(of_port[:, columns], _with_port(plus), step)
    for slot in param_slots(camera.model_name):
        column = j_border[:, FIRST_LENS + slot]
        if slot == 0 and 1 not in param_slots(camera.model_name):
            column = column + j_border[:, FIRST_LENS + 1]
        check(column[:, None], _with_lens(camera.model_name, slot))


def _with_port(plus):
    return lambda x, delta: (*x[:2], plus(x[2], delta), x[3])


def _with_lens(model, slot):
    """One parameter of a lens row; a single focal length is both."""
    both = [0, 1] if slot == 0 and 1 not in param_slots(model) else [slot]

    def plus(x, delta):
        lens = x[3].copy()
        lens[both] += delta
        return *x[:3], lens

    return plus


def _with_rotation(x, delta):
    quat = rigid3.multiply_quats(rigid3.quat_from_rotvec(delta), x[1][:4])
    return x[0], np.concatenate([quat, x[1][4:]]), *x[2:]


def _with_translation(x, delta):
    length = np.linalg.norm(x[1][4:])
    direction = unit_vector.plus(x[1][4:] / length, delta[:2])
    shift = (length + delta[2]) * direction
    return x[0], np.concatenate([x[1][:4], shift]), *x[2:]
