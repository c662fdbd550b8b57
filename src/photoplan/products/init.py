"""Project files from images, orientations and terrain."""

from __future__ import annotations

import glob
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import HeightSystemError, InputError, UsageError, named_by
from photoplan.events import SILENT, Events
from photoplan.findings import Result
from photoplan.geometry.bounds import area_fault, area_note
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
from photoplan.geometry.frames import triple
from photoplan.geometry.heights import check_height_system, declared_pair, height_label, height_step
from photoplan.geometry.local import LocalFrame
from photoplan.geometry.pose import degrees_of
from photoplan.geometry.units import metric_heights, unit_label
from photoplan.io.camera.model import CameraEntry, Triple
from photoplan.io.camera.satellite import read_rpc, rpc_beside, rpc_in
from photoplan.io.disk import make_parents, received
from photoplan.io.files import ImageNames, check_input_name, crs_beside, relative_path, shortest_paths
from photoplan.io.formats import CameraFile, read_cameras, read_orientation
from photoplan.io.orientation.block import OrientationTable, OrientedImage
from photoplan.io.orientation.opensfm import resized
from photoplan.io.project.file import parse_project, write_project
from photoplan.io.project.model import TAGS, Image, ImageEntry, Project, RpcImage, StatedTerrain
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.io.terrain.model import ModelReader, is_terrain_model
from photoplan.plain import pick
from photoplan.products.plausibility import differences, on_map, stated_positions
from photoplan.project.cameras import size_fault
from photoplan.requests.project import InitRequest

#: Names that are listed; the rest is counted.
SHOWN = 5


@dataclass(frozen=True)
class Unoriented:
    """An image of which nothing is known but its file."""

    name: str
    fiducials: None = None


def image_files(patterns: tuple[str, ...]) -> list[Path]:
    """Return the files of all patterns, each once, in the order of the patterns and sorted within."""
    found: dict[Path, None] = {}
    for pattern in patterns:
        check_input_name(pattern)
        # A file is taken by its name even where the name holds brackets.
        names = [pattern] if Path(pattern).is_file() else sorted(glob.glob(pattern, recursive=True))  # noqa: PTH207
        for name in names:
            if Path(name).is_file():
                found[Path(name).absolute()] = None
    if not found:
        hint = "; to take all files of a folder write FOLDER/*.tif" if any(Path(p).is_dir() for p in patterns) else ""
        raise InputError(f"images {' '.join(patterns)!r}: no file matches the pattern{hint}")
    return list(found)


def match_images(
    files: list[Path], table: OrientationTable
) -> tuple[list[tuple[Path, OrientedImage | Unoriented]], list[Path], list[str]]:
    """Match image files with orientations; return these pairs, files without, and names without a file.

    See `photoplan.io.files.ImageNames` for how names are compared.
    """
    by_name = {image.name: image for image in table.images}
    try:
        found = ImageNames(by_name).match([file.as_posix() for file in files])
    except InputError as error:
        raise InputError(f"{table.file}: {error}; or narrow the pattern of image files") from None
    taken = set(found)
    pairs: list[tuple[Path, OrientedImage | Unoriented]] = []
    pairs += [(file, by_name[name]) for file, name in zip(files, found) if name is not None]
    lonely = [file for file, name in zip(files, found) if name is None]
    if not pairs:
        raise InputError(
            f"no image file is named in {table.file}: files are {some([f.name for f in files])}; "
            f"names there are {some([i.name for i in table.images])}"
        )
    return pairs, lonely, [name for name in by_name if name not in taken]


def camera_by_size(file: Path, size: tuple[int, int], cameras: CameraFile) -> str:
    """Name of the camera of an image of which no table tells: the only one, or the only one of its size."""
    if len(cameras.cameras) == 1:
        return next(iter(cameras.cameras))
    of_size = [n for n, c in cameras.cameras.items() if c.size == size and c.fiducial_system is None]
    if len(of_size) == 1:
        return of_size[0]
    known = ", ".join(map(repr, cameras.cameras))
    raise InputError(
        f"{cameras.file} describes {len(cameras.cameras)} cameras ({known}), and {len(of_size)} of them have the "
        f"{size[0]} × {size[1]} px of {file}; make a project with one camera's file, or give an orientation table with "
        "a column called camera"
    )


