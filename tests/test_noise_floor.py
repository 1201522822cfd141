"""The noise floor: what pairs alone leave, whatever the whole model has wrong."""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import simulated_dive
from test_mixed_ports import mixed_rig

from uwsfm.geometry import rigid3
from uwsfm.sfm.noise_floor import noise_floor
from uwsfm.simulate.rigs import sample_rig

NOISE_PX = 0.4  # of `simulated_dive`


@pytest.fixture(scope="module", params=["flat", "flat, dome, none"])
def dive(request):
    rig = sample_rig() if request.param == "flat" else mixed_rig()
    return simulated_dive(rig, num_points=1500)


def test_the_truth_is_at_its_floor_and_the_floor_is_the_noise(dive):
    """Noise of s px in every coordinate makes gaps of s px; 5 % is three standard
    errors of a few thousand matches whose pairs share images."""
    truth = replace(dive.truth, xy=dive.scene.xy)
    found = noise_floor(truth)
    assert found.num_pairs >= 10 and found.num_matches > 1000
    assert found.floor_px == pytest.approx(NOISE_PX, rel=0.07)
    assert found.model_px == pytest.approx(NOISE_PX, rel=0.05)
    assert found.ratio == pytest.approx(1.0, abs=0.07)


def bent(scene):
    """Frames turned about the vertical more and more, by 2 degrees at the end."""
    turns = np.zeros((scene.num_frames, 6))
    turns[:, 1] = np.radians(np.linspace(0.0, 2.0, scene.num_frames))
    poses = rigid3.perturb(scene.rig_from_world, turns)
    return replace(scene, rig_from_world=poses)


def longer(scene):
    """Focal lengths 5 % too long."""
    stretch = np.ones(len(scene.cameras[0].lens))
    stretch[:2] = 1.05
    cameras = tuple(camera.with_lens(stretch * camera.lens) for camera in scene.cameras)
    return replace(scene, cameras=cameras)


@pytest.mark.parametrize("wrong", [bent, longer])
def test_a_wrong_model_is_above_the_floor_that_stays_where_it_is(wrong):
    dive = simulated_dive(num_points=1500)
    truth = replace(dive.truth, xy=dive.scene.xy)
    found, right = noise_floor(wrong(truth)), noise_floor(truth)
    assert found.ratio > 2.0
    # Within what a pair's own lens cannot make up for.
    assert found.floor_px == pytest.approx(right.floor_px, rel=0.15)


def test_regions_are_where_the_error_is():
    """A radial term that the given lens lacks shows in the corners."""
    dive = simulated_dive(num_points=1500)
    truth = replace(dive.truth, xy=dive.scene.xy)
    size = np.array([truth.cameras[0].width, truth.cameras[0].height])
    middle = truth.xy / size - 0.5
    moved = truth.xy + 12.0 * middle * np.sum(middle**2, axis=1, keepdims=True) * 2.0
    found = noise_floor(replace(truth, xy=moved))
    ratio = found.regions[:, :, 1] / found.regions[:, :, 0]
    assert np.nanmax(ratio[[0, 0, 2, 2], [0, 2, 0, 2]]) > 1.3 * ratio[1, 1]


def test_few_matches_have_no_floor():
    dive = simulated_dive(num_points=60)
    assert noise_floor(dive.scene) is None
