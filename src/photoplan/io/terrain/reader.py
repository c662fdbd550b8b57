"""Heights of a grid terrain model that may be larger than memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.geometry.units import (
    MetricSystem,
    agreed_metres,
    metres_in,
    metric_system,
    unit_label,
)
from photoplan.io.files import TERRAIN_LIMITS, RasterLimits
from photoplan.io.raster import USUAL_NODATA, BlockCache, MissingBlocks, missing_blocks, read_pixels
from photoplan.io.raster_info import RasterInfo, read_info

LOWEST, HIGHEST = -12_000.0, 9_000.0
"""Heights of the Earth, metres: below the deepest sea, above the highest mountain."""
TERRAIN_TYPES = ("uint8", "int16", "uint16", "int32", "uint32", "float32", "float64")
"""Types of stored heights."""

_BLOCK = 256
_VOID = 1e30
"""Numbers of this size (±3.4e38 of many programs) are never heights."""
_PLAIN = -9_000.0
"""Above this, metres, no value can be a usual nodata value."""


@dataclass(frozen=True, eq=False)
class TerrainReader:
    """One band of heights, delivered as float32 with NaN where there is none.

    Scale and offset of the file are applied, and heights are brought into metres upwards from the unit of the band, of
    the reference system, or of the declared height system. Overviews are not used. Blocks that were read are kept up
    to `cache_bytes`, least recently used ones are forgotten first. Safe to call from several threads and to pickle (the
    cache stays behind).

    Nodata, alpha, mask and blocks that were never written follow the rule of `photoplan.io.raster`; NaN and values
    of ±1e30 and more are void as well. Other values that are no height on Earth (below -12 000 m or above 9 000 m), and
    the usual nodata values where none is declared, are refused with their count.
    """

    path: Path
    """The file."""
    crs: str | None = None
    """CRS of a file that states none."""
    height_system: str | None = None
    """Declared height system: it is used instead of the file's."""
    cache_bytes: int = 64 << 20
    """Bytes of blocks that are kept."""
    limits: RasterLimits = TERRAIN_LIMITS
    """How much the header may promise."""
    allow_remote: bool = False
    """Follow virtual rasters, `/vsi…` paths and URLs."""
    info: RasterInfo = field(init=False, repr=False)
    """Facts of the file."""
    system: MetricSystem | None = field(init=False, repr=False)
    """Reference system in metres, and what leads the file's coordinates there; None: no CRS is stated or declared."""
    metres: float = field(init=False, repr=False)
    """Metres upwards in the unit of the file's heights; negative for depths."""
    _missing: MissingBlocks | None = field(init=False, repr=False)
    _cache: BlockCache = field(init=False, repr=False)

    def __post_init__(self) -> None:
        info = read_info(self.path, limits=self.limits, allow_remote=self.allow_remote)
        if len(info.colour_bands) != 1 or info.palette:
            raise InputError(f"{info.path}: {len(info.colours)} bands or a palette; a terrain grid has one band")
        if info.dtype not in TERRAIN_TYPES:
            raise InputError(
                f"{info.path}: heights of type {info.dtype}; allowed are {', '.join(TERRAIN_TYPES)}. "
                "Convert it with `gdal_translate -ot Float32`"
            )
        if info.to_map is None:
            raise InputError(f"{info.path}: the grid is not georeferenced; give it a world file or a geotransform")
        if info.contradiction is not None:
            raise InputError(f"{info.path}: {info.contradiction}")
        if not (info.scales[0] != 0 and np.isfinite([info.scales[0], info.offsets[0]]).all()):
            raise InputError(f"{info.path}: scale {info.scales[0]} and offset {info.offsets[0]} make no heights")
        object.__setattr__(self, "path", info.path)
        object.__setattr__(self, "info", info)
        object.__setattr__(self, "system", self._reference(info))
        object.__setattr__(self, "metres", self._unit(info))
        object.__setattr__(self, "_missing", missing_blocks(info))
        object.__setattr__(self, "_cache", BlockCache(self.cache_bytes))

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_cache"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        object.__setattr__(self, "_cache", BlockCache(self.cache_bytes))

    def _reference(self, info: RasterInfo) -> MetricSystem | None:
        stated = info.crs or self.crs
        if stated is None:
            return None
        system = metric_system(stated, f"{info.path}: CRS")
        return system.declaring(self.height_system, f"{info.path}: declared height system")

    def _unit(self, info: RasterInfo) -> float:
        """Metres upwards in a unit of the file's heights."""
        where = f"{info.path}: heights"
        own = metric_system(info.crs, where) if info.crs is not None else None
        stated = None if info.band_unit is None else metres_in(info.band_unit, f"{where}: unit of the band")
        if stated is not None and own is not None and own.heights is not None:
            agreed_metres(stated, own.height_scale, where, in_one_file=True)
        elif stated is None and own is not None and own.heights is not None:
            stated = abs(own.height_scale or 1.0)
        system = 1.0 if self.system is None else self.system.height_scale
        return agreed_metres(stated, system, where, in_one_file=False)

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows of the grid."""
        return self.info.size

    def read(self, window: Window) -> NDArray[np.float32]:
        """Heights of a window inside the grid, shape (height, width), metres; NaN where there is none."""
        width, height = self.info.size
        right, bottom = window.stop
        if window.size == 0 or window.col < 0 or window.row < 0 or right > width or bottom > height:
            raise UsageError(f"{self.path}: {window} is not inside the grid of {width} × {height} points")
        out = np.empty((window.height, window.width), np.float32)
        block_width, block_height = self.block
        for row in range(window.row // block_height, -(-bottom // block_height)):
            for col in range(window.col // block_width, -(-right // block_width)):
                area = Window(col * block_width, row * block_height, block_width, block_height)
                part = area & window
                block = self._cache.get((col, row), partial(self._load, area & Window(0, 0, width, height)))
                source = block[part.row - area.row :, part.col - area.col :][: part.height, : part.width]
                out[part.row - window.row :, part.col - window.col :][: part.height, : part.width] = source
        return out

    def pixel(self, col: int, row: int) -> float:
        """Height of one grid point, metres; NaN if there is none."""
        return float(self.read(Window(col, row, 1, 1))[0, 0])

    @property
    def block(self) -> tuple[int, int]:
        """Width and height of the blocks that are kept: the file's tiles, or whole lines of about 2^16 points."""
        width, height = self.info.block
        if width * height > 16 * _BLOCK * _BLOCK and height > 1:
            return _BLOCK, _BLOCK
        if width < self.info.size[0] and width * height >= _BLOCK * _BLOCK // 4:
            return width, height
        return self.info.size[0], max(height, min(_BLOCK, max(1, _BLOCK * _BLOCK // self.info.size[0])))

    def _load(self, window: Window) -> NDArray[np.float32]:
        """Read and check a block."""
        pixels, valid = read_pixels(self.info, window, self._missing)
        stored = pixels[0]
        plain = valid is None and (self.info.scales[0], self.info.offsets[0], self.metres) == (1.0, 0.0, 1.0)
        if plain and float(stored.min()) > _PLAIN and float(stored.max()) < HIGHEST:
            return stored.astype(np.float32, copy=False)
        heights = stored.astype(np.float64) * self.info.scales[0] + self.info.offsets[0]
        void = ~(np.abs(heights) < _VOID)
        heights *= self.metres
        if valid is not None:
            void |= ~valid
        self._check_range(stored, heights, void, window)
        heights[void] = np.nan
        return heights.astype(np.float32)

    def _check_range(
        self, stored: NDArray[Any], heights: NDArray[np.float64], void: NDArray[np.bool_], window: Window
    ) -> None:
        """Refuse values that are no heights."""
        wrong = ~void & ((heights < LOWEST) | (heights > HIGHEST))
        if self.info.nodata is None:
            wrong |= ~void & np.isin(stored, USUAL_NODATA)
        if not wrong.any():
            return
        value, raw = float(heights[wrong][0]), stored[wrong][0]
        unit = self.info.band_unit or ("metres" if self.metres == 1.0 else unit_label(self.metres))
        what = f"declare the nodata value (`gdal_edit.py -a_nodata {raw:g}`)"
        if raw not in USUAL_NODATA:
            what = (
                f"if {raw:g} marks missing heights, {what}; else state their unit (`gdal_edit.py -units`, now {unit})"
            )
        raise InputError(
            f"{self.path}: {int(wrong.sum())} values in window col {window.col} row {window.row} {window.width} × "
            f"{window.height} are no heights (allowed {LOWEST:g} to {HIGHEST:g} m), for one {value:g} m; {what}"
        )
