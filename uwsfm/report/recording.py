"""A result as a recording for the Rerun viewer: images, rays in water, ports, cloud."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.children import module_command
from uwsfm._base.files import replaced_file
from uwsfm._base.packages import import_package
from uwsfm.colmap.model import Model
from uwsfm.export.scene_ply import camera_lines
from uwsfm.geometry import rigid3
from uwsfm.geometry.rays import finite_rows
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.report.view import FRUSTUM_SHARE, strips
from uwsfm.results.folder import Result, open_result

RECORDING = "view.rrd"
TIMELINE = "frame"
MAX_RAYS = 60
"""Per image."""
_GRID = 12
"""Steps of the mesh of a port, each way."""
_COLORS = ((11, 92, 138), (179, 89, 0), (77, 124, 15))
_GLASS = (160, 200, 220, 120)


def write_recording(out: str | Path, images: str | Path | None = None) -> Path:
    """Write ``out/view.rrd``.

    Entities: ``world/points``, ``world/trajectory``, and per camera ``world/NAME``
    (its pose) with ``frustum``, ``port`` (the outer surface, as far as the image sees
    through it) and ``rays`` (of some observations: through the air, the glass and the
    water to the point); ``images/NAME`` with its observations. Frames are the steps of
    the timeline. No pinhole is logged: these cameras have none.

    Args:
        out: Folder of a result.
        images: Where the images are now; default: where they were. Without images the
            recording has none.

    Raises:
        InputError: the folder is not such a one, or cannot be written to.
        MissingPackageError: Rerun is not installed.
    """
    rerun = import_package("rerun", "a recording", "rerun")
    result = open_result(out, images)
    stream = rerun.RecordingStream("uwsfm", recording_id=result.folder.resolve().name)
    path = result.folder / RECORDING
    with replaced_file(path) as partial:
        stream.save(partial)
        if result.summary["positions"] is None:  # the world is the first rig
            axes = rerun.ViewCoordinates.RDF
            rerun.log("world", axes, static=True, recording=stream)
        _log_world(rerun, stream, result.model)
        for index in range(len(result.model.rig.cameras)):
            _log_camera(rerun, stream, result, index)
        stream.flush()
        stream.disconnect()
    return path


def show_recording(path: Path) -> bool:
    """Open a recording in the viewer, which goes on by itself; False: no display."""
    windowed = sys.platform in ("win32", "darwin")
    if not windowed and not {"DISPLAY", "WAYLAND_DISPLAY"} & {*os.environ}:
        return False
    subprocess.Popen(module_command("rerun", str(path)))
    return True


def _log_world(rerun: ModuleType, stream: object, model: Model) -> None:
    scene = model.scene
    known = finite_rows(scene.points)
    cloud = rerun.Points3D(scene.points[known], colors=model.colors[known])
    rerun.log("world/points", cloud, static=True, recording=stream)
    centers = rigid3.inverse(scene.rig_from_world)[:, 4:]
    path = rerun.LineStrips3D([centers], colors=[(128, 128, 128)])
    rerun.log("world/trajectory", path, static=True, recording=stream)


def _log_camera(rerun: ModuleType, stream: object, result: Result, index: int) -> None:
    model = result.model
    scene, camera = model.scene, model.scene.cameras[index]
    name, color = model.rig.cameras[index].name, _COLORS[index % len(_COLORS)]
    world, flat = f"world/{name}", f"images/{name}"
    mine = np.flatnonzero(scene.camera_idx == index)
    points = scene.points_in_cam()[mine]
    if not len(points):
        return
    length = FRUSTUM_SHARE * float(np.nanmedian(np.linalg.norm(points, axis=1)))
    lines = camera_lines(camera, length, np.array(color, dtype=np.uint8))
    frustum = rerun.LineStrips3D(strips(lines.vertices, lines.edges), colors=[color])
    rerun.log(f"{world}/frustum", frustum, static=True, recording=stream)
    if camera.port.refracts:
        vertices, triangles = port_mesh(camera)
        glass = rerun.Mesh3D(
            vertex_positions=vertices,
            triangle_indices=triangles,
            albedo_factor=_GLASS,
        )
        rerun.log(f"{world}/port", glass, static=True, recording=stream)
    world_from_cam = rigid3.inverse(
        rigid3.compose(scene.cam_from_rig[index], scene.rig_from_world)
    )
    for frame, pose in enumerate(world_from_cam):
        rerun.set_time(TIMELINE, sequence=frame, recording=stream)
        place = rerun.Transform3D(
            translation=pose[4:], quaternion=rerun.Quaternion(xyzw=pose[:4])
        )
        rerun.log(world, place, recording=stream)
        rows = scene.frame_idx[mine] == frame
        xy = scene.xy[mine[rows]]
        rays = rerun.LineStrips3D(
            ray_lines(camera, xy, points[rows]), colors=[color], radii=[-0.5]
        )
        rerun.log(f"{world}/rays", rays, recording=stream)
        if result.images is not None and model.has_image(index, frame):
            image = result.images / model.image_name(index, frame)
            if image.is_file():
                rerun.log(flat, rerun.EncodedImage(path=image), recording=stream)
        seen = rerun.Points2D(xy, colors=[color])
        rerun.log(f"{flat}/observations", seen, recording=stream)


def ray_lines(camera: RefractiveCamera, xy: Array, points_in_cam: Array) -> list[Array]:
    """Rays of some observations as polylines (3, 3) in the camera frame.

    From the projection centre to the outer surface of the port (the small offset inside
    the glass is not drawn), and through the water to where the ray is nearest to its
    point.
    """
    rows = np.linspace(0, len(xy) - 1, min(len(xy), MAX_RAYS)).astype(np.int64)
    origins, dirs = camera.ray_from_img(xy[rows])
    along = np.sum((points_in_cam[rows] - origins) * dirs, axis=1)
    ends = origins + along[:, None] * dirs
    lines = np.stack([np.zeros_like(origins), origins, ends], axis=1)
    return list(lines[np.all(np.isfinite(lines), axis=(1, 2))])


def port_mesh(camera: RefractiveCamera) -> tuple[Array, NDArray[np.int64]]:
    """The outer surface of a port, as far as the image sees through it.

    Returns:
        Vertices (V, 3) in the camera frame and triangles (T, 3).
    """
    steps = np.linspace(0.0, 1.0, _GRID + 1)
    x, y = np.meshgrid(steps * camera.width, steps * camera.height)
    vertices, _ = camera.ray_from_img(np.stack([x.ravel(), y.ravel()], axis=1))
    first = (np.arange(_GRID)[:, None] * (_GRID + 1) + np.arange(_GRID)).ravel()
    right, below = first + 1, first + _GRID + 1
    triangles = np.concatenate(
        [
            np.stack([first, right, below], axis=1),
            np.stack([right, below + 1, below], axis=1),
        ]
    )
    there = finite_rows(vertices)
    triangles = triangles[np.all(there[triangles], axis=1)]
    return np.where(there[:, None], vertices, 0.0), triangles
