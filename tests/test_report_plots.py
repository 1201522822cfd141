"""Residuals, coverage and the view of the report: numbers made by hand."""

import base64
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made import summary
from hand_made_residuals import camera, residuals
from hand_made_result import FRAMES, result_of
from report_pages import model_that_misses, payload_of, report_of, text_of

from uwsfm.geometry import rigid3
from uwsfm.report.gather import _coverage, numbers_of
from uwsfm.report.page import page_of, scales_of
from uwsfm.report.view import level_axes, strips, view_of
from uwsfm.results.files import depth_stddev


@pytest.fixture(scope="module")
def model():
    return model_that_misses()


@pytest.fixture(scope="module")
def report(model, tmp_path_factory):
    return report_of(model, tmp_path_factory.mktemp("dive") / "out")


@pytest.fixture(scope="module")
def payload(report):
    return payload_of(page_of(report))


# ---- Residuals ----------------------------------------------------------------------


def test_maps_and_profiles_share_their_scales():
    """Cells of 0.2 and 0.5 px, 95 % of the way: 0.485; cells of 200 px."""
    scales = scales_of([camera()])
    assert scales.map_px == pytest.approx(0.485)
    # 0.9 of a cell's 200 px over 0.485 px is 371: 300 with one digit.
    assert scales.factor == 300
    # The longest bar reaches 0.3 + 0.05 px; room of a tenth.
    assert scales.profile_px == pytest.approx(1.1 * 0.35)
    lone = scales_of([camera(pinhole=None)])
    assert lone.map_px == pytest.approx(0.2)
    empty = replace(residuals(0.1, 0.1), cells_px=np.full((3, 4, 2), np.nan))
    assert scales_of([camera(pinhole=None, refractive=empty)]).map_px == 0.1


def words_of(report, *cameras):
    return text_of(page_of(replace(report, residuals=cameras)))


def test_residuals_are_told_with_their_numbers(report):
    text = words_of(report, camera(), camera("right"))
    assert (
        "The pinhole leaves 1.23 px RMS, of which 0.57 px is systematic by place in "
        "the image and depth; uwsfm leaves 0.456 px RMS, of which 0.031 px." in text
    )
    assert "same depth, is 0.031 px in left and right." in text
    assert "single centre" not in text and "Fitted in the same way" not in text
    assert "300 times as long in all maps" in text
    assert "all fitted to them (COLMAP's OPENCV), while" in text
    small = camera("right", refractive=residuals(0.4, 0.0049))
    text = words_of(report, camera(), small)
    assert "is 0.031 px in left, less than 0.005 px in right." in text
    lost = camera("right", refractive=residuals(0.4, math.nan))
    text = words_of(report, camera(), lost)
    assert "of which an unknown part." in text and "unknown in right." in text
    text = words_of(report, camera(pinhole=None), camera("right"))
    assert "There is no pinhole to compare with" in text
    assert "uwsfm leaves 0.456 px RMS, of which 0.031 px is systematic." in text
    fisheye = camera("right", model="OPENCV_FISHEYE")
    assert "COLMAP's OPENCV or OPENCV_FISHEYE)" in words_of(report, camera(), fisheye)


def test_whether_it_is_the_lens_is_told_by_what_a_free_lens_leaves(report):
    for systematic, words in (
        (0.001, "it is the lens, as given, that does not fit."),
        (0.030, "it is not the lens alone that does not fit."),
    ):
        freed = residuals(0.321, systematic)
        text = words_of(
            report,
            camera(freed=freed, least_central_px=(0.123, 0.987)),
            camera("right"),
        )
        assert "uwsfm's model leaves 0.321 px RMS, of which" in text and words in text
        assert "off by 0.12 px RMS and up to 0.99 px at the 10th" in text


def test_coverage_is_of_the_images_that_are_there(model, report):
    scene = model.scene
    for c, found in enumerate(report.coverage):
        mine = scene.frame_idx[scene.camera_idx == c]
        per_image = np.bincount(mine, minlength=FRAMES)
        assert found.name == ("left", "right")[c] and found.num_images == FRAMES
        assert found.observations_per_image == np.median(per_image)
        # `model_of` adds one keypoint that no point uses.
        assert found.features_per_image == np.median(per_image + 1)
        assert found.empty_share == 1.0  # fewer than 8 in every cell


