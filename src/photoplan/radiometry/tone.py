"""Tones of grey values: light by the image's curve, without the trend over the image, then a monotone table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.kernels.raster import tone_pixels

_Floats = NDArray[np.float64]

#: A trend is no less than this, however far its surface runs off in a corner.
LEAST = 0.2


@dataclass(frozen=True)
class Tone:
    """The tables and the trend of one band of one image: out = table(light(grey) / trend(x, y))."""

    grey: tuple[float, ...]
    """Grey values of the table, rising."""
    becomes: tuple[float, ...]
    """Grey values that they become, never falling: linear between them, and beyond them as in the last interval."""
    terms: tuple[tuple[int, int, float], ...] = ()
    """(i, j, c) of the trend 1 + Σ c (uⁱ vʲ − m); see `surface`."""
    curve: tuple[tuple[float, ...], tuple[float, ...]] = ((), ())
    """Grey values of the image, and the light that gives them: a characteristic curve that acts after the trend.

    `grey` are values of light then. Without it light is grey.
    """

    def __post_init__(self) -> None:
        self._check(self.grey, self.becomes)
        if any(self.curve):
            self._check(*self.curve)

    @staticmethod
    def _check(of: Sequence[float], to: Sequence[float]) -> None:
        grey, becomes = np.asarray(of), np.asarray(to)
        if len(grey) != len(becomes) or len(grey) < 2:
            raise InputError(f"{len(grey)} grey values that become {len(becomes)}; as many are needed, two at least")
        if not (np.isfinite(grey).all() and np.isfinite(becomes).all()):
            raise InputError("a grey value of the table is no number")
        falling = np.flatnonzero(np.diff(grey) <= 0)
        if len(falling):
            raise InputError(f"grey {grey[falling[0] + 1]:g} comes after {grey[falling[0]]:g}; they must rise")
        falling = np.flatnonzero(np.diff(becomes) < 0)
        if len(falling):
            k = falling[0]
            raise InputError(
                f"grey {grey[k]:g} becomes {becomes[k]:g}, but {grey[k + 1]:g} becomes {becomes[k + 1]:g}; "
                "a table may not fall"
            )

    def table(self, light: ArrayLike) -> _Floats:
        """Return what light without the trend becomes."""
        return _looked_up(light, self.grey, self.becomes)

    def light(self, grey: ArrayLike) -> _Floats:
        """Return the light of grey values of the image."""
        return _looked_up(grey, *self.curve) if any(self.curve) else np.asarray(grey, float)

    def of(self, grey: ArrayLike, x: ArrayLike, y: ArrayLike, size: tuple[int, int]) -> _Floats:
        """Return what grey values at pixels of an image become; `size`: of the image."""
        light = self.light(grey)
        return self.table(light / self.trend(x, y, size) if self.terms else light)

    def at_mean_trend(self, entries: int) -> Tone:
        """Return curve and table as one table of so many entries, without the trend."""
        of = self.curve[0] if any(self.curve) else self.grey
        grey = np.linspace(of[0], of[-1], entries)
        return Tone(tuple(grey.tolist()), tuple(self.table(self.light(grey)).tolist()))

    def trend(self, x: ArrayLike, y: ArrayLike, size: tuple[int, int]) -> _Floats:
        """Return how bright the image is at pixels, beside its mean; `size`: of the image."""
        surfaces = surface(x, y, size, tuple((i, j) for i, j, _ in self.terms))
        return np.asarray(np.maximum(1.0 + surfaces @ np.array([c for _, _, c in self.terms]), LEAST))


def _looked_up(value: ArrayLike, of: Sequence[float], to: Sequence[float]) -> _Floats:
    """A table between its entries; beyond them the first or last interval goes on."""
    x, y, at = np.asarray(of), np.asarray(to), np.asarray(value, float)
    out = np.interp(at, x, y)
    low, high = at < x[0], at > x[-1]
    if low.any():
        out = np.where(low, y[0] + (at - x[0]) * (y[1] - y[0]) / (x[1] - x[0]), out)
    if high.any():
        out = np.where(high, y[-1] + (at - x[-1]) * (y[-1] - y[-2]) / (x[-1] - x[-2]), out)
    return np.asarray(out, float)


def powers_of(degree: int) -> tuple[tuple[int, int], ...]:
    """Powers (i, j) of the surfaces up to a degree, without the constant."""
    return tuple((total - j, j) for total in range(1, degree + 1) for j in range(total + 1))


def surface(x: ArrayLike, y: ArrayLike, size: tuple[int, int], powers: Sequence[tuple[int, int]]) -> _Floats:
    """Surfaces uⁱ vʲ minus their mean over the image, shape (..., terms).

    u and v are columns and rows from the image's middle in half diagonals. Without their means a trend brightens
    one part of the image and darkens another, and leaves the whole as it is.
    """
    half = np.hypot(*size) / 2
    u = (np.asarray(x, float) - (size[0] - 1) / 2) / half
    v = (np.asarray(y, float) - (size[1] - 1) / 2) / half
    found = [u**i * v**j - _mean((i, j), size) for i, j in powers]
    return np.stack(found, axis=-1) if found else np.empty((*np.broadcast_shapes(u.shape, v.shape), 0))


def toned(pixels: NDArray[Any], window: Window, size: tuple[int, int], tones: Sequence[Tone]) -> NDArray[Any]:
    """Pixels of a window of an image after table and trend, in their own type.

    Parameters
    ----------
    pixels : ndarray, shape (bands, height, width)
        Integers are rounded and kept inside their type's range; NaN stays NaN.
    window : Window
        Where they lie in the image.
    size : (int, int)
        Width and height of the image.
    tones : sequence of Tone
        One for each band.
    """
    out = np.empty_like(pixels)
    short = pixels.dtype.kind in "ui" and pixels.dtype.itemsize <= 2
    for band, tone in enumerate(tones):
        if short:
            limits = np.iinfo(pixels.dtype)
            light = tone.light(np.arange(limits.min, limits.max + 1))
            table = light if tone.terms else fitted(tone.table(light), pixels.dtype)
            grey = table[pixels[band].astype(np.int64) - limits.min]
        else:
            grey = tone.light(pixels[band].astype(np.float64))
        if short and not tone.terms:
            out[band] = grey
            continue
        corner, factors = (window.col, window.row), _factors(tone.terms, size)
        tone_pixels(grey, corner, size, factors, LEAST, np.array(tone.grey), np.array(tone.becomes))
        out[band] = fitted(grey, pixels.dtype)
    return out


def _factors(terms: Sequence[tuple[int, int, float]], size: tuple[int, int]) -> _Floats:
    """Return the factors of uⁱ vʲ in a trend, whose mean over the image is 1."""
    out = np.zeros((1 + max((i for i, _, _ in terms), default=0), 1 + max((j for _, j, _ in terms), default=0)))
    out[0, 0] = 1.0
    for i, j, c in terms:
        out[i, j] += c
        out[0, 0] -= c * _mean((i, j), size)
    return out


def _mean(powers: tuple[int, int], size: tuple[int, int]) -> float:
    """Mean of uⁱ vʲ over the image."""
    edge = np.array(size) / np.hypot(*size)
    one, other = (0.0 if k % 2 else e**k / (k + 1) for k, e in zip(powers, edge.tolist()))
    return float(one * other)


def fitted(values: _Floats, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Values in a type: integers rounded and kept inside its range."""
    if dtype.kind not in "ui":
        return values.astype(dtype)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)
