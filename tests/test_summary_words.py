"""The verdict at the head of summary.json, and halves, in words."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made_result import (
    camera_covariance,
)

from uwsfm.results.halves_summary import halves_numbers
from uwsfm.results.summary import versions, write_json
from uwsfm.results.verdict_summary import (
    plain,
    shown_word,
    verdict_line,
    verdict_note,
    with_verdict,
)
from uwsfm.trust.halves import Agreement, CrossValidation, Split
from uwsfm.trust.projections import ProjectionMap
from uwsfm.trust.reason import reason
from uwsfm.trust.shared_numbers import SharedNumber
from uwsfm.trust.verdict import Verdict


@pytest.mark.parametrize(
    ("word", "verdict", "expected"),
    [
        ("determined", "fits", "determined"),
        ("determined", "doubtful", "doubtful"),
        ("weakly determined", "doubtful", "doubtful"),
        ("determined", "does not fit", "withheld"),
        ("weakly determined", "does not fit", "withheld"),
        ("held", "does not fit", "held"),
        ("not determined", "doubtful", "not determined"),
    ],
)
def test_no_word_is_better_than_the_verdict(word, verdict, expected):
    assert shown_word(word, verdict) == expected


def test_the_verdict_comes_first_and_tones_the_words_down():
    because = (
        reason("a", "It is so.", "doubtful", value=np.float64(0.25), lost=math.nan),
        reason("b", "It is so too.", "doubtful"),
    )
    verdict = Verdict(verdict="doubtful", reasons=because, goodness=None)
    camera = {"name": "left", "distance_verdict": "determined", "distance_m": 0.02}
    summary = {
        "cameras": [camera],
        "scale": {"verdict": "determined", "unit": "metre"},
        "verdict": "an older one",
        "num_points": 3,
    }
    found = with_verdict(verdict, summary)
    assert list(found) == [
        "schema_version",
        "verdict",
        "reasons",
        "goodness",
        "cameras",
        "scale",
        "num_points",
    ]
    assert found["verdict"] == "doubtful" and found["num_points"] == 3
    assert found["reasons"][0] == {
        "code": "a",
        "text": "It is so.",
        "severity": "doubtful",
        "value": 0.25,
        "lost": None,
    }
    assert found["cameras"] == [{**camera, "distance_verdict": "doubtful"}]
    assert found["scale"] == {"verdict": "doubtful", "unit": "metre"}
    assert verdict_line(found) == "Verdict: doubtful, for 2 reasons."
    worse = with_verdict(replace(verdict, verdict="does not fit"), summary)
    assert worse["scale"]["verdict"] == "withheld"
    assert worse["cameras"][0]["distance_verdict"] == "withheld"
    (note,) = verdict_note(found)
    assert note.startswith("the verdict on this result is 'doubtful'")
    assert note.endswith("far too small: It is so.")


@pytest.mark.parametrize(
    ("verdict", "scale", "expected"),
    [
        ("fits", "determined", "noise. Its scale is determined, as far as"),
        ("fits", "weakly determined", "noise. Its scale is weakly determined, as"),
        ("fits", "arbitrary", "Verdict: fits. The model explains the images within"),
        ("does not fit", "determined", "Verdict: does not fit, for one reason."),
        (None, "determined", "No verdict: an earlier version of uwsfm made this"),
    ],
)
def test_the_first_line_says_the_verdict(verdict, scale, expected):
    line = verdict_line(
        {"verdict": verdict, "scale": {"verdict": scale}, "reasons": [{}]}
    )
    assert expected in line
    assert ("Its scale" in line) == (verdict == "fits" and scale != "arbitrary")


def test_what_fits_has_no_note():
    assert verdict_note({"verdict": "fits"}) == () == verdict_note({})


def test_plain_data_is_what_json_has(tmp_path):
    found = plain(
        {"a": np.array([1.5, np.nan]), "b": (math.inf, [np.array([[2.0]])]), "c": "x"}
    )
    assert found == {"a": [1.5, None], "b": [None, [[[2.0]]]], "c": "x"}
    assert plain(camera_covariance(2.0))["distance_stddev_m"] == pytest.approx(0.00104)
    write_json({"a": 1.5}, tmp_path / "a.json")
    text = (tmp_path / "a.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"a": 1.5} and text.endswith("}\n")
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json({"a": math.nan}, tmp_path / "b.json")
    assert not (tmp_path / "b.json").exists()
    assert {"python", "uwsfm", "numpy", "pycolmap"} <= set(versions())


# ---- Halves -------------------------------------------------------------------------


def projections():
    """0.11, 0.22, ... px apart at five ranges, in both cameras alike."""
    far = np.arange(1.0, 6.0)[None, :, None, None] * np.ones((2, 1, 3, 4))
    ranges = np.array([0.71, 1.12, 1.53, 2.94, 3.85])
    return ProjectionMap(ranges_m=ranges, px=0.111 * far, mm=1.25 * far)


def cross_validation(*, ratio=1.72, p_value=0.001, numbers=True, unit="m"):
    number = SharedNumber(
        group="distance",
        name="distance of left",
        camera=0,
        unit="mm",
        values=(19.1, 20.2),
        stddev=0.55,
        stddev_in_all=0.88,
    )
    agreement = Agreement(
        group="distance", ratio=ratio, num_independent=2.0, p_value=p_value
    )
    split = Split(
        name="odd and even",
        num_frames=(11, 12),
        num_observations=(3100, 3200),
        sigma_px=(0.31, 0.32),
        numbers=(number,) if numbers else (),
        agreements=(agreement,),
        lengths=None,
        projections=projections(),
    )
    return CrossValidation(splits=(split,), omitted=("No more.",), unit=unit)


def test_halves_are_told_at_the_middle_range():
    found = halves_numbers(cross_validation())
    first, second, third = found["sentences"]
    assert "odd and even (11 and 12 frames, each adjusted alone)" in first
    assert "project 0.33 px apart, which is 3.8 mm at 1.5 m" in first
    assert "by 1.7 times what their standard deviations predict" in second
    assert "enlarged by 1.7." in second and third == "No more."
    assert found["enlarged"] == {"distance": 1.72} and found["omitted"] == ["No more."]
    (split,) = found["splits"]
    assert split["name"] == "odd and even" and split["lengths"] is None
    assert split["num_frames"] == [11, 12]
    assert split["num_observations"] == [3100, 3200]
    assert split["sigma_px"] == [0.31, 0.32]
    (number,) = split["numbers"]
    assert (number["name"], number["group"]) == ("distance of left", "distance")
    assert number["unit"] == "mm" and number["values"] == [19.1, 20.2]
    assert number["difference"] == pytest.approx(1.1)
    assert (number["stddev"], number["stddev_in_all"]) == (0.55, 0.88)
    assert number["z"] == pytest.approx(2.0)
    (agreement,) = split["agreements"]
    assert (agreement["ratio"], agreement["p_value"]) == (1.72, 0.001)
    maps = split["projections"]
    assert maps["ranges_m"] == [0.71, 1.12, 1.53, 2.94, 3.85]
    assert maps["rms_px"] == pytest.approx([0.111, 0.222, 0.333, 0.444, 0.555])
    assert maps["rms_mm"] == pytest.approx([1.25, 2.5, 3.75, 5.0, 6.25])
    assert maps["px"][1][2][0][0] == pytest.approx(0.333)
    assert maps["mm"][1][2][0][0] == pytest.approx(3.75)


def test_halves_that_agree_or_have_nothing_to_differ_in():
    for calm in (cross_validation(ratio=0.9), cross_validation(p_value=0.02)):
        assert not calm.enlarged
        sentences = halves_numbers(calm)["sentences"]
        assert sentences[1].startswith("The halves differ by no more than")
    nothing = halves_numbers(cross_validation(numbers=False))["sentences"]
    assert "have nothing to differ in but poses and points" in nothing[0]
    units = halves_numbers(cross_validation(unit="units"))["sentences"]
    assert "3.8 thousandths of a unit at 1.5 units" in units[0]
    none = CrossValidation(unit="m", splits=(), omitted=("Too few frames.",))
    assert halves_numbers(none)["sentences"] == ["Too few frames."]
