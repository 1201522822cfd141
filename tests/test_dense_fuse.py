"""Depth maps that confirm each other, voxels, and the calibration's share of errors."""

from dataclasses import replace

import numpy as np
import pytest
from dense_scenes import Plane, range_errors

from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.dense.calibration_error import calibration_error
from uwsfm.dense.depth_map import DepthMap, pixel_rows, read_depth_map, write_depth_map
from uwsfm.dense.fuse import (
    Noise,
    Rule,
    differences_px,
    fuse,
    placed,
    robust_stddev,
)
from uwsfm.dense.options import DenseOptions, bytes_of
from uwsfm.dense.voxels import BYTES_PER_VOXEL, Fused, Voxels
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.residuals import border
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import level_poses, rich_motion

NOISE_PX = 0.2
NOISE = Noise(own=NOISE_PX, between=NOISE_PX)
SENSITIVITY = 0.01  # metres per pixel, about that of the sample at two metres
FLOOR = Plane(np.array([0.0, 0.0, 1.0]), 0.0, 0.01)


def maps_of_floor(rng, num: int, bump: float = 0.0, noise: float = NOISE_PX):
    """Depth maps of the plane z = 0 with noise; the last one sees a bump on it."""
    camera = sample_rig(image_scale=0.1).refractive_cameras()[0]
    poses = level_poses(
        np.column_stack([0.1 * np.arange(num), np.zeros(num), np.full(num, -1.5)]),
        20.0 * np.arange(num),
    )
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    shape = camera.height, camera.width
    found = []
    for index, pose in enumerate(poses):
        world_from_cam = rigid3.inverse(pose)
        ranges = FLOOR.ranges(
            rigid3.transform(world_from_cam, origins),
            rigid3.rotate(world_from_cam, dirs),
        ).reshape(shape)
        ranges += noise * SENSITIVITY * rng.standard_normal(shape)
        if bump and index == num - 1:
            ranges[20:40, 20:40] -= bump
        constant = np.full(shape, SENSITIVITY, dtype=np.float32)
        calibration = np.zeros(shape, dtype=np.float32)
        depth = DepthMap(ranges=ranges.astype("f4"), sensitivity=constant)
        found.append(placed(camera, pose, depth, calibration))
    return found


def test_depth_maps_tell_their_noise_and_average_it(rng: np.random.Generator):
    maps = maps_of_floor(rng, 5)
    found = robust_stddev(
        np.concatenate(
            [differences_px(view, maps[:i])[:, 0] for i, view in enumerate(maps)]
        )
    )
    # Lookups between pixels average up to four of the other map's: 2/3 of a variance
    # on average and in each direction, (1 + 4/9) / 2 of both together.
    assert found == pytest.approx(NOISE_PX * np.sqrt(13.0 / 18.0), rel=0.1)
    image = np.zeros((60, 80, 3), dtype=np.uint8)
    fused, counts = fuse(
        *(maps[0], maps[1:], image, NOISE), Rule(min_views=3, keep_single=False)
    )
    all_agree = fused.num_views == 5
    height = fused.points[all_agree, 2]
    # Along the line of sight, whose slope is small; five maps, of which four are
    # interpolated: below the standard deviation said, by less than a half.
    ratio = np.std(height) / np.median(fused.stddev[all_agree])
    assert 0.5 < ratio < 1.1
    assert fused.stddev[all_agree] == pytest.approx(
        NOISE_PX * SENSITIVITY / np.sqrt(5.0), rel=0.2
    )
    assert counts.num_contradicted < 0.02 * counts.num_points
    # The floor's normal, up into the water.
    assert np.median(fused.normals[:, 2]) < -0.99


