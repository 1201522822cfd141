"""Every calibrated parameter is declared once, and everything reads its declaration."""

import io
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest
from hand_made import summary
from rich.console import Console

from uwsfm import CalibrateOptions
from uwsfm._base.options import option_named
from uwsfm.calibration.given_accuracy import CameraAccuracy, RigAccuracy
from uwsfm.calibration.parameters import (
    BASELINE,
    DISTANCE,
    GROUPS,
    LENS,
    OF_PORTS,
    PARAMETERS,
    PRIORS,
    RADIUS,
    REFINABLE,
)
from uwsfm.cli.tables import calibration_table
from uwsfm.models.ports import row
from uwsfm.models.ports.port import KINDS
from uwsfm.options.jobs import (
    CalibrateHousingOptions,
    ReconstructOptions,
    RefineOptions,
)
from uwsfm.report.tables import estimates, held_words
from uwsfm.residuals import border
from uwsfm.results.refined import listed
from uwsfm.rig.schema import CameraAccuracyEntry, RigAccuracyEntry
from uwsfm.solver.state import PORT_COLUMNS
from uwsfm.trust.diagnosis import KEPT
from uwsfm.trust.halves_reason import NAMES

DOCS = Path(__file__).parents[1] / "docs"


def ids(parameter):
    return parameter.name


def slots_of(parameter):
    return range(parameter.first, parameter.first + parameter.size)


@pytest.mark.parametrize("parameter", PARAMETERS, ids=ids)
def test_an_entry_has_all_facts(parameter):
    assert parameter.name and parameter.plural
    accuracy = parameter.accuracy
    assert accuracy is not None and accuracy.because.endswith(".")
    if accuracy.key != "distortion":  # whose default depends on the lens
        assert accuracy.default(0.05) > 0.0 and accuracy.default(0.05) < accuracy.most
        assert accuracy.unit
    low, high = parameter.bounds
    assert low < high
    if parameter.refine is not None:
        assert parameter.prior is not None
        assert parameter.refine.help.endswith(".") and parameter.prior.help.endswith(
            "."
        )
        flag = parameter.refine.flag
        assert flag is None or parameter.refine.field == "refine_" + flag.replace(
            "-", "_"
        )
        # `checked_accuracy` finds the range of a prior by the key of the accuracy.
        assert parameter.prior.field.replace("_stddev", "") == accuracy.key
    if parameter.size > 1 and parameter not in LENS:
        for pattern in (parameter.step, parameter.part):
            assert pattern.count("{}") == 1
    assert (parameter.column is None) == (parameter not in OF_PORTS)


GLASS = {border.THICKNESS, border.GLASS_INDEX}
OF_NO_USE = {
    "flat": {border.RADIUS},
    "dome": set(),
    "interface": {border.RADIUS, *GLASS},
    "none": {*range(border.BORDER_SIZE)[border.PLACE], border.RADIUS, *GLASS}
    | {border.WATER_INDEX},
}
"""Slots that cameras behind such ports have no parameter for."""


@pytest.mark.parametrize("port", KINDS)
def test_no_slot_has_two_parameters(port):
    taken = [s for p in PARAMETERS if p.of(port) for s in slots_of(p)]
    assert len(taken) == len(set(taken))
    assert set(taken) == set(range(border.BORDER_SIZE)) - OF_NO_USE[port.word]


def test_numbers_of_ports_stand_where_the_solver_moves_them():
    columns = {p.first: p.column for p in OF_PORTS}
    both = {DISTANCE.first: row.DISTANCE, RADIUS.first: row.RADIUS}
    assert columns == {**PORT_COLUMNS, **both}


def test_options_files_and_words_have_the_registry_s_parameters():
    known = {field.name for field in fields(CalibrateOptions)}
    assert known >= {*REFINABLE.values(), *PRIORS}
    for name in (*REFINABLE.values(), *PRIORS):
        assert f"{name}: " in CalibrateOptions.__doc__
    for kind in (ReconstructOptions, RefineOptions, CalibrateHousingOptions):
        assert option_named(kind, "refine").choices == tuple(REFINABLE)
        assert option_named(kind, "prior").declared.keys == PRIORS
    own = {p.accuracy.key for p in PARAMETERS if not p.accuracy.of_rig}
    of_rig = {p.accuracy.key for p in PARAMETERS if p.accuracy.of_rig}
    assert own == {field.name for field in fields(CameraAccuracy)}
    assert own == set(CameraAccuracyEntry.model_fields)
    assert of_rig < {field.name for field in fields(RigAccuracy)}
    assert of_rig < set(RigAccuracyEntry.model_fields)
    assert set(NAMES) == {*GROUPS, "length", "scale"}
    assert set(KEPT) >= {*REFINABLE.values(), *PRIORS}


