"""A pyramid before against after rectification of a turbulent strip (Schlüter 2001, §3): by how much do they differ?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.kernels.matching import sample_spline, spline_coefficients
from photoplan.matching.facets.observe import Pyramid
from photoplan.matching.features import GreyImage
from photoplan.matching.register import (
    FOUND,
    PatchDisplacements,
    PatchSettings,
    PixelTransfer,
    contradicting,
    match_grid,
)

Array = NDArray[np.float64]

FLYING, PIXEL, SPEED = 3000.0, 0.375, 70.0
"""Height above ground and pixel on the ground, metres (Schlüter 2001, §3); metres a second."""
LINE = PIXEL / SPEED
"""Seconds between two lines."""
LEVEL = 2
CONTRAST, NOISE = 40.0, 0.8
"""Standard deviations of the ground's grey values and of a pixel's noise."""


@dataclass(frozen=True)
class Strip:
    """A strip along X over level ground; turned by ω (roll) and φ (pitch) as time goes by."""

    columns: int
    lines: int
    rate: float = 0.4
    """Root mean square of the angular rates of ω and of φ, degrees a second."""
    seed: int = 1

    def angles(self) -> Array:
        """ω and φ at the lines, radians, (2, lines): turbulence of 0.3 to 8 Hz, and two jerks of the rate."""
        rng = np.random.default_rng(self.seed)
        t = np.arange(self.lines) * LINE
        out = np.zeros((2, self.lines))
        for angle in out:
            f, phase = np.exp(rng.uniform(np.log(0.3), np.log(8.0), 60)), rng.uniform(0, 2 * np.pi, 60)
            rates = np.radians(self.rate) * np.sqrt(2 / 60) * np.cos(2 * np.pi * np.outer(t, f) + phase)
            angle += np.cumsum(rates.sum(axis=1)) * LINE
            for part, size in ((0.4, 1.0), (0.6, -1.0)):
                # The rate changes by a degree a second within a twentieth of a second, and comes back in half a second.
                since = t - part * t[-1]
                jerk = np.where(since > 0, (1 - np.exp(-since / 0.05)) * np.exp(-since / 0.5), 0.0)
                angle += np.cumsum(np.radians(size) * jerk) * LINE
        return out - out.mean(axis=1, keepdims=True)

    def ground(self, line: Array, column: Array, angles: Array) -> Array:
        """Where pixels look, (..., 2), in pixels of the ground: X along, Y across the flight."""
        at = np.arange(self.lines)
        omega, phi = (np.interp(line, at, angle) for angle in angles)
        across = np.arctan((column - (self.columns - 1) / 2) * PIXEL / FLYING)
        Y = np.tan(across + omega) * FLYING
        X = line * PIXEL + np.tan(phi) * np.hypot(FLYING, Y)
        return np.stack([X, Y], axis=-1) / PIXEL

    def image_of(self, ground: Array, angles: Array) -> Array:
        """Line and column that see ground points, (..., 2): fixed points, since a line sees what is near it."""
        line = ground[..., 0].copy()
        column = np.empty_like(line)
        at = np.arange(self.lines)
        for _ in range(60):
            omega, phi = (np.interp(line, at, angle) for angle in angles)
            slant = np.hypot(FLYING, ground[..., 1] * PIXEL)
            step = ground[..., 0] - np.tan(phi) * slant / PIXEL - line
            line += 0.7 * step
            column = np.tan(np.arctan(ground[..., 1] * PIXEL / FLYING) - omega) * FLYING / PIXEL
            if np.abs(step).max() < 1e-5:
                break
        return np.stack([line, column + (self.columns - 1) / 2], axis=-1)


@dataclass(frozen=True, eq=False)
class Pixels:
    """An image in memory."""

    values: NDArray[np.float32]

    @property
    def size(self) -> tuple[int, int]:
        return self.values.shape[1], self.values.shape[0]

    def read(self, window: Window) -> tuple[NDArray[np.float32], None]:
        return self.values[window.slices(Window(0, 0, *self.size))][None], None


def sampled(values: Array, row_col: Array) -> Array:
    """An image as a cubic spline at places (..., 2) of row and column; NaN outside."""
    coefficients = np.array(values, float)[None]
    spline_coefficients(coefficients)
    out = np.empty(row_col[..., 0].size)
    sample_spline(coefficients[0], np.ascontiguousarray(row_col[..., ::-1].reshape(-1, 2)), out)
    return out.reshape(row_col.shape[:-1])


def texture(shape: tuple[int, int], seed: int = 3) -> Array:
    """A ground with detail of all sizes above 2.5 pixels, as a lens leaves it, (rows, columns)."""
    rng = np.random.default_rng(seed)
    u, v = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
    f = np.hypot(u, v)
    size = np.where(f < 0.4, 1 / np.maximum(f, 0.01) * np.cos(f / 0.4 * np.pi / 2), 0.0)
    values = np.fft.irfft2(np.fft.rfft2(rng.normal(size=shape)) * size, shape)
    return np.asarray(120 + CONTRAST * values / values.std())


def raw_image(strip: Strip, ground: Array, origin: tuple[float, float], seed: int = 5) -> Array:
    """The strip as it is flown, line by line, (lines, columns); `origin`: X and Y of the ground's first pixel."""
    line, column = np.meshgrid(
        np.arange(strip.lines, dtype=float), np.arange(strip.columns, dtype=float), indexing="ij"
    )
    at = strip.ground(line, column, strip.angles()) - np.array(origin)
    noise = np.random.default_rng(seed).normal(0, NOISE, line.shape)
    return np.asarray(sampled(ground, at) + noise)


