"""Maps: a relief comes back at its place, not mirrored, with its holes."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from sfm_scenes import model_of, simulated_dive
from typer.testing import CliRunner

from uwsfm._base.ply import read_vertices, write_ply
from uwsfm.cli.app import app
from uwsfm.cloud import UNKNOWN_UNIT, Cloud, read_cloud, write_cloud
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.results.files import export_colmap, export_ply, unit_of_model
from uwsfm.results.housing import export_housing
from uwsfm.simulate.relief import Relief
from uwsfm.simulate.rigs import sample_rig
from uwsfm.surface.commands import make_map
from uwsfm.surface.height_map import FILLED, MEASURED, NOTHING, make_height_map
from uwsfm.surface.level import UPS, find_level, fit_plane, level_by_axis
from uwsfm.surface.source import find_source

tifffile = pytest.importorskip("tifffile")

RELIEF = Relief(stddev=0.05, correlation_length=0.3)
WORLD_FROM_FLOOR = np.concatenate(
    [rigid3.quat_from_rotvec(np.array([0.7, -0.4, 2.0])), [3.0, -2.0, 8.0]]
)
HOLE = 0.15
SPACING = 0.02


def run(*arguments: object) -> str:
    """What a command prints."""
    found = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert found.exit_code == 0, found.output
    return found.output


def floor_cloud(rng: np.random.Generator) -> Cloud:
    """A relief, turned anyhow, with a hole in one corner; colours tell x and y."""
    count = round(2.0 * 1.4 / SPACING**2)
    xy = rng.uniform([-1.0, -0.7], [1.0, 0.7], (count, 2))
    xy = xy[np.linalg.norm(xy - [0.6, 0.3], axis=1) > HOLE]
    shade = np.column_stack(
        [100 * (xy[:, 0] + 1.0), 100 * (xy[:, 1] + 0.7), 0 * xy.T[0]]
    )
    return Cloud(
        points=rigid3.transform(WORLD_FROM_FLOOR, RELIEF.points(xy)),
        normals=rigid3.rotate(WORLD_FROM_FLOOR, RELIEF.normals(xy)),
        colors=np.rint(shade).astype(np.uint8),
        stddev=np.full(len(xy), np.nan),
        num_views=np.ones(len(xy), dtype=np.int64),
        view_range=np.full(len(xy), np.nan),
    )


def read_grid(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions (rows, columns, 2), heights and colours, by the tags of the files."""
    with tifffile.TiffFile(folder / "height.tif") as file:
        tags = {tag.code: tag.value for tag in file.pages[0].tags}
    assert tags[42113] == "nan"
    assert tags[34735][3:12:4] == (4, 32767, 1)  # keys; user-defined model, areas
    step_x, step_y, _ = tags[33550]
    column, row, _, west, north, _ = tags[33922]
    # Read by another library than the one that wrote them.
    height = cv2.imread(str(folder / "height.tif"), cv2.IMREAD_UNCHANGED)
    bgra = cv2.imread(str(folder / "ortho.tif"), cv2.IMREAD_UNCHANGED)
    rows, columns = np.indices(height.shape) + 0.5
    place = np.stack(
        [west + (columns - column) * step_x, north - (rows - row) * step_y], axis=-1
    )
    return place, height, bgra[..., [2, 1, 0, 3]]


def test_a_relief_comes_back_level_at_its_place_with_its_hole(tmp_path: Path, rng):
    cloud = floor_cloud(rng)
    write_cloud(cloud, tmp_path / "cloud.ply")
    make_map(tmp_path / "cloud.ply", tmp_path / "map")
    report = json.loads((tmp_path / "map" / "map.json").read_text())
    # The fourth neighbour of points at random is 1.09 spacings away, rounded up.
    assert SPACING <= report["resolution"] <= 1.2 * SPACING
    place, height, rgba = read_grid(tmp_path / "map")
    there = np.isfinite(height)
    np.testing.assert_array_equal(rgba[..., 3], np.where(there, 255, 0))
    in_map = np.concatenate([place[there], height[there][:, None]], axis=1)
    pose = report["world_from_map"]
    world_from_map = np.array(pose["rotation_xyzw"] + pose["translation"])
    in_world = rigid3.transform(world_from_map, in_map.astype(np.float64))
    in_floor = rigid3.transform(rigid3.inverse(WORLD_FROM_FLOOR), in_world)
    # Linear interpolation errs by the triangle's side squared / 8 times the curvature,
    # whose root mean square is sqrt(3) 0.05 / 0.3^2; sides are two spacings or so.
    miss = in_floor[:, 2] - RELIEF.depth(in_floor[:, :2])
    assert np.sqrt(np.mean(miss**2)) < (2 * SPACING) ** 2 / 8 * 0.96
    # Mirrored, turned or shifted by a cell, the colours would be those of elsewhere.
    shown = rgba[there][:, :2] / 100.0 - [1.0, 0.7]
    assert np.abs(np.median(shown - in_floor[:, :2], axis=0)).max() < 0.006
    assert np.percentile(np.abs(shown - in_floor[:, :2]), 99) < 0.02
    # The hole is there, but for its rim; the floor around it has no other.
    distance = np.linalg.norm(in_floor[:, :2] - [0.6, 0.3], axis=1)
    assert distance.min() > HOLE - SPACING
    area = np.count_nonzero(there) * report["resolution"] ** 2
    assert area == pytest.approx(2.0 * 1.4 - np.pi * HOLE**2, rel=0.04)
    # Up is where the normals point.
    up = rigid3.rotate(world_from_map, np.array([[0.0, 0.0, 1.0]]))[0]
    assert up @ cloud.normals.mean(axis=0) > 0.99 * np.linalg.norm(
        cloud.normals.mean(0)
    )
    picture = cv2.imread(str(tmp_path / "map" / "map.png"))
    assert picture.shape[0] > 400 and picture.std() > 20


