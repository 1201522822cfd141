"""Touch one input of a depth map: it is made again, and no other."""

import os
from dataclasses import replace

import numpy as np
import pytest
from hand_made_result import result_of, small_model

from uwsfm.dense.depth_map import DepthMap, write_depth_map
from uwsfm.dense.maps import DepthMaps
from uwsfm.dense.stereo_maps import StereoMaps
from uwsfm.errors import InputError
from uwsfm.results.folder import Result


@pytest.fixture(scope="module")
def model():
    return small_model()


@pytest.fixture
def dense(model, tmp_path):
    """A result with images; only names, sizes and times of these are read."""
    images = tmp_path / "images"
    for side in ("left", "right"):
        (images / side).mkdir(parents=True)
        for name in model.frame_names:
            (images / side / name).write_bytes(b"x" * 7)
            os.utime(images / side / name, ns=(10**18, 10**18))
    return result_with(model, tmp_path)


def result_with(model, folder):
    calibration = result_of(model.scene)
    return Result(
        folder=folder,
        model=model,
        calibration=calibration,
        solved=calibration,
        summary={},
        images=folder / "images",
        fingerprint="mark",
    )


def depth_keys(result):
    maps = DepthMaps(result, result.images)
    assert [view.frame for view in maps.views] == [0, 1, 2]
    return [maps._maker.key(index) for index in range(len(maps.views))]


def changed(before, result):
    """Frames whose depth map is made again."""
    after = depth_keys(result)
    return [k for k in range(3) if before[k] != after[k]]


def with_scene(result, **more):
    scene = replace(result.model.scene, **more)
    return replace(result, model=replace(result.model, scene=scene))


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_depth_map_is_of_its_two_images(dense, side):
    before = depth_keys(dense)
    assert changed(before, dense) == []
    path = dense.images / side / "0001.jpg"
    os.utime(path, ns=(10**18, 10**18 + 1))
    assert changed(before, dense) == [1]
    path.write_bytes(b"x" * 8)
    os.utime(path, ns=(10**18, 10**18))
    assert changed(before, dense) == [1]


def test_a_depth_map_is_of_its_calibration(dense):
    """Of lens, port and placement, and of no pose of the rig."""
    before, scene = depth_keys(dense), dense.model.scene
    for index in range(2):
        camera = scene.cameras[index]
        row = camera.lens.copy()
        row[0] += 1e-9
        port = replace(camera.port, distance=camera.port.distance + 1e-12)
        for other in (camera.with_lens(row), camera.with_port(port)):
            cameras = list(scene.cameras)
            cameras[index] = other
            assert changed(before, with_scene(dense, cameras=tuple(cameras))) == [
                0,
                1,
                2,
            ]
    poses = scene.cam_from_rig.copy()
    poses[1, 4] += 1e-12
    assert changed(before, with_scene(dense, cam_from_rig=poses)) == [0, 1, 2]


def test_a_depth_map_is_of_its_range(dense):
    """Of the points of its frame; where these are few, of all, as in frame 0."""
    scene = dense.model.scene
    before = depth_keys(dense)
    poses = scene.rig_from_world.copy()
    poses[2, 6] += 0.5  # frame 2 is half a metre farther from all it sees
    assert changed(before, with_scene(dense, rig_from_world=poses)) == [0, 2]


def test_a_depth_map_is_of_either_end_of_its_range_and_of_its_size(dense):
    maps = DepthMaps(dense, dense.images)
    before = depth_keys(dense)
    for name in ("near", "far"):
        views = list(maps.views)
        views[1] = replace(views[1], **{name: getattr(views[1], name) + 1e-12})
        other = StereoMaps(dense.model, dense.images, views, 1e9)
        whole = StereoMaps(dense.model, dense.images, maps.views, 1e9)
        assert [other.key(k) == whole.key(k) for k in range(3)] == [True, False, True]
    # An image of 800 x 600 as one of 400 x 300.
    small = StereoMaps(dense.model, dense.images, maps.views, 1.3e5)
    assert whole.factor(0) == whole.factor(1) == 1 and small.factor(0) == 2
    assert all(small.key(k) != whole.key(k) for k in range(3))
    assert before == [whole.key(k) for k in range(3)]
    names = [small.name(view) for view in maps.views]
    assert names == ["000000_0-1.npz", "000001_0-1.npz", "000002_0-1.npz"]


def test_a_depth_map_that_is_old_or_missing_is_told(dense):
    maps = DepthMaps(dense, dense.images)
    path = dense.folder / "uwsfm-work" / "dense" / "000001_0-1.npz"
    path.parent.mkdir(parents=True)
    depth = DepthMap(
        ranges=np.full((2, 3), 1.5, np.float32),
        sensitivity=np.full((2, 3), 0.25, np.float32),
    )
    write_depth_map(depth, path, maps._maker.key(1))
    found = maps.read(1)
    assert found.ranges[0, 0] == 1.5 and found.sensitivity[1, 2] == 0.25
    write_depth_map(depth, path, "another")
    for index in (0, 1):
        with pytest.raises(InputError, match=r"_0-1.npz is missing or old: run uwsfm"):
            maps.read(index)


def test_every_image_is_looked_for_before_the_first_is_matched(dense):
    maps = DepthMaps(dense, dense.images)
    maps.require_images()
    (dense.images / "right" / "0002.jpg").unlink()
    with pytest.raises(InputError, match="right.0002.jpg"):
        maps.require_images()
    (dense.images / "left" / "0002.jpg").unlink()
    with pytest.raises(InputError, match="left.0002.jpg"):  # the first of the two
        maps.require_images()


def test_every_pair_has_what_its_calibration_adds(dense):
    maps = DepthMaps(dense, dense.images)
    maps.prepare_errors()
    largest = maps.largest_errors()
    assert list(largest) == [(0, 1)] and largest[0, 1] > 0.0
    open_one = replace(dense.calibration.covariance, determined=False)
    calibration = replace(dense.calibration, covariance=open_one)
    unknown = DepthMaps(replace(dense, calibration=calibration), dense.images)
    unknown.prepare_errors()
    assert unknown.largest_errors() == {(0, 1): None}
