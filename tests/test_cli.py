"""Every command, and the sentences in which its mistakes end."""

import json
import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
import yaml
from command_line import one_sentence, run
from filelock import FileLock
from sfm_scenes import model_of

from uwsfm.cli.console import console
from uwsfm.cli.tables import housing_table
from uwsfm.jobs.reconstruct import WORK
from uwsfm.results.files import export_colmap
from uwsfm.results.housing import export_housing
from uwsfm.rig.file import load_rig
from uwsfm.simulate import ObservationOptions, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion

COMMANDS = [
    [],
    ["init"],
    ["reconstruct"],
    ["calibrate"],
    ["refine"],
    ["demo"],
    ["batch"],
    ["check"],
    ["clean"],
    ["color"],
    ["dense"],
    ["export"],
    ["map"],
    ["measure"],
    ["mesh"],
    ["report"],
    ["view"],
    ["simulate"],
    ["simulate", "images"],
    ["simulate", "observations"],
]


def test_the_package_runs_as_a_module(tmp_path):
    found = subprocess.run(
        [sys.executable, "-m", "uwsfm", "-V"],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[1],
        check=True,
    )
    assert found.stdout == run("--version").stdout != ""


def test_a_shell_completes_commands_and_options():
    """As the function that --install-completion leaves asks for it."""
    for typed, expected in (
        ("uwsfm reconst", "reconstruct"),
        ("uwsfm dense --keep", "--keep-single"),
    ):
        words = {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split()) - 1)}
        environment = {**os.environ, "_UWSFM_COMPLETE": "complete_bash", **words}
        code = (
            "import sys; sys.argv = ['uwsfm']; from uwsfm.cli.app import main; main()"
        )
        found = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            env=environment,
            check=False,
        )
        assert expected in found.stdout.split(), found.stderr


def test_extras_are_installed_from_the_source_folder():
    """The package index knows no uwsfm, or somebody else's."""
    root = Path(__file__).parents[1]
    texts = [*root.glob("*.md")]
    for folder in ("uwsfm", "pipelines", "datasets"):
        texts += [*(root / folder).rglob("*.md"), *(root / folder).rglob("*.py")]
    assert len(texts) > 300
    for path in texts:
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"install\s+'?\"?uwsfm|'uwsfm\[", text), path


def test_version():
    found = run("--version")
    assert found.returncode == 0, found.stderr
    assert found.stdout == f"uwsfm {metadata.version('uwsfm')}\n"


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help(command):
    found = run(*command, "--help")
    assert found.returncode == 0, found.stderr
    assert "Usage" in found.stdout


