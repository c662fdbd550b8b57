"""Whether the file of an image has the size that its camera is stated for."""

from __future__ import annotations

from photoplan.errors import InputError
from photoplan.io.project.model import Image, Project


def check_size(file: str, size: tuple[int, int], stated: tuple[int, int] | None, says: str, so: str) -> None:
    """Refuse an image whose camera is stated for another size; None: none is stated."""
    if stated is not None and tuple(stated) != size:
        raise InputError(f"{file}: {size[0]} × {size[1]} pixels, but {says} {stated[0]} × {stated[1]}; {so}")


def check_camera_size(project: Project, image: Image, size: tuple[int, int]) -> None:
    """The same for an image with a camera of the project."""
    stated = image.size or project.cameras[image.camera].size
    so = "an image that was cropped or scaled needs a camera of its own"
    check_size(image.file, size, stated, f"camera {image.camera!r} has", so)
