"""What `uwsfm clean`, `mesh` and `map` do."""

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwsfm._base.files import checked_target, replaced_dir, replaced_file
from uwsfm._base.packages import import_package
from uwsfm._base.ply import write_ply
from uwsfm._base.progress import Progress, silent
from uwsfm.cloud import Cloud, write_cloud
from uwsfm.errors import InputError
from uwsfm.export.las import write_las
from uwsfm.geometry import rigid3
from uwsfm.geometry.rigid3 import Array
from uwsfm.results.folder import MAP, MESH, Result, open_result
from uwsfm.results.summary import write_json
from uwsfm.surface.atlas import make_atlas
from uwsfm.surface.clean import Filter, clean_points, default_options
from uwsfm.surface.connected import main_parts
from uwsfm.surface.geotiff import (
    write_color_tiff,
    write_height_tiff,
    write_origin_tiff,
)
from uwsfm.surface.height_map import FILLED, make_height_map
from uwsfm.surface.level import world_from_map
from uwsfm.surface.mesh import decimated, distances_to_cloud, make_mesh
from uwsfm.surface.mesh_files import (
    write_glb,
    write_mesh_ply,
    write_obj,
    write_textured_glb,
)
from uwsfm.surface.preview import write_preview
from uwsfm.surface.source import Source, find_source
from uwsfm.surface.texture import make_texture, texel_size
from uwsfm.surface.units import length_words

STRAYS = "strays.ply"
"""Points that are not connected with the main surface."""
MAIN, ALL = PARTS = ("main", "all")


def clean_cloud(
    source: str | Path, path: str | Path, parts: str = MAIN, **limits: float
) -> dict[str, Any]:
    """Write the good points of a cloud, all their columns kept; of the points of an
    adjustment also their ranges, which only the model beside them tells.

    A JSON file of the same name holds what each filter removed, and NAME.strays.ply
    good points that are not connected with the main surface, if there are any.

    Args:
        source: result folder, or a PLY of its.
        path: the PLY to write; must not exist.
        parts: one of `PARTS`: the main connected surface (`surface.connected`), or all.
        limits: fields of `uwsfm.surface.clean.CleanOptions`, by default those of
            `default_options`; infinity leaves a filter out.

    Returns:
        What the JSON file holds.

    Raises:
        InputError: nothing to read, something to write over, or a limit on what the
            cloud does not hold.
    """
    target = checked_target(path)
    if target.suffix != ".ply":
        raise InputError(f"{target}: the name of a cleaned cloud must end in .ply")
    report_path = checked_target(target.with_suffix(".json"))
    strays_path = checked_target(target.with_suffix(f".{STRAYS}"))
    found = find_source(source)
    table = found.table()
    wanted: dict[str, Any] = {
        name: None if value == math.inf else value for name, value in limits.items()
    }
    options = replace(default_options(table), **wanted)
    keep, filters = clean_points(table, options)
    if not np.any(keep):
        worst = max(filters, key=lambda item: item.num_removed)
        raise InputError(
            f"{found.path}: no point is left, {worst.num_removed} of {len(table)} "
            f"failed at '{worst.name}'"
        )
    strays = _leave_out_strays(table, keep, filters, parts)
    report = {
        "source": str(found.path),
        "model": found.model,
        "unit": found.unit,
        "num_points": len(table),
        "num_kept": int(np.count_nonzero(keep)),
        "filters": [asdict(item) for item in filters],
    }
    comment = f"unit: {found.unit}; made by uwsfm clean"
    with replaced_file(report_path) as told, replaced_file(target) as partial:
        write_ply(partial, [("vertex", table[keep])], comment=comment)
        write_json(report, told)
        if np.any(strays):
            with replaced_file(strays_path) as beside:
                write_ply(beside, [("vertex", table[strays])], comment=comment)
    return report


def _leave_out_strays(
    table: np.ndarray, keep: NDArray[np.bool_], filters: list[Filter], parts: str
) -> NDArray[np.bool_]:
    """Take out of ``keep`` what is not connected with the main surface; its mask."""
    strays = np.zeros(len(table), dtype=bool)
    if _checked_parts(parts) == ALL:
        return strays
    rows = np.flatnonzero(keep)
    xyz = np.stack([table[axis][rows] for axis in "xyz"], axis=1).astype(np.float64)
    found = main_parts(xyz)
    strays[rows[~found.main]] = True
    keep[strays] = False
    filters.append(
        Filter(
            name="connected with the main surface",
            limit=found.link,
            num_tested=len(rows),
            num_removed=int(np.count_nonzero(strays)),
            num_unknown=0,
        )
    )
    return strays


