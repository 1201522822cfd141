"""Sentences and tables of the report: numbers made by hand, read with their units."""

import math

import pytest
from hand_made import SI, numbers, slope, summary

from uwsfm.report.halves import halves_of, halves_payload
from uwsfm.report.tables import (
    budget_columns,
    budget_lines,
    estimates,
    lengths_note,
)
from uwsfm.report.words import (
    deviation,
    known_length_rows,
    position_words,
    rounded,
    small_lengths,
    tilts_deg,
    tilts_of,
    unit_of,
    verdict_of,
    with_deviations,
)

DEG = math.pi / 180.0


def arbitrary(**more):
    data = summary(**more)
    data["scale"] |= {"unit": "scale arbitrary", "verdict": "arbitrary"}
    return data


# ---- Estimates ----------------------------------------------------------------------


def si(row):
    """Value and deviations of an estimate in its unit; None for a dash."""
    return [
        None if text == "-" else float(text) * SI[row.unit]
        for text in (row.value, row.stddev, row.stddev_in_all)
    ]


@pytest.fixture(scope="module")
def rows():
    return {(row.group, row.name): row for row in estimates(summary())}


@pytest.mark.parametrize(("camera", "start"), [("left", 2.0), ("right", 4.0)])
def test_estimates_of_a_flat_port(rows, camera, start):
    expected = {
        "port tilt x": (DEG, start, 0.111 * start, 0.213 * start),
        "port tilt y": (DEG, -start - 1.0, 0.122 * start, 0.224 * start),
        "port azimuth phi": (DEG, -56.31 - start, 1.31 * start, 1.42 * start),
        "port tilt theta": (DEG, 3.61 + start, 0.15 * start, 0.26 * start),
        "port distance": (1, 0.01 * start + 0.00045, 0.00033 * start, 0.00077 * start),
    }
    for name, (unit, *values) in expected.items():
        row = rows[camera, name]
        assert row.unit == ("deg" if unit == DEG else "mm")
        # Two digits of a deviation are shown, half of whose last is 5 % of 10; the
        # value has as many as that from the images.
        shown, *deviations = si(row)
        assert shown == pytest.approx(unit * values[0], abs=0.051 * unit * values[1])
        assert deviations == pytest.approx([unit * v for v in values[1:]], rel=0.05)
        word = "weakly determined" if name == "port distance" else "determined"
        assert row.word == word
    glass = rows[camera, "glass thickness"]
    assert (float(glass.value), glass.unit) == (pytest.approx(8.1 + start), "mm")
    assert float(rows[camera, "glass index"].value) == pytest.approx(
        1.5168 + 0.001 * start
    )
    assert (glass.stddev, glass.stddev_in_all, glass.word) == ("-", "-", "given")
    assert (camera, "water index") not in rows  # it was refined, and has its own row


def test_estimates_of_a_dome_and_of_no_port(rows):
    for axis, value, own, total in zip(
        "xyz",
        (7.0, -14.0, 21.0),
        (0.13, 0.24, 0.35),
        (0.46, 0.57, 0.68),
        strict=True,
    ):
        row = rows["nose", f"dome centre {axis}"]
        assert (row.unit, row.word) == ("mm", "weakly determined")
        assert [float(v) for v in (row.value, row.stddev, row.stddev_in_all)] == (
            pytest.approx([value, own, total])
        )
    radius = rows["nose", "dome radius"]
    assert (float(radius.value), radius.unit, radius.word) == (53.7, "mm", "given")
    none = rows["air", "port"]
    assert (none.value, none.stddev, none.stddev_in_all) == ("none", "", "")
    assert none.word == "given"


@pytest.mark.parametrize(("camera", "start"), [("right", 4.0), ("nose", 7.0)])
def test_estimates_of_the_placement(rows, camera, start):
    """A turn of 2 start degrees about x; metres as millimetres."""
    stddevs_deg = ((0.0061, 0.0114), (0.0072, 0.0135), (0.0083, 0.0146))
    turns = zip((2.0 * start, 0.0, 0.0), stddevs_deg, strict=True)
    for axis, (value, (own, total)) in zip("xyz", turns, strict=True):
        row = rows[camera, f"cam_from_rig turn {axis}"]
        assert (row.unit, row.word) == ("deg", "refined")
        found = [float(v) for v in (row.value, row.stddev, row.stddev_in_all)]
        known = [value, own * start, total * start]
        assert found == pytest.approx(known, rel=0.05)  # half of a second digit
    places = (-0.101 * start, 0.0023 * start, 0.0045 * start)
    stddevs = ((1.1e-5, 4.4e-5), (2.2e-4, 5.5e-4), (3.3e-3, 6.6e-3))
    for axis, value, both in zip("xyz", places, stddevs, strict=True):
        row = rows[camera, f"cam_from_rig shift {axis}"]
        assert row.unit == "mm" and row.word == "refined"
        assert si(row) == pytest.approx([value, *both], abs=0.051 * both[0])
    assert ("left", "cam_from_rig turn x") not in rows  # the first is the rig


