"""The rendered sea floor: a relief with boulders, textured and lit."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array
from uwsfm.simulate.floor_texture import TO_LIGHT, rock_image, sea_floor_image
from uwsfm.simulate.raycasting import RayScene, Surface
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.texture import Texture

ROCK_TEXTURE_SIDE = 1.5
NUM_FACETS = 14  # of a boulder, before its corners are rounded
SKY_SHARE = 0.55  # of the light of an open, level floor; the rest comes from TO_LIGHT
SKY_RAYS, SUN_RAYS = 32, 12
SHADE_REACH = 0.6  # what is further away casts no shadow: under water light is diffuse


@dataclass(frozen=True, kw_only=True)
class SeaFloorOptions:
    """What the sea floor looks like. Lengths in metres.

    Raises:
        InputError: a length that is not positive, or a negative number of boulders.
    """

    relief: Relief = field(
        default_factory=lambda: Relief(stddev=0.06, correlation_length=0.4)
    )
    num_boulders: int = 9
    boulder_radius: tuple[float, float] = (0.06, 0.17)
    """Smallest and largest."""
    boulder_extent: float = 0.8
    """Boulders lie in this radius around the origin."""
    texel: float = 0.0006
    """Of the texture; finer than a pixel at the closest approach."""
    mesh_step: float = 0.01
    """Of the relief's mesh. Facets do no harm: the mesh is the floor."""
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("boulder_extent", "texel", "mesh_step"):
            if not getattr(self, name) > 0.0:
                raise InputError(
                    f"sea floor {name} must be positive, got {getattr(self, name)}"
                )
        if not 0.0 < self.boulder_radius[0] <= self.boulder_radius[1]:
            raise InputError(
                f"sea floor boulder_radius must be ordered, got {self.boulder_radius}"
            )
        if self.num_boulders < 0:
            raise InputError(
                f"sea floor num_boulders must be >= 0, got {self.num_boulders}"
            )


def build_sea_floor(options: SeaFloorOptions, low: Array, high: Array) -> RayScene:
    """Model, paint and light the sea floor.

    Args:
        options: What it looks like.
        low: Smallest x and y (2,) that can be seen, metres.
        high: Largest x and y (2,).

    Raises:
        InputError: the texture would be too large.
        MissingPackageError: Open3D is missing.
    """
    # Separate streams: finer texels leave the boulders where they are.
    painting, placing = (np.random.default_rng([options.seed, k]) for k in (0, 1))
    size = (float(high[0] - low[0]), float(high[1] - low[1]))
    floor = Texture.from_image(
        sea_floor_image(size, options.texel, painting),
        (float(low[0]), float(low[1])),
        options.texel,
    )
    surfaces = [relief_surface(options.relief, low, high, options.mesh_step, floor)]
    if options.num_boulders:
        image = rock_image(ROCK_TEXTURE_SIDE, options.texel, painting)
        rock = Texture.from_image(image, (0.0, 0.0), options.texel)
        for center, radius in _scattered_boulders(options, placing):
            surfaces.append(_boulder(options.relief, center, radius, rock, placing))
    return RayScene(lit_surfaces(tuple(surfaces), placing))


def relief_surface(
    relief: Relief, low: Array, high: Array, step: float, texture: Texture
) -> Surface:
    """The mesh of a relief between two corners (2,), with vertices ``step`` apart."""
    num = [int(np.ceil((high[axis] - low[axis]) / step)) + 1 for axis in (0, 1)]
    x, y = (np.linspace(low[axis], high[axis], num[axis]) for axis in (0, 1))
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    index = np.arange(len(xy)).reshape(num[1], num[0])
    return Surface(
        vertices=relief.points(xy),
        triangles=_grid_triangles(index),
        normals=relief.normals(xy),
        light=np.ones(len(xy)),
        texture=texture,
    )


