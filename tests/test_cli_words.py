"""What the command line says, for readers whose first language is another.

The rules are those of the project's words: a help text is a sentence or a full noun
phrase with its unit and its default, and nothing "tells".
"""

import ast
import re
from pathlib import Path

import pytest
import typer

import uwsfm
from uwsfm._base.options import options_of
from uwsfm.cli.app import START, app
from uwsfm.options.jobs import (
    CalibrateHousingOptions,
    ReconstructOptions,
    RefineOptions,
)

JOBS = (ReconstructOptions, RefineOptions, CalibrateHousingOptions)
BANNED = re.compile(
    r"\btells\b|\bis told\b|\bsays so\b|\bnobody tells\b", re.IGNORECASE
)
PACKAGE = Path(uwsfm.__file__).parent
PRINTING = [*(PACKAGE / "cli").glob("*.py"), PACKAGE / "options" / "jobs.py"]


def walked(command, name="uwsfm"):
    """Every command with its full name."""
    yield name, command
    for part, inner in getattr(command, "commands", {}).items():
        yield from walked(inner, f"{name} {part}")


COMMANDS = dict(walked(typer.main.get_command(app)))
HELPS = {
    (name, parameter.opts[0]): (parameter, parameter.help or "")
    for name, command in COMMANDS.items()
    for parameter in command.params
}


@pytest.mark.parametrize("where", HELPS, ids=" ".join)
def test_a_help_text_stands_alone(where):
    parameter, text = HELPS[where]
    assert len(text.split()) >= 4, text
    assert re.match(r"[A-Z0-9]", text), text
    assert not text.startswith("Of "), text
    assert text.endswith("."), text
    # The help of typer shows a default that is a value. Of others the text says it.
    completes = where[1].endswith("-completion")
    if parameter.default is None and not parameter.required and not completes:
        assert "Default: " in text, text


@pytest.mark.parametrize("name", COMMANDS)
def test_the_help_of_a_command_is_a_sentence(name):
    first = COMMANDS[name].help.split("\n\n")[0]
    assert len(first.split()) >= 4 and first.endswith("."), first
    assert re.match(r"[A-Z]", first) and not first.startswith("Of "), first


@pytest.mark.parametrize("kind", JOBS)
def test_a_measured_number_has_its_unit(kind):
    """Counts have none."""
    measured = [item for item in options_of(kind) if item.type is float]
    assert measured
    for item in measured:
        assert item.declared.unit and item.metavar == item.declared.unit.upper()


def test_commands_stand_in_groups_with_the_first_steps_first():
    panels = {}
    for name, command in COMMANDS["uwsfm"].commands.items():
        panels.setdefault(command.rich_help_panel, []).append(name)
    assert list(panels) == [START, "Inspect and measure", "Export", "Research"]
    assert panels[START][:3] == ["init", "demo", "reconstruct"]


def test_no_text_has_the_banned_words():
    assert BANNED.search("The rig tells it") and not BANNED.search("the told rig")
    for _, text in HELPS.values():
        assert not BANNED.search(text), text
    for path in PRINTING:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                assert not BANNED.search(node.value), (path.name, node.value)
