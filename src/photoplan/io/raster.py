"""Source images, read by windows from several threads; much coarser products from overviews, where they hold means."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np
import rasterio.io
import rasterio.shutil
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import FullSize, Pixels, level_size, means, reduced
from photoplan.io.block_cache import BlockCache
from photoplan.io.checks import IMAGE_LIMITS, RasterLimits
from photoplan.io.gdal import gdal_settings, handle, not_georeferenced
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.io.raster_pixels import both, missing_blocks, read_pixels
from photoplan.io.tiff_layout import read_tiff_layout
from photoplan.io.validity import MissingBlocks, refuse_undeclared

IMAGE_TYPES = ("uint8", "uint16", "int16", "float32")
"""Types of the pixels of source images."""

_NOT_RGB = (5, 8, 9, 10)
"""TIFF photometric interpretations: CMYK and the kinds of CIELab."""
_SIDE = 256
"""Of a block of a reduced image. Each is made once: tiles of a coarse product overlap in the source."""
_blocks = BlockCache(48 << 20)


def reduced_by_blocks(key: Hashable, reader: FullSize, window: Window, level: int) -> Pixels:
    """A window of an image that is reduced by 2^level, see `geometry.levels.reduced`."""
    if level == 0:
        return reader.read(window)
    whole = Window(0, 0, *level_size(reader.size, level))
    values = np.empty((reader.bands, window.height, window.width), reader.dtype)
    valid = np.ones((window.height, window.width), bool)
    for row in range(window.row // _SIDE, -(-window.stop[1] // _SIDE)):
        for col in range(window.col // _SIDE, -(-window.stop[0] // _SIDE)):
            block = Window(col * _SIDE, row * _SIDE, _SIDE, _SIDE) & whole

            def load(block: Window = block) -> np.ndarray:
                pixels, good = reduced(reader, block, level)
                # The validity travels as one band more.
                return pixels if good is None else np.concatenate([pixels, good[None].astype(pixels.dtype)])

            kept = _blocks.get((key, level, block), load)
            part = block & window
            to, of = part.slices(window), part.slices(block)
            values[:, to[0], to[1]] = kept[: reader.bands, of[0], of[1]]
            if len(kept) > reader.bands:
                valid[to] = kept[-1][of] > 0
    return values, None if valid.all() else valid


@dataclass(frozen=True, eq=False)
class RasterReader:
    """A source image behind the engine's `Reader`; any side length, read by windows only.

    Safe to call from several threads (each has its own handle) and to pickle. Pixels keep their type and are used as
    they are stored; a palette is expanded to its three colours. See `photoplan.io.validity` for the rule of validity. A
    band that is tagged as alpha is a colour band if its values are those of a picture, see `with_alpha_judged`.
    """

    path: Path
    """The file."""
    limits: RasterLimits = IMAGE_LIMITS
    """How much its header may promise."""
    allow_remote: bool = False
    """Follow virtual rasters, `/vsi…` paths and URLs."""
    alpha: bool | None = None
    """Whether bands that are tagged as alpha are masks; None: their values decide."""
    info: RasterInfo = field(init=False, repr=False)
    """Facts of the file."""
    _missing: MissingBlocks | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        info = read_info(self.path, limits=self.limits, allow_remote=self.allow_remote)
        _check_image(info)
        info = with_alpha_judged(info, self.alpha)
        object.__setattr__(self, "path", info.path)
        object.__setattr__(self, "info", info)
        object.__setattr__(self, "_missing", missing_blocks(info))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.info.size

    @property
    def bands(self) -> int:
        """Number of bands, without alpha."""
        return self.info.bands

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        return np.dtype(self.info.dtype)

    def read(self, window: Window, level: int = 0) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Pixels of a window and their validity, see `engine.base.Reader`; from the file's overviews where it can."""
        if level:
            overview = best_overview(self.info, level)
            state = self.path.stat() if self.path.is_file() else None
            key = (self.path, overview is None, None if state is None else (state.st_mtime_ns, state.st_ino))
            if overview is None:
                return reduced_by_blocks(key, self, window, level)
            return reduced_by_blocks(key, overview, window, level - overview.level)
        pixels, valid = read_pixels(self.info, window, self._missing)
        if self.info.palette:
            pixels, opaque = _expand(self.info, pixels[0])
            valid = both(valid, opaque)
        if self.info.nodata is None:
            refuse_undeclared(self.path, window, pixels, valid)
        return pixels, valid


