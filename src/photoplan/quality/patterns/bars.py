"""Contrast and MTF from bar patterns and Siemens stars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import atan2, degrees, hypot, log, pi, sin, sqrt
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.least_squares import solve
from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError
from photoplan.findings import with_sigma
from photoplan.quality.curves import MtfCurve

#: Share of clipped pixels from which on a pattern is refused.
MOST_CLIPPED = 0.005
#: Side of the largest window that is measured at once.
MOST_SIDE = 8192


def clipped_pixels(stored: NDArray[Any]) -> Mask:
    """Pixels that are cut off at an end of the range, same shape.

    They are at a limit of an integer type; or they all have the highest (lowest) value, one in a hundred of them or
    more, while the other end of the range shows noise. Noise-free drawings are not clipped.
    """
    clipped = np.zeros(stored.shape, bool)
    if stored.size == 0:
        return clipped
    if np.issubdtype(stored.dtype, np.integer):
        limits = np.iinfo(stored.dtype)
        clipped |= (stored == limits.max) | (stored == limits.min)
    low, high = float(np.nanmin(stored)), float(np.nanmax(stored))
    at_low, at_high = stored == low, stored == high
    few, many = 0.002, 0.01
    if at_high.mean() >= many and at_low.mean() < few and _heaped(stored, high, -1, at_high):
        clipped |= at_high
    if at_low.mean() >= many and at_high.mean() < few and _heaped(stored, low, 1, at_low):
        clipped |= at_low
    return clipped


def _heaped(stored: NDArray[Any], end: float, step: int, at_end: Mask) -> bool:
    """An end of integers is cut off if it holds far more pixels than the value beside it: noise rounds to both."""
    return not np.issubdtype(stored.dtype, np.integer) or at_end.sum() >= 4 * (stored == end + step).sum()


def pattern_window(
    light: NDArray[Any], clipped: Mask | None, what: str, least: int = 12, most: int = MOST_SIDE
) -> Floats:
    """The window of a pattern as float64, checked."""
    values = np.asarray(light, np.float64)
    if values.ndim != 2 or min(values.shape, default=0) < least:
        size = " × ".join(map(str, values.shape[::-1]))
        raise InputError(f"{what}: a window of {size} pixels; at least {least} × {least} are needed")
    if max(values.shape) > most:
        raise InputError(
            f"{what}: a window of {values.shape[1]} × {values.shape[0]} pixels; at most {most} a side, give the part "
            "with the pattern"
        )
    missing = int(values.size - np.isfinite(values).sum())
    if missing:
        raise InputError(f"{what}: {missing} of its pixels have no value; choose a window without gaps")
    if clipped is not None and clipped.mean() > MOST_CLIPPED:
        raise InputError(
            f"{what}: {100 * clipped.mean():.1f} % of its pixels are saturated or clipped; their contrast is unknown, "
            "expose shorter"
        )
    if float(np.ptp(values)) == 0.0:
        raise InputError(f"{what}: all pixels have the value {values.flat[0]:g}; there is no pattern")
    return values


def white_noise(values: Floats) -> float:
    """Standard deviation of uncorrelated noise of a picture without its structure.

    The second mixed difference takes planes and slow structure away; Immerkær 1996, "Fast noise variance estimation".
    """
    rows = values[:-2] - 2.0 * values[1:-1] + values[2:]
    both = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    return float(np.sqrt((both**2).mean())) / 6.0


def waves(turn: ArrayLike, harmonics: Sequence[int]) -> Floats:
    """Cosine and sine of each harmonic wave, shape (…, 2 · harmonics), at phases of shape (…) in periods."""
    angle = 2.0 * pi * np.multiply.outer(turn, np.asarray(harmonics, float))
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).reshape(*angle.shape[:-1], -1)


def least_squares(columns: Floats, values: Floats) -> tuple[Floats, Floats, Floats]:
    """Solution, its covariance, and residuals (observed minus computed) of an overdetermined linear system."""
    fit = solve(columns, values)
    if fit.rank < columns.shape[1]:
        raise InputError("the pixels do not determine the pattern: too few of its bars are in the window")
    return fit.unknowns, fit.covariance, -fit.residuals


#: Periods of the pattern that a window has to hold.
LEAST_PERIODS = 2.5
#: Standard deviations by which a wave stands out of the noise.
LEAST_SIGNIFICANCE = 5.0
#: A level is the top of a parabola over so many periods to each side of a bar's middle.
_REACH = 0.125
#: Side of the part of a window that is used, pixels.
_MOST = 1024
#: Harmonic waves of bars that are fitted beside the fundamental one.
_HARMONICS = (2, 3, 4, 5, 6, 7, 9, 11)
#: Beyond it, in cycles per pixel, lenses and pixels leave nothing of a harmonic wave.
_HIGHEST = 1.6


@dataclass(frozen=True)
class BarContrast:
    """One frequency group of a bar pattern."""

    frequency: float
    """Cycles per pixel across the bars."""
    angle_deg: float
    """Direction across the bars, from the columns' direction towards increasing rows, 0 to 180."""
    phase: float
    """Position of the middle of a bright bar from the window's middle along that direction, periods, -0.5 to 0.5."""
    duty: float
    """Share of a period that is bright, from the mean between the levels; narrow bars seem nearer to a half."""
    periods: float
    """Periods across the window."""
    low: float
    """Grey value in the middle of dark bars."""
    high: float
    """Grey value in the middle of bright bars."""
    mean: float
    """Mean grey value of a period."""
    modulation: float
    """(high - low) / (high + low), Behr 1989, §3.6.7."""
    modulation_sigma: float
    fundamental: float
    """Amplitude of the fundamental wave through the mean."""
    fundamental_sigma: float
    bend: float
    """By how much of the contrast a bar's middle stands out over the place an eighth of a period away: 0 for bars with
    a flat middle, 0.15 for a sine wave."""
    aligned: bool
    """The bars meet the pixels at few phases, so that harmonic waves cannot be told from the fundamental one; the
    standard deviations hold what they may add."""


