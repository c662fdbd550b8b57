"""The registry of image geometries: from any image of a project to its camera."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from photoplan.cameras.base import Camera, CentralCamera
from photoplan.errors import InputError
from photoplan.io.project.frame import FrameImage
from photoplan.io.project.image import ImageEntry
from photoplan.io.project.line import LineImage
from photoplan.io.project.model import Project
from photoplan.io.project.posed import Image
from photoplan.io.project.rpc import RpcImage
from photoplan.io.raster_info import read_info
from photoplan.project.by_frame import frame_camera
from photoplan.project.by_line import line_camera
from photoplan.project.by_rpc import rpc_camera
from photoplan.project.ground import Ground, ground_of
from photoplan.project.posed import posed_camera

#: What makes the camera of each kind of image.
_MAKERS: dict[type[ImageEntry], Callable[[Project, Any, Ground, tuple[int, int]], Camera]] = {
    Image: posed_camera,
    RpcImage: rpc_camera,
    LineImage: line_camera,
    FrameImage: frame_camera,
}


def camera_of(project: Project, image: ImageEntry, ground: Ground, size: tuple[int, int]) -> Camera:
    """Camera of an image by what the project states; another `size` of its file than is stated is an InputError."""
    return _MAKERS[type(image)](project, image, ground, size)


def is_there(file: Path) -> bool:
    """Whether anything is found under a name, be it one that no file can have."""
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