def test_coverage_counts_images_without_observations_and_nearly_empty_cells(model):
    """Three images, whose last has lost its observations; cells of 7, 8 and 9."""
    scene = model.scene
    keep = (scene.camera_idx == 1) | (scene.frame_idx < 2)
    rows = {
        n: getattr(scene, n)[keep] for n in ("camera_idx", "frame_idx", "point_idx")
    }
    fewer = replace(model, scene=replace(scene, xy=scene.xy[keep], **rows))
    counts = np.array([[7, 8, 9, 9]])
    found = _coverage(fewer, 0, camera(counts=counts))
    assert found.empty_share == 0.25 and found.num_images == 3
    mine = np.bincount(scene.frame_idx[scene.camera_idx == 0], minlength=3)
    mine[2] = 0
    assert found.observations_per_image == np.median(mine)


def test_the_numbers_of_the_page_are_beside_it(report):
    found = json.loads(json.dumps(numbers_of(report)))
    assert found["unit"] == "m" and found["title"] == report.title
    assert found["frames"][1]["position_stddev_m"] == pytest.approx(math.sqrt(15e-8))
    assert found["timings_s"] == summary()["timings_s"]
    assert [solve["loss"] for solve in found["convergence"]] == ["cauchy", "l2"]
    assert found["estimates"][4]["value"] == "20.45"
    assert found["coverage"][1]["name"] == "right" and found["command"] is None
    assert found["versions"] == {"uwsfm": "9.8.7"}


# ---- View ---------------------------------------------------------------------------


def unpacked(text, kind="<f4"):
    return np.frombuffer(base64.b64decode(text), kind)


def test_the_view_has_each_point_with_its_error_and_deviation(model, payload, report):
    scene, view = model.scene, payload["view"]
    count = np.bincount(scene.point_idx)
    right = np.bincount(scene.point_idx, scene.camera_idx)
    expected = (5.0 * (count - right) + 12.0 * right) / count
    np.testing.assert_allclose(unpacked(view["error"]), expected, rtol=1e-5)
    stddev = depth_stddev(model, result_of(scene).covariance.points)
    assert payload["small_unit"] == "mm" and payload["unit"] == "m"
    np.testing.assert_allclose(1e-3 * unpacked(view["stddev"]), stddev, rtol=1e-5)
    limit = np.percentile(1e3 * stddev, 95.0)
    assert view["limits"]["stddev"] == pytest.approx([0.0, limit])
    assert view["limits"]["error"] == pytest.approx([0.0, np.percentile(expected, 95)])
    colors = unpacked(view["colors"], "u1").reshape(-1, 3)
    np.testing.assert_array_equal(colors, model.colors)
    ids = unpacked(view["ids"], "<u4")
    np.testing.assert_array_equal(ids, np.arange(scene.num_points) + 1)
    assert view["names"] == list(model.frame_names)


def test_the_view_is_drawn_as_far_and_large_as_it_is(model, payload):
    view, scene = payload["view"], model.scene
    axes, origin = np.array(view["axes"]), np.array(view["origin"])
    assert np.linalg.det(axes) == pytest.approx(1.0)
    for name, places in (
        ("points", scene.points),
        ("trajectory", rigid3.inverse(scene.rig_from_world)[:, 4:]),
    ):
        drawn = unpacked(view[name]).reshape(-1, 3)
        np.testing.assert_allclose(drawn @ axes + origin, places, atol=1e-6)
    # 3 % of the longest side is added on every side; the sides keep their proportions.
    drawn = [unpacked(view[k]).reshape(-1, 3) for k in ("points", "trajectory")]
    drawn += [unpacked(lines).reshape(-1, 3) for lines in view["frusta"]]
    places = np.concatenate(drawn)
    low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
    room = 0.03 * (high - low).max()
    ranges = np.array(view["ranges"])
    np.testing.assert_allclose(
        ranges, np.stack([low - room, high + room], 1), atol=1e-6
    )
    sides = ranges[:, 1] - ranges[:, 0]
    np.testing.assert_allclose(view["aspect"], sides / sides.max(), rtol=1e-6)
    assert len(view["frusta"]) == 2
    # The cameras look down on the points, each frustum begins at its own.
    assert drawn[1][:, 2].min() > np.median(drawn[0][:, 2])
    for index, lines in enumerate(drawn[2:]):
        pose = rigid3.compose(scene.cam_from_rig[index], scene.rig_from_world)
        center = axes @ (rigid3.inverse(pose)[0, 4:] - origin)
        np.testing.assert_allclose(lines[0], center, atol=1e-6)


