"""How well given numbers are known: read from a rig file, refused, written again."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest
import yaml
from given_changes import scaled_accuracy

from uwsfm import calibrate
from uwsfm._base.options import option_named
from uwsfm.calibration.error_budget import with_budget
from uwsfm.calibration.given_accuracy import (
    CameraAccuracy,
    NamedCovariance,
    RigAccuracy,
)
from uwsfm.calibration.parameters import DIRECTION, PRIORS
from uwsfm.calibration.tilt import paper_tilt
from uwsfm.cli.options import numbers_of
from uwsfm.errors import InputError
from uwsfm.models.ports.port import FlatPort
from uwsfm.options.jobs import ReconstructOptions
from uwsfm.residuals import border
from uwsfm.results.housing import export_housing
from uwsfm.rig.file import dump_rig, load_rig, template
from uwsfm.rig.values import ACCURACIES
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion

PRIOR = option_named(ReconstructOptions, "prior")
NAMES = ["left.fx", "left.k1", "right.fx", "right.rotation_z"]
ROOT = np.diag([1.0, 0.01, 2.0, 1e-3]) @ np.linalg.cholesky(
    0.5 * np.eye(4) + 0.5 * np.ones((4, 4))
)
MATRIX = (ROOT @ ROOT.T).tolist()


def _file(folder, shared=None, left=None, right=None):
    data = yaml.safe_load(template())
    if shared is not None:
        data["accuracy"] = shared
    for camera, own in zip(data["cameras"], (left, right), strict=True):
        if own is not None:
            camera["accuracy"] = own
    path = folder / "rig.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False), encoding="utf-8")
    return path


def _stddevs(rig):
    return rig.given_accuracy().stddevs


def test_what_is_given_arrives_and_the_rest_is_assumed(tmp_path):
    shared = {"baseline_m": 2e-3, "water_index": 1e-3}
    left = {
        "focal": 2e-3,
        "principal_point_px": 0.5,
        "distortion": [1e-3, 2e-3, 3e-4, 4e-4],
        "thickness_m": 1e-4,
        "glass_index": 2e-3,
    }
    right = {"normal_deg": 1.0, "distance_m": 1e-3, "rotation_deg": 0.05}
    rig = load_rig(_file(tmp_path, shared, left, right))
    accuracy = rig.given_accuracy()
    stddevs, assumed, lens = accuracy.stddevs, accuracy.assumed, border.FIRST_LENS
    expected = [2.8, 2.8, 0.5, 0.5, 1e-3, 2e-3, 3e-4, 4e-4]
    np.testing.assert_allclose(stddevs[0, lens : lens + 8], expected)
    assert not assumed[0, lens : lens + 8].any() and assumed[1, lens : lens + 8].all()
    assert stddevs[0, border.THICKNESS] == 1e-4 and stddevs[0, 11] == 2e-3
    assert stddevs[1, border.LENGTH] == 2e-3 and stddevs[1, border.WATER_INDEX] == 1e-3
    # An RMS angle is sqrt(2) of one component; a rotation is given per axis.
    np.testing.assert_allclose(
        stddevs[1, border.NORMAL], np.radians(1.0) / np.sqrt(2.0)
    )
    np.testing.assert_allclose(stddevs[1, border.ROTATION], np.radians(0.05))
    direction = np.radians(DIRECTION.accuracy.default())
    np.testing.assert_allclose(stddevs[1, border.DIRECTION], direction)
    assert assumed[1, border.DIRECTION].all()
    # Both ports look into one water.
    size = border.BORDER_SIZE
    both = accuracy.covariance[border.WATER_INDEX, size + border.WATER_INDEX]
    assert both == pytest.approx(1e-6)


def test_a_covariance_replaces_single_deviations_and_may_be_a_file(tmp_path):
    block = {"names": NAMES, "matrix": MATRIX}
    (tmp_path / "c.json").write_text(json.dumps(block), encoding="utf-8")
    np.savez(tmp_path / "c.npz", names=np.array(NAMES), matrix=np.array(MATRIX))
    slots = [(0, 13), (0, 17), (1, 13), (1, 2)]
    for covariance in (block, "c.json", "c.npz"):
        accuracy = load_rig(
            _file(tmp_path, {"covariance": covariance})
        ).given_accuracy()
        np.testing.assert_allclose(accuracy.block(slots), MATRIX, rtol=1e-12)
        assert not accuracy.assumed[tuple(np.transpose(slots))].any()
        # What is not named keeps its default, without correlation to the named.
        assert accuracy.assumed[0, 14] and accuracy.stddevs[0, 14] > 0.0
        assert accuracy.block([(0, 13), (0, 14)])[0, 1] == 0.0


def test_the_covariance_of_a_translation_is_that_of_direction_and_length(tmp_path):
    names = [f"right.translation_{axis}" for axis in "xyz"]
    block = {"names": names, "matrix": np.diag([4e-6, 1e-8, 1e-8]).tolist()}
    stddevs = _stddevs(load_rig(_file(tmp_path, {"covariance": block})))
    # The baseline of the template is 0.2 m along -x.
    assert stddevs[1, border.LENGTH] == pytest.approx(2e-3)
    np.testing.assert_allclose(stddevs[1, border.DIRECTION], 1e-4 / 0.2)


def test_accuracy_survives_the_file(tmp_path):
    covariance = NamedCovariance(names=tuple(NAMES), matrix=np.array(MATRIX))
    rig = sample_rig()
    own = CameraAccuracy(principal_point_px=0.4, thickness_m=1e-4)
    cameras = (replace(rig.cameras[0], accuracy=own), rig.cameras[1])
    for shared in (
        RigAccuracy(exact=True),
        RigAccuracy(baseline_m=1e-3, covariance=covariance, lens_prior="correlated"),
    ):
        before = replace(rig, cameras=cameras, accuracy=shared)
        dump_rig(before, tmp_path / "rig.yaml")
        after = load_rig(tmp_path / "rig.yaml")
        ours, theirs = before.given_accuracy(), after.given_accuracy()
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-9)
        assert np.array_equal(ours.assumed, theirs.assumed)
        assert ours.correlated_prior == theirs.correlated_prior


def test_exact_is_everything_that_has_no_deviation(tmp_path):
    rig = load_rig(_file(tmp_path, "exact", {"distance_m": 1e-3}))
    stddevs = _stddevs(rig)
    assert stddevs[0, border.DISTANCE] == 1e-3
    assert np.count_nonzero(stddevs) == 1


def _with(row, column, value):
    matrix = np.array(MATRIX)
    matrix[row, column] = value
    return {"names": NAMES, "matrix": matrix.tolist()}


def _one(name, variance):
    return {"names": [name], "matrix": [[variance]]}


REFUSED = {
    "cameras[0].accuracy.focal: must be at least 0": {"left": {"focal": -1e-3}},
    "cameras[0].accuracy.focal: must be a finite": {"left": {"focal": float("nan")}},
    "cameras[0].accuracy.focal: 0.5 is no plausible standard deviation; it is given as "
    "a share of the focal length": {"left": {"focal": 0.5}},
    "cameras[1].accuracy.distance_m: 2 is no plausible": {"right": {"distance_m": 2.0}},
    "accuracy.baseline_m: 1.5 is no plausible": {"shared": {"baseline_m": 1.5}},
    "accuracy.distortion[0] is 5, which would move the image corner by 3": {
        "left": {"distortion": [5.0, 0.1, 0.001, 0.001]}
    },
    "camera 'left': accuracy.focal and accuracy.covariance state the accuracy of the "
    "same numbers": {
        "shared": {"covariance": {"names": ["left.fx"], "matrix": [[4.0]]}},
        "left": {"focal": 1e-3},
    },
    "camera 'right': accuracy.rotation_deg and accuracy.covariance": {
        "shared": {"covariance": {"names": ["right.rotation_z"], "matrix": [[1e-6]]}},
        "right": {"rotation_deg": 0.1},
    },
    "accuracy.focl: unknown key, did you mean focal?": {"left": {"focl": 1e-3}},
    "accuracy.distortion has 2 values, its lens model has 4": {
        "left": {"distortion": [0.1, 0.1]}
    },
    "accuracy.baseline_mm: unknown key, did you mean baseline_m": {
        "shared": {"baseline_mm": 1.0}
    },
    "accuracy: must be 'exact'": {"shared": "perfect"},
    "matrix: is not symmetric": {"shared": {"covariance": _with(0, 1, 0.0)}},
    "matrix: is not positive definite": {
        "shared": {"covariance": {"names": NAMES[:2], "matrix": [[1, 2], [2, 1]]}}
    },
    "matrix: the variance of left.fx is not positive": {
        "shared": {"covariance": _with(0, 0, -1.0)}
    },
    "matrix: must be 4 x 4": {
        "shared": {"covariance": {"names": NAMES, "matrix": [[1.0]]}}
    },
    "names: 'left.fx' is there twice": {
        "shared": {"covariance": {"names": 4 * NAMES[:1], "matrix": MATRIX}}
    },
    "'left.k9' is no parameter; those of left are fx": {
        "shared": {"covariance": {"names": ["left.k9"], "matrix": [[1.0]]}}
    },
    "'up.fx' is of no camera of this rig": {
        "shared": {"covariance": {"names": ["up.fx"], "matrix": [[1.0]]}}
    },
    "translation of right needs x, y and z": {
        "shared": {"covariance": {"names": ["right.translation_x"], "matrix": [[1.0]]}}
    },
    # Limits: 0.1 of 1400 px, 45 degrees, and k1 that moves the corner, 0.787 from the
    # centre at unit focal length, by 0.3 of that: 0.3 / 0.787^2.
    "accuracy.covariance: the standard deviation of left.fx is 2000 px, and must be "
    "less than 140;": {"shared": {"covariance": _one("left.fx", 4e6)}},
    "the standard deviation of right.rotation_z is 1000 rad, and must be less than "
    "0.785;": {"shared": {"covariance": _one("right.rotation_z", 1e6)}},
    "the standard deviation of left.k1 is 0.5, and must be less than 0.485;": {
        "shared": {"covariance": _one("left.k1", 0.25)}
    },
    "the standard deviation of right.translation_x is 0.2 m, and must be less than "
    "0.157;": {
        "shared": {
            "covariance": {
                "names": [f"right.translation_{axis}" for axis in "xyz"],
                "matrix": np.diag([0.04, 1e-8, 1e-8]).tolist(),
            }
        }
    },
    "accuracy.lens_prior: correlated needs the accuracy of a lens": {
        "shared": {"lens_prior": "correlated"}
    },
    "none.json: there is no such file": {"shared": {"covariance": "none.json"}},
    "is neither .json nor .npz": {"shared": {"covariance": "rig.yaml"}},
    "broken.json: is damaged, or no JSON file": {
        "shared": {"covariance": "broken.json"}
    },
    "needs the keys names and matrix": {"shared": {"covariance": "other.json"}},
    "is damaged, or no .npz file": {"shared": {"covariance": "pickled.npz"}},
}


@pytest.mark.parametrize("words", REFUSED)
def test_impossible_accuracies_are_refused_in_one_sentence(tmp_path, words):
    (tmp_path / "broken.json").write_text("{", encoding="utf-8")
    (tmp_path / "other.json").write_text("[1, 2]", encoding="utf-8")
    np.savez(tmp_path / "pickled.npz", names=np.array([{}]), matrix=np.eye(1))
    path = _file(tmp_path, **REFUSED[words])
    with pytest.raises(InputError) as error:
        load_rig(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ") and words in text and "\n" not in text


def test_single_accuracies_of_a_lens_make_a_correlated_prior(tmp_path):
    shared = {"lens_prior": "correlated"}
    given = load_rig(_file(tmp_path, shared, {"focal": 2e-3})).given_accuracy()
    lens = border.FIRST_LENS
    block = given.block([(0, lens), (0, lens + 1)])
    assert given.correlated_prior
    np.testing.assert_allclose(block, 2.8**2 * np.array([[1, 0.99], [0.99, 1]]))


def test_a_baseline_is_held_or_corrected_and_not_both():
    accuracy = RigAccuracy(baseline_m=1e-3)
    replace(sample_rig(), accuracy=accuracy)
    with pytest.raises(InputError, match="baseline_stddev_m and accuracy.baseline_m"):
        replace(sample_rig(), baseline_stddev_m=1e-3, accuracy=accuracy)


@pytest.fixture(scope="module")
def solved():
    options = ObservationOptions(num_points=120, noise_px=0.2, seed=2)
    dive = simulate_scene(sample_rig(), rich_motion(6), Relief(stddev=0.2), options)
    given = scaled_accuracy(dive.truth, 0.1)
    return with_budget(calibrate(perturbed(dive.scene), loss="l2", given=given))[0]


def test_estimates_that_no_housing_has_are_read_back_from_a_result(tmp_path, solved):
    """A lens calibrated in the water ends at ports of half a metre: the adjustment may,
    and its own file must be readable. What a person writes is still held against it."""
    rig, path = sample_rig(), tmp_path / "housing.yaml"
    ports = [replace(camera.port, distance=0.536) for camera in rig.cameras]
    rig = rig.with_geometry(rig.cam_from_rig, ports)
    export_housing(rig, path, solved)
    assert load_rig(path).cameras[1].port.distance == 0.536
    dump_rig(rig, path)
    with pytest.raises(InputError, match="0.536 m is not a port distance"):
        load_rig(path)


def test_a_housing_file_says_how_well_its_ports_are_known(tmp_path, solved):
    rig = sample_rig().with_geometry(solved.scene.cam_from_rig, solved.scene.ports)
    path = tmp_path / "housing.yaml"
    export_housing(rig, path, solved)
    known = solved.covariance.in_all.cameras
    for camera, item in zip(load_rig(path).cameras, known, strict=True):
        # Four digits are written.
        assert camera.accuracy.distance_m == pytest.approx(
            item.distance_stddev_m, rel=1e-3
        )
        assert camera.accuracy.normal_deg == pytest.approx(
            item.normal_stddev_deg, rel=1e-3
        )
    text = path.read_text(encoding="utf-8")
    assert "from the images, " in text and "in all: " in text


def test_azimuth_and_tilt_are_the_normal_and_share_its_deviation(solved):
    """The paper's two angles: they make the normal again, and their deviations the RMS
    angle, whose parts they are."""
    covariance = solved.covariance
    for c in range(2):
        port, known = solved.scene.ports[c], paper_tilt(solved, c)
        assert isinstance(port, FlatPort)
        theta, phi = np.radians([known.tilt_deg, known.azimuth_deg])
        rebuilt = [
            np.sin(theta) * np.cos(phi),
            np.sin(theta) * np.sin(phi),
            np.cos(theta),
        ]
        np.testing.assert_allclose(rebuilt, port.normal, atol=1e-12)
        stddev = np.radians(covariance.in_all.cameras[c].normal_stddev_deg)
        assert np.hypot(
            np.radians(known.tilt_stddev_in_all_deg),
            np.sin(theta) * np.radians(known.azimuth_stddev_in_all_deg),
        ) == pytest.approx(stddev, rel=1e-6)
        assert known.tilt_stddev_deg < known.tilt_stddev_in_all_deg
        assert known.azimuth_stddev_deg < known.azimuth_stddev_in_all_deg


def test_every_stated_accuracy_has_a_range_and_every_prior(tmp_path):
    """Or another declaration that refuses it: of distortion, by what it moves."""
    shared = {"baseline_m", "water_index"}
    own = {field.name for field in fields(CameraAccuracy)}
    assert set(ACCURACIES) == own - {"distortion"} | shared
    for prior in PRIORS:
        key = prior.replace("_stddev", "")
        if key == "distortion":
            continue
        most, _ = ACCURACIES[key]
        typed = f"{prior}={0.5 * most}"
        assert numbers_of(PRIOR, [typed]) == {prior: 0.5 * most}
        with pytest.raises(InputError, match=f"--prior {prior}=.*no plausible"):
            numbers_of(PRIOR, [f"{prior}={2.0 * most}"])


def test_a_housing_states_the_rotation_that_was_estimated_and_loads_again(tmp_path):
    """Its covariance was of the rotation before, and would contradict it."""
    covariance = NamedCovariance(names=tuple(NAMES), matrix=np.array(MATRIX))
    rig = replace(sample_rig(), accuracy=RigAccuracy(covariance=covariance))
    options = ObservationOptions(num_points=80, noise_px=0.3)
    dive = simulate_scene(rig, rich_motion(4), Relief(stddev=0.2), options)
    given = rig.given_accuracy()
    result, _ = with_budget(calibrate(dive.scene, loss="l2", given=given))
    export_housing(rig, tmp_path / "housing.yaml", result)
    again = load_rig(tmp_path / "housing.yaml")
    assert again.accuracy.covariance.names == tuple(NAMES[:3])
    found = again.cameras[1].accuracy.rotation_deg
    known = result.covariance.in_all.cameras[1].rotation_stddev_deg
    assert found == pytest.approx(known / np.sqrt(3.0), rel=1e-3)
