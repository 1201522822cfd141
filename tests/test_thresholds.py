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
from uwsfm.sfm.colmap_model import ImageModel
from uwsfm.sfm.model_rig import _Pairs, _scale
from uwsfm.sfm.noise_floor import NoiseFloor
from uwsfm.simulate.rigs import sample_rig
from uwsfm.trust.free_lens import FreeLens
from uwsfm.trust.given import Departure
from uwsfm.trust.goodness import CameraFit, Goodness, Part, Used
from uwsfm.trust.verdict import verdict_on

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


# ---- The verdict --------------------------------------------------------------------


def part(by="place", px=0.001, p_value=0.5):
    return Part(by=by, px=px, p_value=p_value)


def floor(ratio):
    """Pairs of images that leave 0.5 px, and a model that leaves so many times that."""
    return NoiseFloor(
        floor_px=0.5,
        model_px=0.5 * ratio,
        regions=np.full((3, 3, 2), np.nan),
        num_pairs=7,
        num_matches=800,
    )


FINE = Goodness(
    rms_px=0.6,
    sigma_px=0.4,
    floor=floor(1.0),
    parts=(part(),),
    cameras=(),
    used=Used(num_frames=100, num_registered=100, num_tested=1000, num_kept=900),
    converged=True,
    departures=(),
    free_lens=None,
    below_zero_z=None,
    known_length_z=None,
    positions_scatter=None,
    positions_left_out=None,
)


def found(**changes):
    """Codes of the reasons with their severity."""
    verdict = verdict_on(replace(FINE, **changes))
    reasons = {reason.code: reason.severity for reason in verdict.reasons}
    word = WRONG if WRONG in reasons.values() else DOUBTFUL if reasons else "fits"
    assert verdict.verdict == word
    return reasons


def test_what_is_fine_fits_and_what_stopped_does_not():
    assert found() == {}
    assert found(converged=False) == {"not_converged": DOUBTFUL}


@pytest.mark.parametrize(
    ("ratio", "severity"),
    [(1.13, None), (1.17, DOUBTFUL), (1.8, DOUBTFUL), (2.2, WRONG)],
)
def test_a_model_is_above_its_noise_floor(ratio, severity):
    assert found(floor=floor(ratio)).get("above_noise_floor") == severity
    text = verdict_on(replace(FINE, floor=floor(2.2))).reasons[0].text
    assert "leaves 1.1 px RMS" in text and "800 matches" in text
    assert "2.2 times the 0.5 px" in text


@pytest.mark.parametrize(
    ("px", "p_value", "sigma", "severity"),
    [
        # Chance of one in a thousand.
        (0.2, 0.9e-3, 0.4, DOUBTFUL),
        (0.2, 1.1e-3, 0.4, None),
        # At least 0.03 px, and 15 % of the noise.
        (0.027, 1e-6, 0.1, None),
        (0.033, 1e-6, 0.1, DOUBTFUL),
        (0.054, 1e-6, 0.4, None),
        (0.066, 1e-6, 0.4, DOUBTFUL),
        # Large from 0.3 px and half of the noise on.
        (0.27, 1e-6, 0.4, DOUBTFUL),
        (0.33, 1e-6, 0.4, WRONG),
        (0.45, 1e-6, 1.0, DOUBTFUL),
        (0.55, 1e-6, 1.0, WRONG),
    ],
)
def test_a_systematic_part_has_a_size_and_a_chance(px, p_value, sigma, severity):
    for by in ("place", "depth", "row", "camera", "time", "image"):
        parts = (
            (part(), part(by, px, p_value))
            if by != "place"
            else (part(by, px, p_value),)
        )
        reasons = found(parts=parts, sigma_px=sigma)
        assert reasons == ({f"systematic_by_{by}": severity} if severity else {})


def test_what_is_seen_by_place_is_not_said_again_by_depth():
    parts = tuple(part(by, 0.2, 1e-6) for by in ("place", "depth", "row", "time"))
    assert list(found(parts=parts)) == ["systematic_by_place", "systematic_by_time"]


@pytest.mark.parametrize(
    ("freed", "told"), [(0.45 * 0.2, True), (0.55 * 0.2, False), (None, False)]
)
def test_it_is_the_lens_if_half_vanishes_with_it(freed, told):
    camera = CameraFit(
        name="left", rms_px=0.5, systematic_px=0.2, p_value=1e-6, freed_px=freed
    )
    parts = (part("depth", 0.2, 1e-6), part())
    reasons = found(cameras=(camera,), parts=parts)
    expected = "lens_does_not_fit" if told else "systematic_by_depth"
    assert reasons == {expected: DOUBTFUL}


@pytest.mark.parametrize(
    ("p_value", "evenness", "told"),
    [
        (0.9e-5, 5.0, True),
        (1.1e-5, 5.0, False),
        (1e-6, 4.05, False),
        (1e-6, 4.95, True),
    ],
)
def test_free_lenses_have_to_be_seen_by_all_points(p_value, evenness, told):
    free = FreeLens(
        px=0.2, p_value=p_value, gain=99.0, num_freed=8, sigma_px=0.4, evenness=evenness
    )
    reasons = found(free_lens=free)
    assert reasons == ({"lenses_do_not_fit": DOUBTFUL} if told else {})
    for sigma, words in ((0.55, "the lenses, as given"), (0.6, "not the lenses alone")):
        if told:
            goodness = replace(FINE, free_lens=replace(free, sigma_px=sigma))
            assert words in verdict_on(goodness).reasons[0].text


