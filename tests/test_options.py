"""An option is declared once: the command line, files and reports follow from it."""

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import pytest
import typer
import yaml
from command_line import one_sentence, run
from typer.testing import CliRunner

import uwsfm
from uwsfm import InputError
from uwsfm._base.options import group, option, option_named, options_of
from uwsfm.cli.app import app
from uwsfm.cli.options import NOT_GIVEN, takes
from uwsfm.jobs.dives_file import DiveEntry, OptionsEntry, options_entry
from uwsfm.options.file import OPTIONS, write_options
from uwsfm.options.jobs import (
    CalibrateHousingOptions,
    ReconstructOptions,
    RefineOptions,
)
from uwsfm.report.command import command_line
from uwsfm.sfm.options import MatchOptions, StartOptions

JOBS = {
    "reconstruct": ReconstructOptions,
    "refine": RefineOptions,
    "calibrate": CalibrateHousingOptions,
}
COMMON = {
    "positions": Path("a dive/nav.csv"),
    "lever_arm": (-0.25, 0.0, 1e-5),
    "lengths": Path("bars.yaml"),
    "scene_distance_m": 2.0,
    "refine": ("focal", "water-index"),
    "prior": {"focal_stddev": 1e-3, "water_index_stddev": 0.002},
}
CHANGED = {
    "reconstruct": {**COMMON, "clahe": True, "seed": 7, "report": False},
    "refine": {**COMMON, "images": Path("photos"), "report": False},
    "calibrate": {**COMMON, "strategy": "nested", "mapper": "refractive"},
}
"""Options that are not at their defaults, of every kind."""


@dataclass(frozen=True, kw_only=True)
class TideOptions:
    """A group that somebody adds."""

    tide: Literal["ebb", "flow"] = option("ebb", help="Tide during the whole dive.")


@dataclass(frozen=True, kw_only=True)
class WithTide(ReconstructOptions):
    """The declaration, and nothing else: all that the tests below know of it."""

    salinity_ppt: float = option(
        35.0, flag="--salinity", unit="ppt", help="Salinity of the sea water there."
    )
    water: TideOptions = group(TideOptions, "Water")


@pytest.fixture
def commands():
    """A program of one command, and the options that it was called with."""
    seen = []
    program = typer.Typer()

    @program.command()
    @takes(WithTide)
    def dive(out: Path, options: WithTide) -> None:
        seen.append(options)

    return program, seen


def test_an_option_that_is_declared_is_everywhere(commands, tmp_path):
    program, seen = commands
    text = " ".join(CliRunner().invoke(program, ["--help"]).output.split())
    assert "--salinity" in text and "PPT" in text and "35.0" in text
    assert "Tide during" in text and "Water" in text
    options = WithTide.of(salinity_ppt=33.5, tide="flow")
    assert options.water.tide == "flow"
    # the command in the report
    line = command_line("dive", (), tmp_path, options)
    assert line.endswith("--salinity 33.5 --tide flow")
    words = shlex.split(line)[4:]
    assert CliRunner().invoke(program, [str(tmp_path), *words]).exit_code == 0
    assert seen.pop() == options
    # options.yaml, which --config reads
    write_options(options, tmp_path / OPTIONS)
    written = yaml.safe_load((tmp_path / OPTIONS).read_text())
    assert (written["salinity_ppt"], written["tide"]) == (33.5, "flow")
    config = ["--config", str(tmp_path / OPTIONS)]
    done = CliRunner().invoke(program, [str(tmp_path), *config])
    assert done.exit_code == 0, done.output
    assert seen.pop() == options
    # dives.yaml
    entry = options_entry(WithTide).model_validate({"salinity_ppt": 33.5})
    assert entry.model_dump(exclude_none=True) == {"salinity_ppt": 33.5}


@pytest.mark.parametrize("command", JOBS)
def test_a_command_has_the_options_that_are_declared(command):
    kind = JOBS[command]
    found = typer.main.get_command(app).commands[command]
    flags = {name: parameter for parameter in found.params for name in parameter.opts}
    for item in options_of(kind):
        parameter = flags.pop(item.flag)
        assert parameter.name == item.name and parameter.help == item.declared.help
        expected = None if item.default in NOT_GIVEN else item.default
        assert parameter.default == expected
    rest = {"--out", "-o", "--config"}
    assert {name for name in flags if name.startswith("-")} == rest