def camera_name(image: OrientedImage, cameras: CameraFile, table: Path) -> str:
    """Name of an image's camera: as the table states it, or the only one."""
    known = ", ".join(map(repr, cameras.cameras))
    if image.camera is not None:
        if image.camera in cameras.cameras:
            return image.camera
        raise InputError(
            f"{table}{f':{image.line}' if image.line else ''}: image {image.name!r} names camera {image.camera!r}; "
            f"{cameras.file} describes {known}; use one name in both files"
        )
    if len(cameras.cameras) == 1:
        return next(iter(cameras.cameras))
    raise InputError(
        f"{cameras.file} describes {len(cameras.cameras)} cameras ({known}), and {table} does not say which image has "
        "which; add a column called camera"
    )


def some(names: list[str]) -> str:
    """Return the first names, and how many more there are."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(names[:SHOWN]) + more


@dataclass(frozen=True)
class TerrainSource:
    """Coordinate systems that a terrain file states."""

    path: Path
    crs: str | None
    vertical_crs: str | None


def _terrain_facts(file: Path) -> TerrainSource:
    if is_terrain_model(file):
        header = ModelReader(file).header
        return TerrainSource(file, header.crs, header.height_system)
    info = read_info(file)
    return TerrainSource(info.path, info.crs, info.height_system)


def terrain_entry(request: InitRequest) -> tuple[StatedTerrain | None, TerrainSource | None]:
    """Return the terrain entry (height system still open) and the facts of its file."""
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
    request: InitRequest,
    table: OrientationTable | None,
    terrain: TerrainSource | None,
    place: tuple[float, float] | None = None,
) -> tuple[str, str]:
    """Return the project's CRS and its origin; `place` is the latitude and longitude of a satellite image,
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
    """Return the CRS of a terrain file, if products can be in it."""
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
    request: InitRequest, table: OrientationTable | None, terrain: TerrainSource | None, ellipsoidal: bool = False
) -> tuple[str | None, str]:
    """Return the height systems of terrain and of orientation and control: as declared, else as the files state.

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
    """Return projection centres (n, 3) and ω, φ, κ in degrees (n, 3) in the project's CRS."""
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
    request: InitRequest, table: OrientationTable | None, others: Sequence[Path]
) -> OrientationTable | None:
    """Return the orientation with heights in metres, by the unit of its file or of its declared height system."""
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
    """Refuse height systems that cannot be joined here, now and not in every later command."""
    if terrain is None:
        return
    bounds = (centers[:, 0].min(), centers[:, 1].min(), centers[:, 0].max(), centers[:, 1].max())
    height_step(images, metric_heights(terrain)[0], crs, bounds)(centers)


#: Polynomials that are written twice differ by rounding, pixels.
_SAME_RPC = 0.5
LENS_NAMES = {
    "none": "no distortion",
    "brown": "Brown lens",
    "opencv": "OpenCV lens",
    "opencv_fisheye": "OpenCV fisheye lens",
    "radial_table": "radial table",
}


@dataclass(frozen=True)
class OwnGeometry:
    """An image with rational polynomials."""

    image: RpcImage
    place: tuple[float, float]
    """Latitude and longitude in the middle of what the polynomials hold for, degrees."""
    fault: str | None
    """Reason why the size of the image is wrong, so that products are refused; None if it is right."""


def project_names(files: Sequence[Path]) -> dict[Path, str]:
    """Name of every image file in the project: its base name, with folders or the suffix if others have the same."""
    short = shortest_paths(file.as_posix() for file in files)
    names = {file: "/".join(short[file.as_posix()]) for file in files}
    count = Counter(name.casefold() for name in names.values())
    return {file: name if count[name.casefold()] == 1 else f"{name}{file.suffix}" for file, name in names.items()}


def own_geometry(files: Iterable[Path], folder: Path, names: Mapping[Path, str]) -> dict[Path, OwnGeometry]:
    """Return the files that have rational polynomials; tags and files next to the image must agree."""
    found = {}
    for file in files:
        rpc, beside = rpc_in(file), None
        others = [read_rpc(other) for other in rpc_beside(file)]
        if rpc is None and others:
            rpc, beside = others[0], others[0].file
        for other in others:
            if rpc is not None and (apart := rpc.functions.apart(other.functions)) > _SAME_RPC:
                raise InputError(
                    f"{file}: {rpc.file.name if beside else 'its tags'} and {other.file.name} beside it state other "
                    f"polynomials (up to {apart:.3g} px apart); move the wrong ones away"
                )
        if rpc is not None:
            fault = size_fault(rpc.functions, read_info(file).size, (0.0, 0.0), rpc.file, stated=False)
            source = TAGS if beside is None else relative_path(beside, folder)
            lon, lat, _ = rpc.functions.ground_offset
            image = RpcImage(name=names[file], file=relative_path(file, folder), rpc=source)
            found[file] = OwnGeometry(image, (lat, lon), fault)
    return found


