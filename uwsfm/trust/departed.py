"""Numbers that have left what was given, as reasons of a verdict."""

import math
from collections.abc import Sequence

from uwsfm.calibration.parameters import OF_PORTS
from uwsfm.trust.given import Departure
from uwsfm.trust.reason import DOES_NOT_FIT, DOUBTFUL, Reason, reason

DEPARTED, FAR_DEPARTED = 4.0, 10.0
"""Standard deviations of given and estimate together; and of what was given alone, for
an estimate that is moved towards it by three of its own. For a port distance whose
accuracy was not stated they are factors of 3 and 6."""
DEPARTED_TOGETHER = 3.0
"""Of all port distances of a rig by one factor: a single number for each dive, where
the ones above are many."""
TILTED_DEG, FAR_TILTED_DEG = 15.0, 25.0
"""A port turned by more against the normal given: no mount is so far off by chance, and
at the second the port would stand in the way of its own lens."""
DOME_SHARE, FAR_DOME_SHARE = 0.5, 0.85
"""Distance of a dome's centre from the lens, by its radius: at 1 the pupil is in the
glass, and a lens body has a radius too."""
LONGEST_DISTANCE_M, READABLE_DISTANCE_M = 0.25, 0.5
"""No housing has a longer way from lens to port; no rig file takes one."""
STRETCH = (0.5, 1.45)
"""Of a lens at the image's edge. Wide lenses have 0.6; a flat port, taken for lens
distortion, 1.3 at the edge of a field of 100 degrees. No lens has more."""
CONTRADICTED = 4.0
"""Standard deviations from what the user stated, with an accuracy of their own."""


def departed_reasons(departures: Sequence[Departure]) -> list[Reason]:
    """A reason for every number that has left what was given."""
    judges = {
        "distance_m": _distance,
        "distances_share": _distances,
        "tilt_deg": _tilt,
        "center_share": _dome,
        "thickness_m": _glass,
        "glass_index": _glass,
        "focal_share": _focal,
        "principal_point_px": _principal_point,
        "stretch": _stretch,
        "unseen_share": _unseen,
    }
    found = (judges[item.what](item) for item in departures)
    reasons = [item for item in found if item is not None]
    if any(item.code == "port_distance" for item in reasons):
        return [item for item in reasons if item.code != "port_distances"]
    return reasons


def _glass(item: Departure) -> Reason | None:
    """A number of the glass against its prior, which pulls on it."""
    if item.z < CONTRADICTED:
        return None
    each = next(p for p in OF_PORTS if p.accuracy and p.accuracy.key == item.what)
    found, known = (
        f"{each.unit.per * value:.5g} ± {each.unit.shown(stddev, '.2g')}"
        for value, stddev in (
            (item.estimate, item.stddev),
            (item.given, item.given_stddev),
        )
    )
    source = "as given" if item.stated else "an accuracy that is assumed"
    text = (
        f"Camera {item.camera}: the {each.name} came out at {found}, against {known}, "
        f"{source}; measure it, and check the port distance, the lens and units."
    )
    return reason("glass", text, DOUBTFUL, **_numbers(item))


def _numbers(item: Departure) -> dict[str, float]:
    numbers = {"given": item.given, "estimate": item.estimate, "stddev": item.stddev}
    return {**numbers, "z": item.z}


def _distance(item: Departure) -> Reason | None:
    """A port distance against the ruler, and against what a housing can be."""
    far = not math.isfinite(item.stddev)
    if far:
        return None
    unreadable = item.at_least > READABLE_DISTANCE_M > item.given
    too_long = item.at_least > LONGEST_DISTANCE_M > item.given
    if item.z < DEPARTED and not too_long:
        return None
    times = item.estimate / item.given if item.given > 0.0 else math.inf
    factor = ""
    if math.isfinite(times) and times > 1.5:
        factor = f", {times:.2g} times the given one"
    source = "the rig file has" if not item.stated else "was stated as"
    text = (
        f"Camera {item.camera}: the port came out at {1e3 * item.estimate:.4g} ± "
        f"{1e3 * item.stddev:.2g} mm from the images{factor} ({source} "
        f"{1e3 * item.given:.3g} ± {1e3 * item.given_stddev:.2g} mm"
        f"{'' if item.stated else ', assumed'}); "
        "measure it with a ruler, and check lens, baseline and units."
    )
    severe = unreadable or item.z_at_least >= FAR_DEPARTED
    severity = DOES_NOT_FIT if severe else DOUBTFUL
    return reason("port_distance", text, severity, **_numbers(item))


