"""Computing units that are held in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.surfaces.units import Unit, UnitLayout


@dataclass(frozen=True, eq=False)
class MemoryUnits:
    """A source of computing units (`UnitSource`) that holds all of them in memory."""

    layout: UnitLayout
    units: Mapping[tuple[int, int], Unit]
    """Units by (column, row); those that are missing are empty."""
    ranges: NDArray[np.float64] = field(init=False, repr=False)
    """Lowest and highest height of every unit, shape (rows, columns, 2), metres; NaN for empty units."""

    def __post_init__(self) -> None:
        ranges = np.full((self.layout.rows, self.layout.columns, 2), np.nan)
        for (column, row), unit in self.units.items():
            if not (0 <= column < self.layout.columns and 0 <= row < self.layout.rows):
                raise InputError(
                    f"unit at column {column}, row {row}; the layout has {self.layout.columns} columns and "
                    f"{self.layout.rows} rows, counted from 0"
                )
            ranges[row, column] = unit_range(unit)
        object.__setattr__(self, "ranges", ranges)

    def unit(self, column: int, row: int) -> Unit | None:
        """The unit, or None if it is empty."""
        return self.units.get((column, row))


def unit_range(unit: Unit) -> tuple[float, float]:
    """Lowest and highest height of a unit's posts and triangles, metres; NaN, NaN if it has none."""
    known = [unit.heights[np.isfinite(unit.heights)].astype(float) + unit.datum]
    if unit.faces is not None:
        Z = unit.faces.vertices[:, 2]
        known.append(Z[np.isfinite(Z)])
    heights = np.concatenate(known)
    return (float(heights.min()), float(heights.max())) if heights.size else (np.nan, np.nan)
