"""Attenuation and veil come back from rendered images, and only where they can."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

import uwsfm
from uwsfm.color.apply import corrected_image, make_correction, point_colors
from uwsfm.color.encoding import ENCODINGS, light_of, values_of
from uwsfm.color.exposure import exposure_warnings, read_exposure
from uwsfm.color.samples import Samples, patch_means, sample_scene
from uwsfm.color.water import fit_channel
from uwsfm.color.water_fit import fit_water
from uwsfm.errors import UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.scene import Scene
from uwsfm.simulate.rendering import SensorOptions, WaterOptions, render_image
from uwsfm.simulate.sea_floor import SeaFloorOptions, build_sea_floor
from uwsfm.simulate.trajectories import rig_from_world_looking_at

WATER = WaterOptions(
    attenuation_per_m=(0.5, 0.2, 0.15),
    backscatter_per_m=(0.6, 0.5, 0.4),
    veil=(0.08, 0.14, 0.2),
)
WIDTH, HEIGHT, NUM_IMAGES = 200, 150, 10
CLEAR = 6


def true_scene(camera: uwsfm.RefractiveCamera, floor, poses) -> Scene:
    """What the camera sees of points spread over the views, all at its true place."""
    x, y = np.meshgrid(np.arange(6.0, WIDTH, 9), np.arange(6.0, HEIGHT, 9))
    origins, dirs = camera.ray_from_img(np.column_stack([x.ravel(), y.ravel()]))
    points = []
    for pose in rigid3.inverse(poses):
        start, direction = rigid3.transform(pose, origins), rigid3.rotate(pose, dirs)
        hits = floor.cast(start, direction)
        points.append(start + hits.distance[:, None] * direction)
    points = np.concatenate(points)
    shown = [camera.img_from_point(rigid3.transform(pose, points)) for pose in poses]
    xy = np.stack([pixels for pixels, _ in shown])
    inside = np.stack([valid for _, valid in shown])
    inside &= ((xy > 0) & (xy < [WIDTH, HEIGHT])).all(axis=2)
    frame_idx, point_idx = np.nonzero(inside)
    return Scene.from_arrays(
        cameras=[camera],
        cam_from_rig=[rigid3.IDENTITY],
        rig_from_world=poses,
        points=points,
        camera_idx=np.zeros(len(frame_idx), dtype=np.int64),
        frame_idx=frame_idx,
        point_idx=point_idx,
        xy=xy[inside],
    )


@pytest.fixture(scope="module")
def rendered(open3d) -> tuple[Scene, list[np.ndarray], np.ndarray]:
    """A dive from 0.5 to 3 m: the scene, its images, and one of them in clear water."""
    options = SeaFloorOptions(texel=0.005, mesh_step=0.04, num_boulders=3)
    floor = build_sea_floor(options, np.array([-2.0, -2.0]), np.array([2.0, 2.0]))
    angle = np.arange(NUM_IMAGES) * 2.4
    height = np.geomspace(0.5, 3.0, NUM_IMAGES)
    centers = np.column_stack([0.3 * np.cos(angle), 0.3 * np.sin(angle), -height])
    poses = rig_from_world_looking_at(centers, centers * [0.3, 0.3, 0], 50 * angle)
    lens = pycolmap.Camera(
        model="PINHOLE", width=WIDTH, height=HEIGHT, params=[165, 165, 100, 75]
    )
    camera = uwsfm.RefractiveCamera(lens, uwsfm.FlatPort(distance=0.05, thickness=0.01))

    def image(index: int, water: WaterOptions | None) -> np.ndarray:
        sensor = SensorOptions(samples_per_side=1, noise=1.0)
        rng = np.random.default_rng(index)
        return render_image(
            camera, poses[index], floor, water=water, sensor=sensor, rng=rng
        )

    images = [image(index, WATER) for index in range(NUM_IMAGES)]
    return true_scene(camera, floor, poses), images, image(CLEAR, None)


def test_rendered_water_comes_back_within_15_percent(rendered):
    scene, images, clear = rendered
    samples = sample_scene(scene, lambda camera, frame: images[frame], "sqrt")
    water = fit_water(samples)
    for k, found in enumerate(water.channels):
        assert found.attenuation == pytest.approx(WATER.attenuation_per_m[k], rel=0.15)
        assert found.backscatter == pytest.approx(WATER.backscatter_per_m[k], rel=0.15)
        assert found.veil[0] == pytest.approx(WATER.veil[k], rel=0.15)
    assert water.problem() is None and water.warnings() == []
    assert water.moves_with_lamps is False

    # What is left of the water in an image from 1.7 m, against the render without any.
    correction = replace(
        make_correction(water, samples, "sqrt", gray=False), gains=np.ones(3)
    )
    rows = scene.frame_idx == CLEAR
    found, share = corrected_image(
        correction, images[CLEAR], scene.xy[rows], samples.range[rows], 1.0
    )
    assert share > 0.7
    before, after = (
        np.abs(image.astype(float) - clear).mean() for image in (images[CLEAR], found)
    )
    # Light that is down to half of it has twice the noise of 1 grey level.
    assert before > 15 and after < 2
    colors = point_colors(correction, samples, scene.num_points)
    seen = np.bincount(scene.point_idx[rows], minlength=scene.num_points) > 0
    column, row = np.floor(scene.xy[rows]).astype(int).T
    truth = clear[row, column].astype(float)
    difference = colors[scene.point_idx[rows]] - truth
    assert seen.sum() > 100 and np.abs(np.median(difference, axis=0)).max() < 4


def tracks(rng: np.random.Generator, low: float, high: float, fall=None) -> Samples:
    """Points seen at several ranges by the equation itself, with 1 % of noise."""
    point = np.repeat(np.arange(250), 6)
    ranges = rng.uniform(low, high, len(point))
    albedo = rng.uniform(0.02, 0.6, (250, 3))[point]
    fade = np.exp(-ranges[:, None] * WATER.attenuation_per_m)
    veil = 1.0 - np.exp(-ranges[:, None] * WATER.backscatter_per_m)
    light = albedo * fade
    if fall is not None:
        light *= ranges[:, None] ** -fall
    light = light * rng.normal(1.0, 0.01, light.shape) + veil * WATER.veil
    return Samples(
        light=light,
        range=ranges,
        point_idx=point,
        image_idx=np.tile(np.arange(6), 250),
        wide_light=light,
        pixel_light=light,
        num_lost=0,
    )


def test_the_equation_s_own_numbers_come_back_within_their_deviations(rng):
    samples = tracks(rng, 0.5, 4.0)
    for k in range(3):
        found = fit_channel(
            samples.light[:, k], samples.range, samples.point_idx, samples.image_idx
        )
        truth = [
            WATER.attenuation_per_m[k],
            WATER.veil[k] * WATER.backscatter_per_m[k],
            WATER.backscatter_per_m[k],
        ]
        values = [found.attenuation, found.veil_slope, found.backscatter]
        assert (np.abs(np.subtract(values, truth)) < 4.0 * found.stddevs).all()
        # And these say something: 1 % of noise on 1500 samples.
        assert found.stddevs[0] < 0.03


def test_what_the_images_do_not_determine_is_not_corrected(rng):
    # A level strip: ranges from 1.9 to 2.1 m, and 15 % of noise.
    strip = tracks(rng, 1.9, 2.1)
    noisy = strip.light * rng.normal(1.0, 0.15, strip.light.shape)
    water = fit_water(replace(strip, light=noisy, wide_light=noisy))
    assert water.moves_with_lamps is None
    assert any("cannot be told" in text for text in water.warnings())
    for channel in water.summary()["channels"].values():
        assert not channel["attenuation_per_m"]["determined"]
    # Lamps at the camera: the light falls with the square of the range.
    water = fit_water(tracks(rng, 0.5, 4.0, fall=2.0))
    assert water.moves_with_lamps is True
    assert water.lamp_exponent[0] == pytest.approx(2.0, abs=0.2)
    assert "as that of lamps at the camera" in water.problem()
    # Exposures that change are seen in the images themselves.
    bright = tracks(rng, 0.5, 4.0)
    factor = np.where(bright.image_idx == 2, 1.3, 1.0)[:, None]
    water = fit_water(replace(bright, light=bright.light * factor))
    assert any("differ in brightness" in text for text in water.warnings())
    # Eleven times as large as slope and backscatter, and the same share of both: the
    # quotient has no error to first order, and no bound where the backscatter is zero.
    red = water.channels[0]
    error = 11.0 * np.array([0.0, red.veil_slope, red.backscatter])
    loose = replace(red, covariance=np.outer(error, error))
    assert loose.veil[1] < 1e-6
    open_water = replace(water, channels=(loose, *water.channels[1:]))
    assert not open_water.summary()["channels"]["red"]["veil"]["determined"]
    with pytest.raises(UwsfmError, match="seen twice"):
        few = np.arange(20)
        fit_channel(bright.light[few, 0], bright.range[few], few, few)


def test_patches_are_means_with_fractional_borders(rng):
    image = rng.uniform(size=(30, 40, 3))
    ramp = np.broadcast_to(np.arange(40) + 0.5, (30, 40))[..., None]
    xy = rng.uniform([8, 8], [32, 22], (50, 2))
    # Any symmetric mean of a ramp is its value in the middle, but for the steps of its
    # pixels: 1/8 of a pixel at the borders of a patch, over its width.
    means = patch_means(ramp.copy(), xy, rng.uniform(2.0, 8.0, 50))
    np.testing.assert_allclose(means[:, 0], xy[:, 0], atol=1 / 8 / 2)
    inside = patch_means(image, np.array([[10.5, 10.5]]), np.array([0.5]))
    np.testing.assert_allclose(inside[0], image[10, 10], atol=1e-12)
    assert np.isnan(patch_means(image, np.array([[3.0, 9.0]]), np.array([3.1]))).all()


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings_are_undone_exactly(encoding):
    for dtype in (np.uint8, np.uint16):
        values = np.arange(np.iinfo(dtype).max + 1, dtype=dtype)
        light = light_of(values, encoding)
        assert light[0] == 0.0 and light[-1] == 1.0
        np.testing.assert_array_equal(values_of(light, encoding, dtype), values)


def test_exposures_are_read_from_exif(tmp_path: Path):
    for name, time, balance in (("a.jpg", (1, 100), 1), ("b.jpg", (1, 50), 0)):
        exif = Image.Exif()
        exif[34665] = {
            33434: IFDRational(*time),
            33437: IFDRational(28, 10),
            34855: 200,
            41987: balance,
        }
        Image.new("RGB", (8, 8)).save(tmp_path / name, exif=exif)
    cv2.imwrite(str(tmp_path / "c.jpg"), np.zeros((8, 8, 3), np.uint8))
    found = read_exposure(tmp_path / "a.jpg")
    assert found.light == pytest.approx(0.01 * 200 / 2.8**2)
    assert read_exposure(tmp_path / "c.jpg") is None
    first, second = exposure_warnings(sorted(tmp_path.iterdir()))
    assert "factor of 2" in first and "1 images, for instance b.jpg" in second
