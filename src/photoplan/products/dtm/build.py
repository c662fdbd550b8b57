"""Building and refining terrain models."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
import psutil
import shapely
from numpy.typing import NDArray

from photoplan.engine.run import steps
from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.events import SILENT, Events
from photoplan.findings import Result, noted
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.heights import check_height_system, common_system, height_label
from photoplan.geometry.units import metric_heights
from photoplan.io.product import check_output
from photoplan.io.store import ResultLog, run_key, run_times, together, when_named, write_run_record
from photoplan.io.tables import Dialect
from photoplan.io.terrain.files import read_measured
from photoplan.io.terrain.model import GrossError, ModelHeader, ModelReader, empty_figures, input_facts
from photoplan.io.terrain.model_write import ModelParts, ModelWriter
from photoplan.io.terrain.options import CodeTable, ReadOptions, read_code_table
from photoplan.io.vector_layer import read_features
from photoplan.plain import pick
from photoplan.project.ground import open_terrain
from photoplan.requests.terrain import BuildRequest, RefineRequest
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.refined_units import LinedUnits, RasterUnits, refine_units
from photoplan.surfaces.units import LineElement, MeasuredTerrain, Unit, UnitFigures, unit_range
from photoplan.terrain.build import BuildPlan, Built, build_terrain, plan_build
from photoplan.terrain.clean import Finding, clean
from photoplan.terrain.fit import ClassFigures
from photoplan.terrain.observations import BuildSettings

#: Bytes that a build needs for each point, measured; more than the machine has is refused before any work.
_BYTES_PER_POINT = 700
#: Findings, gross errors and notes that are printed; all are in the report, in the model and in the JSON.
_SHOWN = 10


@dataclass(frozen=True, eq=False)
class BuildReport(Result):
    """A terrain model that was built."""

    path: Path
    figures: dict[str, Any]
    """Figures of the whole model."""
    gross: tuple[GrossError, ...]
    suspects: tuple[GrossError, ...]
    """Used, but they look like parts of gross errors; group by group."""
    findings: tuple[Finding, ...]
    built: Built
    measured: MeasuredTerrain
    """The clean measurements that the model was built from."""
    inputs: tuple[Path, ...] = ()

    def written(self) -> list[Path]:
        """Return the model."""
        return [self.path]

    def messages(self) -> list[str]:
        """Return the figures of the model, the first gross errors and findings, and the notes."""
        f = self.figures
        lines = [
            f"{f['points']} points in {f['seconds']:.1f} s · {f['units']} units, grid "
            + ", ".join(f"{width} m ({count})" for width, count in f["grid_widths"].items()),
            f"covariance {f['covariance']}: signal ±{f['variance'] ** 0.5:.3f} m, half at {f['length']:.2f} m · "
            f"mass points ±{f['noise']:.3f} m · "
            + ("posts: none amid data · " if f["sigma"] is None else f"posts ±{f['sigma']:.3f} m · ")
            + ("too few points for residuals" if f["spread"] is None else f"normalised residuals {f['spread']:.2f}"),
        ]
        if f["calibration"]:
            lines.append(
                "held-out blocks, errors over stated ±: " + ", ".join(_errors_by_distance(c) for c in f["calibration"])
            )
            bends = [f"{_share_by_bend(c)} {c['after']:.2f}" for c in reversed(f["calibration_by_bend"]) if c["enough"]]
            if bends:
                lines.append("  the same by curvature of the ground: " + ", ".join(bends))
        if self.gross:
            lines.append(f"gross errors, left out: {len(self.gross)}")
            lines += [f"  {g.name}: {g.residual:+.3f} m, {abs(g.normalised):.1f} σ" for g in self.gross[:_SHOWN]]
        if self.suspects:
            lines.append(f"suspects, used all the same: {len(self.suspects)}; look at them in the report or the model")
        if self.findings:
            lines.append(f"note: findings in the measurements: {len(self.findings)}")
            lines += [f"  {finding.kind}: {finding.text}" for finding in self.findings[:_SHOWN]]
        return [*lines, *_noted(self.measured.notes)]

    def json_fields(self) -> dict[str, Any]:
        """Return figures, gross errors, findings and notes."""
        return {
            "model": self.path,
            **self.figures,
            "gross_errors": [pick(g, "name", "xyz", "residual", "normalised") for g in self.gross],
            "suspects": [pick(g, "name", "xyz", "residual", "normalised") for g in self.suspects],
            "findings": self.findings,
            "notes": self.measured.notes,
        }


@dataclass(frozen=True, eq=False)
class PlannedBuild(Result):
    """A terrain model that would be built."""

    plan: BuildPlan
    measured: MeasuredTerrain
    findings: tuple[Finding, ...]
    crs: str
    height_system: str | None

    def summary(self) -> list[str]:
        """Return the plan, what cleaning found, and the notes."""
        found = [f"  {finding.kind}: {finding.text}" for finding in self.findings]
        plan = describe_plan(self.plan, self.measured, self.crs, self.height_system)
        return [plan, *found, *_noted(self.measured.notes)]

    def json_fields(self) -> dict[str, Any]:
        """Return points, lines, units and gaps of the plan, findings and notes."""
        plan, measured = self.plan, self.measured
        return {
            "points": measured.count,
            "lines": dict(Counter(line.kind for line in measured.lines)),
            "spacing": round(plan.seen.spacing, 4),
            "grid_width": plan.width,
            "grid_width_at_breaklines": plan.finest,
            "units": [plan.layout.columns, plan.layout.rows],
            "unit_side": plan.layout.side,
            "bounds": list(plan.layout.bounds),
            "widest_gap": 2 * plan.reach,
            "crs": crs_label(self.crs),
            "height_system": self.height_system,
            "findings": self.findings,
            "notes": measured.notes,
        }


def _noted(notes: Sequence[str]) -> list[str]:
    """Return notes once each, in words that `quiet` does not hide; of many the first ones."""
    found = [f"  {note}" for note in noted(notes)]
    more = len(found) - _SHOWN
    return found[:_SHOWN] + ([f"  note: {more} more notes are in the model's record"] if more > 0 else [])


def _share_by_bend(c: dict[str, Any]) -> str:
    word = "strongest" if c["to"] == 1 else "weakest" if c["from"] == 0 else "next"
    return f"{word} {100 * (c['to'] - c['from']):.0f} %"


def _errors_by_distance(c: dict[str, Any]) -> str:
    """Return the spread of held-out errors at some distances to data."""
    where = f"over {c['from']:.3g} m" if c["to"] is None else f"up to {c['to']:.3g} m"
    return f"{where} {c['after']:.2f}" if c["enough"] else f"{where} too few ({c['blocks']} blocks)"


_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": " "}


def _reading(request: BuildRequest) -> ReadOptions:
    codes = read_code_table(request.codes) if isinstance(request.codes, Path) else request.codes
    return ReadOptions(
        dialect=Dialect(
            request.columns, _DELIMITERS.get(request.delimiter or "", request.delimiter), request.decimal_comma
        ),
        codes=codes if isinstance(codes, CodeTable) else CodeTable(),
        layers=request.layers or None,
        las_classes=request.las_classes or None,
        **pick(request, "attribute", "tin_points", "nodata", "crs", "beyond_area", "height_field", "unit"),
    )


def _settings(request: BuildRequest) -> BuildSettings:
    return BuildSettings(
        family=cast(Any, request.covariance),
        filters=request.sigmas,
        **pick(request, "grid_width", "unit_meshes", "adapt", "gross", "reach"),
    )


def load(request: BuildRequest) -> tuple[MeasuredTerrain, tuple[Finding, ...], str, str | None]:
    """Return clean measurements, what cleaning found, their CRS and their height system."""
    raw = read_measured(request.inputs, replace(_reading(request), height_system=request.height_system))
    if raw.crs is None:
        names = ", ".join(path.name for path in request.inputs)
        raise InputError(f"{names}: no CRS; state it with `crs` EPSG:nnnn, it is not guessed")
    system = _height_system(raw, request.height_system)
    _check_memory(raw)
    measured, findings = clean(replace(raw, height_system=system), sigmas=request.sigmas or None)
    return measured, findings, raw.crs, system


def dtm_build(request: BuildRequest, events: Events = SILENT) -> BuildReport | PlannedBuild:
    """Build a terrain model and write it, with its run record; in a dry run only plan it.

    Raises
    ------
    UsageError
        The output exists or is an input.
    InputError
        A file cannot be used; the measurements do not determine a surface (`GeometryError`).
    ResourceError
        The disk is full, or the points need more memory than there is.
    """
    times, settings = run_times(), _settings(request)
    if not request.dry_run:
        _check_model(request)
    events.begin("reading measurements")
    measured, findings, crs, system = load(request)
    plan = plan_build(measured, settings)
    if request.dry_run:
        return PlannedBuild(plan=plan, measured=measured, findings=findings, crs=crs, height_system=system)
    events.talk(describe_plan(plan, measured, crs, system))
    facts = [input_facts(path) for path in request.inputs]
    decides = [settings, repr(_reading(request)), repr(plan.layout), crs, system]
    key = run_key("terrain model", decides, request.inputs)
    kept = ResultLog.beside(request.output, key, locked=True)
    with (
        ModelWriter(
            path=request.output, layout=plan.layout, run_key=key, overwrite=request.overwrite, inputs=request.inputs
        ) as writer,
        kept,
    ):
        with steps(request.output.name, request.workers, events, kept) as run:
            built = build_terrain(plan, run, events)
        gross = tuple(_gross(built, measured))
        rows = built.fit.suspects
        suspects = tuple(_named(built, measured, rows[:, 0].astype(np.int64), rows[:, 2:]))
        _add_units(writer, built, events)
        totals = _totals(built, measured, findings, len(gross))
        header = ModelHeader(
            crs=crs,
            height_system=system,
            layout=plan.layout,
            settings=asdict(settings),
            inputs=tuple(facts),
            family=built.fit.whole.name,
            totals=totals,
        )
        with together():
            writer.finish(
                ModelParts(header=header, lines=built.lines, gross=gross, domain=plan.polygon, suspects=suspects)
            )
            when_named(kept.remove)
            ran = times()
            figures = {**totals, "crs": crs_label(crs), "height_system": system, "seconds": ran["seconds"]}
            report = BuildReport(
                path=request.output,
                figures=figures,
                gross=gross,
                suspects=suspects,
                findings=findings,
                built=built,
                measured=measured,
                inputs=request.inputs,
            )
            write_run_record(
                request.output,
                key=key,
                inputs=request.inputs,
                run={"workers": request.workers, **ran},
                kind="terrain model",
                product=report.json_fields() | {"findings": dict(Counter(f.kind for f in findings))},
                settings=settings,
            )
    return report


def _check_model(request: BuildRequest) -> None:
    """Refuse a name that a model cannot have, before anything is read."""
    if request.output.suffix.lower() != ".gpkg":
        raise UsageError(f"{request.output}: a terrain model is a GeoPackage; give it a name that ends with .gpkg")
    if not request.output.resolve().parent.is_dir():
        raise UsageError(f"{request.output}: no such folder; make it first")
    check_output(request.output, request.inputs, overwrite=request.overwrite)


def _add_units(writer: ModelWriter, built: Built, events: Events) -> None:
    """Write the units that an earlier run has not."""
    events.begin("writing the model", len(built.figures), "units")
    done = writer.done()
    for of_unit in built.figures:
        place = of_unit.column, of_unit.row
        if place not in done:
            unit = built.units.get(place)
            writer.add(unit, of_unit if unit is not None else empty_figures(*place))
        events.done()


def describe_plan(plan: BuildPlan, measured: MeasuredTerrain, crs: str, system: str | None) -> str:
    """One line on what will be computed."""
    layout = plan.layout
    kinds = Counter(line.kind for line in measured.lines)
    lines = ", ".join(_many(count, kind) for kind, count in kinds.items()) or "no lines"
    return (
        f"{measured.count} points, {lines} · spacing {plan.seen.spacing:.3g} m · grid {plan.width:g} m, "
        + (f"{plan.finest:g} m where breaklines pass, " if plan.finest < plan.width else "")
        + f"{layout.columns} × {layout.rows} units of {layout.side:g} m · gaps over {2 * plan.reach:.3g} m stay open · "
        f"{crs_label(crs)}, heights {height_label(system)}"
    )


def _many(count: int, what: str) -> str:
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


def _height_system(measured: MeasuredTerrain, declared: str | None) -> str | None:
    if declared is None:
        return measured.height_system
    wanted = check_height_system(declared)
    if wanted == "same":
        raise UsageError("height system same; a model needs a name: ellipsoidal or EPSG:nnnn of a vertical CRS")
    wanted, _ = metric_heights(wanted)
    if measured.height_system is not None and check_height_system(measured.height_system) != wanted:
        raise UsageError(
            f"height system {declared} was declared, but the files state {height_label(measured.height_system)}"
        )
    return wanted


def _check_memory(measured: MeasuredTerrain) -> None:
    vertices = sum(len(line.xyz) for line in measured.lines)
    needed = (measured.count + vertices) * _BYTES_PER_POINT
    free = psutil.virtual_memory().available
    if needed > free:
        raise ResourceError(
            f"{measured.count} points need about {needed >> 20} MiB, {free >> 20} MiB are free; build parts of the "
            "area and join them with `photoplan dtm refine`, or thin the points"
        )


def _gross(built: Built, measured: MeasuredTerrain) -> list[GrossError]:
    """The flagged points with their names, the worst first."""
    some = built.fit.gross
    found = _named(built, measured, some, built.fit.residuals[some])
    return sorted(found, key=lambda g: -abs(g.normalised))


def _named(
    built: Built, measured: MeasuredTerrain, some: NDArray[np.int64], residuals: NDArray[np.float64]
) -> list[GrossError]:
    """Points with their names and residuals."""
    seen = built.fit.seen
    found = []
    for k, row in zip(some.tolist(), residuals.tolist()):
        group = measured.points[seen.group[k]]
        place = int(seen.record[k])
        X, Y, Z = group.xyz[place].tolist()
        found.append(GrossError(group.label(place), group.kind, (X, Y, Z), *row))
    return found


def _totals(built: Built, measured: MeasuredTerrain, findings: Sequence[Finding], gross: int) -> dict[str, Any]:
    whole, fit = built.fit.whole, built.fit
    there = [f for f in built.figures if (f.column, f.row) in built.units]
    z = fit.residuals[fit.noise[: fit.seen.points] >= 0, 2]
    z = z[np.isfinite(z)]
    widths = Counter(round(u.width, 6) for u in built.units.values())
    return {
        "points": measured.count,
        "lines": dict(Counter(line.kind for line in measured.lines)),
        "spacing": round(fit.seen.spacing, 4),
        "units": len(there),
        "grid_widths": {f"{width:g}": count for width, count in sorted(widths.items())},
        "covariance": whole.name,
        "variance": whole.variance,
        "length": whole.length,
        "noise": whole.noise,
        "sigma": built.sigma if np.isfinite(built.sigma) else None,
        "spread": float(z.std()) if len(z) else None,
        "calibration": [_class(c, fit.seen.spacing) for c in fit.calibration.classes if c.count],
        "calibration_by_bend": [_class(c, 1.0) for c in fit.calibration.bends if c.count],
        "gross": gross,
        "findings": len(findings),
    }


def _class(found: ClassFigures, spacing: float) -> dict[str, Any]:
    """Return the held-out errors of a class: distances in metres (`to` is None for all beyond), or parts of 1."""
    to = found.furthest * spacing
    return {
        "from": round(found.nearest * spacing, 4),
        "to": round(to, 4) if np.isfinite(to) else None,
        "heights": found.count,
        "blocks": found.blocks,
        "before": round(found.before, 3),
        "after": round(found.after, 3),
        "enough": found.enough,
    }


@dataclass(frozen=True)
class RefineReport(Result):
    """A terrain model that was refined."""

    path: Path
    units: int
    """Units of the model that have a surface."""
    changed: int
    """Units that differ from those of the coarse model."""
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
    """None for a raster."""

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
