"""Frame cameras that are oriented in the axes of a body: planets, moons, the earth from space."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.base import ImageField, Vantage
from photoplan.cameras.frame import FrameCamera
from photoplan.cameras.pushbroom_rays import heights_of, meet, vantage_over
from photoplan.errors import UsageError
from photoplan.geometry.local import BodyGround

_Floats = NDArray[np.float64]
#: Points on a side of the grid over an image that is followed to the ground: a body may fill little of it.
_SIDE = 33


@dataclass(frozen=True, eq=False)
class BodyFrameCamera:
    """A frame image in the axes of its body, over the ground of a project.

    What the body itself hides, on its far side, has no position.
    """

    frame: FrameCamera
    """The camera in the axes of the body."""
    ground: BodyGround

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image in pixels."""
        return self.frame.size

    @property
    def field(self) -> ImageField | None:
        """Lens of the frame camera."""
        return self.frame.field

    @property
    def breaks(self) -> None:
        """The mapping is smooth."""
        return None

    @cached_property
    def vantage(self) -> Vantage:
        """Above the middle of what it sees."""
        w, h = self.size
        rows, columns = np.linspace(-0.5, h - 0.5, _SIDE), np.linspace(-0.5, w - 0.5, _SIDE)
        xy = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
        return vantage_over(self.ground, self.frame.center[None], lambda level: self.rays(xy, level)[0])

    def project_homogeneous(self, XYZ: ArrayLike) -> _Floats:
        """Ground (..., 3) to ideal (x·w, y·w, w), w = depth in metres; NaN behind the body."""
        P = self.ground(XYZ)
        out = self.frame.project_homogeneous(P)
        out[self._hidden(P)] = np.nan
        return out

    def derivatives(self, XYZ: ArrayLike) -> _Floats:
        """∂(x, y)/∂(X, Y, Z), shape (..., 2, 3), pixels per metre; NaN behind the camera and the body."""
        P = self.ground(XYZ)
        out = self.frame.derivatives(P) @ self.ground.jacobian(XYZ)
        out[self._hidden(P)] = np.nan
        return np.asarray(out)

    def rays(self, xy: ArrayLike, height: ArrayLike | None = None) -> tuple[_Floats, _Floats]:
        """Image points (..., 2) to rays: the point of the ray at `height` and its tangent there, each (..., 3).

        `height` is one number or one for each point. NaN where a ray passes the body.
        """
        if height is None:
            raise UsageError("rays over a body are curved on the map; give a height")
        xy = np.asarray(xy, float)
        S, d = self.frame.rays(xy.reshape(-1, 2))
        point, tangent = meet(self.ground, S, d, np.broadcast_to(np.asarray(height, float), xy.shape[:-1]).ravel())
        return point.reshape(*xy.shape[:-1], 3), tangent.reshape(*xy.shape[:-1], 3)

    def _hidden(self, P: _Floats) -> NDArray[np.bool_]:
        """Return whether the lowest ground there may be lies between the camera and points (..., 3) of the body."""
        a, b = (radius + heights_of(self.ground)[0] for radius in self.ground.radii)
        s = self.frame.center / (a, a, b)
        way = P / (a, a, b) - s
        # Where on the way the centre of the body, a sphere now, is nearest.
        part = np.clip(-(way @ s) / (way**2).sum(axis=-1), 0.0, 1.0)
        return np.asarray(((s + part[..., None] * way) ** 2).sum(axis=-1) < 1.0)
