"""The interface: a plane between air and water, without glass."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from jacobians import EXAMPLE_CAMERAS, INTERFACES, tilted
from naive import least_time_dir
from summary_schema import schema_faults
from test_three_cameras import three_camera_rig

from uwsfm import (
    FlatPort,
    InputError,
    InterfacePort,
    NoPort,
    RefractiveCamera,
    Status,
    calibrate,
    error_budget,
    load_rig,
    verdicts,
)
from uwsfm.cli.tables import budget_table, housing_table
from uwsfm.report.tables import budget_columns, budget_lines, estimates
from uwsfm.report.words import _port
from uwsfm.results.housing import export_housing
from uwsfm.results.summary import budget_summary, housing_summary
from uwsfm.rig.file import dump_rig
from uwsfm.sfm.refine import refine_scene
from uwsfm.simulate import (
    ObservationOptions,
    Perturbation,
    Relief,
    perturbed,
    simulate_scene,
)
from uwsfm.simulate.trajectories import rich_motion

PORTS = pytest.mark.parametrize("port", INTERFACES.values(), ids=INTERFACES.keys())
LENS = EXAMPLE_CAMERAS[4]


def points_below(port, rng, count=200):
    """Points in the water, (N, 3), up to 40 degrees from the optical axis."""
    depth = port.distance + 10.0 ** rng.uniform(-1.0, 1.0, count)
    across = rng.uniform(-0.8, 0.8, (count, 2)) * depth[:, None]
    points = np.column_stack([across, 1.3 * depth])
    return points[points @ np.array(port.normal) > port.distance + 1e-2]


def without_glass(port, thickness=0.0, n_glass=1.5):
    return FlatPort(
        port.normal, port.distance, thickness, n_glass, port.n_water, port.n_air
    )


@PORTS
def test_a_flat_port_without_glass_is_an_interface(port, rng):
    """Another kernel, and lanes there: pixels to rounding, and so the Jacobians."""
    points = points_below(port, rng)
    ours, theirs = (RefractiveCamera(LENS, p) for p in (port, without_glass(port)))
    xy, jac, valid = ours.img_from_point_with_jac(points)
    expected, other, seen = theirs.img_from_point_with_jac(points)
    np.testing.assert_array_equal(valid, seen)
    assert np.count_nonzero(valid) > 20
    np.testing.assert_allclose(xy[valid], expected[valid], rtol=0.0, atol=1e-9)
    shared = [0, 1, 2, 3, 4, 5, 8]  # point, normal, distance, n_water
    scale = np.abs(other[valid][..., shared]).max(axis=(0, 1))
    gap = np.abs(jac[valid] - other[valid])[..., shared].max(axis=(0, 1))
    assert np.all(gap < 1e-10 * scale)
    assert np.all(jac[valid][..., [6, 7, 9]] == 0.0)  # no glass and no radius
    pixels = rng.uniform([0, 0], [752, 480], (100, 2))
    for one, two in zip(
        ours.ray_from_img(pixels), theirs.ray_from_img(pixels), strict=True
    ):
        np.testing.assert_allclose(one, two, rtol=0.0, atol=1e-12)
    np.testing.assert_array_equal(
        ours.status_from_img(pixels), theirs.status_from_img(pixels)
    )


@PORTS
def test_thin_glass_comes_near_it_in_proportion(port, rng):
    points = points_below(port, rng)
    xy, valid = RefractiveCamera(LENS, port).img_from_point(points)
    gaps = []
    for thickness in (1e-5, 1e-6):
        thin = RefractiveCamera(LENS, without_glass(port, thickness))
        near, seen = thin.img_from_point(points)
        both = valid & seen
        gaps.append(np.abs(near - xy)[both].max())
    assert gaps[1] == pytest.approx(0.1 * gaps[0], rel=0.05)


@PORTS
def test_light_takes_the_path_of_least_time(port, rng):
    camera = RefractiveCamera(LENS, port)
    points = points_below(port, rng, 30)
    xy, valid = camera.img_from_point(points)
    assert np.count_nonzero(valid) > 3
    dirs = LENS.cam_ray_from_img(xy[valid])
    dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
    for point, ray in zip(points[valid], dirs, strict=True):
        # The oracle needs three layers: a film of water of no effect on the path.
        best = least_time_dir(
            point, port.normal, port.distance, 1e-6, port.n_air, *2 * [port.n_water]
        )
        # The pixel is undistorted to 1e-9 or so of its direction.
        np.testing.assert_allclose(ray, best, atol=2e-8)


@PORTS
def test_snell_holds_on_the_plane_and_the_pixel_comes_back(port, rng):
    camera = RefractiveCamera(LENS, port)
    xy = rng.uniform([150, 100], [600, 380], (100, 2))
    origins, dirs = camera.ray_from_img(xy)
    sound = camera.status_from_img(xy) == Status.VALID
    assert np.count_nonzero(sound) > 50
    xy, origins, dirs = xy[sound], origins[sound], dirs[sound]
    normal = np.array(port.normal)
    np.testing.assert_allclose(origins @ normal, port.distance, rtol=1e-12)
    air = origins / np.linalg.norm(origins, axis=1, keepdims=True)
    sines = [np.linalg.norm(np.cross(normal, d), axis=1) for d in (air, dirs)]
    np.testing.assert_allclose(port.n_air * sines[0], port.n_water * sines[1], 1e-9)
    ranges = rng.uniform(0.1, 5.0, (len(xy), 1))
    back, valid = camera.img_from_point(origins + ranges * dirs)
    assert valid.all()
    np.testing.assert_allclose(back, xy, atol=1e-8)


def test_equal_indices_bend_nothing_and_what_is_in_the_air_is_not_seen(rng):
    points = points_below(InterfacePort(), rng)
    straight = RefractiveCamera(LENS, InterfacePort(tilted(5, 20), 0.1, 1.0))
    bare = RefractiveCamera(LENS, NoPort())
    xy, valid = straight.img_from_point(points)
    np.testing.assert_allclose(xy[valid], bare.img_from_point(points)[0][valid], 1e-12)
    above = RefractiveCamera(LENS, InterfacePort(distance=1.0))
    status = above.status_from_point([[0.0, 0.0, 0.9], [0.0, 0.0, -1.0]])
    assert status.tolist() == [Status.IN_AIR_GAP, Status.BEHIND_CAMERA]


def test_what_is_no_interface_is_refused():
    with pytest.raises(InputError, match="InterfacePort normal must point"):
        InterfacePort((0.0, 0.0, -1.0))
    with pytest.raises(InputError, match="InterfacePort distance must not be negative"):
        InterfacePort(distance=-0.1)
    with pytest.raises(InputError, match="an interface has no glass, got 0.01 m"):
        InterfacePort.from_params(FlatPort().params)


def rig_above_water():
    """Three cameras, one of them behind a flat port, two in air above the water."""
    rig = three_camera_rig()
    ports = [InterfacePort(tilted(3, 40), 0.15), InterfacePort(tilted(2, -80), 0.12)]
    cameras = [
        replace(camera, port=port, refine_normal=True, refine_distance=True)
        for camera, port in zip(rig.cameras, ports, strict=False)
    ]
    return replace(rig, cameras=(*cameras, *rig.cameras[2:]))


def simulated(noise_px=0.0):
    options = ObservationOptions(num_points=250, noise_px=noise_px)
    return simulate_scene(
        rig_above_water(), rich_motion(10), Relief(stddev=0.2), options
    )


def test_it_is_simulated_and_refined_as_any_other():
    dive = simulated()
    start = perturbed(dive.scene, Perturbation(rotation_stddev_deg=0.5))
    assert start.ports[0].distance == 0.5 * dive.truth.ports[0].distance
    result = calibrate(start, loss="l2")
    for port, truth in zip(result.scene.ports, dive.truth.ports, strict=True):
        assert type(port) is type(truth)
        # Exact data: what the solver's last step leaves.
        assert abs(port.distance - truth.distance) < 1e-8
        np.testing.assert_allclose(port.normal, truth.normal, atol=1e-8)
    # The paper's error, metres on the plane, refines the normals of held distances.
    paper = calibrate(
        dive.scene, loss="l2", error="virtual_camera", refine_distances=False
    )
    np.testing.assert_allclose(
        paper.scene.ports[0].normal, dive.truth.ports[0].normal, atol=1e-6
    )


def test_what_is_said_of_it(tmp_path):
    result = calibrate(simulated(0.4).scene, loss="l2")
    given = rig_above_water()
    rig = given.with_geometry(result.scene.cam_from_rig, result.scene.ports)
    cameras = housing_summary(rig, result)
    assert [schema_faults(camera, "camera") for camera in cameras] == 3 * [[]]
    first = cameras[0]
    assert first["port"] == "interface" and first["distance_verdict"] == "determined"
    assert "thickness_m" not in first and first["distance_stddev_m"] > 0.0
    budget = error_budget(result)
    scale = result.covariance.scale_stddev
    summary = {
        "cameras": cameras,
        "refined": [],
        "error_budget": budget_summary(budget, scale),
        "scale": {"small_unit": "mm", "unit": "m", "stddev": scale},
    }
    names = [row["if"] for row in summary["error_budget"]]
    glass = [name for name in names if "glass" in name or "thickness" in name]
    assert glass and not any(rig.cameras[0].name in name for name in glass)
    assert housing_table(summary).row_count and budget_table(summary).row_count
    assert len(budget_columns(summary)) == 7
    assert len(budget_lines(summary)) == len(names)
    rows = [row.name for row in estimates(summary) if row.group == first["name"]]
    assert "port distance" in rows and "glass index" not in rows
    assert _port(first, summary).text.startswith("interface of air and water, its")
    assert isinstance(verdicts(result, ["a", "b", "c"]), tuple)
    export_housing(rig, tmp_path / "housing.yaml", result)
    back = load_rig(tmp_path / "housing.yaml")
    for camera, other in zip(back.cameras, rig.cameras, strict=True):
        np.testing.assert_allclose(camera.port.row, other.port.row, rtol=1e-12)


def test_a_rig_file_takes_a_camera_far_above_the_water_and_no_glass(tmp_path):
    rig, path = rig_above_water(), tmp_path / "rig.yaml"
    high = replace(rig.cameras[0], port=InterfacePort(distance=1.6))
    dump_rig(replace(rig, cameras=(high, *rig.cameras[1:])), path)
    assert load_rig(path).cameras[0].port.distance == 1.6
    text = path.read_text().replace("distance_m: 1.6", "distance_m: 1600.0")
    path.write_text(text)
    with pytest.raises(InputError, match="did you mean 1.600 .as millimetres"):
        load_rig(path)
    path.write_text(text.replace("distance_m: 1600.0", "thickness_m: 0.01"))
    with pytest.raises(InputError, match="thickness_m: unknown key"):
        load_rig(path)


def test_the_log_says_that_its_points_are_computed_one_by_one(caplog):
    with caplog.at_level(logging.INFO, logger="uwsfm"):
        refined = refine_scene(simulated(0.3).scene, rig_above_water())
    assert "interface of air and water: this kind of port has no vec" in caplog.text
    assert refined.calibration.summary.converged
