"""The speed study: every section runs, whatever the times are."""

import importlib
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import pytest

from uwsfm.models.lens import SUPPORTED_MODELS

pytest.importorskip("matplotlib")

FOLDER = Path(__file__).parent.parent / "pipelines" / "bench"
STAGES = 7  # of an iteration of the solver


def numbers(value):
    """All numbers of a JSON tree, with their paths."""
    if isinstance(value, dict):
        value = list(value.items())
    elif isinstance(value, list):
        value = list(enumerate(value))
    else:
        if isinstance(value, int | float) and not isinstance(value, bool):
            yield "", float(value)
        return
    for key, part in value:
        for path, number in numbers(part):
            yield f"{key}/{path}", number


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    paths = os.pathsep.join([str(FOLDER.parent.parent), *sys.path])
    subprocess.run(
        [sys.executable, FOLDER / "pipeline.py", "-o", folder, "--small"],
        env={**os.environ, "PYTHONPATH": paths},
        check=True,
    )
    return folder


@pytest.fixture(scope="module")
def results(out):
    return json.loads((out / "bench.json").read_text())


def test_every_number_is_positive(results):
    # Differences of clocks and errors of the solution have either sign.
    signed = ("distance_error_mm", "stages_", "others_cores", "compiled")
    for path, number in numbers(results):
        assert math.isfinite(number), path
        assert number > 0.0 or any(name in path for name in signed), path


def test_every_stage_of_every_kernel_was_measured(results):
    rows = results["kernels"]["rows"]
    lanes = [row for row in rows if row["kind"] == "lanes"]
    assert {row["port"] for row in lanes} >= {"flat", "none"}
    assert {row["lens"] for row in lanes} == set(SUPPORTED_MODELS)
    assert all(len(row["ns"]) == 5 for row in rows if row["kind"] != "numpy")


def test_stages_make_up_the_iteration(results):
    solved = [found for name, found in results.items() if name.startswith("solver-")]
    assert len(solved) == 2
    for found in solved:
        assert found["stop"] == "converged"
        # At the optimum: the noise, less what the unknowns take up of it.
        assert 0.8 < found["rms_px"] / found["noise_rms_px"] < 1.0
        assert found["peak_mb"] >= found["peak_before_mb"]
        for times in (found["one_thread"], found["two_threads"]):
            for clock in ("cpu_s", "wall_s"):
                stages = times[f"stages_{clock}"]
                assert len(stages) == STAGES
                assert sum(stages.values()) == pytest.approx(times[clock])


def test_peers_reach_the_same_optimum(results):
    peer, ours = results["colmap-12"], results["solver-12"]
    assert peer["rms_px"] == pytest.approx(ours["rms_px"], rel=0.05)  # one noise, drawn
    assert results["scipy-12"]["us_per_observation"] > 0.0


def test_files_are_written(out):
    text = (out / "results.md").read_text()
    assert "Not measured here, so without their rows: solver-100, " in text
    for title in ("Targets", "Kernels", "Solver", "Peers"):
        assert f"## {title}" in text
    for picture in ("kernels.png", "solver.png", "memory.png"):
        assert picture in text
        assert 5_000 < (out / picture).stat().st_size < 150_000


@pytest.mark.slow
def test_python_s_share_is_a_part_of_the_whole(monkeypatch):
    monkeypatch.syspath_prepend(FOLDER)
    child = importlib.import_module("child")
    found = child.call("python_share", "measure", num_threads=2, num_frames=3)
    assert 0.0 < found["imports_s"] < found["python_s"]
    assert 0.0 < found["kernels_s"] < found["cpu_s"] - found["python_s"]
    # SIFT and its matches, which pycolmap finds in threads of ours and its own.
    assert found["python_s"] < 0.5 * found["cpu_s"]
