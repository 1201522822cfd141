"""What two runs of a survey say of each other and of the truth: numbers and tables."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array

RUNS = ("whole", "parts")
NAMES = {"whole": "one piece", "parts": "in parts"}
RESULT = "result.npz"


def in_stddevs(poses: Array, others: Array, covariances: Array) -> Array:
    """RMS over the six coordinates of each pose's difference, in its standard
    deviations (F - 1,), with the first pose in common."""
    first, second = (rigid3.compose(p, rigid3.inverse(p[:1])) for p in (poses, others))
    turns = rigid3.compose(first, rigid3.inverse(second))
    # Left tangent: x maps to Exp(w) (R x + t) + v.
    turned = rigid3.compose(
        np.concatenate([turns[:, :4], np.zeros((len(turns), 3))], axis=1), second
    )
    delta = np.concatenate(
        [rigid3.rotvec_from_quat(turns[:, :4]), first[:, 4:] - turned[:, 4:]], axis=1
    )[1:]
    inverses = np.linalg.inv(covariances[1:])
    return np.sqrt(np.einsum("fi,fij,fj->f", delta, inverses, delta) / 6.0)


def center_rms_mm(poses: Array, others: Array) -> float:
    first, second = (
        rigid3.inverse(rigid3.compose(p, rigid3.inverse(p[:1])))[:, 4:]
        for p in (poses, others)
    )
    return 1e3 * float(np.sqrt(np.mean(np.sum((first - second) ** 2, axis=1))))


def compared(folder: Path, truth: Array, runs: list[str]) -> dict[str, Any]:
    """All numbers of the tables.

    Args:
        folder: Holds a folder per run.
        truth: (F, 7)
        runs: Of `RUNS`.
    """
    found: dict[str, Any] = {"num_frames": len(truth)}
    results = {}
    for name in runs:
        with np.load(folder / name / RESULT) as stored:
            results[name] = {key: stored[key] for key in stored.files}
    for name, result in results.items():
        true = truth[result["frames"]]
        apart = in_stddevs(result["poses"], true, result["covariances"])
        found[name] = {
            **json.loads(str(result["report"])),
            "truth_stddevs": float(np.sqrt(np.mean(apart**2))),
            "center_rms_mm": center_rms_mm(result["poses"], true),
        }
    if len(results) == 2:
        one, two = results["whole"], results["parts"]
        _, *rows = np.intersect1d(one["frames"], two["frames"], return_indices=True)
        apart = in_stddevs(
            one["poses"][rows[0]], two["poses"][rows[1]], one["covariances"][rows[0]]
        )
        moved = (one["ports"] - two["ports"])[:, 3] / one["port_stddevs"][:, 1]
        found["apart"] = {
            "rms_stddevs": float(np.sqrt(np.mean(apart**2))),
            "max_stddevs": float(apart.max()),
            "center_rms_mm": center_rms_mm(
                one["poses"][rows[0]], two["poses"][rows[1]]
            ),
            "port_distances_stddevs": moved.tolist(),
        }
    return found


COLUMNS = (
    "frames",
    "mapped",
    "registered",
    "parts",
    "verifying, s",
    "parts, s",
    "mapping or merging, s",
    "adjustment, s",
    "peak, MB",
    "observations",
    "centres, mm",
    "from the truth, standard deviations",
)


def rows_of(found: dict[str, Any]) -> list[str]:
    rows = []
    for name in RUNS:
        if name not in found:
            continue
        run, times = found[name], found[name]["timings_s"]
        sizes = (run["submaps"] or {}).get("num_frames", [])
        parts = f"{len(sizes)} of {min(sizes)} to {max(sizes)}" if sizes else "-"
        cells = [
            f"{found['num_frames']}",
            NAMES[name],
            f"{run['num_registered']}",
            parts,
            f"{times['verification']:.0f}",
            f"{times['submaps']:.0f}" if sizes else "-",
            f"{times['mapping']:.0f}",
            f"{times['adjustment']:.0f}",
            f"{run['peak_mb']:.0f}",
            f"{run['num_observations']}",
            f"{run['center_rms_mm']:.2f}",
            f"{run['truth_stddevs']:.2f}",
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def apart_rows(found: dict[str, Any]) -> list[str]:
    if "apart" not in found:
        return []
    apart = found["apart"]
    ports = ", ".join(f"{value:+.4f}" for value in apart["port_distances_stddevs"])
    return [
        f"| {found['num_frames']} | {apart['rms_stddevs']:.4f} | "
        f"{apart['max_stddevs']:.4f} | {apart['center_rms_mm']:.4f} | {ports} |"
    ]


def page(out: Path) -> str:
    """The tables of all surveys in a folder."""
    paths = sorted(out.glob("lawn_mower_*.json"), key=lambda p: (len(p.name), p.name))
    found = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    table = [f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|"]
    table += [row for each in found for row in rows_of(each)]
    apart = [f"| {' | '.join(APART)} |", "|---" * len(APART) + "|"]
    apart += [row for each in found for row in apart_rows(each)]
    return "\n".join([HEADER, "", *table, "", APART_HEADER, "", *apart, ""])


APART = ("frames", "poses, RMS", "worst pose", "centres, mm RMS", "port distances")
HEADER = """# Surveys in parts and in one piece

Made by `pipelines/surveys/lawn_mower.py`; see [README.md](../README.md)."""
APART_HEADER = (
    """The two runs from each other, in standard deviations of the single run:"""
)
