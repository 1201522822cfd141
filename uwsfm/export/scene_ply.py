"""A scene as one PLY: points, cameras as frusta, ports as their outlines.

Lines are rows of vertices joined by edges: MeshLab draws the edges, and programs that
read vertices alone still show dotted lines.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.files import checked_target
from uwsfm._base.ply import RGB, XYZ, stacked_rows, write_ply
from uwsfm.colmap.model import Model
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.scene import IndexArray

_FRUSTUM_SHARE = 0.1
"""Length of a frustum, as a share of the median distance of the points."""
_STEPS = 12
"""Vertices along each side of an image and each corner's ray."""
_PORT_COLOR = (255, 255, 255)
# Of the rig's cameras in turn.
_COLORS = np.array(
    [(230, 60, 50), (50, 110, 230), (60, 180, 75), (245, 170, 40), (150, 80, 200)],
    dtype=np.uint8,
)


@dataclass(frozen=True, kw_only=True)
class Lines:
    """Polylines of one colour per vertex."""

    vertices: Array
    """(V, 3) metres."""
    edges: IndexArray
    """(E, 2) indices of vertices."""
    colors: NDArray[np.uint8]
    """(V, 3) RGB"""


def export_scene_ply(
    model: Model, path: str | Path, *, unit: str = "metre", edge_colors: bool = False
) -> None:
    """Write points, frusta and port outlines as one binary PLY with edges.

    Vertices: x y z (float, metres, world), red green blue (uchar), the points first.
    Edges: vertex1 vertex2 (int), and with ``edge_colors`` red green blue.

    Args:
        model: what to write.
        path: the file; must not exist.
        unit: of lengths, for the comment in the file.
        edge_colors: MeshLab draws edges in the colours of their own; trimesh reads no
            file that has them.

    Raises:
        InputError: the file exists or cannot be written.
    """
    target = checked_target(path)
    scene = model.scene
    in_cam = scene.points_in_cam()
    ranges = np.linalg.norm(in_cam, axis=1)
    length = _FRUSTUM_SHARE * float(np.nanmedian(ranges)) if len(ranges) else 0.1
    finite = np.all(np.isfinite(scene.points), axis=1)
    vertices, colors = [scene.points[finite]], [model.colors[finite]]
    edges, of_edges = [np.empty((0, 2), dtype=np.int64)], [np.empty((0, 3), "u1")]
    count = len(vertices[0])
    for index, camera in enumerate(scene.cameras):
        lines = camera_lines(camera, length, _COLORS[index % len(_COLORS)])
        world_from_cam = rigid3.inverse(
            rigid3.compose(scene.cam_from_rig[index], scene.rig_from_world)
        )
        for frame, pose in enumerate(world_from_cam):
            if not model.has_image(index, frame):
                continue
            vertices.append(rigid3.transform(pose, lines.vertices))
            colors.append(lines.colors)
            edges.append(lines.edges + count)
            of_edges.append(lines.colors[lines.edges[:, 1]])
            count += len(lines.vertices)
    rows = stacked_rows(XYZ + RGB, vertices, colors)
    ends = [("vertex1", "<i4"), ("vertex2", "<i4")]
    table = stacked_rows(ends, edges)
    if edge_colors:
        table = stacked_rows(ends + RGB, edges, of_edges)
    tables = [("vertex", rows), ("edge", table)]
    write_ply(target, tables, comment=f"unit: {unit}; uwsfm")


def camera_lines(
    camera: RefractiveCamera, length: float, color: NDArray[np.uint8]
) -> Lines:
    """A camera's frustum as its rays run, in the camera frame.

    From the projection centre through the corners of the image to the outer surface
    of the port, bent there, to ``length`` in the water, where the border of the image
    closes the frustum. The border's outline on the port comes in white.
    """
    border = _border(camera.width, camera.height)
    origins, dirs = camera.ray_from_img(border)
    seen: NDArray[np.bool_] = np.all(np.isfinite(dirs), axis=1)
    far = origins + length * dirs
    corners = [k * _STEPS for k in range(4) if seen[k * _STEPS]]
    steps = np.linspace(0.0, 1.0, _STEPS)[:, None]
    lines = [
        np.concatenate([np.zeros((1, 3)), origins[k] + steps * (far[k] - origins[k])])
        for k in corners
    ]
    lines.append(np.concatenate([far, far[:1]]))
    kinds = [color] * len(lines)
    if np.nanmax(np.linalg.norm(origins, axis=1), initial=0.0) > 0.0:
        lines.append(np.concatenate([origins, origins[:1]]))
        kinds.append(np.array(_PORT_COLOR, dtype=np.uint8))
    return _joined(lines, kinds)


def _border(width: int, height: int) -> Array:
    """Pixels (4 * _STEPS, 2) around the image; each _STEPS-th is a corner."""
    steps = np.arange(_STEPS) / _STEPS
    zero, one = np.zeros(_STEPS), np.ones(_STEPS)
    x = np.concatenate([steps, one, 1.0 - steps, zero])
    y = np.concatenate([zero, steps, one, 1.0 - steps])
    return np.stack([x * width, y * height], axis=1)


def _joined(lines: list[Array], colors: list[NDArray[np.uint8]]) -> Lines:
    """Polylines as one set; vertices without a ray break them."""
    vertices = np.concatenate(lines)
    lengths = [len(line) for line in lines]
    start = np.arange(len(vertices) - 1)
    edges = np.stack([start, start + 1], axis=1)
    ends = np.cumsum(lengths)[:-1] - 1
    edges = np.delete(edges, ends, axis=0)
    there: NDArray[np.bool_] = np.all(np.isfinite(vertices), axis=1)
    edges = edges[np.all(there[edges], axis=1)]
    new_index = np.cumsum(there) - 1
    return Lines(
        vertices=vertices[there],
        edges=new_index[edges].astype(np.int64),
        colors=np.repeat(np.array(colors, dtype=np.uint8), lengths, axis=0)[there],
    )
