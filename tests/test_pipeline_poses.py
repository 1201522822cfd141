"""The study of absolute and relative poses: every method, from few runs."""

import sys
from pathlib import Path

import numpy as np
import pytest

PIPELINES = Path(__file__).parent.parent / "pipelines"


@pytest.fixture(autouse=True)
def modules(monkeypatch):
    """The study's modules are found beside its script only."""
    before = set(sys.modules)
    for folder in ("paper", "rsfm"):
        monkeypatch.syspath_prepend(str(PIPELINES / folder))
    yield
    for name in set(sys.modules) - before:
        origin = getattr(sys.modules[name], "__file__", None) or ""
        if PIPELINES in Path(origin).parents:
            del sys.modules[name]


@pytest.mark.parametrize("port", ["flat", "dome"])
def test_trials_hold_what_they_say(port):
    """Right matches meet their points to the noise, and wrong ones do not."""
    from pose_trials import absolute_trial, relative_trial

    from uwsfm.geometry import rigid3
    from uwsfm.sfm.poses.epipolar import ray_gaps_px

    trial = absolute_trial(port, 0.5, 3)
    in_cam = rigid3.transform(trial.cam_from_world, trial.points)
    errors = trial.camera.img_from_point(in_cam)[0] - trial.xy
    assert np.count_nonzero(trial.right) == 140
    # Of 280 numbers: 4 %.
    assert np.std(errors[trial.right]) == pytest.approx(0.5, rel=0.2)
    assert np.median(np.abs(errors[~trial.right])) > 50.0
    pair = relative_trial(port, 0.5, 3)
    camera = pair.camera
    gaps = ray_gaps_px(camera, camera, pair.b_from_a, pair.xy_a, pair.xy_b)
    assert np.sqrt(np.mean(gaps[pair.right] ** 2)) == pytest.approx(0.5, rel=0.25)


def test_every_line_of_both_tables(tmp_path, monkeypatch):
    import poses

    monkeypatch.setattr(poses, "NOISES_PX", (0.0, 0.5))
    command = ["poses.py", "-o", str(tmp_path), "--absolute", "8", "--relative", "4"]
    monkeypatch.setattr(sys, "argv", command)
    poses.main()
    from tables import read_csv, select

    second = {"absolute_pose": "position_mm", "relative_pose": "direction_deg"}
    for name, column in second.items():
        rows = read_csv(tmp_path / f"{name}.csv")
        for port in poses.PORTS:
            lines = {
                noise: {r["method"]: r for r in select(rows, port=port, noise_px=noise)}
                for noise in poses.NOISES_PX
            }
            ours, pinhole = (
                lines[0.0][method] for method in ("uwsfm", "best-fit pinhole")
            )
            # Exact without noise, where a pinhole never is.
            assert ours["rotation_deg"] < 1e-6 and ours[column] < 1e-6
            assert pinhole["rotation_deg"] > 1e-5 and pinhole[column] > 1e-3
            assert all(row["lost"] in (0.0, None) for row in rows)
            # Medians of 8 and 4 runs against that of the bound: within their scatter.
            told = "uwsfm" if name == "absolute_pose" else "uwsfm, distance told"
            ratio = lines[0.5][told][column] / lines[0.5]["bound"][column]
            assert 0.3 < ratio < 2.5
    text = (tmp_path / "poses.md").read_text(encoding="utf-8")
    assert "Refractive COLMAP" in text and text.count("| bound |") == 8
