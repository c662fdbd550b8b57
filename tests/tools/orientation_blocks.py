"""A small block for tests of orientation files, and the collinearity equations written out."""

from pathlib import Path

import numpy as np

from photoplan.cameras.base import project
from photoplan.cameras.frame import FrameCamera as PixelCamera
from photoplan.geometry.pose import Pose
from photoplan.io.camera.model import FrameEntry
from photoplan.io.orientation.block import OrientationBlock, OrientationTable, OrientedImage
from photoplan.io.project.model import Image, interior_of, lens_of

CAMERA = FrameEntry(
    size=(13824, 7680), camera_constant_mm=120.01, pixel_size_um=12.0, principal_point_mm=(0.024, -0.036)
)
CENTERS = ((512345.678, 5274112.875, 2630.44), (513000.125, 5274100.5, 2641.0625), (512345.0, 5273000.25, 2619.75))
ANGLES = ((0.75, -1.25, 88.5), (-12.5, 7.125, -91.0), (31.0, -22.0, 178.75))
NAMES = ("4711", "4712", "07_0013")
GROUND = ((512300.0, 5274150.0, 500.0), (512500.0, 5273900.0, 612.5), (512900.0, 5274300.0, 433.25))


def block(camera=CAMERA, crs=None):
    """Three images, one of them strongly tilted; angles are ω, φ, κ in degrees."""
    images = tuple(OrientedImage(n, c, a, "DMC" if camera else None) for n, c, a in zip(NAMES, CENTERS, ANGLES))
    table = OrientationTable(Path("made"), images, crs=crs)
    return OrientationBlock(table, {"DMC": camera} if camera else {}, {NAMES[0]: "scans/4711 a.tif"} if camera else {})


def our_pixels(table, camera=CAMERA, ground=GROUND):
    """Pixels of ground points in every image by photoplan's camera, shape (images, points, 2)."""
    found = []
    for image, R in zip(table.images, table.rotations):
        described = Image(name=image.name, file="x.tif", camera="c")
        interior = interior_of(camera, described)
        found.append(project(PixelCamera(interior, lens_of(camera), Pose(np.array(image.center), R)), ground))
    return np.array(found)


def pixels_of_matrix(r, center, camera=CAMERA, ground=GROUND):
    """Collinearity with r_ik the elements of the matrix from the camera's axes to the ground's, in millimetres."""
    dX, dY, dZ = (np.array(ground) - center).T
    down = r[0][2] * dX + r[1][2] * dY + r[2][2] * dZ
    x = -camera.camera_constant_mm * (r[0][0] * dX + r[1][0] * dY + r[2][0] * dZ) / down
    y = -camera.camera_constant_mm * (r[0][1] * dX + r[1][1] * dY + r[2][1] * dZ) / down
    return pixels_of_millimetres(x, y, camera)


def pixels_of_millimetres(x, y, camera=CAMERA):
    """Pixel (0, 0) is the centre of the upper-left one; the image coordinates' origin is the principal point."""
    x0, y0 = camera.principal_point_mm
    width, height = camera.size
    p = camera.pixel_size_um / 1000
    return np.stack([(width - 1) / 2 + (x + x0) / p, (height - 1) / 2 - (y + y0) / p], axis=-1)


def phi_omega_kappa(p, o, k):
    """Rotation with φ primary, written out (Kraus, Photogrammetry, vol. 1: R_φ R_ω R_κ)."""
    from math import cos, sin

    return [
        [cos(p) * cos(k) + sin(p) * sin(o) * sin(k), -cos(p) * sin(k) + sin(p) * sin(o) * cos(k), sin(p) * cos(o)],
        [cos(o) * sin(k), cos(o) * cos(k), -sin(o)],
        [-sin(p) * cos(k) + cos(p) * sin(o) * sin(k), sin(p) * sin(k) + cos(p) * sin(o) * cos(k), cos(p) * cos(o)],
    ]