def _distances(item: Departure) -> Reason | None:
    """All port distances by one factor, as a wrong baseline makes them."""
    if item.z < DEPARTED_TOGETHER:
        return None
    text = (
        f"The ports of {item.camera} together came out at {item.estimate:.2g} times "
        f"their distances in the rig file (± {item.stddev:.2g} from the images, "
        f"± {item.given_stddev:.2g} from the ruler"
        f"{'' if item.stated else ', assumed'}), and nothing else checks the length "
        "that gives the scale: measure the ports and the baseline, and check its unit."
    )
    return reason("port_distances", text, DOUBTFUL, **_numbers(item))


def _tilt(item: Departure) -> Reason | None:
    if not math.isfinite(item.stddev):
        return None
    contradicts = item.stated and item.z >= CONTRADICTED
    if item.at_least < TILTED_DEG and not contradicts:
        return None
    text = (
        f"Camera {item.camera}: the port came out tilted by {item.estimate:.1f} ± "
        f"{item.stddev:.2g} degrees against the normal given, further than ports are "
        "mounted; lens, placement of the cameras or kind of port are wrong."
    )
    severity = DOES_NOT_FIT if item.at_least >= FAR_TILTED_DEG else DOUBTFUL
    return reason("port_tilt", text, severity, **_numbers(item))


def _dome(item: Departure) -> Reason | None:
    if not math.isfinite(item.stddev):
        return None
    moved = item.at_least > DOME_SHARE > item.given
    if not moved and not (item.stated and item.z >= CONTRADICTED):
        return None
    text = (
        f"Camera {item.camera}: the centre of the dome came out {item.estimate:.2f} ± "
        f"{item.stddev:.2g} radii away from the lens; at 1 the lens is in the glass. "
        "Check the radius, the lens and whether the port is a dome at all."
    )
    severity = DOES_NOT_FIT if item.at_least > FAR_DOME_SHARE else DOUBTFUL
    return reason("dome_centre", text, severity, **_numbers(item))


def _focal(item: Departure) -> Reason | None:
    text = (
        f"the focal length came out at {item.estimate:.3f} ± {item.stddev:.2g} times "
        f"the given one ({_stated(item, '{:.2g}')}); check that it was calibrated in "
        "air, at this resolution and zoom."
    )
    return _lens(item, "focal_length", text)


def _principal_point(item: Departure) -> Reason | None:
    text = (
        f"the principal point moved by {item.estimate:.3g} ± {item.stddev:.2g} px "
        f"({_stated(item, '{:.2g} px')}); check that the lens was calibrated on images "
        "of this crop and orientation."
    )
    return _lens(item, "principal_point", text)


def _lens(item: Departure, code: str, what: str) -> Reason | None:
    """A number of a lens that has left its calibration."""
    if item.z < DEPARTED:
        return None
    severity = DOES_NOT_FIT if item.z_at_least >= FAR_DEPARTED else DOUBTFUL
    text = f"Camera {item.camera}: {what}"
    return reason(code, text, severity, **_numbers(item))


def _stated(item: Departure, form: str) -> str:
    word = "stated" if item.stated else "assumed"
    return f"known to {form.format(item.given_stddev)}, {word}"


def _stretch(item: Departure) -> Reason | None:
    low, high = STRETCH
    if low <= item.estimate <= high or not low <= item.given <= high:
        return None
    text = (
        f"Camera {item.camera}: the refined distortion moves the edge of the image to "
        f"{item.estimate:.2g} times its radius, as no lens does."
    )
    return reason("distortion", text, DOES_NOT_FIT, **_numbers(item))


def _unseen(item: Departure) -> Reason | None:
    if not item.estimate > item.given:
        return None
    text = (
        f"Camera {item.camera}: the refined distortion folds back within the image; "
        f"{1e2 * item.estimate:.0f} % of its edge have no ray."
    )
    return reason("distortion_folds", text, DOES_NOT_FIT, **_numbers(item))
