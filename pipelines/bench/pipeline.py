"""Speed and memory of everything, beside the targets and the peers.

    python pipelines/bench/pipeline.py -o OUT [--small] [--refractive-colmap PATH]

OUT receives bench.json, results.md and pictures; OUT/work keeps the surveys and what
each section measured. Measure on a quiet machine: times are CPU times where that is
meant, but caches and memory are shared. With --only solver-500,demo other sections keep
what they measured before. --small has every section at a size that takes seconds: it
shows that the study runs, not how fast the package is.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import demo
import machine
import plots
import report
from child import call
from targets import outcomes

from uwsfm.results.summary import write_json

SIZES = (20, 100, 500, 2000, 5000)
SMALL_SIZES = (12, 20)
COLMAP_SIZES = (20, 100, 500)
MAX_TRIES = 2
"""The first may have to compile; without a cache, every one has."""

Sections = dict[str, Callable[[], Any]]


def main() -> None:
    options = parse()
    work: Path = options.out / "work"
    work.mkdir(parents=True, exist_ok=True)
    sections = all_sections(options)
    for name in options.only or sections:
        print(name, flush=True)
        write_json(machine.watched(sections[name]), work / f"{name}.json")
    results = measured(work, sections)
    results["targets"] = [{**asdict(o), "met": o.met} for o in outcomes(results)]
    write_json(results, options.out / "bench.json")
    plots.draw(results, options.out)
    text = report.markdown(results)
    (options.out / "results.md").write_text(text, encoding="utf-8")
    print(options.out / "results.md")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--small", action="store_true", help="seconds, for a check")
    parser.add_argument("--refractive-colmap", metavar="PATH", help="its binary")
    parser.add_argument("--only", default="", help="sections, separated by commas")
    options = parser.parse_args()
    options.only = options.only.split(",") if options.only else []
    known = all_sections(options)
    unknown = [name for name in options.only if name not in known]
    if unknown:
        parser.error(f"no section {unknown[0]}; there are {', '.join(known)}")
    binary = options.refractive_colmap
    if binary is not None and not Path(binary).is_file():
        parser.error(f"{binary} is no file")
    return options


def all_sections(options: argparse.Namespace) -> Sections:
    """What is measured, by name."""
    small, folder = options.small, str(options.out / "work")
    sizes = SMALL_SIZES if small else SIZES
    peers = SMALL_SIZES[:1] if small else COLMAP_SIZES
    sections: Sections = {
        "kernels": partial(
            call,
            "kernels",
            "measure",
            folder=folder,
            num_points=2_000 if small else 100_000,
            num_frames=sizes[0] if small else 100,
            passes=2 if small else 9,
        )
    }
    for size in sizes:
        sections[f"solver-{size}"] = partial(solve, size, sizes[0], folder)
    for size in peers:
        sections[f"colmap-{size}"] = partial(
            call, "peers", "pinhole_colmap", num_frames=size, folder=folder
        )
    sections[f"scipy-{sizes[0]}"] = partial(
        call,
        "peers",
        "least_squares_scipy",
        num_frames=sizes[0],
        folder=folder,
        steps=2 if small else 10,
    )
    if options.refractive_colmap:
        for size in peers:
            sections[f"refractive-colmap-{size}"] = partial(
                call,
                "peers",
                "refractive_colmap",
                num_frames=size,
                folder=folder,
                binary=options.refractive_colmap,
            )
    sections["demo"] = partial(demo.measure, small=small)
    if not small:  # both may have to compile everything
        sections["python-share"] = partial(
            call, "python_share", "measure", num_threads=2, num_frames=14
        )
        sections["first-run"] = demo.first_run
    return sections


def solve(num_frames: int, smallest: int, folder: str) -> dict[str, Any]:
    """One size; simulating and compiling are left to other processes, for memory."""
    for size in (num_frames, smallest):
        call("surveys", "make", num_frames=size, folder=folder)
    for _ in range(MAX_TRIES):
        found = call(
            "solver",
            "measure",
            num_threads=2,
            num_frames=num_frames,
            smallest=smallest,
            folder=folder,
        )
        if not found["compiled"]:
            break
    return found


def measured(work: Path, sections: Sections) -> dict[str, Any]:
    """Everything measured so far, in this run or before."""
    results: dict[str, Any] = {}
    for name in sections:
        path = work / f"{name}.json"
        if path.exists():
            results[name] = json.loads(path.read_text(encoding="utf-8"))
            results["machine"] = results[name].pop("machine")
    return results


if __name__ == "__main__":
    main()
