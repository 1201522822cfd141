"""What is measured between places of a small dive, beside a calculator."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from measured import clicks_on, one, small_result

from uwsfm.calibration.propagation import Propagation
from uwsfm.errors import InputError
from uwsfm.measuring.measure import (
    measure,
)


@pytest.fixture(scope="module")
def result():
    return small_result()


def test_known_figures_are_measured(result):
    """A point, its neighbour, and what a calculator makes of three places."""
    points = result.model.scene.points
    a, b, c = points[[0, 4, 9]]
    first, second = a - b, c - b
    angle = math.degrees(
        math.acos(first @ second / np.linalg.norm(first) / np.linalg.norm(second))
    )
    expected = {
        "distances": ({"ends": [1, 5]}, np.linalg.norm(a - b)),
        "polylines": (
            {"through": [1, 5, 10]},
            np.linalg.norm(a - b) + np.linalg.norm(b - c),
        ),
        "areas": (
            {"corners": [1, 5, 10]},
            0.5 * np.linalg.norm(np.cross(a - b, c - b)),
        ),
        "angles": ({"at": 5, "between": [1, 10]}, angle),
    }
    for key, (task, value) in expected.items():
        assert one(result, **{key: [task]}).value == pytest.approx(value, rel=1e-9)


def test_a_report_holds_the_summary_and_is_never_written_over(result, tmp_path):
    path, content = tmp_path / "r.json", {"version": 1, "distances": [{"ends": [1, 5]}]}
    found = measure(result, content, path)
    assert json.loads(path.read_text()) == found.summary
    assert found.summary["measurements"][0]["value"] == found.measurements[0].value
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"r\.json"):
        measure(result, content, path)
    assert path.read_bytes() == before


def test_an_angle_and_its_deviations_are_degrees(result):
    """Beside the angle's derivative by its places, moved one at a time (radians)."""
    found = one(result, angles=[{"at": 5, "between": [1, 10]}])
    length = one(result, distances=[{"ends": [1, 5]}])
    # A place that is off by a thousandth of an arm turns it by a thousandth, so that
    # the angle's deviation is of the order of the length's over the arm.
    arm = length.value
    turn = math.radians(found.stddev)
    assert 0.1 * length.stddev / arm < turn < 10.0 * length.stddev / arm
    assert found.stddev_in_all >= found.stddev


def test_deviations_in_all_add_those_of_what_was_given(result):
    found = one(result, distances=[{"ends": [1, 5]}])
    assert found.stddev == max(found.stddev_alone, found.stddev_clustered)
    points = result.model.scene.points
    propagation = Propagation(result.calibration)
    places = propagation.of_points(np.array([0, 4]))
    along = (points[0] - points[4]) / np.linalg.norm(points[0] - points[4])
    slope = np.array([[along, -along]])
    alone = propagation.covariance(places, slope).item()
    given = propagation.given_covariance(places, slope).item()
    assert found.stddev_alone == pytest.approx(math.sqrt(alone), rel=1e-9)
    expected = math.hypot(found.stddev, math.sqrt(given))
    assert found.stddev_in_all == pytest.approx(expected, rel=1e-9)
    covariance = result.calibration.covariance.points
    # Of a place: the root of the sum over its axes.
    place = np.sqrt([np.trace(covariance[0]), np.trace(covariance[4])])
    np.testing.assert_allclose(found.places_stddev, place, rtol=1e-6)


def scaled(result, stddev):
    """The result, with a scale that is known so well."""
    covariance = replace(
        result.calibration.covariance, scale_stddev=stddev, in_all=None
    )
    return replace(
        result, calibration=replace(result.calibration, covariance=covariance)
    )


