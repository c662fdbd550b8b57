"""Mutations of valid files of every format that photoplan reads: none may end in a traceback, hang or fill the memory.

At least 5,000 cases in all. `PHOTOPLAN_MUTATIONS=N` sets the cases of each reader, `PHOTOPLAN_MUTATIONS_FIRST=K` the number
of the first.
"""

# ruff: noqa: E501

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from pyproj import Transformer
from tools.dem_file import write_dem, write_geojson
from tools.format_examples import block_of, frame
from tools.image_headers import folder as headers
from tools.landxml import write_landxml
from tools.line_strip import Strip
from tools.mutations import Reader, run
from tools.rpc_files import as_digitalglobe, as_dimap, as_rpb, as_text, tagged
from tools.rpc_images import functions
from tools.small_block import write_block
from tools.small_model import write_small

from photoplan.codec import NotData, decode, encode
from photoplan.errors import InputError
from photoplan.geometry.grid import MapGrid, Window
from photoplan.io.camera.line import read_line
from photoplan.io.camera.satellite import read_frame, read_rpc
from photoplan.io.formats import read_cameras, read_orientation_block, write_orientation
from photoplan.io.image_metadata import read_image_metadata
from photoplan.io.objects import read_objects
from photoplan.io.orientation.block import TableFormat
from photoplan.io.points import read_gcp_list, read_ground_points, read_image_points, read_observed_positions
from photoplan.io.project.file import load_project
from photoplan.io.quality_files import (
    read_balance_file,
    read_chromatic,
    read_fall_off_entry,
    read_filter_file,
    read_mtf_table,
    read_sensor,
)
from photoplan.io.series import read_series
from photoplan.io.store import ResultLog, TileLog
from photoplan.io.terrain.files import read_measured
from photoplan.io.terrain.model import ModelReader
from photoplan.io.terrain.options import ReadOptions, read_code_table
from photoplan.io.vector_layer import (
    PlanTables,
    read_drawn_features,
    read_features,
    read_plan_tables,
    read_regions,
    write_features,
    write_plan_tables,
)
from photoplan.products.describe import describe
from photoplan.project.ground import open_terrain

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform != "linux", reason="limits of processes, as Linux has them"),
]

FIRST = int(os.environ.get("PHOTOPLAN_MUTATIONS_FIRST", "0"))
CASES = int(os.environ.get("PHOTOPLAN_MUTATIONS", "100"))
DATA = Path(__file__).parents[1] / "data"
SQUARE = "POLYGON ((0 0, 90 0, 90 90, 0 90, 0 0))"
CRS = "EPSG:31287"


def text(name: str, content: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / name).write_text(content, encoding="utf-8")
        return folder / name

    return make


def copied(*files: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        for file in files:
            shutil.copy(DATA / file, folder)
        return folder / Path(files[0]).name

    return make


def oriented(format: str, name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        block = block_of({"cam": frame("brown")}, crs="EPSG:32632", height_system="ellipsoidal")
        images = tuple(replace(image, name=image.name.replace(" ", "_")) for image in block.table.images)
        block = replace(block, table=replace(block.table, images=images))
        write_orientation(block, folder / name, format)
        return folder / name

    return make


def plan(folder: Path) -> Path:
    n = 4
    tiles: dict[str, Any] = {"product": np.array(["a"] * n, object), "tile": np.arange(n),
                             "sources": np.array(["0 1"] * n, object), "cells": np.arange(n),
                             "residual_px": np.zeros(n)}  # fmt: skip
    outline = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)])
    header = {"photoplan": "0", "settings": {"resolution": 1.0}, "products": [{"name": "a", "key": "b" * 20}]}
    bounds = np.array([(k, 0.0, k + 1.0, 1.0) for k in range(n)], float)
    seen = {"product": np.array(["a"], object)}
    write_plan_tables(folder / "plan.gpkg", PlanTables(header, tiles, bounds, seen, [outline], CRS))
    return folder / "plan.gpkg"


def geopackage(kind: str, wkt: str, **columns: Any) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        values = {name: np.array([v] * 3, object if isinstance(v, str) else None) for name, v in columns.items()}
        if "name" in values:
            values["name"] = np.array(["a", "b", "c"], object)
        shapes = [
            shapely.transform(shapely.from_wkt(wkt), lambda a, k=k: a + 100.0 * k, include_z=" Z" in wkt)
            for k in range(3)
        ]
        write_features(folder / "v.gpkg", kind, shapes, values, CRS, "layer")
        return folder / "v.gpkg"

    return make


