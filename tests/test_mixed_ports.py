"""Rigs whose cameras look through ports of different kinds, and rigs of one camera."""

from dataclasses import replace

import numpy as np
import pytest
from summary_schema import schema_faults
from test_three_cameras import three_camera_rig

from uwsfm import (
    DomePort,
    FlatPort,
    InputError,
    NoPort,
    calibrate,
    error_budget,
    load_rig,
    verdicts,
)
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.jobs.judgement import housing_warnings
from uwsfm.results.housing import export_housing
from uwsfm.results.summary import budget_summary, housing_summary
from uwsfm.rig.file import dump_rig
from uwsfm.rig.rig import Rig
from uwsfm.simulate import (
    ObservationOptions,
    Perturbation,
    Relief,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.trajectories import rich_motion

DOME = DomePort((0.004, -0.003, 0.012), 0.06, 0.01, 1.49, 1.333)


def mixed_rig() -> Rig:
    """A flat window, a dome, and a lens that was calibrated in the water."""
    flat, second, third = three_camera_rig().cameras
    dome = replace(second, port=DOME, refine_center=True)
    bare = replace(third, port=NoPort())
    return replace(three_camera_rig(), cameras=(flat, dome, bare))


def dive(noise_px: float = 0.0, rig: Rig | None = None, num_points: int = 300):
    return simulate_scene(
        rig or mixed_rig(),
        rich_motion(10),
        Relief(stddev=0.2),
        ObservationOptions(num_points=num_points, noise_px=noise_px),
    )


def test_flat_dome_and_bare_camera_come_back_together():
    simulated = dive()
    start = perturbed(simulated.scene, Perturbation(rotation_stddev_deg=0.5))
    assert start.ports[1].center == (0.0, 0.0, 0.0)
    result = calibrate(start, loss="l2")
    flat, dome, bare = result.scene.ports
    truth = simulated.truth.ports[0]
    # Exact data: what the solver's last step leaves, as with two cameras.
    assert abs(flat.distance - truth.distance) < 1e-9
    np.testing.assert_allclose(flat.normal, truth.normal, atol=1e-9)
    np.testing.assert_allclose(dome.center, DOME.center, atol=1e-9)
    assert dome.radius == DOME.radius and bare == NoPort()


def test_spread_of_a_dome_is_as_predicted_and_at_the_bound():
    """Over dives: errors of the centre against the covariance, and the Cramer-Rao."""
    scaled = []
    for seed in range(8):
        simulated = simulate_scene(
            mixed_rig(),
            rich_motion(10),
            Relief(stddev=0.2),
            ObservationOptions(num_points=300, noise_px=0.4, seed=seed),
        )
        result = calibrate(simulated.scene, loss="l2")
        spread = np.array(result.covariance.cameras[1].center_stddev_m)
        error = np.array(result.scene.ports[1].center) - DOME.center
        scaled.append(error / spread)
        bound = predict_covariance(simulated.truth, 0.4).cameras[1].center_stddev_m
        # The reported one is the larger of two, and sigma is estimated: a few per cent.
        assert np.all(spread > 0.9 * np.array(bound))
        assert np.all(spread < 2.0 * np.array(bound))
    # 24 numbers, correlated by threes: chi^2 of 24 is within [10, 45] 99 % of the time,
    # and the reported deviations are up to 1.4 times the bound.
    assert 5.0 < np.sum(np.square(scaled)) < 45.0


def test_what_is_said_of_a_dome(tmp_path):
    result = calibrate(dive(noise_px=0.4).scene, loss="l2")
    rig = mixed_rig().with_geometry(result.scene.cam_from_rig, result.scene.ports)
    flat, dome, bare = housing_summary(rig, result)
    assert [schema_faults(c, "camera") for c in (flat, dome, bare)] == 3 * [[]]
    assert flat["port"] == "flat" and flat["distance_verdict"] == "determined"
    assert dome["port"] == "dome" and dome["center_verdict"] == "determined"
    assert min(dome["center_stddev_m"]) > 0.0
    assert bare["port"] == "none" and "normal" not in bare
    budget = budget_summary(error_budget(result), result.covariance.scale_stddev)
    rows = {row["if"]: row["cameras"] for row in budget}
    assert np.linalg.norm(rows["dome radius of camera 1"][1]["center_m"]) > 1e-4
    assert rows["water index"][2]["center_m"] == [0.0, 0.0, 0.0]
    assert verdicts(result, ["a", "b", "c"]) == ()
    (told,) = housing_warnings(rig, result)
    assert f"has no port of {rig.cameras[2].name}: lenses without one were" in told

    path = tmp_path / "housing.yaml"
    export_housing(rig, path, result)
    assert "# center: standard deviation" in path.read_text(encoding="utf-8")
    np.testing.assert_allclose(load_rig(path).cameras[1].port.row, dome_row(result))

    few = dive(noise_px=1.0, num_points=25)
    keep = few.scene.frame_idx < 3
    weak = calibrate(few.scene.select(keep)[0], loss="l2")
    assert any("centre of the dome of b is" in v for v in verdicts(weak, list("abc")))


def dome_row(result):
    return result.scene.ports[1].row


def test_rigs_of_any_ports_survive_the_rig_file(tmp_path):
    rig = mixed_rig()
    sea = replace(rig.cameras[1], port=replace(DOME, n_water=1.341))
    rig = replace(rig, cameras=(rig.cameras[0], sea, rig.cameras[2]))
    single = Rig(cameras=(sea,), cam_from_rig=None, baseline_m=None)
    for number, one in enumerate((rig, single)):
        path = tmp_path / f"{number}.yaml"
        dump_rig(one, path)
        back = load_rig(path)
        assert back.baseline_m == one.baseline_m
        np.testing.assert_array_equal(back.cam_from_rig, one.cam_from_rig)
        for new, old in zip(back.cameras, one.cameras, strict=True):
            np.testing.assert_allclose(new.port.row, old.port.row, rtol=1e-15)
            assert new.refine_center == old.refine_center
            assert new.refine_normal == (
                old.refine_normal and isinstance(old.port, FlatPort)
            )


@pytest.mark.parametrize("error", ["virtual_camera", "point_3d"])
def test_errors_of_flat_ports_refuse_others(error):
    with pytest.raises(InputError, match="defined for flat ports, camera 1 has Dome"):
        calibrate(dive().scene, error=error, refine_distances=False)


def test_a_rig_of_one_camera_has_no_baseline():
    camera = mixed_rig().cameras[0]
    with pytest.raises(InputError, match="this one has a single camera"):
        Rig(cameras=(camera,), cam_from_rig=None, baseline_m=0.2)
    with pytest.raises(InputError, match="at least one is needed"):
        Rig(cameras=(), cam_from_rig=None, baseline_m=None)


def test_a_port_that_may_move_leaves_the_scale_of_one_camera_open():
    """Only the glass would not grow with the rest; that is no measure of a dive."""
    flat = mixed_rig().cameras[0]
    single = Rig(cameras=(flat,), cam_from_rig=None, baseline_m=None)
    scene = dive(noise_px=0.3, rig=single).scene
    free = calibrate(scene)
    assert free.covariance.scale_stddev is None
    assert any("scale arbitrary" in verdict for verdict in verdicts(free, ["a"]))
    held = calibrate(scene, refine_distances=False)
    known = calibrate(scene, distance_stddev_m=1e-3)
    for result in (held, known):
        assert result.covariance.scale_stddev is not None
