"""Measured terrain from LandXML, LAS, GeoPackage, Shapefile, GeoJSON and DXF, alone and together."""

from __future__ import annotations

import json
import sqlite3
import struct
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import pytest
import shapely
from numpy.typing import NDArray
from tools.effort import at_most

from photoplan.errors import HeightSystemError, InputError, UsageError
from photoplan.io.terrain import files
from photoplan.io.terrain.options import CodeClass, CodeTable, ReadOptions
from photoplan.surfaces.units import MeasuredTerrain

laspy = pytest.importorskip("laspy", reason="needs laspy")


def read_measured(paths: Sequence[Path], options: ReadOptions | None = None) -> MeasuredTerrain:
    """Files whose small coordinates lie far outside the area of their CRS."""
    return files.read_measured(paths, replace(options or ReadOptions(), beyond_area=True))


# ---- LandXML ---------------------------------------------------------------------------------------------------------

UNITS = '<Units><Metric linearUnit="meter"/></Units>'
SYSTEM = '<CoordinateSystem epsgCode="3875" verticalCoordinateSystemName="N2000"/>'


def landxml(path: Path, source: str = "", definition: str = "", head: str = UNITS + SYSTEM, before: str = "") -> Path:
    path.write_text(
        f'<?xml version="1.0"?>{before}<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2">{head}<Surfaces>'
        f'<Surface name="ground"><SourceData>{source}</SourceData>{definition}</Surface></Surfaces></LandXML>'
    )
    return path


def test_real_survey_equals_its_parsed_copy(shared: Path) -> None:
    """14,235 points and 175 breaklines with 5,871 vertices, bit by bit; the triangulation as its README says."""
    folder = shared / "data" / "m3_road_survey"
    measured = read_measured([folder / "M3_Terrain.mm.xml"])
    with np.load(folder / "m3_terrain_parsed.npz") as copy:
        points = np.concatenate([g.xyz for g in measured.points]) - copy["off"]
        np.testing.assert_array_equal(points, copy["P"])
        np.testing.assert_array_equal(np.concatenate([x.xyz for x in measured.lines]) - copy["off"], copy["B"])
        index = np.repeat(np.arange(len(measured.lines)), [len(x.xyz) for x in measured.lines])
        np.testing.assert_array_equal(index, copy["I"])
    assert measured.tin is not None
    assert (len(measured.tin.xyz), len(measured.tin.faces)) == (19_872, 36_067)
    assert (measured.crs, measured.height_system) == ("EPSG:3875", "EPSG:3900")
    assert measured.lines[0].code == "121" and measured.lines[0].name == "M3_Terrain.mm.xml: breakline 1 121"
    # The triangulation has the mass points as vertices: both orders of N and E cannot be right.
    tin = {tuple(p) for p in np.round(measured.tin.xyz, 3).tolist()}
    assert {tuple(p) for p in np.round(measured.points[0].xyz[:100], 3).tolist()} <= tin


@pytest.mark.parametrize(
    ("name", "points", "lines", "vertices", "faces"),
    [("M3_Rockbed_survey.mm.xml", 988, 67, 2037, 3244), ("M3_Highest_Comb_rev2_*.xml", 0, 63, 6547, 11_959)],
)
def test_the_other_real_surfaces(shared: Path, name: str, points: int, lines: int, vertices: int, faces: int) -> None:
    (path,) = (shared / "data" / "m3_road_survey").glob(name)
    measured = read_measured([path])
    assert (measured.count, len(measured.lines)) == (points, lines)
    assert measured.tin is not None
    assert (len(measured.tin.xyz), len(measured.tin.faces)) == (vertices, faces)


