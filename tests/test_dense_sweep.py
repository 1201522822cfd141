"""Depth from one camera's neighbouring frames, against the exact depths."""

import numpy as np
import pytest
from dense_scenes import Plane
from sfm_scenes import model_of

from uwsfm.dense.depth_map import pixel_rows
from uwsfm.dense.semi_global import aggregate
from uwsfm.dense.sweep import Source, sweep_depth
from uwsfm.dense.views import sweep_views
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


def test_a_slanted_plane_is_found_by_one_camera():
    camera = sample_rig(image_scale=0.25).refractive_cameras()[0]
    normal = np.array([0.3, -0.25, 1.0]) / np.linalg.norm([0.3, -0.25, 1.0])
    plane = Plane(normal, 1.7, 0.008)
    poses = [
        np.array([0.0, 0.0, np.sin(turn), np.cos(turn), x, y, 0.0])
        for x, y, turn in ((0.2, 0.0, 0.0), (-0.2, 0.05, 0.2), (0.0, 0.2, -0.1))
    ]
    sources = [
        Source(camera=camera, from_reference=pose, image=plane.image(camera, pose))
        for pose in poses
    ]
    image = plane.image(camera, rigid3.IDENTITY)
    # Memory for a few rows at a time: bands must not show.
    depth = sweep_depth(camera, image, sources, 1.2, 2.8, 4e7)
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    truth = plane.ranges(origins, dirs).reshape(image.shape)
    px = np.abs((depth.ranges - truth) / depth.sensitivity)
    inner = np.s_[15:-15, 25:-25]
    assert np.mean(px[inner] < 0.9) > 0.95
    # Free of noise: interpolation and windows, as in a stereo pair.
    assert np.nanmedian(px[inner]) < 0.08
    percent = 100.0 * (depth.ranges / truth - 1.0)[inner]
    assert abs(np.nanmedian(percent)) < 0.1


def test_aggregation_of_one_row_is_dynamic_programming(rng: np.random.Generator):
    cost = rng.integers(0, 255, (1, 6, 5)).astype(np.uint8)
    total = np.empty(cost.shape, dtype=np.float32)
    aggregate(cost, np.float32(8.0), np.float32(64.0), total)
    change = np.abs(np.subtract.outer(np.arange(5), np.arange(5)))
    price = np.where(change == 0, 0.0, np.where(change == 1, 8.0, 64.0))

    def path(row):
        found = [row[0].astype(float)]
        for values in row[1:]:
            # Less the least before, which no choice depends on.
            least = found[-1].min()
            found.append(values + (found[-1][:, None] + price).min(axis=0) - least)
        return np.array(found)

    # A single row has nothing above and below: those paths are the costs alone.
    expected = path(cost[0]) + path(cost[0][::-1])[::-1] + 2.0 * cost[0]
    np.testing.assert_allclose(total[0], expected, rtol=1e-6)


def test_neighbours_have_parallax_or_there_are_none():
    simulated = simulate_scene(
        sample_rig(), rich_motion(5), Relief(), ObservationOptions(num_points=80)
    )
    model = model_of(sample_rig(), simulated.truth)
    views = sweep_views(model)
    assert len(views) == 10
    for view in views:
        assert len(view.others) >= 2 and not view.is_stereo
        assert (view.camera, view.frame) not in view.others
        assert 0.5 < view.near < view.far < 5.0
    alone = simulate_scene(
        sample_rig(), rich_motion(1), Relief(), ObservationOptions(num_points=80)
    )
    with pytest.raises(InputError, match="at least two neighbouring frames"):
        sweep_views(model_of(sample_rig(), alone.truth))
