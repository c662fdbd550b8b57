"""What the engine is handed: where pixels come from. It opens no file itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import FullSize, Pixels


@runtime_checkable
class Reader(FullSize, Protocol):
    """A source image of uint8, uint16, int16 or float32, alpha not counted; safe to call from several threads."""

    def read(self, window: Window, level: int = 0) -> Pixels:
        """Pixels of a window inside the image, shape (bands, height, width), and their validity."""
        ...


class Step(Protocol):
    """Pixels into pixels, on their way from a file to whoever reads it: the grid of the image stays.

    What becomes of a pixel does not depend on the window in which it is asked for.
    """

    def check(self, size: tuple[int, int], bands: int) -> None:
        """Refuse images that the step is not for."""
        ...

    def result(self, stored: np.dtype[Any]) -> np.dtype[Any]:
        """Type of the pixels that come of pixels of a type."""
        ...

    def around(self, window: Window, size: tuple[int, int], gaps: bool) -> Window:
        """Pixels of an image of `size` that those of a window depend on; `gaps`: if some of them are invalid."""
        ...

    def apply(self, window: Window, at: Window, pixels: NDArray[Any], valid: NDArray[np.bool_] | None) -> Pixels:
        """Pixels of a window and their validity, from those of the window `at` around it."""
        ...


@dataclass(frozen=True, eq=False)
class Source:
    """A row of the table of sources as the engine needs it."""

    camera: Projection
    reader: Reader