def test_landxml_classes(tmp_path: Path) -> None:
    source = """
    <DataPoints code="7"><PntList3D>20 10 1 21 11 2</PntList3D></DataPoints>
    <Breaklines><Breakline brkType="wall" name="w"><PntList3D>0 0 1 0 5 2</PntList3D>
      <Feature code="x"><Property label="terrainCoding" value="121"/></Feature></Breakline>
      <RetWall name="r"><RetWallPnt height="2" offset="-0.05">0 0 5</RetWallPnt>
        <RetWallPnt height="3" offset="-0.05">10 0 6</RetWallPnt></RetWall></Breaklines>
    <Boundaries><Boundary bndType="outer" edgeTrim="true"><PntList2D>0 0 0 9 9 9 0 0</PntList2D></Boundary>
      <Boundary bndType="void" edgeTrim="true"><PntList3D>1 1 0 1 2 0 2 2 0</PntList3D></Boundary></Boundaries>
    <Contours><Contour elev="12.5"><PntList2D>3 1 4 2</PntList2D></Contour></Contours>"""
    tin = """<Definition surfType="TIN"><Pnts><P id="5">0 1 2</P><P id="7">3 4 5</P><P id="9">9 4 5</P></Pnts>
    <Faces><F>5 7 9</F><F i="1">7 5 9</F></Faces></Definition>"""
    measured = read_measured([landxml(tmp_path / "a.xml", source, tin)])
    (points,) = measured.points
    assert points.xyz.tolist() == [[10, 20, 1], [11, 21, 2]] and points.name == "a.xml 7"
    edge, wall, border, hole, contour = measured.lines
    assert (edge.kind, edge.code, edge.right) == ("breakline", "121", None)
    # The wall leads north (X 0, Y 0 to 10); its points are the bottom, the other side is left and 2 and 3 m higher.
    assert wall.right is not None
    assert wall.xyz.tolist() == [[0, 0, 7], [0, 10, 9]] and wall.right.tolist() == [5, 6]
    assert border.kind == "border" and np.isnan(border.xyz[:, 2]).all() and border.xyz[1, :2].tolist() == [9, 0]
    assert hole.kind == "hole"
    assert contour.kind == "formline" and contour.xyz.tolist() == [[1, 3, 12.5], [2, 4, 12.5]]
    assert measured.tin is not None
    assert measured.tin.xyz[0].tolist() == [1, 0, 2] and measured.tin.faces.tolist() == [[0, 1, 2]]
    assert any("not two-sided" in n for n in measured.notes)


def test_landxml_codes_choose_classes(tmp_path: Path) -> None:
    source = '<DataPoints code="7"><PntList3D>2 1 1 2 1 2</PntList3D></DataPoints><Breaklines>' + "".join(
        f'<Breakline><PntList3D>0 0 1 0 5 2</PntList3D><Feature><Property label="terrainCoding" value="{c}"/></Feature>'
        "</Breakline>"
        for c in ("F", "I", "K")
    )
    codes = CodeTable({"7": CodeClass("spot", 0.03), "F": CodeClass("formline"), "I": CodeClass("ignore")})
    measured = read_measured([landxml(tmp_path / "a.xml", source + "</Breaklines>")], ReadOptions(codes=codes))
    assert [(g.kind, g.sigma) for g in measured.points] == [("spot", 0.03)]
    assert [x.kind for x in measured.lines] == ["formline", "breakline"]


TIN_ONLY = """<Definition surfType="TIN"><Pnts><P id="1">0 1 2</P><P id="2">3 4 5</P><P id="3">9 4 5</P></Pnts>
<Faces><F>1 2 3</F></Faces></Definition>"""


def test_a_triangulation_is_no_measurement_unless_asked(tmp_path: Path) -> None:
    path = landxml(tmp_path / "a.xml", "", TIN_ONLY)
    assert read_measured([path]).count == 0
    assert read_measured([path], ReadOptions(tin_points=True)).count == 3


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ('<Units><Imperial linearUnit="foot"/></Units><CoordinateSystem epsgCode="32632"/>', "feet.*metres"),
        ('<Units><Metric linearUnit="ell"/></Units>', "linearUnit: 'ell' is not a known unit"),
        ('<Units><Metric linearUnit="millimeter"/></Units>', "millimeter"),
        (UNITS + '<CoordinateSystem epsgCode="4326"/>', "geographic.*ogr2ogr"),
        (UNITS + '<CoordinateSystem epsgCode="2230"/>', "metres.*feet"),
        (UNITS + '<CoordinateSystem epsgCode="99"/>', "not a coordinate reference system"),
    ],
)
def test_fault_20_landxml_in_contradicting_units_is_refused(tmp_path: Path, head: str, message: str) -> None:
    path = landxml(tmp_path / "a.xml", "<DataPoints><PntList3D>0 0 0</PntList3D></DataPoints>", head=head)
    with pytest.raises(InputError, match=message):
        read_measured([path])


