"""Metadata of images (EXIF, XMP): sensor, position and attitude, and approximate orientations from them.

Metadata that cameras and drones write into their images (EXIF, XMP): position, attitude, time, focal length.

Read from EXIF entries and the XMP packet in the header of a JPEG or TIFF file; the pixels are not touched. EXIF is a
TIFF structure (CIPA DC-008, TIFF 6.0): a chain of directories of entries (tag, type, count, value or offset). Own
reading keeps rational numbers exact, which GPS positions of centimetres need.

Positions are those of EXIF's GPS directory (latitude, longitude, altitude; WGS 84 unless it names another datum), or
of the XMP of the maker, which has more digits. Attitudes are DJI's gimbal angles in XMP: north, east, down, rotation
order ZYX (DJI Mavic 3E/3T User Manual, "Photo File"). Accuracies are DJI's (RtkStdLon, RtkStdLat, RtkStdHgt) or those
of Pix4D's ``Camera`` schema.

Heights are as the maker means them: EXIF's altitude is above sea level by its definition, but many cameras write the
ellipsoidal or a barometric height into it. The height system has to be declared.

Approximate orientations from what drones write into their images: position, and the attitude of the gimbal.

The gimbal's axes are x along the viewing direction, y right, z down; R = R_z(yaw) R_y(pitch) R_x(roll) takes them to
north, east, down (DJI Mavic 3E/3T User Manual, "Photo File": NED, rotation order ZYX). So pitch −90 looks straight down
with the top of the image towards the yaw. The image lies on its sensor as the camera writes it, without EXIF's display
rotation.

Yaw is taken from true north. Positions become a tangential system (east, north, up), which later steps carry into the
project's CRS with the convergence of meridians.
"""

from __future__ import annotations

import datetime
import math
import re
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike

from photoplan.arrays import Floats
from photoplan.errors import InputError
from photoplan.geometry.bounds import is_no_fix
from photoplan.geometry.crs import crs_step
from photoplan.geometry.local import enu_poses
from photoplan.geometry.pose import rotation_from_angles
from photoplan.io.files import NotWellFormed, parse_xml, whole_number
from photoplan.io.orientation.block import OrientationBlock, OrientationFormat, OrientationTable, TableFormat, posed

_DJI = "dji.com/drone-dji"
_CAMERA = "pix4d.com/camera"
_MM_PER_UNIT = {2.0: 25.4, 3.0: 10.0, 4.0: 1.0, 5.0: 0.001}
"""Millimetres of EXIF's FocalPlaneResolutionUnit: inch, centimetre, millimetre, micrometre."""
_FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)


@dataclass(frozen=True)
class ImageMetadata:
    """What an image states of itself; None: it does not."""

    file: Path
    size: tuple[int, int] | None = None
    """Width and height in pixels."""
    position: tuple[float, float, float] | None = None
    """Latitude, longitude (degrees) and altitude (metres)."""
    no_fix: bool = False
    """Whether the receiver had no position: latitude and longitude are both 0."""
    datum: str | None = None
    """Datum that EXIF names; None: WGS 84 as it is customary."""
    sigma: tuple[float, float, float] | None = None
    """Standard deviation of east, north and height, metres, as the receiver states them."""
    yaw_pitch_roll: tuple[float, float, float] | None = None
    """Of the viewing direction, degrees: yaw clockwise from north, pitch −90 straight down and 0 to the horizon, roll
    clockwise about the viewing direction."""
    sensor_size_mm: tuple[float, float] | None = None
    """From the resolution in the focal plane, or from the 35 mm equivalent of the focal length (to about 1 %)."""
    camera: str | None = None
    """Maker and model."""
    time: float | None = None
    """Seconds since 1970 by the camera's clock (taken as UTC)."""
    faults: tuple[str, ...] = ()
    """What of its metadata is damaged and was left out: EXIF or the XMP packet, a clause each."""
    display: int = 1
    """EXIF's Orientation: how a viewer turns the image (1: not at all, 3: by 180°). Pixels are read as stored, and
    attitudes are those of the sensor; only programs that turned the pixels make a difference."""


