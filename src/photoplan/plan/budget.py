"""Rules of thumb with a source: what errors of heights and orientation do to a vertical image (Ecker 1991, §4.8).

Lengths in metres, angles in radians. Functions take numbers or arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Distance of an image corner from the principal point, 23 cm film format, metres (Ecker 1991, tables 4.2, 4.3).
FILM_CORNER = 0.140


def displacement_by_height(radius: ArrayLike, flying_height: ArrayLike, error: ArrayLike) -> NDArray[np.float64]:
    """Radial displacement in the image by a height error: Δr = r ΔZ / h (Ecker 1991, eq. 4.18, table 4.3).

    An error of the projection centre's height acts in the same way (eq. 4.21).
    """
    return np.asarray(radius, float) * np.asarray(error, float) / np.asarray(flying_height, float)


def admissible_height_error(
    radius: ArrayLike, flying_height: ArrayLike, displacement: ArrayLike = 25e-6
) -> NDArray[np.float64]:
    """Height error that displaces a point at `radius` by `displacement` in the image (Behr 1989, §6.1.2, fig. 6.4)."""
    return np.asarray(displacement, float) * np.asarray(flying_height, float) / np.asarray(radius, float)


def displacement_by_shift(shift: ArrayLike, scale_number: ArrayLike) -> NDArray[np.float64]:
    """Displacement in the image by an error in X0, Y0: Δr = ΔR / m_b (Ecker 1991, eq. 4.20)."""
    return np.asarray(shift, float) / np.asarray(scale_number, float)


def admissible_shift(displacement: ArrayLike, scale_number: ArrayLike) -> NDArray[np.float64]:
    """Error in X0, Y0 that displaces the image by `displacement`; inverse of `displacement_by_shift`."""
    return np.asarray(displacement, float) * np.asarray(scale_number, float)


def displacement_by_tilt(angle: ArrayLike, c: ArrayLike, w: ArrayLike) -> NDArray[np.float64]:
    """Displacement by an error in ω or φ: c √(2w⁴ + 2w² + 1) Δω (Ecker 1991, eq. 4.27, 4.28).

    `w` is the tangent of the field angle along either axis at an image corner, X / Z = Y / Z there (0.733 for
    wide-angle film); at the principal point it is 0.
    """
    w2 = np.asarray(w, float) ** 2
    return np.asarray(c, float) * np.sqrt(2.0 * w2 * w2 + 2.0 * w2 + 1.0) * np.asarray(angle, float)


def displacement_by_kappa(angle: ArrayLike, c: ArrayLike, w: ArrayLike) -> NDArray[np.float64]:
    """Displacement by an error in κ: c w √2 Δκ (Ecker 1991, eq. 4.29); `w` as in `displacement_by_tilt`."""
    return np.asarray(c, float) * np.asarray(w, float) * math.sqrt(2.0) * np.asarray(angle, float)


@dataclass(frozen=True)
class OrientationEffect:
    """What the standard deviations of an exterior orientation mean in the image corners, metres in the image."""

    X: float
    Y: float
    Z: float
    omega: float
    phi: float
    kappa: float


def orientation_effect(
    center_sd: tuple[float, float, float],
    angles_sd: tuple[float, float, float],
    c: float,
    flying_height: float,
    *,
    scale_number: float | None = None,
    radius: float = FILM_CORNER,
    w: float = 0.733,
) -> OrientationEffect:
    """Displacements in the image corners by errors of the orientation, one by one (Ecker 1991, table in §8.2.2)."""
    scale = flying_height / c if scale_number is None else scale_number
    return OrientationEffect(
        X=float(displacement_by_shift(center_sd[0], scale)),
        Y=float(displacement_by_shift(center_sd[1], scale)),
        Z=float(displacement_by_height(radius, flying_height, center_sd[2])),
        omega=float(displacement_by_tilt(angles_sd[0], c, w)),
        phi=float(displacement_by_tilt(angles_sd[1], c, w)),
        kappa=float(displacement_by_kappa(angles_sd[2], c, w)),
    )
