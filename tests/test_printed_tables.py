"""Tables of the terminal: numbers made by hand, printed, and read with their units."""

import math

import pytest
from hand_made import flat_camera, numbers, printed, quantity, summary, unit_in

from uwsfm.cli.console import NO_CAUSE, ProgressBars, console, errors, print_verdict
from uwsfm.cli.tables import (
    BUDGET_ROWS,
    MAX_IMAGE_ROWS,
    batch_table,
    budget_table,
    calibration_table,
    comparison_table,
    housing_table,
    pinhole_table,
    result_table,
    timings_table,
)
from uwsfm.jobs.batch import Outcome
from uwsfm.jobs.evaluate import CameraComparison, Comparison, DomeComparison

MM, DEG = 1e-3, math.pi / 180.0


def named(table):
    """Rows of a table of two columns or more, by their first cell."""
    _, rows = printed(table)
    return {name: rest[0] if len(rest) == 1 else rest for name, *rest in rows}


def si(row):
    """Estimate and deviations of a row of the housing, in metres and radians."""
    _, what, *cells, _ = row
    return [unit_in(what) * float(cell) for cell in cells]


def test_the_housing_is_printed_in_its_units():
    heads, rows = printed(housing_table(summary()))
    assert heads == ["camera", "port", "estimate", "± images", "± in all", "verdict"]
    assert [row[0] for row in rows] == 5 * ["left"] + 5 * ["right"] + 2 * ["nose"] + [
        "air"
    ]
    for first, start in ((0, 2.0), (5, 4.0)):
        of = rows[first : first + 5]
        expected = [
            (start, 0.111 * start, 0.213 * start),
            (-start - 1.0, 0.122 * start, 0.224 * start),
            (-56.31 - start, 1.31 * start, 1.42 * start),
            (3.61 + start, 0.15 * start, 0.26 * start),
        ]
        whats = [row[1].partition(" (")[0] for row in of]
        assert whats == ["tilt x", "tilt y", "azimuth", "tilt", "distance"]
        for row, degrees in zip(of[:4], expected, strict=True):
            # Half a unit of the last digit printed: 2 digits of the azimuth.
            assert si(row) == pytest.approx(
                [DEG * v for v in degrees], abs=0.0051 * DEG
            )
        metres = [0.01 * start + 0.00045, 0.00033 * start, 0.00077 * start]
        assert si(of[4]) == pytest.approx(metres, abs=0.0051 * MM)
        words = [row[-1] for row in of]
        assert words == ["determined", "determined", "", "", "weakly determined"]
    across, deep = rows[10], rows[11]
    assert (across[1], deep[1]) == ("dome centre x, y (mm)", "dome centre z (mm)")
    assert [numbers(cell) for cell in across[2:5]] == [
        [7.0, -14.0],
        [0.13, 0.24],
        [0.46, 0.57],
    ]
    assert [numbers(cell) for cell in deep[2:5]] == [[21.0], [0.35], [0.68]]
    assert across[-1] == deep[-1] == "weakly determined"
    assert rows[12][1:] == ["none", "", "", "", ""]


def test_what_is_not_known_of_a_housing_is_a_dash():
    held = flat_camera(
        "left",
        2.0,
        tilt_xy_stddev_deg=[None, None],
        distance_stddev_m=None,
        azimuth_stddev_in_all_deg=None,
    )
    data = summary(cameras=[held])
    data["scale"]["small_unit"] = "1e-3, scale arbitrary"
    _, rows = printed(housing_table(data))
    assert [row[3] for row in rows] == ["-", "-", "2.620", "0.300", "-"]
    assert rows[2][4] == "-" and rows[4][1] == "distance (1e-3, scale arbitrary)"


def test_the_reconstruction_is_printed():
    cells = named(result_table(summary()))
    assert numbers(cells["frames registered"]) == [37.0, 41.0]
    assert cells["points"] == "5208" and cells["observations"] == "61234"
    assert cells["invalid observations"] == "7"
    assert cells["RMS error of these observations"] == "0.543 px"
    assert cells["before the adjustment"] == "4.567 px"
    assert cells["scale"] == (
        "determined, ± 0.34 % of every length in all (± 0.12 % from the images)"
    )
    assert numbers(cells["positions used"]) == [33.0, 35.0]
    assert cells["they miss the model by"] == "0.0314 m RMS"
    place = cells["± of the model's place"]
    assert place == "0.011, 0.022, 0.033 m; its turn 0.58 deg"
    assert numbers(cells["water index"]) == [1.3402, 0.00031, 0.00052]
    assert cells["baseline of right (m)"] == (
        "0.20233 ± 0.00021 from the images, ± 0.00043 in all"
    )