def _checked_parts(parts: str) -> str:
    if parts not in PARTS:
        raise InputError(f"--parts {parts}: is one of {', '.join(PARTS)}")
    return parts


def _divided(cloud: Cloud, parts: str) -> tuple[Cloud, Cloud]:
    """What a surface is made of, and the strays that it is made without."""
    cloud = cloud.select(np.isfinite(cloud.points).all(axis=1))
    everything = np.ones(len(cloud), dtype=bool)
    main = everything if _checked_parts(parts) == ALL else main_parts(cloud.points).main
    return cloud.select(main), cloud.select(~main)


def _stray_warnings(strays: Cloud, cloud: Cloud) -> list[str]:
    if not len(strays):
        return []
    share = len(strays) / (len(strays) + len(cloud))
    return [
        f"{len(strays)} points ({share:.2g} of all) are not connected with the main "
        f"surface and were left out: {STRAYS} holds them, --parts all keeps them"
    ]


def export_las(source: str | Path, path: str | Path, suffix: str) -> Cloud:
    """Write a cloud as LAS or LAZ; see `uwsfm.export.las`.

    Args:
        source: result folder, or a PLY of its.
        path: the file to write; must not exist.
        suffix: "las" or "laz", which ends the file's name.

    Raises:
        InputError: nothing to read, or something to write over.
        MissingPackageError: laspy is missing.
    """
    target = checked_target(path)
    if target.suffix.lower() != f".{suffix}":
        raise InputError(f"{target}: for --to {suffix} the name must end in .{suffix}")
    found = find_source(source)
    cloud = found.cloud()
    write_las(cloud, target, found.unit)
    return cloud


@dataclass(frozen=True, kw_only=True)
class MeshOptions:
    """How a mesh is made.

    Raises:
        InputError: a value that is none.
    """

    method: str = "poisson"
    """One of `uwsfm.surface.mesh.METHODS`."""
    max_distance: float | None = None
    """Of the surface from the points; None: four of their spacings."""
    up: str | None = None
    """What is up in the world, for glTF; see `make_map`."""
    web_triangles: int = 100_000
    """Of the decimated copy, at most."""
    parts: str = MAIN
    """As of `clean_cloud`."""
    texture: bool = False
    """Also put the photographs on the decimated copy."""
    texture_side: int = 4096
    """Of the picture, texels at most; it is smaller where the photographs show less."""
    images: str | Path | None = None
    """Folder of the photographs; None: where they were."""

    def __post_init__(self) -> None:
        _checked_parts(self.parts)
        if self.web_triangles < 1:
            raise InputError(
                f"--web-triangles must be positive, got {self.web_triangles}"
            )
        if not 64 <= self.texture_side <= 16384:
            raise InputError(
                f"--texture-side must be from 64 to 16384, got {self.texture_side}"
            )


def mesh_cloud(
    source: str | Path, folder: str | Path, progress: Progress = silent, **options: Any
) -> dict[str, Any]:
    """Write a mesh: mesh.ply, mesh.obj, mesh.glb, web.glb (decimated) and mesh.json;
    strays.ply with the points that are not connected with the main surface; and
    textured.glb, the decimated mesh with the photographs on it, if it is wanted.

    Args:
        source: result folder, or a PLY of its.
        folder: to write; must not exist.
        progress: called with the steps of the texture.
        options: fields of `MeshOptions`.

    Returns:
        What mesh.json holds.

    Raises:
        InputError: nothing to read, something to write over, up is not known, or
            images for the texture are missing.
        UwsfmError: there is no surface near the points.
        MissingPackageError: Open3D or xatlas is missing.
    """
    target, asked = checked_target(folder), MeshOptions(**options)
    found = find_source(source)
    result = _with_images(found, asked) if asked.texture else None
    cloud, strays = _divided(found.cloud(), asked.parts)
    level = found.level(cloud, asked.up)
    above = found.above(cloud)
    mesh, reach = make_mesh(cloud, asked.method, asked.max_distance, above)
    small = decimated(mesh, asked.web_triangles, cloud)
    report: dict[str, Any] = {
        "source": str(found.path),
        "model": found.model,
        "unit": found.unit,
        "method": asked.method,
        "num_points": len(cloud),
        "num_strays": len(strays),
        "max_distance": reach,
        "gltf": "metres, +y up" if found.unit == "metre" else "no metres, +y up",
        "level": level.method,
        "warnings": [*found.warnings(), *_stray_warnings(strays, cloud)],
    }
    for name, part in (("mesh", mesh), ("web", small)):
        report[name] = {
            "num_vertices": len(part.vertices),
            "num_triangles": len(part.triangles),
            "area": part.area(),
            "farthest_from_points": float(distances_to_cloud(part, cloud).max()),
        }
    with replaced_dir(target) as partial:
        write_mesh_ply(mesh, partial / "mesh.ply", found.unit)
        write_obj(mesh, partial / "mesh.obj", found.unit)
        write_glb(mesh, partial / "mesh.glb", level, found.unit)
        write_glb(small, partial / "web.glb", level, found.unit)
        if result is not None:
            atlas = make_atlas(small, texel_size(result.model), asked.texture_side)
            images = result.require_images()
            painted = make_texture(atlas, small, result.model, images, progress)
            path = partial / "textured.glb"
            write_textured_glb(atlas, painted.image, path, level, found.unit)
            report["texture"] = {
                "width": atlas.size[0],
                "height": atlas.size[1],
                "num_images": painted.num_images,
                "share_seen": painted.share_seen,
            }
        if len(strays):
            write_cloud(strays, partial / STRAYS, found.unit)
        write_json(report, partial / MESH)
    return report


