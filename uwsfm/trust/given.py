"""Estimates against what was given: ports against the ruler, lenses against their
calibration.

What is given has an accuracy. Where the user states none, one of those below is
assumed; they are wide, as most numbers of a rig file are guesses. The deviation of the
estimate, in all, is added: what is hardly determined contradicts nothing.
"""

import math
from dataclasses import dataclass

import numpy as np

from uwsfm.calibration.parameters import OF_PORTS
from uwsfm.calibration.priors import prior_stddevs
from uwsfm.calibration.result import CalibrationResult
from uwsfm.geometry.rigid3 import Array
from uwsfm.models.lens import BROWN, KIND, PINHOLE
from uwsfm.models.lens_row import CENTER, DISTORTION, FOCAL, FX
from uwsfm.models.ports.port import DomePort, NoPort, PlanePort, Port
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.residuals import border
from uwsfm.rig.rig import Rig, RigCamera
from uwsfm.solver.layout import HELD

DISTANCE_SHARE, DISTANCE_M = 0.5, 0.005
"""Assumed standard deviation of a port distance: half of the smaller of given and
estimated, 5 mm at least. A guess is often off by a factor of two, a ruler that ends at
the glass by some millimetres, as nobody sees the lens's projection centre."""
TILT_DEG = 5.0
"""Of a normal: ports are mounted straight by eye, and bent or prism-like mounts, of ten
degrees, are rare."""
CENTER_SHARE = 0.2
"""Of the centre of a dome, by its radius: about what a lens can be moved in a dome
before the image shows it."""
FOCAL_SHARE = 0.03
"""Of a focal length that a calibration in air gave and that is refined: focus and
temperature move it by a per cent."""
PRINCIPAL_SHARE = 0.02
"""Of the principal point, by the longer side of the image."""
EDGE_STEPS = 24
"""Points along each side of the image at which a lens is looked at."""


@dataclass(frozen=True, kw_only=True)
class Departure:
    """One estimate that has left what was given."""

    camera: str
    what: str
    """"distance_m", "distances_share" (of all ports together, 1: as given),
    "tilt_deg", "center_share" (of the dome's radius), "thickness_m", "glass_index",
    "focal_share", "principal_point_px", "stretch" (of the distortion at the image's
    edge, 1: none), "unseen_share" (of the image's edge, where the lens has no ray)"""
    given: float
    estimate: float
    stddev: float
    """Of the estimate; NaN: not determined, or held at its bound, zero."""
    given_stddev: float
    """Stated or, where nothing was stated, assumed; NaN: none is needed."""
    stated: bool = False

    @property
    def z(self) -> float:
        """Difference in standard deviations of both; 0 if it is not determined."""
        both = math.hypot(self.stddev, self.given_stddev)
        return abs(self.estimate - self.given) / both if math.isfinite(both) else 0.0

    @property
    def z_at_least(self) -> float:
        """Difference less three standard deviations of the estimate, in standard
        deviations of what was given."""
        difference = abs(self.estimate - self.given) - 3.0 * self.stddev
        return difference / self.given_stddev

    @property
    def at_least(self) -> float:
        """The estimate, less three of its standard deviations."""
        return self.estimate - 3.0 * self.stddev


def departures(rig: Rig, calibration: CalibrationResult) -> tuple[Departure, ...]:
    """Every number that was given and refined; lengths only where they are metres."""
    found: list[Departure] = []
    metric = calibration.covariance.scale_stddev is not None
    for index, camera in enumerate(rig.cameras):
        refined = calibration.covariance.border_cols[index] != HELD
        after = calibration.scene.cameras[index]
        found += _port(camera, after.port, index, refined, calibration, metric)
        found += _glass(camera, after.port, index, calibration)
        if np.any(refined[border.FIRST_LENS :]):
            found += _lens(camera, after, index, calibration)
    return (*found, *_common_factor(rig, calibration, found))