def test_estimates_of_water_baseline_and_lens(rows):
    water = rows["all", "water index"]
    assert (water.value, water.stddev, water.stddev_in_all) == (
        "1.34020",
        "0.00031",
        "0.00052",
    )
    assert water.unit == "" and water.word == "refined"
    baseline = rows["right", "baseline"]
    assert baseline.unit == "mm"
    assert si(baseline) == pytest.approx([0.20233, 0.00021, 0.00043])
    lens = rows["left", "fx"]
    assert lens.unit == "px" and si(lens) == [1234.5, 1.7, 2.9]


def test_what_was_held_or_is_open_says_so():
    data = summary()
    data["refined"] = [
        {"name": "k1 of left", "value": 0.01, "stddev": None, "stddev_in_all": None}
    ]
    pose = data["cameras"][1]["cam_from_rig"]
    pose["turn_xyz_stddev_deg"] = [None] * 3
    pose["translation_stddev_m"] = [None] * 3
    rows = {(row.group, row.name): row for row in estimates(data)}
    lens = rows["left", "k1"]
    assert (lens.word, lens.stddev, lens.unit) == ("not determined", "-", "")
    turn = rows["right", "cam_from_rig turn x"]
    assert (turn.word, turn.stddev) == ("held", "-")
    assert float(turn.stddev_in_all) == pytest.approx(4.0 * 0.0114, rel=0.05)
    assert rows["right", "cam_from_rig shift x"].word == "held"
    # The water index was given then, with the port's.
    water = rows["left", "water index"]
    assert (float(water.value), water.word) == (1.3411, "given")


def test_an_arbitrary_scale_has_units_and_no_millimetres():
    rows = {(row.group, row.name): row for row in estimates(arbitrary())}
    distance = rows["left", "port distance"]
    assert (distance.unit, distance.value) == ("units", "0.02045")
    assert rows["right", "cam_from_rig shift x"].unit == "units"
    assert unit_of(arbitrary()) == "units" and unit_of(summary()) == "m"
    assert small_lengths(arbitrary()) == ("units", 1.0)
    assert small_lengths(summary()) == ("mm", 1e3)


# ---- Budget -------------------------------------------------------------------------


def test_the_budget_has_the_columns_of_its_ports():
    assert budget_columns(summary()) == (
        "left: tilt (deg)",
        "left: distance (mm)",
        "right: tilt (deg)",
        "right: distance (mm)",
        "nose: centre (mm)",
        "lengths (%)",
    )
    assert budget_columns(arbitrary())[1] == "left: distance (units)"
    assert lengths_note(summary()) == "" and "arbitrary" in lengths_note(arbitrary())
    lines = budget_lines(summary())
    assert [line.name for line in lines][0] == "number 0"
    assert [line.source for line in lines] == ["given", "assumed", "prior", ""]
    assert [line.amount for line in lines][:2] == ["+0.10 mm", "+0.11 mm"]
    for line, far in zip(lines, (1.0, 2.0, 3.0, 10.0), strict=True):
        tilts, distances = line.effects[0:4:2], line.effects[1:4:2]
        for c in range(2):
            assert float(tilts[c]) == pytest.approx(0.0123 * far + 0.01 * c, rel=5e-3)
            metres = 1e-3 * float(distances[c])
            assert metres == pytest.approx(-0.000456 * far - 1e-4 * c, rel=5e-3)
        center = [1e-3 * value for value in numbers(line.effects[4])]
        expected = [0.00011 * far, -0.00022 * far, 0.00033 * far]
        assert center == pytest.approx(expected, rel=5e-3)
        share = 1e-2 * float(line.effects[5])
        assert share == pytest.approx(-0.00123 * far, rel=5e-3)
    data = summary()
    data["error_budget"][0]["scale"] = None
    assert budget_lines(data)[0].effects[5] == "-"
    assert budget_lines({**data, "error_budget": []}) == ()


# ---- Words --------------------------------------------------------------------------