def measure_bars(light: NDArray[np.floating], *, clipped: Mask | None = None, what: str = "bars") -> BarContrast:
    """Frequency, direction, phase, duty and modulation of a window with parallel bars.

    Parameters
    ----------
    light : ndarray
        Shape (rows, columns), proportional to light; only bars. Of larger windows the middle 1024 pixels are used.
    clipped : ndarray, optional
        True where a pixel is cut off at an end of its range, same shape.
    what : str
        Names the window in messages.

    Raises
    ------
    InputError
        No bars, bars and other structure, too few bars, bars below the noise, clipped pixels.
    """
    values = _middle_part(pattern_window(light, clipped, what))
    wave = find_wave(values, what)
    phase = wave.phases(values.shape)
    periods = float(np.ptp(phase))
    if periods < LEAST_PERIODS:
        raise InputError(f"{what}: {periods:.1f} periods of bars in the window; at least {LEAST_PERIODS} are needed")
    flat, solution, covariance, residuals, hidden = _fit(values, phase, wave)
    a, b = float(solution[3]), float(solution[4])
    amplitude = hypot(a, b)
    along = np.array([a, b]) / amplitude
    sigma = sqrt(float(along @ covariance[3:5, 3:5] @ along))
    noise = white_noise(residuals.reshape(values.shape))
    if amplitude < LEAST_SIGNIFICANCE * max(sigma, noise * sqrt(2.0 / values.size)):
        raise InputError(f"{what}: the bars are below the noise (amplitude {with_sigma(amplitude, sigma)})")
    rest = float(np.sqrt((residuals**2).mean()))
    if rest**2 > 2.0 * noise**2 + (0.12 * amplitude) ** 2:
        raise InputError(
            f"{what}: more than bars of one frequency is in the window (rest {rest:.3g} beside bars of {amplitude:.3g} "
            f"and noise of {noise:.3g}); choose a window inside the bars"
        )
    turn = phase - atan2(b, a) / (2.0 * pi)
    turn -= np.round(turn)
    mean = float(solution[0])
    low, high, levels_sigma, bend = _levels(flat, turn, solution, (1, *wave.harmonics(values.shape)[0]))
    contrast = high - low
    if contrast <= 0.0 or high + low <= 0.0:
        raise InputError(f"{what}: bars of {high:.4g} on {low:.4g}; their light is positive")
    alias = _alias(hidden, amplitude)
    return BarContrast(
        frequency=wave.frequency,
        angle_deg=degrees(atan2(wave.fy, wave.fx)) % 180.0,
        phase=_middle(wave, atan2(b, a) / (2.0 * pi)),
        duty=(mean - low) / contrast,
        periods=periods,
        low=low,
        high=high,
        mean=mean,
        modulation=contrast / (high + low),
        modulation_sigma=hypot(levels_sigma, 2.0 * alias) / (high + low),
        fundamental=amplitude / mean,
        fundamental_sigma=hypot(sigma, alias) / mean,
        bend=bend / contrast,
        aligned=bool(hidden),
    )