def geojson(folder: Path) -> Path:
    return write_geojson(folder / "v.geojson", {"a": shapely.from_wkt(SQUARE), "b": shapely.box(100, 0, 190, 90)})


def dxf(folder: Path) -> Path:
    import ezdxf

    document = ezdxf.new("R2010", setup=False)
    document.units = 6
    space = document.modelspace()
    block = document.blocks.new("B")
    block.add_polyline3d([(0, 0, 1), (5, 5, 2), (9, 0, 3)])
    for k in range(3):
        space.add_point((k, 2 * k, 3))
        space.add_lwpolyline([(0, k), (5, k + 1), (9, k)], dxfattribs={"elevation": 4.0 + k})
        space.add_blockref("B", (20 * k, 0, 5))
        space.add_3dface([(0, 0, k), (9, 0, k), (9, 9, k)])
    space.add_polyline2d([(0, 50), (9, 50), (9, 59)], dxfattribs={"elevation": (0, 0, 7)})
    space.add_spline([(0, 60, 1), (5, 65, 2), (9, 60, 3)])
    space.add_arc((0, 0, 3), 5, 0, 90)
    space.add_text("12.5", dxfattribs={"insert": (1, 1)})
    document.saveas(folder / "d.dxf")
    return folder / "d.dxf"


def cityjson(folder: Path) -> Path:
    corners = [[x, y, z] for z in (0, 9000) for x, y in ((0, 0), (9000, 0), (9000, 9000), (0, 9000))]
    faces = [[[0, 3, 2, 1]], [[4, 5, 6, 7]], [[0, 1, 5, 4]], [[1, 2, 6, 5]], [[2, 3, 7, 6]], [[3, 0, 4, 7]]]
    solid = {"type": "Solid", "lod": "2", "boundaries": [faces],
             "semantics": {"surfaces": [{"type": "GroundSurface"}, {"type": "RoofSurface"}], "values": [[0, 1, 1, 1, 1, 1]]}}  # fmt: skip
    content = {"type": "CityJSON", "version": "1.1", "transform": {"scale": [0.001] * 3, "translate": [0.0, 0.0, 0.0]},
               "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/31287"},
               "CityObjects": {"a": {"type": "Building", "geometry": [solid]}}, "vertices": corners}  # fmt: skip
    (folder / "c.city.json").write_text(json.dumps(content))
    return folder / "c.city.json"


def las(folder: Path) -> Path:
    import laspy

    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales, header.offsets = np.array([0.01] * 3), np.zeros(3)
    file = laspy.LasData(header)
    file.x, file.y, file.z = np.random.default_rng(1).uniform(0, 100, (3, 60))
    file.classification = np.full(60, 2, np.uint8)
    file.write(folder / "p.las")
    return folder / "p.las"


def landxml(folder: Path) -> Path:
    points = np.random.default_rng(2).uniform(0, 50, (30, 3))
    return write_landxml(folder / "s.xml", points)


def shapefile(folder: Path) -> Path:
    import pyogrio.raw

    shapes = shapely.to_wkb([shapely.Point(k, k, 5.0) for k in range(9)])
    pyogrio.raw.write(folder / "p.shp", shapes, [np.arange(9)], ["code"], driver="ESRI Shapefile",
                      geometry_type="Point Z", crs=CRS)  # fmt: skip
    return folder / "p.shp"


def terrain(folder: Path) -> Path:
    return write_dem(folder / "dem.tif", lambda x, y: 100 + x / 10, (40, 30))


def read_terrain(path: Path) -> Any:
    opened = open_terrain(path)
    return opened.surface.heights(np.array([(opened.bounds[0] + 1, opened.bounds[1] + 1)])) if opened.bounds else None


def small_model(folder: Path) -> Path:
    write_small(folder / "m.gpkg")
    return folder / "m.gpkg"


def read_model(path: Path) -> Any:
    reader = ModelReader(path)
    return reader.unit(0, 0), reader.lines(), reader.gross(), reader.suspects()


def project(folder: Path) -> Path:
    return write_block(folder / "block").folder / "project.toml"


