"""`Model`, a refractive reconstruction with its image names, to COLMAP and back.

The only place where COLMAP's identifiers meet our indices. Image, camera, rig and frame
identifiers are written densely from 1 in the order of our arrays; the camera of index c
is COLMAP's camera c + 1, and image ids run over cameras first, then frames.

COLMAP cannot store ports. The cameras written are the lenses in air, the keypoints are
the raw ones and the poses are those of the real projection centres: the housing in the
sidecar file turns them into water rays.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from uwsfm._base.checksums import check_checksums
from uwsfm._base.disk import require_room
from uwsfm.colmap.files import check_model_files, has_files
from uwsfm.colmap.text_files import stray_track
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.rig import Rig
from uwsfm.scene import IndexArray, Scene

RIG_ID = 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A refractive reconstruction: its scene and what the scene's indices mean."""

    rig: Rig
    """Cameras, folders and ports, the refined ones where they were refined."""
    scene: Scene
    frame_names: tuple[str, ...]
    """(F,) file names shared by the images of a frame."""
    keypoints: tuple[tuple[Array, ...], ...]
    """[camera][frame] -> (n, 2) all keypoints of an image, pixels; an image without
    any is not there."""
    keypoint_idx: IndexArray
    """(N,) which keypoint of its image each observation is."""
    colors: NDArray[np.uint8]
    """(P, 3) RGB"""

    def image_name(self, camera: int, frame: int) -> str:
        """Path of an image below the image directory."""
        return f"{self.rig.cameras[camera].images}/{self.frame_names[frame]}"

    def has_image(self, camera: int, frame: int) -> bool:
        """Whether a frame has an image of a camera."""
        return len(self.keypoints[camera][frame]) > 0

    def image_names(self) -> list[str]:
        """Of the images that are there, camera by camera."""
        shape = len(self.rig.cameras), self.scene.num_frames
        return [self.image_name(*p) for p in np.ndindex(shape) if self.has_image(*p)]

    def errors_px(self) -> Array:
        """True reprojection error of each observation (N,), NaN if invalid."""
        return np.linalg.norm(self.scene.residuals(), axis=1)


def to_reconstruction(model: Model) -> pycolmap.Reconstruction:
    """A COLMAP model with rig and frames, in-air intrinsics and raw keypoints.

    The errors of the points are the true, refractive ones.
    """
    reconstruction = pycolmap.Reconstruction()
    scene = model.scene
    _add_rig(reconstruction, model)
    for frame in range(scene.num_frames):
        _add_frame(reconstruction, model, frame)
    errors = _mean_by_point(model.errors_px(), scene)
    order = np.argsort(scene.point_idx, kind="stable")
    starts = np.searchsorted(scene.point_idx[order], np.arange(scene.num_points + 1))
    image_ids = 1 + scene.camera_idx * scene.num_frames + scene.frame_idx
    for point in range(scene.num_points):
        track = pycolmap.Track()
        for row in order[starts[point] : starts[point + 1]]:
            track.add_element(int(image_ids[row]), int(model.keypoint_idx[row]))
        point_id = reconstruction.add_point3D(
            scene.points[point], track, model.colors[point]
        )
        reconstruction.points3D[point_id].error = float(errors[point])
    return reconstruction


def write_model(model: pycolmap.Reconstruction, folder: Path) -> None:
    """Write a COLMAP model in binary files.

    Raises:
        DiskFullError: there is no room for it: COLMAP would write a part and say
            nothing.
    """
    keypoints = sum(len(image.points2D) for image in model.images.values())
    records = 300 * (len(model.images) + len(model.cameras) + len(model.frames))
    num_bytes = 24 * keypoints + 51 * len(model.points3D) + records
    num_bytes += 8 * model.compute_num_observations()
    require_room(folder, num_bytes, "writing the model")
    model.write_binary(str(folder))
    check_model_files(folder)


def _mean_by_point(values: Array, scene: Scene) -> Array:
    count = np.bincount(scene.point_idx, minlength=scene.num_points)
    total = np.bincount(scene.point_idx, values, minlength=scene.num_points)
    return total / np.maximum(count, 1)


def _sensor(camera: int) -> pycolmap.sensor_t:
    return pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera + 1)


