"""From the map to Cartesian axes fixed to a body (the earth, a planet, a moon), and back."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.geometry.crs import crs_label, require_projected_metres
from photoplan.geometry.geodetic import GeodeticGround
from photoplan.geometry.local import Ellipsoid, ProjectedCrs, projected_crs

#: Semi-axes of WGS 84, metres.
EARTH_RADII = (6_378_137.0, 6_356_752.314245179)
#: Half the distance over which derivatives are taken, metres, and of small bodies as a part of their radius.
_REACH, _PART = 100.0, 2e-5
#: Radii of what a file and a CRS call the same body agree to this part.
_SAME = 0.01


@dataclass(frozen=True)
class BodyGround:
    """Ground coordinates of a project in the axes of its body: metres, z towards the pole, x towards longitude 0.

    On earth the axes are those of WGS 84, with the CRS's own operation to them; elsewhere those of the CRS's own datum.
    """

    crs: str
    """Projected CRS of the ground."""
    heights: str
    """Height system of the ground."""
    radii: tuple[float, float]
    """Equatorial and polar radius of the body, metres, as the file of the image states them."""
    _geodetic: GeodeticGround | None = field(init=False, repr=False, compare=False)
    _own: ProjectedCrs = field(init=False, repr=False, compare=False)
    _wgs84: Ellipsoid = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        ellipsoid = require_projected_metres(self.crs).ellipsoid
        radius = 0.0 if ellipsoid is None else ellipsoid.semi_major_metre
        if abs(radius - self.radii[0]) > _SAME * self.radii[0]:
            raise InputError(
                f"the image shows a body of radius {self.radii[0] / 1000:.1f} km, but the project's CRS "
                f"{crs_label(self.crs)!r} lies on one of {radius / 1000:.1f} km; state a CRS of the right body"
            )
        earth = abs(radius - EARTH_RADII[0]) < _SAME * EARTH_RADII[0]
        object.__setattr__(self, "_geodetic", GeodeticGround(self.crs, self.heights) if earth else None)
        object.__setattr__(self, "_own", projected_crs(self.crs))
        object.__setattr__(self, "_wgs84", Ellipsoid.of_radii(*EARTH_RADII))

    @property
    def bare(self) -> BodyGround:
        """The same with heights above the ellipsoid."""
        return self if self.heights == "ellipsoidal" else BodyGround(self.crs, "ellipsoidal", self.radii)

    @property
    def on_earth(self) -> bool:
        """Whether the body is the earth."""
        return self._geodetic is not None

    def __call__(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Map X, Y and height (..., 3) to the body's axes (..., 3); NaN where the CRS has no place."""
        if self._geodetic is None:
            return self._own.geocentric(np.asarray(XYZ, float))[0]
        at = self._geodetic(XYZ)
        return self._wgs84.geocentric(np.radians(at[..., 0]), np.radians(at[..., 1]), at[..., 2])[0]

    def ellipsoidal(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Height above the body's ellipsoid (...) of map points with height (..., 3), metres."""
        return np.asarray(XYZ, float)[..., 2] if self._geodetic is None else self._geodetic.ellipsoidal(XYZ)

    def to_map(self, xyz: ArrayLike) -> NDArray[np.float64]:
        """The inverse of a call."""
        xyz = np.asarray(xyz, float)
        if self._geodetic is None:
            return self._own.from_geocentric(xyz)
        lon, lat, h = self._wgs84.geodetic(xyz)
        return self._geodetic.to_map(np.stack([np.degrees(lon), np.degrees(lat), h], axis=-1))

    def height(self, xyz: ArrayLike) -> NDArray[np.float64]:
        """Height above the body's ellipsoid (...) of points in its axes (..., 3), metres."""
        return self.ellipsoid.geodetic(np.asarray(xyz, float))[2]

    @property
    def ellipsoid(self) -> Ellipsoid:
        """The body's, whose middle and axes are those of the body."""
        return self._own.ellipsoid if self._geodetic is None else self._wgs84

    @property
    def reach(self) -> float:
        """Half the distance over which the map hardly bends, metres: for derivatives."""
        return min(_REACH, _PART * self.radii[0])

    def jacobian(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """∂(x, y, z) / ∂(X, Y, height), shape (..., 3, 3)."""
        XYZ = np.asarray(XYZ, float)
        steps = self.reach * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0], [0, 0, 1.0], [0, 0, -1.0]])
        around = self(XYZ[..., None, :] + steps)
        return np.asarray(np.moveaxis(around[..., ::2, :] - around[..., 1::2, :], -2, -1) / (2 * self.reach))
