"""Words and decisions just below and just above each limit: 0.9 and 1.1 of it."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dense import small_scene
from hand_made_result import camera_covariance

from uwsfm import calibrate
from uwsfm.calibration.observability import (
    Geometry,
    center_verdict,
    distance_verdict,
    normal_verdict,
)
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.sfm.from_colmap.colmap_model import ImageModel
from uwsfm.sfm.from_colmap.model_rig import _Pairs, _scale
from uwsfm.simulate.rigs import sample_rig

DOUBTFUL, WRONG = "doubtful", "does not fit"


# ---- Words of estimates -------------------------------------------------------------


@pytest.mark.parametrize(
    ("share", "word"),
    [
        (0.225, "determined"),
        (0.275, "weakly determined"),
        (0.9, "weakly determined"),
        (1.1, "not determined"),
    ],
)
def test_a_distance_is_determined_below_a_quarter_of_itself(share, word):
    for distance in (0.03, -0.03):
        known = camera_covariance(1.0, distance_stddev_m=0.03 * share)
        assert distance_verdict(distance, known, True) == word
        assert distance_verdict(distance, known, False) == "held"
    zero = replace(known, distance_at_zero=True)
    assert distance_verdict(0.03, zero, True) == "ran into zero"
    nothing = camera_covariance(1.0, distance_stddev_m=math.nan)
    assert distance_verdict(0.03, nothing, True) == "not determined"


@pytest.mark.parametrize(
    ("degrees", "word"),
    [
        (0.18, "determined"),
        (0.22, "weakly determined"),
        (0.9, "weakly determined"),
        (1.1, "not determined"),
    ],
)
def test_a_tilt_is_determined_below_a_fifth_of_a_degree(degrees, word):
    known = camera_covariance(1.0, normal_stddev_deg=degrees)
    assert normal_verdict(known, True) == word
    assert normal_verdict(known, False) == "held"


@pytest.mark.parametrize(
    ("share", "word"),
    [
        (0.018, "determined"),
        (0.022, "weakly determined"),
        (0.18, "weakly determined"),
        (0.22, "not determined"),
    ],
)
def test_a_dome_is_determined_below_a_fiftieth_of_its_radius(share, word):
    """The length of its deviations: 3, 4 and 12 of 13."""
    parts = tuple(0.05 * share * part / 13.0 for part in (3.0, 4.0, 12.0))
    known = camera_covariance(1.0, center_stddev_m=parts)
    assert center_verdict(0.05, known, True) == word
    assert center_verdict(0.05, known, False) == "held"


@pytest.mark.parametrize(
    ("frames", "relief", "spread", "reason", "advice"),
    [
        (4, 0.5, 0.5, "only 4 frames", "add frames"),
        (5, 0.033, 0.165, "these 5 frames", "add frames, turned"),
        (5, 0.033, 0.135, "a rig at constant altitude", "fly at two altitudes"),
        (5, 0.027, 0.165, "a flat sea floor", "add frames, or fly over relief"),
        (5, 0.027, 0.135, "a flat sea floor at constant altitude", "fly at two"),
    ],
)
def test_what_the_motion_lacks_is_named(frames, relief, spread, reason, advice):
    found = Geometry(num_frames=frames, relief=relief, range_spread=spread).reason()
    assert found[0] == reason and found[1].startswith(advice)


# ---- A model's rig ------------------------------------------------------------------


def pairs(turns, shifts, length=0.2):
    count = len(turns)
    average = rigid3.IDENTITY.copy()
    average[4] = length
    return _Pairs(
        camera=1,
        frames=np.arange(count),
        average=average,
        turn_deg=np.array(turns, dtype=float),
        shift=np.array(shifts, dtype=float),
    )


NONE = np.empty(0, dtype=np.int64)
MODEL = ImageModel(
    folder=Path("model"),
    frame_names=("a", "b", "c"),
    cam_from_world=np.tile(rigid3.IDENTITY, (2, 3, 1)),
    lens_models=frozenset({"PINHOLE"}),
    points=np.empty((0, 3)),
    colors=np.empty((0, 3), dtype=np.uint8),
    camera_idx=NONE,
    frame_idx=NONE,
    point_idx=NONE,
    keypoint_idx=NONE,
    xy=np.empty((0, 2)),
    own_error_px=np.empty(0),
    keypoints=(),
    warnings=(),
)
"""Three frames without a point."""


@pytest.mark.parametrize(
    ("turns", "shifts", "words"),
    [
        ((4.5, 4.5, 4.5), (0.0, 0.0, 0.0), None),
        ((5.5, 5.5, 5.5), (0.0, 0.0, 0.0), "by 5.5 degrees and 0% of the baseline"),
        ((0.0, 0.0, 0.0), (0.9, 0.9, 0.9), None),
        ((0.0, 0.0, 0.0), (1.1, 1.1, 1.1), "by 0.0 degrees and 110% of the baseline"),
        # The median counts: a frame that is wrong is no moving camera.
        ((0.0, 0.0, 50.0), (0.0, 0.0, 0.0), None),
        ((0.0, 6.0, 50.0), (0.0, 0.0, 0.2), "worst in c: 50.0 degrees, 20%"),
        ((50.0,), (9.0,), None),
    ],
)
def test_cameras_are_fixed_to_each_other_below_five_degrees(turns, shifts, words):
    found_pairs = pairs(turns, shifts)
    if words is None:
        found_pairs.require_rigid(MODEL, sample_rig())
    else:
        with pytest.raises(InputError, match=words):
            found_pairs.require_rigid(MODEL, sample_rig())


def test_a_frame_is_wrong_beyond_fifteen_degrees_or_one_and_a_half_baselines():
    far = pairs((13.5, 16.5, 0.0, 0.0), (0.0, 0.0, 1.35, 1.65)).far
    assert far.tolist() == [False, True, False, True]


@pytest.mark.parametrize(
    ("scale", "words"),
    [
        (1.045, ()),
        (1.055, ("multiplied by 1.055", "if the model was in metres")),
        (0.955, ()),
        (0.945, ("multiplied by 0.945", "if the model was in metres")),
        (1.9, ("multiplied by 1.9", "if the model was in metres")),
        (2.1, ("multiplied by 2.1",)),
        (0.48, ("multiplied by 0.48",)),
    ],
)
def test_a_change_of_scale_is_told_from_five_per_cent_on(scale, words):
    rig = sample_rig()
    length = float(np.linalg.norm(rig.cam_from_rig[1, 4:]))
    factor, notes = _scale([pairs((0.0,), (0.0,), length / scale)], MODEL, rig)
    assert factor == pytest.approx(scale)
    assert len(notes) == bool(words)
    for word in ("multiplied by", "if the model was in metres"):
        expected = any(word in item for item in words)
        assert (word in "".join(notes)) == expected


# ---- Outliers -----------------------------------------------------------------------


def test_observations_beyond_four_deviations_are_left_out():
    """Five, of points that many images see, off by 2 or by 7 px of a noise of 1."""
    scene = small_scene(6, 60, noise_px=1.0).scene
    often = np.argsort(-np.bincount(scene.point_idx), kind="stable")[:5]
    rows = np.array([np.flatnonzero(scene.point_idx == point)[0] for point in often])
    truth = small_scene(6, 60, noise_px=0.0).scene
    for off, kept in ((2.0, True), (7.0, False)):
        xy = scene.xy.copy()
        xy[rows] = truth.xy[rows] + [off, 0.0]
        result = calibrate(replace(scene, xy=xy))
        assert result.summary.sigma_px == pytest.approx(1.0, rel=0.15)
        assert result.inliers[rows].all() == kept
        assert result.inliers[rows].any() == kept
