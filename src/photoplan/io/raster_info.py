"""Facts of a raster file, read from its header."""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from photoplan.errors import InputError
from photoplan.geometry.crs import crs_label, same_crs, split_compound
from photoplan.geometry.units import known_metres, metric_heights
from photoplan.io.checks import (
    IMAGE_LIMITS,
    RasterLimits,
    check_declared_size,
    check_plain_file,
    check_sidecars,
    raster_driver,
)
from photoplan.io.gdal import GDAL_ERRORS, first_cause, gdal_settings, open_raster, warnings_of_gdal
from photoplan.io.plain_files import crs_beside
from photoplan.io.tiff_layout import TiffLayout, read_tiff_layout


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
