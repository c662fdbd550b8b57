"""Positions and attitudes in images: EXIF built here byte by byte after CIPA DC-008, XMP after DJI's manual."""

from __future__ import annotations

import contextlib
import csv
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyproj import Proj, Transformer
from scipy.spatial.transform import Rotation
from tools.image_headers import ASCII, MAIN, OWN, RATIONAL, exif, folder, gps, jpeg, xmp

from photoplan.errors import InputError
from photoplan.geometry.crs import topocentric_poses
from photoplan.geometry.local import enu_poses
from photoplan.io.formats import read_orientation, read_orientation_block
from photoplan.io.image_metadata import read_image_folder, read_image_metadata, rotation_from_gimbal
from photoplan.io.points import read_observed_positions


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("place", [(46.8426070833333, -91.9945598888889, 198.309), (-33.5, 151.25, -12.5)])
def test_exif_of_jpeg_and_tiff(tmp_path: Path, order: str, place: tuple[float, float, float]) -> None:
    tiff = exif(MAIN, OWN, gps(*place), order)
    (tmp_path / "b.tif").write_bytes(tiff)
    for path in (jpeg(tmp_path / "a.jpg", tiff), tmp_path / "b.tif"):
        found = read_image_metadata(path)
        # Rationals are exact: 1e-7 seconds are 3 micrometres.
        np.testing.assert_allclose(found.position, place, rtol=0, atol=3e-11)
        assert (found.camera, found.size) == ("DJI FC6310", (5472, 3648))
        # 24 mm of 43.27 mm diagonal is 8.8 mm of 15.86 mm: the one-inch sensor of 13.2 × 8.8 mm.
        np.testing.assert_allclose(found.sensor_size_mm, (13.2, 8.8), rtol=1e-3)
        assert found.time == 1536674709.25
        assert found.display == 3
        assert found.yaw_pitch_roll is None and found.sigma is None


def test_xmp_of_dji(tmp_path: Path) -> None:
    packet = xmp(
        AbsoluteAltitude="+198.31",
        GpsLatitude="46.8426070833",
        GpsLongtitude="-91.99455988",
        GimbalYawDegree="+45.00",
        GimbalPitchDegree="-89.90",
        GimbalRollDegree="+0.00",
        RtkStdLon="0.011",
        RtkStdLat="0.012",
        RtkStdHgt="0.025",
    )
    found = read_image_metadata(jpeg(tmp_path / "a.jpg", exif(MAIN, OWN, gps(46.84, -91.99, 100.0)), packet))
    assert found.position == (46.8426070833, -91.99455988, 198.31)
    assert found.yaw_pitch_roll == (45.0, -89.9, 0.0)
    assert found.sigma == (0.011, 0.012, 0.025)


def test_an_image_that_states_nothing(tmp_path: Path) -> None:
    found = read_image_metadata(jpeg(tmp_path / "a.jpg"))
    assert found.position is None and found.size is None
    zero = gps(1, 2, 3) | {2: (RATIONAL, [(0, 0)] * 3)}
    assert read_image_metadata(jpeg(tmp_path / "a.jpg", exif({}, {}, zero))).position is None


BOMB = b'<!DOCTYPE d [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;">]><x>&b;</x>'


@pytest.mark.parametrize(
    ("raw", "says"),
    [
        (lambda t: t[:60], "EXIF header is damaged"),
        (lambda t: t[:4] + struct.pack("<I", 1 << 31) + t[8:], "EXIF header is damaged"),
        (lambda t: t[:8] + b"\xff\xff" + t[10:], "EXIF header is damaged"),
        (lambda t: b"XXXX" + t[4:], "EXIF header is damaged"),
    ],
)
def test_fault_08_damaged_exif(tmp_path: Path, raw: Any, says: str) -> None:
    found = read_image_metadata(jpeg(tmp_path / "a.jpg", raw(exif(MAIN, OWN, gps(1, 2, 3)))))
    assert says in found.faults[0]
    assert found.position is None


