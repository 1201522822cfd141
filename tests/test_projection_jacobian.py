"""The closed-form Jacobian of the projection, for every block, lens and port."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from jacobians import CAMERA_IDS, EXAMPLE_CAMERAS, EXAMPLE_PORTS, check_jacobian

from uwsfm import RefractiveCamera, Status
from uwsfm.geometry import unit_vector
from uwsfm.models import projection

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


def points_seen(camera, xy, depths):
    """Points (N, 3) at depths (N,) behind the glass, on the water rays of pixels."""
    origins, dirs = camera.ray_from_img(xy)
    return origins + (depths / (dirs @ camera.port.normal))[:, None] * dirs


@PORTS
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
    _, jac, valid = refractive.img_from_point_with_jac(points)
    assert valid.all()
    start = (points, port.row)

    def check(columns, plus, step=1e-4):
        def pixels(x):
            return _project_row(refractive, *x)

        check_jacobian(pixels, plus, start, jac[:, :, columns], step=step)

    check(slice(0, 3), lambda x, delta: (x[0] + delta, x[1]))
    check(slice(3, 5), _with_normal)
    # Distance and thickness may pass through zero: the model is smooth there.
    for column, slot, step in ((5, 3, 1e-5), (6, 4, 1e-5), (7, 6, 1e-4), (8, 7, 1e-4)):
        shift = np.eye(9)[slot]
        check([column], lambda x, d, s=shift: (x[0], x[1] + d * s), step)


def _with_normal(x, delta):
    moved = unit_vector.plus(x[1][:3], delta)
    return x[0], np.concatenate([moved, x[1][3:]])


def _project_row(camera, points, row):
    """`img_from_point` for a port row that need not be physical."""
    xy, status = np.empty((len(points), 2)), np.empty(len(points), dtype=np.uint8)
    projection.project_batch(points, camera.lens, row, xy, status)
    assert np.all(status == Status.VALID)
    return xy
