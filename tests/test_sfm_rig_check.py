"""A rig that contradicts its images is refused, and the sentence says what to change.

Observations are simulated: the true ports are tilted, the rig file knows straight ones.
"""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import same_frame_matches, simulated_dive

from uwsfm.errors import ExplainedInputError, InputError
from uwsfm.geometry import rigid3
from uwsfm.models.ports.port import DomePort, NoPort
from uwsfm.rig.rig import Rig, camera_from_colmap
from uwsfm.scene import Scene
from uwsfm.sfm.rig_checks.rig_check import (
    MAX_TURN_DEG,
    _apart,
    check_rig,
    check_rotation,
    turn_causes,
)
from uwsfm.sfm.rig_checks.rig_rotation import (
    RigRotation,
    correct_rotations,
    scene_depths,
)
from uwsfm.sfm.rig_checks.stereo_matches import PairMatches
from uwsfm.simulate.rigs import nominal_rig, sample_rig, stereo_rig, tilted_normal
from uwsfm.trust.mistakes import shifted

slow = pytest.mark.slow
"""More of a kind, of which one is tested always."""


@pytest.fixture(scope="module")
def dive():
    return simulated_dive()


@pytest.fixture(scope="module")
def pair(dive) -> PairMatches:
    return same_frame_matches(dive.scene)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return nominal_rig(sample_rig())


def poses_of(rig: Rig) -> np.ndarray:
    assert rig.cam_from_rig is not None
    return np.array(rig.cam_from_rig)


def turned(rig: Rig, poses: np.ndarray, pair: PairMatches) -> RigRotation:
    return correct_rotations(rig.refractive_cameras(), poses, [pair])


def refusal(rig: Rig, poses: np.ndarray, pair: PairMatches) -> str:
    with pytest.raises(InputError) as error:
        check_rig(rig, poses, [pair])
        check_rotation(rig, poses, turned(rig, poses, pair), [pair])
    text = str(error.value)
    assert "'right'" in text
    assert "\n" not in text
    return text


def test_a_right_rig_passes_though_its_ports_are_tilted(rig, pair):
    check_rig(rig, poses_of(rig), [pair])


def test_a_right_rig_passes_though_its_domes_are_off_their_centres():
    """By 8 mm, one towards the water and one away: their images differ in size."""
    offsets = (0.004, -0.003, 0.008), (-0.003, 0.002, -0.008)
    rig, known = (
        replace(
            sample_rig(),
            cameras=tuple(
                replace(item, port=DomePort(center=center), refine_center=True)
                for item, center in zip(sample_rig().cameras, centers, strict=True)
            ),
        )
        for centers in (offsets, ((0.0, 0.0, 0.0),) * 2)
    )
    pair = same_frame_matches(simulated_dive(rig).scene)
    check_rig(known, poses_of(known), [pair])
    rotation = turned(known, poses_of(known), pair)
    check_rotation(known, poses_of(known), rotation, [pair])
    assert rotation.turn_deg.max() > MAX_TURN_DEG  # what a flat port would not pass


@pytest.mark.parametrize(
    "tilts",
    [
        # Away from each other, so that far points meet behind the cameras.
        ((10.0, 0.0), (11.0, 180.0)),
        ((10.0, 180.0), (11.0, 0.0)),
        # Across the baseline: the rays miss each other by five degrees.
        ((9.0, 90.0), (11.5, -90.0)),
    ],
)
def test_ports_that_lean_against_each_other_are_no_mistake(rig, tilts):
    """Ten degrees are a badly mounted port; several mistakes look like two of them."""
    ports = [
        replace(item.port, normal=tilted_normal(*tilt))
        for item, tilt in zip(rig.cameras, tilts, strict=True)
    ]
    cameras = tuple(
        replace(item, port=port) for item, port in zip(rig.cameras, ports, strict=True)
    )
    pair = same_frame_matches(simulated_dive(replace(rig, cameras=cameras)).scene)
    poses = poses_of(rig)
    check_rig(rig, poses, [pair])
    check_rotation(rig, poses, turned(rig, poses, pair), [pair])


