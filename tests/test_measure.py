"""`uwsfm measure` on a simulated dive: beside the truth, and what it refuses."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml
from result_folders import clicks
from typer.testing import CliRunner

import uwsfm
from uwsfm import InputError
from uwsfm.cli.app import app
from uwsfm.cli.console import console
from uwsfm.cloud import Cloud, write_cloud
from uwsfm.geometry import rigid3
from uwsfm.measuring.measure import agreement, unit_hint
from uwsfm.measuring.surface import Surface, SurfaceImage
from uwsfm.measuring.table import measurement_table, rounded
from uwsfm.surface.source import find_source

CLICK_PX = 0.5


@pytest.fixture(scope="module")
def opened(dive_result):
    return uwsfm.open_result(dive_result.out)


@pytest.fixture(scope="module")
def spots(dive_result):
    """Ten points of the truth that many images saw, clicked in all of them."""
    truth, rng = dive_result.truth, np.random.default_rng(1)
    often = np.argsort(-np.bincount(truth.point_idx), kind="stable")[2:12]
    found = [clicks(truth, point, rng, CLICK_PX) for point in often]
    return truth.points[often], found


def test_what_is_measured_agrees_with_the_truth(opened, spots, tmp_path):
    places, found = spots
    length = [
        float(np.linalg.norm(a - b))
        for a, b in zip(places[1:], places[:-1], strict=True)
    ]
    content = {
        "version": 1,
        "click_stddev_px": CLICK_PX,
        "distances": [
            {"ends": [a, b]} for a, b in zip(found[1:], found[:-1], strict=True)
        ],
        "polylines": [{"through": found}],
        "scale_bars": [{"length_m": length[0], "ends": found[:2]}],
    }
    report = tmp_path / "measurements.json"
    result = uwsfm.measure(opened, content, report)
    assert result.unit == "metre" and not result.warnings
    expected = [*length, sum(length), length[0]]
    for item, true in zip(result.measurements, expected, strict=True):
        assert abs(item.value - true) < 4.0 * item.stddev
        assert item.stddev == max(item.stddev_alone, item.stddev_clustered)
        assert all(spot.how.startswith("clicked in") for spot in item.spots)
    scale = opened.calibration.covariance.scale_stddev
    for item, true in zip(result.measurements[:9], expected, strict=False):
        # The scale's deviation is in every length. Beside it two ends, each clicked to
        # half a pixel, 1.3 mm at 1.5 m (some are at 1 m): better across the sight as a
        # mean of eleven images, worse along it: rays meet at half a radian.
        clicked = np.sqrt(2.0) * CLICK_PX * 1.5 / 591.0
        assert item.stddev > np.hypot(0.9 * scale * true, 0.7 * clicked / np.sqrt(11.0))
        assert item.stddev < np.hypot(1.6 * scale * true, 1.6 * clicked)
    written = json.loads(report.read_text())
    assert written == json.loads(json.dumps(result.summary))
    bar = written["measurements"][-1]["scale_bar"]
    assert bar["verdict"] == "agrees" == written["scale_bars"]["verdict"]
    # One bar, measured as its distance was.
    assert written["measurements"][-1]["value"] == written["measurements"][0]["value"]


def test_points_of_the_model_have_its_own_covariance(opened):
    scene = opened.model.scene
    found = uwsfm.measure(opened, {"version": 1, "distances": [{"ends": [1, 5]}]})
    (item,) = found.measurements
    expected = np.linalg.norm(scene.points[0] - scene.points[4])
    assert item.value == pytest.approx(expected, rel=1e-14)
    cov = opened.calibration.covariance.points
    place = np.sqrt([np.trace(cov[0]), np.trace(cov[4])])
    np.testing.assert_allclose(item.places_stddev, place, rtol=1e-6)
    # What both share through the poses cancels: no sum of the two is needed.
    assert item.stddev_alone < place.sum()


def test_one_place_picked_in_two_ways_is_one(opened):
    """Its distance from itself is refused; its errors are shared."""
    x, y, z = opened.model.scene.points[6].tolist()
    text = f"{x:.6f},{y:.6f},{z:.6f}"
    assert str(opened.folder).startswith("/")
    with pytest.raises(InputError, match="places 1 and the next are one"):
        uwsfm.measure(opened, {"version": 1, "distances": [{"ends": [7, text]}]})


@pytest.fixture(scope="module")
def dense(dive_result, tmp_path_factory):
    """The same result with a dense cloud, a smooth floor among the model's points."""
    out = tmp_path_factory.mktemp("dense") / "out"
    shutil.copytree(dive_result.out, out)
    points = uwsfm.read_model(out).scene.points
    x, y = (c.ravel() for c in np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 101)]))

    def terms(x, y):
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)

    floor = np.linalg.lstsq(terms(*points[:, :2].T), points[:, 2], rcond=None)[0]
    surface = np.column_stack([x, y, terms(x, y) @ floor])
    count = len(surface)
    cloud = Cloud(
        points=surface,
        normals=np.full((count, 3), np.nan),
        colors=np.zeros((count, 3), dtype=np.uint8),
        stddev=np.full(count, 0.004),
        num_views=np.ones(count, dtype=np.int64),
        view_range=np.full(count, np.nan),
    )
    (out / "dense").mkdir()
    write_cloud(cloud, out / "dense" / "cloud.ply")
    return uwsfm.open_result(out), surface


