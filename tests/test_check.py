"""`uwsfm check`: on a result folder, from the command line."""

import json
import shutil

import numpy as np
import pytest
import yaml
from command_line import one_sentence, run

from uwsfm.cli.check import explanations_table
from uwsfm.cli.console import console
from uwsfm.errors import InputError
from uwsfm.jobs.check import CHECK, check_result, given_rig
from uwsfm.results.files import RIG_GIVEN
from uwsfm.results.log import LOG
from uwsfm.trust.explanation import Explanation


@pytest.fixture
def out(dive_result, tmp_path):
    """A copy of a result folder, to write into."""
    return shutil.copytree(dive_result.out, tmp_path / "out")


def test_the_rig_as_given_stays_with_the_result(dive_result):
    """Ports are moved by the result, and not in the copy of the rig file."""
    given = given_rig(dive_result.out)
    refined = dive_result.result.model.rig
    assert given.cameras[0].port.distance == 0.02  # of `sample_rig`
    assert refined.cameras[0].port.distance != 0.02
    np.testing.assert_array_equal(
        given.cameras[1].camera.params, refined.cameras[1].camera.params
    )


def test_a_result_that_fits_has_no_explanation(out):
    found = run("check", str(out))
    assert found.returncode == 0, found.stderr
    assert "No mistake explains the images better" in found.stdout
    assert json.loads((out / CHECK).read_text())["explanations"] == []
    lines = (out / LOG).read_text().splitlines()
    (begin,) = [k for k, line in enumerate(lines) if f"uwsfm check {out}" in line]
    log = "\n".join(lines[begin:])
    assert "INFO no mistake explains the images better" in log
    assert "INFO looking for the cause" in log and "INFO verdict: fits" in log


def test_a_folder_without_the_rig_as_given_is_refused(out):
    (out / RIG_GIVEN).unlink()
    with pytest.raises(InputError, match=f"{RIG_GIVEN} is missing"):
        check_result(out)
    one_sentence(run("check", str(out)), RIG_GIVEN, "missing")
    assert not (out / CHECK).exists()


@pytest.mark.slow
def test_a_mistake_in_the_rig_file_is_named_and_written(out):
    """The result has healed the rotation: the rig file is what contradicts it."""
    text = yaml.safe_load((out / RIG_GIVEN).read_text())
    pose = text["cameras"][1]["cam_from_rig"]
    x, y, z, w = pose["rotation_xyzw"]
    pose["rotation_xyzw"] = [-x, -y, -z, w]
    (out / RIG_GIVEN).write_text(yaml.safe_dump(text))
    found = check_result(out)
    assert [one.code for one in found.explanations] == ["rotation_transposed"]
    written = json.loads((out / CHECK).read_text())
    assert written["explanations"][0]["text"] == found.explanations[0].text


def test_the_table_has_the_numbers_of_the_explanation():
    one = Explanation(
        code="port_none",
        text="Probably the lens was calibrated in the water.",
        rms_before_px=1.594,
        rms_after_px=0.304,
        gain=83.0,
    )
    with console.capture() as captured:
        console.print(explanations_table([one]))
    text = captured.get()
    for words in ("port none", "1.59", "0.30", "Probably"):
        assert words in text
