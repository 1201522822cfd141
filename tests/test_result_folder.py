"""Output folders read again: everything that was found, or one clear sentence."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

import uwsfm
from uwsfm import InputError
from uwsfm.jobs.output_folder import locked, made_of_files, output_folder
from uwsfm.results.calibration_file import read_calibration
from uwsfm.results.folder import fingerprint_of


def assert_same(found, expected):
    """Two calibrations, or parts of them, array by array."""
    if dataclasses.is_dataclass(expected):
        for field in dataclasses.fields(expected):
            pair = (getattr(part, field.name) for part in (found, expected))
            assert_same(*pair)
    elif isinstance(expected, np.ndarray):
        np.testing.assert_array_equal(found, expected)
    elif isinstance(expected, tuple):
        assert len(found) == len(expected)
        for pair in zip(found, expected, strict=True):
            assert_same(*pair)
    else:
        assert found == expected


def test_what_was_found_is_read_again(dive_result):
    result = uwsfm.open_result(dive_result.out)
    assert result.unit == "metre" and result.images is None
    assert result.summary == json.loads(json.dumps(dive_result.result.summary))
    expected, found = dive_result.result.calibration, result.calibration
    # The COLMAP model has the observations in another order, and renormalised poses.
    for name in ("summary", "covariance", "options", "lengths", "entered"):
        assert_same(getattr(found, name), getattr(expected, name))
    assert found.scene is result.model.scene and np.all(found.inliers)
    np.testing.assert_array_equal(found.scene.points, expected.scene.points)
    np.testing.assert_array_equal(found.bars.points, expected.bars.points)
    np.testing.assert_array_equal(found.bars.xy, expected.bars.xy)
    np.testing.assert_array_equal(found.bars.frame_idx, expected.bars.frame_idx)
    # The ends of the bar count after the points of the model.
    assert found.entered.between_points.ends.min() == found.scene.num_points


def _without_calibration(out):
    (out / "calibration.npz").unlink()


def _cut_short(out):
    data = (out / "calibration.npz").read_bytes()
    (out / "calibration.npz").write_bytes(data[: len(data) // 2])


def _of_another_run(out):
    housing = out / "housing.yaml"
    housing.write_text(
        housing.read_text().replace("thickness_m: 0.02", "thickness_m: 0.03")
    )


def _of_another_run_without_sums(out):
    (out / "SHA256SUMS").unlink()  # as earlier versions left it
    _of_another_run(out)


def _copied_in_part(out):
    (out / "sparse" / "points3D.bin").write_bytes(b"")


def _without_points(out):
    (out / "sparse" / "points3D.bin").unlink()


def _cut_housing(out):
    text = (out / "housing.yaml").read_text().rstrip()
    (out / "housing.yaml").write_text(text[:-1])  # still valid, a digit less


def _of_another_format(out):
    with np.load(out / "calibration.npz") as file:
        arrays = dict(file)
    about = json.loads(str(arrays["about"]))
    arrays["about"] = json.dumps({**about, "version": 9})
    np.savez(out / "calibration.npz", **arrays)


def _of_another_size(out):
    with np.load(out / "calibration.npz") as file:
        arrays = dict(file)
    np.savez(out / "calibration.npz", **{**arrays, "points": arrays["points"][:-1]})


def _without_summary(out):
    (out / "summary.json").unlink()


def _damaged_summary(out):
    (out / "summary.json").write_text('{"versions": ')


def _without_model(out):
    shutil.rmtree(out / "sparse")


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (_without_calibration, "calibration.npz is missing: an earlier version"),
        (_cut_short, "calibration.npz is damaged, or of another version"),
        (_of_another_run, "housing.yaml is not the file that the run wrote"),
        (_of_another_run_without_sums, "is of another model than the one beside it"),
        (_copied_in_part, r"points3D.bin is not the file .* copied only in part"),
        (_without_points, "points3D.bin is missing, but SHA256SUMS lists it"),
        (_cut_housing, "housing.yaml is not the file that the run wrote"),
        (_of_another_format, "has format 9, this version of uwsfm reads 2"),
        (_of_another_size, "calibration.npz is damaged"),
        (_without_summary, "summary.json is missing: the run has not finished"),
        (_damaged_summary, "summary.json is damaged"),
        (_without_model, "sparse: no such COLMAP model folder"),
    ],
)
def test_damaged_folders_are_told_in_one_sentence(dive_result, tmp_path, harm, words):
    out = tmp_path / "out"
    shutil.copytree(dive_result.out, out)
    harm(out)
    with pytest.raises(InputError, match=words) as error:
        uwsfm.open_result(out)
    assert "\n" not in str(error.value) and str(out) in str(error.value)


def test_results_of_earlier_versions_have_no_checksums_and_open(dive_result, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(dive_result.out, out)
    names = {line.split()[1] for line in (out / "SHA256SUMS").open()}
    assert "housing.yaml" in names and "sparse/points3D.bin" in names
    (out / "SHA256SUMS").unlink()
    assert uwsfm.open_result(out).fingerprint


def _wrong_shapes(out):
    with np.load(out / "calibration.npz") as file:
        arrays = dict(file)
    for name, value in arrays.items():
        harmed = np.zeros((2, 3)) if name != "about" else np.zeros(3)
        if value.shape != harmed.shape:
            yield {**arrays, name: harmed}
        yield {other: array for other, array in arrays.items() if other != name}


def test_calibrations_of_wrong_shapes_are_read_or_refused(dive_result, tmp_path):
    """What is missing may be what a run did not make; nothing else may be raised."""
    out = tmp_path / "out"
    shutil.copytree(dive_result.out, out)
    refused = 0
    model = uwsfm.read_model(out)
    mark = fingerprint_of(out)
    for arrays in _wrong_shapes(out):
        np.savez(tmp_path / "calibration.npz", **arrays)
        try:
            read_calibration(tmp_path / "calibration.npz", model.scene, mark)
        except InputError as error:
            assert "calibration.npz" in str(error) and "\n" not in str(error)
            refused += 1
    assert refused > 20


def test_images_are_where_they_were_or_where_one_says(dive_result, tmp_path):
    out, images = tmp_path / "out", tmp_path / "images"
    shutil.copytree(dive_result.out, out)
    summary = json.loads((out / "summary.json").read_text())
    (out / "summary.json").write_text(json.dumps({**summary, "images": str(images)}))
    gone = uwsfm.open_result(out)
    assert gone.images is None
    with pytest.raises(InputError, match="say with --images where they are"):
        gone.require_images()
    (images / "left").mkdir(parents=True)
    assert uwsfm.open_result(out).require_images() == images
    with pytest.raises(InputError, match="lacks left/0000.jpg"):
        uwsfm.open_result(out, images=images)
    (images / "left" / "0000.jpg").write_bytes(b"")
    assert uwsfm.open_result(out, images=images).images == images
    with pytest.raises(InputError, match="no such folder of images"):
        uwsfm.open_result(out, images=tmp_path / "elsewhere")


def test_a_foreign_calibration_is_not_overwritten(tmp_path):
    (tmp_path / "calibration.npz").write_bytes(b"of someone else")
    with pytest.raises(InputError, match=r"calibration\.npz exists and was not made"):
        output_folder(tmp_path)


@pytest.mark.parametrize("written", ["housing.yaml", "uwsfm-work/steps.json"])
def test_what_a_stopped_run_has_written_stays_and_is_ours(tmp_path, written):
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt), locked(out):
        (out / written).touch()
        raise KeyboardInterrupt
    assert (out / written).exists() and output_folder(out) == out


def test_a_result_of_another_job_is_not_overwritten(dive_result, tmp_path):
    """The same model from elsewhere is another job; the same command is the same."""
    folder, out = dive_result.out.parent, tmp_path / "out"
    shutil.copytree(dive_result.out, out)
    other = shutil.copytree(folder / "model", tmp_path / "other")
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=f"result of another job, made of {folder}"):
        uwsfm.refine_model(other, folder / "rig.yaml", out)
    assert all(path.read_bytes() == data for path, data in before.items())
    made_of = made_of_files(folder / "rig.yaml", folder / "model")
    assert output_folder(out, made_of=made_of) == out
    with pytest.raises(InputError, match=r"made of .*rig\.yaml and not of .*b\.yaml"):
        output_folder(out, made_of={**made_of, "rig": str(tmp_path / "b.yaml")})
    unknown = made_of_files(dive_result.result.model.rig, folder / "model")
    assert output_folder(out, made_of=unknown) == out  # a rig that is no file
