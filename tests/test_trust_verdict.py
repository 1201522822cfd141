"""The verdict: correct inputs fit, wrong ones do not, and every reason can be given."""

from dataclasses import replace

import numpy as np
import pytest
from sfm_scenes import simulated_dive

from uwsfm import DomePort
from uwsfm.calibration.bundle_adjustment import calibrate
from uwsfm.geometry import rigid3
from uwsfm.rig.rig import Rig
from uwsfm.sfm.noise_floor import NoiseFloor
from uwsfm.sfm.refine import refine_scene
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, paper_rig, sample_rig, tilted_normal
from uwsfm.simulate.trajectories import lawn_mower, rich_motion, straight_strip
from uwsfm.trust import freed as freed_module
from uwsfm.trust.given import Departure
from uwsfm.trust.goodness import Part, Used
from uwsfm.trust.verdict import (
    DOES_NOT_FIT,
    DOUBTFUL,
    FITS,
    LEVEL,
    judge,
    judged,
    verdict_on,
)


def domed(rig: Rig, rng: np.random.Generator) -> Rig:
    """The same lenses behind domes, nearly concentric ones."""
    cameras = []
    for camera in rig.cameras:
        radius = rng.uniform(0.04, 0.12)
        center = tuple((0.08 * radius * rng.normal(size=3)).tolist())
        port = DomePort(center, radius, 0.005, 1.5, 1.333)
        camera = replace(camera, port=port, refine_center=True)
        cameras.append(replace(camera, refine_normal=False, refine_distance=False))
    return replace(rig, cameras=tuple(cameras))


def random_rig(rng: np.random.Generator) -> Rig:
    """Ports of 1 to 100 mm, tilts to 8 degrees; one in four is behind domes."""
    rig = sample_rig() if rng.random() < 0.5 else paper_rig()
    if rng.random() < 0.25:
        return domed(rig, rng)
    cameras = []
    for camera in rig.cameras:
        normal = tilted_normal(rng.uniform(0.0, 8.0), rng.uniform(-180.0, 180.0))
        distance = float(np.exp(rng.uniform(np.log(0.001), np.log(0.1))))
        port = replace(camera.port, normal=normal, distance=distance)
        cameras.append(replace(camera, port=port))
    return replace(rig, cameras=tuple(cameras))


