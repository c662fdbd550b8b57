"""Drawings: heights where DXF puts them, blocks, faces, and entities that cannot be read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from photoplan.errors import InputError
from photoplan.io.drawing import read_drawing
from photoplan.io.terrain.files import read_measured
from photoplan.io.terrain.options import ReadOptions

ezdxf: Any = pytest.importorskip("ezdxf")


def drawing(path: Path, fill: Callable[[Any, Any], None], version: str = "R2010", units: int = 6) -> Path:
    document = ezdxf.new(version)
    document.units = units
    fill(document, document.modelspace())
    document.saveas(path)
    return path


def heights(path: Path) -> list[list[float]]:
    return [shapely.get_coordinates(s, include_z=True)[:, 2].tolist() for s in read_drawing(path).shapes]


@pytest.mark.parametrize("version", ["R12", "R2000", "R2018"])
def test_old_polylines_have_their_elevation(tmp_path: Path, version: str) -> None:
    def fill(document: Any, space: Any) -> None:
        space.add_polyline2d([(0, 0), (9, 0), (9, 9)], dxfattribs={"elevation": (0, 0, 102.5)})
        space.add_polyline3d([(0, 0, 1), (9, 0, 2)])
        if version != "R12":
            space.add_lwpolyline([(0, 0), (5, 5)], dxfattribs={"elevation": 7.0})

    found = heights(drawing(tmp_path / "a.dxf", fill, version))
    assert found[:2] == [[102.5] * 3, [1, 2]]
    assert version == "R12" or found[2] == [7, 7]


def test_object_coordinates_become_world_coordinates(tmp_path: Path) -> None:
    """An extrusion along −Z mirrors X; along Y the elevation is a distance in Y."""

    def fill(document: Any, space: Any) -> None:
        space.add_lwpolyline([(1, 2), (3, 2)], dxfattribs={"elevation": 5.0, "extrusion": (0, 0, -1)})
        space.add_lwpolyline([(1, 2), (3, 4)], dxfattribs={"elevation": -5.0, "extrusion": (0, -1, 0)})

    a, b = (shapely.get_coordinates(s, include_z=True) for s in read_drawing(drawing(tmp_path / "a.dxf", fill)).shapes)
    np.testing.assert_allclose(a, [[-1, 2, -5], [-3, 2, -5]], atol=1e-12)
    np.testing.assert_allclose(b, [[1, 5, 2], [3, 5, 4]], atol=1e-12)


def test_a_polyline_without_elevation_states_no_height(tmp_path: Path) -> None:
    path = drawing(tmp_path / "a.dxf", lambda document, space: space.add_lwpolyline([(0, 0), (5, 5)]))
    assert not shapely.has_z(read_drawing(path).shapes).any()
    with pytest.raises(InputError, match="has no height"):
        read_measured([path])


def test_blocks_with_heights_are_unfolded_and_symbols_are_points(tmp_path: Path) -> None:
    def fill(document: Any, space: Any) -> None:
        inner = document.blocks.new("INNER")
        inner.add_line((0, 0, 1), (2, 0, 3))
        outer = document.blocks.new("OUTER")
        outer.add_blockref("INNER", (10, 0, 100))
        symbol = document.blocks.new("TREE")
        symbol.add_circle((0, 0), 1)
        space.add_blockref("OUTER", (0, 0, 0), dxfattribs={"xscale": 2, "yscale": 2, "zscale": 2, "layer": "ground"})
        space.add_blockref("TREE", (5, 6, 77))

    found = read_drawing(drawing(tmp_path / "a.dxf", fill))
    line, point = (shapely.get_coordinates(s, include_z=True).tolist() for s in found.shapes)
    assert line == [[20, 0, 202], [24, 0, 206]] and point == [[5, 6, 77]]
    assert found.layers.tolist() == ["ground", "0"]


def test_blocks_that_grow_without_end_are_points(tmp_path: Path) -> None:
    def fill(document: Any, space: Any) -> None:
        for k in range(9):
            block = document.blocks.new(f"B{k}")
            for _ in range(10):
                block.add_point((0, 0, 3)) if k == 0 else block.add_blockref(f"B{k - 1}", (0, 0))
        space.add_blockref("B8", (1, 2, 3))

    found = read_drawing(drawing(tmp_path / "a.dxf", fill))
    assert [s.wkt for s in found.shapes] == ["POINT Z (1 2 3)"]
    assert any("are not unfolded" in note for note in found.notes)


def test_faces_alone_are_points_and_beside_points_they_are_named(tmp_path: Path) -> None:
    def faces(document: Any, space: Any) -> None:
        space.add_3dface([(0, 0, 1), (9, 0, 2), (9, 9, 3)])
        space.add_3dface([(0, 0, 1), (9, 9, 3), (0, 9, 4)])

    def both(document: Any, space: Any) -> None:
        faces(document, space)
        space.add_point((1, 2, 3))

    alone = read_measured([drawing(tmp_path / "a.dxf", faces)])
    assert alone.count == 4 and any("2 faces: their 4 corners" in note for note in alone.notes)
    mixed = read_measured([drawing(tmp_path / "b.dxf", both)])
    assert mixed.count == 1 and any("2 faces left out; with `tin_points`" in note for note in mixed.notes)
    assert read_measured([tmp_path / "b.dxf"], ReadOptions(tin_points=True)).count == 5


def test_curves_are_chains_of_chords(tmp_path: Path) -> None:
    def fill(document: Any, space: Any) -> None:
        space.add_spline([(0, 0, 1), (5, 5, 2), (9, 0, 3)])  # by fit points alone
        space.add_arc((0, 0, 4), 100, 0, 90)

    spline, arc = read_drawing(drawing(tmp_path / "a.dxf", fill)).shapes
    assert shapely.get_coordinates(spline, include_z=True)[[0, -1], 2] == pytest.approx([1, 3])
    XYZ = shapely.get_coordinates(arc, include_z=True)
    assert np.hypot(*XYZ[:, :2].T) == pytest.approx(100) and (XYZ[:, 2] == 4).all()
    assert arc.length == pytest.approx(50 * np.pi, rel=1e-3)


@pytest.mark.parametrize(
    ("old", "new"),
    [("\n 30\n2.0\n", "\n 30\nheight\n"), ("\n 20\n5.0\n", "\n 20\nnan\n"), ("\n 10\n4.0\n", "\n 10\n\n")],
)
def test_one_damaged_entity_is_skipped_and_counted(tmp_path: Path, old: str, new: str) -> None:
    def fill(document: Any, space: Any) -> None:
        space.add_point((1, 1, 1))
        space.add_point((4, 5, 2))
        space.add_point((3, 3, 3))

    path = drawing(tmp_path / "a.dxf", fill)
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    measured = read_measured([path])
    assert measured.points[0].xyz[:, 2].tolist() == [1, 3]
    assert any("1 damaged entit" in note or "cannot be read" in note for note in measured.notes)


@pytest.mark.parametrize(
    "case", ["02_dxf_polyline2d_elevation/b.dxf", "04_dxf_insunits_feet/e.dxf", "21_dxf_messages/i.dxf"]
)
def test_drawings_of_outsiders(shared: Path, case: str) -> None:
    measured = read_measured([shared / "cases" / case], ReadOptions(crs="EPSG:32632", height_system="EPSG:5773"))
    XYZ = np.concatenate([*(g.xyz for g in measured.points), *(line.xyz for line in measured.lines)])
    assert (np.abs(XYZ.mean(axis=0) - [500_050, 5_200_040, 103.5]) < [30, 30, 2]).all()


def test_a_unit_that_leads_out_of_the_area_is_refused_and_can_be_declared(tmp_path: Path) -> None:
    def fill(document: Any, space: Any) -> None:
        space.add_point((500_000, 5_400_000, 300))

    path = drawing(tmp_path / "a.dxf", fill, units=4)
    with pytest.raises(InputError, match=r"a\.dxf: states millimetres, .*only in metres; .*`unit` m"):
        read_measured([path], ReadOptions(crs="EPSG:32632"))
    measured = read_measured([path], ReadOptions(crs="EPSG:32632", unit="m"))
    assert measured.points[0].xyz.tolist() == [[500_000, 5_400_000, 300]]


def test_heights_in_attributes_of_blocks_and_in_texts(tmp_path: Path) -> None:
    """Spot heights of surveyors: the block or the text lies in height 0, and the number beside it is the height."""
    drawing = ezdxf.new("R2010")
    space = drawing.modelspace()
    drawing.blocks.new("SPOT").add_circle((0, 0), 0.2)
    for k in range(4):
        reference = space.add_blockref("SPOT", (k, k * k, 0))
        reference.add_attrib("ELEV", f"{200 + k / 2}", (k, k))
        reference.add_attrib("NO", f"P{k}", (k, k))
        space.add_text(f" {300 + k} ").set_placement((10 + k, k * k))
    space.add_text("road").set_placement((5, 5))
    space.add_line((0, 9, 201), (9, 9, 202))
    drawing.saveas(tmp_path / "s.dxf")
    measured = read_measured([tmp_path / "s.dxf"], ReadOptions(crs="EPSG:32632", beyond_area=True))
    assert any("blocks have attributes: ELEV, NO; `height_field` takes" in note for note in measured.notes)
    for name, heights, x in (("ELEV", [200, 200.5, 201, 201.5], 0.0), ("Text", [300, 301, 302, 303], 10.0)):
        options = ReadOptions(crs="EPSG:32632", beyond_area=True, height_field=name.lower())
        found = read_measured([tmp_path / "s.dxf"], options)
        points = np.concatenate([group.xyz for group in found.points])
        mine = points[(points[:, 0] >= x) & (points[:, 0] < x + 4)]
        assert sorted(mine[:, 2]) == heights and found.lines[0].xyz[:, 2].tolist() == [201, 202]
    with pytest.raises(InputError, match="'P0' in NO is not a number"):
        read_measured([tmp_path / "s.dxf"], ReadOptions(crs="EPSG:32632", beyond_area=True, height_field="NO"))
    alone = ezdxf.new("R2010")
    for k in range(3):
        alone.modelspace().add_text(f"{300 + k}").set_placement((k, k * k))
    alone.saveas(tmp_path / "t.dxf")
    with pytest.raises(InputError, match="3 of its texts are numbers; `height_field` Text takes them for heights"):
        read_measured([tmp_path / "t.dxf"], ReadOptions(crs="EPSG:32632", beyond_area=True))


@pytest.mark.parametrize("version", ["AC1004", "AC2.10", "AC1009", ""])
def test_elevations_of_the_oldest_drawings(tmp_path: Path, version: str) -> None:
    """Before release 11, group 38 states the elevation of any entity; all of them lay in height 0."""
    points = [f"0\nPOINT\n8\nC\n38\n{80 + k}\n10\n{k}\n20\n{k * k}" for k in range(3)]
    line = (
        "0\nLINE\n8\nC\n38\n88\n10\n0\n20\n0\n11\n10\n21\n5\n0\nLINE\n8\nC\n10\n0\n20\n0\n30\n7\n11\n10\n21\n5\n31\n9"
    )
    vertices = "".join(f"\n0\nVERTEX\n8\nC\n10\n{x}\n20\n6" for x in (0, 5))
    chain = f"0\nPOLYLINE\n8\nC\n66\n1\n38\n77.5\n70\n0{vertices}\n0\nSEQEND"
    head = f"9\n$ACADVER\n1\n{version}\n" if version else ""
    entities = "\n".join([*points, line, chain])
    (tmp_path / "o.dxf").write_text(
        f"0\nSECTION\n2\nHEADER\n{head}0\nENDSEC\n0\nSECTION\n2\nENTITIES\n{entities}\n0\nENDSEC\n0\nEOF\n"
    )
    assert heights(tmp_path / "o.dxf") == [[80], [81], [82], [88, 88], [7, 9], [77.5, 77.5]]
