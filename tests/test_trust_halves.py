"""Cross-validation: halves of the frames agree where the model is right, and show by
how much they differ where it is not."""

import io
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

from uwsfm import calibrate
from uwsfm.calibration.enlarged import enlarged
from uwsfm.calibration.error_budget import with_budget
from uwsfm.calibration.observability import verdicts
from uwsfm.cli.app import app
from uwsfm.cli.check import halves_table
from uwsfm.errors import InputError
from uwsfm.geometry import rigid3
from uwsfm.jobs.check_halves import check_halves, cross_validated
from uwsfm.jobs.judgement import judged_result
from uwsfm.report.halves import halves_of, halves_payload
from uwsfm.residuals import border
from uwsfm.results.files import HOUSING
from uwsfm.results.folder import given_rig, open_result, require_model, store_judgement
from uwsfm.results.halves_summary import KEY, halves_numbers
from uwsfm.results.summary import housing_summary
from uwsfm.rig.file import load_rig
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion
from uwsfm.trust import halves as halves_module
from uwsfm.trust.goodness import Used
from uwsfm.trust.halves import (
    IN_ORDER,
    INTERLEAVED,
    CrossValidation,
    _differences,
    cross_validate,
)
from uwsfm.trust.halves_reason import FAR_APART, halves_reasons, untested_notes
from uwsfm.trust.projections import projection_map
from uwsfm.trust.shared_numbers import shared_numbers

RIG = nominal_rig(sample_rig())
NUM_FRAMES = 12


def dive(noise_px=0.3, num_frames=NUM_FRAMES):
    options = ObservationOptions(num_points=300, noise_px=noise_px)
    return simulate_scene(
        sample_rig(), rich_motion(num_frames), Relief(stddev=0.2), options
    )


@pytest.fixture(scope="module")
def solved():
    return calibrate(dive().scene, loss="l2")


@pytest.fixture(scope="module")
def right(solved) -> CrossValidation:
    return cross_validate(RIG, solved)


