"""uwsfm: refractive underwater Structure-from-Motion for rigs behind ports.

The public names are imported on first use, so that ``import uwsfm`` costs nothing.
"""

import logging
from importlib import import_module, metadata
from typing import TYPE_CHECKING

from uwsfm._base.load_order import refuse_broken_zlib

if TYPE_CHECKING:
    from uwsfm.calibration.bundle_adjustment import calibrate
    from uwsfm.calibration.error_budget import error_budget, with_budget
    from uwsfm.calibration.lengths import Distances, Lengths, Positions
    from uwsfm.calibration.observability import verdicts
    from uwsfm.calibration.perspective import perspective_adjustment
    from uwsfm.calibration.problem import CalibrateOptions
    from uwsfm.calibration.result import CalibrationResult
    from uwsfm.calibration.uncertainty import predict_covariance
    from uwsfm.cloud import Cloud, read_cloud, write_cloud
    from uwsfm.colmap.model import Model
    from uwsfm.color.commands import correct_colors
    from uwsfm.dense.run import dense_cloud
    from uwsfm.errors import InputError, UwsfmError
    from uwsfm.export.pinhole_files import export_pinhole
    from uwsfm.export.refractive_colmap import export_refractive_colmap
    from uwsfm.export.scene_ply import export_scene_ply
    from uwsfm.jobs.batch import run_batch
    from uwsfm.jobs.calibrate_housing import calibrate_housing
    from uwsfm.jobs.check_halves import check_halves
    from uwsfm.jobs.reconstruct import reconstruct
    from uwsfm.jobs.refine_model import refine_model
    from uwsfm.measuring.measure import measure
    from uwsfm.models.ports.port import DomePort, FlatPort, InterfacePort, NoPort
    from uwsfm.models.refractive import RefractiveCamera
    from uwsfm.models.status import Status
    from uwsfm.options.jobs import (
        CalibrateHousingOptions,
        ReconstructOptions,
        RefineOptions,
    )
    from uwsfm.report.files import write_report
    from uwsfm.results.files import export_colmap, export_ply, read_model
    from uwsfm.results.folder import Result, open_result
    from uwsfm.results.housing import export_housing
    from uwsfm.rig.file import load_rig
    from uwsfm.rig.rig import Rig
    from uwsfm.scene import Scene
    from uwsfm.sfm.from_colmap.refractive_colmap import (
        read_refractive_colmap,
        rig_of_refractive_colmap,
    )
    from uwsfm.sfm.options import MatchOptions, StartOptions
    from uwsfm.surface.commands import (
        clean_cloud,
        export_las,
        make_map,
        mesh_cloud,
    )
    from uwsfm.trust.verdict import Verdict, judge

refuse_broken_zlib()

__version__ = metadata.version("uwsfm")
logger = logging.getLogger("uwsfm")
logger.addHandler(logging.NullHandler())

_HOMES = {
    "CalibrateHousingOptions": "uwsfm.options.jobs",
    "CalibrateOptions": "uwsfm.calibration.problem",
    "CalibrationResult": "uwsfm.calibration.result",
    "Cloud": "uwsfm.cloud",
    "DomePort": "uwsfm.models.ports.port",
    "Distances": "uwsfm.calibration.lengths",
    "Lengths": "uwsfm.calibration.lengths",
    "Positions": "uwsfm.calibration.lengths",
    "FlatPort": "uwsfm.models.ports.port",
    "InterfacePort": "uwsfm.models.ports.port",
    "NoPort": "uwsfm.models.ports.port",
    "Model": "uwsfm.colmap.model",
    "Rig": "uwsfm.rig.rig",
    "InputError": "uwsfm.errors",
    "RefractiveCamera": "uwsfm.models.refractive",
    "Scene": "uwsfm.scene",
    "Status": "uwsfm.models.status",
    "UwsfmError": "uwsfm.errors",
    "calibrate": "uwsfm.calibration.bundle_adjustment",
    "calibrate_housing": "uwsfm.jobs.calibrate_housing",
    "check_halves": "uwsfm.jobs.check_halves",
    "clean_cloud": "uwsfm.surface.commands",
    "correct_colors": "uwsfm.color.commands",
    "error_budget": "uwsfm.calibration.error_budget",
    "perspective_adjustment": "uwsfm.calibration.perspective",
    "predict_covariance": "uwsfm.calibration.uncertainty",
    "verdicts": "uwsfm.calibration.observability",
    "with_budget": "uwsfm.calibration.error_budget",
    "dense_cloud": "uwsfm.dense.run",
    "export_colmap": "uwsfm.results.files",
    "export_housing": "uwsfm.results.housing",
    "export_las": "uwsfm.surface.commands",
    "export_pinhole": "uwsfm.export.pinhole_files",
    "export_ply": "uwsfm.results.files",
    "export_refractive_colmap": "uwsfm.export.refractive_colmap",
    "export_scene_ply": "uwsfm.export.scene_ply",
    "load_rig": "uwsfm.rig.file",
    "make_map": "uwsfm.surface.commands",
    "mesh_cloud": "uwsfm.surface.commands",
    "measure": "uwsfm.measuring.measure",
    "read_cloud": "uwsfm.cloud",
    "read_model": "uwsfm.results.files",
    "read_refractive_colmap": "uwsfm.sfm.from_colmap.refractive_colmap",
    "rig_of_refractive_colmap": "uwsfm.sfm.from_colmap.refractive_colmap",
    "Result": "uwsfm.results.folder",
    "open_result": "uwsfm.results.folder",
    "MatchOptions": "uwsfm.sfm.options",
    "StartOptions": "uwsfm.sfm.options",
    "ReconstructOptions": "uwsfm.options.jobs",
    "RefineOptions": "uwsfm.options.jobs",
    "reconstruct": "uwsfm.jobs.reconstruct",
    "refine_model": "uwsfm.jobs.refine_model",
    "run_batch": "uwsfm.jobs.batch",
    "write_report": "uwsfm.report.files",
    "Verdict": "uwsfm.trust.verdict",
    "judge": "uwsfm.trust.verdict",
    "write_cloud": "uwsfm.cloud",
}

__all__ = [
    "CalibrateHousingOptions",
    "CalibrateOptions",
    "CalibrationResult",
    "Cloud",
    "Distances",
    "DomePort",
    "FlatPort",
    "InputError",
    "InterfacePort",
    "Lengths",
    "MatchOptions",
    "Model",
    "NoPort",
    "Positions",
    "ReconstructOptions",
    "RefineOptions",
    "RefractiveCamera",
    "Result",
    "Rig",
    "Scene",
    "StartOptions",
    "Status",
    "UwsfmError",
    "Verdict",
    "calibrate",
    "calibrate_housing",
    "check_halves",
    "clean_cloud",
    "correct_colors",
    "dense_cloud",
    "error_budget",
    "export_colmap",
    "export_housing",
    "export_las",
    "export_pinhole",
    "export_ply",
    "export_refractive_colmap",
    "export_scene_ply",
    "judge",
    "load_rig",
    "make_map",
    "measure",
    "mesh_cloud",
    "open_result",
    "perspective_adjustment",
    "predict_covariance",
    "read_cloud",
    "read_model",
    "read_refractive_colmap",
    "reconstruct",
    "refine_model",
    "rig_of_refractive_colmap",
    "run_batch",
    "verdicts",
    "with_budget",
    "write_cloud",
    "write_report",
]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module 'uwsfm' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, "__version__", "logger"})
