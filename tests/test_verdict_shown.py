"""The verdict where people read it: first, everywhere the same, and never outdone."""

import io
import json
import os
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from sfm_scenes import model_of, simulated_dive
from typer import Exit
from typer.testing import CliRunner

from uwsfm.cli.app import app
from uwsfm.cli.results import NO_FIT, finish
from uwsfm.cli.tables import batch_table
from uwsfm.errors import InputError
from uwsfm.jobs.batch import Outcome, cause_of
from uwsfm.report.gather import PAGE
from uwsfm.results.files import HOUSING, SUMMARY, export_colmap
from uwsfm.results.verdict_summary import verdict_line, with_verdict
from uwsfm.rig.file import dump_rig, load_rig
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.trust.reason import DOUBTFUL, reason


@pytest.fixture(scope="module")
def wrong_dive(tmp_path_factory):
    """`uwsfm refine` of a dive whose baseline is ten times too long, as printed."""
    folder = tmp_path_factory.mktemp("wrong")
    rig = nominal_rig(sample_rig())
    scene = simulated_dive(num_frames=6, num_points=400).scene
    export_colmap(model_of(sample_rig(), scene), folder / "model")
    poses = rig.cam_from_rig.copy()
    poses[:, 4:] *= 10.0
    long = replace(rig, cam_from_rig=poses, baseline_m=10.0 * rig.baseline_m)
    dump_rig(long, folder / "rig.yaml")
    arguments = [str(folder / name) for name in ("model", "rig.yaml")]
    out = folder / "out"
    found = CliRunner().invoke(app, ["refine", *arguments, "-o", str(out)])
    return found, out


def own_text(page: str) -> str:
    """The text of a page that is not a script's, without tags."""
    body = page[page.index("<body>") : page.index('<script type="application/json"')]
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", body))


def test_what_does_not_fit_is_written_and_ends_with_its_own_code(wrong_dive):
    found, out = wrong_dive
    assert found.exit_code == NO_FIT == 3, found.output
    summary = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
    assert list(summary)[:4] == ["schema_version", "verdict", "reasons", "goodness"]
    assert summary["verdict"] == "does not fit"
    for name in (HOUSING, PAGE, "points.ply", "calibration.npz"):
        assert (out / name).is_file()
    first = next(line for line in found.stdout.splitlines() if line.strip())
    assert first == verdict_line(summary).rstrip()
    assert first.startswith("Verdict: does not fit")
    for item in summary["reasons"]:
        assert item["severity"] in ("doubtful", "does not fit")
    (left, *_) = summary["reasons"]
    assert left["code"] == "port_distance" and "times the given one" in left["text"]


def test_no_job_takes_the_housing_of_it_as_given(wrong_dive, tmp_path):
    _, out = wrong_dive
    again = CliRunner().invoke(
        app, ["refine", str(out), str(out / HOUSING), "-o", str(tmp_path / "next")]
    )
    assert isinstance(again.exception, InputError) and not (tmp_path / "next").exists()
    assert str(again.exception).startswith(f"{out / HOUSING}: verdict: does not fit:")
    assert load_rig(out / HOUSING).verdict == "does not fit"  # still readable
    assert load_rig(out / "rig_given.yaml").verdict == "fits"


def test_no_number_of_it_is_called_determined_or_metric(wrong_dive):
    found, out = wrong_dive
    page = own_text((out / PAGE).read_text(encoding="utf-8"))
    texts = {
        "console": found.stdout,
        "summary": (out / SUMMARY).read_text(encoding="utf-8"),
        HOUSING: (out / HOUSING).read_text(encoding="utf-8"),
        "page": page,
    }
    for name, text in texts.items():
        text = text.replace("weakly determined", "").replace("not determined", "")
        assert "determined" not in text, name
        assert "withheld" in text or name == HOUSING, name
    assert "The model is metric" not in page
    assert (
        "badge good" not in (out / PAGE).read_text(encoding="utf-8").split("<main>")[1]
    )
    assert page.index("Verdict: does not fit") < page.index("Estimates")


def test_measure_and_report_say_the_same_of_the_stored_result(wrong_dive):
    _, out = wrong_dive
    before = own_text((out / PAGE).read_text(encoding="utf-8"))
    runner = CliRunner()
    assert runner.invoke(app, ["report", str(out)]).exit_code == 0
    after = own_text((out / PAGE).read_text(encoding="utf-8"))
    line = verdict_line(json.loads((out / SUMMARY).read_text(encoding="utf-8")))
    assert line in before and line in after
    picks = ["--from", "1", "--to", "2"]
    found = runner.invoke(app, ["measure", str(out), *picks])
    told = " ".join(found.output.split())
    assert "the verdict on this result is 'does not fit'" in told, found.exception


