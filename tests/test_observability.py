"""What a dive determines, said in words: each sentence from a dive that deserves it."""

from dataclasses import replace

import numpy as np
import pytest

from uwsfm import calibrate, verdicts
from uwsfm.calibration.error_budget import with_budget
from uwsfm.calibration.given_accuracy import CameraAccuracy
from uwsfm.calibration.observability import Geometry, distance_verdict
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import paper_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion, straight_strip

NAMES = ("left", "right")


def dive(poses, relief_m, noise_px=1.0, num_points=500):
    options = ObservationOptions(num_points=num_points, noise_px=noise_px, seed=2)
    return simulate_scene(paper_rig(), poses, Relief(stddev=relief_m), options).scene


def told(scene, **options):
    result = calibrate(perturbed(scene), loss="l2", **options)
    return verdicts(result, NAMES), result


def test_a_good_dive_needs_no_words():
    sentences, _ = told(dive(rich_motion(15), 0.2, noise_px=0.3))
    assert sentences == ()


def test_a_flat_floor_at_constant_altitude_leaves_the_common_distance():
    sentences, result = told(dive(straight_strip(15), 0.0))
    weak = sentences[0]
    assert weak.startswith("the port distances of left and right, moved together, are ")
    assert "by a flat sea floor at constant altitude: standard deviation " in weak
    assert weak.endswith(" mm each; fly at two altitudes")
    # The number is that of either port: they are wrong together.
    said = float(weak.split("deviation ")[1].split(" mm")[0])
    alone = [1e3 * camera.distance_stddev_m for camera in result.covariance.cameras]
    assert said == pytest.approx(np.mean(alone), rel=0.1)
    # Their difference is not among the complaints.
    assert not any("against each other" in sentence for sentence in sentences)


def test_relief_at_constant_altitude_and_few_frames_are_told_apart():
    relief = Geometry.of(dive(straight_strip(15), 0.3))
    assert relief.reason() == ("a rig at constant altitude", "fly at two altitudes")
    flat = Geometry.of(dive(rich_motion(15), 0.0))
    assert flat.reason()[0] == "a flat sea floor"
    few = Geometry.of(dive(rich_motion(3), 0.2))
    assert few.reason() == ("only 3 frames", "add frames")
    # 0.2 m of relief, smooth at the scale of one view, seen from 1.4 to 2.8 m.
    assert 0.03 < few.relief < 0.15 and few.range_spread > 0.15


def test_one_port_refined_is_named():
    options = {"refine_distances": (False, True), "refine_normals": False}
    sentences, _ = told(dive(straight_strip(4), 0.0), **options)
    assert sentences[0].startswith("the port distance of right is ")


def test_a_tilt_that_is_lost_in_noise_is_told():
    scene = dive(rich_motion(2), 0.2, noise_px=4.0, num_points=60)
    sentences, result = told(scene, refine_distances=False)
    for name, camera in zip(NAMES, result.covariance.cameras, strict=True):
        begins = f"the direction of the port of {name} is "
        sentence = next(text for text in sentences if text.startswith(begins))
        assert f"{camera.normal_stddev_deg:.2f} deg" in sentence


def test_numbers_that_replace_each_other_are_named():
    """Behind a long lens all rays are steep: n_w f is seen, and hardly either."""
    options = ObservationOptions(num_points=300, noise_px=0.1, seed=2)
    rig = paper_rig(focal_px=2500.0)
    dived = simulate_scene(rig, rich_motion(15), Relief(stddev=0.2), options)
    sentences, _ = told(dived.scene, refine_focal=True, refine_water_index=True)
    pair = "the water index and the focal length of left can hardly be told apart"
    assert any(text.startswith(pair) for text in sentences)
    sentences, _ = told(dived.scene, refine_focal=True)
    assert not any("told apart" in text for text in sentences)


def test_nothing_is_promised_where_a_direction_is_free():
    scene = dive(rich_motion(6), 0.2, noise_px=0.3)
    thin = tuple(
        camera.with_port(replace(camera.port, thickness=0.0))
        for camera in scene.cameras
    )
    # Without glass nothing but the baseline gives scale, and this prior is none.
    scene = replace(scene, cameras=thin)
    result = calibrate(scene, loss="l2", baseline_stddev_m=1e9)
    assert not result.covariance.determined
    assert "entirely free" in verdicts(result, NAMES)[-1]


def test_a_port_named_alone_has_the_number_and_the_word_of_the_tables():
    """A focal length known to 300 % leaves both distances open, one more than the
    other: the weakest direction is nearly that of left, and holds most of right."""
    rig = sample_rig()
    wild = replace(rig.cameras[0], accuracy=CameraAccuracy(focal=3.0))
    given = replace(rig, cameras=(wild, rig.cameras[1])).given_accuracy()
    options = ObservationOptions(num_points=200, noise_px=0.2, seed=2)
    dived = simulate_scene(rig, rich_motion(8), Relief(stddev=0.2), options)
    result, budget = with_budget(calibrate(dived.scene, loss="l2", given=given))
    sentences = verdicts(result, NAMES, budget)
    judged = result.covariance.judged_cameras
    for c, name in enumerate(NAMES):
        distance = result.scene.ports[c].distance
        word = distance_verdict(distance, judged[c], True)
        begins = f"the port distance of {name} is {word}: standard deviation "
        (sentence,) = [text for text in sentences if text.startswith(begins)]
        said = float(sentence.removeprefix(begins).split(" mm")[0])
        # Printed to a tenth of a millimetre.
        assert said == pytest.approx(1e3 * judged[c].distance_stddev_m, abs=0.051)
