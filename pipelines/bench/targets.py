"""What was asked for, and what came out."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from peers import REFERENCE_US

QUIET = 0.2
"""Cores that other programs may use."""

Results = dict[str, Any]
"""By section, see `pipeline`; sections that were not measured are missing."""

KERNEL_NS = {
    "unproject": 25.0,
    "project": 20.0,
    "project + Jacobian": 45.0,
    "normal equations": 200.0,
    "trial cost": 30.0,
}


@dataclass(frozen=True, kw_only=True)
class Outcome:
    what: str
    target: float
    unit: str
    measured: float
    at_least: bool = False
    """The target is a lower bound; else an upper one."""
    note: str = ""

    @property
    def met(self) -> bool:
        if self.at_least:
            return self.measured >= self.target
        return self.measured <= self.target

    @property
    def headroom(self) -> float:
        """Above one: better than asked."""
        if self.at_least:
            return self.measured / self.target
        return self.target / self.measured


def outcomes(results: Results) -> list[Outcome]:
    found = [*_kernels(results), *_solver(results), *_growth(results)]
    return found + [*_peers(results), *_demo(results), *_python(results)]


def kernel_times(results: Results, kind: str, port: str, lens: str) -> dict[str, float]:
    """Nanoseconds by stage of one row."""
    rows = results["kernels"]["rows"]
    (times,) = [
        row["ns"]
        for row in rows
        if (row["kind"], row["port"], row["lens"]) == (kind, port, lens)
    ]
    return times


def _kernels(results: Results) -> Iterator[Outcome]:
    if "kernels" not in results:
        return
    flat = kernel_times(results, "lanes", "flat", "PINHOLE")
    for stage, limit in KERNEL_NS.items():
        yield Outcome(
            what=f"{stage}, flat port, one core",
            target=limit,
            unit="ns/observation",
            measured=flat[stage],
        )
    domes, lenses, own = [], [], []
    for row in results["kernels"]["rows"]:
        if row["kind"] != "lanes":
            continue
        for stage, limit in KERNEL_NS.items():
            time = row["ns"][stage]
            where = f"{stage}, {row['port']}, {row['lens']}: {time:.1f} ns"
            if row["port"].startswith("dome"):
                domes.append((time / flat[stage], where))
            elif row["lens"] not in ("PINHOLE", "SIMPLE_PINHOLE"):
                lenses.append((time / limit, where))
                own.append((time / flat[stage], where))
    for what, limit, ratios in (
        ("dome, worst stage, over the flat port", 3.0, domes),
        ("distorted lens, worst stage, over the limit above", 1.5, lenses),
        ("distorted lens, worst stage, over the pinhole measured", 1.5, own),
    ):
        ratio, where = max(ratios)
        yield Outcome(what=what, target=limit, unit="x", measured=ratio, note=where)


def _solver(results: Results) -> Iterator[Outcome]:
    for frames, seconds, memory in ((500, 0.35, 500.0), (5000, 4.0, 2000.0)):
        found = results.get(f"solver-{frames}")
        if found is None:
            continue
        one = found["one_thread"]
        name = f"{frames} frames, {found['observations'] / 1e6:.2f} M observations"
        yield Outcome(
            what=f"{name}: one iteration on one core",
            target=seconds,
            unit="s",
            measured=one["cpu_s"],
        )
        if frames == 500:
            yield Outcome(
                what=f"{name}: iterations",
                target=15,
                unit="",
                measured=one["iterations"],
                note=found["stop"],
            )
        yield Outcome(
            what=f"{name}: peak memory of the process",
            target=memory,
            unit="MB",
            measured=found["peak_mb"],
            note=f"{found['peak_before_mb']:.0f} MB before the solve",
        )
        if frames == 500:
            yield from _threads(found, name)


def _threads(found: dict[str, Any], name: str) -> Iterator[Outcome]:
    one = found["one_thread"]["stages_wall_s"]
    two = found["two_threads"]["stages_wall_s"]
    for stage in ("linearise", "eliminate points", "cost"):
        yield Outcome(
            what=f"{name}: two threads, {stage}",
            target=1.7,
            unit="x",
            measured=one[stage] / two[stage],
            at_least=True,
            note=disturbed(found),
        )


def disturbed(found: dict[str, Any]) -> str:
    """What to know of a time on the wall."""
    cores = found.get("others_cores", 0.0)
    return f"while others used {cores:.1f} cores" if cores > QUIET else ""


def solved_sizes(results: Results) -> list[dict[str, Any]]:
    """Solver sections, by rising size."""
    names = [name for name in results if name.startswith("solver-")]
    return sorted((results[name] for name in names), key=lambda one: one["frames"])


def _growth(results: Results) -> Iterator[Outcome]:
    for found in solved_sizes(results)[-1:]:
        frames, smallest = found["frames"], found["smallest"]
        complete = (smallest, frames) == (20, 5000)
        yield Outcome(
            what=f"cost per observation, {frames} over {smallest} frames",
            target=1.5,
            unit="x",
            measured=found["over_smallest"],
            note="taking turns" if complete else "not the sizes asked for",
        )


def _peers(results: Results) -> Iterator[Outcome]:
    for frames in (20, 100, 500):
        ours, peer = results.get(f"solver-{frames}"), results.get(f"colmap-{frames}")
        if peer:
            own = peer["ours_us_per_observation"]
            yield Outcome(
                what=f"{frames} frames: faster than COLMAP's pinhole adjustment",
                target=5.0,
                unit="x",
                measured=peer["us_per_observation"] / own,
                at_least=True,
                note=f"{peer['us_per_observation']:.2f} against {own:.2f} us "
                "per observation and iteration, taking turns",
            )
        peer = results.get(f"refractive-colmap-{frames}")
        if not ours:
            continue
        own = ours["one_thread"]["cpu_us_per_observation"]
        if peer and peer["refractive"]:
            theirs, source = peer["us_per_observation"], "measured in this run"
        elif frames == 500:
            theirs = REFERENCE_US["refractive, CPU"][0]
            source = "an older measurement on other scenes (see the README)"
        else:
            continue
        yield Outcome(
            what=f"{frames} frames: faster than Refractive COLMAP's adjustment",
            target=40.0,
            unit="x",
            measured=theirs / own,
            at_least=True,
            note=f"{theirs:.1f} us, {source}, against {own:.2f} us",
        )


def _demo(results: Results) -> Iterator[Outcome]:
    for name, key, what, limit in (
        ("demo", "wall_s", "`uwsfm demo`, warm", 60.0),
        (
            "demo",
            "second_start_s",
            "its second run, but for adjustment and report",
            2.0,
        ),
        ("first-run", "cold_compilation_s", "compilation in the first run", 20.0),
    ):
        found = results.get(name, {})
        if key in found:
            yield Outcome(
                what=what,
                target=limit,
                unit="s",
                measured=found[key],
                note=disturbed(found),
            )
    first = results.get("first-run", {})
    if "cold_over_warm" in first:
        yield Outcome(
            what="`uwsfm demo` without a cache, over one with it",
            target=1.9,
            unit="x",
            measured=first["cold_over_warm"],
            note=f"{first['cold_demo_s']:.0f} s and {first['warm_demo_s']:.0f} s, "
            "installed as a copy, in the source folder",
        )


def _python(results: Results) -> Iterator[Outcome]:
    found = results.get("python-share")
    if found is None:
        return
    together = found["python_s"] + found["opencv_s"]
    with_opencv = 100.0 * together / found["cpu_s"]
    yield Outcome(
        what="`uwsfm reconstruct`: CPU outside pycolmap, the kernels and OpenCV",
        target=10.0,
        unit="%",
        measured=100.0 * found["python_s"] / found["cpu_s"],
        note=f"{found['python_s']:.1f} of {found['cpu_s']:.1f} s, of which "
        f"{found['imports_s']:.1f} s import; {found['frames']} frames; with OpenCV's "
        f"own functions {with_opencv:.1f} %",
    )
