"""Linear propagation of wrong given numbers, against solving again with them."""

import io
from dataclasses import replace

import numpy as np
import pytest
from given_changes import scaled_accuracy, with_changes
from rich.console import Console
from test_mixed_ports import dive as mixed_dive

from uwsfm import calibrate, error_budget
from uwsfm.calibration.error_budget import TOGETHER, with_budget
from uwsfm.calibration.given_errors import given_reach, in_all
from uwsfm.calibration.given_items import given_items
from uwsfm.cli.tables import budget_table
from uwsfm.jobs.judgement import housing_warnings
from uwsfm.report.tables import budget_lines, lengths_note
from uwsfm.residuals import border
from uwsfm.results.summary import budget_summary, housing_summary, scale_summary
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion

SMALL = 0.05
"""Of the assumed deviations: what is not linear goes with the square of it."""

HELD = {
    "housing free": {},
    "rig held": {"refine_cam_from_rig": False},
    "ports held": {"refine_distances": False, "refine_normals": (False, True)},
    "lens free with priors": {
        "refine_focal": True,
        "focal_stddev": 5e-4,
        "refine_cam_from_rig": False,
    },
}


@pytest.fixture(scope="module")
def optimum():
    options = ObservationOptions(num_points=150, noise_px=0.1, seed=5)
    dive = simulate_scene(sample_rig(), rich_motion(8), Relief(stddev=0.2), options)
    return calibrate(perturbed(dive.scene), loss="l2").scene


def solved(scene, known=None, **options):
    given = scaled_accuracy(scene, SMALL)
    return calibrate(scene, known=known, loss="l2", given=given, **options)


def scale_of(scene, reference):
    """Factor that fits all distances between points, by brute force over pairs."""
    ok = np.isfinite(scene.points).all(axis=1) & np.isfinite(reference.points).all(1)
    ours, theirs = (
        s.points[ok] - s.points[ok].mean(axis=0) for s in (scene, reference)
    )
    distances = [np.linalg.norm(p[:, None] - p, axis=-1) for p in (ours, theirs)]
    return np.sum(distances[0] * distances[1]) / np.sum(distances[1] ** 2) - 1.0


@pytest.mark.parametrize("case", HELD)
def test_rows_are_those_of_solving_again(optimum, case):
    result = solved(optimum, **HELD[case])
    reach = given_reach(result)
    rows = {row.name: row for row in error_budget(result, reach)}
    items = list(given_items(reach, result.scene.ports))
    assert len(items) >= 22
    for item in items:
        shape = reach.accuracy.assumed.shape
        changes = np.zeros(shape)
        changes[tuple(reach.given.T)] = item.changes
        name = f"{item.what} of {item.camera}"
        if item.what == "water index":  # cameras in one water share it
            if item.camera != "left":
                continue
            name, changes[1] = "water index", changes[0]
        wrong = with_changes(optimum, changes)
        # A prior is around what was given; the start is the same.
        again = solved(
            optimum if item.prior else wrong,
            wrong if item.prior else None,
            **HELD[case],
        ).scene
        row = rows[name]
        for c, shift in enumerate(row.shifts):
            old, new = result.scene.ports[c], again.ports[c]
            if result.covariance.border_cols[c, 8] != -1:
                # Solves end within 1e-9 of their cost: a few microns of distance.
                assert shift.distance_m == pytest.approx(
                    new.distance - old.distance, rel=0.03, abs=1e-5
                )
            if result.covariance.border_cols[c, 6] != -1:
                turned = np.subtract(new.normal, old.normal)
                assert np.linalg.norm(turned - shift.normal) < (
                    0.03 * np.linalg.norm(turned) + np.radians(5e-4)
                )


def test_a_rotation_that_is_held_and_wrong_turns_the_normals_as_its_row_says(optimum):
    """0.1 degrees about the optical axis, of one pair and of eight frames."""
    given = scaled_accuracy(optimum, 1.0)
    hold = {"refine_cam_from_rig": False, "refine_distances": False}
    pair, _ = optimum.select(optimum.frame_idx == 0)
    sizes = []
    for scene in (pair, optimum):
        result = calibrate(scene, loss="l2", given=given, **hold)
        rows = {row.name: row for row in error_budget(result)}
        row = rows["cam_from_rig turned about z of right"]
        assert row.amount == "+0.1 deg" and row.assumed
        changes = np.zeros((2, 25))
        changes[1, 2] = np.radians(0.1)
        again = calibrate(with_changes(scene, changes), loss="l2", given=given, **hold)
        for shift, old, new in zip(
            row.shifts, result.scene.ports, again.scene.ports, strict=True
        ):
            turned = np.degrees(np.subtract(new.normal, old.normal))
            # 1.5 degrees bend a little: of a pair 0.03, as the square.
            gap = np.linalg.norm(np.degrees(shift.normal) - turned)
            assert gap < 0.06 * np.linalg.norm(turned) + 2e-3
        sizes.append(row.shifts[0].tilt_deg)
        assert rows[TOGETHER].shifts[0].tilt_deg > row.shifts[0].tilt_deg
    assert sizes[0] > 3.0 * sizes[1]  # one pair has little to set against it


