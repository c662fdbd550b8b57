"""Does the edge of a road lie where it is? An orthophoto with a hybrid terrain model, and with its grid alone.

A curved road runs on a dam: carriageway 8 m wide, embankments 1:1.5, on gently rolling ground. An aerial photo of it is
rendered strictly from the analytic terrain, the road's edge painted exactly along the edge of the carriageway. Mass
points every 5 m and four breaklines (edges of the carriageway, toes of the embankments) are measured with errors. From
these a model is built and the orthophoto made by photoplan's own chain; then its grid is taken alone, without lines.
The edge of the road is measured in both and compared with the truth (Ecker 1991, fig. 4.25, §4.4, §4.6.2).

The photo looks at the road from the side: a height error of 1 m moves the edge by 0.5 m, so that 0.2 px of the
orthophoto (0.04 m) are 0.08 m of height.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.lenses import Interior, NoLens
from photoplan.engine.execute import Source, render
from photoplan.geometry.grid import MapGrid, Window
from photoplan.geometry.pose import Pose
from photoplan.plan.anchors import AnchorRule
from photoplan.plan.footprint import Tiles
from photoplan.plan.product import ProductPlan
from photoplan.surfaces.base import Surface
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain, MemoryUnits, PointGroup
from photoplan.targets.map import MapTarget
from photoplan.terrain.build import Built, build_terrain, plan_build
from photoplan.terrain.clean import clean
from photoplan.terrain.observations import BuildSettings

CENTRE, RADIUS = np.array([70.0, -85.0]), 150.0
"""Of the circle that the road's axis is a part of, metres."""
HALF_WIDTH, SLOPE = 4.0, 1 / 1.5
"""Of the carriageway, metres; and of the embankments."""
AREA = (0.0, 10.0, 140.0, 100.0)
"""xmin, ymin, xmax, ymax of the measured area, metres."""
ANGLES = np.radians([71.0, 109.0])
"""Part of the road where its edges are measured in the orthophoto, seen from the circle's centre."""
DARK, BRIGHT = 60.0, 200.0
"""Grey values of the road and of what is beside it."""

CAMERA_CENTRE = np.array([200.0, -380.0, 1000.0])
FOCAL = 6000.0
"""Pixels: 0.15 m on the ground."""
BLUR = 0.8
"""Standard deviation of the photo's point spread, pixels: lens and film or sensor."""
PIXEL = 0.2
"""Of the orthophoto, metres."""
ORTHO = (15.0, 40.0, 125.0, 80.0)
"""xmin, ymin, xmax, ymax of the orthophoto, metres."""
SPACING, POINT_SIGMA, LINE_SIGMA = 5.0, 0.05, 0.01
"""Of mass points, metres; standard deviations of mass points (in Z) and vertices of lines (in X, Y and Z), metres."""


