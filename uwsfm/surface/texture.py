"""Colours of a mesh from the photographs: of each texel, as the best images see it."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from uwsfm._base.packages import import_package
from uwsfm._base.progress import Progress, silent
from uwsfm.colmap.model import Model
from uwsfm.dense.exposure import SeenColors, balancing_gains
from uwsfm.dense.lookup import looked_up
from uwsfm.dense.views import load_image
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens_row import FOCAL
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.surface.atlas import Atlas
from uwsfm.surface.mesh import Mesh

_TEXELS_PER_PIXEL = 2.0
"""Along a side, at the median distance: nothing is lost of images from half of it."""
_SHARPNESS = 4.0
"""Power of an image's weight: with a large one, the best image nearly alone counts."""
_MIN_COSINE = 0.15
"""Between the line of sight and the normal: what is seen more flatly is not used."""
_BORDER_SHARE = 0.06
"""Of the image's width: towards the border the weight falls to zero, without seams."""
_HIDDEN_SHARE = 4e-3
"""Of the range: what is hit so much before a texel hides it. A decimated mesh lies off
itself by less."""
_NUM_SAMPLED = 20_000
"""Texels that tell how bright images are, beside each other."""


@dataclass(frozen=True, kw_only=True)
class Texture:
    """A picture for the charts of an atlas."""

    image: NDArray[np.uint8]
    """(height, width, 3) red, green, blue."""
    share_seen: float
    """Texels that an image sees; the others have the colours of the cloud."""
    num_images: int


@dataclass(frozen=True, kw_only=True)
class _Sight:
    """What one image sees of the texels."""

    image: int
    rows: NDArray[np.int64]
    """(n,) of the atlas."""
    colors: NDArray[np.float32]
    """(n, 3) blue, green, red, 0 to 255."""
    weights: NDArray[np.float32]
    """(n,)"""


def texel_size(model: Model) -> float:
    """Side of a texel that holds what the images show, from near as well."""
    scene = model.scene
    depths = scene.points_in_cam()[:, 2]
    focal = np.array([camera.lens[FOCAL].mean() for camera in scene.cameras])
    pixel = float(np.nanmedian(depths / focal[scene.camera_idx]))
    return pixel / _TEXELS_PER_PIXEL


def make_texture(
    atlas: Atlas, mesh: Mesh, model: Model, images: Path, progress: Progress = silent
) -> Texture:
    """Blend the images of a model on the charts of a mesh.

    Exposures and flashes are balanced first: each image has one gain per channel, by
    which texels that several images see become alike.

    Args:
        atlas: of the mesh.
        mesh: what hides what.
        model: its frames and cameras.
        images: the folder of their images.
        progress: called with each image.

    Raises:
        InputError: an image is missing, or of another size.
        MissingPackageError: Open3D is missing.
    """
    photographs = _Photographs(model, images, mesh)
    rng = np.random.default_rng(0)
    count = len(atlas.texel)
    some = np.sort(rng.permutation(count)[:_NUM_SAMPLED])
    gains = balancing_gains(
        [
            SeenColors(rows=sight.rows, colors=sight.colors)
            for sight in photographs.sights(atlas, some, progress, "balancing images")
        ]
    )
    total = np.zeros((count, 3), dtype=np.float32)
    weight = np.zeros(count, dtype=np.float32)
    for sight in photographs.sights(atlas, np.arange(count), progress, "texture"):
        colors = sight.colors * gains[sight.image].astype(np.float32)
        total[sight.rows] += sight.weights[:, None] * colors
        weight[sight.rows] += sight.weights
    seen = weight > 0.0
    found = atlas.colors.copy()
    mixed = total[seen] / weight[seen, None]
    found[seen] = np.rint(np.clip(mixed, 0.0, 255.0)).astype(np.uint8)[:, ::-1]
    return Texture(
        image=_picture(atlas, found),
        share_seen=float(np.mean(seen)) if count else 0.0,
        num_images=len(photographs.places),
    )