BROKEN = {
    "ampersand": lambda packet: packet.replace(b"DJI Meta Data", b"R&D Meta"),
    "control character": lambda packet: packet.replace(b"DJI Meta Data", b"DJI\x07Data"),
    "undeclared prefix": lambda packet: packet.replace(b"xmlns:drone-dji=", b"xmlns:other="),
    "cut off": lambda packet: packet[: len(packet) // 2],
    "two roots": lambda packet: packet.replace(b"   <?xpacket", b"<more/><?xpacket"),
    "no XML": lambda packet: b"\xff\x00\x01 not a packet",
}
ATTITUDE = {"GimbalYawDegree": 10, "GimbalPitchDegree": -90, "GimbalRollDegree": 0}


@pytest.mark.parametrize("how", BROKEN)
def test_a_malformed_xmp_packet_costs_that_packet(tmp_path: Path, how: str) -> None:
    packet = BROKEN[how](xmp(**ATTITUDE))
    found = read_image_metadata(jpeg(tmp_path / "b.jpg", exif(MAIN, OWN, gps(47.0, 9.0, 500.0)), packet))
    assert found.position == pytest.approx((47.0, 9.0, 500.0), abs=1e-6)
    assert found.yaw_pitch_roll is None
    assert "its XMP packet is damaged" in found.faults[0]


def test_damaged_exif_leaves_xmp(tmp_path: Path) -> None:
    packet = xmp(GpsLatitude=47.5, GpsLongitude=9.5, AbsoluteAltitude=400, **ATTITUDE)
    found = read_image_metadata(jpeg(tmp_path / "a.jpg", exif(MAIN, OWN, gps(1, 2, 3))[:60], packet))
    assert found.position == (47.5, 9.5, 400.0)
    assert found.yaw_pitch_roll == (10.0, -90.0, 0.0)
    assert "EXIF header is damaged" in found.faults[0]


def test_one_bad_image_of_a_folder_is_listed_and_counted(tmp_path: Path) -> None:
    for k in range(4):
        jpeg(tmp_path / f"{k}.jpg", exif(MAIN, OWN, gps(47.0 + k * 1e-4, 9.0, 500.0)), xmp(**ATTITUDE))
    jpeg(tmp_path / "broken.jpg", exif(MAIN, OWN, gps(47.0, 9.0, 500.0)), b"<x:xmpmeta R&D>")
    (tmp_path / "empty.jpg").write_bytes(b"")
    (tmp_path / "text.tif").write_text("no image")
    jpeg(tmp_path / "far.jpg", exif({}, {}, gps(91.0, 0, 0)))
    jpeg(tmp_path / "bomb.jpg", exif(MAIN, OWN, gps(47.0, 9.0, 500.0)), BOMB)
    jpeg(tmp_path / "cut.jpg", exif(MAIN, OWN, gps(47.0, 9.0, 500.0))[:60], xmp(**ATTITUDE))
    notes = " | ".join(read_orientation_block(tmp_path).table.notes)
    assert "4 of 10 images cannot be used and are left out: bomb.jpg" in notes
    assert "2 of 10 images have damaged metadata, which are left out: broken.jpg: its XMP packet is damaged" in notes
    assert len(read_orientation_block(tmp_path).table.images) == 4
    table = read_observed_positions(tmp_path, crs="EPSG:32632")
    assert table.images == ("0.jpg", "1.jpg", "2.jpg", "3.jpg", "broken.jpg")
    assert "4 of 10 images cannot be used" in table.notes[0]
    # A single image that cannot be read is refused.
    with pytest.raises(InputError, match="neither JPEG nor TIFF"):
        read_orientation_block(tmp_path / "text.tif", format="exif")


def test_fault_10_xml_bomb_in_xmp(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="XMP: holds a document type or entities"):
        read_image_metadata(jpeg(tmp_path / "a.jpg", None, BOMB))


def test_other_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"\x89PNG....")
    with pytest.raises(InputError, match="neither JPEG nor TIFF"):
        read_image_metadata(tmp_path / "a.png")
    with pytest.raises(InputError, match="cannot be read"):
        read_image_metadata(tmp_path / "none.jpg")
    with pytest.raises(InputError, match="not on the earth"):
        read_image_metadata(jpeg(tmp_path / "a.jpg", exif({}, {}, gps(91.0, 0, 0))))


