"""Clouds against exact surfaces: accuracy, completeness and F1, as ETH3D has them.

    python pipelines/inspection/clouds.py -o OUT [--also NAME SCENE CLOUD SPARSE ...]

OUT is that of pipeline.py; what is there is not made again. The scenes are its reef
and its near dive, as a stereo rig and as the left camera alone. ``--also`` scores
another program's cloud (a PLY) of the same images; SPARSE is its COLMAP model. Image
centres place a cloud on the truth, with a scale, and from there it moves to where it
fits the surface best: a pinhole has its centre elsewhere than the camera.

Tolerances are for a metre: they grow with the distance from the nearest camera.
Pictures of the clouds from above, beside each other, go into OUT.
*Off / sd*: median distance from the surface over the deviation that the cloud gives
each point, of what normal errors would have: one where it is right, less where sights
meet the surface at a slant.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from pipeline import dense, reconstructed
from reef import floor_of, reef_spec
from scipy.spatial import cKDTree

import uwsfm
from uwsfm._base.packages import import_package
from uwsfm.cli.console import ProgressBars
from uwsfm.colmap.model import Model
from uwsfm.dense.depth_map import pixel_rows
from uwsfm.geometry import rigid3
from uwsfm.geometry.alignment import Similarity, align
from uwsfm.geometry.rigid3 import Array
from uwsfm.rig.file import dump_rig, load_rig
from uwsfm.simulate.rigs import known_cam_from_rig
from uwsfm.simulate.sequence import (
    SequenceSpec,
    frame_names,
    near_spec,
    render_sequence,
)

TOLERANCES_MM = (1.0, 2.0, 5.0)
"""At a metre from the nearest camera."""
CELL_M = 0.006
"""Of the picture."""
NUM_FITTED, FIT_ROUNDS = 20_000, 30
NORMAL_MEDIAN = 0.6745
"""Of the absolute value of a normal variable, in standard deviations."""
STEP = 2
"""Of the pixels whose rays sample the surface."""
MIN_VIEWS = 2
"""Images that must see a place: one alone tells no depth."""
CELL_SHARE = 0.5
"""Side of the cells in which points count once, of the smallest tolerance."""
HIDDEN_M = 0.005
"""What a ray hits so much before a place hides it."""
MATCHERS = ("stereo", "patchmatch")
"""Of a rig, all; of one camera the last."""
SPECS = {"reef": reef_spec, "near": near_spec}
ONE = "one"
"""Suffix of a scene of which the left camera alone is used."""


@dataclass(frozen=True)
class Surface:
    """The true surface, as far as two images see it."""

    floor: Any
    """Open3D's scene, which knows what of the surface is nearest."""
    places: Array
    """(N, 3) in the world of the truth, one per cell."""
    reach: Array
    """(N,) distance of each to the nearest camera that sees it."""
    cell: float


@dataclass(frozen=True)
class Scores:
    """Of one cloud, per tolerance, shares."""

    num_points: int
    accuracy: tuple[float, ...]
    completeness: tuple[float, ...]
    off_over_stddev: float | None
    """Median, of its expectation; None: the cloud has no deviations."""

    def row(self, scene: str, name: str) -> str:
        cells = []
        for a, c in zip(self.accuracy, self.completeness, strict=True):
            f1 = 2.0 * a * c / max(a + c, 1e-12)
            cells.append(f"{1e2 * a:.1f} | {1e2 * c:.1f} | **{1e2 * f1:.1f}**")
        ratio = self.off_over_stddev
        cells.append("-" if ratio is None else f"{ratio:.2f}")
        return f"| {scene} | {name} | {self.num_points} | {' | '.join(cells)} |"


def surface_of(spec: SequenceSpec, cameras: int) -> Surface:
    """The surface that the first cameras of a rig see, sampled by their rays."""
    floor = floor_of(spec)
    poses = [
        (lens, rigid3.compose(placed, rig_from_world))
        for rig_from_world in np.asarray(spec.rig_from_world)
        for lens, placed in list(
            zip(
                spec.rig.refractive_cameras(), known_cam_from_rig(spec.rig), strict=True
            )
        )[:cameras]
    ]
    found = []
    for lens, pose in poses:
        rays = lens.ray_from_img(pixel_rows(lens, 0, lens.height, STEP))
        back = rigid3.inverse(pose)
        origins, dirs = rigid3.transform(back, rays[0]), rigid3.rotate(back, rays[1])
        hit = floor.cast(origins, dirs).distance.astype(np.float64)
        known = np.isfinite(hit)
        found.append((origins + hit[:, None] * dirs)[known])
    nearest = min(
        float(np.linalg.norm(each - rigid3.inverse(pose)[4:], axis=1).min())
        for each, (_, pose) in zip(found, poses, strict=True)
    )
    cell = CELL_SHARE * 1e-3 * TOLERANCES_MM[0] * nearest
    sampled = np.concatenate(found)
    places = sampled[thinned(sampled, cell)]
    views, reach = np.zeros(len(places)), np.full(len(places), np.inf)
    for lens, pose in poses:
        seen, distance = _seen(floor, lens, pose, places)
        views += seen
        reach = np.where(seen, np.minimum(reach, distance), reach)
    some = views >= MIN_VIEWS
    return Surface(_scene_of(floor), places[some], reach[some], cell)


