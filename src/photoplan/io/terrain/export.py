"""Terrain models for other programs: meshes and points."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from photoplan import __version__
from photoplan.errors import PhotoplanError
from photoplan.events import SILENT, Events
from photoplan.geometry.crs import parse_crs
from photoplan.geometry.heights import height_label
from photoplan.io.disk import FileLock, disk_error, lock_of
from photoplan.io.product import check_output
from photoplan.io.store import give_name, scratch
from photoplan.io.tables import csv_line
from photoplan.plain import xml_quoted
from photoplan.surfaces.units import LineElement, Unit, UnitSource

_SAME = 2e-5
"""Vertices closer than this in the plane, metres, and …"""
_SAME_HEIGHT = 5e-4
"""… closer than this in height are one: posts are stored to a fraction of it, places are known far better."""


@dataclass(frozen=True, eq=False)
class MeshPart:
    """What one unit adds to the triangulation."""

    vertices: NDArray[np.float64]
    """New vertices, X, Y, Z, shape (k, 3), metres; their numbers follow those of the parts before."""
    faces: NDArray[np.int64]
    """Vertex numbers, from 0 over all parts, of each triangle of the surface, counter-clockwise, shape (f, 3)."""
    walls: NDArray[np.int64]
    """The same of vertical triangles at two-sided breaklines, shape (w, 3)."""


def mesh_parts(source: UnitSource) -> Iterator[MeshPart]:
    """The triangulation of a model, a part for each unit that has a surface, row by row."""
    numbers = _SharedNumbers()
    layout = source.layout
    for row in range(layout.rows):
        for column in range(layout.columns):
            unit = source.unit(column, row)
            if unit is None:
                continue
            vertices, faces, walls = unit_mesh(unit)
            if not len(faces):
                continue
            number, new = numbers.take(vertices, _on_edge(vertices, unit))
            yield MeshPart(vertices[new], number[faces], number[walls])
        numbers.next_row()


def unit_mesh(unit: Unit) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Vertices (k, 3), triangles (f, 3) and vertical triangles of walls (w, 3) of a unit; vertex numbers from 0."""
    n = unit.meshes
    post = np.arange((n + 1) ** 2).reshape(n + 1, n + 1)
    along = np.arange(n + 1) * unit.width
    X, Y = np.meshgrid(unit.left + along, unit.top - along)
    vertices = np.stack([X, Y, unit.heights.astype(float) + unit.datum], axis=-1).reshape(-1, 3)
    plain = np.ones((n, n), bool)
    corners = np.empty((0, 3), np.int64)
    if unit.faces is not None:
        plain = (np.diff(unit.faces.start) == 0).reshape(n, n)
        own = unit.faces.corners.astype(np.int64)
        # Three equal corners mark a mesh without a surface.
        corners = own[(own[:, 0] != own[:, 1]) & (own[:, 1] != own[:, 2]) & (own[:, 0] != own[:, 2])] + len(vertices)
        vertices = np.concatenate([vertices, unit.faces.vertices])
    there = np.isfinite(unit.heights)
    plain &= there[:-1, :-1] & there[:-1, 1:] & there[1:, :-1] & there[1:, 1:]
    a, b, c, d = (part[plain] for part in (post[:-1, :-1], post[:-1, 1:], post[1:, :-1], post[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, d], axis=1), np.stack([a, d, b], axis=1), corners])
    if unit.faces is not None:
        faces = _joined(vertices)[faces]
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])]
    used, faces = np.unique(faces, return_inverse=True)
    vertices, faces = vertices[used], faces.reshape(-1, 3)
    return vertices, faces, _walls(vertices, faces) if unit.faces is not None else np.empty((0, 3), np.int64)


