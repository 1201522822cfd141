"""The report's pictures: what is drawn where, and what its labels call it."""

import numpy as np
import pytest
from hand_made import summary
from hand_made_residuals import camera
from report_pages import model_that_misses, report_of

from uwsfm.report.page import scales_of
from uwsfm.report.pictures import (
    _cloud_figure,
    _convergence_figure,
    _coverage_figure,
    _halves_figure,
    _residual_figure,
)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    return report_of(model_that_misses(), tmp_path_factory.mktemp("dive") / "out")


def test_residuals_are_drawn_as_the_model_that_left_them():
    one = camera()
    figure = _residual_figure(one, "m", scales_of([one]))
    maps = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in maps] == [
        "left, best pinhole: 1.234 px RMS, systematic 0.567",
        "left, uwsfm: 0.456 px RMS, systematic 0.031",
    ]
    for axes, model in zip(maps, (one.pinhole, one.refractive), strict=True):
        (image,) = axes.images
        lengths = np.linalg.norm(model.cells_px, axis=2)
        np.testing.assert_allclose(image.get_array().filled(np.nan), lengths)
        assert image.get_extent() == [0.0, 800, 600, 0.0]
        assert image.get_clim() == pytest.approx((0.0, 0.485))
        (arrows,) = [c for c in axes.collections if hasattr(c, "U")]
        # Cells of 200 px: the first arrow stands in the middle of its own.
        assert (arrows.X[0], arrows.Y[0]) == (100.0, 100.0)
        assert (arrows.U[0], arrows.V[0]) == pytest.approx(tuple(model.cells_px[0, 0]))
        assert arrows.scale == pytest.approx(1.0 / 300.0) and arrows.angles == "xy"
    curves = [axes for axes in figure.axes if axes.get_ylabel() == "along radius (px)"]
    labels = [axes.get_xlabel() for axes in curves]
    assert labels == ["radius (px)", "radius (px)", "depth (m)", "depth (m)"]
    limit = 1.1 * 0.35
    for axes, profile in zip(
        (curves[1], curves[3]),
        (one.refractive.by_radius[0], one.refractive.by_depth[0]),
        strict=True,
    ):
        line = axes.containers[0].lines[0]
        assert line.get_xdata()[0] == profile.at[0]
        assert line.get_ydata()[0] == profile.mean_px[0]
        assert axes.get_ylim() == pytest.approx((-limit, limit))
        low, high = axes.containers[0].lines[2][0].get_segments()[0][:, 1]
        assert high - low == pytest.approx(2.0 * profile.stderr_px[0])
    alone = _residual_figure(camera(pinhole=None), "units", scales_of([one]))
    assert [a.get_title()[:11] for a in alone.axes if a.get_title()] == ["left, uwsfm"]
    assert "depth (units)" in [a.get_xlabel() for a in alone.axes]


def test_coverage_is_of_the_camera_above_it(report):
    figure = _coverage_figure(report)
    titled = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in titled] == ["left", "right"]
    for axes, found in zip(titled, report.residuals, strict=True):
        np.testing.assert_array_equal(axes.images[0].get_array(), found.counts)
        assert axes.images[0].get_extent() == [0.0, 800, 600, 0.0]


def test_halves_are_drawn_by_camera(report):
    drawn = {"halves": [[[0.1, None]], [[0.3, 0.4]]], "halves_limit": 0.37}
    titled = [a for a in _halves_figure(report, drawn).axes if a.get_title()]
    assert [a.get_title() for a in titled] == [
        "left: projections of two halves",
        "right: projections of two halves",
    ]
    np.testing.assert_allclose(titled[1].images[0].get_array(), [[0.3, 0.4]])
    assert titled[0].images[0].get_clim() == (0.0, 0.37)
    assert [titled[0].get_xlabel(), titled[0].get_ylabel()] == ["x (px)", "y (px)"]


def test_costs_are_roots_per_observation_one_solve_after_another():
    """Costs of 9 and 4 of 70000 observations, then 3 and 2 of 61234."""
    (axes,) = _convergence_figure(summary()).axes
    robust, last = axes.lines
    np.testing.assert_allclose(robust.get_ydata(), np.sqrt([18 / 70000, 8 / 70000]))
    np.testing.assert_allclose(last.get_ydata(), np.sqrt([6 / 61234, 4 / 61234]))
    assert robust.get_xdata().tolist() == [0, 1] and last.get_xdata().tolist() == [2, 3]
    assert [line.get_label() for line in (robust, last)] == ["cauchy", "l2"]
    assert robust.get_color() != last.get_color()
    assert axes.get_ylabel() == "cost (px)" and axes.get_yscale() == "log"


def test_the_cloud_is_seen_along_the_line_of_sight_and_from_above(report):
    """As the cameras see it: their right is right, and the top of the images up."""
    view = report.view
    along, above = _cloud_figure(report).axes
    assert along.get_title() == "along the line of sight"
    assert above.get_title() == "from above the images"
    assert along.get_xlabel() == above.get_xlabel() == "m"
    right = np.cross(view.sight, view.up)
    right /= np.linalg.norm(right)
    up = np.cross(right, view.sight)
    for axes, across in ((along, up), (above, -view.sight)):
        drawn = axes.collections[0].get_offsets()
        np.testing.assert_allclose(drawn[:, 0], view.points @ right)
        np.testing.assert_allclose(drawn[:, 1], view.points @ across)
        centers = axes.lines[-1].get_xydata()
        np.testing.assert_allclose(centers[:, 1], view.trajectory @ across)
        assert len(axes.lines) == 3  # two cameras and the way
