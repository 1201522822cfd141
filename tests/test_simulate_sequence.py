"""Sequences and observation files on disk, and the committed sample."""

import hashlib
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from uwsfm.cli.app import main
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.rig.file import dump_rig, load_rig
from uwsfm.simulate.commands import (
    TRAJECTORIES,
    simulate_images,
    simulate_observations,
)
from uwsfm.simulate.observation_file import read_observations
from uwsfm.simulate.rendering import SensorOptions
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.sea_floor import SeaFloorOptions
from uwsfm.simulate.sequence import (
    SequenceSpec,
    dome_spec,
    frame_names,
    render_sequence,
    rig_header,
    sample_spec,
    truth_of,
)
from uwsfm.simulate.trajectories import rich_motion

SAMPLE = Path(__file__).parent.parent / "datasets" / "sample"

TINY = SequenceSpec(
    rig=sample_rig(image_scale=0.1),
    rig_from_world=rich_motion(2, altitude=1.0, extent=0.3),
    floor=SeaFloorOptions(texel=0.005, mesh_step=0.04, num_boulders=2),
    sensor=SensorOptions(samples_per_side=1, noise=1.0),
    seed=5,
)


@pytest.fixture(scope="module")
def rendered(open3d, tmp_path_factory):
    """The tiny sequence, and what its progress callback was told."""
    out_dir, calls = tmp_path_factory.mktemp("tiny"), []
    render_sequence(TINY, out_dir, lambda *call: calls.append(call))
    return out_dir, calls


def test_a_rendered_sequence_is_complete(rendered):
    out_dir, calls = rendered
    for camera in ("left", "right"):
        for name in frame_names(2):
            image = cv2.imread(str(out_dir / "images" / camera / name))
            assert image.shape == (60, 80, 3)
            assert image.std() > 5
    names = {line.split()[1] for line in (out_dir / "SHA256SUMS").open()}
    assert {"rig.yaml", "truth.json", "images/right/0002.jpg"} < names
    assert calls[-1] == ("rendering", 4, 4)


def test_rendering_again_gives_the_same_bytes(rendered, tmp_path):
    render_sequence(TINY, tmp_path / "again")
    first, second = (
        (folder / "SHA256SUMS").read_text()
        for folder in (rendered[0], tmp_path / "again")
    )
    assert first == second


def test_rig_yaml_is_the_users_start_and_truth_json_the_truth(rendered):
    out_dir, _ = rendered
    start = load_rig(out_dir / "rig.yaml")
    truth = json.loads((out_dir / "truth.json").read_text())
    np.testing.assert_array_equal(start.cam_from_rig, TINY.rig.cam_from_rig)
    assert start.baseline_stddev_m == 0.0
    for given, true, entry in zip(
        start.cameras, TINY.rig.cameras, truth["cameras"], strict=True
    ):
        assert given.port.normal == (0.0, 0.0, 1.0)
        assert given.port.distance == 0.5 * true.port.distance
        assert tuple(entry["normal"]) == true.port.normal
        assert entry["distance_m"] == true.port.distance
        np.testing.assert_array_equal(given.camera.params, true.camera.params)
    assert list(truth["rig_from_world"]) == ["0001.jpg", "0002.jpg"]
    np.testing.assert_array_equal(
        list(truth["rig_from_world"].values()), TINY.rig_from_world
    )


def test_the_head_of_a_rig_file_speaks_of_the_ports_that_it_has(tmp_path):
    dump_rig(
        nominal_rig(dome_spec().rig), tmp_path / "rig.yaml", rig_header(dome_spec().rig)
    )
    words = " ".join(_comments(tmp_path / "rig.yaml"))
    assert "domes assumed centred on their cameras" in words
    assert "straight" not in words and "distance" not in words
    for camera in load_rig(tmp_path / "rig.yaml").cameras:
        assert camera.port.center == (0.0, 0.0, 0.0)  # as it says
    assert "\n".join(_comments(SAMPLE / "rig.yaml")) == rig_header(sample_spec().rig)


def _comments(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line[2:] for line in lines if line.startswith("# ")]


