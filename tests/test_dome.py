"""The dome port: Fermat's principle, limits, round trips, reasons for no answer."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from jacobians import CAMERA_IDS, DOMES, EXAMPLE_CAMERAS
from scipy.optimize import minimize

from uwsfm import DomePort, FlatPort, InputError, NoPort, RefractiveCamera, Status
from uwsfm.models.ports.port import port_from_row

EVERY_DOME = pytest.mark.parametrize("port", DOMES.values(), ids=DOMES.keys())
PINHOLE = pycolmap.Camera(model="SIMPLE_PINHOLE", params=[1000.0, 0.0, 0.0])


def pixels_around(rng, count, degrees):
    """Pixels of PINHOLE up to an angle from its axis."""
    angle = np.radians(rng.uniform(0.0, degrees, count))
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    radius = 1000.0 * np.tan(angle)
    return np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth)])


def points_seen(camera, xy, ranges):
    """Points (N, 3) at ranges (N,) behind the glass, on the water rays of pixels."""
    origins, dirs = camera.ray_from_img(xy)
    return origins + ranges[:, None] * dirs


def random_dome(rng):
    radius = rng.uniform(0.03, 0.2)
    direction = rng.normal(size=3)
    shift = radius * rng.uniform(0.0, 0.8) * direction / np.linalg.norm(direction)
    indices = rng.uniform([1.3, 1.2, 1.0], [1.9, 1.4, 1.2])  # glass, water, inside
    return DomePort(tuple(shift), radius, 1e-4 * 10.0 ** rng.uniform(0, 3), *indices)


def test_round_trip_over_random_domes(rng):
    for _ in range(100):
        camera = RefractiveCamera(PINHOLE, random_dome(rng))
        xy = pixels_around(rng, 50, 80.0)
        ranges = 1e-3 * 10.0 ** rng.uniform(0.0, np.log10(30e3), len(xy))
        found, valid = camera.img_from_point(points_seen(camera, xy, ranges))
        assert valid.all()
        # Rounding of points at 30 m, over radii of 3 cm; measured 4e-9.
        assert np.abs(found - xy).max() < 1e-7


@EVERY_DOME
def test_light_takes_the_path_of_least_time(rng, port):
    """Fermat: the shortest optical path over both crossings is ours."""
    if port.thickness == 0.0:
        port = replace(port, thickness=1e-3)  # the oracle needs three layers
    camera = RefractiveCamera(PINHOLE, port)
    points = points_seen(camera, pixels_around(rng, 8, 50.0), rng.uniform(0.1, 5.0, 8))
    points *= 1.0 + 0.01 * rng.normal(size=points.shape)  # not only on its rays
    found, valid = camera.img_from_point(points)
    assert valid.all()
    center, outer = np.array(port.center), port.radius + port.thickness

    def crossing(angles, radius):
        u, v = angles
        x, y = np.sin(u), np.sin(v)
        return center + radius * np.array([x, y, np.sqrt(1.0 - x * x - y * y)])

    for point, pixel in zip(points, found, strict=True):

        def path(unknowns, point=point):
            a = crossing(unknowns[:2], port.radius)
            b = crossing(unknowns[2:], outer)
            return (
                port.n_air * np.linalg.norm(a)
                + port.n_glass * np.linalg.norm(b - a)
                + port.n_water * np.linalg.norm(point - b)
            )

        away = point - center
        start = np.arcsin(away[:2] / np.linalg.norm(away))
        best = minimize(path, np.tile(start, 2), tol=1e-14, method="BFGS").x
        ray = crossing(best[:2], port.radius)
        # A minimum is flat, half of the digits: 1e-8 of 5 m, seen at 0.1 m; at
        # worst 3e-3 measured.
        np.testing.assert_allclose(1000.0 * ray[:2] / ray[2], pixel, atol=1e-2)


@pytest.mark.parametrize("camera", EXAMPLE_CAMERAS, ids=CAMERA_IDS)
def test_concentric_dome_and_no_port_are_the_pinhole(camera, rng):
    size = np.array([camera.width, camera.height])
    xy = rng.uniform(0.2 * size, 0.8 * size, (30, 2))
    dirs = camera.cam_ray_from_img(xy)
    points = rng.uniform(0.2, 20.0, (30, 1)) * dirs
    for port in (DomePort(), NoPort()):
        refractive = RefractiveCamera(camera, port)
        # Pixels of 1000 px to machine precision; COLMAP's own undistortion leaves 1e-7.
        found, valid = refractive.img_from_point(points)
        assert valid.all()
        straight = RefractiveCamera(camera, DomePort(n_glass=1.0, n_water=1.0))
        np.testing.assert_allclose(found, straight.img_from_point(points)[0], 1e-12)
        np.testing.assert_allclose(found, camera.img_from_cam(points), atol=1e-9)
        _, water = refractive.ray_from_img(xy)
        np.testing.assert_allclose(water, dirs, atol=1e-7)


def test_large_dome_is_the_flat_port(rng):
    """A dome of 1 km whose near side is where the flat port is."""
    flat = FlatPort(distance=0.03, thickness=0.01)
    radius = 1000.0
    dome = DomePort((0.0, 0.0, 0.03 - radius), radius, 0.01, 1.5, 1.333)
    points = rng.uniform([-0.7, -0.7, 1.0], [0.7, 0.7, 2.0], (50, 3))
    expected, _ = RefractiveCamera(PINHOLE, flat).img_from_point(points)
    found, valid = RefractiveCamera(PINHOLE, dome).img_from_point(points)
    assert valid.all()
    # Where light crosses, up to 5 cm off the axis, the glass is tilted by 5e-5 rad.
    np.testing.assert_allclose(found, expected, atol=0.1)
    bare, _ = RefractiveCamera(PINHOLE, NoPort()).img_from_point(points)
    assert np.abs(found - bare).max() > 10.0


@EVERY_DOME
def test_image_does_not_change_with_the_scale_of_everything(port, rng):
    camera = RefractiveCamera(PINHOLE, port)
    points = points_seen(camera, pixels_around(rng, 30, 50.0), np.full(30, 2.0))
    _, jac, valid = camera.img_from_point_with_jac(points)
    assert valid.all()
    along = np.einsum("nij,nj->ni", jac[:, :, :3], points)
    along += jac[:, :, 3:6] @ np.array(port.center)
    along += jac[:, :, 6] * port.thickness + jac[:, :, 9] * port.radius
    assert np.abs(along).max() < 1e-9  # pixels of 1000 px, sums of terms of that size


def test_every_point_without_a_pixel_has_its_reason():
    camera = RefractiveCamera(PINHOLE, DomePort((0.0, 0.0, 0.01), 0.05, 0.01))
    points = [
        [0.0, 0.0, 0.03],
        [0.0, 0.0, 0.065],
        [0.0, 0.0, -1.0],
        [np.nan, 0.0, 1.0],
        [0.0, 0.0, 1.0],
    ]
    assert camera.status_from_point(points).tolist() == [
        Status.IN_AIR_GAP,
        Status.IN_GLASS,
        Status.BEHIND_CAMERA,
        Status.NOT_FINITE,
        Status.VALID,
    ]
    xy, jac, valid = camera.img_from_point_with_jac(points)
    assert valid.tolist() == [False] * 4 + [True]
    assert np.isnan(xy[:4]).all() and np.isnan(jac[:4]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"center": (0.0, 0.0, 0.06)}, "not inside a dome of radius 0.05"),
        ({"center": (0.0, 0.0)}, "3 finite numbers"),
        ({"radius": -0.05}, "radius must not be negative"),
        ({"thickness": np.nan}, "thickness must be finite"),
        ({"n_water": 0.9}, "refractive index"),
        ({"n_air": 1.4}, "must not be below n_air"),
    ],
)
def test_unphysical_domes_are_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(DomePort(), **change)


def test_rows_return_their_ports():
    for port in (*DOMES.values(), NoPort()):
        assert port_from_row(port.row) == port
    assert DomePort.from_params(DomePort().params) == DomePort()
    with pytest.raises(InputError, match="caustic is known of planes only"):
        RefractiveCamera(PINHOLE, DomePort()).caustic([[0.0, 0.0]])
