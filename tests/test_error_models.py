"""Every error function in the solver, against dense algebra and its own cost."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from dense import small_scene
from jacobians import DOMES, camera_from_line, central_differences

from uwsfm import CalibrateOptions, NoPort
from uwsfm.calibration.priors import border_priors
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.models.lens import param_slots
from uwsfm.models.ports.port import DomePort, FlatPort
from uwsfm.models.ports.row import KIND, N_WATER
from uwsfm.residuals import point_3d, virtual_camera
from uwsfm.simulate import (
    ObservationOptions,
    Perturbation,
    Relief,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.rigs import stereo_rig
from uwsfm.simulate.trajectories import rich_motion
from uwsfm.solver import levenberg_marquardt as lm
from uwsfm.solver.assembly import expand_cells
from uwsfm.solver.error_models import ERROR_CODES, error_model
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.state import State

OFF = Perturbation(
    straight_ports=False,  # a concentric dome does not depend on its water
    distance_scale=1.0,
    rotation_stddev_deg=0.3,
    translation_stddev=0.005,
    cam_rotation_stddev_deg=0.2,
    baseline_direction_stddev_deg=0.3,
    point_stddev=0.01,
)


LENSES = {
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
}
KNOWN = CalibrateOptions(
    baseline_stddev_m=0.002,
    distance_stddev_m=0.002,
    normal_stddev_deg=1.0,
    center_stddev_m=0.002,
    water_index_stddev=0.002,
    focal_stddev=1e-3,
    principal_point_stddev_px=1.0,
    distortion_stddev=1e-3,
)
SHIFT = [2.0, 1.0, 2.0, -1.0, 1e-3, -1e-3, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1e-3]


def contradicted(scene):
    """A state that differs from the scene's in all that can be known."""
    state = State.from_scene(scene)
    cam_from_rig, ports, lenses = (
        rows.copy() for rows in (state.cam_from_rig, state.ports, state.lenses)
    )
    cam_from_rig[1, 4:] *= 1.01
    for row in ports:
        if row[KIND] == FlatPort.code:
            row[:3] = unit_vector.plus(row[:3], [0.02, -0.03])
            row[3] += 0.002
        elif row[KIND] == DomePort.code:
            row[:3] += [0.002, -0.001, 0.003]
    ports[ports[:, KIND] != NoPort.code, N_WATER] += 0.002
    for camera, row in zip(scene.cameras, lenses, strict=True):
        slots = list(param_slots(camera.camera.model_name))
        row[slots] += np.array(SHIFT)[slots]
        row[1] = row[1 if 1 in slots else 0]
    return replace(state, cam_from_rig=cam_from_rig, ports=ports, lenses=lenses)


def problem_of(scene, error, loss, *, known):
    """A problem at the scene's state, all refined that the error determines."""
    lenses = LENSES if error == "reprojection" else {}
    settings = replace(KNOWN, refine_water_index=True, **lenses)
    none = np.zeros(len(scene.cameras), dtype=bool)
    columns = settings.border_columns(scene.cameras, none)
    layout = build_layout(scene, columns)
    priors = None
    if known:
        priors = border_priors(scene, settings, columns, sigma_px=20.0)
        priors = replace(priors, reference=contradicted(scene))
    options = lm.LevenbergMarquardtOptions(error=error, loss=loss)
    model = error_model(error, layout, State.from_scene(scene))
    return lm.Problem(layout, model, options, priors)


def moved(problem, state, delta):
    """A step of everything: reduced system, then points."""
    size = problem.layout.num_frame_cols + problem.layout.num_border_cols
    return state.moved(problem.layout, delta[:size], delta[size:].reshape(-1, 3))


def num_unknowns(problem):
    layout = problem.layout
    points = len(layout.point_start) - 1
    return layout.num_frame_cols + layout.num_border_cols + 3 * points


