"""The bundle adjustment as one dense matrix: the oracle of the sparse solver.

Built observation by observation from the public camera and the chain rule; nothing is
shared with the accumulation of normal equations by cells.
"""

import numpy as np
from jacobians import central_differences

from uwsfm.geometry import rigid3, unit_vector
from uwsfm.geometry.rigid3 import rotmat_from_quat
from uwsfm.models.lens import NUM_PARAMS, param_slots, with_limit
from uwsfm.simulate import (
    ObservationOptions,
    Relief,
    SimulatedScene,
    simulate_scene,
)
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion
from uwsfm.solver.layout import HELD


def small_scene(num_frames=4, num_points=25, **options) -> SimulatedScene:
    """A dive with every term in it: OPENCV lenses, thick glass, a turned camera."""
    return simulate_scene(
        sample_rig(),
        rich_motion(num_frames),
        Relief(stddev=0.2),
        ObservationOptions(num_points=num_points, **options),
    )


def skew(x):
    return np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])


def lens_columns(camera, in_cam):
    """d(pixel) / d(lens parameters), (2, 12), by a five-point stencil."""

    def pixel(delta):
        row = camera.lens.copy()
        row[:NUM_PARAMS] += delta
        return camera.with_lens(with_limit(row)).img_from_point([in_cam])[0][0]

    used = np.isin(np.arange(NUM_PARAMS), param_slots(camera.camera.model_name))
    columns = np.zeros((2, NUM_PARAMS))
    columns[:, used] = central_differences(
        lambda delta: pixel(np.bincount(np.flatnonzero(used), delta, NUM_PARAMS)),
        int(used.sum()),
        1e-4,
    )
    return columns


def dense_system(scene, layout):
    """Jacobian (2N, n + 3P) and residuals (2N,), observations in the layout's order.

    Columns: free frames (6 each), border, points; as the reduced system, then points.
    """
    first_point = layout.num_frame_cols + layout.num_border_cols
    jac = np.zeros((len(layout.order), 2, first_point + 3 * scene.num_points))
    residuals = np.zeros((len(layout.order), 2))
    for row, i in enumerate(layout.order):
        c, f, p = scene.camera_idx[i], scene.frame_idx[i], scene.point_idx[i]
        frame, cam = scene.rig_from_world[f], scene.cam_from_rig[c]
        in_rig = rigid3.transform(frame, scene.points[p])
        turned = rigid3.rotate(cam, in_rig)
        pixel, j_port, _ = scene.cameras[c].img_from_point_with_jac(
            [rigid3.transform(cam, in_rig)]
        )
        residuals[row] = pixel[0] - scene.xy[i]
        j_cam = j_port[0, :, :3]
        j_rig = j_cam @ rotmat_from_quat(cam[:4])
        if layout.frame_col[f] != HELD:
            block = slice(layout.frame_col[f], layout.frame_col[f] + 6)
            jac[row, :, block] = j_rig @ np.column_stack([-skew(in_rig), np.eye(3)])
        length = max(np.linalg.norm(cam[4:]), 1e-300)
        direction = cam[4:] / length if c > 0 else np.array([0.0, 0.0, 1.0])
        border = np.column_stack(
            [
                -j_cam @ skew(turned),
                length * j_cam @ unit_vector.tangent_basis(direction),
                j_cam @ direction,
                # normal (2), distance, n_water, thickness, n_glass, radius
                j_port[0][:, [3, 4, 5, 8, 6, 7, 9]],
                lens_columns(scene.cameras[c], rigid3.transform(cam, in_rig))
                if layout.free_lens
                else np.zeros((2, NUM_PARAMS)),
            ]
        )
        for k, column in enumerate(layout.border_col[c]):
            if column != HELD:
                jac[row, :, layout.num_frame_cols + column] += border[:, k]
        start = first_point + 3 * p
        jac[row, :, start : start + 3] = j_rig @ rotmat_from_quat(frame[:4])
    return jac.reshape(2 * len(jac), -1), residuals.ravel()
