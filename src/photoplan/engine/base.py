"""What the engine is handed: where pixels come from. It opens no file itself."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window


class Reader(Protocol):
    """A source image that is read by windows; safe to call from several threads."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        ...

    @property
    def bands(self) -> int:
        """Number of bands, without alpha."""
        ...

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels: uint8, uint16, int16 or float32."""
        ...

    def read(self, window: Window) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Pixels of a window inside the image, shape (bands, height, width), and their validity.

        The validity has shape (height, width), True = valid; None means that every pixel is valid.
        """
        ...
