"""Interior orientation: camera constant, principal point, and how the image plane lies in pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.fiducials import Affine2D, Bilinear2D
from photoplan.errors import InputError


@dataclass(frozen=True)
class Interior:
    """From tangent coordinates to pixels: image-plane point = principal point + c · t, then plane to pixels.

    The image plane has x right, y up (positive image) and the unit of c: millimetres for film and metric cameras,
    pixels for cameras calibrated in pixels. Pixel (0, 0) is the centre of the upper-left pixel, y down.
    """

    c: float
    """Camera constant (principal distance), in the unit of the image plane."""
    principal_point: tuple[float, float]
    """x0, y0 in the image plane, same unit."""
    plane_to_pixel: Affine2D | Bilinear2D
    """From the image plane to pixels; for film from the fiducial marks."""
    size: tuple[int, int]
    """Width and height of the image in pixels."""
    tangent_to_pixel: Affine2D | Bilinear2D = field(init=False, repr=False, compare=False)
    """Principal point, camera constant and `plane_to_pixel` in one (Ecker 1991, eq. 4.10 and appendix B)."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.c) and self.c > 0):
            raise InputError(f"camera constant {self.c}; a positive number is needed")
        if len(self.principal_point) != 2 or not all(math.isfinite(v) for v in self.principal_point):
            raise InputError(f"principal point {self.principal_point}; two finite numbers are needed")
        if len(self.size) != 2 or not all(int(s) == s and s >= 1 for s in self.size):
            raise InputError(f"image size {self.size}; width and height in whole pixels are needed")
        x0, y0 = (float(v) for v in self.principal_point)
        object.__setattr__(self, "principal_point", (x0, y0))
        object.__setattr__(self, "size", (int(self.size[0]), int(self.size[1])))
        combined = self.plane_to_pixel @ Affine2D(a1=self.c, a2=0.0, a3=x0, a4=0.0, a5=self.c, a6=y0)
        object.__setattr__(self, "tangent_to_pixel", combined)

    @classmethod
    def digital(
        cls, size: tuple[int, int], focal_px: tuple[float, float], principal_offset_px: tuple[float, float] = (0.0, 0.0)
    ) -> Interior:
        """A camera that was calibrated in pixels.

        Parameters
        ----------
        size : (int, int)
            Width and height in pixels.
        focal_px : (float, float)
            fx, fy: camera constant in pixel widths and pixel heights.
        principal_offset_px : (float, float)
            Principal point minus the middle of the image ((width − 1) / 2, (height − 1) / 2), pixels, x right, y down.
        """
        fx, fy = focal_px
        if not (math.isfinite(fx) and math.isfinite(fy) and fx > 0 and fy > 0):
            raise InputError(f"focal lengths {focal_px} px; two positive numbers are needed")
        x, y = ((s - 1) / 2 + o for s, o in zip(size, principal_offset_px))
        return cls(fx, (0.0, 0.0), Affine2D(a1=1.0, a2=0.0, a3=x, a4=0.0, a5=-fy / fx, a6=y), size)

    @classmethod
    def metric(
        cls,
        size: tuple[int, int],
        c_mm: float,
        pixel_mm: float | tuple[float, float],
        principal_point_mm: tuple[float, float] = (0.0, 0.0),
    ) -> Interior:
        """A digital camera that is stated in millimetres.

        Parameters
        ----------
        size : (int, int)
            Width and height in pixels.
        c_mm : float
            Camera constant, millimetres.
        pixel_mm : float or (float, float)
            Side of a pixel, or its width and height, millimetres.
        principal_point_mm : (float, float)
            Principal point relative to the middle of the image, millimetres, x right, y up.
        """
        width, height = (pixel_mm, pixel_mm) if isinstance(pixel_mm, int | float) else pixel_mm
        if not (math.isfinite(width) and math.isfinite(height) and width > 0 and height > 0):
            raise InputError(f"pixel size {pixel_mm} mm; positive numbers are needed")
        x, y = ((s - 1) / 2 for s in size)
        return cls(c_mm, principal_point_mm, Affine2D(a1=1 / width, a2=0.0, a3=x, a4=0.0, a5=-1 / height, a6=y), size)

    def border(self, per_side: int = 8) -> NDArray[np.float64]:
        """Points on the outer edge of the image, corners first in each side, shape (4·per_side, 2), pixels."""
        w, h = self.size
        corners = np.array([(-0.5, -0.5), (w - 0.5, -0.5), (w - 0.5, h - 0.5), (-0.5, h - 0.5)])
        f = (np.arange(per_side) / per_side)[:, None]
        return np.concatenate([a + f * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0))])
