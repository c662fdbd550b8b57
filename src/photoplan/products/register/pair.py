"""Two images to be compared: where a pixel of the first one lies in the second one, and what both have in common."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from photoplan.errors import GeometryError, InputError, UsageError
from photoplan.geometry.crs import crs_label, same_crs
from photoplan.geometry.grid import Window
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
    to_map: tuple[float, float, float, float, float, float] | None
    """Of the first image, see `RasterInfo`; None: compared pixel by pixel."""
    crs: str | None
    notes: tuple[str, ...]

    @property
    def pixel(self) -> float | None:
        """Side of a pixel of the first image in units of the map."""
        return None if self.to_map is None else float(np.sqrt(abs(_square(self.to_map)[0])))


def _square(to_map: tuple[float, ...]) -> tuple[float, np.ndarray, np.ndarray]:
    """Area of a pixel; matrix and offset from pixels to the map."""
    matrix = np.array([[to_map[1], to_map[2]], [to_map[4], to_map[5]]])
    return float(np.linalg.det(matrix)), matrix, np.array([to_map[0], to_map[3]])


def open_pair(first: Path, second: Path) -> Pair:
    """Open two images.

    Raises
    ------
    UsageError
        Both are the same file.
    InputError
        One cannot be used, or they lie in different reference systems, or have different sizes and lie nowhere.
    GeometryError
        They have nothing in common.
    """
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
        to_map, transfer = None, PixelTransfer()
    else:
        to_map, transfer = a.to_map, _between(a, b, notes)
    return Pair(
        paths=(first, second),
        images=(GreyImage(readers[0]), GreyImage(readers[1])),
        transfer=transfer,
        common=_common(a, b, transfer, to_map is not None),
        to_map=to_map,
        crs=a.crs or b.crs if to_map is not None else None,
        notes=tuple(notes),
    )


def _between(a: RasterInfo, b: RasterInfo, notes: list[str]) -> PixelTransfer:
    """By the places of both on the map."""
    assert a.to_map is not None and b.to_map is not None
    if a.crs is not None and b.crs is not None and not same_crs(a.crs, b.crs):
        raise InputError(
            f"{a.path} is in {crs_label(a.crs)}, {b.path} in {crs_label(b.crs)}; transform one of them with "
            "gdalwarp -t_srs"
        )
    if (a.crs is None) != (b.crs is None):
        alone = a if a.crs is None else b
        notes.append(f"{alone.path.name} states no reference system: that of the other image is taken")
    (one, A, at), (two, B, bt) = _square(a.to_map), _square(b.to_map)
    scale = np.sqrt(abs(one / two)) if one and two else np.nan
    if not 1 / _SCALE <= scale <= _SCALE:
        raise InputError(
            f"pixels of {a.path} are {scale:.3g} times as large as those of {b.path}; up to {_SCALE:g} times can be "
            "matched. Bring them to one resolution with gdalwarp -tr -r average"
        )
    L, t = np.linalg.solve(B, A), np.linalg.solve(B, at - bt)
    # Pixels that are meant to coincide do so to the last digits of a file.
    L = np.where(np.abs(L - np.rint(L)) < 1e-9, np.rint(L), L)
    t = np.where(np.abs(t - np.rint(t)) < 1e-6, np.rint(t), t)
    a0, a1, a2, a3 = L.reshape(-1).tolist()
    return PixelTransfer((a0, a1, a2, a3), (float(t[0]), float(t[1])))


def _common(a: RasterInfo, b: RasterInfo, transfer: PixelTransfer, placed: bool) -> Window:
    width, height = b.size
    corners = np.array([[0, 0], [width - 1, 0], [0, height - 1], [width - 1, height - 1]], float)
    back = (corners - np.array(transfer.shift)) @ np.linalg.inv(transfer.L).T
    low = np.maximum(np.floor(np.clip(back.min(axis=0), -1, 1e9)), 0).astype(int)
    high = np.minimum(np.ceil(np.clip(back.max(axis=0), -1, 1e9)) + 1, a.size).astype(int)
    if (high <= low).any():
        extents = "\n  ".join(f"{info.path}: {extent_text(_extent(info))}" for info in (a, b)) if placed else ""
        raise GeometryError(f"the images have nothing in common:\n  {extents}")
    return Window(int(low[0]), int(low[1]), *(high - low).tolist())


def _extent(info: RasterInfo) -> tuple[float, float, float, float]:
    assert info.to_map is not None
    _, matrix, offset = _square(info.to_map)
    width, height = info.size
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float) - 0.5
    XY = corners @ matrix.T + offset
    (x0, y0), (x1, y1) = XY.min(axis=0).tolist(), XY.max(axis=0).tolist()
    return x0, y0, x1, y1