def _common_factor(
    rig: Rig, calibration: CalibrationResult, found: list[Departure]
) -> list[Departure]:
    """The factor by which all port distances together left the rig file's.

    A baseline that is too long lengthens all of them, and nothing else checks it. The
    factor is that of `mean_factor`. Errors of rulers that are assumed are taken as one
    and the same error, which is the careful way: whoever misjudges one port misjudges
    the next one alike.
    """
    index = {camera.name: i for i, camera in enumerate(rig.cameras)}
    items = [
        item
        for item in found
        if item.what == "distance_m" and math.isfinite(item.stddev) and item.given > 0.0
    ]
    if len(items) < 2:
        return []
    covariance = calibration.covariance
    cameras = [index[item.camera] for item in items]
    cols = covariance.border_cols[cameras, border.DISTANCE]
    images = covariance.border[np.ix_(cols, cols)]
    # Correlations of the one estimate of the covariance, sizes of the larger.
    sizes = np.sqrt(np.diag(images))
    larger = np.array([item.stddev for item in items])
    larger = np.divide(larger, sizes, out=np.ones_like(sizes), where=sizes > 0.0)
    images = images * np.outer(larger, larger)
    stddevs = np.array([item.given_stddev for item in items])
    assumed = np.array([not item.stated for item in items])
    rulers = np.diag(stddevs**2)
    rulers[np.ix_(assumed, assumed)] = np.outer(stddevs[assumed], stddevs[assumed])
    factor, of_images, of_rulers = mean_factor(
        np.array([item.given for item in items]),
        np.array([item.estimate for item in items]),
        images,
        rulers,
    )
    return [
        Departure(
            camera=", ".join(item.camera for item in items),
            what="distances_share",
            given=1.0,
            estimate=factor,
            stddev=of_images,
            given_stddev=of_rulers,
            stated=not bool(assumed.any()),
        )
    ]


def mean_factor(
    given: Array, estimates: Array, images: Array, rulers: Array
) -> tuple[float, float, float]:
    """The factor between given and estimated numbers, and its standard deviations.

    It is a mean, weighted as if all errors were independent; its deviations are those
    of the correlated ones. Weights of generalised least squares turn negative where
    errors have much in common, and the factor then lies outside of all numbers' own.

    Args:
        given: (n,)
        estimates: (n,)
        images: (n, n) covariance of the estimates.
        rulers: (n, n) covariance of what was given.

    Returns:
        The factor, its standard deviation from the images, and from the rulers.
    """
    weights = given / np.diag(images + rulers)
    weights /= weights @ given
    return (
        float(weights @ estimates),
        math.sqrt(weights @ images @ weights),
        math.sqrt(weights @ rulers @ weights),
    )


def _port(
    camera: RigCamera,
    after: Port,
    index: int,
    refined: Array,
    calibration: CalibrationResult,
    metric: bool,
) -> list[Departure]:
    before, options, found = camera.port, calibration.options, []
    cov = calibration.covariance.judged_cameras[index]
    # The ruler contradicts a lens, too: what the lens is not known to is no excuse.
    images = calibration.covariance.cameras[index]
    # What the rig file says of a number that is refined is no prior, but a claim.
    distance = options.distance_stddev_m or camera.accuracy.distance_m
    normal = options.normal_stddev_deg or camera.accuracy.normal_deg
    stated = options.center_stddev_m or camera.accuracy.center_m
    if isinstance(before, PlanePort) and isinstance(after, PlanePort):
        if metric and (refined[border.DISTANCE] or cov.distance_at_zero):
            smaller = min(before.distance, after.distance)
            assumed = max(DISTANCE_M, DISTANCE_SHARE * smaller)
            found.append(
                Departure(
                    camera=camera.name,
                    what="distance_m",
                    given=before.distance,
                    estimate=after.distance,
                    stddev=(
                        math.nan if cov.distance_at_zero else images.distance_stddev_m
                    ),
                    given_stddev=distance or assumed,
                    stated=distance is not None,
                )
            )
        if np.any(refined[border.NORMAL]):
            cosine = float(np.dot(before.normal, after.normal))
            found.append(
                Departure(
                    camera=camera.name,
                    what="tilt_deg",
                    given=0.0,
                    estimate=math.degrees(math.acos(min(max(cosine, -1.0), 1.0))),
                    stddev=cov.normal_stddev_deg,
                    given_stddev=normal or TILT_DEG,
                    stated=normal is not None,
                )
            )
    if not (isinstance(before, DomePort) and isinstance(after, DomePort)):
        return found
    if np.any(refined[border.CENTER]):
        found.append(
            Departure(
                camera=camera.name,
                what="center_share",
                given=float(np.linalg.norm(before.center)) / after.radius,
                estimate=float(np.linalg.norm(after.center)) / after.radius,
                stddev=float(np.linalg.norm(cov.center_stddev_m)) / after.radius,
                given_stddev=(stated or CENTER_SHARE * after.radius) / after.radius,
                stated=stated is not None,
            )
        )
    return found


