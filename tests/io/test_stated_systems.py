"""Reference systems as files state them: local ones, datums without a code, and what lies beside a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyogrio.raw
import pytest
import shapely
from affine import Affine
from pyproj import CRS
from tools.command import inside
from tools.small_block import write_image

from photoplan.errors import InputError
from photoplan.geometry.crs import canonical_crs, crs_step, split_compound
from photoplan.geometry.units import metric_system
from photoplan.io.formats import read_orientation
from photoplan.io.points import read_gcp_list
from photoplan.io.project.file import load_project
from photoplan.io.terrain.files import read_measured
from photoplan.io.terrain.options import ReadOptions
from photoplan.project.ground import ground_of, open_terrain

LOCAL = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
LOCAL_FEET = LOCAL.replace('"metre",1', '"foot",0.3048')
ENGINEERING = 'ENGCRS["facade",EDATUM["wall"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]'


@pytest.mark.parametrize(
    ("code", "target", "place"),
    [("EPSG:2314", "EPSG:32620", (5e5, 4e5)), ("EPSG:2136", "EPSG:32630", (9e5, 6e5)),
     ("EPSG:28404", "EPSG:32634", (4.5e6, 6e6))],
)  # fmt: skip
def test_a_datum_is_kept_where_a_crs_has_no_code(code: str, target: str, place: tuple[float, float]) -> None:
    """PROJ strings hold no name of a datum; written as one, a system in Clarke's feet had lost its transformation."""
    system = metric_system(code)
    XY = np.array(place)
    np.testing.assert_allclose(crs_step(system.crs, target)(XY * system.scale), crs_step(code, target)(XY), atol=1e-5)
    content = CRS(code).to_json_dict()
    del content["id"]
    content["conversion"]["parameters"][2 if code != "EPSG:2314" else 0]["value"] += 1e-3
    named = CRS(canonical_crs(CRS.from_json_dict(content).to_wkt()))
    assert named.datum is not None and named.datum.name == CRS(code).datum.name  # type: ignore[union-attr]


def test_short_strings_stay_short() -> None:
    for text in ("+proj=utm +zone=32 +datum=WGS84", "+proj=tmerc +lon_0=9 +datum=NAD27", "+proj=tmerc +lon_0=9 +R=3e6"):
        assert canonical_crs(text).startswith("+proj=")


@pytest.mark.parametrize("text", [LOCAL, ENGINEERING, 'LOCAL_CS["Undefined Cartesian SRS",UNIT["unknown",0.1]]'])
def test_local_systems_in_metres_state_no_place(tmp_path: Path, text: str) -> None:
    """Rasters, layers and tables of local systems ended with a fault of the program."""
    assert split_compound(text) == (None, None)
    rng = np.random.default_rng(0)
    XYZ = np.column_stack([5e5 + rng.uniform(0, 99, 60), 5.2e6 + rng.uniform(0, 99, 60), rng.uniform(100, 101, 60)])
    wkb = shapely.to_wkb(shapely.points(XYZ))
    pyogrio.raw.write(tmp_path / "p.gpkg", wkb, [np.arange(60)], ["id"], driver="GPKG", layer="p",
                      geometry_type="Point Z", crs=text)  # fmt: skip
    np.savetxt(tmp_path / "p.xyz", XYZ)
    (tmp_path / "p.prj").write_text(text)
    for name in ("p.gpkg", "p.xyz"):
        words = ("dtm", "build", tmp_path / name, "--height-system", "EPSG:5773", "--dry-run", "-o", tmp_path / "m")
        said = inside(*words)
        assert said.code == 3 and "no CRS" in said.err, said.err
        assert inside(*words, "--crs", "EPSG:32632").code == 0
    place = Affine(1, 0, 5e5, 0, -1, 5.2e6)
    raster = write_image(tmp_path / "d.tif", np.full((1, 8, 9), 5, np.float32), crs=text, transform=place)
    assert inside("info", raster).code == 0


@pytest.mark.parametrize("code", ["EPSG:32118", "EPSG:2263"])
def test_a_missing_grid_is_answered_with_a_system_that_needs_none(code: str) -> None:
    system = metric_system(code)
    XY = 300_000.0, 60_000.0
    with pytest.raises(
        InputError, match=r"the grid us_noaa_\w+\.tif .* is missing.*on the datum .* such as EPSG:26918"
    ):
        crs_step(system.crs, "EPSG:32618", (XY[0], XY[1], XY[0] + 1, XY[1] + 1))
    crs_step(system.crs, "EPSG:26918")(XY)


