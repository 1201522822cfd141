"""uwsfm: refractive underwater Structure-from-Motion for rigs behind ports.

The public names are imported on first use, so that ``import uwsfm`` costs nothing.
"""

import logging
from importlib import import_module, metadata
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from uwsfm.calibration.bundle_adjustment import calibrate
    from uwsfm.calibration.problem import CalibrateOptions, CalibrationResult
    from uwsfm.errors import InputError, UwsfmError
    from uwsfm.models.port import FlatPort
    from uwsfm.models.refractive import RefractiveCamera
    from uwsfm.models.status import Status
    from uwsfm.scene import Scene

__version__ = metadata.version("uwsfm")
logger = logging.getLogger("uwsfm")
logger.addHandler(logging.NullHandler())

_HOMES = {
    "CalibrateOptions": "uwsfm.calibration.problem",
    "CalibrationResult": "uwsfm.calibration.problem",
    "FlatPort": "uwsfm.models.port",
    "InputError": "uwsfm.errors",
    "RefractiveCamera": "uwsfm.models.refractive",
    "Scene": "uwsfm.scene",
    "Status": "uwsfm.models.status",
    "UwsfmError": "uwsfm.errors",
    "calibrate": "uwsfm.calibration.bundle_adjustment",
}

__all__ = [
    "CalibrateOptions",
    "CalibrationResult",
    "FlatPort",
    "InputError",
    "RefractiveCamera",
    "Scene",
    "Status",
    "UwsfmError",
    "calibrate",
]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'uwsfm' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