@pytest.mark.parametrize("common", [0, 2, 4])
def test_noise_that_depth_maps_of_the_same_images_share_is_made_up_for(rng, common):
    """Two maps of seven images each: errors have the share in common that images have,
    and differences do not show it."""
    share = common / (14 - common)
    exact = maps_of_floor(np.random.default_rng(0), 2, noise=0.0)
    shape = exact[0].distance.shape
    same = np.sqrt(share) * rng.standard_normal(shape)
    maps = []
    for index, view in enumerate(exact):
        # What is common moves the surface by as much in both.
        error = same + np.sqrt(1.0 - share) * rng.standard_normal(shape)
        scale = 1.0 + NOISE_PX * SENSITIVITY * error / view.distance
        images = range(7) if index == 0 else range(7 - common, 14 - common)
        maps.append(
            replace(
                view,
                points=(view.points * scale[..., None]).astype(np.float32),
                distance=(view.distance * scale).astype(np.float32),
                images=frozenset((0, image) for image in images),
            )
        )
    assert maps[0].alone(maps[1]) == pytest.approx(1.0 - share)
    # Of the same camera at the same place, so that pixels meet pixels.
    second = replace(maps[1], cam_from_world=maps[0].cam_from_world)
    between, own = np.std(differences_px(maps[0], [second]), axis=0)
    # Some 290 samples: 4 %.
    assert own == pytest.approx(NOISE_PX, rel=0.15)
    assert between == pytest.approx(np.sqrt(1.0 - share) * own, rel=1e-6)
    # By the one they agree, by the other is said how well a point is known.
    image = np.zeros((*shape, 3), dtype=np.uint8)
    rule = Rule(min_views=2, keep_single=False)
    points = {}
    for name, noise in (
        ("both", NOISE),
        ("less between", Noise(own=NOISE_PX, between=0.3 * NOISE_PX)),
        ("less own", Noise(own=0.3 * NOISE_PX, between=NOISE_PX)),
    ):
        points[name], _ = fuse(maps[0], [second], image, noise, rule)
    assert len(points["less between"]) < 0.9 * len(points["both"])
    assert len(points["less own"]) == len(points["both"])
    np.testing.assert_allclose(
        points["less own"].stddev, 0.3 * points["both"].stddev, rtol=1e-9
    )


def test_errors_of_the_calibration_are_in_every_point_and_not_averaged(rng):
    """Five maps share them: the noise becomes smaller, they stay, and both add up."""
    plain = maps_of_floor(rng, 5)
    shape = plain[0].distance.shape
    # A deviation of its own for each pixel of the map that is fused.
    systematic = np.linspace(0.003, 0.011, shape[0] * shape[1]).reshape(shape)
    uncertain = replace(plain[0], calibration=systematic.astype(np.float32))
    image = np.zeros((*shape, 3), dtype=np.uint8)
    rule = Rule(min_views=2, keep_single=False)
    without, _ = fuse(plain[0], plain[1:], image, NOISE, rule)
    found, _ = fuse(uncertain, plain[1:], image, NOISE, rule)
    np.testing.assert_array_equal(found.points, without.points)
    # Which pixel a point is of: the one that it projects to.
    pose = plain[0].cam_from_world
    xy, _ = plain[0].camera.img_from_point(rigid3.transform(pose, found.points))
    column, row = np.floor(xy).astype(int).T
    expected = np.hypot(without.stddev, systematic[row, column])
    np.testing.assert_allclose(found.stddev, expected, rtol=1e-5)  # single precision


def test_what_others_contradict_is_dropped(rng: np.random.Generator):
    maps = maps_of_floor(rng, 4, bump=0.1)
    image = np.zeros((60, 80, 3), dtype=np.uint8)
    image[..., 0] = 200  # blue
    rule = Rule(min_views=2, keep_single=True)
    fused, counts = fuse(maps[3], maps[:3], image, NOISE, rule)
    # Ten standard deviations off; its border has no normal.
    assert counts.num_contradicted >= 250
    assert np.all(np.abs(fused.points[:, 2]) < 0.03)
    assert np.all(fused.colors == [0, 0, 200])
    alone, _ = fuse(maps[3], [], image, NOISE, rule)
    assert np.all(alone.num_views == 1) and len(alone) > 4000
    strict = Rule(min_views=2, keep_single=False)
    nothing, _ = fuse(maps[3], [], image, NOISE, strict)
    assert len(nothing) == 0


def test_a_point_is_plain_where_no_depth_map_has_it_by_texture(rng):
    maps = maps_of_floor(rng, 3)
    everywhere = np.ones(maps[0].distance.shape, dtype=bool)
    left = np.zeros_like(everywhere)
    left[:, :40] = True
    image = np.zeros((60, 80, 3), dtype=np.uint8)
    rule = Rule(min_views=3, keep_single=False)
    plain = replace(maps[0], plain=everywhere)
    others = [replace(maps[1], plain=left), replace(maps[2], plain=left)]
    fused, _ = fuse(plain, others, image, NOISE, rule)
    expected = np.ones(len(fused), dtype=bool)
    for other in maps[1:]:
        in_cam = rigid3.transform(other.cam_from_world, fused.points)
        xy, _ = other.camera.img_from_point(in_cam)
        expected &= xy[:, 0] < 40.0
    # Each lookup is of the nearest pixel: at the line itself either is right.
    assert np.mean(fused.plain == expected) > 0.98
    assert 0.2 < np.mean(expected) < 0.8
    sure, _ = fuse(maps[0], others, image, NOISE, rule)
    assert not sure.plain.any()


