"""Measured terrain from files of several formats, merged into one.

The format is that of the content: LAS and LAZ, LandXML, GeoPackage, Shapefile, GeoJSON, DXF, else text in columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from photoplan.errors import GeometryError, HeightSystemError, InputError, UsageError
from photoplan.geometry.bounds import area_fault, area_note
from photoplan.geometry.crs import crs_label, parse_crs, require_projected_metres, same_crs, split_compound
from photoplan.geometry.heights import height_label
from photoplan.io.checks import check_plain_file
from photoplan.io.terrain import landxml as terrain_landxml
from photoplan.io.terrain import las as terrain_las
from photoplan.io.terrain import text as terrain_text
from photoplan.io.terrain import vector as terrain_vector
from photoplan.io.terrain.groups import check_matched
from photoplan.io.terrain.options import ReadOptions
from photoplan.io.terrain.reader import HIGHEST, LOWEST
from photoplan.io.validity import USUAL_NODATA
from photoplan.surfaces.measured import MeasuredLine, MeasuredTerrain, PointGroup, Tin

_USUAL_NODATA = (*USUAL_NODATA, -999.0)
_RASTERS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+", b"\x89PNG", b"\xff\xd8\xff", b"ncols", b"NCOLS")
_Reader = Callable[[Path, ReadOptions], MeasuredTerrain]


def read_measured(paths: Sequence[Path], options: ReadOptions | None = None) -> MeasuredTerrain:
    """Points, lines and triangulation of all files together.

    The files must be in one projected CRS in metres: what they state, or what `options.crs` declares for files that
    state none. The height system is what the files state; where one of them states none it is None (nothing is
    guessed).

    Parameters
    ----------
    paths : sequence of Path
        Files; the same file twice is refused.
    options : ReadOptions, optional
        What the files do not say of themselves.

    Raises
    ------
    UsageError
        No file, or one file twice; LAS without laspy.
    InputError
        A file cannot be read, is not in metres, or states another CRS than the others; the message names file and
        line, point or feature. A table of codes was given, and none of its codes is in the files.
    HeightSystemError
        Two files state different height systems.
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
        parts.append(_with_crs(_plausible(part, options), options))
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
        return terrain_landxml.read
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


def _plausible(part: MeasuredTerrain, options: ReadOptions) -> MeasuredTerrain:
    """The part without points of the declared nodata height; impossible heights are refused."""
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
        wrong = (z < LOWEST) | (z > HIGHEST)
        for value in _USUAL_NODATA if len(z) and z.min() <= max(_USUAL_NODATA) else ():
            wrong |= z == value
        if wrong.any():
            at = int(np.flatnonzero(wrong)[0])
            raise InputError(
                f"{part.files[0]}: {group.label(at)}: height {z[at]:g} ({int(wrong.sum())} such points); is it a mark "
                "for none? then declare it as nodata, else check unit and order of the columns"
            )
        if len(group.xyz):
            groups.append(group)
    for line in part.lines:
        z = line.xyz[:, 2][~np.isnan(line.xyz[:, 2])]
        if len(z) and not (z.min() > LOWEST and z.max() < HIGHEST and not np.isin(z, _USUAL_NODATA).any()):
            raise InputError(f"{line.name}: heights from {z.min():g} to {z.max():g}; check them and their unit")
    return replace(part, points=tuple(groups), notes=tuple(notes))


def _with_crs(part: MeasuredTerrain, options: ReadOptions) -> MeasuredTerrain:
    """The part with the CRS that holds for it; unfit and contradicting ones are refused."""
    path = part.files[0]
    declared, declared_heights = (None, None) if options.crs is None else split_compound(options.crs)
    if declared is not None:
        require_projected_metres(declared, "declared CRS")
    if part.crs is not None:
        if declared is not None and not same_crs(part.crs, declared):
            raise InputError(
                f"{path}: states {crs_label(part.crs)}, declared is {crs_label(declared)}; drop the declaration, or "
                "transform the file beforehand (ogr2ogr -t_srs, pdal)"
            )
        try:
            require_projected_metres(part.crs, f"{path}: CRS")
        except InputError as error:
            raise InputError(f"{error}; transform the file beforehand (ogr2ogr -t_srs, pdal)") from None
    heights = part.height_system or declared_heights
    if heights is not None and heights.upper().startswith("EPSG:"):
        _check_height_unit(path, heights)
    crs = declared or part.crs
    notes = part.notes if crs is None or options.beyond_area else (*part.notes, *_judged_area(path, part, crs))
    return replace(part, crs=crs, height_system=heights, notes=notes)


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


def _check_height_unit(path: Path, heights: str) -> None:
    axis = parse_crs(heights).axis_info
    if axis and axis[-1].unit_conversion_factor != 1.0:
        raise InputError(
            f"{path}: heights in {axis[-1].unit_name} ({height_label(heights)}); metres are needed: convert them "
            "beforehand (ogr2ogr -t_srs, pdal)"
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
