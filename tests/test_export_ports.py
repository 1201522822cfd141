"""Exports of domes, cameras without a port, and rigs of one camera."""

from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from sfm_scenes import model_of

import uwsfm
from uwsfm.colmap.model import Model, to_reconstruction
from uwsfm.export.pinhole import PinholeModel, pinhole_model
from uwsfm.export.pinhole_files import export_pinhole, pinhole_report
from uwsfm.export.refractive_colmap import export_refractive_colmap
from uwsfm.export.scene_ply import export_scene_ply
from uwsfm.export.warp import warp_maps
from uwsfm.models.ports.port import Port
from uwsfm.rig.rig import Rig
from uwsfm.sfm.from_colmap.refractive_colmap import read_refractive_colmap
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion

DECENTRED = uwsfm.DomePort((0.005, -0.004, 0.02), 0.06, 0.008)
FLAT = uwsfm.FlatPort((0.0, 0.0, 1.0), 0.06, 0.01)
FISHEYE = pycolmap.Camera(
    model="OPENCV_FISHEYE",
    width=400,
    height=300,
    params=[130.0, 130.0, 200.0, 150.0, 0.0, 0.0, 0.0, 0.0],
)


def rig_with(*ports: Port, lens: pycolmap.Camera | None = None) -> Rig:
    rig = sample_rig()
    cameras = tuple(
        replace(
            camera,
            camera=lens or camera.camera,
            port=port,
            refine_normal=False,
            refine_distance=False,
        )
        for camera, port in zip(rig.cameras, ports, strict=False)
    )
    baseline = rig.baseline_m if len(ports) > 1 else None
    poses = np.array(rig.cam_from_rig)[: len(ports)]
    return Rig(cameras=cameras, cam_from_rig=poses, baseline_m=baseline)


RIGS = {
    "dome and none": rig_with(DECENTRED, uwsfm.NoPort()),
    "dome and flat": rig_with(DECENTRED, FLAT),
    "one flat": rig_with(FLAT),
    "one dome, fisheye": rig_with(DECENTRED, lens=FISHEYE),
}


@pytest.fixture(scope="module", params=RIGS)
def model(request) -> Model:
    relief = Relief(stddev=0.1, correlation_length=0.4, seed=1)
    options = ObservationOptions(num_points=700, noise_px=0.0, seed=2)
    rig = RIGS[request.param]
    return model_of(rig, simulate_scene(rig, rich_motion(4), relief, options).scene)


@pytest.fixture(scope="module")
def found(model) -> PinholeModel:
    return pinhole_model(model)


def is_fisheye(model: Model) -> bool:
    return model.scene.cameras[0].camera.model_name == "OPENCV_FISHEYE"


def test_pinholes_see_the_points_without_refraction(model, found):
    assert found.model.errors_px().max() < 1e-6  # the lenses' iterative undistortion
    stock = to_reconstruction(found.model)
    stock.update_point_3d_errors()
    assert stock.compute_mean_reprojection_error() < 1e-6
    assert stock.num_images() == 4 * len(model.scene.cameras)
    report = pinhole_report(found)
    assert report["max_px"] < 0.3
    assert report["rms_px"] < 0.5 * report["constant_rms_px"] + 1e-6
    # The fisheye sees points beyond 75 degrees, where no pinhole does.
    dropped = report["num_dropped_observations"]
    assert (
        (0 < dropped < 0.3 * len(model.scene.xy)) if is_fisheye(model) else not dropped
    )


def test_pinhole_images_have_the_size_of_the_real_ones(model, found):
    """Wherever a dome hardly magnifies; a fisheye's pinhole ends at 75 degrees."""
    for c, pinhole in enumerate(found.pinholes):
        camera = model.scene.cameras[c]
        assert 0.8 * camera.width < pinhole.width
        assert pinhole.width < (8.0 if is_fisheye(model) else 1.3) * camera.width


def test_maps_show_the_points_where_the_pinhole_sees_them(model, found):
    scene, c, f = model.scene, 0, 1
    maps, known = warp_maps(scene.cameras[c], found.pinholes[c], found.depths[c][f])
    virtual, xy = found.model.scene, found.model.scene.xy
    rows = np.flatnonzero((virtual.camera_idx == c) & (virtual.frame_idx == f))
    size = np.array([found.pinholes[c].width, found.pinholes[c].height])
    rows = rows[np.all((xy[rows] > 1) & (xy[rows] < size - 1), axis=1)]
    column, row = np.floor(xy[rows]).astype(int).T
    camera = scene.cameras[c]
    in_cam = virtual.points_in_cam()[rows] + found.pinholes[c].center_in_cam
    real, _ = camera.img_from_point(in_cam)
    # The nearest pixel's centre is up to 0.7 px away.
    assert np.nanmax(np.linalg.norm(maps[row, column] - real, axis=1)) < 2.0
    assert known[row, column].mean() > 0.9


def test_refractive_colmap_keeps_every_port(model, tmp_path):
    export_refractive_colmap(model, tmp_path / "out")
    found, cameras = read_refractive_colmap(tmp_path / "out")
    assert [cameras[k].port for k in sorted(cameras)] == list(model.scene.ports)
    assert found.num_points3D() == model.scene.num_points


def test_scene_ply_holds_finite_vertices(model, tmp_path):
    export_scene_ply(model, tmp_path / "scene.ply")
    head, body = (tmp_path / "scene.ply").read_bytes().split(b"end_header\n", 1)
    count = int(head.split(b"element vertex ")[1].split()[0])
    kinds = [(axis, "<f4") for axis in "xyz"] + [(c, "u1") for c in "rgb"]
    rows = np.frombuffer(body, dtype=kinds, count=count)
    assert all(np.isfinite(rows[axis]).all() for axis in "xyz")


def test_images_that_a_frame_lacks_are_nowhere(tmp_path):
    """Not in the report, not asked for, not drawn."""
    rig = RIGS["dome and flat"]
    options = ObservationOptions(num_points=150, noise_px=0.3, seed=2)
    full = model_of(rig, simulate_scene(rig, rich_motion(3), None, options).scene)
    gone = (full.scene.camera_idx == 1) & (full.scene.frame_idx == 2)
    scene, points = full.scene.select(~gone)
    left, right = full.keypoints
    model = replace(
        full,
        scene=scene,
        keypoints=(left, (*right[:2], np.empty((0, 2)))),
        keypoint_idx=full.keypoint_idx[~gone],
        colors=full.colors[points],
    )
    for camera, frame in np.ndindex(2, 3):
        path = tmp_path / "images" / model.image_name(camera, frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        if model.has_image(camera, frame):
            cv2.imwrite(str(path), np.zeros((600, 800), dtype=np.uint8))
    found = export_pinhole(model, tmp_path / "out", tmp_path / "images")
    missing = model.image_name(1, 2)
    assert missing not in {error.name for error in found.errors}
    stock = pycolmap.Reconstruction(str(tmp_path / "out" / "sparse" / "0"))
    assert missing not in {image.name for image in stock.images.values()}
    sizes = []
    for which in (full, model):
        export_scene_ply(which, tmp_path / "scene.ply")
        sizes.append((tmp_path / "scene.ply").stat().st_size)
        (tmp_path / "scene.ply").unlink()
    assert sizes[1] < sizes[0]