@pytest.mark.parametrize(
    ("before", "text"),
    [
        ('<!DOCTYPE a [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>', "&b;"),
        ('<!DOCTYPE a [<!ENTITY a SYSTEM "file:///etc/hostname">]>', "&a;"),
        ('<!DOCTYPE a SYSTEM "http://localhost/x.dtd">', ""),
    ],
)
def test_fault_10_entities_and_document_types_are_refused(tmp_path: Path, before: str, text: str) -> None:
    source = f"<DataPoints><PntList3D>0 0 0 {text}</PntList3D></DataPoints>"
    with pytest.raises(InputError, match="document type or entities"):
        read_measured([landxml(tmp_path / "a.xml", source, before=before)])


@pytest.mark.parametrize(
    ("source", "definition", "message"),
    [
        ("<DataPoints><PntList3D>0 0</PntList3D></DataPoints>", "", "2 numbers; 3 for each"),
        ("<DataPoints><PntList3D>0 0 x</PntList3D></DataPoints>", "", "'x' is not a number"),
        ("<DataPoints><PntList3D>0 0 nan</PntList3D></DataPoints>", "", "not finite"),
        (
            '<Breaklines><Breakline name="k"><PntList2D>0 0 1 1</PntList2D></Breakline></Breaklines>',
            "",
            "k: a PntList2D",
        ),
        ('<Breaklines><Breakline name="k"/></Breaklines>', "", "k: holds no list"),
        ("", TIN_ONLY.replace("1 2 3<", "1 2 4<"), "face 1 of the triangulation"),
        ("", TIN_ONLY.replace('id="2"', 'id="1"'), "point '1' of the triangulation: given twice"),
        ("<a>" * 100 + "</a>" * 100, "", "nested deeper"),
        ("<DataPoints>", "", r"a\.xml:1: not valid XML"),
    ],
)
def test_fault_18_damaged_landxml_names_the_element(tmp_path: Path, source: str, definition: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_measured([landxml(tmp_path / "a.xml", source, definition)])


def test_surfaces_are_chosen_by_name(tmp_path: Path) -> None:
    path = landxml(tmp_path / "a.xml", "<DataPoints><PntList3D>0 0 0</PntList3D></DataPoints>")
    two = path.read_text().replace("</Surfaces>", '<Surface name="rock"><SourceData/></Surface></Surfaces>')
    path.write_text(two)
    with pytest.raises(InputError, match=r"2 surfaces.*ground.*rock"):
        read_measured([path])
    assert read_measured([path], ReadOptions(layers=("ground",))).count == 1


# ---- LAS -------------------------------------------------------------------------------------------------------------

GRID = np.array([[500_000 + 0.5 * i, 5_000_000 + i, 100 + 0.01 * i] for i in range(1000)])


def las(path: Path, classes: Sequence[int] | int, crs: str | None = None, form: int = 6) -> Path:
    header = laspy.LasHeader(version="1.4", point_format=form)
    header.scales, header.offsets = np.full(3, 0.001), np.array([500_000.0, 5_000_000, 0])
    if crs is not None:
        from pyproj import CRS

        header.add_crs(CRS.from_user_input(crs))
    data = laspy.LasData(header)
    data.x, data.y, data.z = GRID.T
    data.classification = np.broadcast_to(classes, len(GRID)).astype(np.uint8)
    data.write(path)
    return path


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_ground_points_with_crs_and_heights(tmp_path: Path, suffix: str) -> None:
    path = las(tmp_path / f"a.{suffix}", np.arange(1000) % 5, "EPSG:25832+7837")
    measured = read_measured([path])
    (group,) = measured.points
    np.testing.assert_allclose(group.xyz, GRID[2::5], atol=5e-4)
    np.testing.assert_array_equal(group.records, np.arange(3, 1001, 5))
    assert (measured.crs, measured.height_system) == ("EPSG:25832", "EPSG:7837")
    assert "200 others" not in measured.notes[0] and "800 others left out" in measured.notes[0]
    assert read_measured([path], ReadOptions(las_classes=(1, 3))).count == 400
    with pytest.raises(InputError, match=r"no points of class 9; .*0 \(200 points\)"):
        read_measured([path], ReadOptions(las_classes=(9,)))


def test_unclassified_las_is_taken_whole(tmp_path: Path) -> None:
    measured = read_measured([las(tmp_path / "a.las", 0)])
    assert measured.count == 1000 and "not classified, all 1000 taken" in measured.notes[0]
    assert measured.crs is None and measured.height_system is None


def test_classes_that_begin_late_do_not_bring_earlier_points(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("photoplan.io.terrain.las.CHUNK", 100)
    classes = np.zeros(1000, int)
    classes[550:] = 2
    measured = read_measured([las(tmp_path / "a.las", classes)])
    np.testing.assert_array_equal(measured.points[0].records, np.arange(551, 1001))


def test_withheld_points_are_left_out(tmp_path: Path) -> None:
    path = las(tmp_path / "a.las", 2)
    data = laspy.read(path)
    data.withheld = np.arange(1000) < 10
    data.write(path)
    assert read_measured([path]).count == 990


def patched(path: Path, at: int, form: str, value: Any) -> Path:
    raw = bytearray(path.read_bytes())
    struct.pack_into(form, raw, at, value)
    path.write_bytes(bytes(raw))
    return path


@pytest.mark.parametrize(
    ("at", "form", "value", "message"),
    [
        (247, "<Q", 1 << 40, "promises 1099511627776 points"),
        (96, "<I", 1 << 31, "behind the end"),
        (100, "<I", 1 << 31, "behind the end"),
        (105, "<H", 3, "with 3 bytes a point"),
        (104, "<B", 50, "point format"),
        (243, "<I", 1 << 31, "behind the end"),
        (131, "<d", float("nan"), "scale"),
    ],
)
def test_fault_07_las_headers_that_promise_too_much(
    tmp_path: Path, at: int, form: str, value: Any, message: str
) -> None:
    path = patched(las(tmp_path / "a.las", 2), at, form, value)
    with at_most(1), pytest.raises(InputError, match=message):
        read_measured([path])


def test_fault_07_a_laz_bomb_is_refused_by_its_header(tmp_path: Path) -> None:
    path = patched(las(tmp_path / "a.laz", 2), 247, "<Q", 1 << 40)
    with pytest.raises(InputError, match="times what is stored"):
        read_measured([path])


@pytest.mark.parametrize(
    ("suffix", "trials"), [("las", 60), ("laz", 3), pytest.param("laz", 300, marks=pytest.mark.slow)]
)
def test_fault_08_damaged_las_and_laz_never_crash(tmp_path: Path, suffix: str, trials: int) -> None:
    rng = np.random.default_rng(3)
    whole = las(tmp_path / f"a.{suffix}", 2, "EPSG:25832").read_bytes()
    path = tmp_path / f"b.{suffix}"
    for trial in range(trials):
        raw = bytearray(whole)
        if trial % 3 == 0:
            raw = raw[: int(rng.integers(4, len(raw)))]
        else:
            for at in rng.integers(4, min(len(raw), 900), 5):
                raw[at] = rng.integers(256)
        path.write_bytes(bytes(raw))
        try:
            read_measured([path])
        except InputError as error:
            assert str(path) in str(error) or path.name in str(error)


def test_fault_08_a_decoder_that_asks_for_all_memory_ends_alone(tmp_path: Path) -> None:
    """The table of chunks promises four thousand million of them: its decoder ends its process by an abort."""
    path = las(tmp_path / "a.laz", 2)
    raw = bytearray(path.read_bytes())
    (points,) = struct.unpack_from("<I", raw, 96)
    (table,) = struct.unpack_from("<q", raw, points)
    raw[table + 4 : table + 8] = b"\xff\xff\xff\xff"
    path.write_bytes(raw)
    with pytest.raises(InputError, match=r"a\.laz: cannot be read .*promises 1000 points"):
        read_measured([path])


def test_las_without_laspy_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = las(tmp_path / "a.las", 2)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"photoplan\[points\]"):
        read_measured([path])


def test_fault_20_las_in_feet_is_converted_or_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="unit of heights is not stated"):
        read_measured([las(tmp_path / "a.las", 2, "EPSG:2230")])
    with pytest.raises(InputError, match="geographic"):
        read_measured([las(tmp_path / "b.las", 2, "EPSG:4326")])
    plain = read_measured([las(tmp_path / "p.las", 2, "EPSG:26910+5703")])
    feet = read_measured([las(tmp_path / "c.las", 2, "EPSG:26910+6360")])
    assert feet.height_system == plain.height_system == "EPSG:5703"
    np.testing.assert_allclose(feet.points[0].xyz, plain.points[0].xyz * [1, 1, 1200 / 3937])


