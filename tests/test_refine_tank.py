"""`uwsfm refine` on a real rig: stock COLMAP's own model, with its default settings.

Skipped where the images are not at hand: they carry no licence, so they are not here.
"""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from foreign_models import stock_model, write

import uwsfm

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
    """Figures of the board in the water: refined, and of the pinholes it came from."""
    sys.path.insert(0, str(ROOT / "pipelines" / "uril_tank"))
    try:
        from board import check_boards, pinhole_rays
        from self_calibrated import SelfCalibrated
        from tank_rig import write_rig
    finally:
        sys.path.pop(0)
    folder = tmp_path_factory.mktemp("tank")
    write_rig(DATA, folder / "rig.yaml", whole_image=False, free_rig=False)
    stock = stock_model(DATA, folder)
    write(stock, folder / "model", old=True)
    what = folder / "model", folder / "rig.yaml"
    result = uwsfm.refine_model(*what, folder / "out")
    more = uwsfm.refine_model(*what, folder / "more", database=folder / "database.db")
    left, right = result.model.scene.cameras
    boards = DATA / "tank_corners.npz"
    refined = check_boards(
        boards,
        left.ray_from_img,
        right.ray_from_img,
        result.model.scene.cam_from_rig[1],
    )
    found = SelfCalibrated(stock, result.model.rig)
    pinhole = check_boards(
        boards, *(pinhole_rays(c) for c in found.cameras), found.right_from_left
    )
    print("\nrefined:", refined, "\npinhole:", pinhole, "\n", result.summary)
    return result, refined, pinhole, more


def test_all_frames_of_the_model_stay(study):
    result = study[0]
    assert result.summary["num_registered_frames"] >= 22
    assert result.summary["unregistered_frames"] == []


def test_the_database_brings_back_the_frames_that_pinholes_lost(study):
    summary = study[3].summary
    assert (summary["num_frames"], summary["num_registered_frames"]) == (24, 24)


def test_errors_are_those_of_free_pinholes(study):
    """Whose lenses and images are free, on the same observations."""
    summary = study[0].summary
    assert (
        summary["colmap_model"]["refractive_error_of_common_px"]
        <= summary["colmap_model"]["mean_error_of_common_px"]
    )


def test_ports_are_those_of_the_main_job(study):
    """`reconstruct` finds 10.1 ± 1.2 and 8.3 ± 1.2 mm from features of its own."""
    for port, distance in zip(
        study[0].model.scene.ports, (10.1e-3, 8.3e-3), strict=True
    ):
        assert port.distance == pytest.approx(distance, abs=2 * 1.2e-3)


def test_the_board_is_measured_better_than_by_the_pinholes(study):
    _, refined, pinhole, _ = study
    # Found: 0.025, 0.35 and 0.056 mm against 0.104, 1.58 and 0.49.
    assert refined.square_stddev < 0.5 * pinhole.square_stddev
    assert refined.planarity < 0.5 * pinhole.planarity
    assert refined.gap < 0.25 * pinhole.gap
    assert np.isclose(refined.square_mean, 25.4, rtol=0.03)  # the baseline's own 2 %
