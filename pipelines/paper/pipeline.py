"""The figures of Sedlazeck & Koch (BMVC 2011) again: tables, pictures, a README.

    python pipelines/paper/pipeline.py -o OUT [--tank DATA] [--runs 100]

OUT receives README.md, and a CSV file and a picture per figure; OUT/work keeps images
and reconstructions. DATA is the folder described in pipelines/uril_tank; without it
figure 8 has rendered images only. With --only fig3,fig7 other figures keep their CSV.
"""

import argparse
import textwrap
import time
from pathlib import Path

import fig3
import fig6
import fig7
import fig8
import loops
import partitions
import targets
from settings import Settings
from tables import Tables, read_csv, write_csv

from uwsfm._base.files import replaced_file
from uwsfm._base.tasks import LOCAL, Workers

FIGURES = {
    "fig3": fig3,
    "fig6": fig6,
    "fig7": fig7,
    "loops": loops,
    "fig8": fig8,
    "partitions": partitions,
}
TIMES = "times.csv"


def main() -> None:
    options = parse()
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    with Workers(options.scheduler, out, options.processes) as workers:
        settings = Settings(
            runs=options.runs, workers=workers, work=out / "work", tank=options.tank
        )
        for name in options.only:
            began = time.monotonic()
            for table, rows in FIGURES[name].compute(settings):
                write_csv(rows, out / f"{table}.csv")
            note_time(out, name, time.monotonic() - began, settings)
    found = read_tables(out)
    sections = [HEADER, times(out), targets.section(found)]
    for figure in FIGURES.values():
        if all(table in found for table in figure.TABLES):
            figure.plot(found, out)
            sections.append(figure.section(found))
    with replaced_file(out / "README.md") as partial:
        text = "\n\n".join(filled(section) for section in sections if section)
        partial.write_text(text + "\n", encoding="utf-8")
    print(f"{out / 'README.md'}")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--tank", type=Path, metavar="DATA", help="the real rig")
    parser.add_argument("--runs", type=int, default=100, help="per level")
    parser.add_argument("--processes", type=int, default=2, help="of this machine")
    parser.add_argument("--scheduler", default=LOCAL, help="of Dask: tcp://HOST:PORT")
    parser.add_argument("--only", default=",".join(FIGURES), help="of: %(default)s")
    options = parser.parse_args()
    options.only = options.only.split(",") if options.only else []
    unknown = set(options.only) - set(FIGURES)
    if unknown:
        parser.error(f"no figure {sorted(unknown)[0]}; there are {', '.join(FIGURES)}")
    if options.runs < 2 or options.processes < 1:
        parser.error("it takes two runs and one process at least")
    if options.tank is not None and not (options.tank / "left").is_dir():
        parser.error(f"{options.tank} holds no folder left/ of images")
    return options


def read_tables(out: Path) -> Tables:
    """Everything computed so far, in this run or before."""
    names = [table for figure in FIGURES.values() for table in figure.TABLES]
    paths = {name: out / f"{name}.csv" for name in names}
    return {name: read_csv(path) for name, path in paths.items() if path.exists()}


def note_time(out: Path, name: str, seconds: float, settings: Settings) -> None:
    path = out / TIMES
    rows = (
        [row for row in read_csv(path) if row["figure"] != name]
        if path.exists()
        else []
    )
    rows.append(
        {
            "figure": name,
            "minutes": seconds / 60.0,
            "runs": settings.runs,
            "processes": settings.workers.num_processes,
        }
    )
    write_csv(sorted(rows, key=lambda row: row["figure"]), path)


def times(out: Path) -> str:
    if not (out / TIMES).exists():
        return ""
    rows = read_csv(out / TIMES)
    each = ", ".join(f"{row['figure']} {row['minutes']:.1f} min" for row in rows)
    total = sum(row["minutes"] for row in rows)
    processes = rows[0]["processes"]
    return f"Time: {each}; {total:.0f} min in all, with {processes:.0f} processes."


def filled(text: str) -> str:
    """Lines of equal length again, now that the numbers are in; tables stay."""
    blocks = text.strip().split("\n\n")
    wrapper = textwrap.TextWrapper(width=88, break_on_hyphens=False)
    return "\n\n".join(b if b[0] in "|#!" else wrapper.fill(b) for b in blocks)


HEADER = """# Results: the source paper's figures

A. Sedlazeck and R. Koch, *Calibration of Housing Parameters for Underwater
Stereo-Camera Rigs*, BMVC 2011. Made by `pipelines/paper/pipeline.py`, with the numbers
in the CSV files beside this page. Rig of the simulations: 1200 x 900 px, f = 1000 px,
baseline 200 mm, interfaces at 20 mm behind 5 mm of glass, tilted by 2 and 1 degrees."""


if __name__ == "__main__":
    main()
