"""Grids, windows, placements and levels of resolution; the order of pixel coordinates is (column, row)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.codec import storable
from photoplan.errors import UsageError
from photoplan.kernels.raster import reduce_means


@dataclass(frozen=True)
class Breaks:
    """Places where a mapping is continuous but bent; interpolation across them is measured.

    Positions are those of the image for a projection, those of the product for a target; pixels.
    """

    columns: tuple[float, ...] = ()
    """x (or u), increasing."""
    rows: tuple[float, ...] = ()
    """y (or v), increasing."""

    def __post_init__(self) -> None:
        for name, places in (("columns", self.columns), ("rows", self.rows)):
            if not all(a < b for a, b in pairwise(places)):
                raise UsageError(f"breaks: {name} {places[:5]} …; they must be finite and increase")


Six = tuple[float, float, float, float, float, float]


@storable
@dataclass(frozen=True, order=True, slots=True)
class Window:
    """A rectangle of pixels: `col`, `row` of its first pixel, `width`, `height` in pixels (zero: empty)."""

    col: int
    row: int
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.width < 0 or self.height < 0:
            raise UsageError(f"window of {self.width} × {self.height} pixels; sides must not be negative")

    @property
    def stop(self) -> tuple[int, int]:
        """First column and row beyond the window."""
        return self.col + self.width, self.row + self.height

    @property
    def size(self) -> int:
        """Number of pixels."""
        return self.width * self.height

    def __and__(self, other: Window) -> Window:
        """The common part; empty if there is none."""
        col, row = max(self.col, other.col), max(self.row, other.row)
        right = min(self.stop[0], other.stop[0])
        bottom = min(self.stop[1], other.stop[1])
        return Window(col, row, max(0, right - col), max(0, bottom - row))

    def slices(self, frame: Window) -> tuple[slice, slice]:
        """Rows and columns of this window in an array that holds the pixels of `frame`."""
        row, col = self.row - frame.row, self.col - frame.col
        return slice(row, row + self.height), slice(col, col + self.width)

    def tiles(self, side: int) -> Iterator[Window]:
        """The window cut into tiles of `side` pixels, row by row; the last ones are smaller."""
        right, bottom = self.stop
        for row in range(self.row, bottom, side):
            for col in range(self.col, right, side):
                yield Window(col, row, min(side, right - col), min(side, bottom - row))


#: Tiles of one raster at most, and their usual side, pixels.
MOST_TILES, USUAL_TILE = 1_000_000, 512
#: Pixels of any map, metres.
_FINEST, _COARSEST = 1e-6, 1e6
#: Map coordinates of anything on the earth, metres.
_EARTH = 1e8


def refuse_absurd(size: tuple[float, float], tile: int, where: str) -> None:
    """Refuse a raster that no one means, before any work; `where` names it and its resolution in the message."""
    width, height = size
    tiles = -(-width // tile) * -(-height // tile)
    if tiles > MOST_TILES:
        raise UsageError(
            f"{where} gives {width:.3g} × {height:.3g} pixels in {tiles:.3g} tiles, more than {MOST_TILES}; choose a "
            "larger `resolution`, or a smaller area"
        )


def check_resolution(resolution: float) -> None:
    """Refuse pixels that no map has."""
    if not (math.isfinite(resolution) and resolution > 0):
        raise UsageError(f"resolution {resolution}; a positive number of metres is needed")
    if not _FINEST <= resolution <= _COARSEST:
        raise UsageError(f"resolution {resolution:g} m; pixels of maps have {_FINEST:g} to {_COARSEST:g} m")


@dataclass(frozen=True)
class Placement:
    """Size of a raster, and how its pixels lie in a plane.

    The plane is a map, a wall, an unrolled vault or a picture; a plain image lies in none.
    """

    size: tuple[int, int]
    """Width and height in pixels."""
    transform: Six | None = None
    """a to f: X = a·col + b·row + c, Y = d·col + e·row + f, where col and row count from the outer corner of the
    upper-left pixel, as GDAL has it and unlike pixel coordinates; None: the raster lies nowhere."""
    crs: str | None = None
    """Reference system of X and Y as a string that pyproj reads; None: none, or unknown."""
    unit: str = "metre"
    """Unit of X and Y; `pixel` if there is no transform."""

    def __post_init__(self) -> None:
        width, height = self.size
        if width < 1 or height < 1:
            raise UsageError(f"raster of {width} × {height} pixels; it must hold at least one")
        if self.transform is None:
            object.__setattr__(self, "unit", "pixel")
            return
        a, b, _, d, e, _ = self.transform
        if not (all(math.isfinite(t) for t in self.transform) and a * e - b * d != 0):
            raise UsageError(f"transform {self.transform}; six finite numbers and pixels with an area are needed")

    @classmethod
    def from_affine(cls, affine: Any, crs: Any = None, *, size: tuple[int, int], unit: str = "metre") -> Placement:
        """From an `affine.Affine`, as rasterio has it.

        Parameters
        ----------
        affine : affine.Affine
            Or anything with the attributes a to f.
        crs : optional
            A string, or a CRS object of rasterio or pyproj.
        size : (width, height)
            Pixels.
        unit : str
            Of the affine's results.
        """
        a, b, c, d, e, f = (float(getattr(affine, name)) for name in "abcdef")
        return cls(size, (a, b, c, d, e, f), crs if crs is None or isinstance(crs, str) else crs.to_string(), unit)

    @property
    def coefficients(self) -> Six:
        """The transform; that of the pixels themselves where there is none."""
        return self.transform or (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)

    @property
    def middle(self) -> tuple[float, float]:
        """X and Y in the middle of the raster."""
        (width, height), (a, b, c, d, e, f) = self.size, self.coefficients
        return (a * width + b * height) / 2 + c, (d * width + e * height) / 2 + f

    @property
    def linear(self) -> NDArray[np.float64]:
        """Return what a step to the next column and to the next row is in the plane, (2, 2)."""
        return np.array(self.coefficients).reshape(2, 3)[:, :2]

    @property
    def affine(self) -> Any:
        """`affine.Affine`: with `crs` all that rasterio, xarray or GeoPandas want to know."""
        from affine import Affine  # noqa: PLC0415  (not needed to write a product)

        return Affine(*self.coefficients)

    @property
    def window(self) -> Window:
        """All pixels."""
        return Window(0, 0, *self.size)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Outer edges xmin, ymin, xmax, ymax."""
        width, height = self.size
        corners = self.to_plane([(-0.5, -0.5), (width - 0.5, -0.5), (-0.5, height - 0.5), (width - 0.5, height - 0.5)])
        (xmin, ymin), (xmax, ymax) = corners.min(axis=0), corners.max(axis=0)
        return float(xmin), float(ymin), float(xmax), float(ymax)

    def to_plane(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Pixel coordinates (column, row), whole at pixel centres, to X, Y; shapes (..., 2)."""
        col, row = np.moveaxis(np.asarray(xy, float) + 0.5, -1, 0)
        a, b, c, d, e, f = self.coefficients
        return np.stack([a * col + b * row + c, d * col + e * row + f], axis=-1)

    def part(self, window: Window) -> Placement:
        """The placement of a window."""
        size = (window.width, window.height)
        if self.transform is None:
            return Placement(size)
        a, b, _, d, e, _ = self.transform
        X, Y = self.to_plane((window.col - 0.5, window.row - 0.5)).tolist()
        return Placement(size, (a, b, X, d, e, Y), self.crs, self.unit)


@dataclass(frozen=True)
class MapGrid:
    """A north-up raster of square pixels in a projected CRS.

    (x, y) = (column, row) refer to pixel centres: (0, 0) is the centre of the upper-left pixel.
    """

    left: float
    """X of the outer left edge, metres."""
    top: float
    """Y of the outer upper edge, metres."""
    resolution: float
    """Side of a pixel, metres."""
    width: int
    """Columns."""
    height: int
    """Rows."""
    crs: str | None
    """Coordinate reference system as a string that pyproj reads (usually `EPSG:…` or WKT); None: it is no map."""

    def __post_init__(self) -> None:
        check_resolution(self.resolution)
        refuse_absurd((self.width, self.height), USUAL_TILE, f"resolution {self.resolution:g} m")
        if self.width < 1 or self.height < 1:
            raise UsageError(f"grid of {self.width} × {self.height} pixels; it must hold at least one")

    @classmethod
    def covering(cls, bounds: tuple[float, float, float, float], resolution: float, crs: str | None) -> MapGrid:
        """The grid that covers `bounds` (xmin, ymin, xmax, ymax) with edges on multiples of `resolution`.

        Grids of one resolution therefore share their pixels, whatever their bounds: a crop of a product is the
        product of the crop.
        """
        from photoplan.geometry.bounds import bounds_fault  # noqa: PLC0415  (PROJ is not needed for pixels)

        if (fault := bounds_fault(bounds)) is not None:
            raise UsageError(fault)
        xmin, ymin, xmax, ymax = bounds
        check_resolution(resolution)
        # A bound on a multiple stays there although the quotient carries rounding errors.
        col0 = math.floor(xmin / resolution + 1e-6)
        col1 = math.ceil(xmax / resolution - 1e-6)
        row0 = math.floor(-ymax / resolution + 1e-6)
        row1 = math.ceil(-ymin / resolution - 1e-6)
        return cls(
            left=col0 * resolution,
            top=-row0 * resolution,
            resolution=resolution,
            width=max(1, col1 - col0),
            height=max(1, row1 - row0),
            crs=crs,
        )

    def window_of(self, bounds: tuple[float, float, float, float]) -> Window:
        """Pixels that map bounds xmin, ymin, xmax, ymax touch; empty if there are none."""
        part = MapGrid.covering(bounds, self.resolution, self.crs)
        col = round((part.left - self.left) / self.resolution)
        row = round((self.top - part.top) / self.resolution)
        left, top = max(col, 0), max(row, 0)
        return Window(left, top, max(0, col + part.width - left), max(0, row + part.height - top)) & self.window

    @property
    def window(self) -> Window:
        """All pixels."""
        return Window(0, 0, self.width, self.height)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Outer edges xmin, ymin, xmax, ymax."""
        return (self.left, self.top - self.height * self.resolution, self.left + self.width * self.resolution, self.top)

    @property
    def placement(self) -> Placement:
        """The same for files, which know other places than maps too."""
        corner = (self.resolution, 0.0, self.left, 0.0, -self.resolution, self.top)
        return Placement((self.width, self.height), corner, self.crs)

    def to_map(self, uv: ArrayLike) -> NDArray[np.float64]:
        """Pixel coordinates (column, row) to map X, Y; shapes (..., 2)."""
        uv = np.asarray(uv, float)
        return np.stack(
            [self.left + (uv[..., 0] + 0.5) * self.resolution, self.top - (uv[..., 1] + 0.5) * self.resolution], axis=-1
        )

    def to_pixel(self, XY: ArrayLike) -> NDArray[np.float64]:
        """Map X, Y to pixel coordinates (column, row); inverse of `to_map`."""
        XY = np.asarray(XY, float)
        return np.stack(
            [(XY[..., 0] - self.left) / self.resolution - 0.5, (self.top - XY[..., 1]) / self.resolution - 0.5], axis=-1
        )

    def bounds_of(self, window: Window) -> tuple[float, float, float, float]:
        """Outer edges of a window of this grid."""
        right, bottom = window.stop
        return (
            self.left + window.col * self.resolution,
            self.top - bottom * self.resolution,
            self.left + right * self.resolution,
            self.top - window.row * self.resolution,
        )


Pixels = tuple[NDArray[Any], NDArray[np.bool_] | None]
"""Values (bands, height, width), and validity (height, width); None: all are valid."""

#: Pixels of full size that are held at once, bytes.
CHUNK = 16 << 20


class FullSize(Protocol):
    """An image that is read by windows."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        ...

    @property
    def bands(self) -> int:
        """Number of bands."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        ...

    def read(self, window: Window) -> Pixels:
        """Pixels of a window, and their validity."""
        ...


def level_size(size: tuple[int, int], level: int) -> tuple[int, int]:
    """Width and height of an image reduced by 2 to the power of `level`; its last pixels may be partly outside."""
    return -(-size[0] >> level), -(-size[1] >> level)


def means(pixels: NDArray[Any], valid: NDArray[np.bool_] | None, level: int) -> Pixels:
    """Blocks of 2^level × 2^level pixels as their means, see `engine.base.Reader`; the last ones may be smaller."""
    side = 1 << level
    height, width = (-(-n // side) for n in pixels.shape[1:])
    out, good = np.empty((len(pixels), height, width), pixels.dtype), np.empty((height, width), bool)
    mask = np.empty((0, 0), bool) if valid is None else np.require(valid, bool, ("C", "A", "W"))
    reduce_means(np.require(pixels, None, ("C", "A", "W")), mask, side, pixels.dtype.kind != "f", out, good)
    return out, None if valid is None or good.all() else good


def reduced(reader: FullSize, window: Window, level: int) -> Pixels:
    """A window of an image that is reduced by 2^level, from its pixels of full size, some rows at a time.

    For readers that know no better way: those whose pixels are made of others by steps, and files without overviews.
    """
    if level == 0:
        return reader.read(window)
    whole = Window(0, 0, *reader.size)
    across = Window(window.col << level, 0, window.width << level, whole.height) & whole
    rows = max(1, CHUNK // ((across.width << level) * reader.bands * reader.dtype.itemsize))
    parts = []
    for row in range(window.row, window.stop[1], rows):
        end = min(row + rows, window.stop[1])
        full = Window(across.col, row << level, across.width, (end - row) << level) & whole
        parts.append(means(*reader.read(full), level))
    values = np.concatenate([part[0] for part in parts], axis=1)
    if all(part[1] is None for part in parts):
        return values, None
    return values, np.concatenate([np.ones(v.shape[1:], bool) if m is None else m for v, m in parts])
