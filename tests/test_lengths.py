"""Lengths from outside: scale bars, distances between frames, positions."""

from dataclasses import replace

import numpy as np
import pytest
from dense import dense_system, small_scene
from jacobians import central_differences, check_jacobian

from uwsfm import CalibrateOptions
from uwsfm.geometry import rigid3
from uwsfm.simulate import Perturbation, perturbed
from uwsfm.solver import levenberg_marquardt as lm
from uwsfm.solver.covariance import point_covariances, reduced_covariance
from uwsfm.solver.error_models import error_model
from uwsfm.solver.layout import build_layout
from uwsfm.solver.state import State
from uwsfm.solver.terms import LengthTerm, PositionTerm, centers

NONE_AT_ZERO = np.zeros(2, dtype=bool)
OFF = Perturbation(
    rotation_stddev_deg=0.3,
    translation_stddev=0.005,
    cam_rotation_stddev_deg=0.2,
    point_stddev=0.01,
)


def nav_pose(rng):
    return rigid3.perturb(rigid3.IDENTITY, [*rng.normal(size=3), *rng.normal(size=3)])


def all_terms(state, rng, loss_scale=None):
    """Two bars, a distance between frames, and positions, none of which fits."""
    roots = np.linalg.cholesky(np.eye(3) + 0.2 * np.ones((3, 3)))
    return (
        LengthTerm(
            ends=np.array([[0, 7], [3, 7]]),
            lengths=np.array([0.5, 0.8]),
            variances=np.array([1e-4, 3e-4]),
            of_frames=False,
        ),
        LengthTerm(
            ends=np.array([[0, 3]]),
            lengths=np.array([0.7]),
            variances=np.array([1e-3]),
            of_frames=True,
            first=2,
        ),
        PositionTerm(
            frames=np.array([0, 1, 2, 3, 3]),
            positions=rng.normal(size=(5, 3)),
            roots=np.stack([roots.T * scale for scale in (1.0, 0.5, 0.7, 0.9, 2.0)]),
            lever_arm=np.array([0.1, -0.3, 0.2]),
            sigma_px=0.4,
            loss_scale=loss_scale,
            start=state.nav_from_world,
        ),
    )


def problem_with(scene, rng, loss_scale=None):
    options = CalibrateOptions(baseline_stddev_m=0.002)
    layout = build_layout(
        scene,
        options.border_columns(scene.cameras, NONE_AT_ZERO),
        navigation=True,
        num_lengths=3,
    )
    state = replace(State.from_scene(scene), nav_from_world=nav_pose(rng))
    terms = all_terms(state, rng, loss_scale)
    weights = np.zeros(layout.border_col.shape)
    priors = lm.Priors(reference=state, weights=weights, terms=terms)
    error = error_model("reprojection", layout, state)
    problem = lm.Problem(layout, error, lm.LevenbergMarquardtOptions(), priors)
    return problem, state, terms


def moved(problem, state, delta):
    """A state after a step of frames, border, navigation, points; no forces."""
    size = problem.layout.num_unknowns
    step = np.concatenate([delta[:size], np.zeros(problem.layout.num_lengths)])
    return state.moved(problem.layout, step, delta[size:].reshape(-1, 3))


def term_rows(problem, state, terms):
    """Jacobian and residuals of the terms, in px, by differences of their residuals.

    The same residuals through the manifold: nothing of the blocks' closed forms.
    """
    bars, frames, positions = terms

    def residuals(state):
        parts = [
            (term.distances(state) - term.lengths) / np.sqrt(term.variances)
            for term in (bars, frames)
        ]
        miss = positions.predicted(state) - positions.positions
        parts.append(np.einsum("mij,mj->mi", positions.roots, miss).ravel())
        turn = rigid3.compose(state.nav_from_world, rigid3.inverse(positions.start))
        parts.append(positions.sigma_px * rigid3.rotvec_from_quat(turn[:4]))
        return np.concatenate(parts)

    size = problem.layout.num_unknowns + state.points.size
    jac = central_differences(
        lambda delta: residuals(moved(problem, state, delta)), size, 1e-3
    )
    return jac, residuals(state)


