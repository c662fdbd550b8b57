"""Tables of MTF values: those of a laboratory are read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.plain_files import read_head
from photoplan.io.tables import Columns, read_table

_FREQUENCY = {
    "px": ("cycles_per_px", "cycles_per_pixel", "cycles/px", "cycles/pixel", "cy/px", "lp/px"),
    "mm": ("cycles_per_mm", "cycles/mm", "cy/mm", "lp_per_mm", "lp/mm"),
}
_MODULATION = ("modulation", "mtf", "contrast")
_LARGEST = 1.5


@dataclass(frozen=True, eq=False)
class MtfTable:
    """Modulation at some frequencies."""

    frequency: NDArray[np.float64]
    """Increasing, above or at 0, shape (n,)."""
    modulation: NDArray[np.float64]
    """0 to 1.5, shape (n,)."""
    unit: Literal["px", "mm"]
    """Frequencies are cycles per pixel, or per millimetre on the sensor."""

    def per_pixel(self, pixel_um: float | None) -> NDArray[np.float64]:
        """Frequencies in cycles per pixel."""
        if self.unit == "px":
            return self.frequency
        if pixel_um is None:
            raise InputError(
                "laboratory values in cycles per mm need the size of a pixel on the sensor: give `pixel_size` UM, or a "
                "column cycles_per_px"
            )
        return self.frequency * (pixel_um / 1000.0)


def read_mtf_table(path: Path) -> MtfTable:
    """MTF values of a text table with a header: ``cycles_per_px`` or ``cycles_per_mm``, and ``modulation``."""
    words = read_head(path).casefold()
    unit: Literal["px", "mm"] = "mm" if any(name in words for name in _FREQUENCY["mm"]) else "px"
    if unit == "mm" and any(name in words for name in _FREQUENCY["px"]):
        unit = "px"
    needed = ("frequency", "modulation")
    roles = {"frequency": _FREQUENCY[unit], "modulation": _MODULATION}
    table = read_table(path, Columns(roles=roles, needed=needed, numbers=frozenset(needed)))
    frequency, modulation = table.numbers("frequency"), table.numbers("modulation")
    for k in range(len(frequency)):
        if frequency[k] < 0.0:
            raise InputError(f"{table.where(k)}: frequency {frequency[k]:g}; it is 0 or larger")
        if not 0.0 <= modulation[k] <= _LARGEST:
            hint = "; write parts of 1, not per cent" if modulation[k] > _LARGEST else ""
            raise InputError(f"{table.where(k)}: modulation {modulation[k]:g}; 0 to {_LARGEST:g} are allowed{hint}")
    order = np.argsort(frequency, kind="stable")
    twice = np.flatnonzero(np.diff(frequency[order]) == 0.0)
    if twice.size:
        k = int(order[twice[0] + 1])
        raise InputError(f"{table.where(k)}: frequency {frequency[k]:g} is given twice")
    return MtfTable(frequency[order], modulation[order], unit)
