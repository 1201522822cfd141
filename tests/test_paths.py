"""Names from data lead nowhere but below the folder that they are written to."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sfm_scenes import model_of

import uwsfm
from uwsfm import InputError
from uwsfm._base.paths import inside
from uwsfm.export.pinhole_files import export_pinhole
from uwsfm.export.refractive_colmap import export_refractive_colmap
from uwsfm.export.warp import write_image
from uwsfm.simulate import ObservationOptions, Relief, simulate_scene
from uwsfm.simulate.rigs import sample_rig
from uwsfm.simulate.trajectories import rich_motion

PACKAGE = Path(uwsfm.__file__).parent
PIXELS = np.zeros((4, 4), dtype=np.uint8)


@pytest.mark.parametrize(
    "name",
    [
        "left/../../../x.jpg",
        "../x.jpg",
        "..",
        "/x.jpg",
        "//host/x.jpg",
        "C:x.jpg",
        "C:\\x.jpg",
        "left\\..\\..\\x.jpg",
        "left/\0x.jpg",
        "left//x.jpg",
        "",
        ".",
    ],
)
def test_nothing_is_written_outside(tmp_path, name):
    target = tmp_path / "a" / "b" / "target"
    target.mkdir(parents=True)
    with pytest.raises(InputError, match="cannot write"):
        write_image(target, name, PIXELS)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


def test_links_in_the_target_lead_nowhere_else(tmp_path):
    target, other = tmp_path / "target", tmp_path / "other"
    target.mkdir(), other.mkdir()
    (target / "left").symlink_to(other)
    with pytest.raises(InputError, match="a link below .* leads out of it"):
        write_image(target, "left/x.png", PIXELS)
    (other / "y.png").write_bytes(b"of someone else")
    (target / "y.png").symlink_to(other / "y.png")
    write_image(target, "y.png", PIXELS)
    assert (other / "y.png").read_bytes() == b"of someone else"
    assert (target / "y.png").is_file() and not (target / "y.png").is_symlink()


def test_a_target_that_is_a_link_itself_is_written_to(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "target").symlink_to(tmp_path / "real")
    write_image(tmp_path / "target", "left/x 1.png", PIXELS)
    assert (tmp_path / "real" / "left" / "x 1.png").is_file()
    assert inside(tmp_path / "target", "z.png") == tmp_path / "target" / "z.png"


def _named(name: str):
    """A model with a frame of that name."""
    rig = sample_rig()
    simulated = simulate_scene(
        rig, rich_motion(3), Relief(), ObservationOptions(num_points=60)
    )
    model = model_of(rig, simulated.scene)
    return replace(model, frame_names=(name, *model.frame_names[1:]))


def test_exports_of_a_name_that_leads_out_leave_nothing(tmp_path):
    """The name as it stands in a model in memory: no reader has seen it."""
    model = _named("../../../x.jpg")
    camera = model.rig.cameras[0].camera
    image = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    images = tmp_path / "deep" / "down" / "images"
    for side in ("left", "right"):
        (images / side).mkdir(parents=True)
        for name in model.frame_names[1:]:
            write_image(images / side, name, image)
    # What the name leads to from the images is what it leads to from the target.
    write_image(tmp_path / "deep", "x.jpg", image + 7)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.jpg")}
    with pytest.raises(InputError, match="cannot write '.*x.jpg' in .*leads out of"):
        export_pinhole(model, tmp_path / "deep" / "target", images)
    after = {path: path.read_bytes() for path in tmp_path.rglob("*.jpg")}
    assert before == after and not (tmp_path / "deep" / "target").exists()


def test_text_that_its_reader_would_cut_is_not_written(tmp_path):
    with pytest.raises(
        InputError, match="cannot export 'left/DIVE 1.jpg': its name co"
    ):
        export_refractive_colmap(_named("DIVE 1.jpg"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---- No other writer ----------------------------------------------------------------

READ = {
    ("color/commands.py", "self.folder / model.image_name(camera, frame)"),
    ("color/commands.py", "self.folder / self.result.model.image_name(*p)"),
    ("dense/views.py", "folder / name"),
    ("export/pinhole_files.py", "images / model.image_name(c, f)"),
    ("export/pinhole_files.py", "images / name"),
    ("inputs/known_lengths.py", "PurePosixPath(camera.images) / name"),
    ("jobs/model_inputs.py", "images / camera.images"),
    ("jobs/model_inputs.py", "images / camera.images / n"),
    ("report/recording.py", "result.images / model.image_name(index, frame)"),
    ("sfm/frontend/image_features.py", "image_dir / name"),
    ("sfm/frontend/images.py", "Path(mask_dir) / f'{next(frames.image_names())}.png'"),
    ("sfm/frontend/images.py", "mask_dir / n"),
    ("sfm/frontend/images.py", "image_dir / folder"),
    ("sfm/frontend/images.py", "image_dir / image_name"),
    ("sfm/frontend/images.py", "self.image_dir / n"),
    ("sfm/frontend/parallel.py", "frames.image_dir / next(frames.image_names())"),
}
"""Paths of images and masks that are only read."""
FROM_DATA = re.compile(r"image|\bname\b|frame_name|folder\b|\bn\b")
OWN = re.compile(r"^[A-Z_]+$|\.bin|\.txt|\.npy|\.npz|\.db|^'|kind|assets|_source_key")


def _joins():
    """(file, source) of every `a / b` whose right side may be a name from data."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Div):
                right = ast.unparse(node.right)
                left = ast.unparse(node.left)
                if FROM_DATA.search(right) and re.search(r"image|mask|folder", left):
                    yield path.relative_to(PACKAGE).as_posix(), ast.unparse(node)


def test_no_other_path_is_made_of_the_name_of_an_image():
    """A new one is either only read, and then listed here, or goes through `inside`."""
    found = {join for join in _joins() if not OWN.search(join[1].split(" / ")[-1])}
    own = {("_base/paths.py", "folder / PurePosixPath(name)")}
    own |= {("_base/checksums.py", "folder / name")}
    # What a user's own dives.yaml names is the user's choice, as on the command line.
    own |= {join for join in found if join[0] == "jobs/dives_file.py"}
    assert found - READ - own == set()
    assert READ - found == set(), "no longer there"


def test_images_are_written_by_one_function_and_the_renderer():
    writers = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if "cv2.imwrite" in path.read_text(encoding="utf-8")
    }
    # image_features: numbered files in a temporary folder of its own.
    assert writers == {
        "export/warp.py",
        "simulate/sequence.py",
        "sfm/frontend/image_features.py",
    }
