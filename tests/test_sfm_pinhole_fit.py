"""A virtual pinhole sees what the refractive camera sees, at the scene's distance."""

import numpy as np
import pycolmap
import pytest

from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import FlatPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.sfm.pinhole.mapping_database import virtual_rig
from uwsfm.sfm.rig_checks.baseline import robust_average, with_baseline
from uwsfm.sfm.rig_checks.pinhole_fit import fit_virtual_pinhole
from uwsfm.simulate.rigs import tilted_normal

DEPTHS = np.array([0.7, 1.0, 1.6])
LENSES = {
    "OPENCV": [620.0, 619.0, 404.7, 297.2, -0.052, 0.018, 2e-4, -1e-4],
    "OPENCV_FISHEYE": [760.0, 761.0, 400.0, 300.0, 0.01, -0.002, 1e-3, 0.0],
    "SIMPLE_PINHOLE": [1500.0, 400.0, 300.0],
}


def refractive(model: str, tilt_deg: float = 3.0) -> RefractiveCamera:
    lens = pycolmap.Camera(model=model, width=800, height=600, params=LENSES[model])
    return RefractiveCamera(lens, FlatPort(tilted_normal(tilt_deg, 30.0), 0.03, 0.02))


def points_at(camera: RefractiveCamera, depth: float, rng) -> np.ndarray:
    """Points at a depth, all over the image."""
    xy = rng.uniform([0.0, 0.0], [camera.width, camera.height], size=(400, 2))
    origins, dirs = camera.ray_from_img(xy)
    return origins + (depth - origins[:, 2:]) / dirs[:, 2:] * dirs


@pytest.mark.parametrize("model", LENSES)
def test_pinhole_is_exact_at_the_median_depth(model, rng):
    camera = refractive(model)
    pinhole = fit_virtual_pinhole(camera, DEPTHS)
    points = points_at(camera, DEPTHS[1], rng)
    xy, valid = camera.img_from_point(points)
    assert valid.all()
    seen = pinhole.img_from_real_img(camera, xy)
    expected = pinhole.camera().img_from_cam(points - pinhole.center_in_cam)
    # 1e-6: the iterative undistortion of COLMAP's lens models.
    np.testing.assert_allclose(seen, expected, atol=1e-6)
    assert (seen >= 0.0).all()
    assert (seen <= [pinhole.width, pinhole.height]).all()


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("depth", DEPTHS[[0, 2]])
def test_pinhole_is_subpixel_over_the_scene(model, depth, rng):
    camera = refractive(model)
    pinhole = fit_virtual_pinhole(camera, DEPTHS)
    points = points_at(camera, depth, rng)
    seen = pinhole.img_from_real_img(camera, camera.img_from_point(points)[0])
    expected = pinhole.camera().img_from_cam(points - pinhole.center_in_cam)
    errors = np.linalg.norm(seen - expected, axis=1)
    assert np.sqrt(np.mean(errors**2)) < 0.25
    assert errors.max() <= 1.2 * pinhole.max_px  # the fit looks at a grid only
    assert pinhole.max_px < 1.0


def test_centre_moves_towards_the_water_never_sideways_for_a_straight_port():
    """Between camera and glass for d > 0 (model.md: C_v lies on the port's axis)."""
    lens = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=800, height=600, params=[620.0, 400.0, 300.0]
    )
    pinhole = fit_virtual_pinhole(RefractiveCamera(lens, FlatPort()), DEPTHS)
    assert np.abs(pinhole.center_in_cam[:2]).max() < 1e-9


def test_without_refraction_the_pinhole_is_the_camera(rng):
    lens = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=800, height=600, params=[620.0, 400.0, 300.0]
    )
    port = FlatPort((0.0, 0.0, 1.0), 0.02, 0.01, n_glass=1.0, n_water=1.0)
    camera = RefractiveCamera(lens, port)
    pinhole = fit_virtual_pinhole(camera, DEPTHS)
    np.testing.assert_allclose(pinhole.center_in_cam, 0.0, atol=1e-12)
    xy = rng.uniform(0.0, 600.0, size=(50, 2))
    np.testing.assert_allclose(
        pinhole.img_from_real_img(camera, xy), xy, rtol=0, atol=1e-9
    )
    assert pinhole.rms_px < 1e-9


def test_unknown_depth_means_directions():
    camera = refractive("OPENCV")
    far = fit_virtual_pinhole(camera, None)
    very_far = fit_virtual_pinhole(camera, [1e6, 1e6, 1e6])
    xy = np.array([[0.0, 0.0], [123.0, 456.0], [800.0, 600.0]])
    np.testing.assert_allclose(
        far.img_from_real_img(camera, xy),
        very_far.img_from_real_img(camera, xy),
        atol=1e-3,
    )


def rig_and_pinholes(rng):
    quat = rigid3.quat_from_rotvec(rng.normal(scale=0.1, size=3))
    pose = np.concatenate([quat, [-0.2, 0.01, 0.02]])
    poses = np.stack([rigid3.IDENTITY, pose])
    cameras = refractive("OPENCV"), refractive("SIMPLE_PINHOLE", 1.0)
    return poses, tuple(fit_virtual_pinhole(camera, DEPTHS) for camera in cameras)


def test_virtual_rig_sees_points_from_the_virtual_centres(rng):
    poses, pinholes = rig_and_pinholes(rng)
    virtual = virtual_rig(poses, pinholes)
    np.testing.assert_array_equal(virtual[0], rigid3.IDENTITY)
    point = np.array([[0.1, -0.2, 1.3]])  # in the real rig
    in_virtual_rig = point - pinholes[0].center_in_cam
    expected = rigid3.transform(poses[1], point) - pinholes[1].center_in_cam
    np.testing.assert_allclose(
        rigid3.transform(virtual[1], in_virtual_rig), expected, atol=1e-15
    )


def test_baseline_length_gives_the_unit_of_a_virtual_rig(rng):
    poses, pinholes = rig_and_pinholes(rng)
    virtual = virtual_rig(poses, pinholes)[1]
    virtual[4:] *= 17.0  # the unit of a reconstruction without a rig
    baseline = float(np.linalg.norm(poses[1, 4:]))
    np.testing.assert_allclose(
        with_baseline(virtual, pinholes, baseline), poses, atol=1e-12
    )


def test_average_pose_ignores_frames_that_went_wrong(rng):
    poses, _ = rig_and_pinholes(rng)
    noise = rng.normal(scale=1e-3, size=(20, 6))
    frames = rigid3.perturb(np.tile(poses[1], (20, 1)), noise)
    frames[:6] = rigid3.perturb(frames[:6], rng.normal(scale=1.0, size=(6, 6)))
    error = rigid3.compose(robust_average(frames), rigid3.inverse(poses[1]))
    assert rigid3.rotation_angle(error) < 1e-3
    assert np.linalg.norm(error[4:]) < 2e-3
