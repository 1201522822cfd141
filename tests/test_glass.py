"""Thickness and index of the glass: refined through thick windows, else held."""

import json
from dataclasses import replace

import numpy as np
import pytest
from bounds import LEAST, MOST
from sfm_scenes import model_of
from summary_schema import schema_faults

from uwsfm import InputError, NoPort, UwsfmError, calibrate
from uwsfm.calibration.assumed import assumed_accuracy
from uwsfm.calibration.error_budget import with_budget
from uwsfm.calibration.observability import verdicts
from uwsfm.calibration.parameters import GLASS_INDEX, THICKNESS
from uwsfm.calibration.prior_verdicts import prior_verdict
from uwsfm.calibration.solves import _check_bounds
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.jobs.calibrate_housing import calibrate_housing
from uwsfm.jobs.checks import require_effect
from uwsfm.jobs.output_folder import HOUSING_SUMMARY
from uwsfm.residuals import border
from uwsfm.results.files import export_colmap
from uwsfm.rig.file import dump_rig, load_rig
from uwsfm.rig.rig import RigAccuracy
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, paper_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion
from uwsfm.solver.state import State
from uwsfm.trust.shared_numbers import shared_numbers

NOISE_PX, RELIEF = 0.1, Relief(stddev=0.2)
THICK_M, THIN_M = 0.08, 0.005
CASES = {
    # What is refined, what is known of it, and the names in a port.
    "thickness": ({"refine_glass_thickness": True}, THICKNESS, "thickness", 0.008),
    # A plastic nobody knows the name of.
    "index": (
        {"refine_glass_index": True, "glass_index_stddev": 0.1},
        GLASS_INDEX,
        "n_glass",
        0.1,
    ),
}


def dive(thickness, noise_px=NOISE_PX):
    """Wide lenses; ports whose distance a ruler told."""
    rig = paper_rig(thickness=thickness, focal_px=500.0)
    options = ObservationOptions(num_points=150, noise_px=noise_px)
    return simulate_scene(rig, rich_motion(8), RELIEF, options)


@pytest.fixture(scope="module")
def thick():
    return dive(THICK_M)


@pytest.mark.parametrize("case", CASES)
def test_a_thick_window_shows_its_glass(thick, case):
    """The distances are held: they trade against the glass."""
    options, parameter, name, known = CASES[case]
    options = {**options, "refine_distances": False}
    result = calibrate(thick.scene, loss="l2", **options)
    bound = predict_covariance(thick.truth, NOISE_PX, **options)
    assert result.summary.converged
    for c, (port, true) in enumerate(
        zip(result.scene.ports, thick.truth.ports, strict=True)
    ):
        column = result.covariance.border_cols[c, parameter.first]
        stddev = np.sqrt(result.covariance.border[column, column])
        best = np.sqrt(bound.border[column, column])
        assert LEAST * best < stddev < MOST * best
        assert stddev < 0.5 * known  # the images show more than was known
        assert abs(getattr(port, name) - getattr(true, name)) < 3.0 * stddev
        assert prior_verdict(result, parameter, c) == "determined"
    assert "held by the prior" not in " ".join(verdicts(result, ["left", "right"]))


@pytest.mark.parametrize("case", CASES)
def test_errors_have_the_spread_that_the_covariance_promises(thick, case):
    """What is known, and the noise, drawn anew each time."""
    options, parameter, name, known = CASES[case]
    rng, scores = np.random.default_rng(2011), []
    truth = thick.truth
    for _ in range(40):
        noisy = truth.xy + NOISE_PX * rng.normal(size=truth.xy.shape)
        cameras = []
        for camera in truth.cameras:
            value = getattr(camera.port, name) + known * rng.normal()
            cameras.append(camera.with_port(replace(camera.port, **{name: value})))
        start = replace(truth, xy=noisy, cameras=tuple(cameras))
        result = calibrate(
            start,
            loss="l2",
            refine_distances=False,
            **{**options, parameter.prior.field: known},
        )
        for c, (port, true) in enumerate(
            zip(result.scene.ports, truth.ports, strict=True)
        ):
            column = result.covariance.border_cols[c, parameter.first]
            stddev = np.sqrt(result.covariance.border[column, column])
            scores.append((getattr(port, name) - getattr(true, name)) / stddev)
    # 80 scores know their deviation to 8 %; both cameras share some of their errors.
    assert 0.75 < np.sqrt(np.mean(np.square(scores))) < 1.3


@pytest.fixture(scope="module")
def thin():
    options = {"refine_glass_thickness": True, "refine_glass_index": True}
    simulated = dive(THIN_M)
    return with_budget(calibrate(simulated.scene, loss="l2", **options))


def test_thin_glass_is_held_by_the_prior(thin):
    result, budget = thin
    sentences = verdicts(result, ["left", "right"], budget)
    for c, name in enumerate(("left", "right")):
        for parameter in (THICKNESS, GLASS_INDEX):
            column = result.covariance.border_cols[c, parameter.first]
            stddev = np.sqrt(result.covariance.border[column, column])
            # The accuracy that is assumed of what nobody stated: 0.5 mm, and 0.01.
            prior = parameter.accuracy.default(THIN_M)
            assert 0.9 * prior < stddev <= prior * (1.0 + 1e-9)
            assert prior_verdict(result, parameter, c) == "held by the prior"
            told = [
                s
                for s in sentences
                if s.startswith(f"the {parameter.name} of {name} is held")
            ]
            assert len(told) == 1


