"""Tables: rows of numbers to CSV and back, and to the Markdown of a README."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from uwsfm._base.files import replaced_file

Row = dict[str, Any]
"""One line of a table: column name with its unit -> number or text."""

Tables = dict[str, list[Row]]
"""By name, which is that of the CSV file."""


def write_csv(rows: Sequence[Row], path: Path) -> None:
    """Write a table, numbers with six digits; the file is replaced as a whole."""
    with replaced_file(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({name: _written(value) for name, value in row.items()})


def read_csv(path: Path) -> list[Row]:
    """Read a table back; what looks like a number is one."""
    with path.open(newline="") as file:
        return [
            {name: _parsed(text) for name, text in row.items()}
            for row in csv.DictReader(file)
        ]


def select(rows: Sequence[Row], **wanted: Any) -> list[Row]:
    """The rows whose columns have these values."""
    return [row for row in rows if all(row[k] == v for k, v in wanted.items())]


def column(rows: Sequence[Row], name: str) -> list[Any]:
    return [row[name] for row in rows]


def markdown(rows: Sequence[Row], columns: dict[str, tuple[str, str]]) -> str:
    """A Markdown table.

    Args:
        rows: The lines.
        columns: Column of the rows -> heading, and format of its numbers.
    """
    lines = [
        "| " + " | ".join(heading for heading, _ in columns.values()) + " |",
        "|" + "---|" * len(columns),
    ]
    for row in rows:
        cells = [_shown(row[name], spec) for name, (_, spec) in columns.items()]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _shown(value: Any, spec: str) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else format(value, spec)


def _written(value: Any) -> Any:
    return f"{value:.6g}" if isinstance(value, float) else value


def _parsed(text: str) -> Any:
    if text == "":
        return None
    try:
        return float(text)
    except ValueError:
        return text
