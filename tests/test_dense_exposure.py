"""Colours of images that were exposed differently."""

import numpy as np
import pytest

from uwsfm.dense.exposure import SeenColors, balancing_gains
from uwsfm.dense.voxels import BYTES_PER_VOXEL, Fused, Voxels


def test_exposures_come_back_whatever_a_highlight_does(rng):
    """Three images of 400 places, each sees some; a fifth of one is in the sun."""
    true = np.array([[1.3, 1.3, 1.3], [0.8, 0.75, 0.7], [1.0, 1.1, 1.2]])
    colors = rng.uniform(60.0, 150.0, (400, 3))
    images = []
    for gain in true:
        rows = np.sort(rng.permutation(400)[:250])
        seen = colors[rows] * gain * np.exp(0.02 * rng.standard_normal((250, 3)))
        images.append(SeenColors(rows=rows, colors=seen.astype(np.float32)))
    images[1].colors[:50] *= 1.6
    gains = balancing_gains(images)
    expected = 1.0 / true
    expected /= np.exp(np.log(expected).mean(axis=0))
    # A median of some 150 ratios of 3 % is known to 0.3 %; the highlights shift it by
    # a third of a deviation or so.
    np.testing.assert_allclose(gains, expected, rtol=0.02)
    assert np.log(gains).mean(axis=0) == pytest.approx(0.0, abs=1e-12)


def test_what_is_dark_or_seen_once_says_nothing():
    once = [
        SeenColors(
            rows=np.arange(5) + 10 * k, colors=np.full((5, 3), 50.0 + k, np.float32)
        )
        for k in range(2)
    ]
    assert balancing_gains(once) == pytest.approx(1.0)
    dark = [
        SeenColors(rows=np.arange(5), colors=np.full((5, 3), level, np.float32))
        for level in (2.0, 6.0)
    ]
    assert balancing_gains(dark) == pytest.approx(1.0)


def test_colours_of_a_voxel_are_averaged_by_their_weights():
    """Four to one: (4 * 100 + 200) / 5."""
    voxels = Voxels(0.1, np.zeros(3), 100 * BYTES_PER_VOXEL)
    for level, view_range in ((100, 1.0), (200, 2.0)):
        voxels.add(
            Fused(
                points=np.full((1, 3), 0.05),
                normals=np.array([[0.0, 0.0, -1.0]]),
                colors=np.full((1, 3), level, dtype=np.uint8),
                stddev=np.array([0.01]),
                num_views=np.array([2]),
                view_range=np.array([view_range]),
                plain=np.array([False]),
                color_weight=np.array([view_range**-2.0]),
            )
        )
    cloud = voxels.cloud()
    assert cloud.colors.tolist() == [[120, 120, 120]]
    assert cloud.view_range == pytest.approx([1.0])