# ---- vector files ----------------------------------------------------------------------------------------------------


def vector(
    path: Path, wkt: Sequence[str], layer: str = "survey", crs: str | None = "EPSG:3875", **fields: Sequence[Any]
) -> Path:
    driver = {".gpkg": "GPKG", ".shp": "ESRI Shapefile", ".geojson": "GeoJSON", ".dxf": "DXF"}[path.suffix]
    columns: list[NDArray[Any]] = [np.array(v, object if isinstance(v[0], str) else None) for v in fields.values()]
    more = {"layer": layer} if driver == "GPKG" else {}
    geometry = shapely.to_wkb(shapely.from_wkt(wkt))
    kind = shapely.get_type_id(shapely.from_wkt(wkt[0]))
    pyogrio.raw.write(
        path,
        geometry,
        columns,
        list(fields),
        geometry_type={0: "Point Z", 1: "LineString Z", 3: "Polygon", 5: "MultiLineString Z"}[int(kind)]
        if driver != "DXF"
        else "Unknown",
        crs=crs,
        driver=driver,
        append=path.exists(),
        **more,
    )
    return path


@pytest.mark.parametrize("suffix", ["gpkg", "shp", "geojson"])
def test_vector_points_and_lines(tmp_path: Path, suffix: str) -> None:
    points = vector(
        tmp_path / f"p.{suffix}",
        ["POINT Z (1 2 3)", "POINT Z (4 5 6)"],
        code=["G", "S"],
        name=["a", "b"],
        sigma=[0.1, 0.2],
    )
    lines = vector(tmp_path / f"l.{suffix}", ["LINESTRING Z (0 0 1, 5 0 2, 9 0 3)"], kind=["formline"], z_right=["4"])
    codes = CodeTable({"S": CodeClass("spot"), "G": CodeClass("mass")})
    measured = read_measured([points, lines], ReadOptions(codes=codes))
    assert [(g.kind, g.sigma, g.xyz.tolist(), g.label(0)) for g in measured.points] == [
        ("mass", 0.1, [[1, 2, 3]], f"p.{suffix} G a (record 1)"),
        ("spot", 0.2, [[4, 5, 6]], f"p.{suffix} S b (record 2)"),
    ]
    (line,) = measured.lines
    assert line.kind == "formline" and line.right is None and line.xyz.tolist() == [[0, 0, 1], [5, 0, 2], [9, 0, 3]]
    assert measured.crs == "EPSG:3875"


