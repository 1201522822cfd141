"""summary.json of a result that was made by hand: every number is where it belongs."""

import math
from dataclasses import replace

import numpy as np
import pytest
from dense import dense_system
from hand_made_result import (
    FRAMES,
    PORTS,
    bars,
    camera_covariance,
    positions,
    result_of,
    small_model,
    with_ports,
)

from uwsfm.calibration.error_budget import BudgetRow, Shift
from uwsfm.calibration.problem import CalibrateOptions
from uwsfm.calibration.tilt import paper_tilt, slope_stddevs_deg, turn_stddevs_deg
from uwsfm.models.ports.port import NoPort
from uwsfm.residuals import border
from uwsfm.results.refined import refined_summary
from uwsfm.results.summary import (
    budget_summary,
    errors_summary,
    housing_summary,
    outside_summary,
    scale_summary,
)
from uwsfm.solver.layout import build_layout


@pytest.fixture(scope="module")
def model():
    return small_model()


@pytest.fixture(scope="module")
def result(model):
    """Ports 23.45 and 31.7 mm away, leaning by (2, -3) and (-1, 4) degrees."""
    return result_of(with_ports(model.scene))


def test_ports_come_with_their_own_numbers(model, result):
    left, right = housing_summary(model.rig, result)
    for entry, port, own, total in (
        (left, PORTS[0], 2.0, 3.0),
        (right, PORTS[1], 4.0, 5.0),
    ):
        assert entry["port"] == "flat"
        assert entry["normal"] == list(port.normal)
        assert entry["distance_m"] == port.distance
        assert entry["thickness_m"] == port.thickness
        assert (entry["glass_index"], entry["water_index"]) == (
            port.n_glass,
            port.n_water,
        )
        # `camera_covariance`: 0.041 degrees and 0.52 mm times a number for each.
        assert entry["normal_stddev_deg"] == pytest.approx(0.041 * own)
        assert entry["normal_stddev_in_all_deg"] == pytest.approx(0.041 * total)
        assert entry["distance_stddev_m"] == pytest.approx(0.00052 * own)
        assert entry["distance_stddev_in_all_m"] == pytest.approx(0.00052 * total)
        assert entry["distance_verdict"] == entry["normal_verdict"] == "determined" or (
            entry is right and entry["normal_verdict"] == "weakly determined"
        )
    assert [left["name"], right["name"]] == ["left", "right"]
    # By the deviation in all: 0.123 degrees, and 0.205 of the right one, from 0.2 on.
    assert left["normal_verdict"] == "determined"
    assert right["normal_verdict"] == "weakly determined"
    for index, entry in enumerate((left, right)):
        own, in_all = slope_stddevs_deg(result, index)
        assert entry["tilt_xy_stddev_deg"] == own
        assert entry["tilt_xy_stddev_in_all_deg"] == in_all
        tilt = paper_tilt(result, index)
        assert entry["azimuth_deg"] == tilt.azimuth_deg
        assert entry["tilt_stddev_in_all_deg"] == tilt.tilt_stddev_in_all_deg


def test_words_and_deviations_of_what_was_held(model, result):
    rig = replace(
        model.rig,
        cameras=(
            replace(model.rig.cameras[0], refine_normal=False),
            replace(model.rig.cameras[1], refine_distance=False),
        ),
    )
    left, right = housing_summary(rig, result)
    assert left["normal_stddev_deg"] is None and left["normal_verdict"] == "held"
    assert left["normal_stddev_in_all_deg"] == pytest.approx(0.123)  # as it was given
    assert left["distance_stddev_m"] == pytest.approx(0.00104)
    assert right["distance_stddev_m"] is None and right["distance_verdict"] == "held"
    assert right["distance_stddev_in_all_m"] == pytest.approx(0.0026)
    assert right["normal_stddev_deg"] == pytest.approx(0.164)


def test_a_distance_that_ran_into_zero_has_no_deviation(model, result):
    zero = camera_covariance(2.0, distance_at_zero=True)
    covariance = result.covariance
    in_all = replace(covariance.in_all, cameras=(zero, covariance.in_all.cameras[1]))
    covariance = replace(
        covariance, cameras=(zero, covariance.cameras[1]), in_all=in_all
    )
    left, right = housing_summary(model.rig, replace(result, covariance=covariance))
    assert left["distance_stddev_m"] is left["distance_stddev_in_all_m"] is None
    assert left["distance_verdict"] == "ran into zero"
    assert right["distance_stddev_m"] == pytest.approx(0.00208)