def test_a_dive_of_a_batch_has_the_options_of_a_reconstruction():
    names = {option.name for option in options_of(ReconstructOptions)}
    assert set(OptionsEntry.model_fields) == names - {"num_threads", "scheduler"}
    assert DiveEntry.model_fields["options"].annotation is OptionsEntry


@pytest.mark.parametrize("command", JOBS)
def test_the_options_of_a_result_can_be_given_again(command, tmp_path):
    """As Python's, as a file's, and as the command of the report; paths as given."""
    options = JOBS[command].of(**CHANGED[command])
    write_options(options, tmp_path / OPTIONS)
    data = yaml.safe_load((tmp_path / OPTIONS).read_text())
    assert data["positions"] == "a dive/nav.csv"
    assert JOBS[command].of(**data) == options
    seen = []
    program = typer.Typer()

    @program.command()
    @takes(JOBS[command])
    def job(options) -> None:
        seen.append(options)

    line = command_line(command, (), tmp_path, options)
    for words in (["--config", str(tmp_path / OPTIONS)], shlex.split(line)[4:]):
        done = CliRunner().invoke(program, words)
        assert done.exit_code == 0, done.output
        assert seen.pop() == options
    # What is typed wins, and a list replaces a list.
    words = ["--config", str(tmp_path / OPTIONS), "--refine", "distortion"]
    words += ["--scene-distance", "3"]
    assert CliRunner().invoke(program, words).exit_code == 0
    changes = {"refine": ["distortion"], "scene_distance_m": 3.0}
    assert seen.pop() == options.with_settings(changes)
    if command == "reconstruct":
        del data["num_threads"], data["scheduler"]
        OptionsEntry.model_validate(data)


def refused(tmp_path, text: str) -> str:
    """What the command line says of a file of options."""
    (tmp_path / "mine.yaml").write_text(text)
    done = run(
        "reconstruct", "r", "i", "--config", "mine.yaml", "-o", "o", cwd=tmp_path
    )
    one_sentence(done, "error: mine.yaml: ")
    return done.stderr.strip().removeprefix("error: mine.yaml: ")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("thread: 3", "thread: unknown key, did you mean num_threads?"),
        ("max-features: 3000", "max-features: unknown key, did you mean max_features?"),
        ("xyz: 1", "xyz: unknown key, known are out, positions, lever_arm, le"),
        ("seed: [1, 2]", "seed: must be one value, not [1, 2]"),
        ("refine: focal", "refine: must be a list, not 'focal'"),
        ("prior: 3", "prior: must be a block of keys, not 3"),
        ("lever_arm: [1, 2]", "--lever-arm 1,2: write three numbers X,Y,Z in metres"),
        ("prior: {focal_stddev: 5}", "--prior focal_stddev=5: 5 is no plausible stand"),
        ("prior: {focal: 1}", "--prior focal=1: the key is one of normal_stddev_deg,"),
        ("scene_distance_m: -1", "--scene-distance (scene_distance_m) must be positiv"),
        ("a: [", "line 2: not valid YAML"),
        ("", "is empty instead of keys such as 'seed: 1'"),
    ],
)
def test_a_file_of_options_is_refused_in_one_sentence(tmp_path, text, words):
    assert refused(tmp_path, text).startswith(words)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("seed", "-1"),
        ("seed", "2.5"),
        ("max_features", "many"),
        ("mapper", "stars"),
        ("clahe", "perhaps"),
        ("refine", "[stars]"),
        ("submap_frames", "3"),
    ],
)
def test_values_of_a_file_are_refused_in_the_words_of_the_command_line(
    tmp_path, key, value
):
    flag = option_named(ReconstructOptions, key).flag
    words = [flag, value.strip("[]")] if key != "clahe" else [f"--clahe={value}"]
    typed = run("reconstruct", "r", "i", "-o", "o", *words)
    assert typed.returncode == 2
    plain = " ".join(typed.stderr.replace("│", " ").split())
    sentence = refused(tmp_path, f"{key}: {value}")
    assert sentence.startswith(f"{key}: ")
    if key != "clahe":  # a switch takes no value where it is typed
        assert sentence.removeprefix(f"{key}: ") in plain


def test_options_that_are_missing_from_a_file_or_empty_are_defaults(commands, tmp_path):
    program, seen = commands
    (tmp_path / "few.yaml").write_text("positions: null\nprior:\nclahe: yes\n")
    words = [str(tmp_path), "--config", str(tmp_path / "few.yaml")]
    assert CliRunner().invoke(program, words).exit_code == 0
    assert seen.pop() == WithTide.of(clahe=True)
    assert CliRunner().invoke(program, [*words, "--no-clahe"]).exit_code == 0
    assert seen.pop() == WithTide()


