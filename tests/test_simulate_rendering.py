"""Rendered images are exact: things appear where the projection says they do."""

import cv2
import numpy as np
import pytest

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.simulate.raycasting import RayScene, Surface
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.rendering import SensorOptions, WaterOptions, render_image
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.sea_floor import SeaFloorOptions, build_sea_floor, relief_surface
from uwsfm.simulate.texture import Texture
from uwsfm.simulate.trajectories import level_poses, rig_from_world_looking_at

SQUARE, TEXEL = 0.03, 0.0005  # of the checkerboard, metres
COLUMNS, ROWS = 50, 40
LOW = -0.5 * SQUARE * np.array([COLUMNS, ROWS])
SLOPE = np.array([0.25, -0.15])  # of the board's plane


def plane_scene(texture: Texture, slope=(0.0, 0.0)) -> RayScene:
    """A large plane through the world's origin, seen at its texture's colours."""
    corners = np.array([[-3.0, -3.0], [3.0, -3.0], [-3.0, 3.0], [3.0, 3.0]])
    normal = np.array([*slope, -1.0]) / np.linalg.norm([*slope, -1.0])
    plane = Surface(
        vertices=np.column_stack([corners, corners @ np.asarray(slope)]),
        triangles=np.array([[0, 1, 2], [1, 3, 2]]),
        normals=np.tile(normal, (4, 1)),
        light=np.ones(4),
        texture=texture,
    )
    return RayScene((plane,))


def uniform_texture(value: int) -> Texture:
    image = np.full((64, 64, 3), value, dtype=np.uint8)
    return Texture.from_image(image, (-3.0, -3.0), 6.0 / 64)


@pytest.fixture(scope="module")
def checkerboard() -> Texture:
    per_square = round(SQUARE / TEXEL)
    row, column = np.indices((ROWS * per_square, COLUMNS * per_square)) // per_square
    values = np.where((row + column) % 2, 215, 60).astype(np.uint8)
    return Texture.from_image(np.repeat(values[..., None], 3, 2), tuple(LOW), TEXEL)


@pytest.mark.parametrize("index", [0, 1], ids=["left", "right"])
def test_checkerboard_corners_land_where_the_projection_says(
    open3d, checkerboard, index
):
    rig = sample_rig()
    camera = rig.refractive_cameras()[index]
    # Turned, so that no edge runs along the rows of samples.
    pose = rig_from_world_looking_at([[0.1, 0.05, -0.9]], [[0.0, 0.0, 0.0]], 37.0)[0]
    cam_from_world = rigid3.compose(rig.cam_from_rig[index], pose)
    image = render_image(camera, cam_from_world, plane_scene(checkerboard, SLOPE))

    grid = np.indices((COLUMNS - 1, ROWS - 1)).reshape(2, -1).T + 1
    corners = LOW + SQUARE * grid
    corners = np.column_stack([corners, corners @ SLOPE])
    expected, valid = camera.img_from_point(rigid3.transform(cam_from_world, corners))
    inside = ((expected > 12) & (expected < [788, 588])).all(axis=1)
    expected = expected[valid & inside]
    assert len(expected) > 500

    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    start = np.rint(expected - 0.5).astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(gray, start, (6, 6), (-1, -1), (3, 100, 1e-4))
    found = found.reshape(-1, 2) + 0.5  # OpenCV -> COLMAP pixel origin
    error = found - expected
    # 3x3 samples place an edge to about 1/3 px / sqrt(12) = 0.1 px in each pixel it
    # crosses; a corner averages over the dozen that the window holds.
    assert np.sqrt(np.mean(error**2)) < 0.035  # measured: 0.0255
    assert np.abs(error.mean(axis=0)).max() < 0.006  # measured: 0.002


def test_first_hit_of_a_pixel_is_where_the_point_on_the_relief_is(open3d):
    relief = Relief(stddev=0.08, correlation_length=0.4, seed=1)
    low, high = np.array([-1.2, -1.2]), np.array([1.2, 1.2])
    scene = RayScene((relief_surface(relief, low, high, 0.01, uniform_texture(128)),))
    camera = sample_rig().refractive_cameras()[0]
    pose = rig_from_world_looking_at([[0.2, -0.1, -1.1]], [[0.0, 0.1, 0.0]], 70.0)[0]
    world_from_cam = rigid3.inverse(pose)
    x, y = np.meshgrid(np.arange(5.5, 800, 40), np.arange(5.5, 600, 40))
    xy = np.column_stack([x.ravel(), y.ravel()])
    origins, dirs = camera.ray_from_img(xy)
    origins = rigid3.transform(world_from_cam, origins)
    dirs = rigid3.rotate(world_from_cam, dirs)
    hits = scene.cast(origins, dirs)
    points = origins + hits.distance[:, None] * dirs
    # Facets of 10 mm lie within step^2 / 8 times the curvature (2/m at most) of it.
    np.testing.assert_allclose(points[:, 2], relief.depth(points[:, :2]), atol=3e-5)
    back, valid = camera.img_from_point(rigid3.transform(pose, points))
    assert valid.all()
    # A hit is single precision, 1e-7 of a few metres: along the ray, so hardly visible.
    np.testing.assert_allclose(back, xy, atol=2e-4)