def verdict_of_correct_input(seed: int):
    """A random rig on a random dive; the rig file has straight ports, at a factor of
    two from the truth at most, as one would write them down."""
    rng = np.random.default_rng(seed)
    rig, frames = random_rig(rng), int(rng.integers(5, 16))
    motion = [rich_motion, straight_strip, lambda n: lawn_mower(3, n // 3)][seed % 3]
    simulated = simulate_scene(
        rig,
        motion(frames + 3),
        Relief(stddev=rng.uniform(0.05, 0.2), correlation_length=0.4, seed=seed),
        ObservationOptions(
            num_points=int(rng.choice([200, 500])),
            noise_px=rng.uniform(0.2, 0.6),
            detection_rate=0.7,
            outlier_ratio=float(rng.choice([0.0, 0.05])),
            seed=seed,
        ),
    )
    given = nominal_rig(rig, distance_scale=float(rng.choice([0.5, 1.0, 2.0])))
    scene = replace(simulated.scene, cameras=given.refractive_cameras())
    if seed % 5 == 4:  # one camera alone
        scene, _ = scene.select(scene.camera_idx == 0)
        one = replace(scene, cameras=scene.cameras[:1])
        scene = replace(one, cam_from_rig=scene.cam_from_rig[:1])
        given = replace(
            given, cameras=given.cameras[:1], cam_from_rig=None, baseline_m=None
        )
    refined = refine_scene(scene, given)
    used = Used(
        num_frames=scene.num_frames,
        num_registered=scene.num_frames,
        num_tested=refined.num_tested,
        num_kept=len(refined.kept),
    )
    return judged(given, refined.calibration, used)


def test_what_no_test_could_have_contradicted_does_not_fit_but_is_doubtful():
    """Two frames: no place in the image is seen often enough for what repeats there."""
    simulated = simulated_dive(num_frames=2, num_points=600)
    verdict = adjusted(simulated.scene, nominal_rig(sample_rig()), with_floor=True)
    assert codes(verdict) == {"too_little_data": DOUBTFUL}
    assert "2 frames" in verdict.reasons[0].text


@pytest.mark.parametrize("seed", range(8))
def test_a_correct_input_fits(seed):
    verdict = verdict_of_correct_input(seed)
    assert verdict.verdict == FITS, [reason.text for reason in verdict.reasons]
    assert verdict.reasons == ()


@pytest.mark.slow
def test_correct_inputs_fit_in_97_of_100_cases():
    words = [verdict_of_correct_input(seed).verdict for seed in range(100, 200)]
    assert words.count(FITS) >= 97


@pytest.fixture(scope="module")
def dive():
    """A dive, and its rig as a user would write it down."""
    simulated = simulated_dive(num_frames=8, num_points=600)
    return simulated.scene, nominal_rig(sample_rig())


def adjusted(scene, rig: Rig, *, with_floor: bool = False):
    """The verdict; the noise floor of a wrong model takes seconds."""
    start = replace(
        scene, cameras=rig.refractive_cameras(), cam_from_rig=rig.cam_from_rig
    )
    refined = refine_scene(start, rig)
    frames = scene.num_frames
    used = Used(
        num_frames=frames,
        num_registered=frames,
        num_tested=refined.num_tested,
        num_kept=len(refined.kept),
    )
    if with_floor:
        return judged(rig, refined.calibration, used)
    return judge(rig, refined.calibration, None, used)


@pytest.fixture(scope="module")
def fitting(dive):
    verdict = adjusted(*dive, with_floor=True)
    assert verdict.verdict == FITS
    return verdict


def with_lens(rig: Rig, camera: int, **slots: float) -> Rig:
    cameras = list(rig.cameras)
    lens = cameras[camera].camera
    names = lens.params_info.split(", ")
    params = np.array(lens.params)
    for name, step in slots.items():
        params[names.index(name)] += step
    changed = type(lens)(
        model=lens.model_name, width=lens.width, height=lens.height, params=params
    )
    cameras[camera] = replace(cameras[camera], camera=changed)
    return replace(rig, cameras=tuple(cameras))


def codes(verdict) -> dict[str, str]:
    return {reason.code: reason.severity for reason in verdict.reasons}


def test_a_wrong_lens_is_named_by_its_camera(dive, fitting):
    scene, rig = dive
    verdict = adjusted(scene, with_lens(rig, 1, k1=-0.1, k2=0.1))
    assert verdict.verdict != FITS
    named = [r for r in verdict.reasons if r.code == "lens_does_not_fit"]
    assert any("right" in reason.text for reason in named)
    (fit,) = [c for c in verdict.goodness.cameras if c.name == "right"]
    (text,) = [r.text for r in named if "right" in r.text]
    assert f"{fit.systematic_px:.2g} px" in text and f"{fit.freed_px:.2g} px" in text


@pytest.mark.parametrize(
    "steps",
    [{"fx": 6.0, "fy": 6.0}, {"cy": 6.0}, {"p1": 0.003}],
    ids=["focal length 1 %", "principal point 6 px", "p1 0.003"],
)
def test_a_lens_that_hides_in_ports_and_poses_is_found_by_freeing_it(dive, steps):
    """By place, next to nothing is systematic."""
    scene, rig = dive
    wrong = with_lens(with_lens(rig, 0, **steps), 1, **steps)
    verdict = adjusted(scene, wrong)
    assert verdict.verdict != FITS
    assert {"lenses_do_not_fit", "lens_does_not_fit"} & set(codes(verdict))
    free = verdict.goodness.freed_lenses
    # Twice eight numbers, of which each saves one noise variance by chance.
    assert free.num_freed == 16 and free.gain > 3 * 16


def test_right_lenses_save_no_more_than_chance_and_refined_ones_are_not_asked(fitting):
    free = fitting.goodness.freed_lenses
    assert free.num_freed == 16
    # Chi-square of 16 degrees: 0.0001 at both ends.
    assert 2.0 < free.gain < 45.0 and 1e-4 < free.p_value < 1.0


def test_a_baseline_in_another_unit_is_seen_by_the_ports(dive):
    """It fits to the last digit: only the ruler knows."""
    scene, rig = dive
    poses = rig.cam_from_rig.copy()
    poses[:, 4:] *= 25.0
    long = replace(rig, cam_from_rig=poses, baseline_m=25.0 * rig.baseline_m)
    far = replace(scene, points=25.0 * scene.points)
    frames = scene.rig_from_world.copy()
    frames[:, 4:] *= 25.0
    verdict = adjusted(replace(far, rig_from_world=frames), long, with_floor=True)
    assert codes(verdict)["port_distance"] == DOES_NOT_FIT
    reason = verdict.reasons[0]
    # 20 mm ports in a world 25 times as large, but for glass that has not grown.
    stddev = reason.numbers["stddev"]
    assert reason.numbers["estimate"] == pytest.approx(0.5, abs=3.0 * stddev)
    assert "times the given one" in reason.text and "10 ± 5 mm, assumed" in reason.text
    assert verdict.goodness.floor.ratio < 1.2


@pytest.mark.parametrize("axis,degrees", [(0, 1.0), (1, 0.5), (2, 0.3)])
def test_a_held_rotation_that_ports_and_lenses_could_stand_for_is_found(
    dive, axis, degrees
):
    """Ports that tilt, and lenses if they were free, take up most of it."""
    scene, rig = dive
    poses = rig.cam_from_rig.copy()
    turn = np.zeros(6)
    turn[axis] = np.radians(degrees)
    poses[1, :4] = rigid3.perturb(poses[1], turn)[:4]
    held = replace(rig, cam_from_rig=poses, refine_cam_from_rig=False)
    wrong = adjusted(scene, held)
    assert wrong.verdict != FITS
    # Five numbers, three of a rotation and two of a direction, that hold the truth.
    goodness = wrong.goodness
    assert goodness.freed_placement.num_freed == 5
    assert goodness.freed_placement.gain > goodness.freed_lenses.gain
    (text,) = [r.text for r in wrong.reasons if r.code == "placement_does_not_fit"]
    assert text.startswith("With the placement of the cameras free, ")
    assert not [r for r in wrong.reasons if r.code.startswith("lens")]  # it is exact


def test_a_held_placement_that_is_right_saves_no_more_than_chance(dive):
    scene, rig = dive
    right = adjusted(scene, replace(rig, refine_cam_from_rig=False))
    assert right.verdict == FITS
    # Chi-square of five degrees: 0.0001 at both ends.
    assert 0.08 < right.goodness.freed_placement.gain < 27.0
    assert adjusted(scene, rig).goodness.freed_placement is None


def test_a_held_rotation_that_is_wrong_lies_above_the_noise_floor(dive):
    scene, rig = dive
    poses = rig.cam_from_rig.copy()
    # The transpose of the rotation: the usual mistake.
    poses[1, :3] *= -1.0
    wrong = replace(rig, cam_from_rig=poses, refine_cam_from_rig=False)
    verdict = adjusted(scene, wrong, with_floor=True)
    assert verdict.verdict == DOES_NOT_FIT
    assert "above_noise_floor" in codes(verdict)
    assert "lens_does_not_fit" not in codes(verdict)  # it is exact
    free = [r.text for r in verdict.reasons if r.code == "lenses_do_not_fit"]
    assert all("not the lenses alone" in text for text in free)
    floor = verdict.goodness.floor
    (text,) = [r.text for r in verdict.reasons if r.code == "above_noise_floor"]
    assert f"{floor.model_px:.2g} px RMS" in text and f"{floor.ratio:.1f}" in text


def test_one_camera_that_is_late_is_no_fit(dive):
    scene, rig = dive
    simulated = simulated_dive(num_frames=9, num_points=600)
    late = simulated.scene
    # The right images of frame f + 1 count as those of frame f.
    right = late.camera_idx == 1
    frame = late.frame_idx - right
    keep = (frame >= 0) & (frame < 8)
    shifted, _ = replace(late, frame_idx=frame).select(keep)
    shifted = replace(shifted, rig_from_world=late.rig_from_world[:8])
    verdict = adjusted(shifted, rig)
    assert verdict.verdict == DOES_NOT_FIT


def test_a_zoom_midway_is_systematic_in_time(dive):
    scene, rig = dive
    late = scene.frame_idx >= scene.num_frames // 2
    centers = np.array([camera.lens[2:4] for camera in scene.cameras])
    offset = scene.xy - centers[scene.camera_idx]
    zoomed = scene.xy + 0.04 * late[:, None] * offset
    verdict = adjusted(replace(scene, xy=zoomed), rig)
    assert verdict.verdict != FITS
    (part,) = [p for p in verdict.goodness.parts if p.by == "time"]
    assert part.p_value < LEVEL


def departure(what: str, given: float, estimate: float, stddev: float, **more):
    return Departure(
        camera="left",
        what=what,
        given=given,
        estimate=estimate,
        stddev=stddev,
        given_stddev=more.pop("given_stddev", float("nan")),
        **more,
    )


FLOOR = NoiseFloor(
    floor_px=0.3,
    model_px=0.9,
    regions=np.full((3, 3, 2), np.nan),
    num_pairs=10,
    num_matches=1000,
)
TRIGGERS = {
    "above_noise_floor": ({"floor": FLOOR}, DOES_NOT_FIT),
    "not_converged": ({"converged": False}, DOUBTFUL),
    "too_little_data": (
        {"parts": (Part(by="place", px=float("nan"), p_value=float("nan")),)},
        DOUBTFUL,
    ),
    "distance_at_zero": ({"below_zero_z": 12.0}, DOUBTFUL),
    "few_frames": ({"used": Used(num_frames=30, num_registered=9)}, DOUBTFUL),
    "few_observations": (
        {"used": Used(num_frames=9, num_registered=9, num_tested=1000, num_kept=200)},
        DOUBTFUL,
    ),
    "known_length": ({"known_length_z": 6.0}, DOUBTFUL),
    "positions": ({"positions_scatter": 5.0, "positions_left_out": 0.0}, DOUBTFUL),
    "port_distances": (
        {
            "departures": (
                departure("distances_share", 1.0, 4.7, 0.74, given_stddev=0.65),
            )
        },
        DOUBTFUL,
    ),
    "port_tilt": (
        {"departures": (departure("tilt_deg", 0.0, 32.0, 0.5, given_stddev=5.0),)},
        DOES_NOT_FIT,
    ),
    "dome_centre": (
        {"departures": (departure("center_share", 0.0, 0.97, 0.02, given_stddev=0.2),)},
        DOES_NOT_FIT,
    ),
    "glass": (
        {
            "departures": (
                departure("thickness_m", 0.05, 0.08, 2e-3, given_stddev=5e-3),
            )
        },
        DOUBTFUL,
    ),
    "focal_length": (
        {"departures": (departure("focal_share", 1.0, 1.33, 0.01, given_stddev=0.03),)},
        DOES_NOT_FIT,
    ),
    "principal_point": (
        {
            "departures": (
                departure("principal_point_px", 0.0, 90.0, 3.0, given_stddev=16.0),
            )
        },
        DOUBTFUL,
    ),
    # The GoPro's lens in a wrong basin: k1 1.78, k2 5.78.
    "distortion": (
        {"departures": (departure("stretch", 1.0, 1.8, 0.0),)},
        DOES_NOT_FIT,
    ),
    "distortion_folds": (
        {"departures": (departure("unseen_share", 0.0, 0.2, 0.0),)},
        DOES_NOT_FIT,
    ),
}


@pytest.mark.parametrize("code", TRIGGERS)
def test_each_reason_is_given_when_its_number_is_wrong_and_only_then(fitting, code):
    changes, severity = TRIGGERS[code]
    assert code not in codes(fitting)
    verdict = verdict_on(replace(fitting.goodness, **changes))
    assert codes(verdict) == {code: severity}
    assert verdict.verdict == severity
    (reason,) = verdict.reasons
    assert reason.text.endswith(".") and reason.text[0].isupper()
    assert "nan" not in reason.text and "inf" not in reason.text


@pytest.mark.parametrize(
    ("what", "given", "estimate"),
    [
        ("distance_m", 0.01, 0.43),
        ("tilt_deg", 0.0, 40.0),
        ("center_share", 0.0, 0.9),
        ("glass_index", 1.5, 1.6),
        ("focal_share", 1.0, 2.0),
        ("principal_point_px", 0.0, 300.0),
    ],
)
def test_what_the_images_hardly_determine_is_not_called_wrong(
    fitting, what, given, estimate
):
    for stddev in (abs(estimate - given), float("nan")):
        item = departure(what, given, estimate, stddev, given_stddev=0.01)
        goodness = replace(fitting.goodness, departures=(item,))
        assert verdict_on(goodness).verdict == FITS


def test_a_port_at_the_lens_fits_and_a_wrong_lens_that_drives_it_there_does_not(dive):
    """Both end at the bound, zero."""
    scene, rig = dive
    close = replace(
        sample_rig(),
        cameras=tuple(
            replace(c, port=replace(c.port, distance=0.0)) for c in sample_rig().cameras
        ),
    )
    correct = simulated_dive(close, num_frames=6, num_points=400)
    given = nominal_rig(sample_rig(), distance_scale=0.2)
    verdict = adjusted(correct.scene, given)
    assert verdict.verdict == FITS
    wrong = adjusted(scene, with_lens(rig, 0, cx=-40.0, cy=-30.0))
    assert wrong.verdict != FITS


def test_the_numbers_are_those_of_the_arrays(dive):
    scene, rig = dive
    start = replace(scene, cameras=rig.refractive_cameras())
    result = calibrate(start, baseline_stddev_m=0.0)
    used = Used(num_frames=8, num_registered=8)
    goodness = judge(rig, result, None, used).goodness
    part, _ = result.scene.select(result.inliers)
    residuals = part.residuals()
    assert goodness.rms_px == pytest.approx(np.sqrt(np.mean(np.sum(residuals**2, 1))))
    for index, camera in enumerate(goodness.cameras):
        own = residuals[part.camera_idx == index]
        assert camera.rms_px == pytest.approx(np.sqrt(np.mean(np.sum(own**2, 1))))
    by_what = {(d.camera, d.what): d for d in goodness.departures}
    for port, camera, before in zip(
        result.scene.ports, result.covariance.cameras, rig.cameras, strict=True
    ):
        item = by_what[before.name, "distance_m"]
        assert item.given == before.port.distance and item.estimate == port.distance
        assert item.stddev == camera.distance_stddev_m


def test_a_large_scene_is_asked_by_some_of_its_frames(dive, monkeypatch):
    scene, rig = dive
    monkeypatch.setattr(freed_module, "MAX_OBSERVATIONS", 2000)
    monkeypatch.setattr(freed_module, "PART", 1500)
    right = refine_scene(replace(scene, cameras=rig.refractive_cameras()), rig)
    found = freed_module.freed_numbers(right.calibration).lenses
    part = freed_module._some_frames(right.scene)
    assert 1500 <= part.num_observations < right.scene.num_observations
    assert 1 < part.num_frames < scene.num_frames
    assert found.p_value > 1e-4
    lens = with_lens(with_lens(rig, 0, p1=0.006), 1, p1=0.006)
    wrong = refine_scene(replace(scene, cameras=lens.refractive_cameras()), lens)
    assert freed_module.freed_numbers(wrong.calibration).lenses.p_value < LEVEL
