"""Metashape's cameras.xml: its camera model and its chunk on the earth, written out here after its manual."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import CRS, Transformer
from scipy.spatial.transform import Rotation
from tools.format_examples import assert_same, block_of, frame, pixels, round_trip, with_table

from photoplan.errors import InputError, UsageError
from photoplan.io.formats import orientation_format, read_orientation_block, write_orientation
from photoplan.io.image_metadata import rotation_from_gimbal
from photoplan.io.orientation.structure_from_motion import read_metashape_cameras

LENS = {"f": 3705.5, "cx": 11.7, "cy": -27.7, "b1": 0.53, "b2": -0.31, "k1": -0.092, "k2": -0.076, "k3": 0.116}
LENS |= {"k4": -0.076, "p1": -3.1e-4, "p2": 1.2e-4}
SIZE = (5280, 3956)
#: Where the chunk lies: 8.2° east, 47.3° north, 500 m; a typical scale of a chunk.
SCALE = 12.354192447331316
R_WORLD = Rotation.from_rotvec([0.4, -0.9, 1.7]).as_matrix()


def geocentric(lon: float, lat: float, h: float, a: float = 6378137.0, f: float = 1 / 298.257223563) -> np.ndarray:
    lam, phi = np.radians([lon, lat])
    e2 = f * (2 - f)
    N = a / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    return np.array(
        [(N + h) * np.cos(phi) * np.cos(lam), (N + h) * np.cos(phi) * np.sin(lam), (N * (1 - e2) + h) * np.sin(phi)]
    )


T_WORLD = geocentric(8.2, 47.3, 500.0)


def camera_transform(k: int) -> np.ndarray:
    """A camera some 90 m above the ground that looks about downwards, in the chunk's own system."""
    up = geocentric(8.2, 47.3, 501.0) - T_WORLD
    up = R_WORLD.T @ (up / np.linalg.norm(up))
    z = -up  # forwards is down
    x = np.cross([0.3, 0.5, -0.2], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z], axis=1) @ Rotation.from_rotvec([0.1, -0.2 * k, 0.4 * k]).as_matrix()
    M = np.eye(4)
    M[:3, :3], M[:3, 3] = R, (90.0 * up + np.array([3.0, -7.0, 5.0]) * k) / SCALE
    return M


def text(values: Any) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values).ravel())


def document(wkt: str | None, chunk: str = "", cameras: str = "", version: str = "2.0.0", kind: str = "frame") -> str:
    given = "".join(f"<{n}>{v!r}</{n}>" for n, v in LENS.items())
    placed = (
        f"<transform><rotation locked='true'>{text(R_WORLD)}</rotation><translation locked='true'>{text(T_WORLD)}"
        f"</translation><scale locked='true'>{SCALE!r}</scale></transform>"
    )
    body = "".join(
        f'<camera id="{k}" sensor_id="0" component_id="0" label="IMG {k}.JPG">'
        f"<transform>{text(camera_transform(k))}</transform><orientation>1</orientation></camera>"
        for k in range(3)
    )
    reference = f"<reference>{wkt.replace('&', '&amp;')}</reference>" if wkt else ""
    components = f'<components active_id="0"><component id="0" label="C">{placed}</component></components>'
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="{version}"><chunk label="Chunk 1">
<sensors><sensor id="0" label="M3M (12.29mm)" type="{kind}"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/>
<property name="pixel_width" value="0.0033"/>
<calibration type="{kind}" class="initial"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/><f>3700</f></calibration>
<calibration type="{kind}" class="adjusted"><resolution width="{SIZE[0]}" height="{SIZE[1]}"/>{given}</calibration>
</sensor></sensors>{components if not chunk else chunk.format(placed=placed)}
<cameras next_id="4"><group id="0" label="Group 1" type="folder">{body}</group>
<camera id="9" sensor_id="0" label="lost.JPG"/>{cameras}</cameras>{reference}</chunk></document>"""


def manual(k: int, earth: np.ndarray) -> np.ndarray:
    """u, v of geocentric points after the user manual's appendix, moved to pixel centres at whole numbers."""
    M = camera_transform(k)
    own = ((earth - T_WORLD) @ R_WORLD / SCALE - M[:3, 3]) @ M[:3, :3]
    x, y = own[:, 0] / own[:, 2], own[:, 1] / own[:, 2]
    r2 = x * x + y * y
    v = LENS
    g = 1 + v["k1"] * r2 + v["k2"] * r2**2 + v["k3"] * r2**3 + v["k4"] * r2**4
    xd = x * g + v["p1"] * (r2 + 2 * x * x) + 2 * v["p2"] * x * y
    yd = y * g + v["p2"] * (r2 + 2 * y * y) + 2 * v["p1"] * x * y
    u = SIZE[0] * 0.5 + v["cx"] + xd * v["f"] + xd * v["b1"] + yd * v["b2"]
    w = SIZE[1] * 0.5 + v["cy"] + yd * v["f"]
    # The manual: (0.5, 0.5) is the centre of the upper-left pixel.
    return np.stack([u - 0.5, w - 0.5], axis=1)


