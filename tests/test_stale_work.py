"""Touch one input of a run: exactly the steps that depend on it are done again."""

import inspect
import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest

from uwsfm.calibration.given_accuracy import CameraAccuracy, RigAccuracy
from uwsfm.errors import InputError
from uwsfm.models.ports.port import FlatPort
from uwsfm.results.calibration_file import fingerprint as model_fingerprint
from uwsfm.sfm import refractive_steps, start
from uwsfm.sfm.frontend.images import find_frames
from uwsfm.sfm.options import (
    FeatureOptions,
    MappingOptions,
    MatchOptions,
    StartOptions,
    VerificationOptions,
)
from uwsfm.sfm.start import match_images, start_from_matches
from uwsfm.sfm.steps import Steps, fingerprint
from uwsfm.sfm.workspace import Workspace
from uwsfm.simulate.rigs import sample_rig

NAMES = ("0001.png", "0002.png", "0003.png")


class Finished(Exception):
    """Mapping would be next."""


class Keys(Steps):
    """Notes what each step depends on, and does none of them."""

    def __init__(self, work_dir: Path) -> None:
        super().__init__(work_dir)
        self.keys: dict[str, str] = {}
        self.outputs: dict[str, list[str]] = {}
        self.clear: dict[str, Callable[[], None]] = {}

    def run(self, name, inputs, action, *, outputs, clear=None):
        self.keys[name] = fingerprint(inputs)
        self.outputs[name] = [path.name for path in outputs]
        if clear is not None:
            self.clear[name] = clear
        if name == "mapping":
            raise Finished
        return self.keys[name]


@pytest.fixture
def images(tmp_path):
    """Three frames of two cameras; only names, sizes and times of files are read."""
    for folder in ("left", "right"):
        (tmp_path / "images" / folder).mkdir(parents=True)
        for k, name in enumerate(NAMES):
            path = tmp_path / "images" / folder / name
            path.write_bytes(b"x" * (5 + k))
            os.utime(path, ns=(10**18, 10**18))
    masks = tmp_path / "masks" / "left"
    masks.mkdir(parents=True)
    for name in NAMES[:2]:
        (masks / f"{name}.png").write_bytes(b"mask")
        os.utime(masks / f"{name}.png", ns=(10**18, 10**18))
    return tmp_path / "images"


RIG = replace(sample_rig(), accuracy=RigAccuracy())
REFRACTIVE = StartOptions(mapper="refractive")


def keys_of(images, rig=RIG, options=REFRACTIVE):
    """The key of each step of a run on these images."""
    return steps_of(images, rig, options).keys


def steps_of(images, rig=RIG, options=REFRACTIVE):
    steps = Keys(images.parent / "work")
    space = Workspace(work_dir=steps.work_dir)
    pycolmap.Database.open(str(space.features)).close()
    space.rig.write_text(json.dumps(sample_rig().cam_from_rig.tolist()))
    frames = find_frames(images, rig)
    key = match_images(rig, frames, steps, space, options, print)
    with pytest.raises(Finished):
        start_from_matches(rig, frames, steps, key, options)
    return steps


def again(before, after):
    """Steps of the second run that are not done yet."""
    return [name for name, key in after.items() if before.get(name) != key]


FRONT = ["features", "matches"]
GEOMETRY = ["verification", "mapping"]
ALL = FRONT + GEOMETRY


def test_nothing_is_done_again_where_nothing_changed(images):
    before = keys_of(images)
    assert list(before) == ALL and again(before, keys_of(images)) == []
    assert len(set(before.values())) == 4


def touched(path, size=None):
    if size is not None:
        path.write_bytes(b"y" * size)
    os.utime(path, ns=(10**18, 10**18 + 1))


@pytest.mark.parametrize("folder", ["left", "right"])
@pytest.mark.parametrize("name", NAMES)
def test_an_image_that_was_replaced_is_searched_again(images, folder, name):
    before = keys_of(images)
    touched(images / folder / name)
    assert again(before, keys_of(images)) == ALL
    path = images / folder / name
    path.write_bytes(b"another size")
    os.utime(path, ns=(10**18, 10**18))
    assert again(before, keys_of(images)) == ALL


def test_more_and_fewer_images_are_other_images(images):
    before = keys_of(images)
    for folder in ("left", "right"):
        (images / folder / "0004.png").write_bytes(b"x")
    assert again(before, keys_of(images)) == ALL
    for name in ("0003.png", "0004.png"):
        (images / "right" / name).unlink()
    assert again(before, keys_of(images)) == ALL


