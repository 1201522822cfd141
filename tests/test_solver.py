"""The sparse solver against dense algebra, and its rules at the edges."""

from dataclasses import replace

import numpy as np
import pytest
from dense import dense_system, small_scene
from jacobians import check_jacobian

from uwsfm import CalibrateOptions, InputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.residuals.border import BORDER_SIZE, LENGTH
from uwsfm.simulate import Perturbation, perturbed
from uwsfm.solver import assembly, chunks, normal_equations
from uwsfm.solver import levenberg_marquardt as lm
from uwsfm.solver.error_models import error_model
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.linear import schur
from uwsfm.solver.linear.block_graph import build_graph
from uwsfm.solver.losses import INVALID_PX, rho
from uwsfm.solver.state import State
from uwsfm.solver.workspace import Workspace

# 3 + 2 + 1 of the second camera, 3 of both ports, the index; then 8 of either lens.
HOUSINGS = CalibrateOptions(refine_water_index=True, baseline_stddev_m=0.002)
EVERYTHING = replace(
    HOUSINGS, refine_focal=True, refine_principal_point=True, refine_distortion=True
)
NUM_COLUMNS = 13 + 16
NONE_AT_ZERO = np.zeros(2, dtype=bool)
OFF = Perturbation(
    rotation_stddev_deg=0.3,
    translation_stddev=0.005,
    cam_rotation_stddev_deg=0.2,
    point_stddev=0.01,
)


def problem_of(scene, options=EVERYTHING, loss="l2", prior_weight=1e4):
    layout = build_layout(scene, options.border_columns(scene.cameras, NONE_AT_ZERO))
    priors = None
    if options.baseline_stddev_m > 0.0:
        weights = np.zeros((2, BORDER_SIZE))
        weights[1, LENGTH] = prior_weight
        known = scene.cam_from_rig.copy()
        known[1, 4:] *= 0.201 / np.linalg.norm(known[1, 4:])
        reference = replace(State.from_scene(scene), cam_from_rig=known)
        priors = lm.Priors(reference=reference, weights=weights)
    error = error_model("reprojection", layout, State.from_scene(scene))
    return lm.Problem(layout, error, lm.LevenbergMarquardtOptions(loss=loss), priors)


def python_of(kernel):
    """The uncompiled function, also where NUMBA_DISABLE_JIT is set."""
    return getattr(kernel, "py_func", kernel)


def test_state_moves_along_the_columns_of_the_jacobian():
    scene = perturbed(small_scene(noise_px=0.3).scene, OFF)
    problem = problem_of(scene)
    layout, size = problem.layout, problem.layout.num_frame_cols + NUM_COLUMNS
    assert layout.num_border_cols == NUM_COLUMNS

    def errors(state):
        return state.to_scene(scene).residuals()[layout.order].ravel()

    def plus(state, delta):
        return state.moved(layout, delta[:size], delta[size:].reshape(-1, 3))

    jac, residuals = dense_system(scene, layout)
    state = State.from_scene(scene)
    np.testing.assert_allclose(errors(state), residuals, atol=1e-9)
    check_jacobian(errors, plus, state, jac, step=1e-4)


@pytest.mark.parametrize("loss", ["l2", "cauchy"])
@pytest.mark.parametrize("damping", [1e-8, 1e-4, 1.0])
def test_schur_step_equals_the_dense_step(loss, damping):
    scene = perturbed(small_scene(noise_px=0.5, outlier_ratio=0.1).scene, OFF)
    problem = problem_of(scene, HOUSINGS, loss=loss)
    layout = problem.layout
    state = State.from_scene(scene)
    eqs = problem.linearize(state)
    step, points_step = problem.step(eqs, damping)

    jac, residuals = dense_system(scene, layout)
    if loss == "cauchy":
        squares = np.sum(residuals.reshape(-1, 2) ** 2, axis=1)
        root = np.repeat(1.0 / np.sqrt(1.0 + squares / 9.0), 2)
        jac, residuals = root[:, None] * jac, root * residuals
    baseline = np.zeros(jac.shape[1])
    baseline[layout.num_frame_cols + layout.border_col[1, 5]] = 100.0  # sqrt(weight)
    jac = np.vstack([jac, baseline])
    residuals = np.append(residuals, 100.0 * (state.baselines[1] - 0.201))
    if loss == "l2":
        cost = problem.cost(state)[0]
        assert cost == pytest.approx(0.5 * residuals @ residuals, rel=1e-12)
    normal, gradient = jac.T @ jac, jac.T @ residuals
    damped = normal + np.diag(damping * np.maximum(np.diag(normal), 1e-6))
    # Solved on the scaled system: its condition is what limits both sides.
    scale = 1.0 / np.sqrt(np.diag(damped))
    expected = -scale * np.linalg.solve(
        damped * np.outer(scale, scale), scale * gradient
    )
    found = np.concatenate([step, points_step.ravel()])
    # In units of each parameter's own scale; condition 1e5 at the smallest damping.
    assert np.abs((found - expected) / scale).max() < 1e-10 * np.linalg.norm(
        expected / scale
    )
    decrease = problem.predicted_decrease(eqs, damping, step, points_step)
    model = residuals + jac @ expected
    gain = 0.5 * (residuals @ residuals - model @ model)
    assert decrease == pytest.approx(gain, rel=1e-8)


