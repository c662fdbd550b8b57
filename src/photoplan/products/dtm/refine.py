"""A finer terrain model takes the place of a coarse one inside polygons."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from photoplan.errors import InputError
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.heights import common_system
from photoplan.io.polygons import read_features
from photoplan.io.product import check_output
from photoplan.io.run_record import run_key
from photoplan.io.terrain.model_read import ModelReader
from photoplan.io.terrain.model_tables import GrossError, ModelHeader, empty_figures, input_facts
from photoplan.io.terrain.model_write import ModelParts, ModelWriter
from photoplan.plain import pick
from photoplan.project.open_terrain import open_terrain
from photoplan.requests.terrain import RefineRequest
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.raster_units import RasterUnits
from photoplan.surfaces.refined_units import LinedUnits, refine_units
from photoplan.surfaces.units import LineElement, Unit, UnitFigures, unit_range


@dataclass(frozen=True)
class RefineReport(Result):
    """What came out."""

    path: Path
    units: int
    """Units of the model that have a surface."""
    changed: int
    """Those that differ from the coarse model's."""
    lines: int
    largest: float
    """Largest change of a post that both have, metres; NaN: there is none."""

    def json_fields(self) -> dict[str, Any]:
        """Counts, and the largest change in metres."""
        return pick(self, "units", "changed", "lines", model="path", largest_change="largest")

    def messages(self) -> Sequence[str]:
        """Return the number of new units and the largest change."""
        change = f", largest change of a post {self.largest:.3f} m" if self.largest == self.largest else ""
        return [f"{self.changed} of {self.units} units are new{change}; {self.lines} lines"]


def dtm_refine(request: RefineRequest, events: Events = SILENT) -> RefineReport:
    """Write the coarse model with the fine one inside the polygons.

    Raises
    ------
    UsageError
        The output exists or is an input.
    HeightSystemError
        Height systems differ, or are not stated.
    InputError
        A file cannot be used, CRSs differ, or the polygons touch no unit.
    """
    inputs = [request.coarse, request.fine, request.polygons]
    check_output(request.output, inputs, overwrite=request.overwrite)
    coarse, fine = (_Model.open(path, request.crs) for path in (request.coarse, request.fine))
    if not same_crs(coarse.header.crs, fine.header.crs):
        raise InputError(
            f"{coarse.path} is in {crs_label(coarse.header.crs)}, {fine.path} in {crs_label(fine.header.crs)}; build "
            "both in one CRS"
        )
    stated = {reader.path: reader.header.height_system for reader in (coarse, fine)}
    system = common_system(stated, request.height_system)
    polygons = _polygons(request, coarse)
    width = request.width if request.width is not None else fine.units.finest
    with ModelWriter(
        path=request.output,
        layout=coarse.header.layout,
        run_key=_key(request, coarse, fine),
        overwrite=request.overwrite,
        inputs=inputs,
    ) as writer:
        units, lines = refine_units(
            coarse.lined(),
            fine.lined(polygons.bounds),
            polygons,
            request.transition,
            width,
        )
        if not units:
            raise InputError(f"{request.polygons}: the polygons touch no unit of {coarse.path}")
        _add(writer, coarse, units, lines)
        reader = writer.finish(_parts(request, coarse, fine, system, polygons, width, lines))
    there = int(np.isfinite(reader.ranges[..., 0]).sum())
    return RefineReport(
        path=request.output, units=there, changed=len(units), lines=len(lines), largest=_largest(coarse, units)
    )


@dataclass(frozen=True, eq=False)
class _Model:
    """A terrain model, or a raster of heights as one without lines."""

    path: Path
    header: ModelHeader
    units: ModelReader | RasterUnits
    reader: ModelReader | None
    """None: a raster."""

    @classmethod
    def open(cls, path: Path, crs: str | None) -> _Model:
        opened = open_terrain(path, crs)
        if opened.model is not None:
            return cls(path, opened.model.header, opened.model, opened.model)
        assert isinstance(opened.surface, RasterSurface)
        try:
            units = RasterUnits(opened.surface)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        header = ModelHeader(opened.crs, opened.height_system, units.layout, identity=str(input_facts(path)))
        return cls(path, header, units, None)

    def lined(self, bounds: tuple[float, float, float, float] | None = None) -> LinedUnits:
        """Its units with its lines in some bounds."""
        return LinedUnits(self.units, () if self.reader is None else self.reader.lines(bounds), self.domain)

    @property
    def domain(self) -> Any | None:
        """Polygon of its borders, if it has any."""
        return None if self.reader is None else self.reader.domain()

    def unit(self, column: int, row: int) -> tuple[Unit | None, UnitFigures]:
        """A unit, None if it is empty, and its figures."""
        unit = self.units.unit(column, row)
        figures = self.figures.get((column, row), empty_figures(column, row))
        if self.reader is None and unit is not None:
            low, high = unit_range(unit)
            figures = replace(figures, meshes=unit.meshes, low=low, high=high)
        return unit, figures

    @cached_property
    def figures(self) -> dict[tuple[int, int], UnitFigures]:
        """Figures of its units by column and row."""
        return {} if self.reader is None else {(f.column, f.row): f for f in self.reader.figures()}