def dense_of(layout, eqs):
    """Normal matrix and gradient (n + 3P) from the blocks of `NormalEquations`."""
    offset = layout.num_frame_cols
    size = offset + layout.num_border_cols
    total = size + 3 * len(eqs.points)
    matrix, gradient = np.zeros((total, total)), np.zeros(total)
    coupled = np.empty((1, 6, 3))
    rim = slice(offset, size)
    matrix[rim, rim], gradient[rim] = eqs.border, eqs.border_grad
    for f, col in enumerate(layout.frame_col):
        if col != HELD:
            rows = slice(col, col + 6)
            matrix[rows, rows], gradient[rows] = eqs.frames[f], eqs.frames_grad[f]
            matrix[rows, rim] = eqs.frames_border[f]
    for p in range(len(eqs.points)):
        rows = slice(size + 3 * p, size + 3 * p + 3)
        matrix[rows, rows], gradient[rows] = eqs.points[p], eqs.points_grad[p]
        matrix[rim, rows] = eqs.points_border[p].T
        for c in range(layout.point_start[p], layout.point_start[p + 1]):
            col = layout.frame_col[layout.cell_frame[c]]
            if col != HELD:
                expand_cells(eqs.cells, c, c + 1, coupled)
                matrix[col : col + 6, rows] = coupled[0]
    return np.triu(matrix) + np.triu(matrix, 1).T, gradient


def one_by_one(problem, scene, state):
    """Errors (M, 2 or 3) in pixels from the public projection, kernels and rays."""
    layout, error = problem.layout, problem.error.code
    if error == ERROR_CODES["reprojection"]:
        return state.to_scene(scene).residuals()[layout.order]
    cams, ports = rigid3.matrix_rows(state.cam_from_rig), state.ports
    in_rig = rigid3.transform(
        state.rig_from_world[scene.frame_idx], state.points[scene.point_idx]
    )
    rays = [
        scene.cameras[c].camera.cam_ray_from_img(xy[None])[0]
        for c, xy in zip(scene.camera_idx, scene.xy, strict=True)
    ]
    errors = []
    if error == ERROR_CODES["point_3d"]:
        cells = scene.point_idx * scene.num_frames + scene.frame_idx
        for cell in np.unique(cells):
            rows = np.flatnonzero(cells == cell)
            dirs, camera = np.array([rays[i] for i in rows]), scene.camera_idx[rows]
            args = (dirs, camera, 0, len(rows), cams, ports)
            errors.append(point_3d.residual(*in_rig[rows[0]], *args)[1:])
    else:
        sheet = error == ERROR_CODES["virtual_camera_tangential"]
        for i in layout.order:
            c = scene.camera_idx[i]
            args = (rays[i], cams[c], ports[c], sheet)
            errors.append(virtual_camera.residual(*in_rig[i], *args)[1:])
    return problem.error.unit * np.array(errors)


def odd_pair(num_points):
    """One focal length for two axes in one camera, a fisheye's angles in the other."""
    left = camera_from_line("SIMPLE_RADIAL 800 600 700 402 297 -0.05")
    right = camera_from_line("OPENCV_FISHEYE 800 600 591 592 404 297 .03 .007 0 2e-4")
    rig = stereo_rig((left, right), right_rotvec_deg=(0.6, 1.9, -0.8))
    options = ObservationOptions(num_points=num_points, noise_px=0.5)
    return simulate_scene(rig, rich_motion(3), Relief(stddev=0.2), options).scene


def brown_pair(num_points):
    return small_scene(3, num_points, noise_px=0.5).scene


def dome_and_bare_pair(num_points):
    """A dome off its camera, filled with another gas than air, and no port at all."""
    scene = odd_pair(num_points)
    rig = stereo_rig(tuple(camera.camera for camera in scene.cameras))
    ports = (DOMES["filled with oil"], NoPort())
    cameras = tuple(
        replace(camera, port=port, refine_center=port is ports[0])
        for camera, port in zip(rig.cameras, ports, strict=True)
    )
    options = ObservationOptions(num_points=num_points, noise_px=0.5)
    rig = replace(rig, cameras=cameras)
    return simulate_scene(rig, rich_motion(3), Relief(stddev=0.2), options).scene


