"""A terrain file as a surface, whatever its kind: what the commands on terrain start from."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from photoplan.errors import GeometryError, InputError, UsageError, named_by
from photoplan.geometry.bounds import bounds_fault
from photoplan.geometry.crs import (
    CrsStep,
    crs_label,
    crs_step,
    middle_longitude,
    nearest_turn,
    parse_crs,
    require_projected_metres,
    same_crs,
    split_compound,
    turn_of,
)
from photoplan.geometry.heights import require_metric_heights
from photoplan.io.surface_file import target_of
from photoplan.io.terrain.known_ranges import KnownRanges
from photoplan.io.terrain.model_read import ModelReader, is_terrain_model
from photoplan.io.terrain.reader import TerrainReader
from photoplan.surfaces.height_errors import HeightErrors, ModelHeightErrors
from photoplan.surfaces.hybrid import HybridSurface
from photoplan.surfaces.raster import RasterSurface


@dataclass(frozen=True, eq=False)
class OpenTerrain:
    """A terrain model in its own CRS, or placed in another one."""

    path: Path
    surface: RasterSurface | HybridSurface
    bounds: tuple[float, float, float, float]
    """Outer edges xmin, ymin, xmax, ymax, metres."""
    crs: str
    height_system: str | None
    """As the file gives it; None: not stated."""
    resolution: float
    """Mesh width, of a hybrid model the finest, metres."""
    model: ModelReader | None = None
    """The file of a hybrid model, with its units, lines and figures; None: a raster of heights."""

    @property
    def errors(self) -> HeightErrors | None:
        """What its file knows of the errors of its heights; None: nothing."""
        return ModelHeightErrors(self.surface) if isinstance(self.surface, HybridSurface) else None

    def refuse_apart(self, bounds: tuple[float, float, float, float]) -> None:
        """Refuse bounds xmin, ymin, xmax, ymax that do not meet the terrain."""
        if (fault := bounds_fault(bounds, self.crs, self.bounds)) is not None and turn_of(self.crs) is None:
            raise UsageError(f"{fault} ({self.path})")
        a, b = self.bounds, bounds
        turn = turn_of(self.crs) or 0.0
        if not any(
            a[0] < b[2] + k * turn and b[0] + k * turn < a[2] and a[1] < b[3] and b[1] < a[3] for k in (-1, 0, 1)
        ):
            asked, covered = (" ".join(f"{v:.10g}" for v in each) for each in (b, a))
            raise GeometryError(f"bounds {asked} do not meet {self.path}, which covers {covered}")

    def in_crs(self, crs: str) -> tuple[OpenTerrain, tuple[CrsStep, ...]]:
        """The same terrain with its surface in another CRS, and the coordinate operation that leads to the file's."""
        if same_crs(self.crs, crs):
            return self, ()
        with named_by(self.path):
            back = crs_step(self.crs, crs, self.bounds)
        t = np.linspace(0, 1, 17)
        xmin, ymin, xmax, ymax = self.bounds
        x, y = xmin + t * (xmax - xmin), ymin + t * (ymax - ymin)
        # A grid of half the world reaches beyond most maps.
        corners = back.where_defined(np.stack(np.meshgrid(x, y), axis=-1)).reshape(-1, 2)
        corners = corners[np.isfinite(corners).all(axis=1)]
        if not len(corners):
            raise InputError(f"{self.path}: nothing of its area has coordinates in {crs_label(crs)}; is the CRS right?")
        low, high = corners.min(axis=0), corners.max(axis=0)
        bounds = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        with named_by(self.path):
            step = crs_step(crs, self.crs, bounds, self._about(crs))
        surface: RasterSurface | HybridSurface
        if isinstance(self.surface, RasterSurface):
            surface = replace(self.surface, to_grid_crs=step)
        else:
            assert self.model is not None
            surface = HybridSurface(self.model, step)
        return replace(self, surface=surface, bounds=bounds, crs=crs), (step,)

    def _about(self, crs: str) -> float | None:
        """X about which places of another CRS are counted in that of the terrain; None: it does not go round."""
        turn = turn_of(self.crs)
        if turn is None:
            return None
        middle, longitude = (self.bounds[0] + self.bounds[2]) / 2, middle_longitude(crs)
        if longitude is None or self.bounds[2] - self.bounds[0] < 0.9 * turn or not parse_crs(self.crs).is_geographic:
            return middle
        # A grid that goes round the earth is cut opposite of the map's middle.
        return float(nearest_turn(longitude / 360.0 * turn, middle, turn))