def test_swapped_images_are_recognised(rig, pair):
    swapped = replace(pair, xy_a=pair.xy_b, xy_b=pair.xy_a)
    text = refusal(rig, poses_of(rig), swapped)
    assert "the image folders 'left' and 'right' are swapped" in text
    assert "0%" in text


def test_inverted_pose_is_recognised(rig, pair):
    poses = poses_of(rig)
    poses[1] = rigid3.inverse(poses[1])
    assert "cam_from_rig of 'right' is inverted" in refusal(rig, poses, pair)


def test_position_instead_of_translation_is_recognised(rig, pair):
    poses = poses_of(rig)
    poses[1, 4:] = rigid3.inverse(poses[1])[4:]
    text = refusal(rig, poses, pair)
    assert "translation_m of 'right' is the position of the camera, or" in text


def test_different_lenses_leave_one_explanation(rig, pair):
    """Each wrong explanation would need turns that no tilted port causes."""
    poses = poses_of(rig)
    swapped = replace(pair, xy_a=pair.xy_b, xy_b=pair.xy_a)
    text = refusal(rig, poses, swapped)
    assert "position" not in text
    assert "inverted" not in text
    poses[1] = rigid3.inverse(poses[1])
    text = refusal(rig, poses, pair)
    assert "swapped" not in text
    assert "position" not in text


def test_equal_lenses_leave_several_explanations():
    """Swapped images of one lens are those of the inverted rig: both are said."""
    lens = sample_rig().cameras[0].camera
    twins = stereo_rig((lens, lens), right_rotvec_deg=(0.6, 1.9, -0.8))
    matches = same_frame_matches(simulated_dive(twins).scene)
    swapped = replace(matches, xy_a=matches.xy_b, xy_b=matches.xy_a)
    given = nominal_rig(twins)
    text = refusal(given, poses_of(given), swapped)
    assert "swapped" in text
    assert "inverted" in text


@pytest.mark.parametrize(
    ("which", "names"),
    [((0,), "'left'"), ((1,), "'right'"), ((0, 1), "'left' and 'right'")],
)
def test_a_lens_in_air_whose_port_is_missing_is_told(which, names):
    """Of one lens its refraction looks like a turn of some 30 degrees; of both it
    cancels, unless they are toed in: here by 15 degrees, seen as 11."""
    lenses = tuple(item.camera for item in sample_rig().cameras)
    toed_in = stereo_rig(lenses, right_rotvec_deg=(0.0, -15.0, 0.0))
    given = nominal_rig(toed_in)
    text = refusal(
        without_ports(given, which),
        poses_of(given),
        same_frame_matches(simulated_dive(toed_in).scene),
    )
    assert f"probably the port of {names} is missing in the rig file" in text


@pytest.mark.parametrize(
    "angle_deg",
    [pytest.param(8.0, marks=slow), pytest.param(30.0, marks=slow), 90.0],
)
def test_a_wrong_rotation_of_lenses_calibrated_in_the_water_is_no_missing_port(
    rig, angle_deg
):
    in_water = without_ports(rig, (0, 1))
    pair = same_frame_matches(simulated_dive(in_water).scene)
    poses = poses_of(rig)
    poses[1] = rigid3.perturb(poses[1], np.radians([angle_deg, 0, 0, 0, 0, 0]))
    text = refusal(in_water, poses, pair)
    assert "cam_from_rig" in text and "missing" not in text


def without_ports(rig: Rig, which: tuple[int, ...]) -> Rig:
    cameras = list(rig.cameras)
    for c in which:
        bare = {"port": NoPort(), "refine_normal": False, "refine_distance": False}
        cameras[c] = replace(cameras[c], **bare)
    return replace(rig, cameras=tuple(cameras))


