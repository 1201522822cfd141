"""Figure 3: where the water rays of neighbouring pixels meet."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pycolmap
from plots import BLUE, GRAY, ORANGE, TEAL, new_figure, save
from settings import Settings
from tables import Row, Tables, column

from uwsfm.geometry.rigid3 import Array
from uwsfm.models.ports.port import FlatPort
from uwsfm.models.refractive import RefractiveCamera
from uwsfm.simulate.rigs import tilted_normal

TABLES = ("fig3_section", "fig3_tilted")
WIDTH, HEIGHT = 1200, 900
FOCAL_PX = 750.0  # 39 degrees to the left and right: a wide lens shows the shape
THIN = FlatPort(distance=0.02, thickness=0.0)
THICK = FlatPort(tilted_normal(2.0, 0.0), distance=0.02, thickness=0.03)


def _camera(port: FlatPort) -> RefractiveCamera:
    lens = pycolmap.Camera(
        model="SIMPLE_PINHOLE",
        width=WIDTH,
        height=HEIGHT,
        params=[FOCAL_PX, 0.5 * WIDTH, 0.5 * HEIGHT],
    )
    return RefractiveCamera(lens, port)


def compute(settings: Settings) -> Iterator[tuple[str, list[Row]]]:
    yield from caustics().items()


def caustics(num_columns: int = 33, num_rows: int = 25) -> Tables:
    """Both focal points of a row of pixels (thin) and of a grid of pixels (thick)."""
    x = np.linspace(0.0, WIDTH, num_columns)
    middle = np.column_stack([x, np.full(num_columns, 0.5 * HEIGHT)])
    grid = np.stack(np.meshgrid(x, np.linspace(0.0, HEIGHT, num_rows)), axis=-1)
    return {
        "fig3_section": _rows(_camera(THIN), middle),
        "fig3_tilted": _rows(_camera(THICK), grid.reshape(-1, 2)),
    }


def _rows(camera: RefractiveCamera, xy: Array) -> list[Row]:
    origins, dirs = camera.ray_from_img(xy)
    sagittal, tangential = camera.caustic(xy)
    values = {
        "px": xy,
        "surface_mm": 1e3 * origins,
        "ray": dirs,
        "sagittal_mm": 1e3 * sagittal,
        "tangential_mm": 1e3 * tangential,
    }
    columns = {
        f"{axis}_{name}": array[:, index]
        for name, array in values.items()
        for index, axis in enumerate("xyz"[: array.shape[1]])
    }
    lines = np.column_stack(list(columns.values())).tolist()
    return [dict(zip(columns, line, strict=True)) for line in lines]


def plot(found: Tables, out: Path) -> None:
    figure = new_figure(11.0, 4.4)
    grid = figure.add_gridspec(1, 3, width_ratios=(1.2, 1.1, 0.9))
    _draw_section(figure.add_subplot(grid[0]), found["fig3_section"])
    _draw_sheets(figure.add_subplot(grid[1], projection="3d"), found["fig3_tilted"])
    _draw_rim(figure.add_subplot(grid[2]), found["fig3_tilted"])
    save(figure, out / "fig3.png")


def _draw_section(axes, rows: list[Row]) -> None:
    """Rays, and both sheets, in the plane of the image row through the centre."""
    inner = 1e3 * THIN.distance
    for row in rows:
        x, z = row["x_surface_mm"], row["z_surface_mm"]
        slope = row["x_ray"] / row["z_ray"]
        axes.plot([0.0, x], [0.0, z], color=GRAY, linewidth=0.4)
        axes.plot([x, x + 12.0 * slope], [z, z + 12.0], color=BLUE, linewidth=0.4)
        back = z - row["z_tangential_mm"]
        axes.plot([x, x - back * slope], [z, z - back], "--", color=BLUE, linewidth=0.3)
    axes.axhline(inner, color=TEAL, linewidth=1.6)
    axes.text(-25.0, inner + 2.4, "water", color=TEAL)
    axes.text(-25.0, inner - 0.8, "air", color=TEAL)
    axes.plot(
        column(rows, "x_tangential_mm"),
        column(rows, "z_tangential_mm"),
        color=ORANGE,
        linewidth=2.2,
        label="tangential sheet",
    )
    axes.plot(
        column(rows, "x_sagittal_mm"),
        column(rows, "z_sagittal_mm"),
        color="black",
        linewidth=2.2,
        label="sagittal sheet, on the axis",
    )
    axes.plot(0.0, 0.0, "k+", markersize=9, label="projection centre")
    axes.set_aspect("equal")
    axes.set_xlim(-26.0, 26.0)
    axes.set_ylim(33.0, -21.0)  # depth grows downwards, as under a survey vehicle
    axes.set_xlabel("x, mm")
    axes.set_ylabel("depth z, mm")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2)
    axes.set_title("no glass, 20 mm to the water: section")


def _sheet(rows: list[Row], name: str) -> list[Array]:
    """x, y, z (rows, columns) of a sheet over the image's grid."""
    num_columns = len(set(column(rows, "x_px")))
    return [
        np.reshape(column(rows, f"{axis}_{name}_mm"), (-1, num_columns))
        for axis in "xyz"
    ]


