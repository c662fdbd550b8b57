"""Files of objects: CityJSON, polygons in space, meshes; and what must be refused of them."""

from __future__ import annotations

import copy
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from photoplan.errors import InputError, ResourceError, UsageError
from photoplan.io import objects as mesh
from photoplan.io.objects import read_objects
from photoplan.io.vector_layer import VectorLayer, write_geopackage

CUBE = [[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0], [0, 0, 10], [10, 0, 10], [10, 10, 10], [0, 10, 10]]
SHELL = [[[0, 3, 2, 1]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]
SEMANTICS = {
    "surfaces": [{"type": "GroundSurface"}, {"type": "RoofSurface"}, {"type": "WallSurface"}],
    "values": [[0, 1, 2, 2, 2, 2]],
}


def city(**changes: Any) -> dict[str, Any]:
    """A cube of 10 m as a building of two levels of detail, a road, and a bridge."""
    return {
        "type": "CityJSON", "version": "2.0",
        "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/7415"},
        "transform": {"scale": [0.5, 0.5, 0.5], "translate": [1000.0, 2000.0, 3.0]},
        "vertices": copy.deepcopy(CUBE),
        "CityObjects": {
            "house": {"type": "Building", "geometry": [
                {"type": "MultiSurface", "lod": "1.2", "boundaries": [[[0, 1, 2, 3]]]},
                {"type": "Solid", "lod": "2", "boundaries": [SHELL], "semantics": SEMANTICS},
                {"type": "MultiPoint", "lod": "3", "boundaries": [0]},
            ]},
            "deck": {"type": "BridgePart", "geometry": [
                {"type": "MultiSurface", "lod": 1, "boundaries": [[[4, 5, 6, 7]]]}]},
            "road": {"type": "Road", "geometry": [{"type": "MultiSurface", "lod": 1, "boundaries": [[[0, 1, 2]]]}]},
            "parent": {"type": "Building", "children": ["part"]},
        },
    } | changes  # fmt: skip


def written(tmp_path: Path, data: Any, name: str = "town.json") -> Path:
    path = tmp_path / name
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def area(corners: np.ndarray) -> float:
    e = np.diff(corners, axis=1)
    return float(np.linalg.norm(np.cross(e[:, 0], e[:, 1]), axis=1).sum() / 2)


def test_cityjson_gives_the_finest_faces_of_what_stands(tmp_path: Path) -> None:
    found = read_objects(written(tmp_path, city()))
    assert found.names == ("house", "deck") and not found.mesh and found.roles == (None, None)
    assert (found.crs, found.height_system) == ("EPSG:28992", "EPSG:5709")
    # Five faces of 5 m × 5 m: the ground surface is the terrain's.
    assert area(found.corners[found.owner == 0]) == pytest.approx(5 * 25)
    assert found.corners[..., 2].max() == 8.0 and found.corners[..., :2].min(axis=(0, 1)).tolist() == [1000, 2000]
    for text in (
        "https://www.opengis.net/def/crs-compound?1=http://www.opengis.net/def/crs/EPSG/0/28992"
        "&2=http://www.opengis.net/def/crs/EPSG/0/5709",
        "urn:ogc:def:crs,crs:EPSG::28992,crs:EPSG::5709",
        "http://www.opengis.net/def/crs/EPSG/10.0/7415",
    ):
        same = read_objects(written(tmp_path, city(metadata={"referenceSystem": text})))
        assert (same.crs, same.height_system) == ("EPSG:28992", "EPSG:5709"), text
    road = read_objects(written(tmp_path, city()), "Road")
    assert road.names == ("road",) and area(road.corners) == pytest.approx(12.5)
    old = city(version="1.0", metadata={"referenceSystem": "urn:ogc:def:crs:EPSG::2056"})
    del old["transform"]
    found = read_objects(written(tmp_path, old))
    assert found.crs == "EPSG:2056" and found.height_system is None and found.corners.max() == 10


