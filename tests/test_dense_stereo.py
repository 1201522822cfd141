"""Depth maps of rendered pairs, against the exact depths of their pixels."""

import numpy as np
import pycolmap
import pytest
from dense_scenes import Plane

from uwsfm.dense.depth_map import pixel_rows
from uwsfm.dense.match import match_tiles
from uwsfm.dense.rectify import MAX_DEVIATION_PX, Pair, rectifications
from uwsfm.dense.stereo import rectified_images, stereo_depth
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import FlatPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.simulate.rigs import known_cam_from_rig, sample_rig, tilted_normal


def seen_by_both(pair: Pair, plane: Plane):
    """True ranges (H, W) of the left pixels, and which of them the right shows."""
    camera = pair.left
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    ranges = plane.ranges(origins, dirs)
    points = origins + ranges[:, None] * dirs
    xy, ok = pair.right.img_from_point(rigid3.transform(pair.right_from_left, points))
    ok &= np.all((xy > 0) & (xy < [pair.right.width, pair.right.height]), axis=1)
    shape = camera.height, camera.width
    return ranges.reshape(shape), ok.reshape(shape)


def images_of(pair: Pair, plane: Plane):
    return plane.image(pair.left, rigid3.IDENTITY), plane.image(
        pair.right, pair.right_from_left
    )


@pytest.fixture(scope="module")
def sample_pair() -> tuple[Pair, Plane]:
    """The sample's rig at 320 x 240 before a slanted plane, 1.3 to 2.6 m away."""
    rig = sample_rig(image_scale=0.4)
    left, right = rig.refractive_cameras()
    normal = np.array([0.3, -0.25, 1.0]) / np.linalg.norm([0.3, -0.25, 1.0])
    pair = Pair(
        left=left,
        right=right,
        right_from_left=known_cam_from_rig(rig)[1],
        near=1.2,
        far=2.8,
    )
    return pair, Plane(normal, 1.7, 0.005)


def test_a_slanted_plane_is_measured_without_bend(sample_pair):
    pair, plane = sample_pair
    truth, visible = seen_by_both(pair, plane)
    slabs = rectifications(pair)
    depth = stereo_depth(slabs, *images_of(pair, plane), 1e9)
    error = depth.ranges - truth
    px = np.abs(error / depth.sensitivity)[visible]
    # A pixel that only one image shows in full is lost along the border.
    assert np.mean(px < 0.9) > 0.95
    # Noise-free images: what is left is interpolation and the matcher's windows.
    assert np.nanmedian(px) < 0.06
    y, x = np.mgrid[: pair.left.height, : pair.left.width]
    radius = np.hypot(x - 160, y - 120)
    for low in range(0, 160, 40):
        ring = visible & (radius >= low) & (radius < low + 40)
        # 0.1 % of the distance is 0.03 px here: port and centres off by nothing.
        assert abs(np.nanmedian((error / truth)[ring])) < 1e-3


def test_the_sensitivity_is_the_range_per_pixel(sample_pair):
    pair, plane = sample_pair
    depth = stereo_depth(rectifications(pair), *images_of(pair, plane), 1e9)
    truth, visible = seen_by_both(pair, plane)
    # By the exact projections: how far the match moves in the right image when the
    # point moves a little along the left ray.
    camera = pair.left
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    step = 1e-4
    shown = [
        pair.right.img_from_point(
            rigid3.transform(pair.right_from_left, origins + r[:, None] * dirs)
        )[0]
        for r in (truth.ravel(), truth.ravel() + step)
    ]
    moved = np.linalg.norm(shown[1] - shown[0], axis=1).reshape(truth.shape)
    ratio = (depth.sensitivity * moved / step)[visible & np.isfinite(depth.ranges)]
    # Rectified pixels are as large as raw ones in the middle, smaller in the corners.
    assert np.all(np.abs(ratio - 1.0) < 0.45)
    assert abs(np.median(ratio) - 1.0) < 0.1


def near_pair(far: float) -> tuple[Pair, Plane]:
    """Ports far from the lens and tilted, close to the scene: no central pair fits."""
    normals = (tilted_normal(10.0, 40.0), tilted_normal(8.0, -60.0))
    left, right = (
        RefractiveCamera(
            pycolmap.Camera(
                model="PINHOLE", width=240, height=180, params=[180, 180, 120, 90]
            ),
            FlatPort(normal, 0.12, 0.01, 1.5, 1.333),
        )
        for normal in normals
    )
    pose = np.array([0.0, 0.0, 0.0, 1.0, -0.08, 0.0, 0.0])
    slant = np.array([0.0, -1.2, 1.0]) / np.linalg.norm([0.0, -1.2, 1.0])
    pair = Pair(left=left, right=right, right_from_left=pose, near=0.28, far=far)
    return pair, Plane(slant, 0.3, 0.0012)


def test_rows_correspond_exactly_at_the_depth_of_reference():
    pair, _ = near_pair(0.8)
    slab = rectifications(pair)[0]
    origins, dirs = pair.left.ray_from_img(pixel_rows(pair.left, 0, 180, step=20))
    shown = slab.shown_by(origins, dirs, slab.depth)
    offset = slab.rect_from_left_rays(origins, dirs) - slab.rect_from_right_img(shown)
    # Two exact projections and their inverses.
    np.testing.assert_allclose(offset[:, 1], 0.0, atol=1e-8)


def test_the_depth_range_is_split_where_rows_part():
    pair, plane = near_pair(0.8)
    slabs = rectifications(pair)
    assert len(slabs) > 1
    assert max(slab.deviation_px for slab in slabs) <= MAX_DEVIATION_PX
    assert all(a.far == b.near for a, b in zip(slabs, slabs[1:], strict=False))
    truth, visible = seen_by_both(pair, plane)
    depth = stereo_depth(slabs, *images_of(pair, plane), 1e9)
    px = np.abs((depth.ranges - truth) / depth.sensitivity)
    origins, dirs = pair.left.ray_from_img(pixel_rows(pair.left, 0, 180))
    along = (origins - slabs[0].centers[0] + truth.reshape(-1, 1) * dirs) @ (
        slabs[0].rect_from_left[2]
    )
    for slab in slabs:
        inside = (along > slab.near) & (along < slab.far)
        part = px[visible & inside.reshape(truth.shape)]
        if len(part) > 500:
            assert np.mean(part < 0.9) > 0.85
            assert np.nanmedian(part) < 0.1


def test_tiles_find_what_the_whole_image_does(sample_pair):
    pair, plane = sample_pair
    (slab,) = rectifications(pair)
    left, right = rectified_images(slab, *images_of(pair, plane))
    whole = match_tiles(left, right, slab.num_disparities, 1e9)
    tiles = match_tiles(left, right, slab.num_disparities, 4e6)
    both = np.isfinite(whole) & np.isfinite(tiles)
    assert np.count_nonzero(both) > 0.98 * np.count_nonzero(np.isfinite(whole))
    # Semi-global costs come from afar: a few pixels differ.
    assert np.mean(np.abs(whole - tiles)[both] > 0.25) < 0.01


def test_cameras_that_cannot_be_rectified_are_refused(sample_pair):
    pair, _ = sample_pair
    behind = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.2])
    turned = np.array([0.0, np.sin(0.7), 0.0, np.cos(0.7), 0.2, 0.0, 0.0])
    for pose, words in ((behind, "behind each other"), (turned, "too little view")):
        with pytest.raises(InputError, match=words):
            rectifications(
                Pair(
                    left=pair.left,
                    right=pair.right,
                    right_from_left=pose,
                    near=1.0,
                    far=2.0,
                )
            )
