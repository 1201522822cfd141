"""The seed decides the random choices, and nothing else does."""

import numpy as np
import pytest
from sfm_scenes import simulated_dive

from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate.rigs import nominal_rig, sample_rig


@pytest.mark.parametrize("mapper", ["refractive", "pinhole"])
def test_mapping_follows_its_seed(mapper, tmp_path):
    """Many wrong matches, so that samples matter: same seed, same bytes."""
    rig = nominal_rig(sample_rig())
    scene = simulated_dive(num_frames=4, num_points=400).scene

    def points(seed, folder):
        work_dir = tmp_path / folder
        work_dir.mkdir()
        frames = frames_of(rig, 4, work_dir)
        write_features(work_dir / "database.db", scene, frames, wrong=0.3)
        options = StartOptions(mapper=mapper, seed=seed, num_threads=1)
        start = start_from_matches(rig, frames, Steps(work_dir), "", options)
        arrays = start.arrays()
        return arrays.points

    first = points(3, "a")
    np.testing.assert_array_equal(points(3, "b"), first)
    other = points(4, "c")
    assert other.shape != first.shape or not np.array_equal(other, first)
