"""Lanes: many points at once give what the scalar kernels give one by one."""

import math

import numpy as np
import pytest
from jacobians import CAMERA_IDS, EXAMPLE_CAMERAS, EXAMPLE_PORTS

from uwsfm import RefractiveCamera
from uwsfm.models import projection
from uwsfm.models.lanes import BLOCK
from uwsfm.models.lens_lanes import arctangent, sine_and_cosine
from uwsfm.models.status import VALID

# A full block, and one that is filled up with its last point.
COUNT = BLOCK + 7


def assert_same(fast, slow, tolerance):
    """Equal where finite, NaN at the same places."""
    np.testing.assert_array_equal(np.isnan(fast), np.isnan(slow))
    np.testing.assert_allclose(fast, slow, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("camera", EXAMPLE_CAMERAS, ids=CAMERA_IDS)
@pytest.mark.parametrize("port", EXAMPLE_PORTS.values(), ids=EXAMPLE_PORTS.keys())
def test_lanes_equal_the_scalar_kernels(camera, port, rng):
    camera = RefractiveCamera(camera, port)
    lens, row = camera.lens, port.row
    # Behind the camera, in the glass, beside the image, on the axis, and sound ones.
    points = rng.uniform([-2, -2, -0.3], [2, 2, 3], (COUNT, 3))
    points[:4] = [[0, 0, 0], [np.nan, 0, 1], [0, 0, 1], [0, 0, 0.01]]
    xy, valid = camera.img_from_point(points)
    _, jac, _ = camera.img_from_point_with_jac(points)
    status = camera.status_from_point(points)
    slow = np.full((2, projection.JAC_SIZE), np.nan)
    for i, point in enumerate(points):
        slow[:] = np.nan
        code, px, py = projection.project_with_jac(*point, lens, row, slow)
        assert status[i] == code
        # Both solve to rounding, 1e-12 px; near the rim of a fisheye a hundred times.
        assert_same(xy[i], np.array([px, py]), 1e-10)
        scale = max(1.0, np.abs(slow).max()) if code == VALID else 1.0
        assert_same(jac[i] / scale, slow / scale, 1e-10)
    pixels = rng.uniform([-200, -200], [1200, 900], (COUNT, 2))
    pixels[0], pixels[1] = np.nan, lens[2:4]
    origins, dirs = camera.ray_from_img(pixels)
    status = camera.status_from_img(pixels)
    for i, pixel in enumerate(pixels):
        code, *ray = projection.unproject(*pixel, lens, row)
        assert status[i] == code
        assert_same(np.append(origins[i], dirs[i]), np.array(ray), 1e-12)


def test_series_are_exact_to_rounding():
    for tangent in np.append(np.logspace(-8, 8, 500), 0.0):
        # Three halvings and a series of ten terms: five roundings.
        assert arctangent(tangent) == pytest.approx(math.atan(tangent), rel=1.2e-15)
    for angle in np.linspace(0.0, 0.5 * math.pi, 500):
        expected = (math.sin(angle), math.cos(angle))
        assert sine_and_cosine(angle) == pytest.approx(expected, abs=5e-16)