def test_help_and_version_import_nothing_heavy():
    heavy = (
        "numpy",
        "scipy",
        "numba",
        "pycolmap",
        "cv2",
        "open3d",
        "yaml",
        "distributed",
        "matplotlib",
        "plotly",
        "jinja2",
        "rerun",
    )
    code = (
        "import sys; sys.argv = ['uwsfm', '--version']\n"
        "from uwsfm.cli.app import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        f"print([m for m in {heavy} if m in sys.modules])"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert found.stdout.splitlines()[-1] == "[]"


def test_init_writes_a_rig_file_once(tmp_path):
    assert run("init", "rig.yaml", cwd=tmp_path).returncode == 0
    written = (tmp_path / "rig.yaml").read_text()
    assert "cam_from_rig" in written
    again = run("init", "rig.yaml", cwd=tmp_path)
    assert again.returncode == 2
    assert again.stderr.strip() == "error: rig.yaml exists already: name another file"
    assert (tmp_path / "rig.yaml").read_text() == written


def test_reconstruct_names_what_is_missing(tmp_path):
    one_sentence(
        run("reconstruct", "nowhere.yaml", "images", "-o", "out", cwd=tmp_path),
        "nowhere.yaml",
    )
    run("init", "rig.yaml", cwd=tmp_path)
    one_sentence(
        run("reconstruct", "rig.yaml", "images", "-o", "out", cwd=tmp_path),
        "images",
        "does not exist",
    )
    (tmp_path / "images" / "left").mkdir(parents=True)
    one_sentence(
        run("reconstruct", "rig.yaml", "images", "-o", "out", cwd=tmp_path),
        "left",
        "holds no image",
    )
    assert {path.name for path in tmp_path.iterdir()} == {"rig.yaml", "images"}


def test_reconstruct_never_overwrites_a_foreign_model(tmp_path):
    (tmp_path / "project" / "sparse").mkdir(parents=True)
    keep = tmp_path / "project" / "sparse" / "cameras.bin"
    keep.write_bytes(b"mine")
    run("init", "rig.yaml", cwd=tmp_path)
    one_sentence(
        run("reconstruct", "rig.yaml", ".", "-o", "project", cwd=tmp_path),
        "was not made by uwsfm",
    )
    assert keep.read_bytes() == b"mine"


def test_reconstruct_never_clears_a_foreign_folder(tmp_path):
    """A folder of the name of the workspace may hold anything."""
    mine = tmp_path / "out" / WORK / ".git" / "config"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    run("init", "rig.yaml", cwd=tmp_path)
    one_sentence(
        run("reconstruct", "rig.yaml", ".", "-o", "out", cwd=tmp_path),
        "was not made by uwsfm",
    )
    assert mine.read_text() == "mine"


def test_two_runs_do_not_share_a_folder(tmp_path):
    run("init", "rig.yaml", cwd=tmp_path)
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        for name in ("1.png", "2.png"):
            (tmp_path / folder / name).write_bytes(b"x")
    (tmp_path / "out" / WORK).mkdir(parents=True)
    with FileLock(tmp_path / "out" / WORK / "lock"):
        one_sentence(
            run("reconstruct", "rig.yaml", ".", "-o", "out", cwd=tmp_path),
            "another uwsfm is at work",
        )


def test_names_are_printed_as_they_are(capsys):
    """Square brackets are markup to the library that draws the tables."""
    camera = {
        "name": "[/x]",
        "port": "flat",
        "normal": [0.0, 0.0, 1.0],
        "normal_stddev_deg": None,
        "normal_stddev_in_all_deg": 2.0,
        "normal_verdict": "held",
        "distance_m": 0.02,
        "distance_stddev_m": None,
        "distance_stddev_in_all_m": 0.004,
        "distance_verdict": "held",
    }
    for angle in ("azimuth", "tilt"):
        camera |= {
            f"{angle}_deg": 0.0,
            f"{angle}_stddev_deg": None,
            f"{angle}_stddev_in_all_deg": 1.4,
        }
    console.print(housing_table({"cameras": [camera], "scale": {"small_unit": "mm"}}))
    assert "[/x]" in capsys.readouterr().out


def test_unsupported_lens_is_named(tmp_path):
    run("init", "rig.yaml", cwd=tmp_path)
    text = (tmp_path / "rig.yaml").read_text()
    text = text.replace("model: OPENCV", "model: DIVISION")
    text = text.replace(
        "params: [1400.0, 1400.0, 960.0, 540.0, -0.1, 0.05, 0.0, 0.0]",
        "params: [1400.0, 1400.0, 960.0, 540.0, -0.05]",
    )
    (tmp_path / "rig.yaml").write_text(text)
    one_sentence(
        run("reconstruct", "rig.yaml", ".", "-o", "out", cwd=tmp_path),
        "'left'",
        "DIVISION",
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--prior", "distance=1"], "--prior distance=1: the key is one of normal_s"),
        (["--prior", "focal_stddev=a"], "'a' is not a number"),
        (["--error", "point_3d"], "hold the distances"),
        (["--fundamental-max-error", "3"], "give matcher 'paper'"),
        (["--mapper", "refractive", "--matcher", "paper"], "images does not exist"),
        (
            ["--strategy", "nested", "--refine", "focal", "-o", "x"],
            "refine_focal needs",
        ),
        ([], "images does not exist"),
    ],
)
def test_calibrate_names_the_mistake(tmp_path, options, words):
    run("init", "rig.yaml", cwd=tmp_path)
    arguments = ["calibrate", "rig.yaml", "images", "-o", "out", *options]
    one_sentence(run(*arguments, cwd=tmp_path), words)
    assert {path.name for path in tmp_path.iterdir()} == {"rig.yaml"}


