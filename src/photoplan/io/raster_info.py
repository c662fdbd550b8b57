"""Figures of a raster: size, type, georeference, colour tables, how an image is stored."""

from __future__ import annotations

import math
import re
import struct
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import rasterio
import rasterio.enums
from numpy.typing import NDArray

from photoplan.arrays import Mask
from photoplan.errors import InputError, UsageError
from photoplan.geometry.crs import crs_label, same_crs, split_compound
from photoplan.geometry.grid import Placement
from photoplan.geometry.units import known_metres, metric_heights
from photoplan.io.disk import GDAL_ERRORS, first_cause, gdal_settings, open_raster, warnings_of_gdal
from photoplan.io.files import (
    IMAGE_LIMITS,
    RasterLimits,
    check_declared_size,
    check_plain_file,
    check_sidecars,
    crs_beside,
    raster_driver,
)

_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_CODES = {1: "u1", 3: "u2", 4: "u4", 13: "u4", 16: "u8", 18: "u8"}
_MAX_TAGS = 4096

_WIDTH, _HEIGHT, _BITS, _COMPRESSION, _PHOTOMETRIC, _ORIENTATION = 256, 257, 258, 259, 262, 274
_STRIP_OFFSETS, _SAMPLES, _ROWS, _STRIP_COUNTS, _PLANAR, _PREDICTOR = 273, 277, 278, 279, 284, 317
_TILE_WIDTH, _TILE_HEIGHT, _TILE_OFFSETS, _TILE_COUNTS = 322, 323, 324, 325


@dataclass(frozen=True)
class TiffArray:
    """Where an array of the directory stands in the file."""

    position: int
    """Byte of its first element."""
    dtype: str
    """NumPy type of its elements, with byte order."""
    count: int
    """Number of elements."""


