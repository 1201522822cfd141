"""Residuals of a camera, made by hand."""

import numpy as np

from uwsfm.trust.residuals import CameraResiduals, Profile, Residuals


def residuals(rms, systematic, cells=0.2, radius=(0.1, -0.3), depth=(0.05, 0.02)):
    def profile(mean, spread):
        values = np.array([mean, np.nan])
        return Profile(
            name="near",
            span=(0.5, 1.5),
            at=np.array([10.0, 20.0]),
            mean_px=values,
            stderr_px=np.array([spread, np.nan]),
        )

    grid = np.full((3, 4, 2), np.nan)
    grid[0, 0] = (0.6 * cells, 0.8 * cells)  # as long as ``cells``
    return Residuals(
        cells_px=grid,
        by_radius=(profile(*radius[:1], 0.04), profile(radius[1], 0.05)),
        by_depth=(profile(depth[0], 0.01), profile(depth[1], 0.02)),
        rms_px=rms,
        systematic_px=systematic,
    )


def camera(name="left", **more):
    return CameraResiduals(
        **{
            "name": name,
            "size": (800, 600),
            "counts": np.full((3, 4), 9, dtype=np.int64),
            "refractive": residuals(0.456, 0.0314),
            "model": "OPENCV",
            "pinhole": residuals(1.234, 0.567, cells=0.5),
            "freed": None,
            "least_central_px": None,
            **more,
        }
    )
