"""A terrain file as a surface, whatever its kind: what the commands on terrain start from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from photoplan.errors import InputError
from photoplan.io.terrain_reader import TerrainReader
from photoplan.surfaces.raster import RasterSurface

__all__ = ["OpenTerrain", "open_terrain"]


@dataclass(frozen=True, eq=False)
class OpenTerrain:
    """A terrain model in its own CRS."""

    path: Path
    surface: RasterSurface
    bounds: tuple[float, float, float, float]
    """Outer edges xmin, ymin, xmax, ymax, metres."""
    crs: str
    height_system: str | None
    """As the file gives it; None: not stated."""
    resolution: float
    """Mesh width, of a hybrid model the finest, metres."""


def open_terrain(path: Path, crs: str | None = None) -> OpenTerrain:
    """Open a terrain model.

    Parameters
    ----------
    path : Path
        A GeoTIFF of heights.
    crs : str, optional
        CRS of a file that does not state its own.

    Raises
    ------
    InputError
        The file is no terrain model, its CRS is unknown, or it is in feet or in degrees.
    """
    reader = TerrainReader(path)
    info = reader.info
    assert info.to_map is not None
    found = info.crs or crs
    if found is None:
        raise InputError(f"{path}: no CRS; state it with --crs EPSG:nnnn, it is not guessed")
    if info.metres_per_unit not in (None, 1.0):
        raise InputError(f"{path}: heights in {info.unit}; convert them to metres first")
    x0, xx, xy, y0, yx, yy = info.to_map
    if xy or yx or xx <= 0 or yy >= 0:
        raise InputError(f"{path}: the grid is rotated or not north-up; bring it north-up with gdalwarp first")
    columns, rows = info.size
    bounds = (x0 - xx / 2, y0 + yy * (rows - 0.5), x0 + xx * (columns - 0.5), y0 - yy / 2)
    surface = RasterSurface(reader, (x0, y0), (xx, -yy))
    return OpenTerrain(path, surface, bounds, found, info.vertical_crs, min(xx, -yy))