def test_all_together_is_the_joint_covariance_of_solving_again(optimum):
    """J C J^T with J by solving again, slot by slot: no linearisation of ours."""
    options = {"refine_cam_from_rig": False}
    result = solved(optimum, **options)
    reach = given_reach(result)
    columns = []
    for camera, slot in reach.given:
        step = reach.accuracy.stddevs[camera, slot]
        both = []
        for sign in (-1.0, 1.0):
            changes = np.zeros(reach.accuracy.assumed.shape)
            changes[camera, slot] = sign * step
            scene = solved(with_changes(optimum, changes), **options).scene
            ports = scene.ports
            both.append([*[p.distance for p in ports], scale_of(scene, result.scene)])
        columns.append(np.subtract(both[1], both[0]) / (2.0 * step))
    jac = np.array(columns).T
    stddevs = np.sqrt(np.diag(jac @ reach.accuracy.block(reach.given) @ jac.T))
    *rows, total = error_budget(result, reach)
    assert [s.distance_m for s in total.shifts] == pytest.approx(stddevs[:2], rel=0.01)
    # The pairs here have equal weights, those of the scale more for the well known.
    assert total.scale == pytest.approx(stddevs[2], rel=0.1)
    # Errors that compensate do not add up: k1 against k2, fx against fy.
    single = [row for row in rows if "alike" not in row.name]
    squares = sum(row.shifts[0].distance_m ** 2 for row in single)
    assert total.shifts[0].distance_m < 0.8 * np.sqrt(squares)


def test_rows_are_sorted_and_say_what_was_assumed(optimum):
    result = solved(optimum)
    *rows, total = error_budget(result)
    assert total.name == TOGETHER
    shares = [row.share for row in rows]
    assert shares == sorted(shares, reverse=True)
    names = {row.name for row in rows}
    for name in ("focal length", "fx", "cx", "k1", "p2", "glass thickness"):
        assert {f"{name} of left", f"{name} of right"} < names
        assert f"{name}, all cameras alike" in names
    assert {"water index", "baseline of right"} < names
    assert all(row.assumed and not row.prior for row in rows)


def test_rows_are_sorted_by_what_tables_show(optimum):
    """Distances and lengths here, each in its deviation in all; no turn of the rig."""
    result, budget = with_budget(solved(optimum, refine_normals=False))
    in_all = result.covariance.in_all
    columns = result.covariance.border_cols[:, border.DISTANCE]
    for row in budget[:-1]:
        effects = [
            abs(shift.distance_m) / np.sqrt(in_all.border[k, k])
            for shift, k in zip(row.shifts, columns, strict=True)
        ]
        effects.append(abs(row.scale) / in_all.scale_stddev)
        assert row.share == pytest.approx(max(effects), rel=1e-6)


def test_lengths_without_a_unit_have_no_errors(optimum):
    """One camera and nothing that gives scale: not 0.00 %, but none, and why."""
    alone, _ = optimum.select(optimum.camera_idx == 0)
    alone = replace(
        alone, cameras=alone.cameras[:1], cam_from_rig=alone.cam_from_rig[:1]
    )
    result = calibrate(alone, loss="l2")
    assert result.covariance.scale_stddev is None
    rig = sample_rig()
    one = replace(rig, cameras=rig.cameras[:1], cam_from_rig=None, baseline_m=None)
    scale = scale_summary(result)
    rows = budget_summary(error_budget(result), result.covariance.scale_stddev)
    assert {row["scale"] for row in rows} == {None}
    summary = {
        "error_budget": rows,
        "cameras": housing_summary(one, result),
        "scale": scale,
    }
    console = Console(width=150, record=True, file=io.StringIO())
    console.print(budget_table(summary))
    text = console.export_text()
    assert "because the scale is arbitrary" in text and "0.00 %" not in text
    assert lengths_note(summary) and not lengths_note({"scale": {"unit": "metre"}})
    assert all(line.effects[-1] == "-" for line in budget_lines(summary))


