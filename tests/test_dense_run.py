"""`uwsfm dense` from a result folder to the cloud."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dense_scenes import DenseDive, dense_dive, range_errors
from typer.testing import CliRunner

import uwsfm
from uwsfm._base.disk import DiskFullError
from uwsfm.cli.app import app
from uwsfm.dense import maps, stereo_maps
from uwsfm.dense.depth_map import DepthMap
from uwsfm.errors import InputError, UwsfmError
from uwsfm.residuals import border
from uwsfm.results.files import WORK
from uwsfm.results.log import LOG


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> DenseDive:
    return dense_dive(tmp_path_factory.mktemp("dense"))


def test_a_flat_floor_becomes_a_flat_cloud(dive: DenseDive, monkeypatch):
    made: list[int] = []
    original = stereo_maps.stereo_depth

    def stopped_at(limit: int):
        def counted(*arguments):
            if len(made) == limit:
                raise KeyboardInterrupt
            made.append(1)
            return original(*arguments)

        monkeypatch.setattr(stereo_maps, "stereo_depth", counted)

    stopped_at(2)
    with pytest.raises(KeyboardInterrupt):
        uwsfm.dense_cloud(dive.out, dive.images, num_threads=1)
    assert len(made) == 2 and not (dive.out / "dense").exists()
    _room_is_asked_for(dive, monkeypatch)
    # The same command goes on: the first two are kept.
    stopped_at(3)
    done = CliRunner().invoke(
        app, ["dense", str(dive.out), "--images", str(dive.images)]
    )
    assert done.exit_code == 0, done.output
    cloud = uwsfm.read_cloud(dive.out / "dense" / "cloud.ply")
    summary = json.loads((dive.out / "dense" / "summary.json").read_text())
    assert summary["num_points"] == len(cloud) > 20_000
    assert summary["unit"] == "metre"
    # What it will take is told before the first image.
    steps = (dive.out / LOG).read_text().split("depth maps\n")[-2].splitlines()
    assert f"plan: {summary['plan']['num_maps']} depth map" in steps[-2]
    assert summary["noise_from"] == "differences between depth maps"
    assert summary["calibration_stddev_max"]["0-1"] > 0.0
    middle = cloud.points.mean(axis=0)
    normal = np.linalg.svd(cloud.points - middle, full_matrices=False)[2][2]
    height = (cloud.points - middle) @ normal
    # What the cloud says of itself holds.
    assert np.sqrt(np.mean(height**2)) < 1.5 * np.median(cloud.stddev)
    assert np.median(np.abs(cloud.normals @ normal)) > 0.99
    assert np.all(cloud.num_views >= 2)


@pytest.mark.parametrize("case", ["patchmatch", "reduced pairs"])
def test_other_ways_to_the_same_floor(dive: DenseDive, tmp_path, monkeypatch, case):
    """Images of both cameras compared with all others, and pairs at half their size."""
    shutil.copytree(dive.out, tmp_path / "out")
    options = {"matcher": "patchmatch"}
    if case != "patchmatch":
        options = {"matcher": "stereo"}
        lens = dive.truth.cameras[0]
        pixels = dict.fromkeys(maps.MAX_STEREO_PIXELS, lens.width * lens.height / 2)
        monkeypatch.setattr(maps, "MAX_STEREO_PIXELS", pixels)
    made = uwsfm.dense_cloud(tmp_path / "out", dive.images, **options)
    expected = 6 if case == "patchmatch" else 3
    assert len(made.summary["depth_maps"]) == expected
    if case == "patchmatch":
        # Those of the other camera are among the neighbours, and so are other frames.
        compared = made.summary["depth_maps"][0]["compared_with"]
        assert {"left", "right"} == {Path(name).parent.name for name in compared}
    else:
        shape = made.summary["plan"]["megapixels"] * 1e6
        assert shape == pytest.approx(lens.width * lens.height / 4, rel=0.02)
    assert made.summary["calibration_stddev_max"]["0-1"] > 0.0
    cloud = made.cloud
    middle = cloud.points.mean(axis=0)
    normal = np.linalg.svd(cloud.points - middle, full_matrices=False)[2][2]
    height = np.abs((cloud.points - middle) @ normal)
    # 0.67 if errors were normal. Those of neighbouring depths are alike, and 36 % less
    # or 30 % more is what three frames leave. Depth maps by PatchMatch are all of the
    # same images here: half of their errors counts as common, too much on a plane.
    least = 0.43 if case != "patchmatch" else 0.43 * np.sqrt(0.5)
    assert least < np.median(height / cloud.stddev) < 0.88
    assert np.median(height) < (0.0003 if case == "patchmatch" else 0.0006)
    assert np.median(np.abs(cloud.normals @ normal)) > 0.99


def test_each_depth_has_the_deviation_of_its_own_pixel(dive_result):
    """The right port is uncertain by 2 mm, and nothing else, over all of the image."""
    result = uwsfm.open_result(dive_result.out)
    scene, covariance = result.model.scene, result.calibration.covariance
    column = covariance.border_cols[1, border.DISTANCE]
    only = np.zeros_like(covariance.border)
    only[column, column] = 0.002**2
    uncertain = replace(result.calibration, covariance=replace(covariance, border=only))
    depths = maps.DepthMaps(replace(result, calibration=uncertain), Path("images"))
    depths.prepare_errors()
    index = [view.pair for view in depths.views].index((0, 1))
    ranges = np.full((600, 800), 1.6, dtype=np.float32)
    ranges[300:, :] = 2.1  # a step across the image
    found = depths._calibration(index, DepthMap(ranges=ranges, sensitivity=ranges))
    columns, rows = (n.ravel() for n in np.meshgrid([150, 400, 650], [120, 280, 470]))
    xy = np.column_stack([columns, rows]) + 0.5
    expected = range_errors(scene, (0.0, 0.002), xy, ranges[rows, columns])
    # Between the nodes of a grid of 9 x 7 pixels and four ranges.
    np.testing.assert_allclose(found[rows, columns], np.abs(expected), rtol=0.1)
    assert np.ptp(expected) > 0.3 * np.abs(expected).max()  # no constant would do


def _room_is_asked_for(dive: DenseDive, monkeypatch) -> None:
    """Two depth maps are there: the others are as large."""
    there = list((dive.out / WORK / maps.FOLDER).glob("*.npz"))
    assert len(there) == 2
    asked = maps.DepthMaps(uwsfm.open_result(dive.out, dive.images), dive.images)
    missing = len(asked.views) - len(there)
    size = np.mean([path.stat().st_size for path in there])
    # Names, shapes and the key take less than two kilobytes.
    assert 0 <= missing * size - asked.missing_bytes() < 2000 * missing
    with monkeypatch.context() as patch:
        patch.setattr("uwsfm._base.disk.room", lambda folder: 1_000_000)
        with pytest.raises(DiskFullError, match="making depth maps takes"):
            uwsfm.dense_cloud(dive.out, dive.images, progress=_no_work)


def _no_work(step: str, done: int, total: int) -> None:
    raise AssertionError(f"{step} was begun")


def test_wrong_input_is_told_in_one_sentence(dive: DenseDive, tmp_path):
    images = tmp_path / "images"
    shutil.copytree(dive.images, images)
    first = next(iter(sorted((images / "left").iterdir())))
    for options, words in (
        ({"max_memory": 1e7}, "--max-memory 0.01GB is too little"),
        ({"voxels": 1}, "unknown option voxels"),
        ({"matcher": "sgm"}, "--matcher must be one of auto, stereo, patchmatch"),
        ({"noise_px": -1.0}, "--noise-px must be positive"),
        ({"min_views": 99}, "--min-views 99: there are [0-9]+ depth maps"),
        # No two depth maps agree to a millionth of a pixel.
        ({"noise_px": 1e-9}, "no point is confirmed by 2 depth maps: of [1-9]"),
    ):
        with pytest.raises(UwsfmError, match=words):
            uwsfm.dense_cloud(dive.out, images, **options)
    with pytest.raises(InputError, match="say with --images"):
        uwsfm.dense_cloud(dive.out)
    last = sorted((images / "left").iterdir())[-1]
    os.replace(last, tmp_path / "last")
    with pytest.raises(InputError, match=last.name):
        uwsfm.dense_cloud(dive.out, images, progress=_no_work)
    os.replace(first, tmp_path / "away")
    with pytest.raises(InputError, match=f"{first.name}"):
        uwsfm.dense_cloud(dive.out, images)
