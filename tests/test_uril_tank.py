"""A real rig, target-free: the bounds that the study in pipelines/uril_tank reports.

Skipped where the images are not at hand: they carry no licence, so they are not here.
"""

import os
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parent.parent
DATA = Path(os.environ.get("UWSFM_DATA", ROOT.parent / "shared" / "data")) / "uril_tank"

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not DATA.is_dir(), reason=f"no images in {DATA}; set UWSFM_DATA"
    ),
]


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """The recommended variant, the pinhole in air, and COLMAP on the same features."""
    sys.path.insert(0, str(ROOT / "pipelines" / "uril_tank"))
    try:
        import pipeline
        import self_calibrated

        out = tmp_path_factory.mktemp("tank")
        how = {"whole_image": False, "free_rig": False}
        result, checks = pipeline.run_refractive(DATA, out, **how)
        work, rig = out / "run" / pipeline.WORK, result.model.rig
        pinhole = self_calibrated.run(DATA, work, out / "pinhole", rig)
        yield result, checks, pinhole
    finally:
        sys.path.pop(0)


def test_pairs_are_registered(study):
    result, _, _ = study
    assert result.summary["num_frames"] == 24
    assert result.summary["num_registered_frames"] >= 22


def test_error_is_that_of_a_free_pinhole(study):
    """On the same observations: 16 free lens parameters and no rig to obey."""
    result, _, pinhole = study
    assert pinhole.num_common(result.model) > 10_000
    error, other = (
        pinhole.common_error(result.model),
        pinhole.common_own_error(result.model),
    )
    assert error <= 1.25 * other


def test_ports_are_where_the_board_says(study):
    """A fit to the board in the water: 12-25 mm, (0, 0) and (2, -2.5) degrees.

    The in-air principal points are uncertain by 5 px, which is 1.3 degrees of tilt.
    """
    result, _, _ = study
    for port, tilt in zip(
        result.model.scene.ports, ((0.0, 0.0), (2.0, -2.5)), strict=True
    ):
        assert 8e-3 <= port.distance <= 28e-3
        found = np.degrees(np.arcsin(port.normal[:2]))
        assert np.linalg.norm(found - tilt) <= 2.5


def test_board_is_measured_well(study):
    _, checks, _ = study
    assert checks.square_stddev < 0.15
    assert checks.planarity < 0.6
    assert checks.gap < 0.15