# Each axis and each angle once; every one with every other is slow.
TURNS = [
    pytest.param(
        axis,
        angle,
        marks=() if (axis, angle) in ((0, 8.0), (1, 90.0), (2, 30.0)) else slow,
    )
    for axis in (0, 1, 2)
    for angle in (8.0, 30.0, 90.0)
]


@pytest.mark.parametrize(("axis", "angle_deg"), TURNS)
def test_a_wrong_rotation_is_refused(rig, pair, axis, angle_deg):
    poses = poses_of(rig)
    turn = np.zeros(6)
    turn[axis] = np.radians(angle_deg)
    poses[1] = rigid3.perturb(poses[1], turn)
    refusal(rig, poses, pair)


def test_quaternion_in_the_order_wxyz_is_named(rig, pair):
    poses = poses_of(rig)
    poses[1, :4] = np.roll(poses[1, :4], 1)
    text = refusal(rig, poses, pair)
    assert "the quaternion of 'right' is in the order w, x, y, z" in text


def test_a_lens_of_half_the_resolution_is_named(rig, pair):
    """One is given for images of 400 x 300."""
    text = refusal(with_params(rig, (1,), slice(0, 4), 0.5), poses_of(rig), pair)
    assert "the lens of 'right' was calibrated at another resolution" in text
    assert "of images 0.5 times as large" in text


@pytest.mark.parametrize("larger", [1.25, 0.8, 1.4])
def test_a_lens_of_any_usual_resolution_is_named(rig, pair, larger):
    """As of 1000 x 750 for 800 x 600; such steps lie closer to each other than
    principal points to the middle."""
    text = refusal(with_params(rig, (1,), slice(0, 4), larger), poses_of(rig), pair)
    assert "the lens of 'right' was calibrated at another resolution" in text
    assert f"of images {larger:.3g} times as large" in text
    assert "taken together" not in text


def test_a_lens_of_another_shape_of_image_is_named(rig, pair):
    """Calibrated in 16:9 at 1600 x 900, for 4:3 of the same height at 800 x 600: one
    and a half times, with 133 pixels of 1067 cropped at the left."""
    lens = rig.cameras[1].camera
    fx, fy, cx, cy, *distortion = lens.params.tolist()
    wide = [1.5 * fx, 1.5 * fy, 1.5 * (cx + 400.0 / 3.0), 1.5 * cy, *distortion]
    given = camera_from_colmap(lens.model_name, lens.width, lens.height, wide)
    cameras = rig.cameras[0], replace(rig.cameras[1], camera=given)
    text = refusal(replace(rig, cameras=cameras), poses_of(rig), pair)
    assert "'right' was calibrated at another resolution and shape" in text
    assert "1.5 times as large" in text


def test_a_lens_calibrated_in_the_water_is_named_before_its_focal_length(rig, pair):
    wet = with_params(rig, (1,), slice(0, 2), 1.333)
    text = refusal(wet, poses_of(rig), pair)
    assert "probably the lens of 'right' was calibrated in the water" in text
    assert "else its focal length is 33% too long" in text


def test_a_wrong_lens_is_no_pair_of_images_taken_apart(rig, pair):
    """Enlarged by 0.87, which nothing has as a video mode: no placement fits more than
    80% of the matches, and each frame's own nearly all, as if taken apart."""
    given = with_params(rig, (1,), slice(0, 4), 0.87)
    assert set(_apart(given, pair)) == {"focal"}


def test_the_focal_length_of_one_camera_is_named(rig, pair):
    """Which of the two is wrong no match shows: one too long is the other too short."""
    text = refusal(with_params(rig, (1,), slice(0, 2), 1.2), poses_of(rig), pair)
    assert "the focal length of " in text
    assert "too short, or another camera's too long" in text