def lit_surfaces(
    surfaces: tuple[Surface, ...], rng: np.random.Generator
) -> tuple[Surface, ...]:
    """The surfaces under a diffuse sky and a soft light from one side.

    The light is computed once per vertex: it belongs to the world, not to a view.
    """
    scene = RayScene(surfaces)
    sky = rng.normal(size=(SKY_RAYS, 3))
    sky /= np.linalg.norm(sky, axis=1, keepdims=True)
    sun = TO_LIGHT + 0.15 * rng.normal(size=(SUN_RAYS, 3))
    sun /= np.linalg.norm(sun, axis=1, keepdims=True)
    lit = []
    for surface in surfaces:
        # Off the surface by more than its own facets can bulge.
        start = surface.vertices + 0.002 * surface.normals
        open_sky, open_sun = np.zeros(len(start)), np.zeros(len(start))
        for direction in sky:
            # A unit vector added to the normal is distributed as its cosine.
            dirs = surface.normals + direction
            dirs /= np.linalg.norm(dirs, axis=1, keepdims=True)
            open_sky += 1.0 - scene.is_hidden(start, dirs, SHADE_REACH)
        for direction in sun:
            dirs = np.broadcast_to(direction, start.shape)
            open_sun += 1.0 - scene.is_hidden(start, dirs, SHADE_REACH)
        facing = np.maximum(surface.normals @ TO_LIGHT, 0.0) / -TO_LIGHT[2]
        light = SKY_SHARE * open_sky / SKY_RAYS
        light += (1.0 - SKY_SHARE) * facing * open_sun / SUN_RAYS
        lit.append(replace(surface, light=light))
    return tuple(lit)


def _scattered_boulders(
    options: SeaFloorOptions, rng: np.random.Generator
) -> list[tuple[Array, float]]:
    """Centres (2,) and radii of boulders that hardly overlap, the largest first."""
    radii = np.sort(rng.uniform(*options.boulder_radius, options.num_boulders))[::-1]
    placed: list[tuple[Array, float]] = []
    for radius in radii:
        for _ in range(200):
            angle, share = rng.uniform(0.0, 2.0 * np.pi), np.sqrt(rng.uniform())
            center = (
                options.boulder_extent
                * share
                * np.array([np.cos(angle), np.sin(angle)])
            )
            if all(np.linalg.norm(center - c) > 0.8 * (radius + r) for c, r in placed):
                placed.append((center, float(radius)))
                break
    return placed


def _boulder(
    relief: Relief, center: Array, radius: float, texture: Texture, rng
) -> Surface:
    """A worn, angular, half-buried stone."""
    num_lat, num_lon = 72, 144
    lat = np.linspace(0.0, np.pi, num_lat)[:, None]
    lon = np.linspace(0.0, 2.0 * np.pi, num_lon, endpoint=False)
    dirs = np.stack(
        [np.sin(lat) * np.cos(lon), np.sin(lat) * np.sin(lon), np.cos(lat) + 0.0 * lon],
        axis=-1,
    ).reshape(-1, 3)
    facets = rng.normal(size=(NUM_FACETS, 3))
    facets /= np.linalg.norm(facets, axis=1, keepdims=True)
    facets /= rng.uniform(0.65, 1.0, (NUM_FACETS, 1))
    # The high norm of the facet distances is a polytope with rounded edges.
    shape = (np.maximum(dirs @ facets.T, 0.0) ** 10).sum(axis=1) + 0.7**10
    distance = shape**-0.1
    for amplitude, frequency in ((0.035, 3.0), (0.012, 9.0)):
        waves = frequency * rng.normal(size=(24, 3))
        phases = rng.uniform(0.0, 2.0 * np.pi, 24)
        distance += amplitude * np.cos(dirs @ waves.T + phases).sum(axis=1) / 3.5
    index = np.arange(num_lat * num_lon).reshape(num_lat, num_lon)
    triangles = _grid_triangles(np.column_stack([index, index[:, 0]]))
    vertices = radius * distance[:, None] * dirs * [1.0, rng.uniform(0.75, 1.0), 0.8]
    normals = _vertex_normals(vertices, triangles, dirs)
    base = relief.points(center[None])[0] - [0.0, 0.0, 0.25 * radius]
    offset = rng.uniform(0.35, ROCK_TEXTURE_SIDE - 0.35, 3)
    x, y, z = offset - base
    return Surface(
        vertices=vertices + base,
        triangles=triangles,
        normals=normals,
        light=np.ones(len(vertices)),
        texture=texture,
        texture_offset=(float(x), float(y), float(z)),
    )


def _grid_triangles(index: NDArray[np.int64]) -> NDArray[np.int64]:
    """Two triangles (T, 3) per cell of a grid of vertex indices (rows, columns)."""
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, :-1].ravel(), index[1:, 1:].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])


def _vertex_normals(
    vertices: Array, triangles: NDArray[np.int64], outward: Array
) -> Array:
    """Unit normals (V, 3), averaged over the faces and turned along ``outward``."""
    corners = vertices[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], faces)
    inward = (normals * outward).sum(axis=1) < 0.0
    normals[inward] *= -1.0
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