def ground(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Terrain without the road, metres."""
    return 100.0 + 0.03 * (Y - 50.0) + 0.5 * np.sin(X / 25.0) + 0.3 * np.cos(Y / 18.0)


def off_axis(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance from the road's axis, positive outside its circle, metres."""
    return np.hypot(X - CENTRE[0], Y - CENTRE[1]) - RADIUS


def carriageway(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the road, level across, 2 % along, metres."""
    angle = np.arctan2(Y - CENTRE[1], X - CENTRE[0])
    return 103.5 + 0.02 * RADIUS * (np.pi / 2 - angle)


def terrain(X: NDArray[np.float64], Y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The true height: carriageway, embankments down to the ground."""
    beside = np.abs(off_axis(X, Y)) - HALF_WIDTH
    return np.maximum(ground(X, Y), carriageway(X, Y) - SLOPE * np.maximum(beside, 0.0))


def on_circle(angles: NDArray[np.float64], off: NDArray[np.float64] | float) -> NDArray[np.float64]:
    """X, Y at a distance from the axis, shape (n, 2)."""
    radius = RADIUS + np.asarray(off)
    return CENTRE + np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=-1)


def toe(angles: NDArray[np.float64], side: float) -> NDArray[np.float64]:
    """X, Y where an embankment meets the ground, by bisection, shape (n, 2)."""
    low, high = np.full(len(angles), HALF_WIDTH), np.full(len(angles), 20.0)
    for _ in range(50):
        middle = (low + high) / 2
        X, Y = on_circle(angles, side * middle).T
        above = carriageway(X, Y) - SLOPE * (middle - HALF_WIDTH) > ground(X, Y)
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    return on_circle(angles, side * low)


def measure(seed: int = 0, line_sigma: float = LINE_SIGMA) -> MeasuredTerrain:
    """Points and lines as an operator would measure them, with errors."""
    rng = np.random.default_rng(seed)
    xmin, ymin, xmax, ymax = AREA
    X, Y = (a.ravel() for a in np.meshgrid(np.arange(xmin, xmax, SPACING), np.arange(ymin, ymax, SPACING)))
    X, Y = (a + rng.uniform(0.1, 0.9, len(a)) * SPACING for a in (X, Y))
    points = np.column_stack([X, Y, terrain(X, Y) + rng.normal(0, POINT_SIGMA, len(X))])
    angles = np.radians(90 + np.degrees(np.arange(-70, 70.1, SPACING) / RADIUS))
    lines = []
    for side, where in ((1.0, "outer"), (-1.0, "inner")):
        for name, xy in (("edge", on_circle(angles, side * HALF_WIDTH)), ("toe", toe(angles, side))):
            xyz = np.column_stack([xy, terrain(*xy.T)])
            kept = (xyz[:, 0] > xmin) & (xyz[:, 0] < xmax)
            xyz = (xyz + rng.normal(0, line_sigma, xyz.shape))[kept]
            lines.append(MeasuredLine(f"{where} {name}", "breakline", xyz, sigma=line_sigma))
    group = PointGroup("points", "mass", points, np.arange(1, len(points) + 1), sigma=POINT_SIGMA)
    return clean(MeasuredTerrain((group,), tuple(lines)))[0]


def model(measured: MeasuredTerrain, width: float | None) -> Built:
    """The terrain model; all units have the same grid width, so that its grid alone is one raster."""
    return build_terrain(plan_build(measured, BuildSettings(grid_width=width, adapt=0.0, unit_meshes=16)))


def hybrid(built: Built) -> HybridSurface:
    """The model with its lines."""
    return HybridSurface(MemoryUnits(built.plan.layout, built.units))


@dataclass(frozen=True, eq=False)
class _Posts:
    heights: NDArray[np.float32]

    @property
    def size(self) -> tuple[int, int]:
        return self.heights.shape[1], self.heights.shape[0]

    def read(self, window: Window) -> NDArray[np.float32]:
        return self.heights[window.row : window.stop[1], window.col : window.stop[0]]


def grid_alone(built: Built) -> RasterSurface:
    """The model's posts without its lines."""
    layout, meshes = built.plan.layout, built.plan.settings.unit_meshes
    heights = np.full((layout.rows * meshes + 1, layout.columns * meshes + 1), np.nan, np.float32)
    for (column, row), unit in built.units.items():
        part = heights[row * meshes :, column * meshes :][: meshes + 1, : meshes + 1]
        part[:] = np.where(np.isfinite(unit.heights), unit.heights + np.float32(unit.datum), part)
    return RasterSurface(_Posts(heights), (layout.left, layout.top), (built.plan.width, built.plan.width))


def camera() -> FrameCamera:
    """A tilted aerial camera, of whose image only the part with the road is kept."""
    pose = Pose.from_angles(CAMERA_CENTRE, np.radians([2.0, -1.5, 20.0]))
    whole = FrameCamera(Interior.digital((1, 1), (FOCAL, FOCAL)), NoLens(), pose)
    xmin, ymin, xmax, ymax = ORTHO
    corners = [(x, y, z) for x in (xmin, xmax) for y in (ymin, ymax) for z in (97.0, 106.0)]
    xy = project(whole, corners)
    first, last = np.floor(xy.min(axis=0)) - 8, np.ceil(xy.max(axis=0)) + 8
    size = tuple((last - first).astype(int) + 1)
    offset = -first - (np.array(size) - 1) / 2
    interior = Interior.digital(size, (FOCAL, FOCAL), (float(offset[0]), float(offset[1])))
    return FrameCamera(interior, NoLens(), pose)


def hit(view: FrameCamera, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """X, Y where the rays of image points (..., 2) meet the true terrain.

    The height is put into the ray and the ray's place into the terrain, in turn. Slopes are at most 0.75 and rays have
    run 0.6 m aside at most for each metre down: each turn leaves less than half of the error, twenty leave 5 µm.
    """
    centres, rays = view.rays(xy)
    aside = rays[..., :2] / rays[..., 2:]
    Z = np.full(xy.shape[:-1], 101.0)
    for _ in range(20):
        XY = centres[..., :2] + aside * (Z - centres[..., 2])[..., None]
        Z = terrain(XY[..., 0], XY[..., 1])
    return XY


def photo(view: FrameCamera, fine: int = 8) -> NDArray[np.float32]:
    """The photo, shape (1, rows, columns): grey values of the ground that each pixel sees, averaged over its area and
    spread by the optics.

    Pixels near the edge of the road are cut into `fine` × `fine` rays; all others see one grey value only.
    """
    columns, rows = view.size
    xy = np.stack(np.meshgrid(np.arange(columns, dtype=float), np.arange(rows, dtype=float)), axis=-1)
    beside = np.abs(off_axis(*np.moveaxis(hit(view, xy), -1, 0))) - HALF_WIDTH
    image = np.where(beside < 0, DARK, BRIGHT)
    near = np.abs(beside) < 0.5
    step = (np.arange(fine) + 0.5) / fine - 0.5
    inside = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    seen = hit(view, xy[near][:, None] + inside)
    road = np.abs(off_axis(seen[..., 0], seen[..., 1])) < HALF_WIDTH
    image[near] = np.where(road, DARK, BRIGHT).mean(axis=1)
    return gaussian_filter(image, BLUR)[None].astype(np.float32)


@dataclass(frozen=True, eq=False)
class _Photo:
    image: NDArray[np.float32]

    @property
    def size(self) -> tuple[int, int]:
        return self.image.shape[2], self.image.shape[1]

    @property
    def bands(self) -> int:
        return 1

    @property
    def dtype(self) -> np.dtype[Any]:
        return self.image.dtype

    def read(self, window: Window, level: int = 0) -> tuple[NDArray[Any], None]:
        assert level == 0, "as fine as the product"
        return self.image[:, window.row : window.stop[1], window.col : window.stop[0]], None


def ortho_grid() -> MapGrid:
    """Pixels of the orthophoto."""
    return MapGrid.covering(ORTHO, PIXEL, "EPSG:32633")


def orthophoto(view: FrameCamera, image: NDArray[np.float32], surface: Surface) -> NDArray[np.float32]:
    """The orthophoto, shape (rows, columns), by the package's own chain."""
    grid = ortho_grid()
    plan = ProductPlan("road_ortho", ("road",), MapTarget(grid), AnchorRule(0.005, 3), Tiles.every(grid.window, 1024))
    pixels = render(plan, plan.tiles[0], [Source(view, _Photo(image))], surface, "bicubic")
    assert pixels.values is not None and pixels.valid is not None
    return np.where(pixels.valid, pixels.values[0], np.nan)


def edge_offsets(picture: NDArray[np.float32], side: float, step: float = 0.5) -> tuple[NDArray[np.float64], ...]:
    """How far an edge in the orthophoto lies outside the true one, every `step` metres along it.

    Grey values along the true edge's normal (cubic interpolation, 20 per pixel) cross the mean of dark and bright.

    Returns
    -------
    along, offsets : ndarrays, shape (n,)
        Distance along the edge, metres; offset, pixels, positive away from the road's axis. NaN: no crossing.
    """
    angles = np.arange(*ANGLES, step / RADIUS)
    off = np.arange(-2.5, 2.5001, PIXEL / 20)
    XY = np.stack([on_circle(angles, side * (HALF_WIDTH + t)) for t in off], axis=1)
    column, row = np.moveaxis(ortho_grid().to_pixel(XY), -1, 0)
    grey = map_coordinates(picture, [row, column], order=3, mode="nearest")
    above = grey >= (DARK + BRIGHT) / 2
    # The first change from dark to bright, as one walks away from the axis.
    rising = above[:, 1:] & ~above[:, :-1]
    first = rising.argmax(axis=1)
    each = np.arange(len(angles))
    g0, g1 = grey[each, first], grey[each, first + 1]
    place = off[first] + (off[1] - off[0]) * ((DARK + BRIGHT) / 2 - g0) / np.where(rising.any(axis=1), g1 - g0, 1.0)
    return RADIUS * (angles - angles[0]), np.where(rising.any(axis=1), place / PIXEL, np.nan)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Orthophotos of one model, and where the road's edges lie in them."""

    width: float
    """Grid width, metres."""
    pictures: dict[str, NDArray[np.float32]]
    """By surface: `truth`, `hybrid`, `grid`."""
    along: NDArray[np.float64]
    offsets: dict[str, NDArray[np.float64]]
    """Shape (2, n): outer and inner edge, pixels."""

    def worst(self, surface: str) -> float:
        """Largest offset, pixels."""
        return float(np.abs(self.offsets[surface]).max())

    def rms(self, surface: str) -> float:
        """Root mean square of the offsets, pixels."""
        return float(np.sqrt((self.offsets[surface] ** 2).mean()))


@dataclass(frozen=True)
class _Truth:
    """The true terrain as a surface."""

    def heights(self, XY: Any) -> NDArray[np.float64]:
        XY = np.asarray(XY, float)
        return terrain(XY[..., 0], XY[..., 1])

    def relief(self, target: Any, window: Window) -> NDArray[np.float32]:
        rows, columns = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]]
        return self.heights(target.grid.to_map(np.stack([columns, rows], axis=-1))).astype(np.float32)

    def height_range(self, bounds: tuple[float, float, float, float]) -> tuple[float, float]:
        return 95.0, 108.0


