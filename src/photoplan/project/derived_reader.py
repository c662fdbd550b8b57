"""What readers that change the pixels of another reader have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.io.raster_info import RasterInfo


class ImageReader(Protocol):
    """A reader of an image file, or of what is made of one."""

    @property
    def info(self) -> RasterInfo:
        """Facts of the file."""
        ...

    @property
    def path(self) -> Path:
        """The file."""
        ...

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
        """Type of the pixels."""
        ...

    def read(self, window: Window, level: int = 0) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
        """Pixels of a window and their validity, see `engine.base.Reader`."""
        ...


class DerivedReader:
    """Passes on what stays as the source has it: file, size and bands. Types and pixels are the subclass's."""

    source: ImageReader

    @property
    def info(self) -> RasterInfo:
        """Facts of the file."""
        return self.source.info

    @property
    def path(self) -> Path:
        """The file."""
        return self.source.path

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.source.size

    @property
    def bands(self) -> int:
        """Number of bands, without alpha."""
        return self.source.bands