def test_walls_and_polygons_of_a_geopackage(tmp_path: Path) -> None:
    path = tmp_path / "a.gpkg"
    wall, flat = "MULTILINESTRING Z ((0 0 5, 9 0 5))", "MULTILINESTRING Z ((0 3 5, 9 3 5), (0 4 5, 9 4 5))"
    vector(path, [wall, flat], "Breaklines", z_right=["2 3", ""])
    vector(path, ["POLYGON ((0 0, 9 0, 9 9, 0 9, 0 0), (1 1, 2 1, 2 2, 1 1))"], "area", n=[1])
    measured = read_measured([path])
    assert [x.kind for x in measured.lines] == ["breakline"] * 3 + ["border", "hole"]
    assert measured.lines[0].right is not None and measured.lines[0].right.tolist() == [2, 3]
    assert measured.lines[1].right is None
    assert len(read_measured([path], ReadOptions(layers=("area",))).lines) == 2
    with pytest.raises(InputError, match="no layer called x; it has Breaklines, area"):
        read_measured([path], ReadOptions(layers=("x",)))
    with pytest.raises(InputError, match="no attribute 'art'"):
        read_measured([path], ReadOptions(attribute="art"))


def test_fault_07_a_query_instead_of_a_table_is_refused(tmp_path: Path) -> None:
    path = vector(tmp_path / "a.gpkg", ["POINT Z (1 2 3)"], "real", n=[1])
    with closing(sqlite3.connect(path)) as db, db:
        endless = "WITH RECURSIVE c(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM c) SELECT i AS fid, geom FROM c, real"
        db.execute(f"CREATE VIEW bomb AS {endless}")
        for table in ("gpkg_contents", "gpkg_geometry_columns"):
            names = [row[1] for row in db.execute(f"PRAGMA table_info({table})")]
            values = ", ".join("'bomb'" if n in ("table_name", "identifier") else n for n in names)
            db.execute(f"INSERT INTO {table} SELECT {values} FROM {table}")
    with pytest.raises(InputError, match="bomb is a view"):
        read_measured([path])
    assert read_measured([path], ReadOptions(layers=("real",))).count == 1


