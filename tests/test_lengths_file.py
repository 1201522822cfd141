"""lengths.yaml and positions.csv: what comes of them, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from bounds import LEAST, MOST
from command_line import one_sentence, run
from sfm_scenes import model_of
from summary_schema import schema_faults
from test_outside import (
    ARM,
    NAV_STDDEV,
    bar,
    dive,
    in_nav,
    one_camera,
    scaled_start,
    tracked,
)

import uwsfm
from uwsfm import InputError
from uwsfm._base.options import option_named
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.cli.options import vector_of
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import align
from uwsfm.inputs.known_lengths import KnownLengths
from uwsfm.inputs.lengths_file import load_lengths, load_positions
from uwsfm.results.files import export_colmap
from uwsfm.rig.file import dump_rig
from uwsfm.simulate import perturbed
from uwsfm.simulate.rigs import nominal_rig, sample_rig
from uwsfm.simulate.trajectories import rich_motion
from uwsfm.solver.terms import centers

HEADER = "frame,x,y,z,sx,sy,sz\n"


def positions_csv(path, found, names=None, stddev=NAV_STDDEV):
    names = names or [f"{i:04}.jpg" for i in range(len(found))]
    rows = [
        f"{name},{x:.6f},{y:.6f},{z:.6f},{stddev},{stddev},{stddev}\n"
        for name, (x, y, z) in zip(names, found, strict=True)
    ]
    path.write_text(HEADER + "".join(rows))
    return path


def scale_bar(truth, folders, rng, click_px=0.0, ends=None):
    """A bar between two points, clicked in every image that shows them."""
    if ends is None:
        counts = np.bincount(truth.point_idx, minlength=truth.num_points)
        ends = np.argsort(-counts, kind="stable")[:2]
    clicked = []
    for point in ends:
        rows = np.nonzero(truth.point_idx == point)[0]
        clicks = []
        for i in rows:
            folder, frame = folders[truth.camera_idx[i]], truth.frame_idx[i]
            xy = (truth.xy[i] + click_px * rng.normal(size=2)).tolist()
            clicks.append({"image": f"{folder}/{frame:04}.jpg", "xy": xy})
        clicked.append(clicks)
    length = float(np.linalg.norm(np.subtract(*truth.points[ends])))
    return {"length_m": length, "stddev_m": 0.0005, "ends": clicked}


def lengths_yaml(path, **content):
    path.write_text(yaml.safe_dump({"version": 1, **content}))
    return path


class Mono:
    """A dive with one camera, as a COLMAP model of some scale."""

    def __init__(self, folder):
        self.true_rig = one_camera()
        simulated = dive(self.true_rig, rich_motion(12))
        self.truth = simulated.truth
        self.rig = folder / "rig.yaml"
        dump_rig(nominal_rig(self.true_rig), self.rig)
        start = scaled_start(perturbed(simulated.scene))
        self.model = folder / "model"
        export_colmap(model_of(nominal_rig(self.true_rig), start), self.model)


@pytest.fixture(scope="module")
def mono(tmp_path_factory):
    return Mono(tmp_path_factory.mktemp("mono"))


def scale_of(result, truth):
    found, true = (centers(s.rig_from_world) for s in (result.model.scene, truth))
    return align(found, true, np.ones(len(true)), with_scale=True).scale


def bound_of(mono, **lengths):
    """What observations with 0.5 px of noise and these lengths can tell at best."""
    return predict_covariance(mono.truth, 0.5, lengths=uwsfm.Lengths(**lengths))


def test_scale_arbitrary_is_said_wherever_a_length_is(mono, tmp_path):
    out = tmp_path / "out"
    found = run("refine", str(mono.model), str(mono.rig), "-o", str(out))
    assert found.returncode == 0, found.stderr
    text = " ".join(found.stdout.split())
    assert "distance (1e-3," in text and "scale │" in text
    assert "scale arbitrary: nothing determines it" in text
    assert " mm" not in text and "(mm)" not in text
    summary = json.loads((out / "summary.json").read_text())
    assert schema_faults(summary) == []
    assert summary["scale"]["verdict"] == "arbitrary"
    assert summary["scale"]["relative_stddev"] is None
    assert summary["scale"]["unit"] == "scale arbitrary"
    assert "Scale arbitrary" in (out / "housing.yaml").read_text()
    header = (out / "points.ply").read_bytes()[:200]
    assert b"comment unit: scale arbitrary" in header


def test_clicked_scale_bar_makes_one_camera_metric(mono, tmp_path, rng):
    clicked = scale_bar(mono.truth, ["left"], rng, click_px=1.0)
    file = lengths_yaml(tmp_path / "lengths.yaml", scale_bars=[clicked])
    result = uwsfm.refine_model(
        mono.model, mono.rig, tmp_path / "out", lengths=file, report=False
    )
    stddev = result.summary["scale"]["relative_stddev"]
    assert result.summary["scale"]["unit"] == "metre"
    assert abs(scale_of(result, mono.truth) - 1.0) < 3.0 * stddev
    (fit,) = result.summary["known_lengths"]
    # The clicks' noise is part of what the length is known to: 1 px, at 2 m with a
    # focal length of 1000 px, in some ten images at either end.
    assert 0.0007 < fit["stddev_m"] < 0.003
    best = bound_of(mono, between_points=bar(mono.truth, fit["stddev_m"])).scale_stddev
    assert LEAST < stddev / best < MOST
    assert abs(fit["found_m"] - fit["given_m"]) < 3.0 * fit["stddev_m"]
    # The clicks are no part of the model.
    assert result.model.scene.num_points <= mono.truth.num_points


def test_clicked_scale_bar_makes_a_housing_metric(mono, tmp_path, rng):
    """Calibrated alone, from the same model: the port's distance in millimetres."""
    clicked = scale_bar(mono.truth, ["left"], rng, click_px=1.0)
    file = lengths_yaml(tmp_path / "lengths.yaml", scale_bars=[clicked])
    result = uwsfm.calibrate_housing(
        mono.rig, mono.model, tmp_path / "out", lengths=file
    )
    assert result.summary["scale"]["unit"] == "metre"
    (camera,) = result.summary["cameras"]
    error = camera["distance_m"] - mono.truth.ports[0].distance
    assert abs(error) < 3.0 * camera["distance_stddev_m"]
    # A length to a per mille or two leaves the port's distance to the images.
    bound = bound_of(mono, between_points=bar(mono.truth))
    ratio = camera["distance_stddev_m"] / bound.cameras[0].distance_stddev_m
    assert LEAST < ratio < MOST


