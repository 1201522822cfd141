"""The manual's pages, taken apart: prose, code blocks, tables, headings."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS / "_ext"))

_FENCE = re.compile(r"^(`{3,}|:{3,})(.*)$")
_BULLET = re.compile(r"^\s*(?:[-*]|\d+\.)\s+")


@dataclass(frozen=True, kw_only=True)
class Block:
    """A fenced block."""

    kind: str
    """What stands behind the fence: sh, python, {figure} ..."""
    text: str
    mark: str
    """Of an HTML comment in the line above."""


@dataclass(frozen=True, kw_only=True)
class Page:
    """One page of Markdown."""

    path: Path
    blocks: tuple[Block, ...]
    prose: tuple[str, ...]
    """Paragraphs, list items and headings, without their marks."""
    sections: tuple[str, ...]
    """From one heading to the next, as they are written."""
    headings: tuple[str, ...]
    table_rows: tuple[str, ...]

    @property
    def name(self) -> str:
        return self.path.relative_to(ROOT).as_posix()

    @property
    def anchors(self) -> set[str]:
        return {slug(heading) for heading in self.headings}


def pages() -> list[Page]:
    """Every page of the manual, and the README."""
    files = [path for path in sorted(DOCS.rglob("*.md")) if "_build" not in path.parts]
    return [page(path) for path in [ROOT / "README.md", *files]]


def page(path: Path) -> Page:
    text = path.read_text(encoding="utf-8")
    if text.strip() == "{{ notebook }}":
        text = _prose_of(path.with_suffix(".ipynb"))
    blocks, rest = _split(text.splitlines())
    headings = [line.lstrip("# ") for line in rest if line.startswith("#")]
    sections = re.split(r"^#+ .*$", text, flags=re.MULTILINE)
    return Page(
        path=path,
        blocks=tuple(blocks),
        prose=tuple(_paragraphs(rest)),
        sections=tuple(sections),
        headings=tuple(headings),
        table_rows=tuple(line for line in rest if line.startswith("|")),
    )


def _prose_of(notebook: Path) -> str:
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    texts = ["".join(c["source"]) for c in cells if c["cell_type"] == "markdown"]
    return "\n\n".join(texts)


def _split(lines: list[str]) -> tuple[list[Block], list[str]]:
    """Fenced blocks (and those indented by four), and the other lines."""
    blocks, rest, mark = [], [], ""
    at = 0
    while at < len(lines):
        line = lines[at]
        fence = _FENCE.match(line)
        if fence:
            end = at + 1
            while not lines[end].startswith(fence[1]):
                end += 1
            text = "\n".join(lines[at + 1 : end])
            blocks.append(Block(kind=fence[2].strip(), text=text, mark=mark))
            if fence[2].startswith("{figure}"):
                caption = [row for row in text.splitlines() if row[:1] != ":"]
                rest += ["", *caption, ""]
            at = end
        elif line.startswith("    ") and (not rest or not rest[-1].strip()):
            blocks.append(Block(kind="sh", text=line[4:], mark=mark))
            rest.append("")
        else:
            rest.append("" if line.startswith("<!--") else line)
        mark = line.strip("<!-> ") if line.startswith("<!--") else ""
        at += 1
    return blocks, rest


def _paragraphs(lines: list[str]) -> list[str]:
    found, current = [], []
    for line in [*lines, ""]:
        starts = line.startswith("#") or bool(_BULLET.match(line))
        if (not line.strip() or starts or line.startswith("|")) and current:
            found.append(" ".join(current))
            current = []
        if line.strip() and not line.startswith(("|", "{{", "{.", "![")):
            current.append(_BULLET.sub("", line).strip("# >").strip())
    return [paragraph for paragraph in found if paragraph]


def plain(text: str) -> str:
    """Prose without links, code and emphasis."""
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`", "code", text)
    text = re.sub(r"\$\$.*?\$\$|\$[^$]*\$", "x", text)
    return text.replace("*", "")


def sentences(paragraph: str) -> list[str]:
    """Sentences of a paragraph; what stands in quotes or brackets is part of one."""
    parts = re.split(r"(?<=[.?!])\s+(?=[A-Z\"(±0-9])", plain(paragraph))
    return [part for part in parts if re.search(r"\w", part)]


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub and MyST make it."""
    text = re.sub(r"[^\w\- ]", "", plain_heading(heading).lower())
    return text.strip().replace(" ", "-")


def plain_heading(heading: str) -> str:
    return re.sub(r"[`*]", "", heading)


def tables(section: str) -> list[list[list[str]]]:
    """Rows of cells of each table of a section, without the header."""
    found = []
    for block in re.findall(r"(?:^\|.*\|[ ]*\n?)+", section, re.MULTILINE):
        rows = [
            [cell.strip() for cell in row.strip().strip("|").split("|")]
            for row in block.strip().splitlines()
        ]
        found.append(rows[2:])
    return found
