"""The surface that a model or a dense cloud knows, where people point at it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from uwsfm.cloud import read_cloud
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.results.folder import DENSE_CLOUD, Result, find_dense_cloud
from uwsfm.scene import IndexArray, Scene

NEIGHBOURS = 12
"""Points that tell the surface below a pixel."""
MAX_REACH = 0.03
"""Of the image's width: points farther from the pixel tell nothing of its surface."""
CANDIDATES = 3 * NEIGHBOURS
"""Points behind a surface, which it hides, are among the nearest."""
AROUND = 0.6
"""How far the middle of points around a pixel is from it, at most, in their reach."""
DEPTH_STEP = 0.05
"""Points that differ more in range are on something else."""
AWAY = 5.0
"""Times the spacing of the points around: farther, a place is none of the cloud's."""
WITNESSES = 10
"""Points of the model around a place: what saw them sees the place."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Points on surfaces (P, 3), where they come from, and what is known of each."""

    points: Array
    name: str
    stddev: Array | None = None
    """(P,) along the line of sight, metres; None: points of the model."""

    @property
    def is_model(self) -> bool:
        return self.stddev is None

    @cached_property
    def tree(self) -> cKDTree:
        return cKDTree(self.points)

    def nearest(self, xyz: Array) -> tuple[int, float]:
        """Index of the point that a place means, and how far off it is.

        Raises:
            InputError: the place is not on the cloud.
        """
        gaps, rows = self.tree.query(xyz, k=min(NEIGHBOURS, len(self.points)))
        spacing = float(np.median(self.tree.query(self.points[rows], k=2)[0][:, 1]))
        if not gaps[0] <= AWAY * spacing:
            raise InputError(
                f"the nearest point of {self.name} is {gaps[0]:.3g} m away, the points "
                f"there {spacing:.2g} m from each other: copy the place from the cloud"
            )
        return int(rows[0]), float(gaps[0])


@dataclass(frozen=True, eq=False)
class Patch:
    """The surface where the ray of a pixel meets it."""

    point: Array
    """(3,) in the world."""
    normal: Array
    """(3,) of the plane through the points around."""
    sight: Array
    """(3,) unit, direction of the ray."""
    relief: float
    """RMS distance of these points from the plane, along the ray, metres."""
    reach_px: float
    """How far the points are from the pixel at most."""
    stddev: float
    """That the cloud states along the line of sight; NaN if it does not."""


def surface_of(result: Result) -> Surface:
    """The dense cloud of a result; else the points of its model.

    Raises:
        InputError: the cloud cannot be read, or is of another model.
    """
    path = find_dense_cloud(result.folder)
    if path is not None:
        cloud = read_cloud(path)
        if len(cloud) < NEIGHBOURS:
            raise InputError(f"{path} has {len(cloud)} points only")
        return Surface(cloud.points, DENSE_CLOUD, cloud.stddev)
    return model_surface(result.model.scene)


def model_surface(scene: Scene) -> Surface:
    """The points of a model."""
    return Surface(scene.points, "the sparse model")


