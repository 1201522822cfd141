"""What was to be shown, and whether it was."""

from collections.abc import Iterator

from repeatability import chance_of_ratio
from single_pair import ERRORS
from tables import Row, Tables, markdown, select


def section(found: Tables) -> str:
    """A table of the goals, for the tables that are there."""
    lines: list[Row] = []
    if "fig6_noise" in found:
        lines += _single_pair(found["fig6_noise"])
    if "fig7" in found:
        lines += _many_pairs(found["fig7"])
    if "fig8" in found:
        lines += _repeatability(found["fig8"])
    if not lines:
        return ""
    columns = {"goal": ("goal", ""), "found": ("found", ""), "met": ("met", "")}
    return "## Goals\n\n" + markdown(lines, columns)


def _line(goal: str, found: str, met: bool) -> Row:
    return {"goal": goal, "found": found, "met": "yes" if met else "**no**"}


def _single_pair(rows: list[Row]) -> Iterator[Row]:
    for error in ERRORS:
        ratios = [
            row["rmse_over_bound_both"]
            for row in select(rows, error_function=error)
            if row["noise_px"] > 0.0
        ]
        yield _line(
            f"one pair, {error}: normals within 1.3 x the bound",
            f"{min(ratios):.2f} to {max(ratios):.2f}",
            max(ratios) <= 1.3,
        )


def _many_pairs(rows: list[Row]) -> Iterator[Row]:
    goals = [row for row in rows if row["case"] != "distances known"]
    for case, method in dict.fromkeys((r["case"], r["method"]) for r in goals):
        mine = select(rows, case=case, method=method)
        clean = "outliers" not in case
        name = f"many pairs, {case}, {method}"
        ratios = [
            row[f"{what}_ratio"]
            for row in mine
            for what in ("normal", "distance")
            if row["noise_px"] > 0.0
        ]
        low, high = min(ratios), max(ratios)
        if clean:
            goal, met = "RMSE / bound within 0.85 to 1.15", 0.85 <= low <= high <= 1.15
        else:
            goal, met = "RMSE at most 1.2 x the clean bound", high <= 1.2
        yield _line(f"{name}: {goal}", f"{low:.2f} to {high:.2f}", met)
        share = min(row["converged_percent"] for row in mine)
        yield _line(f"{name}: all runs converge", f"{share:.0f} %", share == 100.0)
        if clean and method == "joint":
            count = max(row["iterations_max"] for row in mine)
            yield _line(f"{name}: at most 8 iterations", f"{count:.0f}", count <= 8)
            typical = max(row["solve_median_s"] for row in mine)
            worst = max(row["solve_max_s"] for row in mine)
            yield _line(
                f"{name}: a solve takes at most 0.3 s",
                f"{typical:.2f} s, at most {worst:.2f} s",
                typical <= 0.3,
            )


def _repeatability(rows: list[Row]) -> Iterator[Row]:
    paper = {row["camera"]: row["theta_sd_deg"] for row in select(rows, data="paper")}
    for row in rows:
        if row["data"] != "paper":
            limit = paper[row["camera"]]
            yield _line(
                f"{row['data']}, {row['method']}, {row['camera']}: "
                f"sd of θ below the paper's {limit:.2f} deg",
                f"{row['theta_sd_deg']:.3f} deg (p = {_chance(row, limit):.2f})",
                row["theta_sd_deg"] <= limit,
            )


def _chance(row: Row, limit: float) -> float:
    return chance_of_ratio(row["theta_sd_deg"], int(row["sets"]), limit, 3)
