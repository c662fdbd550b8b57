"""Interior orientation and lens of a project's images."""

from __future__ import annotations

from photoplan.cameras.fiducials_fit import FiducialFit
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.errors import InputError
from photoplan.io.camera.model import CameraEntry
from photoplan.io.project.posed import Image


def image_size(camera: CameraEntry, image: Image) -> tuple[int, int]:
    """Width and height of an image as the project states it."""
    size = image.size or camera.size
    if size is None:
        raise InputError(f"image {image.name!r}: its size is stated neither with the image nor with its camera")
    return size


def fiducial_fit(camera: CameraEntry, image: Image, model: str | None = None) -> FiducialFit:
    """Adjustment of an image's fiducial marks; see `photoplan.io.camera.model.FiducialSystem.fit`."""
    system = camera.fiducial_system
    if system is None:
        raise InputError(f"image {image.name!r}: its camera has no fiducial marks")
    try:
        return system.fit(image.fiducials, model)
    except InputError as error:
        raise type(error)(f"image {image.name!r}: {error}") from None


def interior_of(camera: CameraEntry, image: Image, size: tuple[int, int] | None = None) -> Interior:
    """Interior orientation of an image."""
    size = size or image_size(camera, image)
    try:
        return camera.interior_orientation(size, image.fiducials)
    except InputError as error:
        raise type(error)(f"image {image.name!r}: {error}") from None


def lens_of(camera: CameraEntry) -> Lens:
    """Lens of a camera; raises InputError where the coefficients cannot be a lens's."""
    return camera.lens.made(camera)