def test_random_bytes_never_crash(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    good = exif(MAIN, OWN, gps(10, 20, 30))
    for _ in range(300):
        raw = bytearray(good)
        for at in rng.integers(0, len(raw), 6):
            raw[at] = rng.integers(0, 256)
        with contextlib.suppress(InputError):
            read_image_metadata(jpeg(tmp_path / "a.jpg", bytes(raw)))


def test_gimbal_axes_by_hand() -> None:
    """Straight down with the top of the image to the east: x to the south, y to the east, z up."""
    np.testing.assert_allclose(rotation_from_gimbal((90, -90, 0)), [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)
    # Level to the north: x east, y up, z (backwards) south.
    np.testing.assert_allclose(rotation_from_gimbal((0, 0, 0)), [[1, 0, 0], [0, 0, -1], [0, 1, 0]], atol=1e-15)
    # A positive roll turns the camera clockwise, so its right side goes down.
    assert rotation_from_gimbal((0, 0, 10))[2, 0] < 0
    # DJI's manual: north, east, down, order ZYX.
    for ypr in np.random.default_rng(4).uniform([-180, -90, -30], [180, 30, 30], (20, 3)):
        ned = Rotation.from_euler("ZYX", ypr, degrees=True).as_matrix()
        R = rotation_from_gimbal(ypr)
        for camera, gimbal in (([0, 0, -1], [1, 0, 0]), ([1, 0, 0], [0, 1, 0]), ([0, -1, 0], [0, 0, 1])):
            n, e, d = ned @ gimbal
            np.testing.assert_allclose(R @ camera, [e, n, -d], atol=1e-14)


def test_a_folder_as_orientation(tmp_path: Path) -> None:
    images = folder(tmp_path)
    jpeg(images / "no_gps.jpg")
    block = read_orientation_block(images)
    assert [i.name for i in block.table.images] == ["DJI_0.JPG", "DJI_1.JPG", "DJI_2.JPG"]
    assert "1 images state no position" in block.table.notes[0]
    assert "turns 3 images for display" in block.table.notes[1]
    assert block.sizes["DJI_0.JPG"] == (5472, 3648)
    XYZ, axes = topocentric_poses(block.table.origin or (0, 0, 0), "EPSG:32615", block.table.centers)
    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32615", always_xy=True)
    for k in range(3):
        lat, lon = 46.84 + 1e-3 * k, -91.99 - 2e-3 * k
        np.testing.assert_allclose(XYZ[k], [*to_map.transform(lon, lat), 200.0 + k], atol=1e-5)
        # Angles refer to grid north: the convergence of meridians of zone 15, 0.73° here, is taken out of the yaw.
        convergence = Proj("EPSG:32615").get_factors(lon, lat).meridian_convergence
        c, s = np.cos(np.radians(convergence)), np.sin(np.radians(convergence))
        turned = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]).T
        expected = turned @ rotation_from_gimbal((40 + k, -85, 1))
        angle = np.degrees(np.arccos(min(1.0, (np.trace(expected.T @ (axes @ block.table.rotations)[k]) - 1) / 2)))
        assert abs(convergence) > 0.7 and angle < 0.01


def test_a_folder_as_observed_positions(tmp_path: Path) -> None:
    images = folder(tmp_path)
    table = read_observed_positions(images, crs="EPSG:32615")
    assert table.images == ("DJI_0.JPG", "DJI_1.JPG", "DJI_2.JPG")
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32615", always_xy=True).transform(-91.99, 46.84)
    np.testing.assert_allclose(table.XYZ[0], [x, y, 200.0], atol=1e-4)
    np.testing.assert_array_equal(table.positions().sigma, [[0.01, 0.02, 0.03]] * 3)
    assert table.attitudes(0.01) is None


