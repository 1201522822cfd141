"""Depths alone as positions: the model is level and at its height, no more."""

from dataclasses import replace

import numpy as np
import pytest

from uwsfm import InputError, Lengths, Positions, calibrate, verdicts
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import align_heights
from uwsfm.inputs.lengths_file import UNKNOWN_STDDEV_M, load_positions
from uwsfm.results.summary import outside_summary
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import paper_rig
from uwsfm.simulate.trajectories import rich_motion
from uwsfm.solver.terms import centers

STDDEV_M = 0.02
UP = np.array([0.0, 0.0, 1.0])


def depth_track(depths, stddev=STDDEV_M, rows=None):
    """Lengths of depths (F,), positive downwards, as the file gives them."""
    rows = np.arange(len(depths)) if rows is None else rows
    places = np.column_stack([np.zeros((len(rows), 2)), -np.asarray(depths)[rows]])
    spread = [UNKNOWN_STDDEV_M, UNKNOWN_STDDEV_M, stddev]
    known = Positions.from_arrays(
        rows, places, spread, measured=[False, False, True], source="depth.csv"
    )
    return Lengths(positions=known)


@pytest.mark.parametrize("outliers", [0, 2])
@pytest.mark.parametrize("with_scale", [False, True])
def test_heights_tell_tilt_height_and_scale(rng, outliers, with_scale):
    """20 places in a box, turned, and 2 heights of them off by three metres."""
    x = rng.uniform(-1.0, 1.0, (20, 3))
    turn = rigid3.quat_from_rotvec([0.9, -0.6, 0.4])
    scale = 2.5 if with_scale else 1.0
    true_up = rigid3.rotate(rigid3.inverse(np.array([*turn, 0, 0, 0])), UP)
    heights = scale * x @ true_up - 7.0
    heights[:outliers] += 3.0
    found = align_heights(x, heights, np.array([1.0, 1.0, 1.0]), with_scale=with_scale)
    good = slice(outliers, None)
    # Exact but for the weight that is left to the wrong ones.
    atol = 1e-9 if not outliers else 1e-3
    np.testing.assert_allclose(found.apply(x)[good, 2], heights[good], atol=atol)
    assert found.scale == pytest.approx(scale, abs=atol)
    np.testing.assert_allclose(found.apply(x).mean(axis=0)[:2], 0.0, atol=1e-9)


@pytest.mark.parametrize("up", [UP, -UP])
def test_places_in_a_plane_are_put_the_way_up_that_is_likelier(rng, up):
    """A plane tilted by 30 degrees: its heights fit from above and from below."""
    x = np.column_stack([rng.uniform(-1.0, 1.0, (12, 2)), np.zeros(12)])
    heights = np.sin(np.radians(30.0)) * x[:, 0]
    found = align_heights(x, heights, up, with_scale=False)
    np.testing.assert_allclose(found.apply(x)[:, 2], heights, atol=1e-6)
    upwards = rigid3.rotate(rigid3.inverse(found.y_from_x), UP)
    np.testing.assert_allclose(
        upwards, [0.5, 0.0, np.sign(up[2]) * np.sqrt(0.75)], atol=1e-5
    )


@pytest.fixture(scope="module")
def dive():
    options = ObservationOptions(num_points=300, noise_px=0.5, seed=0)
    return simulate_scene(paper_rig(), rich_motion(14), Relief(stddev=0.1), options)


NAV_FROM_WORLD = np.concatenate(
    [rigid3.quat_from_rotvec([0.4, 3.0, 0.3]), [120.0, -340.0, -9.0]]
)
"""The simulated world has z downwards, as its cameras look: this turns it over."""


def heights_of(truth):
    return rigid3.transform(NAV_FROM_WORLD, centers(truth.rig_from_world))[:, 2]


