"""A camera in the coordinates of a frame: over a wall, or along another image."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import Camera, ImageField, Parts, Tremor, Vantage
from photoplan.geometry.breaks import Breaks
from photoplan.geometry.frames import Frame


@dataclass(frozen=True, eq=False)
class FramedCamera:
    """Points of a frame go to the ground, then to the image. Its rays must be straight on the ground."""

    camera: Camera
    frame: Frame

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.camera.size

    @property
    def field(self) -> ImageField | None:
        """The camera's: what happens in the image is the same."""
        return self.camera.field

    @property
    def breaks(self) -> Breaks | Tremor | Parts | None:
        """The camera's."""
        return self.camera.breaks

    @property
    def vantage(self) -> Vantage:
        """Where it looks from; where the frame ends, its heights bound what is seen, and it is central no more."""
        point = self.frame.inverse(self.camera.vantage.point)
        low, high = self.frame.heights
        if math.isinf(high):
            return Vantage(point)
        top = min(high, float(point[2])) if np.isfinite(point[2]) else high
        return Vantage(np.array([*np.nan_to_num(point[:2]), top]), low, math.inf)

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Points of the frame (..., 3) to ideal (x·w, y·w, w), shape (..., 3); NaN where the frame has no ground."""
        return self.camera.project_homogeneous(self.frame(XYZ))

    def rays(self, xy: ArrayLike, height: float | None = None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Image points (..., 2) to rays in the frame: a point, that at `height` where it matters, and unit directions.

        NaN where the ray does not get there.
        """
        return self.frame.lines(*self.camera.rays(xy), 0.0 if height is None else height)

    def derivatives(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(x, y)/∂(u, v, h), shape (..., 2, 3), pixels per metre; NaN behind the camera."""
        return self.camera.derivatives(self.frame(XYZ)) @ self.frame.jacobian(XYZ)
