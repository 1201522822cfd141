"""Real images through all steps, and runs that are killed on the way (SIGKILL)."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from sfm_scenes import reduced_images, reduced_rig

from uwsfm.errors import InputError
from uwsfm.models.ports.port import FlatPort
from uwsfm.rig.file import dump_rig
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.options import FeatureOptions, MatchOptions, StartOptions
from uwsfm.sfm.pinhole.perspective import PerspectiveStart, read_start
from uwsfm.sfm.start import perspective_start

NUM_FRAMES = 3
SCALE = 0.4
OPTIONS = StartOptions(num_threads=2, mapper="pinhole")

# Runs a start, and kills itself when a step has come far enough.
CHILD = """
import os, signal, sys
from pathlib import Path
import uwsfm.sfm.frontend.background as background
from uwsfm.rig.file import load_rig
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.start import perspective_start

rig_path, image_dir, work_dir, fatal_step, fatal_count = sys.argv[1:]
background.POLL_SECONDS = 0.005

def progress(step, done, total):
    if step == fatal_step and done >= int(fatal_count):
        os.kill(os.getpid(), signal.SIGKILL)

options = StartOptions(num_threads=2, mapper="pinhole")
perspective_start(
    load_rig(rig_path), Path(image_dir), Path(work_dir), options, progress
)
"""


@pytest.fixture(scope="module")
def image_dir(tmp_path_factory) -> Path:
    """The first frames of the sample, reduced."""
    target = tmp_path_factory.mktemp("images")
    reduced_images(target, SCALE, NUM_FRAMES)
    return target


@pytest.fixture(scope="module")
def rig() -> Rig:
    return reduced_rig(SCALE)


@pytest.fixture(scope="module")
def finished(rig, image_dir, tmp_path_factory) -> tuple[Path, PerspectiveStart]:
    """A run that nothing disturbed."""
    work_dir = tmp_path_factory.mktemp("work")
    return work_dir, perspective_start(rig, image_dir, work_dir, OPTIONS)


def step_times(work_dir: Path) -> dict[str, float]:
    record = json.loads((work_dir / "steps.json").read_text())
    return {name: step.get("seconds", -1.0) for name, step in record["steps"].items()}


def test_real_images_are_registered(finished):
    _, start = finished
    assert read_start(start).rig_from_world.shape == (NUM_FRAMES, 7)
    assert start.summary["mean_error_px"] < 1.0


@pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")
@pytest.mark.parametrize(
    ("step", "count"),
    [("features", 2), ("matching", 5), ("verifying", 5), ("mapping", 1)],
)
def test_a_killed_run_goes_on(rig, image_dir, finished, tmp_path, step, count):
    rig_path, work_dir = tmp_path / "rig.yaml", tmp_path / "work"
    dump_rig(rig, rig_path, "the sample, reduced")
    arguments = [rig_path, image_dir, work_dir, step, count]
    killed = subprocess.run(
        [sys.executable, "-c", CHILD, *map(str, arguments)],
        capture_output=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        check=False,
        timeout=60,
    )
    assert killed.returncode == -signal.SIGKILL, killed.stderr.decode()
    with opened(work_dir / "database.db") as database:
        kept = {image.name: image.image_id for image in database.read_all_images()}
    if step == "features":
        assert 2 <= len(kept) < 2 * NUM_FRAMES
    else:
        assert len(kept) == 2 * NUM_FRAMES

    seen: list[str] = []
    start = perspective_start(
        rig, image_dir, work_dir, OPTIONS, lambda name, *_: seen.append(name)
    )

    with opened(work_dir / "database.db") as database:
        for image in database.read_all_images():  # what was there was not made again
            assert kept.get(image.name, image.image_id) == image.image_id
    order = ["features", "matching", "verifying", "mapping"]
    assert not set(order[: order.index(step)]) & set(seen)
    undisturbed = read_start(finished[1])
    resumed = read_start(start)
    assert resumed.frame_names == undisturbed.frame_names
    # Image identifiers differ by the order of threads; nothing may depend on them.
    np.testing.assert_allclose(
        resumed.rig_from_world, undisturbed.rig_from_world, atol=1e-6
    )


def test_a_finished_run_does_nothing_again(rig, image_dir, finished):
    work_dir, _ = finished
    before = step_times(work_dir)
    seen: list[str] = []
    perspective_start(
        rig, image_dir, work_dir, OPTIONS, lambda name, *_: seen.append(name)
    )
    assert seen == []
    assert step_times(work_dir) == before


def test_another_port_repeats_geometry_but_not_matching(rig, image_dir, finished):
    work_dir, _ = finished
    ports = [FlatPort(distance=0.03, thickness=0.02) for _ in rig.cameras]
    other = rig.with_geometry(rig.cam_from_rig, ports)
    seen: list[str] = []
    perspective_start(
        other, image_dir, work_dir, OPTIONS, lambda name, *_: seen.append(name)
    )
    assert set(seen) == {"verifying", "mapping"}


def test_another_matcher_repeats_matching_but_not_features(
    rig, image_dir, finished, tmp_path
):
    """And with the paper's matcher so does another seed: its trees are random."""
    work_dir = tmp_path / "work"
    shutil.copytree(finished[0], work_dir)
    options = replace(OPTIONS, matching=MatchOptions(matcher="paper"))
    repeated = ["matching", "verifying", "mapping"]
    for how, expected in (
        (options, repeated),
        (options, []),
        (replace(options, seed=1), repeated),
    ):
        seen: list[str] = []
        start = perspective_start(
            rig, image_dir, work_dir, how, lambda name, *_, seen=seen: seen.append(name)
        )
        assert set(seen) == set(expected)
    assert read_start(start).rig_from_world.shape == (NUM_FRAMES, 7)
    assert start.summary["mean_error_px"] < 1.0


