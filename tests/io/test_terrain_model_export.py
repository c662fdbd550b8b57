"""Triangulations and points of a terrain model: closed, true to the surface, each vertex once."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from defusedxml import ElementTree
from tools.small_model import EMPTY, LAYOUT, grid_unit, hills, lines, unit_at, wall_line
from tools.thinned import some

from photoplan.errors import UsageError
from photoplan.geometry.crs import canonical_crs, same_crs
from photoplan.io.terrain.files import read_measured
from photoplan.io.terrain.model_write import mesh_parts, replacing, write_points, write_tin
from photoplan.io.terrain.options import ReadOptions
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.mesh import build_faces
from photoplan.surfaces.units import MemoryUnits, Unit, UnitLayout

LOCAL = canonical_crs("+proj=tmerc +lat_0=48 +lon_0=16 +k=1 +x_0=1000 +y_0=2000 +ellps=GRS80 +units=m +type=crs")


def small() -> MemoryUnits:
    """The small model with faces that close: adapted widths meet without cracks, the wall is built from its line."""
    plain = {(c, r): unit_at(c, r) for r in range(LAYOUT.rows) for c in range(LAYOUT.columns)}
    units: dict[tuple[int, int], Unit] = {}
    from dataclasses import replace

    for (column, row), unit in plain.items():
        if unit is None:
            continue
        sides = {"north": (0, -1), "east": (1, 0), "south": (0, 1), "west": (-1, 0)}
        around = {side: plain.get((column + dc, row + dr)) for side, (dc, dr) in sides.items()}
        neighbours = {side: other for side, other in around.items() if other is not None}
        posts = grid_unit(LAYOUT, column, row, unit.meshes)
        units[column, row] = replace(posts, faces=build_faces(posts, [wall_line()], neighbours))
    return MemoryUnits(LAYOUT, units)


@pytest.fixture(scope="module")
def model() -> MemoryUnits:
    return small()


def whole(source: MemoryUnits) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    parts = list(mesh_parts(source))
    return tuple(np.concatenate([getattr(p, name) for p in parts]) for name in ("vertices", "faces", "walls"))  # type: ignore[return-value]


def doubled_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    (ax, ay), (bx, by), (cx, cy) = (vertices[faces[:, i], :2].T for i in range(3))
    return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)


def test_triangles_cover_the_model_once(model: MemoryUnits) -> None:
    vertices, faces, walls = whole(model)
    doubled = doubled_areas(vertices, faces)
    assert (doubled > 1e-6).all(), "all turn counter-clockwise"
    area = 0.5 * doubled.sum()
    assert area == pytest.approx(11 * LAYOUT.side**2, rel=1e-12)
    assert np.abs(doubled_areas(vertices, walls)).max() < 1e-6, "walls are vertical"
    assert len(walls) > 0


def test_no_vertex_twice_and_no_gap(model: MemoryUnits) -> None:
    """Every edge has two triangles, but for those on the model's rim: walls close what they cut open."""
    vertices, faces, walls = whole(model)
    assert len(np.unique(np.round(vertices, 3), axis=0)) == len(vertices)
    assert np.array_equal(np.unique(faces), np.arange(len(vertices)))
    both = np.concatenate([faces, walls])
    edges = Counter()
    directed = Counter()
    for a, b, c in both.tolist():
        for p, q in ((a, b), (b, c), (c, a)):
            edges[min(p, q), max(p, q)] += 1
            directed[p, q] += 1
    assert max(edges.values()) == 2 and max(directed.values()) == 1, "and neighbours turn alike"
    rim = [edge for edge, count in edges.items() if count == 1]
    ends = vertices[np.array(rim)].mean(axis=1)
    xmin, ymin, xmax, ymax = LAYOUT.bounds
    left, top = LAYOUT.corner(*EMPTY)
    on_rim = (np.abs(ends[:, 0] - [[xmin], [xmax], [left]]) < 1e-3).any(axis=0)
    on_rim |= (np.abs(ends[:, 1] - [[ymin], [ymax], [top], [top - LAYOUT.side]]) < 1e-3).any(axis=0)
    assert on_rim.all(), ends[~on_rim]


def test_triangles_lie_on_the_surface(model: MemoryUnits) -> None:
    """Vertices exactly; middles of bilinear meshes to a quarter of their twist."""
    vertices, faces, _ = whole(model)
    surface = HybridSurface(model)
    inner = vertices[faces].mean(axis=1)
    twist = 0.06
    assert np.abs(surface.heights(inner[:, :2]) - inner[:, 2]).max() < twist
    away = np.abs(hills(*vertices.T[:2]) - vertices[:, 2]) < 0.05
    assert np.abs(surface.heights(vertices[away, :2]) - vertices[away, 2]).max() < 2.01
    assert np.quantile(np.abs(surface.heights(vertices[away, :2]) - vertices[away, 2]), 0.99) < 1e-4


