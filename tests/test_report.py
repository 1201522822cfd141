"""report.html: what it says, that it is complete, and that it never costs a result."""

import base64
import json
import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import uwsfm
from uwsfm import InputError
from uwsfm.cli.app import app
from uwsfm.geometry import rigid3
from uwsfm.options.jobs import ReconstructOptions
from uwsfm.report.command import command_line
from uwsfm.report.files import FOLDER, NUMBERS, PAGE, write_with_report
from uwsfm.report.gather import gather
from uwsfm.report.left_files import left_files
from uwsfm.report.page import page_of
from uwsfm.report.tables import frame_stddevs
from uwsfm.report.view import MAX_POINTS, level_axes, view_of
from uwsfm.report.words import deviation, rounded, verdict_of


def payload_of(page: str) -> dict:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    return json.loads(found.group(1))


def test_refine_writes_a_page_that_says_what_the_summary_says(dive_result):
    page = (dive_result.out / PAGE).read_text(encoding="utf-8")
    summary = dive_result.result.summary
    assert "report" in summary["timings_s"]
    verdict = verdict_of(summary)
    assert summary["scale"]["verdict"] == verdict.metric_word == "determined"
    assert "known lengths" in verdict.metric and verdict.metric in page
    for port in verdict.ports:
        assert port.text in page
    for known in summary["known_lengths"]:
        assert (
            f"{(known['found_m'] - known['given_m']) / known['stddev_m']:+.1f}" in page
        )
    for sentence in summary["cross_validation"]["sentences"]:
        assert sentence in page
    halves = payload_of(page)["halves"]
    assert len(halves) == 2 and payload_of(page)["halves_limit"] > 0.0
    splits = summary["cross_validation"]["splits"]
    assert halves[0] in [split["projections"]["px"][0][1] for split in splits]
    for camera in summary["cameras"]:
        assert f"tilt {camera['normal_verdict']}" in page
        assert f"distance {camera['distance_verdict']}" in page
    # Nothing is fetched: all that the page refers to lies beside it.
    own = page[: page.index("<script>")]
    places = re.findall(r'(?:href|src)="([^"]*)"', own)
    assert {p for p in places if not p.startswith(("#", "data:"))} == {
        "report/report.json",
        "summary.json",
    }
    factor = payload_of(page)["scales"]["factor"]  # to compare cameras by eye
    cameras = len(payload_of(page)["residuals"])
    assert page.count(f"{factor} times as long in\nall maps") == cameras == 2
    view = payload_of(page)["view"]
    drawn = np.frombuffer(base64.b64decode(view["points"]), "<f4").reshape(-1, 3)
    scene = dive_result.result.model.scene
    # Turned back, they are the model's, of a few metres in 32 bits.
    points = drawn @ np.array(view["axes"]) + view["origin"]
    np.testing.assert_allclose(points, scene.points, rtol=0, atol=1e-6)
    ids = np.frombuffer(base64.b64decode(view["ids"]), "<u4")
    np.testing.assert_array_equal(ids, np.arange(scene.num_points) + 1)


