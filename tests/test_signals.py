"""SIGTERM: one sentence, and nothing half-written."""

import json
import shutil
import subprocess
import sys

import pytest

from uwsfm._base.signals import STOPPING

STOPPED = """
import os, signal, sys, time
import typer
from uwsfm.cli import app as cli

@cli.app.command()
def wait():
    from uwsfm.cli.console import ProgressBars
    with ProgressBars():
        try:
            os.kill(os.getpid(), getattr(signal, name))
            time.sleep(60)
        except KeyboardInterrupt as stopped:
            if form == "bare":
                raise
            raise SystemError("returned a result with an exception set") from stopped

name, form = sys.argv[1:]
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may ignore it
sys.argv[1:] = ["wait"]
cli.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="it has no SIGTERM")
@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGINT", 130)])
@pytest.mark.parametrize("form", ["bare", "wrapped"])
def test_signals_end_in_the_sentence_of_an_interrupted_run(name, code, form):
    """Not in a stack dump, which pycolmap's logging would print; nor in the error that
    numba and pybind11 make of an exception that comes up in them."""
    found = subprocess.run(
        [sys.executable, "-c", STOPPED, name, form],
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == code
    assert found.stderr == "interrupted; the same command resumes the run\n"


SLOW = """
import os, signal, sys, time
from concurrent.futures import ThreadPoolExecutor
from uwsfm.cli import app as cli

@cli.app.command()
def wait():
    from uwsfm.cli.console import ProgressBars
    with ProgressBars(), ThreadPoolExecutor(1) as pool:
        pool.submit(time.sleep, 2)
        os.kill(os.getpid(), getattr(signal, name))
        time.sleep(60)

(name,) = sys.argv[1:]
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may ignore it
sys.argv[1:] = ["wait"]
cli.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="it has no SIGTERM")
@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGINT", 130)])
def test_a_slow_end_is_announced(name, code):
    """Threads of pycolmap end between two images: whoever waits should know."""
    found = subprocess.run(
        [sys.executable, "-c", SLOW, name], capture_output=True, text=True, check=False
    )
    sentences = [STOPPING, "interrupted; the same command resumes the run"]
    assert (found.returncode, found.stderr.splitlines()) == (code, sentences)


STOPPED_WRITING = """
import json, os, signal, sys
from typer.testing import CliRunner
from uwsfm._base.partial import PARTIAL
from uwsfm.cli.app import app

def stop(event, arguments):
    if event == "open" and PARTIAL in str(arguments[0]):
        os.kill(os.getpid(), signal.SIGTERM)

sys.addaudithook(stop)
for line in sys.stdin:
    found = CliRunner().invoke(app, json.loads(line))
    print(found.exit_code, found.output, end="")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="it has no SIGTERM")
def test_commands_that_are_stopped_while_they_write_leave_nothing(
    dive_result, tmp_path
):
    """The signal comes when the first of their files is opened."""
    pytest.importorskip("tifffile")
    out = tmp_path / "out"
    shutil.copytree(dive_result.out, out)
    distance = ("--from", "1", "--to", "2")
    commands = [
        ("clean", out, "-o", out / "good.ply"),
        ("map", out, "-o", out / "map"),
        ("measure", out, *distance, "-o", out / "measured.json"),
        ("report", out),
        ("export", out, "--to", "ply", "-o", out / "scene.ply"),
    ]
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    del before[out]  # where files were, for a moment
    found = subprocess.run(
        [sys.executable, "-c", STOPPED_WRITING],
        input="".join(json.dumps([str(w) for w in words]) + "\n" for words in commands),
        capture_output=True,
        text=True,
        check=False,
    )
    sentence = "130 interrupted; nothing was written\n"
    assert (found.stdout, found.stderr) == (len(commands) * sentence, "")
    after = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    del after[out]
    assert after == before
