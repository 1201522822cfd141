"""The text format of Refractive COLMAP, see `uwsfm.sfm.from_colmap.refractive_colmap`:
written."""

import shutil
from pathlib import Path

from uwsfm._base.files import checked_target, replaced_dir
from uwsfm._base.partial import scratch_folder
from uwsfm._base.paths import shown, white_space_fault
from uwsfm.colmap.model import Model, to_reconstruction
from uwsfm.errors import InputError
from uwsfm.sfm.from_colmap.refractive_colmap import (
    CAMERAS,
    IMAGES,
    POINTS,
    PortCamera,
    camera_line,
)

_HEADER = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] OPTIONAL[REFRAC_MODEL REFRAC_PARAMS[]]
# Number of cameras: {count}
"""


def export_refractive_colmap(model: Model, folder: str | Path) -> None:
    """Write a model as Refractive COLMAP's text files.

    Args:
        model: what to write.
        folder: must not exist.

    Raises:
        InputError: the folder exists or cannot be written, or a name would be cut by
            whoever reads the text.
    """
    target = checked_target(folder)
    for name in model.image_names():
        fault = white_space_fault(name)
        if fault is not None:
            raise InputError(f"cannot export {shown(name)!r}: its name {fault}")
    reconstruction = to_reconstruction(model)
    cameras = {
        index + 1: PortCamera(camera=reconstruction.cameras[index + 1], port=port)
        for index, port in enumerate(model.scene.ports)
    }
    with replaced_dir(target) as partial, scratch_folder() as text_model:
        reconstruction.write_text(str(text_model))
        for other in (IMAGES, POINTS):  # rigs.txt and frames.txt are unknown to it
            shutil.copy(text_model / other, partial / other)
        text = _HEADER.format(count=len(cameras))
        text += "".join(camera_line(number, cameras[number]) for number in cameras)
        (partial / CAMERAS).write_text(text, encoding="ascii")
