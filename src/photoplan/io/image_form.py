"""What a processed copy of an image takes over from it: place, names and colours of bands, metadata."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import rasterio
import rasterio.enums

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Placement
from photoplan.io.gdal import GDAL_ERRORS, gdal_settings, open_raster
from photoplan.io.raster_info import RasterInfo
from photoplan.io.scan_pitch import read_pitch

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
