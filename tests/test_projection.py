"""The flat-port camera: round trips, oracles, limits and reasons for no answer."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from jacobians import (
    CAMERA_IDS,
    EXAMPLE_CAMERAS,
    EXAMPLE_PORTS,
    FLAT_PORTS,
    tilted,
)
from naive import least_time_dir, paper_water_ray, plane_axes

from uwsfm import FlatPort, InputError, RefractiveCamera, Status
from uwsfm.models import projection

FLAT = pytest.mark.parametrize("port", FLAT_PORTS.values(), ids=FLAT_PORTS.keys())
PORTS = pytest.mark.parametrize(
    "port", EXAMPLE_PORTS.values(), ids=EXAMPLE_PORTS.keys()
)
CAMERAS = pytest.mark.parametrize("camera", EXAMPLE_CAMERAS, ids=CAMERA_IDS)


def pinhole(port, focal_px=1000.0):
    """A camera whose pixels are 1000 (x/z, y/z): every direction has one."""
    params = [focal_px, 0.0, 0.0]
    return RefractiveCamera(
        pycolmap.Camera(model="SIMPLE_PINHOLE", params=params), port
    )


def python_of(kernel):
    """The uncompiled function, also where NUMBA_DISABLE_JIT is set."""
    return getattr(kernel, "py_func", kernel)


def dirs_around(normal, degrees, azimuths):
    """Unit directions at angles from a normal (both (N,)): (N, 3)."""
    normal, angles = np.asarray(normal), np.radians(degrees)[:, None]
    sideways = np.column_stack([np.cos(azimuths), np.sin(azimuths)]) @ plane_axes(
        normal
    )
    return np.cos(angles) * normal + np.sin(angles) * sideways


def points_seen(camera, xy, depths):
    """Points (N, 3) at depths (N,) behind the glass, on the water rays of pixels."""
    origins, dirs = camera.ray_from_img(xy)
    return origins + (depths / (dirs @ camera.port.normal))[:, None] * dirs


def random_port(rng, indices):
    return FlatPort(
        tilted(rng.uniform(0.0, 60.0), rng.uniform(0.0, 360.0)),
        1e-4 * 10.0 ** rng.uniform(0.0, np.log10(2000.0)),  # 0.1 mm to 20 cm
        1e-4 * 10.0 ** rng.uniform(0.0, 3.0),  # 0.1 mm to 10 cm
        *indices,
    )


INDEX_ORDERS = {
    "as in the sea": lambda rng: (*rng.uniform([1.4, 1.3], [1.9, 1.36]), 1.0),
    "air outside, water inside": lambda rng: (1.5, 1.0, 1.333),
    "glass below the water": lambda rng: (1.1, 1.4, 1.0),
    "any": lambda rng: tuple(rng.uniform(1.0, 2.0, 3)),
}


@pytest.mark.parametrize("order", INDEX_ORDERS.values(), ids=INDEX_ORDERS.keys())
def test_round_trip_to_80_degrees_in_air_over_random_ports(rng, order):
    for _ in range(60):
        camera = pinhole(random_port(rng, order(rng)))
        degrees = np.concatenate([rng.uniform(0.0, 80.0, 98), [0.0, 1e-6]])
        dirs = dirs_around(camera.port.normal, degrees, rng.uniform(0, 2 * np.pi, 100))
        dirs = dirs[dirs[:, 2] > np.cos(np.radians(80.0))]
        xy = 1000.0 * dirs[:, :2] / dirs[:, 2:]
        xy = xy[camera.status_from_img(xy) == Status.VALID]
        depths = 1e-3 * 10.0 ** rng.uniform(0.0, np.log10(30e3), len(xy))
        found, valid = camera.img_from_point(points_seen(camera, xy, depths))
        assert valid.all()  # what a ray reaches is seen
        # Pixels of up to 5700 px at 80 degrees; measured 2e-10 at worst.
        assert np.abs(found - xy).max(initial=0.0) < 1e-9
        # 99 of 100 rays are left, unless the water reflects them or the tilt is high.
        assert len(xy) > 10


def test_round_trip_near_grazing_incidence(rng):
    """89.9 degrees to the normal, the pixel being central: the port is tilted 60."""
    port = FlatPort(tilted(60.0, 0.0), 1e-6, 0.01)
    camera = pinhole(port)
    degrees = rng.uniform(85.0, 89.9, 100)
    dirs = dirs_around(port.normal, degrees, rng.uniform(0.0, 2 * np.pi, 100))
    dirs = dirs[dirs[:, 2] > 0.2]
    xy = 1000.0 * dirs[:, :2] / dirs[:, 2:]
    found, valid = camera.img_from_point(points_seen(camera, xy, np.full(len(xy), 2.0)))
    assert valid.all() and len(xy) > 20
    # 1e-16 of u = tan^2 = 3e5 is left of the slope's digits; measured 2e-9.
    assert np.abs(found - xy).max() < 1e-7


@FLAT
def test_light_takes_the_path_of_least_time(rng, port):
    if port.thickness == 0.0:
        port = replace(port, thickness=1e-9)  # the oracle needs three layers
    camera = pinhole(port)
    height = 10.0 ** rng.uniform(-1.0, 1.0, 10)
    # In the critical cone, if the camera is in the denser medium.
    reach = min(45.0, 0.8 * np.degrees(np.arcsin(min(1.0, port.n_water / port.n_air))))
    xy = 1000.0 * np.tan(np.radians(rng.uniform(-reach, reach, (10, 2)))) / np.sqrt(2)
    points = points_seen(camera, xy, height)
    points += 0.01 * height[:, None] * rng.normal(size=(10, 3))  # not only on its rays
    found, valid = camera.img_from_point(points)
    assert valid.all()
    row = port.row
    for point, pixel in zip(points, found, strict=True):
        ray = least_time_dir(point, row[:3], *row[3:8])
        # The oracle's gradient is zero to 1e-16, its curvature at least n / length.
        np.testing.assert_allclose(1000.0 * ray[:2] / ray[2], pixel, atol=2e-8)


@FLAT
def test_water_ray_is_that_of_the_papers_equations(rng, port):
    camera = pinhole(port)
    xy = 1000.0 * rng.uniform(-0.6, 0.6, (20, 2))
    xy[0] = 1000.0 * np.array(port.normal[:2]) / port.normal[2]  # along the normal
    origins, dirs = camera.ray_from_img(xy)
    rays = np.column_stack([xy / 1000.0, np.ones(20)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    row = port.row
    for i, ray in enumerate(rays):
        origin, direction = paper_water_ray(ray, row[:3], *row[3:8])
        # At normal incidence arccos leaves the paper's formulas half of the digits.
        room = 3e-8 if i == 0 else 1e-12
        np.testing.assert_allclose(dirs[i], direction, atol=room, rtol=0)
        np.testing.assert_allclose(origins[i], origin, atol=room, rtol=0)


@CAMERAS
def test_equal_indices_are_the_pinhole(camera, rng):
    port = FlatPort(tilted(5, 20), 0.03, 0.02, 1.333, 1.333, 1.333)
    refractive = RefractiveCamera(camera, port)
    margin = 0.2 * np.array([camera.width, camera.height])
    xy = rng.uniform(margin, [camera.width, camera.height] - margin, (50, 2))
    points = points_seen(refractive, xy, rng.uniform(0.1, 10.0, 50))
    found, valid = refractive.img_from_point(points)
    assert valid.all()
    in_air = camera.img_from_cam(points)
    np.testing.assert_allclose(found, in_air, rtol=1e-12, atol=1e-12 * camera.width)
    origins, dirs = refractive.ray_from_img(xy)
    np.testing.assert_allclose(np.cross(origins, dirs), 0.0, atol=1e-15)  # one centre


def test_glass_of_no_thickness_or_of_water_is_no_glass(rng):
    points = rng.uniform([-1, -1, 1], [1, 1, 3], (50, 3))
    port = FlatPort(tilted(10, 30), 0.05, 0.0, 1.0, 1.333)
    expected, _ = pinhole(port).img_from_point(points)
    no_thickness = pinhole(replace(port, n_glass=1.77))
    np.testing.assert_allclose(no_thickness.img_from_point(points)[0], expected, 1e-13)
    of_water = pinhole(replace(port, thickness=0.1, n_glass=1.333))
    np.testing.assert_allclose(of_water.img_from_point(points)[0], expected, 1e-12)
    of_air = pinhole(replace(port, distance=0.02, thickness=0.03, n_glass=1.0))
    np.testing.assert_allclose(of_air.img_from_point(points)[0], expected, 1e-12)


def test_every_failure_is_nan_with_its_reason():
    port = FlatPort(tilted(30, 0), 0.02, 0.01)
    camera = pinhole(port)
    normal = np.array(port.normal)
    side = plane_axes(normal)[0]
    nan, inf = np.nan, np.inf
    cases = [
        (0.5 * normal, Status.VALID),
        (0.019999 * normal + 0.001 * side, Status.IN_AIR_GAP),
        (0.020001 * normal + 0.001 * side, Status.IN_GLASS),
        (0.03 * normal - 1e-12 * normal, Status.IN_GLASS),
        (-0.5 * normal, Status.BEHIND_CAMERA),
        (np.zeros(3), Status.BEHIND_CAMERA),
        # In front of the port, but its ray in air comes from behind the camera.
        (np.array([1.0, 0.0, -0.5]), Status.BEHIND_CAMERA),
        ([nan, 0, 1], Status.NOT_FINITE),
        ([0, inf, 1], Status.NOT_FINITE),
    ]
    points = np.array([point for point, _ in cases])
    expected = [status for _, status in cases]
    assert camera.status_from_point(points).tolist() == expected
    xy, jac, valid = camera.img_from_point_with_jac(points)
    np.testing.assert_array_equal(camera.img_from_point(points)[0], xy)
    assert valid.tolist() == [True] + [False] * (len(cases) - 1)
    assert np.isfinite(xy[0]).all() and np.isfinite(jac[0]).all()
    assert np.isnan(xy[1:]).all() and np.isnan(jac[1:]).all()


def test_rays_that_never_reach_the_water_are_nan_with_their_reason():
    camera = pinhole(FlatPort(tilted(60, 0), 0.02, 0.01))
    across = np.tan(np.radians(-30.0))  # parallel to the tilted port
    xy = 1000.0 * np.array([[across + 0.01, 0], [across - 0.01, 0], [np.nan, 0]])
    expected = [Status.VALID, Status.MISSES_PORT, Status.NOT_FINITE]
    assert camera.status_from_img(xy).tolist() == expected

    inside_water = pinhole(FlatPort(n_air=1.333, n_water=1.0))
    critical = np.tan(np.arcsin(1.0 / 1.333))
    # Within 1 % of it, a point a millimetre away is a metre to the side.
    xy_critical = 1000.0 * np.array([[0.99 * critical, 0], [1.01 * critical, 0]])
    expected = [Status.VALID, Status.TOTAL_REFLECTION]
    assert inside_water.status_from_img(xy_critical).tolist() == expected
    for rays in (camera.ray_from_img(xy), inside_water.ray_from_img(xy_critical)):
        for part in rays:
            assert np.isfinite(part[0]).all() and np.isnan(part[1:]).all()


def test_camera_on_the_port_sees_only_the_critical_cone():
    camera = pinhole(FlatPort(distance=0.0, thickness=0.0))
    radius = np.tan(np.arcsin(1.0 / 1.333))  # of Snell's window, at one metre
    points = [[0.99 * radius, 0, 1], [(1 + 1e-9) * radius, 0, 1], [50, 0, 1]]
    xy, valid = camera.img_from_point(points)
    assert valid.tolist() == [True, False, False] and np.isnan(xy[1:]).all()
    assert camera.status_from_point(points)[1] == Status.TOTAL_REFLECTION


@PORTS
def test_compiled_kernels_equal_their_python(port, rng):
    camera = RefractiveCamera(EXAMPLE_CAMERAS[4], port)
    points = rng.uniform([-1, -1, -0.5], [1, 1, 2], (60, 3))
    points[:4] = [[0, 0, 0], [np.nan, 0, 1], port.row[:3], [0.01, 0.0, 0.055]]
    lens, row = camera.lens, port.row
    pixels = rng.uniform([-100, -100], [852, 580], (60, 2))
    for kernel, inputs in (
        (projection.project, points),
        (projection.unproject, pixels),
    ):
        for values in inputs:
            fast = np.array(kernel(*values, lens, row))
            slow = np.array(python_of(kernel)(*values, lens, row))
            np.testing.assert_allclose(fast, slow, rtol=1e-12)
            assert np.isnan(fast[1:]).all() == (fast[0] != Status.VALID)
    fast, slow = np.full((2, 10), np.nan), np.full((2, 10), np.nan)
    for values in points:
        first = projection.project_with_jac(*values, lens, row, fast)
        second = python_of(projection.project_with_jac)(*values, lens, row, slow)
        np.testing.assert_allclose(first, second, rtol=1e-12)
        np.testing.assert_allclose(fast, slow, rtol=1e-10, atol=1e-10)


def test_shapes_are_checked_and_the_port_can_be_changed():
    camera = pinhole(FlatPort())
    for call in (camera.ray_from_img, camera.img_from_point):
        with pytest.raises(InputError, match="expected"):
            call(np.zeros(3))
    assert camera.img_from_point(np.zeros((0, 3)))[0].shape == (0, 2)
    other = camera.with_port(FlatPort(distance=0.1))
    assert other.port.distance == 0.1 and camera.port.distance == 0.02
    assert other.camera is camera.camera
