"""The front end on a real rig in a tank; the data are not in the repository."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import FlatPort
from uwsfm.rig.rig import Rig, RigCamera, camera_from_opencv
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.pinhole.perspective import read_start
from uwsfm.sfm.start import perspective_start

DATA = Path(os.environ.get("UWSFM_DATA", Path(__file__).parents[2] / "shared" / "data"))
TANK = DATA / "uril_tank"
OPTIONS = StartOptions(num_threads=2, mapper="pinhole")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not TANK.is_dir(), reason=f"{TANK} does not exist; set UWSFM_DATA"
    ),
]


def tank_rig() -> Rig:
    """In-air calibration, and a guess of the ports: 5 mm of acrylic, 15 mm away."""
    found = json.loads((TANK / "in_air_calibration.json").read_text())
    cameras = tuple(
        RigCamera(
            name=side,
            images=side,
            camera=camera_from_opencv(
                *found["image_size"],
                found[f"K_{side}"],
                found[f"D_{side}"][:4],
                fisheye=False,
                pixel_origin="opencv",
            ),
            port=FlatPort(distance=0.015, thickness=0.005, n_glass=1.49),
            refine_normal=True,
            refine_distance=True,
        )
        for side in ("left", "right")
    )
    translation = np.array(found["T_mm"]) / 1e3
    return Rig(
        cameras=cameras,
        cam_from_rig=np.stack(
            [rigid3.IDENTITY, rigid3.from_rotmat(found["R"], translation)]
        ),
        baseline_m=float(np.linalg.norm(translation)),
        baseline_stddev_m=0.0,
    )


@pytest.fixture(scope="module")
def work_dir(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("tank")


def test_all_pairs_are_registered_in_one_model(work_dir):
    start = perspective_start(tank_rig(), TANK, work_dir, OPTIONS)
    summary = start.summary
    assert summary["num_frames"] == 24
    assert summary["num_registered_frames"] >= 22
    assert len(read_start(start).xy) > 30_000
    # Straight ports at a guessed distance: the refractive stage halves this.
    assert summary["mean_error_px"] < 0.75
    # The board hung at about half a metre, and the ports are tilted by a few degrees.
    np.testing.assert_allclose(summary["depth_percentiles_m"][0][1], 0.52, atol=0.05)
    assert 0.1 < summary["rig_turn_deg"][1] < 1.0
    assert summary["same_frame_misfit_px"]["after_turn"] < 0.5


def test_baseline_length_alone_finds_the_rig(work_dir):
    rig = tank_rig()
    start = perspective_start(replace(rig, cam_from_rig=None), TANK, work_dir, OPTIONS)
    assert start.summary["num_registered_frames"] >= 22
    expected = np.asarray(rig.cam_from_rig)[1]
    error = rigid3.compose(start.cam_from_rig[1], rigid3.inverse(expected))
    assert np.degrees(rigid3.rotation_angle(error)) < 1.0
    assert np.linalg.norm(start.cam_from_rig[1, 4:] - expected[4:]) < 3e-3


def test_swapped_folders_are_refused(work_dir):
    rig = tank_rig()
    left, right = rig.cameras
    swapped = replace(
        rig,
        cameras=(replace(left, images="right"), replace(right, images="left")),
    )
    with pytest.raises(InputError, match=r"'right' and 'left' are swapped"):
        perspective_start(swapped, TANK, work_dir, OPTIONS)


def test_inverted_pose_is_refused(work_dir):
    rig = tank_rig()
    poses = np.array(rig.cam_from_rig)
    poses[1] = rigid3.inverse(poses[1])
    with pytest.raises(InputError, match=r"cam_from_rig of 'right' is inverted"):
        perspective_start(replace(rig, cam_from_rig=poses), TANK, work_dir, OPTIONS)
