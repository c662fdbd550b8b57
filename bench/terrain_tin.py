"""A constrained triangulation of measured terrain as a process of its own: heights at the places of a table.

    python bench/terrain_tin.py HELD OUT INPUT...

OUT receives the heights as .npy; NaN outside the triangles.
"""

from __future__ import annotations

import itertools
import sys
from pathlib import Path

import numpy as np
from matplotlib.tri import Triangulation
from numpy.typing import NDArray

from photoplan.io.terrain.files import read_measured
from photoplan.surfaces.mesh import constrained_faces
from photoplan.surfaces.units import MeasuredTerrain
from photoplan.terrain.clean import clean


def network(measured: MeasuredTerrain) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (n, 3), each place once, and the edges of all lines (m, 2)."""
    stacks = [group.xyz for group in measured.points] + [line.xyz for line in measured.lines]
    sizes = [len(xyz) for xyz in stacks]
    xyz = np.concatenate(stacks)
    xy, first, place = np.unique(xyz[:, :2], axis=0, return_index=True, return_inverse=True)
    place = place.ravel()
    starts = np.cumsum([0, *sizes])[len(measured.points) :]
    edges = [np.stack([place[a : b - 1], place[a + 1 : b]], axis=1) for a, b in itertools.pairwise(starts)]
    joined = np.concatenate([np.empty((0, 2), np.int64), *edges])
    return np.column_stack([xy, xyz[first, 2]]), np.unique(np.sort(joined, axis=1), axis=0)


def heights(xyz: NDArray[np.float64], corners: NDArray[np.int32], XY: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear inside each triangle; NaN outside all."""
    origin = xyz[:, :2].mean(axis=0)
    x, y = (xyz[:, :2] - origin).T
    mesh = Triangulation(x, y, corners)
    face = mesh.get_trifinder()(*(XY - origin).T)
    planes = mesh.calculate_plane_coefficients(xyz[:, 2])[face]
    found = planes[:, 0] * (XY[:, 0] - origin[0]) + planes[:, 1] * (XY[:, 1] - origin[1]) + planes[:, 2]
    return np.where(face >= 0, found, np.nan)


def main(held: Path, out: Path, inputs: list[Path]) -> None:
    measured = clean(read_measured(inputs))[0]
    xyz, edges = network(measured)
    corners = constrained_faces(xyz[:, :2], edges)
    np.save(out, heights(xyz, corners, np.loadtxt(held, delimiter=",", skiprows=1)[:, :2]))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), [Path(a) for a in sys.argv[3:]])
