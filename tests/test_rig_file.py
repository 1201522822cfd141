"""rig.yaml: what is written comes back, and every mistake is one clear sentence."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import IDENTITY, quat_from_rotvec, transform
from uwsfm.models.ports.port import FlatPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.file import dump_rig, load_rig, template
from uwsfm.rig.rig import Rig, RigCamera, camera_from_colmap

DELETE = object()


def _edited(*edits):
    """The template as text, with (key path, value) edits."""
    data = yaml.safe_load(template())
    for keys, value in edits:
        block = data
        *parents, last = keys.split("/")
        for key in parents:
            block = block[int(key) if isinstance(block, list) else key]
        last = int(last) if isinstance(block, list) else last
        if value is DELETE:
            del block[last]
        else:
            block[last] = value
    return yaml.safe_dump(data, sort_keys=False)


def _load(folder, text):
    path = folder / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return load_rig(path)


def _awkward_rig(num_cameras, baseline_only=False):
    """Numbers with all their digits, names that need quotes, all kinds of flags."""
    rng = np.random.default_rng(3)
    cameras, poses = [], []
    for i in range(num_cameras):
        normal = np.array([*rng.normal(0, 0.05, 2), 1.0])
        normal /= np.linalg.norm(normal)
        port = [*normal, *rng.uniform(1e-5, 0.05, 2), 1.0, 1.49, 1.3331]
        params = [700 / 3, 700.1, 320, 240, *rng.normal(0, 1e-5, 4)]
        cameras.append(
            RigCamera(
                name=f"no: {i} ü",
                images=f"dive/00{i}",
                camera=camera_from_colmap("OPENCV", 640, 480, params),
                port=FlatPort.from_params(port),
                refine_normal=i == 0,
                refine_distance=i == 1,
            )
        )
        pose = [*quat_from_rotvec(rng.normal(0, 1, 3)), *rng.normal(0, 0.3, 3)]
        poses.append(pose if i else IDENTITY)
    return Rig(
        cameras=tuple(cameras),
        cam_from_rig=None if baseline_only else np.array(poses),
        baseline_m=float(np.linalg.norm(poses[1][4:])),
        baseline_stddev_m=1e-5 / 3,
    )


@pytest.mark.parametrize("num_cameras,baseline_only", [(3, False), (2, True)])
def test_a_dumped_rig_loads_to_the_same_values(tmp_path, num_cameras, baseline_only):
    rig = _awkward_rig(num_cameras, baseline_only)
    comments = {rig.cameras[1].name: ["distance 0.3 mm: 1 stddev", "second line"]}
    path = tmp_path / "housing.yaml"
    dump_rig(rig, path, "Refined.\n\nBy uwsfm.", comments)
    text = path.read_text(encoding="utf-8")
    assert text.startswith("# Refined.\n#\n# By uwsfm.\nversion: 1\n")
    assert "  # distance 0.3 mm: 1 stddev\n  # second line\n  - name:" in text

    back = load_rig(path)
    assert back.baseline_m == rig.baseline_m
    assert back.baseline_stddev_m == rig.baseline_stddev_m
    if baseline_only:
        assert back.cam_from_rig is None
    else:
        np.testing.assert_array_equal(back.cam_from_rig, rig.cam_from_rig)
    for new, old in zip(back.cameras, rig.cameras, strict=True):
        for field in ("name", "images", "refine_normal", "refine_distance"):
            assert getattr(new, field) == getattr(old, field)
        assert new.camera.todict()["params"] == pytest.approx(old.camera.params, abs=0)
        assert (new.camera.width, new.camera.height) == (640, 480)
        assert new.camera.has_prior_focal_length
        # FlatPort normalises again, which may move the last bit.
        np.testing.assert_array_max_ulp(new.port.params, old.port.params, 2)

    before = path.read_text(encoding="utf-8")
    with pytest.raises(InputError, match="not in the rig: \\['top'\\]"):
        dump_rig(rig, path, comments={"top": ["x"]})
    assert path.read_text(encoding="utf-8") == before


def test_the_template_loads_and_its_two_ways_of_giving_a_lens_agree(tmp_path):
    rig = _load(tmp_path, template())
    left, right = rig.cameras
    assert (left.images, right.images) == ("left", "right")
    np.testing.assert_array_equal(left.camera.params, right.camera.params)
    assert left.port == FlatPort((0, 0, 1), 0.02, 0.01, 1.49, 1.333)
    assert left.refine_normal and left.refine_distance
    # The sign the template explains: a point in front of the right camera.
    assert rig.cam_from_rig is not None
    np.testing.assert_allclose(transform(rig.cam_from_rig[1], [0.2, 0, 1]), [0, 0, 1])
    cameras = rig.refractive_cameras()
    assert all(isinstance(camera, RefractiveCamera) for camera in cameras)
    assert cameras[1].port == right.port


def test_a_rotation_matrix_is_the_quaternion_and_rounding_is_repaired(tmp_path):
    angle = np.deg2rad(10)
    cos, sin = np.cos(angle).round(5).item(), np.sin(angle).round(5).item()
    rows = [[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]
    pose = {"rotation_matrix": rows, "translation_m": [-0.3, 0, "1e-3"]}
    tilt = [0.05, 0, 0.999]
    text = _edited(("cameras/1/cam_from_rig", pose), ("cameras/0/port/normal", tilt))
    # YAML 1.1 takes 1e-3 for text; a user does not.
    rig = _load(tmp_path, text.replace("'1e-3'", "1e-3"))
    expected = [0, np.sin(angle / 2), 0, np.cos(angle / 2), -0.3, 0, 1e-3]
    np.testing.assert_allclose(rig.cam_from_rig[1], expected, atol=1e-5)
    assert np.linalg.norm(rig.cam_from_rig[1, :4]) == pytest.approx(1, abs=1e-15)
    assert np.linalg.norm(rig.cameras[0].port.normal) == pytest.approx(1, abs=1e-15)


def test_with_geometry_carries_an_estimate_and_its_baseline():
    rig = _awkward_rig(2, baseline_only=True)
    poses = [[0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, -0.3, 0.4, 0]]
    ports = [replace(camera.port, distance=0.03) for camera in rig.cameras]
    refined = rig.with_geometry(poses, ports)
    assert refined.baseline_m == 0.5
    assert [camera.port for camera in refined.cameras] == ports
    with pytest.raises(InputError, match="baseline_m is 0.4"):
        replace(refined, baseline_m=0.4)
    with pytest.raises(InputError, match="must be the identity"):
        rig.with_geometry([poses[1], poses[1]], ports)


OPENCV_LENSES = {
    "pinhole": ([], "PINHOLE"),
    "zeros": ([0, 0, 0, 0], "OPENCV"),
    "four": ([-0.1, 0.05, 1e-3, -2e-3], "OPENCV"),
    "five, k3 zero": ([-0.1, 0.05, 1e-3, -2e-3, 0], "OPENCV"),
    "five": ([-0.1, 0.05, 1e-3, -2e-3, 0.02], "FULL_OPENCV"),
    "eight": ([-0.1, 0.05, 1e-3, -2e-3, 0.02, 0.1, -0.03, 0.01], "FULL_OPENCV"),
    "fisheye": ([-0.1, 0.05, 1e-2, -2e-3], "OPENCV_FISHEYE"),
}


@pytest.mark.parametrize("case", OPENCV_LENSES)
@pytest.mark.parametrize("pixel_origin", ["opencv", "colmap"])
def test_an_opencv_calibration_projects_as_opencv_does(tmp_path, case, pixel_origin):
    distortion, model = OPENCV_LENSES[case]
    matrix = [[910.5, 0, 962.25], [0, 912.5, 535.75], [0, 0, 1]]
    edits = {
        "camera_matrix": matrix,
        "distortion": distortion,
        "pixel_origin": pixel_origin,
        "fisheye": case == "fisheye",
    }
    rig = _load(tmp_path, _edited(*((OPENCV + key, edits[key]) for key in edits)))
    camera = rig.cameras[1].camera
    assert camera.model_name == model

    points = np.random.default_rng(5).uniform([-0.5, -0.4, 1], [0.5, 0.4, 2], (50, 3))
    project = cv2.fisheye.projectPoints if case == "fisheye" else cv2.projectPoints
    lens = np.array(matrix, dtype=float), np.array(distortion, dtype=float)
    xy = project(points[:, None], np.zeros(3), np.zeros(3), *lens)[0][:, 0]
    if pixel_origin == "opencv":
        xy += 0.5  # OpenCV -> COLMAP pixel origin
    # cv2 and pycolmap round differently: 1e-9 px of 1000 px.
    np.testing.assert_allclose(camera.img_from_cam(points), xy, atol=1e-9)


LENS, PORT = "cameras/0/intrinsics/", "cameras/1/port/"
OPENCV, POSE = "cameras/1/intrinsics/opencv/", "cameras/1/cam_from_rig/"
FLIPPED = [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]
SHEARED = [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]
THIRD = {**yaml.safe_load(template())["cameras"][0], "name": "up", "images": "up"}

MISTAKES = [
    # keys
    ("colour", 1, "colour: unknown key; the keys here are version, scale, water"),
    (PORT + "distance_mm", 20, "did you mean distance_m (in metres)?"),
    (LENS + "width", 640, "intrinsics.width: unknown key, did you mean width_px"),
    (LENS + "opencv", {}, "cameras[0].intrinsics.model: unknown key; the keys here"),
    (PORT + "refine", DELETE, "cameras[1].port.refine: this key is missing"),
    ("version", 2, "version: must be 1, not 2"),
    # types
    (PORT + "distance_m", "20 mm", "distance_m: must be a number, not '20 mm'"),
    (PORT + "distance_m", None, "distance_m: must be a number, not empty"),
    (PORT + "thickness_m", float("nan"), "must be a finite number, not nan"),
    ("cameras/1/name", 7, "cameras[1].name: must be text"),
    ("cameras/1/name", " ", "cameras[1].name: must be one line of text"),
    ("cameras", {}, "cameras: must be a list"),
    ("water", 1.33, "water: must be a block of keys, not 1.33"),
    (LENS + "width_px", 640.0, "width_px: must be a whole number, not 640.0"),
    (LENS + "width_px", 10**30, "width_px: must be at most 100000"),
    # units, signs, lengths
    (
        PORT + "distance_m",
        20,
        "0.020 (as millimetres) or 0.200 (as centimetres)?",
    ),
    (PORT + "distance_m", -0.02, "-0.02 m is negative"),
    (
        PORT + "thickness_m",
        12.5,
        "are in metres, did you mean 0.0125 (as millimetres) or 0.125 ",
    ),
    (PORT + "normal", [0, 0, -1], "port.normal: points back at the camera"),
    (PORT + "normal", [0, 0, 2], "port.normal: must have length 1, has length 2"),
    (PORT + "normal", [0, 1], "port.normal: needs 3 values, got 2"),
    (PORT + "glass_index", 0.67, "0.67 is not a refractive index"),
    (
        PORT + "type",
        "cube",
        "port.type: must be 'flat', 'dome', 'none' or 'interface', not 'cube'",
    ),
    (PORT + "refine", ["tilt"], "refine[0]: must be 'normal' or 'distance', not 'ti"),
    ("baseline_stddev_m", -0.1, "baseline_stddev_m: must be at least 0, not -0.1"),
    ("baseline_stddev_m", 0.3, "0.3 m should lie between 0 and the baseline, 0.2 m"),
    # lenses
    (LENS + "params", [1400, 960, 540], "OPENCV has 8 params (fx, fy, cx, cy, k1"),
    (LENS + "model", "OPENVC", "model 'OPENVC' is not one of COLMAP's for a port; ch"),
    (LENS + "params/0", 4.2, "fx = 4.2 is not the focal length in pixels"),
    (LENS + "params/1", -1400, "fy = -1400; a focal length is positive"),
    (LENS + "params/2", 1921, "cx = 1921 puts the principal point outside the image"),
    (OPENCV + "camera_matrix/0/1", 0.3, "intrinsics: camera_matrix has a skew of 0.3"),
    (OPENCV + "camera_matrix/2/2", 0, "camera_matrix is not [[fx, 0, cx]"),
    (OPENCV + "distortion", [0.1], "has 0, 4, 5 or 8 values, got 1"),
    (OPENCV + "fisheye", True, "a fisheye calibration has 4 values, got 5"),
    (OPENCV + "pixel_origin", DELETE, "opencv.pixel_origin: this key is missing"),
    # cameras and folders
    ("cameras", [], "cameras: at least one is needed, got none"),
    ("cameras/1/name", "left", "cameras[1].name: 'left' is also the name of cameras["),
    ("cameras/1/images", "left/", "cameras[1].images: 'left' and the folder of"),
    ("cameras/1/images", "left/a", "hold the same images"),
    ("cameras/1/images", "/data", "images: '/data' must be a folder inside the image"),
    ("cameras/1/images", "../data", "must be a folder inside the image directory"),
    ("cameras/1/images", "a\\b", "with forward slashes"),
    # placement
    ("cameras/0/baseline_m", 0.2, "cameras[0].baseline_m: the first camera is the"),
    (
        "cameras/0/cam_from_rig",
        {"rotation_xyzw": [0, 0, 0, 1], "translation_m": [1, 0, 0]},
        "cameras[0].cam_from_rig: is the identity for the first camera",
    ),
    ("cameras/1/cam_from_rig", DELETE, "cameras[1]: needs cam_from_rig or, if only"),
    ("cameras/1/baseline_m", 0.2, "give cam_from_rig or baseline_m, not both"),
    ("cameras/1/baseline_m", 200, "200 m is not a baseline; baselines are in metres"),
    (POSE + "translation_m", [0, 0, 0], "translation_m: a baseline of length zero"),
    (POSE + "translation_m", [-200, 0, 0], "translation_m: 200 m is not a baseline"),
    (POSE + "rotation_xyzw", [0, 0, 0, 2], "rotation_xyzw: must have length 1, has"),
    (POSE + "rotation_wxyz", [1, 0, 0, 0], "did you mean rotation_xyzw (w last)?"),
    (POSE + "rotation_xyzw", DELETE, "needs one of rotation_xyzw and rotation_matrix"),
    (POSE + "rotation_matrix", np.eye(3).tolist(), "needs one of rotation_xyzw and"),
    (POSE + "rotation_matrix", FLIPPED, "is a reflection (determinant -1)"),
    (POSE + "rotation_matrix", SHEARED, "rotation_matrix: is not a rotation"),
]


def _check_sentence(folder, text, fragment):
    with pytest.raises(InputError) as caught:
        _load(folder, text)
    message = str(caught.value)
    assert message.startswith(f"{folder / 'rig.yaml'}: ")
    assert fragment in message
    assert "\n" not in message and "http" not in message and "pydantic" not in message


@pytest.mark.parametrize("keys,value,fragment", MISTAKES)
def test_a_mistake_is_one_sentence_with_its_key(tmp_path, keys, value, fragment):
    _check_sentence(tmp_path, _edited((keys, value)), fragment)


def test_a_bare_baseline_is_for_two_cameras(tmp_path):
    bare = ("cameras/1/cam_from_rig", DELETE), ("cameras/1/baseline_m", 0.25)
    rig = _load(tmp_path, _edited(*bare))
    assert rig.cam_from_rig is None and rig.baseline_m == 0.25
    cameras = yaml.safe_load(_edited(*bare))["cameras"]
    three = _edited(("cameras", [*cameras, THIRD]))
    _check_sentence(tmp_path, three, "cameras[1]: needs cam_from_rig (baseline_m is")


def test_exchanged_indices_of_glass_and_water_are_named(tmp_path):
    text = _edited(("water/refractive_index", 1.5), (PORT + "glass_index", 1.333))
    _check_sentence(tmp_path, text, "are they exchanged? Water has about 1.333")
    oil = _edited(("water/refractive_index", 1.47), (PORT + "glass_index", 1.49))
    assert _load(tmp_path, oil).cameras[0].port.n_water == 1.47


def test_glass_that_bends_light_less_than_water_is_refused(tmp_path):
    thin = _edited((PORT + "glass_index", 1.2))
    _check_sentence(tmp_path, thin, "glass_index: 1.2 is less than the water's 1.3")
    bare = _edited((PORT + "glass_index", 1.2), (PORT + "thickness_m", 0.0))
    assert _load(tmp_path, bare).cameras[1].port.thickness == 0.0


def test_the_first_of_several_problems_is_told_and_the_others_listed(tmp_path):
    edits = [(PORT + "distance_m", 20), (PORT + "type", 3), ("version", "one")]
    others = "must be 1, not 'one' (and 1 more problem in this file: cameras[1].port.ty"
    _check_sentence(tmp_path, _edited(*edits), others)
    # One slip, one problem: the key that is missing for it is not counted.
    slip = (PORT + "distance_m", DELETE), (PORT + "distance_mm", 20)
    with pytest.raises(InputError, match=r"did you mean distance_m \(in metres\)\?$"):
        _load(tmp_path, _edited(*slip))


@pytest.mark.parametrize(
    "text,fragment",
    [
        ("", "is empty instead of keys"),
        ("- a\n- b\n", "holds ['a', 'b'] instead of keys"),
        ("version: 1\nwater: {a: 1\ncameras: [}\n", "line 3: not valid YAML: "),
        ("version: 1\n\twater: 2\n", "spaces, not tabs"),
        ("version: 1\nwater: 2\nversion: 1\n", "line 3: not valid YAML: the key 'vers"),
        ("version: !!python/name:os.system x\n", "line 1: not valid YAML: could not"),
        ("version: 1\x00\n", "not valid YAML: unacceptable character"),
        ("a: &a [*a]\n", "line 1: not valid YAML: too many blocks within blocks"),
        ("a: {{ x }}\n", "line 1: not valid YAML: the value of a is a placeholder"),
        ("b:\n  ? [1, 2]\n  : 3\n", "line 2: not valid YAML: a key of b is a list"),
        ("a: " + "[" * 100_000, "line 1: not valid YAML: exceeded maximum nesting"),
        ("a: !!bool 7\n", "not valid YAML: '7'"),
        ("1: 2\n", "unknown key; the keys here are version"),
    ],
)
def test_text_that_is_not_a_rig_is_one_sentence(tmp_path, text, fragment):
    _check_sentence(tmp_path, text, fragment)


def test_files_that_cannot_be_read_are_one_sentence(tmp_path):
    with pytest.raises(InputError, match=r"absent.yaml: there is no such file$"):
        load_rig(tmp_path / "absent.yaml")
    with pytest.raises(InputError, match="cannot be read: "):
        load_rig(tmp_path)
    (tmp_path / "latin.yaml").write_bytes("# Fl\xfcgel\n".encode("latin-1"))
    with pytest.raises(InputError, match="latin.yaml: is not a text file in UTF-8"):
        load_rig(tmp_path / "latin.yaml")


def test_the_template_needs_none_of_the_heavy_packages():
    code = (
        "import sys; from uwsfm.rig.file import template; template(); "
        "print({'pycolmap', 'numba', 'cv2', 'scipy'} & set(sys.modules))"
    )
    root = Path(__file__).parents[1]
    run = [sys.executable, "-c", code]
    done = subprocess.run(run, cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_lengths_without_a_unit_may_have_any_size(tmp_path):
    """Of one camera whose scale nothing told: its housing is read back all the same."""
    rig = _load(tmp_path, template())
    camera = replace(rig.cameras[0], port=FlatPort(distance=1.3))
    single = Rig(cameras=(camera,), cam_from_rig=None, baseline_m=None)
    path = tmp_path / "housing.yaml"
    dump_rig(single, path, arbitrary_scale=True)
    assert load_rig(path).cameras[0].port.distance == 1.3
    dump_rig(single, path)
    with pytest.raises(InputError, match="did you mean"):
        load_rig(path)


def test_a_port_of_no_known_kind_is_told_by_its_type(tmp_path):
    for value, sentence in (
        ({"type": "sphere", "radius_m": 0.05, "center_m": [0, 0, 0]}, "not 'sphere'"),
        ("none", "port: write {type: none}"),
    ):
        with pytest.raises(InputError, match=sentence):
            _load(tmp_path, _edited(("cameras/0/port", value)))


def test_aliases_that_grow_exponentially_are_refused(tmp_path):
    names = "abcdefghij"
    lines = ["a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    for before, name in zip(names, names[1:], strict=False):
        lines.append(f"{name}: &{name} [{', '.join([f'*{before}'] * 10)}]")
    _check_sentence(tmp_path, "\n".join(lines), "aliases of aliases")


def test_what_is_far_too_long_for_a_rig_is_refused_unread(tmp_path):
    _check_sentence(tmp_path, "# " + "x" * 10_000_000, "has 10.0 MB")


def test_pipes_and_devices_are_not_waited_on(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    for path in (tmp_path / "pipe.yaml", Path("/dev/zero")):
        with pytest.raises(InputError, match=f"{path}: is a pipe or a device"):
            load_rig(path)
