"""Tables and plots of the report's page, and what it says of other files."""

import base64
import json
import math
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest
from hand_made import numbers, summary
from hand_made_result import FRAMES, result_of, small_model

from uwsfm.export.files import depth_stddev
from uwsfm.geometry import rigid3
from uwsfm.report.gather import _coverage, gather, numbers_of
from uwsfm.report.left_files import left_files
from uwsfm.report.page import cost_unit, page_of, scales_of
from uwsfm.report.tables import frame_stddevs, frames
from uwsfm.report.view import level_axes, strips, view_of
from uwsfm.trust.residuals import CameraResiduals, Profile, Residuals


class Tables(HTMLParser):
    """The tables of a page by the label of what holds them: rows of cells."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: dict[str, list[list[str]]] = {}
        self._label, self._in_cell = "", False
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag == "div" and "scroll" in attributes.get("class", ""):
            self._label = attributes["aria-label"]
            self.found[self._label] = []
        elif tag == "tr" and self._label:
            self.found[self._label].append([])
        elif tag in ("td", "th") and self._label:
            self.found[self._label][-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag):
        if tag in ("td", "th"):
            self._in_cell = False
        elif tag == "table":
            self._label = ""

    def handle_data(self, data):
        if self._in_cell:
            self.found[self._label][-1][-1] += data.strip()


def text_of(page: str) -> str:
    body = page[page.index("<body>") : page.index('<script type="application/json"')]
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]*>", " ", body)))


@pytest.fixture(scope="module")
def model():
    """Observations of the left camera off by (3, 4) px, the right's by (0, 12)."""
    model = small_model()
    scene = model.scene
    exact, _ = scene.projections()
    off = np.array([[3.0, 4.0], [0.0, 12.0]])[scene.camera_idx]
    return replace(model, scene=replace(scene, xy=exact - off))


@pytest.fixture(scope="module")
def report(model, tmp_path_factory):
    out = tmp_path_factory.mktemp("dive") / "out"
    out.mkdir()
    return gather(model, result_of(model.scene).covariance, summary(), out)


@pytest.fixture(scope="module")
def page(report):
    return page_of(report)


@pytest.fixture(scope="module")
def tables(page):
    return Tables(page).found


@pytest.fixture(scope="module")
def payload(page):
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page)
    return json.loads(found.group(1))


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
    assert "the glass and the baseline. Those in all" in text  # the water was refined
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


# ---- Residuals ----------------------------------------------------------------------


def residuals(rms, systematic, cells=0.2, radius=(0.1, -0.3), depth=(0.05, 0.02)):
    def profile(mean, spread):
        values = np.array([mean, np.nan])
        return Profile(
            name="near",
            span=(0.5, 1.5),
            at=np.array([10.0, 20.0]),
            mean_px=values,
            stderr_px=np.array([spread, np.nan]),
        )

    grid = np.full((3, 4, 2), np.nan)
    grid[0, 0] = (0.6 * cells, 0.8 * cells)  # as long as ``cells``
    return Residuals(
        cells_px=grid,
        by_radius=(profile(*radius[:1], 0.04), profile(radius[1], 0.05)),
        by_depth=(profile(depth[0], 0.01), profile(depth[1], 0.02)),
        rms_px=rms,
        systematic_px=systematic,
    )


def camera(name="left", **more):
    return CameraResiduals(
        **{
            "name": name,
            "size": (800, 600),
            "counts": np.full((3, 4), 9, dtype=np.int64),
            "refractive": residuals(0.456, 0.0314),
            "model": "OPENCV",
            "pinhole": residuals(1.234, 0.567, cells=0.5),
            "freed": None,
            "least_central_px": None,
            **more,
        }
    )


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