def test_directions_of_the_view_are_those_of_the_images(model):
    view = view_of(model, result_of(model.scene).covariance)
    back = rigid3.inverse(model.scene.rig_from_world)
    for direction, found in (([0, 0, 1.0], view.sight), ([0, -1.0, 0], view.up)):
        mean = rigid3.rotate(back, direction).mean(axis=0)
        np.testing.assert_allclose(found @ view.axes, mean / np.linalg.norm(mean))
    assert view.num_all_points == model.scene.num_points and view.num_outlying == 0
    assert view.frusta_step == 1


def test_a_row_of_points_is_level_by_the_images():
    row = np.outer(np.linspace(0.0, 1.0, 5), [1.0, 0.0, 0.0])
    top = np.array([0.0, 0.6, 0.8])
    axes = level_axes(row, np.zeros((1, 3)), top)
    np.testing.assert_allclose(axes[2], top)
    assert abs(axes[0] @ [1.0, 0.0, 0.0]) == pytest.approx(1.0)


def test_lines_are_parted_where_edges_end():
    vertices = np.arange(18.0).reshape(6, 3)
    edges = np.array([[0, 1], [1, 2], [3, 4], [4, 5]])
    first, second = strips(vertices, edges)
    np.testing.assert_array_equal(first, vertices[:3])
    np.testing.assert_array_equal(second, vertices[3:])


def test_points_far_outside_are_left_out_by_the_span_of_the_rest(model):
    """A row of 10 m along x: what is 9 m off its middle is not drawn, nor 9 m above."""
    row = np.zeros((12, 3))
    row[:, 0] = np.linspace(-5.0, 5.0, 12)
    many = np.tile(row, (20, 1))
    colors = np.zeros((len(many) + 1, 3), dtype=np.uint8)
    covariances = np.tile(np.eye(3), (len(many) + 1, 1, 1))
    for place, out in (
        ([0.0, 7.0, 0.0], False),
        ([0.0, 9.0, 0.0], True),
        ([-9.0, 0.0, 0.0], True),
    ):
        scene = replace(model.scene, points=np.vstack([many, place]))
        covariance = replace(result_of(scene).covariance, points=covariances)
        with np.errstate(invalid="ignore"):
            view = view_of(replace(model, scene=scene, colors=colors), covariance)
        assert view.num_outlying == out
        assert len(view.points) == len(many) + (not out)


@pytest.mark.parametrize(("times", "moved"), [(900.0, False), (1200.0, True)])
def test_a_far_world_is_drawn_from_a_round_place_in_it(model, times, moved):
    scene = model.scene
    centers = rigid3.inverse(scene.rig_from_world)[:, 4:]
    span = np.ptp(np.concatenate([scene.points, centers]), axis=0).max()
    away = np.array([0.0, -times * span, 0.0])
    shift = rigid3.from_rotmat(np.eye(3), -away)
    far = replace(
        scene,
        points=scene.points + away,
        rig_from_world=rigid3.compose(scene.rig_from_world, shift),
    )
    view = view_of(replace(model, scene=far), result_of(scene).covariance)
    assert bool(np.any(view.origin)) == moved
    assert np.array_equal(view.origin, np.round(view.origin))


def test_every_so_many_frames_have_frusta_and_all_a_place(model, monkeypatch):
    covariance = result_of(model.scene).covariance
    everything = view_of(model, covariance)
    monkeypatch.setattr("uwsfm.report.view.MAX_FRUSTA", 2)
    view = view_of(model, covariance)
    assert view.frusta_step == 2 and len(view.trajectory) == FRAMES
    # Two of three frames are drawn.
    assert 3 * len(view.frusta[0]) == 2 * len(everything.frusta[0])


def test_the_caption_counts_what_is_drawn(report):
    view = replace(
        report.view,
        num_all_points=1000,
        num_outlying=3,
        frusta_step=4,
        origin=np.array([400.4, -20.6, 3.2]),
    )
    text = text_of(page_of(replace(report, view=view)))
    assert "1000 points; frusta run" in text and "12 of them, chosen at random" in text
    assert "3 lie far outside" in text and "Every 4th frame has its cameras" in text
    assert "The axes begin at (400, -21, 3) m of the world." in text
    plain = text_of(page_of(report))
    assert "12 points; frusta run" in plain
    for words in ("chosen at random", "lie far outside", "Every ", "The axes begin"):
        assert words not in plain
