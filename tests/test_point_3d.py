"""The error in space against triangulation by other means, and its Jacobian."""

import numpy as np
import pytest
from jacobians import EXAMPLE_CAMERAS, FLAT_PORTS, check_jacobian, tilted
from naive import nearest_point

from uwsfm import FlatPort, RefractiveCamera, Status
from uwsfm.geometry import rigid3, unit_vector
from uwsfm.geometry.rays import triangulate_tracks
from uwsfm.models.projection import water_ray_from_dir
from uwsfm.residuals.point_3d import residual, residual_with_jac
from uwsfm.solver.state import translation_arm

# Every port once, in rigs of three cameras; and in pairs as the paper's.
_NAMES = list(FLAT_PORTS)
PORTS = [FLAT_PORTS[name] for name in _NAMES]
RIGS = [PORTS[0:3], PORTS[3:6], [PORTS[6], PORTS[0]], [PORTS[1], PORTS[1]]]
IDS = ["+".join(name.split()[0] for name in _NAMES[a:b]) for a, b in ((0, 3), (3, 6))]
IDS += ["air+straight", "paper pair"]
RIG = pytest.mark.parametrize("ports", RIGS, ids=IDS)


def python_of(kernel):
    """The uncompiled function, also where NUMBA_DISABLE_JIT is set."""
    return getattr(kernel, "py_func", kernel)


class Cell:
    """One point in one frame, seen by every camera of a rig 0.2 m apart.

    Its observations are 2, 3, ... of the arrays, in the opposite order of the cameras.
    """

    def __init__(self, ports, rng, noise):
        self.point = rng.uniform((-0.3, -0.3, 1.0), (0.3, 0.3, 2.0))
        self.ports = np.array([port.row for port in ports])
        num = len(ports)
        quats = rigid3.quat_from_rotvec(0.1 * rng.normal(size=(num, 3)))
        shifts = 0.2 * np.arange(-1, num - 1)[:, None] * [1.0, 0.1, 0.05]
        shifts += 0.01 * rng.normal(size=(num, 3))
        self.cam_from_rig = np.column_stack([quats, shifts])
        self.camera = np.concatenate([[0, 0], np.arange(num)[::-1], [0]])
        self.dirs = np.full((num + 3, 3), np.nan)
        for i in self.observations:
            self.dirs[i] = self._seen_by(self.camera[i], ports, noise, rng)

    @property
    def observations(self):
        return range(2, 2 + len(self.ports))

    def _seen_by(self, c, ports, noise, rng):
        """Direction in air, by the projection of a pinhole, and noise in radians."""
        pinhole = RefractiveCamera(EXAMPLE_CAMERAS[0], ports[c])
        in_cam = rigid3.transform(self.cam_from_rig[c], self.point)
        xy, valid = pinhole.img_from_point(in_cam[None])
        assert valid.all()
        direction = EXAMPLE_CAMERAS[0].cam_ray_from_img(xy[0])
        direction = direction / np.linalg.norm(direction) + noise * rng.normal(size=3)
        return direction / np.linalg.norm(direction)

    def error(self, x=None, kernel=residual):
        """(status, e (3,)), at other values x = (point, cam_from_rig, ports)."""
        point, cams, ports = x or (self.point, self.cam_from_rig, self.ports)
        status, *error = kernel(
            *point,
            self.dirs,
            self.camera,
            self.observations.start,
            self.observations.stop,
            rigid3.matrix_rows(cams),
            ports,
        )
        return status, np.array(error)

    def with_jac(self, kernel=residual_with_jac):
        j_border = np.full((len(self.ports) + 1, 3, 14), np.nan)
        status, *error = kernel(
            *self.point,
            self.dirs,
            self.camera,
            self.observations.start,
            self.observations.stop,
            rigid3.matrix_rows(self.cam_from_rig),
            np.array([translation_arm(pose[4:]) for pose in self.cam_from_rig]),
            self.ports,
            j_border,
        )
        return status, np.array(error), j_border

    def rays_in_rig(self):
        """Origins and unit directions (N, 3), by the refraction of `projection`."""
        rays = []
        for i in self.observations:
            c = self.camera[i]
            status, *ray = water_ray_from_dir(*self.dirs[i], self.ports[c])
            assert status == Status.VALID
            rig_from_cam = rigid3.inverse(self.cam_from_rig[c])
            rays.append(
                (
                    rigid3.transform(rig_from_cam, ray[:3]),
                    rigid3.rotate(rig_from_cam, ray[3:]),
                )
            )
        return (np.array(column) for column in zip(*rays, strict=True))


@RIG
def test_is_the_triangulated_point_minus_the_point(ports, rng):
    cell = Cell(ports, rng, noise=0.01)
    origins, dirs = cell.rays_in_rig()
    index = np.zeros(len(origins), dtype=int)
    status, error = cell.error()
    assert status == Status.VALID
    assert np.abs(error).max() > 1e-3  # noise of 0.01 rad at more than a metre
    # The conditioning of rays a tenth of a radian apart costs two digits.
    for met in (
        triangulate_tracks(origins, dirs, index, 1)[0],
        nearest_point(origins, dirs),
    ):
        np.testing.assert_allclose(cell.point + error, met, rtol=0, atol=1e-12)


