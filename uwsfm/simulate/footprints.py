"""What part of the sea floor each image of a dive may see."""

import numpy as np
from numpy.typing import ArrayLike

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.simulate.rigs import known_cam_from_rig


def footprints(
    rig: Rig, rig_from_world: ArrayLike, *, half_depth: float, max_range: float
) -> Array:
    """Bounding boxes (F, C, 2, 2) [low, high] of the x and y each image may see.

    The water rays of the image border are followed to the planes ``z = -half_depth``
    and ``z = half_depth``, or as far as the water lets one see.

    Args:
        rig: With known cam_from_rig.
        rig_from_world: Poses (F, 7).
        half_depth: The floor lies within this of ``z = 0``, metres.
        max_range: Along the ray, metres.
    """
    poses = np.asarray(rig_from_world, dtype=np.float64)
    border = _unit_square_border(9)
    planes = half_depth * np.array([-1.0, 1.0])[:, None, None]
    boxes = np.empty((len(poses), len(rig.cameras), 2, 2))
    placed = zip(rig.refractive_cameras(), known_cam_from_rig(rig), strict=True)
    for c, (camera, cam_from_rig) in enumerate(placed):
        rays = camera.ray_from_img(border * [camera.width, camera.height])
        usable = np.isfinite(rays[1]).all(axis=1)
        world_from_cam = rigid3.inverse(rigid3.compose(cam_from_rig, poses))[:, None]
        origins = rigid3.transform(world_from_cam, rays[0][usable])  # (F, rays, 3)
        dirs = rigid3.rotate(world_from_cam, rays[1][usable])
        with np.errstate(divide="ignore", invalid="ignore"):
            far = (planes - origins[..., 2]) / dirs[..., 2]  # (2, F, rays)
        far = np.where((far > 0.0) & (far < max_range), far, max_range)
        hits = origins[..., :2] + far[..., None] * dirs[..., :2]
        boxes[:, c, 0], boxes[:, c, 1] = hits.min(axis=(0, 2)), hits.max(axis=(0, 2))
    return boxes


def _unit_square_border(per_side: int) -> Array:
    """Points (4 per_side, 2) on the sides of the unit square."""
    along = np.tile(np.linspace(0.0, 1.0, per_side), 2)
    across = np.repeat([0.0, 1.0], per_side)
    return np.concatenate(
        [np.stack([along, across], axis=1), np.stack([across, along], axis=1)]
    )
