"""A central model of a refractive one: exact without noise, and stock tools agree."""

import json
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.ndimage import map_coordinates
from sfm_scenes import model_of

import uwsfm
from uwsfm.colmap.model import Model, to_reconstruction
from uwsfm.export.image_depth import ImageDepth
from uwsfm.export.pinhole import (
    PinholeModel,
    img_from_virtual,
    pinhole_model,
    virtual_from_img,
)
from uwsfm.export.pinhole_files import export_pinhole, pinhole_report
from uwsfm.geometry import rigid3
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


def simulated(noise_px: float, num_points: int = 1500) -> Model:
    rig = sample_rig()
    relief = Relief(stddev=0.1, correlation_length=0.4, seed=1)
    options = ObservationOptions(num_points=num_points, noise_px=noise_px, seed=2)
    scene = simulate_scene(rig, rich_motion(4), relief, options).scene
    return model_of(rig, scene)


@pytest.fixture(scope="module")
def exact() -> Model:
    return simulated(0.0)


@pytest.fixture(scope="module")
def noisy() -> Model:
    return simulated(0.4)


@pytest.fixture(scope="module")
def found_exact(exact) -> PinholeModel:
    return pinhole_model(exact)


@pytest.fixture(scope="module")
def found(noisy) -> PinholeModel:
    return pinhole_model(noisy)


def test_points_without_noise_project_onto_their_keypoints(found_exact):
    """Through a model that knows nothing of ports: COLMAP's own projection."""
    found = to_reconstruction(found_exact.model)
    worst = 0.0
    for image in found.images.values():
        assert found.cameras[image.camera_id].model_name == "PINHOLE"
        for point2d in image.points2D:
            if point2d.has_point3D():
                xyz = found.points3D[point2d.point3D_id].xyz
                worst = max(
                    worst, np.linalg.norm(image.project_point(xyz) - point2d.xy)
                )
    assert worst < 1e-6  # the iterative undistortion of the lens, as in the simulator


def test_points_stay_and_poses_move_to_the_virtual_centres(noisy, found):
    scene, virtual = noisy.scene, found.model.scene
    np.testing.assert_array_equal(virtual.points, scene.points)
    np.testing.assert_array_equal(found.model.colors, noisy.colors)
    for c in range(2):
        center = found.pinholes[c].center_in_cam
        for f in range(scene.num_frames):
            real = rigid3.compose(scene.cam_from_rig[c], scene.rig_from_world[f])
            moved = rigid3.compose(virtual.cam_from_rig[c], virtual.rig_from_world[f])
            np.testing.assert_allclose(
                rigid3.transform(rigid3.inverse(real), center),
                rigid3.inverse(moved)[4:],
                atol=1e-14,
            )


def test_keypoints_keep_their_residuals(noisy, found):
    """In virtual pixels: as large in the centre, larger towards the corners."""
    ratio = found.model.errors_px() / noisy.errors_px()
    assert 0.85 < np.median(ratio) < 1.0
    assert ratio.max() < 1.1
    assert found.num_dropped_keypoints == found.num_dropped_observations == 0
    counts = [len(k) for c in found.model.keypoints for k in c]
    assert counts == [len(k) for c in noisy.keypoints for k in c]


def test_stock_bundle_adjustment_finds_the_model_again(found_exact, rng):
    found = to_reconstruction(found_exact.model)
    for point in found.points3D.values():
        point.xyz += rng.normal(scale=5e-3, size=3)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = True
    options.refine_sensor_from_rig = False
    options.print_summary = False
    focal = [camera.params.copy() for camera in found.cameras.values()]
    pycolmap.bundle_adjustment(found, options)
    found.update_point_3d_errors()
    assert found.compute_mean_reprojection_error() < 1e-3  # where ceres stops
    for camera, before in zip(found.cameras.values(), focal, strict=True):
        np.testing.assert_allclose(camera.params, before, rtol=1e-4)


def test_stock_triangulation_finds_the_points_again(found_exact):
    found = to_reconstruction(found_exact.model)
    for point_id in sorted(found.points3D)[::100]:
        point = found.points3D[point_id]
        images = [found.images[e.image_id] for e in point.track.elements]
        rays = [
            found.cameras[image.camera_id].cam_ray_from_img(
                image.points2D[element.point2D_idx].xy[None]
            )[0]
            for image, element in zip(images, point.track.elements, strict=True)
        ]
        poses = [image.cam_from_world().matrix() for image in images]
        xyz = pycolmap.triangulate_multi_view_point(poses, np.array(rays))
        np.testing.assert_allclose(xyz, point.xyz, atol=1e-7)


def test_warp_and_its_inverse_agree(noisy, found, rng):
    """Real pixel to virtual and back, whatever the depth between the points is."""
    camera, pinhole, depth = noisy.scene.cameras[1], found.pinholes[1], found.depths[1]
    xy = rng.uniform([0.0, 0.0], [camera.width, camera.height], size=(500, 2))
    virtual = virtual_from_img(camera, pinhole, xy, depth[2])
    back, valid = img_from_virtual(camera, pinhole, virtual, depth[2])
    assert valid.all()
    # What three fixed-point iterations leave.
    np.testing.assert_allclose(back, xy, atol=1e-3)


def test_refraction_is_gone_where_no_point_was(found_exact):
    """At points left out, and better than a pinhole at one depth in every image."""
    report = pinhole_report(found_exact)
    assert report["max_px"] < 0.3
    assert report["rms_px"] < 0.2 * report["constant_rms_px"]
    for image in report["images"]:
        assert image["rms_px"] < image["constant_rms_px"]
        assert 0 < image["num_extrapolated"] < 0.2 * image["num_points"]