def trees(**changes: Any) -> dict[str, Any]:
    """Two trees of one template: a square of 2 m, upright; one of them twice as large, turned by a right angle."""
    template = {"type": "MultiSurface", "lod": "2", "boundaries": [[[0, 1, 2, 3]]]}
    plain = [1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    turned = [0.0, -2, 0, 5, 2, 0, 0, 0, 0, 0, 2, 1, 0, 0, 0, 1]
    instance = {"type": "GeometryInstance", "template": 0, "boundaries": [6], "transformationMatrix": plain}
    data = city()
    data["geometry-templates"] = {
        "templates": [template], "vertices-templates": [[0.0, 0, 0], [2, 0, 0], [2, 0, 2], [0, 0, 2]]
    }  # fmt: skip
    data["CityObjects"] = {
        "oak": {"type": "SolitaryVegetationObject", "geometry": [instance]},
        "elm": {
            "type": "SolitaryVegetationObject",
            "geometry": [{**instance, "transformationMatrix": turned, **changes}],
        },
    }
    return data


def test_templates_of_cityjson_stand_in_their_places(tmp_path: Path) -> None:
    found = read_objects(written(tmp_path, trees()), "SolitaryVegetationObject")
    assert found.names == ("oak", "elm")
    # Vertex 6 is (10, 10, 10) of a file in half metres from (1000, 2000, 3); templates are in metres.
    oak, elm = (found.corners[found.owner == k].reshape(-1, 3) for k in (0, 1))
    assert oak.min(axis=0).tolist() == [1005, 2005, 8] and oak.max(axis=0).tolist() == [1007, 2005, 10]
    assert elm.min(axis=0).tolist() == [1010, 2005, 9] and elm.max(axis=0).tolist() == [1010, 2009, 13]
    both = city()
    both["geometry-templates"] = trees()["geometry-templates"]
    both["CityObjects"]["house"]["geometry"].append({**trees()["CityObjects"]["oak"]["geometry"][0]})
    finest = read_objects(written(tmp_path, both))
    assert area(finest.corners[finest.owner == 0]) == pytest.approx(5 * 25)  # the solid comes first of two of LoD 2
    both["geometry-templates"]["templates"][0]["lod"] = "2.2"
    finest = read_objects(written(tmp_path, both))
    assert area(finest.corners[finest.owner == 0]) == pytest.approx(4)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"template": 1}, "'elm'.*template 1 of 1"),
        ({"template": -1}, "'elm'.*template -1 of 1"),
        ({"boundaries": [99]}, "'elm'.*vertex 99 of 8"),
        ({"boundaries": []}, "'elm'.*damaged"),
        ({"transformationMatrix": [1, 2]}, "'elm'.*damaged"),
        ({"transformationMatrix": [1.0] * 16}, "'elm'.*transformationMatrix"),
        ({"transformationMatrix": None}, "'elm'.*damaged"),
    ],
)
def test_fault_19_templates_that_cannot_be_are_named(tmp_path: Path, changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_objects(written(tmp_path, trees(**changes)), "SolitaryVegetationObject")


@pytest.mark.parametrize("mark", ["", "\x1e"])
def test_a_sequence_of_cityjson_is_the_file_in_parts(tmp_path: Path, mark: str) -> None:
    """Each feature has vertices of its own; scale, origin, CRS and templates are those of the first line."""
    data = city()
    whole = read_objects(written(tmp_path, data))
    head = {**data, "CityObjects": {}, "vertices": []}
    lines = [head]
    deck = {"type": "MultiSurface", "lod": 1, "boundaries": [[[5, 6, 7, 8]]]}
    for name, item, vertices in (
        ("house", data["CityObjects"]["house"], CUBE),
        ("deck", {"type": "BridgePart", "geometry": [deck]}, [[0, 0, 0], *CUBE]),
    ):
        lines.append({"type": "CityJSONFeature", "id": name, "CityObjects": {name: item}, "vertices": vertices})
    path = written(tmp_path, "".join(f"{mark}{json.dumps(line)}\n" for line in lines), "town.city.jsonl")
    found = read_objects(path)
    assert found.names == whole.names and (found.crs, found.height_system) == (whole.crs, whole.height_system)
    np.testing.assert_array_equal(found.corners, whole.corners)
    path.write_text(path.read_text() + '{"type": "Feature"}\n')
    with pytest.raises(InputError, match="no CityJSONFeature"):
        read_objects(path)
    path.write_text(path.read_text() + "{\n")
    with pytest.raises(InputError, match=r"town.city.jsonl:5: not valid JSON"):
        read_objects(path)


def broken(**changes: Any) -> dict[str, Any]:
    data = city()
    geometry = data["CityObjects"]["house"]["geometry"][1]
    geometry.update(copy.deepcopy(changes))
    return data


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (city(version="3.0"), "not CityJSON 1.0 to 2.0"),
        (city(vertices=[[0, 0]]), "vertices: a list"),
        (city(vertices=[[0, 0, 1e999]] * 8).__repr__().replace("'", '"').replace("inf", "1e999"), "no number"),
        (city(transform={"scale": [1, 1]}), "3 numbers are needed"),
        (city(CityObjects=[]), "CityObjects"),
        (broken(boundaries=[[[[0, 1, 99]]]], semantics=None), "'house'.*vertex 99 of 8"),
        (broken(boundaries=[[[[0, 1, -1]]]], semantics=None), "'house'.*vertex -1 of 8"),
        (broken(boundaries=[[[[0, 1.5, 2]]]], semantics=None), "'house'.*no list of vertices"),
        (broken(boundaries=[[0, 1]], semantics=None), "'house'.*damaged"),
        (city(CityObjects={"road": city()["CityObjects"]["road"]}), "its types are Road"),
    ],
)  # fmt: skip
def test_fault_19_damaged_cityjson_is_refused_and_the_object_named(tmp_path: Path, data: Any, told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_objects(written(tmp_path, data))


def test_polygons_of_a_geopackage_have_names_roles_and_holes(tmp_path: Path) -> None:
    ring = np.array([(0.0, 0, 5), (10, 0, 5), (10, 10, 7), (0, 10, 7)])
    hole = np.array([(4.0, 4, 5.8), (6, 4, 5.8), (6, 6, 6.2), (4, 6, 6.2)])
    wall = np.array([(0.0, 0, 0), (10, 0, 0), (10, 0, 5), (0, 0, 5)])
    path = tmp_path / "roofs.gpkg"
    columns = {"name": np.array(["roof", None], object), "role": np.array(["occluder", ""], object)}
    layer = VectorLayer("roofs", "Polygon Z", [shapely.Polygon(ring, [hole]), shapely.Polygon(wall)], columns)
    write_geopackage(path, [layer], "EPSG:32632")
    found = read_objects(path)
    assert found.names == ("roof", "roofs 2") and found.roles == ("occluder", None) and found.crs == "EPSG:32632"
    assert area(found.corners[found.owner == 0]) == pytest.approx(96 * np.hypot(1, 0.2))
    assert area(found.corners[found.owner == 1]) == pytest.approx(50)
    write_geopackage(path, [layer, VectorLayer("other", "Polygon Z", layer.shapes, columns)], "EPSG:32632")
    with pytest.raises(InputError, match="layers are roofs, other; state one"):
        read_objects(path)
    assert read_objects(path, "other").names == ("roof", "other 2")
    with pytest.raises(InputError, match="there is no 'walls'"):
        read_objects(path, "walls")


def feature(geometry: str, coordinates: Any, **properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": geometry, "coordinates": coordinates}}


def geojson(*features: dict[str, Any]) -> dict[str, Any]:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    return {"type": "FeatureCollection", "crs": crs, "features": list(features)}


FLAT = [[0, 0], [9, 0], [9, 9], [0, 0]]
HIGH = [[0, 0, 4], [9, 0, 4], [9, 9, 4], [0, 0, 4]]
BOW = [[0, 0, 4], [9, 9, 4], [9, 0, 4], [0, 9, 4], [0, 0, 4]]


def test_fault_19_polygons_without_heights_or_that_cross_themselves_are_named(tmp_path: Path) -> None:
    good = feature("MultiPolygon", [[HIGH]], name="good")
    assert area(read_objects(written(tmp_path, geojson(good), "a.geojson")).corners) == pytest.approx(40.5)
    flat = feature("Polygon", [FLAT], name="flat")
    bow = feature("Polygon", [BOW], name="bow")
    found = read_objects(written(tmp_path, geojson(good, flat, bow), "b.geojson"))
    assert dict(found.faults) == {"flat": "has vertices without a height", "bow": "crosses itself"}
    crossed = read_objects(written(tmp_path, broken(boundaries=[[[[4, 6, 5, 7]]]], semantics=None)))
    assert dict(crossed.faults) == {"house": "crosses itself"}
    with pytest.raises(InputError, match="'way' is a LineString"):
        read_objects(written(tmp_path, geojson(feature("LineString", HIGH, name="way")), "d.geojson"))
    with pytest.raises(InputError, match="'odd': role 'glass'"):
        read_objects(written(tmp_path, geojson(feature("Polygon", [HIGH], name="odd", role="glass")), "e.geojson"))


DXF = """0\nSECTION\n2\nENTITIES\n0\n3DFACE\n8\nroofs\n10\n0\n20\n0\n30\n5\n11\n8\n21\n0\n31\n5\n12\n8\n22\n6\n32\n7
13\n0\n23\n6\n33\n7\n0\nPOLYLINE\n8\nwalls\n66\n1\n70\n9\n0\nVERTEX\n8\nwalls\n10\n0\n20\n0\n30\n0\n70\n32\n0\nVERTEX
8\nwalls\n10\n8\n20\n0\n30\n0\n70\n32\n0\nVERTEX\n8\nwalls\n10\n8\n20\n0\n30\n5\n70\n32\n0\nSEQEND\n8\nwalls\n0\nENDSEC
0\nEOF\n"""


def test_faces_and_closed_lines_of_a_drawing_are_polygons(tmp_path: Path) -> None:
    path = written(tmp_path, DXF, "town.dxf")
    both = read_objects(path)
    assert area(both.corners) == pytest.approx(8 * np.hypot(6, 2) + 20)
    assert area(read_objects(path, "walls").corners) == pytest.approx(20)
    with pytest.raises(InputError, match="no faces on layer 'trees'; it has roofs, walls"):
        read_objects(path, "trees")


OBJ = "# tree\nv 0 0 0\nv 4 0 0\nv 4 4 0\nv 0 4 1\nvn 0 0 1\nf 1/1 2//1 3\nf -4 -2 -1\n"


def test_meshes_hide(tmp_path: Path) -> None:
    found = read_objects(written(tmp_path, OBJ, "tree.obj"))
    assert found.mesh and found.names == ("tree",) and found.crs is None and len(found.corners) == 2
    assert found.corners[1].tolist() == [[0, 0, 0], [4, 4, 0], [0, 4, 1]]
    quad = written(tmp_path, "v 0 0 0\nv 4 0 0\nv 4 4 0\nv 0 4 0\nf 1 2 3 4\n", "quad.obj")
    assert area(read_objects(quad).corners) == 16


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (OBJ + "f 1 2 9\n", "names vertex 8 of 4"),
        (OBJ + "f 1 2 -9\n", ":9: .*three corners"),
        (OBJ + "v 1 2\n", ":9: 'v 1 2' is no v"),
        ("v 1 2 nan\n" + OBJ + "f 1 2 3\n", "no number"),
        ("v 1 2 3\n", "holds no faces"),
    ],
)
def test_damaged_obj_files_are_refused(tmp_path: Path, text: str, told: str) -> None:
    with pytest.raises(InputError, match=told):
        read_objects(written(tmp_path, text, "mesh.obj"))


