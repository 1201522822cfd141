"""`uwsfm color` on a result folder with images of a dive, painted by the equation."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from uwsfm._base.ply import read_vertices
from uwsfm.cli.app import app
from uwsfm.cloud import Cloud, read_cloud, write_cloud
from uwsfm.color.commands import correct_colors
from uwsfm.color.encoding import light_of, values_of
from uwsfm.errors import UwsfmError
from uwsfm.export.image_depth import ImageDepth
from uwsfm.geometry import rigid3
from uwsfm.results.files import read_model

ATTENUATION, BACKSCATTER = np.array([0.4, 0.2, 0.12]), np.array([0.4, 0.35, 0.3])
VEIL = np.array([0.05, 0.12, 0.2])
STEP = 8  # pixels between painted ones


def seen(albedo: np.ndarray, ranges: np.ndarray) -> np.ndarray:
    fade = np.exp(-ranges[..., None] * ATTENUATION)
    return albedo * fade + VEIL * (1.0 - np.exp(-ranges[..., None] * BACKSCATTER))


def albedo_at(points: np.ndarray) -> np.ndarray:
    """Broad dark and bright waves over the floor."""
    x, y = points[..., 0], points[..., 1]
    wave = np.stack([np.sin(2 * x + y), np.sin(2 * y - x), np.sin(x + 1)], axis=-1)
    return 0.3 + 0.25 * wave


def paint(out: Path, folder: Path) -> None:
    """What the cameras of a result would see of a coloured floor, as sRGB."""
    model = read_model(out)
    scene = model.scene
    origins, _ = scene.water_rays()
    ranges = np.linalg.norm(scene.points[scene.point_idx] - origins, axis=1)
    for camera, lens in enumerate(scene.cameras):
        size = (lens.width, lens.height)
        x, y = (np.arange(STEP / 2, side, STEP) for side in size)
        grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        start, direction = lens.ray_from_img(grid)
        for frame in range(scene.num_frames):
            rows = (scene.camera_idx == camera) & (scene.frame_idx == frame)
            depth = ImageDepth(scene.xy[rows], 1.0 / ranges[rows], size, 1.0)
            distance = 1.0 / depth.inverse(grid)
            pose = rigid3.compose(
                scene.cam_from_rig[camera], scene.rig_from_world[frame]
            )
            points = rigid3.transform(
                rigid3.inverse(pose), start + distance[:, None] * direction
            )
            light = seen(albedo_at(points), distance).reshape(len(y), len(x), 3)
            values = values_of(cv2.resize(light, size), "srgb")
            path = folder / model.image_name(camera, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path.with_suffix(".png")), values[..., ::-1])
            path.with_suffix(".png").rename(path)  # OpenCV reads by content


def test_points_cloud_and_images_lose_their_water(dive_result, tmp_path: Path):
    out, images = tmp_path / "out", tmp_path / "images"
    shutil.copytree(dive_result.out, out)
    paint(out, images)
    points = read_model(out).scene.points
    ranges = np.linspace(0.5, 3.0, len(points))
    count = len(points)
    cloud = Cloud(
        points=points,
        normals=np.full((count, 3), np.nan),
        colors=values_of(seen(albedo_at(points), ranges), "srgb"),
        stddev=np.full(count, np.nan),
        num_views=np.full(count, 3),
        view_range=np.where(np.arange(count) < 5, np.nan, ranges),
    )
    write_cloud(cloud, out / "dense" / "cloud.ply")
    found = CliRunner().invoke(
        app,
        ["color", str(out), "-o", str(out / "color"), "--images", str(images)]
        + ["--write-images"],
    )
    assert found.exit_code == 0, found.output
    report = json.loads((out / "color" / "water.json").read_text())
    for k, channel in enumerate(report["channels"].values()):
        # Patches over broad waves, and ranges between points: what is left is 8 bits.
        entry = channel["attenuation_per_m"]
        assert entry["determined"]
        assert entry["value"] == pytest.approx(ATTENUATION[k], rel=0.1)
    assert report["num_without_range"] == 5 and "no lamps" in report["assumed"]

    gains = np.array(report["gains"])
    truth = values_of(gains * albedo_at(points), "srgb").astype(float)
    table, comments = read_vertices(out / "color" / "points.ply")
    assert comments == ["unit: metre; colours without the water, by uwsfm color"]
    assert {"track_length", "depth_stddev_m"} <= set(table.dtype.names)
    rgb = np.stack([table[name] for name in ("red", "green", "blue")], axis=1)
    assert np.median(np.abs(rgb - truth)) < 4
    clear = read_cloud(out / "color" / "cloud.ply")
    np.testing.assert_array_equal(clear.colors[:5], cloud.colors[:5])
    # 8 bits, enlarged by up to exp(0.4 * 3) = 3.3; dark ones in sRGB by more.
    assert np.median(np.abs(clear.colors[5:] - truth[5:])) < 6
    model = read_model(out)
    image = cv2.imread(str(out / "color" / "images" / model.image_name(0, 0)))
    rows = (model.scene.camera_idx == 0) & (model.scene.frame_idx == 0)
    column, row = np.floor(model.scene.xy[rows]).astype(int).T
    shown = image[row, column, ::-1].astype(float)
    assert np.median(np.abs(shown - truth[model.scene.point_idx[rows]])) < 5
    assert light_of(image, "srgb").max() <= 1.0


@pytest.mark.slow
def test_a_flat_scene_without_contrast_is_told_and_not_corrected(
    dive_result, tmp_path: Path
):
    model, images = read_model(dive_result.out), tmp_path / "images"
    rng = np.random.default_rng(0)
    for camera, lens in enumerate(model.scene.cameras):
        for frame in range(model.scene.num_frames):
            path = images / model.image_name(camera, frame)
            path.parent.mkdir(parents=True, exist_ok=True)
            noise = rng.integers(60, 120, (lens.height // 50, lens.width // 50, 3))
            cv2.imwrite(
                str(path), cv2.resize(noise.astype(np.uint8), (lens.width, lens.height))
            )
    with pytest.raises(UwsfmError, match=r"not determined.*water\.json"):
        correct_colors(dive_result.out, tmp_path / "color", images=images)
    assert [path.name for path in (tmp_path / "color").iterdir()] == ["water.json"]
