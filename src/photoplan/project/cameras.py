"""Cameras of a project's images: frame, posed, line, polynomials."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from photoplan.cameras.base import Camera, CentralCamera
from photoplan.cameras.correctable import displaced, map_axes
from photoplan.cameras.framed import oriented_camera
from photoplan.cameras.rpc import RationalFunctions, RpcCamera
from photoplan.errors import InputError
from photoplan.geometry.heights import height_step
from photoplan.geometry.local import GeodeticGround
from photoplan.geometry.pose import Pose, angle_in_radians, rotation_from_angles
from photoplan.io.camera.line import StatedLine, read_line, read_line_correction, read_pose_errors
from photoplan.io.camera.model import CameraEntry
from photoplan.io.camera.satellite import StatedFrame, read_frame, read_rpc
from photoplan.io.project.model import (
    FrameImage,
    Image,
    ImageEntry,
    LineImage,
    Orientation,
    Project,
    RpcImage,
    interior_of,
    lens_of,
)
from photoplan.io.project.model import Image as Image_cameras
from photoplan.io.project.model import Image as Image_posed
from photoplan.io.raster_info import read_info
from photoplan.orientation.conventions import JudgedView
from photoplan.project.ground import Ground, ground_of, stamp_of


def check_size(file: str, size: tuple[int, int], stated: tuple[int, int] | None, says: str, so: str) -> None:
    """Refuse an image whose camera is stated for another size; None: none is stated."""
    if stated is not None and tuple(stated) != size:
        raise InputError(f"{file}: {size[0]} × {size[1]} pixels, but {says} {stated[0]} × {stated[1]}; {so}")


def check_camera_size(project: Project, image: Image, size: tuple[int, int]) -> None:
    """The same for an image with a camera of the project."""
    stated = image.size or project.cameras[image.camera].size
    so = "an image that was cropped or scaled needs a camera of its own"
    check_size(image.file, size, stated, f"camera {image.camera!r} has", so)


def frame_camera(project: Project, image: FrameImage, ground: Ground, size: tuple[int, int]) -> Camera:
    """Camera of an image, over the ground as it is worked in."""
    file = project.resolve(image.frame)
    stated = _read(file, stamp_of(file))
    for given, where in ((stated.size, image.frame), (image.size, "the project")):
        check_size(image.file, size, given, f"{where} states", "its camera fits an image of full size only")
    return stated.camera(project.crs, ground.working_system)


@lru_cache(maxsize=64)
def _read(file: Path, stamp: tuple[int, int]) -> StatedFrame:
    """Read again only when the file changes."""
    return read_frame(file)


def line_camera(project: Project, image: LineImage, ground: Ground, size: tuple[int, int]) -> Camera:
    """Camera of an image of lines, over the ground as it is worked in."""
    file = project.resolve(image.line)
    stamps = tuple(stamp_of(each) for each in image.geometry_files(project.resolve))
    stated = _read_by_line(file, stamps, image.detectors)
    for given, where in ((stated.size, image.line), (image.size, "the project")):
        check_size(image.file, size, given, f"{where} states", "a line camera fits an image of full size only")
    camera = stated.camera(project.crs, ground.working_system)
    if image.correction is None:
        return camera
    correction = read_line_correction(project.resolve(image.correction))
    track = correction.track(camera.track)
    if not image.change:
        return camera.along(track)
    errors = read_pose_errors(project.resolve(image.correction))
    if errors is None:
        raise InputError(
            f"image {image.name!r}: {image.correction} says nothing of the accuracy of the trajectory; `photoplan "
            "adjust` writes it, as [accuracy]"
        )
    return camera.along(displaced(track, errors.course(np.array(image.change)), map_axes(track))).calm()


@lru_cache(maxsize=64)
def _read_by_line(file: Path, stamps: tuple[tuple[int, int], ...], detectors: str | None) -> StatedLine:
    """Read again only when one of the files changes."""
    return read_line(file, detectors)


def rpc_camera(project: Project, image: RpcImage, ground: Ground, size: tuple[int, int]) -> RpcCamera:
    """Camera of an image with rational polynomials, over the ground as it is worked in."""
    check_size(image.file, size, image.size, "the project states", "polynomials fit an image of full size only")
    file = project.resolve(image.geometry_file or image.file)
    _refuse_tile(image, file)
    functions = _read_by_rpc(file, stamp_of(file))
    if image.scale is not None:
        functions = functions.scaled(image.scale)
    fault = size_fault(functions, size, image.shift or (0.0, 0.0), file, stated=image.scale is not None)
    if fault is not None:
        raise InputError(f"{image.file}: {fault}")
    return RpcCamera(functions, GeodeticGround(project.crs, ground.working_system), size, image.correction)


def size_fault(
    functions: RationalFunctions, size: tuple[int, int], shift: tuple[float, float], file: Path, *, stated: bool
) -> str | None:
    """Return what is wrong if an image has another size than its polynomials, and what would fit; None if nothing is.

    An image with the shape of the one that they are made for, but not its size, was scaled; `stated`: the project
    states a scale. An image that lies mostly outside of that one is another image.
    """
    fit = functions.fit(size, shift)
    whole = f"{fit.whole[0]} × {fit.whole[1]}"
    has = f"{size[0]} × {size[1]} pixels, but the polynomials of {file.name} hold for {whole}"
    if fit.kind == "scaled" and not stated:
        change = "reduced" if fit.scale < 1 else "enlarged"
        return (
            f"{has}: give the image in full size. If it was {change}, set scale = {fit.scale:.4g} in its [[images]] "
            "entry; if it is the upper left part of the image, or the polynomials are those of this size, set scale = 1"
        )
    if fit.kind == "outside":
        return (
            f"{has}: much of the image lies outside. Give the polynomials of this image; if it was enlarged, set scale "
            "= FACTOR in its [[images]] entry; if it was cut out, set shift = [-COLUMN, -ROW]"
        )
    return None


def _refuse_tile(image: RpcImage, file: Path) -> None:
    """Refuse a tile of a delivery with the polynomials of the whole: they count from the first tile's corner."""
    tile = re.search(r"_R\d+C\d+(?![0-9A-Za-z])", Path(image.file).stem, re.IGNORECASE)
    if tile is None or tile[0].upper() == "_R1C1" or image.geometry_file is None or image.shift is not None:
        return
    if tile[0].upper() not in file.stem.upper():
        raise InputError(
            f"{image.file}: a tile of a product, and {file.name} counts from the corner of its first tile; join the "
            "tiles into one image, or state where this one begins: shift = [-COLUMN, -ROW]"
        )


