"""Surveys in parts: the parts, their places, and the map that they become."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from uwsfm._base.progress import Progress, silent
from uwsfm.errors import InputError, UwsfmError
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import align
from uwsfm.geometry.joint_alignment import Link, align_jointly
from uwsfm.jobs.finish import start_scene
from uwsfm.sfm.frontend.images import Frames
from uwsfm.sfm.mapping.refractive_start import RefractiveStart
from uwsfm.sfm.options import MappingOptions, StartOptions
from uwsfm.sfm.refine import Refined, refine_scene
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.sfm.start import start_from_matches
from uwsfm.sfm.steps import FILE_NAME as STEPS_FILE
from uwsfm.sfm.steps import Steps
from uwsfm.sfm.submaps.splitting import MIN_OVERLAP, split
from uwsfm.sfm.submaps.submap import Submap, read_submaps
from uwsfm.simulate import ObservationOptions, Relief, SimulatedScene, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.trajectories import lawn_mower


@pytest.mark.parametrize("kept", [0, 3, 100, -30])
def test_a_part_that_was_cut_short_is_named(tmp_path, kept):
    path = tmp_path / "000.npz"
    names = [f"0.{name}" for name in Submap._fields]
    np.savez(path, **{name: np.ones(20) for name in names})
    assert len(read_submaps(path)) == 1
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(UwsfmError, match="000.npz is damaged: remove the folder"):
        read_submaps(path)


def lawn_links(num_lines: int, per_line: int) -> csr_array:
    """Matches of frames whose number falls with their distance, as over a sea floor."""
    centers = -lawn_mower(num_lines, per_line, spacing=0.4, line_spacing=0.9)[:, 4:]
    # Every other line is flown turned round: the pose's translation is turned too.
    turned = (np.arange(len(centers)) // per_line) % 2 == 1
    centers[turned, :2] *= -1.0
    away = np.linalg.norm(centers[:, None] - centers, axis=2)
    links = np.maximum(0.0, np.round(300.0 * (1.0 - away / 1.5)))
    np.fill_diagonal(links, 0.0)
    return csr_array(links)


@pytest.mark.parametrize("shape, max_frames", [((3, 20), 20), ((12, 50), 80)])
def test_parts_are_small_connected_and_overlap(shape, max_frames):
    links = lawn_links(*shape)
    parts = split(links, max_frames)
    cores = np.concatenate([part.core for part in parts])
    assert sorted(cores.tolist()) == list(range(links.shape[0]))
    # Even cuts would make the least number; cheap and connected ones cost some more.
    assert len(parts) <= 2 * -(-links.shape[0] // max_frames)
    for part in parts:
        assert len(part.core) <= max_frames
        assert connected_components(links[part.core][:, part.core])[0] == 1
        assert np.isin(part.core, part.frames).all()
        shared = [np.intersect1d(part.frames, p.frames) for p in parts if p is not part]
        assert max(len(frames) for frames in shared) >= MIN_OVERLAP
    again = split(links, max_frames)
    assert all(
        np.array_equal(p.frames, q.frames) for p, q in zip(parts, again, strict=True)
    )


def test_frames_that_nothing_joins_are_in_no_part():
    links = lawn_links(3, 10).tolil()
    links[[4, 17], :] = 0.0
    links[:, [4, 17]] = 0.0
    parts = split(csr_array(links), 12)
    cores = np.concatenate([part.core for part in parts])
    assert sorted(cores.tolist()) == [f for f in range(30) if f not in (4, 17)]


@pytest.mark.parametrize("with_scale", [False, True])
def test_maps_in_a_ring_find_their_places(rng, with_scale):
    """Eight maps around a square, 1 mm of noise per place; one more link is of another
    place altogether, with all its places."""
    num_maps = 8
    scale = np.exp(rng.normal(size=num_maps)) if with_scale else np.ones(num_maps)
    scale[0] = 1.0
    turn = rigid3.quat_from_rotvec(rng.normal(size=(num_maps, 3)))
    poses = np.concatenate([turn, 10.0 * rng.normal(size=(num_maps, 3))], axis=1)
    poses[0] = rigid3.IDENTITY
    angle = 2.0 * np.pi * np.arange(num_maps) / num_maps
    middle = 20.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])

    def seen(k, places):
        noisy = places + 1e-3 * rng.normal(size=places.shape)
        return rigid3.transform(rigid3.inverse(poses[k]), noisy) / scale[k]

    links = []
    for k in range(num_maps):
        n = (k + 1) % num_maps
        places = 0.5 * (middle[k] + middle[n]) + rng.normal(size=(60, 3)) * [3, 3, 0.5]
        in_b = seen(n, places)
        wrong = rng.random(60) < 0.2
        in_b[wrong] += rng.normal(size=(wrong.sum(), 3))
        links.append(Link(k, n, seen(k, places), in_b))
    false = middle[2] + rng.normal(size=(40, 3))
    links.append(Link(2, 6, seen(2, false), seen(6, false + [0.0, 2.0, 1.0])))
    placement = align_jointly(num_maps, links, with_scale=with_scale)
    assert len(np.unique(placement.group)) == 1
    np.testing.assert_allclose(placement.scale, scale, rtol=2e-3)
    centers = np.array(
        [placement.apply(k, seen(k, middle[k : k + 1]))[0] for k in range(8)]
    )
    # 1 mm per place, 60 per link; turns about lever arms of 3 m carry it 20 m far.
    assert np.linalg.norm(centers - middle, axis=1).max() < 0.02


def test_maps_without_a_link_have_worlds_of_their_own(rng):
    places = rng.normal(size=(50, 3))
    noise = rng.normal(size=(50, 3))
    links = [Link(0, 1, places, places + [1.0, 0.0, 0.0]), Link(1, 2, places, noise)]
    placement = align_jointly(3, links, with_scale=False)
    assert placement.group[0] == placement.group[1] != placement.group[2]


class Survey:
    """A lawn-mower track over relief, and its features."""

    def __init__(
        self, work_dir: Path, num_lines: int, per_line: int, num_cameras: int = 2
    ) -> None:
        num_frames = num_lines * per_line
        rng = np.random.default_rng(0)
        poses = lawn_mower(num_lines, per_line, spacing=0.4, line_spacing=0.9)
        turn = rigid3.quat_from_rotvec(
            np.radians(4.0) * rng.normal(size=(num_frames, 3))
        )
        shift = rng.normal(size=(num_frames, 3)) * [0.05, 0.05, 0.25]
        poses = rigid3.compose(np.concatenate([turn, shift], axis=1), poses)
        self.simulated: SimulatedScene = simulate_scene(
            sample_rig(),
            poses,
            Relief(stddev=0.2, correlation_length=0.8),
            ObservationOptions(
                num_points=60 * num_frames,
                noise_px=0.4,
                detection_rate=0.6,
                max_range=5.0,
            ),
        )
        scene, self.rig = self.simulated.scene, nominal_rig(sample_rig())
        if num_cameras == 1:
            scene, _ = scene.select(scene.camera_idx == 0)
            alone = {"cam_from_rig": scene.cam_from_rig[:1]}
            scene = replace(scene, cameras=scene.cameras[:1], **alone)
            cameras = sample_rig().cameras[:1]  # one camera cannot tell its port
            self.rig = replace(self.rig, cameras=cameras, baseline_m=None, **alone)
        self.frames: Frames = frames_of(self.rig, num_frames, work_dir)
        self.work_dir = work_dir
        write_features(work_dir / "database.db", scene, self.frames, wrong=0.1)

    def start(
        self, submap_frames: int, num_threads: int = 1, progress: Progress = silent
    ) -> RefractiveStart:
        options = StartOptions(
            mapper="refractive",
            mapping=MappingOptions(submap_frames=submap_frames),
            num_threads=num_threads,
            scene_distance_m=2.0,
        )
        steps = Steps(self.work_dir)
        start = start_from_matches(self.rig, self.frames, steps, "", options, progress)
        assert isinstance(start, RefractiveStart)
        return start

    def refined(self, start: RefractiveStart) -> Refined:
        return refine_scene(start_scene(self.rig, start, start.arrays()), self.rig)


def stddevs_apart(one: Refined, two: Refined) -> float:
    """RMS difference of all poses but the first, in their standard deviations."""
    a, b = (r.scene.rig_from_world for r in (one, two))
    a, b = (rigid3.compose(p, rigid3.inverse(p[:1])) for p in (a, b))
    turn = rigid3.compose(a, rigid3.inverse(b))
    delta = np.column_stack([rigid3.rotvec_from_quat(turn[:, :4]), turn[:, 4:]])[1:]
    inverses = np.linalg.inv(one.calibration.covariance.frames[1:])
    return float(
        np.sqrt(np.mean(np.einsum("fi,fij,fj->f", delta, inverses, delta)) / 6)
    )


@pytest.mark.slow
def test_parts_become_the_map_of_the_single_run(tmp_path):
    survey = Survey(tmp_path, 3, 6)
    whole = survey.start(submap_frames=18)
    assert "submaps" not in whole.summary
    expected = survey.refined(whole)
    start = survey.start(submap_frames=10)
    assert len(start.summary["submaps"]["num_frames"]) >= 2
    assert start.summary["unregistered_frames"] == []
    found = survey.refined(start)
    # Another way to the same least squares: only tracks at the tolerance can differ.
    assert stddevs_apart(expected, found) < 0.1
    for mine, other, known in zip(
        found.scene.ports,
        expected.scene.ports,
        expected.calibration.covariance.cameras,
        strict=True,
    ):
        assert abs(mine.distance - other.distance) < 0.1 * known.distance_stddev_m
    _check_that_finished_parts_stay(survey)


def _check_that_finished_parts_stay(survey: Survey) -> None:
    """A run killed among its parts makes the missing ones only."""
    before = survey.start(submap_frames=10).arrays()
    submaps = sorted((survey.work_dir / "submaps").glob("???.npz"))
    submaps[1].unlink()
    stamps = [path.stat().st_mtime_ns for path in submaps if path.exists()]
    record = survey.work_dir / STEPS_FILE
    content = json.loads(record.read_text())
    content["steps"]["submaps"] = {**content["steps"]["submaps"], "finished": False}
    del content["steps"]["mapping"]
    record.write_text(json.dumps(content))
    after = survey.start(submap_frames=10).arrays()
    np.testing.assert_array_equal(after.rig_from_world, before.rig_from_world)
    kept = [path.stat().st_mtime_ns for k, path in enumerate(submaps) if k != 1]
    assert kept == stamps
    assert submaps[1].exists()


def test_a_part_needs_frames():
    with pytest.raises(InputError, match="submap_frames must be at least 10, got 2"):
        MappingOptions(submap_frames=2)


@pytest.mark.slow
def test_parts_of_one_camera_agree_but_for_a_scale(tmp_path):
    """Every part has a scale of its own; the whole has one, which nothing tells."""
    survey = Survey(tmp_path, 4, 12, num_cameras=1)
    expected = survey.refined(survey.start(submap_frames=48))
    start = survey.start(submap_frames=18)
    assert len(start.summary["submaps"]["num_frames"]) >= 3
    found = survey.refined(start)
    assert found.calibration.covariance.scale_stddev is None
    one, two = (
        rigid3.inverse(r.scene.rig_from_world)[:, 4:] for r in (expected, found)
    )
    assert len(one) == len(two) >= 47
    alignment = align(two, one, np.ones(len(one)), with_scale=True)
    # The same least squares: only tracks at the tolerance could differ.
    assert np.linalg.norm(alignment.apply(two) - one, axis=1).max() < 1e-4


@pytest.mark.slow
def test_a_killed_worker_costs_its_task_only(tmp_path):
    """Forty frames in parts on two workers, one of which is killed in the middle: the
    result is that of one process, to the last digit, and that of the single map."""
    survey = Survey(tmp_path, 3, 13)
    expected = survey.refined(survey.start(submap_frames=60))
    killed: list[int] = []

    def kill(step: str, done: int, total: int | None) -> None:
        """At the first part that is done, the other worker is in the middle of one."""
        if step == "submaps" and done == 1 and not killed:
            workers = [
                child
                for child in psutil.Process().children(recursive=True)
                if any("spawn_main" in word for word in child.cmdline())
            ]
            busy = max(workers, key=lambda child: child.cpu_percent(interval=0.1))
            busy.kill()
            killed.append(busy.pid)

    start = survey.start(submap_frames=15, num_threads=2, progress=kill)
    assert killed and len(start.summary["submaps"]["num_frames"]) >= 3
    found = survey.refined(start)
    assert stddevs_apart(expected, found) < 0.1
    (tmp_path / "alone").mkdir()
    alone = Survey(tmp_path / "alone", 3, 13).start(submap_frames=15)
    np.testing.assert_array_equal(
        alone.arrays().rig_from_world, start.arrays().rig_from_world
    )