def test_two_heights_for_three_vertices_are_refused(tmp_path: Path) -> None:
    path = vector(tmp_path / "a.gpkg", ["LINESTRING Z (0 0 5, 9 0 5, 9 1 5)"], z_right=["2 3"])
    with pytest.raises(InputError, match="feature 1: z_right = '2 3'; 3 heights"):
        read_measured([path])


def test_lines_without_heights_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.geojson"
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": [[0, 0], [9, 0]]}}
    crs = {"type": "name", "properties": {"name": "EPSG:3875"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}))
    with pytest.raises(InputError, match="feature 1: has no height"):
        read_measured([path])


def test_fault_20_geojson_in_degrees_is_refused_and_in_metres_taken(tmp_path: Path) -> None:
    def point(*xyz: float) -> str:
        feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": xyz}}
        return json.dumps({"type": "FeatureCollection", "features": [feature]})

    path = tmp_path / "a.geojson"
    path.write_text(point(24.5, 61.2, 100))
    with pytest.raises(InputError, match="geographic"):
        read_measured([path])
    path.write_text(point(21_530_000, 6_782_000, 100))
    measured = read_measured([path], ReadOptions(crs="EPSG:3875"))
    assert measured.crs == "EPSG:3875" and measured.count == 1


def dxf(path: Path, entities: str, units: int | None = None) -> Path:
    head = f"0\nSECTION\n2\nHEADER\n9\n$INSUNITS\n70\n{units}\n0\nENDSEC\n" if units is not None else ""
    path.write_text(f"{head}0\nSECTION\n2\nENTITIES\n{entities}0\nENDSEC\n0\nEOF\n")
    return path


def entity(kind: str, layer: str, *numbers: tuple[int, float]) -> str:
    return f"0\n{kind}\n8\n{layer}\n" + "".join(f"{code}\n{value}\n" for code, value in numbers)


