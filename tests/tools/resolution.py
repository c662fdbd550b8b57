"""Rules of thumb with a source: resolution, data volume, and what errors of the inputs do to the picture.

All for vertical images; lengths in metres, angles in radians. Functions take numbers or arrays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import UsageError
from photoplan.geometry.local import MEAN_RADIUS


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
