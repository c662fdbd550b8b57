"""Spread functions of the image formation model on the cells of a scene, and their transfer functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, cos, pi, radians, sin
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from photoplan.errors import InputError
from photoplan.quality.formation.parts import Aperture, Spread
from photoplan.quality.formation.shapes import disc_share
from photoplan.quality.mtf_curve import disc_transfer, pupil_transfer

_Array = NDArray[np.float64]
_Transfer = Callable[[_Array, _Array], NDArray[Any]]
#: Modulation that counts as none.
_NOTHING = 1e-4
#: Repetitions of the spectrum to each side that are added: a kernel of cells is a sampled function.
_ALIASES = 3
#: Kernels of more cells than this to a side are refused.
MOST_CELLS = 6000
#: Lengths of an exponential tail after which it ends: 0.3 % of its light lies beyond.
_TAIL_REACH = 8.0
#: The Airy pattern falls slowly; at this multiple of λN its rings hold 0.5 % of the light.
_AIRY_REACH = 40.0


def _sinc(x: _Array) -> _Array:
    return np.asarray(np.sinc(x))


def _smooth_transfer(spread: Spread, fx: _Array, fy: _Array, scale: float) -> _Array:
    """Transfer function of the parts that are functions of continuous place, without the tail; cycles per pixel."""
    sx, sy = (sigma * scale for sigma in spread.gaussian)
    result = np.exp(-2.0 * pi**2 * ((sx * fx) ** 2 + (sy * fy) ** 2))
    f = np.hypot(fx, fy)
    if spread.defocus:
        result = result * disc_transfer(spread.defocus * scale / 2.0, f)
    if spread.motion:
        along = radians(spread.motion_deg)
        result = result * _sinc(spread.motion * scale * (cos(along) * fx + sin(along) * fy))
    if spread.diffraction:
        result = result * pupil_transfer(spread.diffraction * scale * f)
    return np.asarray(result)


def _tail_transfer(spread: Spread, fx: _Array, fy: _Array, scale: float) -> _Array:
    """Transfer function of exp(−r / L) / (2π L²)."""
    length = spread.tail_length * scale
    return np.asarray((1.0 + (2.0 * pi * length) ** 2 * (fx**2 + fy**2)) ** -1.5)


def spread_transfer(spread: Spread, fx: _Array, fy: _Array, scale: float = 1.0) -> NDArray[np.complex128]:
    """Optical transfer function of a spread function, without the pixel's aperture."""
    result = _smooth_transfer(spread, fx, fy, scale).astype(complex)
    for values, f in ((spread.along_x, fx), (spread.along_y, fy)):
        if values:
            offsets = np.arange(len(values)) - len(values) // 2
            shares = np.array(values) / sum(values)
            result *= np.exp(-2j * pi * scale * np.multiply.outer(f, offsets)) @ shares
    if spread.kernel:
        kernel = np.array(spread.kernel) / np.sum(spread.kernel)
        rows, columns = (np.arange(n) - n // 2 for n in kernel.shape)
        down = np.exp(-2j * pi * scale * np.multiply.outer(fy, rows))
        across = np.exp(-2j * pi * scale * np.multiply.outer(fx, columns))
        result *= np.einsum("...r,rc,...c->...", down, kernel, across)
    if spread.tail_share:
        result *= 1.0 - spread.tail_share + spread.tail_share * _tail_transfer(spread, fx, fy, scale)
    return result


def aperture_transfer(aperture: Aperture, fx: _Array, fy: _Array) -> _Array:
    """Transfer function of a pixel's aperture at frequencies in cycles per pixel."""
    wx, wy = aperture.width
    if aperture.shape == "square":
        return _sinc(fx * wx) * _sinc(fy * wy)
    if aperture.shape == "round":
        return disc_transfer(0.5, np.hypot(fx * wx, fy * wy))
    return np.ones(np.broadcast_shapes(np.shape(fx), np.shape(fy)))


def _reach(spread: Spread, scale: float) -> float:
    """Pixels to each side beyond which the smooth parts without tail hold nothing of note."""
    reach = 6.0 * max(spread.gaussian) + spread.defocus / 2.0 + spread.motion / 2.0
    return float(scale * (reach + _AIRY_REACH * spread.diffraction))


def _is_smooth(transfer: _Transfer, cells: int) -> bool:
    """Whether next to nothing passes above half the frequency of the cells: values at the cells then say it all."""
    f = np.linspace(cells / 2.0, 1.5 * cells, 21)
    highest = max(np.abs(transfer(f, 0.0 * f)).max(), np.abs(transfer(0.0 * f, f)).max())
    return bool(highest < _NOTHING)


def _of_smooth(transfer: _Transfer, cells: int, reach: float) -> _Array:
    """Kernel on cells of a transfer function that is smooth; odd sides, sum 1."""
    half, base = _grid(cells, reach)
    fx, fy = np.meshgrid(np.abs(base[: 2 * half + 1]), base)
    return _cut(transfer(fx, fy), half)


def _of_squares(transfer: _Transfer, cells: int, reach: float) -> _Array:
    """Kernel between even cells: the light that the mean of a cell receives from another, for each offset.

    It is the spread function convolved with a cell twice and sampled once per cell; in frequencies: times sinc², and
    repeated.
    """
    half, base = _grid(cells, reach)
    fx, fy = np.meshgrid(np.abs(base[: 2 * half + 1]), base)
    spectrum = np.zeros(fx.shape, complex)
    for across in range(-_ALIASES, _ALIASES + 1):
        for down in range(-_ALIASES, _ALIASES + 1):
            x, y = fx + across * cells, fy + down * cells
            spectrum += transfer(x, y) * (_sinc(x / cells) * _sinc(y / cells)) ** 2
    return _cut(spectrum, half)


def _grid(cells: int, reach: float) -> tuple[int, _Array]:
    """Half a kernel's side in cells, and frequencies of a grid twice as wide: nothing returns from its other side."""
    half = max(1, ceil(reach * cells) + 1)
    if 2 * half + 1 > MOST_CELLS:
        raise InputError(
            f"spread: a kernel of {2 * half + 1} cells to a side (reach {reach:.0f} pixels × {cells} cells); at most "
            f"{MOST_CELLS} are allowed: choose a lower oversampling"
        )
    return half, np.asarray(np.fft.fftfreq(4 * half) * cells, np.float64)


def _cut(spectrum: NDArray[Any], half: int) -> _Array:
    n = 4 * half
    kernel = np.fft.fftshift(np.fft.irfft2(spectrum, (n, n)))[half : 3 * half + 1, half : 3 * half + 1]
    return np.asarray(kernel / kernel.sum())


def _spaced(values: _Array, spacing: float) -> _Array:
    """Values at whole pixels put on cells `spacing` apart, each divided between the two cells beside its place."""
    half = values.size // 2
    middle = ceil(half * spacing) + 1
    out = np.zeros(2 * middle + 1)
    place = middle + (np.arange(values.size, dtype=float) - half) * spacing
    low = np.floor(place + 1e-9).astype(int)
    part = np.maximum(place - low, 0.0)
    np.add.at(out, low, values * (1.0 - part))
    np.add.at(out, low + 1, values * part)
    return out


def _discrete(spread: Spread, spacing: float) -> _Array:
    """The discrete parts on cells, shape of odd sides; [[1]] if there are none."""
    result = np.ones((1, 1))
    if spread.along_x:
        result = result * _spaced(np.array(spread.along_x), spacing)[None, :]
    if spread.along_y:
        result = result * _spaced(np.array(spread.along_y), spacing)[:, None]
    if spread.kernel:
        rows = np.stack([_spaced(np.array(row), spacing) for row in spread.kernel])
        result = signal.convolve(result, np.stack([_spaced(column, spacing) for column in rows.T], 1))
    return np.asarray(result / result.sum())


@dataclass(frozen=True, eq=False)
class PixelKernel:
    """How cells become the values of pixels: they are spread, then summed with weights."""

    spread: _Array
    """Kernel with odd sides, sum 1."""
    weights: _Array
    """Weights of the cells of a pixel, sum 1."""
    row: int
    """Cell of ``weights[0, 0]``, counted from the first cell of the pixel; negative for wide apertures."""
    column: int
    """The same along x."""


@lru_cache(maxsize=256)
def pixel_kernel(spread: Spread, aperture: Aperture, scale: float, cells: int, continuous: bool) -> PixelKernel:
    """Kernel of spread function and aperture on the cells of a scene.

    Where the cells are means of a continuous scene and the spread function is smooth against them, both are one kernel
    that also undoes the averaging over the cells: the pixels' values are those of the continuous scene. Elsewhere cells
    that the aperture cuts are taken as even.
    """

    def smooth(fx: _Array, fy: _Array) -> NDArray[Any]:
        return _smooth_transfer(spread, fx, fy, scale)

    def tail(fx: _Array, fy: _Array) -> NDArray[Any]:
        return _tail_transfer(spread, fx, fy, scale)

    def with_aperture(fx: _Array, fy: _Array) -> NDArray[Any]:
        # The middle of a pixel lies between cells where their number is even.
        turn = np.exp(-1j * np.pi * (fx + fy) / cells) if cells % 2 == 0 else 1.0
        averaging = _sinc(np.clip(fx / cells, -0.5, 0.5)) * _sinc(np.clip(fy / cells, -0.5, 0.5))
        return np.asarray(smooth(fx, fy) * aperture_transfer(aperture, fx, fy) * turn / averaging)

    kernel, reach = _discrete(spread, scale * cells), _reach(spread, scale)
    weights, row, column = _aperture_weights(aperture, cells)
    if reach > 0.0 and continuous and _is_smooth(smooth, cells):
        wide = reach + max(aperture.width) + 1.0
        kernel = signal.convolve(kernel, _of_smooth(with_aperture, cells, wide))
        weights, row, column = np.ones((1, 1)), cells // 2, cells // 2
    elif reach > 0.0:
        kernel = signal.convolve(kernel, _of_squares(smooth, cells, reach))
    if spread.tail_share:
        reach = _TAIL_REACH * spread.tail_length * scale
        make = _of_smooth if continuous and _is_smooth(tail, cells) else _of_squares
        wings = make(tail, cells, reach) * spread.tail_share
        wings[wings.shape[0] // 2, wings.shape[1] // 2] += 1.0 - spread.tail_share
        kernel = signal.convolve(kernel, wings)
    return PixelKernel(_trimmed(kernel), weights, row, column)


def _trimmed(kernel: _Array) -> _Array:
    """Without borders that hold nothing, and with the sum 1."""
    for axis in (0, 1):
        lines = np.abs(kernel).sum(1 - axis)
        half = lines.size // 2
        outside = np.cumsum(lines[:half] + lines[:half:-1])
        cut = int(np.searchsorted(outside, 1e-10 * lines.sum()))
        kernel = kernel[cut : lines.size - cut] if axis == 0 else kernel[:, cut : lines.size - cut]
    return kernel / kernel.sum()


@lru_cache(maxsize=64)
def _aperture_weights(aperture: Aperture, cells: int) -> tuple[_Array, int, int]:
    """Shares of the cells in a pixel's value, and the cell of the first weight."""
    (wx, wy), middle = aperture.width, cells / 2.0
    if aperture.shape == "point":
        wx = wy = 0.0
    first = [int(np.floor(middle - w * cells / 2.0 + 1e-9)) for w in (wx, wy)]
    last = [max(f, int(np.ceil(middle + w * cells / 2.0 - 1e-9)) - 1) for f, w in zip(first, (wx, wy))]
    if aperture.shape == "point" and cells % 2 == 0:
        first = [cells // 2 - 1] * 2
        last = [cells // 2] * 2
    x, y = (np.arange(f, e + 1, dtype=np.float64) + 0.5 - middle for f, e in zip(first, last))
    if aperture.shape == "square":
        inside = [
            np.clip(np.minimum(v + 0.5, w * cells / 2.0) - np.maximum(v - 0.5, -w * cells / 2.0), 0.0, 1.0)
            for v, w in ((x, wx), (y, wy))
        ]
        weights = np.multiply.outer(inside[1], inside[0])
    elif aperture.shape == "round":
        weights = _ellipse(x, y, (wx * cells / 2.0, wy * cells / 2.0))
    else:
        weights = np.ones((y.size, x.size))
    weights = weights / weights.sum()
    weights.setflags(write=False)
    return weights, first[1], first[0]


def _ellipse(x: NDArray[Any], y: NDArray[Any], radii: tuple[float, float]) -> _Array:
    """Share of cells of side 1 that an ellipse covers; by parts of cells where it is no circle."""
    rx, ry = radii
    if rx == ry:
        return disc_share(x[None, :], y[:, None], 1.0, rx)
    parts = (np.arange(32) + 0.5) / 32.0 - 0.5
    fine_x = (x[:, None] + parts).ravel() / rx
    fine_y = (y[:, None] + parts).ravel() / ry
    inside = (fine_x[None, :] ** 2 + fine_y[:, None] ** 2 <= 1.0).astype(float)
    return np.asarray(inside.reshape(y.size, 32, x.size, 32).mean((1, 3)))
