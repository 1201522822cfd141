"""What is measured: numbers that are known by hand, in the units that are printed."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made import SI, numbers, printed

from uwsfm.measuring.measure import (
    Measurement,
    MeasureResult,
    agreement,
    bar_check,
    entry,
    unit_hint,
)
from uwsfm.measuring.measurements_file import Task
from uwsfm.measuring.picks import PointPick, WorldPick
from uwsfm.measuring.spots import Spot
from uwsfm.measuring.table import measurement_table, rounded


def item(kind="distance", value=0.25, **more):
    """A measurement; deviations of 2 mm from the images and 3 mm in all."""
    task = Task(
        kind=kind,
        name=more.pop("name", f"[i]{kind}"),
        where="distances[0]",
        picks=(PointPick(1), PointPick(2)),
        keys=("ends[0]", "ends[1]"),
        click_stddev_px=1.0,
        length_m=more.pop("length_m", None),
        stddev_m=more.pop("stddev_m", 0.0),
    )
    return Measurement(
        **{
            "task": task,
            "value": value,
            "stddev": 0.002,
            "stddev_alone": 0.0015,
            "stddev_clustered": 0.002,
            "stddev_in_all": 0.003,
            "spots": (Spot(PointPick(1), "point of the model", 7),),
            "points": np.array([[0.1, 0.2, 0.3]]),
            "places_stddev": np.array([0.004]),
            "flatness": None,
            "notes": (),
            **more,
        }
    )


def table_of(*items, unit="metre", bars=None):
    result = MeasureResult(
        unit=unit, measurements=items, scale_bars=bars, warnings=(), summary={}
    )
    return printed(measurement_table(result))[1]


# ---- The table ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "value", "deviations", "shown", "unit"),
    [
        # Lengths below a metre are millimetres, areas below a square metre cm2.
        ("distance", 0.25, (0.002, 0.003), ("250.0", "3.0", "2.0"), "mm"),
        ("polyline", 0.999, (0.02, 0.03), ("999", "30", "20"), "mm"),
        ("distance", 1.0, (0.02, 0.03), ("1.000", "0.030", "0.020"), "m"),
        ("height", 2.5, (0.02, 0.03), ("2.500", "0.030", "0.020"), "m"),
        ("area", 0.25, (0.002, 0.003), ("2500", "30", "20"), "cm2"),
        ("area", 1.25, (0.002, 0.003), ("1.2500", "0.0030", "0.0020"), "m2"),
        ("angle", 33.25, (0.2, 0.3), ("33.25", "0.30", "0.20"), "deg"),
        ("angle", 0.5, (0.2, 0.3), ("0.50", "0.30", "0.20"), "deg"),
    ],
)
def test_numbers_are_printed_in_the_unit_beside_them(
    kind, value, deviations, shown, unit
):
    stddev, in_all = deviations
    (row,) = table_of(item(kind, value, stddev=stddev, stddev_in_all=in_all))
    name, what, number, images, _ = row
    assert (name, what) == (f"[i]{kind}", kind)
    assert number == f"{shown[0]} ± {shown[1]} {unit}" and images == shown[2]
    scale = 1.0 if unit == "deg" else SI[unit]
    found = [scale * v for v in (*numbers(number)[:2], float(images))]
    assert found == pytest.approx([value, in_all, stddev])


def test_what_is_arbitrary_has_no_unit_and_what_is_open_no_number():
    (row,) = table_of(item(), unit="scale arbitrary")
    assert row[2:4] == ["0.2500 ± 0.0030", "0.0020"]
    open_ones = ({"value": None}, {"stddev": None}, {"stddev_in_all": None})
    for lost in open_ones:
        (row,) = table_of(item(**lost))
        assert row[2:4] == ["not determined", ""]
    for value in (0.5, -0.5):
        assert rounded(value, 0.0) == f"{value:.6f} ± 0.000000"
    assert rounded(-12.3456, 0.95) == "-12.35 ± 0.95"
    assert rounded(12.3, 10.0) == "12 ± 10"


def test_a_scale_bar_is_printed_beside_what_it_is_known_to_be():
    """Known to 4 mm and measured to 3: 19.5 mm too long are 3.9 of 5 mm."""
    bar = item("scale bar", 0.5195, length_m=0.5, stddev_m=0.004)
    (row,) = table_of(bar)
    assert row[2] == "519.5 ± 3.0 mm"
    assert row[4] == "known 0.5 m, off by +19.500 mm, +3.9 std. dev.: doubtful"
    short = item("scale bar", 0.495, length_m=0.5, stddev_m=0.004)
    text = table_of(short)[0][4]
    assert text == "known 0.5 m, off by -5.000 mm, -1.0 std. dev.: agrees"
    wrong = item("scale bar", 0.5, length_m=500.0)
    assert table_of(wrong)[0][4].endswith(
        "contradicts (1000 times what was measured: millimetres?)"
    )
    text = table_of(bar, unit="scale arbitrary")[0][4]
    assert text == "known 0.5 m: no check: nothing determines the length"


def test_the_factor_of_all_scale_bars_has_its_own_row():
    bars = {
        "num_bars": 2,
        "known_over_measured": 1.012345,
        "stddev": 0.004567,
        "verdict": "doubtful",
    }
    assert table_of(item(), bars=bars)[1] == [
        "known / measured",
        "scale bars",
        "1.01235 ± 0.00457",
        "",
        "doubtful",
    ]
    one = {**bars, "num_bars": 1}
    assert len(table_of(item(), bars=one)) == 1  # the bar's own row says the same
    assert len(table_of(item(), bars=one, unit="scale arbitrary")) == 2
    assert len(table_of(item(), unit="scale arbitrary")) == 1


def test_remarks_have_their_units():
    """Corners 3, 4 and 0 mm off their plane: 2.9 mm RMS; a place 5 mm away."""
    flat = np.array([0.003, -0.004, 0.0])
    near = Spot(
        WorldPick((0.1, 0.2, 0.3)),
        "nearest point of the model, 9; so",
        3,
        moved_by=0.005,
    )
    far = replace(near, how="nearest point of a cloud", moved_by=1.5)
    once = Spot(PointPick(3), "clicked in one image, at the depth of a cloud", 2)
    twice = Spot(PointPick(3), "clicked in 4 images", 4)
    spots = (near, far, once, twice, once)
    area = item("area", flatness=flat, spots=spots, notes=("a note",))
    text = table_of(area)[0][4]
    assert text == (
        "corners 2.9 mm RMS off their plane; nearest point of the model, 9, 5 mm from "
        "(0.1, 0.2, 0.3); so; nearest point of a cloud, 1.5 m from (0.1, 0.2, 0.3); "
        "clicked in one image, at the depth of a cloud; a note"
    )
    text = table_of(area, unit="scale arbitrary")[0][4]
    assert text.startswith("corners 0.0029 RMS off their plane; nearest point of the")
    assert "9, 0.005 from (0.1" in text
    assert table_of(item("height", flatness=flat))[0][4] == ""


def test_columns_have_their_heads():
    result = MeasureResult(
        unit="metre", measurements=(item(),), scale_bars=None, warnings=(), summary={}
    )
    heads = ["", "kind", "value ± in all", "± images", ""]
    table = measurement_table(result)
    assert printed(table)[0] == heads and table.title == "measured"
    arbitrary = measurement_table(replace(result, unit="scale arbitrary"))
    assert arbitrary.title == "measured (scale arbitrary)"
    aligned = [column.justify for column in table.columns]
    assert aligned == ["left", "left", "right", "right", "left"]


# ---- JSON ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "unit", "arbitrary"),
    [
        ("distance", "m", "unit"),
        ("polyline", "m", "unit"),
        ("height", "m", "unit"),
        ("area", "m2", "unit2"),
        ("angle", "deg", "deg"),
    ],
)
def test_a_measurement_is_json_with_its_unit(kind, unit, arbitrary):
    found = entry(item(kind, name="it", notes=("so",)), False)
    assert (found["name"], found["kind"], found["unit"]) == ("it", kind, unit)
    assert entry(item(kind), True)["unit"] == arbitrary
    assert found["value"] == 0.25 and found["verdict"] == "determined"
    keys = ("stddev", "stddev_alone", "stddev_clustered", "stddev_in_all")
    assert [found[key] for key in keys] == [0.002, 0.0015, 0.002, 0.003]
    assert "scale_bar" not in found and found["notes"] == ["so"]
    assert entry(item(kind, value=None), False)["verdict"] == "not determined"


def test_flatness_and_places_are_json():
    spot = Spot(PointPick(3), "so", 5, miss_px=1.25, moved_by=0.002)
    flat = item(
        "height",
        flatness=np.array([np.nan, 0.003, -0.004]),
        spots=(spot, spot),
        points=np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]),
        places_stddev=np.array([0.004, np.nan]),
    )
    found = entry(flat, False)
    assert found["off_plane_rms_m"] == pytest.approx(math.sqrt(12.5e-6))
    assert found["off_plane_max_m"] == 0.004
    first, second = found["places"]
    assert first == {
        "pick": "point 3",
        "how": "so",
        "xyz": [1.0, 2.0, 3.0],
        "stddev_m": 0.004,
        "num_images": 5,
        "moved_by_m": 0.002,
        "miss_px": 1.25,
    }
    assert second["xyz"] == [4.0, 5.0, 6.0] and second["stddev_m"] is None


def test_a_bar_is_checked_with_both_deviations():
    found = bar_check(item("scale bar", 0.52, length_m=0.5, stddev_m=0.004), False)
    assert found["known_m"] == 0.5 and found["known_stddev_m"] == 0.004
    assert found["deviation_m"] == pytest.approx(0.02)
    assert found["stddev_m"] == pytest.approx(0.005)
    assert found["ratio"] == pytest.approx(4.0) and found["hint"] is None
    for open_one in (
        bar_check(item("scale bar", length_m=0.5), True),
        bar_check(item("scale bar", None, length_m=0.5), False),
        bar_check(item("scale bar", length_m=0.5, stddev_in_all=None), False),
    ):
        assert open_one["verdict"].startswith("no check") and "ratio" not in open_one


@pytest.mark.parametrize(
    ("ratio", "word"),
    [(1.8, "agrees"), (2.2, "doubtful"), (3.6, "doubtful"), (4.4, "contradicts")],
)
def test_words_change_at_two_and_four_deviations(ratio, word):
    assert agreement(ratio) == agreement(-ratio) == word
    assert agreement(2.0) == "agrees" and agreement(4.0) == "doubtful"


@pytest.mark.parametrize("factor", [1e3, 1e2, 1e1])
def test_another_unit_is_guessed_within_a_half(factor):
    for off in (1.0, 1.4, 1.0 / 1.4):
        assert unit_hint(0.12 * factor * off, 0.12).startswith(f"{factor:g} times what")
        assert unit_hint(0.12 / factor * off, 0.12) == (
            f"{factor:g} times too short: is it in metres?"
        )
    for off in (1.6, 1.0 / 1.6):
        assert unit_hint(0.12 * factor * off, 0.12) is None
    assert unit_hint(0.5, 0.0) is None
    assert unit_hint(12.0, 0.12).endswith("centimetres?")
    assert unit_hint(1.2, 0.12).endswith("decimetres?")