def test_a_scale_without_a_number_or_withheld_is_a_word():
    for change in (
        {"relative_stddev": None},
        {"relative_stddev_in_all": None},
        {"verdict": "withheld"},
    ):
        data = summary()
        data["scale"] |= change
        word = data["scale"]["verdict"]
        assert named(result_table(data))["scale"] == word


def test_errors_of_a_colmap_model_are_not_taken_for_ours():
    theirs = {"mean_error_of_common_px": 1.234, "refractive_error_of_common_px": 0.321}
    cells = named(result_table(summary(colmap_model=theirs)))
    assert cells["mean error of those that the COLMAP model has"] == "0.321 px"
    assert cells["with the COLMAP model"] == "1.234 px"


def test_a_calibration_is_printed():
    data = summary(
        strategy="nested", error="water_ray", start="given", reprojection_rms_px=0.432
    )
    cells = named(calibration_table(data))
    assert cells["strategy, error"] == "nested, water_ray" and cells["start"] == "given"
    assert numbers(cells["frames, points"]) == [37.0, 5208.0]
    assert cells["observations"] == "61234"
    assert cells["RMS error of these observations"] == "0.432 px"
    assert cells["scale"].startswith("determined, ± 0.34 %")
    assert numbers(cells["fx of left"]) == [1234.5, 1.7, 2.9]


def test_the_error_budget_is_printed():
    heads, rows = printed(budget_table(summary()))
    assert heads == [
        "given",
        "by",
        "left tilt (deg)",
        "left distance (mm)",
        "right tilt (deg)",
        "right distance (mm)",
        "nose centre x, y, z (mm)",
        "lengths (%)",
    ]
    assert [row[0] for row in rows] == [
        "number 0",
        "number 1",
        "number 2",
        "all, correlated (±)",
    ]
    assert [row[1] for row in rows] == [
        "+0.10 mm (given)",
        "+0.11 mm (assumed)",
        "+0.12 mm (prior)",
        "",
    ]
    for row, far in zip(rows, (1.0, 2.0, 3.0, 10.0), strict=True):
        tilts, distances = [row[2], row[4]], [row[3], row[5]]
        for c, (tilt, distance) in enumerate(zip(tilts, distances, strict=True)):
            assert float(tilt) == pytest.approx(0.0123 * far + 0.01 * c, abs=0.0006)
            metres = MM * float(distance)
            assert metres == pytest.approx(-0.000456 * far - 1e-4 * c, abs=6e-6)
        center = [MM * value for value in numbers(row[6])]
        assert center == pytest.approx(
            [0.00011 * far, -0.00022 * far, 0.00033 * far], abs=6e-6
        )
        assert 1e-2 * float(row[7]) == pytest.approx(-0.00123 * far, abs=6e-5)
    # Signs are those of the shifts; the last row has deviations, which have none.
    data = summary()
    for row in data["error_budget"]:
        row["scale"] = 0.0456
    _, rows = printed(budget_table(data))
    assert [row[7] for row in rows] == 3 * ["+4.56"] + ["4.56"]


def test_a_long_budget_is_cut_and_what_is_left_out_is_counted():
    data = summary()
    *few, total = data["error_budget"]
    for extra, number in ((0, BUDGET_ROWS), (2, BUDGET_ROWS + 2)):
        data["error_budget"] = [few[0]] * number + [total]
        _, rows = printed(budget_table(data))
        note = [row[0] for row in rows if row[0].startswith("and ")]
        assert note == ([f"and {extra} smaller ones: see the file"] if extra else [])
        assert len(rows) == BUDGET_ROWS + 1 + len(note)
    assert len(printed(budget_table(data, 4))[1]) == 4 + 1 + 1


