"""Where picks are placed in a small dive, and how well."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made import numbers
from measured import clicked, one, small_result

from uwsfm.calibration.propagation import Propagation
from uwsfm.cloud import Cloud, write_cloud
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.lengths_file import Click
from uwsfm.measuring.measurements_file import Task
from uwsfm.measuring.picks import PixelPick, PointPick
from uwsfm.measuring.spots import Spotter
from uwsfm.measuring.surface import CANDIDATES, Surface, SurfaceImage, views_of


@pytest.fixture(scope="module")
def result():
    return small_result()


def test_clicks_are_placed_where_their_rays_meet(result):
    points = result.model.scene.points
    found = one(result, distances=[{"ends": [clicked(result, 0), clicked(result, 4)]}])
    np.testing.assert_allclose(found.points, points[[0, 4]], atol=1e-7)
    for spot, point in zip(found.spots, (0, 4), strict=True):
        count = int(np.count_nonzero(result.model.scene.point_idx == point))
        assert spot.num_images == count and spot.how == f"clicked in {count} images"
        assert spot.miss_px == pytest.approx(0.0, abs=1e-5) and spot.note is None


def test_noise_of_clicks_grows_with_what_is_given_of_them(result):
    """Four times the noise is four times the deviation, where clicks are all of it."""
    ends = [clicked(result, 0), clicked(result, 4)]
    deviations = [
        one(result, click_stddev_px=px, distances=[{"ends": ends}]).stddev_alone
        for px in (20.0, 80.0)
    ]
    assert deviations[1] / deviations[0] == pytest.approx(4.0, rel=1e-3)


def test_clicks_that_miss_each_other_are_named(result):
    """Two clicks, y off by d / 2 each way: rays d px apart, over one spare number."""
    pair = clicked(result, 0, images=2)
    expected = one(result, distances=[{"ends": [pair, 5]}])
    assert expected.spots[0].note is None
    for d in (3.6, 4.8):
        moved = [dict(click) for click in pair]
        (x0, y0), (x1, y1) = pair[0]["xy"], pair[1]["xy"]
        moved[0]["xy"], moved[1]["xy"] = [x0, y0 + d / 2], [x1, y1 - d / 2]
        found = one(result, distances=[{"ends": [moved, 5]}])
        miss = found.spots[0].miss_px
        # Epipolar lines are nearly rows here: the gap is d / sqrt(2), nearly.
        assert miss == pytest.approx(d / math.sqrt(2.0), rel=0.1)
        noise = miss / 4.2
        noted = one(
            result, click_stddev_px=noise, distances=[{"ends": [moved, 5]}]
        ).spots[0]
        assert f"miss each other by {miss:.1f} px, 4 standard" in noted.note
        calm = one(
            result, click_stddev_px=miss / 3.8, distances=[{"ends": [moved, 5]}]
        ).spots[0]
        assert calm.note is None
        with pytest.raises(InputError, match="its clicks miss each other by"):
            one(result, click_stddev_px=miss / 300.0, distances=[{"ends": [moved, 5]}])


def test_points_and_places_of_the_model(result):
    scene = result.model.scene
    near = (scene.points[4] + [0.0, 0.0003, 0.0004]).tolist()
    found = one(result, distances=[{"ends": [1, near]}])
    first, second = found.spots
    assert first.how == "point of the model" and first.moved_by is None
    assert second.how == "nearest point of the model, 5"
    assert second.moved_by == pytest.approx(0.0005)
    for spot, point in ((first, 0), (second, 4)):
        assert spot.num_images == np.count_nonzero(scene.point_idx == point)
    # Picked in two ways it is one place, whose errors are shared.
    with pytest.raises(InputError, match="places 1 and the next are one"):
        one(result, distances=[{"ends": [5, near]}])
    last = scene.num_points
    assert one(result, distances=[{"ends": [1, last]}]).value > 0.0
    for wrong in (0, last + 1):
        with pytest.raises(InputError, match=f"the ids run from 1 to {last}") as error:
            one(result, distances=[{"ends": [1, wrong]}])
        assert str(error.value).startswith(
            f"distances[0].ends[1]: point {wrong}: there"
        )
    outside = [{"image": "left/0000.jpg", "xy": [900.0, 2.0]}, *clicked(result, 4)[:1]]
    with pytest.raises(InputError, match="is outside of left/0000.jpg") as error:
        one(result, distances=[{"ends": [1, outside]}])
    assert str(error.value).count("distances[0].ends[1]") == 1


def plane_cloud(folder, stddev, result):
    """A level floor below the cameras as the dense cloud of a result."""
    x, y = (c.ravel() for c in np.meshgrid(*2 * [np.linspace(-1.0, 1.0, 201)]))
    level = float(np.median(result.model.scene.points[:, 2]))
    points = np.column_stack([x, y, np.full_like(x, level)])
    cloud = Cloud(
        points=points,
        normals=np.full_like(points, np.nan),
        colors=np.zeros((len(points), 3), dtype=np.uint8),
        stddev=np.full(len(points), stddev),
        num_views=np.ones(len(points), dtype=np.int64),
        view_range=np.full(len(points), np.nan),
    )
    (folder / "dense").mkdir()
    write_cloud(cloud, folder / "dense" / "cloud.ply")
    return replace(result, folder=folder), level


def ray_on(result, frame, xy, level):
    """Where the ray of a pixel of the left camera meets the floor; its direction."""
    scene = result.model.scene
    origin, direction = scene.cameras[0].ray_from_img([xy])
    back = rigid3.inverse(scene.rig_from_world[frame])
    start = rigid3.transform(back, origin)[0]
    along = rigid3.rotate(back, direction)[0]
    return start + (level - start[2]) / along[2] * along, along


def test_a_pixel_slides_on_the_floor_as_its_click_errs(result, tmp_path):
    """20 px of noise are far more than all else: by the place of the next pixel."""
    dense, level = plane_cloud(tmp_path, 1e-6, result)
    xy = np.array([420.0, 310.0])
    picks = [f"left/0000.jpg:{xy[0]},{xy[1]}", "left/0000.jpg:300,250"]
    found = one(dense, click_stddev_px=20.0, distances=[{"ends": picks}])
    place, _ = ray_on(result, 0, xy, level)
    np.testing.assert_allclose(found.points[0], place, atol=1e-6)
    steps = [ray_on(result, 0, xy + 0.5 * s, level)[0] for s in np.eye(2)]
    steps = [
        s - ray_on(result, 0, xy - 0.5 * d, level)[0]
        for s, d in zip(steps, np.eye(2), strict=True)
    ]
    calm = one(dense, click_stddev_px=0.01, distances=[{"ends": picks}])
    expected = 20.0 * math.sqrt(sum(float(s @ s) for s in steps))
    added = found.places_stddev[0] ** 2 - calm.places_stddev[0] ** 2
    assert math.sqrt(added) == pytest.approx(expected, rel=0.005)
    assert calm.places_stddev[0] < 0.2 * expected
    assert found.spots[0].how.startswith("clicked in one image, at the depth of dense/")
    reach = numbers(found.spots[0].how)[-1]
    spacing = 0.01 / np.linalg.norm(steps[0])
    assert 1.2 * spacing < reach < 3.5 * spacing  # twelve of a grid of so many pixels


def test_a_place_of_a_cloud_is_no_better_than_the_cloud_states(result, tmp_path):
    """50 mm along the sight are far more than all else."""
    dense, level = plane_cloud(tmp_path, 0.05, result)
    picks = [[0.0, 0.0, level], [0.1, 0.05, level]]
    found = one(dense, distances=[{"ends": picks}])
    np.testing.assert_allclose(found.points, picks, atol=1e-6)
    # And the poses move a place across it by some millimetres.
    assert found.places_stddev == pytest.approx([0.05, 0.05], rel=0.02)
    assert found.spots[0].moved_by == pytest.approx(0.0, abs=1e-6)
    pixel = one(
        dense,
        click_stddev_px=0.01,
        distances=[{"ends": ["left/0000.jpg:420,310", "left/0000.jpg:300,250"]}],
    )
    assert pixel.places_stddev == pytest.approx([0.05, 0.05], rel=0.02)
    precise = plane_cloud_of(tmp_path / "precise", 1e-6, result)
    assert one(precise, distances=[{"ends": picks}]).places_stddev.max() < 0.02


def plane_cloud_of(folder, stddev, result):
    folder.mkdir()
    return plane_cloud(folder, stddev, result)[0]


def grid(step=0.01, half=0.2):
    x, y = np.meshgrid(*2 * [np.arange(-half, half + step / 2, step)])
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.0)], axis=1)


def test_a_place_is_the_clouds_up_to_five_spacings():
    surface = Surface(grid(), "a cloud", np.ones(10_000))
    for away, found in ((0.045, True), (0.055, False)):
        if found:
            row, gap = surface.nearest(np.array([0.0, 0.0, 1.0 + away]))
            assert gap == pytest.approx(away) and surface.points[row] == pytest.approx(
                [0.0, 0.0, 1.0], abs=1e-9
            )
        else:
            with pytest.raises(
                InputError, match="is 0.055 m away, the points there 0.01"
            ):
                surface.nearest(np.array([0.0, 0.0, 1.0 + away]))


def seen(result, points, stddev=1e-3):
    """A surface in front of the first left camera, as it sees it."""
    scene = result.model.scene
    world = rigid3.transform(rigid3.inverse(scene.rig_from_world[0]), points)
    return SurfaceImage(
        Surface(world, "a cloud", np.full(len(points), stddev)), scene, 0, 0
    )


@pytest.mark.parametrize(("step", "hidden"), [(0.045, False), (0.055, True)])
def test_what_is_a_twentieth_farther_is_on_something_else(result, step, hidden):
    """A comb, every other row of which is farther away than the rest."""
    comb = grid()
    comb[::2] *= 1.0 + step
    image = seen(result, comb)
    (xy,), _ = result.model.scene.cameras[0].img_from_point([[0.0, 0.0, 1.0]])
    chosen = image._front(tuple(xy))
    far = np.linalg.norm(comb[image.rows[chosen]], axis=1)
    assert bool(np.ptp(far) > 0.04) != hidden


def test_a_patch_has_the_roughness_of_its_points(result):
    """Points 2 mm above and below their plane; the ray meets the plane."""
    rough = grid()
    signs = np.where(np.indices((41, 41)).sum(axis=0) % 2, 1.0, -1.0).ravel()
    rough[:, 2] += 0.002 * signs
    (xy,), _ = result.model.scene.cameras[0].img_from_point([[0.0, 0.0, 1.0]])
    patch = seen(result, rough, 0.003).patch(tuple(xy))
    assert patch.relief == pytest.approx(0.002, rel=0.15)  # the plane fits twelve
    assert patch.stddev == 0.003
    assert np.linalg.norm(patch.sight) == pytest.approx(1.0)
    assert np.linalg.norm(patch.normal) == pytest.approx(1.0)


def test_a_pixel_needs_twelve_points_around_it(result):
    lens = result.model.scene.cameras[0]
    (xy,), _ = lens.img_from_point([[0.0, 0.0, 1.0]])
    sparse = seen(result, grid(0.06))
    with pytest.raises(InputError, match=r"has \d+ points within 24 px of the pixel"):
        sparse.patch(tuple(xy))  # 3 % of 800
    assert CANDIDATES == 36


def test_a_place_is_seen_by_the_images_that_saw_the_points_around(result):
    scene = result.model.scene
    model = Surface(scene.points, "the sparse model")
    camera, frame, xy = views_of(scene, model, scene.points[4])
    mine = scene.point_idx == 4
    saw = set(
        zip(
            scene.camera_idx[mine].tolist(), scene.frame_idx[mine].tolist(), strict=True
        )
    )
    assert saw <= set(zip(camera.tolist(), frame.tolist(), strict=True))
    exact = scene.projections()[0][mine]
    for k in range(len(xy)):
        rows = (scene.camera_idx[mine] == camera[k]) & (
            scene.frame_idx[mine] == frame[k]
        )
        if rows.any():
            np.testing.assert_allclose(xy[k], exact[rows][0], atol=1e-6)
    assert np.all((xy >= 0.0) & (xy <= [800.0, 600.0]))
    # Left of the images nothing sees it, whoever saw its neighbours.
    aside = scene.points[4] + [30.0, 0.0, 0.0]
    assert len(views_of(scene, model, aside)[0]) == 0


def test_a_bar_is_entered_if_its_clicks_are_those_of_the_adjustment(result):
    picks = [clicked(result, point) for point in (0, 4)]
    scene = result.model.scene
    rows = [np.flatnonzero(scene.point_idx == point) for point in (0, 4)]
    both = np.concatenate(rows)
    bars = replace(
        scene,
        points=scene.points[[0, 4]],
        camera_idx=scene.camera_idx[both],
        frame_idx=scene.frame_idx[both],
        point_idx=np.repeat([0, 1], [len(r) for r in rows]),
        xy=scene.projections()[0][both],
    )
    given = replace(result, calibration=replace(result.calibration, bars=bars))
    spotter = Spotter(given, Propagation(result.calibration))

    def task(*ends):
        clicks = [
            PixelPick(tuple(Click.model_validate(c) for c in end))
            if isinstance(end, list)
            else end
            for end in ends
        ]
        keys = ("ends[0]", "ends[1]")
        return Task(
            kind="scale bar",
            name="bar",
            where="scale_bars[0]",
            picks=tuple(clicks),
            keys=keys,
            click_stddev_px=1.0,
        )

    assert spotter.entered(task(*picks))
    other = [dict(click) for click in picks[0]]
    other[0]["xy"] = [other[0]["xy"][0] + 0.5, other[0]["xy"][1]]
    assert not spotter.entered(task(other, picks[1]))
    assert not spotter.entered(task(PointPick(1), picks[1]))
    assert not Spotter(result, Propagation(result.calibration)).entered(task(*picks))
