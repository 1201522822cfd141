"""Every option of a command reaches the job, under its own name and with its value."""

import importlib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from uwsfm._base.options import options_of
from uwsfm.cli.app import app
from uwsfm.measuring.picks import PointPick
from uwsfm.options.jobs import (
    CalibrateHousingOptions,
    ReconstructOptions,
    RefineOptions,
)
from uwsfm.sfm.options import FeatureOptions, MatchOptions, StartOptions

KNOWN = "--positions nav.csv --lever-arm 1,-2,3 --lengths bars.yaml"
KNOWN_AS = {
    "positions": Path("nav.csv"),
    "lever_arm": (1.0, -2.0, 3.0),
    "lengths": Path("bars.yaml"),
}
CALIBRATION = "--refine focal --prior distance_stddev_m=0.003 --scene-distance 1.7"
CALIBRATION_AS = {
    "refine_focal": True,
    "distance_stddev_m": 0.003,
    "scene_distance_m": 1.7,
}

PICKS = [PointPick(3), PointPick(4)]

# Command line; the job's module and name; its positional arguments; its options, by
# name: of the class that is the last positional argument, or else its other arguments.
# No value is a default, and no two numbers are the same.
COMMANDS = {
    "reconstruct": (
        "rig.yaml photos -o out --clahe --max-features 777 --masks masks --matching "
        "sequential --matcher paper --mapper pinhole --seed 5 --threads 3 "
        f"--submap-frames 44 --scheduler tcp://host:1 --no-report {KNOWN} "
        f"{CALIBRATION}",
        "uwsfm.jobs.reconstruct reconstruct",
        (Path("rig.yaml"), Path("photos"), Path("out")),
        ReconstructOptions,
        {
            "clahe": True,
            "max_features": 777,
            "masks": Path("masks"),
            "matching": "sequential",
            "matcher": "paper",
            "mapper": "pinhole",
            "seed": 5,
            "num_threads": 3,
            "submap_frames": 44,
            "scheduler": "tcp://host:1",
            "report": False,
            **KNOWN_AS,
            **CALIBRATION_AS,
        },
    ),
    "refine": (
        "sparse rig.yaml -o out --images photos --database db.db --no-report "
        f"{KNOWN} {CALIBRATION}",
        "uwsfm.jobs.refine_model refine_model",
        (Path("sparse"), Path("rig.yaml"), Path("out")),
        RefineOptions,
        {
            "images": Path("photos"),
            "database": Path("db.db"),
            "report": False,
            **KNOWN_AS,
            **CALIBRATION_AS,
        },
    ),
    "calibrate": (
        "rig.yaml photos -o out --strategy nested --error point_3d --start paper "
        "--matcher paper --fundamental-max-error 9 --mapper refractive --max-features "
        f"777 --seed 5 --threads 3 {KNOWN} {CALIBRATION}",
        "uwsfm.jobs.calibrate_housing calibrate_housing",
        (Path("rig.yaml"), Path("photos"), Path("out")),
        CalibrateHousingOptions,
        {
            "strategy": "nested",
            "error": "point_3d",
            "start": "paper",
            "front_end": StartOptions(
                features=FeatureOptions(max_num_features=777),
                matching=MatchOptions(matcher="paper", fundamental_max_error_px=9.0),
                seed=5,
                num_threads=3,
            ),
            **KNOWN_AS,
            **CALIBRATION_AS,
        },
    ),
    "dense": (
        "out --images photos --voxel 0.002 --min-views 3 --keep-single --noise-px 0.7 "
        "--max-memory 5GB --threads 4 --quality low --matcher patchmatch",
        "uwsfm.dense.run dense_cloud",
        (Path("out"), Path("photos")),
        None,
        {
            "voxel": 0.002,
            "min_views": 3,
            "keep_single": True,
            "noise_px": 0.7,
            "max_memory": 5 * 10**9,
            "num_threads": 4,
            "quality": "low",
            "matcher": "patchmatch",
        },
    ),
    "measure": (
        "out --from 3 --to 4 --known 0.6 --click-stddev 0.9 -o m.json",
        "uwsfm.measuring.measure measure",
        (
            Path("out"),
            {
                "version": 1,
                "click_stddev_px": 0.9,
                "scale_bars": [{"name": "distance", "ends": PICKS, "length_m": 0.6}],
            },
            Path("m.json"),
        ),
        None,
        {},
    ),
}


class Reached(Exception):
    """The job would begin here."""


def call(monkeypatch, command, line, job):
    """Positional and other arguments of the job that a command line starts."""
    calls = []

    def recorded(*args, **options):
        calls.append((args, options))
        raise Reached

    module, name = job.split()
    monkeypatch.setattr(importlib.import_module(module), name, recorded)
    done = CliRunner().invoke(app, [command, *line.split()])
    assert isinstance(done.exception, Reached), done.output
    (found,) = calls
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_options_reach_the_job(command, monkeypatch):
    line, job, expected_args, kind, expected = COMMANDS[command]
    args, options = call(monkeypatch, command, line, job)
    options.pop("progress", None)
    if kind is not None:
        *args, found = args
        assert found == kind.of(**expected) and options == {}
        by_name = {option.name for option in options_of(kind)}
        assert len(by_name & set(expected)) > 5
    else:
        assert options == expected
    assert tuple(args) == expected_args
