"""From the images and in all: what a person reads, against the arrays behind it."""

import io
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from dense import small_scene
from given_changes import scaled_accuracy, with_changes
from rich.console import Console

import uwsfm
from uwsfm import calibrate
from uwsfm.calibration.given_errors import given_reach
from uwsfm.calibration.point_placement import placed
from uwsfm.calibration.propagation import Places, Propagation
from uwsfm.calibration.scale import scale_slope
from uwsfm.cli.tables import budget_table, housing_table, result_table
from uwsfm.errors import InputError
from uwsfm.jobs.checks import require_effect
from uwsfm.report.tables import estimates
from uwsfm.report.words import deviation
from uwsfm.results.files import SUMMARY


@pytest.fixture(scope="module")
def summary(dive_result):
    return json.loads((dive_result.out / SUMMARY).read_text())


def test_a_result_is_opened_with_all_it_knew_of_what_was_given(dive_result):
    before = dive_result.result.calibration
    after = uwsfm.open_result(dive_result.out).calibration
    for name in ("covariance", "assumed"):
        ours, theirs = (getattr(c.options.given, name) for c in (before, after))
        assert np.array_equal(ours, theirs)
    assert before.options.given.names == after.options.given.names == ("left", "right")
    ours, theirs = before.covariance.in_all, after.covariance.in_all
    for name in ("border", "given", "frames"):
        assert np.array_equal(getattr(ours, name), getattr(theirs, name))
    assert ours.cameras == theirs.cameras and ours.scale_stddev == theirs.scale_stddev


def test_the_summary_has_both_deviations_as_they_are(dive_result, summary):
    covariance = dive_result.result.calibration.covariance
    for camera, own, total in zip(
        summary["cameras"], covariance.cameras, covariance.in_all.cameras, strict=True
    ):
        assert camera["distance_stddev_m"] == own.distance_stddev_m
        assert camera["distance_stddev_in_all_m"] == total.distance_stddev_m
        assert camera["normal_stddev_in_all_deg"] == total.normal_stddev_deg
        assert total.distance_stddev_m > 1.1 * own.distance_stddev_m
        turned = np.hypot(
            camera["tilt_stddev_in_all_deg"],
            np.sin(np.radians(camera["tilt_deg"]))
            * camera["azimuth_stddev_in_all_deg"],
        )
        assert turned == pytest.approx(total.normal_stddev_deg, rel=1e-6)
        for parts, angle in (
            (camera["tilt_xy_stddev_deg"], own.normal_stddev_deg),
            (camera["tilt_xy_stddev_in_all_deg"], total.normal_stddev_deg),
        ):
            # Two slopes of a normal 2 degrees off the axis: all but 0.1 % of its angle.
            assert np.hypot(*parts) == pytest.approx(angle, rel=3e-3)
            assert max(parts) < 0.95 * angle
    scale = summary["scale"]
    assert scale["relative_stddev"] == covariance.scale_stddev
    assert scale["relative_stddev_in_all"] == covariance.in_all.scale_stddev
    names = [row["if"] for row in summary["error_budget"]]
    assert {"k1 of left", "k1 of right", "k1, all cameras alike"} < set(names)
    assert names[-1] == "all of these together"
    sources = {row["if"]: row["deviation"] for row in summary["error_budget"]}
    assert sources["k1 of left"] == "given" and sources["water index"] == "assumed"
    # Its three lengths weigh the baseline: nothing else gives it.
    assert sources["baseline of right"] in ("assumed", "prior")


def _text(*tables):
    console = Console(width=200, record=True, file=io.StringIO())
    for table in tables:
        console.print(table)
    return console.export_text()


def test_tables_of_the_console_show_them(summary):
    text = _text(housing_table(summary), budget_table(summary), result_table(summary))
    left = summary["cameras"][0]
    both = (left["distance_stddev_m"], left["distance_stddev_in_all_m"])
    own, total = (f"{1e3 * value:.2f}" for value in both)
    row = next(line for line in text.splitlines() if "left" in line and "dist" in line)
    assert re.search(rf"{own}\s*│\s*{total}", row)
    largest = summary["error_budget"][0]
    assert f"{largest['if']} " in text and f"({largest['deviation']})" in text
    assert "of every length in all" in text and "azimuth (deg)" in text


