"""A small part of pipelines/faults/fuzz.py: mutated input of every kind ends well."""

import sys
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).parent.parent / "pipelines" / "faults"
sys.path.insert(0, str(FOLDER))
import fuzz  # noqa: E402

CASES = 40


@pytest.mark.parametrize("name", sorted(fuzz._kinds()))
def test_mutated_input_is_read_or_refused_in_one_line(tmp_path, name):
    """Without the watched process of its own: what hangs or aborts ends the suite."""
    kind = fuzz._kinds()[name]()
    found = [
        fuzz._outcome(kind, tmp_path / "a" / "b" / "case", np.random.default_rng(i))
        for i in range(CASES)
    ]
    assert [one for one in found if one[0] not in ("read", "refused")] == []
    # Mutations that always or never broke a file would show nothing.
    assert {one[0] for one in found} <= {"read", "refused"} and len(set(found)) > 2


def test_what_does_not_end_well_is_seen(tmp_path):
    """The faults that the harness is for, planted."""
    rng = np.random.default_rng(0)

    def outcome(read):
        kind = fuzz.Kind({"x.yaml": b"version: 1\n"}, read)
        return fuzz._outcome(kind, tmp_path / "a" / "b" / "case", rng)[0]

    assert outcome(lambda folder: {}["key"]) == "traceback"
    assert outcome(lambda folder: (folder / "../../x").write_text("")) == "outside"
    assert outcome(lambda folder: (folder / "new").write_text("")) == "outside"
    assert outcome(lambda folder: None) == "read"