def test_a_unit_that_nothing_tells_is_never_a_metre(tmp_path: Path, rng):
    """As of a result without summary.json, saved by another program."""
    out = tmp_path / "out"
    (out / "sparse").mkdir(parents=True)
    write_cloud(floor_cloud(rng), tmp_path / "cloud.ply")
    table, _ = read_vertices(tmp_path / "cloud.ply")
    write_ply(out / "points.ply", [("vertex", table)], comment="of another program")
    assert unit_of_model(out) == UNKNOWN_UNIT == find_source(out).unit
    (out / "points.ply").rename(tmp_path / "points.ply")
    said = run("map", tmp_path / "points.ply", "-o", tmp_path / "map")
    assert "(unknown unit)" in said and "nothing tells the unit" in said
    with tifffile.TiffFile(tmp_path / "map" / "height.tif") as file:
        tags = {tag.code: tag.value for tag in file.pages[0].tags}
    assert 3076 not in tags[34735] and UNKNOWN_UNIT in tags[34737]  # no linear unit


def test_axes_of_the_world_become_right_handed_maps():
    for up in UPS[1:]:
        # Mirrored axes are no rotation, and raise: the third tells the rest.
        axis = np.eye(3)["xyz".index(up[-1])] * (-1.0 if up[0] == "-" else 1.0)
        turned = rigid3.transform(level_by_axis(up).map_from_world, axis)
        np.testing.assert_allclose(turned, [0.0, 0.0, 1.0], atol=1e-15)
    # North-east-down: the map's x is east, its y north.
    ned = rigid3.transform(level_by_axis("-z").map_from_world, [2.0, 3.0, -4.0])
    np.testing.assert_allclose(ned, [3.0, 2.0, 4.0], atol=1e-15)


def test_planes_hold_against_a_third_of_strays(rng):
    normal = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    points = rng.uniform(-1.0, 1.0, (3000, 3))
    floor = points[:2000]
    floor -= np.outer(floor @ normal - 0.7 + rng.normal(0.0, 0.01, 2000), normal)
    points[2000:] += 3.0 * normal
    found, offset, scatter = fit_plane(points)
    assert abs(found @ normal) > 1 - 1e-6
    # 0.01 / sqrt(2000), and the strays are further away than Tukey's weights reach.
    assert offset * np.sign(found @ normal) == pytest.approx(0.7, abs=0.001)
    assert 0.005 < scatter < 0.03


def test_nobody_guesses_which_way_is_up(rng):
    points = rng.uniform(size=(50, 3))
    with pytest.raises(InputError, match=r"frame of the positions.*--up=z"):
        find_level(None, points, None, has_positions=True)
    with pytest.raises(InputError, match="neither cameras nor normals"):
        find_level(None, points, None, has_positions=False)
    assert find_level("z", points, None, has_positions=True).method.endswith("is up")
    with pytest.raises(InputError, match=r"--resolution must be positive"):
        make_height_map(points, np.zeros((50, 3), np.uint8), resolution=-1.0)
    with pytest.raises(InputError, match=r"too large.*uwsfm clean"):
        make_height_map(points, np.zeros((50, 3), np.uint8), resolution=1e-6)