def image(folder: Path) -> Path:
    return tagged(folder / "i.tif", functions(), np.arange(1200, dtype=np.uint16).reshape(1, 30, 40))


def frames(folder: Path) -> Path:
    from tools.small_block import write_image

    for k in range(4):
        write_image(folder / f"flat_{k + 1}ms_1.tif", np.full((1, 12, 16), 50 * (k + 1), np.uint16))
        write_image(folder / f"flat_{k + 1}ms_2.tif", np.full((1, 12, 16), 50 * (k + 1), np.uint16))
    (folder / "series.toml").write_text(
        '[camera]\nname = "c"\nbits = 12\n\n[[frames]]\nkind = "flat"\nfiles = "flat_{exposure}ms_*.tif"\n'
    )
    return folder / "series.toml"


def filter_toml(folder: Path) -> Path:
    (folder / "f.toml").write_text(
        'kind = "restoration filter"\nformat = 1\ndescription = "d"\n\n[[kernels]]\n'
        "values = [[0.0, 0.1, 0.0], [0.1, 0.6, 0.1], [0.0, 0.1, 0.0]]\n"
    )
    return folder / "f.toml"


def run_record(folder: Path) -> Path:
    (folder / "m.run.json").write_text(
        json.dumps({"key": "0", "versions": {"photoplan": "0"}, "inputs": [{"file": "a"}]})
    )
    return folder / "m.run.json"


def tile_log(folder: Path) -> Path:
    with TileLog(folder / "a.tiles", "key") as log:
        for k in range(5):
            log.append(k, bytes(range(40 * k)), (k, 1), {"seconds": 0.5, "names": ["a"]})
    return folder / "a.tiles"


def read_tile_log(path: Path) -> Any:
    with TileLog(path, "key") as log:
        return [log.read(k) for k in sorted(log.finished)]


def strip(folder: Path) -> Path:
    return Strip(lines=12, columns=40).strip_file(folder)


def read_strip(path: Path) -> Any:
    return read_line(path, "nadir").camera("EPSG:32633", "ellipsoidal")


def dimap(folder: Path) -> Path:
    """A camera of lines in a circular orbit, as Pléiades states it."""

    def model(name: str, *values: float) -> str:
        return f"<{name}><COEFFICIENTS>{' '.join(map(str, values))}</COEFFICIENTS></{name}>"

    points = "".join(
        f"<Point><UTC_TIME>2020-05-05T10:00:{20 + 10 * k:02}.000Z</UTC_TIME><LOCATION_VALUES>{6.9e6 * np.cos(a)} "
        f"{6.9e6 * np.sin(a)} 1000</LOCATION_VALUES></Point>"
        for k, a in enumerate(np.linspace(-0.01, 0.01, 4))
    )
    half = 0.5**0.5  # turned about y: the camera looks along -x, down
    attitudes = model("Q0", half) + model("Q1", 0, 1e-5) + model("Q2", -half) + model("Q3", 0)
    (folder / "DIM.XML").write_text(
        "<D><Raster_Dimensions><NROWS>60</NROWS><NCOLS>40</NCOLS></Raster_Dimensions><Sensor_Model_Characteristics>"
        "<UTC_Sensor_Model_Range><START>2020-05-05T10:00:35.000Z</START><END>2020-05-05T10:00:35.006Z</END>"
        "</UTC_Sensor_Model_Range><SENSOR_LINE_PERIOD>0.1</SENSOR_LINE_PERIOD>"
        f"<Sensor_Ephemeris><Point_List>{points}</Point_List></Sensor_Ephemeris><Sensor_Attitudes><OFFSET>36035</OFFSET>"
        f"<SCALE>15</SCALE><Polynomial_Models>{attitudes}</Polynomial_Models></Sensor_Attitudes><Sensor_Viewing_Model>"
        f"<Viewing_Directions>{model('PsiX_Model', 1e-3, 0)}{model('PsiY_Model', -2e-5, 1e-6)}</Viewing_Directions>"
        "</Sensor_Viewing_Model></Sensor_Model_Characteristics></D>"
    )
    return folder / "DIM.XML"


