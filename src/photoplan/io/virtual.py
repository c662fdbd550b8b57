"""Virtual rasters: one small file that shows many rasters of a grid as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import rasterio
import rasterio.enums

from photoplan.errors import UsageError
from photoplan.io.naming import write_atomically
from photoplan.plain import xml_text

_MARK = "<!-- written by photoplan -->"
#: Pixels that lie over each other do so to this part of their side.
_ALIGNED = 1e-3
_TYPES = {"uint8": "Byte", "int8": "Int8", "uint16": "UInt16", "int16": "Int16", "uint32": "UInt32", "int32": "Int32",
          "float32": "Float32", "float64": "Float64"}  # fmt: skip


def refuse_foreign_virtual(path: Path) -> None:
    """Refuse to replace a file that `write_virtual` has not written."""
    if path.is_file() and _MARK not in path.read_bytes()[:4096].decode(errors="replace"):
        raise UsageError(f"{path}: exists and is not of photoplan; move it away, or give another name")


def write_virtual(path: Path, rasters: Sequence[Path]) -> None:
    """Write a VRT (GDAL's virtual raster) of rasters of one grid, bands and type, which lie in its folder; replaces an
    older one."""
    left, top, right, bottom = float("inf"), float("-inf"), float("-inf"), float("inf")
    facts = []
    for raster in rasters:
        with rasterio.open(raster) as file:
            b, resolution, crs, dtype = file.bounds, file.res[0], file.crs, file.dtypes[0]
            masked = rasterio.enums.MaskFlags.per_dataset in file.mask_flag_enums[0]
            facts.append((raster.name, b.left, b.top, file.width, file.height))
            count, nodata, colours = file.count, file.nodata, [each.name.capitalize() for each in file.colorinterp]
        left, top, right, bottom = min(left, b.left), max(top, b.top), max(right, b.right), min(bottom, b.bottom)
    size = round((right - left) / resolution), round((top - bottom) / resolution)

    def sources(band: str) -> str:
        found, none = [], 0 if band.startswith("mask") else nodata
        for name, x, y, width, height in facts:
            to = f'xOff="{round((x - left) / resolution)}" yOff="{round((top - y) / resolution)}"'
            at = f'xSize="{width}" ySize="{height}"'
            found.append(
                f'<ComplexSource><SourceFilename relativeToVRT="1">{xml_text(name)}</SourceFilename><SourceBand>{band}'
                f'</SourceBand><SrcRect xOff="0" yOff="0" {at}/><DstRect {to} {at}/>'
                # Where sheets of any outline lie over each other, what one does not show is the other's.
                + ("" if none is None else f"<NODATA>{none!r}</NODATA>")
                + ("<UseMaskBand>true</UseMaskBand>" if masked and not band.startswith("mask") else "")
                + "</ComplexSource>"
            )
        return "\n".join(found)

    none = "" if nodata is None else f"<NoDataValue>{nodata!r}</NoDataValue>"
    bands = [
        f'<VRTRasterBand dataType="{_TYPES[dtype]}" band="{k + 1}">{none}<ColorInterp>{colours[k]}</ColorInterp>\n'
        f"{sources(str(k + 1))}\n</VRTRasterBand>"
        for k in range(count)
    ]
    if masked:
        bands.append(f'<MaskBand><VRTRasterBand dataType="Byte">\n{sources("mask,1")}\n</VRTRasterBand></MaskBand>')
    head = (
        f'<VRTDataset rasterXSize="{size[0]}" rasterYSize="{size[1]}">{_MARK}\n<SRS>{xml_text(crs.to_wkt())}</SRS>\n'
        f"<GeoTransform>{left!r}, {resolution!r}, 0, {top!r}, 0, {-resolution!r}</GeoTransform>\n"
    )
    write_atomically(path, (head + "\n".join(bands) + "\n</VRTDataset>\n").encode())


def write_stacked(path: Path, rasters: Mapping[str, Path]) -> None:
    """Write a VRT that shows rasters of one resolution, which lie in its folder, as bands of one, over all of them.

    Each band has the name of its raster, with the number of the band where that has several.
    """
    left, top, right, bottom = float("inf"), float("-inf"), float("-inf"), float("inf")
    opened = {}
    for name, raster in rasters.items():
        with rasterio.open(raster) as file:
            b, resolution, crs = file.bounds, file.res[0], file.crs
            opened[name] = raster.name, b, (file.width, file.height), file.dtypes, file.nodata
        left, top, right, bottom = min(left, b.left), max(top, b.top), max(right, b.right), min(bottom, b.bottom)
    bands: list[str] = []
    for name, (file_name, b, (width, height), dtypes, nodata) in opened.items():
        x, y = (b.left - left) / resolution, (top - b.top) / resolution
        if max(abs(x - round(x)), abs(y - round(y))) > _ALIGNED:
            raise UsageError(f"{file_name}: its pixels do not lie over those of the other orthophotos")
        at = f'xSize="{width}" ySize="{height}"'
        none = "" if nodata is None else f"<NoDataValue>{nodata!r}</NoDataValue>"
        for k, dtype in enumerate(dtypes, 1):
            title = name if len(dtypes) == 1 else f"{name} {k}"
            bands.append(
                f'<VRTRasterBand dataType="{_TYPES[dtype]}" band="{len(bands) + 1}"><Description>{xml_text(title)}'
                f'</Description>{none}<ComplexSource><SourceFilename relativeToVRT="1">{xml_text(file_name)}'
                f'</SourceFilename><SourceBand>{k}</SourceBand><SrcRect xOff="0" yOff="0" {at}/><DstRect '
                f'xOff="{round(x)}" yOff="{round(y)}" {at}/>'
                + ("<UseMaskBand>true</UseMaskBand>" if nodata is None else f"<NODATA>{nodata!r}</NODATA>")
                + "</ComplexSource></VRTRasterBand>"
            )
    size = round((right - left) / resolution), round((top - bottom) / resolution)
    head = (
        f'<VRTDataset rasterXSize="{size[0]}" rasterYSize="{size[1]}">{_MARK}\n<SRS>{xml_text(crs.to_wkt())}</SRS>\n'
        f"<GeoTransform>{left!r}, {resolution!r}, 0, {top!r}, 0, {-resolution!r}</GeoTransform>\n"
    )
    write_atomically(path, (head + "\n".join(bands) + "\n</VRTDataset>\n").encode())
