"""A project from the files that users have: images, camera, orientation, terrain."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import HeightSystemError, InputError, UsageError
from photoplan.geometry.crs import (
    canonical_crs,
    crs_label,
    crs_step,
    grid_rotation,
    parse_crs,
    require_projected_metres,
    same_crs,
    topocentric_poses,
)
from photoplan.geometry.heights import check_height_system, declared_pair, height_label, height_step
from photoplan.io.camera_file import CameraFile, read_cameras
from photoplan.io.camera_model import FilmCamera, FrameCamera
from photoplan.io.camera_opensfm import resized
from photoplan.io.names import check_input_name, match_key
from photoplan.io.orientation_file import read_orientation
from photoplan.io.orientation_table import OrientationTable, OrientedImage, TableFormat, degrees_of
from photoplan.io.project import parse_project, write_project
from photoplan.io.project_model import Image, Project, Terrain
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.io.terrain_model_read import ModelReader, is_terrain_model
from photoplan.products.init_match import camera_name, image_files, match_images, some

__all__ = ["InitRequest", "InitResult", "init_project", "make_project", "placed"]

LENS_NAMES = {
    "none": "no distortion",
    "brown": "Brown lens",
    "opencv": "OpenCV lens",
    "opencv_fisheye": "OpenCV fisheye lens",
    "radial_table": "radial table",
}


@dataclass(frozen=True)
class InitRequest:
    """What `photoplan init` is given; relative paths start at the current folder."""

    folder: Path
    """Folder of the project; `project.toml` is written into it."""
    images: tuple[str, ...]
    """Files, or patterns with ``*``, ``?`` and ``**``."""
    camera: Path
    """File with cameras: TOML, YAML or JSON."""
    orientation: Path
    """File with orientations, of any format of `photoplan.io.orientation_file`."""
    terrain: str
    """Raster of heights, or one height in metres."""
    crs: str | None = None
    """Projected CRS of the project; None: that of the orientation."""
    height_system: str | None = None
    """Declares whatever the files do not state: ellipsoidal, EPSG:nnnn, same."""
    terrain_crs: str | None = None
    """CRS of a terrain file that states none, such as an ASCII grid."""
    terrain_height_system: str | None = None
    """Declares the terrain's, also against what its file states."""
    orientation_height_system: str | None = None
    """Declares the orientation's, also against what its file states."""
    form: TableFormat = field(default_factory=TableFormat)
    """What the orientation file does not say of itself."""
    format: str | None = None
    """Format of the orientation file; None: by its content."""
    earth_curvature: str = "none"
    """none, correction or strict."""
    refraction: bool = False
    """Whether image points are corrected for refraction."""
    overwrite: bool = False
    """Whether an existing project file is replaced."""

    @property
    def path(self) -> Path:
        """The project file."""
        return self.folder / "project.toml"


@dataclass(frozen=True)
class InitResult:
    """A project that was made, and what did not fit together."""

    path: Path
    """The project file."""
    project: Project
    without_orientation: tuple[str, ...]
    """Image files that no line of the orientation names; they are left out."""
    without_image: tuple[str, ...]
    """Names of the orientation that no image file has; they are left out."""


def init_project(request: InitRequest, talk: Callable[[str], None] = lambda line: None) -> InitResult:
    """Make a project of the given files and write `project.toml`.

    Parameters
    ----------
    request : InitRequest
    talk : callable
        Takes lines for the user: what was found and what was left out.

    Raises
    ------
    UsageError
        The project file exists.
    InputError
        A file cannot be used, or the files do not fit together.
    HeightSystemError
        Height systems are not declared, or the grid that joins them is missing.
    """
    if request.path.exists() and not request.overwrite:
        raise UsageError(f"{request.path} exists; give --overwrite to replace it, or another folder")
    result = make_project(request, talk)
    try:
        request.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{request.folder}: the folder cannot be made ({error.strerror or error})") from None
    write_project(result.path, result.project)
    return result


