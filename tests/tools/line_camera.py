"""A line camera in level flight whose attitude trembles: strict, and in the two factors of a projection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.geometry.grid import Breaks

_ITERATIONS = 30


@dataclass(frozen=True, eq=False)
class Tremble:
    """What the attitude's noise does in the image at the mean height: a field, bent at every knot of the noise."""

    knots: NDArray[np.float64]
    """Lines at which roll and pitch are known; linear between them."""
    roll: NDArray[np.float64]
    pitch: NDArray[np.float64]
    focal: float
    middle: float
    """x of the principal point."""
    lines_per_radian: float
    """How many lines later a point is seen that the pitch moves ahead by one radian, at the mean height."""

    @property
    def breaks(self) -> Breaks:
        return Breaks(rows=tuple(self.knots.tolist()))

    def at(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Roll and pitch at a line."""
        return np.interp(y, self.knots, self.roll), np.interp(y, self.knots, self.pitch)

    def __call__(self, xy: ArrayLike) -> NDArray[np.float64]:
        xy = np.asarray(xy, float)
        roll, pitch = self.at(xy[..., 1])
        return np.stack([self._rolled(xy[..., 0], roll), xy[..., 1] + pitch * self.lines_per_radian], axis=-1)

    def inverse(self, xy: ArrayLike) -> NDArray[np.float64]:
        xy = np.asarray(xy, float)
        y = xy[..., 1]
        for _ in range(_ITERATIONS):
            y = xy[..., 1] - self.at(y)[1] * self.lines_per_radian
        return np.stack([self._rolled(xy[..., 0], -self.at(y)[0]), y], axis=-1)

    def _rolled(self, x: NDArray[np.float64], angle: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.middle + self.focal * np.tan(np.arctan((x - self.middle) / self.focal) + angle)


@dataclass(frozen=True, eq=False)
class LineCamera:
    """Columns across the flight, lines along it; flown northwards at `height` over the ground's datum."""

    size: tuple[int, int]
    focal: float
    height: float
    pixel: float
    """Metres flown from line to line."""
    tremble: Tremble
    declared: str
    """Where the noise is: in a ``"field"``, in the ``"anchors"`` with its breaks, or there and kept ``"silent"``."""

    @property
    def field(self) -> Tremble | None:
        return self.tremble if self.declared == "field" else None

    @property
    def breaks(self) -> Breaks | None:
        return None if self.declared == "silent" else self.tremble.breaks

    def strict(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        """Image points and depth, (..., 3): the line is found at which the point lies in the plane of the sensor."""
        XYZ = np.asarray(XYZ, float)
        X, Y, depth = XYZ[..., 0], XYZ[..., 1], self.height - XYZ[..., 2]
        y = -Y / self.pixel
        for _ in range(_ITERATIONS):
            roll, pitch = self.attitude(y)
            # Lines run southwards down the image: the camera is at Y = −y · pixel and looks ahead by its pitch.
            ahead = depth * np.tan(pitch)
            y = -(Y - ahead) / self.pixel
        roll, pitch = self.attitude(y)
        x = self.tremble.middle + self.focal * np.tan(np.arctan(X / (depth / np.cos(pitch))) + roll)
        return np.stack([x, y, depth], axis=-1)

    def attitude(self, y: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Roll and pitch: slow waves of half a milliradian, and the noise."""
        roll, pitch = self.tremble.at(y)
        return roll + 5e-4 * np.sin(y / 900.0), pitch + 5e-4 * np.cos(y / 1100.0)

    def project_homogeneous(self, XYZ: ArrayLike) -> NDArray[np.float64]:
        p = self.strict(XYZ)
        xy = p[..., :2] if self.field is None else self.tremble.inverse(p[..., :2])
        return np.concatenate([xy * p[..., 2:], p[..., 2:]], axis=-1)


def line_camera(declared: str, jitter: float = 5e-6, period: int = 7) -> LineCamera:
    """12 000 columns and lines of 0.05 m from 1000 m; noise up to `jitter` radians, new every `period` lines."""
    rng = np.random.default_rng(11)
    knots = np.arange(0.0, 12_000.0, period)
    roll, pitch = rng.uniform(-jitter, jitter, (2, len(knots)))
    tremble = Tremble(knots, roll, pitch, 20_000.0, 5_999.5, 1000.0 / 0.05)
    return LineCamera((12_000, 12_000), 20_000.0, 1000.0, 0.05, tremble, declared)