def test_units_that_are_stated_twice(tmp_path: Path) -> None:
    path = tmp_path / "s.xml"
    path.write_text('<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2"><Units><Imperial linearUnit="foot"/>'
                    '<Metric linearUnit="meter"/></Units></LandXML>')  # fmt: skip
    with pytest.raises(InputError, match=r"s\.xml: states its units twice"):
        read_measured([path], ReadOptions())


def test_orientations_in_local_feet_are_refused_by_name(tmp_path: Path) -> None:
    """They were taken as metres."""
    path = tmp_path / "o.txt"
    text = "# CoordinateSystem: {}\n#PhotoID, X, Y, Z, Omega, Phi, Kappa\na.jpg\t1\t2\t3\t0\t0\t0\n"
    path.write_text(text.format(LOCAL_FEET))
    with pytest.raises(InputError, match=r"o\.txt:1: .* is a local system in foot"):
        read_orientation(path)
    path.write_text(text.format(LOCAL))
    assert read_orientation(path).centers.tolist() == [[1, 2, 3]]


def test_local_systems_in_feet_are_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "p.xyz").write_text("1 2 3\n4 5 6\n7 8 10\n")
    (tmp_path / "p.prj").write_text(LOCAL_FEET)
    said = inside("dtm", "build", tmp_path / "p.xyz", "--crs", "EPSG:32632", "-o", tmp_path / "m.gpkg")
    assert said.code == 3 and "p.prj" in said.err and "local system in foot" in said.err
    place = Affine(1, 0, 5e5, 0, -1, 5.2e6)
    raster = write_image(tmp_path / "d.tif", np.full((1, 8, 9), 5, np.float32), crs=LOCAL_FEET, transform=place)
    said = inside("dtm", "contours", raster, "--interval", "1", "-o", tmp_path / "c.gpkg")
    assert said.code == 3 and "d.tif" in said.err and "local system in foot" in said.err


PLACE = Affine(10, 0, 5e5, 0, -10, 5.2e6)
AUX = "<PAMDataset><SRS>EPSG:{}</SRS><GeoTransform>{}, 10, 0, 5200000, 0, -10</GeoTransform></PAMDataset>"


@pytest.mark.parametrize(
    ("beside", "text", "fits"),
    [
        ("d.tfw", "10\n0\n0\n-10\n500005\n5199995\n", True),
        ("d.tfw", "10\n0\n0\n-10\n500000\n5200000\n", False),
        ("d.tfw", "10\n0\n0\n-10\n700005\n5199995\n", False),
        ("d.wld", "20\n0\n0\n-20\n500005\n5199995\n", False),
        ("d.tif.aux.xml", AUX.format(32632, 500000), True),
        ("d.tif.aux.xml", AUX.format(32632, 700000), False),
        ("d.tif.aux.xml", AUX.format(32633, 500000), False),
        ("d.prj", "EPSG:32632", True),
        ("d.prj", "EPSG:25833", False),
        ("d.prj", "of another program", True),
    ],
)
def test_rasters_whose_tags_and_neighbours_differ(tmp_path: Path, beside: str, text: str, fits: bool) -> None:
    """GDAL takes one of the two without a word: heights were read 200 km, or half a post, from where they are."""
    path = write_image(tmp_path / "d.tif", np.full((1, 20, 20), 5, np.float32), crs="EPSG:32632", transform=PLACE)
    (tmp_path / beside).write_text(text)
    said = inside("dtm", "contours", path, "--interval", "1", "-o", tmp_path / "c.gpkg")
    assert ("remove what is wrong" in said.err) is not fits, said.err
    assert fits or (said.code == 3 and "d.tif states" in said.err and f"{beside} states" in said.err)
    assert ("remove what is" in inside("info", path, "--json").out) is not fits


@pytest.mark.parametrize(
    ("vertical", "unit", "system", "metres"),
    [(5103, 9003, "EPSG:5703", 1200 / 3937), (5103, 9001, "EPSG:5703", 1.0), (5103, 0, "EPSG:5703", 1.0),
     (5030, 0, "ellipsoidal", 1.0), (5019, 9002, "ellipsoidal", 0.3048), (5102, 9003, "EPSG:7968", 1200 / 3937)],
)  # fmt: skip
def test_vertical_codes_of_the_first_geotiff(
    tmp_path: Path, vertical: int, unit: int, system: str, metres: float
) -> None:
    """They stand in many LAS files, which were refused; two points that are left were called damaged, too."""
    laspy = pytest.importorskip("laspy")
    from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct

    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = np.array([0.01] * 3)
    keys = {1024: 1, 3072: 26918, 4096: vertical} | ({4099: unit} if unit else {})
    directory = GeoKeyDirectoryVlr()
    directory.geo_keys = [GeoKeyEntryStruct(k, 0, 1, v) for k, v in keys.items()]
    directory.geo_keys_header.number_of_keys = len(keys)
    header.vlrs.append(directory)
    data = laspy.LasData(header)
    data.x, data.y, data.z = np.array([[5e5, 5e5 + 1], [4.5e6, 4.5e6 + 1], [300.0, 301.0]])
    data.write(tmp_path / "a.las")
    measured = read_measured([tmp_path / "a.las"], ReadOptions())
    np.testing.assert_allclose(measured.points[0].xyz[:, 2], np.array([300, 301]) * metres)
    assert measured.height_system == system


