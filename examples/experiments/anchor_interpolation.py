"""What interpolation between anchors costs: image coordinates as in the literature, homogeneous coordinates as here.

A strictly vertical photograph, a plane mesh of the terrain model, its four corners projected strictly. The points
between them are found (a) by bilinear interpolation of their image coordinates, (b) by interpolation of their
homogeneous coordinates (x·w, y·w, w) in (u, v, h) and one division. Both are compared with collinearity.

Sources: Behr 1989, §5.3.4, table 5.6, figs. 5.15 and 5.16; Ecker 1991, §4.8.3.1, fig. 4.23.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

#: Behr's synthetic data (§5.3.4): flying height over the mesh, camera constant; metres.
FLYING_HEIGHT = 2000.0
CAMERA_CONSTANT = 0.153
#: Behr 1989, table 5.6: mesh side in metres, mean deviation in micrometres.
TABLE_5_6 = {12.5: 2, 25.0: 7, 50.0: 27, 100.0: 114}
#: Ecker 1991, §4.8.3.1: 42 µm at a mesh of 5 mm in 100 % terrain, camera constant 150 mm.
ECKER_CAMERA_CONSTANT, ECKER_MESH, ECKER_PRINTED = 150.0, 5.0, 42
#: A pixel of a film scan, to speak of the homogeneous anchors in pixels.
PIXEL = 15e-6

#: Where "11 × 11 intermediate points" may lie along a side of the unit mesh.
SAMPLINGS = {
    "pixel centres, (i + ½)/11": (np.arange(11) + 0.5) / 11,
    "increments from a corner, i/11": np.arange(11) / 11,
    "inner points, (i + 1)/12": np.arange(1, 12) / 12,
    "with the corners, i/10": np.arange(11) / 10,
}
PIXEL_CENTRES = "pixel centres, (i + ½)/11"


@dataclass(frozen=True)
class Mesh:
    """A square mesh of a plane, beside the nadir of a vertical photograph."""

    distance: float
    """From the nadir to the mesh (to its nearer edge, or to its middle: see `at_edge`), metres along +X."""
    side: float
    """Metres."""
    slope: float
    """Degrees; the terrain rises in the direction of `dip`."""
    dip: float = 0.0
    """Direction in which the terrain rises, degrees from the direction away from the nadir."""
    at_edge: bool = True
    """The plane has height 0, and `distance` is counted, at the edge nearer to the nadir; otherwise in the middle."""

    def ground(self, u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
        """Ground points of mesh coordinates in [0, 1], shape (..., 3)."""
        dx = (u if self.at_edge else u - 0.5) * self.side
        dy = (v - 0.5) * self.side
        gradient = np.tan(np.radians(self.slope))
        dip = np.radians(self.dip)
        return np.stack([self.distance + dx, dy, gradient * (dx * np.cos(dip) + dy * np.sin(dip))], axis=-1)


def homogeneous(XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
    """Collinearity of a vertical photograph over the origin: (x·w, y·w, w), metres in the image (Ecker eq. 3.1)."""
    w = FLYING_HEIGHT - XYZ[..., 2]
    return np.stack([CAMERA_CONSTANT * XYZ[..., 0], CAMERA_CONSTANT * XYZ[..., 1], w], axis=-1)


def image(XYZ: NDArray[np.float64]) -> NDArray[np.float64]:
    """Image coordinates, metres."""
    h = homogeneous(XYZ)
    return h[..., :2] / h[..., 2:]


def classical_deviation(mesh: Mesh, t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Bilinear interpolation of image coordinates (Behr eq. 5.9) against collinearity: lengths in the image, metres."""
    u, v = np.meshgrid(t, t)
    between = np.zeros((*u.shape, 2))
    for iu, iv in itertools.product((0.0, 1.0), repeat=2):
        weight = (u if iu else 1 - u) * (v if iv else 1 - v)
        between += weight[..., None] * image(mesh.ground(np.array(iu), np.array(iv)))
    return np.hypot(*np.moveaxis(between - image(mesh.ground(u, v)), -1, 0))


