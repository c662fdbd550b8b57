"""Small pictures to look at first: one product, or many of them together on the map."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import rasterio.enums
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.io.files import check_plain_file, raster_driver
from photoplan.io.gdal import GDAL_ERRORS, first_cause, gdal_settings, not_georeferenced, open_raster
from photoplan.io.store import standing, write_atomically

_PERCENT = 2.0, 98.0
_SOFTWARE = "photoplan"


def write_quicklook(product: Path, picture: Path, *, max_side: int = 1600) -> Path:
    """Write a PNG of one product; transparent where it has no valid pixel.

    Only the overview of a suitable size is read. Bytes are shown as they are, with their colour table if there is one;
    other types are stretched from the second to the ninety-eighth percentile. One or two bands are shown grey, more as
    red, green, blue.
    """
    _check_side(max_side)
    with _opened(product) as dataset, gdal_settings():
        factor = max(1.0, max(dataset.width, dataset.height) / max_side)
        rgba = _look(product, dataset, _scaled(dataset.width, factor), _scaled(dataset.height, factor))
    return write_png(picture, rgba)


def read_reduced(product: Path, *, max_side: int) -> tuple[NDArray[Any], tuple[float, float, float, float]]:
    """All bands of a product from its nearest overview, NaN where invalid, and its outer edges xmin ymin xmax ymax.

    The product may still wait for its name.
    """
    _check_side(max_side)
    with _opened(standing(product)) as dataset, gdal_settings():
        factor = max(1.0, max(dataset.width, dataset.height) / max_side)
        shape = (_scaled(dataset.height, factor), _scaled(dataset.width, factor))
        try:
            pixels = dataset.read(out_shape=shape, resampling=rasterio.enums.Resampling.nearest, masked=True)
        except (*GDAL_ERRORS, OSError) as error:
            raise InputError(f"{product}: cannot be read ({first_cause(error)})") from error
        edges = dataset.bounds
    return pixels.astype(float).filled(np.nan), (edges.left, edges.bottom, edges.right, edges.top)


def write_overview(products: Sequence[Path], picture: Path, title: str = "", *, max_side: int = 1600) -> Path | None:
    """Write a PNG of many products placed on the map together; the first ones lie on top.

    Transparent where there is nothing. The products must share one reference system;
    those with another one than the first are left out. None if there is nothing to show.
    """
    _check_side(max_side)
    sheets = _placed(products)
    if not sheets:
        return None
    left, top = min(s.left for s in sheets), max(s.top for s in sheets)
    right, bottom = max(s.right for s in sheets), min(s.bottom for s in sheets)
    # Never finer than the finest product: small ones make a small picture.
    pixel = max(max(right - left, top - bottom) / max_side, min(s.pixel for s in sheets))
    canvas = np.zeros((4, _scaled(top - bottom, pixel), _scaled(right - left, pixel)), np.uint8)
    for sheet in reversed(sheets):
        col, row = int((sheet.left - left) / pixel), int((top - sheet.top) / pixel)
        width = min(_scaled(sheet.right - sheet.left, pixel), canvas.shape[2] - col)
        height = min(_scaled(sheet.top - sheet.bottom, pixel), canvas.shape[1] - row)
        with _opened(sheet.path) as dataset, gdal_settings():
            rgba = _look(sheet.path, dataset, width, height)
        part = canvas[:, row : row + height, col : col + width]
        np.copyto(part, rgba, where=rgba[3] > 0)
    return write_png(picture, canvas, title)


def refuse_foreign_overview(picture: Path, title: str = "") -> None:
    """Refuse to replace a picture that `write_overview` did not write, or wrote with another title."""
    if not picture.exists():
        return
    try:
        with open_raster(picture, "PNG") as dataset:
            tags = dataset.tags()
        own = tags.get("Software") == _SOFTWARE and tags.get("Title", "") == title
    except InputError:
        own = False
    if not own:
        raise UsageError(
            f"{picture}: this name is needed for the preview, and the file is not a preview of this command; "
            "move it away, or set `overwrite`"
        )


@dataclass(frozen=True)
class _Sheet:
    """Where a product lies on the map."""

    path: Path
    left: float
    top: float
    right: float
    bottom: float
    pixel: float


def _placed(products: Sequence[Path]) -> list[_Sheet]:
    """Products of the first one's reference system, with their edges on the map."""
    sheets: list[_Sheet] = []
    first: Any = None
    for path in products:
        with _opened(path) as dataset:
            first = dataset.crs if not sheets else first
            north_up = dataset.transform.b == dataset.transform.d == 0 and dataset.transform.e < 0
            if dataset.crs == first and north_up:
                b = dataset.bounds
                sheets.append(
                    _Sheet(
                        path=Path(path),
                        left=b.left,
                        top=b.top,
                        right=b.right,
                        bottom=b.bottom,
                        pixel=dataset.transform.a,
                    )
                )
    return sheets


