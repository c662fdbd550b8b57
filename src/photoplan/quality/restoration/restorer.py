"""A restoration filter applied to the pixels of one kind of image, window by window."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.kernels.convolve import round_clipped
from photoplan.kernels.shift_bands import limits_of
from photoplan.quality.linearise import Linearisation
from photoplan.quality.restoration.borders import Convolution, Margin, Scratch
from photoplan.quality.restoration.filters import RestorationFilter

_SCRATCH = Scratch()


@dataclass(frozen=True, eq=False)
class RestoredPixels:
    """A restored window."""

    values: NDArray[Any]
    """(bands, height, width); 0 where invalid."""
    valid: NDArray[np.bool_] | None
    """(height, width); None: all. Invalid pixels are those of the image."""
    below: tuple[int, ...]
    """Valid pixels of each band that would be below the least value of the type."""
    above: tuple[int, ...]
    """Valid pixels of each band that would be above its largest."""


@dataclass(frozen=True, eq=False)
class Restorer:
    """Convolves images of one size and type; the result does not depend on how the image is cut into windows."""

    filter: RestorationFilter
    size: tuple[int, int]
    """Width and height of the images, pixels."""
    bands: int
    dtype: np.dtype[Any]
    """Type of their pixels: uint8, uint16, int16 or float32."""
    out: np.dtype[Any]
    """Type of the restored pixels; grey values keep their scale."""
    linearisation: Linearisation = field(default_factory=Linearisation)
    """How grey values become light, which is what is filtered; the result is encoded again."""
    nodata: float | None = None
    """A value of whole numbers that restored pixels do not take: they become its neighbour."""
    light_given: bool = False
    """Whether windows hold light as float32, on the scale of `dtype`, instead of grey values."""
    _ready: tuple[tuple[Convolution, ...], ...] = field(init=False, repr=False)
    """Convolutions of each band."""

    def __post_init__(self) -> None:
        known = self.filter.image_size
        if known is not None and tuple(known) != tuple(self.size) and any(k.at for k in self.filter.kernels):
            raise InputError(
                f"the filter has places in images of {known[0]} × {known[1]} pixels, the image has {self.size[0]} × "
                f"{self.size[1]}; an image that was cropped or scaled needs a filter of its own"
            )
        for kernel in self.filter.kernels:
            if kernel.band is not None and not 1 <= kernel.band <= self.bands:
                raise InputError(f"the filter has a kernel for band {kernel.band}; the image has {self.bands}")
        ready = {id(kernel): Convolution(kernel) for kernel in self.filter.kernels}
        bands = (self.filter.for_band(band + 1) for band in range(self.bands))
        object.__setattr__(self, "_ready", tuple(tuple(ready[id(k)] for k in kernels) for kernels in bands))

    @property
    def margin(self) -> Margin:
        """How far the filter reaches."""
        return Margin(*self.filter.margin)

    @property
    def is_compiled(self) -> bool:
        """Whether the code for all kernels is compiled already."""
        direct = self.linearisation.is_linear
        return all(
            each.is_compiled(self.out if direct and len(ready) == 1 else np.dtype(np.float32))
            for ready in self._ready
            for each in ready
        )

    def restore(
        self, window: Window, pixels: NDArray[Any], at: Window, valid: NDArray[np.bool_] | None
    ) -> RestoredPixels:
        """Restore a window."""
        rows = slice(window.row - at.row, window.stop[1] - at.row)
        cols = slice(window.col - at.col, window.stop[0] - at.col)
        mask = None if valid is None else np.ascontiguousarray(valid[rows, cols])
        mask = None if mask is None or mask.all() else mask
        values = np.zeros((self.bands, window.height, window.width), self.out)
        counts = []
        for band in range(self.bands):
            if mask is not None and not mask.any():
                counts.append((0, 0))
                continue
            if self._ready[band]:
                light = pixels[band]
                if not self.light_given:
                    light = light_of(self.linearisation, light, valid, band + 1)
                source = self.margin.source(window, light[None], at, valid, _SCRATCH)[0]
                counts.append(self._convolved(source, window, mask, band, values[band]))
            else:
                grey = np.ascontiguousarray(pixels[band, rows, cols], np.float32)
                lost = (0, 0)
                if self.light_given:
                    grey, lost = self._grey(grey, mask, band + 1)
                clipped = _store(grey, mask, values[band])
                counts.append((lost[0] + clipped[0], lost[1] + clipped[1]))
        self._keep_apart(values)
        if mask is not None:
            values[:, ~mask] = 0
        return RestoredPixels(values, mask, tuple(c[0] for c in counts), tuple(c[1] for c in counts))

    def _convolved(
        self,
        source: NDArray[np.float32],
        window: Window,
        mask: NDArray[np.bool_] | None,
        band: int,
        values: NDArray[Any],
    ) -> tuple[int, int]:
        """Grey values of a window of light, filtered; returns how many pixels were clipped."""
        ready, margin = self._ready[band], self.filter.margin
        places = [each.kernel.at or (0.0, 0.0) for each in ready]
        if len(ready) == 1 and self.linearisation.is_linear:
            return ready[0](source, margin, values, mask)
        part, total = (_SCRATCH.array(name, values.shape) for name in ("part", "total"))
        total[:] = 0
        for index, weights in field_weights(places, window):
            ready[index](source, margin, part if weights is not None else total)
            if weights is not None:
                np.multiply(part, weights, out=part)
                np.add(total, part, out=total, where=weights > 0)
        grey, lost = self._grey(total, mask, band + 1)
        clipped = _store(grey, mask, values)
        return lost[0] + clipped[0], lost[1] + clipped[1]

    def _grey(
        self, light: NDArray[np.float32], mask: NDArray[np.bool_] | None, band: int
    ) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Grey values of light, and how many valid pixels were darker and brighter than a table reaches."""
        if self.linearisation.is_linear:
            return light, (0, 0)
        lost = (0, 0)
        if self.linearisation.kind == "table":
            low, high = self.linearisation.limits(self.dtype, band)
            count = np.ones(light.shape, bool) if mask is None else mask
            lost = int(((light < np.float32(low)) & count).sum()), int(((light > np.float32(high)) & count).sum())
        return self.linearisation.to_values(light.astype(np.float64), self.dtype, band).astype(np.float32), lost

    def _keep_apart(self, values: NDArray[Any]) -> None:
        """Give the neighbour of the nodata value to pixels that happen to have it."""
        if self.nodata is None or self.out.kind == "f":
            return
        limits = np.iinfo(self.out)
        if limits.min <= self.nodata <= limits.max:
            step = 1 if self.nodata < limits.max else -1
            values[values == self.out.type(self.nodata)] = self.out.type(self.nodata + step)


