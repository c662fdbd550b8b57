"""Corrections of rational polynomials: shift, drift along the lines, or all six parameters (Fraser & Hanley 2003)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Camera, project
from photoplan.cameras.correctable import ByCorrections, Corrections, prior_rows
from photoplan.cameras.plane import Affine2D
from photoplan.cameras.rpc import RpcCamera

_Floats = NDArray[np.float64]
#: Parameters of each form: column and row shift, then what changes by row, then what changes by column.
FORMS = {"shift": 1, "drift": 2, "affine": 3}
_NAMES = ("column shift of {}", "row shift of {}", "column drift of {}", "row drift of {}",
          "column stretch of {}", "row stretch of {}")  # fmt: skip


@dataclass(frozen=True, eq=False)
class CorrectableRpc:
    """An image with polynomials, whose correction is unknown.

    The parameters are pixels in the middle of the image, and pixels more at its last row and its last column: so all
    are of one size, and hardly correlated.
    """

    plain: RpcCamera
    """Without its correction."""
    name: str
    form: str
    """shift, drift or affine."""
    sigma: tuple[float, float]
    """Standard deviations known beforehand: of the shift, and of what changes until the border; pixels."""
    start: Affine2D | None = None
    """Where to begin."""

    @property
    def corrections(self) -> tuple[Corrections, ...]:
        """One set."""
        count = 2 * FORMS[self.form]
        sigma = np.repeat(np.array([self.sigma[0], self.sigma[1], self.sigma[1]]), 2)[:count]
        values = np.asarray(np.zeros(6) if self.start is None else np.linalg.solve(self.to_affine, _vector(self.start)))
        return (
            Corrections(
                key=self.key,
                owners=(self.name,),
                parameters=_NAMES[:count],
                values=values[None, :count],
                known=prior_rows(sigma),
                owner="image",
            ),
        )

    @property
    def key(self) -> str:
        """Of the set."""
        return f"correction of {self.name!r}"

    @property
    def to_affine(self) -> _Floats:
        """From the parameters to shift at the first pixel (column, row) and drift (as projects state it), (6, 6)."""
        middle, half = (np.array(self.plain.size) - 1) / 2, np.maximum(np.array(self.plain.size) / 2, 1.0)
        T = np.zeros((6, 6))
        T[0, 0] = T[1, 1] = 1.0
        for k, (axis, first) in enumerate(((1, 2), (1, 3), (0, 4), (0, 5))):
            # A change by row or column that vanishes in the middle of the image.
            T[k % 2, first] = -middle[axis] / half[axis]
            T[2 + 2 * (k % 2) + axis, first] = 1.0 / half[axis]
        return T

    def affine(self, values: _Floats) -> tuple[float, ...]:
        """Shift and drift of parameters (k,), as projects state them: six numbers."""
        return tuple((self.to_affine[:, : len(values)] @ values).tolist())

    def camera(self, values: Mapping[str, _Floats]) -> Camera:
        """See `Correctable`."""
        x, y, xx, xy, yx, yy = self.affine(values[self.key][0])
        return replace(self.plain, correction=Affine2D(a1=1.0 + xx, a2=xy, a3=x, a4=yx, a5=1.0 + yy, a6=y))

    def seen(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """See `Correctable`."""
        return project(camera, XYZ)

    def by_ground(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> _Floats:
        """See `Correctable`."""
        return camera.derivatives(XYZ)

    def by_corrections(self, camera: Camera, XYZ: _Floats, xy: _Floats) -> Mapping[str, ByCorrections]:
        """See `Correctable`."""
        count = 2 * FORMS[self.form]
        before = self.plain.project_homogeneous(XYZ)[:, :2]
        middle, half = (np.array(self.plain.size) - 1) / 2, np.maximum(np.array(self.plain.size) / 2, 1.0)
        away = (before - middle) / half
        J = np.zeros((len(xy), 2, 6))
        J[:, 0, 0] = J[:, 1, 1] = 1.0
        J[:, 0, 2] = J[:, 1, 3] = away[:, 1]
        J[:, 0, 4] = J[:, 1, 5] = away[:, 0]
        columns = np.broadcast_to(np.arange(count), (len(xy), count))
        return {self.key: ByCorrections(columns, J[:, :, :count])}


def _vector(a: Affine2D) -> _Floats:
    return np.array([a.a3, a.a6, a.a1 - 1.0, a.a2, a.a4, a.a5 - 1.0])
