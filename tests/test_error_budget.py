"""Linear propagation of wrong given numbers, against solving again with them."""

from dataclasses import replace

import numpy as np
import pytest

from uwsfm import calibrate, error_budget
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


@pytest.fixture(scope="module")
def optimum():
    options = ObservationOptions(num_points=300, noise_px=0.2, seed=5)
    dive = simulate_scene(sample_rig(), rich_motion(10), Relief(stddev=0.2), options)
    return calibrate(perturbed(dive.scene), loss="l2")


def with_error(scene, name):
    """The scene as it would have been given: the same observations, a wrong number."""
    cameras, rig = [], scene.cam_from_rig.copy()
    for camera in scene.cameras:
        lens, port = camera.lens.copy(), camera.port
        if name.startswith("focal"):
            lens[:2] *= 1.001
        elif name.startswith("principal point"):
            lens[3 if name.endswith("y") else 2] += 1.0
        elif name.startswith("water"):
            port = replace(port, n_water=port.n_water + 0.01)
        elif name.startswith("glass index"):
            port = replace(port, n_glass=port.n_glass + 0.01)
        elif name.startswith("glass thickness"):
            port = replace(port, thickness=port.thickness + 2e-3)
        cameras.append(camera.with_lens(lens).with_port(port))
    if name.startswith("baseline"):
        rig[:, 4:] *= 1.01
    return replace(scene, cameras=tuple(cameras), cam_from_rig=rig)


def test_shifts_are_those_of_solving_again(optimum):
    *rows, total = error_budget(optimum)
    optimum = optimum.scene
    assert len(rows) == 7
    for row in rows:
        again = calibrate(with_error(optimum, row.name), loss="l2").scene
        for shift, old, new in zip(row.shifts, optimum.ports, again.ports, strict=True):
            moved = new.distance - old.distance
            turned = np.array(new.normal) - old.normal
            # What is not linear goes with the square: 5 % of errors this large, and
            # they mix: a pixel of principal point bends 0.2 mm into the distance.
            assert shift.distance_m == pytest.approx(moved, rel=0.06, abs=2e-4)
            gap = np.linalg.norm(turned - shift.normal)
            assert gap < 0.03 * np.linalg.norm(turned) + np.radians(2e-3)
    squares = sum(row.shifts[0].distance_m ** 2 for row in rows)
    assert total.shifts[0].distance_m == pytest.approx(np.sqrt(squares))


def budget_of(scene, **options):
    result = calibrate(scene, loss="l2", **options)
    return {row.name: row.shifts for row in error_budget(result)}


def test_a_wrong_prior_pulls_and_a_refined_number_without_one_does_not(optimum):
    name = "water index +0.01"
    assert budget_of(optimum.scene, refine_water_index=True)[name][0].distance_m == 0.0
    # A prior that cannot give way is a given number.
    how = {"refine_water_index": True, "water_index_stddev": 1e-9}
    stiff = budget_of(optimum.scene, **how)[name][0].distance_m
    held = budget_of(optimum.scene)[name][0].distance_m
    assert stiff == pytest.approx(held, rel=1e-3)


def test_what_is_held_does_not_move_and_what_is_open_is_nan(optimum):
    held = budget_of(optimum.scene, refine_distances=(False, True)).values()
    assert all(left.distance_m == 0.0 for left, _ in held)
    assert any(right.distance_m != 0.0 for _, right in held)
    thin = tuple(
        camera.with_port(replace(camera.port, thickness=0.0))
        for camera in optimum.scene.cameras
    )
    # Nothing but the prior of the baseline gives scale: made so weak, nothing does.
    loose = budget_of(replace(optimum.scene, cameras=thin), baseline_stddev_m=1e9)
    assert np.isnan(loose["focal length +0.1 %"][0].distance_m)