def test_exchanged_folders_keep_their_features(rig, image_dir, finished):
    """Who is told that the folders are swapped, and mends it, does not wait twice."""
    work_dir, _ = finished
    left, right = rig.cameras
    exchanged = replace(
        rig,
        cameras=(replace(left, images="right"), replace(right, images="left")),
    )
    seen: list[str] = []
    with pytest.raises(InputError, match="are swapped"):
        perspective_start(
            exchanged, image_dir, work_dir, OPTIONS, lambda name, *_: seen.append(name)
        )
    assert seen == []


def test_ctrl_c_stops_a_running_step_and_leaves_a_workspace(rig, image_dir, tmp_path):
    def interrupt(step: str, done: int, total: int | None) -> None:
        if step == "features":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        perspective_start(rig, image_dir, tmp_path, OPTIONS, interrupt)
    assert step_times(tmp_path) == {"features": -1.0}


def test_clahe_and_masks_reach_the_features(rig, image_dir, tmp_path):
    """The upper half is masked away in all images; contrast finds more in the rest."""
    masks = tmp_path / "masks"
    for path in image_dir.rglob("*.png"):
        mask = np.zeros_like(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
        mask[mask.shape[0] // 2 :] = 255
        target = masks / path.parent.name / f"{path.name}.png"
        target.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(target), mask)
    features = FeatureOptions(clahe=True, mask_dir=masks)
    options = StartOptions(features=features, num_threads=2, mapper="pinhole")
    work_dir = tmp_path / "work"
    perspective_start(rig, image_dir, work_dir, options)
    with opened(work_dir / "database.db") as database:
        for image in database.read_all_images():
            keypoints = database.read_keypoints(image.image_id)
            assert len(keypoints) > 50
            assert keypoints[:, 1].min() >= 0.5 * 600 * SCALE - 1.0
        lens = database.read_camera(database.read_all_images()[0].camera_id)
    np.testing.assert_array_equal(lens.params, rig.cameras[0].camera.params)