def _glass(
    camera: RigCamera, after: Port, index: int, calibration: CalibrationResult
) -> list[Departure]:
    """What has its accuracy as a prior, and the images pull away from it."""
    covariance, found = calibration.covariance, []
    for each in OF_PORTS:
        column = int(covariance.border_cols[index, each.first])
        if column == HELD or not each.has_prior_by_accuracy or each.accuracy is None:
            continue
        columns = covariance.border_cols
        prior = prior_stddevs(calibration.scene, calibration.options, columns)
        stated = getattr(camera.accuracy, each.accuracy.key)
        found.append(
            Departure(
                camera=camera.name,
                what=each.accuracy.key,
                given=float(camera.port.row[each.column]),
                estimate=float(after.row[each.column]),
                stddev=float(np.sqrt(covariance.border[column, column])),
                given_stddev=float(prior[index, each.first]),
                stated=stated is not None,
            )
        )
    return found


def _lens(
    camera: RigCamera,
    after: RefractiveCamera,
    index: int,
    calibration: CalibrationResult,
) -> list[Departure]:
    """A refined lens against the one given; a lens without a port is often a guess,
    whose focal length and centre are compared only where their accuracy is stated."""
    before = RefractiveCamera(camera.camera, camera.port)
    options, found = calibration.options, []
    cols = calibration.covariance.border_cols[index, border.FIRST_LENS :]
    stddevs = np.append(np.sqrt(np.diag(calibration.covariance.border)), 0.0)[cols]
    bare = not camera.port.refracts
    focal, point = options.focal_stddev, options.principal_point_stddev_px
    if cols[0] != HELD and not (bare and focal is None):
        found.append(
            Departure(
                camera=camera.name,
                what="focal_share",
                given=1.0,
                estimate=float(after.lens[FX] / before.lens[FX]),
                stddev=float(stddevs[0] / before.lens[FX]),
                given_stddev=focal or FOCAL_SHARE,
                stated=focal is not None,
            )
        )
    if cols[2] != HELD and not (bare and point is None):
        shift = after.lens[CENTER] - before.lens[CENTER]
        found.append(
            Departure(
                camera=camera.name,
                what="principal_point_px",
                given=0.0,
                estimate=float(np.linalg.norm(shift)),
                stddev=float(np.linalg.norm(stddevs[2:4])),
                given_stddev=point or PRINCIPAL_SHARE * max(after.width, after.height),
                stated=point is not None,
            )
        )
    if np.any(cols[DISTORTION] != HELD):
        found += _distortion(camera, before, after)
    return found


def _distortion(
    camera: RigCamera, before: RefractiveCamera, after: RefractiveCamera
) -> list[Departure]:
    """What a refined distortion does at the edge of the image."""
    edge = _edge(after, camera.valid_radius_px)
    stretches, unseen = [], []
    for item in (before, after):
        rays = item.with_port(NoPort()).ray_from_img(edge)[1]
        seen = np.all(np.isfinite(rays), axis=1)
        offset = (edge - item.lens[CENTER]) / item.lens[FOCAL]
        ideal = np.linalg.norm(rays[:, :2] / rays[:, 2:], axis=1)
        ratio = np.linalg.norm(offset, axis=1) / np.maximum(ideal, 1e-9)
        far = seen & (ideal > 1e-3)
        largest = np.argmax(np.abs(np.log(np.where(far, ratio, 1.0))))
        stretches.append(float(ratio[largest]) if np.any(far) else 1.0)
        unseen.append(1.0 - float(np.mean(seen)))
    found = [
        Departure(
            camera=camera.name,
            what="unseen_share",
            given=unseen[0],
            estimate=unseen[1],
            stddev=0.0,
            given_stddev=math.nan,
        )
    ]
    if after.lens[KIND] in (
        PINHOLE,
        BROWN,
    ):  # a fisheye's edge is far from a pinhole's, rightly
        found.append(
            Departure(
                camera=camera.name,
                what="stretch",
                given=stretches[0],
                estimate=stretches[1],
                stddev=0.0,
                given_stddev=math.nan,
            )
        )
    return found


def _edge(camera: RefractiveCamera, valid_radius_px: float | None) -> Array:
    """Pixels (N, 2) along the edge of the image, or of the part that is valid."""
    t = np.linspace(0.0, 1.0, EDGE_STEPS)
    sides = [
        np.stack([x * np.ones_like(t), y * np.ones_like(t)], axis=1)
        for x, y in ((t, 0.0), (t, 1.0), (0.0, t), (1.0, t))
    ]
    edge = np.concatenate(sides) * [camera.width, camera.height]
    if valid_radius_px is None:
        return edge
    offset = edge - camera.lens[CENTER]
    radius = np.linalg.norm(offset, axis=1, keepdims=True)
    return camera.lens[CENTER] + offset * np.minimum(1.0, valid_radius_px / radius)
