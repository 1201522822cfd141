"""Measurements in a small dive that was solved, and was never written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from dense import small_scene
from sfm_scenes import model_of

from uwsfm import calibrate
from uwsfm.measuring.measure import (
    measure,
)
from uwsfm.results.folder import Result
from uwsfm.simulate.rigs import sample_rig


def small_result() -> Result:
    """A small dive, solved; its result was never written."""
    calibration = calibrate(small_scene(noise_px=0.3).scene, loss="l2")
    return Result(
        folder=Path("nowhere"),
        model=model_of(sample_rig(), calibration.scene),
        calibration=calibration,
        solved=calibration,
        summary={"verdict": "fits"},
        images=None,
        fingerprint="mark",
    )


def one(result, **content):
    (found,) = measure(result, {"version": 1, **content}).measurements
    return found


def clicked(result, point, offsets=0.0, images=None):
    """Clicks where a point of the model is projected, or off by so much."""
    scene = result.model.scene
    rows = np.flatnonzero(scene.point_idx == point)[:images]
    pixels = scene.projections()[0][rows] + offsets
    names = [
        f"{('left', 'right')[scene.camera_idx[i]]}/{scene.frame_idx[i]:04}.jpg"
        for i in rows
    ]
    return [{"image": n, "xy": p.tolist()} for n, p in zip(names, pixels, strict=True)]


def clicks_on(result, place):
    """Clicks on any place, in both images of two frames."""
    scene = result.model.scene
    seen = replace(
        scene,
        points=np.array([place]),
        camera_idx=np.array([0, 1, 0, 1]),
        frame_idx=np.array([0, 0, 1, 1]),
        point_idx=np.zeros(4, dtype=np.int64),
        xy=np.zeros((4, 2)),
    )
    pixels, valid = seen.projections()
    assert valid.all()
    names = [f"{side}/{f:04}.jpg" for f in (0, 1) for side in ("left", "right")]
    return [{"image": n, "xy": p.tolist()} for n, p in zip(names, pixels, strict=True)]