@pytest.mark.parametrize(
    ("stddev", "words"),
    [
        (0.045, None),
        (0.055, "the scale is weakly determined, 6 %, which all"),
        (0.45, "the scale is weakly determined, 45 %, which all"),
        (0.55, "nothing that is measured is determined"),
        (None, "lengths and areas are in an arbitrary unit"),
    ],
)
def test_a_note_says_how_well_the_scale_is_known(result, stddev, words):
    content = {
        "version": 1,
        "distances": [{"ends": [1, 5]}],
        "angles": [{"at": 5, "between": [1, 10]}],
    }
    found = measure(scaled(result, stddev), content)
    assert bool(found.warnings) == (words is not None)
    assert words is None or words in found.warnings[0]
    length, angle = found.measurements
    assert (length.value is None) == (stddev == 0.55)
    assert angle.value is not None  # a scale turns nothing
    if stddev == 0.55:
        assert length.notes[0] == "not determined by the images"
        assert length.stddev is length.stddev_alone is length.stddev_in_all is None
    assert found.unit == ("scale arbitrary" if stddev is None else "metre")
    assert found.summary["measurements"][0]["unit"] == (
        "unit" if stddev is None else "m"
    )


def test_the_words_of_a_doubtful_result_are_no_better(result):
    reasons = [{"text": "Residuals repeat.", "severity": "doubtful"}]
    doubtful = replace(result, summary={"verdict": "doubtful", "reasons": reasons})
    found = measure(doubtful, {"version": 1, "distances": [{"ends": [1, 5]}]})
    assert found.summary["measurements"][0]["verdict"] == "doubtful"
    assert found.warnings[0].endswith("far too small: Residuals repeat.")
    assert found.summary["model"] == "mark" and found.summary["unit"] == "metre"


def test_one_bar_gives_the_factor_that_brings_it_to_its_length(result):
    """known / measured, and the deviations of both over what was measured."""
    length = one(result, distances=[{"ends": [1, 5]}])
    known, own = 1.07 * length.value, 0.03
    bar = {"ends": [1, 5], "length_m": known, "stddev_m": own}
    found = measure(result, {"version": 1, "scale_bars": [bar]}).scale_bars
    assert found["num_bars"] == 1
    assert found["known_over_measured"] == pytest.approx(1.07)
    expected = math.hypot(length.stddev_in_all, own) / length.value
    assert found["stddev"] == pytest.approx(expected, rel=1e-6)
    assert found["ratio"] == pytest.approx(0.07 / expected, rel=1e-6)
    # Twice what two and four deviations are.
    for times, word in ((1.8, "agrees"), (2.2, "doubtful"), (4.4, "contradicts")):
        bar["length_m"] = length.value * (1.0 + times * expected)
        again = measure(result, {"version": 1, "scale_bars": [bar]}).scale_bars
        assert again["verdict"] == word


def test_several_bars_give_a_weighted_mean(result):
    """Bars so badly known that only their own deviations count."""
    ends, own = ([1, 5], [10, 16]), (10.0, 20.0)
    values = [one(result, distances=[{"ends": e}]).value for e in ends]
    known = [1.3 * values[0], 0.8 * values[1]]
    bars = [
        {"ends": e, "length_m": k, "stddev_m": s}
        for e, k, s in zip(ends, known, own, strict=True)
    ]
    found = measure(result, {"version": 1, "scale_bars": bars}).scale_bars
    value, weight = np.array(values), 1.0 / np.square(own)
    normal = float(np.sum(weight * value**2))
    factor = float(np.sum(weight * value * known)) / normal
    assert found["known_over_measured"] == pytest.approx(factor, rel=1e-4)
    assert found["stddev"] == pytest.approx(normal**-0.5, rel=1e-4)
    assert found["num_bars"] == 2


def test_a_bar_without_a_scale_is_no_check(result):
    bar = {"ends": [1, 5], "length_m": 0.5}
    found = measure(scaled(result, None), {"version": 1, "scale_bars": [bar]})
    assert found.scale_bars["verdict"] == "no check: the scale is arbitrary"


def test_a_length_is_told_from_zero_at_two_deviations(result):
    """Two places that are as far apart as a multiple of what is known of that."""
    scene = result.model.scene
    often = int(np.argmax(np.bincount(scene.point_idx)))  # near the middle of images
    first = scene.points[often]

    def between(length):
        ends = [clicks_on(result, first), clicks_on(result, first + [length, 0.0, 0.0])]
        return one(result, click_stddev_px=3.0, distances=[{"ends": ends}])

    unit = between(0.005).stddev_in_all
    for times, words in ((1.8, 1), (2.2, 0)):
        found = between(times * unit)
        assert found.value == pytest.approx(times * found.stddev_in_all, rel=0.02)
        told = [n for n in found.notes if n.startswith("not told from zero")]
        assert len(told) == words
