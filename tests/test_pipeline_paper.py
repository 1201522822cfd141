"""The study of the paper's figures: every table, from very few runs."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from uwsfm._base.tasks import Workers

pytest.importorskip("matplotlib")

HERE = Workers(max_processes=1)
FOLDER = Path(__file__).parent.parent / "pipelines" / "paper"


@pytest.fixture(autouse=True)
def modules(monkeypatch):
    """The study's modules are found beside its script only."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(FOLDER))
    yield
    for name in set(sys.modules) - before:
        origin = getattr(sys.modules[name], "__file__", None) or ""
        if Path(origin).parent == FOLDER:
            del sys.modules[name]


def numbers(rows, optional=()):
    """Rows (R, C) of what is a number; None is allowed in the optional columns."""
    table = []
    for row in rows:
        for name in optional:
            assert row[name] is None or np.isfinite(row[name])
        values = {k: v for k, v in row.items() if k not in optional}
        table.append([v for v in values.values() if not isinstance(v, str)])
    return np.array(table, dtype=float)


def check_round_trip(rows, path):
    """What is drawn is read from the CSV file: it must hold the same."""
    from tables import read_csv, write_csv

    write_csv(rows, path)
    again = read_csv(path)
    assert [list(row) for row in again] == [list(row) for row in rows]
    for row, copy in zip(rows, again, strict=True):
        for name, value in row.items():
            if isinstance(value, str) or value is None:
                assert copy[name] == value
            else:
                # Six digits are written.
                assert copy[name] == pytest.approx(value, rel=1e-5)


def test_caustics_lie_behind_the_camera(tmp_path):
    import fig3

    found = fig3.caustics(9, 7)
    for name, rows in found.items():
        assert np.all(np.isfinite(numbers(rows)))
        check_round_trip(rows, tmp_path / f"{name}.csv")
        # In water a camera seems nearer: its image lies on the far side of the centre.
        assert max(row["z_sagittal_mm"] for row in rows) < 0.0
    tilted = found["fig3_tilted"]
    reach = [row["x_tangential_mm"] for row in tilted]
    assert max(reach) > 1.05 * -min(reach)  # the asymmetry that the paper shows
    fig3.plot(found, tmp_path)
    assert (tmp_path / "fig3.png").stat().st_size > 10_000
    assert "![" in fig3.section(found)


def test_single_pair_tables(tmp_path):
    import single_pair

    rows = single_pair.noise_table(2, HERE, noises_px=(0.0, 0.5), num_points=60)
    assert len(rows) == 2 * 3 * 2
    assert {row["error_function"] for row in rows} == set(single_pair.ERRORS)
    optional = ("rmse_over_bound_both", "ratio_error")
    assert np.all(np.isfinite(numbers(rows, optional)))
    check_round_trip(rows, tmp_path / "noise.csv")
    for row in rows[:6]:
        assert row["max_deg"] < 1e-4  # what the solver's tolerance leaves
    rows = single_pair.distance_table(2, HERE, distances_mm=(10.0, 20.0), num_points=60)
    assert len(rows) == 2 * 3 * 2
    assert np.all(np.isfinite(numbers(rows)))
    wrong, right = rows[0], rows[1]
    assert wrong["mean_deg"] > 100.0 * right["mean_deg"]


def test_many_pairs_table(tmp_path):
    import many_pairs

    tiny = {"noises_px": (0.0, 0.25), "num_frames": 5, "num_points": 60}
    case = many_pairs.Case(name="tiny", methods=many_pairs.STRATEGIES, **tiny)
    rows = many_pairs.table(2, HERE, cases=(case,))
    assert [row["method"] for row in rows] == ["joint", "nested"] * 2
    optional = tuple(name for name in rows[0] if "_z_" in name or "ratio" in name)
    assert np.all(np.isfinite(numbers(rows, optional)))
    check_round_trip(rows, tmp_path / "many.csv")
    exact, noisy = rows[0], rows[2]
    assert exact["normal_ratio"] is None and exact["normal_max_deg"] < 1e-4
    # Four normals of two runs: their RMS is known to a factor of two.
    assert 0.3 < noisy["normal_ratio"] < 2.5
    assert noisy["converged_percent"] == 100.0


def test_loops_repeated_as_printed_creep_to_the_same_end():
    import loops
    import many_pairs

    case = many_pairs.Case(name="tiny", num_frames=5, num_points=60)
    root, *passes = loops.table(case, shown=(1, 3, 10))
    missing = [row["missing_mm"] for row in passes]
    assert root["missing_mm"] == 0.0
    assert missing[0] > missing[1] > missing[2] > 0.5 * missing[0]
    assert "repeated as printed" in loops.section({"loops": [root, *passes]})


def test_basin_table():
    import basin

    case = replace(basin.CASE, num_frames=5, num_points=60)
    rows = basin.table(1, HERE, case=case)
    assert len(rows) == len(basin.ANGLES_DEG) * len(basin.DISTANCE_SCALES)
    assert np.all(np.isfinite(numbers(rows)))
    assert rows[0]["converged_percent"] == 100.0  # 5 degrees off, distance x 0.1


def test_printed_trials_of_the_paper():
    """The spreads beside which ours are put, against its printed variances of phi."""
    import repeatability

    rows = repeatability.spreads(repeatability.paper_rows())
    for row, variance in zip(rows, (2.38, 11.823), strict=True):
        # The paper divides by n = 3, a sample by n - 1.
        assert row["phi_sd_deg"] ** 2 * 2 / 3 == pytest.approx(variance, rel=2e-3)
        assert np.isfinite(row["theta_sd_deg"])


def test_three_numbers_against_three_tell_little():
    """F(2, 2): the chance of a ratio above r is 1 / (1 + r)."""
    from repeatability import chance_of_ratio

    for larger, smaller in ((0.2, 0.12), (0.298, 0.228)):
        ratio = (larger / smaller) ** 2
        assert chance_of_ratio(larger, 3, smaller, 3) == pytest.approx(1 / (1 + ratio))
        # Whichever is larger.
        assert chance_of_ratio(smaller, 3, larger, 3) == pytest.approx(1 / (1 + ratio))


def test_the_tank_in_partitions_is_told_from_its_tables():
    import partitions
    from tables import read_csv

    kept = FOLDER / "results"
    found = {name: read_csv(kept / f"{name}.csv") for name in partitions.TABLES}
    text = partitions.section(found)
    row = next(r for r in found["whole_tank"] if r["method"] == "all parameters")
    assert f"{row['normal_x_deg']:.2f}" in text
    # As the page beside the tables has it.
    page = (kept / "README.md").read_text(encoding="utf-8")
    table = next(line for line in text.splitlines() if line.startswith("| 3 x 8"))
    assert table in page
