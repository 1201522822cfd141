"""Standard deviations between two bounds: that they are right, not that they are there.

No unbiased estimate is better than the Cramer-Rao bound of its observations, and what
is reported is the larger of two estimates of one number (see `CameraCovariance`): the
second is told by the residuals of clusters, which in dives of a few frames know their
variance to a third, and sigma itself to some per cent.
"""

import numpy as np

from uwsfm import Scene
from uwsfm.calibration.result import Covariance
from uwsfm.calibration.uncertainty import predict_covariance

LEAST, MOST = 0.9, 1.6
"""Of the bound."""


def assert_near_the_bound(
    found: Covariance, truth: Scene, noise_px: float, **options
) -> None:
    """Every deviation of ports and scale is that of observations like these.

    Args:
        found: reported, of the truth's observations with noise.
        truth: exact observations.
        noise_px: of each coordinate.
        **options: as of the calibration, ``lengths`` included.
    """
    bound = predict_covariance(truth, noise_px, **options)
    for one, best in zip(found.cameras, bound.cameras, strict=True):
        for name in ("normal_stddev_deg", "distance_stddev_m", "center_stddev_m"):
            values, limits = (
                np.ravel([getattr(one, name)]),
                np.ravel([getattr(best, name)]),
            )
            assert np.all(LEAST * limits <= values), name
            assert np.all(values <= MOST * limits), name
    assert (found.scale_stddev is None) == (bound.scale_stddev is None)
    if found.scale_stddev is not None:
        assert LEAST < found.scale_stddev / bound.scale_stddev < MOST
