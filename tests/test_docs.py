"""The manual: its commands exist, its examples run, its words are the agreed ones."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from manual_pages import DOCS, ROOT, Page, pages, plain, sentences, tables

from uwsfm.simulate.commands import simulate_observations

PAGES = pages()
BY_NAME = {page.name: page for page in PAGES}
EACH = pytest.mark.parametrize("page", PAGES, ids=BY_NAME)
PYTHON = [page for page in PAGES if any(b.kind == "python" for b in page.blocks)]
NOTEBOOKS = sorted((DOCS / "notebooks").glob("*.ipynb"))

BANNED = (
    r"tells?",
    r"told",
    r"says so",
    r"nobody",
    r"outside",
    r"settl(?:e|es|ed|ing)",
    r"reopened",
    r"borders?",
    r"perspective_start",
)
GLOSSARY_ONLY = (r"lanes?",)
MOST_WORDS = 18.0
COMMANDS = re.compile(
    r"`[^`]*\b(?:uwsfm|python|pytest)\s[^`]*`|^(?:uwsfm|python) ", re.M
)


def command_lines(page: Page) -> list[str]:
    """The lines of its shell blocks that call uwsfm."""
    lines = []
    for block in page.blocks:
        if block.kind == "sh":
            lines += [
                line.split("  #")[0].strip()
                for line in block.text.splitlines()
                if line.startswith("uwsfm ")
            ]
    return lines


def inline_commands(page: Page) -> list[str]:
    """Commands in the running text and in tables: their arguments may be missing."""
    text = page.path.read_text(encoding="utf-8")
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    spans = re.findall(r"`(uwsfm [^`]*)`", text)
    return [" ".join(span.split()) for span in spans if "..." not in span]


@pytest.fixture(scope="module")
def tree():
    from command_tree import commands

    return commands()


def parsed(tree, line: str, complete: bool = True) -> None:
    """A command line names a command, options that it has, and enough arguments."""
    words = shlex.split(line)[1:]
    while words and words[0].startswith("-"):
        known = {name for p in tree[""].parameters for name in p.names}
        first = words.pop(0)
        assert first in known | {"--help", "--install-completion"}, line
    if not words or words == ["COMMAND", "--help"]:
        return
    name = words.pop(0)
    if words and f"{name} {words[0]}" in tree:
        name = f"{name} {words.pop(0)}"
    if name not in tree and not words:
        assert any(full.startswith(f"{name} ") for full in tree), line
        return
    assert name in tree, line
    command = tree[name]
    options, _ = command.parse(words)
    for parameter in command.parameters:
        key = next((o for o in options if _is(parameter, o)), None)
        if complete and parameter.required:
            assert options.get(key) is not None, f"{line}: {parameter.names[0]}?"
        if key is not None and parameter.choices and options[key] is not None:
            values = options[key]
            for value in values if isinstance(values, list) else [values]:
                assert value in parameter.choices, line


def _is(parameter, option: str) -> bool:
    names = {name.lstrip("-").replace("-", "_").lower() for name in parameter.names}
    return option in names


@EACH
def test_every_command_line_parses(page, tree):
    for line in command_lines(page):
        parsed(tree, line)
    for line in inline_commands(page):
        parsed(tree, line, complete=False)


def test_a_wrong_command_line_is_noticed(tree):
    for line in (
        "uwsfm reconstruct rig.yaml images --turbo -o out",
        "uwsfm reconstruct rig.yaml -o out",
        "uwsfm reconstruct rig.yaml images",
        "uwsfm reconstruct rig.yaml images -o out --matching all",
        "uwsfm rebuild out",
    ):
        with pytest.raises(Exception):  # noqa: B017 (of click, whichever it is)
            parsed(tree, line)


def test_every_command_is_in_the_manual(tree):
    shown = " ".join(line for page in PAGES for line in command_lines(page))
    inline = " ".join(line for page in PAGES for line in inline_commands(page))
    for name in tree:
        assert f"uwsfm {name}" in f"{shown} {inline}", name


def test_every_question_has_a_page():
    index = BY_NAME["docs/index.md"].path.read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+)\. (.+?) \| \[.+?\]\((.+?)\) \|$", index, re.MULTILINE)
    assert [int(number) for number, _, _ in rows] == list(range(1, 18))
    for _, question, link in rows:
        name, _, anchor = link.partition("#")
        target = BY_NAME[f"docs/{name}"]
        assert not anchor or anchor in target.anchors, (question, link)


def test_links_of_the_readme_exist():
    for name in ("README.md", "CONTRIBUTING.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)#]+)", text):
            assert link.startswith("https://") or (ROOT / link).exists(), link


def test_the_readme_is_short_and_keeps_its_two_commands():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 150
    start = "    python3 -m venv .venv && .venv/bin/pip install "
    assert f"{start}. && .venv/bin/uwsfm demo\n" in text
    assert f"{start}-e '.[dev]' && .venv/bin/pytest\n" in text


@EACH
def test_words(page):
    prose = "\n".join([*page.prose, *page.table_rows])
    banned = BANNED if page.name.endswith("glossary.md") else BANNED + GLOSSARY_ONLY
    text = plain(prose).replace("SIMD lanes", "")
    for pattern in banned:
        found = re.search(rf"\b(?:{pattern})\b", text, re.IGNORECASE)
        assert not found, text[max(0, found.start() - 60) : found.end() + 30]
    for paragraph in page.prose:
        for sentence in sentences(paragraph):
            assert not sentence.startswith(("Of ", "Whose ")), sentence


@EACH
def test_sentences_are_short(page):
    lengths = [
        len(sentence.split())
        for paragraph in page.prose
        if paragraph not in page.headings
        for sentence in sentences(paragraph)
    ]
    if lengths:
        assert np.mean(lengths) < MOST_WORDS


def _numeric(cell: str) -> bool:
    return bool(re.fullmatch(r"[^a-zA-Z]*\d[^a-zA-Z]*(?:mm|px|s|deg|m|MB|GB|%)?", cell))


@EACH
def test_tables_of_numbers_name_their_command(page):
    for section in page.sections:
        for rows in tables(section):
            cells = [cell for row in rows for cell in row[1:] if cell]
            share = np.mean([_numeric(cell) for cell in cells]) if cells else 0.0
            if share > 0.3:
                assert COMMANDS.search(section), (page.name, rows[0])


def test_pages_name_nothing_of_one_machine():
    for path in [ROOT / "README.md", *DOCS.rglob("*.md"), *NOTEBOOKS]:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"/(?:tmp|home|work|root)/|pypi|jfrog", text), path


@pytest.fixture
def desk(tmp_path, dive_result) -> Path:
    """A folder with what the examples open: a rig, a result, a video, a dive."""
    shutil.copytree(dive_result.out, tmp_path / "out")
    shutil.copy(dive_result.out.parent / "rig.yaml", tmp_path)
    video = cv2.VideoWriter(
        str(tmp_path / "left.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, (64, 48)
    )
    for level in range(40):
        video.write(np.full((48, 64, 3), 5 * level, dtype=np.uint8))
    video.release()
    simulate_observations(tmp_path / "dive.npz", altitude=1.2, relief=0.3, noise_px=0.1)
    return tmp_path


def run_examples(page: Page, folder: Path, *, slow: bool) -> str:
    """Run the page's Python in one process, as a reader would who follows it."""
    blocks = [b for b in page.blocks if b.kind == "python"]
    code = "\n".join(b.text for b in blocks if slow or b.mark != "slow")
    (folder / "page.py").write_text(code, encoding="utf-8")
    found = subprocess.run(
        [sys.executable, "page.py"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stderr[-2000:]
    return found.stdout


@pytest.mark.parametrize("page", PYTHON, ids=lambda page: page.name)
def test_python_examples_run(page, desk):
    printed = run_examples(page, desk, slow=False)
    promised = [
        comment
        for block in page.blocks
        if block.kind == "python"
        for comment in re.findall(r"print\(.*\)\s+# (.*)$", block.text, re.MULTILINE)
    ]
    for comment in promised:
        if re.match(r"[\[\d]", comment):  # "1.3423: sea water ..."
            assert comment.split(":")[0] in printed
    if page.name.endswith("trouble.md"):
        assert len(list((desk / "images" / "left").iterdir())) == 4


@pytest.mark.slow
def test_python_examples_that_reconstruct_run(desk):
    """The sample's first frames stand for a reader's own dive."""
    sample = ROOT / "datasets" / "sample"
    shutil.copy(sample / "rig.yaml", desk)
    for side in ("left", "right"):
        (desk / "images" / side).mkdir(parents=True)
        for image in sorted((sample / "images" / side).iterdir())[:6]:
            shutil.copy(image, desk / "images" / side)
    run_examples(BY_NAME["docs/howto/python.md"], desk, slow=True)
    assert (desk / "new_out" / "report.html").exists()


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path, tmp_path):
    nbformat = pytest.importorskip("nbformat")
    client = pytest.importorskip("nbclient").NotebookClient
    notebook = nbformat.read(path, 4)
    resources = {"metadata": {"path": str(tmp_path)}}
    client(notebook, timeout=300, resources=resources).execute()


@pytest.mark.slow
def test_the_planning_page_has_what_its_command_prints():
    """To a unit of the last digit: another processor may round otherwise."""
    script = ROOT / "pipelines" / "planning" / "plan.py"
    found = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stderr
    written = BY_NAME["docs/planning.md"].path.read_text(encoding="utf-8")
    printed = [rows for text in found.stdout.split("\n\n") for rows in tables(text)]
    shown = {row[0]: row for rows in tables(written) for row in rows}
    assert len(printed) == 7
    for row in (row for rows in printed for row in rows):
        page_row = shown[row[0]]
        numbers = zip(row[-3:], page_row[-3:], strict=True)
        assert all(
            np.isclose(float(a), float(b), rtol=0.02, atol=0.01) for a, b in numbers
        ), (row, page_row)


def test_notebooks_are_small():
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        assert path.stat().st_size < 20_000
        assert json.loads(path.read_text(encoding="utf-8"))["nbformat"] == 4


def test_files_of_a_result_are_those_that_the_manual_lists(dive_result):
    text = BY_NAME["docs/reference/outputs.md"].path.read_text(encoding="utf-8")
    listed = set(re.findall(r"^\| `([\w.-]+)/?` \|", text, re.MULTILINE))
    there = {path.name for path in dive_result.out.iterdir()}
    assert there <= listed, there - listed
    header = (dive_result.out / "points.ply").read_bytes().split(b"end_header")[0]
    for name in re.findall(r"property \w+ (\w+)", header.decode()):
        assert f"`{name}`" in text, name
