"""A small part of pipelines/faults/kills.py, and that it would see what it is for."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from uwsfm._base.partial import PARTIAL

FOLDER = Path(__file__).parent.parent / "pipelines" / "faults"
sys.path.insert(0, str(FOLDER))
if sys.platform != "win32":
    import kills
    from full_disk import MOMENTS, filled_at
    from small_dives import left_over, results

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="SIGKILL is POSIX")


def write_result(folder: Path, *, seconds: float = 1.0, points: int = 3) -> Path:
    """A result with times in it, and what counts."""
    folder.mkdir()
    about = json.dumps({"summary": {"solve_s": seconds, "cost": 2.0}})
    np.savez(folder / "calibration.npz", about=about, values=np.arange(points))
    summary = {"timings_s": {"features": seconds}, "num_points": 3}
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "points.ply").write_bytes(bytes(3))
    (folder / "uwsfm.log").write_text(f"{seconds}")
    return folder


def test_results_are_the_same_whatever_time_they_took(tmp_path):
    first = results(write_result(tmp_path / "a"))
    assert first == results(write_result(tmp_path / "b", seconds=7.0))
    assert set(first) == {"calibration.npz", "summary.json", "points.ply"}


def test_other_results_are_seen(tmp_path):
    first = results(write_result(tmp_path / "a"))
    other = results(write_result(tmp_path / "b", points=4))
    assert {n for n in first if first[n] != other[n]} == {"calibration.npz"}
    (tmp_path / "b" / "points.ply").write_bytes(b"\0\0\1")
    assert results(tmp_path / "b")["points.ply"] != first["points.ply"]
    (tmp_path / "b" / "points.ply").unlink()
    assert results(tmp_path / "b").keys() != first.keys()
    (tmp_path / "b" / f"{PARTIAL}x").touch()
    assert left_over(tmp_path) == [tmp_path / "b" / f"{PARTIAL}x"]


@pytest.mark.slow
def test_a_killed_run_and_a_full_disk_end_in_the_same_bytes(tmp_path):
    kills.write_inputs(tmp_path / "inputs")
    job = kills.jobs(tmp_path / "inputs")["reconstruct"]
    expected, seconds = kills.undisturbed(job, tmp_path / "trial")
    counts, words = kills.trial(job, tmp_path / "trial", 0.5 * seconds, expected)
    assert counts == {"kills": 1, "same": 1}, words
    found = filled_at(MOMENTS[0], tmp_path / "inputs" / "dive", tmp_path / "d", results)
    assert found.one_sentence, found.message
    assert found.results == expected
    assert found.left_over == []
