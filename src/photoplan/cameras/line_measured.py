"""Ground points beside where they were measured in lines: what is left of the way there, without looking for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.line import LineCamera
from photoplan.cameras.line_chips import ChippedLine
from photoplan.cameras.line_sight import LineSight

_Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LineMiss:
    """How ground points lie beside where they were measured."""

    miss: _Floats
    """From there to where they are seen, (n, 2), pixels; NaN: behind the camera, or the row has no orientation."""
    by_place: _Floats
    """Its derivatives by places in the axes of the body, (n, 2, 3), pixels per metre."""


def measured(camera: LineCamera | ChippedLine, steady: LineCamera | ChippedLine, XYZ: _Floats, xy: _Floats) -> LineMiss:
    """Compare ground points (n, 3) with measured positions (n, 2), at the moments of the measured rows.

    A step of Newton's method from where the point was measured to where `camera` sees it. On a turbulent flight a point
    may be seen several times, and not at all at the next iteration of an adjustment: what was measured tells which
    moment is meant, and what is left there changes smoothly with the trajectory. Rows are counted by the pace of
    `steady`, the same flight without tremor: where a shaken line stands still on the ground, rows say nothing.
    """
    if isinstance(camera, LineCamera):
        assert isinstance(steady, LineCamera)
        return _of_line(camera, steady, XYZ, xy)
    assert isinstance(steady, ChippedLine)
    miss, by_place, chip = np.empty((len(xy), 2)), np.empty((len(xy), 2, 3)), camera.chip(xy[:, 0])
    for k, (one, calm) in enumerate(zip(camera.chips, steady.chips)):
        mine = chip == k
        part = _of_line(one, calm, XYZ[mine], xy[mine])
        miss[mine], by_place[mine] = part.miss, part.by_place
    return LineMiss(miss, by_place)


def _of_line(camera: LineCamera, steady: LineCamera, XYZ: _Floats, xy: _Floats) -> LineMiss:
    P, (x, y) = camera.near(XYZ), xy.T
    S, R = camera.track(y, camera.near.origin)
    with np.errstate(all="ignore"):
        d = np.einsum("nij,ni->nj", R, P - S)
        d[~(d[:, 2] > 0) | camera.unoriented(y)] = np.nan
        tangents = d[:, :2] / d[:, 2:]
        by_place = (R[:, :, :2] - R[:, :, 2:] * tangents[:, None, :]) / d[:, 2, None, None]
        calm = LineSight(steady.track, steady.look, camera.near.origin)
        later, earlier = calm.tangents(P, y + 0.5), calm.tangents(P, y - 0.5)
        J = np.stack([camera.look.slope(x), earlier - later], axis=-1)
        good = np.asarray(np.isfinite(J).all(axis=(1, 2)))
        A = np.linalg.solve(
            np.where(good[:, None, None], J, np.eye(2)),
            np.concatenate([(tangents - camera.look.tangents(x))[:, :, None], np.swapaxes(by_place, 1, 2)], axis=2),
        )
    A[~good] = np.nan
    return LineMiss(A[:, :, 0], A[:, :, 1:])
