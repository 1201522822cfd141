"""From a features database to a perspective start: simulated, so the truth is known."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from sfm_scenes import frames_of, simulated_dive, write_features
from uwsfm.errors import UwsfmError
from uwsfm.evaluate import center_errors
from uwsfm.geometry import rigid3
from uwsfm.rig import Rig
from uwsfm.scene import Scene
from uwsfm.sfm.images import Frames
from uwsfm.sfm.options import StartOptions
from uwsfm.sfm.perspective import PerspectiveStart, StartArrays, load_start, read_start
from uwsfm.sfm.start import Workspace, fix_rig, map_frames, start_rig
from uwsfm.sfm.steps import Steps
from uwsfm.simulate.rigs import nominal_rig, sample_rig