#: Places of an image whose alpha is judged (along each side), their side, and the width of soft borders, pixels.
_LOOKS, _LOOK, _SOFT = 3, 256, 8
#: Part of the pixels away from borders that a mask makes opaque; values besides 0 and opaque that a mask may have.
_OPAQUE, _LEVELS = 0.75, 8


def with_alpha_judged(info: RasterInfo, alpha: bool | None = None) -> RasterInfo:
    """The facts of an image, with alpha bands that hold a picture among the colour bands.

    Some programs tag the fourth band of every image as alpha, also near infrared. A mask is 0 or opaque (the highest
    value there is), except at soft borders next to 0; it has few other values. A picture has many, in most pixels.
    """
    if not info.alpha_bands or alpha is True or not info.colour_bands:
        return info
    width, height = info.size
    looks = []
    for row in range(_LOOKS):
        for col in range(_LOOKS):
            at = [max(0, int((k + 0.5) / _LOOKS * side - _LOOK / 2)) for k, side in ((col, width), (row, height))]
            looks.append(Window(at[0], at[1], min(_LOOK, width - at[0]), min(_LOOK, height - at[1])))
    count = len(info.alpha_bands)
    # In the order in which the file is read otherwise: a picture may be decoded once for all.
    plain = replace(
        info, colour_bands=info.colour_bands + info.alpha_bands, alpha_bands=(), nodata=None, has_mask=False
    )
    wrong = set(info.alpha_bands)
    if alpha is None:
        seen = [read_pixels(plain, window)[0][-count:] for window in dict.fromkeys(looks)]
        wrong = {band for k, band in enumerate(info.alpha_bands) if _is_picture([pixels[k] for pixels in seen])}
    return replace(
        info,
        colour_bands=tuple(sorted({*info.colour_bands, *wrong})),
        alpha_bands=tuple(band for band in info.alpha_bands if band not in wrong),
        colours=tuple("undefined" if n in wrong else colour for n, colour in enumerate(info.colours, 1)),
        colour_despite_tag=() if alpha is False else tuple(sorted(wrong)),
    )


def _is_picture(looks: list[NDArray[Any]]) -> bool:
    """Whether parts of an alpha band (h, w) have many values away from soft borders."""
    from scipy.ndimage import maximum_filter  # noqa: PLC0415 - few images have alpha

    opaque = max(float(np.nanmax(part)) for part in looks)
    inner, every = [], []
    for part in looks:
        near_zero = maximum_filter((part == 0).astype(np.uint8), 2 * _SOFT + 1) > 0
        every.append(part[part != 0])
        inner.append(part[(part != 0) & ~near_zero])
    values = np.concatenate(inner)
    # Zeros that are strewn all over leave nothing away from them.
    values = values if 4 * len(values) > sum(map(len, every)) else np.concatenate(every)
    between = values[values != opaque]
    return len(between) > (1 - _OPAQUE) * len(values) and len(np.unique(between)) > _LEVELS


def pixels_of_dataset(source: Any) -> RasterReader | np.ma.MaskedArray[Any, Any] | None:
    """A dataset that is open in rasterio, read by windows from its file, or whole where it lives in memory.

    None: it is no dataset.
    """
    if not isinstance(source, rasterio.io.DatasetReader):
        return None
    path = Path(source.name)
    return RasterReader(path) if path.is_file() else source.read(masked=True)


def stated_classes(info: RasterInfo) -> tuple[Path, ...] | None:
    """Return the files beside a raster by which its values are numbers of classes; None if they are not.

    A colour table, category names or a thematic attribute table state so, for one band of whole numbers.
    """
    if info.palette:
        return ()
    if len(info.colour_bands) != 1 or np.dtype(info.dtype).kind not in "iu":
        return None
    table, aux = (info.path.with_name(info.path.name + suffix) for suffix in (".vat.dbf", ".aux.xml"))
    if table.is_file():
        return (table,)
    # GDAL hands out names of categories in no other way than as text.
    place = f"/vsimem/{uuid4().hex}.vrt"
    with gdal_settings(), not_georeferenced():
        rasterio.shutil.copy(handle(info.path, info.driver), place, driver="VRT")
        try:
            with rasterio.open(place) as described:
                text = described.tags(ns="xml:VRT")["xml:VRT"]
        finally:
            rasterio.shutil.delete(place, driver="VRT")
    if "<CategoryNames>" in text or ("<GDALRasterAttributeTable" in text and 'tableType="thematic"' in text):
        return (aux,) if aux.is_file() else ()
    return None


