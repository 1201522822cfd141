"""What looks at a lens as a whole, with each model: fits, mistakes, accuracies."""

from dataclasses import replace

import numpy as np
import pytest
from jacobians import CAMERA_IDS, EXAMPLE_CAMERAS

from uwsfm import FlatPort, InputError, RefractiveCamera
from uwsfm.calibration.given_accuracy import CORNER, RigAccuracy
from uwsfm.models.lens import (
    KIND,
    NUM_PARAMS,
    dir_from_img,
    img_from_dir,
    lens_row,
    param_slots,
    with_limit,
)
from uwsfm.residuals import border
from uwsfm.rig.rig import camera_from_colmap
from uwsfm.sfm.rig_checks.lens_mistakes import lens_corrections
from uwsfm.simulate.rigs import sample_rig
from uwsfm.trust.central import fit_central, fit_lens

EXAMPLES = pytest.mark.parametrize("lens", EXAMPLE_CAMERAS, ids=CAMERA_IDS)
PORT = FlatPort(distance=0.03, thickness=0.01, n_glass=1.5, n_water=1.333)


def seen(lens, rng, count=600):
    """Points in the middle of an image behind a port, at 1 to 2 m, and their pixels."""
    camera = RefractiveCamera(lens, PORT)
    size = np.array([lens.width, lens.height])
    pixels = size * rng.uniform(0.25, 0.75, (count, 2))
    origins, dirs = camera.ray_from_img(pixels)
    points = origins + rng.uniform(1.0, 2.0, (count, 1)) * dirs
    known = np.isfinite(points).all(axis=1)
    return camera, points[known], pixels[known]


@EXAMPLES
def test_a_lens_as_free_as_a_pinhole_finds_itself(lens, rng):
    """Behind its own port nothing is left; a single centre leaves more."""
    camera, points, pixels = seen(lens, rng)
    own = fit_lens(camera, points, pixels).residuals(points, pixels)
    # What MINPACK's relative tolerance of 1e-8 leaves of a start that is exact.
    assert np.abs(own).max() < 1e-4
    central = fit_central(camera, points, pixels).residuals(points, pixels)
    rms = np.sqrt(np.mean(np.sum(central**2, axis=1)))
    assert 1e-3 < rms < 2.0


@EXAMPLES
def test_mistakes_of_a_lens_are_lenses_themselves(lens):
    """Every correction can be built and projects something: none is half a lens."""
    rig = sample_rig()
    cameras = tuple(replace(camera, camera=lens) for camera in rig.cameras)
    rig = replace(rig, cameras=cameras)
    corrections = list(lens_corrections(rig))
    assert "principal_point" in {one.code for one in corrections}
    for one in corrections:
        for camera in one.rig.refractive_cameras():
            center = np.array([[camera.width / 2, camera.height / 2]])
            assert np.isfinite(camera.ray_from_img(center)[1]).all()


@pytest.mark.parametrize("model", ["FOV", "EUCM"])
def test_an_assumed_accuracy_of_a_shape_moves_the_corner_as_a_coefficients_does(model):
    """By `CORNER` of its distance from the centre, each number by itself: found by
    moving it."""
    (lens,) = [one for one in EXAMPLE_CAMERAS if one.model_name == model]
    rig = sample_rig()
    rig = replace(
        rig,
        cameras=(replace(rig.cameras[0], camera=lens),),
        cam_from_rig=rig.cam_from_rig[:1],
        baseline_m=None,
        accuracy=RigAccuracy(),
    )
    stddevs = rig.given_accuracy().stddevs[0, border.FIRST_LENS :][4:NUM_PARAMS]
    row = lens_row(model, lens.params)
    half = 0.5 * np.hypot(lens.width, lens.height)
    ray = dir_from_img(row[2] + half, row[3], row)
    for slot in param_slots(model)[4:]:
        moved = row.copy()
        moved[slot] += 1e-6
        shift = (img_from_dir(*ray, moved)[0] - img_from_dir(*ray, row)[0]) / 1e-6
        found = abs(shift) * stddevs[slot - 4] / half
        assert found == pytest.approx(CORNER, rel=1e-3)


def test_another_kind_of_lens_is_no_brown_lens():
    row = lens_row("PINHOLE", [500.0, 500.0, 320.0, 240.0])
    row[KIND] = 9.0
    with pytest.raises(InputError, match="9 is no kind of lens"):
        with_limit(row)


def test_a_number_that_moves_nothing_is_known():
    """EUCM with alpha zero is a pinhole, whatever its beta."""
    rig = sample_rig()
    lens = camera_from_colmap("EUCM", 800, 600, [600.0, 600.0, 400.0, 300.0, 0.0, 1.0])
    cameras = tuple(replace(camera, camera=lens) for camera in rig.cameras)
    rig = replace(rig, cameras=cameras, accuracy=RigAccuracy())
    alpha, beta = rig.given_accuracy().stddevs[0, border.FIRST_LENS + 4 :][:2]
    assert alpha > 0.0 and beta == 0.0