def ply(form: str, triangles_only: bool, count: int = 4) -> bytes:
    head = f"ply\nformat {form} 1.0\nelement vertex {count}\nproperty double x\nproperty double y\nproperty float z\n"
    faces = [(0, 1, 2), (0, 2, 3)] if triangles_only else [(0, 1, 2, 3)]
    head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nproperty uchar red\nend_header\n"
    points = [(0.0, 0, 5), (4, 0, 5), (4, 4, 5), (0, 4, 5)]
    if form == "ascii":
        rows = [" ".join(map(str, p)) for p in points] + [f"{len(f)} {' '.join(map(str, f))} 7" for f in faces]
        return (head + "\n".join(rows) + "\n").encode()
    order = "<" if "little" in form else ">"
    body = b"".join(np.array(p[:2], order + "f8").tobytes() + np.array(p[2:], order + "f4").tobytes() for p in points)
    for f in faces:
        body += bytes([len(f)]) + np.array(f, order + "i4").tobytes() + bytes([7])
    return head.encode() + body


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("triangles", [True, False])
def test_ply_of_every_form(tmp_path: Path, form: str, triangles: bool) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(ply(form, triangles))
    found = read_objects(path)
    assert found.mesh and area(found.corners) == pytest.approx(16) and (found.corners[..., 2] == 5).all()


