"""The closed-form Jacobian of the projection: every block, every lens, every port."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from jacobians import (
    CAMERA_IDS,
    EXAMPLE_CAMERAS,
    EXAMPLE_PORTS,
    FLAT_PORTS,
    check_jacobian,
    port_blocks,
)

from uwsfm import DomePort, RefractiveCamera, Status
from uwsfm.models import projection

FLAT = pytest.mark.parametrize("port", FLAT_PORTS.values(), ids=FLAT_PORTS.keys())
PORTS = pytest.mark.parametrize(
    "port", EXAMPLE_PORTS.values(), ids=EXAMPLE_PORTS.keys()
)
CAMERAS = pytest.mark.parametrize("camera", EXAMPLE_CAMERAS, ids=CAMERA_IDS)


def pinhole(port):
    """A camera whose pixels are 1000 (x/z, y/z)."""
    params = [1000.0, 0.0, 0.0]
    return RefractiveCamera(
        pycolmap.Camera(model="SIMPLE_PINHOLE", params=params), port
    )


def points_seen(camera, xy, ranges):
    """Points (N, 3) at ranges (N,) behind the glass, on the water rays of pixels."""
    origins, dirs = camera.ray_from_img(xy)
    return origins + ranges[:, None] * dirs


@FLAT
def test_image_does_not_change_with_the_scale_of_everything(port, rng):
    """J_point X + J_distance d + J_thickness t = 0: no image tells the scale."""
    camera = pinhole(port)
    points = points_seen(camera, rng.uniform(-300, 300, (30, 2)), np.full(30, 2.0))
    xy, jac, valid = camera.img_from_point_with_jac(points)
    assert valid.all()
    along_scale = np.einsum("nij,nj->ni", jac[:, :, :3], points)
    along_scale += jac[:, :, 5] * port.distance + jac[:, :, 6] * port.thickness
    # Pixels of 1000 px, differences of terms of that size.
    assert np.abs(along_scale).max() < 1e-11
    larger = pinhole(
        replace(port, distance=7 * port.distance, thickness=7 * port.thickness)
    )
    np.testing.assert_allclose(larger.img_from_point(7 * points)[0], xy, atol=1e-10)


@PORTS
@CAMERAS
def test_jacobian_of_every_block(camera, port, rng):
    refractive = RefractiveCamera(camera, port)
    size = np.array([camera.width, camera.height])
    xy = rng.uniform(0.3 * size, 0.7 * size, (6, 2))
    xy = xy[refractive.status_from_img(xy) == Status.VALID]
    points = points_seen(refractive, xy, rng.uniform(0.5, 3.0, len(xy)))
    assert len(xy) >= 4
    if isinstance(port, DomePort) and not any(port.center[:2]):
        points[0] = [0.0, 0.0, 1.0]  # on the line of centres the angles vanish
    _, jac, valid = refractive.img_from_point_with_jac(points)
    assert valid.all()

    def by_point(moved):
        return _project_row(refractive, moved, port.row)

    def by_port(row):
        return _project_row(refractive, points, row)

    check_jacobian(by_point, np.add, points, jac[:, :, :3], step=1e-4)
    for columns, plus, step in port_blocks(port):
        of_port = jac[:, :, 3:][:, :, columns]
        check_jacobian(by_port, plus, port.row, of_port, step=step)


def _project_row(camera, points, row):
    """`img_from_point` for a port row that need not be physical."""
    xy, status = np.empty((len(points), 2)), np.empty(len(points), dtype=np.uint8)
    projection.project_batch(points, camera.lens, row, xy, status)
    assert np.all(status == Status.VALID)
    return xy
