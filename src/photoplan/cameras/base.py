"""What every camera can do. The rest of photoplan knows no more of one."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray


class Camera(Protocol):
    """A mapping from ground to image, smooth wherever the point lies in front.

    Ground coordinates are those of the product: projected X, Y and height Z, metres. Image coordinates are
    (x, y) = (column, row) in pixels, (0, 0) the centre of the upper-left pixel. All methods are vectorised.
    """

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        ...

    @property
    def center(self) -> NDArray[np.float64]:
        """Projection centre in ground coordinates, shape (3,)."""
        ...

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ground (..., 3) to homogeneous image coordinates (x·w, y·w, w), shape (..., 3).

        w is positive in front of the camera, zero or negative behind, and for an undistorted frame camera all three
        are linear in XYZ. NaN in gives NaN out.
        """
        ...

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image points (..., 2) to rays: an origin and a unit direction (pointing away from the camera), each (..., 3).

        In Cartesian ground space the origin is the projection centre and `height` is not needed. Where the ray is
        curved in map coordinates (earth curvature, refraction) the origin is the ray's point at `height` and the line
        is its tangent there; `height` is then required. Points that no ray reaches give NaN.
        """
        ...

    def derivatives(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(x, y)/∂(X, Y, Z), shape (..., 2, 3), pixels per metre; NaN behind the camera."""
        ...


def project(camera: Camera, XYZ: ArrayLike) -> NDArray[np.float64]:
    """Ground points (..., 3) to image points (..., 2) in pixels; NaN at and behind the camera's plane."""
    h = camera.project_homogeneous(XYZ)
    w = h[..., 2:]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(w > 0, h[..., :2] / w, np.nan)