def open_terrain(
    path: Path,
    crs: str | None = None,
    option: str = "with `crs` EPSG:nnnn",
    height_system: str | None = None,
    *,
    default_crs: str | None = None,
) -> OpenTerrain:
    """Open a terrain model.

    Parameters
    ----------
    path : Path
        A model of `photoplan dtm build`, or a GeoTIFF of heights.
    crs : str, optional
        Declared CRS of a file that does not state its own; a file that states another one is refused.
    option : str, optional
        How a user states it, for the message.
    height_system : str, optional
        Declared height system; its unit is that of a raster's heights. All heights and coordinates are returned in
        metres, whatever the units of the file are.
    default_crs : str, optional
        CRS of a file that does not state its own if none is declared; a file may state another one.

    Raises
    ------
    InputError
        The file is no terrain model, its CRS is unknown, or its units are unknown or contradict each other.
    """
    path = Path(path)
    if path.suffix.lower() == ".gpkg" or is_terrain_model(path):
        reader = ModelReader(path)
        header = reader.header
        require_projected_metres(header.crs, f"{path}: CRS")
        _refuse_other(path, header.crs, crs)
        if height_system is not None:
            require_metric_heights(height_system, f"{path}: a terrain model is in metres; declared height system")
        return OpenTerrain(
            path=path,
            surface=HybridSurface(reader),
            bounds=reader.layout.bounds,
            crs=header.crs,
            height_system=header.height_system,
            resolution=reader.finest,
            model=reader,
        )
    raster = TerrainReader(path, crs or default_crs, height_system)
    _refuse_other(path, raster.info.crs, crs)
    return _of_raster(path, raster, option)


def _refuse_other(path: Path, stated: str | None, declared: str | None) -> None:
    """Refuse a declared CRS that is not the one which the file states."""
    if stated is not None and declared is not None and not same_crs(stated, declared):
        raise InputError(
            f"{path}: states {crs_label(split_compound(stated)[0] or stated)}, declared is {crs_label(declared)}; "
            "leave the declaration out, or correct the file (`gdal_edit.py -a_srs`)"
        )


def _of_raster(path: Path, reader: TerrainReader, option: str) -> OpenTerrain:
    info = reader.info
    assert info.to_map is not None
    target = target_of(info.path, info.driver)
    if target is not None:
        raise InputError(
            f"{path}: heights over {target}, which is no map and no terrain; let `photoplan surface` write them as "
            "points, too, and build a terrain of these"
        )
    if reader.system is None:
        raise InputError(f"{path}: no CRS; state it {option}, it is not guessed")
    x0, xx, xy, y0, yx, yy = (reader.system.scale * value for value in info.to_map)
    if xy or yx or xx <= 0 or yy >= 0:
        raise InputError(f"{path}: the grid is rotated or not north-up; bring it north-up with gdalwarp first")
    columns, rows = info.size
    bounds = (x0 - xx / 2, y0 + yy * (rows - 0.5), x0 + xx * (columns - 0.5), y0 - yy / 2)
    surface = RasterSurface(
        reader, (x0, y0), (xx, -yy), part=reader.block, store=KnownRanges.of(reader), turn=turn_of(reader.system.crs)
    )
    return OpenTerrain(
        path=info.path,
        surface=surface,
        bounds=bounds,
        crs=reader.system.crs,
        height_system=reader.system.heights,
        resolution=min(xx, -yy),
    )
