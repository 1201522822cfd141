"""What lies beyond the reach of a calibration in air takes no part, step by step.

In images of 800 x 600 px the left lens was calibrated to 250 px, the right one to 300.
"""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import model_of, simulated_dive

from uwsfm.rig.rig import Rig
from uwsfm.sfm.from_colmap.colmap_model import ImageModel
from uwsfm.sfm.from_colmap.model_rig import same_frame_matches
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.refine import refine_scene
from uwsfm.sfm.rig_checks.stereo_matches import read_same_frame_matches
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.trust.given import _edge
from uwsfm.trust.projections import projection_map

RADII_PX = (250.0, 300.0)
NUM_FRAMES = 5


def limited(rig: Rig, radii=RADII_PX) -> Rig:
    cameras = tuple(
        replace(camera, valid_radius_px=radius)
        for camera, radius in zip(rig.cameras, radii, strict=True)
    )
    return replace(rig, cameras=cameras)


@pytest.fixture(scope="module")
def dive():
    return simulated_dive(num_frames=NUM_FRAMES, num_points=900)


@pytest.fixture(scope="module")
def database(dive, tmp_path_factory):
    folder = tmp_path_factory.mktemp("features")
    frames = frames_of(sample_rig(), NUM_FRAMES, folder)
    write_features(folder / "database.db", dive.scene, frames, wrong=0.1)
    return folder, frames


def radii_of(scene, camera_idx, xy):
    """Distance (N,) of pixels from their camera's principal point, by hand."""
    centres = np.array([camera.lens[2:4] for camera in scene.cameras])
    return np.hypot(*(xy - centres[camera_idx]).T)


def assert_within(scene, camera_idx, xy):
    """Nothing beyond the limit of its camera, and something near it."""
    radii = radii_of(scene, camera_idx, xy)
    for c, limit in enumerate(RADII_PX):
        largest = radii[camera_idx == c].max()
        # Hundreds of features: some lie in the outer tenth, the images go to 400 px.
        assert 0.9 * limit < largest <= limit


def test_the_limit_is_around_the_principal_point_and_belongs_to_the_lens():
    camera = replace(sample_rig().cameras[0], valid_radius_px=250.0)
    centre = [camera.camera.principal_point_x, camera.camera.principal_point_y]
    assert centre != [400.0, 300.0]  # the middle of the image
    # 3-4-5 triangles, in all four quadrants.
    away = np.array([[150, 200], [-150, 200], [150.1, -200], [-150, -200.1]])
    assert camera.covers(centre + away * (1.0 - 1e-12)).tolist() == [
        True,
        True,
        False,
        False,
    ]
    free = replace(camera, valid_radius_px=None)
    assert free.covers(centre + 100.0 * away).all()


def test_refinement_keeps_to_it(dive):
    rig = limited(sample_rig())
    refined = refine_scene(dive.scene, rig)
    scene = refined.scene
    assert_within(scene, scene.camera_idx, scene.xy)
    radii = radii_of(dive.scene, dive.scene.camera_idx, dive.scene.xy)
    limits = np.array(RADII_PX)[dive.scene.camera_idx]
    assert refined.num_tested == np.count_nonzero(radii <= limits)


def test_mapping_keeps_to_it(database):
    folder, frames = database
    rig = limited(nominal_rig(sample_rig()))
    options = StartOptions(mapper="refractive", num_threads=2)
    start = start_from_matches(rig, frames, Steps(folder), "", options)
    arrays = start.arrays()
    scene = simulated_dive(num_frames=1, num_points=10).scene
    assert_within(scene, arrays.camera_idx, arrays.xy)


def test_the_check_of_the_rig_keeps_to_it(dive, database):
    folder, frames = database
    path, rig = folder / "database.db", sample_rig()
    (whole,) = read_same_frame_matches(path, frames, rig)
    (part,) = read_same_frame_matches(path, frames, limited(rig))
    assert 100 < len(part) < 0.8 * len(whole)
    for camera, xy in enumerate((part.xy_a, part.xy_b)):
        index = np.full(len(xy), camera)
        assert radii_of(dive.scene, index, xy).max() <= RADII_PX[camera] + 1e-3


def test_the_check_of_a_model_keeps_to_it(dive, tmp_path):
    scene, rig = dive.truth, limited(sample_rig())
    model = model_of(rig, scene)
    images = ImageModel(
        folder=tmp_path,
        frame_names=model.frame_names,
        cam_from_world=np.zeros((2, NUM_FRAMES, 7)),
        lens_models=frozenset(),
        points=scene.points,
        colors=model.colors,
        camera_idx=scene.camera_idx,
        frame_idx=scene.frame_idx,
        point_idx=scene.point_idx,
        keypoint_idx=model.keypoint_idx,
        xy=scene.xy,
        own_error_px=np.zeros(scene.num_observations),
        keypoints=model.keypoints,
        warnings=(),
    )
    (pair,) = same_frame_matches(images, rig)
    camera_idx = np.repeat([0, 1], len(pair))
    assert_within(scene, camera_idx, np.vstack([pair.xy_a, pair.xy_b]))


def test_comparisons_of_projections_keep_to_it(dive):
    """Cells of the map are 1/COLUMNS of the image; those beyond are blank."""
    scene = dive.truth
    found = projection_map(scene, scene, scene, limited(sample_rig()), with_scale=False)
    rows, columns = found.px.shape[2:]
    x = (np.arange(columns) + 0.5) * 800 / columns
    y = (np.arange(rows) + 0.5) * 600 / rows
    cells = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    for c, limit in enumerate(RADII_PX):
        shown = np.isfinite(found.px[c, 0]).ravel()
        beyond = radii_of(scene, np.full(len(cells), c), cells) > limit
        assert beyond.any() and not shown[beyond].any()
        assert np.count_nonzero(shown) > 0.8 * np.count_nonzero(~beyond)


def test_lenses_are_compared_along_the_edge_of_what_is_valid(dive):
    camera = dive.truth.cameras[0]
    edge = _edge(camera, 250.0)
    radii = np.hypot(*(edge - camera.lens[2:4]).T)
    np.testing.assert_allclose(radii, 250.0, rtol=1e-12)
    corners = _edge(camera, None)
    assert np.ptp(corners, axis=0).tolist() == [800.0, 600.0]
