"""Pictures of the results."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from kernels import STAGES as KERNEL_STAGES
from solver import STAGES as SOLVER_STAGES
from targets import KERNEL_NS, Results, solved_sizes

DPI = 80


def draw(results: Results, out: Path) -> None:
    if "kernels" in results:
        _kernels(results, out / "kernels.png")
    if len(solved_sizes(results)) > 1:
        _solver(results, out / "solver.png")
        _memory(results, out / "memory.png")


def _save(figure: plt.Figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def _kernels(results: Results, path: Path) -> None:
    """Bars of the flat port's three implementations and of the worst dome."""
    wanted = [("lanes", "flat"), ("scalar", "flat"), ("numpy", "flat")]
    wanted += [("lanes", "dome, 34 mm off"), ("scalar", "dome, 34 mm off")]
    rows = {
        (row["kind"], row["port"]): row["ns"]
        for row in results["kernels"]["rows"]
        if row["lens"] == "PINHOLE"
    }
    figure, axes = plt.subplots(figsize=(8, 4))
    places = np.arange(len(KERNEL_STAGES))
    for k, key in enumerate(wanted):
        values = [rows[key].get(stage, np.nan) for stage in KERNEL_STAGES]
        label = f"{key[0]}, {key[1]}"
        axes.bar(places + 0.16 * (k - 2), values, 0.15, label=label)
    for place, stage in zip(places, KERNEL_STAGES, strict=True):
        axes.hlines(KERNEL_NS[stage], place - 0.42, place + 0.42, "k", "dashed")
    axes.set_yscale("log")
    axes.set_ylabel("ns per observation, one core")
    axes.set_xticks(places, KERNEL_STAGES)
    figure.legend(fontsize="small", ncols=len(wanted), loc="upper center")
    axes.set_title("\ndashed: target", fontsize="small")
    _save(figure, path)


def _solver(results: Results, path: Path) -> None:
    """Time per observation against the size, split by stage; and the peer.

    Only what took turns is compared: each size with the smallest, the peer with ours.
    """
    sizes = solved_sizes(results)
    frames = [one["frames"] for one in sizes]
    base = _us(sizes[0]) / sizes[0]["over_smallest"]
    total = np.array([base * one["over_smallest"] for one in sizes])
    shares = [
        [one["one_thread"]["stages_cpu_s"][stage] for one in sizes]
        for stage in SOLVER_STAGES
    ]
    parts = total * np.array(shares) / np.sum(shares, axis=0)
    figure, axes = plt.subplots(figsize=(9, 4))
    axes.stackplot(frames, parts, labels=SOLVER_STAGES, alpha=0.8)
    axes.plot(frames, total, "k.-", label="all")
    smallest = sizes[0]["smallest"]
    axes.axhline(1.5 * base, color="k", ls="--", label=f"1.5 x {smallest} frames")
    peers = [
        (
            one["frames"],
            us * found["us_per_observation"] / found["ours_us_per_observation"],
        )
        for one, us in zip(sizes, total, strict=True)
        if (found := results.get(f"colmap-{one['frames']}"))
    ]
    if peers:
        axes.plot(*zip(*peers, strict=True), "rs-", label="COLMAP, pinholes")
    axes.set_xscale("log")
    axes.set_xticks(frames, [f"{count}" for count in frames])
    axes.minorticks_off()
    axes.set_xlabel("frames of two cameras")
    axes.set_ylabel("us of CPU per observation and iteration")
    axes.set_title(results["machine"]["cpu"], fontsize="small")
    axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    _save(figure, path)


def _us(one: dict[str, Any]) -> float:
    return float(one["one_thread"]["cpu_us_per_observation"])


def _memory(results: Results, path: Path) -> None:
    sizes = solved_sizes(results)
    figure, axes = plt.subplots(figsize=(5, 4))
    frames = [one["frames"] for one in sizes]
    axes.loglog(frames, [one["peak_mb"] for one in sizes], "k.-", label="peak")
    before = [one["peak_before_mb"] for one in sizes]
    axes.loglog(frames, before, "k.:", label="before the solve")
    axes.plot([500, 5000], [500, 2000], "r_", ms=20, label="target")
    axes.set_xlabel("frames of two cameras")
    axes.set_ylabel("memory of the process, MB")
    axes.legend(fontsize="small")
    _save(figure, path)