def test_colours_beside_a_step_and_from_aside_and_afar_count_little(rng):
    """A step of 30 cm in a floor: its pixels show the colours of both sides."""
    maps = maps_of_floor(rng, 4, bump=0.3)
    image = np.zeros((60, 80, 3), dtype=np.uint8)
    rule = Rule(min_views=1, keep_single=True)
    fused, _ = fuse(maps[3], [], image, NOISE, rule)
    weight = np.full(image.shape[:2], np.nan)
    weight[np.isfinite(maps[3].distance) & np.isfinite(maps[3].normals[..., 0])] = (
        fused.color_weight
    )
    # Beside the step, but not a few pixels away from it on either side.
    assert np.nanmax(weight[18:22, 24:36]) < 0.01 * np.nanmin(weight[27:33, 27:33])
    assert np.nanmin(weight[10:15, 25:35]) > 100.0 * np.nanmax(weight[18:22, 24:36])
    # Of the floor in the middle, the square of cosine over distance.
    expected = 1.0 / maps[3].distance[30, 60] ** 2
    assert weight[30, 60] == pytest.approx(expected, rel=0.15)


def test_bands_of_rows_give_what_the_whole_map_gives(rng: np.random.Generator):
    maps = maps_of_floor(rng, 4, bump=0.3)
    image = rng.integers(0, 256, (60, 80, 3)).astype(np.uint8)
    rule = Rule(min_views=2, keep_single=False)
    whole, counts = fuse(maps[3], maps[:3], image, NOISE, rule)
    bands = [
        fuse(maps[3], maps[:3], image, NOISE, rule, slice(top, top + 17))
        for top in range(0, 60, 17)
    ]
    for name, expected in vars(whole).items():
        joined = np.concatenate([getattr(band, name) for band, _ in bands])
        np.testing.assert_array_equal(joined, expected, err_msg=name)
    for name, expected in vars(counts).items():
        assert sum(getattr(count, name) for _, count in bands) == expected


def test_voxels_average_by_inverse_variance(rng: np.random.Generator):
    count = 500
    # A real survey's coordinates: single precision has 3 cm there.
    origin = np.array([4e5, 5e6, -20.0])
    points = origin + rng.uniform(0.0, 0.1, (count, 3))
    fused = Fused(
        points=points,
        normals=np.tile([0.0, 0.0, -1.0], (count, 1)),
        colors=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        stddev=rng.uniform(0.001, 0.002, count),
        num_views=rng.integers(2, 9, count),
        view_range=rng.uniform(1.0, 2.0, count),
        # Of some 60 in a voxel: in half of the voxels all.
        plain=np.all(points - origin < [0.1, 0.1, 0.05], axis=1),
        color_weight=rng.uniform(0.1, 3.0, count),
    )
    voxels = Voxels(0.05, origin, 1e9)
    for part in np.array_split(np.arange(count), 7):
        voxels.add(Fused(**{name: v[part] for name, v in vars(fused).items()}))
    cloud = voxels.cloud()
    cells = np.floor((points - origin) / 0.05).astype(int)
    keys = [tuple(key) for key in np.unique(cells, axis=0)]
    assert len(cloud) == len(keys) == 8
    for key in keys:
        rows = np.flatnonzero(np.all(cells == key, axis=1))
        weight = fused.stddev[rows] ** -2
        mean = np.average(points[rows], axis=0, weights=weight)
        i = int(np.argmin(np.linalg.norm(cloud.points - mean, axis=1)))
        # Double precision at 5000 km is a nanometre, and the oracle sums there.
        np.testing.assert_allclose(cloud.points[i], mean, rtol=0.0, atol=1e-8)
        color = np.average(fused.colors[rows], axis=0, weights=fused.color_weight[rows])
        # Rounded, from sums in single precision.
        np.testing.assert_allclose(cloud.colors[i], color, rtol=0.0, atol=0.501)
        assert cloud.view_range[i] == np.float32(fused.view_range[rows].min())
        assert cloud.num_views[i] == fused.num_views[rows].max()
        assert cloud.plain[i] == fused.plain[rows].all()
        # Neighbours share their errors: the mean's deviation is the mean deviation,
        # no smaller for being of many.
        expected = np.average(fused.stddev[rows], weights=weight)
        assert cloud.stddev[i] == pytest.approx(expected, rel=1e-9)
    with pytest.raises(InputError, match="choose a larger --voxel"):
        Voxels(1e-9, origin, 1e9).add(fused)


