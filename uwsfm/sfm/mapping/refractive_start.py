"""`RefractiveStart`: where the refraction-aware mapper ends."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from uwsfm._base.files import replaced_dir
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import port_from_row
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.background import DAMAGE, damaged
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.mapping.growing_map import GrowingMap
from uwsfm.sfm.pinhole.perspective import StartArrays, real_keypoints
from uwsfm.solver.state import State

START_FILE = "start.json"
ARRAYS = (
    "registered",
    "rig_from_world",
    "points",
    "camera_idx",
    "frame_idx",
    "point_idx",
    "keypoint_idx",
)
"""One .npy file each: a zip archive would hold the time of day."""


@dataclass(frozen=True, kw_only=True)
class RefractiveStart:
    """A map on disk, and the housings that it was made with."""

    map_path: Path
    features_path: Path
    """Database with the real keypoints."""
    frames: Frames
    """All frames, registered or not."""
    cam_from_rig: Array
    """(C, 7)"""
    ports: Array
    """(C, PORT_SIZE) rows."""
    lenses: Array
    """(C, LENS_SIZE) rows."""
    summary: dict[str, Any] = field(default_factory=dict)
    """Numbers for the report; see `summary.json`."""

    kind: ClassVar[str] = "refractive"

    def cameras(self, rig: Rig) -> tuple[RefractiveCamera, ...]:
        """The rig's cameras with the ports and lenses of the map."""
        return tuple(
            camera.with_port(port_from_row(port)).with_lens(lens)
            for camera, port, lens in zip(
                rig.refractive_cameras(), self.ports, self.lenses, strict=True
            )
        )

    def arrays(self) -> StartArrays:
        """The map as arrays.

        Raises:
            UwsfmError: the file is damaged.
        """
        try:
            stored = {n: np.load(self.map_path / f"{n}.npy") for n in ARRAYS}
        except DAMAGE as error:
            raise damaged(self.map_path, error) from None
        registered = stored["registered"].tolist()
        keypoints = real_keypoints(self.features_path, self.frames, registered)
        camera, frame = stored["camera_idx"], stored["frame_idx"]
        images = [points for of_camera in keypoints for points in of_camera]
        before = np.cumsum([0, *map(len, images)])[camera * len(registered) + frame]
        return StartArrays(
            frame_names=tuple(self.frames.names[f] for f in registered),
            rig_from_world=stored["rig_from_world"],
            points=stored["points"],
            camera_idx=camera,
            frame_idx=frame,
            point_idx=stored["point_idx"],
            keypoint_idx=stored["keypoint_idx"],
            xy=np.concatenate(images)[before + stored["keypoint_idx"]],
            keypoints=keypoints,
        )


def write_refractive_start(
    path: Path, growing: GrowingMap, summary: dict[str, Any]
) -> None:
    """Write a map with its housings, whole or not at all."""
    scene, keypoints = growing.scene()
    state = State.from_scene(scene)
    registered = np.flatnonzero(growing.registered)
    order = np.lexsort((scene.camera_idx, scene.frame_idx, scene.point_idx))
    content = {
        "cam_from_rig": growing.cam_from_rig.tolist(),
        "ports": state.ports.tolist(),
        "lenses": [camera.lens.tolist() for camera in growing.cameras],
        "summary": summary,
    }
    arrays = (
        registered,
        growing.rig_from_world[registered],
        scene.points,
        scene.camera_idx[order],
        np.searchsorted(registered, scene.frame_idx[order]),
        scene.point_idx[order],
        growing.correspondences.keypoint_idx(keypoints[order]),
    )
    with replaced_dir(path) as partial:
        for name, array in zip(ARRAYS, arrays, strict=True):
            np.save(partial / f"{name}.npy", array)
        text = json.dumps(content, indent=1)
        (partial / START_FILE).write_text(text, encoding="utf-8")


def load_refractive_start(
    path: Path, features_path: Path, frames: Frames
) -> RefractiveStart:
    """Read what `write_refractive_start` wrote; the map itself stays on disk.

    Raises:
        UwsfmError: the file is damaged.
    """
    try:
        content = json.loads((path / START_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise damaged(path / START_FILE, error) from None
    return RefractiveStart(
        map_path=path,
        features_path=features_path,
        frames=frames,
        cam_from_rig=np.array(content["cam_from_rig"]),
        ports=np.array(content["ports"]),
        lenses=np.array(content["lenses"]),
        summary=content["summary"],
    )
