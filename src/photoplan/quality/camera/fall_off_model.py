"""Light fall-off as a formula: a natural part cos⁴ω and an artificial one, and pixels corrected by it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window

Array = NDArray[np.float64]

_AT_ONCE = 1 << 21
"""Pixels whose gain is computed at once."""
MOST_DEGREE = 10
_FAINT = 0.01
"""Brightness as part of that at the principal point below which nothing can be corrected."""


@dataclass(frozen=True)
class FallOffModel:
    """Brightness of an even surface over the image, relative to the principal point."""

    size: tuple[int, int]
    """Width and height of the image, pixels."""
    principal_point: tuple[float, float]
    """Column and row where the brightness is 1, from which the radius counts."""
    camera_constant: float | None
    """Pixels, of the natural part; None: there is none apart, the terms hold everything."""
    terms: tuple[tuple[int, int], ...]
    """(n, m) for r^n cos(m θ), (n, −m) for r^n sin(m θ); r in half diagonals of the image, θ from columns to rows."""
    coefficients: tuple[float, ...]
    """Of the terms in the artificial part, 1 + Σ."""
    dark: float = 0.0
    """Grey value of no light, which is taken off before the gain is applied and added after it."""

    def __post_init__(self) -> None:
        if min(self.size) < 1 or len(self.terms) != len(self.coefficients):
            raise InputError(
                f"light fall-off for an image of {self.size} with {len(self.terms)} terms and {len(self.coefficients)} "
                "coefficients; a size and one coefficient for each term are needed"
            )
        for n, m in self.terms:
            if not 1 <= n <= MOST_DEGREE or abs(m) > n or (n - m) % 2:
                raise InputError(
                    f"light fall-off: term ({n}, {m}); allowed are degrees 1 to {MOST_DEGREE} with |m| up to the "
                    "degree and as even or odd as it"
                )
        numbers = (*self.principal_point, *self.coefficients, self.dark)
        if not all(math.isfinite(v) for v in numbers):
            raise InputError("light fall-off: principal point, coefficients and dark must be finite numbers")
        if self.camera_constant is not None and not 0.0 < self.camera_constant < math.inf:
            raise InputError(f"light fall-off: camera constant {self.camera_constant}; a positive number is needed")

    @property
    def half_diagonal(self) -> float:
        """The unit of the radius, pixels."""
        return math.hypot(*self.size) / 2.0

    def natural(self, x: Array, y: Array) -> Array:
        """cos⁴ω at columns and rows; 1 where there is no natural part."""
        x, y = np.asarray(x, float) - self.principal_point[0], np.asarray(y, float) - self.principal_point[1]
        if self.camera_constant is None:
            return np.ones(np.broadcast_shapes(x.shape, y.shape))
        return (1.0 + (x**2 + y**2) / self.camera_constant**2) ** -2

    def artificial(self, x: Array, y: Array) -> Array:
        """What the natural part leaves, 1 at the principal point."""
        unit = self.half_diagonal
        u = (np.asarray(x, float) - self.principal_point[0]) / unit
        v = (np.asarray(y, float) - self.principal_point[1]) / unit
        total = np.ones(np.broadcast_shapes(u.shape, v.shape))
        for term, factor in zip(self.terms, self.coefficients):
            total += factor * term_values(u, v, term)
        return total

    def relative(self, x: Array, y: Array) -> Array:
        """Brightness at columns and rows, 1 at the principal point."""
        return self.natural(x, y) * self.artificial(x, y)


def term_values(u: Array, v: Array, term: tuple[int, int]) -> Array:
    """r^n cos(m θ), or for negative m r^n sin(|m| θ), of u = r cos θ and v = r sin θ."""
    n, m = term
    square = u * u + v * v
    turned = (u + 1j * v) ** abs(m)
    return np.asarray((turned.imag if m < 0 else turned.real) * square ** ((n - abs(m)) // 2))


def surface_terms(degree: int) -> tuple[tuple[int, int], ...]:
    """All terms up to a degree: together they span the general polynomial in columns and rows of that degree."""
    return tuple(
        (n, s * m) for n in range(1, degree + 1) for m in range(n % 2, n + 1, 2) for s in ((1, -1) if m else (1,))
    )


def correct_fall_off(pixels: NDArray[Any], window: Window, model: FallOffModel) -> tuple[NDArray[Any], int]:
    """Apply the gain, 1 / relative brightness, to the pixels of a window."""
    if pixels.ndim not in (2, 3) or pixels.shape[-2:] != (window.height, window.width):
        raise InputError(f"pixels of shape {pixels.shape} for a window of {window.width} × {window.height}")
    if window.col < 0 or window.row < 0 or window.stop[0] > model.size[0] or window.stop[1] > model.size[1]:
        raise InputError(
            f"light fall-off is known for an image of {model.size[0]} × {model.size[1]} pixels; the window {window} "
            "leaves it: use the correction of this camera at this image size"
        )
    if pixels.dtype.kind not in "uif":
        raise InputError(f"pixels of type {pixels.dtype}; whole numbers or floats are needed")
    out = np.empty_like(pixels)
    clipped = 0
    rows = max(1, _AT_ONCE // max(window.width, 1))
    x = np.arange(window.col, window.stop[0], dtype=float)[None, :]
    for first in range(0, window.height, rows):
        part = slice(first, min(first + rows, window.height))
        gain = _gain(model, x, window.row + np.arange(part.start, part.stop, dtype=float)[:, None])
        values = (pixels[..., part, :].astype(np.float64) - model.dark) * gain + model.dark
        if pixels.dtype.kind in "ui":
            limits = np.iinfo(pixels.dtype)
            np.rint(values, out=values)
            clipped += int(np.count_nonzero((values < limits.min) | (values > limits.max)))
            np.clip(values, limits.min, limits.max, out=values)
        out[..., part, :] = values
    return out, clipped


def gain_image(model: FallOffModel, factor: int = 1) -> NDArray[np.float32]:
    """Gains 1 / relative brightness at the middles of blocks of `factor` × `factor` pixels, shape (h, w) / factor.

    Blocks at the right and lower border may reach beyond the image.
    """
    if factor < 1:
        raise InputError(f"gain image reduced by {factor}; 1 or more is allowed")
    width, height = (-(-side // factor) for side in model.size)
    x = (np.arange(width) + 0.5)[None, :] * factor - 0.5
    out = np.empty((height, width), np.float32)
    rows = max(1, _AT_ONCE // width)
    for first in range(0, height, rows):
        y = (np.arange(first, min(first + rows, height)) + 0.5)[:, None] * factor - 0.5
        out[first : first + rows] = _gain(model, x, y)
    return out


def largest_gain(model: FallOffModel) -> float:
    """The largest gain, 1 / relative brightness, of 65 × 65 places over the image, its corners among them."""
    x, y = (np.linspace(0.0, side - 1.0, 65) for side in model.size)
    return float(_gain(model, x[None, :], y[:, None]).max())


def _gain(model: FallOffModel, x: NDArray[np.floating], y: NDArray[np.floating]) -> Array:
    relative = model.relative(np.asarray(x, float), np.asarray(y, float))
    if relative.min() < _FAINT:
        raise InputError(
            f"light fall-off: the model gives {100 * relative.min():.2g} % of the central brightness inside the image; "
            "it does not hold there and corrects nothing: fit it again with a lower degree"
        )
    return 1.0 / relative
