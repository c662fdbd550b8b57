"""The ground of a project: terrain and heights."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
from photoplan.geometry.heights import HeightStep, declared_pair, height_step, require_metric_heights
from photoplan.geometry.units import metric_heights
from photoplan.io.disk import target_of
from photoplan.io.files import resolve_input
from photoplan.io.project.model import Objects, Project, StatedTerrain
from photoplan.io.raster import TerrainReader
from photoplan.io.terrain.model import ModelReader, is_terrain_model
from photoplan.io.terrain.options import KnownRanges
from photoplan.surfaces.base import LevelSurface, Terrain
from photoplan.surfaces.hybrid import HeightErrors, HybridSurface, ModelHeightErrors
from photoplan.surfaces.objects import ObjectSurface, without_objects
from photoplan.surfaces.raster import RasterSurface
from photoplan.surfaces.shifted import ShiftedSurface


@dataclass(frozen=True, eq=False)
class OpenTerrain:
    """A terrain model in its own CRS, or placed in another one."""

    path: Path
    surface: RasterSurface | HybridSurface
    bounds: tuple[float, float, float, float]
    """Outer edges xmin, ymin, xmax, ymax, metres."""
    crs: str
    height_system: str | None
    """Height system as the file gives it; None if not stated."""
    resolution: float
    """Mesh width, of a hybrid model the finest, metres."""
    model: ModelReader | None = None
    """The file of a hybrid model, with its units, lines and figures; None: a raster of heights."""

    @property
    def errors(self) -> HeightErrors | None:
        """Return what its file states of the errors of its heights; None if nothing."""
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


@dataclass(frozen=True, eq=False)
class Ground:
    """The terrain of a project with its objects, in the project's CRS and the orientation's height system."""

    surface: Terrain
    """With objects: an `ObjectSurface` if there are some."""
    bounds: tuple[float, float, float, float] | None
    """Outer edges xmin, ymin, xmax, ymax; None: everywhere."""
    file: Path | None
    """The height raster or terrain model."""
    operations: tuple[CrsStep | HeightStep, ...]
    """Coordinate operations on the way from the file, for the run record."""
    height_systems: tuple[str, str]
    """Height systems of the terrain file and of the orientation, as declared or read."""
    working_system: str
    """The one that surface and cameras are in."""

    @property
    def bare(self) -> Terrain:
        """The surface without objects."""
        return without_objects(self.surface)

    def into_working(self, crs: str, stated: str | None = None) -> HeightStep:
        """From heights in a stated system, else the orientation's, to those of surface and cameras, at points of the
        project's CRS."""
        return height_step(stated or self.height_systems[1], self.working_system, crs, self.bounds)

    def out_of_working(self, crs: str) -> HeightStep:
        """Back again, as whoever states heights in a project, or reads them, expects them."""
        return height_step(self.working_system, self.height_systems[1], crs, self.bounds)

    def is_open(self, XY: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether no object stands at map points (..., 2) or hangs over them, shape (...)."""
        if not isinstance(self.surface, ObjectSurface):
            return np.ones(XY.shape[:-1], bool)
        return np.isneginf(self.surface.faces.heights(XY))


@dataclass(frozen=True)
class _GroundAddress:
    """Values that decide the ground of a project; hashable."""

    terrain: StatedTerrain
    orientation_system: str | None
    to_ellipsoid: bool
    crs: str
    folder: str
    stamps: tuple[tuple[int, int], ...]
    """Size and time of each file: files that change are opened again."""
    objects: tuple[Objects, ...] = ()


def ground_of(project: Project) -> Ground:
    """The terrain of a project with its objects, in the project's CRS and the height system that the cameras
    work in.
    """
    orientation = project.orientation
    strict = orientation.earth_curvature == "strict"
    files = [*([] if project.ground.file is None else [project.ground.file]), *(o.file for o in project.objects)]
    stamps = tuple(stamp_of(project.resolve(file)) for file in files)
    folder = str(project.folder)
    return _ground(
        _GroundAddress(
            terrain=project.ground,
            orientation_system=project.height_system,
            to_ellipsoid=strict,
            crs=project.crs,
            folder=folder,
            stamps=stamps,
            objects=project.objects,
        )
    )


@lru_cache(maxsize=8)
def _ground(address: _GroundAddress) -> Ground:
    if address.objects:
        # A project without objects does not need the libraries of vector data.
        from photoplan.project.objects import Place, with_objects  # noqa: PLC0415

        bare = _ground(replace(address, objects=(), stamps=address.stamps[: -len(address.objects)]))
        place = Place(address.crs, bare.working_system, bare.height_systems[0], bare.bounds)
        files = [(resolve_input(Path(address.folder), stated.file), stated) for stated in address.objects]
        surface, steps = with_objects(bare.surface, files, place)
        return replace(bare, surface=surface, operations=(*bare.operations, *steps))
    terrain = address.terrain
    if terrain.height is not None:
        systems = declared_pair(terrain.height_system, address.orientation_system)
        return _in_system(
            Ground(
                surface=LevelSurface(terrain.height * metric_heights(terrain.height_system or "same")[1]),
                bounds=None,
                file=None,
                operations=(),
                height_systems=systems,
                working_system=systems[1],
            ),
            address,
        )
    assert terrain.file is not None
    path = resolve_input(Path(address.folder), terrain.file)
    own = open_terrain(path, terrain.crs, 'as crs = "EPSG:nnnn" in [terrain]', terrain.height_system)
    systems = declared_pair(terrain.height_system or own.height_system, address.orientation_system)
    placed, steps = own.in_crs(address.crs)
    return _in_system(
        Ground(
            surface=placed.surface,
            bounds=placed.bounds,
            file=placed.path,
            operations=steps,
            height_systems=systems,
            working_system=systems[1],
        ),
        address,
    )


def _in_system(ground: Ground, address: _GroundAddress) -> Ground:
    """The ground with heights in the system that the cameras work in."""
    terrain, orientation = ground.height_systems
    wanted = "ellipsoidal" if address.to_ellipsoid and orientation != "same" else orientation
    step = height_step(terrain, wanted, address.crs, ground.bounds)
    if step.definition is None:
        return replace(ground, working_system=wanted)
    surface = ShiftedSurface(ground.surface, _Undulation(step, ground.bounds))
    return replace(ground, surface=surface, operations=(*ground.operations, step), working_system=wanted)


@dataclass(frozen=True)
class _Undulation:
    """Heights that a height step adds at map points.

    Rays and tiles reach beyond the terrain, where the grid of the step may have ended: the next place of the terrain
    counts there. A place inside that the grid does not cover is an error.
    """

    step: HeightStep
    bounds: tuple[float, float, float, float] | None
    """Bounds of the terrain; None if it is everywhere."""

    def __call__(self, XY: NDArray[np.float64]) -> NDArray[np.float64]:
        XYZ = np.concatenate([XY, np.zeros((*XY.shape[:-1], 1))], axis=-1)
        if self.bounds is None:
            return self.step(XYZ)
        out = self.step.where_defined(XYZ)
        lost = np.isnan(out)
        XYZ[lost, :2] = np.clip(XYZ[lost, :2], self.bounds[:2], self.bounds[2:])
        out[lost] = self.step(XYZ[lost])
        return out


def stamp_of(path: Path) -> tuple[int, int]:
    """Size and time of a file."""
    try:
        state = path.stat()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check that it is there and readable") from error
    return state.st_size, state.st_mtime_ns
