"""Caustics in closed form against the determinant that defines them (paper, sec. 2)."""

import numpy as np
import pycolmap
import pytest

import uwsfm

PORTS = {
    "thin": uwsfm.FlatPort(distance=0.02, thickness=0.0),
    "thick, tilted 2 degrees": uwsfm.FlatPort(
        (np.sin(np.radians(2.0)), 0.0, np.cos(np.radians(2.0))), 0.02, 0.03
    ),
    "strongly tilted, odd indices": uwsfm.FlatPort(
        (0.3, -0.4, np.sqrt(0.75)), 0.05, 0.01, 1.3, 1.36
    ),
}


def camera_behind(port: uwsfm.FlatPort) -> uwsfm.RefractiveCamera:
    lens = pycolmap.Camera(
        model="OPENCV",
        width=800,
        height=600,
        params=[600, 610, 400, 300, -0.05, 0.02, 1e-3, -1e-3],
    )
    return uwsfm.RefractiveCamera(lens, port)


def ranges_of_zero_determinant(camera: uwsfm.RefractiveCamera, pixel: np.ndarray):
    """Both roots a of det d(X_o + a r_w) / d(x, y, a), by central differences."""
    step = 0.05  # px: the error of the difference falls with its square
    origin, direction = camera.ray_from_img(pixel[None])
    shifted = pixel + step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    origins, directions = camera.ray_from_img(shifted)
    do = np.array([origins[0] - origins[1], origins[2] - origins[3]]) / (2 * step)
    dr = np.array([directions[0] - directions[1], directions[2] - directions[3]])
    dr /= 2 * step

    def det(a):
        return np.linalg.det(np.array([*(do + a * dr), direction[0]]))

    # A quadratic in a, through three of its values; scaled to be of order one.
    a = np.array([-0.05, 0.0, 0.05])
    values = np.array([det(v) for v in a])
    return np.sort(np.roots(np.polyfit(a, values / np.abs(values).max(), 2)).real)


@pytest.mark.parametrize("port", PORTS.values(), ids=PORTS)
def test_focal_points_are_where_the_determinant_vanishes(port):
    camera = camera_behind(port)
    for pixel in np.array([[20.0, 30.0], [150.0, 500.0], [780.0, 560.0]]):
        origin, direction = camera.ray_from_img(pixel[None])
        sagittal, tangential = camera.caustic(pixel[None])
        ranges = [
            ((point - origin) @ direction[0]).item() for point in (sagittal, tangential)
        ]
        expected = ranges_of_zero_determinant(camera, pixel)
        # Differences over 0.05 px leave 1e-7 of a distance of centimetres.
        np.testing.assert_allclose(np.sort(ranges), expected, rtol=1e-5)


def test_sagittal_points_lie_on_the_axis(rng):
    port = PORTS["thick, tilted 2 degrees"]
    camera = camera_behind(port)
    sagittal, _ = camera.caustic(rng.uniform((0, 0), (800, 600), (50, 2)))
    assert np.abs(np.cross(sagittal, port.normal)).max() < 1e-15


def test_without_refraction_all_rays_meet_in_the_camera(rng):
    camera = camera_behind(uwsfm.FlatPort((0.0, 0.6, 0.8), 0.02, 0.01, 1.0, 1.0))
    for points in camera.caustic(rng.uniform((0, 0), (800, 600), (50, 2))):
        assert np.abs(points).max() < 1e-15


def test_paraxial_rays_share_one_focus():
    """On the axis both sheets touch: the apparent depth d n_w + t n_w / n_g."""
    port = uwsfm.FlatPort(distance=0.02, thickness=0.03)
    lens = pycolmap.Camera(
        model="PINHOLE", width=800, height=600, params=[600, 600, 400, 300]
    )
    sagittal, tangential = uwsfm.RefractiveCamera(lens, port).caustic([[400.0, 300.0]])
    np.testing.assert_allclose(sagittal, tangential, atol=1e-16)
    apparent = 0.02 * port.n_water + 0.03 * port.n_water / port.n_glass
    assert sagittal[0, 2] == pytest.approx(0.05 - apparent)