def _check_image(info: RasterInfo) -> None:
    """Refuse what cannot be an image's pixels, each by its name."""
    path, advice = info.path, "convert it with"
    cmyk = info.colour_space in ("CMYK", "YCCK") or {"cyan", "magenta", "yellow", "black"} & set(info.colours)
    if cmyk or (info.driver == "GTiff" and path.is_file() and read_tiff_layout(path).photometric in _NOT_RGB):
        raise InputError(f"{path}: CMYK or CIELab colours; {advice} an image program to RGB")
    if {"Y", "Cb", "Cr", "hue", "saturation", "lightness"} & set(info.colours):
        raise InputError(f"{path}: colours {', '.join(info.colours)}; {advice} an image program to RGB")
    if info.bits == 1:
        raise InputError(f"{path}: 1-bit image; {advice} `gdal_translate -ot Byte -scale 0 1 0 255`")
    if info.dtype not in IMAGE_TYPES:
        raise InputError(
            f"{path}: pixels of type {info.dtype}; allowed are {', '.join(IMAGE_TYPES)}. "
            "Convert it with `gdal_translate -ot UInt16` or `-ot Float32`"
        )
    if not info.colour_bands:
        raise InputError(f"{path}: holds nothing but alpha; give the image itself")
    if any(colour == "palette" for colour in info.colours) and not info.palette:
        raise InputError(f"{path}: a colour table beside other bands; {advice} `gdal_translate -expand rgb`")


def _expand(info: RasterInfo, index: NDArray[Any]) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Colours (3, h, w) that the indices of a palette stand for, and where they are opaque."""
    with gdal_settings():
        table = handle(info.path, info.driver).colormap(info.colour_bands[0])
    lut = np.zeros((max(max(table) + 1, int(index.max()) + 1), 4), np.uint8)
    for entry, colour in table.items():
        lut[entry] = colour
    rgba = lut[index]
    opaque = rgba[..., 3] > 0
    return np.ascontiguousarray(np.moveaxis(rgba[..., :3], -1, 0)), None if opaque.all() else opaque


_COMPARED = 64
"""Side of the places where an overview is compared with what it should be."""
_PLACES = (0.5, 0.25, 0.75)


@dataclass(frozen=True, eq=False)
class Overview:
    """A reduced copy inside the file, read like an image."""

    info: RasterInfo
    number: int
    """Its place among the file's overviews, from 0."""
    level: int
    """The image is reduced by 2 to the power of this."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return level_size(self.info.size, self.level)

    @property
    def bands(self) -> int:
        """Number of bands, without alpha."""
        return self.info.bands

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        return np.dtype(self.info.dtype)

    def read(self, window: Window) -> Pixels:
        """Pixels of a window and their validity."""
        pixels, valid = read_pixels(self.info, window, overview=(self.number, self.size))
        if self.info.nodata is None:
            refuse_undeclared(self.info.path, window, pixels, valid)
        return pixels, valid


@lru_cache(maxsize=256)
def best_overview(info: RasterInfo, level: int) -> Overview | None:
    """The overview that saves most on the way to a level; None if there is none that can be used."""
    if info.palette or info.missing_blocks:
        return None
    for wanted in range(level, 0, -1):
        for number, factor in enumerate(info.overviews):
            overview = Overview(info, number, wanted)
            if factor == 2**wanted and _are_means(overview):
                return overview
    return None


def _are_means(overview: Overview) -> bool:
    """Whether an overview holds means, and not pixels that were picked out, which would alias.

    Picked pixels lie beside the mean as far as the pixels of a block do; whatever smooths lies much nearer.
    """
    info, f = overview.info, 1 << overview.level
    with gdal_settings():
        found = handle(info.path, info.driver, overview.number)
        if (found.width, found.height) != overview.size:
            return False
    width, height = overview.size
    beside = spread = 0.0
    for place in _PLACES:
        side = (min(_COMPARED, width - 1), min(_COMPARED, height - 1))
        part = Window(int(place * (width - side[0])), int(place * (height - side[1])), *side) & Window(
            0, 0, width - 1, height - 1
        )
        if not part.size:
            continue
        full, _ = read_pixels(info, Window(part.col * f, part.row * f, part.width * f, part.height * f))
        got, valid = overview.read(part)
        mean, square = means(full.astype(np.float32), None, overview.level)[0], full.astype(np.float32) ** 2
        variance = np.maximum(means(square, None, overview.level)[0] - mean**2, 0.0)
        there = slice(None) if valid is None else valid
        beside += float(((got - mean) ** 2)[:, there].sum())
        spread += float(variance[:, there].sum())
    # Half the spread of the pixels, and what rounding and a lossy compression may add.
    return beside <= 0.25 * spread + (0.0 if overview.dtype.kind == "f" else 4.0 * len(_PLACES) * _COMPARED**2)