def test_lengths_in_an_arbitrary_unit_have_a_note_for_their_dashes():
    data = summary()
    data["scale"] |= {"unit": "scale arbitrary", "small_unit": "1e-3, scale arbitrary"}
    assert "scale is arbitrary" in str(budget_table(data).caption)
    assert budget_table(summary()).caption is None
    for row in data["error_budget"]:
        row["scale"] = None
    heads, rows = printed(budget_table(data))
    assert heads[3] == "left distance (1e-3, scale arbitrary)"
    assert {row[7] for row in rows if len(row) > 7} == {"-"}


def normal(x, y):
    data = flat_camera("", 0.0)["normal"]
    data[:2] = [math.sin(DEG * x), math.sin(DEG * y)]
    return tuple(data)


COMPARISON = Comparison(
    cameras=(
        CameraComparison(
            name="left",
            tilt_error_deg=0.234,
            tilt_stddev_deg=0.345,
            normal=normal(1.5, -2.5),
            true_normal=normal(-3.5, 4.5),
            distance_m=0.02345,
            distance_stddev_m=0.00067,
            true_distance_m=0.02111,
        ),
    ),
    domes=(
        DomeComparison(
            name="nose",
            center_m=(0.004, 0.005, 0.011),
            center_stddev_m=(0.0012, None, 0.0034),
            true_center_m=(0.001, 0.001, 0.009),
        ),
    ),
    num_true_frames=14,
    num_frames=12,
    center_rms_m=0.00123,
    start_center_rms_m=0.00456,
)


def test_an_estimate_is_printed_beside_its_truth():
    heads, rows = printed(comparison_table(COMPARISON))
    assert heads[1:] == ["estimate", "±", "truth", "error"]
    cells = {name: [numbers(cell) for cell in rest] for name, *rest in rows}
    assert cells["left: tilt x, y (deg)"] == [
        [1.5, -2.5],
        [0.345],
        [-3.5, 4.5],
        [0.234],
    ]
    # 23.45 - 21.11 = +2.34
    assert cells["left: distance (mm)"] == [[23.45], [0.67], [21.11], [2.34]]
    # 3 and 4 mm off in x and y: 5 mm; 2 mm in z
    assert cells["nose: centre x, y (mm)"] == [[4.0, 5.0], [1.2], [1.0, 1.0], [5.0]]
    assert cells["nose: centre z (mm)"] == [[11.0], [3.4], [9.0], [2.0]]
    assert cells["frames"] == [[12.0], [], [14.0], []]
    assert cells["rig centres (mm RMS)"][-1] == [1.23]
    assert cells["before the end"][-1] == [4.56]
    assert rows[1][-1] == "+2.34" and rows[2][2] == "1.20, -"


def test_refraction_that_is_left_is_listed_with_the_worst_first():
    def entry(name, start):
        return {
            "name": name,
            "num_points": int(start),
            "rms_px": 0.01 * start,
            "max_px": 0.02 * start,
            "constant_rms_px": 0.03 * start,
            "constant_max_px": 0.04 * start,
        }

    none = {**entry("none", 1.0), "rms_px": None}
    total = {**entry("", 50.0), "num_observations": 777}
    report = {**total, "images": [none, entry("a", 30.0), entry("b", 40.0)]}
    heads, rows = printed(pinhole_table(report))
    assert heads == ["image", "points", "RMS", "max", "one depth: RMS", "max"]
    assert rows == [
        ["b", "40", "0.400", "0.800", "1.200", "1.600"],
        ["a", "30", "0.300", "0.600", "0.900", "1.200"],
        ["none", "1", "-", "0.020", "0.030", "0.040"],
        ["all", "777", "0.500", "1.000", "1.500", "2.000"],
    ]
    for extra in (0, 3):
        many = [entry(f"{k}", 10.0) for k in range(MAX_IMAGE_ROWS + extra)]
        _, rows = printed(pinhole_table({**total, "images": many}))
        note = [row[0] for row in rows if row[0].startswith("and ")]
        assert note == ([f"and {extra} better ones"] if extra else [])
        assert len(rows) == MAX_IMAGE_ROWS + 1 + len(note)


