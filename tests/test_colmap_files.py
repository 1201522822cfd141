"""COLMAP's files: cut, overwritten or ill named, they are refused before COLMAP reads
them, which believes any count."""

import os
import struct
import subprocess
import sys

import numpy as np
import pycolmap
import pytest
from command_line import one_sentence
from hostile import CASES, copied, needs_cases, small_model, written

import uwsfm
from uwsfm import InputError
from uwsfm.colmap.files import check_model_files
from uwsfm.colmap.model import read_reconstruction
from uwsfm.sfm.from_colmap.refractive_colmap import rig_of_refractive_colmap

FILES = ("cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin")


@pytest.mark.parametrize("rigs", [True, False])
def test_whole_models_of_both_layouts_pass(tmp_path, rigs):
    model = small_model()
    folder = written(model, tmp_path / "model", rigs=rigs)
    assert read_reconstruction(folder).num_points3D() == model.num_points3D()
    text = tmp_path / "text"
    text.mkdir()
    model.write_text(str(text))
    assert read_reconstruction(text).num_images() == 6


@pytest.mark.parametrize("name", FILES)
def test_every_cut_and_every_surplus_is_refused(tmp_path, name):
    folder = written(small_model(), tmp_path)
    whole = (folder / name).read_bytes()
    step = max(1, len(whole) // 150)
    lengths = set(range(0, len(whole), step)) | {len(whole) - 1}
    for length in lengths:
        (folder / name).write_bytes(whole[:length])
        with pytest.raises(InputError, match=name) as error:
            check_model_files(folder)
        assert "\n" not in str(error.value)
    (folder / name).write_bytes(whole + b"\0")
    with pytest.raises(InputError, match="1 bytes follow"):
        check_model_files(folder)


@pytest.mark.parametrize("name", FILES)
@pytest.mark.parametrize("count", [0, 1, 2**31, 2**32, 2**63, 2**64 - 1])
def test_counts_of_records_are_those_of_the_file(tmp_path, name, count):
    folder = written(small_model(), tmp_path)
    whole = (folder / name).read_bytes()
    (folder / name).write_bytes(struct.pack("<Q", count) + whole[8:])
    if struct.unpack_from("<Q", whole)[0] == count:
        check_model_files(folder)
        return
    with pytest.raises(InputError, match=name):
        check_model_files(folder)


@pytest.mark.parametrize("missing", FILES)
def test_a_missing_file_is_named(tmp_path, missing):
    folder = written(small_model(), tmp_path)
    (folder / missing).unlink()
    with pytest.raises(InputError, match=f"{missing} is missing"):
        read_reconstruction(folder)


def test_files_of_different_models_are_told_apart(tmp_path):
    one, other = small_model(), small_model()
    other.deregister_frame(max(other.frames))
    other.delete_point3D(max(other.points3D))
    folder = written(one, tmp_path / "one")
    strange = written(other, tmp_path / "other")
    (folder / "points3D.bin").write_bytes((strange / "points3D.bin").read_bytes())
    with pytest.raises(InputError, match=r"sees a point that points3D.bin lacks"):
        read_reconstruction(folder)


def test_a_pipe_is_not_waited_on(tmp_path):
    folder = written(small_model(), tmp_path)
    (folder / "images.bin").unlink()
    os.mkfifo(folder / "images.bin")
    with pytest.raises(InputError, match="is a pipe or a device"):
        read_reconstruction(folder)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("left/../../x.jpg", "leads out of the folder of the images"),
        ("../left/0001.jpg", "leads out of the folder of the images"),
        ("/left/0001.jpg", "is absolute"),
        ("C:/left/0001.jpg", "is absolute"),
        ("left\\0001.jpg", "contains a backslash.*'left/0001.jpg'"),
        ("left/00\n01.jpg", "contains a control character"),
        ("left/", "names a folder"),
        ("left/" + "x" * 300, "is longer than the 255 bytes"),
        ("", "is empty"),
    ],
)
def test_names_that_no_image_has_are_refused(tmp_path, name, words):
    folder = written(small_model({1: name}), tmp_path)
    with pytest.raises(InputError, match=words) as error:
        read_reconstruction(folder)
    assert "images.bin" in str(error.value) and "\n" not in str(error.value)


