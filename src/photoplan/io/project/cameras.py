"""From a project's descriptions of cameras to the interior orientation and lens that compute."""

from __future__ import annotations

from photoplan.cameras.fiducials_fit import FiducialFit, fit_marks
from photoplan.cameras.interior import Interior
from photoplan.cameras.lenses.base import Lens
from photoplan.cameras.lenses.brown import Brown
from photoplan.cameras.lenses.fisheye import Fisheye
from photoplan.cameras.lenses.none import NoLens
from photoplan.cameras.lenses.opencv import OpenCV
from photoplan.cameras.lenses.radial_table import RadialTable
from photoplan.cameras.lenses.reversed import Reversed
from photoplan.errors import InputError
from photoplan.io.camera import model as described
from photoplan.io.project.model import Image


def image_size(camera: described.FrameEntry | described.FilmCamera, image: Image) -> tuple[int, int]:
    """Width and height of an image as the project states it.

    Raises
    ------
    InputError
        Neither image nor camera states it.
    """
    size = image.size or camera.size
    if size is None:
        raise InputError(f"image {image.name!r}: its size is stated neither with the image nor with its camera")
    return size


def fiducial_fit(camera: described.FilmCamera, image: Image) -> FiducialFit:
    """Adjustment of an image's fiducial marks, with residuals and sigma0.

    Raises
    ------
    InputError
        Marks are missing, exchanged, far off or mirrored; the image is named.
    GeometryError
        The marks lie on a line.
    """
    if not image.fiducials:
        raise InputError(
            f"image {image.name!r}: the fiducial marks of its scan are not measured; `photoplan fiducials` finds them"
        )
    try:
        return fit_marks(camera.interior, camera.fiducials_mm, image.fiducials, mirrored=camera.mirrored)
    except InputError as error:
        raise type(error)(f"image {image.name!r}: {error}") from None


def interior_of(
    camera: described.FrameEntry | described.FilmCamera, image: Image, size: tuple[int, int] | None = None
) -> Interior:
    """Interior orientation of an image.

    Parameters
    ----------
    camera : FrameCamera or FilmCamera
        Description of its camera.
    image : Image
        The image; only film needs its fiducial marks.
    size : (int, int), optional
        Width and height of the file in pixels; as stated if it is None.

    Raises
    ------
    InputError
        See `fiducial_fit`.
    """
    size = size or image_size(camera, image)
    if isinstance(camera, described.FilmCamera):
        plane_to_pixel = fiducial_fit(camera, image).transformation
        return Interior(camera.camera_constant_mm, camera.principal_point_mm, plane_to_pixel, size)
    if camera.camera_constant_mm is not None and camera.principal_point_px is None:
        point = camera.principal_point_mm or (0.0, 0.0)
        return Interior.metric(size, camera.camera_constant_mm, camera.pixel_mm, point)
    col, row = camera.principal_point
    return Interior.digital(size, camera.focal, (col - (size[0] - 1) / 2, row - (size[1] - 1) / 2))


def lens_of(camera: described.FrameEntry | described.FilmCamera) -> Lens:
    """Lens of a camera.

    Raises
    ------
    InputError
        The coefficients cannot be a lens's.
    """
    lens = camera.lens
    if isinstance(lens, described.IdealLens):
        return NoLens()
    if isinstance(lens, described.OpenCVLens):
        return OpenCV(k1=lens.k1, k2=lens.k2, p1=lens.p1, p2=lens.p2, k3=lens.k3, k4=lens.k4, k5=lens.k5, k6=lens.k6)
    if isinstance(lens, described.OpenCVFisheyeLens):
        return Fisheye(lens.k1, lens.k2, lens.k3, lens.k4)
    if isinstance(lens, described.BrownLens):
        return _brown(lens, camera)
    c = _camera_constant(camera)
    if lens.angles_deg is not None:
        return RadialTable.from_angles(lens.angles_deg, lens.distortion_um, c)
    return RadialTable.from_radii(lens.radii_mm or (), lens.distortion_um, c)


def _brown(lens: described.BrownLens, camera: described.FrameEntry | described.FilmCamera) -> Lens:
    c = 1.0
    if lens.unit == "mm":
        c = _camera_constant(camera)
    elif lens.unit == "px" and isinstance(camera, described.FrameEntry):
        c = camera.focal[0]
    made = Brown.from_image_units(c, k=(lens.k1, lens.k2, lens.k3, lens.k4), p=(lens.p1, lens.p2), b=(lens.b1, lens.b2))
    if lens.y_axis == "down":
        k = (made.k1, made.k2, made.k3, made.k4)
        made = Brown.from_y_down(k=k, p=(made.p1, made.p2), b=(made.b1, made.b2))
    return Reversed(made) if lens.meaning == "correction" else made


def _camera_constant(camera: described.FrameEntry | described.FilmCamera) -> float:
    if camera.camera_constant_mm is None:
        raise InputError("the lens is described in millimetres; give camera_constant_mm")
    return camera.camera_constant_mm
