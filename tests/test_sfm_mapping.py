"""From raw matches to a perspective start: simulated, so that the truth is known."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from sfm_scenes import simulated_dive

from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.rig.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.pinhole.mapper import map_images
from uwsfm.sfm.pinhole.mapping_database import write_mapping_database
from uwsfm.sfm.pinhole.perspective import PerspectiveStart, StartArrays, read_start
from uwsfm.sfm.rig_checks.pinhole_fit import fit_virtual_pinhole
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate import SimulatedScene
from uwsfm.simulate.rigs import nominal_rig, sample_rig

NUM_FRAMES = 6
OPTIONS = StartOptions(num_threads=2, mapper="pinhole")


@dataclass(frozen=True)
class Dive:
    rig: Rig
    frames: Frames
    simulated: SimulatedScene
    work_dir: Path

    def start(self, rig: Rig | None = None) -> PerspectiveStart:
        steps = Steps(self.work_dir)
        return start_from_matches(rig or self.rig, self.frames, steps, "", OPTIONS)


def make_dive(work_dir: Path, scene: Scene | None = None, seed: int = 0) -> Dive:
    """Straight ports at half their distance: what a user would write down."""
    rig = nominal_rig(sample_rig())
    simulated = simulated_dive(num_frames=NUM_FRAMES, seed=seed)
    work_dir.mkdir(exist_ok=True)
    frames = frames_of(rig, NUM_FRAMES, work_dir)
    features = scene or simulated.scene
    write_features(work_dir / "database.db", features, frames, wrong=0.1, seed=seed)
    return Dive(rig, frames, simulated, work_dir)


@pytest.fixture(scope="module")
def dive(tmp_path_factory) -> Dive:
    return make_dive(tmp_path_factory.mktemp("dive"))


@pytest.fixture(scope="module")
def start(dive) -> PerspectiveStart:
    return dive.start()


@pytest.fixture(scope="module")
def arrays(start) -> StartArrays:
    return read_start(start)


def center_errors(rig_from_world: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances of the rig centres after aligning the first pose only: no scaling."""
    true_from_world = rigid3.compose(rigid3.inverse(truth[0]), rig_from_world[0])
    centers = rigid3.transform(true_from_world, rigid3.inverse(rig_from_world)[:, 4:])
    return np.linalg.norm(centers - rigid3.inverse(truth)[:, 4:], axis=1)


def test_all_frames_are_registered(dive, start, arrays):
    assert arrays.frame_names == dive.frames.names
    assert start.summary["num_registered_frames"] == NUM_FRAMES
    assert start.summary["unregistered_frames"] == []
    assert start.summary["warnings"] == []


def test_start_is_metric_and_in_the_frame_of_the_real_rig(dive, arrays):
    """A dive of 1.4 m at an altitude of 2 m; the refractive stage does the rest."""
    truth = dive.simulated.truth.rig_from_world
    assert center_errors(arrays.rig_from_world, truth).max() < 0.05
    moved, expected = (
        rigid3.compose(poses, rigid3.inverse(np.tile(poses[0], (len(poses), 1))))
        for poses in (arrays.rig_from_world, truth)
    )
    error = rigid3.compose(moved, rigid3.inverse(expected))
    # The reference's port, tilted by 2 degrees, turns its rays by 0.5; frames that are
    # rolled by half a circle differ by twice that, and depths are still a little wrong.
    assert np.degrees(rigid3.rotation_angle(error)).max() < 2.5


def test_observations_are_real_pixels_of_their_keypoints(dive, arrays):
    scene = dive.simulated.scene
    for camera in (0, 1):
        for frame in range(NUM_FRAMES):
            rows = (scene.camera_idx == camera) & (scene.frame_idx == frame)
            np.testing.assert_allclose(
                arrays.keypoints[camera][frame], scene.xy[rows], atol=1e-3
            )  # stored as float32
    picked = [
        arrays.keypoints[c][f][k]
        for c, f, k in zip(
            arrays.camera_idx, arrays.frame_idx, arrays.keypoint_idx, strict=True
        )
    ]
    np.testing.assert_array_equal(arrays.xy, picked)


def test_tracks_follow_the_true_points(dive, arrays):
    """Each observation is a keypoint of a true point: tracks hold one point each."""
    scene = dive.simulated.scene
    true_point = {}
    for camera in (0, 1):
        for frame in range(NUM_FRAMES):
            rows = (scene.camera_idx == camera) & (scene.frame_idx == frame)
            for keypoint, point in enumerate(scene.point_idx[rows]):
                true_point[camera, frame, keypoint] = point
    found = np.array(
        [
            true_point[key]
            for key in zip(
                arrays.camera_idx.tolist(),
                arrays.frame_idx.tolist(),
                arrays.keypoint_idx.tolist(),
                strict=True,
            )
        ]
    )
    first = np.zeros(len(arrays.points), dtype=np.int64)
    first[arrays.point_idx[::-1]] = found[::-1]
    assert np.mean(found == first[arrays.point_idx]) > 0.99
    assert len(arrays.xy) > 0.8 * len(scene.xy)