def shots_geojson(folder: Path) -> Path:
    features = []
    for k in range(3):
        place = [-87.16 + 1e-4 * k, 14.09, 1155.0 + k]
        at = Transformer.from_crs("EPSG:4326", "EPSG:32616", always_xy=True).transform(*place[:2])
        properties = {"filename": f"DJI_{k}.JPG", "camera": "c", "focal": 0.57, "width": 2048, "height": 1536,
                      "translation": [*at, place[2]], "rotation": [3.1, 0.01, 0.02], "capture_time": 1.5e9}  # fmt: skip
        features.append(
            {"type": "Feature", "properties": properties, "geometry": {"type": "Point", "coordinates": place}}
        )
    (folder / "odm_report").mkdir()
    (folder / "odm_report/shots.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    camera = {"projection_type": "brown", "width": 2048, "height": 1536, "focal_x": 0.57, "focal_y": 0.57, "c_x": 0.0,
              "c_y": 0.0, "k1": -0.02, "k2": 0.01, "p1": 0.0, "p2": 0.0, "k3": 0.0}  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps({"c": camera}))
    return folder / "odm_report/shots.geojson"


def steps(folder: Path) -> Path:
    with ResultLog(folder / "a.steps", "key", None) as log:
        for k in range(4):
            log.append(k, {"name": "a", "window": Window(1, 2, 3, 4), "values": (np.arange(6.0), None, [1, "x", b"y"])})
    return folder / "a.steps"


def read_steps(path: Path) -> Any:
    with ResultLog(path, "key", None) as log:
        return [log[k] for k in sorted(log.finished)]


def record(folder: Path) -> Path:
    (folder / "r").write_bytes(
        encode({"window": Window(1, 2, 3, 4), "rows": (np.eye(3), np.array(["a", None], object), {1.5, 2})})
    )
    return folder / "r"


def read_record(path: Path) -> Any:
    try:
        return decode(path.read_bytes())
    except NotData as error:
        raise InputError(str(error)) from error


def exif(folder: Path) -> Path:
    """One image's headers alone, so that bits fall on them and not on pixels."""
    return headers(folder, 1) / "DJI_0.JPG"


GRID = MapGrid(left=0.0, top=100.0, resolution=1.0, width=100, height=100, crs=CRS)
POINTS = "x,y,z,code\n" + "".join(f"{k}.5,{k * 2},{100 + k / 7:.3f},1\n" for k in range(40))
CONTROL = "name,x,y,z,sigma_xy,sigma_z,role\n" + "".join(
    f"p{k},{500 + k},{600 + k},{9 + k},0.01,0.02,control\n" for k in range(9)
)
GCPS = "EPSG:32632\n" + "".join(f"{500000 + k} 5400000 90.5 {k} 20.5 img{k}.jpg p{k}\n" for k in range(9))
POSITIONS = "name,x,y,z,omega,phi,kappa,sigma_xy,sigma_z,time\n" + "".join(
    f"i{k}.jpg,{500000 + k},5400000,900.5,1.5,2.5,30,0.02,0.03,{k}\n" for k in range(9)
)
BLUH = "4711 512345.678 5274112.875 2630.44 -1.3894 0.8331 98.3333\n4712 513000.125 5274100.5 2641.0 7.9 -13.8 -101.1\n"
BALANCE = (
    'format = "photoplan balance 1"\nsize = [40, 30]\ndescription = "d"\n\n[[bands]]\ngrey = [0.0, 100.0, 255.0]\n'
    "becomes = [1.0, 110.0, 250.0]\ntrend = [[1, 0, 0.01]]\n"
)
CHROMATIC = (
    'format = "photoplan chromatic 1"\nimage_size = [40, 30]\nreference = 2\n\n[[bands]]\nband = 1\n'
    "terms = [[1, 0, 0.1, 0.0], [0, 1, 0.0, 0.1]]\n"
)
FALL_OFF = (
    'format = "photoplan light fall-off 1"\nsize = [40, 30]\nprincipal_point_px = [20.0, 15.0]\n'
    "camera_constant_px = 50.0\n\n[[terms]]\nn = 2\nm = 0\ncoefficient = 0.1\n"
)
SENSOR = 'name = "s"\n\n[optics]\nf_number = 4.0\n\n[noise]\nfull_well_e = 20000.0\ndark_e = 5.0\nread_noise_e = 7.0\n'
CAMERA = '[cameras.cam]\ntype = "frame"\nsize = [400, 300]\nfocal_px = 500.0\n'
OPENCV = (
    "%YAML:1.0\n---\nimage_width: 400\nimage_height: 300\ncamera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n"
    "   dt: d\n   data: [500., 0., 200., 0., 500., 150., 0., 0., 1.]\ndistortion_coefficients: !!opencv-matrix\n"
    "   rows: 1\n   cols: 5\n   dt: d\n   data: [-0.1, 0.01, 0., 0., 0.]\n"
)
MARKS = "a,12.5,13.5\nb,2.5,3.5\n"