def test_places_of_a_dense_cloud_are_measured(dense):
    opened, surface = dense
    ends = surface[[1200, 5200]]
    picks = [",".join(f"{v:.4f}" for v in end) for end in ends]
    (item,) = uwsfm.measure(
        opened, {"version": 1, "distances": [{"ends": picks}]}
    ).measurements
    assert item.value == pytest.approx(np.linalg.norm(ends[0] - ends[1]), rel=1e-12)
    assert all("nearest point of dense/cloud.ply" in spot.how for spot in item.spots)
    # No place is better than the cloud says of it.
    assert np.all(item.places_stddev >= 0.004)
    # Nor much worse: across the sight, the rays of eleven images tell a millimetre.
    assert np.all(item.places_stddev < 0.006)
    with pytest.raises(InputError, match="copy the place from the cloud"):
        uwsfm.measure(
            opened, {"version": 1, "distances": [{"ends": [picks[0], "0,0,3"]}]}
        )


def test_a_cloud_of_another_model_is_refused(dense):
    opened, surface = dense
    place = ",".join(f"{v:.4f}" for v in surface[1200])
    summary = opened.folder / "dense" / "summary.json"
    content = {"version": 1, "distances": [{"ends": [1, place]}]}
    summary.write_text(json.dumps({"model": opened.fingerprint}))
    assert uwsfm.measure(opened, content).measurements[0].value > 0.0
    summary.write_text(json.dumps({"model": "another"}))
    with pytest.raises(InputError, match="is of another model: run uwsfm dense"):
        uwsfm.measure(opened, content)
    with pytest.raises(InputError, match="is of another model: run uwsfm dense"):
        find_source(opened.folder)  # of maps, meshes, cleaned and exported clouds
    summary.unlink()


def test_a_pixel_in_one_image_takes_the_depth_of_the_surface(dense):
    opened, surface = dense
    scene = opened.model.scene
    ends = surface[[1200, 5200]]
    seen = replace(
        scene,
        points=ends,
        camera_idx=np.zeros(2, dtype=np.int64),
        frame_idx=np.zeros(2, dtype=np.int64),
        point_idx=np.arange(2),
        xy=np.zeros((2, 2)),
    )
    pixels, valid = seen.projections()
    assert valid.all()
    picks = [f"left/0000.jpg:{x:.4f},{y:.4f}" for x, y in pixels]
    (item,) = uwsfm.measure(
        opened, {"version": 1, "distances": [{"ends": picks}]}
    ).measurements
    # A plane through twelve points a centimetre apart, of a floor that hardly bends.
    assert np.linalg.norm(item.points - ends, axis=1).max() < 1e-4
    assert all("depth of dense/cloud.ply" in spot.how for spot in item.spots)