def test_names_in_other_encodings_are_refused(tmp_path):
    folder = written(small_model(), tmp_path)
    path = folder / "images.bin"
    path.write_bytes(
        path.read_bytes().replace(b"left/0001.jpg", b"left/\xe4\xf601.jpg")
    )
    with pytest.raises(InputError, match="is not UTF-8"):
        read_reconstruction(folder)


def test_two_images_of_one_name_are_refused(tmp_path):
    folder = written(small_model({1: "left/a.jpg", 3: "left/a.jpg"}), tmp_path)
    with pytest.raises(InputError, match=r"two images have the name left/a.jpg"):
        read_reconstruction(folder)


def test_white_space_is_read_from_binary_and_refused_in_text(tmp_path):
    model = small_model({1: "left/DIVE 1.jpg"})
    binary = read_reconstruction(written(model, tmp_path / "binary"))
    assert "left/DIVE 1.jpg" in [image.name for image in binary.images.values()]
    text = tmp_path / "text"
    text.mkdir()
    model.write_text(str(text))
    with pytest.raises(InputError, match=r"line \d+: .*'left/DIVE 1.jpg' contains wh"):
        read_reconstruction(text)


# ---- The shared cases ---------------------------------------------------------------


@needs_cases
@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("names_with_spaces", ("images.txt", "line 1", "contains white space")),
        ("two_images_of_one_name", ("two images have the name left/0001.jpg",)),
        ("track_to_removed_image", ("points3D.txt", "is seen by image", "lacks")),
    ],
)
def test_models_with_wrong_names_end_in_a_sentence(tmp_path, name, words):
    model, rig = CASES / "models" / name, CASES / "models" / "rig.yaml"
    out = tmp_path / "out"
    for work, order in (
        (uwsfm.refine_model, (model, rig)),
        (uwsfm.calibrate_housing, (rig, model)),
    ):
        with pytest.raises(InputError) as error:
            work(*order, out)
        assert all(word in str(error.value) for word in words), error.value
        assert "\n" not in str(error.value) and not out.exists()


@needs_cases
def test_the_export_with_white_space_gives_no_rig():
    source = CASES / "models" / "own_export_with_spaces"
    with pytest.raises(InputError, match=r"images.txt: line 1: .*contains white space"):
        rig_of_refractive_colmap(source)


@needs_cases
def test_an_empty_file_is_refused_within_a_second_of_work(tmp_path):
    folder = copied("empty_points3D", tmp_path / "model")
    model = tmp_path / "other"
    written(small_model(), model)
    (folder / "images.bin").write_bytes((model / "images.bin").read_bytes())
    code = (
        "import resource; resource.setrlimit(resource.RLIMIT_CPU, (30, 30))\n"
        "from uwsfm.cli.app import main; main()"
    )
    rig = CASES / "models" / "rig.yaml"
    arguments = ["refine", str(folder), str(rig), "-o", str(tmp_path / "out")]
    found = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    one_sentence(found, str(folder))


def test_text_files_beside_binary_ones_must_be_of_the_same_state(tmp_path):
    """Both formats of one model, as COLMAP's GUI leaves them; then either is newer."""
    model = small_model()
    folder = written(model, tmp_path / "model")
    model.write_text(str(folder))
    assert read_reconstruction(folder).num_images() == model.num_images()
    path = folder / "images.txt"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace("left/0001.jpg", "left/9.jpg"), encoding="utf-8")
    with pytest.raises(InputError, match=r"differ \(image left/0001.jpg\): remove"):
        read_reconstruction(folder)
    path.write_text(text, encoding="utf-8")
    model.transform(pycolmap.Sim3d(1.01, pycolmap.Rotation3d(), np.zeros(3)))
    model.write_text(str(folder))
    with pytest.raises(InputError, match=r"differ \(image left/"):
        read_reconstruction(folder)
    for point_id in sorted(model.points3D)[:3]:
        model.delete_point3D(point_id)
    model.write_text(str(folder))
    with pytest.raises(InputError, match="10 points3D in the binary files, 7 in the"):
        read_reconstruction(folder)
