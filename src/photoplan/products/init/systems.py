"""CRS and height systems of a project that is made, and its terrain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import HeightSystemError, InputError, UsageError, named_by
from photoplan.geometry.crs import (
    canonical_crs,
    crs_label,
    crs_step,
    grid_rotation,
    parse_crs,
    require_projected_metres,
    same_crs,
    topocentric_poses,
    utm_codes,
)
from photoplan.geometry.heights import check_height_system, declared_pair, height_label, height_step
from photoplan.geometry.units import metric_heights, unit_label
from photoplan.io.names import check_input_name, relative_path
from photoplan.io.orientation.table import OrientationTable, degrees_of
from photoplan.io.plain_files import crs_beside
from photoplan.io.project.model import StatedTerrain
from photoplan.io.raster_info import read_info
from photoplan.io.terrain.model_read import ModelReader, is_terrain_model


class Systems(Protocol):
    """What is declared; `photoplan.products.init.run.InitRequest` tells of each."""

    @property
    def folder(self) -> Path:
        """Folder of the project."""
        ...

    @property
    def terrain(self) -> str | None:
        """Raster of heights, or one height."""
        ...

    @property
    def crs(self) -> str | None:
        """CRS of the project."""
        ...

    @property
    def height_system(self) -> str | None:
        """Of whatever does not state one."""
        ...

    @property
    def terrain_crs(self) -> str | None:
        """CRS of a terrain file that states none."""
        ...

    @property
    def terrain_height_system(self) -> str | None:
        """The terrain's alone."""
        ...

    @property
    def orientation_height_system(self) -> str | None:
        """The orientation's alone."""
        ...


@dataclass(frozen=True)
class TerrainSource:
    """What a terrain file states of its systems."""

    path: Path
    crs: str | None
    vertical_crs: str | None


def _terrain_facts(file: Path) -> TerrainSource:
    if is_terrain_model(file):
        header = ModelReader(file).header
        return TerrainSource(file, header.crs, header.height_system)
    info = read_info(file)
    return TerrainSource(info.path, info.crs, info.height_system)


def terrain_entry(request: Systems) -> tuple[StatedTerrain | None, TerrainSource | None]:
    """The terrain entry (height system still open) and the facts of its file."""
    if request.terrain is None:
        return None, None
    text = request.terrain.strip()
    try:
        return StatedTerrain(height=float(text)), None
    except ValueError:
        pass
    check_input_name(text)
    file = Path(text)
    info = _terrain_facts(file)
    if info.crs is None and request.terrain_crs is None:
        raise InputError(f"terrain {file}: states no CRS; say the one it is in: `terrain_crs` EPSG:nnnn")
    stated = info.crs or request.terrain_crs
    parse_crs(stated or "", f"terrain {file}")
    if info.crs is not None and request.terrain_crs is not None and not same_crs(info.crs, request.terrain_crs):
        raise InputError(
            f"terrain {file}: states {crs_label(info.crs)}, not {request.terrain_crs}; leave `terrain_crs` out"
        )
    crs = None if info.crs is not None else request.terrain_crs
    return StatedTerrain(file=relative_path(file.absolute(), request.folder), crs=crs), replace(info, crs=stated)


def project_crs(
    request: Systems,
    table: OrientationTable | None,
    terrain: TerrainSource | None,
    place: tuple[float, float] | None = None,
) -> tuple[str, str]:
    """The project's CRS and where it comes from; `place` is the latitude and longitude of a satellite image,
    degrees.
    """
    if request.crs is not None:
        crs, source = request.crs, "as given"
    elif table is None and place is not None:
        crs, source = _map_of(terrain) or (utm_codes(*place)[0], "UTM zone of the images")
    elif table is None:
        raise InputError(
            "without an orientation nothing states the CRS of the project; declare that of the control points with "
            "`crs` EPSG:nnnn"
        )
    elif table.crs is not None:
        crs, source = table.crs, f"from {(table.crs_file or table.file).name}"
    elif table.origin is not None and terrain is not None and terrain.crs is not None:
        crs, source = _horizontal(terrain.crs), f"from {terrain.path.name}"
    else:
        raise InputError(f"{table.file}: does not state the CRS of its coordinates; declare it with `crs` EPSG:nnnn")
    require_projected_metres(crs, f"CRS ({source})")
    return canonical_crs(crs), source


def _map_of(terrain: TerrainSource | None) -> tuple[str, str] | None:
    """The CRS of a terrain file, if products can be in it."""
    if terrain is None or terrain.crs is None:
        return None
    crs = _horizontal(terrain.crs)
    try:
        require_projected_metres(crs)
    except InputError:
        return None
    return crs, f"from {terrain.path.name}"


