"""Cleaning takes out what is bad, says how much, and keeps the columns."""

import json
from pathlib import Path

import numpy as np
import pytest

from uwsfm._base.ply import read_vertices
from uwsfm.cloud import Cloud, read_cloud, write_cloud
from uwsfm.errors import InputError
from uwsfm.simulate.relief import Relief
from uwsfm.surface.clean import CleanOptions, clean_points, outliers
from uwsfm.surface.commands import clean_cloud

NUM_BAD = 40


def floor_cloud(rng: np.random.Generator, count: int = 4000) -> Cloud:
    """Points of a relief, four times denser on one side, with known deviations."""
    xy = rng.uniform(-1.0, 1.0, (count, 2))
    xy[: count // 2] = 0.5 * xy[: count // 2] + [0.5, 0.0]
    relief = Relief(stddev=0.05, correlation_length=0.4)
    return Cloud(
        points=relief.points(xy),
        normals=relief.normals(xy),
        colors=rng.integers(0, 256, (count, 3)).astype(np.uint8),
        stddev=np.full(count, 0.002),
        num_views=np.full(count, 3),
        view_range=np.full(count, 2.0),
    )


def test_each_filter_takes_out_its_points_and_counts_them(tmp_path: Path, rng):
    cloud = floor_cloud(rng)
    # Each kind of bad point is good in all other ways; some have no deviation at all.
    kinds = np.arange(len(cloud)) // NUM_BAD
    cloud.points[kinds == 0] += rng.uniform(0.5, 1.5, (NUM_BAD, 3)) * [3.0, 3.0, -1.0]
    cloud.num_views[kinds == 1] = 1
    cloud.stddev[kinds == 2] = 0.05
    cloud.stddev[kinds == 3] = np.nan
    cloud.points[kinds == 4] = np.nan
    write_cloud(cloud, tmp_path / "cloud.ply", "scale arbitrary")
    report = clean_cloud(tmp_path / "cloud.ply", tmp_path / "clean.ply")
    removed = {item["name"]: item["num_removed"] for item in report["filters"]}
    assert removed.pop("neighbours") == pytest.approx(NUM_BAD, abs=10)
    removed.pop("connected with the main surface")
    assert removed == {
        "position is finite": NUM_BAD,
        "views": NUM_BAD,
        "standard deviation / range": 2 * NUM_BAD,
    }
    assert report["filters"][2]["num_unknown"] == NUM_BAD
    assert json.loads((tmp_path / "clean.json").read_text()) == report
    table, comments = read_vertices(tmp_path / "clean.ply")
    assert len(table) == report["num_kept"]
    assert comments == ["unit: scale arbitrary; made by uwsfm clean"]
    kept = read_cloud(tmp_path / "clean.ply")
    assert np.abs(kept.points[:, 2]).max() < 0.25  # 5 standard deviations of the relief


def test_strays_are_found_whatever_their_number_and_the_density(rng):
    floor = floor_cloud(rng).points
    stray = rng.uniform([-1.0, -1.0, -1.5], [1.0, 1.0, -0.5], (200, 3))
    found = outliers(np.concatenate([floor, stray]), 16, 4.0)
    assert np.mean(found[len(floor) :]) > 0.95
    # The sparse half is not thrown away; its corners have fewer neighbours.
    assert np.mean(found[: len(floor)]) < 0.005


def test_a_limit_on_what_a_cloud_lacks_is_refused(tmp_path: Path, rng):
    cloud = floor_cloud(rng, 50)
    table = np.rec.fromarrays(cloud.points.T, names="x,y,z")
    with pytest.raises(InputError, match="holds no reprojection error"):
        clean_points(table, CleanOptions(max_error_px=1.0))
    table = np.rec.fromarrays([*cloud.points.T, cloud.stddev], names="x,y,z,stddev")
    with pytest.raises(InputError, match=r"no range.*leave --max-relative-stddev out"):
        clean_points(table, CleanOptions(max_stddev_m=1.0, max_relative_stddev=1.0))
    with pytest.raises(InputError, match="--max-stddev must be positive, got nan"):
        CleanOptions(max_stddev_m=np.nan)
    write_cloud(cloud, tmp_path / "cloud.ply")
    with pytest.raises(InputError, match=r"no point is left, 50 of 50.*'views'"):
        clean_cloud(tmp_path / "cloud.ply", tmp_path / "clean.ply", min_views=9)
    assert not (tmp_path / "clean.ply").exists()


def test_strays_go_into_a_file_of_their_own(tmp_path: Path, rng):
    """A clump beside the floor: good in every way, and not of its surface."""
    cloud = floor_cloud(rng)
    clump = np.arange(len(cloud)) < 60
    cloud.points[clump] = 0.02 * rng.normal(size=(60, 3)) + [4.0, 0.0, -0.5]
    write_cloud(cloud, tmp_path / "cloud.ply")
    limits = {"outlier_ratio": np.inf, "min_views": np.inf}
    report = clean_cloud(tmp_path / "cloud.ply", tmp_path / "clean.ply", **limits)
    last = report["filters"][-1]
    assert last["name"] == "connected with the main surface"
    assert last["num_removed"] == 60 and report["num_kept"] == len(cloud) - 60
    strays = read_cloud(tmp_path / "clean.strays.ply").points
    np.testing.assert_allclose(strays, cloud.points[clump], atol=1e-6)
    everything = clean_cloud(
        tmp_path / "cloud.ply", tmp_path / "all.ply", parts="all", **limits
    )
    assert everything["num_kept"] == len(cloud)
    assert not (tmp_path / "all.strays.ply").exists()
    with pytest.raises(InputError, match="--parts some: is one of main, all"):
        clean_cloud(tmp_path / "cloud.ply", tmp_path / "no.ply", parts="some")