def with_params(rig: Rig, which: tuple[int, ...], part: slice, factor: float) -> Rig:
    cameras = list(rig.cameras)
    for c in which:
        lens = cameras[c].camera
        params = np.array(lens.params)
        params[part] *= factor
        new = camera_from_colmap(
            lens.model_name, lens.width, lens.height, params.tolist()
        )
        cameras[c] = replace(cameras[c], camera=new)
    return replace(rig, cameras=tuple(cameras))


def test_a_late_camera_is_named(rig, dive):
    """Its images bear the names of the frames before: neighbours fit, they do not."""
    scene = shifted(dive.scene, 1, 1, 0)

    def later(shift: int) -> list[PairMatches]:
        return [same_frame_matches(shifted(scene, 1, -shift, 0))]

    (now,) = later(0)
    with pytest.raises(ExplainedInputError) as error:
        poses = poses_of(rig)
        check_rig(rig, poses, [now], later)
        check_rotation(rig, poses, turned(rig, poses, now), [now], later)
    assert error.value.codes == ("frames_shifted",)
    assert "the images of 'right' are 1 frame late" in str(error.value)


def successive(scene: Scene, camera: int) -> PairMatches:
    """Matches of a camera's images with its next ones."""
    rows = []
    for frame in range(scene.num_frames - 1):
        now, then = (
            np.flatnonzero((scene.camera_idx == camera) & (scene.frame_idx == f))
            for f in (frame, frame + 1)
        )
        _, a, b = np.intersect1d(
            scene.point_idx[now], scene.point_idx[then], return_indices=True
        )
        first = np.full((len(a), 1), float(frame))
        rows.append(np.hstack([first, scene.xy[now[a]], scene.xy[then[b]]]))
    table = np.concatenate(rows)
    return PairMatches(
        camera_a=camera,
        camera_b=camera,
        frame_idx=table[:, 0].astype(np.int64),
        xy_a=table[:, 1:3],
        xy_b=table[:, 3:5],
    )


@pytest.mark.parametrize("axis", [0, 1, None])
def test_one_mirrored_camera_is_told_by_its_motion(rig, dive, pair, axis):
    """Nothing matches across a mirror; where nothing matches for another reason, as in
    murky water, the motions fit each other, and nobody is accused."""
    scene, xy = dive.scene, dive.scene.xy.copy()
    if axis is not None:
        right = scene.camera_idx == 1
        xy[right, axis] = (800.0, 600.0)[axis] - xy[right, axis]
    scene = replace(scene, xy=xy)
    few = pair.thinned(10)
    with pytest.raises(InputError) as error:
        check_rig(
            rig,
            poses_of(rig),
            [few],
            successive=lambda: [successive(scene, c) for c in range(2)],
        )
    codes = getattr(error.value, "codes", ())
    assert codes == (() if axis is None else ("mirrored",))
    if axis is not None:
        assert ("left to right", "top to bottom")[axis] in str(error.value)


def test_a_zoom_of_one_camera_midway_is_named(rig, pair):
    """By 15 % from the fourth frame on: no single focal length fits all frames."""
    center = rig.cameras[1].camera.params[2:4]
    late = (pair.frame_idx >= 3)[:, None]
    xy = np.where(late, center + 1.15 * (pair.xy_b - center), pair.xy_b)
    text = refusal(rig, poses_of(rig), replace(pair, xy_b=xy))
    assert "another one after the first 3 frames" in text


def test_domes_off_their_centres_declared_flat_are_named(rig):
    """A fisheye bends a central ray alike, but only a dome off its centre fits."""
    centers = (0.002, -0.003, 0.008), (-0.003, 0.001, 0.012)
    domes = tuple(
        replace(item, port=DomePort(center=center, radius=0.05))
        for item, center in zip(sample_rig().cameras, centers, strict=True)
    )
    pair = same_frame_matches(
        simulated_dive(replace(sample_rig(), cameras=domes)).scene
    )
    text = refusal(rig, poses_of(rig), pair)
    assert "is a dome, and not flat" in text and "fisheye" not in text


