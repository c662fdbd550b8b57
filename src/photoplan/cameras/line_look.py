"""Where the detectors of a line look: their directions in the camera, as a curve over the columns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from photoplan.cameras.line_bend import LineBend
from photoplan.errors import InputError

_Floats = NDArray[np.float64]
_DEGREE = 16
#: The curve leaves what it stands for by less than this, in columns.
_TOLERANCE = 1e-9
#: Coefficients below this are left out, in columns.
_NOTHING = 1e-11
#: Angle between detectors below which there is no such camera.
_FINEST = 1e-12
#: Columns beyond either end of the line over which the curve goes on, by its width; further out it is straight.
_ROOM = 0.05


@dataclass(frozen=True, eq=False)
class LineLook:
    """Directions of a line's detectors in camera axes, as tangents (X/Z, Y/Z): any lens, any place in the focal plane.

    Lens distortion, the place of the line and the pitch of its detectors are one smooth curve, kept as Chebyshev
    polynomials of the column. Camera axes are those of the file; the camera looks along +Z.
    """

    columns: int
    coefficients: _Floats
    """Shape (degree + 1, 2); over the columns of `span` as −1 to 1."""
    part: tuple[int, int] | None = None
    """First and end column of those that are its own, of a line of several chips; None: all."""
    bend: LineBend | None = None
    """What comes on top of the polynomials."""

    @classmethod
    def of(
        cls,
        tangents: Callable[[_Floats], _Floats],
        columns: int,
        part: tuple[int, int] | None = None,
        bend: LineBend | None = None,
    ) -> LineLook:
        """The curve of a function from columns (n,) to tangents (n, 2), with a bend on top of it."""
        low, high = _span(part or (0, columns))
        nodes = chebyshev.chebpts1(4 * _DEGREE)
        values = tangents((low + high) / 2 + (high - low) / 2 * nodes)
        if not np.isfinite(values).all():
            raise InputError("detectors of the line have no direction; are the numbers of its lens right?")
        coefficients = chebyshev.chebfit(nodes, values, _DEGREE)
        look = cls(columns, np.asarray(coefficients, float), part, bend)
        if not look.pitch > _FINEST:
            raise InputError(
                f"the line's detectors are {look.pitch:.3g} rad apart, which no telescope tells; is its focal length "
                "in millimetres?"
            )
        # Most lenses are of low degree; what is next to nothing is not computed a million times.
        tiny = np.abs(coefficients).max(axis=1) < _NOTHING * look.pitch
        look = cls(columns, look.coefficients[: max(2, len(tiny) - int(np.argmin(tiny[::-1])))], part, bend)
        miss = float(np.abs(chebyshev.chebval(nodes, look.coefficients).T - values).max())
        if miss > _TOLERANCE * look.pitch:
            raise InputError(f"the line's lens is not smooth: polynomials miss it by {miss / look.pitch:.2g} columns")
        if not (look.along(look.ends[1]) > look.along(look.ends[0])):
            raise InputError("the directions of the line's detectors turn back")
        return look

    def tangents(self, column: _Floats) -> _Floats:
        """Tangents (n, 2) of columns (n,); straight on where the line has ended."""
        inside = np.clip(column, *self.span)
        values, away = chebyshev.chebval(self._unit(inside), self.coefficients).T, column - inside
        if self.bend is not None:
            values = values + self.bend(inside)
        return np.asarray(values + self.slope(inside) * away[:, None] if np.any(away) else values)

    def slope(self, column: _Floats) -> _Floats:
        """Change of the tangents (n, 2) from column to column."""
        inside = np.clip(column, *self.span)
        change = chebyshev.chebval(self._unit(inside), self._slopes).T
        return np.asarray(change if self.bend is None else change + self.bend.slope(inside))

    @property
    def span(self) -> tuple[float, float]:
        """First and last column over which the curve goes on."""
        return _span(self.part or (0, self.columns))

    @property
    def ends(self) -> tuple[float, float]:
        """Outer edges of its first and last column."""
        first, end = self.part or (0, self.columns)
        return first - 0.5, end - 0.5

    @property
    def _outer(self) -> _Floats:
        """Its first and last column."""
        return np.add(self.ends, (0.5, -0.5))

    @cached_property
    def axes(self) -> _Floats:
        """Unit vectors along the line, from the first to the last column, and across it, (2, 2)."""
        first, last = self.tangents(self._outer)
        e = (last - first) / np.linalg.norm(last - first)
        return np.array([e, [-e[1], e[0]]])

    @cached_property
    def pitch(self) -> float:
        """Tangent of a column in the middle of the line."""
        return float(np.linalg.norm(self.slope(np.array([sum(self.ends) / 2]))))

    @cached_property
    def is_wide(self) -> bool:
        """Whether it looks further to the sides than ahead."""
        middle = self.tangents(self._outer).mean(axis=0)
        half = abs(self.along(self.ends[1]) - self.along(self.ends[0])) / 2
        return bool(half > abs(middle @ self.axes[1]))

    def along(self, column: float) -> float:
        """Tangent along the line's chord."""
        return float(self.tangents(np.array([column]))[0] @ self.axes[0])

    def column(self, along: _Floats) -> _Floats:
        """The columns (n,) with these tangents along the chord (n,), by Newton's method."""
        first, last = self._along_ends
        at = self.ends[0] + (along - first) * (self.ends[1] - self.ends[0]) / (last - first)
        values, slopes = self._chord
        e = self.axes[0]
        for _ in range(12):
            inside = np.clip(at, *self.span)
            unit = self._unit(inside)
            value, slope = chebyshev.chebval(unit, values), chebyshev.chebval(unit, slopes)
            if self.bend is not None:
                value, slope = value + self.bend(inside) @ e, slope + self.bend.slope(inside) @ e
            step = (value + slope * (at - inside) - along) / slope
            at = at - step
            if not (np.abs(step) > 1e-11 * self.columns).any():
                break
        return np.asarray(at)

    @cached_property
    def _chord(self) -> tuple[_Floats, _Floats]:
        """Polynomials of the tangents along the chord, and of their change from column to column; without the bend."""
        return self.coefficients @ self.axes[0], self._slopes @ self.axes[0]

    @cached_property
    def _along_ends(self) -> tuple[float, float]:
        """Tangents of the ends along the chord."""
        return self.along(self.ends[0]), self.along(self.ends[1])

    @cached_property
    def _slopes(self) -> _Floats:
        low, high = self.span
        return np.asarray(chebyshev.chebder(self.coefficients) * 2.0 / (high - low))

    def _unit(self, column: _Floats) -> _Floats:
        low, high = self.span
        return (2.0 * column - (low + high)) / (high - low)


def _span(part: tuple[int, int]) -> tuple[float, float]:
    first, end = part
    room = 1.0 + _ROOM * (end - first)
    return first - 0.5 - room, end - 0.5 + room
