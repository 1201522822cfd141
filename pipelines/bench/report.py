"""The results as Markdown."""

from typing import Any

from kernels import STAGES as KERNEL_STAGES
from solver import STAGES as SOLVER_STAGES
from targets import QUIET, Results, outcomes, solved_sizes


def markdown(results: Results) -> str:
    parts = [_machine(results), _targets(results), _kernels(results)]
    parts += [_solver(results), _peers(results), _demo(results)]
    return "\n\n".join(part for part in parts if part) + "\n"


def table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _machine(results: Results) -> str:
    found = results["machine"]
    versions = ", ".join(f"{k} {v}" for k, v in found["versions"].items())
    text = (
        f"Machine: {found['cpu']}; {found['cores']} cores, {found['memory_gb']} GB, "
        f"{found['system']}. {versions}."
    )
    loud = [
        f"{name} ({one['others_cores']:.1f})"
        for name, one in results.items()
        if isinstance(one, dict) and one.get("others_cores", 0.0) > QUIET
    ]
    if loud:
        text += (
            "\n\n**The machine was not quiet**: cores that other programs used "
            f"meanwhile: {', '.join(loud)}. Wall times, and the ratios of threads, are "
            "worse than on an idle machine."
        )
    return text


def _targets(results: Results) -> str:
    rows = []
    for one in outcomes(results):
        sign = ">=" if one.at_least else "<="
        rows.append(
            [
                one.what,
                f"{sign} {one.target:g} {one.unit}".strip(),
                f"{one.measured:.3g} {one.unit}".strip(),
                "yes" if one.met else "**no**",
                f"{one.headroom:.2f}",
                one.note,
            ]
        )
    header = ["what", "target", "measured", "met", "times better than asked", "note"]
    text = "## Targets"
    missing = [name for name in TARGETED if name not in results]
    if "wall_s" not in results.get("demo", {}):  # --small times its imports alone
        missing.append("demo")
    if missing:
        text += "\n\nNot measured here, so without their rows: "
        text += ", ".join(missing) + "."
    return text + ("\n\n" + table(header, rows) if rows else "")


TARGETED = [
    "kernels",
    *(f"solver-{size}" for size in (20, 100, 500, 5000)),
    *(f"colmap-{size}" for size in (20, 100, 500)),
    "python-share",
    "first-run",
]
"""Sections that targets are of; and `demo`."""


def _kernels(results: Results) -> str:
    if "kernels" not in results:
        return ""
    rows = results["kernels"]["rows"]
    base = next(
        row["ns"] for row in rows if (row["port"], row["lens"]) == ("flat", "PINHOLE")
    )
    lines = []
    for row in rows:
        cells = [
            f"{row['ns'][stage]:.1f} ({row['ns'][stage] / base[stage]:.2f})"
            if stage in row["ns"]
            else "-"
            for stage in KERNEL_STAGES
        ]
        lines.append([row["kind"], row["port"], row["lens"], *cells])
    return (
        "## Kernels\n\n"
        "Nanoseconds per observation on one core, and in parentheses the ratio to the "
        "first row. The scalar rows of the normal equations have residuals and "
        "Jacobians but no sums; the Jacobian in numpy has the point's columns only.\n\n"
        + table(["", "port", "lens", *KERNEL_STAGES], lines)
        + "\n\n![kernels](kernels.png)"
    )