def make_project(request: InitRequest, talk: Callable[[str], None] = lambda line: None) -> InitResult:
    """The project of the given files, without writing anything; see `init_project`."""
    files = image_files(request.images)
    cameras = read_cameras(request.camera)
    table = read_orientation(request.orientation, request.form, request.format)
    pairs, lonely_files, lonely_names = match_images(files, table)
    infos = {file: read_info(file) for file, _ in pairs}
    terrain, terrain_info = _terrain(request)
    crs, origin_of_crs = _crs(request, table, terrain_info)
    used = _cameras(pairs, cameras, infos, table.file)
    for line in _summary(used, pairs, crs, origin_of_crs, lonely_files, lonely_names, table):
        talk(line)
    systems = _height_systems(request, table, terrain_info)
    talk(f"  height systems: terrain {height_label(systems[0])}, orientation {height_label(systems[1])}")
    centers, angles = placed(table, crs, systems[1])
    _check_joined(systems, crs, centers)
    rows = {image.name: k for k, image in enumerate(table.images)}
    images = []
    for file, oriented in pairs:
        k, camera = rows[oriented.name], used[oriented.name][0]
        described = used[oriented.name][1]
        size = infos[file].size if isinstance(described, FilmCamera) and described.size is None else None
        images.append(
            Image(
                name=match_key(file.name),
                file=_relative(file, request.folder),
                camera=camera,
                center=(float(centers[k, 0]), float(centers[k, 1]), float(centers[k, 2])),
                angles=(float(angles[k, 0]), float(angles[k, 1]), float(angles[k, 2])),
                fiducials=oriented.fiducials,
                size=size,
            )
        )
    project = _checked(request, terrain, systems, crs, dict(used.values()), images)
    return InitResult(request.path, project, tuple(f.name for f in lonely_files), tuple(lonely_names))


def _cameras(
    pairs: list[tuple[Path, OrientedImage]], cameras: CameraFile, infos: dict[Path, RasterInfo], table: Path
) -> dict[str, tuple[str, FrameCamera | FilmCamera]]:
    """Camera (name and description) of every image name; sizes agree with the files'."""
    used: dict[str, tuple[str, FrameCamera | FilmCamera]] = {}
    sizes: dict[str, tuple[tuple[int, int], Path]] = {}
    for file, image in pairs:
        name = camera_name(image, cameras, table)
        camera, size = cameras.cameras[name], infos[file].size
        if isinstance(camera, FrameCamera):
            before = sizes.setdefault(name, (size, file))
            if cameras.normalised and size == before[0]:
                camera = resized(camera, size, f"{file}: camera {name!r}")
        if camera.size is not None and camera.size != size:
            raise InputError(
                f"{file}: {size[0]} × {size[1]} px, but camera {name!r} of {cameras.file} has "
                f"{camera.size[0]} × {camera.size[1]} px; give the camera of these images, or images of full size"
            )
        used[image.name] = (name, camera)
    return used


@dataclass(frozen=True)
class _TerrainFacts:
    """What a terrain file states of its systems."""

    path: Path
    crs: str | None
    vertical_crs: str | None


def _terrain_facts(file: Path) -> _TerrainFacts:
    if is_terrain_model(file):
        header = ModelReader(file).header
        return _TerrainFacts(file, header.crs, header.height_system)
    info = read_info(file)
    return _TerrainFacts(info.path, info.crs, info.vertical_crs)


def _terrain(request: InitRequest) -> tuple[Terrain, _TerrainFacts | None]:
    """The terrain entry (height system still open) and the facts of its file."""
    text = request.terrain.strip()
    try:
        return Terrain(height=float(text)), None
    except ValueError:
        pass
    check_input_name(text)
    file = Path(text)
    info = _terrain_facts(file)
    if info.crs is None and request.terrain_crs is None:
        raise InputError(f"terrain {file}: states no CRS; say the one it is in: --terrain-crs EPSG:nnnn")
    stated = info.crs or request.terrain_crs
    parse_crs(stated or "", f"terrain {file}")
    if info.crs is not None and request.terrain_crs is not None and not same_crs(info.crs, request.terrain_crs):
        raise InputError(
            f"terrain {file}: states {crs_label(info.crs)}, not {request.terrain_crs}; leave --terrain-crs out"
        )
    crs = None if info.crs is not None else request.terrain_crs
    return Terrain(file=_relative(file.absolute(), request.folder), crs=crs), replace(info, crs=stated)


def _crs(request: InitRequest, table: OrientationTable, terrain: _TerrainFacts | None) -> tuple[str, str]:
    """The project's CRS and where it comes from."""
    if request.crs is not None:
        crs, source = request.crs, "as given"
    elif table.crs is not None:
        crs, source = table.crs, f"from {(table.crs_file or table.file).name}"
    elif table.origin is not None and terrain is not None and terrain.crs is not None:
        crs, source = _horizontal(terrain.crs), f"from {terrain.path.name}"
    else:
        raise InputError(f"{table.file}: does not state the CRS of its coordinates; declare it with --crs EPSG:nnnn")
    require_projected_metres(crs, f"CRS ({source})")
    return canonical_crs(crs), source