def _seen(floor, lens, pose, places) -> tuple[Array, Array]:
    xy, ok = lens.img_from_point(rigid3.transform(pose, places))
    ok &= np.all((xy > 0) & (xy < [lens.width, lens.height]), axis=1)
    rays = lens.ray_from_img(np.where(ok[:, None], xy, 1.0))
    back = rigid3.inverse(pose)
    origins, dirs = rigid3.transform(back, rays[0]), rigid3.rotate(back, rays[1])
    distance = np.linalg.norm(places - origins, axis=1)
    return ok & (floor.cast(origins, dirs).distance > distance - HIDDEN_M), distance


def _scene_of(floor) -> Any:
    """Open3D's scene of the surface."""
    open3d = import_package("open3d", "comparing clouds", "render")
    scene = open3d.t.geometry.RaycastingScene()
    for part in floor.surfaces:
        scene.add_triangles(
            open3d.core.Tensor(part.vertices.astype(np.float32)),
            open3d.core.Tensor(part.triangles.astype(np.uint32)),
        )
    return scene


def _nearest(scene: Any, points: Array) -> Array:
    """The places of the surface (N, 3) that are nearest to points."""
    open3d = import_package("open3d", "comparing clouds", "render")
    found = scene.compute_closest_points(open3d.core.Tensor(points.astype(np.float32)))
    return found["points"].numpy().astype(np.float64)


def fitted(place: Similarity, points: Array, surface: Surface) -> Similarity:
    """Where a cloud (N, 3) fits the surface best, from a place near it.

    Iterated closest points, by the half that fits better each time.
    """
    rng = np.random.default_rng(0)
    known = points[np.isfinite(points).all(axis=1)]
    some = known[rng.permutation(len(known))[:NUM_FITTED]]
    for _ in range(FIT_ROUNDS):
        there = place.apply(some)
        near = _nearest(surface.floor, there)
        off = np.linalg.norm(there - near, axis=1)
        good = (off <= np.median(off)).astype(np.float64)
        place = align(some, near, good, with_scale=True)
    return place


def thinned(points: Array, cell: float) -> NDArray[np.int64]:
    """One point of each cell: dense parts of a cloud count no more than thin ones."""
    _, first = np.unique(
        np.floor(points / cell).astype(np.int64), axis=0, return_index=True
    )
    return np.sort(first)


def scored(points: Array, stddev: Array | None, surface: Surface) -> Scores:
    """Scores of a cloud (N, 3), deviations (N,), in the world of the truth."""
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    rows = known[thinned(points[known], surface.cell)]
    points = points[rows]
    off = np.linalg.norm(points - _nearest(surface.floor, points), axis=1)
    ratio = None
    if stddev is not None:
        ratio = float(np.median(off / stddev[rows]) / NORMAL_MEDIAN)
    _, nearest = cKDTree(surface.places).query(points, workers=-1)
    gap, _ = cKDTree(points).query(surface.places, workers=-1)
    limits = [1e-3 * t for t in TOLERANCES_MM]
    return Scores(
        num_points=len(points),
        accuracy=tuple(
            float(np.mean(off <= t * surface.reach[nearest])) for t in limits
        ),
        completeness=tuple(float(np.mean(gap <= t * surface.reach)) for t in limits),
        off_over_stddev=ratio,
    )


def placement(centers: dict[str, Array], spec: SequenceSpec) -> Similarity:
    """Of a model in the world of the truth, by its image centres."""
    names = [camera.name for camera in spec.rig.cameras]
    poses = known_cam_from_rig(spec.rig)
    true = {
        f"{name}/{frame}": rigid3.inverse(rigid3.compose(pose, rig_from_world))[4:]
        for frame, rig_from_world in zip(
            frame_names(len(spec.rig_from_world)), spec.rig_from_world, strict=True
        )
        for name, pose in zip(names, poses, strict=True)
    }
    common = sorted(set(true) & set(centers))
    x, y = (np.array([place[name] for name in common]) for place in (centers, true))
    return align(x, y, np.ones(len(common)), with_scale=True)