def test_simulated_observations_calibrate_back_as_the_manual_shows(
    tmp_path, monkeypatch, capsys
):
    manual = Path(__file__).parents[1] / "docs" / "howto" / "python.md"
    page = manual.read_text(encoding="utf-8")
    (command,) = re.findall(
        r"^uwsfm (simulate observations -o .*)$", page, re.MULTILINE
    )
    found = run(*command.split(), cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    (example,) = (block for block in blocks if "perturbed" in block)
    names: dict[str, Any] = {}
    exec(example, names)
    scene, truth = names["result"].scene, names["dive"].truth
    cameras = names["result"].covariance.cameras
    for port, true, known in zip(scene.ports, truth.ports, cameras, strict=True):
        miss = abs(port.distance - true.distance)
        # It started 10 mm off; 0.2 mm is what this dive determines.
        assert 0.0 < miss < 4.0 * known.distance_stddev_m < 0.001
    shown = capsys.readouterr().out.splitlines()
    assert shown[0] == (
        f"{1e3 * scene.ports[0].distance:.2f} ± "
        f"{1e3 * cameras[0].distance_stddev_m:.2f} mm, true: 20.00"
    )
    one_sentence(
        run("simulate", "observations", "-o", "dive.npz", cwd=tmp_path),
        "dive.npz exists already",
    )
    run("init", "rig.yaml", cwd=tmp_path)
    one_sentence(
        run("calibrate", "rig.yaml", "dive.npz", "-o", "out", cwd=tmp_path),
        "uwsfm.simulate.read_observations('dive.npz')",
    )
    one_sentence(
        run("simulate", "observations", "-o", "dive.txt", cwd=tmp_path), ".npz"
    )
    one_sentence(
        run("simulate", "images", "-o", "d", "--preset", "ocean", cwd=tmp_path), "ocean"
    )


@pytest.mark.parametrize("to", ["pinhole", "refractive-colmap", "ply"])
def test_export_writes_what_is_asked(tmp_path, to):
    rig = sample_rig()
    options = ObservationOptions(num_points=60, noise_px=0.3)
    scene = simulate_scene(rig, rich_motion(2), None, options).scene
    export_colmap(model_of(rig, scene), tmp_path / "out" / "sparse")
    export_housing(rig, tmp_path / "out" / "housing.yaml")
    found = run("export", "out", "-o", "target", "--to", to, cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    assert "wrote target" in found.stdout
    if to == "pinhole":
        assert "left/0000.jpg" in found.stdout
    if to == "refractive-colmap":
        back = run("init", "back.yaml", "--from", "target", cwd=tmp_path)
        assert "image folders left, right, baseline 0.2 m" in back.stdout
        assert load_rig(tmp_path / "back.yaml").cameras[0].port == rig.cameras[0].port
    again = run("export", "out", "-o", "target", "--to", to, cwd=tmp_path)
    one_sentence(again, "target exists already")


def test_init_says_of_which_cameras_a_model_has_no_port(tmp_path):
    """Stock COLMAP's has none; its lens was calibrated in the water, or was not."""
    lens, port = "PINHOLE 800 600 790 790 400 300", "FLATPORT 0 0 1 0.02 0.01 1 1.5 1.3"
    for name, line in (("stock", lens), ("refractive", f"{lens} {port}")):
        (tmp_path / "cameras.txt").write_text(f"7 {line}\n")
        found = run("init", f"{name}.yaml", "--from", "cameras.txt", cwd=tmp_path)
        assert found.returncode == 0, found.stderr
        comments = (tmp_path / f"{name}.yaml").read_text().replace("\n#", "")
        for text in (found.stdout, comments):
            words = " ".join(text.split())
            told = "o port was found of camera7: their lenses may have been calib"
            assert (told in words) == (name == "stock")
    # A port that is put there refracts, though the file was made without one.
    data = yaml.safe_load((tmp_path / "stock.yaml").read_text())
    assert data["water"] == {"refractive_index": 1.333}
    (tmp_path / "cameras.txt").rename(tmp_path / "cameras.bin")
    found = run("init", "again.yaml", "--from", ".", cwd=tmp_path)
    one_sentence(found, "only cameras.bin: ports are in text models that Refractive")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere", "--to", "pinhole"], "nowhere: no such folder"),
        (["nowhere", "--to", "ply", "--images", "x"], "--to ply writes no images"),
    ],
)
def test_export_names_the_mistake(tmp_path, arguments, words):
    one_sentence(run("export", *arguments, "-o", "target", cwd=tmp_path), words)
    found = run("export", "out", "-o", "target", "--to", "pdf", cwd=tmp_path)
    assert found.returncode == 2
    assert "'pdf' is not one of" in " ".join(found.stderr.split())
    assert not list(tmp_path.iterdir())


def test_output_folder_that_is_a_file(tmp_path):
    (tmp_path / "out").write_text(json.dumps({}))
    run("init", "rig.yaml", cwd=tmp_path)
    one_sentence(
        run("reconstruct", "rig.yaml", ".", "-o", "out", cwd=tmp_path), "is a file"
    )


@pytest.mark.parametrize("first", ["pycolmap", "numpy, pycolmap", "zlib, pycolmap"])
def test_imports_in_any_order_never_abort(first):
    """pycolmap first may be refused (its zlib), but compression then never aborts."""
    code = f"import {first}, uwsfm, zlib; zlib.compress(bytes(10_000)); print('fine')"
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    refused = "import uwsfm, or numpy, before pycolmap" in found.stderr
    assert found.stdout == "fine\n" or (refused and first == "pycolmap")