def _horizontal(text: str) -> str:
    crs = parse_crs(text)
    return str((crs.sub_crs_list[0] if crs.is_compound else crs).to_wkt())


def height_systems(
    request: Systems, table: OrientationTable | None, terrain: TerrainSource | None, ellipsoidal: bool = False
) -> tuple[str | None, str]:
    """Height systems of terrain and orientation (with that of control): as declared, else as the files state.

    That of images which bring their geometry along is `ellipsoidal`.
    """
    stated_terrain = terrain.vertical_crs if terrain is not None else None
    stated_table = table.height_system if table is not None else "ellipsoidal" if ellipsoidal else None
    stated = [
        request.terrain_height_system or stated_terrain or request.height_system,
        request.orientation_height_system or stated_table or request.height_system,
    ]
    if request.height_system is not None:
        declared = check_height_system(request.height_system, "`height_system`")
        of_files = [s for s in (stated_terrain, stated_table) if s is not None]
        if len(of_files) == 2 and declared not in [check_height_system(s) for s in of_files]:
            raise UsageError(
                f"`height_system` {request.height_system}: both files state theirs "
                f"({height_label(stated[0])}; {height_label(stated[1])}); to overrule a file use "
                "`terrain_height_system` or `orientation_height_system`"
            )
    terrain_system, orientation_system = stated
    if request.terrain is not None:
        metric, of_images = declared_pair(terrain_system, orientation_system)
        # The project states the unit of the terrain's heights; those of images are converted by `in_declared_unit`.
        own = check_height_system(terrain_system or "same")
        return metric if metric_heights(own)[1] == 1.0 else own, of_images
    if orientation_system is None:
        raise HeightSystemError(
            "height system of control points and orientation not stated → declare it with `height_system`: "
            "ellipsoidal, EPSG:nnnn (a vertical CRS, such as EPSG:5773 for EGM96), or same (as that of all heights)"
        )
    return None, metric_heights(check_height_system(orientation_system, "orientation"))[0]


def placed(table: OrientationTable, crs: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Projection centres (n, 3) and ω, φ, κ in degrees (n, 3) in the project's CRS."""
    if table.origin is not None:
        with named_by(table.file):
            centers, axes = topocentric_poses(table.origin, crs, table.centers)
        return centers, degrees_of(axes @ table.rotations)
    if table.crs is None or same_crs(table.crs, crs):
        return table.centers, table.opk_degrees()
    source = parse_crs(table.crs)
    if not source.is_projected:
        raise InputError(
            f"{table.file}: positions are in {crs_label(table.crs)}, which is not projected, so angles have no axes "
            "to refer to; transform the orientation into a projected CRS beforehand"
        )
    XY = table.centers[:, :2]
    bounds = (XY[:, 0].min(), XY[:, 1].min(), XY[:, 0].max(), XY[:, 1].max())
    with named_by(table.file):
        step = crs_step(table.crs, crs, bounds).near(XY[0])
        centers = np.column_stack([step(XY), table.centers[:, 2]])
    return centers, degrees_of(grid_rotation(step, XY) @ table.rotations)


def in_declared_unit(
    request: Systems, table: OrientationTable | None, others: Sequence[Path]
) -> OrientationTable | None:
    """The orientation with heights in metres, by the unit of its file or of the height system declared for it."""
    own = None if table is None else table.height_system
    declared = request.orientation_height_system or (request.height_system if own is None else None)
    if declared is not None and declared.strip().casefold() not in ("same", "ellipsoidal"):
        metric, rise = metric_heights(check_height_system(declared))
        silent = [f for f in others if f.is_file() and f.suffix.lower() != ".gpkg" and crs_beside(f) is None]
        if rise != 1.0 and silent:
            raise HeightSystemError(
                f"{silent[0]}: heights of control and positions are in metres, not in {unit_label(rise)} as declared "
                f"({height_label(declared)}); convert them and declare {crs_label(metric)}, or state their CRS with "
                f"its height system in {silent[0].with_suffix('.prj').name} beside the file: they are then converted"
            )
    return None if table is None else table.heights_in_metres(declared)


def check_joined(terrain: str | None, images: str, crs: str, centers: NDArray[np.float64]) -> None:
    """Fail now, not in every later command, if the height systems cannot be joined here."""
    if terrain is None:
        return
    bounds = (centers[:, 0].min(), centers[:, 1].min(), centers[:, 0].max(), centers[:, 1].max())
    height_step(images, metric_heights(terrain)[0], crs, bounds)(centers)
