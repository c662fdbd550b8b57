"""Terrain models for other programs: triangulations as OBJ, PLY or LandXML, points as XYZ or CSV."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from photoplan import __version__
from photoplan.errors import PhotoplanError
from photoplan.events import SILENT, Events
from photoplan.geometry.crs import parse_crs
from photoplan.geometry.heights import height_label
from photoplan.io.disk import disk_error
from photoplan.io.lock import FileLock, lock_of
from photoplan.io.naming import give_name, scratch
from photoplan.io.product import check_output
from photoplan.io.table_lines import csv_line
from photoplan.io.terrain.export_mesh import MeshPart, mesh_parts
from photoplan.plain import xml_quoted
from photoplan.surfaces.units import LineElement, Unit, UnitSource

TIN_SUFFIXES = (".obj", ".ply", ".xml")


@dataclass(frozen=True)
class ExportFigures:
    """What was written."""

    vertices: int
    faces: int = 0
    walls: int = 0
    """Vertical triangles at two-sided breaklines."""
    line_points: int = 0


@contextmanager
def replacing(path: Path, inputs: Sequence[Path | str] = (), overwrite: bool = False) -> Iterator[Path]:
    """A temporary name beside `path` to write to; it takes the name when the context ends well, else it is removed."""
    check_output(path, inputs, overwrite=overwrite)
    with FileLock(lock_of(path)):
        check_output(path, inputs, overwrite=overwrite)
        try:
            with scratch(path.parent) as folder:
                yield folder / path.name
                check_output(path, inputs, overwrite=overwrite)
                give_name(folder / path.name, path)
        except PhotoplanError:
            raise
        except OSError as error:
            raise disk_error(path, error) from error


def write_tin(
    part: Path,
    kind: str,
    source: UnitSource,
    name: str,
    events: Events = SILENT,
    *,
    crs: str | None = None,
    height_system: str | None = None,
) -> ExportFigures:
    """Write the triangulation of a model."""
    counts = [0, 0, 0]

    def parts() -> Iterator[MeshPart]:
        for item in mesh_parts(source):
            counts[0] += len(item.vertices)
            counts[1] += len(item.faces)
            counts[2] += len(item.walls)
            events.done()
            yield item

    if kind == ".xml":
        _write_landxml(part, parts(), name, _coordinate_system(crs, height_system))
    else:
        {".obj": _write_obj, ".ply": _write_ply}[kind](part, parts(), name)
    return ExportFigures(counts[0], counts[1], 0 if kind == ".xml" else counts[2])


def _write_obj(path: Path, parts: Iterator[MeshPart], name: str) -> None:
    with path.open("wb") as file:
        file.write(
            f"# photoplan {__version__}: terrain model, X east, Y north, Z up, metres\no {_word(name)}\n".encode()
        )
        for item in parts:
            file.write(_text("v %.5f %.5f %.4f\n", item.vertices))
            file.write(_text("f %d %d %d\n", np.concatenate([item.faces, item.walls]) + 1))


def _write_ply(path: Path, parts: Iterator[MeshPart], name: str) -> None:
    record = np.dtype([("count", "u1"), ("corners", "<i4", 3)])
    with ExitStack() as open_files:
        file, faces = _two_files(open_files, path)
        # The counts are known at the end: room is left for them.
        file.write(_ply_header(0, 0, name))
        vertices = triangles = 0
        for item in parts:
            file.write(item.vertices.astype("<f8").tobytes())
            both = np.concatenate([item.faces, item.walls])
            rows = np.empty(len(both), record)
            rows["count"], rows["corners"] = 3, both
            faces.write(rows.tobytes())
            vertices, triangles = vertices + len(item.vertices), triangles + len(both)
        faces.seek(0)
        shutil.copyfileobj(faces, file, 1 << 20)
        file.seek(0)
        file.write(_ply_header(vertices, triangles, name))


def _ply_header(vertices: int, faces: int, name: str) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment photoplan {__version__}: {_word(name)}; X east, Y north, Z up, metres",
        f"element vertex {vertices:012d}",
        *(f"property double {axis}" for axis in "xyz"),
        f"element face {faces:012d}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode()


def _coordinate_system(crs: str | None, height_system: str | None) -> str:
    """The CoordinateSystem of LandXML 1.2; empty if nothing is known."""
    facts: dict[str, str] = {}
    if crs is not None:
        code = crs.upper().removeprefix("EPSG:")
        facts |= {"name": parse_crs(crs).name} | ({"epsgCode": code} if code.isdigit() else {"ogcWktCode": crs})
    if height_system is not None:
        facts |= {"verticalDatum": height_label(height_system), "verticalCoordinateSystemName": height_system}
    return f"<CoordinateSystem{''.join(f' {k}={xml_quoted(v)}' for k, v in facts.items())}/>\n" if facts else ""


def _write_landxml(path: Path, parts: Iterator[MeshPart], name: str, system: str) -> None:
    with ExitStack() as open_files:
        file, faces = _two_files(open_files, path)
        file.write(
            (
                '<?xml version="1.0" encoding="UTF-8"?>\n<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2" '
                'version="1.2">\n<Units><Metric linearUnit="meter" areaUnit="squareMeter" volumeUnit="cubicMeter" '
                f'temperatureUnit="celsius" pressureUnit="milliBars"/></Units>\n{system}'
                f'<Application name="photoplan" version="{__version__}"/>\n'
                f'<Surfaces><Surface name={xml_quoted(_word(name))}><Definition surfType="TIN">\n<Pnts>\n'
            ).encode()
        )
        count = 0
        for item in parts:
            # LandXML has north before east.
            numbered = np.column_stack([count + 1 + np.arange(len(item.vertices)), item.vertices[:, [1, 0, 2]]])
            file.write(_text('<P id="%d">%.5f %.5f %.4f</P>\n', numbered))
            faces.write(_text("<F>%d %d %d</F>\n", item.faces + 1))
            count += len(item.vertices)
        file.write(b"</Pnts>\n<Faces>\n")
        faces.seek(0)
        shutil.copyfileobj(faces, file, 1 << 20)
        file.write(b"</Faces>\n</Definition></Surface></Surfaces>\n</LandXML>\n")


def _two_files(stack: ExitStack, path: Path) -> tuple[IO[bytes], IO[bytes]]:
    """The file, and one beside it for what comes last."""
    faces = path.with_name(path.name + ".faces")
    return stack.enter_context(path.open("w+b")), stack.enter_context(faces.open("w+b"))


def _text(form: str, rows: NDArray[np.float64] | NDArray[np.int64]) -> bytes:
    return (form * len(rows) % tuple(rows.ravel().tolist())).encode()


def _word(name: str) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in name).split()) or "terrain"


def write_points(
    part: Path, kind: str, source: UnitSource, lines: Sequence[LineElement], events: Events = SILENT
) -> ExportFigures:
    """Write the posts and the vertices of the lines as text."""
    posts = points = 0
    with part.open("wb") as file:
        if kind == ".csv":
            file.write(b"x,y,z,sigma,kind,name,code,side\n")
        for rows in _posts(source):
            form = "%.4f %.4f %.4f\n" if kind == ".xyz" else "%.4f,%.4f,%.4f,%.4f,post,,,\n"
            file.write(_text(form, rows[:, :3] if kind == ".xyz" else rows))
            posts += len(rows)
            events.done()
        for line in lines:
            for side, z in (("left", line.xyz[:, 2]), ("right", line.right)):
                if z is None or (side == "left" and not np.isfinite(z).any()):
                    continue
                there = np.isfinite(z)
                rows = np.column_stack([line.xyz[:, :2], z, line.sigmas])[there]
                points += len(rows)
                if kind == ".xyz":
                    file.write(_text("%.4f %.4f %.4f\n", rows[:, :3]))
                else:
                    ending = csv_line([line.kind, line.name, line.code, side if line.right is not None else ""])
                    file.write(_text("%.4f,%.4f,%.4f,%.4f," + ending.replace("%", "%%"), rows))
    return ExportFigures(posts, line_points=points)


def _posts(source: UnitSource) -> Iterator[NDArray[np.float64]]:
    """X, Y, Z, sigma of the posts of each unit, shape (k, 4); a post that the unit before has is left out."""
    layout = source.layout
    above: dict[int, Unit] = {}
    for row in range(layout.rows):
        before: Unit | None = None
        here: dict[int, Unit] = {}
        for column in range(layout.columns):
            unit = source.unit(column, row)
            if unit is not None:
                here[column] = unit
                new = np.isfinite(unit.heights)
                upper, corner = above.get(column), above.get(column - 1)
                if before is not None:
                    new[:, 0] &= ~_shared(before.heights[:, -1], unit.meshes)
                if upper is not None:
                    new[0] &= ~_shared(upper.heights[-1], unit.meshes)
                if corner is not None and np.isfinite(corner.heights[-1, -1]):
                    new[0, 0] = False
                east = above.get(column + 1)
                if east is not None and np.isfinite(east.heights[-1, 0]):
                    new[0, -1] = False
                yield _rows(unit, new)
            before = unit
        above = here


def _shared(edge: NDArray[np.float32], meshes: int) -> NDArray[np.bool_]:
    """Which of the posts along an edge the other unit has, whose posts along it are given."""
    at = np.arange(meshes + 1) * (len(edge) - 1) / meshes
    nearest = np.rint(at).astype(int)
    return np.asarray((np.abs(at - nearest) < 1e-9) & np.isfinite(edge[nearest]))


def _rows(unit: Unit, which: NDArray[np.bool_]) -> NDArray[np.float64]:
    along = np.arange(unit.meshes + 1) * unit.width
    X, Y = np.meshgrid(unit.left + along, unit.top - along)
    heights = unit.heights.astype(float) + unit.datum
    return np.column_stack([X[which], Y[which], heights[which], unit.sigmas[which]])