def test_planes_have_exact_depths_between_their_points(rng):
    """Inverse depth is linear on a plane that a pinhole sees."""
    xy = rng.uniform(0.0, 500.0, size=(60, 2))
    plane = np.array([1e-3, -4e-4])
    depth = ImageDepth(xy, 0.8 + xy @ plane, (500, 500), 1.0)
    asked = rng.uniform(100.0, 400.0, size=(50, 2))
    assert depth.is_between_points(asked).all()
    np.testing.assert_allclose(depth.inverse(asked), 0.8 + asked @ plane, rtol=1e-12)
    corners = np.array([[0.0, 0.0], [500.0, 500.0], [-300.0, 900.0]])
    assert not depth.is_between_points(corners).any()
    assert np.all((depth.inverse(corners) > 0.6) & (depth.inverse(corners) < 1.3))


@pytest.mark.parametrize("count", [0, 1, 3, 9])
def test_images_with_few_points_have_one_depth(count):
    """Points in a row have no triangles either."""
    xy = np.arange(count)[:, None] * np.array([10.0, 5.0])
    depth = ImageDepth(xy, np.full(count, 0.5), (100, 100), 0.25)
    asked = np.array([[3.0, 4.0], [np.nan, 1.0]])
    np.testing.assert_array_equal(
        depth.inverse(asked), [0.5 if count else 0.25, np.nan]
    )
    assert not depth.is_between_points(asked).any()


def write_images(model: Model, folder: Path) -> None:
    """Images whose grey value is a coordinate: 16 bits, 64 levels per pixel."""
    for c, camera in enumerate(model.scene.cameras):
        value = (np.arange(camera.width) + 0.5) * 64
        image = np.tile(value.astype(np.uint16), (camera.height, 1))
        for f in range(model.scene.num_frames):
            path = folder / model.image_name(c, f)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), image)


def test_folder_holds_what_dense_tools_expect(exact, tmp_path):
    model = exact
    names = tuple(name.replace(".jpg", ".png") for name in model.frame_names)
    model = Model(**{**vars(model), "frame_names": names})
    write_images(model, tmp_path / "images")
    found = export_pinhole(model, tmp_path / "out", tmp_path / "images")
    stock = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    assert stock.num_reg_images() == 8
    assert stock.compute_mean_reprojection_error() < 1e-6
    for image in stock.images.values():
        path = tmp_path / "out" / "images" / image.name
        warped = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        mask = cv2.imread(str(tmp_path / "out" / "masks" / f"{image.name}.png"), 0)
        camera = stock.cameras[image.camera_id]
        assert warped.shape == mask.shape == (camera.height, camera.width)
        assert set(np.unique(mask)) == {0, 255}
    # The grey value of a virtual pixel tells which real column it shows.
    c, f = 0, 1
    rows = (model.scene.camera_idx == c) & (model.scene.frame_idx == f)
    real = model.scene.xy[rows]
    virtual = found.model.scene.xy[rows]
    name = model.image_name(c, f)
    warped = cv2.imread(str(tmp_path / "out" / "images" / name), cv2.IMREAD_UNCHANGED)
    size = model.rig.cameras[c].camera.width, model.rig.cameras[c].camera.height
    inner = np.all((real > 20) & (real < np.array(size) - 20), axis=1)
    at = virtual[inner, ::-1].T - 0.5
    shown = map_coordinates(warped.astype(np.float64), at, order=1) / 64
    # What OpenCV's Lanczos resampling makes of a ramp, and steps of 1/64 px.
    error = np.abs(shown - real[inner, 0])
    assert np.quantile(error, 0.99) < 0.04
    assert error.max() < 0.3  # between near points of different depth
    report = json.loads((tmp_path / "out" / "pinhole.json").read_text())
    assert {image["name"] for image in report["images"]} == {
        image.name for image in stock.images.values()
    }
    assert all(0.5 < image["share_between_points"] < 1 for image in report["images"])


def test_mistakes_end_in_one_sentence_and_no_folder(exact, tmp_path):
    with pytest.raises(uwsfm.InputError, match="nowhere: no such folder of images"):
        export_pinhole(exact, tmp_path / "out", tmp_path / "nowhere")
    (tmp_path / "images").mkdir()
    with pytest.raises(uwsfm.InputError, match=r"left/0000.jpg: no such image"):
        export_pinhole(exact, tmp_path / "out", tmp_path / "images")
    for c in range(2):
        for f in range(4):
            path = tmp_path / "images" / exact.image_name(c, f)
            path.parent.mkdir(exist_ok=True)
            cv2.imwrite(str(path), np.zeros((30, 40), dtype=np.uint8))
    with pytest.raises(uwsfm.InputError, match="is 40 x 30, but its camera takes"):
        export_pinhole(exact, tmp_path / "out", tmp_path / "images")
    assert {path.name for path in tmp_path.iterdir()} == {"images"}
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").touch()
    with pytest.raises(uwsfm.InputError, match="out exists already"):
        export_pinhole(exact, tmp_path / "out")


def test_a_camera_without_points_is_named(exact):
    scene, points = exact.scene.select(exact.scene.camera_idx == 0)
    half = Model(
        **{
            **vars(exact),
            "scene": scene,
            "keypoint_idx": exact.keypoint_idx[exact.scene.camera_idx == 0],
            "colors": exact.colors[points],
        }
    )
    with pytest.raises(uwsfm.InputError, match="camera right sees no point"):
        pinhole_model(half)