def _add_rig(reconstruction: pycolmap.Reconstruction, model: Model) -> None:
    rig = pycolmap.Rig(rig_id=RIG_ID)
    for index, camera in enumerate(model.rig.cameras):
        lens = camera.camera
        reconstruction.add_camera(
            pycolmap.Camera(
                model=lens.model_name,
                width=lens.width,
                height=lens.height,
                params=lens.params,
                camera_id=index + 1,
                has_prior_focal_length=True,
            )
        )
        if index == 0:
            rig.add_ref_sensor(_sensor(index))
        else:
            pose = model.scene.cam_from_rig[index]
            rig.add_sensor(_sensor(index), _rigid(pose))
    reconstruction.add_rig(rig)


def _add_frame(
    reconstruction: pycolmap.Reconstruction, model: Model, index: int
) -> None:
    scene = model.scene
    frame = pycolmap.Frame(frame_id=index + 1, rig_id=RIG_ID)
    frame.rig_from_world = _rigid(scene.rig_from_world[index])
    images = []
    for camera in range(len(scene.cameras)):
        keypoints = model.keypoints[camera][index]
        if not len(keypoints):
            continue
        image = pycolmap.Image(
            name=model.image_name(camera, index),
            keypoints=keypoints,
            camera_id=camera + 1,
            image_id=1 + camera * scene.num_frames + index,
        )
        image.frame_id = index + 1
        images.append(image)
        frame.add_data_id(pycolmap.data_t(_sensor(camera), image.image_id))
    reconstruction.add_frame(frame)
    for image in images:
        reconstruction.add_image(image)
    reconstruction.register_frame(index + 1)


def _rigid(pose: Array) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4]), pose[4:])


def _params(pose: pycolmap.Rigid3d | None) -> Array:
    if pose is None:
        raise InputError("the COLMAP model has a frame or a rig sensor without a pose")
    return np.array(pose.params)


def from_reconstruction(reconstruction: pycolmap.Reconstruction, rig: Rig) -> Model:
    """The `Model` of a COLMAP model written by `to_reconstruction` and its rig.

    Raises:
        InputError: an image is in no folder of the rig, or a frame has no image.
    """
    frames = sorted(reconstruction.reg_frame_ids())
    images = _images_by_place(reconstruction, rig, frames)
    first = {f: c for c, f in sorted(images, reverse=True)}
    names = [
        images[first[f], f].name[len(rig.cameras[first[f]].images) + 1 :]
        for f in range(len(frames))
    ]
    if len(set(names)) < len(names):
        raise InputError(
            "images of equal names are in several frames of the COLMAP model: uwsfm "
            "did not write it; uwsfm refine reads it"
        )
    point_ids = sorted(reconstruction.points3D)
    point_of = {point_id: index for index, point_id in enumerate(point_ids)}
    place_of = {image.image_id: place for place, image in images.items()}
    rows, pixels = [], []
    for point_id in point_ids:
        for element in reconstruction.points3D[point_id].track.elements:
            camera, frame = place_of[element.image_id]
            point2d = images[camera, frame].points2D[element.point2D_idx]
            rows.append((camera, frame, point_of[point_id], element.point2D_idx))
            pixels.append(point2d.xy)
    table = np.array(rows, dtype=np.int64).reshape(-1, 4)
    world = [_params(reconstruction.frames[f].rig_from_world) for f in frames]
    cam_from_rig = [rigid3.IDENTITY]
    colmap_rig = reconstruction.rigs[reconstruction.frames[frames[0]].rig_id]
    camera_id = {camera: image.camera_id for (camera, _), image in images.items()}
    for index in range(1, len(rig.cameras)):
        if index not in camera_id:
            name = rig.cameras[index].name
            raise InputError(f"the COLMAP model has no image of camera {name}")
        lens = reconstruction.cameras[camera_id[index]]
        cam_from_rig.append(_params(colmap_rig.sensor_from_rig(lens.sensor_id)))
    points = [reconstruction.points3D[i] for i in point_ids]
    return Model(
        rig=rig,
        scene=Scene.from_arrays(
            cameras=rig.refractive_cameras(),
            cam_from_rig=np.array(cam_from_rig),
            rig_from_world=np.array(world),
            points=np.array([point.xyz for point in points]).reshape(-1, 3),
            camera_idx=table[:, 0],
            frame_idx=table[:, 1],
            point_idx=table[:, 2],
            xy=np.array(pixels).reshape(-1, 2),
        ),
        frame_names=tuple(names),
        keypoints=tuple(
            tuple(_keypoints(images.get((c, f))) for f in range(len(frames)))
            for c in range(len(rig.cameras))
        ),
        keypoint_idx=table[:, 3],
        colors=np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3),
    )


def _keypoints(image: pycolmap.Image | None) -> Array:
    """(n, 2) pixels, none of an image that is not there."""
    if image is None:
        return np.empty((0, 2))
    return np.array([point.xy for point in image.points2D]).reshape(-1, 2)


