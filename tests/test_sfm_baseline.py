"""The rig from the length of its baseline: which frames, what it shows, how near."""

from dataclasses import replace

import numpy as np
import pytest

from uwsfm.geometry import rigid3
from uwsfm.sfm.frontend.background import opened
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.rig_checks import baseline
from uwsfm.sfm.rig_checks.baseline import STEP, connected_frames, rig_from_baseline
from uwsfm.sfm.simulated import frames_of, write_features
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """A stereo dive of 12 frames: its rig, images and database of matches."""
    folder, rig = tmp_path_factory.mktemp("survey"), sample_rig()
    scene = simulate_scene(
        rig,
        rich_motion(12),
        Relief(stddev=0.15, correlation_length=0.4),
        ObservationOptions(num_points=500, noise_px=0.3),
    ).scene
    frames = frames_of(rig, scene.num_frames, folder)
    write_features(folder / "database.db", scene, frames, wrong=0.1)
    return rig, frames, folder / "database.db"


def test_some_frames_are_enough_and_progress_goes_forward(
    survey, tmp_path, monkeypatch
):
    """Two thirds of the frames. Straight ports at the right distance: what is left are
    the tilts of 2 and 1 degrees, which turn the rig by as much at most."""
    rig, frames, database = survey
    monkeypatch.setattr(baseline, "MAX_MAPPED_FRAMES", 8)
    truth = np.asarray(rig.cam_from_rig)
    length = float(np.linalg.norm(truth[1, 4:]))
    unknown = replace(rig, cam_from_rig=None, baseline_m=length)
    shown: list[tuple[str, int, int | None]] = []
    poses = rig_from_baseline(
        database,
        tmp_path,
        frames,
        unknown,
        StartOptions(num_threads=1),
        lambda *report: shown.append(report),
    )
    turn = rigid3.rotation_angle(rigid3.compose(poses, rigid3.inverse(truth)))[1]
    assert np.degrees(turn) < 1.0
    centers = [rigid3.inverse(pose)[1, 4:] for pose in (poses, truth)]
    assert np.linalg.norm(centers[0]) == pytest.approx(length, rel=1e-9)
    assert np.linalg.norm(np.subtract(*centers)) < 0.03 * length
    steps = list(dict.fromkeys(step for step, _, _ in shown))
    assert steps == [f"{STEP}{name}" for name in ("verifying", "mapping", "adjusting")]
    for step in steps:  # one after the other, and each only forward
        rows = [k for k, report in enumerate(shown) if report[0] == step]
        assert rows == list(range(rows[0], rows[-1] + 1))
        counts = [done for name, done, _ in shown if name == step]
        assert counts == sorted(counts)
    assert shown[-2][1:] == (16, 16)  # images of 8 frames


def test_frames_that_match_each_other_and_in_themselves_are_chosen(survey):
    _, frames, path = survey
    assert connected_frames(path, frames, 12) is frames
    few = connected_frames(path, frames, 5)
    assert len(few.names) == 5 and set(few.names) < set(frames.names)
    assert list(few.names) == sorted(few.names)
    with opened(path) as database:
        names = {i.image_id: i.name for i in database.read_all_images()}
        ids = {name: i for i, name in names.items()}

        def ties(a: str, b: str) -> int:
            """Matches between all images of two frames."""
            found = 0
            for left in frames.folders:
                for right in frames.folders:
                    pair = ids[f"{left}/{a}"], ids[f"{right}/{b}"]
                    found += len(database.read_matches(*pair))
            return found

        best = max(
            ((a, b) for a in frames.names for b in frames.names if a < b),
            key=lambda pair: ties(*pair),
        )
    assert set(best) <= set(few.names)


def test_all_frames_are_used_if_some_do_not_suffice(survey, tmp_path, monkeypatch):
    """Of two frames no rig is taken, which three have to show."""
    rig, frames, database = survey
    monkeypatch.setattr(baseline, "MAX_MAPPED_FRAMES", 2)
    unknown = replace(rig, cam_from_rig=None, baseline_m=0.2)
    few = replace(frames, names=frames.names[:6])
    steps: dict[str, int | None] = {}
    poses = rig_from_baseline(
        database,
        tmp_path,
        few,
        unknown,
        StartOptions(num_threads=1),
        lambda step, done, total: steps.update({step: total}),
    )
    assert np.linalg.norm(rigid3.inverse(poses)[1, 4:]) == pytest.approx(0.2)
    assert steps["rig from baseline_m, all frames: mapping"] == 12
    assert list(steps)[0] == f"{STEP}verifying"
