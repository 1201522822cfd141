"""The calibrated parameters: numbers of a camera, its port and its place in the rig.

Each is declared once, below. Options, priors, bounds, default accuracies, the error
budget, tables, verdicts, the comparison of halves and files read here what they need.
The command line reads it before anything is computed, so it imports nothing heavy.
"""

import math
from typing import TYPE_CHECKING, Literal

from uwsfm.calibration.parameter import (
    DEGREE,
    MILLIMETRE,
    NUMBER,
    PIXEL,
    Accuracy,
    Parameter,
    Prior,
    Refine,
)
from uwsfm.models.ports import row
from uwsfm.residuals import border

LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""As the slots of `uwsfm.residuals.border.LENS`."""

ROTATION = Parameter(
    name="rotation of cam_from_rig",
    group="rotation",
    plural="rotations of cam_from_rig",
    slots=border.ROTATION,
    unit=DEGREE,
    step="cam_from_rig turned about {}",
    part="rotation {}",
    accuracy=Accuracy(
        key="rotation_deg",
        most=45.0,
        unit="in degrees",
        least=0.1,
        because="Per axis, of a held cam_from_rig.",
        per=math.radians(1.0),
    ),
)
DIRECTION = Parameter(
    name="direction of the baseline",
    group="direction",
    plural="directions of the baselines",
    slots=border.DIRECTION,
    unit=DEGREE,
    step="direction of the baseline towards {}",
    part="baseline direction {}",
    accuracy=Accuracy(
        key="direction_deg",
        most=45.0,
        unit="in degrees",
        least=0.1,
        because="Per component, of the direction of the translation.",
        per=math.radians(1.0),
    ),
)
TILT = Parameter(
    name="port tilt",
    group="tilt",
    plural="port tilts",
    slots=border.NORMAL,
    unit=DEGREE,
    number="normal",
    step="port tilt towards {}",
    part="tilt {}",
    refine=Refine(field="refine_normals", default=True, help="Normals of flat ports."),
    prior=Prior(field="normal_stddev_deg", help="Root mean square angle."),
    accuracy=Accuracy(
        key="normal_deg",
        most=45.0,
        unit="in degrees",
        least=2.0,
        because="RMS angle of a held normal: ports are mounted no better.",
        # The RMS angle is sqrt(2) of its two components.
        per=math.radians(1.0) / math.sqrt(2.0),
    ),
)
CENTER = Parameter(
    name="dome centre",
    group="center",
    plural="dome centres",
    slots=border.CENTER,
    unit=MILLIMETRE,
    number="center",
    step="dome centre {}",
    part="centre {}",
    refine=Refine(
        field="refine_centers",
        default=True,
        help="Centres of domes, all three coordinates.",
    ),
    prior=Prior(
        field="center_stddev_m", help="Per coordinate of the centres of domes."
    ),
    accuracy=Accuracy(
        key="center_m",
        most=0.1,
        unit="in metres: 0.002 is two millimetres",
        least=2e-3,
        because="Per coordinate, of a held dome centre: the pupil is not visible.",
    ),
)
DISTANCE = Parameter(
    name="port distance",
    group="distance",
    plural="port distances",
    slots=border.DISTANCE,
    unit=MILLIMETRE,
    number="distance",
    column=row.DISTANCE,
    refine=Refine(
        field="refine_distances", default=True, help="Distances of flat ports."
    ),
    prior=Prior(
        field="distance_stddev_m",
        help="How well the port distances of the start are known; None: not at all. "
        "So for all priors; they matter for what is refined only.",
    ),
    bounds=(0.0, math.inf),
    accuracy=Accuracy(
        key="distance_m",
        most=0.2,
        unit="in metres: 0.002 is two millimetres",
        share=0.2,
        least=2e-3,
        because="The larger of the two, of a held port distance: the entrance pupil is "
        "not visible.",
    ),
)
RADIUS = Parameter(
    name="dome radius",
    group="radius",
    plural="dome radii",
    slots=border.RADIUS,
    unit=MILLIMETRE,
    number="radius",
    column=row.RADIUS,
    bounds=(0.0, math.inf),
    listed=True,
    accuracy=Accuracy(
        key="radius_m",
        most=0.05,
        unit="in metres: 0.001 is a millimetre",
        share=0.02,
        because="Of a dome's radius: 1 mm of 50.",
    ),
)
THICKNESS = Parameter(
    name="glass thickness",
    group="glass thickness",
    plural="glass thicknesses",
    slots=border.THICKNESS,
    unit=MILLIMETRE,
    number="thickness",
    column=row.THICKNESS,
    bounds=(0.0, math.inf),
    listed=True,
    refine=Refine(
        field="refine_glass_thickness",
        flag="glass-thickness",
        help="Thickness of every window; it trades against the port distance.",
    ),
    prior=Prior(
        field="thickness_stddev_m",
        from_accuracy=True,
        help="Of every window. None: the accuracy that is given, or assumed.",
    ),
    accuracy=Accuracy(
        key="thickness_m",
        most=0.02,
        unit="in metres: 0.0005 is half a millimetre",
        share=0.1,
        least=5e-4,
        because="The larger of the two: data sheets promise 10 %, a calliper 0.5 mm.",
    ),
)
GLASS_INDEX = Parameter(
    name="glass index",
    group="glass index",
    plural="glass indices",
    slots=border.GLASS_INDEX,
    unit=NUMBER,
    number="n_glass",
    column=row.N_GLASS,
    bounds=(1.0, 4.0),
    listed=True,
    refine=Refine(
        field="refine_glass_index",
        flag="glass-index",
        help="Refractive index of every window; it trades against the thickness.",
    ),
    prior=Prior(
        field="glass_index_stddev",
        from_accuracy=True,
        help="Of every window. None: the accuracy that is given, or assumed.",
    ),
    accuracy=Accuracy(
        key="glass_index",
        most=0.3,
        unit="in units of the index",
        least=0.01,
        because="Between kinds of glass, or of acrylic.",
    ),
)
WATER_INDEX = Parameter(
    name="water index",
    group="water index",
    plural="water indices",
    slots=border.WATER_INDEX,
    unit=NUMBER,
    number="n_water",
    column=row.N_WATER,
    bounds=(1.0, 4.0),
    listed=True,
    refine=Refine(
        field="refine_water_index",
        flag="water-index",
        help="Shared by all ports that start from the same index.",
    ),
    prior=Prior(field="water_index_stddev", help="Of the water."),
    accuracy=Accuracy(
        key="water_index",
        most=0.1,
        unit="in units of the index",
        least=0.002,
        because="15 degrees of temperature, or 10 g/kg of salt.",
        of_rig=True,
    ),
)
BASELINE = Parameter(
    name="baseline",
    group="baseline",
    plural="lengths of the baselines",
    slots=border.LENGTH,
    unit=MILLIMETRE,
    listed=True,
    accuracy=Accuracy(
        key="baseline_m",
        most=1.0,
        unit="in metres: 0.001 is a millimetre",
        share=0.005,
        because="1 mm of 200: a stereo calibration, or a careful ruler.",
        of_rig=True,
    ),
)
FOCAL = Parameter(
    name="focal length",
    group="lens",
    plural="lenses",
    slots=slice(border.FIRST_LENS, border.FIRST_LENS + 2),
    unit=PIXEL,
    listed=True,
    refine=Refine(
        field="refine_focal",
        flag="focal",
        help="Focal lengths of every camera; they trade against water index and "
        "distance.",
    ),
    prior=Prior(field="focal_stddev", help="Relative: 1e-3 is 0.1 %."),
    accuracy=Accuracy(
        key="focal",
        most=0.1,
        unit="as a share of the focal length: 0.001 is 0.1 %",
        least=1e-3,
        because="Relative. Two calibrations in air of one lens differ by so much, or "
        "by more.",
        relative=True,
    ),
)
PRINCIPAL_POINT = Parameter(
    name="principal point",
    group="lens",
    plural="lenses",
    slots=slice(border.FIRST_LENS + 2, border.FIRST_LENS + 4),
    unit=PIXEL,
    listed=True,
    refine=Refine(
        field="refine_principal_point",
        flag="principal-point",
        help="Principal points; they trade against the normal.",
    ),
    prior=Prior(field="principal_point_stddev_px", help="Per coordinate."),
    accuracy=Accuracy(
        key="principal_point_px",
        most=500.0,
        unit="in pixels",
        least=1.0,
        because="Per coordinate; the same comparison.",
    ),
)
DISTORTION = Parameter(
    name="distortion",
    group="lens",
    plural="lenses",
    slots=slice(border.FIRST_LENS + 4, border.LENS.stop),
    unit=NUMBER,
    listed=True,
    refine=Refine(
        field="refine_distortion",
        flag="distortion",
        help="All distortion parameters that the camera's model has.",
    ),
    prior=Prior(field="distortion_stddev", help="Of each distortion parameter."),
    accuracy=Accuracy(
        key="distortion",
        most=math.inf,  # no common size: how far one moves the corner is checked
        unit="",
        because="As far as it moves the corner of the image: CORNER, or TANGENTIAL.",
    ),
)

PARAMETERS = (
    ROTATION,
    DIRECTION,
    TILT,
    CENTER,
    DISTANCE,
    RADIUS,
    THICKNESS,
    GLASS_INDEX,
    WATER_INDEX,
    BASELINE,
    FOCAL,
    PRINCIPAL_POINT,
    DISTORTION,
)
"""All of them, in the order in which tables have them."""
LENS = (FOCAL, PRINCIPAL_POINT, DISTORTION)
"""Those of a lens: how many of their numbers there are depends on its model."""
OF_PORTS = tuple(each for each in PARAMETERS if each.column is not None)
"""Single numbers of ports."""
OF_RIG = tuple(
    each.accuracy.key
    for each in PARAMETERS
    if each.accuracy is not None and each.accuracy.of_rig
)
"""Accuracies that stand beside the cameras in a rig file."""
REFINABLE = {
    each.refine.flag: each.refine.field
    for each in PARAMETERS
    if each.refine is not None and each.refine.flag is not None
}
"""Words of ``--refine``, with the fields of `CalibrateOptions` that they set."""
PRIORS = tuple(each.prior.field for each in PARAMETERS if each.prior is not None)
"""Fields of `CalibrateOptions` that say how well a refined number is known before."""
GROUPS = {each.group: each.plural for each in PARAMETERS}
"""Groups of numbers that halves are compared by, with their names for people."""


def lens_parameter(slot: int) -> Parameter:
    """The parameter that a slot of a lens belongs to."""
    return next(p for p in LENS if p.first <= slot < p.first + p.size)


if TYPE_CHECKING:
    Refinable = str
else:
    Refinable = Literal[tuple(REFINABLE)]
