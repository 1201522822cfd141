"""Planted faults: what the script changes, and that it tells killed from survived."""

import subprocess
import sys
from pathlib import Path

import pytest

FAULTS = Path(__file__).parents[1] / "pipelines" / "faults"
sys.path.insert(0, str(FAULTS))
from edits import chosen, faults  # noqa: E402

SOURCE = '''
def length(camera, own, total):
    """Docstrings are left alone: 1.5 mm."""
    if camera.a_stddev is not None and own < 2.5:
        own = 1e3 * camera["value_m"] + camera["value_mm"]
    return f"{1e3 * own:.2f} mm", max(own, total), camera.b_stddev
'''


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("operator", "1000.0 / camera['value_m'] + camera['value_mm']"),
        ("operator", "1000.0 * camera['value_m'] - camera['value_mm']"),
        ("left out", "own = camera['value_m'] + camera['value_mm']"),
        ("left out", "if camera.a_stddev is not None:"),
        ("comparison", "own <= 2.5"),
        ("comparison", "own >= 2.5"),
        ("comparison", "camera.a_stddev is None and"),
        ("and, or", "is not None or own < 2.5"),
        ("constant", "own < 25.0"),
        ("constant", "own < 0.25"),
        ("constant", "f'{10000.0 * own:.2f} mm'"),
        ("left out", "f'{own:.2f} mm'"),
        ("unit", "f'{1000.0 * own:.2f} m'"),
        ("exchanged", "camera['value_mm'] + camera['value_mm']"),
        ("exchanged", "min(own, total)"),
        ("exchanged", "camera.a_stddev)"),
        ("condition", "if not (camera.a_stddev is not None and own < 2.5):"),
    ],
)
def test_a_kind_of_fault_is_planted(kind, words):
    found = [(fault, text) for fault, text in faults("m.py", SOURCE)]
    after = [text for fault, text in found if fault.kind == kind and words in text]
    assert len(after) == 1
    assert all("Docstrings are left alone: 1.5 mm." in text for _, text in found)
    for fault, text in found:
        assert fault.before != fault.after and 3 <= fault.line <= 6
        assert text.count("\n") == 4  # one line is another one


def test_the_same_seed_plants_the_same_faults():
    first = [fault for fault, _ in chosen("m.py", SOURCE, 8, 5)]
    assert first == [fault for fault, _ in chosen("m.py", SOURCE, 8, 5)]
    assert first != [fault for fault, _ in chosen("m.py", SOURCE, 8, 6)]
    assert len(first) == 8 == len({(fault.line, fault.kind) for fault in first})
    assert chosen("m.py", SOURCE, 8, 5, only=("other",)) == []


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(sys, "getdlopenflags"), reason="POSIX: it forks")
def test_faults_of_a_small_module_are_killed(tmp_path):
    """A minute: kernels are compiled for the copy."""
    command = [sys.executable, FAULTS / "mutants.py", "--work", tmp_path / "work"]
    command += ["--count", "4", "--group", "summary", "--module", "surface/units.py"]
    for _ in range(2):  # the second time it knows what became of them
        done = subprocess.run(
            [str(word) for word in command], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert "| summary | surface/units.py | 4 | 0 | 0 | 100% |" in done.stdout
    lines = (tmp_path / "work" / "results.jsonl").read_text().splitlines()
    assert len(lines) == 4
