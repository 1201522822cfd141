"""The perspective start against COLMAP's bundle adjustment, and what it leads to."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from test_calibrate import FAR_OFF, errors_of

from uwsfm import InputError, RefractiveCamera, calibrate
from uwsfm.calibration.perspective import perspective_adjustment
from uwsfm.colmap.model import Model, to_reconstruction
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import FlatPort
from uwsfm.simulate import ObservationOptions, Relief, perturbed, simulate_scene
from uwsfm.simulate.rigs import paper_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion


def dive(rig, num_frames=6, num_points=80, **options):
    observations = ObservationOptions(num_points=num_points, **options)
    motion = rich_motion(num_frames)
    return simulate_scene(rig, motion, Relief(stddev=0.2), observations)


def in_colmap(rig, scene):
    """The scene as a COLMAP model whose cameras are pinholes in water."""
    pinholes = tuple(
        replace(
            item,
            camera=pycolmap.Camera(
                model="RADIAL",
                width=item.camera.width,
                height=item.camera.height,
                params=[
                    item.port.n_water * item.camera.params[0],
                    *item.camera.params[1:3],
                    0.0,
                    0.0,
                ],
            ),
        )
        for item in rig.cameras
    )
    keypoints, keypoint_idx = [], np.zeros(scene.num_observations, dtype=np.int64)
    for camera in range(2):
        of_camera = []
        for frame in range(scene.num_frames):
            of_image = (scene.camera_idx == camera) & (scene.frame_idx == frame)
            keypoint_idx[of_image] = np.arange(np.count_nonzero(of_image))
            of_camera.append(scene.xy[of_image])
        keypoints.append(tuple(of_camera))
    return to_reconstruction(
        Model(
            rig=replace(rig, cameras=pinholes),
            scene=scene,
            frame_names=tuple(f"{i:04}.jpg" for i in range(scene.num_frames)),
            keypoints=tuple(keypoints),
            keypoint_idx=keypoint_idx,
            colors=np.zeros((scene.num_points, 3), dtype=np.uint8),
        )
    )


def adjusted_by_colmap(model):
    """Ceres on rig poses, relative pose, distortion and points, to its end."""
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_principal_point = False
    options.refine_extra_params = options.refine_sensor_from_rig = True
    options.print_summary = False
    options.ceres.solver_options.gradient_tolerance = 1e-10
    options.ceres.solver_options.function_tolerance = 1e-14
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    squares = []
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            in_cam = image.cam_from_world() * point.xyz
            pixel = model.cameras[image.camera_id].img_from_cam(in_cam)
            squares.append(
                np.sum((pixel - image.points2D[element.point2D_idx].xy) ** 2)
            )
    (rig,) = model.rigs.values()
    (sensor_from_rig,) = rig.non_ref_sensors.values()
    return np.array(squares), np.array(sensor_from_rig.params)


def test_colmap_reaches_the_same_optimum():
    rig = paper_rig()
    start = perturbed(dive(rig, noise_px=0.3).scene, FAR_OFF)
    squares, cam_from_rig = adjusted_by_colmap(in_colmap(rig, start))
    adjusted, summary = perspective_adjustment(start)
    assert summary.converged and summary.num_observations == len(squares)
    # Scale is a gauge: costs do not know it. Ours stops at 1e-9 of the cost.
    assert summary.rms_px == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-8)
    assert summary.rms_px > 0.4  # more than noise: pinholes do not fit water
    change = rigid3.compose(adjusted.cam_from_rig[1], rigid3.inverse(cam_from_rig))
    # A cost 1e-9 above the minimum is 3e-5 of its square root away: of 0.1 degrees.
    assert rigid3.rotation_angle(change) < 1e-6
    direction = [
        pose[4:] / np.linalg.norm(pose[4:])
        for pose in (adjusted.cam_from_rig[1], cam_from_rig)
    ]
    np.testing.assert_allclose(*direction, atol=1e-6)


@pytest.mark.parametrize("rig", [paper_rig(), sample_rig()], ids=["paper", "OPENCV"])
def test_pinholes_in_air_fit_without_a_residual(rig):
    """Nothing refracts: the start is already the answer, whatever the lens."""
    air = FlatPort(distance=0.03, thickness=0.01, n_glass=1.0, n_water=1.0)
    bare = replace(rig, cameras=tuple(replace(item, port=air) for item in rig.cameras))
    truth = dive(bare).truth
    adjusted, summary = perspective_adjustment(perturbed(truth, FAR_OFF))
    # Lenses are undone to 1e-12, 1e-9 px; the rest is the last step of the solver.
    assert summary.rms_px < 1e-8
    length, angle = errors_of(replace(adjusted, cameras=truth.cameras), truth)
    assert length < 1e-8 and angle < 1e-9


@pytest.mark.parametrize("rig", [paper_rig(), sample_rig()], ids=["paper", "OPENCV"])
def test_the_start_leads_to_the_truth(rig):
    truth = dive(rig, 8, 150).truth
    start = perturbed(truth, FAR_OFF)
    before = [np.array(camera.camera.params) for camera in start.cameras]
    adjusted, summary = perspective_adjustment(start)
    assert summary.converged and 0.1 < summary.rms_px < 1.0
    assert adjusted.cameras == start.cameras  # the same objects, ports included
    for camera, params in zip(start.cameras, before, strict=True):
        np.testing.assert_array_equal(camera.camera.params, params)
    lengths = np.linalg.norm(adjusted.cam_from_rig[:, 4:], axis=1)
    np.testing.assert_allclose(lengths, [0.0, 0.2], rtol=1e-14)
    np.testing.assert_array_equal(adjusted.xy, truth.xy)
    # Points half a pixel wrong, not 5 cm as they came.
    assert np.median(np.abs(adjusted.points - truth.points)) < 0.02
    result = calibrate(adjusted, loss="l2")
    assert result.summary.converged and result.summary.num_iterations <= 8
    length, angle = errors_of(result.scene, truth)
    assert length < 1e-8 and angle < 1e-9


def test_outliers_do_not_spoil_a_robust_start():
    rig = paper_rig()
    clean = perspective_adjustment(perturbed(dive(rig, noise_px=0.3).scene))[0]
    dirty = dive(rig, noise_px=0.3, outlier_ratio=0.1).scene
    found, summary = perspective_adjustment(perturbed(dirty), loss="cauchy")
    assert summary.num_outliers > 0.08 * dirty.num_observations
    change = rigid3.compose(
        found.cam_from_rig[1], rigid3.inverse(clean.cam_from_rig[1])
    )
    assert np.degrees(rigid3.rotation_angle(change)) < 0.2


def test_observations_without_a_ray_are_left_out():
    """A barrel lens that bends the image back at its edge: no ray ends outside."""
    rig = paper_rig()
    barrel = pycolmap.Camera(
        model="RADIAL", width=1200, height=900, params=[1000.0, 600.0, 450.0, -0.2, 0.0]
    )
    rig = replace(
        rig, cameras=tuple(replace(item, camera=barrel) for item in rig.cameras)
    )
    truth = dive(rig, num_points=40).truth
    rows = np.flatnonzero(truth.point_idx < 2)
    lost = np.append(rows[truth.point_idx[rows] == 0][1:], rows[-1:])  # one is left
    xy = truth.xy.copy()
    xy[lost] = [9000.0, 450.0]
    broken = replace(truth, xy=xy)
    assert RefractiveCamera(barrel, FlatPort()).status_from_img(xy[lost[:1]]) != 0
    found, summary = perspective_adjustment(broken)
    expected, _ = perspective_adjustment(
        truth.select(
            ~np.isin(truth.point_idx, [0]) & ~np.isin(np.arange(len(xy)), lost)
        )[0]
    )
    assert summary.num_observations == len(xy) - len(lost) - 1
    assert np.isnan(found.points[0]).all()
    np.testing.assert_allclose(found.points[1:], expected.points, atol=1e-12)
    np.testing.assert_allclose(found.cam_from_rig, expected.cam_from_rig, atol=1e-12)
    # Nothing was dropped from the scene itself.
    assert found.num_observations == truth.num_observations


def test_what_pinholes_have_not_is_refused():
    scene = dive(paper_rig()).scene
    with pytest.raises(InputError, match="needs the reprojection error"):
        perspective_adjustment(scene, error="point_3d")
    with pytest.raises(InputError, match="'refine'"):
        perspective_adjustment(scene, refine=True)
