"""An image as light: grey values made linear, one band or the luminance of three, with what is saturated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.io.plain_files import whole_number
from photoplan.io.raster import RasterReader
from photoplan.quality.clipping import piled_ends
from photoplan.quality.edges.candidates import range_of
from photoplan.quality.edges.find import EdgePicture
from photoplan.quality.linearise import Linearisation

#: Channel 0.
LUMINANCE = 0
_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
#: Weights of red, green and blue in the luminance of JPEG (ITU-R BT.601).
_LUMA = (0.299, 0.587, 0.114)
"""Of red, green and blue light (ITU-R BT.709)."""
_CLIPS = tuple(float(2**bits - 1) for bits in (8, 10, 11, 12, 13, 14, 15, 16))
"""Values with which sensors of so many bits end."""
_OFTEN = 20
"""Pixels that must have such a value."""
_SAMPLES = 24
"""Windows in which the range of values is looked for."""


@dataclass(frozen=True, eq=False)
class LightImage:
    """An image behind windows of light.

    Channel 0 is the luminance of the first three bands, or the only band; channel n is band n.
    """

    reader: RasterReader
    linearisation: Linearisation
    span: dict[int, float]
    """Range of the values of each channel that was asked for."""
    extremes: dict[int, tuple[float, float]]
    """Smallest and largest grey value that was seen in each band, as stored."""

    @classmethod
    def open(cls, path: Path, linearisation: Linearisation) -> LightImage:
        """Open a file; its pixels are not read yet."""
        return cls(RasterReader(path), linearisation, {}, {})

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.reader.size

    def channel_name(self, channel: int) -> str:
        """How messages call a channel."""
        if channel == LUMINANCE:
            return "luminance" if self.reader.bands >= 3 else "band 1"
        return f"band {channel}"

    def channels(self, band: str | None) -> tuple[int, ...]:
        """Channels that an option asks for: None: luminance or the first band, a number, or all."""
        bands = self.reader.bands
        if band is None:
            return (LUMINANCE,) if bands >= 3 or bands == 1 else (1,)
        if band == "all":
            return (LUMINANCE, *range(1, bands + 1)) if bands >= 3 else tuple(range(1, bands + 1))
        if not 1 <= (whole_number(band) or 0) <= bands:
            raise UsageError(f"{self.reader.path}: `band` {band}; the file has bands 1 to {bands}, or say all")
        return (int(band),)

    def picture(self, window: Window, channel: int) -> EdgePicture:
        """Light of a channel in a window, with the range of values of the whole image."""
        # First the samples of the whole image: they tell whether an end of a window is one of the image.
        span = self._span(channel)
        grey, valid, saturated = self._light(window, channel)
        return EdgePicture(grey, valid, saturated, span)

    def stored(self, window: Window, channel: int) -> NDArray[np.float64]:
        """Grey values of a channel in a window as stored; of colours the luminance that compression works on."""
        pixels, _ = self.reader.read(window)
        if self.reader.bands < 3:
            return pixels[max(channel, 1) - 1].astype(np.float64)
        return np.tensordot(_LUMA, pixels[:3].astype(np.float64), 1)

    def _light(
        self, window: Window, channel: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None, NDArray[np.bool_] | None]:
        pixels, valid = self.reader.read(window)
        single = channel != LUMINANCE or self.reader.bands < 3
        bands = [max(channel, 1)] if single else [1, 2, 3]
        light = np.zeros(pixels.shape[1:], np.float32)
        saturated = np.zeros(pixels.shape[1:], bool)
        for weight, band in zip([1.0] if single else _WEIGHTS, bands):
            stored = pixels[band - 1]
            light += np.float32(weight) * self._linear(stored, valid, band)
            low, high = self._ends(stored if valid is None else stored[valid], band)
            saturated |= (stored >= high) | (stored <= low)
        return light, valid, saturated if saturated.any() else None

    def _linear(self, stored: NDArray[np.generic], valid: NDArray[np.bool_] | None, band: int) -> NDArray[np.float32]:
        """Light of a band, full scale 1 but for tables; integers by a table of the values that occur."""
        known = stored if valid is None else stored[valid]
        result = np.zeros(stored.shape, np.float32)
        if known.size == 0:
            return result
        scale = 1.0 if self.linearisation.kind == "table" else self.linearisation.full_scale(stored.dtype)
        low = known.min()
        if stored.dtype.kind == "f":
            light = self.linearisation.to_linear(known, band)
        else:
            grey = np.arange(int(low), int(known.max()) + 1).astype(stored.dtype)
            light = self.linearisation.to_linear(grey, band)[known.astype(np.int64) - int(low)]
        if valid is None:
            return np.asarray(light / scale, np.float32)
        result[valid] = light / scale
        return result

    def _ends(self, known: NDArray[Any], band: int) -> tuple[float, float]:
        """Stored values at which a sensor or a file clips, by the valid pixels of a window.

        Those of the type, of the bits that the file states, or the largest value of the window if it is what a sensor
        of fewer bits ends with; else values at which the pixels pile up, unless the image holds values beyond them.
        """
        kind = self.reader.dtype
        if kind.kind == "f":
            known = known[np.isfinite(known)]
            low, high = -np.inf, np.inf
        else:
            limits, bits = np.iinfo(kind), self.reader.info.bits
            low = float(limits.min)
            high = float(2**bits - 1) if kind.kind == "u" and 0 < bits < 8 * kind.itemsize else float(limits.max)
        if known.size == 0:
            return low, high
        largest = float(known.max())
        if (largest in _CLIPS or (kind.kind == "f" and largest == 1.0)) and int((known == largest).sum()) >= _OFTEN:
            high = min(high, largest)
        between = known[(known > low) & (known < high)]
        if between.size == 0:
            return low, high
        seen = (float(between.min()), float(between.max()))
        before = self.extremes.get(band, seen)
        self.extremes[band] = min(seen[0], before[0]), max(seen[1], before[1])
        smallest, largest = self.extremes[band]
        first, last = piled_ends(between)
        return (max(low, first) if first <= smallest else low), (min(high, last) if last >= largest else high)

    def _span(self, channel: int) -> float:
        """Range of the values of the whole image, from windows spread over it; asked once."""
        if channel not in self.span:
            width, height = self.size
            side = min(256, width), min(256, height)
            n = max(1, round(_SAMPLES**0.5))
            parts = []
            for i in range(n):
                for j in range(n):
                    at = (round(j * (width - side[0]) / max(n - 1, 1)), round(i * (height - side[1]) / max(n - 1, 1)))
                    grey, valid, _ = self._light(Window(*at, *side), channel)
                    parts.append((grey if valid is None else grey[valid]).ravel()[::7])
            self.span[channel] = range_of(np.concatenate(parts)[None])
        return self.span[channel]
