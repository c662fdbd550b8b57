"""What homogeneous anchors leave of a distorted lens: over the side of a cell, and over its own height range.

Without distortion there is no residual at all. Here the lens is that of a large drone camera, f = 12 500 px, image
10 000 × 7 500 px, radial distortion x′ = x · (1 + k1 · r²) with k1 = −0.08 (r in units of f), flown 1250 m above the
ground: 0.10 m per pixel. The worst place is the image's corner, r = 0.5.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

FOCAL = 12_500.0
HALF_DIAGONAL = 6_250.0
K1 = -0.08
FLYING_HEIGHT = 1250.0
GROUND_PIXEL = 0.10


def homogeneous(XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
    """(x·w, y·w, w) of a vertical image, pixels from the principal point, w the distance below the camera in metres."""
    w = FLYING_HEIGHT - XYZ[..., 2]
    factor = FOCAL * (1 + K1 * (XYZ[..., 0] ** 2 + XYZ[..., 1] ** 2) / w**2)
    return np.stack([factor * XYZ[..., 0], factor * XYZ[..., 1], w], axis=-1)


def cell_residual(side: float, height_range: float, middle: tuple[float, float], samples: int = 9) -> float:
    """Worst difference in pixels between trilinear (x·w, y·w, w) and the strict projection inside one cell.

    Parameters
    ----------
    side : float
        Side of the cell, product pixels.
    height_range : float
        Thickness of its box, metres, about the mean ground.
    middle : (float, float)
        Its middle in the image, as multiples of the focal length from the principal point.
    samples : int
        Samples along each of u, v and h; odd numbers hold the middle.
    """
    t = np.linspace(0.0, 1.0, samples)
    u, v, h = np.meshgrid(t, t, t, indexing="ij")

    def ground(u: NDArray[np.float64], v: NDArray[np.float64], h: NDArray[np.float64]) -> NDArray[np.float64]:
        x = middle[0] * FLYING_HEIGHT + (u - 0.5) * side * GROUND_PIXEL
        y = middle[1] * FLYING_HEIGHT + (v - 0.5) * side * GROUND_PIXEL
        return np.stack([x, y, (h - 0.5) * height_range], axis=-1)

    between = np.zeros((*u.shape, 3))
    for iu, iv, ih in itertools.product((0.0, 1.0), repeat=3):
        weight = (u if iu else 1 - u) * (v if iv else 1 - v) * (h if ih else 1 - h)
        between += weight[..., None] * homogeneous(ground(np.array(iu), np.array(iv), np.array(ih)))
    strict = homogeneous(ground(u, v, h))
    miss = between[..., :2] / between[..., 2:] - strict[..., :2] / strict[..., 2:]
    return float(np.hypot(miss[..., 0], miss[..., 1]).max())


def worst_residual(side: float, height_range: float, samples: int = 9) -> float:
    """The worst of the cells around the image's corner distance, pixels; the product's grid may be turned anyhow."""
    r = HALF_DIAGONAL / FOCAL
    angles = np.radians([0.0, 15.0, 30.0, 45.0])
    return max(cell_residual(side, height_range, (r * np.cos(a), r * np.sin(a)), samples) for a in angles)


def leading_terms(side: float, height_range: float) -> tuple[float, float]:
    """The two residuals by Taylor expansion at the corner, pixels: of the cell's side, and of its height range.

    A third-order displacement k1·r³ has the second derivatives 6·k1·r along and 2·k1·r across the radius; linear
    interpolation over s misses s²/8 times each. Along h the same point wanders along the radius by r·Δh/H.
    """
    r = HALF_DIAGONAL / FOCAL
    plan = (side * GROUND_PIXEL / FLYING_HEIGHT) ** 2 / 8 * (6 + 2) * abs(K1) * r * FOCAL
    depth = (r * height_range / FLYING_HEIGHT) ** 2 / 8 * 6 * abs(K1) * r * FOCAL
    return plan, depth