def test_dives_are_printed_with_their_numbers():
    done = Outcome(
        name="bow",
        reason=None,
        seconds=90.0,
        num_frames=44,
        num_registered_frames=41,
        rms_px=0.567,
        verdict="doubtful",
        cause="The port is 3 mm off.",
    )
    failed = Outcome(name="keel", reason="no images", seconds=math.nan)
    heads, rows = printed(batch_table([done, failed]))
    assert heads == ["dive", "result", "verdict", "frames", "RMS (px)", "minutes"]
    assert rows == [
        ["bow", "The port is 3 mm off.", "doubtful", "41 of 44", "0.567", "1.5"],
        ["keel", "failed: no images", "", "", "", "-"],
    ]


def test_shares_of_time_are_of_what_this_run_did():
    data = summary()
    table = timings_table(data["timings_s"], data["steps_of_earlier_runs"])
    _, rows = printed(table)
    # 60.06 + 10.02 = 70.08 s, of which 85.7 and 14.3 %.
    assert rows == [
        ["features", "30.0 s", "earlier run"],
        ["matching", "60.1 s", "86%"],
        ["adjusting", "10.0 s", "14%"],
        ["total", "70.1 s", ""],
    ]
    assert quantity(rows[-1][1]) == pytest.approx(70.08, abs=0.051)
    assert printed(timings_table({"features": 0.0}))[1][0][2] == "0%"


def test_the_verdict_is_printed_with_every_reason_and_cause(capsys):
    data = summary(
        verdict="doubtful",
        reasons=[
            {"severity": "doubtful", "text": "Residuals repeat."},
            {"severity": "does not fit", "text": "[bold] is no markup."},
        ],
        explanations=[{"text": "The baseline is 10 times too long."}],
    )
    print_verdict(data)
    lines = capsys.readouterr().out.splitlines()
    assert [line.rstrip() for line in lines] == [
        "Verdict: doubtful, for 2 reasons.",
        "  doubtful: Residuals repeat.",
        "  does not fit: [bold] is no markup.",
        "  cause: The baseline is 10 times too long.",
    ]
    print_verdict(summary())
    assert capsys.readouterr().out.startswith("Verdict: fits.")


@pytest.mark.parametrize("causes", [None, [], ["Probably the water.", "Or the port."]])
def test_a_verdict_is_printed_with_its_reasons_and_causes(causes):
    """A search that found nothing is told, too; not where nothing was searched for."""
    data = summary(verdict="doubtful", reasons=[])
    for severity, text in (("does not fit", "A is off."), ("doubtful", "B is open.")):
        data["reasons"].append({"severity": severity, "text": text})
    data.pop("explanations")
    if causes is not None:
        data["explanations"] = [{"text": text} for text in causes]
    with console.capture() as captured:
        print_verdict(data)
    first, *lines = captured.get().splitlines()
    assert first == "Verdict: doubtful, for 2 reasons."
    told = [NO_CAUSE] if causes == [] else causes or []
    wanted = ["does not fit: A is off.", "doubtful: B is open."]
    wanted += [f"cause: {text}" for text in told]
    assert [line.rstrip() for line in lines] == [f"  {text}" for text in wanted]


@pytest.mark.parametrize(("spare", "lines"), [(0, 1), (-1, 2)])
def test_reasons_and_causes_take_the_whole_width(spare, lines):
    """Beside two columns on their left."""
    text = (console.width - len("  doubtful: ") - spare) * "x"
    cause = (console.width - len("  cause: ") - spare) * "y"
    data = summary(verdict="doubtful", explanations=[{"text": cause}])
    data["reasons"] = [{"severity": "doubtful", "text": text}]
    with console.capture() as captured:
        print_verdict(data)
    assert captured.get().count("\n") == 1 + 2 * lines


def test_a_result_that_fits_has_no_cause_to_be_told():
    with console.capture() as captured:
        print_verdict(summary(verdict="fits", reasons=[], explanations=[]))
    assert "cause" not in captured.get()


def test_progress_goes_to_standard_error_and_ends_well(monkeypatch):
    """What was written by then is complete; what failed is not."""
    assert errors.stderr and not console.stderr
    ended = []

    class Display:
        def __call__(self, *_):
            pass

        def close(self, *, complete):
            ended.append(complete)

    monkeypatch.setattr("uwsfm.cli.console.display", lambda where: Display())
    with ProgressBars():
        pass
    with pytest.raises(ValueError, match="no"), ProgressBars():
        raise ValueError("no")
    assert ended == [True, False]
