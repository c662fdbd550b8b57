"""Lines of detectors as strips state them: polynomials of the column, or a table with a position of each element."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.polynomial import Chebyshev, polynomial
from numpy.typing import NDArray
from pydantic import Field, model_validator

from photoplan.cameras.pushbroom_rays import LineLook
from photoplan.errors import InputError
from photoplan.io.camera.line.number_table import read_numbers
from photoplan.io.camera.model import Entry, Number, Pixels, Positive

_Floats = NDArray[np.float64]
_Polynomial = Annotated[tuple[Number, ...], Field(min_length=1, max_length=16)]
_COLUMNS = "x,y"
#: Degree of the curve through a table; elements lie no further beside it than this, in units of their distance.
_DEGREE, _BESIDE = 15, 0.05


class StripChip(Entry):
    """One of ``chips``: what several chips of a line have of their own."""

    columns: Pixels
    x_mm: _Polynomial | None = None
    """As of a line, by the chip's own columns; None with a table, or: 0."""
    y_mm: _Polynomial | None = None


class StripDetectors(Entry):
    """``[detectors.NAME]``: one line of detectors."""

    columns: Pixels
    focal_mm: Positive
    x_mm: _Polynomial | None = None
    """Where the detectors are in the direction of flight: coefficients of the powers of the column, mm; None: 0."""
    y_mm: _Polynomial | None = None
    """The same across it, to the left."""
    table: Annotated[str, Field(min_length=1, max_length=4000)] | None = None
    """Instead of both: a file with a row for each element, mm: CSV with the header ``x,y``, or NPY (columns, 2)."""
    chips: Annotated[tuple[StripChip, ...], Field(min_length=2, max_length=64)] | None = None
    """Where a line is made of several chips, in the order of their columns: each follows a smooth curve of its own."""

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        own = [] if self.chips is None else [chip.y_mm for chip in self.chips]
        if self.table is None and self.y_mm is None and (not own or None in own):
            raise ValueError("state y_mm (and x_mm), or a table of the elements; of chips, each has y_mm")
        stated = (self.x_mm, self.y_mm, *own, *(chip.x_mm for chip in self.chips or ()))
        if self.table is not None and any(each is not None for each in stated):
            raise ValueError("a table of the elements takes the place of x_mm and y_mm; state one of both")
        if self.chips is not None and (self.x_mm is not None or self.y_mm is not None):
            raise ValueError("x_mm and y_mm of a line of several chips are those of each chip")
        if self.chips is not None and sum(chip.columns for chip in self.chips) != self.columns:
            raise ValueError(f"chips of {sum(chip.columns for chip in self.chips)} columns in a line of {self.columns}")
        return self


def looks_of(detectors: StripDetectors, folder: Path, max_bytes: int) -> tuple[tuple[LineLook, ...], float | None]:
    """Directions of a line, or of its chips, and how far the elements of its table lie beside them, in columns.

    None: no table.
    """
    whole = StripChip(columns=detectors.columns, x_mm=detectors.x_mm, y_mm=detectors.y_mm)
    chips, table, file = detectors.chips or (whole,), None, Path()
    if detectors.table is not None:
        file = folder / detectors.table
        table = read_numbers(file, _COLUMNS, max_bytes)
        if len(table) != detectors.columns:
            raise InputError(f"{file}: {len(table)} rows; needed are x and y of {detectors.columns} elements")
    looks, beside, first = [], 0.0, 0
    for chip in chips:
        end = first + chip.columns
        if table is None:
            curve = _stated(chip)
        else:
            curve, away = _through(table[first:end], file, first)
            beside = max(beside, away)
        part = None if detectors.chips is None else (first, end)
        looks.append(LineLook.of(_tangents(curve, first, detectors.focal_mm), detectors.columns, part))
        first = end
    return tuple(looks), None if table is None else beside


_Curve = tuple[Callable[[_Floats], _Floats], Callable[[_Floats], _Floats]]


def _stated(chip: StripChip) -> _Curve:
    x_mm, y_mm = (np.array(each or (0.0,)) for each in (chip.x_mm, chip.y_mm))
    return lambda c: np.asarray(polynomial.polyval(c, x_mm), float), lambda c: np.asarray(
        polynomial.polyval(c, y_mm), float
    )


def _tangents(curve: _Curve, first: int, focal_mm: float) -> Callable[[_Floats], _Floats]:
    """Directions by the columns of the image, of a curve by those of a chip."""
    x, y = curve
    return lambda column: np.asarray(np.stack([x(column - first), -y(column - first)], axis=-1) / focal_mm)


def _through(table: _Floats, file: Path, first: int) -> tuple[_Curve, float]:
    """Curves x, y of the column through elements, and how far these lie beside them, in columns.

    first: elements of the line before them.
    """
    column = np.arange(len(table), dtype=float)
    degree = min(_DEGREE, max(1, len(table) // 8))
    x, y = (Chebyshev.fit(column, values, degree) for values in table.T)
    pitch = float(np.hypot(*(np.ptp(values) for values in table.T))) / max(len(table) - 1, 1)
    away = np.hypot(x(column) - table[:, 0], y(column) - table[:, 1]) / max(pitch, 1e-12)
    worst = int(np.argmax(away))
    if not away[worst] <= _BESIDE:
        raise InputError(
            f"{file}: element {first + worst + 1} lies {away[worst]:.3g} columns beside a smooth curve through all; at "
            f"most {_BESIDE:g} can be used. Is a number wrong? Of several chips in one line, state `chips`"
        )
    return (x, y), float(away[worst])
