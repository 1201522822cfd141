"""The refraction-aware mapper: simulated dives, so that the truth is known."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from sfm_scenes import simulated_dive
from test_mixed_ports import mixed_rig

from uwsfm.errors import UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.rig.rig import Rig
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.mapping.refractive_start import RefractiveStart
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import Steps
from uwsfm.simulate import SimulatedScene
from uwsfm.simulate.rigs import nominal_rig, sample_rig

NUM_FRAMES = 6


@dataclass(frozen=True)
class Dive:
    rig: Rig
    frames: Frames
    simulated: SimulatedScene
    work_dir: Path

    def start(self, **options) -> RefractiveStart:
        settings = StartOptions(mapper="refractive", **options)
        steps = Steps(self.work_dir)
        start = start_from_matches(self.rig, self.frames, steps, "", settings)
        assert isinstance(start, RefractiveStart)
        return start


def make_dive(
    work_dir: Path,
    wrong: float = 0.2,
    without: int | None = None,
    true_rig: Rig | None = None,
    absent: frozenset[tuple[int, int]] = frozenset(),
) -> Dive:
    """Straight ports at half their distance: what a user would write down.

    Args:
        work_dir: of the database.
        wrong: fraction of wrong matches.
        without: a frame in which nothing is seen.
        true_rig: the sample's by default.
        absent: (camera, frame) of images that are not there.
    """
    true_rig = true_rig or sample_rig()
    rig = nominal_rig(true_rig)
    simulated = simulated_dive(true_rig, num_frames=NUM_FRAMES)
    scene = simulated.scene
    if without is not None:
        scene, _ = scene.select(scene.frame_idx != without)
    frames = frames_of(rig, NUM_FRAMES, work_dir)
    if absent:
        names = frozenset(frames.image_name(c, f) for c, f in absent)
        frames = replace(frames, absent=names)
        there = [
            frames.has_image(c, f)
            for c, f in zip(scene.camera_idx, scene.frame_idx, strict=True)
        ]
        scene, _ = scene.select(np.array(there))
    work_dir.mkdir(exist_ok=True)
    write_features(work_dir / "database.db", scene, frames, wrong=wrong)
    return Dive(rig, frames, simulated, work_dir)


@pytest.fixture(scope="module")
def dive(tmp_path_factory) -> Dive:
    return make_dive(tmp_path_factory.mktemp("dive"))


@pytest.fixture(scope="module")
def start(dive) -> RefractiveStart:
    return dive.start(num_threads=2)


def center_errors(dive: Dive, start: RefractiveStart) -> np.ndarray:
    """Distances of all rig centres after aligning the first pose only: no scaling."""
    found, truth = start.arrays().rig_from_world, dive.simulated.truth.rig_from_world
    true_from_world = rigid3.compose(rigid3.inverse(truth[0]), found[0])
    centers = rigid3.transform(true_from_world, rigid3.inverse(found)[:, 4:])
    return np.linalg.norm(centers - rigid3.inverse(truth)[:, 4:], axis=1)


def test_frames_and_ports_are_those_of_the_dive(dive, start):
    """A dive at an altitude of 2 m, seen with noise of 0.4 px: the optimum knows the
    centres to a millimetre; a pinhole start is 7 to 40 mm off."""
    assert start.arrays().frame_names == dive.frames.names
    assert start.summary["unregistered_frames"] == []
    assert start.summary["warnings"] == []
    assert center_errors(dive, start).max() < 5e-3
    truth = dive.simulated.truth
    for found, true in zip(start.cameras(dive.rig), truth.cameras, strict=True):
        # From 0 and 2 degrees off; six frames hardly tell the distances at 2 m.
        cosine = np.dot(found.port.normal, true.port.normal)
        assert np.degrees(np.arccos(min(cosine, 1.0))) < 0.3


ABSENT = frozenset({(1, 1), (0, 4)})


@pytest.mark.parametrize("mapper", ["refractive", "pinhole"])
def test_a_frame_without_one_camera_is_mapped_with_the_other(tmp_path, mapper):
    """One frame lacks the right image, one the left, which is the rig's reference."""
    dive = make_dive(tmp_path / "dive", wrong=0.1, absent=ABSENT)
    settings = StartOptions(mapper=mapper, num_threads=1)
    start = start_from_matches(
        dive.rig, dive.frames, Steps(dive.work_dir), "", settings
    )
    arrays = start.arrays()
    assert arrays.frame_names == dive.frames.names
    assert start.summary["unregistered_frames"] == []
    counts = np.zeros((2, NUM_FRAMES), dtype=int)
    np.add.at(counts, (arrays.camera_idx, arrays.frame_idx), 1)
    for c, f in np.ndindex(counts.shape):
        empty = (c, f) in ABSENT
        assert (len(arrays.keypoints[c][f]) == 0) == empty
        assert (counts[c, f] == 0) == empty
    # As with all images: pinholes of ports whose distance is a guess are 40 mm off.
    limit = 5e-3 if mapper == "refractive" else 0.05
    assert center_errors(dive, start).max() < limit