def test_the_manual_lists_exactly_what_can_be_refined():
    text = (DOCS / "howto" / "housings.md").read_text(encoding="utf-8")
    row = r"^\| `--refine ([\w-]+)` \|.*`--prior (\w+)="
    rows = re.findall(row, text, re.MULTILINE)
    assert rows == [
        (p.refine.flag, p.prior.field)
        for p in PARAMETERS
        if p.refine is not None and p.refine.flag is not None
    ]


LISTED = [
    (parameter, name, camera)
    for parameter in PARAMETERS
    if parameter.listed and (parameter.refine is not None or parameter is BASELINE)
    for name, camera in {
        "water index": [("water index", "")],
        "focal length": [("f", "left"), ("fy", "left")],
        "principal point": [("cx", "left")],
        "distortion": [("k", "left"), ("k1", "left"), ("alpha", "left")],
    }.get(parameter.name, [(parameter.name, "left")])
]


@pytest.mark.parametrize(
    ("parameter", "name", "camera"), LISTED, ids=[f"{p.name} {n}" for p, n, _ in LISTED]
)
def test_a_printed_row_reads_back_as_its_value_and_unit(parameter, name, camera):
    data = summary()
    text = name if not camera else parameter.listed_name(camera, name)
    entry = {"name": text, "value": 0.0123456, "stddev": 2e-5, "stddev_in_all": 3e-5}
    data["refined"] = [entry]
    assert listed(text) == (parameter, name, camera)
    rows = [r for r in estimates(data) if r.name == name and r.group in (camera, "all")]
    (row,) = rows  # none says that it was given
    assert row.word == "refined" and row.unit == parameter.unit.name
    shown = [float(v) / parameter.unit.per for v in (row.value, row.stddev)]
    assert shown == pytest.approx([0.0123456, 2e-5], abs=1e-6)
    if parameter.column is not None:
        others = [
            r.group for r in estimates(data) if r.name == name and r.word == "given"
        ]
        assert camera not in others and (camera or not others)
    # The terminal prints the unit of files, which stands in the name.
    console = Console(width=200, record=True, file=io.StringIO())
    data |= {"strategy": "joint", "error": "reprojection", "start": "virtual"}
    data["reprojection_rms_px"] = 0.3
    console.print(calibration_table(data))
    assert re.search(rf"{re.escape(text)}\W+0\.0123456 ± 2e-05", console.export_text())


def test_what_was_refined_is_not_among_what_was_given():
    data = summary()
    data["refined"] = []
    first = held_words(data)
    assert first == ("the lens in air, the glass, the water index and the baseline")
    for name, gone in (
        ("glass index of left", "the glass,"),
        ("water index", "water"),
        ("baseline of right (m)", "baseline"),
        ("k1 of left", "given the lens in air"),
    ):
        data["refined"] = [{"name": name}]
        assert gone not in "given " + held_words(data)
    data["refined"] = [{"name": "glass thickness of left (m)"}]
    assert "the glass index" in held_words(data)


EXAMPLE = """
import sys, types
from pathlib import Path

import uwsfm.calibration

path = Path(uwsfm.calibration.__path__[0]) / "parameters.py"
source = path.read_text(encoding="utf-8")
head, tail = source.split("RADIUS = Parameter(", 1)
module = types.ModuleType("uwsfm.calibration.parameters")
exec(head + "RADIUS = Parameter(" + LINES + tail, module.__dict__)
sys.modules["uwsfm.calibration.parameters"] = module

from test_mixed_ports import dive

from uwsfm import calibrate
from uwsfm._base.options import option_named
from uwsfm.calibration.error_budget import with_budget
from uwsfm.calibration.uncertainty import predict_covariance
from uwsfm.options.jobs import RefineOptions

assert "dome-radius" in option_named(RefineOptions, "refine").choices
assert "radius_stddev_m" in option_named(RefineOptions, "prior").declared.keys
simulated = dive(noise_px=0.3)
options = {"refine_dome_radius": True, "radius_stddev_m": 0.002}
result, budget = with_budget(calibrate(simulated.scene, loss="l2", **options))
column = result.covariance.border_cols[1, module.RADIUS.first]
assert column >= 0
bound = predict_covariance(simulated.truth, 0.3, **options)
spread = bound.border[column, column] ** 0.5
error = result.scene.ports[1].radius - simulated.truth.ports[1].radius
assert abs(error) < 4.0 * spread, (error, spread)
assert any(row.prior and row.name.startswith("dome radius") for row in budget)
print("done")
"""


def test_the_example_of_the_manual_makes_another_parameter_refinable():
    text = (DOCS / "contributing.md").read_text(encoding="utf-8")
    _, section = text.split("## Add a calibrated parameter", 1)
    block = re.search(r"```diff\n(.*?)```", section, re.DOTALL)[1]
    lines = "".join(f"{line[1:]}\n" for line in block.splitlines() if line[0] == "+")
    code = f"LINES = {lines!r}\n{EXAMPLE}"
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.stdout.strip() == "done", done.stderr