def test_the_view_is_level():
    """A slope of 50 degrees, 6 m by 1 m, and outliers: it becomes level, x along it."""
    rng = np.random.default_rng(0)
    across, along = rng.uniform(-0.5, 0.5, 2000), rng.uniform(-3.0, 3.0, 2000)
    slope = np.array([[1.0, 0.0, 0.0], [0.0, np.cos(0.87), np.sin(0.87)]])
    points = np.column_stack([across, along]) @ slope
    points[:200] += rng.uniform(-2.0, 2.0, (200, 3))
    normal = np.array([0.0, np.sin(0.87), -np.cos(0.87)])  # to the cameras, here below
    centers = np.array([[0.1, 0.0, 0.0], [-0.1, 0.5, 0.0]]) + 2.0 * normal
    axes = level_axes(points, centers, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0.0
    assert axes[2] @ normal > np.cos(1e-3)  # an exact plane, but for the outliers
    assert abs(axes[0] @ slope[1]) > np.cos(0.05)  # these are in the spread
    top = np.array([0.0, 0.0, 1.0])
    row = np.outer(np.linspace(0.0, 1.0, 5), [1.0, 0.0, 0.0])  # no plane: the images'
    np.testing.assert_allclose(level_axes(row, centers[:1], top)[2], top)
    for places in (np.zeros((1, 3)), np.full((3, 3), np.nan)):
        lone = level_axes(places, np.zeros((1, 3)), top)
        np.testing.assert_allclose(lone @ lone.T, np.eye(3), atol=1e-12)


def test_the_numbers_and_pictures_are_beside_it(dive_result):
    folder = dive_result.out / FOLDER
    names = {path.name for path in folder.iterdir()}
    assert names == {
        NUMBERS,
        "residuals_0.png",
        "residuals_1.png",
        "coverage.png",
        "halves.png",
        "convergence.png",
        "cloud.png",
    }
    numbers = json.loads((folder / NUMBERS).read_text())
    costs = [solve["costs"] for solve in numbers["convergence"]]
    summary = dive_result.result.summary
    last = numbers["convergence"][-1]
    # 0.5 sum of squares; the clicks on the scale bar, of 1 px, and priors are in it.
    rms = np.sqrt(2.0 * last["costs"][-1] / last["num_observations"])
    after = summary["reprojection_rms_px"]["after"]
    assert last["loss"] == "l2" and after <= rms < 1.1 * after
    assert all(solve[0] >= solve[-1] for solve in costs)
    frame = numbers["frames"][0]
    assert frame["position_stddev_m"] == 0.0 and frame["num_images"] == 2


def test_a_report_that_fails_costs_no_result(dive_result, tmp_path):
    result = dive_result.result
    mine = tmp_path / FOLDER / "thesis.txt"
    mine.parent.mkdir()
    mine.write_text("mine")
    (tmp_path / PAGE).write_text("of an earlier run")
    summary = json.loads(json.dumps(result.summary))
    write_with_report(tmp_path, result.model, result.calibration, summary)
    assert mine.read_text() == "mine" and not (tmp_path / PAGE).exists()
    written = json.loads((tmp_path / "summary.json").read_text())
    assert written == summary
    assert written["warnings"][-1].startswith("the report could not be written: ")
    assert str(mine.parent) in written["warnings"][-1]


def test_a_result_without_a_report_has_none_of_an_earlier_run(dive_result, tmp_path):
    result = dive_result.result
    shutil.copytree(dive_result.out / FOLDER, tmp_path / FOLDER)
    (tmp_path / PAGE).write_text("of an earlier run")
    summary = dict(result.summary)
    write_with_report(tmp_path, result.model, result.calibration, summary, wanted=False)
    assert [path.name for path in tmp_path.iterdir()] == ["summary.json"]


def test_report_of_what_is_no_result_is_refused(tmp_path):
    with pytest.raises(InputError, match="nowhere"):
        uwsfm.write_report(tmp_path / "nowhere")


def test_the_command_is_one_that_the_program_takes(tmp_path):
    options = ReconstructOptions.of(
        clahe=True,
        max_features=3000,
        matching="sequential",
        positions="nav.csv",
        lever_arm=(-0.2, 0.0, 1.5),
        scene_distance_m=2.5,
        seed=3,
        report=False,
        refine_water_index=True,
        water_index_stddev=0.002,
    )
    inputs = (tmp_path / "my rig.yaml", "images")
    text = command_line("reconstruct", inputs, "out", options)
    program, command, *words = shlex.split(text)
    assert program == "uwsfm"
    parsed = typer.main.get_command(app).commands[command].make_context(command, words)
    found = parsed.params
    assert found["rig"] == inputs[0] and found["clahe"] is True
    assert found["max_features"] == 3000
    assert found["matching"] == "sequential" and found["seed"] == 3
    assert found["report"] is False and found["num_threads"] == -1
    assert found["lever_arm"] == "-0.2,0,1.5" and found["scene_distance_m"] == 2.5
    assert [item.value for item in found["refine"]] == ["water-index"]
    assert found["prior"] == ["water_index_stddev=0.002"]
    in_python = options.with_settings({"max_iterations": 3})
    assert command_line("reconstruct", inputs, "out", in_python) is None
    assert command_line("reconstruct", (object(), "images"), "out", options) is None


def test_digits_follow_the_standard_deviation():
    assert rounded(0.0199284, 0.000103, 1e3) == "19.93"
    assert deviation(0.000103, 1e3) == "0.10"
    assert deviation(None) == "-" and rounded(1.5, None) == "1.5"
    assert rounded(1234.5678, 25.0) == "1235" and deviation(25.0) == "25"


def test_stddevs_of_the_frames_are_those_of_their_centres(dive_result, rng):
    covariance = dive_result.result.calibration.covariance
    pose = dive_result.result.model.scene.rig_from_world[-1]
    turns, places = frame_stddevs(covariance.frames)
    steps = rng.multivariate_normal(np.zeros(6), covariance.frames[-1], 20_000)
    moved = rigid3.perturb(pose, steps)
    centers = rigid3.inverse(moved)[:, 4:]
    spread = np.sqrt(np.var(centers, axis=0).sum())
    angle = rigid3.rotation_angle(rigid3.compose(moved, rigid3.inverse(pose)))
    # 20000 draws know a spread to 0.5 % per axis.
    np.testing.assert_allclose(places[-1], spread, rtol=0.02)
    np.testing.assert_allclose(
        turns[-1], np.degrees(np.sqrt(np.mean(angle**2))), rtol=0.02
    )


def test_a_large_cloud_is_thinned_and_far_points_left_out(dive_result):
    model = dive_result.result.model
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (MAX_POINTS + 50, 3))
    points[:20] = 1e4
    points[20:25] = np.nan  # too few observations
    scene = replace(model.scene, points=points)
    colors = np.zeros((len(points), 3), dtype=np.uint8)
    covariance = dive_result.result.calibration.covariance
    covariances = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    with np.errstate(invalid="ignore"):  # most have no line of sight
        view = view_of(
            replace(model, scene=scene, colors=colors),
            replace(covariance, points=covariances),
        )
    assert len(view.points) == MAX_POINTS and view.num_all_points == len(points)
    assert view.num_outlying == 20
    np.testing.assert_allclose(view.points @ view.axes, points[view.point_idx])
    assert view.point_idx.min() >= 25


