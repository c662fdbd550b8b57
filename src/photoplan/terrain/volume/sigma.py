"""Standard deviation of a volume from the standard deviations of two surfaces and the reach of their errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import convolve1d

from photoplan.errors import UsageError
from photoplan.geometry.grid import MapGrid
from photoplan.surfaces.base import Terrain
from photoplan.terrain.volume.region import cover

#: Cells of the field of errors that is held in memory; regions with more are computed by the formula of large areas.
MOST_CELLS = 6_000_000
TILE = 512


@dataclass(frozen=True)
class ErrorModel:
    """How the heights of one surface err."""

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

    A volume is V = ∫ (h_B − h_A) dF, so errors of the heights with standard deviation σ(x) and correlation ρ give it

        σ_V² = Σ over A and B of ∬ σ(x) σ(y) ρ(|x − y|) dF_x dF_y  +  (bias · F)²,      ρ(r) = exp(−r² / L²).

    The double integral is a sum over cells, smoothed by ρ. For a region much wider than L it becomes π L² ∫ σ² dF,
    which is used where the region has too many cells of about L for the memory. `bias` is the standard deviation of an
    error that both surfaces' difference has everywhere alike, such as that of their height datums; F is the area.
    For cut and fill the integrals go over the area where A, or B, is the higher one.

    Parameters
    ----------
    a, b : Terrain
    errors : (ErrorModel, ErrorModel)
        How the heights of A and of B err.
    polygon : shapely Polygon or MultiPolygon
    cell : float
        Side of the cells at most, metres.
    bias : float
        Metres.
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
    grid = MapGrid.covering(tuple(float(v) for v in polygon.bounds), side, "")  # type: ignore[arg-type]
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
