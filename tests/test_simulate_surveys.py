"""Long surveys: as many frames as asked for, loops by lines and cross lines."""

import numpy as np
import pytest

from uwsfm.errors import InputError
from uwsfm.simulate import SurveySpec, simulate_survey
from uwsfm.simulate.surveys import survey_track

SPEC = SurveySpec(num_frames=70, num_points=2000, detection_rate=1.0, noise_px=0.0)


@pytest.mark.parametrize("num_frames", [12, 70, 503, 5000])
def test_a_track_has_the_frames_asked_for_and_one_turn_of_the_rig_per_line(num_frames):
    spec = SurveySpec(num_frames=num_frames, num_points=1, detection_rate=1.0)
    poses = survey_track(spec)
    assert poses.shape == (num_frames, 7)
    heading = 2.0 * np.degrees(np.arctan2(poses[:, 2], poses[:, 3])) % 360.0
    turns = np.round(heading / 90.0).astype(int) % 4
    assert set(turns) == {0, 1, 2}  # forth, the cross lines, back
    # The last frames are the cross lines, one in twenty but for short surveys.
    assert np.flatnonzero(turns == 1)[0] >= 0.45 * num_frames
    assert np.all(np.diff(np.flatnonzero(turns == 1)) == 1)


def test_neighbouring_lines_and_cross_lines_share_points():
    scene = simulate_survey(SPEC).scene
    assert (scene.num_frames, scene.num_points) == (70, 2000)
    seen = np.zeros((scene.num_points, scene.num_frames), dtype=int)
    seen[scene.point_idx, scene.frame_idx] = 1
    shared = seen.T @ seen
    # A line has 11 frames: the first of one and the last of the next are side by side.
    assert shared[0, 1] > 0 and shared[0, 21] > 0
    assert shared[0, 10] == shared[0, 11] == 0
    cross = shared[55:]
    assert np.all(cross[:, :55].sum(axis=1) > 0)
    assert np.ptp(np.flatnonzero(cross[:, :55].any(axis=0))) > 40


def test_what_is_no_survey_is_refused():
    with pytest.raises(InputError, match="pool, reef, field"):
        simulate_survey("ocean")
    with pytest.raises(InputError, match="12 frames"):
        simulate_survey(SPEC, num_frames=5)
    for name in ("spacing", "line_spacing", "altitude", "sway_deg", "heave"):
        for value in (-1.0, np.nan, np.inf):
            with pytest.raises(InputError, match=rf"^{name} must .*, got {value}"):
                simulate_survey(SPEC, **{name: value})
