"""Bar patterns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, degrees, hypot, log, pi, sin, sqrt
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from photoplan.adjustment.least_squares import solve
from photoplan.errors import InputError
from photoplan.findings import with_sigma
from photoplan.quality.mtf_curve import MtfCurve

Array = NDArray[np.float64]

#: Share of clipped pixels from which on a pattern is refused.
MOST_CLIPPED = 0.005
#: Side of the largest window that is measured at once.
MOST_SIDE = 8192


def clipped_pixels(stored: NDArray[Any]) -> NDArray[np.bool_]:
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


def _heaped(stored: NDArray[Any], end: float, step: int, at_end: NDArray[np.bool_]) -> bool:
    """An end of integers is cut off if it holds far more pixels than the value beside it: noise rounds to both."""
    return not np.issubdtype(stored.dtype, np.integer) or at_end.sum() >= 4 * (stored == end + step).sum()


def pattern_window(
    light: NDArray[Any], clipped: NDArray[np.bool_] | None, what: str, least: int = 12, most: int = MOST_SIDE
) -> Array:
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


def white_noise(values: Array) -> float:
    """Standard deviation of uncorrelated noise of a picture without its structure.

    The second mixed difference takes planes and slow structure away; Immerkær 1996, "Fast noise variance estimation".
    """
    rows = values[:-2] - 2.0 * values[1:-1] + values[2:]
    both = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    return float(np.sqrt((both**2).mean())) / 6.0


def waves(turn: ArrayLike, harmonics: Sequence[int]) -> Array:
    """Cosine and sine of each harmonic wave, shape (…, 2 · harmonics), at phases of shape (…) in periods."""
    angle = 2.0 * pi * np.multiply.outer(turn, np.asarray(harmonics, float))
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).reshape(*angle.shape[:-1], -1)


def least_squares(columns: Array, values: Array) -> tuple[Array, Array, Array]:
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


def measure_bars(
    light: NDArray[np.floating], *, clipped: NDArray[np.bool_] | None = None, what: str = "bars"
) -> BarContrast:
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


def _middle_part(values: Array) -> Array:
    """The middle of a large window: more pixels than these add nothing but time."""
    rows, columns = (slice(max(0, (n - _MOST) // 2), max(0, (n - _MOST) // 2) + _MOST) for n in values.shape)
    return values[rows, columns]


def _fit(values: Array, phase: Array, wave: BarWave) -> tuple[Array, Array, Array, Array, tuple[int, ...]]:
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


def _levels(flat: Array, turn: Array, solution: Array, harmonics: tuple[int, ...]) -> tuple[float, float, float, float]:
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


def _few_level(x: Array, phase: float, solution: Array, harmonics: tuple[int, ...]) -> tuple[float, float, float]:
    """Level of bars that meet the pixels at few phases: what the waves add up to; its deviation from the pixels there
    as standard deviation; and the bend of the waves."""

    def at(turn: float | Array) -> Array:
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

    def phases(self, shape: tuple[int, ...]) -> Array:
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


def _both(wave: Array) -> list[Array]:
    return [wave, -wave]


def _wrapped(wave: Array) -> Array:
    return np.asarray(wave - np.round(wave))


def wave_columns(shape: tuple[int, ...], phase: Array, harmonics: tuple[int, ...]) -> Array:
    """Columns of the linear model: level, its slopes in x and y, and cosine and sine of each harmonic wave.

    The phase is in periods, one for each pixel of a window of this shape; a row of the result is a pixel.
    """
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    x, y = x / max(shape[1] - 1, 1) - 0.5, y / max(shape[0] - 1, 1) - 0.5
    plane = np.stack([np.ones(phase.size), x.ravel(), y.ravel()], axis=1)
    return np.hstack([plane, waves(phase.ravel(), harmonics)])


def find_wave(values: Array, what: str) -> BarWave:
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


def _refined(values: Array, wave: BarWave) -> BarWave:
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