def test_a_pixel_sees_what_is_in_front_and_nothing_beside_an_edge(opened):
    """A plate at half the distance hides the floor; beside its edge is neither."""
    scene = opened.model.scene
    pose = rigid3.inverse(scene.rig_from_world[0])
    x, y = (c.ravel() for c in np.meshgrid(*2 * [np.linspace(-0.4, 0.4, 161)]))
    floor = np.stack([x, y, np.full_like(x, 1.0)], axis=1)
    plate = 0.5 * floor[x > 0.1]
    surface = Surface(
        rigid3.transform(pose, np.vstack([floor, plate])),
        "a cloud",
        np.full(99999, 1e-3),
    )
    image = SurfaceImage(surface, scene, 0, 0)
    lens = scene.cameras[0]
    for place in ([0.1, 0.0, 0.5], [-0.2, 0.1, 1.0]):
        (xy,), _ = lens.img_from_point([place])
        patch = image.patch(tuple(xy))
        expected = rigid3.transform(pose, np.array(place))
        np.testing.assert_allclose(patch.point, expected, atol=1e-9)
        assert patch.relief < 1e-9 and patch.stddev == 1e-3
    (edge,), _ = lens.img_from_point([[0.0495, 0.0, 0.5]])
    with pytest.raises(InputError, match="the depth jumps there, from 0.5"):
        image.patch(tuple(edge))


def test_a_pixel_in_one_image_without_a_surface_is_refused(opened):
    picks = ["left/0000.jpg:400,300", "left/0000.jpg:300,300"]
    with pytest.raises(InputError, match="click the spot in a second image"):
        uwsfm.measure(opened, {"version": 1, "distances": [{"ends": picks}]})


def wrong_pairs(found):
    """Clicks on two things."""
    return [{**found[0][0]}, {**found[3][1]}]


