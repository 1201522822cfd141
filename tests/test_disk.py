"""Full disks: found before the work where that is possible, told in one sentence."""

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import one_sentence
from hostile import small_model

from uwsfm._base.disk import DiskFullError, explained, is_full, require_room, room
from uwsfm._base.files import replaced_dir
from uwsfm._base.partial import PARTIAL
from uwsfm.colmap.model import write_model
from uwsfm.errors import InputError
from uwsfm.jobs.demo import sample_dir
from uwsfm.sfm.frontend.image_features import scratch_bytes
from uwsfm.sfm.options import FeatureOptions

FULL = OSError(errno.ENOSPC, "No space left on device")


def test_room_is_that_of_the_nearest_folder_there_is(tmp_path):
    there = os.statvfs(tmp_path)
    free = there.f_bavail * there.f_frsize
    # Others write to the disk meanwhile.
    assert abs(room(tmp_path / "not" / "yet") - free) < 0.05 * free + 1e8
    require_room(tmp_path, 1.0, "a byte")
    with pytest.raises(DiskFullError) as error:
        require_room(tmp_path / "out", 1e18, "finding features")
    text = str(error.value)
    assert "\n" not in text
    assert text.startswith(f"the disk of {tmp_path / 'out'} is full: finding features")
    assert "takes 1000000000.0 GB more" in text and "run the same command again" in text


def test_the_place_of_a_result_is_named_and_not_its_half_written_twin(tmp_path):
    with (
        pytest.raises(DiskFullError, match=rf"the disk of {tmp_path} is full"),
        replaced_dir(tmp_path / "sparse") as partial,
    ):
        require_room(partial / "0", 1e18, "writing the model")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "full"),
    [
        (FULL, True),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), True),
        (OSError(errno.EFBIG, "File too large"), True),
        (RuntimeError("SQLite error: database or disk is full"), True),
        (PermissionError(errno.EACCES, "Permission denied"), False),
        (ValueError("full of errors"), False),
    ],
)
def test_what_a_full_disk_does_is_told_apart(error, full, tmp_path):
    assert is_full(error) == full
    try:
        raise KeyError("later") from error
    except KeyError as later:
        assert is_full(later) == full
    with pytest.raises(DiskFullError if full else type(error)), explained(tmp_path):
        raise error


def test_the_file_that_cannot_be_written_is_named_where_it_is_known(tmp_path):
    named = OSError(errno.ENOSPC, "No space left on device", str(tmp_path / "a.npy"))
    for error, path in ((named, tmp_path / "a.npy"), (FULL, tmp_path)):
        words = f"the disk is full: {path} cannot be written; make room"
        with pytest.raises(DiskFullError, match=words), explained(tmp_path):
            raise error
    with pytest.raises(InputError, match="mine"), explained(tmp_path):
        raise InputError("mine")


def test_scratch_holds_images_masks_and_a_database_twice():
    """By hand: 2 images of 100 x 50 px with at most 1000 features of 155 bytes."""
    options = FeatureOptions(max_num_features=1000)
    expected = 2 * (100 * 50 + 2 * 1000 * 155)
    assert scratch_bytes((100, 50), 2, options) == expected


LIMITED = """
import resource, sys
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
sys.argv[1:2] = []
"""
posix = pytest.mark.skipif(sys.platform == "win32", reason="it has no such limits")


def limited(code: str, limit: int, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Python code whose files may have so many bytes, as on a full disk."""
    return subprocess.run(
        [sys.executable, "-c", LIMITED + code, str(limit), *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


WRITE = """
from pathlib import Path
from uwsfm.errors import UwsfmError
import pycolmap
from uwsfm.colmap.model import write_model
out = Path(sys.argv[2])
out.mkdir()
try:
    write_model(pycolmap.Reconstruction(sys.argv[1]), out)
except UwsfmError as error:
    print(error)
"""


@posix
def test_colmap_never_writes_a_part_of_a_model_in_silence(tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    whole.mkdir()
    write_model(small_model(), whole)
    found = limited(WRITE, 1000, str(whole), str(cut))
    assert found.stdout.startswith(f"the disk of {cut} is full: writing the model")
    assert list(cut.iterdir()) == []


@posix
def test_a_disk_that_is_full_from_the_start_ends_in_one_sentence(tmp_path):
    """Features of the sample take more than the limit, and COLMAP would abort."""
    out = tmp_path / "out"
    paths = [str(sample_dir() / "rig.yaml"), str(sample_dir() / "images")]
    code = "from uwsfm.cli.app import main; main()"
    found = limited(code, 3_000_000, "reconstruct", *paths, "-o", str(out))
    one_sentence(found, f"the disk of {out / 'uwsfm-work'} is full: finding features")
    assert [path for path in Path(out).rglob(f"{PARTIAL}*")] == []