def test_voxels_that_do_not_fit_become_larger(rng: np.random.Generator):
    """Rather than none after all the work; and nothing is lost."""
    count = 5000
    points = np.column_stack([rng.uniform(0.0, 1.0, (count, 2)), np.zeros(count)])
    fused = Fused(
        points=points,
        normals=np.tile([0.0, 0.0, -1.0], (count, 1)),
        colors=np.zeros((count, 3), dtype=np.uint8),
        stddev=np.full(count, 0.001),
        num_views=np.full(count, 3),
        view_range=np.full(count, 1.5),
        plain=np.zeros(count, dtype=bool),
        color_weight=np.ones(count),
    )
    voxels = Voxels(0.001, np.zeros(3), 300.0 * BYTES_PER_VOXEL)
    voxels.add(fused)
    cloud = voxels.cloud()
    # Half of a surface's voxels remain at each step.
    assert 120 < len(cloud) <= 300 and voxels.size > 0.05
    assert np.ptp(cloud.points[:, :2], axis=0).min() > 0.9
    np.testing.assert_allclose(cloud.stddev, 0.001)
    np.testing.assert_allclose(cloud.normals, [[0.0, 0.0, -1.0]] * len(cloud))


OFF_BY = {
    "one port": {(1, border.DISTANCE): 0.002},
    "both alike": {(0, border.DISTANCE): 0.002, (1, border.DISTANCE): 0.002},
    "both, opposite": {(0, border.DISTANCE): 0.002, (1, border.DISTANCE): -0.002},
}
"""Errors of port distances, metres, that come together or not at all."""


@pytest.mark.parametrize("how", OFF_BY)
def test_uncertain_ports_make_the_depths_uncertain(how):
    scene = simulate_scene(
        sample_rig(),
        rich_motion(4),
        Relief(stddev=0.1),
        ObservationOptions(num_points=60, noise_px=0.0),
    ).truth
    covariance = predict_covariance(scene, 0.5)
    error = np.zeros(len(covariance.border))
    for (camera, slot), amount in OFF_BY[how].items():
        error[covariance.border_cols[camera, slot]] = amount
    only = np.outer(error, error)  # one error, in all of them at once
    found = calibration_error(scene, replace(covariance, border=only), (0, 1), 1.0, 3.0)
    # Nodes of the grid: 8 by 6 steps between the outer pixels of 800 x 600, and three
    # in the inverse range from 1 to 1/3.
    xy = np.array([[400.0, 300.0], [0.5 + 799.0 / 4.0, 0.5 + 599.0 / 3.0]])
    ranges = 1.0 / np.array([5.0 / 9.0, 7.0 / 9.0])
    amounts = [OFF_BY[how].get((camera, border.DISTANCE), 0.0) for camera in (0, 1)]
    expected = np.abs(range_errors(scene, amounts, xy, ranges))
    # To first order: 2 mm of a port at 2 cm.
    np.testing.assert_allclose(found.stddev(xy, ranges), expected, rtol=0.03)


def test_depth_maps_come_back_or_are_made_again(tmp_path):
    depth = DepthMap(
        ranges=np.ones((3, 4), dtype="f4"), sensitivity=np.ones((3, 4), dtype="f4")
    )
    path = tmp_path / "work" / "map.npz"
    assert read_depth_map(path, "key") is None
    write_depth_map(depth, path, "key")
    found = read_depth_map(path, "key")
    assert found is not None and np.array_equal(found.ranges, depth.ranges)
    assert read_depth_map(path, "other") is None
    path.write_bytes(path.read_bytes()[:200])
    assert read_depth_map(path, "key") is None


def test_sizes_are_read():
    assert bytes_of("2GB") == 2e9 and bytes_of(" 500 M") == 5e8 and bytes_of("1e9")
    for text in ("", "much", "2TB", "-1GB"):
        with pytest.raises(InputError, match="is no size"):
            bytes_of(text)


@pytest.mark.parametrize(
    ("option", "value", "words"),
    [
        ("min_views", 0, "--min-views must be at least 1"),
        ("voxel", np.inf, "--voxel must be positive and finite"),
        ("noise_px", -0.1, "--noise-px must be positive"),
        ("max_memory", 0.0, "--max-memory must be positive"),
        ("num_threads", 0, r"--threads \(num_threads\) must be positive"),
    ],
)
def test_options_out_of_range_are_named_as_they_are_typed(option, value, words):
    with pytest.raises(InputError, match=f"^{words}.*, got {value}"):
        DenseOptions(**{option: value})