class _Photographs:
    """The images of a model, and what they see of a mesh."""

    def __init__(self, model: Model, folder: Path, mesh: Mesh) -> None:
        self.model, self.folder = model, folder
        self.hits = _Hits(mesh)
        scene = self.model.scene
        self.places = [
            (camera, frame)
            for frame in range(scene.num_frames)
            for camera in range(len(scene.cameras))
            if self.model.has_image(camera, frame)
        ]

    def sights(
        self,
        atlas: Atlas,
        rows: NDArray[np.int64],
        progress: Progress,
        step: str,
    ) -> Iterator[_Sight]:
        """What each image sees of some rows of an atlas."""
        progress(step, 0, len(self.places))
        for index, place in enumerate(self.places):
            yield self._sight(index, place, atlas, rows)
            progress(step, index + 1, len(self.places))

    def _sight(
        self,
        index: int,
        place: tuple[int, int],
        atlas: Atlas,
        rows: NDArray[np.int64],
    ) -> _Sight:
        camera, frame = place
        scene = self.model.scene
        lens = scene.cameras[camera]
        pose = rigid3.compose(scene.cam_from_rig[camera], scene.rig_from_world[frame])
        rows = rows[_faces(pose, atlas, rows)]
        xy, valid = lens.img_from_point(rigid3.transform(pose, atlas.points[rows]))
        valid &= _border_distance(lens, np.where(valid[:, None], xy, 0.0)) > 0.0
        rows, xy = rows[valid], xy[valid]
        rays = lens.ray_from_img(xy)
        back = rigid3.inverse(pose)
        origins, dirs = rigid3.transform(back, rays[0]), rigid3.rotate(back, rays[1])
        distance = np.linalg.norm(atlas.points[rows] - origins, axis=1)
        cosine = -np.einsum("ni,ni->n", dirs, atlas.normals[rows])
        good = cosine > _MIN_COSINE
        good &= self.hits.distance(origins, dirs) >= (1.0 - _HIDDEN_SHARE) * distance
        feather = _border_distance(lens, xy) / (_BORDER_SHARE * lens.width)
        # Ranges in units of the typical one: single precision.
        nearness = np.median(distance) / distance if len(distance) else distance
        weights = np.minimum(feather, 1.0) * (cosine * nearness) ** _SHARPNESS
        name = self.model.image_name(camera, frame)
        image = load_image(self.model, self.folder, camera, name)
        return _Sight(
            image=index,
            rows=rows[good],
            colors=looked_up(image, xy[good], cv2.BORDER_REPLICATE).astype(np.float32),
            weights=weights[good].astype(np.float32),
        )


class _Hits:
    """How far rays come before they meet a mesh (Open3D, single precision)."""

    def __init__(self, mesh: Mesh) -> None:
        self._open3d = import_package("open3d", "a textured mesh", "inspect")
        self._middle = mesh.vertices.mean(axis=0)
        self._scene = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._open3d.core.Tensor((mesh.vertices - self._middle).astype(np.float32)),
            self._open3d.core.Tensor(mesh.triangles.astype(np.uint32)),
        )

    def distance(self, origins: Array, dirs: Array) -> NDArray[np.float32]:
        """(n,) of rays with unit directions, both (n, 3) in the world; inf: none."""
        rays = np.concatenate([origins - self._middle, dirs], axis=1, dtype=np.float32)
        found = self._scene.cast_rays(self._open3d.core.Tensor(rays))
        return np.asarray(found["t_hit"].numpy())


def _faces(pose: Array, atlas: Atlas, rows: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which texels turn towards a camera and lie before it: a quick look."""
    points = rigid3.transform(pose, atlas.points[rows])
    normals = rigid3.rotate(pose, atlas.normals[rows])
    return (points[:, 2] > 0.0) & (np.einsum("ni,ni->n", points, normals) < 0.0)


def _border_distance(lens: RefractiveCamera, xy: Array) -> Array:
    """Pixels (n,) from the middle of the outermost pixels inwards."""
    far = np.array([lens.width, lens.height]) - 0.5
    return np.minimum(xy - 0.5, far - xy).min(axis=1)


def _picture(atlas: Atlas, colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Texels in their places; what lies between charts has the colour of the nearest,
    as viewers blend across their borders."""
    width, height = atlas.size
    image = np.zeros((height * width, 3), dtype=np.uint8)
    empty = np.full(height * width, 255, dtype=np.uint8)
    image[atlas.texel], empty[atlas.texel] = colors, 0
    _, label = cv2.distanceTransformWithLabels(
        empty.reshape(height, width),
        cv2.DIST_L2,
        cv2.DIST_MASK_5,
        labelType=cv2.DIST_LABEL_PIXEL,
    )
    of_label = np.zeros((int(label.max()) + 1, 3), dtype=np.uint8)
    of_label[label.ravel()[atlas.texel]] = colors
    return np.asarray(of_label[label])