POINT = entity("POINT", "GROUND", (10, 1), (20, 2), (30, 3))
LINE = entity("LINE", "BREAKLINES", (10, 0), (20, 0), (30, 1), (11, 5), (21, 5), (31, 2))
RING = entity("LWPOLYLINE", "BORDER", (90, 3), (70, 1), (10, 0), (20, 0), (10, 9), (20, 0), (10, 9), (20, 9))
TEXT = entity("TEXT", "GROUND", (10, 1), (20, 2), (30, 0), (40, 1)) + "1\nhello\n"
FACE = entity(
    "3DFACE", "TIN", *((c + 10 * k, float(v)) for k in (1, 2, 3) for c, v in ((0, k), (1, k * k), (2, k), (3, 0)))
)


def test_dxf_layers_are_classes(tmp_path: Path) -> None:
    measured = read_measured([dxf(tmp_path / "a.dxf", POINT + LINE + RING + TEXT + FACE, 6)])
    assert [(g.kind, g.xyz.tolist()) for g in measured.points] == [("mass", [[1, 2, 3]])]
    assert [(x.kind, len(x.xyz)) for x in measured.lines] == [("breakline", 2), ("border", 4)]
    assert any("1 texts left out" in n for n in measured.notes) and any("1 faces" in n for n in measured.notes)
    only = read_measured([tmp_path / "a.dxf"], ReadOptions(layers=("GROUND",)))
    assert only.count == 1 and not only.lines


@pytest.mark.parametrize(("number", "metres"), [(2, 0.3048), (21, 1200 / 3937), (4, 1e-3), (1, 0.0254), (14, 0.1)])
def test_fault_20_dxf_in_other_units_is_converted(tmp_path: Path, number: int, metres: float) -> None:
    measured = read_measured([dxf(tmp_path / "a.dxf", POINT, number)])
    np.testing.assert_allclose(measured.points[0].xyz, np.array([[1, 2, 3]]) * metres)
    assert any("converted to metres" in note for note in measured.notes)


def test_fault_20_dxf_in_no_known_unit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a\.dxf.*INSUNITS"):
        read_measured([dxf(tmp_path / "a.dxf", POINT, 25)])


def test_fault_07_nested_blocks_of_a_drawing_are_not_unfolded(tmp_path: Path) -> None:
    at = ((10, 0), (20, 0), (30, 7))
    blocks = ""
    for k in range(12):
        inner = entity("INSERT", "0") + f"2\nB{k - 1}\n10\n0\n20\n0\n" if k else POINT
        blocks += entity("BLOCK", "0") + f"2\nB{k}\n70\n0\n10\n0\n20\n0\n30\n0\n3\nB{k}\n" + inner * 10
        blocks += entity("ENDBLK", "0")
    last = entity("INSERT", "GROUND") + "2\nB11\n" + "".join(f"{c}\n{v}\n" for c, v in at)
    path = dxf(tmp_path / "a.dxf", POINT + last, 6)
    section = f"0\nSECTION\n2\nBLOCKS\n{blocks}0\nENDSEC\n"
    path.write_text(path.read_text().replace("0\nSECTION\n2\nENT", section + "0\nSECTION\n2\nENT"))
    with at_most(3):
        measured = read_measured([path])
    assert measured.count == 2


# ---- several files ---------------------------------------------------------------------------------------------------


def test_files_of_one_crs_are_merged(tmp_path: Path) -> None:
    a = vector(tmp_path / "a.gpkg", ["POINT Z (1 2 3)"], n=[1])
    b = landxml(tmp_path / "b.xml", "<DataPoints><PntList3D>2 1 4</PntList3D></DataPoints>")
    c = tmp_path / "c.xyz"
    c.write_text("1 2 3\n")
    measured = read_measured([a, b, c])
    assert measured.count == 3 and measured.files == (a, b, c)
    assert measured.crs == "EPSG:3875"
    # Fault 2: one file states heights, the others do not; nothing is guessed.
    assert measured.height_system is None
    assert any("declare it" in n for n in measured.notes) and any("states no CRS" in n for n in measured.notes)


