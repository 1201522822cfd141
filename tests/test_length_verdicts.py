"""Lengths and positions that were given: where they go, and what is said of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made import numbers
from hand_made_result import bars, positions, result_of, small_model

from uwsfm.calibration.length_verdicts import (
    length_verdicts,
    scale_verdict,
    small_length,
    small_unit,
)
from uwsfm.calibration.lengths import Distances, Lengths, PositionFit, Positions
from uwsfm.errors import InputError


@pytest.fixture(scope="module")
def model():
    return small_model()


@pytest.fixture(scope="module")
def result(model):
    return result_of(model.scene)


# ---- Words --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stddev", "word"),
    [
        (None, "arbitrary"),
        (0.045, "determined"),
        (0.055, "weakly determined"),
        (0.45, "weakly determined"),
        (0.55, "not determined"),
        (math.nan, "not determined"),
        (math.inf, "not determined"),
    ],
)
def test_a_scale_is_determined_below_five_per_cent(stddev, word):
    assert scale_verdict(stddev) == word
    assert scale_verdict(0.05) == "weakly determined"
    assert scale_verdict(1.0) == "not determined"


def test_a_thousandth_of_an_arbitrary_length_is_no_millimetre():
    assert small_unit(None) == "1e-3, scale arbitrary"
    assert small_unit(0.45) == small_unit(0.01) == "mm"


@pytest.mark.parametrize("known", [0.01, 0.3])
def test_a_length_in_a_sentence_is_millimetres_or_of_no_unit(known):
    assert small_length(0.01234, known) == "12.3 mm"
    assert small_length(2.5, known) == "2500.0 mm"
    assert small_length(0.01234, None) == "0.012 (scale arbitrary)"
    assert small_length(2.56, None) == "2.6 (scale arbitrary)"


def scaled(result, own, in_all, **more):
    covariance = result.covariance
    in_all = replace(covariance.in_all, scale_stddev=in_all)
    covariance = replace(covariance, scale_stddev=own, in_all=in_all)
    return replace(result, covariance=covariance, **more)


def test_an_open_or_weak_scale_is_a_sentence(result):
    assert length_verdicts(scaled(result, 0.01, 0.02)) == ()
    (weak,) = length_verdicts(scaled(result, 0.01, 0.123))
    assert "scale is weakly determined, with a standard deviation of 12 % that" in weak
    (arbitrary,) = length_verdicts(scaled(result, None, None))
    assert arbitrary.startswith("scale arbitrary: nothing determines it")


def test_one_camera_without_a_length_has_its_scale_from_refraction(result):
    scene = result.scene
    alone = replace(
        scene, cameras=scene.cameras[:1], cam_from_rig=scene.cam_from_rig[:1]
    )
    one = replace(result, scene=alone)
    (sentence,) = length_verdicts(scaled(one, 0.01, 0.02))
    assert sentence.startswith("the scale comes from refraction alone")
    assert (
        length_verdicts(scaled(one, 0.01, 0.02, lengths=replaced(bars(), [0, 0]))) == ()
    )
    assert "refraction" not in " ".join(length_verdicts(scaled(one, None, None)))


def replaced(fit, misses):
    """Known lengths that came out off by so many of their deviations."""
    return replace(fit, found_m=fit.given_m + np.array(misses) * fit.stddevs_m)


@pytest.mark.parametrize(("miss", "told"), [(3.6, False), (4.4, True), (-4.4, True)])
def test_a_length_that_is_off_by_four_deviations_contradicts(result, miss, told):
    sentences = length_verdicts(replace(result, lengths=replaced(bars(), [0.0, miss])))
    assert len(sentences) == told
    if told:
        (sentence,) = sentences
        found = 2.314 + miss * 0.001
        assert sentence.startswith(
            f"known length 2 came out as {found:.4g} m, given as 2.314 ± 0.001 m: it"
        )


def placed_fit(count, wrong, **more):
    """So many positions, the first of them left out."""
    inliers = np.arange(count) >= wrong
    return replace(
        positions(),
        frame_idx=np.arange(count),
        misses_m=np.tile([0.03, 0.04, 0.0], (count, 1)),
        inliers=inliers,
        scatter=more.pop("scatter", 1.0),
        **more,
    )


def sentences_of(result, fit):
    return length_verdicts(replace(result, positions=fit))


def test_positions_that_were_left_out_are_counted(result):
    assert sentences_of(result, placed_fit(20, 0)) == ()
    (few,) = sentences_of(result, placed_fit(20, 7))
    assert few == "7 of 20 positions contradict the images and were left out"
    # More than two in five, there is something wrong with all of them.
    (many,) = sentences_of(result, placed_fit(20, 9))
    assert "9 of 20 positions" in many and "out: check the lever arm and its" in many
    assert sentences_of(result, placed_fit(20, 8)) == (few.replace("7", "8"),)
    (mirrored,) = sentences_of(result, placed_fit(9, 1))
    assert "; with so few, mirrored axes" in mirrored and "check the lever" in mirrored
    (enough,) = sentences_of(result, placed_fit(10, 1))
    assert "mirrored" not in enough


def test_positions_that_scatter_twice_as_much_are_told_with_what_they_miss_by(result):
    """3 and 4 cm: 50 mm; the one that was left out by metres does not count."""
    fit = placed_fit(20, 1, scatter=2.2)
    misses = fit.misses_m.copy()
    misses[0] = 99.0
    _, sentence = sentences_of(result, replace(fit, misses_m=misses))
    assert "the positions miss the model by 0.05 m, 2.2 times their" in sentence
    assert sentences_of(result, placed_fit(20, 0, scatter=1.8)) == ()


@pytest.mark.parametrize(
    ("degrees", "word"),
    [
        (1.8, None),
        (2.2, "weakly determined"),
        (18.0, "weakly determined"),
        (22.0, "not determined"),
    ],
)
def test_a_turn_of_the_model_is_told_with_its_axis(result, degrees, word):
    axis = np.array([0.0, 0.6, 0.8])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = math.radians(degrees) ** 2 * np.outer(axis, axis)
    covariance[3:, 3:] = 9.0 * np.eye(3)
    fit = placed_fit(20, 0, covariance=covariance)
    turn, found = fit.turn
    assert turn == pytest.approx(math.radians(degrees))
    assert abs(found @ axis) == pytest.approx(1.0)
    sentences = sentences_of(result, fit)
    assert len(sentences) == (word is not None)
    if word:
        (sentence,) = sentences
        assert f"is {word} (standard deviation {degrees:.0f} deg)" in sentence
        x, y, z = numbers(sentence)[:3]
        assert (x, abs(y), abs(z)) == (0.0, 0.6, 0.8) and y * z > 0.0


DEPTHS = np.array([False, False, True])


def test_depths_say_nothing_of_the_heading_and_are_told_of_by_their_own_signs(result):
    """A heading that is open is no news; the tilt is told with its axis."""
    covariance = np.zeros((6, 6))
    covariance[2, 2] = math.radians(50.0) ** 2
    covariance[:2, :2] = math.radians(1.8) ** 2 * np.diag([1.0, 0.25])
    fit = placed_fit(20, 0, covariance=covariance, measured=DEPTHS)
    turn, axis = fit.turn
    assert turn == pytest.approx(math.radians(1.8))
    np.testing.assert_allclose(np.abs(axis), [1.0, 0.0, 0.0], atol=1e-12)
    (level,) = sentences_of(result, fit)
    assert level.startswith("depths level the model and give its height; its heading")
    steep = replace(fit, covariance=1.21 / 0.81 * covariance)
    _, turned = sentences_of(result, steep)
    assert "is weakly determined (standard deviation 2 deg)" in turned
    x, y, z = numbers(turned)[:3]
    assert (abs(x), y, z) == (1.0, 0.0, 0.0)
    # With all three of them it is the heading that is open.
    _, axis = replace(fit, measured=np.ones(3, dtype=bool)).turn
    np.testing.assert_allclose(np.abs(axis), [0.0, 0.0, 1.0], atol=1e-12)


def test_few_depths_are_mirrored_by_no_axes(result):
    signs = "check the lever arm and its signs, the unit (metres) and the sign of the"
    _, few = sentences_of(result, placed_fit(9, 1, measured=DEPTHS))
    assert few == "1 of 9 positions contradict the images and were left out"
    _, many = sentences_of(result, placed_fit(9, 4, measured=DEPTHS))
    assert many.startswith("4 of 9 positions contradict the images and were left out: ")
    assert signs in many and "axes" not in many
    _, scattered = sentences_of(result, placed_fit(20, 0, scatter=2.2, measured=DEPTHS))
    assert signs in scattered and "axes" not in scattered


# ---- Arrays -------------------------------------------------------------------------


def test_distances_are_checked():
    found = Distances.from_arrays([[0, 3], [2, 1]], [0.5, 0.7], [0.01, 0.02])
    assert found.ends.tolist() == [[0, 3], [2, 1]]
    assert found.lengths_m.tolist() == [0.5, 0.7]
    assert found.stddevs_m.tolist() == [0.01, 0.02]
    for ends, lengths, stddevs, words in (
        ([0, 1], [0.5], [0.1], r"ends must be integers \(M, 2\)"),
        ([[0, 1, 2]], [0.5], [0.1], r"ends must be integers \(M, 2\)"),
        ([[0.0, 1.0]], [0.5], [0.1], r"ends must be integers \(M, 2\)"),
        ([[0, 1]], [0.5, 0.6], [0.1], "lengths_m must have one entry"),
        ([[0, 1]], [0.5], [0.1, 0.2], "stddevs_m must have one entry"),
        ([[0, 1], [1, 2]], [0.5, 0.0], [0.1, 0.1], r"lengths_m\[1\] must be positive"),
        ([[0, 1], [1, 2]], [0.5, 1.0], [-1.0, 0.1], r"stddevs_m\[0\] must be positive"),
        ([[0, 1]], [math.inf], [0.1], r"lengths_m\[0\] must be positive and finite"),
        ([[0, 1], [2, 2]], [0.5, 1.0], [0.1, 0.1], r"ends\[1\] are one and the same"),
    ):
        with pytest.raises(InputError, match=words):
            Distances.from_arrays(ends, lengths, stddevs)


def test_positions_are_checked():
    places = [[0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    found = Positions.from_arrays([4, 2], places, [0.1, 0.2, 0.3], [1, 2, 3], "nav.csv")
    assert found.frame_idx.tolist() == [4, 2] and found.positions.tolist() == places
    # One deviation for all: x, y and z as they were given.
    for block in found.covariances:
        np.testing.assert_allclose(block, np.diag([0.01, 0.04, 0.09]))
    assert found.lever_arm.tolist() == [1.0, 2.0, 3.0] and found.source == "nav.csv"
    rows = Positions.from_arrays([4, 2], places, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    np.testing.assert_allclose(rows.covariances[1], np.diag([0.16, 0.25, 0.36]))
    full = np.array([[2.0, 0.5, 0.0], [0.5, 3.0, 0.0], [0.0, 0.0, 4.0]])
    both = Positions.from_arrays([4, 2], places, np.stack([full, 2 * full]))
    np.testing.assert_array_equal(both.covariances[1], 2 * full)
    assert rows.lever_arm.tolist() == [0.0, 0.0, 0.0]
    skewed, flat = full.copy(), full.copy()
    skewed[0, 1], flat[2, 2] = 0.6, 0.0
    for frames, where, spread, arm, words in (
        ([[4, 2]], places, 0.1, (0, 0, 0), "frame_idx must be integers"),
        ([4.0, 2.0], places, 0.1, (0, 0, 0), "frame_idx must be integers"),
        ([4], places, 0.1, (0, 0, 0), r"expected \(1, 3\)"),
        ([4, 2], places, np.ones((1, 3, 3)), (0, 0, 0), r"expected \(M, 3, 3\)"),
        ([4, 2], places, 0.1, (0, 0), "lever_arm must be three numbers"),
        ([4, 2], places, 0.1, (0, 0, math.nan), "lever_arm must be three numbers"),
        (
            [4, 2],
            [places[0], [0, math.nan, 0]],
            0.1,
            (0, 0, 0),
            r"positions\[1\] is not",
        ),
        (
            [4, 2],
            places,
            np.stack([full, skewed]),
            (0, 0, 0),
            r"covariances\[1\] is not",
        ),
        ([4, 2], places, np.stack([flat, full]), (0, 0, 0), r"covariances\[0\] is not"),
    ):
        with pytest.raises(InputError, match=words):
            Positions.from_arrays(frames, where, spread, arm)


def test_what_is_not_said_of_positions_is_that_all_three_were_measured():
    arrays = {
        "frame_idx": np.arange(3),
        "positions": np.zeros((3, 3)),
        "covariances": np.tile(np.eye(3), (3, 1, 1)),
        "lever_arm": np.zeros(3),
    }
    found = Positions(**arrays)
    assert found.measured.tolist() == [True, True, True]
    assert found.measured.dtype == bool and found.source == "positions"
    made = Positions.from_arrays(np.arange(3), np.zeros((3, 3)), [1.0, 1.0, 1.0])
    assert made.measured.tolist() == [True, True, True] and made.source == "positions"
    depths = Positions.from_arrays(
        np.arange(3), np.zeros((3, 3)), np.ones(3), measured=[0, 0, 1]
    )
    assert depths.measured.tolist() == [False, False, True]
    assert depths.measured.dtype == bool
    fit = PositionFit(
        frame_idx=np.arange(3),
        misses_m=np.zeros((3, 3)),
        inliers=np.ones(3, dtype=bool),
        scatter=1.0,
        covariance=np.eye(6),
    )
    assert fit.measured.tolist() == [True, True, True]
    assert replace(fit, measured=DEPTHS).in_frames(np.array([1])).measured is DEPTHS
    assert Lengths().clicked.size == 0 and Lengths().clicked.dtype == np.int64


def known():
    return Lengths(
        between_points=Distances.from_arrays(
            [[10, 14], [12, 10]], [0.5, 0.7], [0.1, 0.2]
        ),
        between_frames=Distances.from_arrays([[0, 4], [4, 6]], [1.5, 1.7], [0.3, 0.4]),
        positions=Positions.from_arrays(
            [6, 2, 0], np.arange(9.0).reshape(3, 3), [0.1, 0.2, 0.3]
        ),
        clicked=np.array([20, 22, 25]),
    )


def test_lengths_of_a_part_are_numbered_as_it_is():
    """Points 10, 12, 14 are its first, third and last; observations 21 and 24 go."""
    keep = np.ones(26, dtype=bool)
    keep[[3, 21, 24]] = False
    found = known().in_part(keep, np.array([10, 11, 12, 14]))
    assert found.between_points.ends.tolist() == [[0, 3], [2, 0]]
    assert found.clicked.tolist() == [19, 20, 22]
    assert found.between_frames is not None and found.positions is not None
    with pytest.raises(InputError, match="scale bar 2: an end is not seen well enough"):
        known().in_part(keep, np.array([10, 14]))
    nothing = Lengths().in_part(keep, np.array([1]))
    assert nothing.between_points is None and nothing.clicked.size == 0


def test_lengths_of_some_frames_are_those_that_speak_of_them():
    found = known().in_frames(np.array([0, 2, 4]))
    assert found.between_frames.ends.tolist() == [[0, 2]]
    assert found.between_frames.lengths_m.tolist() == [1.5]
    assert found.between_frames.stddevs_m.tolist() == [0.3]
    assert found.positions.frame_idx.tolist() == [1, 0]
    assert found.positions.positions.tolist() == [[3.0, 4.0, 5.0], [6.0, 7.0, 8.0]]
    assert len(found.positions.covariances) == 2
    assert found.between_points is not None
    assert Lengths().in_frames(np.array([0])).positions is None


def test_indices_out_of_range_are_named(model):
    scene = model.scene
    ends = [[0, scene.num_points - 1]]
    fine = Lengths(between_points=Distances.from_arrays(ends, [1.0], [0.1]))
    assert fine.checked(scene) is fine
    count = scene.num_points
    places = np.zeros((1, 3))
    for lengths, words in (
        (
            Lengths(between_points=Distances.from_arrays([[0, count]], [1.0], [0.1])),
            f"between_points.ends is out of range: there are {count}",
        ),
        (
            Lengths(between_points=Distances.from_arrays([[-1, 0]], [1.0], [0.1])),
            "between_points.ends is out of range",
        ),
        (
            Lengths(between_frames=Distances.from_arrays([[0, 3]], [1.0], [0.1])),
            "between_frames.ends is out of range: there are 3",
        ),
        (
            Lengths(positions=Positions.from_arrays([3], places, 0.1)),
            "positions.frame_idx is out of range: there are 3",
        ),
        (
            Lengths(clicked=np.array([scene.num_observations])),
            f"clicked is out of range: there are {scene.num_observations}",
        ),
    ):
        with pytest.raises(InputError, match=words):
            lengths.checked(scene)


def test_lengths_give_the_scale_and_clicks_alone_do_not():
    one = known()
    for name in ("between_points", "between_frames", "positions"):
        assert Lengths(**{name: getattr(one, name)}).give_scale
    assert not Lengths(clicked=np.array([1])).give_scale


def test_a_fit_of_some_frames_is_numbered_as_they_are():
    found = positions().in_frames(np.array([1, 3]))
    assert found.frame_idx.tolist() == [0, 1]
    assert found.misses_m.tolist() == [[0.0, 0.04, 0.0], [0.0, 0.0, 0.12]]
    assert found.inliers.tolist() == [True, True] and found.num_outliers == 0
    assert positions().num_outliers == 1