def test_points_of_a_result_are_cleaned_exported_and_mapped(tmp_path: Path):
    """The commands, on a result folder without a dense cloud."""
    rig, out = sample_rig(), tmp_path / "out"
    model = model_of(rig, simulated_dive(rig, num_frames=3, num_points=300).scene)
    export_colmap(model, out / "sparse")
    export_housing(rig, out / "housing.yaml")
    covariance = np.tile(1e-6 * np.eye(3), (model.scene.num_points, 1, 1))
    export_ply(model, out / "points.ply", covariance, unit="scale arbitrary")
    (out / "summary.json").write_text('{"scale": {"unit": "scale arbitrary"}}')
    good = tmp_path / "good.ply"
    run("clean", out, "-o", good, "--min-views", 2)
    report = json.loads((tmp_path / "good.json").read_text())
    assert [item["name"] for item in report["filters"]][
        3
    ] == "standard deviation / range"
    # What is known of the points stays known of those that were kept.
    kept, given = read_cloud(good), find_source(out).cloud()
    np.testing.assert_allclose(kept.stddev, 1e-3, rtol=1e-6)  # single precision
    assert set(kept.num_views) <= set(given.num_views) - {1}
    assert set(kept.view_range) <= set(given.view_range)
    stricter = tmp_path / "stricter.ply"
    middle = np.median(kept.stddev / kept.view_range)
    run("clean", good, "-o", stricter, "--max-relative-stddev", middle)
    assert len(read_cloud(stricter)) < len(kept)
    said = run("export", good, "-o", tmp_path / "good.laz", "--to", "laz")
    assert f"{report['num_kept']} points" in said
    assert "scale of this reconstruction is arbitrary" in " ".join(said.split())
    shutil.copy(good, out)  # in its folder, whose cameras tell which side is up
    said = run("map", out / "good.ply", "-o", tmp_path / "map")
    assert "scale of this reconstruction is arbitrary" in " ".join(said.split())
    percentiles = json.loads((tmp_path / "map" / "map.json").read_text())
    assert percentiles["point_stddev_percentiles"]["50"] == pytest.approx(1e-3)
    # The world's z points down: cameras are above, so the map is turned over.
    pose = json.loads((tmp_path / "map" / "map.json").read_text())["world_from_map"]
    up = rigid3.rotate(np.array(pose["rotation_xyzw"] + [0, 0, 0]), np.eye(3)[2:])[0]
    assert up[2] < -0.9
    with pytest.raises(InputError, match="map exists already"):
        make_map(out, tmp_path / "map")


def test_gaps_are_filled_where_the_surface_is_smooth_and_marked():
    """Points on a grid with two gaps four cells wide: across one the floor goes on,
    across the other it rises by ten cells, as to something that stands before it."""
    cell = 0.1
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(20) + 0.5)
    here = ~np.isin(np.floor(x), [10, 11, 12, 26, 27, 28])
    z = 0.05 * x + np.where(x > 27.0, 10.0, 0.0)
    points = cell * np.column_stack([x[here], y[here], z[here]])
    colors = np.zeros((len(points), 3), np.uint8)
    found = make_height_map(points, colors, resolution=cell, max_gap=6.0 * cell)
    inner = found.origin[1:-1]
    assert found.origin.shape == (20, 40)
    assert (inner[:, :9] == MEASURED).all() and (inner[:, 14:25] == MEASURED).all()
    assert (inner[:, 10:13] == FILLED).all() and (inner[:, 26:29] == NOTHING).all()
    # Filled as the plane goes on, exactly; and no height where there is nothing.
    middle = 0.05 * cell * (np.arange(10, 13) + 0.5)
    np.testing.assert_allclose(found.height[5, 10:13], middle, atol=1e-6)
    np.testing.assert_array_equal(np.isfinite(found.height), found.origin != NOTHING)
    narrow = make_height_map(points, colors, resolution=cell, max_gap=3.0 * cell)
    assert (narrow.origin[1:-1, 10:13] == NOTHING).all()


def test_a_stray_far_away_does_not_widen_a_map(tmp_path: Path, rng):
    cloud = floor_cloud(rng)
    cloud.points[:3] += 1000.0
    write_cloud(cloud, tmp_path / "cloud.ply")
    report = make_map(tmp_path / "cloud.ply", tmp_path / "map")
    assert report["num_strays"] == 3 and "3 points" in report["warnings"][-1]
    assert report["share_with_data"] > 0.5
    strays = read_cloud(tmp_path / "map" / "strays.ply").points
    np.testing.assert_allclose(strays, cloud.points[:3], atol=1e-6)
    origin = tifffile.imread(tmp_path / "map" / "origin.tif")
    assert report["share_filled"] == pytest.approx(np.mean(origin == FILLED))
    said = run("map", tmp_path / "cloud.ply", "-o", tmp_path / "all", "--parts", "all",
               "--resolution", 1.0)  # fmt: skip
    assert "strays" not in said
