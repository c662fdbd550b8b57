"""Rules of thumb with a source: resolution, data volume, and what errors of the inputs do to the picture.

All for vertical images; lengths in metres, angles in radians. Functions take numbers or arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.local import MEAN_RADIUS

#: Distance of an image corner from the principal point, 23 cm film format, metres (Ecker 1991, tables 4.2, 4.3).
FILM_CORNER = 0.140


def resolution_on_ground(scale_number: ArrayLike, aperture: ArrayLike) -> NDArray[np.float64]:
    """Ground size of a pixel that keeps what the image holds: m_B · Δ_A (Behr 1989, eq. 5.8, fig. 5.8).

    `scale_number` is m_B of the image scale 1 : m_B, `aperture` the scanning aperture or sensor pixel, metres (25 µm
    keeps nearly all of a film image, 50 and 100 µm serve interpretation).
    """
    return np.asarray(scale_number, float) * np.asarray(aperture, float)


def sampling_interval(line_pairs_per_metre: float) -> float:
    """Largest interval that loses nothing of an image with this resolving power, metres (Ecker 1991, eq. 4.4)."""
    if not line_pairs_per_metre > 0:
        raise UsageError(f"resolving power {line_pairs_per_metre} line pairs per metre; a positive number is needed")
    return 1.0 / (2.0 * line_pairs_per_metre)


def scan_bytes(side: float | tuple[float, float], interval: float, bands: int = 1, bytes_per_sample: int = 1) -> float:
    """Bytes of a scanned image (Ecker 1991, table 4.1; Behr 1989, table 5.1).

    Parameters
    ----------
    side : float or (float, float)
        Side of the square format, or width and height, metres.
    interval : float
        Sampling interval, metres.
    """
    if not interval > 0:
        raise UsageError(f"sampling interval {interval} m; a positive number is needed")
    width, height = (side, side) if isinstance(side, int | float) else side
    return (width / interval) * (height / interval) * bands * bytes_per_sample


def megabytes(count: float) -> float:
    """Bytes in megabytes of 2²⁰ bytes, as both sources count."""
    return count / 2**20


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
    """Displacements in the image corners by errors of the orientation, one by one (Ecker 1991, table in §8.2.2).

    Parameters
    ----------
    center_sd : (float, float, float)
        Standard deviations of X0, Y0, Z0, metres.
    angles_sd : (float, float, float)
        Of ω, φ, κ, radians.
    c, flying_height : float
        Camera constant and flying height above ground, metres.
    scale_number : float, optional
        Of the image scale; by default `flying_height` / `c`.
    radius, w : float
        Distance of the corner from the principal point, metres; its tangent along either axis.
    """
    scale = flying_height / c if scale_number is None else scale_number
    return OrientationEffect(
        float(displacement_by_shift(center_sd[0], scale)),
        float(displacement_by_shift(center_sd[1], scale)),
        float(displacement_by_height(radius, flying_height, center_sd[2])),
        float(displacement_by_tilt(angles_sd[0], c, w)),
        float(displacement_by_tilt(angles_sd[1], c, w)),
        float(displacement_by_kappa(angles_sd[2], c, w)),
    )


def curvature_displacement(
    radius: ArrayLike, c: ArrayLike, Z0: ArrayLike, Z: ArrayLike = 0.0, earth_radius: float = MEAN_RADIUS
) -> NDArray[np.float64]:
    """Radial displacement in the image if earth curvature is neglected (Ecker 1991, eq. 4.17, table 4.2).

    Parameters
    ----------
    radius, c : array_like
        Distance from the principal point and camera constant, metres.
    Z0, Z : array_like
        Heights of the projection centre and of the ground point above the nadir point, metres.
    earth_radius : float
        Increased by the nadir point's height, metres.
    """
    r, c, Z0, Z = (np.asarray(v, float) for v in (radius, c, Z0, Z))
    return np.asarray(r / (2.0 * earth_radius) * (r * r * (Z0 - Z) / (c * c) - 2.0 * Z), float)


def on_map(displacement: ArrayLike, depth: ArrayLike, c: ArrayLike, map_scale_number: ArrayLike) -> NDArray[np.float64]:
    """A displacement in the image as a length in a map (Ecker 1991, §4.6.5.2): Δr (Z0 − Z) / (c m_K)."""
    ground = np.asarray(displacement, float) * np.asarray(depth, float) / np.asarray(c, float)
    return np.asarray(ground / np.asarray(map_scale_number, float), float)