def model_centers(model: Model) -> dict[str, Array]:
    scene = model.scene
    return {
        model.image_name(c, f): rigid3.inverse(
            rigid3.compose(scene.cam_from_rig[c], scene.rig_from_world[f])
        )[4:]
        for c in range(len(scene.cameras))
        for f in range(scene.num_frames)
        if model.has_image(c, f)
    }


def colmap_centers(folder: Path) -> dict[str, Array]:
    """Of another program's model; its names may lack the folder."""
    found = {}
    for image in pycolmap.Reconstruction(folder).images.values():
        name = image.name if "/" in image.name else f"left/{image.name}"
        found[f"{Path(name).parent.name}/{Path(name).name}"] = image.projection_center()
    return found


def results(out: Path, only: str) -> Iterator[tuple[str, SequenceSpec, Path, Path]]:
    """Name, truth, result folder and images of scenes, made where missing.

    Args:
        out: their folder.
        only: what their names must hold.
    """
    for name, make in SPECS.items():
        spec, folder = make(), out / name
        if not folder.exists():
            with ProgressBars() as progress:
                render_sequence(spec, folder, progress)
        for suffix in ("", f" {ONE}"):
            if only not in f"{name}{suffix}":
                continue
            result = out / f"{name}_{suffix.strip() or 'out'}"
            rig = folder / "rig.yaml"
            if suffix:
                rig = result.with_suffix(".yaml")
                both = load_rig(folder / "rig.yaml")
                one = replace(
                    both, cameras=both.cameras[:1], cam_from_rig=None, baseline_m=None
                )
                dump_rig(one, rig)
            reconstructed(rig, folder / "images", result)
            yield f"{name}{suffix}", spec, result, folder / "images"


@dataclass(frozen=True)
class Shown:
    """A cloud in the world of the truth, for the picture."""

    label: str
    points: Array
    colors: NDArray[np.uint8]

    def from_above(self, low: Array, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Its highest points in cells; white where there is none."""
        image = np.full((size[1], size[0], 3), 255, dtype=np.uint8)
        order = np.argsort(-self.points[:, 2], kind="stable")  # z points down
        cell = np.floor((self.points[order, :2] - low) / CELL_M).astype(np.int64)
        inside = np.all((cell >= 0) & (cell < size), axis=1)
        x, y = cell[inside].T
        image[y, x] = self.colors[order][inside]
        return image


def picture(shown: list[Shown], surface: Surface, path: Path) -> None:
    """Clouds beside each other, from above."""
    import matplotlib.pyplot as plt

    low, high = (np.percentile(surface.places[:, :2], q, axis=0) for q in (1, 99))
    size = tuple(np.ceil((high - low) / CELL_M).astype(int).tolist())
    width = 3.4 * len(shown)
    figure, axes = plt.subplots(1, len(shown), figsize=(width, 3.8), squeeze=False)
    for axis, cloud in zip(axes[0], shown, strict=True):
        axis.imshow(cloud.from_above(low, size))
        axis.set_title(f"{cloud.label}\n{len(cloud.points):,} points", fontsize=9)
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--only", default="", help="scenes whose name holds this")
    parser.add_argument(
        "--also",
        nargs=4,
        action="append",
        default=[],
        metavar=("NAME", "SCENE", "CLOUD", "SPARSE"),
    )
    options = parser.parse_args()
    rows = []
    for name, spec, result, images in results(options.out, options.only):
        surface = surface_of(spec, 1 if name.endswith(ONE) else 2)
        centers, shown = model_centers(uwsfm.read_model(result)), []
        for matcher in MATCHERS[1 if name.endswith(ONE) else 0 :]:
            cloud = dense(result, images, matcher=matcher)
            place = fitted(placement(centers, spec), cloud.points, surface)
            known = place.apply(cloud.points), place.scale * cloud.stddev
            rows.append(scored(*known, surface).row(name, f"uwsfm, {matcher}"))
            shown.append(Shown(f"uwsfm, {matcher}", known[0], cloud.colors))
        for label, scene, path, sparse in options.also:
            if scene == name:
                other = uwsfm.read_cloud(path)
                place = placement(colmap_centers(Path(sparse)), spec)
                points = fitted(place, other.points, surface).apply(other.points)
                rows.append(scored(points, None, surface).row(name, label))
                shown.append(Shown(label, points, other.colors))
        picture(shown, surface, options.out / f"{name.replace(' ', '_')}_clouds.png")
    head = [f"accuracy | completeness | F1 at {t:g} mm" for t in TOLERANCES_MM]
    print(f"| scene | cloud of | points | {' | '.join(head)} | off / sd |")
    print("|---" * (4 + 3 * len(TOLERANCES_MM)) + "|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
