"""`uwsfm batch`."""

from pathlib import Path
from typing import Annotated

import typer

from uwsfm.cli.options import SchedulerOption


def batch(
    dives: Annotated[
        Path,
        typer.Argument(help="YAML file of the dives, see docs/howto/many_dives.md."),
    ],
    scheduler: SchedulerOption = "local",
    threads: Annotated[
        int,
        typer.Option(
            min=-1,
            help="Number of threads of all dives together. -1: one for each core.",
        ),
    ] = -1,
) -> None:
    """Reconstruct many dives; one that fails never stops the others.

    Run the same command again to go on with those that failed or were stopped.
    """
    from uwsfm.cli.console import ProgressBars, console
    from uwsfm.cli.tables import batch_table

    with ProgressBars() as progress:
        from uwsfm.jobs.batch import run_batch
        from uwsfm.trust.verdict import DOES_NOT_FIT

        outcomes = run_batch(
            dives, scheduler=scheduler, num_threads=threads, progress=progress
        )
    console.print(batch_table(outcomes))
    failed = [outcome for outcome in outcomes if outcome.reason is not None]
    if failed:
        typer.echo(f"{len(failed)} of {len(outcomes)} dives failed", err=True)
        raise typer.Exit(1)
    contradicted = [o for o in outcomes if o.verdict == DOES_NOT_FIT]
    if contradicted:
        text = f"{len(contradicted)} of {len(outcomes)} dives do not fit"
        typer.echo(f"{text}: see summary.json", err=True)
        raise typer.Exit(3)
