"""How the results of the jobs are printed, and what they end with."""

from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from uwsfm.jobs.calibrate_housing import HousingResult

NO_FIT = 3
"""Exit code of a result that does not fit its images; it is written all the same."""


def finish(summary: dict[str, Any], where: str) -> None:
    """The last line, and the exit code of the verdict."""
    from uwsfm.trust.verdict import DOES_NOT_FIT

    typer.echo(where)
    if summary.get("verdict") == DOES_NOT_FIT:
        raise typer.Exit(NO_FIT)


def print_result(summary: dict[str, Any]) -> None:
    """Verdict, tables and notes of a reconstruction."""
    from rich.markup import escape

    from uwsfm.cli.console import console, print_verdict
    from uwsfm.cli.tables import (
        FEW_BUDGET_ROWS,
        budget_table,
        housing_table,
        result_table,
        timings_table,
    )

    print_verdict(summary)
    console.print(result_table(summary))
    console.print(housing_table(summary))
    if len(summary["error_budget"]) > 1:  # something was given that may be wrong
        console.print(budget_table(summary, FEW_BUDGET_ROWS))
    for warning in summary["warnings"]:
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")
    earlier = summary.get("steps_of_earlier_runs", ())
    console.print(timings_table(summary["timings_s"], earlier))


def print_housing(result: "HousingResult") -> None:
    """Verdict, tables and notes of a calibration."""
    from rich.markup import escape

    from uwsfm.cli.console import console, print_verdict
    from uwsfm.cli.tables import budget_table, calibration_table, housing_table

    print_verdict(result.summary)
    console.print(calibration_table(result.summary))
    console.print(housing_table(result.summary))
    if len(result.summary["error_budget"]) > 1:
        console.print(budget_table(result.summary))
    else:
        console.print("No error budget: all that is given counts as exact.")
    for warning in result.summary["warnings"]:
        console.print(f"[yellow]note:[/yellow] {escape(warning)}")