def test_depths_level_a_rig_and_their_misfit_is_theirs_alone(dive, rng):
    heights = heights_of(dive.truth)
    noise = STDDEV_M * rng.normal(size=len(heights))
    result = calibrate(dive.scene, lengths=depth_track(-(heights + noise)))
    fit = result.positions
    assert fit.inliers.all() and fit.scatter == 1.0
    reached = centers(result.scene.rig_from_world)[:, 2]
    # The mean height and the tilt are free: the noise that is left has 14 - 3 degrees.
    rms = float(np.sqrt(np.mean(fit.misses_m[:, 2] ** 2)))
    assert 0.4 * STDDEV_M < rms < 1.5 * STDDEV_M  # chi of 11: 0.886 +- 0.19, 3 sd
    np.testing.assert_array_equal(fit.misses_m[:, :2], 0.0)
    limit = 3.0 * np.sqrt(fit.covariance[5, 5])
    assert abs(np.mean(reached - heights)) < limit < STDDEV_M
    stddev, axis = fit.turn
    assert axis[2] == 0.0 and np.degrees(stddev) < 5.0
    # Up in the result against up of the truth, both seen from the first camera.
    up, true_up = (
        rigid3.rotate(pose, UP)
        for pose in (
            result.scene.rig_from_world[0],
            rigid3.compose(
                dive.truth.rig_from_world[0], rigid3.inverse(NAV_FROM_WORLD)
            ),
        )
    )
    assert np.arccos(up @ true_up) < 3.0 * stddev
    (told,) = (s for s in verdicts(result, ["left", "right"]) if "depths" in s)
    assert "its heading and its place in the horizontal are arbitrary" in told
    names = [f"{f}.jpg" for f in range(14)]
    summary = outside_summary(result, names)["positions"]
    assert summary["rms_miss_m"] == pytest.approx(rms)
    assert summary["place_stddev_m"][:2] == [None, None]
    assert summary["place_stddev_m"][2] == pytest.approx(np.sqrt(fit.covariance[5, 5]))


def test_wrong_depths_are_left_out_and_optimistic_ones_show(dive, rng):
    heights = heights_of(dive.truth)
    wrong = -(heights + STDDEV_M * rng.normal(size=len(heights)))
    wrong[[2, 9]] += 4.0
    fit = calibrate(dive.scene, lengths=depth_track(wrong)).positions
    np.testing.assert_array_equal(np.flatnonzero(~fit.inliers), [2, 9])
    noisy = -(heights + STDDEV_M * rng.normal(size=len(heights)))
    fit = calibrate(dive.scene, lengths=depth_track(noisy, STDDEV_M / 8.0)).positions
    # Eight times the stated deviation; 11 degrees of freedom know it to 21 %, 3 sd.
    assert 0.37 * 8.0 < fit.scatter < 1.63 * 8.0


def write_csv(path, header, rows):
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def test_a_file_of_depths_is_read_upwards(tmp_path):
    rows = ["1.jpg,7.5,0.02", "2.jpg,8.25,0.03", "3.jpg,7.0,0.02"]
    table = load_positions(write_csv(tmp_path / "d.csv", "frame,depth,sdepth", rows))
    assert table.depths_only
    np.testing.assert_array_equal(
        table.positions, [[0, 0, -7.5], [0, 0, -8.25], [0, 0, -7.0]]
    )
    np.testing.assert_array_equal(table.stddevs[:, 2], [0.02, 0.03, 0.02])


@pytest.mark.parametrize(
    ("header", "row", "words"),
    [
        ("frame,depth", "1.jpg,7.5", "or frame,depth,sdepth where only depths"),
        ("frame,depth,sdepth", "1.jpg,7.5", "2 columns instead of 3"),
        ("frame,depth,sdepth", "1.jpg,7.5,0", "sdepth: 0 m must be positive"),
        ("frame,depth,sdepth", "1.jpg,deep,1", "depth: 'deep' is not a number"),
    ],
)
def test_what_is_no_file_of_depths_is_named(tmp_path, header, row, words):
    with pytest.raises(InputError, match=words):
        load_positions(write_csv(tmp_path / "d.csv", header, [row] * 3))


def test_positions_with_all_coordinates_are_unchanged():
    known = Positions.from_arrays([0, 1, 2], np.eye(3), np.full(3, 0.1))
    assert known.measured.all()
    assert replace(known, positions=known.positions + 1.0).measured.all()