def test_distance_of_frames_makes_one_camera_metric(mono, tmp_path):
    origins = centers(mono.truth.rig_from_world)
    length = float(np.linalg.norm(origins[11] - origins[8]))
    known = {"frames": ["0011.jpg", "0008.jpg"], "length_m": length, "stddev_m": 0.005}
    file = lengths_yaml(tmp_path / "lengths.yaml", frame_distances=[known])
    result = uwsfm.refine_model(
        mono.model, mono.rig, tmp_path / "out", lengths=file, report=False
    )
    stddev = result.summary["scale"]["relative_stddev"]
    known = uwsfm.Distances.from_arrays([[11, 8]], [length], [0.005])
    assert LEAST < stddev / bound_of(mono, between_frames=known).scale_stddev < MOST
    assert abs(scale_of(result, mono.truth) - 1.0) < 4.0 * stddev


def test_positions_make_one_camera_metric_and_place_it(mono, tmp_path, rng):
    found, wrong = tracked(mono.truth, rng, outliers=0.3)
    file = positions_csv(tmp_path / "nav.csv", found)
    arm = ",".join(str(value) for value in ARM)
    out = tmp_path / "out"
    done = run(
        "refine",
        *map(str, (mono.model, mono.rig, "-o", out, "--positions", file)),
        f"--lever-arm={arm}",
    )
    assert done.returncode == 0, done.stderr
    text = " ".join(done.stdout.split())
    assert f"{len(wrong)} of 12 positions contradict the images" in text
    summary = json.loads((out / "summary.json").read_text())
    assert schema_faults(summary) == []
    assert summary["positions"]["outliers"] == [f"{f:04}.jpg" for f in wrong]
    assert summary["scale"]["verdict"] == "determined"
    model = uwsfm.read_model(out)
    reached = centers(model.scene.rig_from_world)
    gap = np.linalg.norm(reached.mean(axis=0) - in_nav(mono.truth).mean(axis=0))
    assert gap < 4.0 * np.linalg.norm(summary["positions"]["place_stddev_m"])


