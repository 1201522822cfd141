"""Tilts in the terms of the paper, and deviations of both slopes: by many draws."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made_result import (
    PORTS,
    STEEP,
    camera_covariance,
    result_of,
    small_model,
    with_ports,
)

from uwsfm.calibration.tilt import paper_tilt, slope_stddevs_deg, turn_stddevs_deg
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import FlatPort
from uwsfm.residuals import border


@pytest.fixture(scope="module")
def model():
    return small_model()


@pytest.fixture(scope="module")
def result(model):
    """Ports 23.45 and 31.7 mm away, leaning by (2, -3) and (-1, 4) degrees."""
    return result_of(with_ports(model.scene))


def test_tilts_are_those_of_the_paper(result):
    """n = (sin t cos p, sin t sin p, cos t): 2 and -3 degrees across make 3.6."""
    found = paper_tilt(result, 0)
    x, y, _ = PORTS[0].normal
    assert found.azimuth_deg == pytest.approx(math.degrees(math.atan2(y, x)))
    expected = math.degrees(math.asin(math.hypot(x, y)))
    assert found.tilt_deg == pytest.approx(expected)


def test_deviations_of_tilts_are_those_of_many_draws(result, rng):
    """Normals drawn with the covariance of their tangents, from the images and in all:
    20000 draws know a deviation to 0.5 %."""
    from uwsfm.geometry import unit_vector

    port, block = STEEP, np.array([[4.0, 1.5], [1.5, 2.0]]) * 1e-8
    columns = result.covariance.border_cols[1, border.NORMAL]
    matrix = result.covariance.border.copy()
    matrix[np.ix_(columns, columns)] = block / 2.25  # neighbours share errors
    angle = math.degrees(math.sqrt(np.trace(block)))
    cameras = (camera_covariance(2.0), camera_covariance(4.0, normal_stddev_deg=angle))
    given = result.covariance.in_all.given.copy()
    rows = border.BORDER_SIZE + np.r_[border.NORMAL]
    given[np.ix_(rows, rows)] = np.array([[3.0, -1.0], [-1.0, 7.0]]) * 1e-8
    covariance = replace(
        result.covariance,
        border=matrix,
        cameras=cameras,
        in_all=replace(result.covariance.in_all, given=given),
    )
    scene = with_ports(result.scene, (PORTS[0], STEEP))
    calibration = replace(result, scene=scene, covariance=covariance)
    own, in_all = slope_stddevs_deg(calibration, 1)
    tilt = paper_tilt(calibration, 1)
    for total, slopes, azimuth, theta in (
        (block, own, tilt.azimuth_stddev_deg, tilt.tilt_stddev_deg),
        (
            block + given[np.ix_(rows, rows)],
            in_all,
            tilt.azimuth_stddev_in_all_deg,
            tilt.tilt_stddev_in_all_deg,
        ),
    ):
        steps = rng.multivariate_normal(np.zeros(2), total, 20_000)
        normals = port.normal + steps @ unit_vector.tangent_basis(port.normal).T
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        spread = np.degrees(np.std(np.arcsin(normals[:, :2]), axis=0))
        np.testing.assert_allclose(slopes, spread, rtol=0.02)
        drawn = np.degrees(np.std(np.arctan2(normals[:, 1], normals[:, 0])))
        assert azimuth == pytest.approx(drawn, rel=0.02)
        drawn = np.degrees(np.std(np.arccos(normals[:, 2])))
        assert theta == pytest.approx(drawn, rel=0.02)


def test_a_held_tilt_has_no_deviation_and_a_wild_azimuth_half_a_turn(result):
    columns = np.full((2, border.BORDER_SIZE), -1, dtype=np.int64)
    held = replace(result.covariance, border_cols=columns, in_all=None)
    found = paper_tilt(replace(result, covariance=held), 0)
    assert found.tilt_stddev_deg is found.azimuth_stddev_in_all_deg is None
    lost = (camera_covariance(2.0, normal_stddev_deg=math.inf), camera_covariance(4.0))
    unknown = replace(result.covariance, cameras=lost)
    with np.errstate(invalid="ignore"):
        found = paper_tilt(replace(result, covariance=unknown), 0)
    assert found.tilt_stddev_deg is found.azimuth_stddev_deg is None
    straight = with_ports(result.scene, (FlatPort(distance=0.02), PORTS[1]))
    found = paper_tilt(replace(result, scene=straight), 0)
    assert found.azimuth_stddev_deg == 180.0 and found.tilt_deg == 0.0


def test_deviations_of_a_turn_are_those_of_many_draws(result, rng):
    """A camera turned by 50 degrees, whose small turns have a covariance: the rotation
    vector scatters otherwise than they do. Twice as much where neighbours share errors,
    and more with what is given."""
    turn = np.radians([20.0, -40.0, 25.0])
    block = np.array([[4.0, 1.0, 0.0], [1.0, 2.0, -0.5], [0.0, -0.5, 1.0]]) * 1e-8
    count = 3 + len(result.covariance.border)
    matrix = np.zeros((count, count))
    matrix[3:, 3:], matrix[:3, :3] = result.covariance.border, block / 4.0
    columns = np.where(result.covariance.border_cols < 0, -1, 3)
    columns[:, border.ROTATION] = (-1, -1, -1), (0, 1, 2)
    angle = math.degrees(math.sqrt(np.trace(block)))
    cameras = camera_covariance(2.0), camera_covariance(4.0, rotation_stddev_deg=angle)
    given = result.covariance.in_all.given.copy()
    rows = border.BORDER_SIZE + np.r_[border.ROTATION]
    given[np.ix_(rows, rows)] = np.diag([9.0, 1.0, 2.0]) * 1e-8
    placement = result.scene.cam_from_rig.copy()
    placement[1, :4] = rigid3.quat_from_rotvec(turn)
    calibration = replace(
        result,
        scene=replace(result.scene, cam_from_rig=placement),
        covariance=replace(
            result.covariance,
            border=matrix,
            border_cols=columns,
            cameras=cameras,
            in_all=replace(result.covariance.in_all, given=given),
        ),
    )
    own, in_all = turn_stddevs_deg(calibration, 1)
    for found, total in (own, block), (in_all, block + given[np.ix_(rows, rows)]):
        delta = np.zeros((20_000, 6))
        delta[:, :3] = rng.multivariate_normal(np.zeros(3), total, 20_000)
        turned = rigid3.perturb(placement[1], delta)
        spread = np.std(rigid3.rotvec_from_quat(turned[:, :4]), axis=0)
        np.testing.assert_allclose(found, np.degrees(spread), rtol=0.02)
    assert turn_stddevs_deg(calibration, 0) == ([None] * 3, [None] * 3)
