"""The verdict just below and just above each of its limits: 0.9 and 1.1 of it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from uwsfm.sfm.noise_floor import NoiseFloor
from uwsfm.trust.freed import Freed
from uwsfm.trust.given import Departure
from uwsfm.trust.goodness import CameraFit, Goodness, Part, Used
from uwsfm.trust.verdict import verdict_on

DOUBTFUL, WRONG = "doubtful", "does not fit"


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
    freed_lenses=None,
    freed_placement=None,
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
def test_what_is_set_free_has_to_be_seen_by_all_points(p_value, evenness, told):
    free = freed(p_value=p_value, evenness=evenness)
    for field, code in (
        ("freed_lenses", "lenses_do_not_fit"),
        ("freed_placement", "placement_does_not_fit"),
    ):
        assert found(**{field: free}) == ({code: DOUBTFUL} if told else {})


def freed(px=0.2, **more):
    return Freed(
        **{
            "px": px,
            "p_value": 1e-6,
            "gain": 99.0,
            "num_freed": 8,
            "sigma_px": 0.4,
            "evenness": 5.0,
            **more,
        }
    )


def test_what_takes_more_of_the_residuals_is_named():
    lenses, placement = "lenses_do_not_fit", "placement_does_not_fit"
    for of_lenses, of_placement, code in ((0.2, 0.21, placement), (0.21, 0.2, lenses)):
        reasons = found(
            freed_lenses=freed(of_lenses), freed_placement=freed(of_placement)
        )
        assert reasons == {code: DOUBTFUL}


@pytest.mark.parametrize(
    ("sigma", "lens", "placement"),
    [
        # 1.15 times a floor of 0.5 px.
        (0.55, "the lenses, as given, do not fit", "cam_from_rig, as held, does not"),
        (0.60, "more than the lenses may be wrong", "more than the placement may be"),
    ],
)
def test_noise_that_is_left_has_another_cause(sigma, lens, placement):
    for field, words in (("freed_lenses", lens), ("freed_placement", placement)):
        goodness = replace(FINE, **{field: freed(sigma_px=sigma)})
        (reason,) = verdict_on(goodness).reasons
        assert words in reason.text and "0.2 px of the residuals vanish" in reason.text


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
