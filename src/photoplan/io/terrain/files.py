"""Measured terrain from files of several formats, merged into one.

The format is that of the content: LAS and LAZ, LandXML, GeoPackage, Shapefile, GeoJSON, DXF, else text in columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from photoplan.arrays import Floats
from photoplan.errors import GeometryError, HeightSystemError, InputError, UsageError
from photoplan.geometry.bounds import area_fault, area_note, beyond_area
from photoplan.geometry.crs import crs_label, require_projected_metres, same_crs, split_compound
from photoplan.geometry.heights import check_height_system
from photoplan.geometry.units import MetricSystem, agreed_metres, metric_system, unit_label
from photoplan.io.files import check_plain_file
from photoplan.io.raster import HIGHEST, LOWEST, USUAL_NODATA
from photoplan.io.terrain import las as terrain_las
from photoplan.io.terrain import text as terrain_text
from photoplan.io.terrain import vector as terrain_landxml
from photoplan.io.terrain import vector as terrain_vector
from photoplan.io.terrain.options import ReadOptions
from photoplan.io.terrain.vector import check_matched
from photoplan.surfaces.units import MeasuredLine, MeasuredTerrain, PointGroup, Tin

#: Kilometres beyond the area of the CRS from which on the unit of a drawing is doubted, if its numbers lie inside.
_MISSTATED = 20.0
_USUAL_NODATA = (*USUAL_NODATA, -999.0)
_RASTERS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+", b"\x89PNG", b"\xff\xd8\xff", b"ncols", b"NCOLS")
_Reader = Callable[[Path, ReadOptions], MeasuredTerrain]


def read_measured(paths: Sequence[Path], options: ReadOptions | None = None) -> MeasuredTerrain:
    """Points, lines and triangulation of all files together.

    The files must be in one projected CRS: what they state, or what `options.crs` declares for files that state none.
    Coordinates and heights in feet or another known unit are converted: the result is in metres. The height system is
    what the files state; where one of them states none it is None (nothing is guessed).
    """
    options = options or ReadOptions()
    if not paths:
        raise UsageError("no file of measured terrain was given")
    parts: list[MeasuredTerrain] = []
    seen: dict[Path, Path] = {}
    for given in paths:
        path = check_plain_file(given, "terrain file")
        if path.resolve() in seen:
            raise UsageError(f"{path}: the same file as {seen[path.resolve()]}; its points would count twice")
        seen[path.resolve()] = path
        try:
            part = _reader(path)(path, options)
        except GeometryError:
            raise
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: cannot be read as text ({error})") from None
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
        stated = part.crs is not None
        part = _without_nodata(part, options)
        if not _coordinates(part.points, part.lines) and part.tin is None:
            raise InputError(f"{path}: holds no points and no lines with heights; leave it out, or choose other layers")
        parts.append(_in_metres(_with_crs(part, options), options, stated))
    measured = _merged(parts)
    check_matched(measured, options)
    return measured


def _reader(path: Path) -> _Reader:
    """The reader for the content of a file."""
    try:
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    start = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    suffix = path.suffix.casefold()
    if head.startswith(b"LASF"):
        return terrain_las.read
    if head.startswith((b"SQLite format 3\x00", b"\x00\x00\x27\x0a", b"AutoCAD Binary DXF")) or start.startswith(b"{"):
        return terrain_vector.read
    if start.startswith(b"<"):
        return terrain_landxml.read_landxml
    if start.startswith(_RASTERS):
        raise InputError(f"{path}: a raster, not measured points; a grid model is given to orthophotos as it is")
    words = start.split(maxsplit=4)
    if suffix == ".dxf" or (len(words) > 1 and words[:2] == [b"0", b"SECTION"]):
        return terrain_vector.read
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return terrain_text.read  # it says what to do
    if b"\0" in head:
        raise InputError(
            f"{path}: not a format of measured terrain; read are LAS/LAZ, LandXML, GeoPackage, Shapefile (.shp), "
            "GeoJSON, DXF and text in columns"
        )
    return terrain_text.read


def _without_nodata(part: MeasuredTerrain, options: ReadOptions) -> MeasuredTerrain:
    """The part without points of the declared nodata height; the usual ones that nobody declared are refused."""
    groups: list[PointGroup] = []
    notes = list(part.notes)
    for group in part.points:
        z = group.xyz[:, 2]
        if options.nodata is not None and (z == options.nodata).any():
            keep = z != options.nodata
            notes.append(f"{group.name}: {int((~keep).sum())} points of height {options.nodata:g} (none) left out")
            names = None if group.names is None else group.names[keep]
            group = replace(group, xyz=group.xyz[keep], records=group.records[keep], names=names)
            z = group.xyz[:, 2]
        wrong = np.zeros(len(z), bool)
        for value in _USUAL_NODATA if len(z) and z.min() <= max(_USUAL_NODATA) else ():
            wrong |= z == value
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            raise InputError(
                f"{part.files[0]}: {group.label(at)}: height {z[at]:g} ({int(wrong.sum())} such points) is usually a "
                "mark for none; declare it as nodata, or change these heights a little"
            )
        if len(group.xyz):
            groups.append(group)
    for line in part.lines:
        if np.isin(line.xyz[:, 2], _USUAL_NODATA).any():
            raise InputError(f"{line.name}: a height of {_USUAL_NODATA} usually means none; check its heights")
    return replace(part, points=tuple(groups), notes=tuple(notes))


def _with_crs(part: MeasuredTerrain, options: ReadOptions) -> MeasuredTerrain:
    """The part with the CRS that holds for it; unfit and contradicting ones are refused."""
    path = part.files[0]
    declared, declared_heights = (None, None) if options.crs is None else split_compound(options.crs)
    if declared is not None:
        require_projected_metres(metric_system(declared, "declared CRS").crs, "declared CRS")
    if part.crs is not None and declared is not None and not same_crs(part.crs, declared):
        raise InputError(
            f"{path}: states {crs_label(part.crs)}, declared is {crs_label(declared)}; drop the declaration, or "
            "transform the file beforehand (ogr2ogr -t_srs, pdal)"
        )
    return replace(part, crs=part.crs or declared, height_system=part.height_system or declared_heights)


def _in_metres(part: MeasuredTerrain, options: ReadOptions, own_crs: bool) -> MeasuredTerrain:
    """The part in a projected CRS in metres, with heights in metres upwards; impossible ones are refused.

    `own_crs` states whether the CRS is the file's own, not a declared one.
    """
    path = part.files[0]
    system = MetricSystem("", 1.0, None, 1.0) if part.crs is None else metric_system(part.crs, f"{path}: CRS")
    stated, heights = part.height_system or options.height_system, part.height_system
    if stated is not None and stated.strip().casefold() != "same":
        try:
            system = system.declaring(check_height_system(stated), f"{path}: heights")
            heights = system.heights if part.height_system is not None else None
        except InputError:  # a name of a height system that no register has
            if part.height_system is None:
                raise
    plan = agreed_metres(part.unit, system.scale, f"{path}: X and Y", in_one_file=own_crs)
    every = _coordinates(part.points, part.lines)
    with_heights = part.tin is not None or any(bool(np.isfinite(xyz[:, 2]).any()) for xyz in every)
    rise = 1.0
    if with_heights:
        unit = part.unit if part.height_unit is None else part.height_unit
        rise = agreed_metres(unit, system.height_scale, f"{path}: heights", in_one_file=False)
    if part.crs is not None:
        try:
            require_projected_metres(system.crs, f"{path}: CRS")
        except InputError as error:
            raise InputError(f"{error}; transform the file beforehand (ogr2ogr -t_srs, pdal)") from None
    notes = part.notes
    if (plan, rise) != (1.0, 1.0):
        notes = (
            *notes,
            f"{path.name}: X and Y in {unit_label(plan)}, heights in {unit_label(rise)}; converted to metres",
        )
        if part.unit is not None and system.scale == 1.0:
            _refuse_misstated(part, plan, system.crs)
    factors = np.array([plan, plan, rise])
    groups = tuple(_scaled(group, factors) for group in part.points)
    lines = tuple(
        replace(line, xyz=line.xyz * factors, right=None if line.right is None else line.right * rise)
        if (plan, rise) != (1.0, 1.0)
        else line
        for line in part.lines
    )
    for group in groups:
        z = group.xyz[:, 2]
        wrong = (z < LOWEST) | (z > HIGHEST)
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            raise InputError(
                f"{path}: {group.label(at)}: height {z[at]:g} m ({int(wrong.sum())} such points); is it a mark for "
                "none? then declare it as nodata, else check unit and order of the columns"
            )
    for line in lines:
        z = line.xyz[:, 2][~np.isnan(line.xyz[:, 2])]
        if len(z) and not (z.min() > LOWEST and z.max() < HIGHEST):
            raise InputError(f"{line.name}: heights from {z.min():g} to {z.max():g} m; check them and their unit")
    tin = part.tin if part.tin is None or (plan, rise) == (1.0, 1.0) else replace(part.tin, xyz=part.tin.xyz * factors)
    part = replace(
        part,
        points=groups,
        lines=lines,
        tin=tin,
        crs=None if part.crs is None else system.crs,
        height_system=heights,
        notes=notes,
        unit=None,
        height_unit=None,
    )
    if part.crs is None or options.beyond_area:
        return part
    return replace(part, notes=(*part.notes, *_judged_area(path, part, part.crs)))


def _judged_area(path: Path, part: MeasuredTerrain, crs: str) -> tuple[str, ...]:
    """A note on coordinates a little outside the area of their CRS; those far outside are refused."""
    parts = [group.xyz for group in part.points] + [line.xyz for line in part.lines]
    parts += [] if part.tin is None else [part.tin.xyz]
    XY = np.concatenate([f(xyz[:, :2], axis=0)[None] for xyz in parts if len(xyz) for f in (np.nanmin, np.nanmax)])
    fault = area_fault(crs, XY)
    if fault is not None:
        raise InputError(f"{path}: {fault}")
    note = area_note(crs, XY)
    return () if note is None else (f"{path.name}: {note}",)


def _coordinates(points: Sequence[PointGroup], lines: Sequence[MeasuredLine]) -> list[Floats]:
    """X, Y, Z of each group and line that has some."""
    return [xyz for xyz in (*(p.xyz for p in points), *(line.xyz for line in lines)) if len(xyz)]


def _scaled(group: PointGroup, factors: Floats) -> PointGroup:
    return group if (factors == 1.0).all() else replace(group, xyz=group.xyz * factors)


def _refuse_misstated(part: MeasuredTerrain, plan: float, crs: str) -> None:
    """Refuse a unit that leads out of the area of the CRS, if the numbers lie in it as metres.

    Templates of CAD programs state millimetres or inches in drawings of any unit.
    """
    every = [xyz[:, :2] for xyz in _coordinates(part.points, part.lines)]
    if not crs or plan == 1.0 or not every:
        return
    middle = np.array([np.median(np.concatenate([xy[:1] for xy in every]), axis=0)])
    if beyond_area(crs, middle * plan)[0] > _MISSTATED and beyond_area(crs, middle)[0] == 0.0:
        x, y = middle[0]
        raise InputError(
            f"{part.files[0]}: states {unit_label(plan)}, but X {x:.10g}, Y {y:.10g} lies in the area of "
            f"{crs_label(crs)} only in metres; declare the unit of the drawing with `unit` m, or correct it"
        )


def _merged(parts: Sequence[MeasuredTerrain]) -> MeasuredTerrain:
    stating = [p for p in parts if p.crs is not None]
    notes = [note for part in parts for note in part.notes]
    for part in stating[1:]:
        first = stating[0]
        assert first.crs is not None and part.crs is not None
        if not same_crs(first.crs, part.crs):
            raise InputError(
                f"{first.files[0]} is in {crs_label(first.crs)}, {part.files[0]} in {crs_label(part.crs)}; transform "
                "one of them beforehand (ogr2ogr -t_srs, pdal)"
            )
    silent = [p.files[0].name for p in parts if p.crs is None]
    if stating and silent:
        notes.append(f"{', '.join(silent)}: states no CRS; taken as {crs_label(stating[0].crs or '')} like the others")
    lines: tuple[MeasuredLine, ...] = tuple(line for p in parts for line in p.lines)
    points = tuple(group for p in parts for group in p.points)
    tin = _joined([p.tin for p in parts if p.tin is not None])
    if not points and not lines and tin is None:
        raise InputError(f"{', '.join(str(p.files[0]) for p in parts)}: no point and no line is left")
    notes += _constant(points, lines)
    return MeasuredTerrain(
        points=points,
        lines=lines,
        crs=stating[0].crs if stating else None,
        height_system=_heights(parts, notes),
        tin=tin,
        files=tuple(f for p in parts for f in p.files),
        notes=tuple(notes),
        codes=frozenset().union(*(p.codes for p in parts)),
        fields=tuple(f for p in parts for f in p.fields),
    )


def _constant(points: Sequence[PointGroup], lines: Sequence[MeasuredLine]) -> list[str]:
    """What to note if all heights are one number: files whose heights are elsewhere look so."""
    every = [xyz[:, 2] for xyz in _coordinates(points, lines)]
    ranges = [(float(np.nanmin(z)), float(np.nanmax(z))) for z in every if bool(np.isfinite(z).any())]
    low, high = min((a for a, _ in ranges), default=0.0), max((b for _, b in ranges), default=1.0)
    count = sum(len(z) for z in every)
    if low != high or count < 3:
        return []
    return [
        f"warning: all {count} heights are {low:g} m: the surface is level. Are the heights in an attribute "
        "(`height_field`), in texts, or missing?"
    ]


def _heights(parts: Sequence[MeasuredTerrain], notes: list[str]) -> str | None:
    """The height system that all files state; None if one of them states none."""
    stated: dict[str, Path] = {}
    for part in parts:
        if part.height_system is not None:
            stated.setdefault(part.height_system, part.files[0])
    if len(stated) > 1:
        given = ", ".join(f"{path} {name}" for name, path in stated.items())
        raise HeightSystemError(f"height systems differ: {given}; bring the files into one system beforehand")
    silent = [p.files[0].name for p in parts if p.height_system is None]
    if stated and silent:
        notes.append(f"height system: {next(iter(stated))} is stated, but not by {', '.join(silent)}: declare it")
        return None
    return next(iter(stated), None)


def _joined(tins: list[Tin]) -> Tin | None:
    if not tins:
        return None
    start = np.cumsum([0] + [len(t.xyz) for t in tins])
    return Tin(np.concatenate([t.xyz for t in tins]), np.concatenate([t.faces + a for t, a in zip(tins, start)]))