def homogeneous_deviation(
    mesh: Mesh, t: NDArray[np.float64], roughness: NDArray[np.float64] | float = 0.0
) -> NDArray[np.float64]:
    """Relief per pixel and trilinear (x·w, y·w, w) in (u, v, h), against collinearity: lengths in the image, metres.

    `roughness` (metres, per point) is added to the plane: the relief belongs to the pixel, not to the anchors.
    """
    u, v = np.meshgrid(t, t)
    XYZ = mesh.ground(u, v)
    XYZ[..., 2] += roughness
    low, high = XYZ[..., 2].min() - 0.01, XYZ[..., 2].max() + 0.01
    k = (XYZ[..., 2] - low) / (high - low)
    between = np.zeros((*u.shape, 3))
    for iu, iv, ih in itertools.product((0.0, 1.0), repeat=3):
        corner = mesh.ground(np.array(iu), np.array(iv))
        corner[2] = high if ih else low
        weight = (u if iu else 1 - u) * (v if iv else 1 - v) * (k if ih else 1 - k)
        between += weight[..., None] * homogeneous(corner)
    return np.hypot(*np.moveaxis(between[..., :2] / between[..., 2:] - image(XYZ), -1, 0))


def table_5_6(
    distance: float = 1300.0, sampling: str = PIXEL_CENTRES, dip: float = 0.0, at_edge: bool = True
) -> dict[float, float]:
    """Mean deviation in micrometres for the four mesh sides of Behr's table 5.6, slope 45°."""
    t = SAMPLINGS[sampling]
    return {
        side: 1e6 * float(classical_deviation(Mesh(distance, side, 45.0, dip, at_edge), t).mean()) for side in TABLE_5_6
    }


def setups_that_print_table_5_6(distances: NDArray[np.float64]) -> list[tuple[str, bool, float, float, float]]:
    """All set-ups of a family whose four values round to those printed.

    Returns
    -------
    list of (sampling, at_edge, dip, first distance, last distance)
        Those that reproduce 2, 7, 27 and 114 µm somewhere in `distances` (metres).
    """
    found = []
    for sampling, at_edge, dip in itertools.product(SAMPLINGS, (True, False), (0.0, 45.0, 90.0, 180.0)):
        hits = [
            float(d)
            for d in distances
            if all(round(x) == TABLE_5_6[s] for s, x in table_5_6(float(d), sampling, dip, at_edge).items())
        ]
        if hits:
            found.append((sampling, at_edge, dip, hits[0], hits[-1]))
    return found


def deviation_by_distance(
    distances: NDArray[np.float64], slope: float, side: float = 50.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and largest deviation in micrometres over the distance of a mesh from the nadir (Behr figs. 5.15, 5.16)."""
    e = [classical_deviation(Mesh(float(d), side, slope), SAMPLINGS[PIXEL_CENTRES]) for d in distances]
    return 1e6 * np.array([x.mean() for x in e]), 1e6 * np.array([x.max() for x in e])


def ecker_displacement(mesh_mm: NDArray[np.float64] | float, slope_percent: float) -> NDArray[np.float64]:
    """ΔM of Ecker 1991, fig. 4.22: how far the point that lies at the middle of 1′2′ is from M on the ground.

    Computed as he draws it: project the ends of the mesh side, halve 1′2′, take that image point back to the slope.
    Everything in millimetres at image scale, so that it holds for any flying height. It does not depend on where in
    the image the mesh lies; here its middle is below the camera.
    """
    s = np.asarray(mesh_mm, float)
    m = slope_percent / 100.0
    c = ECKER_CAMERA_CONSTANT
    ends = np.stack([-s / 2, s / 2])
    x = c * ends / (c - m * ends)
    middle = x.mean(axis=0)
    # Intersection of the ray x = c·t / (c − m·t) with the slope, solved for t.
    return middle * c / (c + m * middle)