def test_digits_are_those_of_the_deviation():
    assert rounded(0.0123456, 0.00078, 1e3) == "12.35"
    assert rounded(-0.0123456, 0.0078, 1e3) == "-12.3"
    assert rounded(12345.678, 99.0) == "12346" and rounded(1.0, 1e-12) == "1.000000000"
    assert rounded(1.23456789, 0.0) == "1.23457" == rounded(1.23456789, None)
    assert deviation(0.00078, 1e3) == "0.78" and deviation(0.0) == "0"
    assert deviation(0.0314) == "0.031" and deviation(None, 1e3) == "-"
    assert deviation(123.4) == "123" and deviation(9.96) == "10.0"
    mm = ("mm", 1e3)
    assert with_deviations(0.02, 0.0001, 0.0003, mm) == (
        "20.00 ± 0.30 (± 0.10 from the images) mm"
    )
    assert with_deviations(0.02, None, 0.0003, mm) == "20.00 ± 0.30 mm"
    assert with_deviations(0.02, 0.0001, None, mm) == (
        "20.00 (± 0.10 from the images) mm"
    )
    assert with_deviations(0.02, None, None, mm) == "20 mm"


def test_tilts_are_degrees_about_the_axes_they_are_named_by():
    camera = {
        "normal": [slope(2.5), slope(-7.5), 0.99],
        "tilt_xy_stddev_deg": [0.1, 0.2],
        "tilt_xy_stddev_in_all_deg": [0.3, 0.4],
    }
    assert tilts_deg(camera["normal"]) == pytest.approx((2.5, -7.5))
    x, y = tilts_of(camera)
    assert x == pytest.approx((2.5, 0.1, 0.3)) and y == pytest.approx((-7.5, 0.2, 0.4))
    x, y = tilts_of({"normal": camera["normal"]})
    assert x[1:] == y[1:] == (None, None)


def test_the_fit_is_told_with_its_numbers():
    found = verdict_of(summary())
    assert numbers(found.fit) == [37, 41, 5208, 61234, 4.57, 0.543]
    assert found.fit.index("4.57") < found.fit.index("0.543 px RMS")
    assert found.word == "fits" and found.metric_word == "determined"
    assert found.line.startswith("Verdict: fits.")
    assert found.open == ("The port distance of left is weakly determined.", "Ask why?")
    data = summary(reasons=[{"severity": "doubtful", "text": "It repeats."}])
    assert verdict_of(data).reasons == (("doubtful", "It repeats."),)


def test_ports_are_told_with_their_numbers():
    left, _, nose, air = verdict_of(summary()).ports
    assert left.camera == "left"
    assert "2.00 ± 0.43 (± 0.22 from the images) deg towards x" in left.text
    assert "-3.00 ± 0.45 (± 0.24 from the images) deg towards y" in left.text
    assert "at 20.45 ± 1.5 (± 0.66 from the images) mm from" in left.text
    assert left.words == (("tilt", "determined"), ("distance", "weakly determined"))
    assert "7.00 ± 0.46 (± 0.13 from the images) mm, -14.00 ± 0.57" in nose.text
    assert "21.00 ± 0.68 (± 0.35 from the images) mm from the projection" in nose.text
    assert nose.words == (("centre", "weakly determined"),)
    assert (air.text, air.words) == ("no port", ())


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("determined", "The model is metric: every length shares an error of 0.34 %"),
        ("weakly determined", "The model is metric, but weakly: every length shares"),
        ("doubtful", "The model is doubtful: if it fits, every length shares an"),
        ("withheld", "Whether the model is metric is withheld, because the model"),
        ("not determined", "The model is not metric: what was given does not"),
        ("arbitrary", "The model is not metric: nothing determines its scale"),
    ],
)
def test_whether_lengths_are_metres(word, expected):
    data = summary()
    data["scale"]["verdict"] = word
    metric = verdict_of(data).metric
    assert metric.startswith(expected)
    told = "0.34 % in all, 0.12 % from the images" in metric
    assert told == word.endswith(("determined", "doubtful")) or word == "not determined"


def source_of(**more):
    return verdict_of(summary(**more)).metric.partition("from the images. ")[2]


def test_where_the_scale_comes_from():
    """A baseline of 202.15 mm, known to 0.47 mm; two lengths; 33 of 35 positions."""
    text = source_of()
    assert "the baseline of 202.15 mm, ± 0.47 mm" in text
    assert "and from 2 known lengths, and from 33 positions of frames." in text
    assert "One per cent" not in text
    none = {"known_lengths": None, "positions": None}
    held = source_of(baseline_stddev_m=0.0, **none)
    assert "the baseline of 202.15 mm, held. One per cent wrong there is one" in held
    assert "One per cent" not in source_of(**none)
    assert "One per cent" not in source_of(baseline_stddev_m=0.0)
    alone = source_of(baseline_m=None, **none)
    assert alone.startswith("Its scale comes from refraction alone")
    lengths = source_of(baseline_m=None, baseline_stddev_m=0.0, positions=None)
    assert lengths == "Its scale comes from 2 known lengths."