def test_the_budget_calls_what_was_refined_a_prior(thin):
    _, budget = thin
    rows = [row for row in budget if row.name.startswith("glass")]
    assert len(rows) >= 4 and all(row.prior and not row.assumed for row in rows)
    amounts = {row.name.split(" of ")[0]: row.amount for row in rows}
    assert amounts["glass thickness"].startswith("+0.5")  # a tenth of the estimate
    assert amounts["glass index"] == "+0.01"


def test_the_accuracy_of_the_rig_file_is_the_prior(thick):
    """As information: what one states otherwise is added to, or taken off."""
    stated = assumed_accuracy(thick.truth)
    half = replace(stated, covariance=0.25 * stated.covariance)
    found = []
    for options in (
        {},
        {"given": half},
        {"thickness_stddev_m": 0.5 * THICKNESS.accuracy.default(THICK_M)},
    ):
        covariance = predict_covariance(
            thick.truth, NOISE_PX, refine_glass_thickness=True, **options
        )
        column = covariance.border_cols[0, border.THICKNESS]
        found.append(np.linalg.inv(covariance.border)[column, column])
    prior = THICKNESS.accuracy.default(THICK_M)
    np.testing.assert_allclose(found[1] - found[0], 3.0 / prior**2, rtol=1e-3)
    np.testing.assert_allclose(found[1], found[2], rtol=1e-6)


def test_exact_glass_and_glass_that_is_not_there_are_refused(thick):
    rig = replace(paper_rig(thickness=THICK_M), accuracy=RigAccuracy(exact=True))
    exact = {"given": rig.given_accuracy(), "refine_glass_thickness": True}
    for refuse in (
        lambda: calibrate(thick.scene, **exact),
        lambda: require_effect(exact),
    ):
        with pytest.raises(InputError, match="the glass thickness as exact; give"):
            refuse()
    calibrate(thick.scene, loss="l2", thickness_stddev_m=0.008, **exact)
    with pytest.raises(InputError, match="refine_glass_index needs the joint strategy"):
        calibrate(thick.scene, refine_glass_index=True, strategy="nested")
    with pytest.raises(InputError, match="glass_index_stddev has no effect: the glass"):
        require_effect({"glass_index_stddev": 0.01})
    bare = tuple(camera.with_port(NoPort()) for camera in thick.scene.cameras)
    with pytest.raises(InputError, match="refine_glass_index: no camera is behind"):
        calibrate(replace(thick.scene, cameras=bare), refine_glass_index=True)


def test_glass_that_leaves_its_bounds_ends_in_one_sentence(thin):
    result, _ = thin
    columns = result.covariance.border_cols
    for column, value in ((4, -0.001), (6, 0.9)):
        state = State.from_scene(result.scene)
        ports = state.ports.copy()
        ports[1, column] = value
        with pytest.raises(UwsfmError, match="of camera number 2 came out at") as told:
            _check_bounds(replace(state, ports=ports), columns)
        assert "\n" not in str(told.value) and "give a prior" in str(told.value)


def test_a_job_refines_the_glass_and_writes_what_it_knows(tmp_path):
    options = ObservationOptions(num_points=300, noise_px=0.3)
    simulated = simulate_scene(sample_rig(), rich_motion(8), RELIEF, options)
    rig = nominal_rig(sample_rig())
    export_colmap(model_of(rig, perturbed(simulated.scene)), tmp_path / "sparse")
    dump_rig(rig, tmp_path / "rig.yaml", "a rig")  # which is exact
    calibrate_housing(
        tmp_path / "rig.yaml",
        tmp_path / "sparse",
        tmp_path / "out",
        refine=("glass-thickness",),
        prior={"thickness_stddev_m": 0.001},
    )
    summary = json.loads((tmp_path / "out" / HOUSING_SUMMARY).read_text())
    assert schema_faults(summary) == []
    rows = {row["name"]: row for row in summary["refined"]}
    assert set(rows) == {"glass thickness of left (m)", "glass thickness of right (m)"}
    text = (tmp_path / "out" / "housing.yaml").read_text(encoding="utf-8")
    assert text.count("# glass thickness: standard deviation ") == 2
    back = load_rig(tmp_path / "out" / "housing.yaml")
    for camera in back.cameras:
        row = rows[f"glass thickness of {camera.name} (m)"]
        assert row["verdict"] == "held by the prior"
        assert camera.port.thickness == pytest.approx(row["value"], rel=1e-9)
        stated = camera.accuracy.thickness_m
        assert stated == pytest.approx(row["stddev_in_all"], rel=1e-3)
        assert abs(row["value"] - 0.02) < 3.0 * 0.001


def test_halves_compare_the_glass_too():
    results = []
    for seed in (0, 1):
        options = ObservationOptions(num_points=150, noise_px=NOISE_PX, seed=seed)
        rig = paper_rig(thickness=THICK_M, focal_px=500.0)
        scene = simulate_scene(rig, rich_motion(8), RELIEF, options).scene
        known = {"refine_distances": False, "refine_glass_thickness": True}
        results.append(calibrate(scene, loss="l2", **known))
    found = shared_numbers(results[0], results[1], ["left", "right"])
    rows = [found.numbers[k] for k in found.of(THICKNESS.group)]
    assert [row.name for row in rows] == [
        "glass thickness of left",
        "glass thickness of right",
    ]
    for row, port in zip(rows, results[1].scene.ports, strict=True):
        assert row.unit == "mm" and abs(row.z) < 4.0
        assert row.values[1] == pytest.approx(1e3 * port.thickness)