def test_in_all_is_the_images_and_the_budget(optimum):
    result = solved(optimum)
    found, budget = with_budget(result)
    total = budget[-1]
    covariance = found.covariance
    for own, both, shift in zip(
        covariance.cameras, covariance.in_all.cameras, total.shifts, strict=True
    ):
        assert both.distance_stddev_m == pytest.approx(
            np.hypot(own.distance_stddev_m, shift.distance_m), rel=1e-9
        )
        assert both.normal_stddev_deg == pytest.approx(
            np.hypot(own.normal_stddev_deg, shift.tilt_deg), rel=1e-9
        )
        assert both.rotation_stddev_deg == pytest.approx(
            np.hypot(own.rotation_stddev_deg, shift.rotation_deg), rel=1e-9
        )
    assert covariance.in_all.scale_stddev == pytest.approx(
        np.hypot(covariance.scale_stddev, total.scale), rel=1e-9
    )


def test_what_is_held_has_the_deviation_it_was_given_with(optimum):
    result = solved(optimum, refine_cam_from_rig=False, refine_distances=(False, True))
    left, right = in_all(result, given_reach(result)).cameras
    stddevs = scaled_accuracy(optimum, SMALL).stddevs
    assert left.distance_stddev_m == pytest.approx(stddevs[0, 8])
    about_axes = np.degrees(np.linalg.norm(stddevs[1, :3]))
    assert right.rotation_stddev_deg == pytest.approx(about_axes)


def test_a_refined_number_without_a_prior_has_no_row(optimum):
    names = {row.name for row in error_budget(solved(optimum, refine_focal=True))}
    assert not any("focal" in name or name.startswith("f") for name in names)


def test_a_stiff_prior_pulls_as_a_given_number(optimum):
    held = {row.name: row for row in error_budget(solved(optimum))}
    amount = 0.002 * SMALL
    how = {"refine_water_index": True, "water_index_stddev": 1e-3 * amount}
    found = {row.name: row for row in error_budget(solved(optimum, **how))}
    row = next(r for name, r in found.items() if name.startswith("water index"))
    assert row.prior and not row.assumed
    expected = 1e-3 * held["water index"].shifts[0].distance_m
    assert row.shifts[0].distance_m == pytest.approx(expected, rel=1e-3)


def test_a_prior_is_told_beside_the_deviations_from_the_images(optimum):
    """It is refined like an observation, and would pass for what the images show."""
    rig = sample_rig()
    for how, words in (({}, None), ({"focal_stddev": 2e-3}, "focal length of left")):
        result = solved(optimum, refine_focal=bool(how), **how)
        notes = housing_warnings(rig, result, error_budget(result))
        told = [note for note in notes if "entered as a prior" in note]
        assert len(told) == (words is not None)
        assert all(words in note and "alike" not in note for note in told)


def test_what_is_open_is_nan(optimum):
    thin = tuple(
        camera.with_port(replace(camera.port, thickness=0.0))
        for camera in optimum.cameras
    )
    # Nothing but the prior of the baseline gives scale: made so weak, nothing does.
    loose = solved(replace(optimum, cameras=thin), baseline_stddev_m=1e9)
    rows = {row.name: row for row in error_budget(loose)}
    assert np.isnan(rows["focal length of left"].shifts[0].distance_m)
    assert np.isnan(rows[TOGETHER].scale)


def test_domes_and_bare_lenses_have_rows_of_their_own():
    """Centre held, then free: radius, centre and indices, against solving again."""
    scene = calibrate(mixed_dive(noise_px=0.1).scene, loss="l2").scene
    for held in (True, False):
        how = {"refine_centers": not held, "refine_distances": not held}
        result = solved(scene, **how)
        reach = given_reach(result)
        rows = {row.name: row for row in error_budget(result, reach)}
        centre = {f"dome centre {axis} of right" for axis in "xyz"}
        assert (centre <= set(rows)) is held
        assert "port distance of left" in rows or not held
        assert not any("glass" in name and "third" in name for name in rows)
        slot = border.CENTER.start if held else border.RADIUS
        name = "dome centre x of right" if held else "dome radius of right"
        changes = np.zeros(reach.accuracy.assumed.shape)
        changes[1, slot] = reach.accuracy.stddevs[1, slot]
        again = solved(with_changes(scene, changes), **how).scene
        left, right, _ = rows[name].shifts
        turned = np.subtract(again.ports[0].normal, result.scene.ports[0].normal)
        assert np.linalg.norm(turned - left.normal) < (
            0.05 * np.linalg.norm(turned) + np.radians(5e-4)
        )
        if not held:
            moved = np.subtract(again.ports[1].center, result.scene.ports[1].center)
            assert np.linalg.norm(moved) > 1e-6
            gap = np.linalg.norm(moved - right.center_m)
            assert gap < 0.05 * np.linalg.norm(moved) + 1e-6
