"""Two images to be compared: where a pixel of the first one lies in the second one, and what both have in common."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import Placement, Window
from photoplan.io.image_form import placement_of
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import RasterInfo
from photoplan.matching.grey import GreyImage
from photoplan.matching.register import PixelTransfer
from photoplan.products.orthophoto.look import extent_text

#: Pixels of one image may be so much larger than those of the other.
_SCALE = 2.0


@dataclass(frozen=True, eq=False)
class Pair:
    """Two images that were opened."""

    paths: tuple[Path, Path]
    images: tuple[GreyImage, GreyImage]
    transfer: PixelTransfer
    """From pixels of the first to pixels of the second image."""
    common: Window
    """Pixels of the first image that may have a partner."""
    place: Placement | None
    """Of the first image; None: compared pixel by pixel."""
    crs: str | None
    notes: tuple[str, ...]

    @property
    def pixel(self) -> float | None:
        """Side of a pixel of the first image in units of the map."""
        return None if self.place is None else float(np.sqrt(abs(np.linalg.det(self.place.linear))))


def open_pair(first: Path, second: Path) -> Pair:
    """Open two images."""
    if first.exists() and second.exists() and first.samefile(second):
        raise UsageError(f"{second}: is the first image, too; give two images")
    readers = RasterReader(first), RasterReader(second)
    a, b = (reader.info for reader in readers)
    notes = [warning for info in (a, b) for warning in info.warnings]
    if a.to_map is None or b.to_map is None:
        if a.size != b.size:
            raise InputError(
                f"{first} has {a.size[0]} × {a.size[1]} pixels, {second} has {b.size[0]} × {b.size[1]}, and not both "
                "have a place on a map: it is not known which pixels belong together. Give images of one size, or "
                "georeferenced ones"
            )
        if a.to_map is not b.to_map:
            alone = second if b.to_map is None else first
            notes.append(f"{alone.name} has no place on a map: the images are compared pixel by pixel")
        place, transfer = None, PixelTransfer()
    else:
        place, transfer = placement_of(a), _between(a, b, notes)
    common = transfer.common(a.size, b.size)
    if common is None:
        extents = "\n  ".join(f"{info.path}: {extent_text(placement_of(info).bounds)}" for info in (a, b) if place)
        raise GeometryError(f"the images have nothing in common:\n  {extents}")
    return Pair(
        paths=(first, second),
        images=(GreyImage(readers[0]), GreyImage(readers[1])),
        transfer=transfer,
        common=common,
        place=place,
        crs=a.crs or b.crs if place is not None else None,
        notes=tuple(notes),
    )


def _between(a: RasterInfo, b: RasterInfo, notes: list[str]) -> PixelTransfer:
    """By the places of both on the map."""
    if a.crs is not None and b.crs is not None and not same_crs(a.crs, b.crs):
        raise InputError(
            f"{a.path} is in {crs_label(a.crs)}, {b.path} in {crs_label(b.crs)}; transform one of them with "
            "gdalwarp -t_srs"
        )
    if (a.crs is None) != (b.crs is None):
        alone = a if a.crs is None else b
        notes.append(f"{alone.path.name} states no reference system: that of the other image is taken")
    transfer = PixelTransfer.between(placement_of(a), placement_of(b))
    if not 1 / _SCALE <= transfer.scale <= _SCALE:
        raise InputError(
            f"pixels of {a.path} are {transfer.scale:.3g} times as large as those of {b.path}; up to {_SCALE:g} times "
            "can be matched. Bring them to one resolution with gdalwarp -tr -r average"
        )
    return transfer
