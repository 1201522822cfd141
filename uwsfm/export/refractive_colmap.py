"""Refractive COLMAP's text models, which carry ports: written and read.

That fork of COLMAP (She et al., IROS 2024) appends the name and the parameters of a
port to a camera's line in ``cameras.txt``::

    CAMERA_ID MODEL WIDTH HEIGHT PARAMS[] [REFRAC_MODEL REFRAC_PARAMS[]]

Everything else is COLMAP's old text format, without rigs and frames. Lenses are those
in air, keypoints the raw ones and poses those of the real cameras: as here.
"""

import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from uwsfm._files import replaced_dir
from uwsfm.colmap import Model, read_reconstruction, to_reconstruction
from uwsfm.errors import InputError
from uwsfm.export.files import checked_target
from uwsfm.models.port import DomePort, FlatPort, NoPort, Port
from uwsfm.rig import camera_from_colmap

CAMERAS, OTHERS = "cameras.txt", ("images.txt", "points3D.txt")
_PORTS: dict[str, type[FlatPort] | type[DomePort]] = {
    "FLATPORT": FlatPort,
    "DOMEPORT": DomePort,
}
_HEADER = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] OPTIONAL[REFRAC_MODEL REFRAC_PARAMS[]]
# Number of cameras: {count}
"""


@dataclass(frozen=True, kw_only=True)
class PortCamera:
    """One line of ``cameras.txt``."""

    camera: pycolmap.Camera
    """In air, with its identifier."""
    port: Port
    """None is written of a `NoPort`."""


def export_refractive_colmap(model: Model, folder: str | Path) -> None:
    """Write a model as Refractive COLMAP's text files.

    Args:
        model: what to write.
        folder: must not exist.

    Raises:
        InputError: the folder exists or cannot be written.
    """
    target = checked_target(folder)
    reconstruction = to_reconstruction(model)
    cameras = {
        index + 1: PortCamera(camera=reconstruction.cameras[index + 1], port=port)
        for index, port in enumerate(model.scene.ports)
    }
    with replaced_dir(target) as partial, tempfile.TemporaryDirectory() as name:
        reconstruction.write_text(name)
        for other in OTHERS:  # rigs.txt and frames.txt are unknown to it
            shutil.copy(Path(name) / other, partial / other)
        text = _HEADER.format(count=len(cameras))
        text += "".join(_line(number, cameras[number]) for number in cameras)
        (partial / CAMERAS).write_text(text, encoding="ascii")


def _line(camera_id: int, entry: PortCamera) -> str:
    camera = entry.camera
    items = [camera_id, camera.model_name, camera.width, camera.height]
    # repr: the shortest decimal number that reads back to the same double.
    items += [repr(float(value)) for value in camera.params]
    if not isinstance(entry.port, NoPort):
        kind = next(name for name, cls in _PORTS.items() if isinstance(entry.port, cls))
        items += [kind, *(repr(float(value)) for value in entry.port.params)]
    return " ".join(str(item) for item in items) + "\n"


def read_refractive_cameras(path: str | Path) -> dict[int, PortCamera]:
    """Lenses and ports by camera identifier, from a ``cameras.txt``.

    Plain COLMAP's is one without ports.

    Raises:
        InputError: no such file, or the file and the line that cannot be understood.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
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
    if kind not in _PORTS:
        known = " and ".join(_PORTS)
        raise InputError(f"unknown port model {kind!r}; the known ones are {known}")
    row = [_number(item) for item in items[split + 1 :]]
    return camera_id, PortCamera(camera=camera, port=_PORTS[kind].from_params(row))


def _integer(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise InputError(f"{text!r} is not a whole number") from None


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
    with tempfile.TemporaryDirectory() as name:
        for other in OTHERS:
            if not (folder / other).is_file():
                raise InputError(f"{folder / other}: no such file")
            shutil.copy(folder / other, name)
        text = "".join(
            _line(number, PortCamera(camera=entry.camera, port=NoPort()))
            for number, entry in cameras.items()
        )
        (Path(name) / CAMERAS).write_text(text, encoding="ascii")
        try:
            return read_reconstruction(Path(name)), cameras
        except InputError:
            raise InputError(f"{folder}: not a text model of COLMAP") from None
