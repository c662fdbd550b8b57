"""Images whose pixels go through steps while they are read: linearisation, fall-off, chromatic shift, restoration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from photoplan.engine.base import Step
from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.geometry.levels import Pixels, reduced
from photoplan.io.raster import RasterReader
from photoplan.io.raster_info import RasterInfo

#: Side of the parts in which a large window goes through steps: what bounds memory. The result does not depend on it.
PART = 512
S = TypeVar("S")


@dataclass(frozen=True, eq=False)
class SteppedReader:
    """An image file behind the engine's `Reader`, its pixels as they are after some steps."""

    image: RasterReader
    steps: tuple[Step, ...] = ()

    def __post_init__(self) -> None:
        for step in self.steps:
            try:
                step.check(self.size, self.bands)
            except InputError as error:
                raise InputError(f"{self.path}: {error}") from None

    @property
    def info(self) -> RasterInfo:
        """Facts of the file."""
        return self.image.info

    @property
    def path(self) -> Path:
        """The file."""
        return self.image.path

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return self.image.size

    @property
    def bands(self) -> int:
        """Number of bands, without alpha."""
        return self.image.bands

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the pixels after the last step."""
        return self.dtype_before(len(self.steps))

    def dtype_before(self, step: int) -> np.dtype[Any]:
        """Type of the pixels that a step gets."""
        stored = self.image.dtype
        for each in self.steps[:step]:
            stored = each.result(stored)
        return stored

    def step(self, kind: type[S]) -> S | None:
        """The step of a kind; None: there is none."""
        return next((step for step in self.steps if isinstance(step, kind)), None)

    def then(self, *steps: Step) -> SteppedReader:
        """The same with further steps."""
        return SteppedReader(self.image, (*self.steps, *steps))

    def read(self, window: Window, level: int = 0) -> Pixels:
        """Pixels of a window and their validity, see `engine.base.Reader`; reduced after the last step."""
        if not self.steps:
            return self.image.read(window, level)
        if level:
            return reduced(self, window, level)
        parts = list(window.tiles(PART))
        if len(parts) == 1:
            return self._after(len(self.steps), window)
        values = np.empty((self.bands, window.height, window.width), self.dtype)
        valid = np.ones((window.height, window.width), bool)
        for part in parts:
            pixels, good = self._after(len(self.steps), part)
            rows, cols = part.slices(window)
            values[:, rows, cols] = pixels
            if good is not None:
                valid[rows, cols] = good
        return values, None if valid.all() else valid

    def before_last(self, window: Window) -> tuple[Window, Pixels]:
        """What the last step is given for a window: pixels around it, and where they are."""
        return self._before(len(self.steps) - 1, window)

    def _before(self, number: int, window: Window) -> tuple[Window, Pixels]:
        at = self.steps[number].around(window, self.size, False)
        pixels = self._after(number, at)
        if pixels[1] is not None:
            wide = self.steps[number].around(window, self.size, True)
            if wide != at:
                at, pixels = wide, self._after(number, wide)
        return at, pixels

    def _after(self, count: int, window: Window) -> Pixels:
        """Pixels after the first `count` steps."""
        if count == 0:
            return self.image.read(window)
        at, (pixels, valid) = self._before(count - 1, window)
        try:
            return self.steps[count - 1].apply(window, at, pixels, valid)
        except InputError as error:
            raise InputError(f"{self.path}: {error}") from None