def _with_images(found: Source, asked: MeshOptions) -> Result:
    """The result folder around a cloud; its photographs must be there.

    Raises:
        InputError: the cloud is not in one, or they are missing.
    """
    if found.folder is None:
        raise InputError(
            f"{found.path} is in no result folder, and only its model tells what the "
            "photographs show: give the folder, or leave --texture out"
        )
    result = open_result(found.folder, asked.images)
    result.require_images()
    return result


def make_map(
    source: str | Path,
    folder: str | Path,
    *,
    up: str | None = None,
    resolution: float | None = None,
    max_gap: float | None = None,
    parts: str = MAIN,
) -> dict[str, Any]:
    """Write a height map and an orthophoto: height.tif, ortho.tif, origin.tif (what is
    measured, and what filled between points), map.json, map.png; and strays.ply.

    Args:
        source: result folder, or a PLY of its (of a mesh, its vertices count).
        folder: to write; must not exist.
        up: what is up in the world, one of `uwsfm.surface.level.UPS`; default: the
            plane through the points is level, unless the world is that of positions.
        resolution: side of a cell, metres; default: the spacing of the points.
        max_gap: longest distance between points to bridge; default: five spacings.
        parts: as of `clean_cloud`; strays would widen the map.

    Returns:
        What map.json holds, lengths in its "unit". Heights have no standard deviation
        of their own: "point_stddev_percentiles" is of the cloud's points along their
        lines of sight, "relief_about_plane" the scatter of the floor itself.

    Raises:
        InputError: nothing to read, something to write over, or up is not known.
        MissingPackageError: tifffile is missing.
    """
    target = checked_target(folder)
    import_package("tifffile", "uwsfm map", "inspect")
    found = find_source(source)
    cloud, strays = _divided(found.cloud(), parts)
    level = found.level(cloud, up)
    points = rigid3.transform(level.map_from_world, cloud.points)
    grid = make_height_map(points, cloud.colors, resolution, max_gap, found.unit)
    pose = world_from_map(level)
    report = {
        "source": str(found.path),
        "model": found.model,
        "unit": found.unit,
        "level": level.method,
        "relief_about_plane": level.relief,
        "point_stddev_percentiles": _percentiles(cloud.stddev),
        "resolution": grid.resolution,
        "max_gap": grid.max_gap,
        "west": grid.west,
        "north": grid.north,
        "num_rows": grid.height.shape[0],
        "num_columns": grid.height.shape[1],
        "share_with_data": float(np.mean(np.isfinite(grid.height))),
        "share_filled": float(np.mean(grid.origin == FILLED)),
        "num_strays": len(strays),
        "world_from_map": {
            "rotation_xyzw": pose[:4].tolist(),
            "translation": pose[4:].tolist(),
        },
        "warnings": [*found.warnings(), *_stray_warnings(strays, cloud)],
    }
    frame = f"uwsfm local frame, {level.method}"
    cell, gap = (length_words(x, found.unit) for x in (grid.resolution, grid.max_gap))
    title = f"{level.method}; cells {cell}, gaps up to {gap}"
    with replaced_dir(target) as partial:
        write_height_tiff(grid, partial / "height.tif", frame, found.unit)
        write_color_tiff(grid, partial / "ortho.tif", frame, found.unit)
        write_origin_tiff(grid, partial / "origin.tif", frame, found.unit)
        if len(strays):
            write_cloud(strays, partial / STRAYS, found.unit)
        write_preview(grid, partial / "map.png", title, found.unit)
        write_json(report, partial / MAP)
    return report


def _percentiles(stddev: Array) -> dict[str, float] | None:
    known = stddev[np.isfinite(stddev)]
    if not len(known):
        return None
    shares = (5, 50, 95)
    found = np.percentile(known, shares).tolist()
    return dict(zip(map(str, shares), found, strict=True))