@dataclass(frozen=True)
class InitResult(Result):
    """A project that was made, and what did not fit together."""

    path: Path
    """The project file."""
    project: Project
    without_orientation: tuple[str, ...]
    """Image files that no line of the orientation names; they are left out."""
    without_image: tuple[str, ...]
    """Names of the orientation that no image file has; they are left out."""
    unusable: tuple[str, ...] = ()
    """Reason why files could not be opened; they are left out."""

    def json_fields(self) -> dict[str, Any]:
        """Images and systems of the project, and what is left out."""
        terrain, orientation = self.project.terrain, self.project.orientation
        return {
            "project": self.path,
            "images": [image.name for image in self.project.images],
            "crs": self.project.crs,
            "height_systems": {
                "terrain": terrain and terrain.height_system,
                "orientation": orientation.height_system,
            },
            **pick(self, "without_orientation", "without_image"),
        }


def init_project(request: InitRequest, events: Events = SILENT) -> InitResult:
    """Make a project of the given files and write `project.toml`; events get what was found and what was left out.

    Raises
    ------
    UsageError
        The project file exists.
    InputError
        A file cannot be used, or the files do not fit together.
    HeightSystemError
        Height systems are not declared, or the grid that joins them is missing.
    """
    if request.folder.is_file():
        raise UsageError(f"{request.folder}: is a file; give the folder of the project")
    if (request.path.exists() or request.path.is_symlink()) and not request.overwrite:
        raise UsageError(f"{request.path} exists; give `overwrite` to replace it, or another folder")
    received(request.folder)
    result = make_project(request, events)
    try:
        make_parents(request.folder)
    except OSError as error:
        raise InputError(f"{request.folder}: the folder cannot be made ({error.strerror or error})") from None
    write_project(result.path, result.project)
    return result


def make_project(request: InitRequest, events: Events = SILENT) -> InitResult:
    """Return the project of the given files, without writing anything; see `init_project`."""
    talk = events.talk
    infos, unusable = _readable(image_files(request.images))
    files = list(infos)
    names = project_names(files)
    table = None
    if request.orientation is not None:
        table = read_orientation(request.orientation, request.form, request.format)
    others = [*request.control, *([] if request.positions is None else [request.positions])]
    table = in_declared_unit(request, table, others)
    pairs, lonely_files, lonely_names = match_images(files, table) if table else ([], files, [])
    own = own_geometry(lonely_files, request.folder, names)
    lonely_files = [file for file in lonely_files if file not in own]
    if table is None:
        pairs, lonely_files = [(file, Unoriented(names[file])) for file in lonely_files], []
    terrain, terrain_info = terrain_entry(request)
    places = [each.place for each in own.values()]
    place = next(iter(places), None)
    crs, origin_of_crs = project_crs(request, table, terrain_info, place)
    _judge_area(request, crs, [place[::-1] for place in places], "the middle of the images", talk, geographic=True)
    used = _cameras(pairs, _described(request, pairs), infos, table.file if table else None)
    where = f"{crs_label(crs)} ({origin_of_crs})"
    for line in _summary(used, pairs, len(own), where, lonely_files, lonely_names, table):
        talk(line)
    if unusable:
        talk(f"  warning: left out, {len(unusable)} files cannot be read: {some(unusable)}")
    for file, each in own.items():
        if each.fault is not None:
            talk(f"  warning: {file.name}: {each.fault}")
    systems = height_systems(request, table, terrain_info, ellipsoidal=not pairs)
    of_terrain = f"terrain {height_label(systems[0])}, " if terrain is not None else ""
    of_others = "orientation" if table else "control" if pairs else "images"
    talk(f"  height systems: {of_terrain}{of_others} {height_label(systems[1])}")
    poses: dict[str, tuple[Triple, Triple]] = {}
    if table is not None:
        centers, angles = placed(table, crs)
        check_joined(*systems, crs, centers)
        _judge_area(request, crs, centers, f"{table.file}: projection centre", talk)
        poses = {i.name: (triple(c), triple(a)) for i, c, a in zip(table.images, centers, angles)}
        stated = on_map(stated_positions(table, {oriented.name: file for file, oriented in pairs}), crs)
        for said in differences([i.name for i in table.images], centers, stated):
            talk(f"  warning: {said}")
    images: list[ImageEntry] = [each.image for each in own.values()]
    for file, oriented in pairs:
        camera, described = used[oriented.name]
        center, turned = poses.get(oriented.name, (None, None))
        size = infos[file].size if described.size is None else None
        images.append(
            Image(
                name=names[file],
                file=relative_path(file, request.folder),
                camera=camera,
                center=center,
                angles=turned,
                fiducials=oriented.fiducials,
                size=size,
            )
        )
    curvature = request.earth_curvature or "none"
    if request.earth_curvature is None and table is not None and table.cartesian:
        curvature = _in_true_metres(table, *systems, crs, np.array([p[0] for p in poses.values()], float), talk)
    request = request.replace(earth_curvature=curvature)
    project = _checked(request, terrain, *systems, crs, dict(used.values()), images)
    return InitResult(
        path=request.path,
        project=project,
        without_orientation=tuple(f.name for f in lonely_files),
        without_image=tuple(lonely_names),
        unusable=tuple(unusable),
    )


