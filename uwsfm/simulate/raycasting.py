"""Textured triangle meshes, and what rays hit of them (Open3D)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.packages import import_package
from uwsfm.geometry.rigid3 import Array
from uwsfm.simulate.texture import Texture


@dataclass(frozen=True, kw_only=True, eq=False)
class Surface:
    """A mesh in the world frame, with a texture and light that no view changes."""

    vertices: Array
    """(V, 3) metres."""
    triangles: NDArray[np.int64]
    """(T, 3) vertex indices; both sides are hit."""
    normals: Array
    """(V, 3) unit vertex normals, pointing into the water."""
    light: Array
    """(V,) what the texture's reflectance is multiplied by; static in the world."""
    texture: Texture
    texture_offset: tuple[float, float, float] | None = None
    """None: the texture is looked up at world x and y, exactly, whatever the mesh.
    Otherwise it is projected along all three axes, at the world position plus this, and
    blended by the normal: what steep objects need."""


@dataclass(frozen=True, eq=False)
class Hits:
    """What N rays hit first."""

    distance: NDArray[np.float32]
    """(N,) along the unit direction, metres; inf where nothing was hit."""
    surface_idx: NDArray[np.int64]
    """(N,), -1 where nothing was hit."""
    triangle_idx: NDArray[np.int64]
    """(N,) within the surface."""
    weights: NDArray[np.float32]
    """(N, 3) barycentric coordinates of the triangle's vertices."""


class RayScene:
    """Surfaces that rays can be cast against.

    Open3D works in single precision: within a few metres of the world's origin a hit is
    good to 1e-6 m, about a thousandth of a pixel.

    Raises:
        MissingPackageError: Open3D is missing.
    """

    def __init__(self, surfaces: tuple[Surface, ...]) -> None:
        self._open3d = import_package("open3d", "rendering", "render")
        self.surfaces = surfaces
        self._scene = self._open3d.t.geometry.RaycastingScene()
        for surface in surfaces:
            self._scene.add_triangles(
                self._open3d.core.Tensor(surface.vertices.astype(np.float32)),
                self._open3d.core.Tensor(surface.triangles.astype(np.uint32)),
            )
        # The first cast builds the search tree: now, before threads share the scene.
        self.cast(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))

    def cast(self, origins: Array, dirs: Array) -> Hits:
        """First hits of rays (N, 3), (N, 3) in the world frame."""
        found = self._scene.cast_rays(self._rays(origins, dirs))
        distance = found["t_hit"].numpy()
        missed = ~np.isfinite(distance)
        surface_idx = found["geometry_ids"].numpy().astype(np.int64)
        triangle_idx = found["primitive_ids"].numpy().astype(np.int64)
        surface_idx[missed], triangle_idx[missed] = -1, -1
        second, third = found["primitive_uvs"].numpy().T
        weights = np.stack([1.0 - second - third, second, third], axis=1)
        return Hits(distance, surface_idx, triangle_idx, weights)

    def is_hidden(self, origins: Array, dirs: Array, max_distance: float) -> Array:
        """1.0 where a ray (N, 3), (N, 3) hits something within a distance, else 0.0."""
        rays = self._rays(origins, dirs)
        hidden = self._scene.test_occlusions(rays, tnear=0.0, tfar=max_distance)
        return hidden.numpy().astype(np.float64)

    def _rays(self, origins: Array, dirs: Array):
        rays = np.concatenate([origins, dirs], axis=1, dtype=np.float32)
        return self._open3d.core.Tensor(rays)
