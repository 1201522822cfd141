"""Tables and plots of the report's page, and what it says of other files."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hand_made import numbers, summary
from hand_made_result import result_of
from report_pages import Tables, model_that_misses, report_of, text_of

from uwsfm.report.left_files import left_files
from uwsfm.report.page import cost_unit, page_of
from uwsfm.report.tables import frame_stddevs, frames


@pytest.fixture(scope="module")
def model():
    return model_that_misses()


@pytest.fixture(scope="module")
def report(model, tmp_path_factory):
    return report_of(model, tmp_path_factory.mktemp("dive") / "out")


@pytest.fixture(scope="module")
def page(report):
    return page_of(report)


@pytest.fixture(scope="module")
def tables(page):
    return Tables(page).found


# ---- Frames -------------------------------------------------------------------------


def test_frames_have_their_counts_errors_and_deviations(model):
    scene = model.scene
    found = frames(model, result_of(scene).covariance)
    assert [frame.name for frame in found] == list(model.frame_names)
    for f, frame in enumerate(found):
        mine = scene.frame_idx == f
        left = int(np.count_nonzero(mine & (scene.camera_idx == 0)))
        right = int(np.count_nonzero(mine & (scene.camera_idx == 1)))
        assert frame.num_observations == left + right
        assert frame.num_points == len(set(scene.point_idx[mine].tolist()))
        assert frame.num_images == (left > 0) + (right > 0)
        # 5 px in the left camera, 12 in the right
        mean = (5.0 * left + 12.0 * right) / (left + right)
        square = (25.0 * left + 144.0 * right) / (left + right)
        assert frame.mean_error_px == pytest.approx(mean)
        assert frame.rms_error_px == pytest.approx(math.sqrt(square))
        # In all: f (1, 2, 3, 4, 5, 6) 1e-8 for variances, rotations first.
        assert frame.position_stddev_m == pytest.approx(math.sqrt(15e-8 * f))
        turn = math.degrees(math.sqrt(6e-8 * f))
        assert frame.rotation_stddev_deg == pytest.approx(turn)
    images_only = replace(result_of(scene).covariance, in_all=None)
    last = frames(model, images_only)[-1]
    assert last.position_stddev_m == pytest.approx(math.sqrt(0.25 * 30e-8))


def test_an_observation_without_an_error_does_not_count_in_the_mean(model):
    scene = model.scene
    points = scene.points.copy()
    points[scene.point_idx[0]] = [0.0, 0.0, -50.0]
    found = frames(
        replace(model, scene=replace(scene, points=points)), result_of(scene).covariance
    )
    assert sum(frame.num_observations for frame in found) == scene.num_observations
    assert all(5.0 <= frame.mean_error_px <= 12.0 for frame in found)


def test_a_turn_of_the_rig_does_not_move_its_centre():
    blocks = np.zeros((2, 6, 6))
    blocks[0, :3, :3] = np.diag([4.0, 9.0, 36.0]) * 1e-6
    blocks[1, 3:, 3:] = np.diag([4.0, 9.0, 36.0]) * 1e-6
    turns, places = frame_stddevs(blocks)
    assert turns == pytest.approx([math.degrees(0.007), 0.0])
    assert places == pytest.approx([0.0, 0.007])


# ---- The page -----------------------------------------------------------------------


def test_the_estimates_are_in_their_columns(tables, report):
    head, *rows = tables["Estimates"]
    names = ["of", "what", "estimate", "± images", "± in all", "unit", "verdict"]
    assert head == names
    for row, known in zip(rows, report.estimates, strict=True):
        values = [known.group, known.name, known.value, known.stddev]
        assert row[:6] == [*values, known.stddev_in_all, known.unit]
        assert row[6].endswith(known.word)
    found = {(row[0], row[1]): row[2:6] for row in rows}
    assert found["left", "port distance"] == ["20.45", "0.66", "1.5", "mm"]
    assert found["right", "port distance"] == ["40.5", "1.3", "3.1", "mm"]


def test_the_budget_and_known_lengths_are_in_their_columns(tables):
    head, first, *_ = tables["Error budget"]
    assert head[:3] == ["given", "by", "deviation"] and head[-1] == "lengths (%)"
    assert first[:3] == ["number 0", "+0.10 mm", "given"]
    assert [float(cell) for cell in first[3:7]] == [0.0123, -0.456, 0.0223, -0.556]
    assert len(head) == len(first)
    head, first, _ = tables["Known lengths"]
    assert head[:4] == ["given (mm)", "±", "found (mm)", "found - given"]
    assert first == ["500.30", "0.40", "499.30", "-1.00", "-2.5"]


def test_the_frames_are_in_their_columns(tables, report):
    head, *rows = tables["Frames"]
    assert head == [
        "frame",
        "images",
        "points",
        "observations",
        "error, mean (px)",
        "RMS (px)",
        "± position (mm)",
        "± rotation (deg)",
    ]
    for row, frame in zip(rows, report.frames, strict=True):
        counts = (frame.num_images, frame.num_points, frame.num_observations)
        assert row[:4] == [frame.name, *(str(count) for count in counts)]
        assert float(row[4]) == pytest.approx(frame.mean_error_px, abs=6e-4)
        assert float(row[5]) == pytest.approx(frame.rms_error_px, abs=6e-4)
        place, turn = float(row[6]), float(row[7])
        assert 1e-3 * place == pytest.approx(frame.position_stddev_m, rel=0.05)
        assert turn == pytest.approx(frame.rotation_stddev_deg, rel=0.05)
    assert rows[0][6:] == ["0", "0"]


def test_frames_sort_by_numbers_and_what_is_not_known_is_a_dash(report):
    lost = replace(report.frames[0], position_stddev_m=math.nan)
    text = page_of(replace(report, frames=(lost, *report.frames[1:])))
    values = re.findall(r'data-value="([^"]*)">([^<]*)</td>', text)
    (place, shown) = values[5]
    assert (place, shown) == ("", "-")
    second = [float(value) for value, _ in values[7:14]]
    frame = report.frames[1]
    assert second == pytest.approx(
        [
            frame.num_images,
            frame.num_points,
            frame.num_observations,
            frame.mean_error_px,
            frame.rms_error_px,
            frame.position_stddev_m,
            frame.rotation_stddev_deg,
        ],
        rel=1e-5,
    )


def test_time_is_that_of_this_run(page, tables):
    rows = {row[0]: row[1:] for row in tables["Times"]}
    assert rows["features"] == ["30.0 s", "earlier run"]
    assert rows["matching"][0] == "60.1 s" and rows["total"][0] == "70.1 s"
    widths = [float(w) for w in re.findall(r'style="width: ([\d.]+)%"', page)]
    assert widths == [85.7, 14.3]  # of 60.06 and 10.02 s


def test_what_the_page_says_in_sentences(page, report):
    text = text_of(page)
    assert "37 of 41 frames are registered" in text
    assert (
        "at the start and after each step of the 2 solves; the last has 61234" in text
    )
    assert "Root of twice the cost per observation (px)" in text
    assert "Converged." in text and "Stopped before" not in text
    assert "Not registered: 0003.jpg, 0011.jpg, 0012.jpg, 0040.jpg." in text
    for name, counts in zip(("left", "right"), report.coverage, strict=True):
        assert f"{name} {counts.num_images} images; median of" in text
    # Water, baseline and a focal length were refined.
    assert "what is held of the lens in air and the glass. Those in all" in text
    assert "uwsfm 9.8.7," in text and report.title in text
    plain = text_of(page_of(replace(report, summary=summary(refined=[]))))
    assert "the glass, the water index and the baseline." in plain


def test_words_have_the_sign_of_their_meaning(page):
    found = dict(re.findall(r'<span class="badge (\w+)">(.) ', page))
    assert found["good"] == "●" and found["weak"] == "◐"
    assert '<span class="badge good">● scale determined</span>' in page
    assert '<span class="badge weak">◐ distance weakly determined</span>' in page
    assert '<span class="badge plain">given</span>' in page


def test_costs_are_in_pixels_or_metres():
    assert cost_unit(summary()) == "px"
    data = summary()
    data["solves"][0] = {**data["solves"][0], "error": "point_3d"}
    assert cost_unit(data) == "m"


# ---- Other files --------------------------------------------------------------------


def written(path, told):
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(told))


def test_other_files_are_told_with_their_numbers(tmp_path):
    (tmp_path / "dense").mkdir()
    (tmp_path / "map").mkdir()
    for name in ("dense/cloud.ply", "map/height.tif", "reef.glb", "other.las"):
        (tmp_path / name).write_bytes(b"")
    written(
        tmp_path / "dense" / "summary.json",
        {
            "num_points": 12345,
            "stddev_percentiles": {"5": 0.00021, "50": 0.00043, "95": 0.00087},
            "noise_px": 0.123,
            "noise_from": "assumed",
            "depth_maps": [{"share_matched": 0.5}, {"share_matched": 0.76}],
        },
    )
    items = [{"value": 1.0}, {"value": None}, {"value": 2.0}]
    written(tmp_path / "measured.json", {"measurements": items})
    told = dict(left_files(tmp_path, "report", "mm", 1e3))
    assert told["dense/cloud.ply"] == (
        "dense cloud: 12345 points; standard deviation along the sight 0.21, 0.43, "
        "0.87 mm (5, 50, 95 %); noise of a disparity 0.12 px (assumed); 63% of the "
        "pixels have a depth"
    )
    assert told["measured.json"] == "measurements: 3, of these 2 determined"
    assert told["other.las"] == "cloud" and told["reef.glb"] == "mesh for the web"
    assert told["map/height.tif"] == "map"
    written(
        tmp_path / "map" / "height.json",
        {
            "num_columns": 640,
            "num_rows": 480,
            "resolution": 0.0042,
            "share_with_data": 0.876,
            "level": "level by its points",
        },
    )
    written(
        tmp_path / "reef.json",
        {"reef": {"num_triangles": 7654}, "max_distance": 0.0123},
    )
    told = dict(left_files(tmp_path, "report", "mm", 1e3))
    assert told["map/height.tif"] == (
        "map: 640 x 480 cells of 4.2 mm, 88% with data, level by its points"
    )
    assert told["reef.glb"] == (
        "mesh: 7654 triangles, none further than 12 mm from a point"
    )
    units = dict(left_files(tmp_path, "report", "units", 1.0))
    assert "cells of 0.0042 units" in units["map/height.tif"]
    assert "0.00021, 0.00043, 0.00087 units (5" in units["dense/cloud.ply"]
    assert numbers(units["measured.json"]) == [3, 2]


def test_files_of_the_result_itself_and_of_other_kinds_are_not_listed(tmp_path):
    for name in ("points.ply", "notes.txt", "sparse/a.ply", "report/a.tif", "b.obj"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "uwsfm-work").mkdir()
    (tmp_path / "uwsfm-work" / "a.ply").write_bytes(b"")
    (tmp_path / "folder.ply").mkdir()
    found = left_files(tmp_path, "report", "mm", 1e3)
    assert found == (("b.obj", "mesh"),)