def _polygons(request: RefineRequest, coarse: _Model) -> Any:
    read = read_features(request.polygons, "Polygon", crs=coarse.header.crs)
    return shapely.union_all([shapely.force_2d(item.geometry) for item in read.items])


def _key(request: RefineRequest, coarse: _Model, fine: _Model) -> str:
    decides = [
        coarse.header.identity,
        fine.header.identity,
        request.transition,
        request.width,
        request.height_system,
        request.crs,
    ]
    return run_key("refined model", decides, [request.polygons])


def _add(
    writer: ModelWriter, coarse: _Model, units: dict[tuple[int, int], Unit], lines: tuple[LineElement, ...]
) -> None:
    """All units into the new model."""
    done = writer.done()
    boxes = shapely.STRtree([shapely.LineString(line.xyz[:, :2]) for line in lines])
    layout = coarse.header.layout
    for row in range(layout.rows):
        for column in range(layout.columns):
            at = column, row
            if at not in done:
                (old, figures), new = coarse.unit(column, row), units.get(at)
                writer.add(new or old, figures if new is None else _figures(new, old, figures, boxes))


def _figures(unit: Unit, old: Unit | None, before: UnitFigures, lines: shapely.STRtree) -> UnitFigures:
    """Figures of a new unit: where it joins two models, what was estimated for one of them does not hold for it."""
    low, high = unit_range(unit)
    known = unit.sigmas[np.isfinite(unit.sigmas)].astype(float)
    sigma = float(np.sqrt((known**2).mean())) if known.size else math.nan
    box = shapely.box(unit.left, unit.top - unit.side, unit.left + unit.side, unit.top)
    count = len(lines.query(box, predicate="intersects"))
    after = replace(before, meshes=unit.meshes, low=low, high=high, lines=count, sigma=sigma)
    if old is not None and np.array_equal(unit.heights, old.heights, equal_nan=True):
        # Only its triangles are new: finer posts adjoin.
        return after
    nan = math.nan
    return replace(after, variance=nan, length=nan, noise=nan, spread=nan)


def _parts(
    request: RefineRequest,
    coarse: _Model,
    fine: _Model,
    system: str | None,
    polygons: Any,
    width: float,
    lines: tuple[LineElement, ...],
) -> ModelParts:
    """All but the units."""
    settings = {"transition": request.transition, "width": width}
    header = ModelHeader(
        coarse.header.crs,
        system,
        coarse.header.layout,
        settings={"refined": settings, "coarse": coarse.header.settings, "fine": fine.header.settings},
        inputs=tuple(input_facts(path) for path in (request.coarse, request.fine, request.polygons)),
        family=coarse.header.family,
    )
    shapely.prepare(polygons)

    def merged(outside: list[GrossError], inside: list[GrossError]) -> list[GrossError]:
        kept = [g for g in outside if not shapely.intersects_xy(polygons, *g.xyz[:2])]
        return kept + [g for g in inside if shapely.intersects_xy(polygons, *g.xyz[:2])]

    of_both = [model.reader for model in (coarse, fine)]
    gross = merged(*([] if reader is None else reader.gross() for reader in of_both))
    suspects = merged(*([] if reader is None else reader.suspects() for reader in of_both))
    outer, inner = coarse.domain, fine.domain
    domain = None
    if outer is not None or inner is not None:
        # Inside the polygons the fine model's border counts, outside the coarse one's.
        outer = shapely.box(*coarse.header.layout.bounds) if outer is None else outer
        domain = outer.difference(polygons).union(polygons if inner is None else polygons.intersection(inner))
        areas = [p for p in shapely.get_parts(domain) if p.geom_type == "Polygon" and p.area > 0]
        domain = shapely.multipolygons(areas)
    return ModelParts(header=header, lines=lines, gross=gross, domain=domain, suspects=suspects)


def _largest(coarse: _Model, units: dict[tuple[int, int], Unit]) -> float:
    """Largest change of a post that both models have."""
    largest = math.nan
    for (column, row), unit in units.items():
        old, _ = coarse.unit(column, row)
        if old is None or unit.meshes % old.meshes:
            continue
        step = unit.meshes // old.meshes
        change = (unit.heights[::step, ::step] + unit.datum) - (old.heights + old.datum)
        if np.isfinite(change).any():
            largest = max(float(np.nanmax(np.abs(change))), largest if math.isfinite(largest) else 0.0)
    return largest