def test_the_placement_is_the_scenes_and_only_of_the_others(model, result):
    for options, turned in (
        (result.options, result.options.refine_cam_from_rig),
        (CalibrateOptions(refine_cam_from_rig=False), False),
        (CalibrateOptions(refine_cam_from_rig=True), True),
    ):
        entries = housing_summary(model.rig, replace(result, options=options))
        left, right = (entry["cam_from_rig"] for entry in entries)
        pose = result.scene.cam_from_rig[1]
        assert right["rotation_xyzw"] == pose[:4].tolist()
        assert right["translation_m"] == pose[4:].tolist()
        known = (right["rotation_stddev_deg"], *right["translation_stddev_m"])
        expected = 4.0 * np.array([0.0163, 7.1e-5, 8.2e-5, 9.3e-5])
        if turned:
            assert known == pytest.approx(expected)
        else:
            assert known == (None,) * 4
            assert right["turn_xyz_stddev_deg"] == [None] * 3
        assert right["rotation_stddev_in_all_deg"] == pytest.approx(5.0 * 0.0163)
        total = right["translation_stddev_in_all_m"]
        assert total == pytest.approx([5 * 7.1e-5, 5 * 8.2e-5, 5 * 9.3e-5])
        # The first camera is the rig: nothing of it can err.
        assert left["rotation_stddev_deg"] is left["rotation_stddev_in_all_deg"] is None
        assert left["turn_xyz_stddev_in_all_deg"] == [None] * 3
        assert left["translation_stddev_m"] == [None] * 3
        assert left["translation_stddev_in_all_m"] == [None] * 3


def test_a_turn_that_was_refined_has_its_own_deviations(model, result):
    """And one that was held those of what was given, in all alone."""
    columns = result.covariance.border_cols.copy()
    columns[1, border.ROTATION] = 0, 1, 2
    covariance = replace(result.covariance, border_cols=columns)
    for turned in (True, False):
        options = CalibrateOptions(refine_cam_from_rig=turned)
        changed = replace(result, covariance=covariance, options=options)
        own, total = turn_stddevs_deg(changed, 1)
        assert None not in own
        pose = housing_summary(model.rig, changed)[1]["cam_from_rig"]
        assert pose["turn_xyz_stddev_deg"] == (own if turned else [None] * 3)
        assert pose["turn_xyz_stddev_in_all_deg"] == total


def test_how_well_a_lens_was_converted_is_told_as_it_is(model, result):
    camera = model.rig.cameras[0]
    camera = replace(camera, conversion_max_px=0.31, conversion_rms_px=0.042)
    rig = replace(model.rig, cameras=(camera, model.rig.cameras[1]))
    left, right = housing_summary(rig, result)
    assert left["lens_conversion_max_px"] == 0.31
    assert left["lens_conversion_rms_px"] == 0.042
    assert right["lens_conversion_max_px"] is None


def test_a_dome_and_a_bare_camera():
    model = small_model(dome=True)
    result = result_of(model.scene)
    _, right = housing_summary(model.rig, result)
    assert right["port"] == "dome" and right["center_m"] == [0.002, -0.003, 0.004]
    assert right["radius_m"] == 0.05 and right["thickness_m"] == 0.007
    assert right["center_stddev_m"] == pytest.approx([5.6e-5, 1e-4, 1.44e-4])
    assert right["center_stddev_in_all_m"] == pytest.approx([7e-5, 1.25e-4, 1.8e-4])
    assert right["center_verdict"] == "determined"  # 0.23 mm, below 2 % of 50 mm
    held = replace(model.rig.cameras[1], refine_center=False)
    rig = replace(model.rig, cameras=(model.rig.cameras[0], held))
    _, right = housing_summary(rig, result)
    assert right["center_stddev_m"] == [None] * 3
    assert right["center_stddev_in_all_m"] == pytest.approx([7e-5, 1.25e-4, 1.8e-4])
    bare = with_ports(model.scene, (NoPort(), PORTS[1]))
    left, _ = housing_summary(small_model().rig, result_of(bare))
    assert left["port"] == "none" and "distance_m" not in left