def test_start_projects_close_to_its_pixels(dive, start, arrays):
    """Port tilts are still unknown, yet the real cameras explain most of the image."""
    scene = Scene.from_arrays(
        cameras=dive.rig.refractive_cameras(),
        cam_from_rig=start.cam_from_rig,
        rig_from_world=arrays.rig_from_world,
        points=arrays.points,
        camera_idx=arrays.camera_idx,
        frame_idx=arrays.frame_idx,
        point_idx=arrays.point_idx,
        xy=arrays.xy,
    )
    assert np.nanmedian(np.linalg.norm(scene.residuals(), axis=1)) < 1.5


def test_same_input_gives_the_same_numbers(arrays, tmp_path):
    again = read_start(make_dive(tmp_path / "again").start())
    np.testing.assert_array_equal(again.keypoint_idx, arrays.keypoint_idx)
    np.testing.assert_allclose(again.rig_from_world, arrays.rig_from_world, atol=1e-6)


@pytest.mark.parametrize("seed", [0, 2])
def test_baseline_length_alone_is_enough(seed, tmp_path):
    """Dive 2: a wrong match that one rig does not explain gets into the free model."""
    other = make_dive(tmp_path / "baseline", seed=seed)
    bare = replace(other.rig, cam_from_rig=None)
    start = other.start(bare)
    pose, true_pose = start.cam_from_rig[1], other.simulated.truth.cam_from_rig[1]
    assert np.linalg.norm(pose[4:]) == pytest.approx(0.2, rel=1e-9)
    error = rigid3.compose(pose, rigid3.inverse(true_pose))
    # The ports' tilts, 2 and 1 degrees, turn the rays by a quarter of that.
    assert np.degrees(rigid3.rotation_angle(error)) < 1.0
    baseline, true_baseline = (rigid3.inverse(p)[4:] for p in (pose, true_pose))
    # As above: the turns of the rays, a little more than 0.5 degrees.
    assert np.linalg.norm(np.cross(baseline, true_baseline)) < np.radians(1.0) * 0.2**2
    truth = other.simulated.truth.rig_from_world
    assert center_errors(read_start(start).rig_from_world, truth).max() < 0.05


def test_free_images_begin_with_a_wide_pair(dive, tmp_path):
    """The two images of a frame, 0.2 m apart at 2 m, led to a model 2 px wrong."""
    cameras = dive.rig.refractive_cameras()
    write_mapping_database(
        dive.work_dir / "database.db",
        tmp_path / "free.db",
        dive.frames,
        cameras,
        tuple(fit_virtual_pinhole(camera, None) for camera in cameras),
        None,
        OPTIONS,
        model="RADIAL",
    )
    model = map_images(tmp_path / "free.db", dive.frames, OPTIONS, free=True)[0]
    assert model.num_reg_images() == 2 * NUM_FRAMES
    # The mean length of the noise is 0.4 px sqrt(pi / 2); ports at the wrong distance
    # add little to what distortion absorbs.
    assert model.compute_mean_reprojection_error() < 0.6


def test_inverted_rig_stops_before_mapping(dive, tmp_path):
    other = make_dive(tmp_path / "inverted")
    poses = np.array(other.rig.cam_from_rig)
    poses[1] = rigid3.inverse(poses[1])
    with pytest.raises(InputError, match="cam_from_rig of 'right' is inverted"):
        other.start(replace(other.rig, cam_from_rig=poses))
    assert not (other.work_dir / "perspective").exists()


def test_frames_that_share_nothing_are_explained(tmp_path):
    """Every frame sees points of its own: pairs match, frames do not."""
    scene = simulated_dive(num_frames=NUM_FRAMES).scene
    apart = replace(
        scene,
        point_idx=scene.point_idx + scene.num_points * scene.frame_idx,
        points=np.tile(scene.points, (NUM_FRAMES, 1)),
    )
    with pytest.raises(UwsfmError, match="share only 0 matches"):
        make_dive(tmp_path / "apart", apart).start()


def test_no_matches_at_all_are_explained(tmp_path):
    scene = simulated_dive(num_frames=NUM_FRAMES).scene
    alone = replace(scene, point_idx=np.arange(len(scene.xy)))
    with pytest.raises(InputError, match="'left' and 'right' share only 0 matches"):
        make_dive(tmp_path / "alone", alone).start()
