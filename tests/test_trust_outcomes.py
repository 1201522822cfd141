"""Inputs of the study in pipelines/trust, run to their verdicts."""

import sys
from pathlib import Path

import numpy as np
import pytest

from uwsfm.errors import ExplainedInputError, InputError

FOLDER = Path(__file__).parent.parent / "pipelines" / "trust"
sys.path.insert(0, str(FOLDER))

from correct import correct_dive  # noqa: E402
from dives import Dive, simulated_dive  # noqa: E402
from outcomes import (  # noqa: E402
    FITS,
    LIMIT,
    REFUSED,
    Outcome,
    causes_of,
    outcome_of,
    relative_size,
)
from wrong_inputs import MISTAKES  # noqa: E402

# Some no observation shows; one takes 14 frames: six leave the ports at ± 18 mm.
SHOWN = [
    mistake
    for mistake in MISTAKES
    if not mistake.hidden and mistake.name != "baseline longer by half to three times"
]


@pytest.fixture(scope="module")
def flat() -> Dive:
    return simulated_dive("small", num_frames=6, num_points=400)


def run(dive: Dive, name: str, *, diagnosed: bool) -> Outcome:
    mistake = next(mistake for mistake in MISTAKES if mistake.name == name)
    return outcome_of(mistake.applied(dive, 0), diagnosed=diagnosed)


def test_the_right_input_fits_and_its_errors_are_within_its_deviations(flat):
    outcome = outcome_of(flat, diagnosed=False)
    assert outcome.verdict == FITS
    assert outcome.worst < LIMIT
    # Two ports of distance and tilt, the scale, and the worst length.
    assert len(outcome.errors) == 6
    # Noise of 0.35 px per coordinate, two of them; a third goes into the points.
    assert 0.3 < outcome.rms_px < 0.55


@pytest.mark.parametrize(
    ("name", "code"),
    [
        ("rotation transposed, held", "rotation_transposed"),
        ("folders swapped", "folders_swapped"),
        ("baseline in cm, mm or feet", "length_unit"),
    ],
)
def test_a_refusal_names_the_mistake(flat, name, code):
    outcome = run(flat, name, diagnosed=False)
    assert outcome.verdict == REFUSED
    assert code in outcome.causes


@pytest.mark.slow
def test_a_lens_of_another_sign_does_not_fit_and_is_named(flat):
    outcome = run(flat, "radial distortion negative", diagnosed=True)
    assert outcome.verdict == "does not fit"
    assert outcome.causes[0] == "distortion_sign"
    assert not outcome.confidently_wrong


@pytest.mark.slow
@pytest.mark.parametrize("mistake", SHOWN, ids=lambda mistake: mistake.name)
def test_no_mistake_is_confidently_wrong(flat, mistake):
    dive = flat
    if mistake.domes:
        dive = simulated_dive("small", num_frames=6, num_points=400, domes=True)
    try:
        wrong = mistake.applied(dive, 0)
    except InputError:  # the rig file cannot hold such numbers
        return
    assert not outcome_of(wrong, diagnosed=False).confidently_wrong


def test_correct_inputs_are_drawn_from_what_is_promised():
    drawn = [correct_dive(seed)[1] for seed in range(8)]
    assert {row["motion"] for row in drawn} <= {"strip", "few frames", "varied"}
    assert all(0.1 <= row["noise_px"] <= 1.0 for row in drawn)
    assert len({row["cameras"] for row in drawn}) > 1


def test_a_refusal_without_a_cause_names_nothing():
    hint = "check its rotation (order x, y, z, w), and that images were taken together"
    assert causes_of(InputError(f"cam_from_rig is wrong; {hint}")) == ()
    explained = ExplainedInputError("probably mirrored", ("mirrored",))
    assert causes_of(explained) == ("mirrored",)
    unit = InputError("20 m is not a port distance; did you mean 0.02?")
    assert causes_of(unit) == ("length_unit",)


def test_the_size_of_points_is_their_factor(rng):
    points = rng.normal(size=(80, 3))
    points[:3] += 50.0  # points of wrong matches are no matter of scale
    bent = 1.01 * points
    bent[:3] = rng.normal(size=(3, 3))
    assert np.isclose(relative_size(bent, points), 1.01, rtol=2e-3)
