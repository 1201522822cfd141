"""A mesh cut into charts that lie flat in one picture (xatlas)."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm._base.packages import import_package
from uwsfm.geometry.rigid3 import Array
from uwsfm.surface.mesh import Mesh

_FILL = 0.6
"""Share of a picture that charts cover, or less: what is left is between them."""
_PADDING = 2
"""Texels around each chart, for viewers that blend neighbours."""
_SUBTEXEL_BITS = 6


@dataclass(frozen=True, kw_only=True, eq=False)
class Atlas:
    """A mesh whose every corner has a place in a picture."""

    mesh: Mesh
    """Vertices on the border of a chart are there once for each."""
    uv: NDArray[np.float32]
    """(V, 2) place of each vertex, shares of width and height from the upper left."""
    size: tuple[int, int]
    """Width and height, texels."""
    texel: NDArray[np.int64]
    """(N,) the texels that triangles cover, row * width + column."""
    triangle: NDArray[np.int64]
    """(N,) the triangle of each."""
    points: Array
    """(N, 3) where the texels' middles lie on the mesh."""
    normals: Array
    """(N, 3) of their triangles, unit, into the water."""
    colors: NDArray[np.uint8]
    """(N, 3) of the vertices, between them."""


def make_atlas(mesh: Mesh, texel_size: float, max_side: int) -> Atlas:
    """Unfold a mesh.

    Args:
        mesh: of some 100 000 triangles at most: unfolding takes half a minute then.
        texel_size: side of a texel on the mesh; larger where the picture would be
            larger than ``max_side`` squared.
        max_side: texels.

    Raises:
        MissingPackageError: xatlas is missing.
    """
    xatlas = import_package("xatlas", "a textured mesh", "inspect")
    middle = mesh.vertices.mean(axis=0)
    unfolded = xatlas.Atlas()
    unfolded.add_mesh(
        (mesh.vertices - middle).astype(np.float32), mesh.triangles.astype(np.uint32)
    )
    options = xatlas.PackOptions()
    options.padding, options.bilinear = _PADDING, True
    most = float(np.sqrt(_FILL * max_side**2 / max(mesh.area(), 1e-300)))
    options.texels_per_unit = min(1.0 / texel_size, most)
    unfolded.generate(pack_options=options)
    vertex, triangles, uv = unfolded.get_mesh(0)
    cut = Mesh(
        vertices=mesh.vertices[vertex],
        triangles=triangles.astype(np.int64),
        normals=mesh.normals[vertex],
        colors=mesh.colors[vertex],
    )
    size = int(unfolded.width), int(unfolded.height)
    return _with_texels(cut, uv.astype(np.float32), size)


def _with_texels(mesh: Mesh, uv: NDArray[np.float32], size: tuple[int, int]) -> Atlas:
    places = uv[mesh.triangles].astype(np.float64) * size  # (T, 3, 2), from the corner
    owner = _owners(places, size)
    texel = np.flatnonzero(owner >= 0)
    triangle = owner[texel].astype(np.int64)
    middles = np.stack([texel % size[0] + 0.5, texel // size[0] + 0.5], axis=1)
    weights = _barycentric(places[triangle], middles)
    corners = mesh.triangles[triangle]
    sides = mesh.vertices[mesh.triangles]
    normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-300)[:, None]
    colors = np.einsum("nk,nkc->nc", weights, mesh.colors[corners].astype(np.float64))
    return Atlas(
        mesh=mesh,
        uv=uv,
        size=size,
        texel=texel,
        triangle=triangle,
        points=np.einsum("nk,nkc->nc", weights, mesh.vertices[corners]),
        normals=normals[triangle],
        colors=np.rint(np.clip(colors, 0.0, 255.0)).astype(np.uint8),
    )


def _owners(places: Array, size: tuple[int, int]) -> NDArray[np.int32]:
    """The triangle (height * width,) that covers or touches each texel; -1: none."""
    owner = np.full((size[1], size[0]), -1, dtype=np.int32)
    scale = 1 << _SUBTEXEL_BITS
    corners = np.rint((places - 0.5) * scale).astype(np.int32)  # of middles, for OpenCV
    for index, triangle in enumerate(corners):
        cv2.fillConvexPoly(owner, triangle, index, shift=_SUBTEXEL_BITS)
    return owner.ravel()


def _barycentric(triangles: Array, places: Array) -> Array:
    """Weights (N, 3) of the corners of triangles (N, 3, 2) at places (N, 2) in them; of
    places at an edge, outside by less than a texel, those of the edge."""
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = places - triangles[:, 0]
    area = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = np.where(np.abs(area) > 1e-12, area, np.inf)
    second = (p[:, 0] * b[:, 1] - p[:, 1] * b[:, 0]) / area
    third = (a[:, 0] * p[:, 1] - a[:, 1] * p[:, 0]) / area
    weights = np.stack([1.0 - second - third, second, third], axis=1)
    weights = np.clip(weights, 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)
