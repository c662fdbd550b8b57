"""The ground of a project: terrain, objects and heights, on the map or on a target."""

from __future__ import annotations

import math
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
from photoplan.geometry.frames import Frame
from photoplan.geometry.heights import HeightStep, declared_pair, height_step, require_metric_heights
from photoplan.geometry.units import metric_heights
from photoplan.io.disk import target_of
from photoplan.io.files import resolve_input
from photoplan.io.project.model import Objects, PlacedTarget, Project, StatedTerrain
from photoplan.io.raster import TerrainReader
from photoplan.io.terrain.model import ModelReader, is_terrain_model
from photoplan.io.terrain.options import KnownRanges
from photoplan.surfaces.base import LevelSurface, Terrain
from photoplan.surfaces.hybrid import HeightErrors, HybridSurface, ModelHeightErrors
from photoplan.surfaces.objects import Faces, ObjectSurface, without_objects
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
    target = target_of(reader.info.path, reader.info.driver)
    if target is not None:
        raise InputError(
            f"{path}: heights over {target}, which is no map and no terrain; let `photoplan surface` write them as "
            "points, too, and build a terrain of these"
        )
    if reader.system is None:
        raise InputError(f"{path}: no CRS; state it {option}, it is not guessed")
    return _placed_raster(path, reader, reader.system.scale, reader.system.crs)


def _placed_raster(path: Path, reader: TerrainReader, scale: float, crs: str) -> OpenTerrain:
    """A raster of heights in a plane, whose units are so many metres; the plane of a target has no CRS, an empty
    one."""
    info = reader.info
    assert info.to_map is not None
    x0, xx, xy, y0, yx, yy = (scale * value for value in info.to_map)
    if xy or yx or xx <= 0 or yy >= 0:
        raise InputError(f"{path}: the grid is rotated or not north-up; bring it north-up with gdalwarp first")
    columns, rows = info.size
    bounds = (x0 - xx / 2, y0 + yy * (rows - 0.5), x0 + xx * (columns - 0.5), y0 - yy / 2)
    turn = turn_of(crs) if crs else None
    surface = RasterSurface(reader, (x0, y0), (xx, -yy), part=reader.block, store=KnownRanges.of(reader), turn=turn)
    return OpenTerrain(
        path=info.path,
        surface=surface,
        bounds=bounds,
        crs=crs,
        height_system=None if reader.system is None else reader.system.heights,
        resolution=min(xx, -yy),
    )


def open_relief(path: Path) -> tuple[OpenTerrain, str | None]:
    """Open a raster of offsets from a target's frame; also return the frame that it states, None if it states none."""
    reader = TerrainReader(path)
    if reader.system is not None:
        raise InputError(f"{path}: states a CRS, so that it lies on the map; a relief of a target has none")
    return _placed_raster(path, reader, 1.0, ""), target_of(reader.info.path, reader.info.driver)


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


#: Faces of objects on a frame that bends lines are cut until they are straight to this part of a turn, or there are so
#: many pieces.
_BENT, _MOST_PIECES = 2e-5, 200_000


def target_ground(project: Project) -> Ground:
    """The surface of a project's target in the coordinates of its frame, with the project's objects as occluders."""
    assert project.target is not None
    relief = project.target.relief
    stamp = stamp_of(project.resolve(relief)) if isinstance(relief, str) else (0, 0)
    # The cache of grounds is keyed by the project's own files, so that this one follows them.
    return _target_ground(ground_of(project), project.target, str(project.folder), stamp)


@lru_cache(maxsize=8)
def _target_ground(ground: Ground, target: PlacedTarget, folder: str, _stamp: tuple[int, int]) -> Ground:
    surface: Terrain
    file = None
    if isinstance(target.relief, str):
        opened, _ = open_relief(resolve_input(Path(folder), target.relief))
        surface, file = opened.surface, opened.path
    else:
        surface = LevelSurface(target.relief)
    if isinstance(ground.surface, ObjectSurface):
        faces = _faces_on(ground.surface.faces, target.space)
        surface = surface if faces is None else replace(ground.surface, ground=surface, faces=faces, part=None)
    return replace(ground, surface=surface, bounds=target.bounds, file=file)


def _faces_on(faces: Faces, frame: Frame) -> Faces | None:
    """Faces of objects in the coordinates of a frame, cut until they follow its bends; they only hide what lies behind
    them. None if the frame has none of them."""
    corners, owner, turn = faces.corners, faces.owner, frame.turn
    uvh = frame.inverse(corners)
    while math.isfinite(turn) and len(corners) < _MOST_PIECES:
        uvh[..., 0] -= turn * np.round((uvh[..., 0] - uvh[:, :1, 0]) / turn)
        middles = (corners + np.roll(corners, -1, axis=1)) / 2
        off = frame.inverse(middles) - (uvh + np.roll(uvh, -1, axis=1)) / 2
        off[..., 0] -= turn * np.round(off[..., 0] / turn)
        long = np.linalg.norm(off, axis=-1).max(axis=1) > _BENT * turn
        if not long.any():
            break
        (a, b, c), (ab, bc, ca) = (np.moveaxis(points[long], 1, 0) for points in (corners, middles))
        four = np.stack([(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)])
        corners = np.concatenate([corners[~long], four.swapaxes(1, 2).reshape(-1, 3, 3)])
        owner, uvh = np.concatenate([owner[~long], np.tile(owner[long], 4)]), frame.inverse(corners)
    if math.isfinite(turn):
        # What lies across the seam of the frame is on both of its sides.
        uvh[..., 0] -= turn * np.round((uvh[..., 0] - uvh[:, :1, 0]) / turn)
        uvh, owner = np.concatenate([uvh + np.array([k * turn, 0.0, 0.0]) for k in (-1, 0, 1)]), np.tile(owner, 3)
        seam = (uvh[..., 0].min(axis=1) <= turn / 2) & (uvh[..., 0].max(axis=1) >= -turn / 2)
        uvh, owner = uvh[seam], owner[seam]
    known = np.isfinite(uvh).all(axis=(1, 2))
    if not known.any():
        return None
    return Faces(uvh[known], np.zeros(int(known.sum()), bool), owner[known], faces.names)


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