def test_masks_that_changed_came_or_went_are_used(images):
    masks = images.parent / "masks"
    options = replace(REFRACTIVE, features=FeatureOptions(mask_dir=masks))
    before = keys_of(images, options=options)
    assert again(keys_of(images), before) == ALL
    for change in (
        lambda: touched(masks / "left" / f"{NAMES[0]}.png"),
        lambda: touched(masks / "left" / f"{NAMES[1]}.png", 9),
        lambda: (masks / "left" / f"{NAMES[2]}.png").write_bytes(b"mask"),
        lambda: (masks / "left" / f"{NAMES[0]}.png").unlink(),
    ):
        change()
        after = keys_of(images, options=options)
        assert again(before, after) == ALL
        before = after
    # What masks no image changes nothing.
    (masks / "left" / "0099.png.png").write_bytes(b"mask")
    assert again(before, keys_of(images, options=options)) == []


OPTIONS = {
    "contrast": ({"features": FeatureOptions(clahe=True)}, ALL),
    "number of features": ({"features": FeatureOptions(max_num_features=999)}, ALL),
    "threshold": ({"features": FeatureOptions(peak_threshold=0.01)}, ALL),
    "pairs": ({"matching": MatchOptions(strategy="sequential")}, ALL[1:]),
    "overlap": ({"matching": MatchOptions(overlap=3)}, ALL[1:]),
    "matcher": ({"matching": MatchOptions(matcher="paper")}, ALL[1:]),
    "seed": ({"seed": 1}, GEOMETRY),
    "verification": ({"verification": VerificationOptions(max_error_px=3.0)}, GEOMETRY),
    "mapping": ({"mapping": MappingOptions(max_error_px=5.0)}, ["mapping"]),
    "angle": ({"mapping": MappingOptions(min_angle_deg=2.0)}, ["mapping"]),
    "mapper": ({"mapper": "pinhole"}, ["mapping"]),
    "threads": ({"num_threads": 1}, []),
    "distance, by a baseline": ({"scene_distance_m": 7.0}, []),
}


@pytest.mark.parametrize("what", OPTIONS)
def test_an_option_repeats_what_it_changes(images, what):
    change, expected = OPTIONS[what]
    after = keys_of(images, options=replace(REFRACTIVE, **change))
    assert again(keys_of(images), after) == expected


def test_the_papers_matcher_draws_lots_and_colmaps_does_not(images):
    paper = replace(REFRACTIVE, matching=MatchOptions(matcher="paper"))
    before = keys_of(images, options=paper)
    assert again(before, keys_of(images, options=replace(paper, seed=1))) == ALL[1:]


def with_camera(index, **more):
    cameras = list(RIG.cameras)
    cameras[index] = replace(cameras[index], **more)
    return replace(RIG, cameras=tuple(cameras))


def lens(index, **more):
    old = RIG.cameras[index].camera
    camera = pycolmap.Camera(
        model=more.get("model", old.model_name),
        width=more.get("width", old.width),
        height=more.get("height", old.height),
        params=more.get("params", old.params),
    )
    return with_camera(index, camera=camera)


def params(slot, by):
    found = np.array(RIG.cameras[1].camera.params)
    found[slot] += by
    return found


def moved_rig(slot):
    poses = RIG.cam_from_rig.copy()
    poses[1, slot] += 1e-6
    poses[1, :4] /= np.linalg.norm(poses[1, :4])
    length = float(np.linalg.norm(poses[1, 4:]))
    return replace(RIG, cam_from_rig=poses, baseline_m=length)


def accuracy(**more):
    return with_camera(1, accuracy=CameraAccuracy(**more))


