"""Results made by hand, every number another one, and what was printed parsed back."""

import io
import math
import re
from typing import Any

from rich.console import Console
from rich.table import Table

SI = {"m": 1.0, "mm": 1e-3, "deg": math.pi / 180.0, "px": 1.0, "%": 1e-2, "": 1.0}
"""One of each printed unit."""
SI |= {"m2": 1.0, "cm2": 1e-4, "s": 1.0, "units": 1.0}

NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"


def numbers(text: str) -> list[float]:
    """Every number in a text."""
    return [float(found) for found in re.findall(NUMBER, text)]


def quantity(text: str) -> float:
    """The one number of a text, times the unit behind it."""
    found = re.fullmatch(rf"({NUMBER}) ?(\S*)", text.strip())
    assert found is not None, text
    return float(found[1]) * SI[found[2]]


def unit_in(heading: str) -> float:
    """What is in the brackets at the end of a heading: "distance (mm)"."""
    return SI[heading[heading.rindex("(") + 1 : heading.rindex(")")].split()[0]]


def printed(table: Table) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of a table as it stands on a wide terminal."""
    console = Console(width=400, record=True, file=io.StringIO())
    console.print(table)
    lines = console.export_text().splitlines()
    heads = [_cells(line, "┃") for line in lines if "┃" in line]
    rows = [_cells(line, "│") for line in lines if "│" in line]
    return [" ".join(parts).strip() for parts in zip(*heads, strict=True)], rows


def _cells(line: str, border: str) -> list[str]:
    return [cell.strip() for cell in line.strip(border).split(border)]


def slope(degrees: float) -> float:
    """Component of a unit vector that leans so much."""
    return math.sin(math.radians(degrees))


def flat_camera(name: str, start: float, **more: Any) -> dict[str, Any]:
    """The entry of a camera behind a flat port.

    Tilts of ``start`` and ``-start - 1`` degrees, a port ``start`` centimetres away,
    and deviations that are all other numbers.
    """
    x, y = slope(start), slope(-start - 1.0)
    return {
        "name": name,
        "port": "flat",
        "normal": [x, y, math.sqrt(1.0 - x * x - y * y)],
        "normal_stddev_deg": 0.163 + start,
        "normal_stddev_in_all_deg": 0.304 + start,
        "normal_verdict": "determined",
        "tilt_xy_stddev_deg": [0.111 * start, 0.122 * start],
        "tilt_xy_stddev_in_all_deg": [0.213 * start, 0.224 * start],
        "azimuth_deg": -56.31 - start,
        "azimuth_stddev_deg": 1.31 * start,
        "azimuth_stddev_in_all_deg": 1.42 * start,
        "tilt_deg": 3.61 + start,
        "tilt_stddev_deg": 0.15 * start,
        "tilt_stddev_in_all_deg": 0.26 * start,
        "distance_m": 0.01 * start + 0.00045,
        "distance_stddev_m": 0.00033 * start,
        "distance_stddev_in_all_m": 0.00077 * start,
        "distance_verdict": "weakly determined",
        "thickness_m": 0.0081 + 0.001 * start,
        "glass_index": 1.5168 + 0.001 * start,
        "water_index": 1.3391 + 0.001 * start,
        "cam_from_rig": placement(start),
        **more,
    }


def dome_camera(name: str, start: float) -> dict[str, Any]:
    """The entry of a camera behind a dome; no number is another one."""
    return {
        "name": name,
        "port": "dome",
        "center_m": [1e-3 * start, -2e-3 * start, 3e-3 * start],
        "center_stddev_m": [0.13e-3, 0.24e-3, 0.35e-3],
        "center_stddev_in_all_m": [0.46e-3, 0.57e-3, 0.68e-3],
        "center_verdict": "weakly determined",
        "radius_m": 0.0537,
        "thickness_m": 0.0062,
        "glass_index": 1.4917,
        "water_index": 1.3412,
        "cam_from_rig": placement(start),
    }


def placement(start: float) -> dict[str, Any]:
    """A turn of ``2 start`` degrees about x and 90 times less about nothing else."""
    half = math.radians(start)
    return {
        "rotation_xyzw": [math.sin(half), 0.0, 0.0, math.cos(half)],
        "translation_m": [-0.101 * start, 0.0023 * start, 0.0045 * start],
        "rotation_stddev_deg": 0.0123 * start,
        "rotation_stddev_in_all_deg": 0.0234 * start,
        "turn_xyz_stddev_deg": [0.0061 * start, 0.0072 * start, 0.0083 * start],
        "turn_xyz_stddev_in_all_deg": [0.0114 * start, 0.0135 * start, 0.0146 * start],
        "translation_stddev_m": [1.1e-5, 2.2e-4, 3.3e-3],
        "translation_stddev_in_all_m": [4.4e-5, 5.5e-4, 6.6e-3],
    }


def summary(**more: Any) -> dict[str, Any]:
    """A summary.json of two flat ports, a dome and a camera in a bare housing."""
    return {
        "verdict": "fits",
        "reasons": [],
        "explanations": [],
        "warnings": ["the port distance of left is weakly determined", "ask why?"],
        "num_frames": 41,
        "num_registered_frames": 37,
        "unregistered_frames": ["0003.jpg", "0011.jpg", "0012.jpg", "0040.jpg"],
        "num_points": 5208,
        "num_observations": 61234,
        "num_invalid": 7,
        "reprojection_rms_px": {"before": 4.567, "after": 0.543},
        "scale": {
            "verdict": "determined",
            "relative_stddev": 0.0012,
            "relative_stddev_in_all": 0.0034,
            "unit": "metre",
            "small_unit": "mm",
        },
        "baseline_m": 0.20215,
        "baseline_stddev_m": 0.00047,
        "known_lengths": [
            {"given_m": 0.5003, "stddev_m": 0.0004, "found_m": 0.4993},
            {"given_m": 2.314, "stddev_m": 0.013, "found_m": 2.353},
        ],
        "positions": {
            "num_positions": 35,
            "outliers": ["0007.jpg", "0009.jpg"],
            "rms_miss_m": 0.0314,
            "scatter": 1.27,
            "place_stddev_m": [0.011, 0.022, 0.033],
            "turn_stddev_deg": 0.58,
            "turn_axis": [0.0, 0.6, 0.8],
        },
        "refined": [
            {
                "name": "water index",
                "value": 1.3402,
                "stddev": 0.00031,
                "stddev_in_all": 0.00052,
            },
            {
                "name": "baseline of right (m)",
                "value": 0.20233,
                "stddev": 0.00021,
                "stddev_in_all": 0.00043,
            },
            {
                "name": "fx of left",
                "value": 1234.5,
                "stddev": 1.7,
                "stddev_in_all": 2.9,
            },
        ],
        "cameras": [
            flat_camera("left", 2.0),
            flat_camera("right", 4.0),
            dome_camera("nose", 7.0),
            {"name": "air", "port": "none", "cam_from_rig": placement(9.0)},
        ],
        "error_budget": [_budget_row(k) for k in range(3)] + [_budget_row(9)],
        "timings_s": {"features": 30.04, "matching": 60.06, "adjusting": 10.02},
        "steps_of_earlier_runs": ["features"],
        "versions": {"uwsfm": "9.8.7"},
        "solves": [
            _solve("cauchy", 70000, [9.0, 4.0]),
            _solve("l2", 61234, [3.0, 2.0]),
        ],
        "solver_converged": True,
        **more,
    }


def _solve(loss: str, count: int, costs: list[float]) -> dict[str, Any]:
    return {
        "error": "reprojection",
        "loss": loss,
        "num_observations": count,
        "costs": costs,
    }


def _budget_row(k: int) -> dict[str, Any]:
    far = 1.0 + k
    return {
        "if": "all of these together" if k == 9 else f"number {k}",
        "amount": "" if k == 9 else f"+0.1{k} mm",
        "deviation": (None if k == 9 else ("given", "assumed", "prior")[k]),
        "scale": -0.00123 * far,
        "cameras": [
            {
                "tilt_deg": 0.0123 * far + 0.01 * c,
                "distance_m": -0.000456 * far - 0.0001 * c,
                "center_m": [0.00011 * far, -0.00022 * far, 0.00033 * far],
                "rotation_deg": 0.5 * far,
                "lens": [],
            }
            for c in range(4)
        ],
    }
