"""Terrain in parts as it is seen in the columns of a picture that are vertical planes: a profile for each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.kernels.profiles import LEFT, Columns, Fan, Shown, begin_columns, follow_columns
from photoplan.kernels.raycast import MISS, OVER
from photoplan.kernels.raywalk import begin_lines, next_part
from photoplan.surfaces.rays import Cache, TerrainPart, TerrainParts, over_parts


@dataclass(frozen=True, eq=False)
class _Columns:
    """The rays of all columns: see `kernels.profiles`."""

    fan: Fan
    columns: Columns
    shown: Shown

    def next(
        self,
        ranges: tuple[NDArray[np.float64], NDArray[np.float64]],
        first: tuple[int, int],
        which: NDArray[np.int64],
        places: NDArray[np.int64],
    ) -> None:
        low, high = ranges
        # Only a mesh tells whether a ray is below the ground: a part may begin with a hole.
        low = np.where(low == np.inf, low, -np.inf)
        next_part(low, high, first, self.columns[1], np.full(len(self.fan[3]), OVER), which, places)

    def over(self, part: TerrainPart, group: NDArray[np.int64]) -> None:
        frame = (*part.corner, *part.mesh, part.datum)
        follow_columns(part.posts, part.pyramid, part.faces, frame, self.fan, self.columns, self.shown, group)

    def going(self, which: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.asarray(self.columns[2][which] >= self.fan[4])


def follow_fan(
    parts: TerrainParts,
    center: NDArray[np.float64],
    ends: NDArray[np.float64],
    rise: tuple[NDArray[np.float64], NDArray[np.float64]],
    rows: tuple[int, int],
    bend: float,
    cache: Cache,
) -> Shown:
    """First hits of the rays of a picture, column by column."""
    n, height = len(ends), len(rise[0])
    XYZ, normal, towards = np.full((3, height, n, 3), np.nan)
    shown: Shown = XYZ, normal, towards, np.full((height, n), np.nan), np.full((height, n), -1)
    shown[4][: rows[0]] = shown[4][rows[1] :] = LEFT
    paths = np.empty((n, 2, 3))
    paths[:, 0], paths[:, 1, :2], paths[:, 1, 2] = center, ends, center[2]
    lines, rays, spans, states = np.empty((n, 7)), np.empty((n, 10)), np.empty((n, 2)), np.full(n, OVER)
    frame = (*parts.corner, *parts.step)
    box = begin_lines(paths, 0, 0.0, parts.inside, frame, np.zeros(n), np.full(n, MISS), states, lines, rays, spans)
    if not box[0] <= box[2]:
        return shown
    metres = np.linalg.norm(ends - center[:2], axis=1)
    fan: Fan = (float(center[2]), bend, *rise, rows[0], spans * metres[:, None])
    columns: Columns = lines, rays, np.full(n, rows[1] - 1)
    which = np.flatnonzero(spans[:, 1] >= 0)
    begin_columns(fan, columns, which)
    over_parts(parts, box, which, _Columns(fan, columns, shown), cache)
    return shown
