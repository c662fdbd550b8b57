"""Lenses and interior orientations that the camera tests share."""

from __future__ import annotations

import numpy as np

from photoplan.cameras.fiducials import Bilinear2D
from photoplan.cameras.lenses import Brown, Fisheye, Interior, Lens, NoLens, OpenCV, RadialTable, Reversed

#: USGS report OSL/1785 (Jena LMK 1000, Lamegon PI/C 7384525C): mean radial distortion, camera constant 152.299 mm.
OSL_1785_ANGLES = (7.5, 15.0, 22.7, 30.0, 35.0, 40.0)
OSL_1785_MICROMETRES = (3.0, 4.0, 1.0, -3.0, -4.0, 3.0)
OSL_1785_C = 152.299

BROWN = Brown(-0.12, 0.03, -0.004, 1.1e-3, -7e-4, 3e-4, -2e-4, 2e-3)
LENSES: dict[str, Lens] = {
    "none": NoLens(),
    "brown": BROWN,
    "opencv four": OpenCV(0.0135891, 0.03861561, -0.00167842, 0.00106552),
    "opencv eight": OpenCV(0.11, -0.02, 8e-4, -5e-4, 0.011, 0.21, -0.03, 0.004),
    "fisheye": Fisheye(0.05, -0.012, 0.003, -0.0004),
    "radial table": RadialTable.from_angles(OSL_1785_ANGLES, OSL_1785_MICROMETRES, OSL_1785_C),
    "reversed": Reversed(BROWN),
}

INTERIORS = {
    "digital": Interior.digital((2000, 1125), (1435.5, 1432.9), (3.2, -5.1)),
    "metric": Interior.metric((1536, 864), 120.0, 0.108, (0.1, -0.2)),
    "film": Interior(
        153.24, (-0.001, 0.003), Bilinear2D(10.02, 0.06, 3e-5, 1124.0, 0.05, -9.98, -2e-5, 1193.0), (2300, 2350)
    ),
}


def numeric_derivative(f: object, p: np.ndarray, step: float) -> np.ndarray:
    """Derivative of f at points (n, k) by central differences of fourth order, shape (n, m, k)."""
    columns = []
    for e in np.eye(p.shape[-1]) * step:
        columns.append((8 * (f(p + e) - f(p - e)) - (f(p + 2 * e) - f(p - 2 * e))) / (12 * step))  # type: ignore[operator]
    return np.stack(columns, axis=-1)