def test_obj_ply_and_landxml_say_the_same(model: MemoryUnits, tmp_path: Path) -> None:
    vertices, faces, walls = whole(model)
    both = {tuple(f) for f in np.concatenate([faces, walls]).tolist()}
    figures = write_tin(tmp_path / "a.obj", ".obj", model, "name\nf 1 2 3")
    assert (figures.vertices, figures.faces, figures.walls) == (len(vertices), len(faces), len(walls))
    rows = [line.split() for line in (tmp_path / "a.obj").read_text().splitlines()]
    read = np.array([row[1:] for row in rows if row[0] == "v"], float)
    assert np.abs(read - vertices).max() < 1e-4
    assert {tuple(int(i) - 1 for i in row[1:]) for row in rows if row[0] == "f"} == both

    write_tin(tmp_path / "a.ply", ".ply", model, "m")
    raw = (tmp_path / "a.ply").read_bytes()
    head, _, body = raw.partition(b"end_header\n")
    assert f"element vertex {len(vertices):012d}".encode() in head
    assert f"element face {len(both):012d}".encode() in head
    assert np.array_equal(np.frombuffer(body[: 24 * len(vertices)], "<f8").reshape(-1, 3), vertices)
    found = np.frombuffer(body[24 * len(vertices) :], [("n", "u1"), ("i", "<i4", 3)])
    assert (found["n"] == 3).all() and {tuple(i) for i in found["i"].tolist()} == both

    write_tin(tmp_path / "a.xml", ".xml", model, 'a<b>&"c')
    root = ElementTree.parse(tmp_path / "a.xml").getroot()
    space = "{http://www.landxml.org/schema/LandXML-1.2}"
    points = {p.get("id"): [float(v) for v in p.text.split()] for p in root.iter(f"{space}P")}
    assert np.abs(np.array(list(points.values()))[:, [1, 0, 2]] - vertices).max() < 1e-4, "north before east"
    triangles = {tuple(int(i) - 1 for i in f.text.split()) for f in root.iter(f"{space}F")}
    assert triangles == {tuple(f) for f in faces.tolist()}
    assert next(root.iter(f"{space}Surface")).get("name") == 'a<b>&"c'
    assert list(tmp_path.glob("*.faces")) != []


@pytest.mark.parametrize(
    ("crs", "heights"),
    some([("EPSG:25832", "EPSG:7837"), ("EPSG:25833", "ellipsoidal"), (LOCAL, None), ("EPSG:25832", None)], 0, 2),
)
def test_landxml_states_its_systems_and_is_read_with_them(
    model: MemoryUnits, tmp_path: Path, crs: str, heights: str | None
) -> None:
    """By code where there is one, else as WKT with all its quotes."""
    path = tmp_path / "a.xml"
    write_tin(path, ".xml", model, "m", crs=crs, height_system=heights)
    # The model's X begins with no number of a zone, as X of EPSG:3875 does.
    read = read_measured([path], ReadOptions(tin_points=True, beyond_area=True))
    assert read.crs is not None and same_crs(read.crs, crs) and read.height_system == heights
    assert read.count == len(whole(model)[0])
    write_tin(path, ".xml", model, "m")
    assert read_measured([path], ReadOptions(tin_points=True)).crs is None


def test_points_are_each_post_once_and_the_lines(model: MemoryUnits, tmp_path: Path) -> None:
    figures = write_points(tmp_path / "a.csv", ".csv", model, lines())
    text = (tmp_path / "a.csv").read_text().splitlines()
    assert text[0] == "x,y,z,sigma,kind,name,code,side"
    rows = [line.split(",") for line in text[1:]]
    posts = np.array([row[:3] for row in rows if row[4] == "post"], float)
    assert len(posts) == figures.vertices == len(np.unique(posts[:, :2], axis=0))
    expected = set()
    for row in range(LAYOUT.rows):
        for column in range(LAYOUT.columns):
            unit = model.unit(column, row)
            if unit is not None:
                along = np.arange(unit.meshes + 1) * unit.width
                expected |= {(unit.left + x, unit.top - y) for x in along for y in along}
    assert {tuple(p) for p in posts[:, :2].tolist()} == expected
    assert np.abs(posts[:, 2] - hills(posts[:, 0], posts[:, 1])).max() < 1e-4
    wall = [row for row in rows if row[5] == "wall Ä 7"]
    assert [row[7] for row in wall] == ["left"] * 9 + ["right"] * 9
    drop = np.array(wall, object)[:, 2].astype(float)
    assert np.allclose(drop[:9] - drop[9:], 2.0)
    assert figures.line_points == 18 + 3, "the border has no heights"
    xyz = write_points(tmp_path / "a.xyz", ".xyz", model, lines())
    assert np.loadtxt(tmp_path / "a.xyz").shape == (xyz.vertices + xyz.line_points, 3)


def test_memory_is_that_of_two_rows_of_units() -> None:
    """A hundred rows of units: the table of shared vertices never holds more than two rows' edges."""
    from photoplan.io.terrain import model_write as module

    layout = UnitLayout(0.0, 0.0, 8.0, 3, 100)
    source = MemoryUnits(layout, {(c, r): grid_unit(layout, c, r, 4) for c in range(3) for r in range(100)})
    held = []
    numbers = module._SharedNumbers.next_row

    def watched(self: module._SharedNumbers) -> None:
        held.append(sum(map(len, self._here.values())) + sum(map(len, self._above.values())))
        numbers(self)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module._SharedNumbers, "next_row", watched)
        parts = list(mesh_parts(source))
    assert sum(len(p.vertices) for p in parts) == 13 * 401
    assert max(held) <= 2 * 3 * 16


class TestReplacing:
    def test_fault_03_what_fails_leaves_nothing(self, tmp_path: Path) -> None:
        path = tmp_path / "a.obj"
        with pytest.raises(ZeroDivisionError), replacing(path) as part:
            part.write_text("half")
            raise ZeroDivisionError
        assert list(tmp_path.iterdir()) == []

    def test_fault_13_existing(self, tmp_path: Path) -> None:
        path = tmp_path / "a.obj"
        path.write_text("precious")
        with pytest.raises(UsageError, match="exists already"), replacing(path):
            pass
        with replacing(path, overwrite=True) as part:
            part.write_text("new")
            assert path.read_text() == "precious"
        assert path.read_text() == "new" and list(tmp_path.iterdir()) == [path]