def _solver(results: Results) -> str:
    sizes = solved_sizes(results)
    if not sizes:
        return ""
    lines, speed = [], []
    for one in sizes:
        single, double = one["one_thread"], one["two_threads"]
        lines.append(
            [
                f"{one['frames']}",
                f"{one['points']:,}",
                f"{one['observations']:,}",
                f"{single['iterations']}",
                f"{1e3 * one['setup_s']:.0f}",
                f"{1e3 * single['cpu_s']:.1f}",
                f"{single['cpu_us_per_observation']:.3f}",
                f"{one['over_smallest']:.2f}",
                f"{single['iterations'] * single['cpu_s']:.2f}",
                *(f"{1e3 * single['stages_cpu_s'][s]:.1f}" for s in SOLVER_STAGES),
                f"{one['peak_mb']:.0f} ({one['peak_before_mb']:.0f})",
            ]
        )
        whole = single["wall_s"] / double["wall_s"]
        ratios = [
            _ratio(single["stages_wall_s"][s], double["stages_wall_s"][s])
            for s in SOLVER_STAGES
        ]
        speed.append([f"{one['frames']}", f"{whole:.2f}", *ratios])
    over = f"over {sizes[0]['smallest']}"
    header = ["frames", "points", "observations", "iterations", "set-up"]
    header += ["iteration", "us/observation", over, "all, s"]
    said = sorted({line for one in sizes for line in one["log"]})
    return "\n\n".join(
        [
            "## Solver",
            "CPU milliseconds on one core: of the set-up (observations sorted, "
            "structure found), and of one iteration, whole and by stage; seconds of "
            "all; peak memory of the process in MB (and before the solve). "
            f'"{over}" is the cost per observation and iteration over that of the '
            "smallest survey, whose solves took turns with this one's iterations: the "
            "lines were measured one after another, at speeds that may differ.",
            table([*header, *SOLVER_STAGES, "MB"], lines),
            *(["The solver's own words: " + "; ".join(said) + "."] if said else []),
            "![time per observation](solver.png) ![memory](memory.png)",
            "Two threads over one, on the wall:",
            table(["frames", "whole", *SOLVER_STAGES], speed),
        ]
    )


def _ratio(one: float, two: float) -> str:
    return f"{one / two:.2f}" if two > 0.0 else "-"


def _peers(results: Results) -> str:
    lines = []
    for name, found in results.items():
        peer, _, frames = name.rpartition("-")
        if peer not in PEERS:
            continue
        what = PEERS[peer]
        if peer == "refractive-colmap" and not found["refractive"]:
            what += " (its command has no refraction: pinholes)"
        own = results.get(f"solver-{frames}")
        lines.append([frames, what, *_peer_cells(found, own)])
    if not lines:
        return ""
    lines.sort(key=lambda line: int(line[0]))
    header = ["frames", "peer", "us", "ours, us", "ratio", "with set-up"]
    header += ["rms, px", "ours, px", "MB", "ours, MB"]
    text = "CPU per observation and iteration on one thread, of the iterations alone, "
    text += "and the ratio with the set-up of the problem spread over them; the error "
    text += "where each stopped; peak memory of the process. COLMAP's pinholes took "
    text += "turns with ours."
    if not any(name.startswith("refractive-colmap") for name in results):
        text += " No binary of Refractive COLMAP was given: its 18 us in the table of "
        text += "targets are of an older measurement, see the README."
    return "## Peers\n\n" + text + "\n\n" + table(header, lines)


PEERS = {
    "colmap": "COLMAP, pinholes without water",
    "scipy": "scipy.optimize.least_squares, this package's residuals",
    "refractive-colmap": "Refractive COLMAP",
}


def _peer_cells(found: dict[str, Any], own: dict[str, Any] | None) -> list[str]:
    theirs, whole = found["us_per_observation"], found.get("whole_us_per_observation")
    rms = f"{found['rms_px']:.3f}" if "rms_px" in found else "-"
    memory = f"{found['peak_mb']:.0f}" if "peak_mb" in found else "-"
    if own is None:
        return [f"{theirs:.2f}", "-", "-", "-", rms, "-", memory, "-"]
    single = own["one_thread"]
    ours = found.get("ours_us_per_observation", single["cpu_us_per_observation"])
    setup = 1e6 * own["setup_s"] / single["iterations"] / own["observations"]
    return [
        f"{theirs:.2f}",
        f"{ours:.3f}",
        f"{theirs / ours:.1f}",
        f"{whole / (ours + setup):.1f}" if whole else "-",
        rms,
        f"{own['rms_px']:.3f}",
        memory,
        f"{own['peak_mb']:.0f}",
    ]


def _demo(results: Results) -> str:
    found = results.get("demo")
    if found is None or "wall_s" not in found:
        return ""
    total = found["wall_s"]
    stages = dict(found["stages_s"])
    stages["imports, evaluation and the rest"] = total - sum(stages.values())
    lines = [[k, f"{v:.2f}", f"{100 * v / total:.0f} %"] for k, v in stages.items()]
    lines.append(["whole", f"{total:.2f}", "100 %"])
    return (
        "## `uwsfm demo`\n\nWarm, seconds on the wall with all cores "
        f"({found['cpu_s']:.0f} s of CPU); a second run in the same folder takes "
        f"{found['second_run_s']:.1f} s, of which {found['second_start_s']:.1f} s are "
        "not its adjustment, export and report.\n\n"
        + table(["stage", "s", "share"], lines)
    )
