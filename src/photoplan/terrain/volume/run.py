"""Cut and fill between two surfaces: the integral of their difference over a polygon."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.surfaces.base import Terrain
from photoplan.targets.map import MapTarget
from photoplan.terrain.volume.region import CoveredCells, cover

#: Side of the windows that are held in memory at once, cells.
TILE = 512
#: Times that the cell is halved at most while the integral still changes.
MOST_HALVINGS = 5


@dataclass(frozen=True)
class Sums:
    """An integral over one polygon with cells of one size, in m³ and m²."""

    cut: float = 0.0
    fill: float = 0.0
    area: float = 0.0
    """Where both surfaces exist."""
    missing: float = 0.0
    """Inside the polygon, but without one of the surfaces."""


@dataclass(frozen=True)
class Volume:
    """What lies between surface A and surface B inside one polygon."""

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
    """How much `cut` changed when the cells were halved last, m³. For a smooth difference the error left is a third
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
    """How finely to integrate."""

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


def volume_between(
    a: Terrain,
    b: Terrain,
    polygon: Any,
    settings: VolumeSettings,
    progress: Callable[[int, int], None] | None = None,
) -> Volume:
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
    settings : VolumeSettings
    progress : callable, optional
        Called with 1 and the number of cells when a window is finished.
    """
    shapely.prepare(polygon)
    cell = settings.cell
    coarse = integrate(a, b, polygon, cell, progress)
    for _ in range(MOST_HALVINGS):
        cell /= 2
        fine = integrate(a, b, polygon, cell, progress)
        change = abs(fine.cut - coarse.cut), abs(fine.fill - coarse.fill)
        settled = max(change) <= settings.tolerance * (fine.cut + fine.fill)
        if settled or settings.tolerance == 0:
            break
        coarse, last = fine, coarse
    else:
        coarse = last
    net = abs(fine.fill - fine.cut - coarse.fill + coarse.cut)
    return Volume(fine.cut, fine.fill, fine.area, fine.missing, cell, *change, net, settled or settings.tolerance == 0)


def integrate(
    a: Terrain, b: Terrain, polygon: Any, cell: float, progress: Callable[[int, int], None] | None = None
) -> Sums:
    """The integral with cells of one size; grids of all sizes share their edges at multiples of the cell."""
    grid = MapGrid.covering(tuple(float(v) for v in polygon.bounds), cell, "")  # type: ignore[arg-type]
    sums = Sums()
    for window in grid.window.tiles(TILE):
        covered = cover(polygon, grid, window)
        if covered is not None:
            sums = _add(sums, a, b, grid, window, covered)
        if progress is not None:
            progress(1, window.size)
    return sums


def _add(sums: Sums, a: Terrain, b: Terrain, grid: MapGrid, window: Window, covered: CoveredCells) -> Sums:
    """The sums with those of one window."""
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
    return replace(
        sums,
        cut=sums.cut - float(volume[volume < 0].sum()),
        fill=sums.fill + float(volume[volume > 0].sum()),
        area=sums.area + float(area[there].sum()),
        missing=sums.missing + float(area[~there].sum()),
    )