def test_a_bar_that_contradicts_the_baseline_is_told(tmp_path, rng):
    rig = sample_rig()
    simulated = dive(rig, rich_motion(8), noise_px=0.2)
    model = tmp_path / "model"
    export_colmap(model_of(rig, simulated.scene), model)
    dump_rig(rig, tmp_path / "rig.yaml")
    clicked = scale_bar(simulated.truth, ["left", "right"], rng)
    clicked = {
        **clicked,
        "length_m": 1.05 * clicked["length_m"],
        "click_stddev_px": 0.2,
    }
    file = lengths_yaml(tmp_path / "lengths.yaml", scale_bars=[clicked])
    result = uwsfm.refine_model(
        model, tmp_path / "rig.yaml", tmp_path / "out", lengths=file, report=False
    )
    told = [w for w in result.summary["warnings"] if "known length 1" in w]
    assert len(told) == 1 and "contradicts" in told[0]
    assert not any("scale" in w for w in result.summary["warnings"])


CSV_PROBLEMS = {
    "": "must be frame,x,y,z,sx,sy,sz, or frame,depth,sdepth where only depths",
    "a.jpg,1,2,3,1,1,1\n": "header must be",
    "frame,lat,lon,depth,sx,sy,sz\na,1,2,3,1,1,1\n": "'lat' is in degrees",
    HEADER + "a,1,2,3,1,1\n": "row 2: 6 columns instead of 7",
    HEADER + "a,1,2,x,1,1,1\n": "row 2: z: 'x' is not a number",
    HEADER + "a,1,nan,3,1,1,1\n": "row 2: y: nan is not finite",
    HEADER + "a,1,2,3,1,0,1\n": "row 2: sy: 0 m must be positive",
    HEADER + "a,1,2,3,1,1,1\na,1,2,3,1,1,1\n": "frame 'a' is given twice",
    HEADER + "a,1,2,3,1,1,1\nb,2,2,3,1,1,1\n": "2 positions are too few",
    HEADER
    + "".join(f"{i},8.9{i},44.4001,{i},1,1,1\n" for i in range(3)).replace(
        "8.9", "8.9000"
    ): "if 8.9000 and 44.4001 are degrees",
    HEADER + "".join(f"{i},{i},4900000,0,1,1,1\n" for i in range(3)): (
        "up to 4900000 m are not of a local"
    ),
    HEADER + "".join(f"{i},{i},1e300,0,1,1,1\n" for i in range(3)): "up to 1e+300 m",
}


@pytest.mark.parametrize(("text", "words"), CSV_PROBLEMS.items())
def test_wrong_positions_end_inone_sentence(tmp_path, text, words):
    file = tmp_path / "nav.csv"
    file.write_text(text)
    with pytest.raises(InputError) as refused:
        load_positions(file)
    assert words in str(refused.value) and str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