RIGS = {
    "size": (lens(0, width=802), ALL),
    "height": (lens(1, height=602), ALL),
    "focal length": (lens(1, params=params(0, 1e-6)), GEOMETRY),
    "last distortion": (lens(1, params=params(-1, 1e-9)), GEOMETRY),
    "port": (with_camera(1, port=FlatPort(distance=0.0201)), GEOMETRY),
    "water": (
        with_camera(0, port=replace(RIG.cameras[0].port, n_water=1.3401)),
        GEOMETRY,
    ),
    "valid radius": (with_camera(1, valid_radius_px=300.0), GEOMETRY),
    "position": (moved_rig(4), GEOMETRY),
    "rotation": (moved_rig(0), GEOMETRY),
    "held normal": (with_camera(0, refine_normal=False), ["mapping"]),
    "held distance": (with_camera(1, refine_distance=False), ["mapping"]),
    "held placement": (
        replace(RIG, refine_cam_from_rig=not RIG.refine_cam_from_rig),
        ["mapping"],
    ),
    "baseline's deviation": (replace(RIG, baseline_stddev_m=0.0123), ["mapping"]),
    "accuracy of the last": (accuracy(glass_index=0.0123), ["mapping"]),
    "accuracy of a lens": (accuracy(focal=0.0123), ["mapping"]),
    "accuracy of a tilt": (accuracy(normal_deg=0.123), ["mapping"]),
    "names": (with_camera(0, name="port"), None),
}


@pytest.mark.parametrize("what", RIGS)
def test_a_number_of_the_rig_repeats_what_it_changes(images, what):
    rig, expected = RIGS[what]
    found = again(keys_of(images), keys_of(images, rig))
    if expected is None:  # the accuracies are named by the cameras; no more is
        assert found in ([], ["mapping"])
    else:
        assert found == expected


def test_another_accuracy_is_no_less_another_for_having_been_given_before(images):
    """The covariance of all given numbers is a matrix of thousands."""
    before = keys_of(images, accuracy(focal=0.0123))
    assert again(before, keys_of(images, accuracy(focal=0.0124))) == ["mapping"]


def test_exchanged_folders_keep_their_features(images):
    left, right = RIG.cameras
    cameras = (replace(left, images="right"), replace(right, images="left"))
    after = keys_of(images, replace(RIG, cameras=cameras))
    assert again(keys_of(images), after) == GEOMETRY


def test_a_rig_from_its_baseline_is_a_step_of_its_own(images):
    open_rig = replace(RIG, cam_from_rig=None)
    before = keys_of(images, open_rig)
    assert list(before) == [*FRONT, "rig", *GEOMETRY]
    later = ["rig", *GEOMETRY]
    for changed in (
        replace(open_rig, baseline_m=0.2001),
        replace(with_camera(0, port=FlatPort(distance=0.0201)), cam_from_rig=None),
    ):
        assert again(before, keys_of(images, changed)) == later
    for change in (
        {"mapping": MappingOptions(max_error_px=5.0)},
        {"seed": 3},
        {"verification": VerificationOptions(min_num_inliers=20)},
    ):
        options = replace(REFRACTIVE, **change)
        assert again(before, keys_of(images, open_rig, options)) == later


def test_one_camera_is_scaled_by_the_distance_that_is_given(images):
    alone = replace(
        RIG, cameras=RIG.cameras[:1], cam_from_rig=RIG.cam_from_rig[:1], baseline_m=None
    )
    before = keys_of(images, alone)
    options = replace(REFRACTIVE, scene_distance_m=7.0)
    assert again(before, keys_of(images, alone, options)) == GEOMETRY


def test_a_long_survey_is_mapped_in_parts(images):
    options = more_frames(images)
    before = keys_of(images, options=options)
    assert list(before) == [*FRONT, "verification", "submaps", "mapping"]
    larger = replace(REFRACTIVE, mapping=MappingOptions(submap_frames=21))
    after = keys_of(images, options=larger)
    assert again(before, after) == ["submaps", "mapping"]


def more_frames(images):
    for k in range(4, 24):
        for folder in ("left", "right"):
            (images / folder / f"{k:04}.png").write_bytes(b"x")
    return replace(REFRACTIVE, mapping=MappingOptions(submap_frames=20))


