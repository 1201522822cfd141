"""Small models of COLMAP, and how broken input must end."""

import os
import shutil
from pathlib import Path

import pycolmap
import pytest

ROOT = Path(__file__).parent.parent
CASES = Path(os.environ.get("UWSFM_CASES", ROOT.parent / "shared" / "cases"))
needs_cases = pytest.mark.skipif(
    not CASES.is_dir(), reason=f"no cases in {CASES}; set UWSFM_CASES"
)
RIG_FILES = ("rigs.bin", "frames.bin")


def small_model(names: dict[int, str] | None = None) -> pycolmap.Reconstruction:
    """Two cameras, three frames, ten points; images by identifier may be renamed."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 1, 2
    options.num_frames_per_rig, options.num_points3D = 3, 10
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    for image_id in sorted(model.images):
        image = model.images[image_id]
        side = "left" if image.camera_id == min(model.cameras) else "right"
        name = f"{side}/{image.frame_id:04}.jpg"
        image.name = (names or {}).get(image_id, name)
    return model


def written(model: pycolmap.Reconstruction, folder: Path, *, rigs: bool = True) -> Path:
    """A binary model, of 4.x or, without rigs, of the layout before."""
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(str(folder))
    if not rigs:
        for name in RIG_FILES:
            (folder / name).unlink()
    return folder


def copied(name: str, folder: Path) -> Path:
    """A model of the shared cases, writable."""
    shutil.copytree(CASES / "models" / name, folder)
    folder.chmod(0o755)
    for path in folder.iterdir():
        path.chmod(0o644)
    return folder