def test_residuals_and_gradient_vanish_at_the_truth():
    truth = small_scene().truth
    problem = problem_of(truth, CalibrateOptions())
    cost, valid = problem.cost(State.from_scene(truth))
    # The projection is solved to 1e-12 px, give or take the poses' rounding.
    assert valid == truth.num_observations and cost < 1e-18
    eqs = problem.linearize(State.from_scene(truth))
    for gradient, block in (
        (eqs.frames_grad, eqs.frames),
        (eqs.border_grad, eqs.border),
        (eqs.points_grad, eqs.points),
    ):
        assert np.abs(gradient).max() < 1e-9 * np.sqrt(block.max())


def test_scale_is_a_gauge_up_to_the_thickness_of_the_glass():
    """J (points, translations, baseline, distances, thickness) = 0, and thickness is
    known: so the scale's column is minus that of the thickness, and zero without it."""
    truth = small_scene().truth
    origin = truth.rig_from_world[0]
    with_first_frame_at_origin = replace(
        truth,
        rig_from_world=rigid3.compose(truth.rig_from_world, rigid3.inverse(origin)),
        points=rigid3.transform(origin, truth.points),
    )
    for thickness in (0.0, 0.02):
        cameras = tuple(
            camera.with_port(replace(camera.port, thickness=thickness))
            for camera in truth.cameras
        )
        scene = replace(with_first_frame_at_origin, cameras=cameras)
        layout = problem_of(scene).layout
        offset = layout.num_frame_cols
        scale = np.zeros(offset + layout.num_border_cols)
        for frame, column in enumerate(layout.frame_col):
            if column != HELD:
                scale[column + 3 : column + 6] = scene.rig_from_world[frame, 4:]
        scale[offset + layout.border_col[1, 5]] = 0.2
        scale[offset + layout.border_col[:, 8]] = 0.02
        jac, _ = dense_system(scene, layout)
        along = jac @ np.concatenate([scale, scene.points.ravel()])
        expected = np.zeros_like(along)
        for row, i in enumerate(layout.order):
            camera = scene.cameras[scene.camera_idx[i]]
            point = scene.points_in_cam()[i]
            j_port = camera.img_from_point_with_jac([point])[1]
            expected[2 * row : 2 * row + 2] = -thickness * j_port[0, :, 6]
        # Rounding of terms of 1e3 px per metre; the thickness' own is 0.1-10 px.
        np.testing.assert_allclose(along, expected, atol=1e-10)


def test_observations_that_cannot_be_projected_cost_and_count_but_do_not_pull():
    scene = small_scene().truth
    behind = int(scene.point_idx[0])
    points = scene.points.copy()
    points[behind] = [0.0, 0.0, -100.0]  # above the rig, which looks down
    broken = replace(scene, points=points)
    num_broken = np.count_nonzero(scene.point_idx == behind)
    problem = problem_of(broken, CalibrateOptions())
    cost, valid = problem.cost(State.from_scene(broken))
    assert valid == broken.num_observations - num_broken
    assert cost == pytest.approx(0.5 * num_broken * INVALID_PX**2)
    eqs = problem.linearize(State.from_scene(broken))
    assert not eqs.points[behind].any() and not eqs.points_grad[behind].any()
    step, points_step = problem.step(eqs, 1e-4)
    assert np.isfinite(step).all() and not points_step[behind].any()


