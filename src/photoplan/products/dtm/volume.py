"""Cut and fill between two terrain files, for each polygon of a file or where both exist."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.engine.steps import steps
from photoplan.errors import InputError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import USUAL_TILE, MapGrid, Window, check_resolution, refuse_absurd
from photoplan.geometry.heights import common_system
from photoplan.io.polygons import Feature, read_features
from photoplan.io.product import check_output
from photoplan.io.result_log import ResultLog
from photoplan.plain import pick
from photoplan.products.dtm.raster import GridOptions, write_grid
from photoplan.project.open_terrain import OpenTerrain, open_terrain
from photoplan.requests.terrain import VolumeRequest
from photoplan.targets.map import MapTarget
from photoplan.terrain.volume import TILE, ErrorModel, Volume, VolumeSettings, VolumeSigma, volume_between, volume_sigma


@dataclass(frozen=True)
class VolumeRow:
    """Figures of one polygon."""

    name: str
    volume: Volume
    sigma: VolumeSigma | None

    def json_fields(self) -> dict[str, Any]:
        """m³, m², metres."""
        v, s = self.volume, self.sigma
        errors = {f"integration_error_{name}": f"error_{name}" for name in ("cut", "fill", "net")}
        sigmas = {f"sigma_{name}": None if s is None else getattr(s, name) for name in ("cut", "fill", "net")}
        own = pick(
            v, "cut", "fill", "net", "area", "cell", area_without_model="missing", within_tolerance="settled", **errors
        )
        return {"polygon": self.name, **own, **sigmas}


@dataclass(frozen=True)
class VolumeReport(Result):
    """What came out."""

    rows: tuple[VolumeRow, ...]
    height_system: str
    notes: tuple[str, ...]
    """What a reader of the figures must know."""
    difference: Path | None

    def json_fields(self) -> dict[str, Any]:
        """The rows as volumes."""
        return pick(self, "height_system", "difference", "notes", volumes="rows")

    def summary(self) -> Sequence[str]:
        """Return the table of volumes."""
        w = max(7, *(len(row.name) for row in self.rows))
        lines = [f"{'polygon':<{w}}  {'cut m³':>14} {'fill m³':>14} {'net m³':>14} {'area m²':>13} {'no model m²':>13}"]
        for name, v, s in ((row.name, row.volume, row.sigma) for row in self.rows):
            areas = f"{v.area:>13.1f} {v.missing:>13.1f}"
            lines.append(f"{name:<{w}}  {v.cut:>14.2f} {v.fill:>14.2f} {v.net:>14.2f} {areas}")
            changes = f"{v.error_cut:>13.2g}i {v.error_fill:>13.2g}i {v.error_net:>13.2g}i"
            lines.append(f"{'':<{w}}  {changes}  cells {v.cell:g} m")
            if s is not None:
                lines.append(f"{'':<{w}}  {s.cut:>13.2f}σ {s.fill:>13.2f}σ {s.net:>13.2f}σ")
        return [*lines, "i: change with the last halving of the cells; σ: standard deviation from that of the heights"]

    def messages(self) -> Sequence[str]:
        """Return the height system and the notes."""
        return [f"height system: {self.height_system}", *noted(self.notes)]


def dtm_volume(request: VolumeRequest, events: Events = SILENT) -> VolumeReport:
    """Volumes from terrain A to terrain B.

    Raises
    ------
    UsageError
        The raster of differences exists, or is an input.
    HeightSystemError
        The height systems differ, or are not stated.
    InputError
        A file cannot be used, CRSs differ, or the two models have nothing in common.
    """
    inputs = [request.a, request.b, *([request.polygons] if request.polygons else [])]
    if request.difference is not None:
        check_output(request.difference, inputs, overwrite=request.overwrite, raster=True)
    a, b = (open_terrain(path, request.crs) for path in (request.a, request.b))
    system = common_system({t.path: t.height_system for t in (a, b)}, request.height_system) or "same, not named"
    if not same_crs(a.crs, b.crs):
        raise InputError(
            f"{a.path} is in {crs_label(a.crs)}, {b.path} in {crs_label(b.crs)}; bring both into one CRS first"
        )
    items = _polygons(request.polygons, a, b)
    cell = request.resolution or min(a.resolution, b.resolution)
    check_resolution(cell / 2)
    for item in items:
        xmin, ymin, xmax, ymax = item.geometry.bounds
        halves = 2 * (xmax - xmin) / cell, 2 * (ymax - ymin) / cell
        refuse_absurd(halves, USUAL_TILE, f"{item.name}: resolution {cell:g} m, halved to see how exact it is,")
    settings = VolumeSettings(cell, 0.0 if request.resolution else request.tolerance)
    errors, notes = _errors(request, a, b)
    options = GridOptions.of(request, "difference", inputs, events, tile=TILE)
    log = None
    if request.difference is not None:
        log = ResultLog.beside(request.difference, f"{options.key} {settings}", locked=False)
    events.begin("volumes", 0, "windows")
    rows = []
    # One window at once: a prepared polygon makes its index when it is first asked, whoever else asks it meanwhile.
    with log or nullcontext(), steps("volumes", 1, events, log) as run:

        def counted(function: Callable[[Any], Any], windows: Iterable[Any]) -> Iterator[Any]:
            # How often cells are halved is not known beforehand: each round adds its windows to the total.
            every = list(windows)
            events.more(len(every))
            return run(function, every)

        for item in items:
            volume, sigma = volume_between(a.surface, b.surface, item.geometry, settings, counted), None
            if errors is not None:
                of_errors = partial(volume_sigma, a.surface, b.surface, errors, cell=cell, bias=request.bias)
                (sigma,) = counted(of_errors, [item.geometry])
            rows.append(VolumeRow(item.name, volume, sigma))
    notes += [note for row in rows for note in _notes(row)]
    if log is not None and request.difference is not None:
        _write_difference(request.difference, (a, b), items, cell, options)
        log.remove()
    return VolumeReport(tuple(rows), system, tuple(notes), request.difference)


def _notes(row: VolumeRow) -> list[str]:
    """What is to be said about one polygon."""
    notes = []
    if row.sigma is not None and row.sigma.unknown > 0:
        notes.append(f"{row.name}: on {row.sigma.unknown:.6g} m² a model has no standard deviation")
    if not row.volume.settled:
        notes.append(f"{row.name}: not within the tolerance; see the change with the last halving of the cells")
    return notes


def _polygons(path: Path | None, a: OpenTerrain, b: OpenTerrain) -> tuple[Feature, ...]:
    """The polygons, or the rectangle that both models share."""
    common = np.maximum(a.bounds[:2], b.bounds[:2]), np.minimum(a.bounds[2:], b.bounds[2:])
    if not (common[0] < common[1]).all():
        raise InputError(f"{a.path} covers {_text(a.bounds)}, {b.path} {_text(b.bounds)}: they have nothing in common")
    if path is None:
        return (Feature("all", shapely.box(*common[0], *common[1])),)
    read = read_features(path, "Polygon", crs=a.crs)
    return tuple(Feature(item.name, shapely.force_2d(item.geometry)) for item in read.items)


def _text(bounds: tuple[float, float, float, float]) -> str:
    return " ".join(f"{v:.10g}" for v in bounds)


def _errors(
    request: VolumeRequest, a: OpenTerrain, b: OpenTerrain
) -> tuple[tuple[ErrorModel, ErrorModel] | None, list[str]]:
    """How both models err, or why the volumes have no standard deviation."""
    models = []
    for letter, terrain, given in (("a", a, request.sigma_a), ("b", b, request.sigma_b)):
        sigma = given if given is not None else _own(terrain)
        if sigma is None:
            return None, [f"no standard deviation: {terrain.path} has none of its own; give `sigma_{letter}` METRES"]
        models.append(ErrorModel(sigma, request.correlation or terrain.resolution))
    return (models[0], models[1]), []


def _own(terrain: OpenTerrain) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
    return None if terrain.errors is None else terrain.errors.sigmas


def _write_difference(
    path: Path, both: tuple[OpenTerrain, OpenTerrain], items: tuple[Feature, ...], cell: float, options: GridOptions
) -> None:
    """B − A as a raster over all polygons."""
    a, b = both
    bounds = shapely.total_bounds(np.array([item.geometry for item in items], object))
    grid = MapGrid.covering(tuple(float(v) for v in bounds), cell, a.crs)  # type: ignore[arg-type]
    target = MapTarget(grid)

    def tile(window: Window) -> NDArray[np.float32]:
        return np.asarray(b.surface.relief(target, window) - a.surface.relief(target, window))[None]

    write_grid(path, grid.placement, np.float32, 1, "auto", tile, options)
