"""A project from the files that users have: images, camera, orientation, terrain."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import HeightSystemError, InputError, UsageError
from photoplan.geometry.bounds import area_fault, area_note
from photoplan.geometry.crs import crs_label, crs_step
from photoplan.geometry.frames import triple
from photoplan.geometry.heights import height_label, height_step
from photoplan.geometry.local import LocalFrame
from photoplan.io.camera.file import CameraFile, read_cameras
from photoplan.io.camera.model import CameraEntry, Triple
from photoplan.io.camera.opensfm import resized
from photoplan.io.camera.rpc.file import read_rpc, rpc_beside, rpc_in
from photoplan.io.disk import make_parents, received
from photoplan.io.names import check_input_name, relative_path, shortest_paths
from photoplan.io.orientation.file import read_orientation
from photoplan.io.orientation.table import OrientationTable, OrientedImage, TableFormat
from photoplan.io.project.file import parse_project, write_project
from photoplan.io.project.image import ImageEntry
from photoplan.io.project.model import Project, StatedTerrain
from photoplan.io.project.posed import Image
from photoplan.io.project.rpc import TAGS, RpcImage
from photoplan.io.raster_info import RasterInfo, read_info
from photoplan.products.init.match import (
    Unoriented,
    camera_by_size,
    camera_name,
    image_files,
    match_images,
    some,
)
from photoplan.products.init.systems import (
    check_joined,
    height_systems,
    in_declared_unit,
    placed,
    project_crs,
    terrain_entry,
)
from photoplan.products.judged import differences, on_map, stated_positions
from photoplan.project.by_rpc import size_fault

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
    """What is wrong with the size of the image, so that products are refused; None: nothing is."""


def project_names(files: Sequence[Path]) -> dict[Path, str]:
    """Name of every image file in the project: its base name, with folders or the suffix if others have the same."""
    short = shortest_paths(file.as_posix() for file in files)
    names = {file: "/".join(short[file.as_posix()]) for file in files}
    count = Counter(name.casefold() for name in names.values())
    return {file: name if count[name.casefold()] == 1 else f"{name}{file.suffix}" for file, name in names.items()}


def own_geometry(files: Iterable[Path], folder: Path, names: Mapping[Path, str]) -> dict[Path, OwnGeometry]:
    """Those of the files that have rational polynomials; tags and files beside the image must agree."""
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
class InitRequest:
    """What `photoplan init` is given; relative paths start at the current folder."""

    folder: Path
    """Folder of the project; `project.toml` is written into it."""
    images: tuple[str, ...]
    """Files, or patterns with ``*``, ``?`` and ``**``."""
    camera: Path | None
    """File with cameras: TOML, YAML or JSON; None: all images have rational polynomials."""
    orientation: Path | None = None
    """File with orientations, of any format of `photoplan.io.orientation.file`; None: the images are to be oriented."""
    terrain: str | None = None
    """Raster of heights, or one height in metres; None: it is added to the project before products are made."""
    crs: str | None = None
    """Projected CRS of the project; None: that of the orientation. Needed without one."""
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
    earth_curvature: str | None = None
    """none, correction or strict; None: strict for poses that were computed in true metres, else none."""
    refraction: bool = False
    """Whether image points are corrected for refraction."""
    scene: str = "z < 0"
    """Side of the image on which the scene lies in the camera system of the files, "z < 0" or "z > 0"."""
    image_points: tuple[Path, ...] = ()
    """Files of measured image points, for [observations]."""
    control: tuple[Path, ...] = ()
    """Files of ground points, for [observations]."""
    positions: Path | None = None
    """Table of observed projection centres, for [observations]."""
    beyond_area: bool = False
    """Whether places far outside the area of use of the CRS are meant."""
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
    unusable: tuple[str, ...] = ()
    """Why files could not be opened; they are left out."""


def init_project(request: InitRequest, talk: Callable[[str], None] = lambda line: None) -> InitResult:
    """Make a project of the given files and write `project.toml`.

    Parameters
    ----------
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
    if (request.path.exists() or request.path.is_symlink()) and not request.overwrite:
        raise UsageError(f"{request.path} exists; give `overwrite` to replace it, or another folder")
    received(request.folder)
    result = make_project(request, talk)
    try:
        make_parents(request.folder)
    except OSError as error:
        raise InputError(f"{request.folder}: the folder cannot be made ({error.strerror or error})") from None
    write_project(result.path, result.project)
    return result


def make_project(request: InitRequest, talk: Callable[[str], None] = lambda line: None) -> InitResult:
    """The project of the given files, without writing anything; see `init_project`."""
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
    request = replace(request, earth_curvature=curvature)
    project = _checked(request, terrain, *systems, crs, dict(used.values()), images)
    return InitResult(
        path=request.path,
        project=project,
        without_orientation=tuple(f.name for f in lonely_files),
        without_image=tuple(lonely_names),
        unusable=tuple(unusable),
    )


def _readable(files: Sequence[Path]) -> tuple[dict[Path, RasterInfo], list[str]]:
    """Facts of the images that can be opened, and why others cannot."""
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
) -> str:
    """The earth curvature of poses in true metres: strict, unless heights cannot be brought onto the ellipsoid."""
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
    """Cameras of the images that need one."""
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
    """Camera (name and description) of every image name; sizes agree with the files'."""
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
    """The project, checked as if it had been read."""
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
    """Entries of [observations]; the files have to be there."""
    entries: dict[str, Any] = {}
    for key, files in (("image_points", request.image_points), ("control", request.control)):
        if files:
            entries[key] = [_present(file, request.folder) for file in files]
    if request.positions is not None:
        entries["positions"] = _present(request.positions, request.folder, or_folder=True)
    return entries


def _present(file: Path, folder: Path, *, or_folder: bool = False) -> str:
    """Path from the project; positions may be a folder, of images that state them."""
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
    """What was found, in a few lines, of images with a camera and of so many with polynomials."""
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