def test_images_that_were_never_taken_together_are_named(rig, dive):
    """Three frames late, and no neighbours to match: no placement of two cameras fits
    all frames, though in each frame one does."""
    scene = shifted(dive.scene, 1, 3, 0)
    now = same_frame_matches(scene)
    assert "were not taken together" in refusal(rig, poses_of(rig), now)


def test_baseline_along_another_axis_is_refused(rig, pair):
    poses = poses_of(rig)
    poses[1, 4:] = np.roll(poses[1, 4:], 1)
    refusal(rig, poses, pair)


def test_too_few_matches_are_counted(rig, pair):
    few = PairMatches(
        camera_a=0,
        camera_b=1,
        frame_idx=pair.frame_idx[:7],
        xy_a=pair.xy_a[:7],
        xy_b=pair.xy_b[:7],
    )
    assert "share only 7 matches" in refusal(rig, poses_of(rig), few)


def test_turns_make_the_rays_meet(rig, pair):
    """Tilts of 2 and 1 degrees: several pixels before, the noise after."""
    found = turned(rig, poses_of(rig), pair)
    focal_px = 620.0 * 1.333
    assert found.misfit_before * focal_px > 2.0
    assert found.misfit_after * focal_px < 0.5
    assert found.turn_deg[0] == 0.0
    assert 0.2 < found.turn_deg[1] < 0.8
    assert found.warnings(rig, {}) == []


def test_turns_keep_the_camera_centres(rig, pair):
    found = turned(rig, poses_of(rig), pair).cam_from_rig
    np.testing.assert_allclose(
        rigid3.inverse(found)[:, 4:], rigid3.inverse(poses_of(rig))[:, 4:], atol=1e-12
    )


def test_a_notable_turn_is_reported(rig, pair):
    poses = poses_of(rig)
    poses[1] = rigid3.perturb(poses[1], np.radians([3.0, 0, 0, 0, 0, 0]))
    rotation = turned(rig, poses, pair)
    causes = turn_causes(rig, poses, rotation, [pair])
    (warning,) = rotation.warnings(rig, causes)
    assert "'right'" in warning and "transposed" not in warning


def test_the_note_of_a_turn_names_the_mistake_that_it_healed(rig, pair):
    """A transposed rotation of 2 degrees: the turn back is of nearly 4, a port tilted
    by 15, which nobody mounts."""
    poses = poses_of(rig)
    poses[1, :3] *= -1.0
    rotation = turned(rig, poses, pair)
    check_rotation(rig, poses, rotation, [pair])
    (note,) = rotation.warnings(rig, turn_causes(rig, poses, rotation, [pair]))
    assert "probably the rotation of 'right' is transposed: transpose" in note
    assert "port" not in note


def test_one_picture_in_both_folders_has_no_depth(rig, pair):
    """Equal pixels of cameras side by side: their rays never meet in front."""
    same = replace(pair, xy_b=pair.xy_a)
    cameras = [rig.refractive_cameras()[0]] * 2
    poses = np.array([rigid3.IDENTITY, [0.0, 0.0, 0.0, 1.0, -0.2, 0.0, 0.0]])
    with pytest.raises(InputError, match="hold the same pictures"):
        scene_depths(cameras, poses, [same])


def test_depths_are_those_of_the_scene(rig, dive, pair):
    """Within a few percent, though ports and rotations are only approximate."""
    poses = turned(rig, poses_of(rig), pair).cam_from_rig
    depths = scene_depths(rig.refractive_cameras(), poses, [pair])
    truth = dive.truth
    for camera in (0, 1):
        seen = truth.camera_idx == camera
        cam_from_world = rigid3.compose(
            truth.cam_from_rig[camera], truth.rig_from_world[truth.frame_idx[seen]]
        )
        in_cam = rigid3.transform(cam_from_world, truth.points[truth.point_idx[seen]])
        expected = np.percentile(in_cam[:, 2], [10, 50, 90])
        np.testing.assert_allclose(depths[camera], expected, rtol=0.1)
