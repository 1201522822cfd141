"""Refractive COLMAP's text models, which carry ports: lenses, ports and a rig of them.

That fork of COLMAP (She et al., IROS 2024) appends the name and the parameters of a
port to a camera's line in ``cameras.txt``::

    CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] [REFRAC_MODEL REFRAC_PARAMS[]]

Everything else is COLMAP's old text format, without rigs and frames. Lenses are those
in air, keypoints the raw ones and poses those of the real cameras: as here.
"""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap

from uwsfm._base.files import read_text
from uwsfm._base.partial import scratch_folder
from uwsfm.colmap.model import read_reconstruction
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.kind import eight
from uwsfm.models.ports.port import KINDS, NoPort, Port
from uwsfm.rig.rig import Rig, RigCamera, camera_from_colmap, refine_flags
from uwsfm.sfm.rig_checks.baseline import MAX_FRAMES, robust_average

CAMERAS, IMAGES, POINTS = "cameras.txt", "images.txt", "points3D.txt"
MAX_BYTES = 50_000_000
"""Of ``cameras.txt``: a camera for each of half a million images."""
_NAMES = tuple(dict.fromkeys(k.colmap_name for k in KINDS if k.colmap_name))


@dataclass(frozen=True, kw_only=True)
class PortCamera:
    """One line of ``cameras.txt``."""

    camera: pycolmap.Camera
    """In air, with its identifier."""
    port: Port
    """None is written of a `NoPort`."""


def camera_line(camera_id: int, entry: PortCamera) -> str:
    """A line of ``cameras.txt``, with its end."""
    camera = entry.camera
    items = [camera_id, camera.model_name, camera.width, camera.height]
    # repr: the shortest decimal number that reads back to the same double.
    items += [repr(float(value)) for value in camera.params]
    if entry.port.colmap_name is not None:
        items.append(entry.port.colmap_name)
        items += [repr(float(value)) for value in entry.port.params]
    return " ".join(str(item) for item in items) + "\n"


def read_refractive_cameras(path: str | Path) -> dict[int, PortCamera]:
    """Lenses and ports by camera identifier, from a ``cameras.txt``.

    Plain COLMAP's is one without ports.

    Raises:
        InputError: no such file, or the file and the line that cannot be understood.
    """
    path = Path(path)
    if not path.exists():
        hint = ""
        if path.with_suffix(".bin").is_file():
            hint = (
                f", only {path.stem}.bin: ports are in text models that Refractive "
                "COLMAP wrote, and nowhere else; of an ordinary model, fill in a rig "
                "file (uwsfm init without --from) with the lenses in air and the "
                "ports, and give both to uwsfm refine"
            )
        raise InputError(f"{path}: no such file{hint}")
    try:
        lines = read_text(path, MAX_BYTES).splitlines()
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    found: dict[int, PortCamera] = {}
    for number, line in enumerate(lines, start=1):
        items = line.split()
        if not items or items[0].startswith("#"):
            continue
        try:
            camera_id, entry = _parsed(items)
        except InputError as error:
            raise InputError(f"{path}: line {number}: {error}") from None
        if camera_id in found:
            raise InputError(f"{path}: line {number}: camera {camera_id} comes twice")
        found[camera_id] = entry
    if not found:
        raise InputError(f"{path}: describes no camera")
    return found


def _parsed(items: list[str]) -> tuple[int, PortCamera]:
    if len(items) < 5:
        raise InputError("CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] expected")
    camera_id, width, height = (_integer(items[k]) for k in (0, 2, 3))
    split = next((k for k in range(4, len(items)) if items[k][0].isalpha()), None)
    if split is not None and items[split].lower() in ("nan", "inf"):
        split = None
    params = [_number(item) for item in items[4:split]]
    camera = camera_from_colmap(items[1], width, height, params)
    camera.camera_id = camera_id
    if split is None:
        return camera_id, PortCamera(camera=camera, port=NoPort())
    kind = items[split]
    if kind not in _NAMES:
        known = " and ".join(_NAMES)
        raise InputError(f"unknown port model {kind!r}; the known ones are {known}")
    row = [_number(item) for item in items[split + 1 :]]
    return camera_id, PortCamera(camera=camera, port=_port(kind, row))


def _port(name: str, row: list[float]) -> Port:
    """The port of a name of Refractive COLMAP, which several kinds may share: the kind
    with the fewest numbers of its own that its parameters fit."""
    numbers = np.array(eight(name, row))
    kinds = [k for k in KINDS if k.colmap_name == name and k.reads(numbers)]
    return min(kinds, key=lambda kind: len(kind.numbers)).from_params(numbers)


