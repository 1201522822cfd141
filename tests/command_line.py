"""The command line in a process of its own, and how its mistakes must end."""

import subprocess
import sys
from pathlib import Path


def run(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """The command line as a user starts it."""
    return subprocess.run(
        [sys.executable, "-c", "from uwsfm.cli.app import main; main()", *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        check=False,
    )


def one_sentence(found: subprocess.CompletedProcess[str], *parts: str) -> None:
    """It failed, and told why in one line that has all the parts."""
    assert found.returncode != 0, found.stdout
    lines = [line for line in found.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == 1, found.stderr
    assert "Traceback" not in found.stderr
    for part in parts:
        assert part in lines[0], lines[0]