def light_of(
    linearisation: Linearisation, grey: NDArray[Any], valid: NDArray[np.bool_] | None, band: int
) -> NDArray[Any]:
    """Light of grey values of a band (from 1), float32; as they are where they are light already.

    What invalid pixels hold is of no account.
    """
    if linearisation.is_linear:
        return grey
    if linearisation.kind == "srgb" and grey.dtype.kind == "u":
        table = linearisation.to_linear(np.arange(np.iinfo(grey.dtype).max + 1, dtype=grey.dtype), band)
        return table.astype(np.float32)[grey]
    if valid is not None and valid.any():
        grey = np.where(valid, grey, grey[valid][0])
    return linearisation.to_linear(grey, band).astype(np.float32)


def _store(grey: NDArray[np.float32], mask: NDArray[np.bool_] | None, values: NDArray[Any]) -> tuple[int, int]:
    """Round into the type of the result; returns how many pixels were clipped."""
    if values.dtype.kind == "f":
        values[:] = grey
        return 0, 0
    usable = np.empty((0, 0), bool) if mask is None else mask
    below, above = round_clipped(grey, usable, limits_of(values.dtype), values)
    return int(below), int(above)


def field_weights(
    places: Sequence[tuple[float, float]], window: Window
) -> list[tuple[int, NDArray[np.float32] | None]]:
    """Weights of the places for every pixel of a window; they add up to 1.

    Places that form a full grid (each of their columns with each of their rows, whatever the steps) are interpolated
    bilinearly, and beyond the outer ones the outer ones hold. Others get weights by the inverse square of the distance
    (Shepard 1968), so that each place has its own filter exactly and far from all of them their mean holds.
    """
    if len(places) == 1:
        return [(0, None)]
    col = np.arange(window.col, window.stop[0], dtype=np.float64)
    row = np.arange(window.row, window.stop[1], dtype=np.float64)
    cols, rows = sorted({x for x, _ in places}), sorted({y for _, y in places})
    found = []
    if len(cols) * len(rows) == len(places):
        across, down = _hats(cols, col), _hats(rows, row)
        for i, (x, y) in enumerate(places):
            along, below = across[cols.index(x)], down[rows.index(y)]
            if along.any() and below.any():
                found.append((i, np.multiply.outer(below, along).astype(np.float32)))
        return found
    nearness = [1.0 / np.maximum((row[:, None] - y) ** 2 + (col - x) ** 2, 1e-12) for x, y in places]
    total = np.sum(nearness, axis=0)
    return [(i, (near / total).astype(np.float32)) for i, near in enumerate(nearness)]


def _hats(nodes: Sequence[float], at: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear interpolation between nodes as one row of weights for each of them, (nodes, positions)."""
    return np.stack([np.interp(at, nodes, unit) for unit in np.eye(len(nodes))])
