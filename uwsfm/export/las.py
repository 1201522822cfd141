"""Clouds as LAS and LAZ, for survey software (laspy)."""

from pathlib import Path

import numpy as np

from uwsfm._base.files import replaced_file
from uwsfm._base.packages import import_package
from uwsfm.cloud import Cloud
from uwsfm.errors import InputError
from uwsfm.geometry.rigid3 import Array

MAX_SCALE = 1e-4
"""Metres per step of the stored integers: positions are rounded by half of it."""
_MIN_SCALE = 1e-6
# Of the 2^31 steps to either side of the offset.
_LARGEST = 2_000_000_000
# LAS 1.4, format 7: colours of 16 bits, no waveforms, up to 15 returns.
_POINT_FORMAT, _VERSION = 7, "1.4"


def write_las(cloud: Cloud, path: str | Path, unit: str = "metre") -> None:
    """Write a LAS 1.4 file, or LAZ by its suffix.

    Coordinates are those of the world frame. Extra dimensions: stddev (float, along
    the line of sight), num_views (unsigned short), view_range (float), plain (0 or 1);
    each only if it is known of some point.

    Args:
        cloud: what to write.
        path: the file, .las or .laz.
        unit: of lengths, for the header: LAS files of survey software are metres.

    Raises:
        InputError: no finite point, points too far apart for 0.1 mm, another suffix,
            or the file cannot be written.
        MissingPackageError: laspy or lazrs is missing.
    """
    target = Path(path)
    if target.suffix.lower() not in (".las", ".laz"):
        raise InputError(f"{target}: the name must end in .las or .laz")
    laspy = import_package("laspy", "writing LAS", "inspect")
    if target.suffix.lower() == ".laz":
        import_package("lazrs", "writing LAZ", "inspect")
    good = np.isfinite(cloud.points).all(axis=1)
    if not np.any(good):
        raise InputError(f"{target}: the cloud has no point with a finite position")
    shown = cloud.select(good)
    offsets, scale = offsets_and_scale(shown.points)
    header = laspy.LasHeader(point_format=_POINT_FORMAT, version=_VERSION)
    header.offsets, header.scales = offsets, np.full(3, scale)
    header.generating_software = "uwsfm"
    header.system_identifier = f"unit: {unit}"[:32]
    columns: dict[str, np.ndarray] = {
        "stddev": shown.stddev.astype(np.float32),
        "view_range": shown.view_range.astype(np.float32),
        "num_views": np.minimum(shown.num_views, 65_535).astype(np.uint16),
    }
    if np.any(shown.plain):
        columns["plain"] = np.asarray(shown.plain, dtype=np.uint8)
    known = {name: v for name, v in columns.items() if np.any(np.isfinite(v))}
    header.add_extra_dims(
        [laspy.ExtraBytesParams(name=n, type=v.dtype) for n, v in known.items()]
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = shown.points.T
    # Eight bits fill all sixteen: 255 becomes 65535.
    las.red, las.green, las.blue = shown.colors.T.astype(np.uint16) * 257
    for name, values in known.items():
        setattr(las, name, values)
    with replaced_file(target) as partial:
        las.write(str(partial))


def offsets_and_scale(points: Array) -> tuple[Array, float]:
    """Offsets (3,) and the step that store points (N, 3) to 0.05 mm or better.

    Raises:
        InputError: they are too far apart.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    # Whole metres: readers that add offset and steps in doubles then agree.
    offsets = np.round((low + high) / 2)
    reach = float(np.abs(np.stack([low, high]) - offsets).max())
    scale = _MIN_SCALE
    while reach / scale > _LARGEST:
        scale *= 10.0
    if scale > MAX_SCALE * 1.001:
        raise InputError(
            f"the points reach {reach:.0f} m from their middle: LAS cannot store that "
            f"to {MAX_SCALE / 2:g} m; clean the cloud first (uwsfm clean)"
        )
    return offsets, scale
