"""Which frames one camera's images are compared with."""

import numpy as np
import pytest
from sfm_scenes import model_of

from uwsfm.dense.views import image_views
from uwsfm.errors import InputError
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


def test_neighbours_have_parallax_or_there_are_none():
    simulated = simulate_scene(
        sample_rig(), rich_motion(5), Relief(), ObservationOptions(num_points=80)
    )
    model = model_of(sample_rig(), simulated.truth)
    views = image_views(model)
    assert len(views) == 10
    for view in views:
        assert len(view.others) >= 2 and not view.is_stereo
        assert (view.camera, view.frame) not in view.others
        assert 0.5 < view.near < view.far < 5.0
    alone = simulate_scene(
        sample_rig(), rich_motion(1), Relief(), ObservationOptions(num_points=80)
    )
    with pytest.raises(InputError, match="at least two other images"):
        image_views(model_of(sample_rig(), alone.truth))


def test_all_of_an_image_is_seen_by_some_neighbour():
    """Not only what most frames see: those that see the rest come among the first."""
    simulated = simulate_scene(
        sample_rig(), rich_motion(12), Relief(), ObservationOptions(num_points=300)
    )
    scene = simulated.truth
    views = image_views(model_of(sample_rig(), scene))
    for view in views:
        of_view = scene.point_idx[scene.frame_idx == view.frame]
        frames = [frame for _, frame in view.others]
        elsewhere = scene.point_idx[scene.frame_idx != view.frame]
        near = scene.point_idx[np.isin(scene.frame_idx, frames)]
        possible = np.isin(of_view, elsewhere).mean()
        assert np.isin(of_view, near).mean() > 0.95 * possible
