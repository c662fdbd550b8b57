"""Units of coordinates and heights: each reader converts what is known and refuses the rest by the file's name."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyogrio.raw
import pytest
import shapely
from affine import Affine
from pyproj import CRS
from tools.small_block import write_image, write_terrain

from photoplan.errors import HeightSystemError, InputError
from photoplan.geometry.grid import Window
from photoplan.geometry.heights import check_height_system
from photoplan.geometry.units import agreed_metres, known_metres, metric_heights, metric_system
from photoplan.io.formats import read_orientation
from photoplan.io.points import read_gcp_list, read_ground_points, read_observed_positions
from photoplan.io.project.file import load_project
from photoplan.io.raster import TerrainReader
from photoplan.io.terrain.files import read_measured
from photoplan.io.terrain.options import ReadOptions
from photoplan.io.vector_layer import read_features
from photoplan.products.init import InitRequest, init_project
from photoplan.project.ground import open_terrain

FT, US = 0.3048, 1200 / 3937
#: Spellings of a unit in PROJ, EPSG, GDAL, UCUM, Esri and everyday files.
UNITS: dict[float, tuple[str, ...]] = {
    1.0: ("m", "metre", "Meter", "METERS", "9001", "EPSG:9001"),
    1000.0: ("km", "kilometre", "Kilometer"),
    0.1: ("dm", "decimetre", "Decimeters", "0.1 m"),
    0.01: ("cm", "centimetre", "CENTIMETER"),
    0.001: ("mm", "millimetre", "millimeters"),
    FT: ("ft", "foot", "Feet", "[ft_i]", "international foot", "9002"),
    US: ("us-ft", "US survey foot", "Foot_US", "ftUS", "[ft_us]", "USSurveyFoot", "U.S. survey feet", "9003"),
    0.9144: ("yd", "yard", "[yd_i]"),
    0.0254: ("in", "inch", "[in_i]"),
    1609.344: ("mi", "Statute mile", "miles"),
    1852.0: ("kmi", "nautical mile", "Nautical_Mile", "[nmi_i]"),
    1.8288: ("fath", "fathom", "Fathoms", "[fth_i]"),
    20.1168: ("ch", "chain"),
    0.201168: ("link", "links"),
    US * 66: ("us-ch", "US survey chain"),
    0.3047972654: ("Clarke's foot", "Foot_Clarke", "9005"),
    0.304799471538676: ("British foot (Sears 1922)", "Foot_Sears"),
    0.304799510248147: ("Indian foot", "Foot_Indian"),
    0.30479841: ("ind-ft", "Indian foot (1937)"),
    1.0000135965: ("German legal metre", "German_Meter"),
}
SPELLED = [(name, metres) for metres, names in UNITS.items() for name in names]


@pytest.mark.parametrize(("name", "metres"), SPELLED)
def test_units_are_known_in_every_spelling(name: str, metres: float) -> None:
    assert known_metres(name) == pytest.approx(metres, rel=1e-9)


@pytest.mark.parametrize("name", ["", "degree", "Mm", "ell", "feets", "Pa", "DN", "unknown", "1", "999999", "m²"])
def test_other_words_are_no_unit(name: str) -> None:
    assert known_metres(name) is None


@pytest.mark.parametrize(
    ("system", "metric", "rise"),
    [
        ("EPSG:6360", "EPSG:5703", US),
        ("EPSG:8228", "EPSG:5703", FT),
        ("EPSG:5702", "EPSG:7968", US),
        ("EPSG:6358", "EPSG:5703", -US),
        ("EPSG:5715", "EPSG:5714", -1.0),
        ("EPSG:5773", "EPSG:5773", 1.0),
        ("EPSG:4979", "ellipsoidal", 1.0),
        ("EPSG:2263+6360", "EPSG:5703", US),
        (CRS("EPSG:6360").to_wkt(), "EPSG:5703", US),
        (CRS("EPSG:6360").to_json(), "EPSG:5703", US),
        ("+proj=utm +zone=18 +datum=WGS84 +vunits=us-ft +type=crs", "ellipsoidal", US),
        ("+proj=utm +zone=18 +datum=WGS84 +vto_meter=0.3048 +type=crs", "ellipsoidal", FT),
    ],
)
def test_height_systems_in_metres(system: str, metric: str, rise: float) -> None:
    assert metric_heights(system) == (metric, pytest.approx(rise))
    assert check_height_system(system) not in ("ellipsoidal",) or rise == 1.0


@pytest.mark.parametrize(
    ("crs", "metric", "scale"),
    [
        ("EPSG:2263", "EPSG:32118", US),
        (CRS("EPSG:2226").to_wkt("WKT1_ESRI"), None, US),
        ("EPSG:6539", "EPSG:6538", US),
        ("EPSG:24500", "EPSG:24500", 1.0),
        ("+proj=utm +zone=18 +datum=NAD83 +units=us-ft", None, US),
        ("+proj=utm +zone=18 +datum=NAD83 +units=ind-yd", None, 0.91439523),
    ],
)
def test_projected_systems_in_metres(crs: str, metric: str | None, scale: float) -> None:
    found = metric_system(crs)
    assert found.scale == pytest.approx(scale, rel=1e-9) and metric in (None, found.crs)
    feet, metres = CRS(crs), CRS(found.crs)
    assert metres.axis_info[0].unit_conversion_factor == 1.0
    # The same place has coordinates that differ by the factor alone.
    from pyproj import Transformer

    forth = [Transformer.from_crs("EPSG:4269", c, always_xy=True).transform(-74.0, 40.7) for c in (feet, metres)]
    if "24500" not in crs:
        np.testing.assert_allclose(np.array(forth[0]) * scale, forth[1], rtol=1e-9)


def raster(path: Path, value: float, crs: str | None = "EPSG:32618", **options: Any) -> Path:
    place = {"transform": Affine(10, 0, 500_000, 0, -10, 4_500_000)} | ({} if crs is None else {"crs": crs})
    scale = {key: options.pop(key) for key in ("units", "scales", "offsets") if key in options}
    write_image(path, np.full((1, 8, 9), value, np.float32), **place, **options)
    if scale:
        import rasterio

        with rasterio.open(path, "r+") as file:
            for key, values in scale.items():
                setattr(file, key, values)
    return path


@pytest.mark.parametrize(("name", "metres"), [(names[k], m) for m, names in UNITS.items() for k in (0, 1)])
def test_a_raster_is_converted_by_the_unit_of_its_band(tmp_path: Path, name: str, metres: float) -> None:
    path = raster(tmp_path / "a.tif", 4.0 / metres, units=(name,))
    assert TerrainReader(path).pixel(1, 1) == pytest.approx(4.0, rel=1e-6)
    assert open_terrain(path).surface.heights((500_020.0, 4_499_960.0)) == pytest.approx(4.0, rel=1e-6)


def test_scale_and_offset_of_a_band_are_in_its_unit(tmp_path: Path) -> None:
    path = raster(tmp_path / "a.tif", 100, units=("dm",), scales=(0.5,), offsets=(30.0,))
    assert TerrainReader(path).pixel(0, 0) == pytest.approx(8.0)


def test_heights_in_centimetres_beyond_nine_thousand_are_heights(tmp_path: Path) -> None:
    assert TerrainReader(raster(tmp_path / "a.tif", 40_000, units=("cm",))).pixel(0, 0) == pytest.approx(400.0)


@pytest.mark.parametrize("name", ["furlongs", "degree", "DN"])
def test_a_raster_in_an_unknown_unit_is_refused_by_name(tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match=rf"a\.tif: .*'{name}' is not a known unit"):
        TerrainReader(raster(tmp_path / "a.tif", 4.0, units=(name,)))


@pytest.mark.parametrize(
    ("crs", "unit", "declared", "metres"),
    [
        ("EPSG:32618", None, "EPSG:6360", US),
        ("EPSG:32618", None, "EPSG:5703", 1.0),
        ("EPSG:32618", "ft", "EPSG:5703", FT),
        ("EPSG:32618", "ft", "EPSG:6360", US),
        ("EPSG:32618", None, CRS("EPSG:6360").to_wkt(), US),
        ("EPSG:32618+6360", None, None, US),
        ("EPSG:32618+5703", None, None, 1.0),
        ("EPSG:32618+6360", None, "EPSG:5773", US),
        ("EPSG:2263+6360", None, None, US),
        ("EPSG:2263", None, "EPSG:5703", 1.0),
        ("EPSG:2263", None, "EPSG:6360", US),
        ("EPSG:2263", "m", "ellipsoidal", 1.0),
        ("EPSG:32618", None, "EPSG:5715", -1.0),
        ("EPSG:4979", None, None, 1.0),
    ],
)
def test_declared_height_systems_decide_the_unit(
    tmp_path: Path, crs: str, unit: str | None, declared: str | None, metres: float
) -> None:
    options = {} if unit is None else {"units": (unit,)}
    reader = TerrainReader(raster(tmp_path / "a.tif", 100.0, crs, **options), height_system=declared)
    assert reader.pixel(0, 0) == pytest.approx(100.0 * metres, rel=1e-6)
    opened = open_terrain(tmp_path / "a.tif", height_system=declared)
    if "2263" in crs:
        assert opened.crs == "EPSG:32118" and opened.bounds[0] == pytest.approx(500_000 * US)


@pytest.mark.parametrize(
    ("crs", "unit", "declared"),
    [("EPSG:32618", "m", "EPSG:6360"), ("EPSG:32618+5703", "ft", None), ("EPSG:32618+6360", "cm", None),
     ("EPSG:2263", None, None), ("EPSG:2263", None, "same"), ("EPSG:2263", None, "ellipsoidal")],
)  # fmt: skip
def test_contradictions_and_unstated_units_are_refused(
    tmp_path: Path, crs: str, unit: str | None, declared: str | None
) -> None:
    path = raster(tmp_path / "a.tif", 100.0, crs, **({} if unit is None else {"units": (unit,)}))
    with pytest.raises(InputError, match=r"a\.tif"):
        TerrainReader(path, height_system=declared)


def test_a_three_dimensional_crs_states_ellipsoidal_heights(tmp_path: Path) -> None:
    for k, crs in enumerate(("EPSG:4979", CRS("EPSG:32632").to_3d().to_wkt())):
        path = raster(tmp_path / f"{k}.tif", 5.0, crs)
        assert TerrainReader(path).info.height_system == "ellipsoidal"
        assert open_terrain(path).height_system == "ellipsoidal"


def points(path: Path, prj: str | None = None, rows: str = "1000 2000 300\n1010 2000 301\n1000 2010 302\n") -> Path:
    path.write_text(rows)
    if prj is not None:
        path.with_suffix(".prj").write_text(prj)
    return path


@pytest.mark.parametrize(
    ("prj", "crs", "system", "factors"),
    [
        ("EPSG:2263+6360", None, None, (US, US)),
        ("EPSG:32618+6360", None, None, (1.0, US)),
        ("EPSG:2263+5703", None, None, (US, 1.0)),
        (None, "EPSG:32618", "EPSG:8228", (1.0, FT)),
        (None, "EPSG:2263", "EPSG:5703", (US, 1.0)),
        (None, "EPSG:2263", "EPSG:6360", (US, US)),
        (None, "EPSG:32618", "EPSG:6358", (1.0, -US)),
        (CRS("EPSG:2263+6360").to_json(), None, None, (US, US)),
    ],
)
def test_text_points(tmp_path: Path, prj: str | None, crs: str | None, system: str | None, factors: Any) -> None:
    measured = read_measured(
        [points(tmp_path / "p.xyz", prj)], ReadOptions(beyond_area=True, crs=crs, height_system=system)
    )
    np.testing.assert_allclose(measured.points[0].xyz[0], np.array([1000, 2000, 300]) * [factors[0], *factors])
    assert CRS(measured.crs).axis_info[0].unit_conversion_factor == 1.0


def test_points_in_feet_of_which_no_height_unit_is_stated_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"p\.xyz: heights: the unit of heights is not stated"):
        read_measured([points(tmp_path / "p.xyz", "EPSG:2263")], ReadOptions(beyond_area=True))


def test_layers_in_feet(tmp_path: Path) -> None:
    path = tmp_path / "v.gpkg"
    shapes = shapely.to_wkb(shapely.from_wkt(["POINT Z (1000 2000 300)"]))
    pyogrio.raw.write(path, shapes, [np.array(["a"], object)], ["name"], driver="GPKG", layer="p",
                      geometry_type="Point Z", crs="EPSG:2263+6360")  # fmt: skip
    np.testing.assert_allclose(
        read_measured([path], ReadOptions(beyond_area=True)).points[0].xyz, np.array([[1000, 2000, 300]]) * US
    )
    np.testing.assert_allclose(read_ground_points(path, crs="EPSG:32118").XYZ, np.array([[1000, 2000, 300]]) * US)
    (one,) = read_features(path, "Point", crs="EPSG:32118").items
    assert one.geometry.z == pytest.approx(300 * US) and one.geometry.x == pytest.approx(1000 * US)


@pytest.mark.parametrize(
    ("head", "factors"),
    [
        ('<Metric linearUnit="meter"/>', (1.0, 1.0)),
        ('<Metric linearUnit="meter" elevationUnit="feet"/>', (1.0, FT)),
        ('<Metric linearUnit="millimeter" elevationUnit="meter"/>', (1e-3, 1.0)),
        ('<Imperial linearUnit="foot"/>', (FT, FT)),
        ('<Imperial linearUnit="USSurveyFoot"/>', (US, US)),
        ('<Imperial linearUnit="USSurveyFoot" elevationUnit="feet"/>', (US, US)),
        ('<Imperial linearUnit="foot" elevationUnit="meter"/>', (FT, 1.0)),
        ('<Imperial linearUnit="inch" elevationUnit="feet"/>', (0.0254, FT)),
    ],
)
def test_landxml(tmp_path: Path, head: str, factors: Any) -> None:
    path = tmp_path / "s.xml"
    surface = "<DataPoints><PntList3D>2000 1000 300 2010 1000 301 2000 1010 302</PntList3D></DataPoints>"
    path.write_text(
        f'<LandXML xmlns="http://www.landxml.org/schema/LandXML-1.2"><Units>{head}</Units><Surfaces><Surface name="s">'
        f"<SourceData>{surface}</SourceData></Surface></Surfaces></LandXML>"
    )
    measured = read_measured([path], ReadOptions(beyond_area=True, crs="EPSG:32618", height_system="EPSG:5703"))
    np.testing.assert_allclose(measured.points[0].xyz[0], np.array([1000, 2000, 300]) * [factors[0], *factors])


@pytest.mark.parametrize(("keys", "factors"), [
    ({3076: 9003, 4099: 9003}, (US, US)), ({4099: 9002}, (1.0, FT)), ({3076: 9001, 4099: 9014}, (1.0, 1.8288)),
    ({4096: 6360}, (1.0, US)), ({3072: 2263, 3076: 9003, 4096: 6360, 4099: 9003}, (US, US)),
])  # fmt: skip
def test_las_geokeys(tmp_path: Path, keys: dict[int, int], factors: Any) -> None:
    laspy = pytest.importorskip("laspy")
    from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct

    declared = ReadOptions(beyond_area=True, crs=None if 3072 in keys else "EPSG:32618")
    header = laspy.LasHeader(point_format=1, version="1.2")
    header.scales = np.array([0.01] * 3)
    directory = GeoKeyDirectoryVlr()
    entries = {1024: 1, 3072: 26918, **keys} if 3076 in keys or 3072 in keys else dict(keys)
    directory.geo_keys = [GeoKeyEntryStruct(k, 0, 1, v) for k, v in sorted(entries.items())]
    directory.geo_keys_header.number_of_keys = len(entries)
    header.vlrs.append(directory)
    data = laspy.LasData(header)
    data.x, data.y, data.z = np.array([[1000.0], [2000.0], [300.0]])
    data.write(tmp_path / "a.las")
    if 3076 in keys and 3072 not in keys:  # metres of EPSG:26918 and feet contradict each other, metres agree
        if keys[3076] != 9001:
            with pytest.raises(InputError, match=r"a\.las: X and Y: the file states US survey feet"):
                read_measured([tmp_path / "a.las"])
            return
        declared = ReadOptions(beyond_area=True)
    xyz = read_measured([tmp_path / "a.las"], declared).points[0].xyz[0]
    np.testing.assert_allclose(xyz, np.array([1000, 2000, 300]) * [factors[0], *factors], rtol=1e-6)


def test_las_in_feet_of_a_system_in_metres_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="feet"):
        agreed_metres(US, metric_heights("EPSG:5703")[1], "a.las: heights", in_one_file=True)


ORIENTATION = "name,x,y,z,omega,phi,kappa\na.jpg,1000,2000,3000,1,2,3\nb.jpg,1100,2000,3000,1,2,3\n"


@pytest.mark.parametrize(
    ("prj", "declared", "factors"),
    [
        ("EPSG:32618+6360", None, (1.0, US)),
        ("EPSG:2263+6360", None, (US, US)),
        ("EPSG:2263", "EPSG:6360", (US, US)),
        ("EPSG:2263", "EPSG:5703", (US, 1.0)),
        ("EPSG:32618", "EPSG:8228", (1.0, FT)),
        ("EPSG:32618", None, (1.0, 1.0)),
        ("EPSG:32618+6360", "EPSG:6360", (1.0, US)),
    ],
)
def test_orientations(tmp_path: Path, prj: str, declared: str | None, factors: Any) -> None:
    path = points(tmp_path / "o.csv", prj, ORIENTATION)
    table = read_orientation(path).heights_in_metres(declared)
    np.testing.assert_allclose(table.centers[0], np.array([1000, 2000, 3000]) * [factors[0], *factors])
    assert read_observed_positions(path, crs=table.crs).XYZ.shape == (2, 3) if declared is None else True


def test_orientations_in_feet_without_a_unit_of_heights_are_refused(tmp_path: Path) -> None:
    table = read_orientation(points(tmp_path / "o.csv", "EPSG:2263", ORIENTATION))
    for declared in (None, "same", "ellipsoidal"):
        with pytest.raises(InputError, match=r"o\.csv: heights"):
            table.heights_in_metres(declared)


def test_control_and_positions_beside_which_a_crs_in_feet_is_stated(tmp_path: Path) -> None:
    control = points(tmp_path / "c.csv", "EPSG:2263+6360", "name,x,y,z\np,1000,2000,300\nq,1000,2000,\n")
    XYZ = read_ground_points(control, crs="EPSG:32118").XYZ
    np.testing.assert_allclose(XYZ, np.array([[1000, 2000, 300], [1000, 2000, np.nan]]) * US)
    (tmp_path / "gcp_list.txt").write_text("EPSG:2263+6360\n1000 2000 300 5 6 a.jpg p\n")
    gcps = read_gcp_list(tmp_path / "gcp_list.txt")
    assert gcps.crs == "EPSG:32118"
    np.testing.assert_allclose(gcps.ground.XYZ, [[1000 * US, 2000 * US, 300 * US]])


def test_a_project_in_feet_is_refused_and_init_makes_one_in_metres(tmp_path: Path) -> None:
    write_terrain(tmp_path / "dem.tif", np.full((60, 64), 328.0833333))
    write_image(tmp_path / "a.tif", np.full((1, 30, 40), 90, np.uint8))
    import rasterio

    with rasterio.open(tmp_path / "dem.tif") as file:
        crs, (left, bottom, right, top) = str(file.crs), file.bounds
    (tmp_path / "c.toml").write_text('[cameras.cam]\ntype = "frame"\nsize = [40, 30]\nfocal_px = 50.0\n')
    x, y = (left + right) / 2, (bottom + top) / 2
    (tmp_path / "o.csv").write_text(f"name,x,y,z,omega,phi,kappa\na,{x},{y},1968.5,0,0,0\n")
    request = InitRequest(tmp_path, (str(tmp_path / "a.tif"),), tmp_path / "c.toml", tmp_path / "o.csv",
                          str(tmp_path / "dem.tif"), crs=crs, height_system="EPSG:6360")  # fmt: skip
    made = init_project(request)
    project = load_project(made.path)
    assert project.orientation.height_system == "EPSG:5703"
    assert project.posed[0].center[2] == pytest.approx(600.0)
    assert project.terrain is not None and project.terrain.height_system == "EPSG:6360"
    from photoplan.project.ground import ground_of

    assert ground_of(project).surface.heights((x, y)) == pytest.approx(100.0, abs=1e-4)
    text = made.path.read_text()
    made.path.write_text(text.replace('"EPSG:5703"', '"EPSG:6360"'))
    with pytest.raises(HeightSystemError, match=r"\[orientation\] height_system.*US survey feet"):
        load_project(made.path)


def test_a_metashape_reference_in_feet_leaves_geocentric_poses_alone(shared: Path, tmp_path: Path) -> None:
    table = read_orientation(shared / "cases" / "16_metashape_reference_feet" / "r.xml")
    assert table.crs is not None and CRS(table.crs).axis_info[0].unit_conversion_factor == 1.0
    assert table.height_system == "ellipsoidal"


def test_contours_take_heights_of_an_attribute(tmp_path: Path) -> None:
    lines = [{"type": "Feature", "properties": {"ELEV": 100 + k, "n": k},
              "geometry": {"type": "LineString", "coordinates": [[500000 + 9 * k, 5e6], [500009 + 9 * k, 5e6 + 9]]}}
             for k in range(3)]  # fmt: skip
    path = tmp_path / "c.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": lines}))
    with pytest.raises(InputError, match=r"ELEV may hold it; .*height_field` ELEV"):
        read_measured([path], ReadOptions(beyond_area=True, crs="EPSG:32632"))
    for system, metres in (("EPSG:5703", 1.0), ("EPSG:6360", US)):
        measured = read_measured(
            [path], ReadOptions(beyond_area=True, crs="EPSG:32632", height_system=system, height_field="elev")
        )
        assert [line.xyz[0, 2] for line in measured.lines] == pytest.approx([(100 + k) * metres for k in range(3)])
    with pytest.raises(InputError, match="no attribute 'nothing'"):
        read_measured([path], ReadOptions(beyond_area=True, crs="EPSG:32632", height_field="nothing"))


def test_a_level_surface_is_reported(tmp_path: Path) -> None:
    measured = read_measured(
        [points(tmp_path / "p.xyz", None, "1 2 0\n3 4 0\n5 9 0\n")], ReadOptions(beyond_area=True, crs="EPSG:32632")
    )
    assert any("all 3 heights are 0 m" in note for note in measured.notes)


def test_windows_of_a_depth_raster_rise(tmp_path: Path) -> None:
    reader = TerrainReader(raster(tmp_path / "a.tif", 12.0), height_system="EPSG:5715")
    assert (reader.read(Window(0, 0, 3, 3)) == -12.0).all() and reader.system is not None
    assert reader.system.heights == "EPSG:5714"