def test_a_declared_crs_and_the_one_of_the_file(tmp_path: Path) -> None:
    """The declaration was passed over in silence."""
    path = write_image(tmp_path / "d.tif", np.full((1, 20, 20), 5, np.float32), crs="EPSG:32632", transform=PLACE)
    words = ("dtm", "contours", path, "--interval", "1", "-o", tmp_path / "c.gpkg", "--crs")
    said = inside(*words, "EPSG:25833")
    assert said.code == 3 and "d.tif: states EPSG:32632, declared is EPSG:25833" in said.err
    said = inside(*words, "EPSG:32632")
    assert "declared is" not in said.err
    project = 'format = 1\ncrs = "EPSG:32632"\n[terrain]\nfile = "d.tif"\ncrs = "EPSG:32633"\nheight_system = "same"\n'
    image = '[cameras.c]\ntype = "frame"\nsize = [9, 9]\nfocal_px = 9.0\n[[images]]\nname = "i"\nfile = "i.tif"\n'
    (tmp_path / "project.toml").write_text(f'{project}[orientation]\nheight_system = "same"\n{image}camera = "c"\n')
    with pytest.raises(InputError, match=r"d\.tif: states EPSG:32632, declared is EPSG:32633"):
        ground_of(load_project(tmp_path / "project.toml"))


def test_a_missing_grid_is_told_with_the_file(tmp_path: Path) -> None:
    place = Affine(10, 0, 4e5, 0, -10, 3e5)
    path = write_image(tmp_path / "d.tif", np.full((1, 20, 20), 5, np.float32), crs="EPSG:27700", transform=place)
    with pytest.raises(InputError, match=r"d\.tif: no exact transformation from EPSG:27700 to EPSG:32630: the grid"):
        open_terrain(path).in_crs("EPSG:32630")
    (tmp_path / "gcp_list.txt").write_text("EPSG:27700\n400000 300000 50 5 6 a.jpg p\n")
    with pytest.raises(InputError, match=r"gcp_list\.txt: no exact transformation"):
        read_gcp_list(tmp_path / "gcp_list.txt", "EPSG:32630")


def test_objects_whose_heights_are_declared_otherwise(tmp_path: Path) -> None:
    """What [[objects]] declared was passed over if the file states a height system."""
    square = shapely.from_wkt("POLYGON Z ((0 0 9, 1 0 9, 1 1 9, 0 0 9))")
    square = shapely.transform(square, lambda XYZ: np.add(XYZ, (500050, 5199950, 0)), include_z=True)
    pyogrio.raw.write(tmp_path / "o.gpkg", shapely.to_wkb([square]), [np.array(["a"], object)], ["name"],
                      driver="GPKG", layer="o", geometry_type="Polygon Z", crs="EPSG:32632+5703")  # fmt: skip
    write_image(tmp_path / "d.tif", np.full((1, 20, 20), 5, np.float32), crs="EPSG:32632", transform=PLACE)
    text = (
        'format = 1\ncrs = "EPSG:32632"\n[terrain]\nfile = "d.tif"\nheight_system = "EPSG:5703"\n[orientation]\n'
        'height_system = "EPSG:5703"\n[[objects]]\nfile = "o.gpkg"\nheight_system = "{}"\n[cameras.c]\n'
        'type = "frame"\nsize = [9, 9]\nfocal_px = 9.0\n[[images]]\nname = "i"\nfile = "i.tif"\ncamera = "c"\n'
    )
    project = tmp_path / "project.toml"
    for declared in ("EPSG:5703", "EPSG:8228", "same"):
        project.write_text(text.format(declared))
        ground_of(load_project(project))
    project.write_text(text.format("EPSG:5773"))
    with pytest.raises(InputError, match=r"o\.gpkg: states heights NAVD88 .*\[\[objects\]\] states EGM96"):
        ground_of(load_project(project))