def read_image_metadata(path: str | Path) -> ImageMetadata:
    """Metadata of a JPEG or TIFF image; pixels are not read."""
    path = Path(path)
    exif, packet, faults = read_exif(path)
    try:
        dji, schema = _xmp(packet, path)
    except NotWellFormed as error:
        (dji, schema), faults = ({}, {}), (*faults, f"its XMP packet is damaged ({str(error).partition(': ')[2]})")
    size = _size(exif)
    position = _position(exif, dji, path)
    no_fix = position is not None and is_no_fix(*position[:2])
    names = [n for n in (_text(exif, "Make"), _text(exif, "Model")) if n]
    return ImageMetadata(
        file=path,
        size=size,
        position=None if no_fix else position,
        no_fix=no_fix,
        datum=_text(exif, "GPSMapDatum"),
        sigma=_sigma(exif, dji, schema),
        yaw_pitch_roll=_attitude(dji),
        sensor_size_mm=_sensor(exif, size, _number(exif, "FocalLength")),
        camera=" ".join(names) or None,
        time=_time(exif),
        faults=faults,
        display=int(_number(exif, "Orientation") or 1),
    )


def _xmp(packet: str | None, path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Properties of DJI's schema and of Pix4D's ``Camera`` schema."""
    found: tuple[dict[str, str], dict[str, str]] = ({}, {})
    if not packet:
        return found
    # The packet is padded with blanks and zero bytes, and framed by processing instructions.
    text = re.sub(r"<\?xpacket[^>]*\?>", "", packet.replace("\0", "")).strip()
    if not text:
        return found
    for name, value in _properties(parse_xml(text, f"{path}: XMP")):
        for schema, into in zip((_DJI, _CAMERA), found):
            if schema in name:
                into[name.rpartition("}")[2]] = value
    return found


def _properties(root: Element) -> Iterator[tuple[str, str]]:
    """Names with namespace, and values, of attributes and of elements with text."""
    for element in root.iter():
        yield from element.attrib.items()
        if element.text and element.text.strip():
            yield str(element.tag), element.text.strip()
        else:
            # A list is a container with items.
            items = [i.text.strip() for i in element.iter() if i is not element and i.text and i.text.strip()]
            if items and len(items) <= 10:
                yield str(element.tag), ",".join(items)


def _float(text: str | None) -> float | None:
    try:
        value = float(text or "")
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _number(exif: dict[str, ExifValue], name: str) -> float | None:
    value = exif.get(name)
    if isinstance(value, str) or not value or not math.isfinite(value[0]):
        return None
    return float(value[0])


def _text(exif: dict[str, ExifValue], name: str) -> str | None:
    value = exif.get(name)
    return value.strip() or None if isinstance(value, str) else None


def _size(exif: dict[str, ExifValue]) -> tuple[int, int] | None:
    for names in (("PixelXDimension", "PixelYDimension"), ("ImageWidth", "ImageLength")):
        width, height = (_number(exif, n) for n in names)
        if width and height:
            return int(width), int(height)
    return None


def _position(exif: dict[str, ExifValue], dji: dict[str, str], path: Path) -> tuple[float, float, float] | None:
    lat = _degrees(exif, "GPSLatitude", "S")
    lon = _degrees(exif, "GPSLongitude", "W")
    altitude = _number(exif, "GPSAltitude")
    below = _number(exif, "GPSAltitudeRef") in (1.0, 3.0) or _text(exif, "GPSAltitudeRef") in ("1", "3")
    if altitude is not None and below:
        altitude = -altitude  # below the reference: sea level, or (since EXIF 3.0) the ellipsoid
    # The maker's own numbers have more digits; one of DJI's names is misspelled in many drones.
    own = _float(dji.get("GpsLatitude")), _float(dji.get("GpsLongitude", dji.get("GpsLongtitude")))
    if own[0] is not None and own[1] is not None and not is_no_fix(own[0], own[1]):
        lat, lon = own
    height = _float(dji.get("AbsoluteAltitude"))
    altitude = height if height is not None else altitude
    if lat is None or lon is None or altitude is None:
        return None
    if abs(lat) > 90 or abs(lon) > 180:
        raise InputError(f"{path}: latitude {lat}, longitude {lon} are not on the earth; its GPS entries are damaged")
    return lat, lon, altitude


def _degrees(exif: dict[str, ExifValue], name: str, negative: str) -> float | None:
    value = exif.get(name)
    if isinstance(value, str) or not value or not all(math.isfinite(v) for v in value):
        return None
    degrees = sum(v / 60.0**k for k, v in enumerate(value[:3]))
    sign = _text(exif, f"{name}Ref") or ""
    return -abs(degrees) if sign.upper().startswith(negative) else degrees


def _sigma(
    exif: dict[str, ExifValue], dji: dict[str, str], schema: dict[str, str]
) -> tuple[float, float, float] | None:
    east, north, up = (_float(dji.get(f"RtkStd{n}")) for n in ("Lon", "Lat", "Hgt"))
    if east is None or north is None:
        east = north = _float(schema.get("GPSXYAccuracy")) or _number(exif, "GPSHPositioningError")
        up = _float(schema.get("GPSZAccuracy"))
    if not (east and north and up) or min(east, north, up) <= 0:
        return None
    return east, north, up


def _attitude(dji: dict[str, str]) -> tuple[float, float, float] | None:
    gimbal = [_float(dji.get(f"Gimbal{n}Degree")) for n in ("Yaw", "Pitch", "Roll")]
    if gimbal[0] is not None and gimbal[1] is not None:
        return gimbal[0], gimbal[1], gimbal[2] or 0.0
    return None


def _sensor(
    exif: dict[str, ExifValue], size: tuple[int, int] | None, focal: float | None
) -> tuple[float, float] | None:
    if size is None:
        return None
    per_x, per_y = (_number(exif, f"FocalPlane{a}Resolution") for a in "XY")
    unit = _MM_PER_UNIT.get(_number(exif, "FocalPlaneResolutionUnit") or 2.0)
    if per_x and per_y and unit:
        return size[0] / per_x * unit, size[1] / per_y * unit
    equivalent = _number(exif, "FocalLengthIn35mmFilm")
    if focal and equivalent:
        diagonal = _FULL_FRAME_DIAGONAL * focal / equivalent
        scale = diagonal / math.hypot(*size)
        return size[0] * scale, size[1] * scale
    return None


def _time(exif: dict[str, ExifValue]) -> float | None:
    text = _text(exif, "DateTimeOriginal") or _text(exif, "DateTime")
    try:
        moment = datetime.datetime.strptime(text or "", "%Y:%m:%d %H:%M:%S").replace(tzinfo=datetime.UTC)
    except ValueError:
        return None
    fraction = _text(exif, "SubSecTimeOriginal") or ""
    return moment.timestamp() + (float(f"0.{fraction}") if whole_number(fraction) is not None else 0.0)


ExifValue = str | tuple[float, ...]

#: Entries of a directory, bytes of a value and segments of a JPEG header at most; real ones are far smaller.
MAX_ENTRIES = 1000
MAX_VALUE = 1 << 20
MAX_SEGMENTS = 500
EXIF_DIRECTORY, GPS_DIRECTORY, XMP_TAG = 34665, 34853, 700
#: struct letter and length of one value, by TIFF type; rationals are two numbers.
_TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 6: "b", 7: "s", 8: "h", 9: "i", 11: "f", 12: "d"}
_RATIONAL = {5: "I", 10: "i"}
_XMP_HEAD = b"http://ns.adobe.com/xap/1.0/\0"

#: Names of the entries that photoplan uses, by directory.
_NAMES = {
    0: {271: "Make", 272: "Model", 274: "Orientation", 256: "ImageWidth", 257: "ImageLength", 306: "DateTime"},
    EXIF_DIRECTORY: {
        36867: "DateTimeOriginal",
        37521: "SubSecTimeOriginal",
        37386: "FocalLength",
        41989: "FocalLengthIn35mmFilm",
        40962: "PixelXDimension",
        40963: "PixelYDimension",
        41486: "FocalPlaneXResolution",
        41487: "FocalPlaneYResolution",
        41488: "FocalPlaneResolutionUnit",
    },
    GPS_DIRECTORY: {
        1: "GPSLatitudeRef",
        2: "GPSLatitude",
        3: "GPSLongitudeRef",
        4: "GPSLongitude",
        5: "GPSAltitudeRef",
        6: "GPSAltitude",
        16: "GPSImgDirectionRef",
        17: "GPSImgDirection",
        18: "GPSMapDatum",
        31: "GPSHPositioningError",
    },
}


def read_exif(path: Path) -> tuple[dict[str, ExifValue], str | None, tuple[str, ...]]:
    """EXIF entries by their standard names, the XMP packet as text (None: there is none), and what is damaged."""
    try:
        with path.open("rb") as file:
            start = file.read(4)
            if start[:2] == b"\xff\xd8":
                return _of_jpeg(file)
            if start in (b"II*\0", b"MM\0*"):
                return *_of_tiff(_window(file)), ()
            if start in (b"II+\0", b"MM\0+"):
                return {}, None, ()  # BigTIFF: no camera writes it
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (struct.error, ValueError, OverflowError) as error:
        raise InputError(f"{path}: its EXIF header is damaged ({error}); get a fresh copy") from None
    raise InputError(f"{path}: neither JPEG nor TIFF; positions are read from EXIF of these")


def _of_jpeg(file: BinaryIO) -> tuple[dict[str, ExifValue], str | None, tuple[str, ...]]:
    file.seek(2)
    entries: dict[str, ExifValue] = {}
    faults: tuple[str, ...] = ()
    xmp: str | None = None
    for _ in range(MAX_SEGMENTS):
        head = file.read(4)
        # The picture starts (SOS), or ends (EOI): no more segments with metadata.
        if len(head) < 4 or head[0] != 0xFF or head[1] in (0xDA, 0xD9):
            break
        (length,) = struct.unpack(">H", head[2:])
        if length < 2:
            break
        segment = file.read(length - 2)
        if head[1] == 0xE1 and segment.startswith(b"Exif\0\0") and not entries:
            try:
                entries, _ = _of_tiff(_buffer(segment[6:]))
            except (struct.error, ValueError, OverflowError) as error:
                faults = (f"its EXIF header is damaged ({error})",)
        elif head[1] == 0xE1 and segment.startswith(_XMP_HEAD):
            xmp = segment[len(_XMP_HEAD) :].decode("utf-8", "replace")
    return entries, xmp, faults


_Reader = Callable[[int, int], bytes]


def _buffer(data: bytes) -> _Reader:
    def read(offset: int, count: int) -> bytes:
        if offset + count > len(data):
            raise ValueError("an entry points beyond its end")
        return data[offset : offset + count]

    return read


def _window(file: BinaryIO) -> _Reader:
    def read(offset: int, count: int) -> bytes:
        file.seek(offset)
        data = file.read(count)
        if len(data) < count:
            raise ValueError("an entry points beyond its end")
        return data

    return read


def _of_tiff(read: _Reader) -> tuple[dict[str, ExifValue], str | None]:
    mark = read(0, 4)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(mark)
    if order is None:
        raise ValueError("it begins with no byte order")
    (first,) = struct.unpack(order + "I", read(4, 4))
    entries: dict[str, ExifValue] = {}
    xmp: str | None = None
    pending = [(0, first)]
    for directory, offset in pending:
        wanted = {*_NAMES[directory], *((EXIF_DIRECTORY, GPS_DIRECTORY, XMP_TAG) if directory == 0 else ())}
        for tag, value in _directory(read, order, offset, wanted):
            if directory == 0 and tag in (EXIF_DIRECTORY, GPS_DIRECTORY) and not isinstance(value, str):
                pending.append((tag, int(value[0])))
            elif directory == 0 and tag == XMP_TAG:
                xmp = value if isinstance(value, str) else bytes(int(v) for v in value).decode("utf-8", "replace")
            elif tag in _NAMES[directory]:
                entries[_NAMES[directory][tag]] = value
    return entries, xmp


def _directory(read: _Reader, order: str, offset: int, wanted: set[int]) -> list[tuple[int, ExifValue]]:
    (count,) = struct.unpack(order + "H", read(offset, 2))
    if count > MAX_ENTRIES:
        raise ValueError(f"a directory of {count} entries")
    found = []
    for k in range(count):
        entry = read(offset + 2 + 12 * k, 12)
        tag, kind, number = struct.unpack(order + "HHI", entry[:8])
        letter = _RATIONAL.get(kind) or _TYPES.get(kind)
        if letter is None or not number or tag not in wanted:
            continue
        each = struct.calcsize(order + letter) * (2 if kind in _RATIONAL else 1)
        size = each * number
        if size > MAX_VALUE:
            continue  # a preview, a maker note
        if size <= 4:
            raw = entry[8 : 8 + size]
        else:
            raw = read(struct.unpack(order + "I", entry[8:])[0], size)
        found.append((tag, _value(raw, order, kind, letter, number)))
    return found


def _value(raw: bytes, order: str, kind: int, letter: str, number: int) -> ExifValue:
    if letter == "s":
        return raw.split(b"\0")[0].decode("utf-8", "replace").strip() if kind == 2 else raw.decode("utf-8", "replace")
    if kind in _RATIONAL:
        parts = struct.unpack(f"{order}{2 * number}{letter}", raw)
        # A denominator of zero is how cameras say that they do not know.
        return tuple(a / b if b else float("nan") for a, b in zip(parts[::2], parts[1::2]))
    return tuple(float(v) for v in struct.unpack(f"{order}{number}{letter}", raw))


IMAGE_SUFFIXES = (".jpg", ".jpeg", ".tif", ".tiff")
#: From north, east, down to east, north, up.
_R_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
#: Columns: camera x (right), y (up) and z (backwards) in the gimbal's axes forwards, right, down.
_R_GIMBAL_CAMERA = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def rotation_from_gimbal(yaw_pitch_roll: ArrayLike) -> Floats:
    """R_enu_camera (3, 3): camera axes to east, north, up, of yaw, pitch and roll in degrees."""
    # About z by yaw, then y by pitch, then x by roll: the order that is spelled kappa, phi, omega.
    R_ned_gimbal = rotation_from_angles(np.radians(np.asarray(yaw_pitch_roll, float)), "kpo")
    return np.asarray(_R_ENU_NED @ R_ned_gimbal @ _R_GIMBAL_CAMERA, np.float64)


def image_files(path: Path) -> list[Path]:
    """JPEG and TIFF images of a folder by name, or the one file."""
    if not path.is_dir():
        return [path]
    files = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES and p.is_file())
    if not files:
        raise InputError(f"{path}: the folder holds no image ({', '.join(IMAGE_SUFFIXES)})")
    return files


@dataclass(frozen=True)
class ImageFolder:
    """Images of a folder, or one image, by what they state."""

    placed: tuple[ImageMetadata, ...]
    """Images that state a position."""
    count: int
    """All images."""
    notes: tuple[str, ...]
    """Images that were left out, or parts of their metadata that are damaged."""


def read_image_folder(path: Path) -> ImageFolder:
    """Metadata of the images of a folder, or of one image."""
    files, found, unread = image_files(path), [], []
    for file in files:
        try:
            found.append(read_image_metadata(file))
        except InputError as error:
            if len(files) == 1:
                raise
            unread.append(str(error).removeprefix(f"{path}/"))
    notes = []
    unfixed = tuple(m.file.name for m in found if m.no_fix)
    damaged = tuple(f"{m.file.name}: {fault}" for m in found for fault in m.faults)
    lost = sum(m.position is None and not m.no_fix and not m.faults for m in found)
    elsewhere = {m.file: m.datum for m in found if m.position is not None and m.datum and not _is_wgs84(m.datum)}
    of_other = tuple(f"{file.name}: datum {datum}" for file, datum in elsewhere.items())
    for many, what in (
        (unread, "cannot be used and are left out"),
        (damaged, "have damaged metadata, which are left out"),
        (of_other, "refer to another datum than WGS 84 and are left out"),
    ):
        if many:
            notes.append(f"{path.name}: {len(many)} of {len(files)} images {what}: {listed(many)}")
    if unfixed:
        notes.append(f"{path.name}: {without_fix(unfixed)}; left out")
    if lost:
        notes.append(f"{path.name}: {lost} images state no position; left out")
    stated = tuple(m for m in found if m.position is not None and m.file not in elsewhere)
    if not stated:
        raise InputError(
            "; ".join([f"{path}: no image states a GPS position (latitude, longitude and altitude)", *notes])
        )
    return ImageFolder(stated, len(files), tuple(notes))


def _is_wgs84(datum: str) -> bool:
    return datum.upper().replace(" ", "").replace("-", "").startswith("WGS84")


def listed(texts: Sequence[str]) -> str:
    """The first texts of many."""
    return "; ".join(texts[:3]) + (" …" if len(texts) > 3 else "")


def without_fix(names: Sequence[str]) -> str:
    """A note on images that state latitude and longitude 0."""
    states = "1 image states" if len(names) == 1 else f"{len(names)} images state"
    some = ", ".join(names[:3]) + (" …" if len(names) > 3 else "")
    return f"{states} latitude 0 and longitude 0, which receivers write without a position: {some}"


def map_positions(images: Sequence[ImageMetadata], crs: str) -> Floats:
    """Positions in a projected CRS, shape (n, 3): map coordinates, and the height as the images state it."""
    places = np.array([m.position for m in images], float).reshape(-1, 3)
    step = crs_step("EPSG:4326", crs)
    step = step.near(places[0, [1, 0]]) if len(places) else step
    return np.column_stack([step(places[:, [1, 0]]), places[:, 2]])


def read_drone_images(path: Path, form: TableFormat) -> OrientationBlock:
    """Approximate orientations of a folder of drone images, or of one; `form` is not used."""
    folder = read_image_folder(path)
    stated = folder.placed
    oriented = [m for m in stated if m.yaw_pitch_roll is not None and m.position is not None]
    if not oriented:
        raise InputError(
            f"{path}: {len(stated)} images state a position and none an attitude (gimbal angles in XMP); give the "
            "folder as positions in [observations] instead"
        )
    origin, enu, axes = enu_poses(np.array([m.position for m in oriented], float))
    # One camera needs no name: that of the camera file may be any.
    several = len({m.camera for m in oriented}) > 1
    images = tuple(
        posed(m.file.name, at, R @ rotation_from_gimbal(m.yaw_pitch_roll or (0, 0, 0)), m.camera if several else None)
        for m, at, R in zip(oriented, enu, axes)
    )
    notes, lost = list(folder.notes), len(stated) - len(oriented)
    notes += [f"{path.name}: {lost} images state no attitude; left out"] if lost else []
    turned = sum(m.display != 1 for m in oriented)
    if turned:
        notes.append(
            f"{path.name}: EXIF turns {turned} images for display; angles are those of the pixels as stored, so images "
            "that another program has turned need its angle"
        )
    notes.append(
        "positions and gimbal angles of drones are approximate: metres, degrees, and heights in a system of their own"
    )
    sizes = {m.file.name: m.size for m in oriented if m.size is not None}
    named = {m.file.name: m.file.name if path.is_dir() else str(m.file) for m in oriented}
    return OrientationBlock(OrientationTable(path, images, origin=origin, notes=tuple(notes)), files=named, sizes=sizes)


def _sniff_images(path: Path, head: str) -> bool:
    if path.is_dir():
        return any(p.suffix.lower() in IMAGE_SUFFIXES for p in path.iterdir())
    return path.suffix.lower() in IMAGE_SUFFIXES


EXIF = OrientationFormat("exif", "positions and attitudes in drone images", _sniff_images, read_drone_images)
