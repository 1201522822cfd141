"""List and count the tests that pytest skipped; fail if one lacked more than real data.

    pytest -ra | tee FILE; python .ci/skipped.py FILE

Images of real dives are not part of the repository. Whatever else a test needs, its run
in an environment of its own has to have.
"""

import re
import sys
from pathlib import Path

SKIPPED = re.compile(r"^SKIPPED \[(\d+)\] (.*)$", re.M)
REAL_DATA = re.compile(r"set UWSFM_(DATA|CASES)$")
"""How the tests that need it end their reason."""


def main() -> int:
    """Print a table of the skipped tests, and 1 if any should have run."""
    found = SKIPPED.findall(Path(sys.argv[1]).read_text(encoding="utf-8"))
    wrong = 0
    for count, where in found:
        allowed = REAL_DATA.search(where) is not None
        wrong += 0 if allowed else int(count)
        print(f"{int(count):4d}  {'no data' if allowed else 'MISSING'}  {where}")
    print(f"{sum(int(count) for count, _ in found)} skipped, {wrong} not for real data")
    if wrong:
        print("tests were skipped for want of what is installed here", file=sys.stderr)
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
