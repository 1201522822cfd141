"""PatchMatch on a slanted plane, rendered along exact water rays."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
from dense_scenes import Plane

from uwsfm.dense.depth_map import pixel_rows
from uwsfm.dense.options import ASSUMED_NOISE_PX
from uwsfm.dense.patchmatch_depth import Neighbour, PatchMatch, depth_map_of
from uwsfm.dense.reduced import reduced_camera, reduced_image
from uwsfm.dense.warp import Placement
from uwsfm.geometry import rigid3
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.simulate.rigs import sample_rig

NORMAL = np.array([0.3, -0.25, 1.0]) / np.linalg.norm([0.3, -0.25, 1.0])
PLANE = Plane(NORMAL, 1.7, 0.008)
FINE = Plane(NORMAL, 1.7, 0.004)
LIMITS = 1.2, 2.8
NOTHING = np.empty((0, 3))
INNER = np.s_[12:-12, 20:-20]
"""Beyond it one neighbour at most sees the plane."""


@dataclass(frozen=True)
class Case:
    camera: RefractiveCamera
    image: np.ndarray
    neighbours: list[Neighbour]

    def depth(self, planes=None, seed=0):
        made = PatchMatch(self.camera, self.image, self.neighbours, LIMITS, seed)
        found = made.settled(made.search(NOTHING) if planes is None else planes)
        return depth_map_of(self.camera, *found)

    def truth(self):
        """Ranges (H, W) and points (N, 3)."""
        origins, dirs = self.camera.ray_from_img(
            pixel_rows(self.camera, 0, self.camera.height)
        )
        return PLANE.ranges(origins, dirs).reshape(self.image.shape)


def noisy(image, sigma, seed):
    noise = sigma * np.random.default_rng(seed).standard_normal(image.shape)
    return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def case() -> Case:
    camera = sample_rig(image_scale=0.2).refractive_cameras()[0]
    poses = [
        np.array([0.0, 0.0, np.sin(turn), np.cos(turn), x, y, 0.0])
        for x, y, turn in ((0.2, 0.0, 0.0), (-0.2, 0.05, 0.2), (0.0, 0.2, -0.1))
    ]
    neighbours = [
        Neighbour(
            placement=Placement(camera=camera, from_reference=pose),
            image=PLANE.image(camera, pose),
        )
        for pose in poses
    ]
    return Case(camera, PLANE.image(camera, rigid3.IDENTITY), neighbours)


def test_depths_and_normals_of_a_slanted_plane_are_found(case):
    depth = case.depth()
    px = ((depth.ranges - case.truth()) / depth.sensitivity)[INNER]
    assert np.mean(np.abs(px) < 0.5) > 0.99
    # Free of noise: what the interpolation of grey values leaves.
    assert np.nanmedian(np.abs(px)) < 0.03
    cosine = -depth.normals[INNER] @ NORMAL
    assert np.nanmedian(cosine) > np.cos(np.radians(5.0))


def test_the_same_seed_gives_the_same_depths(case):
    first, again, other = (case.depth(seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.ranges, again.ranges)
    assert not np.array_equal(first.ranges, other.ranges)


def test_a_neighbour_that_shows_something_else_is_left_out(case):
    """As one that is behind another surface, or whose picture is spoilt."""
    spoilt = replace(case.neighbours[0], image=case.neighbours[1].image[::-1].copy())
    depth = replace(case, neighbours=[spoilt, *case.neighbours]).depth()
    px = ((depth.ranges - case.truth()) / depth.sensitivity)[INNER]
    assert np.mean(np.abs(px) < 0.5) > 0.98


def plain_disc(camera, pose, radius=0.25):
    """An image of the plane with a disc that has one colour, and where it is."""
    image = FINE.image(camera, pose).astype(np.float64)
    back = rigid3.inverse(pose)
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    origins, dirs = rigid3.transform(back, origins), rigid3.rotate(back, dirs)
    points = origins + PLANE.ranges(origins, dirs)[:, None] * dirs
    disc = np.hypot(points[:, 0] - 0.05, points[:, 1]).reshape(image.shape) < radius
    image[disc] = 110.0
    return noisy(image, 1.0, int(1e6 * abs(pose[4]))), disc


def test_a_plain_area_is_filled_and_marked_and_known_less_well():
    """A disc 80 pixels across without any texture but noise, its images searched
    each for itself."""
    camera = sample_rig(image_scale=0.4).refractive_cameras()[0]
    moves = [(0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (-0.2, 0.05, 0.2), (0.1, 0.2, -0.1)]
    poses = [np.array([0, 0, np.sin(t), np.cos(t), x, y, 0]) for x, y, t in moves]
    images, discs = zip(*(plain_disc(camera, pose) for pose in poses), strict=True)

    def made(index, planes):
        back = rigid3.inverse(poses[index])
        neighbours = [
            Neighbour(
                placement=Placement(
                    camera=camera, from_reference=rigid3.compose(pose, back)
                ),
                image=image,
                planes=known,
            )
            for i, (pose, image, known) in enumerate(
                zip(poses, images, planes, strict=True)
            )
            if i != index
        ]
        return PatchMatch(camera, images[index], neighbours, LIMITS, index)

    planes = [made(i, [None] * len(poses)).search(NOTHING) for i in range(len(poses))]
    depth = depth_map_of(camera, *made(0, planes).settled(planes[0]))
    origins, dirs = camera.ray_from_img(pixel_rows(camera, 0, camera.height))
    truth = PLANE.ranges(origins, dirs).reshape(depth.ranges.shape)
    px = np.abs(depth.ranges - truth) / depth.sensitivity
    disc = discs[0]
    assert np.count_nonzero(disc) > 3000
    # Without the planes it is about half.
    assert np.mean(np.isfinite(px[disc])) > 0.97
    # A pixel is what they say; corners at its rim, which the planes go through, are
    # known to 0.2 px.
    assert np.nanmedian(px[disc]) < 0.3 and np.nanpercentile(px[disc], 95) < 1.0
    # Beside its rim there is texture within the patch.
    core = cv2.erode(disc.astype(np.uint8), np.ones((17, 17), np.uint8)) > 0
    assert np.mean(depth.plain[core]) > 0.95
    around = ~disc & np.isfinite(depth.ranges)
    assert np.mean(depth.plain[around]) < 0.05
    stddev = ASSUMED_NOISE_PX * depth.spread
    assert np.median(stddev[core & depth.plain]) > 5.0 * np.nanmedian(stddev[~disc])


def test_depths_that_neighbours_object_to_become_dear(case):
    """Where the images say nothing, what the neighbours found decides."""
    plain = np.full_like(case.image, 90)
    camera = case.camera
    half = reduced_camera(camera, 2)

    def inverse_of(lens, pose):
        origins, dirs = lens.ray_from_img(pixel_rows(lens, 0, lens.height))
        back = rigid3.inverse(pose)
        ranges = PLANE.ranges(
            rigid3.transform(back, origins), rigid3.rotate(back, dirs)
        )
        inverse = 1.0 / (origins + ranges[:, None] * dirs)[:, 2]
        return inverse.reshape(lens.height, lens.width)

    def planes_of(inverse):
        down, right = np.gradient(inverse)
        return np.stack([inverse, right, down], axis=-1).astype(np.float32)

    neighbours = [
        replace(
            n,
            image=plain,
            planes=planes_of(inverse_of(half, n.placement.from_reference)),
        )
        for n in case.neighbours
    ]
    made = PatchMatch(camera, plain, neighbours, LIMITS, 0)
    truth = inverse_of(half, rigid3.IDENTITY)
    start = planes_of(truth)
    start[..., 0] *= np.random.default_rng(0).uniform(0.95, 1.05, truth.shape)
    before = np.abs(start[..., 0] / truth - 1.0)[6:-6, 10:-10]
    planes, found = made.settled(start)
    after = np.abs(planes[..., 0] / inverse_of(camera, rigid3.IDENTITY) - 1.0)[INNER]
    assert np.median(after) < 0.2 * np.median(before)
    # They say so, and how badly a depth is known.
    assert np.mean(found[INNER][..., 4] >= 2) > 0.9
    assert np.nanmedian(found[INNER][..., 2]) > 0.5


def test_depths_are_as_good_as_they_say(case):
    """Median of error over deviation: 0.67 if errors are normal.

    With less noise the least deviation decides, which real images need (0.38 at five
    grey levels); with twice as much, half of the texture, slopes are of noise and the
    deviation is too small (1.16). Fusion finds the scale of all of them anew.
    """
    sigma = 8.0
    neighbours = [
        replace(n, image=noisy(n.image, sigma, 1 + i))
        for i, n in enumerate(case.neighbours)
    ]
    image = noisy(case.image, sigma, 0)
    depth = replace(case, image=image, neighbours=neighbours).depth()
    stddev = 0.3 * depth.spread * depth.sensitivity
    ratio = (np.abs(depth.ranges - case.truth()) / stddev)[INNER]
    assert 0.7 * 0.6745 < np.nanmedian(ratio) < 1.2 * 0.6745


def test_a_reduced_camera_sees_what_its_image_shows():
    camera = sample_rig(image_scale=0.25).refractive_cameras()[0]
    small = reduced_camera(camera, 3)
    assert (small.width, small.height) == (camera.width // 3, camera.height // 3)
    xy = np.array([[10.5, 20.5], [40.0, 31.0]])
    for found, expected in zip(
        small.ray_from_img(xy), camera.ray_from_img(3.0 * xy), strict=True
    ):
        np.testing.assert_allclose(found, expected, atol=1e-12)
    x = np.arange(camera.width) + 0.5
    ramp = np.tile(x, (camera.height, 1)).astype(np.float32)
    reduced = reduced_image(ramp, 3)
    assert reduced.shape == (small.height, small.width)
    # The mean of three pixels is at their middle, in pixels of the larger image.
    np.testing.assert_allclose(reduced[0], 3.0 * (np.arange(small.width) + 0.5))
