"""Source images whose grey values are balanced while they are read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import Pixels
from photoplan.io.balance_file import read_balance_file
from photoplan.radiometry.tone import Tone, toned


@dataclass(frozen=True, eq=False)
class BalanceStep:
    """Table and trend of each band; the type of the pixels stays."""

    path: Path
    size: tuple[int, int]
    tones: tuple[Tone, ...]

    def check(self, size: tuple[int, int], bands: int) -> None:
        """The tables are for an image of one size and number of bands."""
        if size != self.size or bands != len(self.tones):
            raise InputError(
                f"{size[0]} × {size[1]} pixels, {bands} bands; the tables in {self.path} are for {self.size[0]} × "
                f"{self.size[1]} and {len(self.tones)}: run `photoplan balance` again, or remove the image's `balance`"
            )

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """The same."""
        return stored

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """The window itself."""
        return window

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Balanced pixels of a window and their validity."""
        return toned(pixels, window, self.size, self.tones), valid


def load_balance(path: Path) -> BalanceStep:
    """The step of a balance file."""
    entry = read_balance_file(path)
    tones = []
    for number, band in enumerate(entry.bands, 1):
        try:
            tones.append(Tone(band.grey, band.becomes, band.trend, (band.curve_grey, band.curve_light)))
        except InputError as error:
            raise InputError(f"{path}: band {number}: {error}") from None
    return BalanceStep(path, entry.size, tuple(tones))
