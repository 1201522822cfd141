"""Images of a textured floor, pixel by pixel along the refracted water rays.

Nothing is approximated by a pinhole: each sample of each pixel follows
`RefractiveCamera.ray_from_img` to the floor. What the program later measures in such an
image is therefore exact, up to the sampling.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.simulate.raycasting import Hits, RayScene, Surface
from uwsfm.simulate.texture import Image, Plane

SAMPLES_PER_BLOCK = 200_000  # bounds the memory: about 300 bytes per sample
NUM_THREADS = 2
OPEN_WATER = 1000.0  # metres: no light crosses that


@dataclass(frozen=True, kw_only=True)
class WaterOptions:
    """How water changes colours, red, green and blue.

    Raises:
        InputError: a negative coefficient.
    """

    attenuation_per_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Beer-Lambert, along the water ray."""
    backscatter_per_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """How fast the veiling light saturates with range."""
    veil: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Colour of open water, linear, 1 is white."""

    def __post_init__(self) -> None:
        for name in ("attenuation_per_m", "backscatter_per_m", "veil"):
            if not min(getattr(self, name)) >= 0.0:
                raise InputError(
                    f"water {name} must not be negative, got {getattr(self, name)}"
                )


@dataclass(frozen=True, kw_only=True)
class SensorOptions:
    """How a pixel becomes a number.

    Raises:
        InputError: a value out of its range.
    """

    samples_per_side: int = 3
    """Each pixel is the mean of this many squared water rays, on a regular grid."""
    blur_px: float = 0.0
    """Standard deviation of the lens' point spread."""
    exposure: float = 1.0
    """Brightness of a white floor in clear water, linear."""
    noise: float = 0.0
    """Standard deviation, grey levels. The square-root encoding makes the noise of
    photon counting the same at every brightness."""

    def __post_init__(self) -> None:
        if self.samples_per_side < 1:
            raise InputError(
                f"samples_per_side must be at least 1, got {self.samples_per_side}"
            )
        for name in ("blur_px", "exposure", "noise"):
            if not getattr(self, name) >= 0.0:
                raise InputError(
                    f"sensor {name} must not be negative, got {getattr(self, name)}"
                )


def render_image(
    camera: RefractiveCamera,
    cam_from_world: ArrayLike,
    scene: RayScene,
    *,
    water: WaterOptions | None = None,
    sensor: SensorOptions | None = None,
    rng: np.random.Generator | None = None,
) -> Image:
    """Render one image (H, W, 3), RGB, encoded by a square root.

    Args:
        camera: Lens and port.
        cam_from_world: Pose (7,).
        scene: What there is to see.
        water: Clear by default.
        sensor: Exact by default.
        rng: For the sensor's noise; needed if there is any.
    """
    water, sensor = water or WaterOptions(), sensor or SensorOptions()
    world_from_cam = rigid3.inverse(np.asarray(cam_from_world, dtype=np.float64))
    radiance = np.empty((camera.height, camera.width, 3), dtype=np.float32)
    samples_per_row = camera.width * sensor.samples_per_side**2
    num_rows = max(1, SAMPLES_PER_BLOCK // samples_per_row)

    def render_block(top: int) -> None:
        bottom = min(top + num_rows, camera.height)
        radiance[top:bottom] = _rendered_rows(
            camera, world_from_cam, scene, water, sensor, top, bottom
        )

    # Threads are enough: numpy, numba, OpenCV and Open3D all release the GIL.
    with ThreadPoolExecutor(NUM_THREADS) as pool:
        list(pool.map(render_block, range(0, camera.height, num_rows)))
    if sensor.blur_px > 0.0:
        radiance = np.asarray(
            cv2.GaussianBlur(
                radiance, (0, 0), sensor.blur_px, borderType=cv2.BORDER_REFLECT
            )
        )
    values = 255.0 * np.sqrt(sensor.exposure * radiance)
    if sensor.noise > 0.0:
        if rng is None:
            raise InputError("sensor noise needs a random number generator")
        values += sensor.noise * rng.standard_normal(values.shape, dtype=np.float32)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _rendered_rows(
    camera: RefractiveCamera,
    world_from_cam: Array,
    scene: RayScene,
    water: WaterOptions,
    sensor: SensorOptions,
    top: int,
    bottom: int,
) -> Plane:
    """Linear radiance (bottom - top, W, 3) of some rows of pixels."""
    side = sensor.samples_per_side
    # Sample centres: pixel i covers [i, i + 1), its centre is i + 0.5.
    x = (np.arange(camera.width * side) + 0.5) / side
    y = (np.arange(top * side, bottom * side) + 0.5) / side
    xy = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    origins, dirs = camera.ray_from_img(xy)
    origins = rigid3.transform(world_from_cam, origins)
    dirs = rigid3.rotate(world_from_cam, dirs)
    hits = scene.cast(origins, dirs)
    reflectance = np.zeros((len(xy), 3), dtype=np.float32)
    for index, surface in enumerate(scene.surfaces):
        rows = np.flatnonzero(hits.surface_idx == index)
        if len(rows):
            distance = hits.distance[rows]
            points = origins[rows] + distance[:, None] * dirs[rows]
            spacing = distance * _sample_angle(camera, side)
            reflectance[rows] = _reflectance(surface, hits, rows, points, spacing)
    # Rays that leave the scene see open water: nothing, very far away.
    distance = np.minimum(hits.distance, OPEN_WATER)[:, None]
    radiance = reflectance * np.exp(-distance * _float32(water.attenuation_per_m))
    scattered = 1.0 - np.exp(-distance * _float32(water.backscatter_per_m))
    radiance += _float32(water.veil) * scattered
    blocks = radiance.reshape(bottom - top, side, camera.width, side, 3)
    return blocks.mean(axis=(1, 3))


def _sample_angle(camera: RefractiveCamera, side: int) -> float:
    """Angle in the water between neighbouring samples in the middle of the image."""
    center = np.array([camera.width / 2.0, camera.height / 2.0])
    _, dirs = camera.ray_from_img([center, center + [1.0, 0.0]])
    return float(np.linalg.norm(dirs[1] - dirs[0])) / side


def _reflectance(
    surface: Surface, hits: Hits, rows: np.ndarray, points: Array, spacing: Plane
) -> Plane:
    """Linear reflectance times light (n, 3) at hit points (n, 3) of one surface."""
    corners = surface.triangles[hits.triangle_idx[rows]]  # (n, 3)
    weights = hits.weights[rows]
    if surface.texture_offset is None:
        encoded = surface.texture.lookup(points[:, :2], spacing)
    else:
        normals = np.einsum("nc,nci->ni", weights, surface.normals[corners])
        blend = normals**4
        blend /= blend.sum(axis=1, keepdims=True)
        position = points + surface.texture_offset
        encoded = np.zeros((len(points), 3), dtype=np.float32)
        for axis, plane in enumerate(([1, 2], [0, 2], [0, 1])):
            color = surface.texture.lookup(position[:, plane], spacing)
            encoded += blend[:, axis, None].astype(np.float32) * color
    light = np.einsum("nc,nc->n", weights, surface.light[corners])
    return (encoded / 255.0) ** 2 * light[:, None].astype(np.float32)


def _float32(values: ArrayLike) -> Plane:
    return np.asarray(values, dtype=np.float32)