def _readable(files: Sequence[Path]) -> tuple[dict[Path, RasterInfo], list[str]]:
    """Return facts of the images that can be opened, and why others cannot."""
    infos: dict[Path, RasterInfo] = {}
    unusable: list[str] = []
    for file in files:
        try:
            infos[file] = read_info(file)
        except InputError as error:
            unusable.append(str(error))
            if len(unusable) == len(files):
                raise
    return infos, unusable


def _in_true_metres(
    table: OrientationTable,
    terrain_system: str | None,
    system: str,
    crs: str,
    centers: NDArray[np.float64],
    talk: Callable[[str], None],
) -> Literal["none", "strict"]:
    """Return the earth curvature of poses in true metres: strict, unless heights do not reach the ellipsoid."""
    X, Y = centers[:, :2].mean(axis=0).tolist()
    scale = float(LocalFrame(crs, (X, Y)).scale(np.array([X, Y])))
    metre = f"1 m on the ground is {scale:.5f} m of the map"
    if system != "same":
        try:
            for each in {terrain_system, system} - {None}:
                height_step(str(each), "ellipsoidal", crs)(centers)
        except HeightSystemError as error:
            talk(
                f"  warning: earth_curvature none, though the poses of {table.file.name} are in true metres ({metre}, "
                f"so images are off by up to {1000 * abs(1 - scale):.2g} px per 1000 px from their middle): {error}"
            )
            return "none"
    talk(f"  earth_curvature strict: the poses of {table.file.name} are in true metres ({metre})")
    return "strict"


def _judge_area(
    request: InitRequest,
    crs: str,
    places: ArrayLike,
    what: str,
    talk: Callable[[str], None],
    geographic: bool = False,
) -> None:
    """Refuse places far outside the area of the CRS unless they are meant, and talk of those a little outside."""
    XY = np.asarray(places, float)
    if not len(XY):
        return
    if geographic:
        XY = crs_step("EPSG:4326", crs).where_defined(XY[:, :2])
        if np.isnan(XY).any() and not request.beyond_area:
            raise InputError(f"{what} has no place in {crs_label(crs)}; is it the right CRS?")
    fault = None if request.beyond_area else area_fault(crs, XY)
    if fault is not None:
        raise InputError(f"{what} {fault}")
    note = None if request.beyond_area else area_note(crs, XY)
    if note is not None:
        talk(f"  warning: {what} {note}")


def _described(request: InitRequest, pairs: Sequence[tuple[Path, object]]) -> CameraFile:
    """Read the cameras of the images that need one."""
    if request.camera is not None:
        return read_cameras(request.camera)
    if pairs:
        raise UsageError(
            f"{pairs[0][0]}: no rational polynomials (RPC) in it nor beside it; give `camera`, the file that describes "
            "its camera"
        )
    return CameraFile(Path(), {}, False)