def test_known_lengths_are_millimetres_and_deviations():
    first, second = known_length_rows(summary())
    # 0.5003 ± 0.0004 came out as 0.4993: 2.5 deviations too short.
    assert first == ("500.30", "0.40", "499.30", "-1.00", "-2.5")
    assert second == ("2314", "13", "2353", "39", "+3.0")
    assert known_length_rows(summary(known_lengths=None)) == []


def test_positions_are_told_with_their_numbers():
    text = position_words(summary())
    found = numbers(text.partition(" Left out")[0])
    assert found == [33, 35, 0.0314, 1.3, 0.011, 0.022, 0.033, 0.58]
    assert "0.0314 m RMS" in text and "0.033 m, its turn to 0.58 deg" in text
    assert text.endswith("Left out: 0007.jpg, 0009.jpg.")
    data = summary()
    for count, end in ((0, "0.58 deg."), (10, "09."), (11, "09 ...."), (12, "09 ....")):
        data["positions"]["outliers"] = [f"{k:02d}" for k in range(count)]
        assert position_words(data).endswith(end)
    assert position_words(summary(positions=None)) is None


# ---- Halves -------------------------------------------------------------------------


def split(name, far, *, numbers=True, missing=False):
    return {
        "name": name,
        "numbers": [{}] if numbers else [],
        "agreements": [
            {"group": "tilt", "ratio": 1.234 * far, "p_value": 0.0213},
            {"group": "lens", "ratio": 0.8 * far, "p_value": 0.0009},
        ],
        "projections": {
            "ranges_m": [0.5, 1.5, 2.5, 3.5],
            "rms_px": [0.11 * far, 0.22 * far, None if missing else 0.33 * far, 0.44],
            "rms_mm": [1.1 * far, 2.2 * far, 3.3 * far, 4.4],
            "px": [
                [[[far, 2 * far]]] * 2 + [[[3 * far, None]]] * 2,
                [[[9 * far, 12 * far]]] * 4,
            ],
        },
    }


def crossed(*splits, unit="m"):
    return {"cross_validation": {"sentences": ["So."], "unit": unit, "splits": splits}}


def test_halves_of_the_worse_split_are_shown():
    data = crossed(split("first and last", 1.0), split("odd and even", 2.0))
    found = halves_of(data)
    assert found["split"] == "odd and even" and found["sentences"] == ["So."]
    assert found["range"] == "2.5 m"  # the middle one
    assert found["ranges"] == (
        "RMS over all cameras: 0.22 px, 2.2 mm at 0.5 m; 0.44 px, 4.4 mm at 1.5 m; "
        "0.66 px, 6.6 mm at 2.5 m; 0.44 px, 4.4 mm at 3.5 m."
    )
    assert found["rows"][0] == {
        "split": "first and last",
        "numbers": "port tilts",
        "ratio": "1.23",
        "chance": "2.1 %",
    }
    assert found["rows"][3]["numbers"] == "lenses"
    assert [row["ratio"] for row in found["rows"]] == ["1.23", "0.80", "2.47", "1.60"]
    assert found["rows"][1]["chance"] == "< 0.1 %"
    drawn = halves_payload(data)
    assert drawn["halves"] == [[[6.0, None]], [[18.0, 24.0]]]
    # 95 % of the way through 6, 18 and 24
    assert drawn["halves_limit"] == pytest.approx(23.4)
    units = halves_of(crossed(split("a", 1.0, missing=True), unit="units"))
    assert "2.2 thousandths of a unit at 1.5 units" in units["ranges"]
    assert "at 2.5 units" not in units["ranges"]


def test_a_split_that_no_pixel_of_both_halves_sees_is_the_better_one():
    blind, other = split("blind", 1.0), split("other", 0.1)
    blind["projections"]["rms_px"] = [None] * 4
    assert halves_of(crossed(blind, other))["split"] == "other"
    calm = split("a", 1.0)
    calm["projections"]["px"] = [[[[None, None]]] * 4] * 2
    assert halves_payload(crossed(calm))["halves_limit"] == 1.0
    calm["projections"]["px"] = [[[[1e-9, 1e-9]]] * 4] * 2
    assert halves_payload(crossed(calm))["halves_limit"] == 1e-3


def test_halves_that_have_nothing_to_differ_in_have_no_map():
    data = crossed(split("a", 1.0, numbers=False))
    assert halves_of(data)["split"] is None and halves_payload(data) == {}
    for nothing in ({}, crossed()):
        assert halves_of(nothing) is None and halves_payload(nothing) == {}