def ground(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([8.2, 47.3, 500.0]) + rng.uniform(-1, 1, (40, 3)) * [5e-4, 3e-4, 10.0]


WKT2 = CRS("EPSG:32632").to_wkt("WKT1_GDAL")


@pytest.mark.parametrize("chunk", ["", "{placed}"], ids=["component", "before version 1.5"])
def test_a_projected_block_sees_the_manuals_pixels(tmp_path: Path, chunk: str) -> None:
    (tmp_path / "cameras.xml").write_text(document(WKT2, chunk))
    block = read_orientation_block(tmp_path / "cameras.xml")
    assert block.table.crs == "EPSG:32632"
    assert block.table.height_system == "ellipsoidal"
    assert [i.name for i in block.table.images] == ["IMG 0.JPG", "IMG 1.JPG", "IMG 2.JPG"]
    assert any("1 cameras are not aligned" in n for n in block.table.notes)
    points = ground()
    to_map = Transformer.from_crs("EPSG:4979", "EPSG:32632", always_xy=True)
    X, Y = to_map.transform(points[:, 0], points[:, 1])
    earth = np.array([geocentric(*p) for p in points])
    for k in range(3):
        seen = pixels(block, np.column_stack([X, Y, points[:, 2]]), k, crs="EPSG:32632")
        np.testing.assert_allclose(seen, manual(k, earth), atol=1e-4)


def test_a_geographic_block_is_read_in_a_tangential_system(tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(document(CRS("EPSG:4326").to_wkt("WKT1_GDAL")))
    block = read_orientation_block(tmp_path / "cameras.xml")
    assert block.table.crs is None
    lat, lon, h = block.table.origin or (0, 0, 0)
    points = ground()
    earth = np.array([geocentric(*p) for p in points])
    S, C, s, c = (f(np.radians(v)) for v in (lat, lon) for f in (np.sin, np.cos))
    axes = np.array([[-s, c, 0], [-S * c, -S * s, C], [C * c, C * s, S]])
    enu = (earth - geocentric(lon, lat, h)) @ axes.T
    for k in range(3):
        np.testing.assert_allclose(pixels(block, enu, k), manual(k, earth), atol=1e-5)


def test_another_datum_keeps_its_own_ellipsoid(tmp_path: Path) -> None:
    """Geocentric coordinates are those of the CRS's datum: here Bessel's ellipsoid."""
    (tmp_path / "cameras.xml").write_text(document(CRS("EPSG:2056").to_wkt("WKT1_GDAL")))
    block = read_orientation_block(tmp_path / "cameras.xml")
    lv95 = CRS("EPSG:2056")
    a, f = lv95.ellipsoid.semi_major_metre, 1 / lv95.ellipsoid.inverse_flattening
    points = ground()
    # The chunk's translation is a point of the other datum; its own geographic coordinates there:
    on_bessel = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=cart +a={a} +rf={1 / f} +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    lon, lat, h = on_bessel.transform(*T_WORLD)
    points = points - [8.2, 47.3, 500.0] + [lon, lat, h]
    X, Y = Transformer.from_crs(lv95.geodetic_crs, lv95, always_xy=True).transform(points[:, 0], points[:, 1])
    earth = np.array([geocentric(*p, a=a, f=f) for p in points])
    seen = pixels(block, np.column_stack([X, Y, points[:, 2]]), 1, crs="EPSG:2056")
    np.testing.assert_allclose(seen, manual(1, earth), atol=1e-3)


#: Camera, component and measured position of one drone image (DJI Mavic 3M with RTK) from a real cameras.xml, as the
#: tests of geograypher show it (Open Forest Observatory, BSD-3-Clause).
REAL_TRANSFORM = (
    "-0.99988146 -0.00872749 0.01268391 7.04224697 -0.00842932 0.99969124 0.02337453 7.05403071 "
    "-0.01288400 0.02326485 -0.99964631 0.43561421 0 0 0 1"
)
REAL_ROTATION = (
    "0.8710699454 0.3070967021 -0.3833128821 -0.4909742007 0.5658364395 -0.6623997719 "
    "0.0134716110 0.7651932691 0.6436596744"
)
REAL_TRANSLATION, REAL_SCALE = "-2499366.429888 -4256836.520906 4029217.965003", "12.354192447331316"
REAL_PLACE, REAL_YAW, REAL_PITCH = (39.41191747, -120.417985477, 2420.109), 179.9, 0.1


def test_a_real_camera_lies_where_its_receiver_says(tmp_path: Path) -> None:
    """The adjusted projection centre is 4.2 cm from the measured one; the rotation 1.9° from the drone's compass."""
    placed = (
        f"<rotation>{REAL_ROTATION}</rotation><translation>{REAL_TRANSLATION}</translation><scale>{REAL_SCALE}</scale>"
    )
    text = document(CRS("EPSG:4326").to_wkt("WKT1_GDAL"), "<transform>" + placed + "</transform>")
    text = text[: text.index("<cameras")] + (
        f'<cameras><camera id="0" sensor_id="0" component_id="0" label="/home/user/000001-01_00001.JPG">'
        f"<transform>{REAL_TRANSFORM}</transform></camera></cameras>{text[text.index('<reference>') :]}"
    )
    (tmp_path / "cameras.xml").write_text(text)
    table = read_orientation_block(tmp_path / "cameras.xml").table
    lat, lon, h = table.origin or (0, 0, 0)
    assert np.abs(table.centers).max() < 1e-6  # the only camera is the middle
    off = np.subtract((lat, lon, h), REAL_PLACE) * [111_000.0, 86_000.0, 1.0]
    assert np.linalg.norm(off) < 0.05
    # Metashape counts the pitch of a reference from straight down.
    measured = rotation_from_gimbal((REAL_YAW, REAL_PITCH - 90.0, 0.0))
    assert np.degrees(np.arccos((np.trace(measured.T @ table.rotations[0]) - 1) / 2)) < 2.0


def test_longitudes_from_paris_are_refused(tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(document(CRS("EPSG:27572").to_wkt("WKT1_GDAL")))
    with pytest.raises(InputError, match="counts longitudes from Paris"):
        read_orientation_block(tmp_path / "cameras.xml")
    block = block_of({"a": frame()}, middle=(6e5, 2.4e6, 900.0), crs="EPSG:27572", height_system="ellipsoidal")
    with pytest.raises(InputError, match="counts longitudes from Paris"):
        write_orientation(block, tmp_path / "b.xml", "metashape")


def test_a_local_block_stays_as_it_is(tmp_path: Path) -> None:
    local = 'LOCAL_CS["Local Coordinates (m)",LOCAL_DATUM["Local Datum",0],UNIT["metre",1]]'
    (tmp_path / "cameras.xml").write_text(document(local))
    block = read_orientation_block(tmp_path / "cameras.xml")
    assert block.table.crs is None and block.table.origin is None
    earth = np.array([geocentric(*p) for p in ground()])
    np.testing.assert_allclose(pixels(block, earth, 2), manual(2, earth), atol=1e-4)


def test_no_position_at_all_is_said(tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(document(WKT2, "<components><component id='0'/></components>"))
    block = read_orientation_block(tmp_path / "cameras.xml")
    assert block.table.crs is None
    assert any("no position, scale and rotation" in n for n in block.table.notes)
    np.testing.assert_allclose(block.table.centers[1], camera_transform(1)[:3, 3], atol=1e-12)


@pytest.mark.parametrize("lens", ["none", "brown", "brown with affinity", "brown with shear", "opencv", "fisheye"])
def test_round_trip_of_lenses(tmp_path: Path, lens: str) -> None:
    block = block_of({"cam <1> & 2": frame(lens)})
    again = round_trip(block, tmp_path / "cameras.xml", "metashape")
    assert_same(block, again)
    assert list(again.cameras) == ["cam <1> & 2"]


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:2056", "EPSG:2154"])
def test_round_trip_on_the_earth(tmp_path: Path, crs: str) -> None:
    middle = {
        "EPSG:32632": (460e3, 5.24e6, 900.0),
        "EPSG:2056": (2.64e6, 1.2e6, 900.0),
        "EPSG:2154": (7e5, 6.6e6, 900.0),
    }
    block = block_of({"a": frame("brown"), "b": frame("opencv")}, 6, middle[crs], crs=crs, height_system="ellipsoidal")
    again = round_trip(block, tmp_path / "cameras.xml", "metashape")
    assert again.table.crs == crs
    # Geocentric and map coordinates of millions of metres have a spacing of 1e-9 m each.
    assert_same(block, again, position=2e-8)


def test_round_trip_of_a_tangential_system(tmp_path: Path) -> None:
    block = with_table(block_of({"a": frame("opencv")}, middle=(0, 0, 90.0)), origin=(46.84, -91.99, 150.0))
    again = round_trip(block, tmp_path / "cameras.xml", "metashape")

    # The origin is another one; the cameras' places on the earth are the same.
    def earth(b: Any) -> np.ndarray:
        lat, lon, h = b.table.origin
        S, C, s, c = (f(np.radians(v)) for v in (lat, lon) for f in (np.sin, np.cos))
        axes = np.array([[-s, c, 0], [-S * c, -S * s, C], [C * c, C * s, S]])
        return geocentric(lon, lat, h) + b.table.centers @ axes, axes.T @ b.table.rotations

    for one, two in zip(earth(block), earth(again)):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-8)


def test_losses_and_refusals_in_writing(tmp_path: Path) -> None:
    losses = orientation_format("metashape").losses
    heights = block_of({"a": frame()}, crs="EPSG:32632", height_system="EPSG:5773")
    assert [x.kind for x in losses(heights)] == ["height_system"]
    assert [x.kind for x in losses(block_of({"a": frame("rational")}))] == ["lens"]
    with pytest.raises(InputError, match="none is given"):
        write_orientation(block_of({}), tmp_path / "c.xml", "metashape")
    write_orientation(block_of({"a": frame()}), tmp_path / "c.xml", "metashape")
    with pytest.raises(UsageError, match="`overwrite`"):
        write_orientation(block_of({"a": frame()}), tmp_path / "c.xml", "metashape")


def test_cameras_alone(tmp_path: Path) -> None:
    (tmp_path / "cameras.xml").write_text(document(None))
    camera: Any = read_metashape_cameras(tmp_path / "cameras.xml")["M3M (12.29mm)"]
    assert camera.pixels.focal == (3705.5, 3705.5)
    np.testing.assert_allclose(camera.pixels.point, (5279 / 2 + 11.7, 3955 / 2 - 27.7))
    assert (camera.lens.k4, camera.lens.b1) == (-0.076, 0.53 / 3705.5)


BOMB = '<!DOCTYPE d [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]><document><chunk>&b;</chunk></document>'
EXTERNAL = '<!DOCTYPE d [<!ENTITY x SYSTEM "file:///etc/passwd">]><document><chunk>&x;</chunk></document>'
ROW = text(camera_transform(0))
SENSOR = '<sensor id="0" label="M3M (12.29mm)" type="frame">'


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: BOMB, "document type or entities"),
        (lambda d: EXTERNAL, "document type or entities"),
        (lambda d: d[:700], "not valid XML"),
        (lambda d: "<document><chunk/><chunk/></document>", "2 chunks"),
        (lambda d: "<other/>", "document of <other>"),
        (lambda d: "<document><chunk>" + "<a>" * 100 + "</a>" * 100 + "</chunk></document>", "nested deeper"),
        (lambda d: "<document><chunk/></document>", "no camera has a transform"),
        (lambda d: d.replace(ROW, ROW[: ROW.rindex(" ")]), "camera 'IMG 0.JPG': transform: 15 values"),
        (lambda d: d.replace(ROW, "x " + ROW[ROW.index(" ") :]), "camera 'IMG 0.JPG': transform: 16 values given"),
        (lambda d: d.replace(ROW, "nan " + ROW[ROW.index(" ") :]), "camera 'IMG 0.JPG'.*finite"),
        (lambda d: d.replace(ROW, text(np.diag([1, 1, -1, 1]))), "camera 'IMG 0.JPG'.*right-handed"),
        (lambda d: d.replace(ROW, text(np.eye(4)[::-1])), "last row"),
        (lambda d: d.replace(f"<f>{LENS['f']}</f>", ""), r"sensor 'M3M \(12.29mm\)'.*focal length"),
        (lambda d: d.replace("<k1>", "<p3>0.1</p3><k1>"), "p3 and p4 are not supported"),
        (lambda d: d.replace('type="frame"', 'type="spherical"'), "type 'spherical' is not supported"),
        (lambda d: d.replace('type="frame"', 'type="fisheye"'), "a fisheye with p1, p2 or b2"),
        (lambda d: d.replace(SENSOR, SENSOR.replace('id="0"', 'id="7"')), "sensor '0'.*not described"),
        (lambda d: d.replace(f"<scale locked='true'>{SCALE!r}", "<scale>-1"), "scale -1.0"),
        (lambda d: d.replace(WKT2, 'PROJCS["broken"'), "reference"),
    ],
)
def test_fault_10_hostile_and_broken_files(tmp_path: Path, change: Any, says: str) -> None:
    good = document(WKT2)
    broken = change(good)
    assert broken != good
    (tmp_path / "cameras.xml").write_text(broken)
    with pytest.raises(InputError, match=says):
        read_orientation_block(tmp_path / "cameras.xml", format="metashape")


