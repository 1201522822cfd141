"""Ends of scale bars that people marked: how well they are placed, and where."""

from dataclasses import replace

import numpy as np

from uwsfm.calibration.lengths import Lengths
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array, rotmat_from_quat
from uwsfm.scene import Scene

MAX_MISS = 15.0
"""Standard deviations of a click; beyond, another thing was clicked."""


def with_click_noise(lengths: Lengths, scene: Scene) -> Lengths:
    """Lengths whose standard deviations hold those of their clicked ends.

    Features are an order better than clicks, but observations have one weight: so the
    noise of the clicks goes with the length.

    Args:
        lengths: of ``scene``.
        scene: with its points where they belong.

    Raises:
        InputError: an end cannot be placed.
    """
    bars, noise = lengths.between_points, lengths.click_stddevs_px
    if bars is None or noise is None:
        return lengths
    if not np.all(np.isfinite(scene.points[bars.ends])):
        row = int(np.argmax(~np.isfinite(scene.points[bars.ends]).all(axis=(1, 2))))
        raise InputError(
            f"scale bar {row + 1}: an end cannot be placed, as its images see it from "
            "the same side, or not at one place"
        )
    clicked = np.zeros(scene.num_observations, dtype=bool)
    clicked[lengths.clicked] = True
    part, used = scene.select(clicked)
    information = np.zeros((part.num_points, 3, 3))
    jac = pixels_by_point(part)
    np.add.at(information, part.point_idx, np.swapaxes(jac, 1, 2) @ jac)
    spread = np.linalg.inv(information)
    ends = np.searchsorted(used, bars.ends)
    along = scene.points[bars.ends[:, 0]] - scene.points[bars.ends[:, 1]]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    both = spread[ends[:, 0]] + spread[ends[:, 1]]
    of_clicks = noise**2 * np.einsum("ma,mab,mb->m", along, both, along)
    stddevs = np.sqrt(bars.stddevs_m**2 + of_clicks)
    return replace(lengths, between_points=replace(bars, stddevs_m=stddevs))


def check_clicks(lengths: Lengths, scene: Scene) -> None:
    """Refuse clicks on one end that are not on one thing.

    Args:
        lengths: of ``scene``.
        scene: adjusted, up to how far clicks are off.

    Raises:
        InputError: the first end whose clicks miss each other.
    """
    bars, noise = lengths.between_points, lengths.click_stddevs_px
    if bars is None or noise is None:
        return
    miss = np.linalg.norm(scene.residuals()[lengths.clicked], axis=1)
    points = scene.point_idx[lengths.clicked]
    for row, ends in enumerate(bars.ends):
        for end, point in enumerate(ends):
            worst = float(np.max(miss[points == point]))
            if not worst <= MAX_MISS * noise[row]:
                raise InputError(
                    f"scale bar {row + 1}, end {end + 1}: its clicks miss each other "
                    f"by {worst:.0f} px: was the same end clicked in all images?"
                )


def pixels_by_point(scene: Scene) -> Array:
    """d(pixel) / d(point in the world), (N, 2, 3)."""
    jac = np.full((scene.num_observations, 2, 3), np.nan)
    in_cam = scene.points_in_cam()
    for c, camera in enumerate(scene.cameras):
        rows = scene.camera_idx == c
        jac[rows] = camera.img_from_point_with_jac(in_cam[rows])[1][:, :, :3]
    poses = rigid3.compose(
        scene.cam_from_rig[scene.camera_idx], scene.rig_from_world[scene.frame_idx]
    )
    return jac @ rotmat_from_quat(poses[:, :4])