def _images_by_place(
    reconstruction: pycolmap.Reconstruction, rig: Rig, frames: list[int]
) -> dict[tuple[int, int], pycolmap.Image]:
    """Images by (camera, frame) index."""
    images = {}
    for index, frame_id in enumerate(frames):
        for data_id in reconstruction.frames[frame_id].image_ids:
            image = reconstruction.images[data_id.id]
            cameras = [
                c
                for c, camera in enumerate(rig.cameras)
                if image.name.startswith(f"{camera.images}/")
            ]
            if not cameras:
                raise InputError(f"image {image.name} is in no folder of the rig")
            images[cameras[0], index] = image
        if not any((c, index) in images for c in range(len(rig.cameras))):
            raise InputError(f"frame {frame_id} of the COLMAP model has no image")
    return images


def read_reconstruction(path: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model folder.

    Raises:
        InputError: there is none, it cannot be read, is damaged, was copied in part,
            or has names of images that no file can have.
    """
    if not path.is_dir():
        raise InputError(f"{path}: no such COLMAP model folder")
    check_checksums(path)
    check_model_files(path)
    try:
        model = pycolmap.Reconstruction(str(path))
    except (ValueError, RuntimeError, IndexError, MemoryError, OSError) as error:
        stray = stray_track(path)
        cause = str(error).partition("\n")[0][:80]
        raise InputError(
            stray
            or f"{path}: not a COLMAP model that can be read: a file is damaged, or "
            f"the files are of different models ({cause})"
        ) from None
    _check_poses(path, model)
    if has_files(path, "bin") and has_files(path, "txt"):
        _require_one_state(path, model)
    return model


def _require_one_state(path: Path, model: pycolmap.Reconstruction) -> None:
    """Refuse a folder whose text files are another state of its binary model: COLMAP
    reads the binary ones, and the user may have edited or renewed the others."""
    other = pycolmap.Reconstruction()
    try:
        other.read_text(str(path))
    except (ValueError, RuntimeError, IndexError, OSError):
        difference = "the text files cannot be read"
    else:
        difference = _difference(model, other)
    if difference:
        raise InputError(
            f"{path} holds a binary and a text model that differ ({difference}): "
            "remove the .txt files or the .bin files, whichever are out of date"
        )


def _difference(model: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> str:
    """In what the text files differ from the binary ones, but for rounding; or ''."""
    counts = [
        (name, getattr(model, f"num_{name}")(), getattr(other, f"num_{name}")())
        for name in ("cameras", "images", "points3D")
    ]
    for name, mine, theirs in counts:
        if mine != theirs:
            return f"{mine} {name} in the binary files, {theirs} in the text"
    for camera_id, camera in model.cameras.items():
        if not other.exists_camera(camera_id) or not np.allclose(
            camera.params, other.cameras[camera_id].params, rtol=TEXT_ROUNDING
        ):
            return f"camera {camera_id}"
    for image_id in sorted(model.images):
        image = model.images[image_id]
        twin = other.images[image_id] if other.exists_image(image_id) else None
        if twin is None or twin.name != image.name or not _same_pose(image, twin):
            return f"image {image.name}"
    return ""


def _same_pose(image: pycolmap.Image, twin: pycolmap.Image) -> bool:
    if not (image.has_pose and twin.has_pose):
        return bool(image.has_pose == twin.has_pose)
    mine, theirs = (one.cam_from_world().params for one in (image, twin))
    size = max(1.0, float(np.abs(mine).max()))
    return bool(np.allclose(mine, theirs, rtol=0.0, atol=TEXT_ROUNDING * size))


TEXT_ROUNDING = 1e-5
"""Of numbers in text files, which older versions of COLMAP wrote with six digits."""
FARTHEST = 1e9
"""From the origin, in any unit: what is farther away is no place under water."""


def _check_poses(path: Path, model: pycolmap.Reconstruction) -> None:
    for image in model.images.values():
        if not image.has_pose:
            continue
        try:
            pose = np.array(image.cam_from_world().params)
        except RuntimeError:  # of an empty optional
            raise InputError(
                f"{path}: image {image.name} has no pose: its camera has none in its "
                "rig; was the file of the rigs edited?"
            ) from None
        if not np.all(np.abs(pose) < FARTHEST):  # NaN as well
            raise InputError(
                f"{path}: the pose of image {image.name} is not finite, or farther "
                f"than {FARTHEST:g} from the origin"
            )
