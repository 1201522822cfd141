"""The cache of kernels: several processes, homes that cannot be written, no rest."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

# Compiles one small kernel; says where it is kept, and whether it was there already.
SMALL = """
from uwsfm._jit import CACHE_DIR
from uwsfm.geometry.unit_vector import tangents
assert tangents(0.0, 0.0, 1.0)[0] == 1.0
print(CACHE_DIR, sum(tangents.stats.cache_hits.values()))
"""

# What a reconstruction of the sample's kind compiles after the first run's jobs.
LEFT = """
import sys
from pathlib import Path
from numba.core import event
from uwsfm import first_run

assert first_run.compile_kernels(2, lambda *args: print(*args)) > 1.0
assert first_run.compile_kernels() == 0.0

class Listener(event.Listener):
    def on_start(self, found):
        print("compiled again:", found.data["dispatcher"].py_func.__qualname__)
    def on_end(self, found):
        pass

event.register("numba:compile", Listener())
for job in first_run.JOBS.values():
    job()
"""


def start(code: str, **environment: str) -> subprocess.Popen[str]:
    inherited = {k: v for k, v in os.environ.items() if k != "XDG_CACHE_HOME"}
    inherited.pop("UWSFM_CACHE_DIR", None)
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env={**inherited, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def output(process: subprocess.Popen[str]) -> str:
    text, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    return text


def test_processes_that_start_cold_together_share_one_cache(tmp_path):
    together = [start(SMALL, UWSFM_CACHE_DIR=str(tmp_path)) for _ in range(3)]
    folders = {output(process).split()[0] for process in together}
    assert len(folders) == 1
    assert Path(folders.pop()).is_relative_to(tmp_path)
    later = output(start(SMALL, UWSFM_CACHE_DIR=str(tmp_path)))
    assert later.split()[1] == "1"


@pytest.mark.skipif(sys.platform == "win32", reason="homes are named otherwise")
def test_a_home_that_cannot_be_written_moves_the_cache(tmp_path):
    """A home below a file: even root cannot create it."""
    home = tmp_path / "file"
    home.write_text("")
    elsewhere = tmp_path / "temporary"
    elsewhere.mkdir()
    for hits in ("0", "1"):
        text = output(start(SMALL, HOME=str(home / "me"), TMPDIR=str(elsewhere)))
        folder, found = text.split()
        assert Path(folder).is_relative_to(elsewhere)
        assert found == hits


@pytest.mark.slow
def test_the_first_run_leaves_nothing_to_compile(tmp_path):
    text = output(start(LEFT, UWSFM_CACHE_DIR=str(tmp_path)))
    assert "first run only" in text
    assert "compiled again" not in text
