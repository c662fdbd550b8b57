"""A photograph against its view: over it, in squares with it, or beside it, pixel by pixel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.products.view.content import Colours, grey_span, in_colours

HOWS = ("over", "squares", "beside")
#: Squares along the longer side of a picture.
_SQUARES = 16


@dataclass(frozen=True)
class PhotoRequest:
    """A photograph that has the pixels of the picture."""

    path: str
    how: str = "over"
    """One of `HOWS`."""
    opacity: float = 0.5
    """Of what lies over the picture."""

    def __post_init__(self) -> None:
        if self.how not in HOWS:
            raise UsageError(f"photo {self.path}: {self.how!r}; allowed are {', '.join(HOWS)}, or an opacity")
        if not 0 < self.opacity <= 1:
            raise UsageError(f"photo {self.path}: opacity {self.opacity}; above 0 and up to 1")

    @classmethod
    def parse(cls, text: str) -> PhotoRequest:
        """From ``FILE``, ``FILE@OPACITY``, ``FILE@squares`` or ``FILE@beside``."""
        head, _, tail = text.rpartition("@")
        if not head or Path(text).is_file():
            return cls(text)
        try:
            return cls(head, "over", float(tail))
        except ValueError:
            return cls(head, tail)


@dataclass(frozen=True, eq=False)
class ViewPhoto:
    """A photograph, open, and the size of the picture that it belongs to."""

    request: PhotoRequest
    reader: RasterReader
    span: tuple[float, float]
    """Values that become black and white."""

    @classmethod
    def open(cls, request: PhotoRequest, size: tuple[int, int]) -> ViewPhoto:
        """"""
        reader = RasterReader(Path(request.path))
        if reader.size != size:
            own, asked = (" × ".join(map(str, each)) for each in (reader.size, size))
            raise InputError(
                f"{request.path}: {own} pixels, the picture has {asked}; give the photo's own image as `camera`, or "
                "its `size`"
            )
        return cls(request, reader, grey_span(reader))

    @property
    def shift(self) -> int:
        """Columns by which the photo lies beside the picture; 0: over it."""
        return self.reader.size[0] if self.request.how == "beside" else 0

    def lay(self, picture: NDArray[np.uint8], window: Window) -> None:
        """Put its pixels into those of a window of the product, shape (3, height, width)."""
        width, height = self.reader.size
        place = Window(self.shift, 0, width, height) & window
        if not place.size:
            return
        own = Window(place.col - self.shift, place.row, place.width, place.height)
        values, valid = self.reader.read(own)
        colours: Colours = in_colours(values, self.span)
        weight = np.full(colours.shape[1:], self.request.opacity if self.request.how == "over" else 1.0, np.float32)
        if self.request.how == "squares":
            v, u = np.mgrid[own.row : own.stop[1], own.col : own.stop[0]] // max(1, -(-max(width, height) // _SQUARES))
            weight[(u + v) % 2 == 0] = 0.0
        if valid is not None:
            weight[~valid] = 0.0
        at = (slice(None), *place.slices(window))
        under = picture[at].astype(np.float32) if not self.shift else np.zeros_like(colours)
        picture[at] = np.clip(np.rint(under + weight * (colours - under)), 0, 255)
