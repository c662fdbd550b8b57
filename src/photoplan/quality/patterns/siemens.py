"""Siemens stars."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import degrees, hypot, pi
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import with_sigma
from photoplan.quality.mtf_curve import MtfCurve
from photoplan.quality.patterns.bars import least_squares, pattern_window, waves, white_noise

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
    """Covariances of cosine and sine, (2, 2)."""
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


#: Side of the largest window, pixels: all of its pixels are fitted at once.
_MOST_SIDE = 4096


@dataclass(frozen=True)
class StarRules:
    """Rules of measuring a star."""

    sectors: int | None = None
    """Bright sectors, to be confirmed; None: as counted."""
    wave: Literal["square", "sine"] | None = None
    """Sharp sectors, or light that changes as a sine; None: told apart by the third harmonic wave."""
    levels: tuple[float, float] | None = None
    """Light of wide dark and bright areas; None: from the middle of the widest sectors."""
    centre: tuple[float, float] | None = None
    """Column and row of the centre, to a few pixels; None: found."""
    radius: float | None = None
    """Outer radius; None: as far as the star reaches."""
    directions: int = 8
    """Directions of the frequency that are measured apart, over half a turn."""
    highest: float = 0.6
    """Frequency up to which is measured, cycles per pixel."""

    def __post_init__(self) -> None:
        if self.sectors is not None and not SECTORS[0] <= self.sectors <= SECTORS[1]:
            raise InputError(f"a star with {self.sectors} sectors; {SECTORS[0]} to {SECTORS[1]} are allowed")
        if not 1 <= self.directions <= 36:
            raise InputError(f"{self.directions} directions; 1 to 36 are allowed")
        if not 0.0 < self.highest <= 1.0:
            raise InputError(f"a highest frequency of {self.highest:g} cycles per pixel; it is at most 1")
        if self.radius is not None and not self.radius > 0.0:
            raise InputError(f"a radius of {self.radius:g} pixels; it is positive")
        if self.levels is not None and not 0.0 <= self.levels[0] < self.levels[1] < np.inf:
            raise InputError(f"levels of {self.levels[0]:g} and {self.levels[1]:g}; the first is the lower one")


@dataclass(frozen=True, eq=False)
class StarMtf:
    """Result of an image of a Siemens star."""

    centre: tuple[float, float]
    """Column and row in the window."""
    centre_sigma: tuple[float, float]
    sectors: int
    wave: Literal["square", "sine"]
    low: float
    """Light of dark sectors where they are wide."""
    high: float
    """Light of bright sectors where they are wide."""
    levels_from: str
    radii: tuple[float, float]
    """Inner and outer radius that were measured, pixels."""
    mtf: MtfCurve
    """Curve of whole rings: the mean over all directions."""
    directional: dict[float, MtfCurve]
    """By direction of the frequency, degrees from the columns' direction towards increasing rows, 0 to 180. A star's
    sectors at an angle hold frequencies across it."""


def measure_star(
    light: NDArray[np.floating],
    rules: StarRules | None = None,
    *,
    clipped: NDArray[np.bool_] | None = None,
    what: str = "star",
) -> StarMtf:
    """Modulation transfer of a window with a Siemens star.

    Parameters
    ----------
    light : ndarray
        Shape (rows, columns), proportional to light.
    clipped : ndarray, optional
        True where a pixel is cut off at an end of its range, same shape.
    what : str
        Names the window in messages.

    Raises
    ------
    InputError
        No star, too few pixels or sectors, clipped pixels, or an unknown contrast of the object.
    """
    rules = rules or StarRules()
    values = pattern_window(light, clipped, what, 32, _MOST_SIDE)
    centre = rules.centre or rough_centre(values)
    outer = _outer(values, centre, rules, what)
    pixels = StarPixels.of(values, centre)
    sectors = count_sectors(pixels, (0.3 * outer, outer), what)
    if rules.sectors not in (None, sectors):
        raise InputError(f"{what}: {rules.sectors} bright sectors are stated, but {sectors} are counted")
    inner = max(sectors / (2.0 * pi * rules.highest), 4.0)
    if outer < 2.0 * inner:
        raise InputError(
            f"{what}: {sectors} sectors within a radius of {outer:.0f} pixels; the finest that can be measured have a "
            f"radius of {inner:.0f}, and the star has to be twice as large at least"
        )
    pixels, sigma = find_centre(pixels, (max(0.35 * outer, inner), outer), sectors, what)
    outer = rules.radius or _extent(pixels, sectors, outer)
    rings = [fit_ring(*pixels.between(r - w, r + w), r, sectors, whole=True) for r, w in _radii(inner, outer)]
    _refuse_weak(rings, white_noise(values), what)
    wave = rules.wave or _wave(rings)
    low, high, uncertain, source = _levels(pixels, rings, rules.levels, wave, sectors, outer, what)
    full = (high - low) / 2.0 * (4.0 / pi if wave == "square" else 1.0) / ((high + low) / 2.0)
    directional = {}
    for k in range(rules.directions):
        parts = [_direction(pixels, r, w, k, rules.directions, sectors) for r, w in _radii(inner, outer, 1.25)]
        kept = [ring for ring in parts if ring is not None]
        if len(kept) >= 2:
            directional[degrees(pi * k / rules.directions)] = _curve(kept, sectors, (full, uncertain))
    return StarMtf(
        centre=pixels.centre,
        centre_sigma=sigma,
        sectors=sectors,
        wave=wave,
        low=low,
        high=high,
        levels_from=source,
        radii=(inner, outer),
        mtf=_curve(rings, sectors, (full, uncertain)),
        directional=directional,
    )


def _outer(values: Array, centre: tuple[float, float], rules: StarRules, what: str) -> float:
    """Radius of the largest circle about the centre that the window holds."""
    rows, columns = values.shape
    if not (0 <= centre[0] <= columns - 1 and 0 <= centre[1] <= rows - 1):
        raise InputError(f"{what}: the centre {centre[0]:.1f}, {centre[1]:.1f} is outside of the window")
    room = min(centre[0], centre[1], columns - 1 - centre[0], rows - 1 - centre[1])
    if rules.radius is not None and rules.radius > room:
        raise InputError(f"{what}: a radius of {rules.radius:.1f} pixels leaves the window; {room:.1f} is the largest")
    if room < 12.0:
        raise InputError(f"{what}: no star is found; its centre seems to be {room:.0f} pixels from the window's border")
    return rules.radius or room


def _extent(pixels: StarPixels, sectors: int, outer: float) -> float:
    """Radius up to which the wave goes on: the outermost ring that keeps 90 % of the strongest wave, and a margin."""
    step = max(1.5, outer / 200.0)
    radii = np.arange(outer / 3.0, outer - 1.0, step)
    rings = [fit_ring(*pixels.between(r - step, r + step), r, sectors, whole=True) for r in radii]
    if not rings:
        return outer
    amplitude = np.array([ring.amplitude for ring in rings])
    reach = float(rings[int(np.flatnonzero(amplitude >= 0.9 * amplitude.max())[-1])].radius)
    return outer if reach >= outer - 3.0 else reach - 3.0


def _radii(inner: float, outer: float, least: float = 0.75) -> list[tuple[float, float]]:
    """Radii of rings and half their widths: 3 % of the radius, and `least` pixels at least."""
    radii: list[tuple[float, float]] = []
    r = outer - 1.0
    while r > inner and len(radii) < 400:
        half = float(np.clip(0.03 * r, least, 6.0))
        radii.append((r - half, half))
        r -= 2.0 * half
    return radii[:-1] if len(radii) > 1 and radii[-1][0] < inner else radii


def _direction(pixels: StarPixels, radius: float, half: float, k: int, count: int, sectors: int) -> StarRing | None:
    """The wave of both opposite parts of a ring whose frequency has the k-th direction; None: too few pixels."""
    values, angle = pixels.between(radius - half, radius + half)
    # Across the sectors: a quarter turn from the direction in which they lie.
    away = (angle + pi / 2.0 - pi * k / count + pi / 2.0) % pi - pi / 2.0
    reach = max(pi / count / 2.0, 1.5 * pi / sectors)
    part = np.abs(away) <= reach
    if reach > pi / 4.0 or part.sum() < 20:
        return None
    try:
        ring = fit_ring(values[part], angle[part], radius, sectors, whole=False)
    except InputError:
        return None
    return ring if np.isfinite(ring.sigma) and ring.mean > 0.0 else None


def _refuse_weak(rings: list[StarRing], noise: float, what: str) -> None:
    """Refuse what is no star: weak waves, or other structure on the rings."""
    if len(rings) < 3:
        raise InputError(f"{what}: only {len(rings)} rings can be measured; the star is too small")
    if min(ring.mean for ring in rings) <= 0.0:
        raise InputError(f"{what}: the mean light of a ring is not positive; is the dark level subtracted twice?")
    widest = rings[0]
    strongest = max(ring.amplitude for ring in rings)
    if strongest < 5.0 * widest.sigma or strongest == 0.0:
        raise InputError(f"{what}: the star is below the noise (amplitude {with_sigma(strongest, widest.sigma)})")
    rest = float(np.median([ring.residual for ring in rings[: max(3, len(rings) // 2)]]))
    if rest**2 > (1.5 * noise) ** 2 + (0.35 * strongest) ** 2:
        raise InputError(
            f"{what}: more than a star is in the window (rest {rest:.3g} beside waves of {strongest:.3g}); no MTF"
        )


def _wave(rings: list[StarRing]) -> Literal["square", "sine"]:
    """A third harmonic wave of more than a tenth of the fundamental one comes from sharp sectors."""
    widest = rings[0]
    third = 0.0 if widest.third is None else float(np.hypot(*widest.third))
    return "square" if third > 0.1 * widest.amplitude else "sine"


def _levels(
    pixels: StarPixels,
    rings: list[StarRing],
    levels: tuple[float, float] | None,
    wave: str,
    sectors: int,
    outer: float,
    what: str,
) -> tuple[float, float, float, str]:
    """Light of wide dark and bright areas, and the relative standard deviation of their difference."""
    if levels is not None:
        return levels[0], levels[1], 0.0, "as given"
    widest = rings[0]
    if wave == "sine":
        # Next to frequency 0 the transfer falls with the square of the frequency.
        squares = np.array([(sectors / (2.0 * pi * ring.radius)) ** 2 for ring in rings[:8]])
        share = np.array([ring.amplitude / ring.mean for ring in rings[:8]])
        line = np.stack([np.ones_like(squares), squares], axis=1)
        to_top = np.linalg.pinv(line)[0]
        top = float(to_top @ share) * widest.mean
        error = float(np.hypot.reduce(to_top * [ring.sigma / ring.mean for ring in rings[:8]])) * widest.mean
        return widest.mean - top, widest.mean + top, error / top, "widest sectors, continued to frequency 0"
    values, angle = pixels.between(0.87 * outer, 0.99 * outer)
    turn = (sectors * angle - np.arctan2(widest.sine, widest.cosine)) / (2.0 * pi)
    found = []
    for middle in (0.5, 0.0):
        away = np.abs((turn - middle + 0.5) % 1.0 - 0.5)
        inside, beside = values[away <= 0.07], values[(away > 0.07) & (away <= 0.12)]
        if min(inside.size, beside.size) < 12:
            raise InputError(f"{what}: the widest sectors hold too few pixels; give the light of dark and bright areas")
        found.append((float(inside.mean()), float(beside.mean()), float(inside.std() / np.sqrt(inside.size))))
    (low, low_beside, low_sigma), (high, high_beside, high_sigma) = found
    bend = max(low_beside - low, high - high_beside)
    if bend > 0.01 * (high - low) + 4.0 * max(low_sigma, high_sigma):
        raise InputError(
            f"{what}: even the widest sectors, {2 * pi * outer / sectors:.1f} pixels a period, have no flat middle, so "
            "that the object's contrast is unknown; give the light of wide dark and bright areas"
        )
    uncertain = float(np.hypot(low_sigma, high_sigma)) / (high - low)
    return low, high, uncertain, f"middle of the widest sectors, {2 * pi * outer / sectors:.1f} pixels a period"


def _curve(rings: list[StarRing], sectors: int, object_wave: tuple[float, float]) -> MtfCurve:
    """Rings as a curve; each ring's wave through its mean, against that of the object and its relative error."""
    full, uncertain = object_wave
    frequency = np.array([sectors / (2.0 * pi * ring.radius) for ring in rings])
    modulation = np.array([ring.amplitude / ring.mean / full for ring in rings])
    sigma = np.hypot([ring.sigma / ring.mean / full for ring in rings], modulation * uncertain)
    return MtfCurve.from_zero(frequency, modulation, sigma)