def test_errors_are_those_of_the_observations_that_took_part(model, result):
    """Observations off by (3, 4) px, some left out that are off by 100."""
    scene = result.scene
    exact, _ = scene.projections()
    count = scene.num_observations
    xy = exact - [3.0, 4.0]
    used = np.ones(count, dtype=bool)
    used[[2, 5]] = False
    xy[[2, 5]] += 100.0
    xy[::2] += [3.0, 4.0]  # half of them are exact
    found = errors_summary(replace(result, scene=replace(scene, xy=xy), inliers=used))
    off = np.where(np.arange(count) % 2 == 0, 0.0, 5.0)[used]
    assert found["reprojection_mean_px"] == pytest.approx(off.mean(), rel=1e-9)
    rms = math.sqrt(np.mean(off**2))
    assert found["reprojection_rms_px"] == pytest.approx(rms, rel=1e-9)
    assert found["num_observations"] == count - 2 and found["num_invalid"] == 0
    assert found["num_registered_frames"] == FRAMES
    assert found["num_points"] == scene.num_points
    assert (found["sigma_px"], found["solver_iterations"]) == (0.38, 17)
    assert found["solver_converged"] is True
    assert found["solves"][0]["costs"] == (3.0, 2.0)
    behind = scene.points.copy()
    behind[scene.point_idx[0]] = [0.0, 0.0, -50.0]  # nothing can project it
    found = errors_summary(replace(result, scene=replace(scene, points=behind)))
    assert found["num_invalid"] == np.count_nonzero(
        scene.point_idx == scene.point_idx[0]
    )
    assert math.isfinite(found["reprojection_rms_px"])


@pytest.mark.parametrize(
    ("own", "in_all", "expected"),
    [
        (0.013, 0.021, ("determined", 0.013, 0.021, "metre", "mm")),
        # 5 % and 50 % are the limits, of the deviation in all.
        (0.013, 0.045, ("determined", 0.013, 0.045, "metre", "mm")),
        (0.013, 0.055, ("weakly determined", 0.013, 0.055, "metre", "mm")),
        (0.013, 0.45, ("weakly determined", 0.013, 0.45, "metre", "mm")),
        (0.013, 0.55, ("not determined", 0.013, 0.55, "metre", "mm")),
        (math.inf, 0.02, ("not determined", None, None, "metre", "mm")),
        (
            None,
            0.02,
            ("arbitrary", None, None, "scale arbitrary", "1e-3, scale arbitrary"),
        ),
    ],
)
def test_the_scale_is_judged_by_its_deviation_in_all(result, own, in_all, expected):
    covariance = result.covariance
    covariance = replace(
        covariance,
        scale_stddev=own,
        in_all=replace(covariance.in_all, scale_stddev=in_all),
    )
    found = scale_summary(replace(result, covariance=covariance))
    keys = ("verdict", "relative_stddev", "relative_stddev_in_all", "unit")
    assert tuple(found[key] for key in (*keys, "small_unit")) == expected


def test_lengths_and_positions_that_were_given(result):
    names = ("a", "b", "c", "d")
    given = replace(result, lengths=bars(), positions=positions())
    found = outside_summary(given, names)
    assert found["known_lengths"] == [
        {"given_m": 0.5003, "stddev_m": 0.0004, "found_m": 0.4993},
        {"given_m": 2.314, "stddev_m": 0.001, "found_m": 2.354},
    ]
    known = found["positions"]
    assert (known["num_positions"], known["outliers"]) == (4, ["c"])
    # 3, 4 and 12 cm: the one that was left out does not count.
    assert known["rms_miss_m"] == pytest.approx(0.13 / math.sqrt(3.0))
    assert known["scatter"] == 1.5
    assert known["place_stddev_m"] == pytest.approx([0.01, 0.04, 0.09])
    assert known["turn_stddev_deg"] == pytest.approx(math.degrees(0.02))
    assert np.abs(known["turn_axis"]) == pytest.approx([0.0, 1.0, 0.0])
    assert outside_summary(result, names) == {"known_lengths": None, "positions": None}


def shift(k):
    return Shift(
        distance_m=0.001 * k,
        normal=(0.003 * k, 0.004 * k, 0.0),
        center_m=(1e-4 * k, 2e-4 * k, math.nan),
        rotation=(0.0, 0.006 * k, 0.008 * k),
        lens=(0.5 * k, math.inf),
    )