def test_what_fits_is_said_first_and_keeps_its_words(dive_result):
    summary = dive_result.result.summary
    assert list(summary)[:4] == ["schema_version", "verdict", "reasons", "goodness"]
    assert summary["verdict"] == dive_result.result.verdict.verdict == "fits"
    assert summary["reasons"] == []
    assert summary["scale"]["verdict"] == "determined"
    page = (dive_result.out / PAGE).read_text(encoding="utf-8")
    line = "Verdict: fits. The model explains the images within their noise. Its scale"
    assert line in own_text(page)
    assert own_text(page).index(line) < own_text(page).index("Estimates")


def test_the_numbers_of_the_summary_are_those_of_the_result(dive_result):
    stored = json.loads((dive_result.out / SUMMARY).read_text(encoding="utf-8"))
    goodness, scene = stored["goodness"], dive_result.result.model.scene
    residuals = scene.residuals()
    # The model that is written holds the observations that were used, as doubles.
    rms = np.sqrt(np.mean(np.sum(residuals**2, axis=1)))
    assert goodness["rms_px"] == pytest.approx(rms, rel=1e-9)
    assert goodness["sigma_px"] == stored["sigma_px"]
    assert goodness["used"]["num_kept"] == scene.num_observations
    assert goodness["used"]["num_registered"] == scene.num_frames
    assert [part["by"] for part in goodness["parts"]] == [
        "place",
        "depth",
        "row",
        "camera",
        "time",
        "image",
    ]
    for item in goodness["departures"]:
        if item["what"] == "distance_m":
            (camera,) = [c for c in stored["cameras"] if c["name"] == item["camera"]]
            assert item["estimate"] == camera["distance_m"]
            assert item["stddev"] == camera["distance_stddev_m"]


def test_a_doubtful_result_has_weaker_words(dive_result):
    result = dive_result.result
    because = reason("few_frames", "Only 2 of 9 frames are registered.", DOUBTFUL)
    verdict = replace(result.verdict, verdict=DOUBTFUL, reasons=(because,))
    summary = with_verdict(verdict, result.summary)
    assert (
        summary["verdict"] == "doubtful" and summary["scale"]["verdict"] == "doubtful"
    )
    assert {c["distance_verdict"] for c in summary["cameras"]} == {"doubtful"}
    assert verdict_line(summary) == "Verdict: doubtful, for one reason."


@pytest.mark.slow
def test_check_ends_as_the_verdict_does(wrong_dive):
    """Every mistake is tried before it ends."""
    _, out = wrong_dive
    found = CliRunner().invoke(app, ["check", str(out)])
    assert found.exit_code == NO_FIT, found.output
    assert found.stdout.startswith("Verdict: does not fit")


def test_every_job_ends_as_its_verdict_does(capsys):
    for word in ("fits", "doubtful"):
        finish({"verdict": word}, "results in out")
    with pytest.raises(Exit) as ended:
        finish({"verdict": "does not fit"}, "results in out")
    assert ended.value.exit_code == NO_FIT
    assert capsys.readouterr().out == 3 * "results in out\n"


def test_every_rms_says_of_what_it_is(wrong_dive):
    found, _ = wrong_dive
    text = " ".join(found.stdout.split())
    assert "RMS error of these observations" in text
    assert "best 90 % of a sample of the observations" in text


def test_batch_shows_the_named_cause_or_else_the_first_reason():
    reasons = [{"text": "The residuals repeat."}]
    cause = [{"text": "Probably the baseline is in another unit."}]
    assert cause_of({"explanations": cause, "reasons": reasons}) == cause[0]["text"]
    assert cause_of({"explanations": [], "reasons": reasons}) == reasons[0]["text"]
    assert cause_of({"explanations": [], "reasons": []}) is None


def test_a_pipe_is_wide_enough_and_a_terminal_as_wide_as_it_is():
    script = "from uwsfm.cli.console import console; print(console.width)"
    for columns, expected in ((None, "200"), ("80", "80")):
        environment = {k: v for k, v in os.environ.items() if k != "COLUMNS"}
        if columns is not None:
            environment["COLUMNS"] = columns
        found = subprocess.run(
            [sys.executable, "-c", script],
            capture_output=True,
            text=True,
            env=environment,
            check=True,
        )
        assert found.stdout.strip() == expected


def test_batch_shows_the_verdict_of_each_dive():
    outcomes = [
        Outcome(name="bow", reason=None, seconds=60.0, verdict="fits"),
        Outcome(
            name="stern",
            reason=None,
            seconds=60.0,
            verdict="does not fit",
            cause="Camera left: the port came out at 431 mm.",
        ),
        Outcome(name="keel", reason="no images", seconds=1.0),
    ]
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(batch_table(outcomes))
    bow, stern, keel = (
        line for line in console.export_text().splitlines() if "│" in line
    )
    assert "fits" in bow and "does not fit" not in bow
    assert "does not fit" in stern and "the port came out at 431 mm" in stern
    assert "failed: no images" in keel and "fit" not in keel
