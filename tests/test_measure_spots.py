"""Where picks are placed in a small dive, and how well."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hand_made import numbers
from measured import clicked, one, small_result

from uwsfm.calibration.propagation import Propagation
from uwsfm.cloud import Cloud, read_cloud, write_cloud
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.inputs.lengths_file import Click
from uwsfm.measuring.measurements_file import Task
from uwsfm.measuring.picks import PixelPick, PointPick
from uwsfm.measuring.spots import Spotter
from uwsfm.measuring.surface import (
    CANDIDATES,
    Surface,
    SurfaceImage,
    surface_of,
    views_of,
)


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


def ray_on(result, frame, xy, level, camera=0):
    """Where the ray of a pixel of a camera meets the floor; its direction."""
    scene = result.model.scene
    origin, direction = scene.cameras[camera].ray_from_img([xy])
    pose = rigid3.compose(scene.cam_from_rig[camera], scene.rig_from_world[frame])
    back = rigid3.inverse(pose)
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


def test_a_pixel_is_looked_up_in_its_own_image(result, tmp_path):
    """Frames and cameras of different numbers, one image after another and back."""
    dense, level = plane_cloud(tmp_path, 1e-6, result)
    clicks = [(1, 0, (400, 300)), (0, 2, (390, 310)), (1, 2, (380, 290))]
    clicks += [(0, 2, (430, 330)), (0, 0, (410, 300))]
    picks = [
        f"{('left', 'right')[camera]}/{frame:04}.jpg:{x},{y}"
        for camera, frame, (x, y) in clicks
    ]
    found = one(dense, click_stddev_px=20.0, polylines=[{"through": picks}])
    calm = one(dense, click_stddev_px=0.01, polylines=[{"through": picks}])
    added = np.sqrt(found.places_stddev**2 - calm.places_stddev**2)
    for place, noise, (camera, frame, xy) in zip(
        found.points, added, clicks, strict=True
    ):
        expected, _ = ray_on(result, frame, xy, level, camera)
        np.testing.assert_allclose(place, expected, atol=1e-6)
        # And it slides as the next pixels of that image lie on the floor.
        steps = [
            ray_on(result, frame, np.add(xy, 0.5 * s), level, camera)[0]
            - ray_on(result, frame, np.add(xy, -0.5 * s), level, camera)[0]
            for s in np.eye(2)
        ]
        assert noise == pytest.approx(20.0 * np.linalg.norm(steps), rel=0.005)


def test_the_image_of_the_last_click_is_kept_for_the_next(result):
    spotter = Spotter(result, Propagation(result.calibration))
    first = spotter._image(0, 1)
    assert spotter._image(0, 1) is first
    other = spotter._image(1, 0)
    assert other is not first and other.lens is result.model.scene.cameras[1]
    assert spotter._image(1, 0) is other and first.lens is not other.lens


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


def test_the_spacing_of_a_cloud_is_that_of_most_of_its_points():
    """Eleven points 10 mm from each other, and one a metre away."""
    row = np.column_stack([0.01 * np.arange(11.0), np.zeros(11), np.ones(11)])
    surface = Surface(np.vstack([row, [1.1, 0.0, 1.0]]), "a cloud", np.ones(12))
    assert surface.nearest(np.array([0.0, 0.045, 1.0]))[0] == 0
    with pytest.raises(InputError, match="is 0.055 m away, the points there 0.01 m"):
        surface.nearest(np.array([0.0, 0.055, 1.0]))


def on_pixels(result, xy, ranges):
    """What the first left camera sees at pixels, so far along their rays (in it)."""
    origins, directions = result.model.scene.cameras[0].ray_from_img(xy)
    return origins + np.asarray(ranges)[:, None] * directions


MIDDLE = np.array([400.0, 300.0])


@pytest.mark.parametrize(("share", "refused"), [(0.54, False), (0.66, True)])
def test_points_are_around_a_pixel_up_to_three_fifths_of_their_reach(
    result, share, refused
):
    """Twelve on a circle of 10 px, whose middle is so much of that aside."""
    right = share + np.linspace(-0.3, 0.3, 6)
    up = np.sqrt(1.0 - right**2)
    ring = np.vstack([np.column_stack([right, up]), np.column_stack([right, -up])])
    for turned in (ring, ring[:, ::-1], -ring):
        xy = MIDDLE + 10.0 * turned
        image = seen(result, on_pixels(result, xy, np.ones(12)))
        if refused:
            with pytest.raises(InputError, match="the depth jumps there, from"):
                image.patch(tuple(MIDDLE))
        else:
            # The projection back is iterated to a billionth of a pixel.
            found = image.patch(tuple(MIDDLE)).reach_px
            assert found == pytest.approx(10.0, abs=1e-5)


def test_a_jump_in_depth_is_told_from_its_nearest_to_its_farthest(result):
    """Eighteen points left of the pixel, half a metre nearer than those right of it."""
    x, y = (c.ravel() for c in np.meshgrid([3, 4, 5, 6, 7, 8], [-1, 0, 1]))
    xy = MIDDLE + np.vstack([np.column_stack([-x, y]), np.column_stack([x, y])])
    ranges = np.repeat([1.0, 1.5], 18)
    image = seen(result, on_pixels(result, xy, ranges))
    # From the lens: a few centimetres more than from the port.
    first, last = sorted({f"{r:.3g}" for r in (image.ranges.min(), image.ranges.max())})
    assert 1.0 <= float(first) < 1.1 and 1.5 <= float(last) < 1.6
    words = f"jumps there, from {first} to {last} m around the pixel: click the spot"
    with pytest.raises(InputError, match=words):
        image.patch(tuple(MIDDLE))
    # With eleven points only, though all around; with twelve there is a surface.
    for count in (11, 12):
        turn = np.arange(count) * 2.0 * np.pi / count
        ring = MIDDLE + 9.0 * np.column_stack([np.cos(turn), np.sin(turn)])
        far = MIDDLE + 12.0 * np.column_stack([np.cos(turn), np.sin(turn)])
        both = on_pixels(
            result, np.vstack([ring, far]), np.repeat([1.0, 1.5], [count, count])
        )
        image = seen(result, both)
        if count == 11:
            with pytest.raises(InputError, match="the depth jumps there"):
                image.patch(tuple(MIDDLE))
        else:
            near = np.linalg.norm(both[image.rows[image._front(tuple(MIDDLE))]], axis=1)
            assert len(near) == 12 and near.max() < 1.2


@pytest.mark.parametrize(("off", "refused"), [(0.045, False), (0.055, True)])
def test_a_surface_is_edge_on_where_it_is_rough_by_a_twentieth(result, off, refused):
    """Twelve points above and below a plane that is seen at a sine of 0.1, so that they
    are ten times as far from it along the ray."""
    (origin,), (sight,) = result.model.scene.cameras[0].ray_from_img([MIDDLE])
    across = np.cross(sight, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    up, cosine = np.cross(sight, across), math.sqrt(0.99)
    normal = cosine * across + 0.1 * sight
    along = -0.1 * across + cosine * sight
    corners = [
        a * along + b * up + c * normal
        for a in (-0.02, 0.0, 0.02)
        for b in (-0.01, 0.01)
        for c in (-0.1 * off, 0.1 * off)
    ]
    # Behind the camera are some more, which have no pixel.
    points = np.vstack([np.outer([1.0, 2.0, 3.0], -sight), origin + sight + corners])
    scene = result.model.scene
    world = rigid3.transform(rigid3.inverse(scene.rig_from_world[0]), points)
    stated = np.array([9.0, 9.0, 9.0, *(0.001 * np.arange(1, 12)), 5.0])
    image = SurfaceImage(Surface(world, "a cloud", stated), scene, 0, 0)
    if refused:
        with pytest.raises(InputError, match="the surface is seen edge-on there: clic"):
            image.patch(tuple(MIDDLE))
        return
    patch = image.patch(tuple(MIDDLE))
    assert patch.relief == pytest.approx(off, rel=1e-6)
    assert patch.stddev == pytest.approx(0.0065)  # between the sixth and the seventh
    back = rigid3.inverse(scene.rig_from_world[0])
    middle = rigid3.transform(back, (origin + sight)[None])[0]
    np.testing.assert_allclose(patch.point, middle, atol=1e-7)
    turned = rigid3.rotate(back, np.stack([sight, normal]))
    np.testing.assert_allclose(patch.sight, turned[0], atol=1e-12)
    assert abs(patch.normal @ turned[1]) == pytest.approx(1.0, abs=1e-9)
    bare = SurfaceImage(Surface(world, "the sparse model"), scene, 0, 0)
    assert math.isnan(bare.patch(tuple(MIDDLE)).stddev)


def test_a_dense_cloud_takes_twelve_points(result, tmp_path):
    dense, _ = plane_cloud(tmp_path, 0.002, result)
    whole = surface_of(dense)
    assert whole.name == "dense/cloud.ply" and not whole.is_model
    assert whole.stddev == pytest.approx(np.full(len(whole.points), 0.002))
    assert surface_of(result).is_model
    path = tmp_path / "dense" / "cloud.ply"
    cloud = read_cloud(path)
    for count in (11, 12):
        write_cloud(cloud.select(np.arange(len(cloud)) < count), path)
        if count == 11:
            with pytest.raises(InputError, match="cloud.ply has 11 points only"):
                surface_of(dense)
        else:
            assert len(surface_of(dense).points) == 12


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


@pytest.mark.parametrize(("count", "sees"), [(9, True), (10, False)])
def test_ten_points_around_tell_who_sees_a_place(result, count, sees):
    """An image that lost so many of them, and has all others."""
    scene = result.model.scene
    model = Surface(scene.points, "the sparse model")
    place = scene.points[4] + [0.001, 0.0, 0.0]
    near = np.argsort(np.linalg.norm(scene.points - place, axis=1))[:count]
    tenth = np.argsort(np.linalg.norm(scene.points - place, axis=1))[9]
    at = int(np.flatnonzero(scene.point_idx == tenth)[0])
    camera, frame = int(scene.camera_idx[at]), int(scene.frame_idx[at])
    mine = (scene.camera_idx == camera) & (scene.frame_idx == frame)
    kept = ~(mine & np.isin(scene.point_idx, near))
    assert np.any(mine & kept)
    columns = ("camera_idx", "frame_idx", "point_idx", "xy")
    rest = replace(scene, **{name: getattr(scene, name)[kept] for name in columns})
    cameras, frames, _ = views_of(rest, model, place)
    found = list(zip(cameras.tolist(), frames.tolist(), strict=True))
    assert ((camera, frame) in found) == sees and len(found) > 2
    whole = views_of(scene, model, place)
    assert (camera, frame) in list(zip(*(c.tolist() for c in whole[:2]), strict=True))


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
