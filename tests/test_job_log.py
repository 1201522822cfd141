"""uwsfm.log beside a result, and what of it reaches other handlers."""

import logging
import re

import pytest

from uwsfm._base.progress import silent
from uwsfm.errors import InputError, UwsfmError
from uwsfm.jobs.output_folder import locked
from uwsfm.results.log import LOG, job_log, log_file

logger = logging.getLogger("uwsfm")
LINE = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d,\d{3} (INFO|WARNING|ERROR) (.*)")


def lines_of(path):
    """Levels and messages; a line that has no time goes on from the one before."""
    found = []
    for line in path.read_text(encoding="utf-8").splitlines():
        match = LINE.fullmatch(line)
        if match is None:
            found[-1][1] += "\n" + line
        else:
            found.append([match[1], match[2]])
    return [tuple(each) for each in found]


def test_a_result_has_a_log_of_what_made_it(dive_result):
    lines = lines_of(dive_result.out / LOG)
    said = [message for _, message in lines]
    summary = dive_result.result.summary
    assert said[0] == f"uwsfm {summary['versions']['uwsfm']}: {summary['command']}"
    assert "lengths.yaml" in said[1] and "scene_distance_m=None" in said[1]
    assert f"pycolmap {summary['versions']['pycolmap']}" in said[2]
    assert "working folder" in said[3]
    ends = [re.fullmatch(r"(.+): (?:\d+ of \d+, )?(\d+\.\d) s", text) for text in said]
    times = {end[1]: float(end[2]) for end in ends if end is not None}
    assert {"refractive bundle adjustment", "judging the fit", "report"} <= set(times)
    assert all(said.count(step) == 1 for step in times)  # each began once
    # The summary times it, too; the log counts what is written until the next step.
    judged = summary["timings_s"]["judging the fit"]
    assert times["judging the fit"] >= judged - 0.1  # rounded
    assert f"verdict: {summary['verdict']}" in said
    for note in summary["warnings"]:
        assert f"note: {note}" in said
    assert said[-1] == "done"


def test_a_mistake_of_the_users_is_a_sentence_and_another_error_a_traceback(tmp_path):
    path = tmp_path / LOG
    with pytest.raises(InputError), log_file(path):
        raise InputError("rig.yaml: a key is wrong")
    assert lines_of(path) == [("ERROR", "failed: rig.yaml: a key is wrong")]
    with pytest.raises(ZeroDivisionError), log_file(path):
        raise ZeroDivisionError("by nought")
    with pytest.raises(KeyboardInterrupt), log_file(path):
        raise KeyboardInterrupt
    _, trace, sentence, interrupted = lines_of(path)  # the first run's is still there
    assert trace[1].startswith("Traceback") and "test_job_log.py" in trace[1]
    assert sentence == ("ERROR", "failed: by nought")
    assert interrupted == ("ERROR", "interrupted")


@pytest.mark.parametrize(
    ("level", "reach"), [(logging.WARNING, ["b"]), (logging.INFO, ["a", "b"])]
)
def test_handlers_of_the_program_get_what_they_would_get(
    tmp_path, caplog, level, reach
):
    """The file takes more than the program shows, and failures alone."""
    root = logging.getLogger()
    caplog.set_level(level)
    before = (logger.level, logger.propagate, [*logger.handlers])
    with pytest.raises(UwsfmError), log_file(tmp_path / LOG), log_file(tmp_path / LOG):
        logger.info("a")
        logging.getLogger("uwsfm.sfm").warning("b")
        raise UwsfmError("no map")
    assert caplog.messages == reach
    said = [message for _, message in lines_of(tmp_path / LOG)]
    assert said[:2] == ["a", "b"] and said[-1] == "failed: no map" and len(said) == 4
    assert (logger.level, logger.propagate, logger.handlers) == before
    assert root.level == level


def test_steps_are_logged_and_passed_on(tmp_path, caplog):
    """In Python, whoever turns logging on sees them."""
    caplog.set_level(logging.INFO)
    seen = []
    with job_log(
        tmp_path, None, {"a": 1, "progress": silent}, lambda *s: seen.append(s)
    ) as log:
        log.progress("features", 0, 4)
        log.progress("features", 4, 4)
        log.progress("adjusting", 0, None)
    assert seen == [("features", 0, 4), ("features", 4, 4), ("adjusting", 0, None)]
    steps = [re.sub(r"\d\.\d s", "T", text) for text in caplog.messages[4:]]
    assert steps == ["features", "features: 4 of 4, T", "adjusting", "adjusting: T"]
    assert caplog.messages[1] == "options: a=1"


def test_a_run_that_leaves_nothing_leaves_no_log(tmp_path):
    """But for an error that no sentence explains: its traceback is in there."""
    out = tmp_path / "new" / "out"
    with pytest.raises(InputError), locked(out), job_log(out, None, {}, silent):
        raise InputError("an image is blank")
    assert not any(tmp_path.iterdir())
    with pytest.raises(IndexError), locked(out), job_log(out, None, {}, silent):
        raise IndexError
    assert "Traceback" in (out / LOG).read_text()
