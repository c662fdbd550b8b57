"""Cut and fill between two surfaces: the integral of their difference over a polygon, and its standard deviation."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass
from functools import partial
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from photoplan.codec import storable
from photoplan.errors import UsageError
from photoplan.events import Map
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Terrain
from photoplan.targets.map import MapTarget

#: Side of the windows that are held in memory at once, cells.
TILE = 512
#: Times that the cell is halved at most while the integral still changes.
MOST_HALVINGS = 5


@storable
@dataclass(frozen=True)
class Sums:
    """An integral over one polygon with cells of one size, in m³ and m²."""

    cut: float = 0.0
    fill: float = 0.0
    area: float = 0.0
    """Area in which both surfaces exist."""
    missing: float = 0.0
    """Inside the polygon, but without one of the surfaces."""


@dataclass(frozen=True)
class Volume:
    """Volumes between surface A and surface B inside one polygon, with their standard deviations."""

    cut: float
    """Volume where A lies above B, m³: what is taken away on the way from A to B."""
    fill: float
    """Volume where B lies above A, m³."""
    area: float
    """Area on which both surfaces exist, m²."""
    missing: float
    """Area of the polygon on which one of them does not, m²: holes, about which the volume says nothing."""
    cell: float
    """Side of the cells of the integration, metres."""
    error_cut: float
    """Change of `cut` when the cells were halved last, m³. For a smooth difference the error left is a third
    of it (Richardson's extrapolation of an error of second order), at breaklines up to about as much."""
    error_fill: float
    error_net: float
    settled: bool
    """Whether these are within the tolerance."""

    @property
    def net(self) -> float:
        """Fill minus cut, m³: the integral of B − A."""
        return self.fill - self.cut


@dataclass(frozen=True)
class VolumeSettings:
    """Options of the integration of a volume."""

    cell: float
    """Side of the cells to begin with, metres; the usual choice is the finer of the two mesh widths."""
    tolerance: float = 1e-3
    """Cells are halved until cut and fill change by no more than this part of cut + fill; 0: cells of `cell` and of
    half of it are compared, and no more is done."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.cell) and self.cell > 0):
            raise UsageError(f"cells of {self.cell} m; a positive number of metres is needed")
        if not 0 <= self.tolerance < 1:
            raise UsageError(f"tolerance {self.tolerance}; a part of the volume from 0 to below 1 is needed")


def volume_between(a: Terrain, b: Terrain, polygon: Any, settings: VolumeSettings, run: Map = map) -> Volume:
    """Cut and fill from surface A to surface B inside a polygon.

    The difference B − A is taken at the middle of square cells (midpoint rule), its positive and negative values are
    summed apart. Cells on the polygon's edge count with the part of them that is inside, the difference taken at that
    part's centroid, so that a linear difference is integrated exactly whatever the polygon. The integral is computed
    with cells of two sizes; the change says how exact it is. Places where one surface has no height are counted, not
    filled.

    Parameters
    ----------
    a, b : Terrain
        In one CRS and one height system.
    polygon : shapely Polygon or MultiPolygon
    run : callable
        ``map``, or what computes windows as it does.
    """
    shapely.prepare(polygon)
    cell = settings.cell
    coarse = integrate(a, b, polygon, cell, run)
    for _ in range(MOST_HALVINGS):
        cell /= 2
        fine = integrate(a, b, polygon, cell, run)
        change = abs(fine.cut - coarse.cut), abs(fine.fill - coarse.fill)
        settled = max(change) <= settings.tolerance * (fine.cut + fine.fill)
        if settled or settings.tolerance == 0:
            break
        coarse, last = fine, coarse
    else:
        coarse = last
    net = abs(fine.fill - fine.cut - coarse.fill + coarse.cut)
    return Volume(fine.cut, fine.fill, fine.area, fine.missing, cell, *change, net, settled or settings.tolerance == 0)


def integrate(a: Terrain, b: Terrain, polygon: Any, cell: float, run: Map = map) -> Sums:
    """The integral with cells of one size; grids of all sizes share their edges at multiples of the cell."""
    grid = MapGrid.covering(tuple(float(v) for v in polygon.bounds), cell, None)  # type: ignore[arg-type]
    total = Sums()
    for part in run(partial(_window_sums, a, b, polygon, grid), grid.window.tiles(TILE)):
        total = Sums(*(x + y for x, y in zip(astuple(total), astuple(part))))
    return total


def _window_sums(a: Terrain, b: Terrain, polygon: Any, grid: MapGrid, window: Window) -> Sums:
    covered = cover(polygon, grid, window)
    if covered is None:
        return Sums()
    parts: list[NDArray[np.float64]] = []
    areas: list[NDArray[np.float64]] = []
    if covered.whole.any():
        target = MapTarget(grid)
        inside = b.relief(target, window).astype(float) - a.relief(target, window).astype(float)
        parts.append(inside[covered.whole])
        areas.append(np.full(len(parts[0]), grid.resolution**2))
    if len(covered.areas):
        parts.append(b.heights(covered.centroids) - a.heights(covered.centroids))
        areas.append(covered.areas)
    d: NDArray[np.float64] = np.concatenate(parts)
    area = np.concatenate(areas)
    there = np.isfinite(d)
    volume = d[there] * area[there]
    return Sums(
        cut=-float(volume[volume < 0].sum()),
        fill=float(volume[volume > 0].sum()),
        area=float(area[there].sum()),
        missing=float(area[~there].sum()),
    )


@dataclass(frozen=True, eq=False)
class CoveredCells:
    """Cells of a window that lie in a polygon."""

    whole: NDArray[np.bool_]
    """True where the whole cell lies inside, shape (height, width)."""
    rows: NDArray[np.int64]
    """Row in the window of each cell that the polygon's edge crosses, shape (n,)."""
    columns: NDArray[np.int64]
    areas: NDArray[np.float64]
    """Covered part of each of these cells, shape (n,), square metres."""
    centroids: NDArray[np.float64]
    """X, Y of the covered part's centroid, shape (n, 2): a linear function times the area is integrated exactly."""


def cover(polygon: Any, grid: MapGrid, window: Window) -> CoveredCells | None:
    """Cells of a window that lie inside a polygon; None if none does.

    Blocks of cells are halved until they lie inside or outside, so that the cost follows the polygon's length, not its
    area. A polygon that is prepared (`shapely.prepare`) is looked at faster.
    """
    whole = np.zeros((window.height, window.width), bool)
    blocks = np.array([[0, 0, window.height, window.width]])
    edge: list[NDArray[np.int64]] = []
    while len(blocks):
        boxes = _boxes(grid, window, blocks)
        touched = shapely.intersects(polygon, boxes)
        blocks, boxes = blocks[touched], boxes[touched]
        inside = shapely.covers(polygon, boxes)
        for row0, col0, row1, col1 in blocks[inside]:
            whole[row0:row1, col0:col1] = True
        blocks = blocks[~inside]
        single = (blocks[:, 2] - blocks[:, 0] == 1) & (blocks[:, 3] - blocks[:, 1] == 1)
        edge.append(blocks[single])
        blocks = _halves(blocks[~single])
    cells = np.concatenate(edge) if edge else np.empty((0, 4), np.int64)
    parts = shapely.intersection(polygon, _boxes(grid, window, cells))
    areas = shapely.area(parts)
    keep = areas > 0
    if not (whole.any() or keep.any()):
        return None
    centroids = shapely.get_coordinates(shapely.centroid(parts[keep]))
    return CoveredCells(
        whole=whole, rows=cells[keep, 0], columns=cells[keep, 1], areas=areas[keep], centroids=centroids
    )


def _boxes(grid: MapGrid, window: Window, blocks: NDArray[np.int64]) -> NDArray[Any]:
    left = grid.left + (window.col + blocks[:, 1]) * grid.resolution
    right = grid.left + (window.col + blocks[:, 3]) * grid.resolution
    top = grid.top - (window.row + blocks[:, 0]) * grid.resolution
    bottom = grid.top - (window.row + blocks[:, 2]) * grid.resolution
    return np.asarray(shapely.box(left, bottom, right, top))


def _halves(blocks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Each block cut into four, those without cells left out."""
    row0, col0, row1, col1 = blocks.T
    row, col = (row0 + row1 + 1) // 2, (col0 + col1 + 1) // 2
    parts = [(row0, col0, row, col), (row0, col, row, col1), (row, col0, row1, col), (row, col, row1, col1)]
    quarters = np.concatenate([np.stack(part, axis=1) for part in parts])
    return quarters[(quarters[:, 2] > quarters[:, 0]) & (quarters[:, 3] > quarters[:, 1])]


#: Cells of the field of errors that is held in memory; regions with more are computed by the formula of large areas.
MOST_CELLS = 6_000_000


@dataclass(frozen=True)
class ErrorModel:
    """Error model of the heights of one surface."""

    sigma: float | Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """Standard deviation of the heights, metres: one number, or a function of map points (n, 2)."""
    length: float
    """Correlation length L, metres: errors at distance r are correlated by exp(−r² / L²)."""

    def __post_init__(self) -> None:
        if not (np.isfinite(self.length) and self.length > 0):
            raise UsageError(f"correlation length {self.length} m; a positive number of metres is needed")
        if not callable(self.sigma) and not (np.isfinite(self.sigma) and self.sigma >= 0):
            raise UsageError(f"standard deviation {self.sigma} m; zero or a positive number of metres is needed")

    def at(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviations at map points (n, 2)."""
        return np.asarray(self.sigma(XY), float) if callable(self.sigma) else np.full(len(XY), float(self.sigma))


@storable
@dataclass(frozen=True)
class VolumeSigma:
    """Standard deviations of a volume, m³."""

    cut: float
    fill: float
    net: float
    unknown: float
    """Area on which a surface has a height but no standard deviation, m²: it is left out of the three above."""


def volume_sigma(
    a: Terrain, b: Terrain, errors: tuple[ErrorModel, ErrorModel], polygon: Any, cell: float, bias: float = 0.0
) -> VolumeSigma:
    """Standard deviation of the volume between two surfaces inside a polygon.

    A volume is V = ∫ (h_B − h_A) dF, so errors of the heights with standard deviation σ(x) and correlation ρ give it::

        σ_V² = Σ over A and B of ∬ σ(x) σ(y) ρ(|x − y|) dF_x dF_y  +  (bias · F)²,      ρ(r) = exp(−r² / L²).

    The double integral is a sum over cells, smoothed by ρ. For a region much wider than L it becomes π L² ∫ σ² dF,
    which is used where the region has too many cells of about L for the memory. `bias` is the standard deviation of an
    error that both surfaces' difference has everywhere alike, such as that of their height datums; F is the area.
    For cut and fill the integrals go over the area where A, or B, is the higher one.
    """
    if not (np.isfinite(bias) and bias >= 0):
        raise UsageError(f"bias {bias} m; a standard deviation of zero or more metres is needed")
    shapely.prepare(polygon)
    variance, area, unknown = np.zeros(3), np.zeros(3), 0.0
    for model in errors:
        found = _fields(a, b, model, polygon, cell)
        variance += [_variance(field, model.length, found.side) for field in found.fields]
        area, unknown = found.areas, max(unknown, found.unknown)
    variance += (bias * area) ** 2
    cut, fill, net = np.sqrt(variance)
    return VolumeSigma(float(cut), float(fill), float(net), unknown)


@dataclass(frozen=True, eq=False)
class _Fields:
    """σ · area of each cell in the area of cut, of fill and of both; these areas; the side of the cells.

    Fields of one dimension hold cells that are taken as uncorrelated, with their variance made up for it.
    """

    fields: list[NDArray[np.float64]]
    areas: NDArray[np.float64]
    unknown: float
    side: float


def _fields(a: Terrain, b: Terrain, model: ErrorModel, polygon: Any, cell: float) -> _Fields:
    side = _side(model.length, cell, polygon)
    grid = MapGrid.covering(tuple(float(v) for v in polygon.bounds), side, None)  # type: ignore[arg-type]
    dense = grid.window.size <= MOST_CELLS and side <= model.length
    fields = [np.zeros((grid.height, grid.width)) for _ in range(3)] if dense else []
    sums, areas, unknown = np.zeros(3), np.zeros(3), 0.0
    for window in grid.window.tiles(TILE):
        covered = cover(polygon, grid, window)
        if covered is None:
            continue
        rows, columns = np.nonzero(covered.whole)
        XY = grid.to_map(np.stack([columns + window.col, rows + window.row], axis=-1))
        XY = np.concatenate([XY, covered.centroids])
        rows, columns = np.append(rows, covered.rows), np.append(columns, covered.columns)
        weight = np.append(np.full(len(XY) - len(covered.areas), side**2), covered.areas)
        d = b.heights(XY) - a.heights(XY)
        sigma = model.at(XY)
        known = np.isfinite(sigma)
        unknown += float(weight[np.isfinite(d) & ~known].sum())
        for k, inside in enumerate((d < 0, d > 0, np.isfinite(d))):
            areas[k] += weight[inside].sum()
            here = inside & known
            sums[k] += float((sigma[here] ** 2 * weight[here]).sum())
            if dense:
                fields[k][rows[here] + window.row, columns[here] + window.col] = sigma[here] * weight[here]
    if not dense:
        fields = [np.array([math.sqrt(math.pi * model.length**2 * total)]) for total in sums]
    return _Fields(fields, areas, unknown, side)


def _side(length: float, cell: float, polygon: Any) -> float:
    """Cells a third of the correlation length wide, or a little wider where that many do not fit, never below `cell`
    by more than a power of two."""
    side = min(cell, length)
    while side * 2 <= length / 3:
        side *= 2
    xmin, ymin, xmax, ymax = polygon.bounds
    while (xmax - xmin) * (ymax - ymin) / side**2 > MOST_CELLS and side * 2 <= length:
        side *= 2
    return side


def _variance(field: NDArray[np.float64], length: float, side: float) -> float:
    """Σ Σ f_i f_j ρ_ij of a field of cells."""
    if field.ndim == 1:
        return float((field**2).sum())
    reach = math.ceil(3.5 * length / side)
    kernel = np.exp(-((np.arange(-reach, reach + 1) * side / length) ** 2))
    smooth = convolve1d(convolve1d(field, kernel, axis=0, mode="constant"), kernel, axis=1, mode="constant")
    return float((field * smooth).sum())