CLICKS = [{"image": "left/0000.jpg", "xy": [1.0, 2.0]}]
BAR = {"length_m": 0.5, "stddev_m": 0.001, "ends": [2 * CLICKS, 2 * CLICKS]}
PAIR = {"length_m": 1.0, "stddev_m": 0.1, "frames": ["a", "b"]}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({}, "neither scale_bars nor frame_distances"),
        ({"scale_bar": [BAR]}, "did you mean scale_bars"),
        ({"scale_bars": [{**BAR, "length_m": -1.0}]}, "scale_bars[0].length_m"),
        ({"scale_bars": [{**BAR, "ends": [CLICKS, CLICKS]}]}, "scale_bars[0].ends[0]"),
        ({"scale_bars": [{**BAR, "ends": [2 * CLICKS]}]}, "scale_bars[0].ends"),
        ({"frame_distances": [{**PAIR, "frames": ["a", "a"]}]}, "one and the same"),
        ({"frame_distances": [{**PAIR, "stddev_m": float("nan")}]}, "stddev_m"),
    ],
)
def test_wrong_lengths_end_inone_sentence(tmp_path, content, words):
    file = lengths_yaml(tmp_path / "lengths.yaml", **content)
    with pytest.raises(InputError) as refused:
        load_lengths(file)
    assert words in str(refused.value) and str(file) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_unknown_names_are_refused_before_anything_is_written(mono, tmp_path, rng):
    found, _ = tracked(mono.truth, rng)
    names = [f"{i:04}.png" for i in range(12)]
    nav = positions_csv(tmp_path / "nav.csv", found, names)
    arguments = ("refine", str(mono.model), str(mono.rig), "-o", str(tmp_path / "out"))
    done = run(*arguments, "--positions", str(nav))
    one_sentence(done, "'0000.png' is not among the images", "'0000.jpg'")
    assert not (tmp_path / "out").exists()
    with pytest.raises(InputError, match="--lever-arm 1,2: write three numbers"):
        vector_of(option_named(uwsfm.ReconstructOptions, "lever_arm"), "1,2")
    with pytest.raises(InputError, match=r"^--lever-arm .* no effect without"):
        KnownLengths.read(None, None, [1.0, 2.0, 3.0])

    def refused(words, **content):
        file = lengths_yaml(tmp_path / "lengths.yaml", **content)
        with pytest.raises(InputError, match=words):
            uwsfm.refine_model(
                mono.model, mono.rig, tmp_path / "out", lengths=file, report=False
            )

    clicked = scale_bar(mono.truth, ["left"], rng)
    other = {
        **clicked,
        "ends": [[{"image": "up/1.jpg", "xy": [1, 1]}] * 2, clicked["ends"][1]],
    }
    refused("'up/1.jpg' is not among the images", scale_bars=[other])
    outside = replace_click(clicked, xy=[1e4, 1.0])
    refused("outside of left/", scale_bars=[outside])
    refused("frame_distances", frame_distances=[PAIR])
    elsewhere = replace_click(clicked, xy=[2.0, 3.0])
    refused("scale bar 1, end 1: its clicks miss each other", scale_bars=[elsewhere])
    once = {**clicked, "ends": [[clicked["ends"][0][0]] * 2, clicked["ends"][1]]}
    refused("it takes two different images", scale_bars=[once])


def replace_click(bar, **values):
    first = {**bar["ends"][0][0], **values}
    return {**bar, "ends": [[first, *bar["ends"][0][1:]], bar["ends"][1]]}


def test_lengths_do_not_change_what_they_agree_with(rng):
    """Exact lengths of the model itself, weak: the same optimum."""
    simulated = dive(sample_rig(), rich_motion(6), num_points=200)
    plain = uwsfm.calibrate(simulated.scene)
    origins = centers(plain.scene.rig_from_world)
    known = uwsfm.Distances.from_arrays(
        [[0, 5]], [np.linalg.norm(origins[0] - origins[5])], [10.0]
    )
    again = uwsfm.calibrate(
        simulated.scene, lengths=uwsfm.Lengths(between_frames=known)
    )
    moved = replace(again.scene, cameras=plain.scene.cameras)
    np.testing.assert_allclose(
        rigid3.inverse(moved.rig_from_world)[:, 4:], origins, rtol=0, atol=1e-5
    )
