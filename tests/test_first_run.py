"""The cache of kernels: several processes, homes that cannot be written, no rest."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import uwsfm

# Compiles one small kernel; says where it is kept, and whether it was there already.
SMALL = """
from uwsfm._base.jit import CACHE_DIR
from uwsfm.geometry.unit_vector import tangents
assert tangents(0.0, 0.0, 1.0)[0] == 1.0
print(CACHE_DIR, sum(tangents.stats.cache_hits.values()))
"""

# Projects through a port, by kernels whose sums may be regrouped.
DIGITS = """
from hashlib import sha256
import numpy as np
from uwsfm.simulate.rigs import sample_rig

points = np.random.default_rng(0).uniform((-0.6, -0.4, 0.4), (0.6, 0.4, 3.0), (1000, 3))
xy, _ = sample_rig().refractive_cameras()[0].img_from_point(points)
print(sha256(xy.tobytes()).hexdigest())
"""

# What the commands compile after the first run's jobs, which are of simulated features:
# a few images of the sample, mapped and refined.
LEFT = """
import sys
from pathlib import Path
import uwsfm
from uwsfm.jobs import compile_kernels as first_run
from uwsfm._base.jit import CACHE_DIR
from uwsfm.jobs.demo import sample_dir

def kept():
    return {path.name for path in CACHE_DIR.rglob("*.nbc")}

assert first_run.compile_kernels(2, lambda *args: print(*args)) > 1.0
assert first_run.compile_kernels() == 0.0
before, out = kept(), Path(sys.argv[1])
assert len(before) > 100
for side in ("left", "right"):
    (out / side).mkdir(parents=True)
    for image in sorted((sample_dir() / "images" / side).iterdir())[:5]:
        (out / side / image.name).symlink_to(image)
rig = sample_dir() / "rig.yaml"
uwsfm.reconstruct(rig, out, out / "found")
uwsfm.refine_model(out / "found" / "sparse", rig, out / "refined")
uwsfm.reconstruct(rig, out, out / "found", mapper="pinhole")
print("compiled again:", *(kept() - before))
"""


def start(code: str, *arguments: str, **environment: str) -> subprocess.Popen[str]:
    inherited = {k: v for k, v in os.environ.items() if k != "XDG_CACHE_HOME"}
    inherited.pop("UWSFM_CACHE_DIR", None)
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        env={**inherited, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def output(process: subprocess.Popen[str]) -> str:
    text, errors = process.communicate(timeout=600)
    assert process.returncode == 0, errors
    return text


def test_processes_that_start_cold_together_share_one_cache(tmp_path):
    together = [start(SMALL, UWSFM_CACHE_DIR=str(tmp_path)) for _ in range(3)]
    folders = {output(process).split()[0] for process in together}
    assert len(folders) == 1
    assert Path(folders.pop()).is_relative_to(tmp_path)
    later = output(start(SMALL, UWSFM_CACHE_DIR=str(tmp_path)))
    assert later.split()[1] == "1"


def test_a_process_that_compiles_computes_the_digits_of_one_that_loads(tmp_path):
    runs = [output(start(DIGITS, UWSFM_CACHE_DIR=str(tmp_path))) for _ in range(2)]
    assert runs[0] == runs[1]


def test_another_installation_keeps_kernels_of_its_own(tmp_path):
    """Numba would not take those of the first, though nothing differs but the place."""
    package = Path(uwsfm.__file__).parent
    shutil.copytree(package, tmp_path / "other" / "uwsfm", copy_function=shutil.copy2)
    code = "import sys; sys.path.insert(0, sys.argv[1]); from uwsfm._base import jit;"
    code += "print(jit.CACHE_DIR)"
    places = [str(package.parent), str(tmp_path / "other")]
    runs = [start(code, place, UWSFM_CACHE_DIR=str(tmp_path)) for place in places]
    assert len({output(run) for run in runs}) == 2


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


def test_a_chosen_cache_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    process = start("import uwsfm._base.jit", UWSFM_CACHE_DIR=str(tmp_path / "file"))
    errors = process.communicate(timeout=60)[1]
    assert process.returncode != 0
    assert f"UWSFM_CACHE_DIR: cannot write to {tmp_path / 'file'}" in errors


@pytest.mark.slow
def test_the_first_run_leaves_nothing_to_compile(tmp_path):
    images, cache = str(tmp_path / "images"), str(tmp_path / "cache")
    text = output(start(LEFT, images, UWSFM_CACHE_DIR=cache))
    assert "first run only" in text
    assert text.split("compiled again:")[1].strip() == ""


# What an installed command does first, from the folder of its script.
INSTALLED = """
from uwsfm.jobs.compile_kernels import compile_kernels
from uwsfm._base import jit
assert compile_kernels(2) > 1.0
print(jit.__file__, jit.CACHE_DIR)
"""


@pytest.mark.slow
def test_the_source_folder_as_working_folder_changes_nothing(tmp_path):
    """README's first command: install a copy, and run it where the source lies.

    Compiled by the source, kernels would be kept under its key, and compiled again.
    """
    package = Path(uwsfm.__file__).resolve().parent
    installed = tmp_path / "site"
    shutil.copytree(package, installed / "uwsfm", copy_function=shutil.copy2)
    script = installed / "script.py"
    script.write_text(INSTALLED)
    paths = os.pathsep.join(
        p for p in sys.path if p and Path(p).resolve() != package.parent
    )
    found = subprocess.run(
        [sys.executable, script],
        env={**os.environ, "PYTHONPATH": paths, "UWSFM_CACHE_DIR": str(tmp_path / "c")},
        cwd=package.parent,
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr
    file, cache = found.stdout.split()
    assert Path(file).is_relative_to(installed)
    assert list(Path(cache).parent.iterdir()) == [Path(cache)]
    assert len(list(Path(cache).rglob("*.nbc"))) > 100  # as in the test above