def test_without_attitudes_there_is_no_orientation(tmp_path: Path) -> None:
    jpeg(tmp_path / "a.jpg", exif(MAIN, OWN, gps(46, -91, 100)))
    with pytest.raises(InputError, match=r"1 images state a position and none an attitude.*\[observations\]"):
        read_orientation(tmp_path)
    (tmp_path / "a.jpg").unlink()
    jpeg(tmp_path / "b.jpg")
    with pytest.raises(InputError, match="no image states a GPS position"):
        read_orientation(tmp_path, format="exif")
    datum = gps(46, -91, 100) | {18: (ASCII, "TOKYO")}
    jpeg(tmp_path / "b.jpg", exif(MAIN, OWN, datum))
    with pytest.raises(InputError, match="datum TOKYO"):
        read_orientation(tmp_path, format="exif")


def test_signs_of_positions_in_unusual_forms(tmp_path: Path) -> None:
    """References as words, and the reference of the altitude as text."""
    for changes, place in (({1: (ASCII, "s")}, (-33.5, 70.6, 412.0)), ({3: (ASCII, "West")}, (33.5, -70.6, 412.0)),
                           ({5: (ASCII, "1")}, (33.5, 70.6, -412.0))):  # fmt: skip
        jpeg(tmp_path / "a.jpg", exif(MAIN, OWN, gps(33.5, 70.6, 412.0) | changes))
        assert read_image_metadata(tmp_path / "a.jpg").position == pytest.approx(place)


def test_an_image_of_another_datum_is_left_out_of_a_folder(tmp_path: Path) -> None:
    """One image in Tokyo's datum had refused the whole folder."""
    for name, datum in (("a", "WGS-84"), ("b", "TOKYO"), ("c", "WGS 84")):
        jpeg(tmp_path / f"{name}.jpg", exif(MAIN, OWN, gps(46, -91, 100) | {18: (ASCII, datum)}))
    placed = read_image_folder(tmp_path)
    assert [m.file.name for m in placed.placed] == ["a.jpg", "c.jpg"]
    assert "1 of 3 images refer to another datum than WGS 84 and are left out: b.jpg: datum TOKYO" in placed.notes[0]


def test_the_brighton_blocks_gimbal_angles_agree_with_its_adjusted_ones(shared: Path) -> None:
    """18 images: yaw and pitch of the drone against ω, φ, κ from an adjustment; the gimbal is good to some degrees.

    The six images of the strip that was flown back lie turned by 180° in these data: their reduction followed EXIF's
    display rotation. Measured: the whole rotation differs by 2.7° to 5.2°, 3.7° rms (the
    adjustment finds tilts of up to 4°, where the gimbal says 0.1°), the heading by −1.2° in the mean.
    """
    data = shared / "data" / "drone_brighton"
    adjusted = read_orientation(data / "ext.csv")
    rotations = dict(zip((i.name[:8] for i in adjusted.images), adjusted.rotations))
    centers = dict(zip((i.name[:8] for i in adjusted.images), adjusted.centers))
    rows = list(csv.DictReader((data / "exif.csv").open()))
    names = [Path(r["SourceFile"]).stem for r in rows]
    rows, names = zip(*((r, n) for r, n in zip(rows, names) if n in rotations))  # type: ignore[assignment]
    places = [[float(r[f"GPS{n}"]) for n in ("Latitude", "Longitude", "Altitude")] for r in rows]
    origin, enu, axes = enu_poses(places)
    XYZ, to_map = topocentric_poses(origin, "EPSG:32615", enu)
    angles, headings = [], []
    for k, (row, name) in enumerate(zip(rows, names)):
        R = (
            to_map[k]
            @ axes[k]
            @ rotation_from_gimbal([float(row["GimbalYawDegree"]), float(row["GimbalPitchDegree"]), 0])
        )
        flown_back = float(row["GimbalYawDegree"]) < 0
        between = rotations[name].T @ R @ np.diag([-1, -1, 1] if flown_back else [1, 1, 1])
        angles.append(np.degrees(np.arccos((np.trace(between) - 1) / 2)))
        headings.append(np.degrees(np.arctan2(between[1, 0], between[0, 0])))
        assert np.hypot(*(XYZ[k] - centers[name])[:2]) < 3.0
    assert len(angles) == 18
    assert max(angles) < 6 and np.sqrt(np.mean(np.square(angles))) < 4
    assert abs(np.mean(headings)) < 2