def test_a_start_that_sees_nothing_is_refused():
    scene = small_scene().truth
    away = replace(scene, points=scene.points - [0.0, 0.0, 100.0])
    problem = problem_of(away, CalibrateOptions())
    with pytest.raises(UwsfmError, match="no observation"):
        lm.minimize(
            problem.layout, State.from_scene(away), lm.LevenbergMarquardtOptions()
        )


def test_iteration_limit_is_told_and_every_step_reported():
    scene = perturbed(small_scene(noise_px=0.3).scene, OFF)
    layout = problem_of(scene, CalibrateOptions()).layout
    seen = []
    result = lm.minimize(
        layout,
        State.from_scene(scene),
        lm.LevenbergMarquardtOptions(max_iterations=2),
        report=lambda iteration, cost: seen.append((iteration, cost)),
    )
    assert result.stop is lm.Stop.MAX_ITERATIONS and result.num_iterations == 2
    assert [iteration for iteration, _ in seen] == [0, 1, 2]
    assert seen[-1][1] == result.cost


def test_layout_sorts_observations_and_holds_the_first_observed_frame(rng):
    scene = small_scene().scene
    shuffled = rng.permutation(scene.num_observations)
    keep = scene.frame_idx[shuffled] != 0  # nobody saw frame 0
    scene, _ = replace(
        scene,
        camera_idx=scene.camera_idx[shuffled],
        frame_idx=scene.frame_idx[shuffled],
        point_idx=scene.point_idx[shuffled],
        xy=scene.xy[shuffled],
    ).select(keep)
    layout = build_layout(
        scene, CalibrateOptions().border_columns(scene.cameras, NONE_AT_ZERO)
    )
    assert layout.frame_col.tolist() == [HELD, HELD, 0, 6]
    held = np.array([False, False, True, False])
    local = build_layout(scene, layout.border_col, held)
    assert local.frame_col.tolist() == [HELD, 0, HELD, 6]
    table = np.column_stack([scene.point_idx, scene.frame_idx, scene.camera_idx])
    assert table[layout.order].tolist() == sorted(table.tolist())
    np.testing.assert_array_equal(layout.xy, scene.xy[layout.order])
    assert len(layout.cell_frame) == len(np.unique(table[:, :2], axis=0))
    with pytest.raises(InputError, match="no observations"):
        build_layout(scene.select(np.zeros(len(table), bool))[0], layout.border_col)


def test_cauchy_loss_and_its_slope():
    for square in (0.0, 1e-6, 4.0, 1e4):
        value, slope = rho(square, 1, 3.0)
        assert value == pytest.approx(9.0 * np.log(1.0 + square / 9.0), rel=1e-9)
        step = 1e-4 * (1.0 + square)
        rise = rho(square + step, 1, 3.0)[0] - rho(square - step, 1, 3.0)[0]
        assert slope == pytest.approx(rise / (2.0 * step), rel=1e-6)
        assert rho(square, 0, 3.0) == (square, 1.0)


def test_compiled_kernels_equal_their_python():
    scene = perturbed(small_scene(num_frames=3, num_points=5).scene, OFF)
    problem = problem_of(scene)
    layout, error = problem.layout, problem.error
    state = State.from_scene(scene).kernel_state()
    fast = normal_equations.empty_normal_equations(layout)
    slow = normal_equations.empty_normal_equations(layout)
    work = Workspace(layout)
    normal_equations.linearize(work, state, error, 1, 3.0, fast)
    sums = assembly.new_sums(layout, np.unique(layout.cell_frame))
    chunk = chunks.new_chunk(layout, chunks.largest_chunk(layout))
    linearize_points = python_of(normal_equations._linearize_points)
    linearize_points(layout, state, 1, 3.0, 0, len(state.points), chunk, sums, slow)
    normal_equations.scatter(layout, [sums], slow)
    for a, b in zip(fast, slow, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(a).max())
    graph = build_graph(layout)
    results = []
    for invert, eliminate in (
        (schur.invert_points, schur.eliminate_rows),
        (python_of(schur.invert_points), python_of(schur.eliminate_rows)),
    ):
        system = schur.empty_system(layout, graph)
        system.border[:], system.right_border[:] = fast.border, 0.0
        sums = (system.inverses, system.border, system.right_border)
        invert(fast, 1e-4, 0, len(fast.points), *sums)
        rows = (0, graph.num_frames)
        eliminate(layout.point_start, graph, fast, 1e-4, *rows, system)
        results.append(system)
    for a, b in zip(*results, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10 * np.abs(a).max())