@lru_cache(maxsize=256)
def _read_by_rpc(file: Path, stamp: tuple[int, int]) -> RationalFunctions:
    """Read again only when the file changes."""
    return read_rpc(file).functions


def stated_pose(project: Project, image: Image_posed) -> Pose:
    """Exterior orientation of an image as the project states it, in the orientation's height system."""
    orientation = project.orientation
    center, angles = image.pose_numbers
    radians = angle_in_radians(np.array(angles), orientation.angle_unit)
    return Pose(np.array(center, float), rotation_from_angles(radians, orientation.rotation))


def pose_of(project: Project, image: Image_posed, ground: Ground) -> Pose:
    """Exterior orientation of an image, in the height system that the ground has."""
    stated = stated_pose(project, image)
    center = stated.center.copy()
    center[2] = height_step(ground.height_systems[1], ground.working_system, project.crs)(center)
    return Pose(center, stated.R_ground_camera)


def posed_camera(project: Project, image: Image_posed, ground: Ground, size: tuple[int, int]) -> CentralCamera:
    """Camera of an image by the project's numbers; `size` is that of its file, another one stated is an InputError."""
    description = project.cameras[image.camera]
    check_camera_size(project, image, size)
    interior = interior_of(description, image, size)
    pose = pose_of(project, image, ground)
    nadir = float(ground.bare.heights(pose.center[:2]))
    return oriented_camera(
        interior,
        lens_of(description),
        pose,
        crs=project.crs,
        earth_curvature=project.orientation.earth_curvature,
        refraction=project.orientation.refraction,
        mean_ground=nadir if np.isfinite(nadir) else 0.0,
    )


#: Points on a side of the grid over an image.
_POINTS = 5


def view_of(image: Image_posed, camera: CameraEntry, orientation: Orientation, center: ArrayLike) -> JudgedView:
    """View of a project's image."""
    interior, lens = interior_of(camera, image), lens_of(camera)
    w, h = interior.size
    part = np.linspace(0.0, 1.0, _POINTS)
    x, y = (g.ravel() for g in np.meshgrid(part * (w - 1), part * (h - 1)))
    middle, half = np.array([(w - 1) / 2, (h - 1) / 2]), np.array([0.5, 0.0])
    xy = np.concatenate([[middle, middle + half, middle - half], np.column_stack([x, y])])
    t = lens.undistort(interior.tangent_to_pixel.inverse(xy))
    pixel = float(np.linalg.norm(t[1] - t[2]))
    angles = angle_in_radians(np.array(image.pose_numbers[1]), orientation.angle_unit)
    points = np.delete(t, [1, 2], axis=0)
    return JudgedView(
        name=image.name,
        center=np.asarray(center, float),
        angles=angles,
        order=orientation.rotation,
        tangents=points,
        pixel=pixel,
        unit=orientation.angle_unit,
        mirrored=camera.fiducial_system is not None and camera.fiducial_system.mirrored,
    )


#: What makes the camera of each kind of image.
_MAKERS: dict[type[ImageEntry], Callable[[Project, Any, Ground, tuple[int, int]], Camera]] = {
    Image_cameras: posed_camera,
    RpcImage: rpc_camera,
    LineImage: line_camera,
    FrameImage: frame_camera,
}


def camera_of(project: Project, image: ImageEntry, ground: Ground, size: tuple[int, int]) -> Camera:
    """Camera of an image by what the project states; another `size` of its file than is stated is an InputError."""
    return _MAKERS[type(image)](project, image, ground, size)


def is_there(file: Path) -> bool:
    """Return whether anything is found under a name, be it one that no file can have."""
    try:
        file.stat()
    except (OSError, ValueError):
        return False
    return True


def camera_without_pixels(project: Project, name: str) -> Camera:
    """Camera of one image without its pixels: the image file need not be there; where it is, its size is compared."""
    image = project.any_image(name)
    return camera_of(project, image, ground_of(project), size_of(project, image))


def central_without_pixels(project: Project, name: str) -> CentralCamera:
    """The same of an image whose rays meet in a point."""
    image = project.image(name)
    return posed_camera(project, image, ground_of(project), size_of(project, image))


def size_of(project: Project, image: ImageEntry) -> tuple[int, int]:
    """Width and height of an image: of its file, or what is stated where that is not there."""
    file = project.resolve(image.file)
    if is_there(file):
        return read_info(file).size
    described = image.described_by
    size = image.size or (None if described is None else project.cameras[described].size)
    if size is None:
        raise InputError(f"image {image.name!r}: {file} is not there, and no size is stated")
    return size
