"""Plain lines of progress, by a clock that the test moves."""

import builtins
import io
import re
import sys

import pytest
from command_line import run
from rich.console import Console

from uwsfm._base.progress_display import (
    HEARTBEAT_SECONDS,
    LINE_SECONDS,
    Bars,
    PlainLines,
    display,
    notebook_display,
)


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def lines():
    """Plain lines whose watch never starts, their clock and what they wrote."""
    clock, stream = Clock(), io.StringIO()
    plain = PlainLines(stream, clock)
    plain._watch.run = lambda: None
    return plain, clock, stream


def test_a_line_has_the_step_its_count_and_the_time_left(lines):
    plain, clock, stream = lines
    plain("mapping", 0, 14)
    clock.now += 20.0
    plain("mapping", 4, 14)
    clock.now += 10.0
    plain("mapping", 14, 14)
    assert stream.getvalue().splitlines() == [
        "mapping 0/14, 0 s",
        "mapping 4/14, 20 s, about 50 s left",  # 10 more at 5 s each
        "mapping 14/14, 30 s",
    ]


def test_what_an_earlier_run_did_sets_no_pace(lines):
    plain, clock, stream = lines
    plain("matching", 900, 1000)
    clock.now += 10.0
    plain("matching", 910, 1000)
    assert stream.getvalue().endswith("matching 910/1000, 10 s, about 90 s left\n")


def test_lines_keep_their_distance_and_the_last_state_is_shown(lines):
    """A thousand reports in 50 seconds, and the end of a step that comes too soon."""
    plain, clock, stream = lines
    times = []
    for k in range(1000):
        clock.now += 0.05
        before = stream.tell()
        plain(f"step {k // 100}", k % 100, 100)
        times += [clock.now] if stream.tell() > before else []
    assert min(b - a for a, b in zip(times, times[1:], strict=False)) >= LINE_SECONDS
    assert len(times) >= 50.0 / (LINE_SECONDS + 0.1)
    clock.now += LINE_SECONDS
    plain.tick()
    assert stream.getvalue().splitlines()[-1].startswith("step 9 99/100")


def test_a_step_without_reports_shows_that_it_runs(lines):
    plain, clock, stream = lines
    plain("judging the fit", 0, None)
    clock.now += 0.99 * HEARTBEAT_SECONDS
    plain.tick()
    assert stream.getvalue() == "judging the fit, 0 s\n"
    clock.now += 0.02 * HEARTBEAT_SECONDS
    plain.tick()
    assert stream.getvalue().splitlines()[1] == "judging the fit, 61 s"


@pytest.mark.parametrize(
    ("seconds", "words"), [(98, "98 s"), (120, "2 min"), (7_500, "2 h 05 min")]
)
def test_durations_are_in_words(lines, seconds, words):
    plain, clock, stream = lines
    plain("waiting", 0, None)
    clock.now += seconds
    plain.tick()
    assert stream.getvalue().endswith(f"waiting, {words}\n")


def test_a_command_whose_output_is_piped_shows_lines(dive_result, tmp_path):
    """Its first step has one, whatever the machine; steps that are over soon have not.
    Tables stay on the other stream."""
    dive, out = dive_result.out.parent, tmp_path / "out"
    files = str(dive / "model"), str(dive / "rig.yaml"), "-o", str(out)
    found = run("refine", *files, "--no-report")
    assert found.returncode == 0, found.stderr
    lines = found.stderr.splitlines()
    assert re.fullmatch(r"[a-z][a-z ()]*( \d+/\d+)?, 0 s", lines[0]), found.stderr
    assert all(", " in line and "\x1b" not in line for line in lines)
    assert "verdict" in found.stdout and lines[0] not in found.stdout


def test_a_terminal_and_a_notebook_show_bars(monkeypatch):
    assert isinstance(display(Console(force_terminal=True)), Bars)
    assert isinstance(display(Console(force_terminal=False)), PlainLines)
    with notebook_display() as shown:
        assert shown is None  # this is neither

    class ZMQInteractiveShell:
        """What Jupyter's kernel calls itself, by which rich knows it."""

    monkeypatch.setitem(sys.modules, "IPython", sys)
    monkeypatch.setattr(builtins, "get_ipython", ZMQInteractiveShell, raising=False)
    widgets = "ipywidgets" in sys.modules or _installed("ipywidgets")
    with notebook_display() as shown:
        assert isinstance(shown, Bars if widgets else PlainLines)


def _installed(name: str) -> bool:
    import importlib.util

    return importlib.util.find_spec(name) is not None