def _draw_sheets(axes, rows: list[Row]) -> None:
    tangential, sagittal = _sheet(rows, "tangential"), _sheet(rows, "sagittal")
    # Depth runs down in the picture: -z is drawn.
    axes.plot_wireframe(
        tangential[0],
        tangential[1],
        -tangential[2],
        color=ORANGE,
        linewidth=0.45,
        rcount=50,
        ccount=50,
        label="tangential sheet",
    )
    axes.plot(
        sagittal[0].ravel(),
        sagittal[1].ravel(),
        -sagittal[2].ravel(),
        color="black",
        linewidth=2.5,
        label="sagittal sheet",
    )
    low, high = -float(np.max(tangential[2])), -float(np.min(tangential[2]))
    axes.plot([0, 0], [0, 0], [low, high], ":", color=BLUE, label="optical axis")
    spans = [np.ptp(tangential[0]), np.ptp(tangential[1]), high - low]
    axes.set_box_aspect(spans, zoom=0.95)
    axes.view_init(elev=16, azim=-62)
    for name in "xy":
        getattr(axes, f"set_{name}label")(f"{name}, mm", labelpad=-3)
    axes.set_zlabel("-z, mm", labelpad=-1)
    axes.set_zticks(np.arange(5, high, 5))
    axes.set_xticks([-6, -3, 0, 3, 6])
    axes.set_yticks([-5, 0, 5])
    axes.tick_params(pad=-1, labelsize=7)
    axes.legend(loc="upper left", fontsize=7.5)
    axes.set_title("30 mm of glass, tilted by 2 degrees")


def _draw_rim(axes, rows: list[Row]) -> None:
    """The tangential sheet along the optical axis: its rim is off centre."""
    x, y, _ = _sheet(rows, "tangential")
    for lines in (x, y), (x.T, y.T):
        axes.plot(*(part.T for part in lines), color=ORANGE, linewidth=0.35)
    rim = [np.concatenate([a[0], a[:, -1], a[-1, ::-1], a[::-1, 0]]) for a in (x, y)]
    axes.plot(*rim, color=ORANGE, linewidth=1.8, label="rays of the image border")
    axes.plot(0.0, 0.0, "+", color=BLUE, markersize=10, label="optical axis")
    axes.set_aspect("equal")
    axes.set_xlabel("x, mm")
    axes.set_ylabel("y, mm")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16))
    axes.set_title("the same sheet, along the optical axis")


def section(found: Tables) -> str:
    """What the README says."""
    rows = found["fig3_section"]
    middle = rows[len(rows) // 2]
    tilted = found["fig3_tilted"]
    depths = column(tilted, "z_sagittal_mm")
    return TEXT.format(
        apex=middle["z_sagittal_mm"],
        edge=rows[0]["z_sagittal_mm"],
        wide=column(rows, "x_tangential_mm")[0],
        length=max(depths) - min(depths),
        low=min(column(tilted, "x_tangential_mm")),
        high=max(column(tilted, "x_tangential_mm")),
    )


TEXT = """## Figure 3: caustics

![Caustics of a water-air interface, and of tilted thick glass](fig3.png)

Where the water rays of neighbouring pixels meet, followed backwards
(`fig3_section.csv`, `fig3_tilted.csv`, mm in the camera's frame). Left: rays in air
grey, in water blue, their continuation dashed; the caustic starts at z = {apex:.2f} mm
behind the projection centre, at the image border its sheets are at {edge:.2f} mm on the
axis and {wide:.2f} mm off it. Middle and right: 30 mm of glass, tilted by 2 degrees.

**The paper** shows the tangential sheet, as the zero of a numerical determinant.
**Here** both sheets are closed forms (`RefractiveCamera.caustic`): for a flat port the
sagittal one is a piece of the axis, here {length:.2f} mm long. The tilt makes the
tangential one reach from x = {low:.2f} to {high:.2f} mm: the asymmetric distortion.
Nothing is lost against the paper.
"""