def _middle_part(values: Floats) -> Floats:
    """The middle of a large window: more pixels than these add nothing but time."""
    rows, columns = (slice(max(0, (n - _MOST) // 2), max(0, (n - _MOST) // 2) + _MOST) for n in values.shape)
    return values[rows, columns]


def _fit(values: Floats, phase: Floats, wave: BarWave) -> tuple[Floats, Floats, Floats, Floats, tuple[int, ...]]:
    """Values with a uniform mean level, solution, covariance and residuals of the wave, harmonics that are hidden.

    Illumination acts as a factor: the plane of the mean level is divided out.
    """
    harmonics, hidden = wave.harmonics(values.shape)
    columns = wave_columns(values.shape, phase, (1, *harmonics))
    solution, _, _ = least_squares(columns, values.ravel())
    plane = (columns[:, :3] @ solution[:3]).reshape(values.shape)
    if plane.min() <= 0.0:
        raise InputError(
            f"the mean level of the bars falls to {plane.min():.3g}; modulation needs positive light: is the dark "
            "level subtracted twice, or the window larger than the pattern?"
        )
    flat = values / plane * float(plane.mean())
    solution, covariance, residuals = least_squares(columns, flat.ravel())
    return flat, solution, covariance, residuals, hidden


def _levels(
    flat: Floats, turn: Floats, solution: Floats, harmonics: tuple[int, ...]
) -> tuple[float, float, float, float]:
    """Levels of dark and bright bars in their middle, the standard deviation of their difference, and their bend."""
    found = []
    start = atan2(float(solution[4]), float(solution[3]))
    for middle in (0.5, 0.0):
        away = turn - middle
        away -= np.round(away)
        near = np.abs(away) <= _REACH
        x, y = away[near], flat[near]
        if np.unique(np.floor((x / _REACH + 1.0) * 5.999)).size < 7:
            found.append(_few_level(x, middle + start / (2.0 * pi), solution, harmonics))
            continue
        columns = np.stack([np.ones_like(x), x**2], axis=1)
        keep = np.ones(x.size, bool)
        for _ in range(2):
            top, covariance, _ = least_squares(columns[keep], y[keep])
            rest = y - columns @ top
            keep = np.abs(rest) <= 4.0 * max(float(np.sqrt((rest[keep] ** 2).mean())), 1e-12 * abs(float(top[0])))
        found.append((float(top[0]), sqrt(float(covariance[0, 0])), float(top[1]) * _REACH**2))
    (low, low_sigma, low_bend), (high, high_sigma, high_bend) = found
    return low, high, hypot(low_sigma, high_sigma), (low_bend - high_bend) / 2.0


def _few_level(x: Floats, phase: float, solution: Floats, harmonics: tuple[int, ...]) -> tuple[float, float, float]:
    """Level of bars that meet the pixels at few phases: what the waves add up to; its deviation from the pixels there
    as standard deviation; and the bend of the waves."""

    def at(turn: float | Floats) -> Floats:
        return np.asarray(solution[0] + waves(turn, harmonics) @ solution[3:])

    level = float(at(phase))
    beside = float(at(phase - _REACH) + at(phase + _REACH)) / 2.0
    if x.size == 0:
        return level, abs(level - beside), beside - level
    return level, abs(float(at(phase + x[:200]).mean()) - level) / 2.0, beside - level


def _alias(hidden: tuple[int, ...], amplitude: float) -> float:
    """Return what hidden waves may add to the amplitude: those of a square wave, blurred as a Gaussian blurs.

    A Gaussian that leaves the share m of the fundamental wave leaves m to the power k² of the k-th one. m is not
    known here; it is at most 1, and 0.5 is taken: bars so fine that harmonics hide are seldom transferred better.
    """
    return sum(amplitude * 0.5 ** (k * k - 1) / k for k in hidden)


def _middle(wave: BarWave, turn: float) -> float:
    """Phase of the middle of a bright bar; the direction is turned so that it points to increasing rows or columns."""
    sense = 1.0 if degrees(atan2(wave.fy, wave.fx)) % 360.0 < 180.0 else -1.0
    return float((sense * turn + 0.5) % 1.0 - 0.5)


def fundamental_of_square(duty: float) -> float:
    """Amplitude of the fundamental wave of bars with levels 0 and 1, of which the share `duty` is bright."""
    return 2.0 / pi * sin(pi * duty)


@dataclass(frozen=True)
class BarWave:
    """Frequency vector of parallel bars."""

    fx: float
    """Cycles per pixel along the columns' direction."""
    fy: float
    """Cycles per pixel along the rows' direction."""

    @property
    def frequency(self) -> float:
        """Cycles per pixel across the bars."""
        return hypot(self.fx, self.fy)

    def phases(self, shape: tuple[int, ...]) -> Floats:
        """Periods from the middle of a window, shape (rows, columns)."""
        x = np.arange(shape[1]) - (shape[1] - 1) / 2.0
        y = np.arange(shape[0]) - (shape[0] - 1) / 2.0
        return np.asarray(self.fx * x[None, :] + self.fy * y[:, None])

    def harmonics(self, shape: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Harmonic waves that the pixels tell apart from each other, and those hidden behind the fundamental one.

        On pixels a wave looks like all others whose frequencies differ by whole numbers; two are told apart if they
        differ by more than a period over the window.
        """
        least = np.array([1.0 / shape[1], 1.0 / shape[0]])
        taken = [np.array([0.0, 0.0]), *_both(np.array([self.fx, self.fy]))]
        kept: list[int] = []
        hidden: list[int] = []
        for k in _HARMONICS:
            if k * self.frequency > _HIGHEST:
                break
            wave = np.array([k * self.fx, k * self.fy])
            near = [bool((np.abs(_wrapped(wave - other)) < least).all()) for other in taken]
            if any(near[1:3]):
                hidden.append(k)
            if not any(near) and not (np.abs(_wrapped(2 * wave)) < least).all():
                kept.append(k)
                taken += _both(wave)
        return tuple(kept), tuple(hidden)


def _both(wave: Floats) -> list[Floats]:
    return [wave, -wave]


def _wrapped(wave: Floats) -> Floats:
    return np.asarray(wave - np.round(wave))


def wave_columns(shape: tuple[int, ...], phase: Floats, harmonics: tuple[int, ...]) -> Floats:
    """Columns of the linear model: level, its slopes in x and y, and cosine and sine of each harmonic wave.

    The phase is in periods, one for each pixel of a window of this shape; a row of the result is a pixel.
    """
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    x, y = x / max(shape[1] - 1, 1) - 0.5, y / max(shape[0] - 1, 1) - 0.5
    plane = np.stack([np.ones(phase.size), x.ravel(), y.ravel()], axis=1)
    return np.hstack([plane, waves(phase.ravel(), harmonics)])


def find_wave(values: Floats, what: str) -> BarWave:
    """The strongest plane wave of a window."""
    rows, columns = values.shape
    flat = values - values.mean()
    plane = wave_columns(values.shape, np.zeros(values.size), ())
    _, _, residuals = least_squares(plane, flat.ravel())
    taper = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(columns + 2)[1:-1])
    size = (2 * rows, 2 * columns)
    power = np.abs(np.fft.rfft2(residuals.reshape(values.shape) * taper, size)) ** 2
    fy, fx = np.fft.fftfreq(size[0])[:, None], np.fft.rfftfreq(size[1])[None, :]
    # Below, a wave has less than a period and a half across the window: slow changes of light look alike.
    slow = np.hypot(fx * columns, fy * rows) < 1.5
    power[slow] = 0.0
    top = int(power.argmax())
    level = float(np.median(power[~slow])) / log(2.0)
    if power.flat[top] < (log(power.size) + 12.0) * level or power.flat[top] == 0.0:
        raise InputError(f"{what}: no bars are found; nothing periodic stands out of the window")
    row, column = np.unravel_index(top, power.shape)
    return _refined(residuals.reshape(values.shape), BarWave(float(fx[0, column]), float(fy[row, 0])))


def _refined(values: Floats, wave: BarWave) -> BarWave:
    """Frequencies by least squares, from a start that is right within half a period over the window."""
    y, x = np.mgrid[0 : values.shape[0], 0 : values.shape[1]]
    x = (x - (values.shape[1] - 1) / 2.0).ravel()
    y = (y - (values.shape[0] - 1) / 2.0).ravel()
    for k in range(16):
        harmonics = np.array((1,) if k < 4 else (1, *wave.harmonics(values.shape)[0]))
        columns = wave_columns(values.shape, wave.phases(values.shape), tuple(harmonics))
        solution, _, _ = least_squares(columns, values.ravel())
        a, b = 2.0 * pi * harmonics * solution[3::2], 2.0 * pi * harmonics * solution[4::2]
        slope = columns[:, 3::2] @ b - columns[:, 4::2] @ a
        solution, _, _ = least_squares(
            np.concatenate([columns, (slope * x)[:, None], (slope * y)[:, None]], axis=1), values.ravel()
        )
        dx, dy = (float(np.clip(d, -0.5 / n, 0.5 / n)) for d, n in zip(solution[-2:], values.shape[::-1]))
        wave = BarWave(wave.fx + dx, wave.fy + dy)
        if k > 4 and abs(dx) * values.shape[1] + abs(dy) * values.shape[0] < 1e-6:
            break
    return wave


#: Bars with less bend than this have a flat middle, where their levels are those of wide areas.
FLAT = 0.02
#: With less bend the duty can be read from the profile.
_SHARP = 0.05


@dataclass(frozen=True, eq=False)
class BarCurve:
    """Transfer of bars against frequency."""

    groups: tuple[BarContrast, ...]
    """By increasing frequency."""
    low: float
    """Light of wide dark areas."""
    high: float
    """Light of wide bright areas."""
    levels_from: str
    """Source of these levels, in words."""
    contrast: MtfCurve
    """Contrast transfer of square waves (CTF), from the extremes; not an MTF."""
    mtf: MtfCurve
    """Modulation transfer, from the fundamental waves."""


def bar_curve(groups: Sequence[BarContrast], levels: tuple[float, float] | None = None) -> BarCurve:
    """Contrast transfer and MTF of frequency groups."""
    if not groups:
        raise InputError("no group of bars is given")
    ordered = tuple(sorted(groups, key=lambda group: group.frequency))
    frequency = np.array([group.frequency for group in ordered])
    close = np.flatnonzero(np.diff(frequency) <= 1e-9)
    if close.size:
        raise InputError(f"two groups of bars have the frequency {frequency[close[0]]:.4g} cycles per pixel; keep one")
    low, high, source = _levels_bar_curve(ordered, levels)
    modulation = (high - low) / (high + low)
    # An object's contrast that is measured itself is as uncertain as the widest bars, and all figures with it.
    own = 0.0 if levels is not None else ordered[0].modulation_sigma / ordered[0].modulation
    contrast = np.array([group.modulation / modulation for group in ordered])
    contrast_sigma = np.array([group.modulation_sigma / modulation for group in ordered])
    contrast_sigma[1:] = np.hypot(contrast_sigma[1:], contrast[1:] * own)
    duties, duty_sigma = _duties(ordered, low, high)
    share = np.array([_fundamental(duty, low, high) for duty in duties])
    transfer = np.array([group.fundamental for group in ordered]) / share
    transfer_sigma = np.array([group.fundamental_sigma for group in ordered]) / share
    transfer_sigma = np.sqrt(transfer_sigma**2 + transfer**2 * (duty_sigma**2 + own**2))
    return BarCurve(
        groups=ordered,
        low=low,
        high=high,
        levels_from=source,
        contrast=MtfCurve.from_zero(frequency, contrast, contrast_sigma),
        mtf=MtfCurve.from_zero(frequency, transfer, transfer_sigma),
    )


def _levels_bar_curve(groups: Sequence[BarContrast], levels: tuple[float, float] | None) -> tuple[float, float, str]:
    if levels is not None:
        if not 0.0 <= levels[0] < levels[1] < np.inf:
            raise InputError(f"levels of {levels[0]:g} and {levels[1]:g}; the first is the lower one and not negative")
        return levels[0], levels[1], "as given"
    widest = groups[0]
    if widest.bend > FLAT:
        raise InputError(
            f"the widest bars, {1 / widest.frequency:.1f} pixels a period, have no flat middle (bend "
            f"{widest.bend:.3f}, at most {FLAT}), so that the object's contrast is unknown; add wider bars or give the "
            "grey values of wide dark and bright areas"
        )
    return widest.low, widest.high, f"widest bars, {1 / widest.frequency:.1f} pixels a period"


def _duties(groups: Sequence[BarContrast], low: float, high: float) -> tuple[list[float], float]:
    """Duty of each group, and the relative standard deviation of the fundamental wave that its error makes.

    Blur moves the duty of narrow bars towards a half: theirs is that of the widest group, if that is sharp, and else
    follows from the mean level.
    """
    sharp = [group.duty for group in groups if group.bend < _SHARP and not group.aligned]
    if sharp:
        return [g.duty if g.bend < _SHARP and not g.aligned else sharp[0] for g in groups], 0.002
    means = [(group.mean - low) / (high - low) for group in groups]
    return [min(max(mean, 0.2), 0.8) for mean in means], 0.01


def _fundamental(duty: float, low: float, high: float) -> float:
    """Fundamental wave through the mean of bars of these levels."""
    return (high - low) * fundamental_of_square(duty) / (low + duty * (high - low))


def coltman_factor(k: int) -> float:
    """Factor of the contrast at k times the frequency in Coltman's series; 0 for even k and those with a square.

    J. W. Coltman, "The specification of imaging properties by response to a sine wave input", Journal of the Optical
    Society of America 44 (1954) 468–471.
    """
    if k % 2 == 0:
        return 0.0
    primes = [p for p in range(3, k + 1, 2) if k % p == 0 and all(p % q for q in range(3, p, 2))]
    if any(k % (p * p) == 0 for p in primes):
        return 0.0
    return float((-1.0) ** len(primes) * (-1.0) ** ((k - 1) // 2) / k)


def coltman_mtf(contrast: MtfCurve) -> MtfCurve:
    """MTF from a contrast transfer function of square waves with equal bars, by Coltman's series.

    MTF(f) = π/4 [C(f) + C(3f)/3 − C(5f)/5 + C(7f)/7 + C(11f)/11 − …]. C is interpolated linearly; beyond the last
    frequency it is 0, and what this may miss is in the standard deviations.
    """
    given = np.zeros(contrast.frequency.size) if contrast.sigma is None else contrast.sigma
    last, end = float(contrast.frequency[-1]), float(contrast.modulation[-1])
    factors = {k: coltman_factor(k) for k in range(1, 32, 2)}
    modulation, sigma = [], []
    for f in contrast.frequency[1:]:
        seen = {k: factor for k, factor in factors.items() if k * f <= last * (1.0 + 1e-12)}
        at, weights = np.array(list(seen)) * f, pi / 4.0 * np.array(list(seen.values()))
        # Contrast falls on, at least in proportion to the frequency.
        missed = next(
            (abs(factor) * end * last / (k * f) for k, factor in factors.items() if factor and k not in seen), 0.0
        )
        modulation.append(weights @ np.interp(at, contrast.frequency, contrast.modulation))
        noise = np.linalg.norm(weights * np.interp(at, contrast.frequency, given))
        sigma.append(hypot(float(noise), pi / 4.0 * missed))
    return MtfCurve.from_zero(contrast.frequency[1:], modulation, sigma)


#: Numbers of sectors that a star may have.
SECTORS = (4, 360)


@dataclass(frozen=True, eq=False)
class StarPixels:
    """Pixels of a window in polar coordinates about a centre, by increasing radius."""

    centre: tuple[float, float]
    values: Floats
    """Light, shape (n,)."""
    x: Floats
    y: Floats
    radius: Floats
    """Distance from the centre."""
    angle: Floats
    """Direction from the centre, from columns towards increasing rows, radians."""

    @classmethod
    def of(cls, values: Floats, centre: tuple[float, float]) -> StarPixels:
        """Pixels of a window."""
        y, x = np.mgrid[0 : values.shape[0], 0 : values.shape[1]].astype(float)
        return cls._sorted(centre, values.ravel(), x.ravel(), y.ravel())

    def about(self, centre: tuple[float, float]) -> StarPixels:
        """The same pixels about another centre."""
        return self._sorted(centre, self.values, self.x, self.y)

    @classmethod
    def _sorted(cls, centre: tuple[float, float], values: Floats, x: Floats, y: Floats) -> StarPixels:
        radius = np.hypot(x - centre[0], y - centre[1])
        order = np.argsort(radius, kind="stable")
        x, y = x[order], y[order]
        angle = np.arctan2(y - centre[1], x - centre[0])
        return cls(centre=centre, values=values[order], x=x, y=y, radius=radius[order], angle=angle)

    def between(self, inner: float, outer: float) -> tuple[Floats, Floats]:
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
    covariance: Floats
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


def fit_ring(values: Floats, angle: Floats, radius: float, sectors: int, *, whole: bool) -> StarRing:
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


def rough_centre(values: Floats) -> tuple[float, float]:
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


def _parts(pixels: StarPixels, radii: tuple[float, float], sectors: int) -> tuple[Floats, NDArray[np.complex128]]:
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


def _shift(rows: Floats, found: NDArray[np.complex128]) -> tuple[tuple[float, float], Floats]:
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
    light: NDArray[np.floating], rules: StarRules | None = None, *, clipped: Mask | None = None, what: str = "star"
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
    low, high, uncertain, source = _star_levels(pixels, rings, rules.levels, wave, sectors, outer, what)
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


def _outer(values: Floats, centre: tuple[float, float], rules: StarRules, what: str) -> float:
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


def _star_levels(
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