@dataclass(frozen=True, eq=False)
class Outcome:
    """Both rectified pyramids and the vectors between them."""

    before: Array
    """Pyramid first, then rectified."""
    after: Array
    """Rectified first, then the pyramid."""
    found: PatchDisplacements
    shape: tuple[int, int]

    @property
    def vectors(self) -> Array:
        """Along and across the flight, pixels of the level, (n, 2), of all patches that were found, (x, y) = (Y, X)."""
        return self.found.moved[self.found.state == FOUND][:, ::-1]

    @property
    def quarter(self) -> float:
        """Share of vectors not longer than a quarter of a pixel."""
        return float((np.linalg.norm(self.vectors, axis=1) <= 0.25).mean())

    @property
    def largest(self) -> float:
        return float(np.linalg.norm(self.vectors, axis=1).max())

    @property
    def ratio(self) -> float:
        """Of the root mean squares along and across the flight."""
        along, across = np.sqrt((self.vectors**2).mean(axis=0))
        return float(along / across)


def run(strip: Strip, ground: Array | None = None, span: int = 11, radius: int = 5, spacing: int = 5) -> Outcome:
    """Fly the strip, make both pyramids with the low-pass filter of `span` pixels, register them."""
    margin = 120
    f = 2**LEVEL
    if ground is None:
        ground = texture((strip.lines + 2 * margin, strip.columns + 2 * margin))
    origin = -margin, -margin - (strip.columns - 1) / 2
    angles = strip.angles()
    raw = raw_image(strip, ground, origin)
    # The rectified area: what the strip surely sees.
    edge = 80
    X = np.arange(edge, strip.lines - edge, dtype=float)
    Y = np.arange(edge, strip.columns - edge, dtype=float) - (strip.columns - 1) / 2
    fine = sampled(raw, strip.image_of(np.stack(np.meshgrid(X, Y, indexing="ij"), axis=-1), angles))
    after = _level(fine, span)
    coarse = np.stack(np.meshgrid(X[::f], Y[::f], indexing="ij"), axis=-1)
    before = sampled(np.nan_to_num(_level(raw, span), nan=120.0), strip.image_of(coarse, angles) / f)
    rows, columns = (np.arange(12, n - 12, spacing) for n in after.shape)
    pair = GreyImage(Pixels(after.astype(np.float32))), GreyImage(Pixels(before.astype(np.float32)))
    at = np.stack([v.ravel() for v in np.meshgrid(columns, rows)], axis=1)
    parts = [match_grid(pair, PixelTransfer(), part, PatchSettings(radius, 2.0)) for part in _parts(at)]
    joined = {
        name: np.concatenate([getattr(p, name) for p in parts]) for name in PatchDisplacements.__dataclass_fields__
    }
    shape = len(rows), len(columns)
    return Outcome(before, after, contradicting(PatchDisplacements(**joined), shape), shape)


def _parts(at: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    return np.array_split(at, max(1, len(at) // 3000))


def _level(image: Array, span: int) -> Array:
    pyramid = Pyramid(GreyImage(Pixels(image.astype(np.float32))), span)
    return np.asarray(pyramid.read(LEVEL, Window(0, 0, *pyramid.size(LEVEL))), float)