def _cameras(
    pairs: list[tuple[Path, OrientedImage | Unoriented]],
    cameras: CameraFile,
    infos: dict[Path, RasterInfo],
    table: Path | None,
) -> dict[str, tuple[str, CameraEntry]]:
    """Return the camera (name and description) of every image name; sizes must agree with the files'."""
    used: dict[str, tuple[str, CameraEntry]] = {}
    sizes: dict[str, tuple[int, int]] = {}
    for file, image in pairs:
        size = infos[file].size
        if table is None or isinstance(image, Unoriented):
            name = camera_by_size(file, size, cameras)
        else:
            name = camera_name(image, cameras, table)
        camera = cameras.cameras[name]
        if cameras.normalised and size == sizes.setdefault(name, size):
            camera = resized(camera, size, f"{file}: camera {name!r}")
        if camera.size is not None and camera.size != size:
            raise InputError(
                f"{file}: {size[0]} × {size[1]} px, but camera {name!r} of {cameras.file} has "
                f"{camera.size[0]} × {camera.size[1]} px; give the camera of these images, or images of full size"
            )
        used[image.name] = (name, camera)
    return used


def _checked(
    request: InitRequest,
    terrain: StatedTerrain | None,
    terrain_system: str | None,
    height_system: str,
    crs: str,
    cameras: dict[str, CameraEntry],
    images: Sequence[ImageEntry],
) -> Project:
    """Return the project, checked as if it had been read."""
    orientation = {
        "height_system": height_system,
        "earth_curvature": request.earth_curvature,
        "refraction": request.refraction,
        "scene": request.scene,
    }
    if request.orientation is None:
        # Angles will be written so; those of a file are turned into ω, φ, κ in degrees.
        orientation |= {"angle_unit": request.form.angle_unit, "rotation": request.form.rotation}
    contents: dict[str, Any] = {
        "crs": crs,
        "beyond_area": request.beyond_area,
        "orientation": orientation,
        "observations": _observations(request),
        "cameras": {name: c.model_dump(exclude_none=True) for name, c in cameras.items()},
        "images": [i.model_dump(exclude_none=True) for i in images],
    }
    if terrain is not None:
        contents["terrain"] = {**terrain.model_dump(exclude_none=True), "height_system": terrain_system}
    return parse_project(contents, request.folder.absolute().resolve(), "project")


def _observations(request: InitRequest) -> dict[str, Any]:
    """Return the entries of [observations]; the files must exist."""
    entries: dict[str, Any] = {}
    for key, files in (("image_points", request.image_points), ("control", request.control)):
        if files:
            entries[key] = [_present(file, request.folder) for file in files]
    if request.positions is not None:
        entries["positions"] = _present(request.positions, request.folder, or_folder=True)
    return entries


def _present(file: Path, folder: Path, *, or_folder: bool = False) -> str:
    """Return a path from the project; positions may be a folder, of images that state them."""
    check_input_name(str(file))
    if not (file.is_file() or (or_folder and file.is_dir())):
        raise InputError(f"{file}: no such file; give the measurements that exist, or add them to the project later")
    return relative_path(file.absolute(), folder)


def _summary(
    used: dict[str, tuple[str, CameraEntry]],
    pairs: Sequence[tuple[Path, OrientedImage | Unoriented]],
    own: int,
    crs: str,
    without_orientation: list[Path],
    without_file: list[str],
    table: OrientationTable | None,
) -> list[str]:
    """Return a few lines on images with a camera and on those with polynomials."""
    parts = [f"{len(pairs)} images" + ("" if table else " without orientation")] if pairs else []
    parts += [f"{own} images with rational polynomials (RPC)"] if own else []
    for name, camera in dict(used.values()).items():
        size = f", {camera.size[0]} × {camera.size[1]} px" if camera.size is not None else ""
        film = "film, " if camera.fiducial_system is not None else ""
        parts.append(f'camera "{name}"{size}, {film}{LENS_NAMES[camera.lens.type]}')
    lines = ["  " + " · ".join([*parts, crs])]
    if without_orientation:
        lines.append(f"  left out, no orientation: {some([f.name for f in without_orientation])}")
    if without_file:
        lines.append(f"  left out, no image file: {some(without_file)}")
    return lines + ([f"  {note}" for note in table.notes] if table else [])