@RIG
def test_is_zero_at_exact_observations(ports, rng):
    for _ in range(5):
        status, error = Cell(ports, rng, noise=0.0).error()
        assert status == Status.VALID
        # Pixels of thousands are exact to 1e-12, directions to 1e-15.
        assert np.abs(error).max() < 1e-12


@RIG
def test_jacobian_of_the_point_and_of_every_camera(ports, rng):
    cell = Cell(ports, rng, noise=0.01)
    start = (cell.point, cell.cam_from_rig, cell.ports)
    status, error, j_border = cell.with_jac()
    assert status == Status.VALID
    np.testing.assert_allclose(error, cell.error()[1], rtol=0, atol=1e-15)
    # Neither the lens's columns nor the entries beyond the cell are ours.
    assert np.isnan(j_border[:, :, 12:]).all() and np.isnan(j_border[-1]).all()

    def values(x):
        status, error = cell.error(x)
        assert status == Status.VALID
        return error

    def check(jac, plus, step=1e-4):
        check_jacobian(values, plus, start, jac, step=step)

    check(-np.eye(3), lambda x, d: (x[0] + d, *x[1:]))
    for jac, i in zip(j_border, cell.observations, strict=False):
        c = cell.camera[i]
        check(jac[:, 0:3], _at(1, c, _turned))
        check(jac[:, 3:6], _at(1, c, _shifted))
        check(jac[:, 6:8], _at(2, c, _tilted))
        steps = (1e-4, 1e-4, 1e-5, 1e-4)
        for column, slot, step in zip((8, 9, 10, 11), (3, 7, 4, 6), steps, strict=True):
            shift = np.eye(9)[slot]
            check(
                jac[:, [column]], _at(2, c, lambda row, d, s=shift: row + d * s), step
            )


def _at(block, camera, plus):
    """A step of one camera's row in block 1 (cam_from_rig) or 2 (ports)."""

    def step(x, delta):
        rows = x[block].copy()
        rows[camera] = plus(rows[camera], delta)
        return *x[:block], rows, *x[block + 1 :]

    return step


def _turned(pose, delta):
    quat = rigid3.multiply_quats(rigid3.quat_from_rotvec(delta), pose[:4])
    return np.concatenate([quat, pose[4:]])


def _shifted(pose, delta):
    length = np.linalg.norm(pose[4:])
    direction = unit_vector.plus(pose[4:] / length, delta[:2])
    return np.concatenate([pose[:4], (length + delta[2]) * direction])


def _tilted(row, delta):
    return np.concatenate([unit_vector.plus(row[:3], delta), row[3:]])


@RIG
def test_interpreted_and_compiled_kernels_agree(ports, rng):
    cell = Cell(ports, rng, noise=0.01)
    fast, slow = cell.with_jac(), cell.with_jac(python_of(residual_with_jac))
    assert fast[0] == slow[0] == Status.VALID
    for compiled, interpreted in zip(fast[1:], slow[1:], strict=True):
        np.testing.assert_allclose(compiled, interpreted, rtol=1e-10, atol=1e-12)


def _squinting(cell, angle):
    """Two cameras side by side, their axes turned outwards by an angle (radians)."""
    cell.cam_from_rig = np.array([rigid3.IDENTITY, rigid3.IDENTITY])
    cell.cam_from_rig[1, 4] = -0.2
    cell.ports = np.array([FlatPort().row] * 2)
    cell.dirs[2:4] = np.sin(angle), 0.0, np.cos(angle)
    cell.dirs[3, 0] *= -1.0


def test_cells_without_an_intersection_are_nan_with_their_reason(rng):
    def spoil(status, change):
        cell = Cell([PORTS[1], PORTS[1]], rng, noise=1e-3)
        change(cell)
        return status, cell

    def lose(cell):
        cell.dirs[3] = np.nan

    def turn_away(cell):
        cell.ports[0, :3] = -cell.ports[0, :3]

    def invert(cell):
        cell.ports[1] = FlatPort(tilted(60, 0), n_air=1.5, n_water=1.0).row

    def blow_up(cell):
        cell.point[1] = np.nan

    cases = [
        spoil(Status.VALID, lambda cell: _squinting(cell, -0.1)),
        spoil(Status.NO_INTERSECTION, lambda cell: _squinting(cell, 0.0)),
        spoil(Status.BEHIND_CAMERA, lambda cell: _squinting(cell, 0.1)),
        spoil(Status.OUTSIDE_LENS, lose),
        spoil(Status.MISSES_PORT, turn_away),
        spoil(Status.TOTAL_REFLECTION, invert),
        spoil(Status.NOT_FINITE, blow_up),
    ]
    for expected, cell in cases:
        results = [
            cell.error(),
            cell.error(kernel=python_of(residual)),
            cell.with_jac(),
            cell.with_jac(python_of(residual_with_jac)),
        ]
        for status, error, *_ in results:
            assert status == expected
            assert np.isnan(error).all() == (expected != Status.VALID)


@pytest.mark.parametrize("num_rays", [0, 1])
def test_one_ray_fixes_no_point(num_rays, rng):
    cell = Cell([PORTS[1], PORTS[1]], rng, noise=0.0)
    cams = rigid3.matrix_rows(cell.cam_from_rig)
    for kernel in (residual, python_of(residual)):
        status, *error = kernel(
            *cell.point, cell.dirs, cell.camera, 2, 2 + num_rays, cams, cell.ports
        )
        assert status == Status.NO_INTERSECTION
        assert np.isnan(error).all()