def test_the_folder_for_results_may_come_from_a_file(tmp_path):
    (tmp_path / "mine.yaml").write_text("out: results\n")
    words = ("reconstruct", "rig.yaml", "images", "--config", "mine.yaml")
    one_sentence(run(*words, cwd=tmp_path), "rig.yaml")  # and not that -o is missing


def test_python_may_name_options_groups_and_fields_of_the_adjustment():
    mine = StartOptions(seed=4, mapper="pinhole")
    options = ReconstructOptions.of(front_end=mine, num_threads=2, masks="m")
    assert options.front_end.features.mask_dir == Path("m")
    assert (options.front_end.seed, options.front_end.num_threads) == (4, 2)
    both = ReconstructOptions.of(
        refine_focal=True, focal_stddev=1e-3, max_iterations=3, refine_distortion=False
    )
    assert both.adjustment.refine == ("focal",)
    assert both.adjustment.prior == {"focal_stddev": 1e-3}
    assert both.adjustment.further == {"max_iterations": 3}
    assert both.adjustment.as_fields() == {
        "refine_focal": True,
        "focal_stddev": 1e-3,
        "max_iterations": 3,
    }
    assert both.with_settings({"refine_focal": False}).adjustment.refine == ()
    assert both.with_settings({"focal_stddev": None}).adjustment.prior == {}
    one_camera = ReconstructOptions.of(refine_focal=(True, False))
    assert one_camera.adjustment.as_fields() == {"refine_focal": (True, False)}
    for name, words in (("mapperr", "mapper"), ("max_iteration", "max_iterations")):
        with pytest.raises(
            InputError, match=rf"unknown option {name}, did you mean {words}\?"
        ):
            uwsfm.reconstruct("rig.yaml", "images", "out", **{name: 1})
    with pytest.raises(InputError, match="lever_arm must be three numbers, got 3"):
        ReconstructOptions.of(lever_arm=3)


def test_python_shows_the_options_and_what_they_do():
    for kind in JOBS.values():
        for item in options_of(kind):
            assert f"    {item.name} ({item.default!r}): " in kind.__doc__


def test_a_result_has_the_options_that_it_was_made_with(dive_result):
    data = yaml.safe_load((dive_result.out / OPTIONS).read_text())
    options = RefineOptions.of(**data)
    assert options.constraints.lengths is not None
    program, command, *words = shlex.split(dive_result.result.summary["command"])
    assert (program, command) == ("uwsfm", "refine")
    assert "--lengths" in words and str(options.constraints.lengths) in words


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"max_features": 3}, "max_features must be at least 100, got 3: fewer feat"),
        ({"seed": -1}, "seed must be between 0 and 2147483647, got -1"),
        (
            {"matching": "all"},
            "matching must be one of auto, exhaustive, sequential, g",
        ),
        ({"mapper": "x"}, "mapper must be one of pinhole, refractive, got 'x'"),
        ({"num_threads": 0}, r"--threads \(num_threads\) must be positive, or -1"),
        (
            {"refine": ["x"]},
            "refine must be one of glass-thickness, .*, got 'x'",
        ),
    ],
)
def test_values_in_python_are_checked_when_they_are_given(options, words):
    with pytest.raises(InputError, match=words):
        ReconstructOptions.of(**options)


def test_what_only_python_asked_for_is_a_comment(tmp_path):
    options = ReconstructOptions.of(max_iterations=3, refine_focal=(True, False))
    write_options(options, tmp_path / OPTIONS)
    lines = (tmp_path / OPTIONS).read_text().splitlines()
    assert lines[1].startswith("# Asked for in Python, and no option: max_iterations")
    data = yaml.safe_load("\n".join(lines))
    assert ReconstructOptions.of(**data) == ReconstructOptions()


def test_defaults_are_the_same_wherever_a_job_is_started():
    """But for the start of a calibration, which is the paper's."""
    assert ReconstructOptions().front_end == StartOptions()
    assert StartOptions().mapper == "refractive"
    own = CalibrateHousingOptions().front_end
    assert own == replace(StartOptions(), mapper="pinhole")
    for job in JOBS:
        assert "mapper" not in JOBS[job]().adjustment.as_fields()
    assert MatchOptions().matcher == "colmap"