@pytest.fixture(scope="module")
def remounted() -> CrossValidation:
    """The right port is mounted anew midway, 10 mm farther away."""
    truth = dive().truth
    moved = truth.cameras[1].with_port(replace(truth.ports[1], distance=0.030))
    late = (truth.frame_idx >= NUM_FRAMES // 2) & (truth.camera_idx == 1)
    other = replace(truth, cameras=(truth.cameras[0], moved)).projections()[0]
    rng = np.random.default_rng(0)
    xy = np.where(late[:, None], other, truth.xy) + rng.normal(0.0, 0.1, truth.xy.shape)
    return cross_validate(RIG, calibrate(replace(truth, xy=xy), loss="l2"))


def split_of(found: CrossValidation, name: str):
    (split,) = (each for each in found.splits if each.name == name)
    return split


def test_halves_are_disjoint_and_whole(right, solved):
    for split in right.splits:
        assert sum(split.num_frames) == NUM_FRAMES
        # Points that one half sees once are left out of it.
        count = sum(split.num_observations)
        assert 0.97 * solved.scene.num_observations < count
        assert count <= solved.scene.num_observations
    assert [split.name for split in right.splits] == [INTERLEAVED, IN_ORDER]


def test_nothing_is_enlarged_where_the_model_is_right(right):
    """40 such dives: ratios of 0.87 to 0.98 RMS, none enlarged."""
    assert right.enlarged == {}
    groups = {each.group for each in right.splits[0].agreements}
    assert groups == {"tilt", "distance", "rotation", "direction", "length", "scale"}
    for split in right.splits:
        for each in split.agreements:
            assert each.num_independent >= 1.0
            assert 0.005 < each.p_value < 0.995


def test_a_port_that_moved_midway_is_seen(remounted):
    """First against second are two rigs; interleaved halves are of both."""
    numbers = split_of(remounted, IN_ORDER).numbers
    left, right = (n for n in numbers if n.group == "distance")
    # What both ports have in common is known to 1.5 mm, what they differ by to 0.4.
    assert right.difference - left.difference == pytest.approx(10.0, abs=1.5)
    assert remounted.enlarged["distance"] > 2.0
    by_group = {
        each.group: each.ratio for each in split_of(remounted, IN_ORDER).agreements
    }
    assert by_group["distance"] == max(by_group.values())
    # Groups are judged by the worse split.
    for group, factor in remounted.enlarged.items():
        ratios = [
            each.ratio
            for split in remounted.splits
            for each in split.agreements
            if each.group == group
        ]
        assert factor == max(ratios)


def test_numbers_differ_as_their_halves_do(solved):
    """Values, differences and deviations against the calibrations themselves."""
    other = calibrate(dive(noise_px=0.2).scene, loss="l2")
    found = shared_numbers(solved, other, ["left", "right"])
    by_name = {number.name: number for number in found.numbers}
    distance = by_name["port distance of right"]
    values = [1e3 * r.scene.ports[1].distance for r in (solved, other)]
    assert distance.values == pytest.approx(values, rel=1e-12)
    known = [r.covariance.cameras[1].distance_stddev_m for r in (solved, other)]
    # The same matrices, from the optimum and from the optimum opened again.
    assert distance.stddev == pytest.approx(1e3 * np.hypot(*known), rel=1e-3)
    normals = [r.scene.ports[0].normal for r in (solved, other)]
    tilt = by_name["tilt x of left"]
    assert tilt.values == pytest.approx(np.degrees(np.arcsin([n[0] for n in normals])))
    both = [
        np.sum([by_name[f"tilt {axis} of left"].stddev ** 2 for axis in "xy"]),
        np.sum(
            [r.covariance.cameras[0].normal_stddev_deg ** 2 for r in (solved, other)]
        ),
    ]
    # Two components make the angle. Each is raised to what neighbours share by itself,
    # the angle as a whole: one component may be raised alone.
    assert both[1] <= 1.001 * both[0] < 1.1 * both[1]
    turn = rigid3.compose(
        other.scene.cam_from_rig[1], rigid3.inverse(solved.scene.cam_from_rig[1])
    )
    turned = [by_name[f"rotation {axis} of right"].difference for axis in "xyz"]
    angle = np.degrees(rigid3.rotation_angle(turn))
    assert np.linalg.norm(turned) == pytest.approx(float(angle), rel=1e-6)


def test_projections_know_nothing_of_the_frame_of_the_rig():
    """A rig that is moved as a whole projects as before; a focal length does not."""
    truth = dive(noise_px=0.0).truth
    same = projection_map(truth, truth, truth, RIG, with_scale=False)
    assert np.nanmax(same.px) < 1e-6 and np.nanmax(same.mm) < 1e-6
    larger = replace(
        truth,
        cam_from_rig=np.hstack(
            [truth.cam_from_rig[:, :4], 1.02 * truth.cam_from_rig[:, 4:]]
        ),
        cameras=tuple(
            c.with_port(
                replace(
                    c.port,
                    distance=1.02 * c.port.distance,
                    thickness=1.02 * c.port.thickness,
                )
            )
            for c in truth.cameras
        ),
    )
    scaled = projection_map(truth, larger, truth, RIG, with_scale=True)
    assert np.nanmax(scaled.px) < 1e-5  # all lengths by one factor: no image changes
    held = projection_map(truth, larger, truth, RIG, with_scale=False)
    # 2 % of a disparity of 100 px, of which the motion takes what is common.
    assert held.rms_px(0) > 0.1


def test_projections_of_a_turned_port_are_off_by_as_much_as_pixels_are():
    """Against the projections of the scene's own points, the poses held."""
    truth = dive(noise_px=0.0).truth
    bent = truth.cameras[1].with_port(replace(truth.ports[1], distance=0.030))
    second = replace(truth, cameras=(truth.cameras[0], bent))
    found = projection_map(truth, second, truth, RIG, with_scale=False)
    moved = (second.projections()[0] - truth.xy)[truth.camera_idx == 1]
    held = np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    # The best motion of the rig takes part of it, and cannot add any.
    right = np.sqrt(np.nanmean(found.px[1] ** 2))
    assert 0.0 < right < held
    # Across the ray: pixels times range over the focal length in water. Rays of the
    # middle cells are slanted by less than 4 degrees, and begin 3 cm from a centre.
    focal = 1.333 * truth.cameras[1].lens[0]
    expected = found.px[1, 1] * 1e3 * found.ranges_m[1] / focal
    ratio = (found.mm[1, 1] / expected)[2:4, 3:5]
    assert np.all(np.abs(ratio - 1.0) < 0.03)


def test_enlarged_deviations_are_one_number_everywhere(remounted, solved):
    """In the covariance, the summary and the notes; what was given adds as before."""
    whole, budget = with_budget(solved)
    larger = enlarged(whole, remounted.enlarged)
    factor = remounted.enlarged["distance"]
    covariance, before = larger.covariance, whole.covariance
    totals = zip(before.in_all.cameras, covariance.in_all.cameras, strict=True)
    cameras = zip(before.cameras, covariance.cameras, totals, strict=True)
    entries = housing_summary(RIG, larger)
    columns = before.border_cols[:, border.DISTANCE]
    for entry, (own, more, (old, new)), k in zip(
        entries, cameras, columns, strict=True
    ):
        assert more.distance_stddev_m == pytest.approx(factor * own.distance_stddev_m)
        # Of a root sum of squares, only the part of the images has grown.
        assert new.distance_stddev_m == pytest.approx(
            np.sqrt(
                old.distance_stddev_m**2 + (factor**2 - 1.0) * own.distance_stddev_m**2
            )
        )
        assert entry["distance_stddev_m"] == more.distance_stddev_m
        assert entry["distance_stddev_in_all_m"] == new.distance_stddev_m
        assert covariance.border[k, k] == pytest.approx(factor**2 * before.border[k, k])
    hundred = enlarged(whole, {"distance": 100.0})
    notes = " ".join(verdicts(hundred, ["left", "right"], budget))
    said = [float(x) for x in re.findall(r"standard deviation ([0-9.]+) mm", notes)]
    known = [1e3 * c.distance_stddev_m for c in hundred.covariance.in_all.cameras]
    # Two notes: the ports moved together, and against each other. Their variances add
    # to that of a port, as far as both ports have the same share in each.
    assert len(said) == 2
    assert np.hypot(*said) == pytest.approx(np.sqrt(np.mean(np.square(known))), rel=0.1)
    with pytest.raises(AssertionError, match="enlarged once"):
        enlarged(larger, remounted.enlarged)


def with_ratio(found: CrossValidation, group: str, ratio: float) -> CrossValidation:
    """Halves that differ in one group by so many times, beyond any chance."""
    splits = []
    for split in found.splits:
        agreements = tuple(
            replace(a, ratio=ratio, p_value=1e-9) if a.group == group else a
            for a in split.agreements
        )
        splits.append(replace(split, agreements=agreements))
    return replace(found, splits=tuple(splits))


def test_halves_that_differ_far_are_a_reason_and_others_are_not(right, remounted):
    assert halves_reasons(None) == halves_reasons(right) == []
    near = with_ratio(right, "distance", 0.99 * FAR_APART)
    assert near.enlarged and halves_reasons(near) == []
    (reason,) = halves_reasons(with_ratio(right, "distance", 5.0))
    assert (
        reason.severity == "doubtful" and "port distances by 5.0 times" in reason.text
    )
    # 10 mm of 0.4 that one port's distance is known to, beside the other's.
    assert halves_reasons(remounted)


def test_halves_with_nothing_estimated_say_so(solved):
    """All that could differ is held: 1e-14 px is no agreement."""
    hold = {
        "refine_distances": False,
        "refine_normals": False,
        "refine_cam_from_rig": False,
    }
    found = cross_validate(RIG, calibrate(solved.scene, loss="l2", **hold))
    numbers = halves_numbers(found)
    for sentence in numbers["sentences"][:2]:
        assert "is estimated here" in sentence and "px" not in sentence
    shown = halves_of({KEY: numbers})
    assert shown["split"] is None and halves_payload({KEY: numbers}) == {}


def test_halves_change_verdict_words_and_notes_of_a_stored_result(dive_result):
    """And another cross-validation takes all of it back."""
    result, given = open_result(dive_result.out), given_rig(dive_result.out)
    found = cross_validate(given, result.solved)
    assert found.enlarged == {}
    far = cross_validated(result, given, with_ratio(found, "distance", 50.0))
    assert far["verdict"] == "doubtful"
    assert [reason["code"] for reason in far["reasons"]] == ["halves_differ"]
    for old, new in zip(result.summary["cameras"], far["cameras"], strict=True):
        own = old["distance_stddev_m"]
        assert new["distance_stddev_m"] == pytest.approx(50.0 * own)
        assert new["distance_verdict"] != "determined"
    added = set(far["warnings"]) - set(result.summary["warnings"])
    assert any("port distances by 50.0 times" in note for note in added)
    assert any("port distances of left and right, moved" in note for note in added)
    factors = far[KEY]["enlarged"]
    stored = replace(result, summary=far, calibration=enlarged(result.solved, factors))
    again = cross_validated(stored, given, found)
    for key in ("verdict", "reasons", "cameras", "scale", "refined"):
        assert again[key] == result.summary[key]
    assert sorted(again["warnings"]) == sorted(result.summary["warnings"])


def test_housing_and_what_is_made_of_a_result_follow_its_new_verdict(
    dive_result, tmp_path
):
    out = tmp_path / "out"
    shutil.copytree(dive_result.out, out)
    result = open_result(out)
    (out / "cloud.json").write_text(json.dumps({"model": result.fingerprint}))
    shown = enlarged(result.solved, {"distance": 50.0})
    store_judgement(result, shown, "doubtful")
    rig, old = load_rig(out / "housing.yaml"), load_rig(dive_result.out / HOUSING)
    assert (old.verdict, rig.verdict) == ("fits", "doubtful")
    known = shown.covariance.judged_cameras
    for camera, before, cov in zip(rig.cameras, old.cameras, known, strict=True):
        # Written with four digits.
        assert camera.accuracy.distance_m == pytest.approx(
            cov.distance_stddev_m, rel=1e-3
        )
        assert camera.accuracy.distance_m > 3.0 * before.accuracy.distance_m
        assert camera.port == before.port
    again = open_result(out)  # the checksums and the calibration's mark are its own
    require_model(out / "cloud.ply", out, "make it again")
    assert again.fingerprint != result.fingerprint


def test_a_folder_is_cross_validated_again(dive_result, tmp_path):
    """As the run itself did it; the table shows what the summary holds."""
    out = tmp_path / "out"
    shutil.copytree(dive_result.out, out)
    before = json.loads((out / "summary.json").read_text())
    bare = {key: value for key, value in before.items() if key != KEY}
    (out / "summary.json").write_text(json.dumps(bare))
    shown = CliRunner().invoke(app, ["check", str(out), "--halves"])
    assert shown.exit_code == 0, shown.output
    assert shown.stdout.startswith("Verdict: fits.")
    numbers = check_halves(out)
    after = json.loads((out / "summary.json").read_text())
    assert after[KEY] == json.loads(json.dumps(numbers))
    for split, first in zip(numbers["splits"], before[KEY]["splits"], strict=True):
        assert split["num_frames"] == [3, 3]
        for one, two in zip(split["numbers"], first["numbers"], strict=True):
            # Read from files of doubles: the same to the solver's last step.
            assert one["z"] == pytest.approx(two["z"], abs=1e-3)
    shown = io.StringIO()
    Console(file=shown, width=150).print(halves_table(numbers))
    ratio = numbers["splits"][0]["agreements"][0]["ratio"]
    assert "port tilts" in shown.getvalue() and f"{ratio:.2f} (p" in shown.getvalue()
    assert numbers["sentences"][0] in (out / "report.html").read_text(encoding="utf-8")


def test_few_frames_are_refused_with_the_number_that_is_needed():
    few = calibrate(dive(num_frames=5).scene, loss="l2")
    with pytest.raises(InputError, match="has 5 frames: halves .* need 6 or more"):
        cross_validate(RIG, few)
    (note,) = untested_notes(few, has_model=True)
    assert "not tested by halves" in note and "5 frames, and halves need 6" in note


def test_a_note_names_a_result_that_is_too_large_until_it_is_tested(
    dive_result, monkeypatch
):
    result, given = open_result(dive_result.out), given_rig(dive_result.out)
    assert untested_notes(result.calibration, has_model=True) == []
    count = result.model.scene.num_observations
    monkeypatch.setattr(halves_module, "LITTLE_WORK", count - 1)
    used = Used(**result.summary["goodness"]["used"])
    judged = judged_result(given, result.solved, used)
    bare = {key: value for key, value in result.summary.items() if key != KEY}
    large = judged.added_to({**bare, "warnings": []}, result.model.rig)
    (note,) = [text for text in large["warnings"] if "not tested" in text]
    assert f"{count:,} observations" in note
    assert "; uwsfm check OUT --halves tests them" in note and KEY not in large
    (other,) = untested_notes(result.calibration, has_model=False)
    assert "uwsfm reconstruct or refine, and then uwsfm check OUT --halves" in other
    found = cross_validate(given, result.solved)
    after = cross_validated(replace(result, summary=large), given, found)
    assert not any("not tested" in text for text in after["warnings"])


def test_a_result_without_a_model_is_refused_as_wrong_input(tmp_path):
    (tmp_path / "calibration.json").write_text("{}")
    shown = CliRunner().invoke(app, ["check", str(tmp_path), "--halves"])
    assert isinstance(shown.exception, InputError)
    assert "is a result of uwsfm calibrate" in str(shown.exception)


def test_lengths_of_a_scale_that_is_hardly_known_are_compared_by_their_shape():
    """Behind a flat port of a known distance one camera knows its scale by half: two
    halves a factor of 1.7 apart agree, and one whose lengths differ by 2 % does not."""
    rng = np.random.default_rng(5)
    first = rng.uniform(0.3, 2.0, 40)
    noise, loose = np.diag((1e-3 * first) ** 2), np.outer(first, first) * 0.4**2
    covariances = [noise + loose, 1.7**2 * (noise + loose)]

    def size(spread: float) -> float:
        second = 1.7 * first * (1.0 + spread * rng.standard_normal(len(first)))
        found, covariance = _differences([first, second], covariances, 1.7)
        return float(np.sqrt(np.mean(found**2 / np.diag(covariance))))

    # One half is noisy here and two are predicted, so the mean square is 0.5; of forty
    # numbers it has a standard deviation of 0.11.
    assert 0.1 < size(1e-3) ** 2 < 0.9
    assert size(2e-2) > 8.0
    # What is known well keeps its scale: 1.7 is far from one then.
    gaps, covariance = _differences([first, 1.7 * first], [noise, noise], 1.7)
    np.testing.assert_allclose(gaps, 0.7 * first)
    np.testing.assert_allclose(covariance, 2.0 * noise)


def test_a_half_whose_scale_is_loose_may_have_shrunk(rng):
    """A third of its own lengths is a twelfth of the other half's, and loose."""
    first = rng.uniform(0.3, 2.0, 40)
    second = 0.22 * first * (1.0 + 1e-3 * rng.standard_normal(40))
    known = np.diag((1e-3 * first) ** 2)
    loose = 0.22**2 * (known + np.outer(first, first) * 0.35**2)
    gaps, covariance = _differences([first, second], [known, loose], 0.22)
    assert np.mean(gaps**2 / np.diag(covariance)) < 2.0  # 0.5 to be expected