READERS = [
    Reader("project", project, load_project, mutated="block/project.toml"),
    Reader("project info", project, describe, mutated="block/project.toml"),
    Reader("orientation csv", copied("brighton/ext.csv", "brighton/ext.prj"), read_orientation_block),
    Reader("orientation prj", copied("brighton/ext.csv", "brighton/ext.prj"), read_orientation_block, mutated="ext.prj"),
    Reader("orientation toml", oriented("toml", "o.toml"), read_orientation_block),
    Reader("opensfm", oriented("opensfm", "reconstruction.json"), read_orientation_block, "json"),
    Reader("opendronemap", shots_geojson, read_orientation_block, "json"),
    Reader("opendronemap cameras", shots_geojson, read_orientation_block, "json", mutated="cameras.json"),
    Reader("bluh", text("b.dat", BLUH), lambda p: read_orientation_block(p, TableFormat(angle_unit="gon"), "bluh")),
    Reader("exif orientation", exif, lambda p: read_orientation_block(p, format="exif"), "binary"),
    Reader("patb", oriented("patb", "o.ori"), lambda p: read_orientation_block(p, TableFormat(direction="camera-to-ground"), "patb")),
    Reader("bingo", oriented("bingo", "o.dat"), lambda p: read_orientation_block(p, format="bingo")),
    Reader("inpho", oriented("inpho", "o.prj"), lambda p: read_orientation_block(p, format="inpho")),
    Reader("metashape", oriented("metashape", "o.xml"), read_orientation_block),
    Reader("opk", oriented("opk", "o.txt"), read_orientation_block),
    Reader("colmap", oriented("colmap", "model"), lambda p: read_orientation_block(p, format="colmap")),
    Reader("pix4d", copied("pix4d_easyidp/test_calibrated_camera_parameters.txt",
                           "pix4d_easyidp/test_calibrated_internal_camera_parameters.cam"), read_orientation_block),
    Reader("camera yaml", copied("brighton/int.yaml"), read_cameras),
    Reader("camera toml", text("c.toml", CAMERA), read_cameras),
    Reader("camera opencv", text("c.yml", OPENCV), read_cameras),
    Reader("positions", text("p.csv", POSITIONS), read_observed_positions),
    Reader("control", text("c.csv", CONTROL), read_ground_points),
    Reader("control layer", geopackage("Point Z", "POINT Z (1 2 3)", name="a", sigma=0.1), read_ground_points, "database"),
    Reader("gcp list", text("gcp_list.txt", GCPS), read_gcp_list),
    Reader("image points", text("i.csv", "point,image,x,y,sigma\n" + "".join(f"p{k},i,{k}.5,{k}.25,0.2\n" for k in range(9))),
           read_image_points),
    Reader("rpc text", text("i_RPC.TXT", as_text(functions())), read_rpc),
    Reader("rpb", text("i.RPB", as_rpb(functions())), read_rpc),
    Reader("rpc digitalglobe", text("i.XML", as_digitalglobe(functions())), read_rpc),
    Reader("rpc dimap", text("RPC_i.XML", as_dimap(functions())), read_rpc),
    Reader("rpc tags", image, read_rpc, "binary"),
    Reader("isd frame", copied("csm_frame/vesta_radtan.json"), read_frame, "json"),
    Reader("isd line", copied("csm_line/kaguya_tc.json"), read_line, "json"),
    Reader("dimap line", dimap, read_line),
    Reader("strip", strip, read_strip, mutated="strip.toml"),
    Reader("strip table", strip, read_strip, mutated="flight.csv"),
    Reader("terrain raster", terrain, read_terrain, "binary"),
    Reader("terrain model", small_model, read_model, "database"),
    Reader("terrain model info", small_model, describe, "database"),
    Reader("points", text("p.csv", POINTS), lambda p: read_measured([p])),
    Reader("codes", text("codes.toml", '[codes]\n1 = "breakline"\nD4 = { kind = "spot", sigma = 0.05 }\n'), read_code_table),
    Reader("codes csv", text("codes.csv", "code,kind,sigma\n1,breakline,0.1\n2,spot,0.2\n"), read_code_table),
    Reader("las", las, lambda p: read_measured([p]), "binary"),
    Reader("landxml", landxml, lambda p: read_measured([p])),
    Reader("dxf", dxf, lambda p: read_measured([p])),
    Reader("measured geopackage", geopackage("Point Z", "POINT Z (1 2 3)", code="1"), lambda p: read_measured([p]), "database"),
    Reader("contours", geopackage("LineString", "LINESTRING (1 2, 3 4)", ELEV=5.0),
           lambda p: read_measured([p], ReadOptions(height_field="ELEV")), "database"),
    Reader("shapefile", shapefile, lambda p: read_measured([p]), "binary"),
    Reader("cityjson", cityjson, read_objects, "json"),
    Reader("objects geopackage", geopackage("Polygon Z", "POLYGON Z ((0 0 5, 9 0 5, 9 9 5, 0 9 5, 0 0 5))", name="a", role="paint"),
           read_objects, "database"),
    Reader("obj", text("m.obj", "v 0 0 1\nv 9 0 1\nv 9 9 2\nv 0 9 2\nf 1 2 3\nf 1 3 4\n"), read_objects),
    Reader("ply", text("m.ply", "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
                       "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 1\n9 0 1\n9 9 2\n3 0 1 2\n"), read_objects),
    Reader("polygons geojson", geojson, lambda p: read_features(p, "Polygon", crs=CRS), "json"),
    Reader("regions", geopackage("Polygon", SQUARE, image="i"), lambda p: read_regions(p, ["i", "j"], GRID).rows(Window(0, 0, 50, 50)),
           "database"),
    Reader("drawn features", geojson, lambda p: read_drawn_features(p, None), "json"),
    Reader("drawn dxf", dxf, lambda p: read_drawn_features(p, None)),
    Reader("plan", plan, read_plan_tables, "database"),
    Reader("plan info", plan, describe, "database"),
    Reader("balance", text("b.toml", BALANCE), read_balance_file),
    Reader("chromatic", text("c.toml", CHROMATIC), read_chromatic),
    Reader("fall-off", text("f.toml", FALL_OFF), read_fall_off_entry),
    Reader("filter", filter_toml, read_filter_file),
    Reader("filter table", text("f.txt", "0 0.1 0\n0.1 0.6 0.1\n0 0.1 0\n"), read_filter_file),
    Reader("mtf table", text("m.csv", "cycles_per_px,modulation\n0.1,0.9\n0.4,0.3\n"), read_mtf_table),
    Reader("sensor", text("s.toml", SENSOR), read_sensor),
    Reader("series", frames, read_series, mutated="series.toml"),
    Reader("image metadata", copied("brighton/images/DJI_0018.jpg"), read_image_metadata, "binary"),
    Reader("exif", exif, read_image_metadata, "binary"),
    Reader("image info", image, describe, "binary"),
    Reader("tile log", tile_log, read_tile_log, "binary"),
    Reader("kept results", steps, read_steps, "binary"),
    Reader("codec", record, read_record, "json"),
    Reader("codec bytes", record, read_record, "binary"),
    Reader("run record", run_record, describe, "json"),
]  # fmt: skip


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_no_mutation_ends_in_a_fault(reader: Reader, tmp_path: Path) -> None:
    counts = run(reader, tmp_path, CASES, FIRST)
    print(f"MUTATIONS {reader.name}: {counts.cases} cases, {counts.refused} refused, {counts.accepted} accepted, "
          f"{dict(counts.kinds)}")  # fmt: skip
    assert counts.cases == CASES
    assert not counts.faults, "\n".join(counts.faults)


def test_the_cases_are_five_thousand_and_a_fault_is_seen(tmp_path: Path) -> None:
    assert "PHOTOPLAN_MUTATIONS" in os.environ or len(READERS) * CASES >= 5000

    def broken(path: Path) -> None:
        if b"\0" in path.read_bytes() or not path.read_bytes():
            raise KeyError("x")
        json.loads(path.read_text(errors="replace")[:1] or "1") if path.stat().st_size > 20 else None

    found = run(Reader("broken", text("a.txt", "1" * 15), broken), tmp_path, 60)
    assert found.kinds["traceback"] > 0 and found.cases == 60