def test_a_step_has_its_outputs_and_leaves_nothing_of_other_inputs(images):
    open_rig = replace(RIG, cam_from_rig=None)
    steps = steps_of(images, open_rig, more_frames(images))
    assert steps.outputs == {
        "features": ["database.db"],
        "matches": ["database.db"],
        "rig": ["rig.json"],
        "verification": ["mapping.db"],
        "submaps": ["submaps"],
        "mapping": ["refractive"],
    }
    pinhole = steps_of(images, options=replace(REFRACTIVE, mapper="pinhole"))
    assert pinhole.outputs["mapping"] == ["perspective"]
    space = Workspace(work_dir=steps.work_dir)
    left = [space.submaps, steps.work_dir / "matches", steps.work_dir / "features"]
    left.append(space.colors)
    for folder in left:
        folder.mkdir()
        (folder / "old").write_text("of other inputs")
    with pycolmap.Database.open(str(space.features)) as database:
        pair = two_images(database)
        database.write_matches(*pair, np.array([[0, 0]], dtype=np.uint32))
    assert set(steps.clear) == {"features", "matches", "submaps"}
    for name, gone in (
        ("submaps", left[:1]),
        ("matches", left[:2]),
        ("features", left),
    ):
        for _ in range(2):  # what is not there is no mistake
            steps.clear[name]()
        assert [folder for folder in left if not folder.exists()] == gone
        if name == "matches":
            with pycolmap.Database.open(str(space.features)) as database:
                assert not database.exists_matches(*pair)
    assert not space.features.exists()


class Doing(Keys):
    """Takes some steps of earlier runs for done, and does the others."""

    def run(self, name, inputs, action, *, outputs, clear=None):
        if name in ("features", "matches"):
            return "done"
        return Steps.run(self, name, inputs, action, outputs=outputs, clear=clear)


def noted(monkeypatch, module, name, gives, makes=None):
    """Put in the place of a function what notes its arguments by their names."""
    found: dict = {}
    takes = inspect.signature(getattr(module, name))

    def instead(*args, **keywords):
        found.update(takes.bind(*args, **keywords).arguments)
        if makes is not None:
            makes.mkdir(exist_ok=True)
        return gives

    monkeypatch.setattr(module, name, instead)
    return found


@pytest.mark.parametrize("mapper", ["pinhole", "refractive"])
def test_every_step_is_given_what_it_works_on(images, monkeypatch, mapper):
    """And the summary of the start says what it took, and what was odd."""
    masks = images.parent / "masks"
    options = StartOptions(
        mapper=mapper, scene_distance_m=3.5, features=FeatureOptions(mask_dir=masks)
    )
    rig, work = replace(RIG, cam_from_rig=None), images.parent / "work"
    frames, space = find_frames(images, rig), Workspace(work_dir=work)
    steps = Doing(work)
    assert match_key(rig, frames, steps, space, options) == "done"
    placement = np.array([[1.0, 0, 0, 0, 0, 0, 0], [1.0, 0, 0, 0, -0.25, 0, 0]])
    fixed = SimpleNamespace(
        pinholes=["pinhole"], rotation=SimpleNamespace(cam_from_rig="turned")
    )
    ended = SimpleNamespace(summary={"warnings": ["of the mapper"], "num_points": 9})
    baseline = noted(monkeypatch, start, "rig_from_baseline", placement)
    fitted = noted(monkeypatch, start, "fix_rig", fixed)
    database = noted(
        monkeypatch, start, "write_mapping_database", None, makes=space.mapping
    )
    if mapper == "pinhole":
        done = noted(monkeypatch, start, "_map", None, makes=space.perspective)
        read = noted(monkeypatch, start, "load_start", ended)
    else:
        best = SimpleNamespace(
            cam_from_rig="best",
            registered=np.array([True, False, True]),
            num_registered=2,
            counts=lambda: {"num_points": 9},
        )
        other = SimpleNamespace(num_registered=1)
        steps_of_it = refractive_steps
        pairs = noted(monkeypatch, steps_of_it, "read_correspondences", "matches")
        done = noted(monkeypatch, steps_of_it, "map_incrementally", [best, other])
        turned = noted(monkeypatch, steps_of_it, "turned_to", "ended")
        told = noted(monkeypatch, steps_of_it, "mapping_summary", {"told": 1})
        written = noted(
            monkeypatch,
            steps_of_it,
            "write_refractive_start",
            None,
            makes=space.refractive,
        )
        read = noted(monkeypatch, steps_of_it, "load_refractive_start", ended)
    monkeypatch.setattr(start, "range_warnings", lambda of: [f"{len(of.names)} dark"])

    found = start_from_matches(rig, frames, steps, "done", options, print)

    assert found is ended and found.summary["num_points"] == 9
    of_mapper, of_masks, of_range = found.summary["warnings"]
    assert of_mapper == "of the mapper" and of_range == "3 dark"
    assert of_masks.startswith("4 of 6 images have no mask in")
    assert list(found.summary["timings_s"]) == ["rig", "verification", "mapping"]
    assert found.summary["steps_of_earlier_runs"] == []
    for given in (baseline, fitted, database, done):
        for name, value in {
            "rig": rig,
            "frames": frames,
            "options": options,
            "progress": print,
            "features_path": space.features,
            "space": space,
            "fixed": fixed,
            "mapping_path": space.mapping,
            "scene_distance_m": 3.5,
            "work_dir": work,
        }.items():
            assert name not in given or given[name] == value, name
    assert np.array_equal(fitted["poses"], placement)
    assert database["pinholes"] == ["pinhole"] and database["cam_from_rig"] == "turned"
    assert len(database["cameras"]) == 2
    assert read["features_path"] == space.features and read["frames"] is frames
    if mapper == "pinhole":
        assert read["model_path"] == space.perspective
        return
    assert read["path"] == written["path"] == space.refractive
    assert list(pairs.values()) == [space.features, space.mapping, frames, rig]
    assert list(done.values()) == ["matches", rig, "turned", options, print]
    assert list(turned.values()) == [fixed, "best"]
    assert list(told.values()) == [rig, frames, "ended", {NAMES[0], NAMES[2]}, [1]]
    assert list(written.values())[1:] == [best, {"num_points": 9, "told": 1}]

    # Nothing is done again; what took how long is still told.
    for given in (baseline, database, done):
        given.clear()
    ended.summary = {"warnings": []}
    again = start_from_matches(rig, frames, Doing(work), "done", options, print)
    assert not baseline and not database and not done
    assert again.summary["steps_of_earlier_runs"] == ["rig", "verification", "mapping"]