def test_fault_31_a_ply_that_promises_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mesh.ply"
    for form in ("ascii", "binary_little_endian"):
        for count, told in ((4_000_000_000, "promises"), (40, "damaged|names vertex")):
            path.write_bytes(ply(form, True, count))
            with pytest.raises(InputError, match=told):
                read_objects(path)
    path.write_bytes(ply("binary_little_endian", True)[:-9])
    with pytest.raises(InputError, match="damaged"):
        read_objects(path)
    path.write_bytes(b"ply\nformat ascii 1.0\nelement vertex x\nend_header\n")
    with pytest.raises(InputError, match="not understood"):
        read_objects(path)


@pytest.mark.parametrize("name", ["mesh.obj", "mesh.ply", "roofs.geojson", "town.json"])
def test_fault_18_marks_and_line_ends_of_object_files_change_nothing(tmp_path: Path, name: str) -> None:
    text = {
        "mesh.obj": OBJ,
        "mesh.ply": ply("ascii", False).decode(),
        "roofs.geojson": json.dumps(geojson(feature("Polygon", [HIGH], name="good")), indent=1),
        "town.json": json.dumps(city(), indent=1),
    }[name]
    plain = read_objects(written(tmp_path, text, name)).corners
    for k, mark in enumerate(("", "\ufeff") if name != "mesh.ply" else ("",)):
        path = tmp_path / f"{k}_{name}"
        path.write_bytes((mark + text).replace("\n", "\r\n").encode())
        np.testing.assert_array_equal(read_objects(path).corners, plain)


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("comma.obj", OBJ.replace("v 4 0 0", "v 4,5 0 0"), r":3: 'v 4,5 0 0' is no v \(numbers, with a point"),
        ("ragged.obj", OBJ.replace("v 4 0 0", "v 4 0"), ":3: 'v 4 0' is no v"),
        ("two.obj", OBJ.replace("v 4 0 0", "v 4 0\nv 4 0 0 0"), ":3: 'v 4 0' is no v"),
        ("half.obj", OBJ + "f 1 2 2.5\n", ":9: 'f 1 2 2.5' is no f"),
        ("word.obj", OBJ + "f 1 2 x\n", ":9: 'f 1 2 x' is no f"),
        ("header.obj", "# tree\nvn 0 0 1\n", "holds no faces"),
        ("header.ply", ply("ascii", True).decode().split("end_header")[0] + "end_header\n", "damaged|promises"),
        ("comma.ply", ply("ascii", True).decode().replace("4 0 5", "4,5 0 5"), "damaged.*with a point"),
        ("ragged.ply", ply("ascii", True).decode().replace("4 0 5", "4 0"), "damaged.*a vertex of 2 instead of 3"),
        ("corners.ply", ply("ascii", True).decode().replace("3 0 1 2 7", "9 0 1 2 7"), "damaged.*fewer corners"),
    ],
)
def test_fault_18_meshes_with_a_fault_are_named(tmp_path: Path, name: str, text: str, told: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(InputError, match=told):
        read_objects(path)


def grid_of_faces(side: int, triangles: bool) -> tuple[np.ndarray, list[np.ndarray]]:
    """Vertices of a grid, and its meshes: triangles, or two triangles and a quadrangle in turn."""
    y, x = np.mgrid[:side, :side].reshape(2, -1)
    vertices = np.stack([x * 0.25, y * 0.25, np.sin(x / 9) + np.cos(y / 7)], axis=1)
    k = np.arange(side * side).reshape(side, side)
    a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    if triangles:
        return vertices, [*np.stack([a, b, c], axis=1), *np.stack([a, c, d], axis=1)]
    quads = np.stack([a, b, c, d], axis=1)
    odd = np.arange(len(a)) % 2 == 1
    return vertices, [*quads[odd], *np.stack([a, b, c], axis=1)[~odd], *np.stack([a, c, d], axis=1)[~odd]]


@pytest.mark.parametrize("kind", ["obj", "ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("triangles", [True, False])
def test_large_meshes_are_read_in_batches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, triangles: bool
) -> None:
    monkeypatch.setattr(mesh, "_BATCH", 100)
    vertices, faces = grid_of_faces(25, triangles)
    rows = [" ".join(f"{v:.6f}" for v in p) for p in vertices]
    path = tmp_path / ("mesh.obj" if kind == "obj" else "mesh.ply")
    if kind == "obj":
        lines = [f"v {row}" for row in rows] + ["f " + " ".join(f"{v + 1}//7" for v in f) for f in faces]
        lines[300:300] = ["# half"]
        path.write_text("\n".join(lines))
    else:
        head = f"ply\nformat {kind} 1.0\ncomment x\nelement vertex {len(vertices)}\nproperty float x\n"
        head += f"property float y\nproperty float z\nelement face {len(faces)}\nproperty uchar red\n"
        head += "property list uchar uint vertex_indices\nproperty float q\nend_header\n"
        order = "<" if "little" in kind else ">"
        body = b"".join(
            bytes([9, len(f)]) + f.astype(order + "u4").tobytes() + np.array(0.5, order + "f4").tobytes() for f in faces
        )
        text = "\n".join(rows + [f"9 {len(f)} " + " ".join(map(str, f)) + " 0.5" for f in faces]) + "\n"
        path.write_bytes(
            head.encode() + (text.encode() if kind == "ascii" else vertices.astype(order + "f4").tobytes() + body)
        )
    found = read_objects(path)
    want = [[vertices[f[[0, k, k + 1]]] for k in range(1, len(f) - 1)] for f in faces]
    np.testing.assert_allclose(found.corners, np.concatenate(want), atol=2e-6)
    monkeypatch.setattr(mesh, "_MOST", 500)
    with pytest.raises(InputError, match="more than 500 faces or vertices; cut out"):
        read_objects(path)


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="allowed are CityJSON"):
        read_objects(written(tmp_path, "x,y,z\n1,2,3\n", "points.csv"))
    with pytest.raises(InputError, match="there is no such file"):
        read_objects(tmp_path / "none.gpkg")


@pytest.mark.skipif(os.name != "posix", reason="no limit of the size of files")
@pytest.mark.parametrize("limit", [100, 3_000, 30_000, 90_000])
def test_fault_04_a_full_disk_is_told_from_a_place_without_rights(tmp_path: Path, limit: int) -> None:
    """Libraries of vector files raise the same for both, or whatever SQLite says where a table is not there."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    layer = VectorLayer("points", "Point", shapely.points(np.zeros((5000, 2))), {"n": np.arange(5000)})
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        with pytest.raises(ResourceError, match="free some space"):
            write_geopackage(tmp_path / "a.gpkg", [layer], "EPSG:32632")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())
    with pytest.raises(UsageError, match="choose a folder"):
        write_geopackage(tmp_path / "a.gpkg", [VectorLayer("x", "Nonsense", layer.shapes, layer.columns)], "EPSG:32632")
    assert not list(tmp_path.iterdir())