def _look(path: Path, dataset: Any, width: int, height: int) -> NDArray[np.uint8]:
    """Red, green, blue and alpha, shape (4, height, width), from the nearest overview."""
    indexes = [1, 2, 3] if dataset.count >= 3 else [1, 1, 1]
    # Nearest neighbour in a suitable overview: it is an average already.
    how = {"out_shape": (height, width), "resampling": rasterio.enums.Resampling.nearest}
    try:
        pixels = dataset.read(sorted(set(indexes)), **how)
        valid = (dataset.read_masks(sorted(set(indexes)), **how) > 0).any(axis=0)
    except (*GDAL_ERRORS, OSError) as error:
        raise InputError(f"{path}: cannot be read for a quick look ({first_cause(error)})") from error
    if pixels.dtype != np.uint8:
        pixels = _stretched(pixels, valid)
    elif dataset.count == 1 and dataset.colorinterp[0] == rasterio.enums.ColorInterp.palette:
        table = np.zeros((256, 3), np.uint8)
        for value, colour in dataset.colormap(1).items():
            table[value] = colour[:3]
        pixels = np.moveaxis(table[pixels[0]], -1, 0)
    alpha = valid * np.uint8(255)
    return np.concatenate([np.broadcast_to(pixels, (3, height, width)) * valid, alpha[None]]).astype(np.uint8)


def _stretched(pixels: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Values from the second to the ninety-eighth percentile of all bands, as bytes."""
    values = pixels[:, valid].astype(np.float64)
    values = values[np.isfinite(values)]
    low, high = np.percentile(values, _PERCENT) if values.size else (0.0, 1.0)
    scaled = (np.nan_to_num(pixels.astype(np.float64), nan=low) - low) * (255.0 / max(high - low, 1e-12))
    return np.clip(scaled, 0, 255).astype(np.uint8)


def write_png(picture: Path, rgba: NDArray[np.uint8], title: str = "") -> Path:
    """Write red, green, blue and alpha, shape (4, height, width): encoded in memory, put in place at once."""
    with not_georeferenced(), gdal_settings(GDAL_PAM_ENABLED=False), rasterio.MemoryFile() as memory:
        profile = {"driver": "PNG", "width": rgba.shape[2], "height": rgba.shape[1], "count": 4, "dtype": "uint8"}
        profile["WRITE_METADATA_AS_TEXT"] = "YES"
        with memory.open(**profile) as dataset:
            dataset.write(rgba)
            dataset.update_tags(Software=_SOFTWARE, **({"Title": title} if title else {}))
        content = memory.read()
    write_atomically(Path(picture), content)
    return Path(picture)


def _opened(path: Path | str) -> Any:
    plain = check_plain_file(os.fspath(path))
    return open_raster(plain, raster_driver(plain))


def _scaled(length: float, factor: float) -> int:
    return max(1, round(length / factor))


def _check_side(max_side: int) -> None:
    if not 16 <= max_side <= 20_000:
        raise UsageError(f"a picture of {max_side} pixels; the longest side must be 16 to 20,000")
