"""Posterior covariance: the inverse of the dense normal matrix, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse as sp
from dense import dense_system, small_scene
from scipy.sparse.linalg import splu

from uwsfm import CalibrateOptions, calibrate
from uwsfm.calibration.uncertainty import camera_variances, likelihood
from uwsfm.residuals.border import BORDER_SIZE, WATER_INDEX
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import lawn_mower
from uwsfm.solver.assembly import expand_cells
from uwsfm.solver.covariance import point_covariances, reduced_covariance
from uwsfm.solver.layout import HELD, build_layout
from uwsfm.solver.state import State


def linearized(scene, options):
    at_zero = np.zeros(len(scene.cameras), dtype=bool)
    layout = build_layout(scene, options.border_columns(scene.cameras, at_zero))
    return layout, likelihood(layout, State.from_scene(scene), None)


def repeat_observations(scene, rows, shift_px):
    """New points, each seen twice in the image of an observation and nowhere else."""
    again = np.repeat(rows, 2)
    shifts = shift_px * (np.arange(len(again)) % 2)
    new_idx = scene.num_points + np.repeat(np.arange(len(rows)), 2)
    return replace(
        scene,
        points=np.vstack([scene.points, scene.points[scene.point_idx[rows]]]),
        camera_idx=np.append(scene.camera_idx, scene.camera_idx[again]),
        frame_idx=np.append(scene.frame_idx, scene.frame_idx[again]),
        point_idx=np.append(scene.point_idx, new_idx),
        xy=np.vstack([scene.xy, scene.xy[again] + shifts[:, None]]),
    )


def test_every_marginal_is_that_of_the_dense_normal_matrix():
    scene = small_scene().truth
    layout, eqs = linearized(scene, CalibrateOptions(refine_water_index=True))
    reduced = reduced_covariance(layout, eqs)
    assert reduced.determined

    jac, _ = dense_system(scene, layout)
    norms = np.linalg.norm(jac, axis=0)
    dense = np.linalg.inv((jac / norms).T @ (jac / norms)) / np.outer(norms, norms)
    offset = layout.num_frame_cols
    size = offset + layout.num_border_cols

    def assert_close(found, expected):
        # The scaled normal matrix has condition 1e7 here: 1e-16 of it twice.
        spread = np.sqrt(np.diag(expected))
        error = np.abs(found - expected) / np.outer(spread, spread)
        assert error.max() < 1e-7

    assert_close(reduced.border, dense[offset:size, offset:size])
    for frame, column in enumerate(layout.frame_col):
        block = reduced.frames[frame]
        if column == HELD:
            assert not block.any()
        else:
            inside = slice(column, column + 6)
            assert_close(block, dense[inside, inside])
    for p, block in enumerate(point_covariances(layout, eqs, reduced)):
        inside = slice(size + 3 * p, size + 3 * p + 3)
        assert_close(block, dense[inside, inside])


@pytest.mark.slow
def test_border_of_500_frames_is_that_of_the_sparse_normal_matrix():
    """A survey: the marginal over 2994 pose and 12000 point unknowns, two ways."""
    seen = ObservationOptions(num_points=4000, detection_rate=0.7)
    lines = lawn_mower(20, 25)
    truth = simulate_scene(paper_rig(), lines, Relief(stddev=0.2), seen).truth
    layout, eqs = linearized(truth, CalibrateOptions())
    reduced = reduced_covariance(layout, eqs)
    assert reduced.determined and layout.num_frame_cols == 6 * 499
    whole = sparse_normal_matrix(layout, eqs)
    scale = 1.0 / np.sqrt(whole.diagonal())
    scaled = (sp.diags_array(scale) @ whole @ sp.diags_array(scale)).tocsc()
    offset, size = layout.num_frame_cols, layout.num_border_cols
    right = np.zeros((whole.shape[0], size))
    right[offset : offset + size] = np.eye(size)
    inside = slice(offset, offset + size)
    expected = splu(scaled).solve(right)[inside] * np.outer(
        scale[inside], scale[inside]
    )
    spread = np.sqrt(np.diag(expected))
    error = np.abs(reduced.border - expected) / np.outer(spread, spread)
    # A survey bends: the scaled matrix has condition 1e9, 1e-16 of it twice.
    assert error.max() < 1e-5


def sparse_normal_matrix(layout, eqs):
    """J^T J of frames, border and points, from its blocks, as a sparse matrix."""
    offset, size = layout.num_frame_cols, layout.num_border_cols
    first = offset + size
    rows, cols, values = [], [], []

    def add(row, col, block):
        mesh = np.meshgrid(
            row + np.arange(block.shape[0]),
            col + np.arange(block.shape[1]),
            indexing="ij",
        )
        rows.append(mesh[0].ravel())
        cols.append(mesh[1].ravel())
        values.append(block.ravel())

    def add_both(row, col, block):
        add(row, col, block)
        add(col, row, block.T)

    add(offset, offset, eqs.border)
    for frame, col in enumerate(layout.frame_col):
        if col != HELD:
            add(col, col, eqs.frames[frame])
            add_both(col, offset, eqs.frames_border[frame])
    for point in range(len(eqs.points)):
        at = first + 3 * point
        add(at, at, eqs.points[point])
        add_both(at, offset, eqs.points_border[point])
        for cell in range(layout.point_start[point], layout.point_start[point + 1]):
            col = layout.frame_col[layout.cell_frame[cell]]
            if col != HELD:
                coupled = np.empty((1, 6, 3))
                expand_cells(eqs.cells, cell, cell + 1, coupled)
                add_both(col, at, coupled[0])
    shape = (first + 3 * len(eqs.points),) * 2
    triplets = (np.concatenate(rows), np.concatenate(cols))
    return sp.coo_array((np.concatenate(values), triplets), shape=shape).tocsc()


def test_free_scale_is_found_to_be_undetermined():
    """With glass of no thickness nothing but the baseline tells lengths apart."""
    truth = small_scene().truth
    cameras = tuple(
        camera.with_port(replace(camera.port, thickness=0.0))
        for camera in truth.cameras
    )
    scene = replace(truth, cameras=cameras)
    free_length = CalibrateOptions(baseline_stddev_m=1.0)  # no prior is added here
    for options, determined in ((free_length, False), (CalibrateOptions(), True)):
        layout, eqs = linearized(scene, options)
        reduced = reduced_covariance(layout, eqs)
        assert reduced.determined is determined
        assert np.isnan(reduced.border).all() != determined
        points = point_covariances(layout, eqs, reduced)
        assert np.isnan(points).all() != determined


def test_points_seen_twice_in_one_image_tell_nothing():
    """Their blocks are singular; held still, they would pass for landmarks."""
    clean = perturbed(small_scene(6, 60, noise_px=0.3).scene)
    expected = calibrate(clean, loss="l2")
    doubled = repeat_observations(clean, np.arange(0, 300, 30), shift_px=1e-6)
    found = calibrate(doubled, loss="l2")
    assert found.covariance.determined
    noise = found.summary.sigma_px / expected.summary.sigma_px
    # What is left of them is how loosely they are held, 1e-8 of their blocks.
    np.testing.assert_allclose(
        np.sqrt(np.diag(found.covariance.border)) / noise,
        np.sqrt(np.diag(expected.covariance.border)),
        rtol=1e-4,
    )
    assert np.isnan(found.covariance.points[clean.num_points :]).all()
    assert np.isfinite(found.covariance.points[: clean.num_points]).all()


def test_stddevs_of_a_camera_are_read_from_the_right_columns():
    truth = small_scene(noise_px=0.2).scene
    options = {"refine_normals": (True, False), "refine_distances": (False, True)}
    result = calibrate(truth, loss="l2", **options)
    covariance = result.covariance
    # Normal of the left; then rotation, direction and port distance of the right.
    nothing = [HELD] * (BORDER_SIZE - WATER_INDEX)
    expected = [HELD] * 6 + [0, 1, HELD, *nothing]
    assert covariance.border_cols[0].tolist() == expected
    expected = [2, 3, 4, 5, 6, HELD, HELD, HELD, 7, *nothing]
    assert covariance.border_cols[1].tolist() == expected
    variance = np.diag(covariance.border)
    left, right = (
        camera_variances(covariance.border, cols, pose)
        for cols, pose in zip(
            covariance.border_cols, result.scene.cam_from_rig, strict=True
        )
    )
    normal, distance, rotation = 0, 1, 2
    assert left[normal] == pytest.approx(variance[0] + variance[1])
    assert left[distance] == right[normal] == 0.0
    assert right[distance] == pytest.approx(variance[7])
    assert right[rotation] == pytest.approx(variance[2:5].sum())
    # The length is held: the translation varies on a sphere, across itself.
    assert right[3:].sum() == pytest.approx(0.2**2 * variance[5:7].sum())
    # What is reported is never less than what independent noise does.
    reported = covariance.cameras[1]
    assert reported.distance_stddev_m >= np.sqrt(variance[7])
    assert covariance.cameras[0].distance_stddev_m == 0.0