def test_far_worlds_keep_their_digits(dive_result):
    model = dive_result.result.model
    away = np.array([5e5, 6.2e6, -10.0])
    scene = model.scene
    shift = rigid3.from_rotmat(np.eye(3), -away)
    moved = replace(
        scene,
        points=scene.points + away,
        rig_from_world=rigid3.compose(scene.rig_from_world, shift),
    )
    covariance = dive_result.result.calibration.covariance
    here, there = (view_of(replace(model, scene=s), covariance) for s in (scene, moved))
    assert not np.any(here.origin)
    as_drawn = there.points.astype(np.float32) @ there.axes + (there.origin - away)
    # Half a unit in the last place of 32 bits, for coordinates of a few metres.
    np.testing.assert_allclose(as_drawn, here.points @ here.axes, atol=1e-6)


def test_what_other_commands_left_is_named(dive_result, tmp_path):
    result = dive_result.result
    (tmp_path / "dense").mkdir()
    for name in ("points.ply", "dense/cloud.ply", "my reef.glb", "measured.json"):
        (tmp_path / name).write_bytes(b"")
    covariance = result.calibration.covariance
    report = gather(result.model, covariance, result.summary, tmp_path)
    assert [path for path, _ in report.other_files] == [
        "dense/cloud.ply",
        "my reef.glb",
        "measured.json",
    ]
    assert '<a href="my%20reef.glb">my reef.glb</a>' in page_of(report)


def test_what_was_made_is_told_with_its_numbers_or_as_another_model_s(
    dive_result, tmp_path
):
    pytest.importorskip("tifffile")
    out = tmp_path / "out"
    shutil.copytree(dive_result.out, out)
    uwsfm.make_map(out, out / "map", up="z")
    uwsfm.clean_cloud(out, out / "good.ply")
    content = {"version": 1, "distances": [{"ends": [1, 2]}]}
    uwsfm.measure(out, content, out / "measured.json")
    dense = {
        "num_points": 1234,
        "stddev_percentiles": {"5": 2e-4, "50": 4e-4, "95": 8e-4},
        "noise_px": 0.1,
        "noise_from": "differences between depth maps",
        "depth_maps": [{"share_matched": 0.7}, {"share_matched": 0.9}],
    }
    (out / "dense").mkdir()
    (out / "dense" / "cloud.ply").write_bytes(b"")
    text = json.dumps({**dense, "model": uwsfm.open_result(out).fingerprint})
    (out / "dense" / "summary.json").write_text(text)
    told = dict(left_files(out, "report", "mm", 1e3))
    assert "1234 points; standard deviation along the sight 0.2, 0.4, " in told.pop(
        "dense/cloud.ply"
    )
    assert told["map/height.tif"].startswith("map: ")
    assert told["measured.json"] == "measurements: 1, of these 1 determined"
    with (out / "housing.yaml").open("a") as file:
        file.write("# another\n")
    told = dict(left_files(out, "report", "mm", 1e3))
    assert len(told) == 6  # with ortho.tif, origin.tif and good.ply
    assert all("but of another model: make it again" in what for what in told.values())
    with pytest.raises(InputError, match=r"good\.ply is of another model"):
        uwsfm.make_map(out / "good.ply", tmp_path / "again", up="z")


def test_view_tells_where_the_page_is(dive_result, tmp_path):
    runner = CliRunner()
    found = runner.invoke(app, ["view", str(dive_result.out), "--no-open"])
    assert found.exit_code == 0 and str(dive_result.out / PAGE) in found.output
    found = runner.invoke(app, ["view", str(tmp_path), "--no-open"])
    assert isinstance(found.exception, InputError)
    found = runner.invoke(app, ["view", str(dive_result.out), "--images", "x"])
    assert isinstance(found.exception, InputError) and "--rerun" in str(found.exception)