def _integer(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        raise InputError(f"{text!r} is not a whole number") from None
    if not 0 <= number < 2**31:
        raise InputError(f"{text} is neither an identifier nor a size in pixels")
    return number


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{text!r} is not a number") from None


def read_refractive_colmap(
    folder: str | Path,
) -> tuple[pycolmap.Reconstruction, dict[int, PortCamera]]:
    """A text model of Refractive COLMAP: the model as stock COLMAP reads it, and ports.

    Raises:
        InputError: a file is missing or cannot be understood.
    """
    folder = Path(folder)
    cameras = read_refractive_cameras(folder / CAMERAS)
    with scratch_folder() as plain:
        for other in (IMAGES, POINTS):
            if not (folder / other).is_file():
                raise InputError(f"{folder / other}: no such file")
            shutil.copy(folder / other, plain)
        text = "".join(
            camera_line(number, PortCamera(camera=entry.camera, port=NoPort()))
            for number, entry in cameras.items()
        )
        (plain / CAMERAS).write_text(text, encoding="ascii")
        try:
            return read_reconstruction(plain), cameras
        except InputError as error:
            raise InputError(str(error).replace(str(plain), str(folder))) from None


def rig_of_refractive_colmap(path: str | Path) -> Rig:
    """The rig of a ``cameras.txt``, or of the text model that it belongs to.

    Images of one moment have the same file name, in one folder per camera; of several
    cameras, these tell the placement, in the model's unit. Indices are made relative
    to that of the air: nothing else of them has a meaning.

    Args:
        path: the file or the folder.

    Raises:
        InputError: as `read_refractive_colmap`, or the placement cannot be found.
    """
    path = Path(path)
    file = path / CAMERAS if path.is_dir() else path
    cameras = read_refractive_cameras(file)
    model = None
    if len(cameras) > 1 and not (file.parent / IMAGES).is_file():
        raise InputError(
            f"{file}: describes {len(cameras)} cameras, and without {IMAGES} beside it "
            "nothing tells how they are placed"
        )
    if (file.parent / IMAGES).is_file() and file.name == CAMERAS:
        model, _ = read_refractive_colmap(file.parent)
    ids = sorted(cameras)
    folders = _folders(ids, model)
    poses = [rigid3.IDENTITY]
    if len(ids) > 1 and model is not None:
        poses += [_placed(model, ids[0], other, folders) for other in ids[1:]]
    return Rig(
        cameras=tuple(_rig_camera(cameras[i], folders[i]) for i in ids),
        cam_from_rig=np.array(poses),
        baseline_m=float(np.linalg.norm(poses[1][4:])) if len(ids) > 1 else None,
    )


def ports_missing(rig: Rig) -> str:
    """What to do about cameras that a model has no port of, a sentence; "": there are
    none. Stock COLMAP's have none, and lenses that make up for refraction."""
    bare = [c.name for c in rig.cameras if not c.port.refracts]
    if not bare:
        return ""
    return (
        f"no port was found of {', '.join(bare)}: their lenses may have been "
        "calibrated under water, and then hold the refraction already and take no "
        "port; to work with ports, put intrinsics calibrated in air, the port and the "
        "water index in their place (uwsfm init without --from explains each)"
    )


def _rig_camera(entry: PortCamera, folder: str) -> RigCamera:
    port = entry.port
    if port.refracts:
        port = port.in_air()
    return RigCamera(
        name=folder.replace("/", "-"),
        images=folder,
        camera=entry.camera,
        port=port,
        **refine_flags(port.refinable),
    )


def _folders(
    ids: list[int], model: pycolmap.Reconstruction | None
) -> Mapping[int, str]:
    """The folder of each camera's images; a name where the model has none."""
    found = {}
    for camera_id in ids:
        images = model.images.values() if model else ()
        parents = {
            str(PurePosixPath(image.name).parent)
            for image in images
            if image.camera_id == camera_id
        }
        alone = len(parents) == 1 and parents != {"."}
        found[camera_id] = parents.pop() if alone else f"camera{camera_id}"
    return found


def _placed(
    model: pycolmap.Reconstruction, first: int, other: int, folders: Mapping[int, str]
) -> Array:
    """Pose (7,) of a camera in the frame of the first one, over all common frames."""
    by_name: dict[int, dict[str, Array]] = {first: {}, other: {}}
    for image in model.images.values():
        if image.camera_id in by_name and image.has_pose:
            name = PurePosixPath(image.name).name
            by_name[image.camera_id][name] = np.array(image.cam_from_world().params)
    common = sorted(by_name[first].keys() & by_name[other].keys())[:MAX_FRAMES]
    if not common:
        raise InputError(
            f"no images of {folders[first]} and {folders[other]} have the same file "
            "name: nothing tells how these cameras are placed"
        )
    relative = rigid3.compose(
        np.array([by_name[other][name] for name in common]),
        rigid3.inverse(np.array([by_name[first][name] for name in common])),
    )
    return robust_average(relative) if len(common) > 2 else relative[0]
