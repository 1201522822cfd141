"""What `uwsfm reconstruct` puts together for summary.json, from parts made by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hand_made_result import bars, result_of, small_model

from uwsfm.jobs.finish import refined_rig
from uwsfm.jobs.reconstruct import _images_without_points, _summary
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.mapping.refractive_start import RefractiveStart
from uwsfm.sfm.refine import Refined


@pytest.fixture(scope="module")
def model():
    return small_model()


def start_of(model, **more):
    """Three of five frames were registered by the mapper."""
    frames = Frames(
        image_dir=Path("images"),
        folders=("left", "right"),
        names=(*model.frame_names, "0003.jpg", "0004.jpg"),
    )
    return RefractiveStart(
        map_path=Path("map"),
        features_path=Path("database.db"),
        frames=frames,
        cam_from_rig=model.rig.cam_from_rig,
        ports=np.empty((2, 0)),
        lenses=np.empty((2, 0)),
        summary={
            "num_frames": 5,
            "unregistered_frames": ["0003.jpg", "0004.jpg"],
            "num_registered_frames": 3,
            "mean_error_px": 1.23,
            "warnings": ["2 of 5 frames could not be registered"],
            "timings_s": {"features": 9.0},
            "steps_of_earlier_runs": ["features"],
            **more,
        },
    )


def test_before_is_before_and_after_is_after(model):
    """Every observation is off by 5 px in the end; 7.89 px were at the beginning."""
    scene = model.scene
    exact, _ = scene.projections()
    scene = replace(scene, xy=exact - [3.0, 4.0])
    calibration = result_of(scene, lengths=bars())
    refined = Refined(
        scene=scene,
        kept=np.arange(scene.num_observations),
        calibration=calibration,
        start_rms_px=7.89,
        num_tested=99,
    )
    rig = replace(model.rig, baseline_stddev_m=0.00123)
    timings = {"features": 9.0, "adjusting": 4.0}
    found = _summary(
        replace(model, rig=rig, scene=scene),
        start_of(model),
        refined,
        timings,
        Path("/data/images"),
    )
    assert found["reprojection_rms_px"]["before"] == 7.89
    assert found["reprojection_rms_px"]["after"] == pytest.approx(5.0, rel=1e-9)
    assert found["reprojection_mean_px"] == pytest.approx(5.0, rel=1e-9)
    assert (found["num_frames"], found["num_registered_frames"]) == (5, 3)
    assert found["unregistered_frames"] == ["0003.jpg", "0004.jpg"]
    assert found["num_observations"] == scene.num_observations
    assert found["baseline_m"] == rig.baseline_m
    assert found["baseline_stddev_m"] == 0.00123
    assert [c["name"] for c in found["cameras"]] == ["left", "right"]
    assert found["cameras"][1]["distance_m"] == scene.ports[1].distance
    assert found["scale"]["relative_stddev"] == 0.013
    assert found["known_lengths"][1]["found_m"] == 2.354
    assert found["timings_s"] == timings and found["images"] == "/data/images"
    assert found["steps_of_earlier_runs"] == ["features"]
    assert found["warnings"] == ["2 of 5 frames could not be registered"]
    assert found["refractive_start"] == {
        "num_registered_frames": 3,
        "mean_error_px": 1.23,
    }


def without(model, *images):
    """The model without the observations of some images (camera, frame)."""
    scene = model.scene
    keep = np.ones(scene.num_observations, dtype=bool)
    for camera, frame in images:
        keep &= (scene.camera_idx != camera) | (scene.frame_idx != frame)
    rows = {
        n: getattr(scene, n)[keep] for n in ("camera_idx", "frame_idx", "point_idx")
    }
    return replace(model, scene=replace(scene, xy=scene.xy[keep], **rows))


def test_images_that_see_nothing_are_counted_and_named(model):
    assert _images_without_points(model) == []
    (one,) = _images_without_points(without(model, (1, 2)))
    assert one.startswith("image right/0002.jpg sees no point of the result: is")
    (two,) = _images_without_points(without(model, (1, 2), (0, 1)))
    assert two.startswith("2 images see no point of the result, for instance left/0001")


def test_a_refined_rig_has_the_scenes_poses_ports_and_lenses(model):
    scene = model.scene
    poses = scene.cam_from_rig.copy()
    poses[1, 5] += 0.001
    row = scene.cameras[1].lens.copy()
    row[0] += 7.0
    port = replace(scene.ports[1], distance=0.0456)
    cameras = (scene.cameras[0], scene.cameras[1].with_port(port).with_lens(row))
    rig = refined_rig(model.rig, replace(scene, cam_from_rig=poses, cameras=cameras))
    np.testing.assert_array_equal(rig.cam_from_rig, poses)
    left, right = rig.cameras
    assert right.port.distance == 0.0456 and left.port == model.rig.cameras[0].port
    # Two focal lengths lead the parameters of OPENCV.
    assert right.camera.params[0] == pytest.approx(row[0])
    assert left.camera.params[0] == model.rig.cameras[0].camera.params[0]
