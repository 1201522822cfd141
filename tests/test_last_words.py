"""What no module foresaw: one sentence, a log, and the traceback on request."""

import subprocess
import sys

import pytest

from uwsfm._base.last_words import is_out_of_memory, unexpected

FAULT = """
import sys
import uwsfm._base.files
from uwsfm.cli import app as cli
def broken(*_, **__):
    raise {error}
uwsfm._base.files.replaced_file = broken
sys.argv = ["uwsfm", {options} "init", "r.yaml"]
cli.main()
"""


def ended(tmp_path, error: str, options: str = "") -> subprocess.CompletedProcess[str]:
    code = FAULT.format(error=error, options=options)
    return subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={**__import__("os").environ, "TMPDIR": str(tmp_path)},
        check=False,
    )


def test_a_fault_is_one_sentence_with_its_log(tmp_path):
    found = ended(tmp_path, "LookupError('the 7th of 6')")
    assert found.returncode == 1 and "Traceback" not in found.stderr
    (log,) = tmp_path.glob("uwsfm-fault-*.log")
    assert found.stderr == (
        "error: unexpected fault of uwsfm (LookupError: the 7th of 6); please report "
        f"it to its authors, with {log}\n"
    )
    text = log.read_text()
    assert "Traceback" in text and "in broken" in text and "command: uwsfm" in text


def test_the_traceback_is_shown_on_request(tmp_path):
    found = ended(tmp_path, "LookupError('the 7th of 6')", '"--debug",')
    assert found.returncode == 1
    assert "Traceback" in found.stderr and "in broken" in found.stderr
    assert found.stderr.splitlines()[-1].startswith("error: unexpected fault")


@pytest.mark.parametrize(
    "error",
    [
        "MemoryError()",
        "RuntimeError('std::bad_alloc')",
        "OSError(12, 'Cannot allocate memory')",
        "ImportError('libx.so: failed to map segment from shared object')",
        'RuntimeError("can\'t start new thread")',
    ],
)
def test_a_lack_of_memory_is_named(error):
    assert is_out_of_memory(eval(error))
    try:
        try:
            raise eval(error)
        except Exception as cause:
            raise ValueError("of a wrapper") from cause
    except ValueError as wrapped:
        assert is_out_of_memory(wrapped)


def test_no_other_error_is_a_lack_of_memory():
    assert not is_out_of_memory(ValueError("shape (3,) of memory map"))
    assert not is_out_of_memory(OSError(28, "No space left on device"))


def test_without_a_place_for_the_log_the_sentence_stands(monkeypatch, tmp_path):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    text = unexpected(ValueError("a\nb"), "1.0")
    assert "(ValueError: a)" in text and "uwsfm --debug" in text
