"""`PerspectiveStart`: where a reconstruction with ideal pinholes ends."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pycolmap

from uwsfm._base.files import replaced_dir
from uwsfm.colmap.model import write_model
from uwsfm.errors import UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray
from uwsfm.sfm.frontend.background import damaged, opened
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.pinhole.mapping_database import indices_of
from uwsfm.sfm.rig_checks.pinhole_fit import VirtualPinhole

START_FILE = "start.json"


@dataclass(frozen=True, kw_only=True)
class PerspectiveStart:
    """A perspective model, and what its virtual cameras have to do with the real ones.

    The model is COLMAP's: virtual pinholes, and keypoints moved to them. `read_start`
    returns what it says about the real rig and the real pixels.
    """

    model_path: Path
    features_path: Path
    """Database with the real keypoints."""
    frames: Frames
    """All frames, registered or not."""
    cam_from_rig: Array
    """(C, 7) real cameras as they were held: turned as far as tilted ports demand."""
    pinholes: tuple[VirtualPinhole, ...]
    depths: Array
    """(C, 3) 10th, 50th and 90th percentile of the scene's depth, metres."""
    summary: dict[str, Any] = field(default_factory=dict)
    """Numbers for the report; see `summary.json`."""

    kind: ClassVar[str] = "perspective"

    def cameras(self, rig: Rig) -> tuple[RefractiveCamera, ...]:
        """The rig's cameras: a pinhole knows nothing better of the ports."""
        return rig.refractive_cameras()

    def arrays(self) -> StartArrays:
        """See `read_start`."""
        return read_start(self)


@dataclass(frozen=True, kw_only=True)
class StartArrays:
    """Where mapping ended as arrays, in the frames of the real rig."""

    frame_names: tuple[str, ...]
    """(F,) registered frames, in the order of `Frames.names`."""
    rig_from_world: Array
    """(F, 7)"""
    points: Array
    """(P, 3) in the world."""
    camera_idx: IndexArray
    """(N,)"""
    frame_idx: IndexArray
    """(N,)"""
    point_idx: IndexArray
    """(N,)"""
    keypoint_idx: IndexArray
    """(N,) index of the keypoint in its image."""
    xy: Array
    """(N, 2) real pixels."""
    keypoints: tuple[tuple[Array, ...], ...]
    """[camera][frame] -> (n, 2) all keypoints of an image, real pixels."""


def write_start(
    model_path: Path,
    model: pycolmap.Reconstruction,
    cam_from_rig: Array,
    pinholes: Sequence[VirtualPinhole],
    depths: Array,
    summary: dict[str, Any],
) -> None:
    """Write a COLMAP model with a sidecar, whole or not at all."""
    content = {
        "cam_from_rig": cam_from_rig.tolist(),
        "depths_m": depths.tolist(),
        "pinholes": [
            {**asdict(pinhole), "center_in_cam": pinhole.center_in_cam.tolist()}
            for pinhole in pinholes
        ],
        "summary": summary,
    }
    with replaced_dir(model_path) as partial:
        write_model(model, partial)
        text = json.dumps(content, indent=1)
        (partial / START_FILE).write_text(text, encoding="utf-8")


def load_start(
    model_path: Path, features_path: Path, frames: Frames
) -> PerspectiveStart:
    """Read what `write_start` wrote; the model itself stays on disk.

    Raises:
        UwsfmError: the file is damaged.
    """
    try:
        content = json.loads((model_path / START_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise damaged(model_path / START_FILE, error) from None
    pinholes = []
    for entry in content["pinholes"]:
        entry["center_in_cam"] = np.array(entry["center_in_cam"])
        entry["principal_point"] = tuple(entry["principal_point"])
        pinholes.append(VirtualPinhole(**entry))
    return PerspectiveStart(
        model_path=model_path,
        features_path=features_path,
        frames=frames,
        cam_from_rig=np.array(content["cam_from_rig"]),
        pinholes=tuple(pinholes),
        depths=np.array(content["depths_m"]),
        summary=content["summary"],
    )


def read_start(start: PerspectiveStart) -> StartArrays:
    """The perspective model in terms of real cameras and real pixels.

    Raises:
        UwsfmError: a frame of the model lacks an image or its pose.
    """
    frames = start.frames
    try:
        model = pycolmap.Reconstruction(start.model_path)
    except (RuntimeError, ValueError, MemoryError):
        raise damaged(start.model_path) from None
    cameras = range(len(frames.folders))
    frame_of: dict[int, int] = {}  # index in `frames` -> COLMAP's frame id
    for frame_id in model.reg_frame_ids():
        ids = [data_id.id for data_id in model.frames[frame_id].image_ids]
        frame = indices_of(frames, ids[0])[1]
        if len(ids) != sum(frames.has_image(c, frame) for c in cameras):
            raise UwsfmError(f"frame {frame_id} of {start.model_path} lacks an image")
        frame_of[frame] = frame_id
    registered = sorted(frame_of)
    index_of = {f: index for index, f in enumerate(registered)}
    # The virtual rig's frame is the reference camera's, moved to its virtual centre.
    rig_from_virtual_rig = rigid3.inverse(start.pinholes[0].virtual_from_cam)
    virtual_poses = np.array(
        [_pose(model.frames[frame_of[f]].rig_from_world) for f in registered]
    )
    table = _observation_table(model, frames, index_of)
    keypoints = real_keypoints(start.features_path, frames, registered)
    return StartArrays(
        frame_names=tuple(frames.names[f] for f in registered),
        rig_from_world=rigid3.compose(rig_from_virtual_rig[None], virtual_poses),
        points=np.array([model.points3D[i].xyz for i in sorted(model.points3D)]),
        camera_idx=table[:, 0],
        frame_idx=table[:, 1],
        point_idx=table[:, 2],
        keypoint_idx=table[:, 3],
        xy=np.array([keypoints[c][f][k] for c, f, _, k in table.tolist()]),
        keypoints=keypoints,
    )


def _pose(pose: pycolmap.Rigid3d | None) -> Array:
    if pose is None:
        raise UwsfmError("a registered frame of the perspective model has no pose")
    return np.array(pose.params)


def _observation_table(
    model: pycolmap.Reconstruction, frames: Frames, index_of: dict[int, int]
) -> IndexArray:
    """Rows (N, 4): camera, frame, point, keypoint; points in the order of their ids."""
    rows = []
    for point, point_id in enumerate(sorted(model.points3D)):
        for element in model.points3D[point_id].track.elements:
            camera, frame = indices_of(frames, element.image_id)
            rows.append((camera, index_of[frame], point, element.point2D_idx))
    return np.array(sorted(rows, key=lambda row: (row[2], row[1], row[0])), np.int64)


def real_keypoints(
    features_path: Path, frames: Frames, registered: Sequence[int]
) -> tuple[tuple[Array, ...], ...]:
    """[camera][frame] -> (n, 2) keypoints of some frames, from their database; none of
    an image that is not there.

    Raises:
        UwsfmError: the database lacks an image.
    """
    with opened(features_path) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}

        def keypoints(c: int, f: int) -> Array:
            if not frames.has_image(c, f):
                return np.empty((0, 2))
            stored = database.read_keypoints(ids[frames.image_name(c, f)])
            return stored[:, :2].astype(np.float64)

        try:
            return tuple(
                tuple(keypoints(c, f) for f in registered)
                for c in range(len(frames.folders))
            )
        except KeyError:
            raise damaged(features_path) from None
