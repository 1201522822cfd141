"""The options of the jobs: `reconstruct`, `refine` and `calibrate`.

Each option is declared in one place: here, or in `uwsfm.sfm.options` if it concerns the
way from images to a map. Whatever else knows of it is derived, see
`uwsfm._base.options`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Literal, TypeVar

from uwsfm._base.options import (
    Checked,
    Option,
    documented,
    group,
    group_names,
    option,
    options_of,
    replaced,
    unknown,
    value_at,
)
from uwsfm.calibration.choices import ErrorName, Strategy
from uwsfm.calibration.parameters import PRIORS, REFINABLE, Refinable
from uwsfm.errors import InputError
from uwsfm.sfm.options import StartOptions

Start = Literal["virtual", "paper", "pairs"]
Job = TypeVar("Job", bound="JobOptions")


@dataclass(frozen=True, kw_only=True)
class ConstraintOptions(Checked):
    """What is known of lengths and places, besides the rig."""

    positions: Path | None = option(
        None,
        help="Positions of the frames, from navigation or GPS: a CSV file with the "
        "header frame,x,y,z,sx,sy,sz in metres, in a local right-handed frame; or "
        "frame,depth,sdepth where only depths are known. The result is in their "
        "frame. Default: no positions.",
    )
    lever_arm: tuple[float, float, float] | None = option(
        None,
        metavar="X,Y,Z",
        help="Place of the antenna of the positions in the frame of the first camera, "
        "in metres. Default: 0,0,0.",
    )
    lengths: Path | None = option(
        None,
        help="Scale bars and distances between frames: a YAML file, see "
        "docs/howto/scale.md. Default: no lengths besides those of the rig.",
    )
    scene_distance_m: float | None = option(
        None,
        flag="--scene-distance",
        unit="metres",
        positive=True,
        help="Rough distance from a single camera to its scene. It sets the scale that "
        "the adjustment starts with. Default: 1. Not for rigs of two or more cameras, "
        "which measure it.",
    )


@dataclass(frozen=True, kw_only=True)
class AdjustmentOptions(Checked):
    """What the last adjustment refines besides poses, ports and points."""

    refine: tuple[Refinable, ...] = option(
        (),
        help="Refine this number of the rig, too. May be repeated. Default: the glass "
        "of the ports, the index of the water and the lenses are held as given.",
    )
    prior: Mapping[str, float] = option(
        {},
        metavar="KEY=VALUE",
        keys=PRIORS,
        help="Standard deviation of a refined number as it is known before: KEY is "
        f"one of {', '.join(PRIORS)}. focal_stddev is relative: 0.001 is 0.1 %. May be "
        "repeated. Default: the accuracy of the rig file for the glass; for all else, "
        "nothing is known.",
    )
    further: Mapping[str, Any] = field(default_factory=dict)
    """Other fields of `CalibrateOptions`, by name: for Python only."""

    def as_fields(self) -> dict[str, Any]:
        """All of this as fields of `CalibrateOptions`."""
        refined = {REFINABLE[name]: True for name in self.refine}
        return {**refined, **self.prior, **self.further}


@dataclass(frozen=True, kw_only=True)
class JobOptions(Checked):
    """What all jobs take."""

    constraints: ConstraintOptions = group(ConstraintOptions, "Known lengths")
    adjustment: AdjustmentOptions = group(AdjustmentOptions, "Adjustment")

    @classmethod
    def of(cls: type[Job], **settings: Any) -> Job:
        """The defaults, but for some options by name; see `with_settings`."""
        return cls().with_settings(settings)

    def with_settings(self: Job, settings: Mapping[str, Any]) -> Job:
        """These options with some others.

        Args:
            settings: Options by name, whole groups by the name of their field, and
                fields of `CalibrateOptions` for the adjustment.

        Raises:
            InputError: a value is out of bounds, or a name is unknown.
        """
        declared = {item.name: item for item in options_of(type(self))}
        whole: dict[tuple[str, ...], Any] = {}
        own: dict[tuple[str, ...], Any] = {}
        rest = {}
        for name, value in settings.items():
            if name in group_names(type(self)):
                whole[name,] = value
            elif name in declared:
                own[declared[name].path] = value
            else:
                rest[name] = value
        # A group first, then what is given of it beside.
        options = replaced(replaced(self, whole), own)
        if rest:
            _require_known(rest, list(declared))
        adjustment = _with_fields(options.adjustment, rest)
        return replaced(options, {("adjustment",): adjustment})

    def items(self) -> Iterator[tuple[Option, Any]]:
        """Every option with its value."""
        for item in options_of(type(self)):
            yield item, value_at(self, item.path)

    def values(self) -> dict[str, Any]:
        """Every value by name, and what only Python gives to the adjustment."""
        named = {item.name: value for item, value in self.items()}
        return {**named, **self.adjustment.further}


@dataclass(frozen=True, kw_only=True)
class ModelOptions(JobOptions):
    """What the jobs take that leave a model."""

    report: bool = option(True, help="Write report.html, which takes a second or two.")


@documented
@dataclass(frozen=True, kw_only=True)
class ReconstructOptions(ModelOptions):
    """Options of `uwsfm.reconstruct`, and of `uwsfm reconstruct`."""

    front_end: StartOptions = group(StartOptions)


@documented
@dataclass(frozen=True, kw_only=True)
class RefineOptions(ModelOptions):
    """Options of `uwsfm.refine_model`, and of `uwsfm refine`."""

    images: Path | None = option(
        None,
        help="Folder that holds one folder of images per camera, for the colours of "
        "the points. Default: the points keep the colours of the model.",
    )
    database: Path | None = option(
        None,
        help="COLMAP's database of the model. It adds all its matches, frames that the "
        "model lost, and points where the model has poses only. It is not changed. "
        "Default: the tracks of the model alone.",
    )


@documented
@dataclass(frozen=True, kw_only=True)
class CalibrateHousingOptions(JobOptions):
    """Options of `uwsfm.calibrate_housing`, and of `uwsfm calibrate`."""

    strategy: Strategy = option(
        "joint",
        help="Order in which unknowns are adjusted. joint: one adjustment of "
        "everything. nested: the two nested loops of the 2011 paper.",
    )
    error: ErrorName | None = option(
        None,
        help="Which error is minimised, in pixels (reprojection) or in metres. "
        "Default: reprojection; with --strategy nested: virtual_camera.",
    )
    start: Start = option(
        "virtual",
        help="How the adjustment starts. virtual: from pinholes fitted to the ports. "
        "paper: from pinholes of 1.333 f with radial distortion, adjusted as in the "
        "paper. pairs: from single stereo pairs, which determine normals only.",
    )
    # The start of the 2011 paper: a map of pinholes.
    front_end: StartOptions = group(lambda: StartOptions(mapper="pinhole"))


def _require_known(names: Iterable[str], options: list[str]) -> None:
    """Refuse a name that neither an option nor a field of `CalibrateOptions` has."""
    from uwsfm.calibration.problem import CalibrateOptions  # heavy, and for Python only

    known = options + [field.name for field in fields(CalibrateOptions)]
    for name in names:
        if name not in known:
            raise InputError(f"unknown option {name}, {unknown(name, known)}")


def _with_fields(
    options: AdjustmentOptions, given: Mapping[str, Any]
) -> AdjustmentOptions:
    """Options of an adjustment with some fields of `CalibrateOptions`.

    Those that have an option become it: a result is the same job, and shows the same
    command, whether Python or the command line asked for it.
    """
    refine, prior = dict.fromkeys(options.refine), dict(options.prior)
    further = dict(options.further)
    names = {field: flag for flag, field in REFINABLE.items()}
    for name, value in given.items():
        if name in names and isinstance(value, bool):
            further.pop(name, None)
            refine.pop(names[name], None)
            if value:
                refine[names[name]] = None
        elif name in PRIORS:
            prior.pop(name, None)
            if value is not None:
                prior[name] = value
        else:
            further[name] = value
    return AdjustmentOptions(refine=tuple(refine), prior=prior, further=further)