def test_the_budget_has_every_shift_and_its_source():
    rows = [
        BudgetRow(
            name=name,
            amount=amount,
            assumed=assumed,
            prior=prior,
            shifts=(shift(1.0), shift(2.0)),
            scale=scale,
            share=1.0,
        )
        for name, amount, assumed, prior, scale in (
            ("k1 of left", "+0.01", False, False, 0.002),
            ("water index", "+0.005", True, False, math.nan),
            ("baseline", "+1 mm", True, True, 0.004),
            ("all of these together", "", False, False, 0.005),
        )
    ]
    found = budget_summary(rows, 0.01)
    assert [row["if"] for row in found] == [row.name for row in rows]
    assert [row["amount"] for row in found] == [row.amount for row in rows]
    sources = ["given", "assumed", "prior", None]
    assert [row["deviation"] for row in found] == sources
    assert [row["scale"] for row in found] == [0.002, None, 0.004, 0.005]
    first, second = found[0]["cameras"]
    for entry, k in ((first, 1.0), (second, 2.0)):
        assert entry["distance_m"] == 0.001 * k
        assert entry["tilt_deg"] == pytest.approx(math.degrees(0.005 * k))
        assert entry["rotation_deg"] == pytest.approx(math.degrees(0.01 * k))
        assert entry["center_m"] == [1e-4 * k, 2e-4 * k, None]
        assert entry["lens"] == [0.5 * k, None]
    assert [row["scale"] for row in budget_summary(rows, None)] == [None] * 4


def test_what_is_refined_besides_has_its_own_row(model, result):
    """Deviations by one dense matrix: of exact observations, whose neighbours share no
    error, with a noise of 0.38 px and a baseline known to 1 mm."""
    columns = np.full((2, border.BORDER_SIZE), -1, dtype=np.int64)
    columns[0, border.WATER_INDEX] = columns[1, border.WATER_INDEX] = 0
    columns[1, border.LENGTH] = 1
    columns[0, border.FIRST_LENS] = 2
    columns[1, border.FIRST_LENS + 2] = 3
    scene = replace(result.scene, xy=result.scene.projections()[0])
    layout = build_layout(scene, columns)
    jac, _ = dense_system(scene, layout)
    weights = jac.T @ jac / 0.38**2
    first = layout.num_frame_cols
    weights[first + 1, first + 1] += 1.0 / 0.001**2
    known = np.sqrt(np.diag(np.linalg.inv(weights)))[first : first + 4]
    own = np.diag(known**2)
    added = np.diag([1e-8, 2e-8, 3e-8, 4e-8])
    covariance = replace(
        result.covariance,
        border=own,
        border_cols=columns,
        in_all=replace(result.covariance.in_all, border=own + added),
    )
    options = CalibrateOptions(baseline_stddev_m=0.001)
    calibration = replace(result, scene=scene, covariance=covariance, options=options)
    found = refined_summary(model.rig, calibration)
    lens = scene.cameras
    assert [row["name"] for row in found] == [
        "water index",
        "fx of left",
        "baseline of right (m)",
        "cx of right",
    ]
    baseline = float(np.linalg.norm(scene.cam_from_rig[1, 4:]))
    values = [1.341, lens[0].lens[0], baseline, lens[1].lens[2]]
    assert [row["value"] for row in found] == pytest.approx(values)
    order = [0, 2, 1, 3]
    # The dense inverse of a matrix of condition 1e12 keeps four digits or more.
    images = [row["stddev"] for row in found]
    assert images == pytest.approx(known[order], rel=1e-4)
    total = np.array([row["stddev_in_all"] for row in found])
    more = np.diag(added)[order]
    assert total**2 == pytest.approx(np.square(images) + more, rel=1e-9)
    # Halves may have found deviations too small.
    larger = replace(covariance, enlarged={"water index": 2.0, "lens": 3.0})
    found = refined_summary(model.rig, replace(calibration, covariance=larger))
    grown = np.array(images) * [2.0, 3.0, 1.0, 3.0]
    assert [row["stddev"] for row in found] == pytest.approx(grown, rel=1e-9)
    found = refined_summary(
        model.rig, replace(calibration, covariance=replace(covariance, in_all=None))
    )
    assert [row["stddev_in_all"] for row in found] == pytest.approx(images, rel=1e-9)
    assert refined_summary(model.rig, result) == []


def test_two_waters_are_named_by_their_cameras(model, result):
    columns = np.full((2, border.BORDER_SIZE), -1, dtype=np.int64)
    columns[0, border.WATER_INDEX], columns[1, border.WATER_INDEX] = 0, 1
    covariance = replace(
        result.covariance,
        border=np.eye(2) * 1e-8,
        border_cols=columns,
        in_all=replace(result.covariance.in_all, border=np.eye(2) * 4e-8),
    )
    found = refined_summary(model.rig, replace(result, covariance=covariance))
    assert [(row["name"], row["value"]) for row in found] == [
        ("water index at left", 1.341),
        ("water index at right", 1.342),
    ]
