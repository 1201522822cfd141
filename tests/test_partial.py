"""What killed processes leave goes with the next run, and nothing else does."""

import os
import signal
import subprocess
import sys
import tempfile

from uwsfm._base import partial as _partial
from uwsfm._base.files import replaced_dir, replaced_file
from uwsfm._base.partial import PARTIAL, partial_prefix, remove_stale, scratch_folder
from uwsfm.jobs.output_folder import locked

KILLED = """
import os, sys
from pathlib import Path
from uwsfm._base.files import replaced_dir, replaced_file
from uwsfm._base.partial import scratch_folder
out = Path(sys.argv[1])
with (
    replaced_file(out / "deep" / "a.txt") as a,
    replaced_dir(out / "b") as b,
    scratch_folder() as c,
):
    for path in (a, b / "x", c / "y"):
        path.write_text("half")
    print("there", flush=True)
    sys.stdin.read()
"""


def test_a_killed_process_leaves_nothing_for_longer_than_to_the_next_run(
    tmp_path, monkeypatch
):
    temporary, out = tmp_path / "tmp", tmp_path / "out"
    temporary.mkdir()
    child = subprocess.Popen(
        [sys.executable, "-c", KILLED, str(out)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "TMPDIR": str(temporary)},
    )
    assert child.stdout is not None and child.stdout.readline() == b"there\n"
    remove_stale(out, deep=True)  # of a process that is alive
    assert len(list(out.rglob(f"{PARTIAL}*"))) == 2
    child.send_signal(signal.SIGKILL)
    child.wait(timeout=10)
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    _partial._clean_temporary.cache_clear()
    with locked(out), scratch_folder() as mine:
        assert list(out.rglob(f"{PARTIAL}*")) == []
        assert list(temporary.iterdir()) == [mine]
    assert list(temporary.iterdir()) == []


def test_only_what_is_left_over_is_removed(tmp_path):
    mine = tmp_path / f"{partial_prefix()}x"
    before_me = f"{PARTIAL}{_partial._HOST}-{os.getpid()}-00000000-x"  # a reused number
    elsewhere = f"{PARTIAL}deadbeef-1-00000000-x"
    old_version = f"{PARTIAL}abc123"
    for path in (mine, *map(tmp_path.joinpath, (before_me, elsewhere, old_version))):
        path.write_text("half")
    (tmp_path / "mine.txt").write_text("mine")
    remove_stale(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        [mine.name, elsewhere, "mine.txt"]
    )
    long_ago = _partial.ABANDONED_SECONDS + 60.0
    status = (tmp_path / elsewhere).stat()
    os.utime(tmp_path / elsewhere, (status.st_atime, status.st_mtime - long_ago))
    remove_stale(tmp_path)
    assert not (tmp_path / elsewhere).exists()


def test_a_link_is_removed_and_not_what_it_leads_to(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "kept").write_text("mine")
    (tmp_path / f"{PARTIAL}link").symlink_to(tmp_path / "real")
    remove_stale(tmp_path)
    assert (tmp_path / "real" / "kept").exists()
    assert not (tmp_path / f"{PARTIAL}link").is_symlink()


def test_writers_name_themselves(tmp_path):
    with replaced_file(tmp_path / "a.txt") as a, replaced_dir(tmp_path / "b") as b:
        assert all(path.name.startswith(partial_prefix()) for path in (a, b))