@dataclass(frozen=True, eq=False)
class TiffLayout:
    """The first directory of a TIFF."""

    size: tuple[int, int]
    """Width and height in pixels."""
    samples: int
    """Samples per pixel."""
    bits: int
    """Bits per sample."""
    compression: int
    """Code of the compression; 1 = none."""
    predictor: int
    """1 = none, 2 = differences of neighbours, 3 = differences of the bytes of floats."""
    photometric: int
    """Code of the photometric interpretation: 0 white is zero, 5 CMYK, 8 CIELab …"""
    orientation: int
    """1 to 8 as in EXIF; 1 = as stored."""
    planar: bool
    """True: one plane of blocks per sample."""
    block: tuple[int, int]
    """Width and height of a block."""
    offsets: NDArray[np.uint64]
    """First byte of every block; 0 = never written."""
    counts: NDArray[np.uint64]
    """Stored bytes of every block; 0 = never written."""
    offsets_array: TiffArray
    """Where `offsets` stands in the file."""
    counts_array: TiffArray
    """Where `counts` stands in the file."""
    directory: int
    """Byte at which the first directory begins."""

    @property
    def grid(self) -> tuple[int, int]:
        """Blocks across and down."""
        return -(-self.size[0] // self.block[0]), -(-self.size[1] // self.block[1])

    @property
    def present(self) -> Mask:
        """Which blocks are stored, shape (planes, rows, columns) of blocks."""
        across, down = self.grid
        return ((self.counts > 0) & (self.offsets > 0)).reshape(-1, down, across)

    @property
    def ratio(self) -> float:
        """Decoded bytes per stored byte over the stored blocks; 0 if none is stored."""
        present = self.present.ravel()
        stored = float(self.counts[present].sum(dtype=np.float64))
        per_block = self.block[0] * self.block[1] * self.bits / 8 * (1 if self.planar else self.samples)
        return float(present.sum()) * per_block / stored if stored else 0.0


def read_tiff_layout(path: Path) -> TiffLayout:
    """Read the first directory of a TIFF or BigTIFF."""
    return read_tiff_layouts(path, most=1)[0]


def read_tiff_layouts(path: Path, most: int = 64) -> list[TiffLayout]:
    """Read the directories of a TIFF or BigTIFF in the order of their chain: image, overviews, masks."""
    file_size = path.stat().st_size
    try:
        with path.open("rb") as file:
            layouts: list[TiffLayout] = []
            start = None
            while start != 0 and len(layouts) < most:
                directory = _Directory(file, file_size, start)
                layouts.append(_layout(directory, file_size))
                start = directory.next
            return layouts
    except (struct.error, ValueError, KeyError, OverflowError, IndexError) as error:
        raise InputError(
            f"{path}: the TIFF directory is damaged or cut off ({error}); the file has {file_size} bytes. "
            "Get a fresh copy"
        ) from error
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error


class _Directory:
    """Tags of a directory: code -> (type, count, position of the values); the first one without `start`."""

    def __init__(self, file: BinaryIO, file_size: int, start: int | None = None) -> None:
        self._file, self._file_size = file, file_size
        head = self._at(0, 16)
        self.order = {b"II": "<", b"MM": ">"}[head[:2]]
        version = struct.unpack(self.order + "H", head[2:4])[0]
        self.big = version == 43
        if version not in (42, 43):
            raise ValueError(f"version {version}")
        self.start = struct.unpack(self.order + ("Q" if self.big else "I"), head[8:16] if self.big else head[4:8])[0]
        if start is not None:
            self.start = start
        number_size, entry = (8, 20) if self.big else (2, 12)
        number = struct.unpack(self.order + ("Q" if self.big else "H"), self._at(self.start, number_size))[0]
        if not 0 < number <= _MAX_TAGS:
            raise ValueError(f"{number} tags")
        block = self._at(self.start + number_size, number * entry)
        link = self._at(self.start + number_size + number * entry, 8 if self.big else 4)
        self.next = struct.unpack(self.order + ("Q" if self.big else "I"), link)[0]
        self.tags: dict[int, tuple[int, int, int]] = {}
        for i in range(number):
            code, kind, count = struct.unpack_from(self.order + ("HHQ" if self.big else "HHI"), block, i * entry)
            inline = 8 if self.big else 4
            position = self.start + number_size + (i + 1) * entry - inline
            if _SIZES.get(kind, 1) * count > inline:
                raw = block[(i + 1) * entry - inline : (i + 1) * entry]
                position = struct.unpack(self.order + ("Q" if self.big else "I"), raw)[0]
            self.tags.setdefault(code, (kind, count, position))

    def _at(self, position: int, count: int) -> bytes:
        if position + count > self._file_size:
            raise ValueError(f"bytes {position} to {position + count} are wanted")
        self._file.seek(position)
        return self._file.read(count)

    def where(self, code: int) -> TiffArray:
        """Place of an array of unsigned numbers."""
        kind, count, position = self.tags[code]
        return TiffArray(position, self.order + _CODES[kind], count)

    def array(self, code: int) -> NDArray[np.uint64]:
        """All values of a tag of unsigned numbers."""
        place = self.where(code)
        raw = self._at(place.position, place.count * np.dtype(place.dtype).itemsize)
        return np.frombuffer(raw, place.dtype).astype(np.uint64)

    def one(self, code: int, default: int | None = None) -> int:
        """First value of a tag."""
        if code not in self.tags and default is not None:
            return default
        kind, _, position = self.tags[code]
        dtype = np.dtype(self.order + _CODES[kind])
        return int(np.frombuffer(self._at(position, dtype.itemsize), dtype)[0])


def _layout(tags: _Directory, file_size: int) -> TiffLayout:
    """Put the tags together and check them against each other and the file's length."""
    width, height = tags.one(_WIDTH), tags.one(_HEIGHT)
    samples, planar = tags.one(_SAMPLES, 1), tags.one(_PLANAR, 1) == 2
    tiled = _TILE_OFFSETS in tags.tags
    if tiled:
        block = tags.one(_TILE_WIDTH), tags.one(_TILE_HEIGHT)
    else:
        block = width, min(tags.one(_ROWS, 2**32 - 1), height)
    if min(width, height, samples, *block) < 1:
        raise ValueError(f"{width} × {height} pixels in blocks of {block[0]} × {block[1]}")
    codes = (_TILE_OFFSETS, _TILE_COUNTS) if tiled else (_STRIP_OFFSETS, _STRIP_COUNTS)
    needed = -(-width // block[0]) * -(-height // block[1]) * (samples if planar else 1)
    places = tags.where(codes[0]), tags.where(codes[1])
    if any(place.count != needed for place in places):
        raise ValueError(f"{places[0].count} blocks are listed where {needed} are needed")
    offsets, counts = tags.array(codes[0]), tags.array(codes[1])
    beyond = np.flatnonzero((counts > 0) & (offsets > 0) & (offsets.astype(float) + counts.astype(float) > file_size))
    if beyond.size:
        first = int(beyond[0])
        across, down = -(-width // block[0]), -(-height // block[1])
        row, col = divmod(first % (across * down), across)
        raise ValueError(
            f"{beyond.size} of {needed} blocks lie beyond its end, the first is band "
            f"{first // (across * down) + 1 if planar else 'all'}, window col {col * block[0]} row {row * block[1]} "
            f"{block[0]} × {block[1]}"
        )
    return TiffLayout(
        size=(width, height),
        samples=samples,
        bits=tags.one(_BITS, 1),
        compression=tags.one(_COMPRESSION, 1),
        predictor=tags.one(_PREDICTOR, 1),
        photometric=tags.one(_PHOTOMETRIC, 1),
        orientation=tags.one(_ORIENTATION, 1),
        planar=planar,
        block=block,
        offsets=offsets,
        counts=counts,
        offsets_array=places[0],
        counts_array=places[1],
        directory=tags.start,
    )


def check_png_complete(path: Path) -> None:
    """Follow the chunks to the end chunk; the decoder itself would deliver a cut-off picture without a word."""
    size = path.stat().st_size
    with path.open("rb") as file:
        position = 8
        while position + 12 <= size:
            file.seek(position)
            length, kind = struct.unpack(">I4s", file.read(8))
            position += 12 + length
            if kind == b"IEND" and position <= size:
                return
    raise InputError(f"{path}: the PNG is cut off (its end chunk is missing, {size} bytes); get a fresh copy")


@dataclass(frozen=True)
class RasterInfo:
    """What a raster file states about itself."""

    path: Path
    """The file."""
    driver: str
    """GDAL's name of the format."""
    size: tuple[int, int]
    """Width and height in pixels."""
    dtype: str
    """NumPy name of the pixels' type."""
    colour_bands: tuple[int, ...]
    """Numbers (from 1) of the bands without alpha."""
    alpha_bands: tuple[int, ...]
    """Numbers (from 1) of the alpha bands."""
    colours: tuple[str, ...]
    """Colour interpretation of every band, as GDAL names it."""
    colour_space: str | None
    """Colour space of the stored data where it differs from the bands' (JPEG: `YCbCr`, `CMYK`, `YCCK`)."""
    bits: int
    """Bits per sample as stored."""
    nodata: float | None
    """Value that means "nothing here"; may be NaN."""
    has_mask: bool
    """A mask band inside the file, or a `.msk` file beside it."""
    missing_blocks: int
    """Blocks that were never written (sparse TIFF)."""
    block: tuple[int, int]
    """Width and height of a stored block."""
    overviews: tuple[int, ...]
    """Reduction factors of the overviews."""
    crs: str | None
    """Coordinate reference system as WKT."""
    to_map: tuple[float, float, float, float, float, float] | None
    """(X0, Xx, Xy, Y0, Yx, Yy): X = X0 + Xx x + Xy y, Y = Y0 + Yx x + Yy y, where (x, y) = (column, row) refer to
    pixel **centres**. None if the file is not georeferenced."""
    band_unit: str | None
    """Unit of the values as the bands state it."""
    scales: tuple[float, ...]
    """Factor of every band from stored to true values."""
    offsets: tuple[float, ...]
    """Offset of every band from stored to true values."""
    white_is_zero: bool
    """Grey values are stored inverted (TIFF photometric interpretation 0)."""
    colour_despite_tag: tuple[int, ...] = field(default=(), kw_only=True)
    """Numbers (from 1) of the bands that are tagged as alpha and hold a picture: they count as colour bands."""
    contradiction: str | None = field(default=None, kw_only=True)
    """What the tags and a file beside them state differently of the raster's place; None: nothing."""
    orientation: int
    """Orientation of EXIF or TIFF, 1 to 8. Pixels are used as they are stored, whatever it says: the camera's
    geometry refers to the sensor."""

    @property
    def bands(self) -> int:
        """Bands without alpha; a palette counts as the three colours that it stands for."""
        return 3 if self.palette else len(self.colour_bands)

    @property
    def palette(self) -> bool:
        """The only band holds indices into a colour table."""
        return len(self.colour_bands) == 1 and self.colours[self.colour_bands[0] - 1] == "palette"

    @property
    def height_system(self) -> str | None:
        """What the reference system states of heights: a vertical CRS, `ellipsoidal` for a three-dimensional one."""
        return None if self.crs is None else split_compound(self.crs)[1]

    @property
    def metres_per_unit(self) -> float | None:
        """Metres in the unit that the bands or the vertical reference system state; None: none is, or it is unknown."""
        if self.band_unit is not None:
            return known_metres(self.band_unit)
        return None if self.height_system is None else abs(metric_heights(self.height_system)[1])

    @property
    def warnings(self) -> tuple[str, ...]:
        """What a user should know before these pixels are used, one sentence each."""
        found = []
        if self.orientation != 1:
            found.append(
                f"{self.path.name}: the orientation tag says {self.orientation} (a viewer turns the picture); pixels "
                "are used as stored, because the camera's geometry refers to the sensor"
            )
        if self.white_is_zero:
            found.append(f"{self.path.name}: white is stored as zero; grey values are used as stored")
        if self.contradiction is not None:
            found.append(f"{self.path.name}: {self.contradiction}")
        for band in self.colour_despite_tag:
            found.append(
                f"{self.path.name}: band {band} is tagged as alpha but holds a picture, so it is used as a colour "
                "band; if it is a mask, set `alpha = true` in [[images]]"
            )
        if self.missing_blocks and self.nodata is None:
            found.append(f"{self.path.name}: {self.missing_blocks} blocks were never written; they count as invalid")
        return tuple(found)


def read_info(path: str | Path, *, limits: RasterLimits = IMAGE_LIMITS, allow_remote: bool = False) -> RasterInfo:
    """Read the facts of a raster from its header, and refuse a file that cannot be what it says."""
    if allow_remote and not Path(path).is_file():
        return _describe(Path(path), None, None, limits)
    plain = check_plain_file(path)
    driver = None
    layout = None
    try:
        driver = raster_driver(plain)
    except InputError:
        if not allow_remote:
            raise
    check_sidecars(plain)
    if driver == "GTiff":
        layout = read_tiff_layout(plain)
        _check_layout(plain, layout, limits)
    elif driver == "PNG":
        check_png_complete(plain)
    return _describe(plain, driver, layout, limits)


def _check_layout(path: Path, layout: TiffLayout, limits: RasterLimits) -> None:
    """Compare a TIFF's promises with its blocks, before GDAL sees it."""
    check_declared_size(
        path,
        limits,
        size=layout.size,
        pixel_bytes=-(-layout.bits * layout.samples // 8),
        # Plain strips are read line by line, however many lines one strip has.
        block=(layout.block[0], 1) if layout.compression == 1 and layout.block[0] == layout.size[0] else layout.block,
        stored=layout.ratio,
    )


def _describe(path: Path, driver: str | None, layout: TiffLayout | None, limits: RasterLimits) -> RasterInfo:
    """Open a raster and put its facts together."""
    with warnings_of_gdal():
        dataset = open_raster(path, driver)
    with dataset, gdal_settings():
        if dataset.count < 1:
            raise InputError(f"{path}: holds no bands of pixels; give one of its parts as a plain file")
        if dataset.tags(ns="OVERVIEWS"):
            raise InputError(f"{path}: its metadata lead to other files, which are not followed; make a plain copy")
        if len(set(dataset.dtypes)) > 1:
            raise InputError(f"{path}: bands of different types ({', '.join(dataset.dtypes)}); make them one type")
        if layout is None and driver is not None:
            pixel_bytes = dataset.count * np.dtype(dataset.dtypes[0]).itemsize
            check_declared_size(
                path,
                limits,
                size=(dataset.width, dataset.height),
                pixel_bytes=pixel_bytes,
                block=dataset.block_shapes[0][::-1],
                stored=float(dataset.width * dataset.height * pixel_bytes) / path.stat().st_size,
            )
        try:
            return _facts(path, dataset, layout)
        except GDAL_ERRORS as error:
            # Also of what stands beside it: GDAL reads `NAME_RPC.TXT` and others of its own accord.
            raise InputError(
                f"{path}: its metadata, or those of a file beside it, cannot be read ({first_cause(error)}); mend or "
                "remove that file"
            ) from error


def _facts(path: Path, dataset: Any, layout: TiffLayout | None) -> RasterInfo:
    """The facts of an open dataset."""
    colours = tuple(c.name for c in dataset.colorinterp)
    alpha = tuple(i + 1 for i, name in enumerate(colours) if name == "alpha")
    wkt = dataset.crs.to_wkt() if dataset.crs else None
    if wkt is not None and split_compound(wkt, f"{path}: CRS")[0] is None:
        wkt = None
    orientation = dataset.tags().get("EXIF_Orientation") or dataset.tags(ns="EXIF").get("EXIF_Orientation")
    bits = dataset.tags(1, ns="IMAGE_STRUCTURE").get("NBITS")
    return RasterInfo(
        path=path,
        driver=dataset.driver,
        size=(dataset.width, dataset.height),
        dtype=dataset.dtypes[0],
        colour_bands=tuple(i for i in dataset.indexes if i not in alpha),
        alpha_bands=alpha,
        colours=colours,
        colour_space=dataset.tags(ns="IMAGE_STRUCTURE").get("SOURCE_COLOR_SPACE"),
        bits=int(bits) if bits else (layout.bits if layout else np.dtype(_known(dataset.dtypes[0])).itemsize * 8),
        nodata=_nodata(path, dataset, alpha),
        has_mask=_has_mask(dataset),
        missing_blocks=int((~layout.present).sum()) if layout else 0,
        block=dataset.block_shapes[0][::-1],
        overviews=tuple(dataset.overviews(1)),
        crs=wkt,
        contradiction=_contradiction(path, dataset, wkt),
        to_map=_centre_transform(dataset),
        band_unit=next((u.strip() for u in dataset.units if u and u.strip()), None),
        scales=tuple(dataset.scales),
        offsets=tuple(dataset.offsets),
        white_is_zero=layout is not None and layout.photometric == 0,
        orientation=layout.orientation if layout else int(orientation or 1),
    )


def _known(dtype: str) -> str:
    """A type that NumPy knows; GDAL has a complex 16-bit integer of its own."""
    return "complex64" if dtype == "complex_int16" else dtype


def _nodata(path: Path, dataset: Any, alpha: tuple[int, ...]) -> float | None:
    """The one nodata value of all bands; alpha bands do not count."""
    values = [value for i, value in zip(dataset.indexes, dataset.nodatavals) if i not in alpha and value is not None]
    if not values:
        return None
    if any(v != values[0] and not (np.isnan(v) and np.isnan(values[0])) for v in values):
        raise InputError(f"{path}: bands with different nodata values {values}; give them one value")
    return float(values[0])


def _has_mask(dataset: Any) -> bool:
    """Whether a mask band or file says which pixels are valid (alpha and nodata are looked at by themselves)."""
    for flags in dataset.mask_flag_enums:
        names = {flag.name for flag in flags}
        if not names or ("per_dataset" in names and "alpha" not in names):
            return True
    return False


#: Places that differ by less than this, pixels, are printed with different digits.
_SAME_PLACE = 0.1


def _contradiction(path: Path, dataset: Any, crs: str | None) -> str | None:
    """What a world file, `.prj` or `.aux.xml` beside a TIFF states otherwise than its tags; GDAL takes one of them."""
    names = {"WORLDFILE": [path.with_suffix(s) for s in (".tfw", ".TFW", ".tifw", ".wld", ".tiffw")],
             "PAM": [path.with_name(f"{path.name}.aux.xml")], "PRJ": [path.with_suffix(s) for s in (".prj", ".PRJ")],
             "INTERNAL": [path]}  # fmt: skip
    beside = {source: next((f for f in files if f.is_file()), None) for source, files in names.items()}
    if dataset.driver != "GTiff" or sum(file is not None for file in beside.values()) < 2:
        return None
    width, height = dataset.width, dataset.height
    places: list[tuple[Path, str, Any]] = []
    systems: list[tuple[Path, str]] = []
    for source, file in beside.items():
        if file is None:
            continue
        if source == "PRJ":
            with suppress(InputError):  # a file of another program, which GDAL does not read either
                stated = None if crs is None else crs_beside(path)
                systems += [] if stated is None else [(stated.file, stated.crs)]
            continue
        with open_raster(path, "GTiff", GEOREF_SOURCES=source) as alone:
            t = alone.transform
            if not t.is_identity:
                said = f"the first pixel's corner at X {t.c:.10g}, Y {t.f:.10g} and pixels of {t.a:.6g} × {t.e:.6g}"
                places.append((file, said, t))
            wkt = alone.crs.to_wkt() if alone.crs and source != "WORLDFILE" else None
            horizontal = None if wkt is None else split_compound(wkt, f"{file}: CRS")[0]
            systems += [] if horizontal is None else [(file, horizontal)]
    for file, said, t in places[1:]:
        corners = [(~places[0][2] @ t) @ corner for corner in ((0, 0), (width, 0), (0, height), (width, height))]
        if np.abs(np.array(corners) - [(0, 0), (width, 0), (0, height), (width, height)]).max() > _SAME_PLACE:
            return f"{places[0][0].name} states {places[0][1]}, {file.name} states {said}; remove what is wrong"
    for file, system in systems[1:]:
        if not same_crs(systems[0][1], system):
            labels = [f"{name.name} states {crs_label(text)}" for name, text in (systems[0], (file, system))]
            return f"{', '.join(labels)}; remove what is wrong"
    return None


def _centre_transform(dataset: Any) -> tuple[float, float, float, float, float, float] | None:
    """GDAL's geotransform, which refers to pixel corners, moved to pixel centres.

    GDAL has already moved files whose tags refer to pixel centres (`AREA_OR_POINT=Point`) to corners.
    """
    t = dataset.transform
    if t.is_identity:
        return None
    return (t.c + 0.5 * (t.a + t.b), t.a, t.b, t.f + 0.5 * (t.d + t.e), t.d, t.e)


_INCH = 25.4
#: Millimetres that a resolution tag counts pixels in: 2 is the inch, 3 the centimetre (TIFF 6.0, EXIF 2.3).
_UNITS = {"2": _INCH, "3": 10.0}
_NAMES = (
    ("TIFFTAG_XRESOLUTION", "TIFFTAG_YRESOLUTION", "TIFFTAG_RESOLUTIONUNIT"),
    ("EXIF_XResolution", "EXIF_YResolution", "EXIF_ResolutionUnit"),
)


def read_pitch(path: Path) -> tuple[float, float] | None:
    """Distance of two columns and of two rows in millimetres, from the resolution tags of a TIFF, JPEG or EXIF header.

    None where the file states none, or states it without a unit.
    """
    info = read_info(path)
    with open_raster(info.path, info.driver) as file:
        tags: dict[str, Any] = file.tags()
    for x, y, unit in _NAMES:
        length = _UNITS.get(str(tags.get(unit, "2")).strip()[:1])
        per = [_number(tags.get(name)) for name in (x, y)]
        if length and per[0] and per[1]:
            return length / per[0], length / per[1]
    return _jfif(info.path) if info.driver == "JPEG" else None


def _jfif(path: Path) -> tuple[float, float] | None:
    """Density in a JFIF header (ITU-T T.871, 10.1): unit 1 is the inch, 2 the centimetre, 0 states a ratio only."""
    with path.open("rb") as file:
        head = file.read(18)
    if len(head) < 18 or head[:4] != b"\xff\xd8\xff\xe0" or head[6:11] != b"JFIF\0":
        return None
    length = {1: _INCH, 2: 10.0}.get(head[13])
    across, down = struct.unpack(">HH", head[14:18])
    return (length / across, length / down) if length and across and down else None


def parse_pitch(text: str) -> tuple[float, float]:
    """Distance of two columns and of two rows in millimetres, from ``1200dpi``, ``21um`` or ``21,20.8um``."""
    match = re.fullmatch(r"\s*([\d.]+)(?:\s*,\s*([\d.]+))?\s*(dpi|um|µm|μm)\s*", text, re.IGNORECASE)
    numbers = [_number(match[k] or match[1]) for k in (1, 2)] if match else [None]
    if match is None or None in numbers:
        raise UsageError(f"scan resolution {text!r}; write for example 1200dpi or 21um, or 21,20.8um for columns, rows")
    first, second = (_INCH / v if match[3].lower() == "dpi" else v / 1000 for v in numbers if v)
    return first, second


def _number(text: Any) -> float | None:
    """A positive number; EXIF values stand in brackets."""
    try:
        value = float(str(text).strip().strip("()"))
    except ValueError:
        return None
    return value if math.isfinite(value) and value > 0 else None


#: Metadata that are not true of a copy, or are written by its maker.
_NOT_KEPT = ("AREA_OR_POINT", "PHOTOPLAN_", "TIFFTAG_SOFTWARE", "TIFFTAG_MINSAMPLEVALUE", "TIFFTAG_MAXSAMPLEVALUE",
             "OVR_RESAMPLING_ALG", "LAYOUT", "STATISTICS_")  # fmt: skip
_MOST_TAGS, _LONGEST, _LONGEST_XMP = 1000, 20_000, 4_000_000
_XMP = "xml:XMP"


@dataclass(frozen=True)
class ImageForm:
    """The form of an image, without its pixels."""

    colours: tuple[str, ...] = ()
    """Colour interpretation of every band, as GDAL names it; empty: by their number."""
    descriptions: tuple[str | None, ...] = ()
    """Name of every band."""
    tags: tuple[tuple[str, str], ...] = ()
    """Metadata, such as resolution and date of a scan, or what a camera wrote into EXIF."""
    xmp: str | None = None
    """Packet of XMP."""
    units: tuple[str, ...] = ()
    """Unit of every band."""
    offsets: tuple[float, ...] = ()
    """What readers add to the stored values of every band."""

    @property
    def photometric(self) -> str | None:
        """TIFF's word for the colours; None: by their number."""
        if not self.colours:
            return None
        return "RGB" if self.colours[:3] == ("red", "green", "blue") else "MINISBLACK"


def placement_of(info: RasterInfo) -> Placement:
    """Where a file that `read_info` has checked lies."""
    if info.to_map is None:
        return Placement(info.size, crs=info.crs)
    x0, xx, xy, y0, yx, yy = info.to_map
    try:
        return Placement(info.size, (xx, xy, x0 - (xx + xy) / 2, yx, yy, y0 - (yx + yy) / 2), info.crs)
    except UsageError as error:
        raise InputError(f"{info.path}: {error}") from None


def form_of(info: RasterInfo) -> ImageForm:
    """The form of a file that `read_info` has checked; a palette counts as the three colours that it stands for."""
    with open_raster(info.path, info.driver) as file, gdal_settings():
        tags: dict[str, Any] = file.tags()
        packet = file.tags(ns=_XMP).get(_XMP)
        names = tuple(file.descriptions[band - 1] for band in info.colour_bands)
    kept = {
        str(name): str(value)
        for name, value in sorted(tags.items())
        if not str(name).startswith(_NOT_KEPT) and len(str(value)) <= _LONGEST
    }
    _add_pitch(info, kept)
    colours = ("red", "green", "blue") if info.palette else tuple(info.colours[b - 1] for b in info.colour_bands)
    xmp = packet if packet and "=" in packet and len(packet) <= _LONGEST_XMP else None
    return ImageForm(colours, () if info.palette else names, tuple(kept.items())[:_MOST_TAGS], xmp)


def bands_of(info: RasterInfo) -> ImageForm:
    """What holds for a product of an image too: colours and names of its bands."""
    form = form_of(info)
    return ImageForm(form.colours, form.descriptions)


def _add_pitch(info: RasterInfo, tags: dict[str, str]) -> None:
    """State the resolution of a scan as a TIFF does."""
    unit = tags.get("TIFFTAG_RESOLUTIONUNIT")
    if unit is not None:
        tags["TIFFTAG_RESOLUTIONUNIT"] = unit.strip()[:1]
        return
    pitch = read_pitch(info.path)
    if pitch is not None:
        tags["TIFFTAG_XRESOLUTION"], tags["TIFFTAG_YRESOLUTION"] = (f"{25.4 / side:.9g}" for side in pitch)
        tags["TIFFTAG_RESOLUTIONUNIT"] = "2"


def dress(dataset: Any, form: ImageForm) -> None:
    """Give a raster that is open for writing the form of another; what GDAL does not take is left out."""
    if form.descriptions:
        dataset.descriptions = form.descriptions
    if form.units:
        dataset.units = form.units
    if form.offsets:
        dataset.offsets = form.offsets
    if form.colours:
        known = {each.name: each for each in rasterio.enums.ColorInterp}
        dataset.colorinterp = [known.get(name, known["undefined"]) for name in form.colours]
    dataset.update_tags(**dict(form.tags))
    if form.xmp is not None:
        # rasterio joins name and value by "=", also where the packet as a whole is the value.
        head, _, rest = form.xmp.partition("=")
        try:
            dataset.update_tags(ns=_XMP, **{head: rest})
        except GDAL_ERRORS:
            return
