"""Many dives: their file, and what becomes of them."""

import subprocess
import sys
from pathlib import Path

import cv2
import pytest
import yaml
from sfm_scenes import reduced_images, reduced_rig

from uwsfm._base.tasks import Workers
from uwsfm.errors import InputError
from uwsfm.jobs.batch import run_batch
from uwsfm.jobs.dives_file import load_dives
from uwsfm.options.jobs import ReconstructOptions
from uwsfm.results.log import LOG
from uwsfm.rig.file import dump_rig

DIVE = {"name": "bow", "rig": "rig.yaml", "images": "wreck/bow"}


def written(folder: Path, content: dict) -> Path:
    path = folder / "dives.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def test_dives_inherit_options_and_find_their_files(tmp_path):
    stern = {
        **DIVE,
        "name": "stern",
        "out": "results/stern",
        "options": {
            "clahe": False,
            "lengths": "wreck/lengths.yaml",
            "lever_arm": [0.2, -0.1, 1],
            "refine": ["water-index"],
            "prior": {"water_index_stddev": 0.002},
        },
    }
    content = {"version": 1, "options": {"clahe": True}, "dives": [DIVE, stern]}
    bow, other = load_dives(written(tmp_path, content))
    assert (bow.rig, bow.images) == (tmp_path / "rig.yaml", tmp_path / "wreck/bow")
    assert (bow.out, other.out) == (tmp_path / "bow", tmp_path / "results/stern")
    assert bow.options == ReconstructOptions.of(clahe=True)
    assert other.options == ReconstructOptions.of(
        clahe=False,
        lengths=tmp_path / "wreck/lengths.yaml",
        lever_arm=(0.2, -0.1, 1.0),
        refine_water_index=True,
        water_index_stddev=0.002,
    )


@pytest.mark.parametrize(
    "dives, message",
    [
        (
            [{**DIVE, "image": "x"}],
            r"dives\[0\].image: unknown key, did you mean images",
        ),
        (
            [{**DIVE, "options": {"matches": "all"}}],
            r"dives\[0\].options.matches: unknown key, did you mean matcher\?",
        ),
        (
            [{**DIVE, "options": {"prior": {"focal": 0.1}}}],
            r"dives\[0\].options.prior.focal: unknown key; .* focal_stddev, ",
        ),
        ([{**DIVE, "options": {"seed": -1}}], r"options.seed: must be at least 0"),
        (
            [{**DIVE, "options": {"fundamental_max_error_px": 3.0}}],
            r"dives\[0\].options: fundamental_max_error_px has no effect",
        ),
        ([DIVE, DIVE], r"dives\[1\].name: is that of dives\[0\]"),
        (
            [DIVE, {**DIVE, "name": "stern", "out": "./bow"}],
            r"dives\[1\].out: is that of dives\[0\]",
        ),
        (
            [{**DIVE, "out": "nn/b"}, {**DIVE, "name": "stern", "out": "nn"}],
            r"dives\[0\].out: the folder of 'bow' is inside that of 'stern'",
        ),
        ([{**DIVE, "name": "a/b"}], r"dives\[0\].name: must be the name of a folder"),
        ([], r"dives: there is none in the list"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_its_key(tmp_path, dives, message):
    path = written(tmp_path, {"version": 1, "dives": dives})
    with pytest.raises(InputError, match=f"{path}: .*{message}"):
        load_dives(path)


def test_wrong_input_needs_no_workers_and_is_one_sentence_in_the_log(
    tmp_path, monkeypatch, caplog
):
    monkeypatch.setattr(Workers, "outcomes", None)  # not to be called
    (outcome,) = run_batch(written(tmp_path, {"version": 1, "dives": [DIVE]}))
    assert caplog.messages == [f"dive bow: {outcome.reason}"]  # and once on the screen
    assert "rig.yaml" in outcome.reason
    log = (tmp_path / "bow" / LOG).read_text().splitlines()
    assert log[-1].endswith(f"failed: {outcome.reason}") and len(log) == 2


def test_a_dive_named_as_its_images_leaves_nothing_among_them(tmp_path):
    small_dive(tmp_path, num_frames=1)
    dive = {"name": "images", "rig": "rig.yaml", "images": "./images"}
    before = sorted(tmp_path.rglob("*"))
    path = written(tmp_path, {"version": 1, "dives": [dive]})
    (outcome,) = run_batch(path)
    assert "images is the folder of the images" in outcome.reason
    assert sorted(tmp_path.rglob("*")) == sorted([*before, path])


def test_no_threads_at_all_are_refused(tmp_path):
    """Local worker processes would be none, and never end."""
    with pytest.raises(
        InputError, match=r"^--threads \(num_threads\) must be positive"
    ):
        run_batch(written(tmp_path, {"version": 1, "dives": [DIVE]}), num_threads=0)
    assert not (tmp_path / "bow").exists()


def small_dive(folder: Path, num_frames: int, scale: float = 0.4) -> None:
    """The first frames of the sample, reduced, and their rig."""
    reduced_images(folder / "images", scale, num_frames)
    dump_rig(reduced_rig(scale), folder / "rig.yaml", "")


@pytest.mark.slow
def test_a_failed_dive_does_not_stop_the_others(tmp_path):
    """The second of three dives has no images, the third cannot be matched."""
    small_dive(tmp_path, num_frames=6)
    blank = tmp_path / "grey"
    for folder in ("left", "right"):
        (blank / folder).mkdir(parents=True)
        for source in (tmp_path / "images" / folder).iterdir():
            image = cv2.imread(str(source))
            cv2.imwrite(str(blank / folder / source.name), 0 * image + 90)
    dives = [
        {"name": "good", "rig": "rig.yaml", "images": "images"},
        {"name": "lost", "rig": "rig.yaml", "images": "nowhere"},
        {"name": "blank", "rig": "rig.yaml", "images": "grey"},
        {"name": "again", "rig": "rig.yaml", "images": "images"},
    ]
    path = written(tmp_path, {"version": 1, "dives": dives})
    found = subprocess.run(
        [
            sys.executable,
            "-c",
            "from uwsfm.cli.app import main; main()",
            "batch",
            str(path),
        ],
        capture_output=True,
        text=True,
        env=None,
        check=False,
    )
    assert found.returncode == 1
    assert "2 of 4 dives failed" in found.stderr
    table = " ".join(found.stdout.split())
    for dive in dives:
        assert dive["name"] in table
    assert "result" in table and table.count("6 of 6") == 2
    assert "does not exist" in " ".join(table.replace("│", " ").split())
    for name in ("good", "again"):
        assert (tmp_path / name / "summary.json").exists()
        log = (tmp_path / name / LOG).read_text()
        assert "mapping" in log and log.rstrip().endswith("done")
    assert "no features were found" in (tmp_path / "blank" / LOG).read_text()
    assert "Traceback" not in found.stdout + found.stderr
