"""Lines of detectors as strips state them: polynomials of the column, or a table with a position of each element."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

import numpy as np
from numpy.polynomial import Chebyshev, polynomial
from numpy.typing import NDArray
from pydantic import Field, model_validator

from photoplan.cameras.line_look import LineLook
from photoplan.errors import InputError
from photoplan.io.camera.line.number_table import read_numbers
from photoplan.io.camera.model import Entry, Number, Pixels, Positive

_Floats = NDArray[np.float64]
_Polynomial = Annotated[tuple[Number, ...], Field(min_length=1, max_length=16)]
_COLUMNS = "x,y"
#: Degree of the curve through a table; elements lie no further beside it than this, in units of their distance.
_DEGREE, _BESIDE = 15, 0.05


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

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if self.table is None and self.y_mm is None:
            raise ValueError("state y_mm (and x_mm), or a table of the elements")
        if self.table is not None and (self.x_mm is not None or self.y_mm is not None):
            raise ValueError("a table of the elements takes the place of x_mm and y_mm; state one of both")
        return self


def look_of(detectors: StripDetectors, folder: Path, max_bytes: int) -> tuple[LineLook, float | None]:
    """Directions of a line, and how far the elements of its table lie beside the curve, in columns (None: no table).

    Raises
    ------
    InputError
        The table cannot be used, or its elements do not follow a smooth curve.
    """
    beside, x_mm, y_mm = None, detectors.x_mm or (0.0,), detectors.y_mm or (0.0,)
    curve: tuple[Chebyshev, Chebyshev] | None = None
    if detectors.table is not None:
        file = folder / detectors.table
        table = read_numbers(file, _COLUMNS, max_bytes)
        if len(table) != detectors.columns:
            raise InputError(f"{file}: {len(table)} rows; needed are x and y of {detectors.columns} elements")
        curve, beside = _through(table, file)

    def tangents(column: _Floats) -> _Floats:
        if curve is None:
            x, y = (polynomial.polyval(column, each) for each in (x_mm, y_mm))
        else:
            x, y = (each(column) for each in curve)
        return np.asarray(np.stack([x, -y], axis=-1) / detectors.focal_mm)

    return LineLook.of(tangents, detectors.columns), beside


def _through(table: _Floats, file: Path) -> tuple[tuple[Chebyshev, Chebyshev], float]:
    """Curves x, y of the column through the elements, and how far these lie beside them, in columns."""
    column = np.arange(len(table), dtype=float)
    degree = min(_DEGREE, max(1, len(table) // 8))
    x, y = (Chebyshev.fit(column, values, degree) for values in table.T)
    pitch = float(np.hypot(*(np.ptp(values) for values in table.T))) / max(len(table) - 1, 1)
    away = np.hypot(x(column) - table[:, 0], y(column) - table[:, 1]) / max(pitch, 1e-12)
    worst = int(np.argmax(away))
    if not away[worst] <= _BESIDE:
        raise InputError(
            f"{file}: element {worst + 1} lies {away[worst]:.3g} columns beside a smooth curve through all; at most "
            f"{_BESIDE:g} can be used. Is a number wrong? Two chips in one line are two images, each with its table"
        )
    return (x, y), float(away[worst])