REFUSED = {
    "no such point": ("1", "9999", "there is no such point: the ids run from 1 to"),
    "image": ("1", "left/9.jpg:4,5+right/9.jpg:4,5", "is not among the images"),
    "outside": ("1", "left/0000.jpg:4,5+right/0000.jpg:4,5000", "is outside of"),
    "form": ("1", "left", "'left' is no pick: write a point id"),
    "away": ("1", "50,50,50", "the nearest point of the sparse model is"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_wrong_picks_are_named(opened, what):
    first, second, words = REFUSED[what]
    content = {"version": 1, "distances": [{"ends": [first, second]}]}
    with pytest.raises(InputError, match=words) as error:
        uwsfm.measure(opened, content)
    assert "distances[0].ends[1]" in str(error.value)
    assert "\n" not in str(error.value)


def test_clicks_on_different_things_are_named(opened, spots):
    _, found = spots
    ends = [found[1], wrong_pairs(found)]
    content = {"version": 1, "distances": [{"ends": ends}]}
    with pytest.raises(InputError, match=r"ends\[1\].*(miss each other|same side)"):
        uwsfm.measure(opened, content)
    moved = [dict(found[0][0]), dict(found[0][1])]
    x, y = moved[1]["xy"]
    moved[1]["xy"] = [x, y + 8.0]  # across the epipolar line, shared by two images
    content = {"version": 1, "distances": [{"ends": [found[1], moved]}]}
    (item,) = uwsfm.measure(opened, content).measurements
    assert "miss each other by 4.9 px, 5 standard" in item.notes[0]
    straight = {"version": 1, "distances": [{"ends": [found[1], found[0][:2]]}]}
    (better,) = uwsfm.measure(opened, straight).measurements
    assert item.stddev > 3.0 * better.stddev


def test_undetermined_is_said_and_no_number_given(opened):
    covariance = replace(opened.calibration.covariance, scale_stddev=np.inf)
    calibration = replace(opened.calibration, covariance=covariance)
    unknown = replace(opened, calibration=calibration)
    content = {"version": 1, "distances": [{"ends": [1, 5]}]}
    found = uwsfm.measure(unknown, content)
    (item,) = found.measurements
    assert item.value is None and item.stddev is None
    assert item.notes == ("not determined by the images",)
    assert "nothing that is measured is determined" in found.warnings[0]


def test_a_scale_that_is_arbitrary_is_said_with_every_length(opened, spots):
    covariance = replace(opened.calibration.covariance, scale_stddev=None)
    calibration = replace(opened.calibration, covariance=covariance)
    unknown = replace(opened, calibration=calibration)
    bar = {"ends": spots[1][:2], "length_m": 0.5}
    found = uwsfm.measure(unknown, {"version": 1, "scale_bars": [bar]})
    assert found.unit == "scale arbitrary" and "arbitrary unit" in found.warnings[0]
    (entry,) = found.summary["measurements"]
    assert entry["unit"] == "unit" and "no check" in entry["scale_bar"]["verdict"]
    # What would make it metric is told all the same.
    factor = found.scale_bars["known_over_measured"]
    assert factor == pytest.approx(0.5 / entry["value"], rel=1e-12)
    assert "no check" in found.scale_bars["verdict"]


def test_a_bar_that_was_given_is_no_check(dive_result, opened):
    given = yaml.safe_load((dive_result.out.parent / "lengths.yaml").read_text())
    content = {"version": 1, "scale_bars": given["scale_bars"]}
    (item,) = uwsfm.measure(opened, content).measurements
    assert "no independent check" in item.notes[0]


def test_words_and_digits():
    assert [agreement(r) for r in (-1.9, 3.0, -4.1)] == [
        "agrees",
        "doubtful",
        "contradicts",
    ]
    assert rounded(25.4123, 0.0234) == "25.412 ± 0.023"
    assert rounded(1234.5, 120.0) == "1234 ± 120"


def test_a_length_in_another_unit_is_guessed():
    assert unit_hint(120.0, 0.1203) == "1000 times what was measured: millimetres?"
    assert unit_hint(0.0012, 0.1203) == "100 times too short: is it in metres?"
    assert unit_hint(0.13, 0.1203) is None


def test_command_line(dive_result, spots, tmp_path, capsys):
    out, report = str(dive_result.out), tmp_path / "m.json"
    known = np.linalg.norm(spots[0][0] - spots[0][1])
    ends = [
        "+".join(f"{c['image']}:{c['xy'][0]},{c['xy'][1]}" for c in clicked)
        for clicked in spots[1][:2]
    ]
    found = CliRunner().invoke(
        app,
        ["measure", out, "--from", ends[0], "--to", ends[1], "--click-stddev", "0.5"]
        + ["--known", f"{known:.5f}", "-o", str(report)],
        catch_exceptions=False,
    )
    assert found.exit_code == 0 and f"wrote {report}" in found.output
    assert json.loads(report.read_text())["measurements"][0]["kind"] == "scale bar"
    console.print(measurement_table(uwsfm.measure(out, {"version": 1, **AREA})))
    assert "cm2" in capsys.readouterr().out


def test_a_place_shows_how_far_its_point_is(dive_result, capsys):
    """3 and 4 mm off in y and z: 5.0 mm; less than half of what points are apart."""
    points = dive_result.result.model.scene.points
    typed = ",".join(f"{v:.9f}" for v in points[11] + [0.0, 0.003, 0.004])
    content = {"version": 1, "distances": [{"ends": [1, typed]}]}
    found = uwsfm.measure(dive_result.out, content)
    (item,) = found.measurements
    assert item.value == pytest.approx(np.linalg.norm(points[0] - points[11]))
    assert item.spots[0].moved_by is None
    assert item.spots[1].moved_by == pytest.approx(0.005, rel=1e-5)  # as it was typed
    console.print(measurement_table(found))
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "nearest point of the model, 12, 5 mm from (" in said


AREA = {"areas": [{"name": "floor", "corners": [1, 5, 9]}]}


def test_command_line_wants_one_thing(dive_result, tmp_path):
    out, file = str(dive_result.out), tmp_path / "m.yaml"
    file.write_text(yaml.safe_dump({"version": 1, **AREA}))
    for arguments, words in (
        (["--from", "1"], "a measurements.yaml, or --from and --to"),
        ([str(file), "--to", "1"], "says what to measure: --from, --to"),
        (["--from", "abc", "--to", "2"], r"^--from 'abc' is no pick: .*11\.9\)$"),
        (["--from", "3", "--to", "3"], "both ends are the same point 3"),
        (["--from", "3", "--to", "99999999"], "^--to: point 99999999: there is no"),
        (["--from", "3", "--to", "4", "--known=-3"], "--known must be positive"),
        (
            ["--from", "3", "--to", "4", "--click-stddev=-1"],
            "--click-stddev must be positive",
        ),
        (["--from", "3", "--to", "4", "-o", str(file)], "exists already"),
    ):
        with pytest.raises(InputError, match=words):
            CliRunner().invoke(
                app, ["measure", out, *arguments], catch_exceptions=False
            )
