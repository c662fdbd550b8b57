"""Images in memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import Pixels, reduced

_TYPES = ("uint8", "uint16", "int16", "float32")


@dataclass(frozen=True, eq=False)
class ArrayReader:
    """A source image in memory, behind the engine's `Reader`."""

    image: NDArray[Any]
    """(bands, height, width): uint8, uint16, int16 or float32."""
    valid: NDArray[np.bool_] | None = None
    """(height, width), True = valid; None: all are."""

    def __post_init__(self) -> None:
        if self.image.ndim != 3 or self.image.dtype.name not in _TYPES or not self.image.size:
            advice = "" if self.image.dtype.name in _TYPES else "; convert it, for instance with astype('float32')"
            raise UsageError(
                f"image of shape {self.image.shape} and type {self.image.dtype}; needed are (bands, height, width) of "
                f"{', '.join(_TYPES)}{advice}"
            )
        if self.valid is not None and (self.valid.shape != self.image.shape[1:] or self.valid.dtype != bool):
            raise UsageError(f"validity of shape {self.valid.shape}; needed is bool of {self.image.shape[1:]}")

    @classmethod
    def of(cls, values: NDArray[Any]) -> ArrayReader:
        """From (height, width) or (bands, height, width); what is masked in any band, or NaN, is invalid."""
        image = values[None] if values.ndim == 2 else values
        bad = np.asarray(np.ma.getmaskarray(image).any(axis=0), bool)
        plain = np.ma.getdata(image)
        plain = plain.astype(plain.dtype.newbyteorder("="), copy=False)  # files of other machines
        if plain.dtype.kind == "f":
            bad |= ~np.isfinite(plain).all(axis=0)
        return cls(plain, ~bad if bad.any() else None)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.image.shape[2], self.image.shape[1]

    @property
    def bands(self) -> int:
        """Number of bands."""
        return int(self.image.shape[0])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels."""
        return self.image.dtype

    def read(self, window: Window, level: int = 0) -> Pixels:
        """Pixels of a window and their validity, see `engine.base.Reader`."""
        if level:
            return reduced(self, window, level)
        if window & Window(0, 0, *self.size) != window:
            raise UsageError(f"{window} is not inside the image of {self.size[0]} × {self.size[1]} pixels")
        rows, cols = window.slices(Window(0, 0, *self.size))
        return self.image[:, rows, cols], None if self.valid is None else self.valid[rows, cols]