def test_observations_are_real_pixels_of_right_matches(dive, start):
    arrays, scene = start.arrays(), dive.simulated.scene
    truths = np.empty(len(arrays.xy), dtype=np.int64)
    for camera in (0, 1):
        for frame in range(NUM_FRAMES):
            rows = (scene.camera_idx == camera) & (scene.frame_idx == frame)
            mine = (arrays.camera_idx == camera) & (arrays.frame_idx == frame)
            keypoints = arrays.keypoint_idx[mine]
            np.testing.assert_array_equal(
                arrays.xy[mine], scene.xy[rows].astype(np.float32)[keypoints]
            )
            truths[mine] = scene.point_idx[rows][keypoints]
    order = np.lexsort((truths, arrays.point_idx))
    same = arrays.point_idx[order][1:] == arrays.point_idx[order][:-1]
    agree = truths[order][1:] == truths[order][:-1]
    # A wrong match is kept where it lies on the epipolar curve, near the point's depth.
    assert np.mean(agree[same]) > 0.995
    # Nothing that pinholes could not explain is missing.
    counts = np.bincount(scene.point_idx, minlength=scene.num_points)
    assert len(arrays.xy) > 0.8 * counts[counts >= 3].sum()


def test_twice_the_same_bytes_whatever_the_number_of_threads(dive, start, tmp_path):
    again = make_dive(tmp_path / "again").start(num_threads=1)
    for path in sorted(start.map_path.iterdir()):
        if path.suffix == ".npy":
            assert path.read_bytes() == (again.map_path / path.name).read_bytes()


def test_a_finished_map_is_not_made_again(dive, start):
    before = (start.map_path / "points.npy").stat().st_mtime_ns
    assert dive.start(num_threads=2).summary["num_points"] > 0
    assert (start.map_path / "points.npy").stat().st_mtime_ns == before


def test_a_frame_without_matches_is_reported(tmp_path):
    start = make_dive(tmp_path, without=2).start()
    assert start.summary["unregistered_frames"] == ["0002.png"]
    assert len(start.arrays().frame_names) == NUM_FRAMES - 1


def test_ports_of_any_kind_make_a_metric_map(tmp_path):
    """A flat port, a dome whose centre is a guess, and a camera without a port. With
    pinholes the rig has to be turned by 6 degrees, and the centres are 0.5 m off."""
    dive = make_dive(tmp_path, true_rig=mixed_rig())
    start = dive.start()
    assert start.summary["unregistered_frames"] == []
    assert start.summary["warnings"] == []  # turned back, once the ports had moved
    assert center_errors(dive, start).max() < 10e-3


def aligned_errors(centers: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances after the best similarity (Umeyama 1991), in the truth's unit."""
    a, b = centers - centers.mean(axis=0), truth - truth.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = np.sum(s * signs) / np.sum(a**2)
    return np.linalg.norm(scale * a @ (u * signs @ vt).T - b, axis=1)


def test_one_camera_begins_with_a_pair_of_frames(tmp_path):
    """The right camera is not there. With a known housing the shape is metric but for
    one scale, to the noise; the scale is near the distance that was given."""
    dive = make_dive(tmp_path)
    scene = dive.simulated.scene
    left, _ = scene.select(scene.camera_idx == 0)
    camera = replace(
        sample_rig().cameras[0], refine_normal=False, refine_distance=False
    )
    rig = replace(
        dive.rig,
        cameras=(camera,),
        cam_from_rig=rigid3.IDENTITY[None],
        baseline_m=None,
        refine_cam_from_rig=False,
    )
    frames = frames_of(rig, NUM_FRAMES, tmp_path)
    database = tmp_path / "one" / "database.db"
    database.parent.mkdir()
    write_features(database, left, frames, wrong=0.2)
    one = replace(dive, rig=rig, frames=frames, work_dir=database.parent)
    start = one.start(scene_distance_m=2.0)
    assert start.summary["unregistered_frames"] == []
    centers = rigid3.inverse(start.arrays().rig_from_world)[:, 4:]
    truth = rigid3.inverse(dive.simulated.truth.rig_from_world)[:, 4:]
    assert aligned_errors(centers, truth).max() < 5e-3


def test_frames_that_share_nothing_are_no_map(tmp_path):
    """Each frame sees itself only: its cameras agree, but there is no second frame."""
    dive = make_dive(tmp_path / "dive")
    scene = dive.simulated.scene
    own = scene.point_idx % NUM_FRAMES == scene.frame_idx
    lonely, _ = scene.select(own)
    (tmp_path / "lonely").mkdir()
    database = tmp_path / "lonely" / "database.db"
    write_features(database, lonely, dive.frames, wrong=0.0)
    with pytest.raises(UwsfmError, match="no map could be built"):
        replace(dive, work_dir=tmp_path / "lonely").start()
