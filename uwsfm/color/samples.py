"""How bright each point looks in each image, and through how much water.

A point is always seen by the same patch of the scene: the pixels that a disc of fixed
size in the world covers, wider from near than from far. Single pixels would mix with
the range: keypoints are the darkest or brightest spots, and from afar less so.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm.color.encoding import Light, light_of
from uwsfm.geometry.rigid3 import Array
from uwsfm.scene import IndexArray, Scene

_MIN_RADIUS_PX = 5.0
"""Of a patch in the image where it is smallest. The blur of the lens,
and of colours in JPEG files, must hardly reach across it: contrasts that fade with the
range pass for attenuation and veil."""
_SATURATED = 0.99
_ANGLES = np.radians([15.0, 30.0, 45.0, 60.0, 75.0])
_RECTANGLES = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """N observations of points, by images."""

    light: Light
    """(N, 3) mean linear red, green, blue of the patch; NaN where it leaves the image
    or any of it is overexposed."""
    range: Array
    """(N,) length of the ray in the water, in the unit of the scene."""
    point_idx: IndexArray
    """(N,)"""
    image_idx: IndexArray
    """(N,) camera * num_frames + frame"""
    wide_light: Light
    """(N, 3) of patches twice as large: what differs is an error of the method."""
    pixel_light: Light
    """(N, 3) of the one pixel at the observation."""
    num_lost: int
    """Observations without light: overexposed, or at the border of the image."""


def sample_scene(
    scene: Scene, read: Callable[[int, int], NDArray], encoding: str
) -> Samples:
    """Look at all observations of a scene.

    Args:
        scene: points, poses and observations.
        read: the image (height, width, 3), RGB, of a camera and a frame.
        encoding: of the images, one of `uwsfm.color.encoding.ENCODINGS`.
    """
    origins, _ = scene.water_rays()
    ranges = np.linalg.norm(scene.points[scene.point_idx] - origins, axis=1)
    radius = _radii(scene, ranges)
    light, wide, pixel = (np.full((scene.num_observations, 3), np.nan) for _ in "123")
    image_idx = scene.camera_idx * scene.num_frames + scene.frame_idx
    num_lost = 0
    for image in np.unique(image_idx):
        rows = np.flatnonzero(image_idx == image)
        camera, frame = divmod(int(image), scene.num_frames)
        linear = light_of(read(camera, frame), encoding)
        burnt = np.any(linear >= _SATURATED, axis=2, keepdims=True).astype(np.float64)
        for found, size in ((light, 1.0), (wide, 2.0)):
            reach = size * radius[rows]
            means = patch_means(linear, scene.xy[rows], reach)
            lost = patch_means(burnt, scene.xy[rows], reach)[:, 0] > 0.0
            means[lost] = np.nan
            found[rows] = means
        num_lost += int(np.count_nonzero(np.isnan(light[rows, 0])))
        column, row = np.floor(scene.xy[rows]).astype(np.int64).T
        height, width = linear.shape[:2]
        pixel[rows] = linear[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return Samples(
        light=light,
        range=ranges,
        point_idx=scene.point_idx,
        image_idx=image_idx.astype(np.int64),
        wide_light=wide,
        pixel_light=pixel,
        num_lost=num_lost,
    )


def _radii(scene: Scene, ranges: Array) -> Array:
    """Radius of each observation's patch (N,), pixels."""
    footprint = np.empty(scene.num_observations)  # of a pixel, in the scene
    for index, camera in enumerate(scene.cameras):
        rows = scene.camera_idx == index
        _, here = camera.ray_from_img(scene.xy[rows])
        _, beside = camera.ray_from_img(scene.xy[rows] + [1.0, 0.0])
        footprint[rows] = ranges[rows] * np.linalg.norm(beside - here, axis=1)
    largest = np.zeros(scene.num_points)
    np.fmax.at(largest, scene.point_idx, footprint)
    return _MIN_RADIUS_PX * largest[scene.point_idx] / footprint


def patch_means(image: Light, xy: Array, radius: Array) -> Light:
    """Means over round patches, weighted more in the middle.

    A patch is the sum of rectangles inscribed in its circle: fast whatever its size,
    and nearly the same whichever way the camera is turned, which squares are not.

    Args:
        image: (height, width, channels)
        xy: (N, 2) centres; the centre of the first pixel is (0.5, 0.5).
        radius: (N,) pixels.

    Returns:
        (N, channels), NaN where a patch is not inside the image.
    """
    height, width, channels = image.shape
    low, high = xy - radius[:, None], xy + radius[:, None]
    inside = (low >= 0.0).all(axis=1) & (high <= (width, height)).all(axis=1)
    means = np.full((len(xy), channels), np.nan)
    # Sums up to a corner: exactly bilinear within a pixel, for pixels are constant.
    integral = np.asarray(cv2.integral(image, sdepth=cv2.CV_64F), dtype=np.float64)
    sums = integral.reshape(height + 1, width + 1, channels)
    center, reach = xy[inside], radius[inside, None]
    means[inside] = np.mean(
        [_rectangle_means(sums, center, reach * shape) for shape in _RECTANGLES], axis=0
    )
    return means


def _rectangle_means(sums: Light, center: Array, half: Array) -> Light:
    """Means (n, channels) over rectangles with half sides (n, 2)."""
    low, high = center - half, center + half
    corner = [_bilinear(sums, x, y) for y in (low, high) for x in (low, high)]
    total = corner[3] - corner[2] - corner[1] + corner[0]
    return total / np.prod(high - low, axis=1)[:, None]


def _bilinear(sums: Light, x_of: Array, y_of: Array) -> Light:
    """Values (n, channels) at x of one corner and y of another."""
    x, y = x_of[:, 0], y_of[:, 1]
    column = np.minimum(x.astype(np.int64), sums.shape[1] - 2)
    row = np.minimum(y.astype(np.int64), sums.shape[0] - 2)
    u, v = (x - column)[:, None], (y - row)[:, None]
    upper = (1.0 - u) * sums[row, column] + u * sums[row, column + 1]
    lower = (1.0 - u) * sums[row + 1, column] + u * sums[row + 1, column + 1]
    return (1.0 - v) * upper + v * lower
