"""The main job on the sample, beside the sample's truth."""

from importlib.resources import files
from pathlib import Path

from uwsfm._base.progress import Progress, silent
from uwsfm.errors import UwsfmError
from uwsfm.jobs.evaluate import Comparison, compare_with_truth
from uwsfm.jobs.reconstruct import ReconstructResult, reconstruct
from uwsfm.sfm.options import Mapper, StartOptions

MAX_FEATURES = 4096
"""The texture of the sample is dense: twice as many would take a first look twice as
long, and show the same."""


def sample_dir() -> Path:
    """The rendered sample: in the installed package, or in the source tree.

    Raises:
        UwsfmError: neither is there.
    """
    package = Path(str(files("uwsfm")))
    for folder in (
        package / "datasets" / "sample",
        package.parent / "datasets" / "sample",
    ):
        if (folder / "rig.yaml").exists():
            return folder
    raise UwsfmError(f"the sample is missing from the installation in {package}")


def run_demo(
    out: str | Path,
    mapper: Mapper = StartOptions.mapper,
    progress: Progress = silent,
) -> tuple[ReconstructResult, Comparison]:
    """Reconstruct the sample into ``out``, and compare with its truth."""
    sample = sample_dir()
    result = reconstruct(
        sample / "rig.yaml",
        sample / "images",
        out,
        max_features=MAX_FEATURES,
        mapper=mapper,
        progress=progress,
    )
    return result, compare_with_truth(result, sample / "truth.json")
