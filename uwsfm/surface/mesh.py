"""Surfaces through clouds, with holes where there is no data (Open3D)."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from uwsfm._base.packages import import_package
from uwsfm.cloud import Cloud
from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry.rigid3 import Array
from uwsfm.surface.height_map import point_spacing

METHODS = ("poisson", "ball-pivoting")
_GAP_SPACINGS = 4.0
# Of Poisson's octree: 1024 cells on a side; each level takes four times the memory.
_MAX_DEPTH = 10
# Balls, in spacings: a small one keeps detail, large ones close what it leaves.
_BALLS = (1.0, 2.0, 4.0)
_NORMAL_NEIGHBOURS = 24
_COLOR_NEIGHBOURS = 4
_DENSITY_QUANTILE = 0.01
_MIN_POINTS = 10


@dataclass(frozen=True, kw_only=True, eq=False)
class Mesh:
    """Triangles in the world frame, metres."""

    vertices: Array
    """(V, 3)"""
    triangles: NDArray[np.int64]
    """(T, 3) vertex indices, counter-clockwise seen from the water."""
    normals: Array
    """(V, 3) unit, into the water."""
    colors: NDArray[np.uint8]
    """(V, 3) RGB"""

    def area(self) -> float:
        return float(
            np.linalg.norm(_cross(self.vertices, self.triangles), axis=1).sum() / 2
        )


def make_mesh(
    cloud: Cloud, method: str, max_distance: float | None, above: Array | None
) -> tuple[Mesh, float]:
    """A surface through the points of a cloud, and nowhere else.

    Args:
        cloud: points; where normals are missing, all are estimated.
        method: one of `METHODS`.
        max_distance: from every vertex and every middle of a triangle to the nearest
            point, at most; default: four times the spacing of the points.
        above: (3,) where normals that are estimated point to.

    Returns:
        The mesh, and the largest distance that was allowed.

    Raises:
        InputError: an unknown method, or a distance that is not positive.
        UwsfmError: too few points, or no surface is near them.
        MissingPackageError: Open3D is missing.
    """
    if method not in METHODS:
        raise InputError(f"--method {method}: is one of {', '.join(METHODS)}")
    if max_distance is not None and not max_distance > 0.0:
        raise InputError(f"--max-distance must be positive, got {max_distance}")
    open3d = import_package("open3d", "a mesh", "inspect")
    cloud = cloud.select(np.isfinite(cloud.points).all(axis=1))
    if len(cloud) < _MIN_POINTS:
        raise UwsfmError(f"a mesh needs more than {len(cloud)} points")
    # Coordinates far from zero would lose their digits.
    middle = cloud.points.mean(axis=0)
    points = cloud.points - middle
    spacing = point_spacing(points)
    reach = _GAP_SPACINGS * spacing if max_distance is None else float(max_distance)
    o3d_cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    _give_normals(o3d_cloud, open3d, cloud.normals, above, middle)
    if method == "poisson":
        raw = _poisson(open3d, o3d_cloud, spacing)
    else:
        radii = [ball * spacing for ball in _BALLS if ball * spacing <= reach]
        raw = open3d.geometry.TriangleMesh.create_from_point_cloud_ball_pivoting(
            o3d_cloud, open3d.utility.DoubleVector(radii or [reach])
        )
    tree = cKDTree(points)
    _trim(raw, tree, reach)
    if len(raw.triangles) == 0:
        raise UwsfmError(
            f"no surface lies within {reach:.3g} of the points: take a larger "
            "--max-distance"
        )
    return _as_mesh(raw, tree, cloud.colors, middle), reach


def decimated(mesh: Mesh, num_triangles: int, cloud: Cloud) -> Mesh:
    """A copy with fewer triangles (quadric errors), coloured anew by the cloud.

    Args:
        mesh: what to reduce; comes back as it is if it has few triangles already.
        num_triangles: at most.
        cloud: the points it was made from.
    """
    if len(mesh.triangles) <= num_triangles:
        return mesh
    open3d = import_package("open3d", "a mesh", "inspect")
    middle = mesh.vertices.mean(axis=0)
    raw = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(mesh.vertices - middle),
        open3d.utility.Vector3iVector(mesh.triangles),
    )
    raw = raw.simplify_quadric_decimation(num_triangles)
    raw.remove_unreferenced_vertices()
    good = np.isfinite(cloud.points).all(axis=1)
    tree = cKDTree(cloud.points[good] - middle)
    return _as_mesh(raw, tree, cloud.colors[good], middle)


def distances_to_cloud(mesh: Mesh, cloud: Cloud) -> Array:
    """From vertices and middles of triangles to the nearest point (V + T,)."""
    good = np.isfinite(cloud.points).all(axis=1)
    places = [mesh.vertices, mesh.vertices[mesh.triangles].mean(axis=1)]
    return cKDTree(cloud.points[good]).query(np.concatenate(places), workers=-1)[0]


def _give_normals(
    o3d_cloud: Any,
    open3d: ModuleType,
    normals: Array,
    above: Array | None,
    middle: Array,
) -> None:
    if np.isfinite(normals).all():
        o3d_cloud.normals = open3d.utility.Vector3dVector(normals)
        return
    if above is None:
        raise InputError(
            "the cloud has points without normals, and no cameras tell which side of "
            "them is the water"
        )
    search = open3d.geometry.KDTreeSearchParamKNN(_NORMAL_NEIGHBOURS)
    o3d_cloud.estimate_normals(search)
    found = np.asarray(o3d_cloud.normals).copy()
    to_camera = above - middle - np.asarray(o3d_cloud.points)
    found[np.einsum("ni,ni->n", found, to_camera) < 0.0] *= -1.0
    # Those that are known, are better.
    known = np.isfinite(normals).all(axis=1)
    found[known] = normals[known]
    o3d_cloud.normals = open3d.utility.Vector3dVector(found)


def _poisson(open3d: ModuleType, o3d_cloud: Any, spacing: float) -> Any:
    """Screened Poisson with cells of one or two spacings, without the thinnest part."""
    extent = float(np.max(o3d_cloud.get_max_bound() - o3d_cloud.get_min_bound()))
    depth = int(np.clip(np.floor(np.log2(1.1 * extent / spacing)), 4, _MAX_DEPTH))
    raw, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        o3d_cloud, depth=depth, linear_fit=True
    )
    values = np.asarray(density)
    raw.remove_vertices_by_mask(values < np.quantile(values, _DENSITY_QUANTILE))
    return raw


def _trim(raw: Any, tree: cKDTree, reach: float) -> None:
    """Take away what is far from the points, and what is then alone."""
    vertices = np.asarray(raw.vertices)
    far = tree.query(vertices, distance_upper_bound=reach, workers=-1)[0] > reach
    raw.remove_vertices_by_mask(far)
    vertices, triangles = np.asarray(raw.vertices), np.asarray(raw.triangles)
    if len(triangles) == 0:
        return
    middles = vertices[triangles].mean(axis=1)
    far = tree.query(middles, distance_upper_bound=reach, workers=-1)[0] > reach
    raw.remove_triangles_by_mask(far)
    raw.remove_degenerate_triangles()
    raw.remove_unreferenced_vertices()


def _as_mesh(raw: Any, tree: cKDTree, colors: NDArray[np.uint8], middle: Array) -> Mesh:
    vertices = np.array(raw.vertices)
    triangles = np.array(raw.triangles, dtype=np.int64)
    faces = _cross(vertices, triangles)
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], faces)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(
        normals, lengths, where=lengths > 0.0, out=np.zeros_like(normals)
    )
    count = min(_COLOR_NEIGHBOURS, tree.n)
    distance, near = tree.query(vertices, k=list(range(1, count + 1)), workers=-1)
    weights = 1.0 / np.maximum(distance, 1e-12)
    weights /= weights.sum(axis=1, keepdims=True)
    mixed = np.einsum("vk,vkc->vc", weights, colors[near].astype(np.float64))
    return Mesh(
        vertices=vertices + middle,
        triangles=triangles,
        normals=normals,
        colors=np.rint(mixed).astype(np.uint8),
    )


def _cross(vertices: Array, triangles: NDArray[np.int64]) -> Array:
    """Twice the area times the normal of each triangle (T, 3)."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)
