"""Images are counted beside frames, which are there though one of theirs is not."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from sfm_scenes import simulated_dive

from uwsfm.cli.tables import result_table
from uwsfm.report.words import _images
from uwsfm.results.summary import _num_images

SUMMARY = {
    "num_registered_frames": 14,
    "num_frames": 14,
    "num_registered_images": 20,
    "num_images": 28,
    "num_points": 900,
    "num_observations": 5000,
    "num_invalid": 3,
    "reprojection_rms_px": {"before": 4.0, "after": 0.5},
    "cameras": [{}, {}],
    "scale": {
        "verdict": "metric",
        "unit": "metre",
        "relative_stddev": 0.001,
        "relative_stddev_in_all": 0.002,
    },
}


def test_images_that_see_a_point_are_counted():
    """Six frames of two cameras; one image sees nothing that is left."""
    scene = simulated_dive(num_points=200).scene
    assert _num_images(scene) == 12
    lost = (scene.camera_idx == 1) & (scene.frame_idx == 2)
    assert lost.any()
    fewer, _ = scene.select(np.logical_not(lost))
    assert _num_images(fewer) == 11


def test_images_of_more_cameras_than_frames_are_counted_one_by_one():
    cameras, frames = np.repeat(np.arange(4), 2), np.tile([0, 1], 4)
    scene = SimpleNamespace(num_frames=2, camera_idx=cameras, frame_idx=frames)
    assert _num_images(scene) == 8
    scene.camera_idx, scene.frame_idx = cameras[1:], frames[1:]
    assert _num_images(scene) == 7


@pytest.mark.parametrize("cameras", [1, 2])
def test_the_table_has_images_where_a_frame_has_several(cameras):
    summary = {**SUMMARY, "cameras": [{}] * cameras}
    console = Console(file=io.StringIO(), width=100)
    console.print(result_table(summary))
    text = console.file.getvalue()
    assert "14 of 14" in text
    assert ("20 of 28" in text) == (cameras == 2)


def test_the_page_names_missing_images_and_old_results_have_no_count():
    assert _images(SUMMARY) == " (20 of 28 images)"
    assert _images({**SUMMARY, "num_registered_images": 28}) == ""
    assert _images({"num_registered_frames": 14, "num_frames": 14}) == ""