@pytest.mark.parametrize(
    ("change", "code", "severity"),
    [
        ({"below_zero_z": 3.6}, "distance_at_zero", None),
        ({"below_zero_z": 4.4}, "distance_at_zero", DOUBTFUL),
        ({"known_length_z": 3.6}, "known_length", None),
        ({"known_length_z": 4.4}, "known_length", DOUBTFUL),
        ({"positions_scatter": 2.7, "positions_left_out": 0.36}, "positions", None),
        ({"positions_scatter": 3.3, "positions_left_out": 0.36}, "positions", DOUBTFUL),
        ({"positions_scatter": 2.7, "positions_left_out": 0.44}, "positions", DOUBTFUL),
        ({"used": Used(num_frames=100, num_registered=55)}, "few_frames", None),
        ({"used": Used(num_frames=100, num_registered=45)}, "few_frames", DOUBTFUL),
    ],
)
def test_a_reason_begins_at_its_limit(change, code, severity):
    assert found(**change) == ({code: severity} if severity else {})


@pytest.mark.parametrize(
    ("kept", "severity"), [(330, None), (270, DOUBTFUL), (165, DOUBTFUL), (135, WRONG)]
)
def test_few_observations_agree_below_thirty_per_cent(kept, severity):
    used = replace(FINE.used, num_kept=kept)
    assert found(used=used).get("few_observations") == severity
    assert found(used=replace(used, num_tested=None)) == {}


def test_too_little_data_is_not_called_a_fit():
    nothing = part(px=math.nan, p_value=math.nan)
    assert found(parts=(nothing, part("depth"))) == {"too_little_data": DOUBTFUL}
    assert found(parts=(nothing, part())) == {}


# ---- What has left what was given ---------------------------------------------------


def departed(what, given, estimate, stddev, given_stddev=math.nan, *, stated=False):
    item = Departure(
        camera="left",
        what=what,
        given=given,
        estimate=estimate,
        stddev=stddev,
        given_stddev=given_stddev,
        stated=stated,
    )
    return found(departures=(item,))


@pytest.mark.parametrize(
    ("what", "code", "given", "unit"),
    [
        ("distance_m", "port_distance", 0.02, 0.001),
        ("focal_share", "focal_length", 1.0, 0.01),
        ("principal_point_px", "principal_point", 0.0, 5.0),
    ],
)
def test_estimates_depart_at_four_deviations_and_far_at_ten(what, code, given, unit):
    """Of both together, 3 and 4 make 5; and of the given one alone beyond three of the
    estimate's."""
    for times, severity in ((3.6, None), (4.4, DOUBTFUL)):
        estimate = given + 5.0 * unit * times
        reasons = departed(what, given, estimate, 3.0 * unit, 4.0 * unit)
        assert reasons.get(code) == severity
    for times, severity in ((9.0, DOUBTFUL), (11.0, WRONG)):
        estimate = given + (times + 3.0 * 0.1) * unit
        assert departed(what, given, estimate, 0.1 * unit, unit).get(code) == severity


@pytest.mark.parametrize(
    ("at_least", "severity"),
    [(0.225, None), (0.275, DOUBTFUL), (0.45, DOUBTFUL), (0.55, WRONG)],
)
def test_no_port_is_a_quarter_of_a_metre_away(at_least, severity):
    """However little was known of it: 1 m."""
    reasons = departed("distance_m", 0.02, at_least + 3.0 * 0.001, 0.001, 1.0)
    assert reasons == ({"port_distance": severity} if severity else {})


@pytest.mark.parametrize(("times", "told"), [(2.7, False), (3.3, True)])
def test_all_ports_depart_together_at_three_deviations(times, told):
    reasons = departed("distances_share", 1.0, 1.0 + 0.5 * times, 0.3, 0.4)
    assert reasons == ({"port_distances": DOUBTFUL} if told else {})


@pytest.mark.parametrize(
    ("at_least", "severity"),
    [(13.5, None), (16.5, DOUBTFUL), (22.5, DOUBTFUL), (27.5, WRONG)],
)
def test_no_port_is_tilted_by_fifteen_degrees(at_least, severity):
    reasons = departed("tilt_deg", 0.0, at_least + 0.3, 0.1, 5.0)
    assert reasons == ({"port_tilt": severity} if severity else {})


@pytest.mark.parametrize(
    ("at_least", "severity"),
    [(0.45, None), (0.55, DOUBTFUL), (0.80, DOUBTFUL), (0.90, WRONG)],
)
def test_no_lens_is_half_a_radius_from_its_dome_s_centre(at_least, severity):
    reasons = departed("center_share", 0.0, at_least + 0.03, 0.01, 0.2)
    assert reasons == ({"dome_centre": severity} if severity else {})


@pytest.mark.parametrize(
    ("what", "code", "unit"),
    [("tilt_deg", "port_tilt", 0.1), ("center_share", "dome_centre", 0.01)],
)
def test_what_was_stated_is_contradicted_at_four_deviations(what, code, unit):
    for times, told in ((3.6, False), (4.4, True)):
        estimate = 5.0 * unit * times
        one = (what, 0.0, estimate, 3.0 * unit, 4.0 * unit)
        assert (code in departed(*one, stated=True)) == told
        assert departed(*one, stated=False) == {}


@pytest.mark.parametrize(
    ("estimate", "told"), [(0.45, True), (0.55, False), (1.4, False), (1.5, True)]
)
def test_no_lens_stretches_its_edge_so_much(estimate, told):
    reasons = departed("stretch", 1.0, estimate, 0.0)
    assert reasons == ({"distortion": WRONG} if told else {})
    assert departed("unseen_share", 0.1, 0.11, 0.0) == {"distortion_folds": WRONG}
    assert departed("unseen_share", 0.1, 0.09, 0.0) == {}


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
