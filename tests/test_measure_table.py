"""What is measured: numbers that are known by hand, in the units that are printed."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dense import small_scene
from hand_made import SI, numbers, printed
from sfm_scenes import model_of

from uwsfm import calibrate
from uwsfm.calibration.propagation import Propagation
from uwsfm.cloud import Cloud, write_cloud
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.lengths_file import Click
from uwsfm.measuring.measure import (
    Measurement,
    MeasureResult,
    agreement,
    bar_check,
    entry,
    measure,
    unit_hint,
)
from uwsfm.measuring.measurements_file import Task
from uwsfm.measuring.picks import PixelPick, PointPick, WorldPick
from uwsfm.measuring.spots import Spot, Spotter
from uwsfm.measuring.surface import CANDIDATES, Surface, SurfaceImage, views_of
from uwsfm.measuring.table import measurement_table, rounded
from uwsfm.result_folder import Result
from uwsfm.simulate.rigs import sample_rig


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


# ---- Measuring ----------------------------------------------------------------------


@pytest.fixture(scope="module")
def result():
    """A small dive, solved; its result was never written."""
    calibration = calibrate(small_scene(noise_px=0.3).scene, loss="l2")
    return Result(
        folder=Path("nowhere"),
        model=model_of(sample_rig(), calibration.scene),
        calibration=calibration,
        solved=calibration,
        summary={"verdict": "fits"},
        images=None,
        fingerprint="mark",
    )


def one(result, **content):
    (found,) = measure(result, {"version": 1, **content}).measurements
    return found


def clicked(result, point, offsets=0.0, images=None):
    """Clicks where a point of the model is projected, or off by so much."""
    scene = result.model.scene
    rows = np.flatnonzero(scene.point_idx == point)[:images]
    pixels = scene.projections()[0][rows] + offsets
    names = [
        f"{('left', 'right')[scene.camera_idx[i]]}/{scene.frame_idx[i]:04}.jpg"
        for i in rows
    ]
    return [{"image": n, "xy": p.tolist()} for n, p in zip(names, pixels, strict=True)]


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
        (0.9, "the scale is weakly determined, 90 %, which all"),
        (1.1, "nothing that is measured is determined"),
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
    assert (length.value is None) == (stddev == 1.1)
    assert angle.value is not None  # a scale turns nothing
    if stddev == 1.1:
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


def clicks_on(result, place):
    """Clicks on any place, in both images of two frames."""
    scene = result.model.scene
    seen = replace(
        scene,
        points=np.array([place]),
        camera_idx=np.array([0, 1, 0, 1]),
        frame_idx=np.array([0, 0, 1, 1]),
        point_idx=np.zeros(4, dtype=np.int64),
        xy=np.zeros((4, 2)),
    )
    pixels, valid = seen.projections()
    assert valid.all()
    names = [f"{side}/{f:04}.jpg" for f in (0, 1) for side in ("left", "right")]
    return [{"image": n, "xy": p.tolist()} for n, p in zip(names, pixels, strict=True)]


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


# ---- Spots --------------------------------------------------------------------------


def test_clicks_are_placed_where_their_rays_meet(result):
    points = result.model.scene.points
    found = one(result, distances=[{"ends": [clicked(result, 0), clicked(result, 4)]}])
    np.testing.assert_allclose(found.points, points[[0, 4]], atol=1e-7)
    for spot, point in zip(found.spots, (0, 4), strict=True):
        count = int(np.count_nonzero(result.model.scene.point_idx == point))
        assert spot.num_images == count and spot.how == f"clicked in {count} images"
        assert spot.miss_px == pytest.approx(0.0, abs=1e-5) and spot.note is None


def test_noise_of_clicks_grows_with_what_is_given_of_them(result):
    """Four times the noise is four times the deviation, where clicks are all of it."""
    ends = [clicked(result, 0), clicked(result, 4)]
    deviations = [
        one(result, click_stddev_px=px, distances=[{"ends": ends}]).stddev_alone
        for px in (20.0, 80.0)
    ]
    assert deviations[1] / deviations[0] == pytest.approx(4.0, rel=1e-3)


def test_clicks_that_miss_each_other_are_named(result):
    """Two clicks, y off by d / 2 each way: rays d px apart, over one spare number."""
    pair = clicked(result, 0, images=2)
    expected = one(result, distances=[{"ends": [pair, 5]}])
    assert expected.spots[0].note is None
    for d in (3.6, 4.8):
        moved = [dict(click) for click in pair]
        (x0, y0), (x1, y1) = pair[0]["xy"], pair[1]["xy"]
        moved[0]["xy"], moved[1]["xy"] = [x0, y0 + d / 2], [x1, y1 - d / 2]
        found = one(result, distances=[{"ends": [moved, 5]}])
        miss = found.spots[0].miss_px
        # Epipolar lines are nearly rows here: the gap is d / sqrt(2), nearly.
        assert miss == pytest.approx(d / math.sqrt(2.0), rel=0.1)
        noise = miss / 4.2
        noted = one(
            result, click_stddev_px=noise, distances=[{"ends": [moved, 5]}]
        ).spots[0]
        assert f"miss each other by {miss:.1f} px, 4 standard" in noted.note
        calm = one(
            result, click_stddev_px=miss / 3.8, distances=[{"ends": [moved, 5]}]
        ).spots[0]
        assert calm.note is None
        with pytest.raises(InputError, match="its clicks miss each other by"):
            one(result, click_stddev_px=miss / 300.0, distances=[{"ends": [moved, 5]}])


def test_points_and_places_of_the_model(result):
    scene = result.model.scene
    near = (scene.points[4] + [0.0, 0.0003, 0.0004]).tolist()
    found = one(result, distances=[{"ends": [1, near]}])
    first, second = found.spots
    assert first.how == "point of the model" and first.moved_by is None
    assert second.how == "nearest point of the model, 5"
    assert second.moved_by == pytest.approx(0.0005)
    for spot, point in ((first, 0), (second, 4)):
        assert spot.num_images == np.count_nonzero(scene.point_idx == point)
    last = scene.num_points
    assert one(result, distances=[{"ends": [1, last]}]).value > 0.0
    for wrong in (0, last + 1):
        with pytest.raises(InputError, match=f"the ids run from 1 to {last}"):
            one(result, distances=[{"ends": [1, wrong]}])


def plane_cloud(folder, stddev, result):
    """A level floor below the cameras as the dense cloud of a result."""
    x, y = (c.ravel() for c in np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 201)]))
    level = float(np.median(result.model.scene.points[:, 2]))
    points = np.column_stack([x, y, np.full_like(x, level)])
    cloud = Cloud(
        points=points,
        normals=np.full_like(points, np.nan),
        colors=np.zeros((len(points), 3), dtype=np.uint8),
        stddev=np.full(len(points), stddev),
        num_views=np.ones(len(points), dtype=np.int64),
        view_range=np.full(len(points), np.nan),
    )
    (folder / "dense").mkdir()
    write_cloud(cloud, folder / "dense" / "cloud.ply")
    return replace(result, folder=folder), level


def ray_on(result, frame, xy, level):
    """Where the ray of a pixel of the left camera meets the floor; its direction."""
    scene = result.model.scene
    origin, direction = scene.cameras[0].ray_from_img([xy])
    back = rigid3.inverse(scene.rig_from_world[frame])
    start = rigid3.transform(back, origin)[0]
    along = rigid3.rotate(back, direction)[0]
    return start + (level - start[2]) / along[2] * along, along


def test_a_pixel_slides_on_the_floor_as_its_click_errs(result, tmp_path):
    """20 px of noise are far more than all else: by the place of the next pixel."""
    dense, level = plane_cloud(tmp_path, 1e-6, result)
    xy = np.array([420.0, 310.0])
    picks = [f"left/0000.jpg:{xy[0]},{xy[1]}", "left/0000.jpg:300,250"]
    found = one(dense, click_stddev_px=20.0, distances=[{"ends": picks}])
    place, _ = ray_on(result, 0, xy, level)
    np.testing.assert_allclose(found.points[0], place, atol=1e-6)
    steps = [ray_on(result, 0, xy + 0.5 * s, level)[0] for s in np.eye(2)]
    steps = [
        s - ray_on(result, 0, xy - 0.5 * d, level)[0]
        for s, d in zip(steps, np.eye(2), strict=True)
    ]
    calm = one(dense, click_stddev_px=0.01, distances=[{"ends": picks}])
    expected = 20.0 * math.sqrt(sum(float(s @ s) for s in steps))
    added = found.places_stddev[0] ** 2 - calm.places_stddev[0] ** 2
    assert math.sqrt(added) == pytest.approx(expected, rel=0.005)
    assert calm.places_stddev[0] < 0.2 * expected
    assert found.spots[0].how.startswith("clicked in one image, at the depth of dense/")
    reach = numbers(found.spots[0].how)[-1]
    spacing = 0.01 / np.linalg.norm(steps[0])
    assert 1.2 * spacing < reach < 3.5 * spacing  # twelve of a grid of so many pixels


def test_a_place_of_a_cloud_is_no_better_than_the_cloud_states(result, tmp_path):
    """50 mm along the sight are far more than all else."""
    dense, level = plane_cloud(tmp_path, 0.05, result)
    picks = [[0.0, 0.0, level], [0.1, 0.05, level]]
    found = one(dense, distances=[{"ends": picks}])
    np.testing.assert_allclose(found.points, picks, atol=1e-6)
    # And the poses move a place across it by some millimetres.
    assert found.places_stddev == pytest.approx([0.05, 0.05], rel=0.02)
    assert found.spots[0].moved_by == pytest.approx(0.0, abs=1e-6)
    pixel = one(
        dense,
        click_stddev_px=0.01,
        distances=[{"ends": ["left/0000.jpg:420,310", "left/0000.jpg:300,250"]}],
    )
    assert pixel.places_stddev == pytest.approx([0.05, 0.05], rel=0.02)
    precise = plane_cloud_of(tmp_path / "precise", 1e-6, result)
    assert one(precise, distances=[{"ends": picks}]).places_stddev.max() < 0.02


def plane_cloud_of(folder, stddev, result):
    folder.mkdir()
    return plane_cloud(folder, stddev, result)[0]


def grid(step=0.01, half=0.2):
    x, y = np.meshgrid(*2 * [np.arange(-half, half + step / 2, step)])
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.0)], axis=1)


def test_a_place_is_the_clouds_up_to_five_spacings():
    surface = Surface(grid(), "a cloud", np.ones(10_000))
    for away, found in ((0.045, True), (0.055, False)):
        if found:
            row, gap = surface.nearest(np.array([0.0, 0.0, 1.0 + away]))
            assert gap == pytest.approx(away) and surface.points[row] == pytest.approx(
                [0.0, 0.0, 1.0], abs=1e-9
            )
        else:
            with pytest.raises(
                InputError, match="is 0.055 m away, the points there 0.01"
            ):
                surface.nearest(np.array([0.0, 0.0, 1.0 + away]))


def seen(result, points, stddev=1e-3):
    """A surface in front of the first left camera, as it sees it."""
    scene = result.model.scene
    world = rigid3.transform(rigid3.inverse(scene.rig_from_world[0]), points)
    return SurfaceImage(
        Surface(world, "a cloud", np.full(len(points), stddev)), scene, 0, 0
    )


@pytest.mark.parametrize(("step", "hidden"), [(0.045, False), (0.055, True)])
def test_what_is_a_twentieth_farther_is_on_something_else(result, step, hidden):
    """A comb, every other row of which is farther away than the rest."""
    comb = grid()
    comb[::2] *= 1.0 + step
    image = seen(result, comb)
    (xy,), _ = result.model.scene.cameras[0].img_from_point([[0.0, 0.0, 1.0]])
    chosen = image._front(tuple(xy))
    far = np.linalg.norm(comb[image.rows[chosen]], axis=1)
    assert bool(np.ptp(far) > 0.04) != hidden


def test_a_patch_has_the_roughness_of_its_points(result):
    """Points 2 mm above and below their plane; the ray meets the plane."""
    rough = grid()
    signs = np.where(np.indices((41, 41)).sum(axis=0) % 2, 1.0, -1.0).ravel()
    rough[:, 2] += 0.002 * signs
    (xy,), _ = result.model.scene.cameras[0].img_from_point([[0.0, 0.0, 1.0]])
    patch = seen(result, rough, 0.003).patch(tuple(xy))
    assert patch.relief == pytest.approx(0.002, rel=0.15)  # the plane fits twelve
    assert patch.stddev == 0.003
    assert np.linalg.norm(patch.sight) == pytest.approx(1.0)
    assert np.linalg.norm(patch.normal) == pytest.approx(1.0)


def test_a_pixel_needs_twelve_points_around_it(result):
    lens = result.model.scene.cameras[0]
    (xy,), _ = lens.img_from_point([[0.0, 0.0, 1.0]])
    sparse = seen(result, grid(0.06))
    with pytest.raises(InputError, match=r"has \d+ points within 24 px of the pixel"):
        sparse.patch(tuple(xy))  # 3 % of 800
    assert CANDIDATES == 36


def test_a_place_is_seen_by_the_images_that_saw_the_points_around(result):
    scene = result.model.scene
    model = Surface(scene.points, "the sparse model")
    camera, frame, xy = views_of(scene, model, scene.points[4])
    mine = scene.point_idx == 4
    saw = set(
        zip(
            scene.camera_idx[mine].tolist(), scene.frame_idx[mine].tolist(), strict=True
        )
    )
    assert saw <= set(zip(camera.tolist(), frame.tolist(), strict=True))
    exact = scene.projections()[0][mine]
    for k in range(len(xy)):
        rows = (scene.camera_idx[mine] == camera[k]) & (
            scene.frame_idx[mine] == frame[k]
        )
        if rows.any():
            np.testing.assert_allclose(xy[k], exact[rows][0], atol=1e-6)
    assert np.all((xy >= 0.0) & (xy <= [800.0, 600.0]))
    # Left of the images nothing sees it, whoever saw its neighbours.
    aside = scene.points[4] + [30.0, 0.0, 0.0]
    assert len(views_of(scene, model, aside)[0]) == 0


def test_a_bar_is_entered_if_its_clicks_are_those_of_the_adjustment(result):
    picks = [clicked(result, point) for point in (0, 4)]
    scene = result.model.scene
    rows = [np.flatnonzero(scene.point_idx == point) for point in (0, 4)]
    both = np.concatenate(rows)
    bars = replace(
        scene,
        points=scene.points[[0, 4]],
        camera_idx=scene.camera_idx[both],
        frame_idx=scene.frame_idx[both],
        point_idx=np.repeat([0, 1], [len(r) for r in rows]),
        xy=scene.projections()[0][both],
    )
    given = replace(result, calibration=replace(result.calibration, bars=bars))
    spotter = Spotter(given, Propagation(result.calibration))

    def task(*ends):
        clicks = [
            PixelPick(tuple(Click.model_validate(c) for c in end))
            if isinstance(end, list)
            else end
            for end in ends
        ]
        return replace(item("scale bar", length_m=0.5).task, picks=tuple(clicks))

    assert spotter.entered(task(*picks))
    other = [dict(click) for click in picks[0]]
    other[0]["xy"] = [other[0]["xy"][0] + 0.5, other[0]["xy"][1]]
    assert not spotter.entered(task(other, picks[1]))
    assert not spotter.entered(task(PointPick(1), picks[1]))
    assert not Spotter(result, Propagation(result.calibration)).entered(task(*picks))
