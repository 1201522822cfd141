"""The error on the outer interface against the paper's equations, and its Jacobian."""

from itertools import product

import numpy as np
import pytest
from jacobians import EXAMPLE_CAMERAS, FLAT_PORTS, check_jacobian, tilted
from naive import least_time_dir, paper_virtual_error

from uwsfm import FlatPort, RefractiveCamera, Status
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.residuals.virtual_camera import residual, residual_with_jac
from uwsfm.solver.state import translation_arm

SAGITTAL, TANGENTIAL = 0, 1
SHEETS = pytest.mark.parametrize(
    "sheet", [SAGITTAL, TANGENTIAL], ids=["sagittal", "tangential"]
)
PORTS = pytest.mark.parametrize("port", FLAT_PORTS.values(), ids=FLAT_PORTS)
UNMOVED = rigid3.matrix_rows(rigid3.IDENTITY)


def python_of(kernel):
    """The uncompiled function, also where NUMBA_DISABLE_JIT is set."""
    return getattr(kernel, "py_func", kernel)


def on_interface(point_in_cam, air_dir, port, sheet):
    status, *error = residual(*point_in_cam, air_dir, UNMOVED, port.row, sheet)
    assert status == Status.VALID
    return np.array(error)


@SHEETS
@PORTS
def test_equals_the_virtual_camera_of_the_paper(port, sheet, rng):
    lens = EXAMPLE_CAMERAS[4]
    camera, normal = RefractiveCamera(lens, port), np.array(port.normal)
    xy_seen = rng.uniform((0, 0), (lens.width, lens.height), (20, 2))
    xy_seen = xy_seen[camera.status_from_img(xy_seen) == Status.VALID]
    assert len(xy_seen) >= 10  # the port with air outside reflects the others
    for xy in xy_seen:
        origin, ray = (rows[0] for rows in camera.ray_from_img(xy[None]))
        center = camera.caustic(xy[None])[sheet][0]
        # Up to 0.5 m off the ray: a residual as before any calibration.
        point = origin + rng.uniform(0.5, 3.0) * ray + 0.3 * rng.uniform(-1, 1, 3)
        expected, virtual_from_cam = paper_virtual_error(
            point, origin, ray, center, normal
        )
        air_dir = lens.cam_ray_from_img(xy)
        air_dir /= np.linalg.norm(air_dir)
        error = on_interface(point, air_dir, port, sheet)
        # Rounding of coordinates of metres; the residual is of millimetres.
        np.testing.assert_allclose(virtual_from_cam @ error, expected, atol=1e-14)
        assert abs(normal @ error) < 1e-15  # it lies in the interface


@SHEETS
@pytest.mark.parametrize("name", [name for name in FLAT_PORTS if name != "no glass"])
def test_is_zero_on_the_path_of_least_time(name, sheet, rng):
    port = FLAT_PORTS[name]  # the oracle divides by the length of every leg
    for _ in range(5):
        point = rng.uniform((-0.7, -0.7, 1.0), (0.7, 0.7, 3.0))
        air_dir = least_time_dir(
            point,
            port.normal,
            port.distance,
            port.thickness,
            port.n_air,
            port.n_glass,
            port.n_water,
        )
        # Fermat's direction has 1e-14 rad, over 3 m and shrunk by the port.
        assert np.abs(on_interface(point, air_dir, port, sheet)).max() < 1e-14


@SHEETS
def test_without_refraction_it_is_the_pinhole_with_the_interface_as_image(sheet, rng):
    port = FlatPort(tilted(15, 70), 0.02, 0.03, 1.0, 1.0)
    normal, air_dir = np.array(port.normal), np.array([0.3, -0.2, 0.933])
    air_dir /= np.linalg.norm(air_dir)
    for point in rng.uniform((-1, -1, 0.5), (1, 1, 3), (10, 3)):
        hit, seen = (0.05 * x / (normal @ x) for x in (point, air_dir))
        error = on_interface(point, air_dir, port, sheet)
        np.testing.assert_allclose(error, hit - seen, atol=1e-16)


def scene_row(camera, port, rng):
    """(point in the rig, direction in air, cam_from_rig); the point off its ray."""
    quat = rigid3.quat_from_rotvec(0.2 * rng.normal(size=3))
    cam_from_rig = np.concatenate([quat, 0.2 * rng.normal(size=3)])
    xy = rng.uniform(0.2, 0.8, 2) * (camera.width, camera.height)
    air_dir = camera.cam_ray_from_img(xy)
    air_dir /= np.linalg.norm(air_dir)
    origins, rays = RefractiveCamera(camera, port).ray_from_img(xy[None])
    in_cam = origins[0] + rng.uniform(0.5, 3.0) * rays[0] + 0.05 * rng.normal(size=3)
    return rigid3.transform(rigid3.inverse(cam_from_rig), in_cam), air_dir, cam_from_rig


def with_jac(point, air_dir, cam_from_rig, params, sheet, kernel=residual_with_jac):
    j_rig, j_border = np.full((3, 3), np.nan), np.full((3, 14), np.nan)
    status, *error = kernel(
        *point,
        air_dir,
        rigid3.matrix_rows(cam_from_rig),
        translation_arm(cam_from_rig[4:]),
        params,
        sheet,
        j_rig,
        j_border,
    )
    return status, np.array(error), j_rig, j_border