def _joined(vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """For each vertex the first that lies at its place."""
    there = np.flatnonzero(np.isfinite(vertices[:, 2]))
    scaled = vertices[there] / [_SAME, _SAME, _SAME_HEIGHT]
    pairs = there[cKDTree(scaled - scaled.min(axis=0)).query_pairs(1.0, output_type="ndarray")].reshape(-1, 2)
    first = np.arange(len(vertices))
    if len(pairs):
        graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(vertices),) * 2)
        group = connected_components(graph, directed=False)[1]
        _, lowest = np.unique(group, return_index=True)
        first = lowest[group]
    return first


def _walls(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Vertical triangles between edges that lie above each other and belong to one triangle each."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    _, first, count = np.unique(np.sort(edges, axis=1), axis=0, return_index=True, return_counts=True)
    open_edges = edges[first[count == 1]]
    if not len(open_edges):
        return np.empty((0, 3), np.int64)
    # Ends at one place in the plane have one number.
    ends = np.unique(open_edges)
    place = np.zeros(len(vertices), np.int64)
    flat = vertices[ends] * [1, 1, 0]
    place[ends] = _joined(flat)
    by_place: dict[tuple[int, int], tuple[int, int]] = {(place[a], place[b]): (a, b) for a, b in open_edges.tolist()}
    walls: list[tuple[int, int, int]] = []
    for (p, q), (a, b) in by_place.items():
        other = by_place.get((q, p))
        if other is None or p > q:
            continue
        c, d = other  # c lies at b's place, d at a's
        walls += [t for t in ((b, a, d), (b, d, c)) if len(set(t)) == 3]
    return np.array(walls, np.int64).reshape(-1, 3)


def _on_edge(vertices: NDArray[np.float64], unit: Unit) -> NDArray[np.bool_]:
    """Whether vertices lie on the border of their unit."""
    x, y = vertices[:, 0] - unit.left, unit.top - vertices[:, 1]
    inside = (x > _SAME) & (x < unit.side - _SAME) & (y > _SAME) & (y < unit.side - _SAME)
    return np.asarray(~inside)


class _SharedNumbers:
    """Numbers of vertices over all units."""

    def __init__(self) -> None:
        self.count = 0
        self._here: dict[tuple[int, int], list[tuple[float, float, float, int]]] = {}
        self._above: dict[tuple[int, int], list[tuple[float, float, float, int]]] = {}

    def next_row(self) -> None:
        """Forget vertices that no later unit can share."""
        self._above, self._here = self._here, {}

    def take(
        self, vertices: NDArray[np.float64], shared: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Number of each vertex, and which are new."""
        known = np.full(len(vertices), -1, np.int64)
        cells = np.floor(vertices[:, :2] / (4 * _SAME) + 0.5)
        # A vertex near the edge of its cell may lie in the next one as another unit has it.
        rest = vertices[:, :2] / (4 * _SAME) + 0.5 - cells
        near = np.where(rest < 0.25, -1, np.where(rest > 0.75, 1, 0)).astype(int)
        for i in np.flatnonzero(shared).tolist():
            known[i] = self._find(cells[i], near[i], vertices[i].tolist())
        new = known < 0
        known[new] = self.count + np.arange(np.count_nonzero(new))
        self.count += int(np.count_nonzero(new))
        for i in np.flatnonzero(shared).tolist():
            place = (int(cells[i, 0]), int(cells[i, 1]))
            x, y, z = vertices[i].tolist()
            self._here.setdefault(place, []).append((x, y, z, int(known[i])))
        return known, new

    def _find(self, cell: NDArray[np.float64], near: NDArray[np.int64], xyz: list[float]) -> int:
        column, row = int(cell[0]), int(cell[1])
        for c in {column, column + int(near[0])}:
            for r in {row, row + int(near[1])}:
                for kept in (self._here, self._above):
                    for x, y, z, number in kept.get((c, r), ()):
                        same = abs(x - xyz[0]) < _SAME and abs(y - xyz[1]) < _SAME
                        if same and abs(z - xyz[2]) < _SAME_HEIGHT:
                            return number
        return -1


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