def match_key(rig, frames, steps, space, options):
    pycolmap.Database.open(str(space.features)).close()
    return match_images(rig, frames, steps, space, options, print)


def two_images(database):
    """Identifiers of two images with a keypoint each."""
    camera = pycolmap.Camera(model="PINHOLE", width=8, height=6, params=[5, 5, 4, 3])
    camera_id = database.write_camera(camera)
    pair = [
        database.write_image(pycolmap.Image(name=name, camera_id=camera_id))
        for name in ("left/a", "left/b")
    ]
    for image in pair:
        database.write_keypoints(image, np.ones((1, 2), dtype=np.float32))
    return pair


# ---- Fingerprints -------------------------------------------------------------------


def test_no_number_of_an_array_is_left_out_of_a_fingerprint():
    """As text, large arrays have only their first and last numbers."""
    large = np.zeros((60, 60))
    before = fingerprint([large])
    for place in ((0, 0), (30, 30), (59, 59)):
        other = large.copy()
        other[place] = 1e-12
        assert fingerprint([other]) != before
    assert fingerprint({"a": 1, "b": 2}) == fingerprint({"b": 2, "a": 1})
    assert fingerprint([Path("a")]) != fingerprint([Path("b")])
    assert fingerprint([np.int64(3)]) == fingerprint([3])
    assert len(before) == 16
    with pytest.raises(TypeError, match="no step may depend on object"):
        fingerprint([object()])


def test_every_file_of_a_model_is_in_its_mark(tmp_path):
    sparse = tmp_path / "sparse"
    sparse.mkdir()
    names = ("cameras.bin", "frames.bin", "images.bin", "points3D.bin", "rigs.bin")
    for name in names:
        (sparse / name).write_bytes(name.encode())
    housing = tmp_path / "housing.yaml"
    housing.write_text("version: 1")
    before = model_fingerprint(sparse, housing)
    assert model_fingerprint(sparse, housing) == before
    for path in (*(sparse / name for name in names), housing):
        content = path.read_bytes()
        path.write_bytes(content[:-1] + b"?")
        assert model_fingerprint(sparse, housing) != before
        path.write_bytes(content)
    (sparse / "rigs.bin").rename(sparse / "rigs.bin.old")
    assert model_fingerprint(sparse, housing) != before
    (sparse / "rigs.bin.old").rename(sparse / "rigs.bin")
    (sparse / "more.bin").write_bytes(b"")
    assert model_fingerprint(sparse, housing) != before
    housing.unlink()
    with pytest.raises(InputError, match="housing.yaml: cannot be read"):
        model_fingerprint(sparse, housing)
    with pytest.raises(InputError, match="nowhere: no such COLMAP model folder"):
        model_fingerprint(tmp_path / "nowhere", housing)