@SHEETS
@PORTS
@pytest.mark.parametrize("camera", EXAMPLE_CAMERAS[3::2], ids=lambda c: c.model_name)
def test_jacobian_of_the_point_the_camera_pose_and_the_housing(
    camera, port, sheet, rng
):
    point, air_dir, cam_from_rig = scene_row(camera, port, rng)
    start = (point, cam_from_rig, port.row)

    def error(x):
        cam = rigid3.matrix_rows(x[1])
        status, *e = residual(*x[0], air_dir, cam, x[2], sheet)
        assert status == Status.VALID
        return np.array(e)

    status, e, j_rig, j_border = with_jac(point, air_dir, cam_from_rig, port.row, sheet)
    assert status == Status.VALID
    # The same digits; only the order of the compiled sums may differ.
    np.testing.assert_allclose(e, error(start), rtol=0, atol=1e-15)
    assert np.isnan(j_border[:, 12:]).all()  # the lens's columns are not ours

    def check(jac, plus, step=1e-4):
        check_jacobian(error, plus, start, jac, step=step)

    check(j_rig, lambda x, d: (x[0] + d, *x[1:]))
    check(j_border[:, 0:3], _with_rotation)
    check(j_border[:, 3:6], _with_translation)
    check(j_border[:, 6:8], _with_normal)
    # A distance is as small as 0.1 mm here: its differences pass through zero.
    steps = (1e-4, 1e-4, 1e-5, 1e-4)
    for column, slot, step in zip((8, 9, 10, 11), (3, 7, 4, 6), steps, strict=True):
        shift = np.eye(9)[slot]
        check(j_border[:, [column]], lambda x, d, s=shift: (*x[:2], x[2] + d * s), step)


def _with_rotation(x, delta):
    quat = rigid3.multiply_quats(rigid3.quat_from_rotvec(delta), x[1][:4])
    return x[0], np.concatenate([quat, x[1][4:]]), x[2]


def _with_translation(x, delta):
    length = np.linalg.norm(x[1][4:])
    direction = unit_vector.plus(x[1][4:] / length, delta[:2])
    shift = (length + delta[2]) * direction
    return x[0], np.concatenate([x[1][:4], shift]), x[2]


def _with_normal(x, delta):
    return *x[:2], np.concatenate([unit_vector.plus(x[2][:3], delta), x[2][3:]])


@SHEETS
@PORTS
def test_grows_with_the_scale_of_everything(port, sheet, rng):
    """e is homogeneous: J_point X + J_distance d + J_thickness t = e. A smaller housing
    alone makes a smaller error, which a pixel does not."""
    point, air_dir, _ = scene_row(EXAMPLE_CAMERAS[1], port, rng)
    _, error, j_point, j_border = with_jac(
        point, air_dir, rigid3.IDENTITY, port.row, sheet
    )
    along_scale = j_point @ point
    along_scale += j_border[:, 8] * port.distance + j_border[:, 10] * port.thickness
    np.testing.assert_allclose(along_scale, error, atol=1e-14)


@PORTS
def test_interpreted_and_compiled_kernels_agree(port, rng):
    for camera, sheet in product(EXAMPLE_CAMERAS[:3], (SAGITTAL, TANGENTIAL)):
        row = scene_row(camera, port, rng)
        fast = with_jac(*row, port.row, sheet)
        slow = with_jac(*row, port.row, sheet, python_of(residual_with_jac))
        assert fast[0] == slow[0] == Status.VALID
        for compiled, interpreted in zip(fast[1:], slow[1:], strict=True):
            np.testing.assert_allclose(compiled, interpreted, rtol=1e-10, atol=1e-13)


@SHEETS
def test_what_cannot_be_projected_is_nan_with_its_reason(sheet):
    port = FlatPort(tilted(10, 0), 0.02, 0.01)
    dense_inside = FlatPort(n_air=1.5, n_glass=1.5, n_water=1.333)
    thin_glass = FlatPort(n_air=1.5, n_glass=1.333, n_water=1.5)
    ahead, far, aside = np.array([[0, 0, 1.0], [0, 0, 2.0], [1.0, 0, 0]])
    oblique = np.array([0.96, 0.0, 0.28])
    cases = [
        (far, ahead, port, Status.VALID),
        (far, aside, FlatPort(tilted(10, 180)), Status.MISSES_PORT),
        (far, np.full(3, np.nan), port, Status.OUTSIDE_LENS),
        (far, oblique, dense_inside, Status.TOTAL_REFLECTION),
        (far, oblique, thin_glass, Status.TOTAL_REFLECTION),
        (-far, ahead, port, Status.BEHIND_CAMERA),
        ([0.0, np.inf, 1.0], ahead, port, Status.NOT_FINITE),
    ]
    for point, air_dir, housing, expected in cases:
        for kernel in (residual_with_jac, python_of(residual_with_jac)):
            status, error, _, _ = with_jac(
                point, air_dir, rigid3.IDENTITY, housing.params, sheet, kernel
            )
            assert status == expected
            assert np.isnan(error).all() == (expected != Status.VALID)
        for kernel in (residual, python_of(residual)):
            status, *error = kernel(*point, air_dir, UNMOVED, housing.params, sheet)
            assert status == expected
            assert np.isnan(error).all() == (expected != Status.VALID)