def test_fault_20_files_of_different_crs_are_refused_by_name(tmp_path: Path) -> None:
    a = vector(tmp_path / "a.gpkg", ["POINT Z (1 2 3)"], n=[1])
    b = vector(tmp_path / "b.gpkg", ["POINT Z (1 2 3)"], crs="EPSG:3876", n=[1])
    with pytest.raises(InputError, match=r"a\.gpkg is in EPSG:3875, .*b\.gpkg in EPSG:3876"):
        read_measured([a, b])
    with pytest.raises(InputError, match=r"a\.gpkg: states EPSG:3875, declared is EPSG:3876"):
        read_measured([a], ReadOptions(crs="EPSG:3876"))
    with pytest.raises(InputError, match=r"declared CRS.*geographic"):
        read_measured([a], ReadOptions(crs="EPSG:4326"))


def test_fault_02_different_height_systems_are_refused(tmp_path: Path) -> None:
    source = "<DataPoints><PntList3D>2 1 4</PntList3D></DataPoints>"
    a = landxml(tmp_path / "a.xml", source)
    b = landxml(tmp_path / "b.xml", source, head=UNITS + SYSTEM.replace("N2000", "N60"))
    with pytest.raises(HeightSystemError, match=r"a\.xml.*b\.xml"):
        read_measured([a, b])


def test_one_file_twice_and_no_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.xyz"
    path.write_text("1 2 3\n")
    (tmp_path / "b.xyz").symlink_to(path)
    with pytest.raises(UsageError, match="count twice"):
        read_measured([path, tmp_path / "b.xyz"])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.tif", b"II*\x00....", "a raster"),
        ("a.asc", b"ncols 5\nnrows 5\n", "a raster"),
        ("a.xyz", b"", "empty"),
        ("a.xml", b"<gml/>", "<gml>; LandXML"),
        ("a.gpkg", b"SQLite format 3\x00 damaged", "cannot be read"),
        ("a.shp", b"\x00\x00\x27\x0a damaged", "cannot be"),
        ("a.geojson", b'{"type": "nothing"', "cannot be read"),
        ("a.las", b"LASF", "cut off in its header"),
    ],
)
def test_fault_08_what_is_no_measured_terrain_is_named(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_measured([path])


def test_fault_09_virtual_paths_are_refused() -> None:
    with pytest.raises(InputError, match="virtual"):
        read_measured([Path("/vsizip/a.zip/a.gpkg")])


def test_codes_that_no_attribute_holds_are_an_error_that_lists_the_attributes(tmp_path: Path) -> None:
    path = vector(tmp_path / "p.gpkg", ["POINT Z (1 2 3)", "POINT Z (4 5 6)"], Description=["G", "S"], Nr=["a", "b"])
    options = ReadOptions(codes=CodeTable({"S": CodeClass("spot"), "*": CodeClass("mass")}))
    with pytest.raises(InputError, match=r"none of its codes \(S\).*layer survey with Description, Nr.*`attribute`"):
        read_measured([path], options)
    named = read_measured([path], replace(options, attribute="Description"))
    assert sorted(g.kind for g in named.points) == ["mass", "spot"]
    by_layer = ReadOptions(codes=CodeTable({"survey": CodeClass("spot")}))
    assert [g.kind for g in read_measured([path], by_layer).points] == ["spot"]


def test_codes_that_landxml_does_not_hold(tmp_path: Path) -> None:
    source = '<DataPoints code="7"><PntList3D>2 1 1 2 1 2</PntList3D></DataPoints>' * 2
    path = landxml(tmp_path / "a.xml", source.replace('"7"', '"8"', 1))
    with pytest.raises(InputError, match=r"none of its codes \(9\).*the codes 7, 8"):
        read_measured([path], ReadOptions(codes=CodeTable({"9": CodeClass("spot")})))
    read = read_measured([path], ReadOptions(codes=CodeTable({"7": CodeClass("spot")})))
    assert any("read as their elements say: 8" in note for note in read.notes)


def test_a_standard_deviation_too_large_for_a_machine_number_is_a_number() -> None:
    assert CodeClass("mass", 10**30).sigma == 10**30
    with pytest.raises(InputError, match="zero or more"):
        CodeClass("mass", -(10**30))