def labels(change: str = "", groups: tuple[str, str] = ("100MEDIA", "101MEDIA"), second: str = "0") -> str:
    """Two cameras of one label, in two groups, of two sensors of one label."""
    sensors = "".join(
        f'<sensor id="{k}" label="FC6310" type="frame"><resolution width="600" height="400"/><calibration type="frame" '
        f'class="adjusted"><f>500</f><k1>{k1}</k1></calibration></sensor>'
        for k, k1 in ((0, 0.01), (1, 0.02))
    )
    cameras = "".join(
        f'<group id="{k}" label="{group}"><camera id="{k}" sensor_id="{sensor}" label="DJI_1"><transform>'
        f"1 0 0 {k} 0 -1 0 0 0 0 -1 50 0 0 0 1</transform></camera></group>"
        for k, (group, sensor) in enumerate(zip(groups, ("0", second)))
    )
    return f"<document><chunk><sensors>{sensors}</sensors><cameras>{cameras}{change}</cameras></chunk></document>"


def test_equal_labels_are_told_apart(tmp_path: Path) -> None:
    path = tmp_path / "cameras.xml"
    path.write_text(labels(second="1"))
    block = read_orientation_block(path)
    assert [i.name for i in block.table.images] == ["100MEDIA/DJI_1", "101MEDIA/DJI_1"]
    assert [block.camera(i).lens.k1 for i in block.table.images] == [0.01, 0.02]
    assert list(read_metashape_cameras(path)) == ["FC6310 (sensor 0)", "FC6310 (sensor 1)"]
    # One sensor is used: its name is the same as in the file of cameras.
    path.write_text(labels())
    assert list(read_orientation_block(path).cameras) == ["FC6310 (sensor 0)"]
    # Groups of one label, and no groups.
    for groups, name in ((("g", "g"), "g/DJI_1"), (("", ""), "DJI_1")):
        path.write_text(labels(groups=groups))
        images = read_orientation_block(path).table.images
        assert [i.name for i in images] == [f"{name} (camera 0)", f"{name} (camera 1)"]