def test_water_attenuates_and_veils_with_the_range(open3d):
    water = WaterOptions(
        attenuation_per_m=(0.5, 0.2, 0.1),
        backscatter_per_m=(0.3, 0.3, 0.3),
        veil=(0.02, 0.15, 0.3),
    )
    rig = sample_rig(image_scale=0.2)
    camera = rig.refractive_cameras()[0]
    scene = plane_scene(uniform_texture(180))
    sensor = SensorOptions(samples_per_side=1)
    image = render_image(
        camera, level_poses([[0, 0, -1.5]])[0], scene, water=water, sensor=sensor
    )
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    origins, dirs = camera.ray_from_img(np.column_stack([x.ravel(), y.ravel()]))
    distance = (1.5 - origins[:, 2:]) / dirs[:, 2:]
    radiance = (180 / 255) ** 2 * np.exp(-distance * water.attenuation_per_m)
    radiance += water.veil * (1 - np.exp(-distance * water.backscatter_per_m))
    expected = 255 * np.sqrt(radiance).reshape(image.shape)
    np.testing.assert_allclose(image, expected, atol=0.51)  # rounded to grey levels


def test_rays_that_miss_the_floor_see_open_water(open3d):
    water = WaterOptions(backscatter_per_m=(0.3, 0.3, 0.3), veil=(0.04, 0.16, 0.25))
    camera = sample_rig(image_scale=0.1).refractive_cameras()[0]
    away = rig_from_world_looking_at([[0, 0, -1.0]], [[9.0, 0, -9.0]], 0.0)[0]
    image = render_image(camera, away, plane_scene(uniform_texture(200)), water=water)
    expected = np.rint(255 * np.sqrt(water.veil))
    np.testing.assert_array_equal(image, np.broadcast_to(expected, image.shape))


def test_the_floor_looks_the_same_from_everywhere(open3d):
    options = SeaFloorOptions(texel=0.004, mesh_step=0.02, num_boulders=3)
    scene = build_sea_floor(options, np.array([-0.9, -0.9]), np.array([0.9, 0.9]))
    camera = sample_rig(image_scale=0.25).refractive_cameras()[0]
    sensor = SensorOptions(samples_per_side=4)
    poses = rig_from_world_looking_at(
        [[0.0, 0.0, -1.0], [0.12, 0.05, -1.0]], [[0.0, 0.0, 0.0]] * 2, [0.0, 90.0]
    )
    first, second = (render_image(camera, p, scene, sensor=sensor) for p in poses)
    x, y = np.meshgrid(np.arange(30, 170, 7) + 0.5, np.arange(20, 130, 7) + 0.5)
    xy = np.column_stack([x.ravel(), y.ravel()])
    origins, dirs = camera.ray_from_img(xy)
    world_from_cam = rigid3.inverse(poses[0])
    origins = rigid3.transform(world_from_cam, origins)
    dirs = rigid3.rotate(world_from_cam, dirs)
    hits = scene.cast(origins, dirs)
    points = origins + hits.distance[:, None] * dirs
    other, _ = camera.img_from_point(rigid3.transform(poses[1], points))
    here = first[y.ravel().astype(int), x.ravel().astype(int)].astype(float)
    map_xy = (other - 0.5).astype(np.float32)  # COLMAP -> OpenCV pixel origin
    there = cv2.remap(
        second, map_xy[:, :1].copy(), map_xy[:, 1:].copy(), cv2.INTER_LINEAR
    )
    difference = np.abs(here - there.reshape(-1, 3)).max(axis=1)
    # Interpolating between pixels blurs the second view, and some points are hidden.
    assert np.median(difference) < 6
    assert np.corrcoef(here[:, 1], there.reshape(-1, 3)[:, 1])[0, 1] > 0.9


def test_sensor_noise_is_as_asked_and_needs_a_generator(open3d, rng):
    camera = sample_rig(image_scale=0.2).refractive_cameras()[0]
    scene, pose = plane_scene(uniform_texture(120)), level_poses([[0, 0, -1.0]])[0]
    sensor = SensorOptions(samples_per_side=1, noise=3.0)
    image = render_image(camera, pose, scene, sensor=sensor, rng=rng)
    # 57,600 values, and rounding adds 1/12 to the variance of 9.
    assert image.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)
    assert image.mean() == pytest.approx(120, abs=0.06)
    with pytest.raises(InputError, match="random number generator"):
        render_image(camera, pose, scene, sensor=sensor)


def test_smaller_copies_of_a_texture_are_not_shifted():
    ramp = np.arange(256, dtype=np.uint8)[None, :, None].repeat(256, 0).repeat(3, 2)
    texture = Texture.from_image(ramp, (-1.0, 2.0), 0.01)
    xy = np.array([[0.3, 3.0], [0.7, 3.3]])
    expected = (xy[:, 0] + 1.0) / 0.01 - 0.5
    for level in range(len(texture.levels) - 1):
        spacing = np.full(2, 0.01 * 2.0**level, dtype=np.float32)
        colors = texture.lookup(xy, spacing)
        # Averages of two neighbours end in .5 and are rounded at every level.
        np.testing.assert_allclose(colors[:, 0], expected, atol=0.5 + 0.5 * level)


def test_a_texture_too_large_for_opencv_is_refused():
    with pytest.raises(InputError, match="larger texels"):
        Texture.from_image(np.zeros((4, 40_000, 3), np.uint8), (0.0, 0.0), 0.001)


@pytest.mark.parametrize(
    ("build", "name"),
    [
        (lambda: WaterOptions(veil=(0.1, -0.1, 0.1)), "veil"),
        (lambda: SensorOptions(samples_per_side=0), "samples_per_side"),
        (lambda: SensorOptions(noise=-1.0), "noise"),
        (lambda: SeaFloorOptions(texel=0.0), "texel"),
        (lambda: SeaFloorOptions(boulder_radius=(0.2, 0.1)), "boulder_radius"),
        (lambda: SeaFloorOptions(num_boulders=-1), "num_boulders"),
    ],
)
def test_options_out_of_range_are_refused(build, name):
    with pytest.raises(InputError, match=name):
        build()
