"""Cameras over the axes of their body: without a map, against values of other programs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.pushbroom import LineCamera
from photoplan.geometry.local import Ellipsoid
from photoplan.io.camera.line import StatedLine


@dataclass(frozen=True)
class BodyAxes:
    """Ground coordinates that are those of the body already."""

    radii: tuple[float, float]
    on_earth = False
    reach = 100.0

    def __call__(self, xyz: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(xyz, float)

    to_map = __call__

    @property
    def bare(self) -> BodyAxes:
        return self

    def ellipsoidal(self, xyz: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(xyz)[..., 2]

    def height(self, xyz: ArrayLike) -> NDArray[np.float64]:
        return Ellipsoid.of_radii(*self.radii).geodetic(np.asarray(xyz))[2]


def over_its_body(stated: StatedLine) -> LineCamera:
    return LineCamera(stated.track, stated.look, BodyAxes(stated.radii))  # type: ignore[arg-type]