def test_cameras_of_a_rig_follow_their_master(tmp_path: Path) -> None:
    R = Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()
    slave = (
        '<camera id="7" sensor_id="1" master_id="0" label="NIR"/><camera id="8" sensor_id="1" master_id="9" label="x"/>'
    )
    offset = f"<rotation>{text(R)}</rotation><location>0.5 0.1 -0.2</location></sensor></sensors>"
    path = tmp_path / "cameras.xml"
    path.write_text(labels(slave).replace("</sensor></sensors>", offset))
    block = read_orientation_block(path)
    assert [i.name for i in block.table.images][2:] == ["NIR"]
    master = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(block.table.centers[2], master @ [0.5, 0.1, -0.2] + [0, 0, 50], atol=1e-12)
    np.testing.assert_allclose(block.table.rotations[2], master @ R @ np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    assert [n for n in block.table.notes if "not aligned" in n or "rigs" in n] == [
        "cameras.xml: 1 cameras are not aligned; left out",
        "cameras.xml: 1 cameras of rigs are placed by their master and the offset of the sensor",
    ]


def test_outsiders_labels_are_read(shared: Path) -> None:
    blocks = [read_orientation_block(shared / f"cases/15_metashape_same_labels/{name}.xml") for name in "efg"]
    assert [len(block.table.images) for block in blocks] == [2, 2, 2]
    assert [len(block.cameras) for block in blocks] == [2, 1, 2]


def test_a_sensor_without_a_form_costs_its_images(tmp_path: Path) -> None:
    """A spherical camera beside the others had refused the whole file."""
    text = document(WKT2)
    start, stop = text.index('<sensor id="0"'), text.index("</sensor>") + len("</sensor>")
    other = text[start:stop].replace('id="0"', 'id="7"', 1).replace('type="frame"', 'type="spherical"')
    text = text[:stop] + other + text[stop:]
    (tmp_path / "c.xml").write_text(text)
    assert len(read_orientation_block(tmp_path / "c.xml").table.images) == 3
    (tmp_path / "c.xml").write_text(text.replace('id="1" sensor_id="0"', 'id="1" sensor_id="7"'))
    block = read_orientation_block(tmp_path / "c.xml")
    assert [i.name for i in block.table.images] == ["IMG 0.JPG", "IMG 2.JPG"]
    assert any("warning: 1 of 3 images are left out" in n and "'spherical'" in n for n in block.table.notes)
    (tmp_path / "c.xml").write_text(text.replace('sensor_id="0"', 'sensor_id="7"'))
    with pytest.raises(InputError, match="type 'spherical' is not supported"):
        read_orientation_block(tmp_path / "c.xml")
