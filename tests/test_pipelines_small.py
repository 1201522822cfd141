"""Every script under pipelines/ runs, on little input: none is left behind by a change.

Numbers of so little mean nothing; that they are numbers, of the kind that is promised,
is what is tested. The studies of the paper, of poses and of speed have tests of their
own.
"""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import uwsfm
from uwsfm.jobs.demo import sample_dir

ROOT = Path(__file__).parent.parent
PIPELINES = ROOT / "pipelines"
DATA = Path(os.environ.get("UWSFM_DATA", ROOT.parent / "shared" / "data"))
CASES = Path(os.environ.get("UWSFM_CASES", ROOT.parent / "shared" / "cases"))
needs_data = pytest.mark.skipif(
    not DATA.is_dir(), reason=f"no images in {DATA}; set UWSFM_DATA"
)
needs_cases = pytest.mark.skipif(
    not CASES.is_dir(), reason=f"no images in {CASES}; set UWSFM_CASES"
)
pytestmark = pytest.mark.slow

START = """
import sys
from pathlib import Path
sys.argv = {argv!r}
sys.path[:0] = [{folder!r}, {root!r}]
import {module} as study
{change}
sys.exit(study.main())
"""


def run(script: str, *arguments: object, change: str = "") -> str:
    """What a script prints, with some of its constants changed before it begins."""
    path = PIPELINES / script
    code = START.format(
        argv=[str(path), *map(str, arguments)],
        folder=str(path.parent),
        root=str(ROOT),
        module=path.stem,
        change=change,
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def table(text: str, title: str) -> list[list[str]]:
    """Cells of the rows below the table's line that begins with a title."""
    lines = iter(text.splitlines())
    rows = []
    for line in lines:
        if line.startswith(f"| {title}"):
            next(lines)  # the rule
            break
    for line in lines:
        if not line.startswith("|"):
            break
        rows.append([cell.strip() for cell in line.strip("|").split("|")])
    assert rows, f"no table {title!r} in:\n{text}"
    return rows


def number(cell: str) -> float:
    """The first number of a cell."""
    found = re.search(r"-?\d+(\.\d+)?(e-?\d+)?", cell)
    assert found, cell
    return float(found[0])


def test_every_script_has_a_test():
    """Named, with its folder, in one of the tests."""
    texts = [path.read_text(encoding="utf-8") for path in ROOT.glob("tests/*.py")]
    for path in PIPELINES.rglob("*.py"):
        if "__main__" not in path.read_text(encoding="utf-8"):
            continue
        words = re.compile(rf"\b{path.stem}\b"), re.compile(rf"\b{path.parent.name}\b")
        assert any(all(w.search(t) for w in words) for t in texts), path


def test_strips(tmp_path):
    change = """
study.NUM_FRAMES, study.NUM_POINTS = 8, 500
study.ALTITUDES, study.DISTANCES, study.MAX_ITERATIONS = (0.5, 1.0), (0.06,), 60
"""
    run(
        "rsfm/strips.py",
        *("-o", tmp_path, "--runs", 1, "--processes", 1),
        change=change,
    )
    rows = list(csv.DictReader((tmp_path / "strips.csv").open()))
    assert len(rows) == 10  # five methods at two altitudes
    assert (tmp_path / "strips.png").stat().st_size > 5_000
    assert "refractive, ports exact" in (tmp_path / "strips.md").read_text()


def test_mono_strip(tmp_path):
    change = "study.NUM_FRAMES, study.NUM_POINTS = 8, 3000"
    text = run("rsfm/mono_strip.py", "-o", tmp_path, "--runs", 1, change=change)
    rows = table(text, "port")
    assert len(rows) == 2  # known, and not
    assert all(0.0 < number(row[3]) < 50.0 for row in rows)


def test_held_tilt(tmp_path):
    change = """
study.NUM_FRAMES, study.NUM_POINTS, study.DISTANCES_M = 8, 600, (0.06,)
"""
    text = run("rsfm/held_tilt.py", "-o", tmp_path, "--runs", 1, change=change)
    assert [row[1] for row in table(text, "port at")] == [
        "level strip",
        "swaying strip",
        "varied dive",
    ]


def test_mappers(tmp_path):
    change = """
study.DIVES = (study.Dive(name="small", num_frames=5, num_points=800),)
"""
    run("rsfm/mappers.py", "-o", tmp_path, change=change)
    text = (tmp_path / "mappers.md").read_text()
    assert text.count("| small |") == 2 and "refractive" in text


def test_lawn_mower(tmp_path):
    run("surveys/lawn_mower.py", *("-o", tmp_path, "--frames", 24, "--part-frames", 12))
    found = json.loads((tmp_path / "lawn_mower_24.json").read_text())
    assert found["whole"]["num_registered"] == found["parts"]["num_registered"] == 24
    # Parts end in the adjustment of the whole.
    assert found["apart"]["rms_stddevs"] < 0.5


def test_correct(tmp_path):
    run("trust/correct.py", "-o", tmp_path, "--runs", 1)
    (row,) = (tmp_path / "correct.jsonl").read_text().splitlines()
    assert json.loads(row)["verdict"] == "fits"


def test_matrix(tmp_path):
    how = ("--trials", 1, "--dive", "six frames", "--without-causes")
    run("trust/matrix.py", "-o", tmp_path, "--only", "baseline in cm", *how)
    (row,) = (tmp_path / "matrix.jsonl").read_text().splitlines()
    assert json.loads(row)["verdict"] == "refused"


def test_against_colmap(tmp_path):
    run("trust/against_colmap.py", "-o", tmp_path, "--only", "near preset")
    found = json.loads((tmp_path / "against_colmap.json").read_text())
    row = found["near preset, 0.1 MP"]
    assert 0.5 < row["uwsfm"]["right"] / row["uwsfm"]["places"] <= 1.0


def test_one_camera():
    text = run("bench/one_camera.py", change="study.SIZES = (12,)")
    assert [number(row[1]) > 0.0 for row in table(text, "survey")] == [True, True]


def test_fuzz():
    text = run("faults/fuzz.py", "--cases", 4)
    assert all(number(cell) == 0 for row in table(text, "kind") for cell in row[3:])


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The sample's first six pairs, reconstructed, with a dense cloud."""
    folder = tmp_path_factory.mktemp("demo")
    for side in ("left", "right"):
        (folder / "images" / side).mkdir(parents=True)
        for path in sorted((sample_dir() / "images" / side).iterdir())[:6]:
            shutil.copy(path, folder / "images" / side / path.name)
    out, images = folder / "out", folder / "images"
    uwsfm.reconstruct(
        sample_dir() / "rig.yaml", images, out, max_features=1500, report=False
    )
    uwsfm.dense_cloud(out, images)
    return out


def test_figure(demo, tmp_path):
    run("sample/figure.py", demo, "-o", tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 20_000


def test_exports(demo, tmp_path):
    text = run("sample/exports.py", demo, "-o", tmp_path / "exports.png")
    rows = table(text, "pixels of all images")
    # Depths of the points bend less than one depth for all of an image.
    assert number(rows[1][1]) < number(rows[0][1])


def test_measuring_on_the_sample(demo):
    text = run("inspection/measuring.py", "--sample", demo)
    assert all(number(row[1]) > 0 for row in table(text, "bar"))


def test_surface(demo, tmp_path):
    text = run(
        "inspection/surface.py", demo, "-o", tmp_path / "work", change="study.SHOWN = 3"
    )
    assert "triangles" in text
    for name in ("color", "surface"):
        assert (tmp_path / "work" / f"{name}.png").stat().st_size > 5_000


REEF = """
from dataclasses import replace
import reef
from uwsfm.simulate.rigs import sample_rig
def small(spec, **changes):
    floor = replace(spec.floor, texel=4 * spec.floor.texel)
    poses = spec.rig_from_world[:5]
    return replace(spec, rig_from_world=poses, floor=floor, **changes)
reef_of = reef.reef_spec
spec = small(reef_of(), rig=sample_rig(image_scale=0.4))
study.reef_spec = lambda: spec
"""


def test_inspection_of_a_reef_and_its_matchers(tmp_path):
    """The second reads what the first made."""
    change = f"""{REEF}
import plots
near = small(study.near_spec())
study.near_spec = lambda: near
study.HERE, plots.FRAME = Path({str(tmp_path)!r}), 1
"""
    text = run("inspection/pipeline.py", "-o", tmp_path, change=change)
    assert text.count("depths by") == 2
    assert (tmp_path / "reef_errors.png").stat().st_size > 5_000
    change = f"{REEF}\nstudy.FRAMES = (0, 2)"
    rows = table(run("inspection/matchers.py", tmp_path, change=change), "disparities")
    assert [row[0] for row in rows] == [
        "semi-global",
        "semi-global, WLS",
        "semi-global, refined",
    ]


def test_inspection_of_whole_clouds(tmp_path):
    """Of the left camera of a rig alone."""
    change = f"{REEF}\nstudy.SPECS = {{'reef': lambda: spec}}"
    arguments = ("-o", tmp_path, "--only", "one")
    rows = table(run("inspection/clouds.py", *arguments, change=change), "scene")
    assert [row[0] for row in rows] == ["reef one"]
    for row in rows:
        assert 0.0 < number(row[3]) <= 100.0 and number(row[-3]) > 5.0
        assert 0.2 < number(row[-1]) < 5.0


@pytest.fixture(scope="module")
def few_photographs(tmp_path_factory):
    """A folder with twelve of the coral's photographs, as `DATA` has all."""
    folder = tmp_path_factory.mktemp("data") / "coral_tg5"
    folder.mkdir()
    for path in sorted((DATA / "coral_tg5").iterdir())[:12]:
        (folder / path.name).symlink_to(path.resolve())
    return folder


@needs_data
def test_coral(few_photographs, tmp_path):
    text = run("coral_tg5/pipeline.py", few_photographs, "-o", tmp_path)
    assert re.search(r"refractive: 1[0-2] images", text)
    (out,) = (path.parent for path in tmp_path.rglob("points.ply"))
    uwsfm.dense_cloud(out, quality="low")
    views = [path.stem for path in sorted(few_photographs.iterdir())[:2]]
    rows = table(
        run("coral_tg5/dense.py", out, change=f"study.VIEWS = {views}"), "photograph"
    )
    assert [row[0] for row in rows] == views
    assert all(number(row[1]) > 5.0 for row in rows)  # of a quarter of the pixels
    assert (out / "dense.jpg").stat().st_size > 10_000


@needs_data
def test_z_scores(few_photographs, tmp_path):
    change = "study.NUM_DEALS = 2"
    run("trust/z_scores.py", few_photographs.parent, "-o", tmp_path, change=change)
    assert "Coral" in (tmp_path / "z_scores.md").read_text()


@needs_data
def test_tank(tmp_path):
    data = tmp_path / "uril_tank"
    for side in ("left", "right"):
        (data / side).mkdir(parents=True)
        for path in sorted((DATA / "uril_tank" / side).iterdir())[:8]:
            (data / side / path.name).symlink_to(path.resolve())
    for path in (DATA / "uril_tank").glob("*.*"):
        shutil.copy(path, data / path.name)
    text = run("uril_tank/pipeline.py", data, "-o", tmp_path / "out")
    assert text.count("refractive, ") >= 4


@needs_cases
def test_clip_seeds(tmp_path):
    change = """
study.FRAMES = {study.ALL: slice(None), "first six": slice(None, 6)}
study.NUM_SEEDS, study.MAX_FEATURES = 0, 1000
study.CLIP_OPTIONS = {"good": study.CLIP_OPTIONS["good"]}
"""
    run("trust/clip_seeds.py", CASES / "gopro_clip", "-o", tmp_path, change=change)
    assert "first six" in (tmp_path / "clip_seeds.md").read_text()