@cache
def _shot() -> tuple[FrameCamera, NDArray[np.float32]]:
    view = camera()
    return view, photo(view)


def run(width: float | None = 5.0, seed: int = 0, line_sigma: float = LINE_SIGMA) -> Outcome:
    """The whole experiment with one grid width (None: from the spacing of the points) and one set of errors."""
    view, image = _shot()
    built = model(measure(seed, line_sigma), width)
    surfaces: dict[str, Surface] = {"truth": _Truth(), "hybrid": hybrid(built), "grid": grid_alone(built)}
    pictures = {name: orthophoto(view, image, surface) for name, surface in surfaces.items()}
    offsets, along = {}, np.empty(0)
    for name, picture in pictures.items():
        sides = [edge_offsets(picture, side) for side in (1.0, -1.0)]
        along = sides[0][0]
        offsets[name] = np.stack([s[1] for s in sides])
    return Outcome(built.plan.width, pictures, along, offsets)


def main() -> None:
    """Print the tables of the page."""
    print("grid width  surface   rms px   worst px")
    for width in (2.5, 5.0, 10.0):
        outcome = run(width)
        for name in ("hybrid", "grid"):
            print(f"{outcome.width:8.1f} m  {name:8} {outcome.rms(name):7.3f} {outcome.worst(name):10.3f}")
    print(f"{'':10}  {'truth':8} {outcome.rms('truth'):7.3f} {outcome.worst('truth'):10.3f}")
    print("error of lines  worst px of six measurements with the hybrid model, grid width 5 m")
    for sigma in (0.01, 0.02, 0.03, 0.05):
        worst = [run(5.0, seed, sigma).worst("hybrid") for seed in range(6)]
        print(f"{sigma:12.2f} m  {min(worst):.2f} to {max(worst):.2f}")


if __name__ == "__main__":
    main()