def test_positions_have_the_jacobian_of_the_manifold(rng):
    problem, state, terms = problem_with(small_scene().scene, rng)
    positions = terms[2]
    rows = positions.linearized(state)
    for m, frame in enumerate(positions.frames):

        def miss(changed, m=m):
            return positions.linearized(changed).miss[m]

        def plus_frame(state, delta, frame=frame):
            poses = state.rig_from_world.copy()
            poses[frame] = rigid3.perturb(poses[frame], delta)
            return replace(state, rig_from_world=poses)

        def plus_nav(state, delta):
            nav = rigid3.perturb(state.nav_from_world, delta)
            return replace(state, nav_from_world=nav)

        check_jacobian(miss, plus_frame, state, rows.by_frame[m], step=1e-3)
        check_jacobian(miss, plus_nav, state, rows.by_navigation[m], step=1e-3)


@pytest.mark.parametrize("damping", [1e-6, 1.0])
def test_step_with_terms_is_the_dense_step(rng, damping):
    scene = perturbed(small_scene(noise_px=0.5).scene, OFF)
    problem, state, terms = problem_with(scene, rng)
    layout = problem.layout
    eqs = problem.linearize(state)
    step, points_step = problem.step(eqs, damping)

    image, miss = dense_system(scene, layout._replace(num_nav_cols=0, num_lengths=0))
    size = layout.num_frame_cols + layout.num_camera_cols
    image = np.insert(image, [size] * 6, 0.0, axis=1)
    rows, term_miss = term_rows(problem, state, terms)
    jac, residuals = np.vstack([image, rows]), np.append(miss, term_miss)
    assert problem.cost(state)[0] == pytest.approx(0.5 * residuals @ residuals)
    normal, gradient = jac.T @ jac, jac.T @ residuals
    # Damping follows the images and the positions, not the lengths.
    kept = np.vstack([image, rows[3:]])
    diagonal = np.maximum(np.sum(kept**2, axis=0), 1e-6)
    damped = normal + np.diag(damping * diagonal)
    scale = 1.0 / np.sqrt(np.diag(damped))
    expected = -scale * np.linalg.solve(
        damped * np.outer(scale, scale), scale * gradient
    )
    found = np.concatenate([step[: layout.num_unknowns], points_step.ravel()])
    # The rows are differences, good to 1e-8; the condition of the scaled system is
    # 1e4 at the smaller damping.
    error = np.linalg.norm((found - expected) / scale)
    assert error < 1e-5 * np.linalg.norm(expected / scale)
    model = residuals + jac @ found
    gain = 0.5 * (residuals @ residuals - model @ model)
    decrease = problem.predicted_decrease(eqs, damping, step, points_step)
    assert decrease == pytest.approx(gain, rel=1e-6)


def test_covariance_with_terms_is_that_of_the_dense_matrix(rng):
    scene = small_scene().truth
    problem, state, terms = problem_with(scene, rng)
    layout = problem.layout
    eqs = problem.linearize(state)
    reduced = reduced_covariance(layout, eqs)
    image, _ = dense_system(scene, layout._replace(num_nav_cols=0, num_lengths=0))
    cameras = layout.num_frame_cols + layout.num_camera_cols
    image = np.insert(image, [cameras] * 6, 0.0, axis=1)
    jac = np.vstack([image, term_rows(problem, state, terms)[0]])
    norms = np.linalg.norm(jac, axis=0)
    dense = np.linalg.inv((jac / norms).T @ (jac / norms)) / np.outer(norms, norms)
    size = layout.num_unknowns

    def assert_close(found, inside):
        expected = dense[inside, inside]
        spread = np.sqrt(np.diag(expected))
        # Rows by differences (1e-9), times the condition of the scaled matrix.
        assert np.abs((found - expected) / np.outer(spread, spread)).max() < 1e-5

    assert_close(reduced.border, slice(layout.num_frame_cols, cameras))
    assert_close(reduced.navigation, slice(cameras, size))
    for p, block in enumerate(point_covariances(layout, eqs, reduced)):
        assert_close(block, slice(size + 3 * p, size + 3 * p + 3))


def test_outlying_positions_pull_less(rng):
    """The gradient of the robust cost, by differences through the manifold."""
    scene = small_scene().truth
    problem, state, terms = problem_with(scene, rng, loss_scale=0.7)
    positions = terms[2]
    eqs = problem.linearize(state)
    layout = problem.layout

    def nav_cost(delta):
        step = np.zeros(layout.num_unknowns + 3 * scene.num_points)
        step[layout.num_unknowns - 6 : layout.num_unknowns] = delta
        return np.array([positions.cost(moved(problem, state, step))])

    found = eqs.border_grad[layout.num_camera_cols :][:6]
    numeric = central_differences(nav_cost, 6, 1e-3)[0]
    np.testing.assert_allclose(found, numeric, rtol=1e-7, atol=1e-9)
    assert centers(state.rig_from_world).shape == (4, 3)
