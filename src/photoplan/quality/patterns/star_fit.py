"""Waves around the centre of a Siemens star: number of sectors, centre, and waves of single rings."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import hypot, pi

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.quality.patterns.pixels import least_squares, waves

Array = NDArray[np.float64]

#: Numbers of sectors that a star may have.
SECTORS = (4, 360)


@dataclass(frozen=True, eq=False)
class StarPixels:
    """Pixels of a window in polar coordinates about a centre, by increasing radius."""

    centre: tuple[float, float]
    values: Array
    """Light, shape (n,)."""
    x: Array
    y: Array
    radius: Array
    """Distance from the centre."""
    angle: Array
    """Direction from the centre, from columns towards increasing rows, radians."""

    @classmethod
    def of(cls, values: Array, centre: tuple[float, float]) -> StarPixels:
        """Pixels of a window."""
        y, x = np.mgrid[0 : values.shape[0], 0 : values.shape[1]].astype(float)
        return cls._sorted(centre, values.ravel(), x.ravel(), y.ravel())

    def about(self, centre: tuple[float, float]) -> StarPixels:
        """The same pixels about another centre."""
        return self._sorted(centre, self.values, self.x, self.y)

    @classmethod
    def _sorted(cls, centre: tuple[float, float], values: Array, x: Array, y: Array) -> StarPixels:
        radius = np.hypot(x - centre[0], y - centre[1])
        order = np.argsort(radius, kind="stable")
        x, y = x[order], y[order]
        angle = np.arctan2(y - centre[1], x - centre[0])
        return cls(centre=centre, values=values[order], x=x, y=y, radius=radius[order], angle=angle)

    def between(self, inner: float, outer: float) -> tuple[Array, Array]:
        """Light and direction of the pixels of a ring."""
        part = slice(*np.searchsorted(self.radius, [inner, outer]))
        return self.values[part], self.angle[part]


@dataclass(frozen=True, eq=False)
class StarRing:
    """The wave that is left on a ring, or on a part of it."""

    radius: float
    mean: float
    cosine: float
    sine: float
    covariance: Array
    """Of cosine and sine, (2, 2)."""
    third: tuple[float, float] | None
    """Cosine and sine of the third harmonic wave; None where it is not fitted."""
    residual: float
    """Root mean square of what the waves leave."""
    pixels: int

    @property
    def amplitude(self) -> float:
        """Amplitude without what noise adds to it."""
        return float(np.sqrt(max(self.cosine**2 + self.sine**2 - 2.0 * self.sigma**2, 0.0)))

    @property
    def sigma(self) -> float:
        """Standard deviation of the amplitude."""
        return float(np.sqrt(np.trace(self.covariance) / 2.0))


def fit_ring(values: Array, angle: Array, radius: float, sectors: int, *, whole: bool) -> StarRing:
    """Least squares of a wave with so many periods around the centre, beside a level that changes slowly."""
    frequency = sectors / (2.0 * pi * radius)
    around = angle / (2.0 * pi)
    slow = np.hstack([np.ones((angle.size, 1)), waves(around, (1, 2) if whole else (1,))])
    start = slow.shape[1]
    high = [k for k in (2, 3, 4, 5, 7, 9, 11) if k * frequency < 1.3 and start + 2 + 2 * k < angle.size / 4]
    solution, covariance, residuals = least_squares(np.hstack([slow, waves(sectors * around, (1, *high))]), values)
    third = None
    if 3 in high:
        place = start + 2 + 2 * high.index(3)
        third = (float(solution[place]), float(solution[place + 1]))
    return StarRing(
        radius=radius,
        mean=float(solution[0]),
        cosine=float(solution[start]),
        sine=float(solution[start + 1]),
        covariance=covariance[start : start + 2, start : start + 2],
        third=third,
        residual=float(np.sqrt((residuals**2).mean())),
        pixels=angle.size,
    )


def rough_centre(values: Array) -> tuple[float, float]:
    """Centre of the pattern that a half turn maps onto itself, or onto its negative (odd numbers of sectors).

    The correlation of the window with itself, turned by half a turn; it peaks at twice the centre.
    """
    rows, columns = values.shape
    flat = values - values.mean()
    size = (2 * rows, 2 * columns)
    # High frequencies count more: plain areas are alike under every shift.
    spectrum = np.fft.rfft2(flat, size)
    fy, fx = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None, :]
    spectrum = spectrum * np.clip(np.hypot(fx, fy) / 0.05, 0.0, 1.0)
    score = np.abs(np.fft.irfft2(spectrum**2, size))
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    inside = (np.abs(x - (columns - 1)) < 0.6 * columns) & (np.abs(y - (rows - 1)) < 0.6 * rows)
    row, column = np.unravel_index(int(np.where(inside, score, -1.0).argmax()), score.shape)
    return float(column) / 2.0, float(row) / 2.0


def count_sectors(pixels: StarPixels, radii: tuple[float, float], what: str) -> int:
    """Number of bright sectors: the strongest wave around the outer rings."""
    values, angle = pixels.between((radii[0] + radii[1]) / 2.0, radii[1])
    count = 1 << int(np.ceil(np.log2(max(2.0 * pi * radii[1], 64.0))))
    place = np.clip(((angle + pi) / (2.0 * pi) * count).astype(int), 0, count - 1)
    number = np.maximum(np.bincount(place, minlength=count), 1)
    profile = np.bincount(place, values - values.mean(), count) / number
    power = np.abs(np.fft.rfft(profile)) ** 2
    most = min(SECTORS[1], count // 2 - 1, int(pi * radii[1]))
    if most <= SECTORS[0]:
        raise InputError(f"{what}: the star is too small, its radius is {radii[1]:.0f} pixels")
    band = power[SECTORS[0] : most + 1]
    best = int(band.argmax()) + SECTORS[0]
    rest = float(np.median(power[2 : most + 1])) / np.log(2.0)
    if power[best] < (np.log(count) + 12.0) * rest or power[best] < 0.25 * float(power[2:].sum()):
        raise InputError(
            f"{what}: no star is found about column {pixels.centre[0]:.1f}, row {pixels.centre[1]:.1f}; choose a "
            "window with the star in its middle"
        )
    return best


def find_centre(
    pixels: StarPixels, radii: tuple[float, float], sectors: int, what: str
) -> tuple[StarPixels, tuple[float, float]]:
    """The centre to a fraction of a pixel, and its standard deviations in column and row.

    About a wrong centre the phase of a ring's wave changes with the direction, by the number of sectors times the part
    of the shift across the direction through the radius. The shifts follow from all parts of all rings at once.
    """
    sigma = (np.inf, np.inf)
    for step in range(30):
        rows, phases = _parts(pixels, radii, sectors)
        solution, covariance = _shift(rows, phases)
        long = hypot(*solution)
        limit = 0.25 * 2.0 * pi * radii[0] / sectors + 0.25
        factor = min(1.0, limit / long) if long else 1.0
        pixels = pixels.about((pixels.centre[0] + factor * solution[0], pixels.centre[1] + factor * solution[1]))
        variance = np.diag(covariance)
        sigma = tuple(np.sqrt(np.where(variance >= 0.0, variance, np.inf)).tolist())
        if long < 1e-4 and step > 1:
            break
    if not (np.isfinite(sigma).all() and max(sigma) < 1.0):
        raise InputError(f"{what}: the centre of the star does not settle; choose a window with the star in its middle")
    return pixels, sigma


def _parts(pixels: StarPixels, radii: tuple[float, float], sectors: int) -> tuple[Array, NDArray[np.complex128]]:
    """Complex amplitudes of eight parts of six rings; rows of the shift's equations: column, row, ring."""
    edges, rings = np.linspace(-pi, pi, 9), np.linspace(*radii, 7)
    rows, found = [], []
    for k, (inner, outer) in enumerate(pairwise(rings)):
        values, angle = pixels.between(inner, outer)
        middle = sectors / float(np.sqrt(inner * outer))
        for low, high in pairwise(edges):
            part = (angle >= low) & (angle < high)
            if part.sum() < 12:
                continue
            direction, light = angle[part], values[part]
            row = np.zeros(8)
            row[:2] = middle * np.sin(direction).mean(), -middle * np.cos(direction).mean()
            row[2 + k] = 1.0
            rows.append(row)
            found.append(complex(((light - light.mean()) * np.exp(-1j * sectors * direction)).mean()))
    return np.array(rows).reshape(-1, 8), np.array(found, complex)


def _shift(rows: Array, found: NDArray[np.complex128]) -> tuple[tuple[float, float], Array]:
    """Shift of the centre and its covariance from the phases of all parts, relative to each ring's mean phase."""
    turned = np.zeros(found.size)
    for k in range(2, 8):
        members = rows[:, k] > 0.0
        if members.any():
            turned[members] = np.angle(found[members] * np.conj(found[members].sum()))
    used = rows[:, [True, True, *(rows[:, 2:].sum(axis=0) > 0)]]
    root = np.sqrt(np.abs(found))[:, None]
    solution, covariance, _ = least_squares(used * root, turned * root[:, 0])
    return (float(solution[0]), float(solution[1])), covariance[:2, :2]