def test_the_report_shows_them(dive_result, summary):
    page = (dive_result.out / "report.html").read_text(encoding="utf-8")
    assert "<h3>Error budget</h3>" in page and "± in all" in page
    left = summary["cameras"][0]
    rows = {(row.group, row.name): row for row in estimates(summary)}
    row = rows["left", "port distance"]
    assert row.stddev == deviation(left["distance_stddev_m"], 1e3)
    assert row.stddev_in_all == deviation(left["distance_stddev_in_all_m"], 1e3)
    for entry in summary["error_budget"]:
        assert f">{entry['if']}<" in page


def test_measurements_move_with_what_was_given_as_they_say():
    """Lengths between points, and clicked ones, by solving again for each number."""
    solved = calibrate(small_scene(5, 40, noise_px=0.1).scene, loss="l2")
    given = scaled_accuracy(solved.scene, 0.02)
    solved = calibrate(solved.scene, loss="l2", given=given)
    part, _ = solved.scene.select(np.isin(solved.scene.point_idx, [3, 11]))
    clicked = replace(part, points=placed(part))

    def lengths(scene):
        again = replace(clicked, cameras=scene.cameras, cam_from_rig=scene.cam_from_rig)
        again = replace(again, rig_from_world=scene.rig_from_world)
        places = np.vstack([scene.points[[5, 17]], placed(again)])
        return np.linalg.norm(places[[0, 2]] - places[[1, 3]], axis=1)

    propagation, reach = Propagation(solved), given_reach(solved)
    places = Places.joined(
        [
            propagation.of_points(np.array([5, 17])),
            propagation.of_rays(clicked, np.full(2, 0.5)),
        ]
    )
    slopes = np.zeros((2, 4, 3))
    for k in range(2):
        along = places.points[2 * k] - places.points[2 * k + 1]
        slopes[k, 2 * k] = along / np.linalg.norm(along)
        slopes[k, 2 * k + 1] = -slopes[k, 2 * k]
    columns = []
    for (camera, slot), stddev in zip(reach.given, reach.stddevs, strict=True):
        ends = []
        for sign in (-1.0, 1.0):
            changes = np.zeros(given.assumed.shape)
            changes[camera, slot] = sign * stddev
            wrong = with_changes(solved.scene, changes)
            ends.append(lengths(calibrate(wrong, loss="l2", given=given).scene))
        columns.append(np.subtract(*ends[::-1]) / (2.0 * stddev))
    jac = np.array(columns).T
    expected = jac @ given.block(reach.given) @ jac.T
    found = propagation.given_covariance(places, slopes)
    # Solves end within 1e-9 of their cost; the baseline's 0.01 % is most of it.
    np.testing.assert_allclose(found, expected, rtol=0.02)


def test_measure_reports_both(dive_result):
    found = uwsfm.measure(
        dive_result.out, {"version": 1, "distances": [{"ends": [1, 5]}]}
    )
    (item,) = found.measurements
    assert item.stddev_in_all > item.stddev
    (entry,) = found.summary["measurements"]
    assert entry["stddev_in_all"] == item.stddev_in_all
    assert "stddev_in_all adds the errors of what was given" in found.summary["stddev"]


def test_a_correlated_prior_of_nothing_is_refused():
    scene = small_scene(4, 25).scene
    given = scaled_accuracy(scene, 1.0, correlated_prior=True)
    with pytest.raises(InputError, match="lens_prior: correlated has no effect"):
        require_effect({"loss": "l2", "given": given})
    require_effect({"loss": "l2", "given": given, "refine_focal": True})


def test_the_scale_of_points_without_a_place_is_not_determined():
    assert np.isnan(scale_slope(np.full((3, 3), np.nan), np.ones((3, 3, 3)))).all()
