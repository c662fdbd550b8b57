"""From the map to longitude, latitude and ellipsoidal height (WGS 84), and back: the ground of satellite images."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.crs import CrsStep, crs_step, nearest_turn
from photoplan.geometry.heights import HeightStep, height_step

WGS84 = "EPSG:4326"
#: Half the distance over which derivatives are taken, metres: truncation and rounding both stay below 1e-10.
_REACH = 100.0
#: An undulation is so even that each turn of the iteration gains four digits.
_TURNS = 4


@dataclass(frozen=True)
class GeodeticGround:
    """Ground coordinates of a project as WGS 84 has them.

    Raises
    ------
    InputError
        There is no exact operation between the CRS and WGS 84.
    HeightSystemError
        The grid that joins the height systems is missing.
    """

    crs: str
    """Projected CRS of the ground."""
    heights: str = "ellipsoidal"
    """Height system of the ground; ``"same"`` is declared to be ellipsoidal."""
    _to_geodetic: CrsStep = field(init=False, repr=False, compare=False)
    _to_map: CrsStep = field(init=False, repr=False, compare=False)
    _to_ellipsoid: HeightStep = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_to_geodetic", crs_step(self.crs, WGS84))
        object.__setattr__(self, "_to_map", crs_step(WGS84, self.crs))
        object.__setattr__(self, "_to_ellipsoid", height_step(self.heights, "ellipsoidal", self.crs))

    @property
    def operations(self) -> tuple[CrsStep | HeightStep, ...]:
        """What is done to coordinates and heights, for the run record."""
        heights = () if self._to_ellipsoid.definition is None else (self._to_ellipsoid,)
        return (self._to_geodetic, *heights)

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map X, Y and height to longitude, latitude (degrees) and ellipsoidal height; shapes (..., 3).

        NaN where the CRS has no place.

        Raises
        ------
        HeightSystemError
            A point lies outside the grid that joins the height systems.
        """
        XYZ = np.asarray(XYZ, float)
        out = np.empty_like(XYZ)
        out[..., :2] = self._to_geodetic.where_defined(XYZ[..., :2])
        out[..., 2] = self._to_ellipsoid(XYZ)
        return out

    def ellipsoidal(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Ellipsoidal height (...) of map X, Y and height (..., 3); raises as a call does."""
        return self._to_ellipsoid(np.asarray(XYZ, float))

    def to_map(self, geodetic: ArrayLike) -> NDArray[np.float64]:
        """The inverse of a call, to 1e-8 m; NaN where the CRS has no place, and outside the grid of the heights.

        A ray may leave the grid above or below the ground that it shows, far from any point that is asked for.
        """
        geodetic = np.asarray(geodetic, float)
        out = np.empty_like(geodetic)
        out[..., :2] = self._to_map.where_defined(geodetic[..., :2])
        out[..., 2] = geodetic[..., 2]
        if self._to_ellipsoid.definition is not None:
            for _ in range(_TURNS):
                out[..., 2] -= self._to_ellipsoid.where_defined(out) - geodetic[..., 2]
        return out

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(longitude, latitude, ellipsoidal height) / ∂(X, Y, height), shape (..., 3, 3), degrees and metres."""
        XYZ = np.asarray(XYZ, float)
        steps = np.array([[_REACH, 0, 0], [-_REACH, 0, 0], [0, _REACH, 0], [0, -_REACH, 0]])
        around = self(XYZ[..., None, :] + steps)
        around[..., 0] = nearest_turn(around[..., 0], around[..., :1, 0], 360.0)
        J = np.zeros((*XYZ.shape, 3))
        J[..., 0] = (around[..., 0, :] - around[..., 1, :]) / (2 * _REACH)
        J[..., 1] = (around[..., 2, :] - around[..., 3, :]) / (2 * _REACH)
        J[..., 2, 2] = 1.0
        return J