class SurfaceImage:
    """A surface as one image of the model sees it."""

    def __init__(self, surface: Surface, scene: Scene, camera: int, frame: int) -> None:
        self.surface, self.lens = surface, scene.cameras[camera]
        placement, pose = scene.cam_from_rig[camera], scene.rig_from_world[frame]
        self.cam_from_world = rigid3.compose(placement, pose)
        in_cam = rigid3.transform(self.cam_from_world, surface.points)
        pixels, valid = self.lens.img_from_point(in_cam)
        self.rows = np.flatnonzero(valid)
        self.ranges = np.linalg.norm(in_cam[valid], axis=1)
        self.pixels = pixels[valid]
        self.tree = cKDTree(self.pixels)

    def patch(self, xy: tuple[float, float]) -> Patch:
        """Where the ray of a pixel meets the surface.

        Raises:
            InputError: there is no surface there, or its depth jumps.
        """
        chosen = self._front(xy)
        near = self.surface.points[self.rows[chosen]]
        origin, sight = _ray_in_world(self.lens, self.cam_from_world, xy)
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle)[2][2]
        facing = float(normal @ sight)
        with np.errstate(divide="ignore", invalid="ignore"):
            off = (near - middle) @ normal / facing
        if not np.all(np.abs(off) < DEPTH_STEP * self.ranges[chosen]):
            raise InputError(f"the surface is seen edge-on there: {_TWICE}")
        stddev = self.surface.stddev
        stated = np.nan if stddev is None else np.median(stddev[self.rows[chosen]])
        along = float(normal @ (middle - origin)) / facing
        return Patch(
            point=origin + along * sight,
            normal=normal,
            sight=sight,
            relief=float(np.sqrt(np.mean(off**2))),
            reach_px=float(np.linalg.norm(self.pixels[chosen] - xy, axis=1).max()),
            stddev=float(stated),
        )

    def _front(self, xy: tuple[float, float]) -> IndexArray:
        """The nearest points around a pixel that nothing hides."""
        limit = MAX_REACH * self.lens.width
        gaps, found = self.tree.query(xy, k=CANDIDATES, distance_upper_bound=limit)
        found = found[np.isfinite(gaps)]
        if len(found) < NEIGHBOURS:
            raise InputError(
                f"{self.surface.name} has {len(found)} points within {limit:.0f} px of "
                f"the pixel, its surface takes {NEIGHBOURS}: {_TWICE}"
            )
        ranges = self.ranges[found]
        front = found[ranges <= (1.0 + DEPTH_STEP) * ranges.min()][:NEIGHBOURS]
        # Beside an edge they are all on one side of the pixel.
        offset = self.pixels[front] - xy
        aside = np.linalg.norm(offset.mean(axis=0))
        reach = np.linalg.norm(offset, axis=1).max()
        if len(front) < NEIGHBOURS or aside > AROUND * reach:
            raise InputError(
                f"the depth jumps there, from {ranges.min():.3g} to {ranges.max():.3g} "
                f"m around the pixel: {_TWICE}"
            )
        return front


_TWICE = "click the spot in a second image"


def _ray_in_world(lens, pose: Array, xy: tuple[float, float]) -> tuple[Array, Array]:
    """Origin and direction (3,) of a pixel's water ray in the world."""
    origin, direction = lens.ray_from_img([xy])
    back = rigid3.inverse(pose)
    world = rigid3.transform(back, origin)[0], rigid3.rotate(back, direction)[0]
    if not np.all(np.isfinite(world)):
        raise InputError("no ray in the water belongs to this pixel")
    return world


def views_of(
    scene: Scene, model: Surface, point: Array
) -> tuple[IndexArray, IndexArray, Array]:
    """Images that see a place: those that saw the model's points around it.

    Args:
        scene: of the model.
        model: its points.
        point: (3,) in the world.

    Returns:
        camera_idx, frame_idx (k,) and pixels (k, 2), inside of the images.
    """
    near = np.atleast_1d(model.tree.query(point, k=min(WITNESSES, scene.num_points))[1])
    rows = np.isin(scene.point_idx, near)
    images = np.unique(
        np.stack([scene.camera_idx[rows], scene.frame_idx[rows]], axis=1), axis=0
    )
    seen = Scene(
        cameras=scene.cameras,
        cam_from_rig=scene.cam_from_rig,
        rig_from_world=scene.rig_from_world,
        points=point[None],
        camera_idx=images[:, 0],
        frame_idx=images[:, 1],
        point_idx=np.zeros(len(images), dtype=np.int64),
        xy=np.zeros((len(images), 2)),
    )
    pixels, valid = seen.projections()
    sizes = np.array([(lens.width, lens.height) for lens in scene.cameras])
    size = sizes[images[:, 0]]
    inside = valid & np.all((pixels >= 0.0) & (pixels <= size), axis=1)
    return images[inside, 0], images[inside, 1], pixels[inside]
