"""The radial distortion of a calibration report, as a table."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.cameras.lenses.inverse import radial_jacobian
from photoplan.errors import InputError

_ITERATIONS = 60


@dataclass(frozen=True)
class RadialTable:
    """Radial distortion known at a few radii; dimensionless, as everything about a lens: millimetres divided by c.

    A shift is *distortion*, positive outwards: the real image point lies at r + Δ(r). Reports that state corrections
    are entered with the opposite sign (the difference, Δ times its slope, is far below a micrometre).

    Between the knots, of which the axis with Δ = 0 is always one, Δ is a piecewise cubic that is monotone between
    neighbouring knots and has a continuous derivative (Fritsch and Carlson 1980): it never overshoots the report.
    Beyond the last knot the report says nothing, and nothing is invented: Δ keeps the last value, which it reaches
    with slope zero.
    """

    radii: tuple[float, ...]
    """Radii of the knots, tan α = r / c, increasing; the axis may be left out."""
    shifts: tuple[float, ...]
    """Δ at the knots, divided by c."""
    _knots: NDArray[np.float64] = field(init=False, repr=False, compare=False)
    _cubics: NDArray[np.float64] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        radii, shifts = tuple(map(float, self.radii)), tuple(map(float, self.shifts))
        if len(radii) != len(shifts) or not radii:
            raise InputError(
                f"radial table with {len(radii)} radii and {len(shifts)} shifts; as many of both are needed"
            )
        if not all(map(math.isfinite, radii + shifts)):
            raise InputError(f"radial table {self.radii}, {self.shifts}: every entry must be a finite number")
        if radii[0] != 0.0:
            radii, shifts = (0.0, *radii), (0.0, *shifts)
        if shifts[0] != 0.0:
            raise InputError(f"radial table: the shift on the axis is {shifts[0]}, it must be zero")
        if len(radii) < 2 or not all(a < b for a, b in itertools.pairwise(radii)):
            raise InputError(f"radial table: radii {self.radii} must be positive and increase")
        knots = np.array(radii)
        cubics = _monotone_cubics(knots, np.array(shifts))
        object.__setattr__(self, "radii", radii)
        object.__setattr__(self, "shifts", shifts)
        object.__setattr__(self, "_knots", knots)
        object.__setattr__(self, "_cubics", cubics)
        sample = np.linspace(0.0, knots[-1], 32 * len(knots))
        steep = 1.0 + self._shift(sample)[1] <= 0.0
        if steep.any():
            raise InputError(
                f"radial table folds back near r / c = {sample[steep][0]:.4g}: the shifts fall faster than the radii "
                "grow; check their unit (micrometres?)"
            )

    @classmethod
    def from_angles(cls, angles_deg: ArrayLike, micrometres: ArrayLike, c_mm: float) -> RadialTable:
        """From distortion in micrometres against the field angle in degrees (USGS reports), camera constant in mm."""
        angles = np.atleast_1d(np.asarray(angles_deg, float))
        if not ((angles >= 0) & (angles < 90)).all():
            raise InputError(f"field angles {angles.tolist()}; degrees from 0 to below 90 are needed")
        return cls.from_radii(_camera_constant(c_mm) * np.tan(np.radians(angles)), micrometres, c_mm)

    @classmethod
    def from_radii(cls, radii_mm: ArrayLike, micrometres: ArrayLike, c_mm: float) -> RadialTable:
        """From distortion in micrometres against the radius in the image in millimetres, camera constant in mm."""
        c = _camera_constant(c_mm)
        radii = np.atleast_1d(np.asarray(radii_mm, float)) / c
        shifts = np.atleast_1d(np.asarray(micrometres, float)) * 1e-3 / c
        return cls(tuple(radii.tolist()), tuple(shifts.tolist()))

    def distort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Ideal to real tangent coordinates, shapes (..., 2)."""
        t = np.asarray(t, float)
        r = np.hypot(t[..., 0], t[..., 1])
        return t * (1.0 + self._ratio(r))[..., None]

    def undistort(self, t: ArrayLike) -> NDArray[np.float64]:
        """Real to ideal tangent coordinates, shapes (..., 2), by Newton's method."""
        t = np.asarray(t, float)
        rd = np.hypot(t[..., 0], t[..., 1])
        r = rd
        for _ in range(_ITERATIONS):
            shift, slope = self._shift(r)
            step = (r + shift - rd) / (1.0 + slope)
            r = np.maximum(r - step, 0.0)
            if not (np.abs(step) > 4e-16 + 2e-15 * r).any():
                break
        good = np.abs(r + self._shift(r)[0] - rd) <= 1e-12 * (1.0 + rd)
        return t * np.where(good, 1.0 / (1.0 + self._ratio(r)), np.nan)[..., None]

    def jacobian(self, t: ArrayLike) -> NDArray[np.float64]:
        """∂ distort(t) / ∂ t, shape (..., 2, 2)."""
        t = np.asarray(t, float)
        r = np.hypot(t[..., 0], t[..., 1])
        return radial_jacobian(t, r, 1.0 + self._ratio(r), 1.0 + self._shift(r)[1])

    def _shift(self, r: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Δ(r) and its slope."""
        # The last row of the cubics is the constant beyond the last knot.
        i = np.searchsorted(self._knots, r, side="right") - 1
        s = r - self._knots[i]
        a, b, c, d = np.moveaxis(self._cubics[i], -1, 0)
        return a + s * (b + s * (c + s * d)), b + s * (2.0 * c + s * 3.0 * d)

    def _ratio(self, r: NDArray[np.float64]) -> NDArray[np.float64]:
        """Δ(r) / r, on the axis its limit, the slope."""
        shift = self._shift(r)[0]
        return np.where(r > 0, shift / np.where(r > 0, r, 1.0), self._cubics[0, 1])


def _camera_constant(c_mm: float) -> float:
    if not (math.isfinite(c_mm) and c_mm > 0):
        raise InputError(f"camera constant {c_mm} mm; a positive number is needed")
    return float(c_mm)


def _monotone_cubics(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients a + b s + c s² + d s³ of each interval and of the constant beyond, shape (len(x), 4)."""
    h, rise = np.diff(x), np.diff(y)
    steepness = rise / h
    slope = np.zeros(len(x))
    before, after = steepness[:-1], steepness[1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        w1, w2 = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
        slope[1:-1] = np.where(before * after > 0, (w1 + w2) / (w1 / before + w2 / after), 0.0)
    # On the axis the first chord; at the last knot zero, where the constant takes over.
    slope[0] = steepness[0]
    c = (3.0 * steepness - 2.0 * slope[:-1] - slope[1:]) / h
    d = (slope[:-1] + slope[1:] - 2.0 * steepness) / h**2
    return np.vstack([np.stack([y[:-1], slope[:-1], c, d], axis=1), [y[-1], 0.0, 0.0, 0.0]])
