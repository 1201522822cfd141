"""What may be skipped where all is installed: tests of images that are not here."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
SCRIPT = TESTS.parent / ".ci" / "skipped.py"

NO_DATA = "SKIPPED [5] tests/test_uril_tank.py:40: no images in x; set UWSFM_DATA\n"
NO_BROWSER = "SKIPPED [3] tests/test_report_page.py:37: no Chromium is installed\n"
REST = "tests/a.py ss. [100%]\n1 passed, 8 skipped in 2.0s\n"


@pytest.mark.parametrize(
    ("output", "code", "total"),
    [
        (REST, 0, "0 skipped, 0 not for real data"),
        (NO_DATA + REST, 0, "5 skipped, 0 not for real data"),
        (NO_DATA + NO_BROWSER + REST, 1, "8 skipped, 3 not for real data"),
    ],
)
def test_only_missing_data_is_a_reason(tmp_path, output, code, total):
    (tmp_path / "pytest.txt").write_text(output)
    command = [sys.executable, SCRIPT, tmp_path / "pytest.txt"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == code
    assert done.stdout.splitlines()[-1] == total


def test_tests_of_real_data_say_so():
    """Their reason names the variable that finds the data."""
    found = 0
    for path in TESTS.glob("*.py"):
        for reason in re.findall(
            r"is_dir\(\), reason=f?\"([^\"]*)\"", path.read_text()
        ):
            found += 1
            assert re.search(r"set UWSFM_(DATA|CASES)$", reason), path
    assert found >= 5