# The other errors are those of flat ports.
PAIRS = pytest.mark.parametrize(
    ("pair", "error"),
    [
        *product([brown_pair, odd_pair], ERROR_CODES),
        (dome_and_bare_pair, "reprojection"),
    ],
)


def with_repeats(scene):
    """What both cameras see, and some of it once more by one of them: such matches
    exist, and there are more of them in a cell than cameras."""
    cells = scene.point_idx * scene.num_frames + scene.frame_idx
    scene, _ = scene.select(np.bincount(cells)[cells] == 2)
    again = np.flatnonzero((scene.camera_idx == 1) & (scene.point_idx % 2 == 0))
    rows = np.append(np.arange(scene.num_observations), again)
    columns = ("camera_idx", "frame_idx", "point_idx", "xy")
    scene = replace(scene, **{name: getattr(scene, name)[rows] for name in columns})
    scene.xy[-len(again) :] += 3.0
    return scene


@pytest.mark.parametrize("loss", ["l2", "cauchy"])
@PAIRS
def test_cells_sum_to_the_dense_normal_equations(pair, error, loss):
    scene = with_repeats(perturbed(pair(8), OFF))
    problem = problem_of(scene, error, loss, known=False)
    state, layout = State.from_scene(scene), problem.layout
    errors = one_by_one(problem, scene, state)
    square = np.sum(errors**2, axis=1)
    weight, price = np.ones_like(square), square
    if loss == "cauchy":
        weight, price = 1.0 / (1.0 + square / 9.0), 9.0 * np.log1p(square / 9.0)
    cost, valid = problem.cost(state)
    assert valid == len(errors) and cost == pytest.approx(0.5 * price.sum(), rel=1e-9)

    jac = central_differences(
        lambda delta: one_by_one(problem, scene, moved(problem, state, delta)),
        num_unknowns(problem),
        1e-5,
    )
    rows = np.sqrt(weight)[:, None, None] * jac
    rows = rows.reshape(-1, jac.shape[-1])
    matrix, gradient = dense_of(layout, problem.linearize(state))
    expected = rows.T @ (np.sqrt(weight)[:, None] * errors).ravel()
    scale = np.linalg.norm(rows, axis=0)
    assert scale.min() > 0.0
    # Differences over 1e-5 rad or m: 1e-13 / 1e-5 of rounding, 1e-4^4 of curvature.
    relative = np.abs(matrix - rows.T @ rows) / np.outer(scale, scale)
    assert relative.max() < 1e-6
    miss = np.abs(gradient - expected) / scale / np.sqrt(price.sum())
    assert miss.max() < 1e-7


@pytest.mark.parametrize("loss", ["l2", "cauchy"])
@PAIRS
def test_gradient_is_that_of_the_cost_with_its_priors(pair, error, loss):
    scene = perturbed(pair(20), OFF)
    problem = problem_of(scene, error, loss, known=True)
    state = State.from_scene(scene)
    assert problem.priors.cost(state) > 0.02 * problem.cost(state)[0]
    matrix, gradient = dense_of(problem.layout, problem.linearize(state))
    # A step of each unknown that changes its errors by about 0.01 px in all.
    size = 1e-2 / np.sqrt(np.maximum(np.diag(matrix), 1e-6))
    numeric = central_differences(
        lambda delta: np.array(problem.cost(moved(problem, state, size * delta))[0]),
        len(size),
        1.0,
    )
    spread = np.sqrt(2.0 * problem.cost(state)[0]) * 1e-2
    np.testing.assert_allclose(size * gradient, numeric, rtol=0, atol=1e-6 * spread)
