"""The seed decides the random choices of each step, and nothing else does.

Many matches are wrong, so that samples matter; every step has the same input. A small
error of the model shows what was drawn.
"""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import simulated_dive

from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.mapping.correspondences import read_correspondences
from uwsfm.sfm.mapping.incremental import map_incrementally
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.pinhole.mapper import map_images
from uwsfm.sfm.pinhole.mapping_database import write_mapping_database
from uwsfm.sfm.rig_checks.pinhole_fit import fit_virtual_pinhole
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.simulate.rigs import nominal_rig, sample_rig

NUM_FRAMES = 4
OPTIONS = StartOptions(num_threads=1)
RIG = nominal_rig(sample_rig())


@pytest.fixture(scope="module")
def front_end(tmp_path_factory):
    """A folder with features, and the names of their images."""
    folder = tmp_path_factory.mktemp("seeds")
    frames = frames_of(RIG, NUM_FRAMES, folder)
    scene = simulated_dive(num_frames=NUM_FRAMES, num_points=300).scene
    write_features(folder / "database.db", scene, frames, wrong=0.3)
    return folder, frames


def verified(front_end, seed: int, name: str):
    """The mapping database of a seed."""
    folder, frames = front_end
    cameras = RIG.refractive_cameras()
    pinholes = tuple(fit_virtual_pinhole(camera, None) for camera in cameras)
    path = folder / name
    options = replace(OPTIONS, seed=seed)
    write_mapping_database(
        folder / "database.db",
        path,
        frames,
        cameras,
        pinholes,
        RIG.cam_from_rig,
        options,
    )
    return path


@pytest.fixture(scope="module")
def mapping(front_end):
    return verified(front_end, 0, "mapping.db")


def geometry(front_end, seed, name):
    with opened(verified(front_end, seed, name)) as database:
        _, found = database.read_two_view_geometries()
    return np.concatenate(
        [np.ravel(one.E if one.E is not None else one.F) for one in found]
    )


def refractive(front_end, mapping, seed):
    folder, frames = front_end
    seen = read_correspondences(folder / "database.db", mapping, frames, RIG)
    options = replace(OPTIONS, mapper="refractive", seed=seed)
    return map_incrementally(seen, RIG, RIG.cam_from_rig, options)[0].points


def pinhole(front_end, mapping, seed):
    options = replace(OPTIONS, mapper="pinhole", seed=seed)
    model = map_images(mapping, front_end[1], options)[0]
    return np.array([model.points3D[i].xyz for i in sorted(model.points3D)])


def assert_follows(result):
    first, again, other = result(3), result(3), result(4)
    np.testing.assert_array_equal(again, first)
    assert other.shape != first.shape or not np.array_equal(other, first)


def test_verification_follows_its_seed(front_end):
    names = iter("abc")
    assert_follows(lambda seed: geometry(front_end, seed, f"{next(names)}.db"))


@pytest.mark.parametrize("mapper", [refractive, pinhole])
def test_mapping_follows_its_seed(front_end, mapping, mapper):
    assert_follows(lambda seed: mapper(front_end, mapping, seed))
