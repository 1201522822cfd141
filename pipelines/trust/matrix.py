"""Every mistake on two dives, three magnitudes each: refused, named, or missed.

    python pipelines/trust/matrix.py -o OUT [--only TEXT] [--images FOLDER]

Simulated keypoints and matches by default, without mapping; ``--mapped``: with it.
``--images``: features of rendered images, which are made in FOLDER and found once. A
run that was stopped goes on.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dives import Dive, simulated_dive
from images import rendered_dive
from outcomes import FITS, REFUSED, Outcome, causes_of, outcome_of
from wrong_inputs import MISTAKES, Mistake

from uwsfm._base.files import replaced_file
from uwsfm.cli.console import ProgressBars
from uwsfm.errors import InputError

TRIALS = 3
DIVES = ("sample", "six frames")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One run of the matrix."""

    mistake: str
    dive: str
    trial: int
    images: Path | None = None
    mapped: bool = False
    """Verify and map, too."""
    causes: bool = True
    """Look for the cause of what does not fit; a refusal names its own."""

    def run(self) -> dict[str, Any]:
        """Its outcome, as a row of the file of all runs."""
        mistake = by_name(self.mistake)
        right = self.right(mistake)
        try:
            wrong = mistake.applied(right, self.trial)
        except InputError as error:  # the rig file cannot hold such numbers
            outcome = Outcome(
                verdict=REFUSED, words=str(error), causes=causes_of(error)
            )
        else:
            mapped = self.mapped or self.images is not None
            outcome = outcome_of(wrong, diagnosed=self.causes, mapped=mapped)
        return {
            "mistake": self.mistake,
            "code": mistake.code,
            "dive": self.dive,
            "trial": self.trial,
            "looked": self.causes or outcome.verdict == REFUSED,
            **outcome.to_json(),
        }

    def right(self, mistake: Mistake) -> Dive:
        """The dive without the mistake."""
        frames = 6 if self.dive == "six frames" else None
        if self.images is not None:
            return rendered_dive(self.images, num_frames=frames, domes=mistake.domes)
        return simulated_dive(
            "small" if frames else "sample",
            num_frames=frames,
            domes=mistake.domes,
            num_points=700 if frames else 1000,
            seed=self.trial,
        )


def by_name(name: str) -> Mistake:
    return next(mistake for mistake in MISTAKES if mistake.name == name)


def named(row: dict[str, Any]) -> bool:
    """Whether the right cause is among those named."""
    mistake = by_name(row["mistake"])
    return bool({mistake.code, *mistake.also} & set(row["causes"]))


def wrong(row: dict[str, Any]) -> bool:
    """Confidently: it fits, and something is off by more than three of its ±."""
    return Outcome(**_fields(row)).confidently_wrong


def healed(row: dict[str, Any]) -> bool:
    """It fits, and all estimates agree with the truth: there is nothing to name."""
    return row["verdict"] == FITS and not wrong(row)


def _fields(row: dict[str, Any]) -> dict[str, Any]:
    names = Outcome.__dataclass_fields__
    return {name: row[name] for name in names}


COLUMNS = (
    "mistake",
    "code",
    REFUSED,
    "does not fit",
    "doubtful",
    "fits, right",
    "fits, WRONG",
    "named",
    "worst error of a fit, in ±",
)
HEAD = """\
# The matrix of mistakes

`python pipelines/trust/matrix.py -o pipelines/trust/results{option}`

{kinds} kinds of wrong input on two dives, {count} runs. Each cell counts runs.
"fits, right": every length, port and tilt within 3 of its printed standard deviations.
"fits, WRONG": something is off by more. "named": the right cause is among those that
are named, of the runs that were refused or called doubtful or not fitting.

"""


def page(rows: list[dict[str, Any]], *, images: bool) -> str:
    """The table, and what it adds up to."""
    lines = []
    for mistake in MISTAKES:
        mine = [row for row in rows if row["mistake"] == mistake.name]
        if mine:
            lines.append(_line(mistake, mine))
    caught = [r for r in rows if r["code"] and r["verdict"] != FITS and r["looked"]]
    good = sum(map(named, caught))
    shown = [row for row in rows if not by_name(row["mistake"]).hidden]
    misses = sum(map(wrong, shown))
    share = f"{good} ({good / max(len(caught), 1):.1%})"
    summary = (
        f"\n**{misses} of {len(shown)}** runs are called fitting with something off by "
        f"more than 3 of its ±, not counting what no observation shows (†). Of the "
        f"{len(caught)} that were caught, have a single cause and were looked into, "
        f"**{share}** name it.\n"
    )
    head = HEAD.format(
        option=" --images OUT/images" if images else "",
        kinds=len(lines),
        count=len(rows),
    )
    columns = ["| " + " | ".join(COLUMNS) + " |", "|---" * len(COLUMNS) + "|"]
    return head + "\n".join([*columns, *lines]) + "\n" + summary


def _line(mistake: Mistake, rows: list[dict[str, Any]]) -> str:
    def count(verdict: str) -> int:
        return sum(row["verdict"] == verdict for row in rows)

    caught = [row for row in rows if row["verdict"] != FITS and row["looked"]]
    fits = [Outcome(**_fields(row)) for row in rows if row["verdict"] == FITS]
    worst = max((outcome.worst for outcome in fits), default=None)
    cells = [
        mistake.name + (" †" if mistake.hidden else ""),
        f"`{mistake.code}`" if mistake.code else "-",
        *(str(count(verdict)) for verdict in (REFUSED, "does not fit", "doubtful")),
        str(sum(map(healed, rows))),
        str(sum(map(wrong, rows))),
        f"{sum(map(named, caught))} of {len(caught)}" if mistake.code else "-",
        "-" if worst is None else f"{worst:.1f}",
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", metavar="TEXT", help="mistakes whose name holds it")
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--dive", choices=DIVES, help="one of the two alone")
    parser.add_argument(
        "--without-causes", action="store_true", help="only the verdicts: faster"
    )
    parser.add_argument(
        "--mapped", action="store_true", help="verify and map each case: slow"
    )
    parser.add_argument("--images", type=Path, help="folder of rendered images")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    stem = "matrix_images" if options.images else "matrix"
    stored = options.out / f"{stem}.jsonl"
    rows = _stored(stored)
    done = {
        _key(row)
        for row in rows
        if row["looked"] or row["verdict"] == FITS or options.without_causes
    }
    chosen = [m.name for m in MISTAKES if (options.only or "") in m.name]
    cases = [
        Case(
            mistake=name,
            dive=dive,
            trial=trial,
            images=options.images,
            mapped=options.mapped,
            causes=not options.without_causes,
        )
        for trial in range(options.trials)
        for dive in ([options.dive] if options.dive else DIVES)
        for name in chosen
        if (name, dive, trial) not in done
    ]
    with ProgressBars() as progress:
        for number, case in enumerate(cases):
            progress("runs", number, len(cases))
            row = case.run()  # in place of one whose cause was not looked for
            rows = [other for other in rows if _key(other) != _key(row)] + [row]
            with replaced_file(stored) as partial:
                partial.write_text("".join(json.dumps(r) + "\n" for r in rows))
    text = page(rows, images=options.images is not None)
    with replaced_file(options.out / f"{stem}.md") as partial:
        partial.write_text(text, encoding="utf-8")
    print(text)


def _key(row: dict[str, Any]) -> tuple[str, str, int]:
    return row["mistake"], row["dive"], row["trial"]


def _stored(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


if __name__ == "__main__":
    main()