def test_a_folder_in_use_is_never_written_to(tmp_path):
    (tmp_path / "mine.txt").write_text("kept")
    with pytest.raises(InputError, match="not an empty folder"):
        render_sequence(TINY, tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "kept"


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"preset": "smaple"}, "smaple.*sample, small"),
        ({"num_frames": 99}, "1 to 14 frames, got 99"),
        ({"jpeg_quality": 0}, "jpeg_quality"),
    ],
)
def test_wrong_image_options_are_refused(tmp_path, options, words):
    with pytest.raises(InputError, match=words):
        simulate_images(tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_small_preset_renders_the_first_frames(open3d, tmp_path):
    spec = simulate_images(tmp_path / "out", preset="small", num_frames=1, seed=9)
    assert spec.floor.seed == spec.floor.relief.seed == 9
    image = cv2.imread(str(tmp_path / "out" / "images" / "right" / "0001.jpg"))
    assert image.shape == (300, 400, 3)
    sift = cv2.SIFT_create(contrastThreshold=0.02)
    keypoints = sift.detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    assert len(keypoints) > 400
    cells = np.array([k.pt for k in keypoints]) // 100
    assert len(np.unique(cells, axis=0)) == 12  # all of 4 x 3: well spread


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_observation_files_come_back_as_they_were(tmp_path, trajectory):
    path = tmp_path / "dive.npz"
    written = simulate_observations(
        path, trajectory=trajectory, num_frames=7, num_points=60, outlier_ratio=0.1
    )
    read = read_observations(path)
    for a, b in ((written.scene, read.scene), (written.truth, read.truth)):
        assert b.num_frames == 7
        for name in ("xy", "points", "camera_idx", "frame_idx", "point_idx"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        np.testing.assert_allclose(a.rig_from_world, b.rig_from_world, atol=1e-15)
        assert a.ports == b.ports
    np.testing.assert_array_equal(written.is_outlier, read.is_outlier)
    assert np.abs(read.truth.residuals()).max() < 1e-9


def test_wrong_observation_options_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"must end in \.npz"):
        simulate_observations(tmp_path / "dive.txt")
    with pytest.raises(InputError, match="rich, strip, lawn-mower"):
        simulate_observations(tmp_path / "dive.npz", trajectory="circle")
    with pytest.raises(InputError, match="positive altitude"):
        simulate_observations(tmp_path / "dive.npz", altitude=-1.0)
    with pytest.raises(InputError, match="at least two frames"):
        simulate_observations(tmp_path / "dive.npz", num_frames=1)
    with pytest.raises(InputError, match=r"nothing\.npz"):
        read_observations(tmp_path / "nothing.npz")


@pytest.mark.parametrize("value", ["nan", "inf", "-1", "1e12"])
@pytest.mark.parametrize(
    "option",
    [
        "frames",
        "altitude-m",
        "relief-m",
        "points",
        "noise-px",
        "outliers",
        "distance-m",
        "thickness-m",
        "focal-px",
        "seed",
    ],
)
def test_absurd_numbers_are_refused_by_the_name_of_their_option(
    tmp_path, monkeypatch, capsys, option, value
):
    arguments = ["simulate", "observations", "-o", str(tmp_path / "dive.npz")]
    monkeypatch.setattr(sys, "argv", ["uwsfm", *arguments, f"--{option}", value])
    with pytest.raises(SystemExit) as end:
        main()
    told = capsys.readouterr().err
    assert end.value.code == 2 and f"--{option}" in told
    # nan is neither too small nor too large.
    assert value != "nan" or "number" in told or "integer" in told
    assert not any(tmp_path.iterdir())


def test_the_committed_sample_is_whole_and_small():
    listed = [line.split("  ") for line in (SAMPLE / "SHA256SUMS").open()]
    for digest, name in listed:
        content = (SAMPLE / name.strip()).read_bytes()
        assert hashlib.sha256(content).hexdigest() == digest, name
    files = [path for path in SAMPLE.rglob("*") if path.is_file()]
    assert len(files) == len(listed) + 1
    assert sum(path.stat().st_size for path in files) < 3_000_000
    for name in frame_names(14):
        for camera in ("left", "right"):
            image = cv2.imread(str(SAMPLE / "images" / camera / name))
            assert image.shape == (600, 800, 3)


def test_the_committed_sample_is_the_preset():
    spec = sample_spec()
    truth = json.loads((SAMPLE / "truth.json").read_text())
    expected = json.loads(json.dumps(truth_of(spec)))
    poses = np.array(list(truth.pop("rig_from_world").values()))
    # Sines and cosines may differ in the last bit between machines.
    np.testing.assert_allclose(poses, spec.rig_from_world, atol=1e-12)
    expected.pop("rig_from_world")
    for camera in (*truth["cameras"], *expected["cameras"]):
        for key in ("normal", "cam_from_rig"):
            camera[key] = np.round(camera[key], 12).tolist()
    assert truth == expected
    start = load_rig(SAMPLE / "rig.yaml")
    np.testing.assert_allclose(start.cam_from_rig, spec.rig.cam_from_rig, atol=1e-12)
    for given, true in zip(start.cameras, spec.rig.cameras, strict=True):
        assert (given.port.normal, given.port.distance) == ((0.0, 0.0, 1.0), 0.01)
        np.testing.assert_array_equal(given.camera.params, true.camera.params)


def test_the_sample_moves_as_its_description_says():
    spec = sample_spec()
    altitude = -rigid3.inverse(spec.rig_from_world)[:, 6]
    assert altitude.min() > 0.7
    assert altitude.max() / altitude.min() > 1.8
    for item, tilt in zip(spec.rig.cameras, (2.0, 1.0), strict=True):
        assert item.port.distance == item.port.thickness == 0.02
        assert np.degrees(np.arccos(item.port.normal[2])) == pytest.approx(tilt)
