"""Standard deviations on real images: do disjoint sets of one dive differ as predicted?

    python pipelines/trust/z_scores.py DATA -o OUT

DATA is the folder that holds uril_tank/ and coral_tg5/ (see their pipelines), or one of
them. Each is reconstructed once, with the choices of its own pipeline. Then its frames
are dealt into disjoint sets, each set is adjusted alone, and each pair of sets gives,
for every tilt, distance and lens parameter, a z: their difference over its predicted
standard deviation. The RMS of z should be 1.

"Images" predicts from what the images leave over. "In all" adds what errors of given
numbers do: all sets share the lens as it was calibrated in air, but not what it does
to their ports, for they see different scenes.
"""

import argparse
import importlib.util
from collections.abc import Iterator, Sequence
from dataclasses import fields, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

import uwsfm
from uwsfm.calibration.result import CalibrationResult
from uwsfm.cli.console import ProgressBars
from uwsfm.scene import IndexArray
from uwsfm.trust.halves import adjusted_alone
from uwsfm.trust.shared_numbers import SharedNumber, shared_numbers

PIPELINES = Path(__file__).resolve().parent.parent
NUM_DEALS = 16
"""Random ways to deal the frames."""
GROUPS = ("tilt", "distance", "lens")


def loaded(script: str) -> Any:
    """A module of another pipeline: two of them have the same name."""
    path = PIPELINES / script
    spec = importlib.util.spec_from_file_location(
        f"{path.parent.name}_{path.stem}", path
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def tank(data: Path, out: Path) -> uwsfm.Result:
    """Covered lens, rig held: the recommended variant of pipelines/uril_tank."""
    write_rig = loaded("uril_tank/tank_rig.py").write_rig
    write_rig(data / "uril_tank", out / "tank.yaml", whole_image=False, free_rig=False)
    return reconstructed(out / "tank.yaml", data / "uril_tank", out / "tank")


def coral(data: Path, out: Path) -> uwsfm.Result:
    """One camera, lens and window refined within what is known of them."""
    pipeline = loaded("coral_tg5/pipeline.py")
    pipeline.write_rig(data / "coral_tg5", out / "coral.yaml")
    return reconstructed(
        out / "coral.yaml",
        data,
        out / "coral",
        scene_distance_m=pipeline.SCENE_DISTANCE_M,
        **pipeline.REFINE,
        **pipeline.KNOWN,
    )


def reconstructed(rig: Path, images: Path, out: Path, **options: Any) -> uwsfm.Result:
    """The result of a folder, which the next call finds again."""
    if not (out / "summary.json").is_file():
        with ProgressBars() as progress:
            uwsfm.reconstruct(
                rig, images, out, report=False, progress=progress, **options
            )
    return uwsfm.open_result(out)


def dealt(num_frames: int, num_sets: int, rng: np.random.Generator | None) -> Any:
    """Disjoint sets of frames: every num_sets-th, or at random."""
    order = np.arange(num_frames) if rng is None else rng.permutation(num_frames)
    return [np.sort(order[k::num_sets]) for k in range(num_sets)]


LENS_FREE = {
    "refine_cam_from_rig": True,
    "refine_focal": True,
    "refine_principal_point": True,
    "refine_distortion": True,
    "focal_stddev": 5e-3,
    "principal_point_stddev_px": 3.0,
    "distortion_stddev": 0.02,
}
"""About as far as two calibrations of the tank's lenses in air are apart."""


def with_own_lens(result: uwsfm.Result) -> CalibrationResult:
    """Lens and placement refined on all frames, then held as they were before."""
    whole = result.calibration
    given = {f.name: getattr(whole.options, f.name) for f in fields(whole.options)}
    refined = uwsfm.calibrate(whole.scene, **{**given, **LENS_FREE})
    scene, _ = refined.scene.select(refined.inliers)
    everything = np.ones(scene.num_observations, dtype=bool)
    return replace(refined, scene=scene, inliers=everything, options=whole.options)


def differences(
    whole: CalibrationResult, names: Sequence[str], sets: Sequence[IndexArray]
) -> Iterator[SharedNumber]:
    """Of all pairs of sets, what is judged here."""
    found = [adjusted_alone(whole.scene, frames, whole).calibration for frames in sets]
    for first, second in combinations(found, 2):
        for number in shared_numbers(first, second, names).numbers:
            if number.group in GROUPS:
                yield number


def table(
    title: str, whole: CalibrationResult, names: Sequence[str], num_sets: int
) -> list[str]:
    """Markdown: RMS of z per number, of interleaved sets and over random deals."""
    num_frames = whole.scene.num_frames
    rng = np.random.default_rng(0)
    deals = {
        "interleaved": [dealt(num_frames, num_sets, None)],
        f"{NUM_DEALS} random deals": [
            dealt(num_frames, num_sets, rng) for _ in range(NUM_DEALS)
        ],
    }
    columns: dict[str, dict[str, float]] = {}
    sizes: dict[str, float] = {}
    for name, ways in deals.items():
        numbers = [n for sets in ways for n in differences(whole, names, sets)]
        for column in ("images", "in all"):
            attribute = "z" if column == "images" else "z_in_all"
            by_name: dict[str, list[float]] = {}
            for number in numbers:
                value = getattr(number, attribute)
                by_name.setdefault(_label(number), []).append(value)
            columns[f"{name}: {column}"] = {
                key: float(np.sqrt(np.mean(np.square(z)))) for key, z in by_name.items()
            }
        for number in numbers:
            sizes.setdefault(_label(number), number.stddev / np.sqrt(2.0))
    lines = [
        f"### {title}",
        "",
        f"| RMS of z | {' | '.join(columns)} |",
        "|---" * (1 + len(columns)) + "|",
    ]
    for key in sizes:
        cells = [f"{values[key]:.2f}" for values in columns.values()]
        lines.append(f"| {key} | {' | '.join(cells)} |")
    medians = [f"**{np.median([*v.values()]):.2f}**" for v in columns.values()]
    return [*lines, f"| median | {' | '.join(medians)} |", ""]


def _label(number: SharedNumber) -> str:
    return f"{number.name} ({number.unit})" if number.unit else number.name


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, required=True)
    options = parser.parse_args()
    data, out = options.data.resolve(), options.out
    out.mkdir(parents=True, exist_ok=True)
    lines: list[str] = []
    if (data / "uril_tank").is_dir():
        in_tank = tank(data, out)
        sides, found = ("left", "right"), in_tank.calibration
        lines += table("Tank, 24 pairs: disjoint sixths (4 pairs)", found, sides, 6)
        lines += table("Tank: disjoint thirds (8 pairs)", found, sides, 3)
        title = "Tank, lens and placement refined on all pairs, then held: disjoint "
        found = with_own_lens(in_tank)
        lines += table(f"{title}sixths", found, sides, 6)
        lines += table(f"{title}thirds", found, sides, 3)
    if (data / "coral_tg5").is_dir():
        found = coral(data, out).calibration
        title = "Coral, 42 photographs: disjoint thirds (14)"
        lines += table(title, found, ("TG-5",), 3)
    if not lines:
        parser.error(f"{data} holds neither uril_tank/ nor coral_tg5/")
    text = "\n".join(lines)
    (out / "z_scores.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