def _horizontal(text: str) -> str:
    crs = parse_crs(text)
    return str((crs.sub_crs_list[0] if crs.is_compound else crs).to_wkt())


def _height_systems(request: InitRequest, table: OrientationTable, terrain: _TerrainFacts | None) -> tuple[str, str]:
    """Height systems of terrain and orientation: as declared, else as the files state."""
    stated_terrain = terrain.vertical_crs if terrain is not None else None
    stated = [
        request.terrain_height_system or stated_terrain or request.height_system,
        request.orientation_height_system or table.height_system or request.height_system,
    ]
    if request.height_system is not None:
        declared = check_height_system(request.height_system, "--height-system")
        of_files = [s for s in (stated_terrain, table.height_system) if s is not None]
        if len(of_files) == 2 and declared not in [check_height_system(s) for s in of_files]:
            raise UsageError(
                f"--height-system {request.height_system}: both files state theirs "
                f"({height_label(stated[0])}; {height_label(stated[1])}); to overrule a file use "
                "--terrain-height-system or --orientation-height-system"
            )
    terrain_system, orientation_system = stated
    return declared_pair(terrain_system, orientation_system)


def placed(table: OrientationTable, crs: str, system: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Projection centres (n, 3) and ω, φ, κ in degrees (n, 3) in the project's CRS."""
    if table.origin is not None:
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
    if source.axis_info[0].unit_conversion_factor != 1.0 and system in ("same", "ellipsoidal"):
        raise HeightSystemError(
            f"{table.file}: {crs_label(table.crs)} is in {source.axis_info[0].unit_name}, and the unit of Z is not "
            "stated; declare the vertical CRS with --orientation-height-system EPSG:nnnn"
        )
    XY = table.centers[:, :2]
    bounds = (XY[:, 0].min(), XY[:, 1].min(), XY[:, 0].max(), XY[:, 1].max())
    step = crs_step(table.crs, crs, bounds)
    centers = np.column_stack([step(XY), table.centers[:, 2]])
    return centers, degrees_of(grid_rotation(step, XY) @ table.rotations)


def _check_joined(systems: tuple[str, str], crs: str, centers: NDArray[np.float64]) -> None:
    """Fail now, not in every later command, if the height systems cannot be joined here."""
    bounds = (centers[:, 0].min(), centers[:, 1].min(), centers[:, 0].max(), centers[:, 1].max())
    height_step(systems[1], systems[0], crs, bounds)(centers)


def _checked(
    request: InitRequest,
    terrain: Terrain,
    systems: tuple[str, str],
    crs: str,
    cameras: dict[str, FrameCamera | FilmCamera],
    images: list[Image],
) -> Project:
    """The project, checked as if it had been read."""
    contents = {
        "crs": crs,
        "terrain": {**terrain.model_dump(exclude_none=True), "height_system": systems[0]},
        "orientation": {
            "height_system": systems[1],
            "earth_curvature": request.earth_curvature,
            "refraction": request.refraction,
        },
        "cameras": {name: c.model_dump(exclude_none=True) for name, c in cameras.items()},
        "images": [i.model_dump(exclude_none=True) for i in images],
    }
    return parse_project(contents, request.folder.absolute().resolve(), "project")


def _relative(file: Path, folder: Path) -> str:
    """Path of a file as the project file states it: from the project's folder, where there is a way."""
    # The folder of the file is resolved, not the file: a link keeps its own name, and so do the products.
    target = file.parent.resolve() / file.name
    try:
        return Path(os.path.relpath(target, folder.absolute().resolve())).as_posix()
    except ValueError:  # another drive
        return target.as_posix()


def _summary(
    used: dict[str, tuple[str, FrameCamera | FilmCamera]],
    pairs: list[tuple[Path, OrientedImage]],
    crs: str,
    source: str,
    lonely_files: list[Path],
    lonely_names: list[str],
    table: OrientationTable,
) -> list[str]:
    """What was found, in a few lines."""
    parts = [f"{len(pairs)} images"]
    for name, camera in dict(used.values()).items():
        size = f", {camera.size[0]} × {camera.size[1]} px" if camera.size is not None else ""
        film = "film, " if isinstance(camera, FilmCamera) else ""
        parts.append(f'camera "{name}"{size}, {film}{LENS_NAMES[camera.lens.type]}')
    lines = ["  " + " · ".join([*parts, f"{crs_label(crs)} ({source})"])]
    if lonely_files:
        lines.append(f"  left out, no orientation: {some([f.name for f in lonely_files])}")
    if lonely_names:
        lines.append(f"  left out, no image file: {some(lonely_names)}")
    return lines + [f"  {note}" for note in table.notes]
