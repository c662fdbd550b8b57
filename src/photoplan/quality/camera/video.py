"""Video: automatic gain, jitter and periods of lines, parallel edges."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from photoplan.adjustment.least_squares import levenberg, solve, spread
from photoplan.adjustment.statistics import chance_f, chance_normal, chance_t
from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError
from photoplan.quality.camera.drift import LEAST_VALUES, Settling, check_times, fit_settling
from photoplan.quality.camera.geometry import LEAST_LINES

#: Frames before the step below which nothing is said about the noise there.
LEAST_BEFORE = 3
#: A step is this many times larger than anything else between two frames.
_CLEAR = 3.0


@dataclass(frozen=True)
class NoiseChange:
    """Noise of single frames before the step and after it."""

    before: float | None
    """Standard deviation of one frame's mean grey value; None: too few frames."""
    after: float
    """The same about the curve that the values follow after the step."""
    probability: float | None
    """Chance that equal noise gives a ratio as far from 1 (F-test, two-sided)."""


@dataclass(frozen=True, eq=False)
class GainControl:
    """A transition, and what the camera does to the grey values after it though the scene is the same."""

    name: str
    step_time: float
    """Time of the first frame after the step, seconds."""
    direction: str
    """`bright to dark` or `dark to bright`."""
    before: float
    """Mean grey value before the step."""
    sigma_before: float | None
    approach: Settling
    """Grey values after the step: `change` is what the control adds, with sign."""
    noise: NoiseChange
    first: int
    """Index of the first frame after the step."""
    times: Floats
    values: Floats

    @property
    def step(self) -> float:
        """Grey values from before the step to right after it."""
        right_after = self.approach.start if self.approach.start is not None else float(self.values[self.first])
        return right_after - self.before

    @property
    def share(self) -> float | None:
        """The change as part of the step, negative where the control works against it; None: no change known."""
        return None if self.approach.change is None else self.approach.change / self.step


@dataclass(frozen=True)
class Asymmetry:
    """Whether the control works by the same amount after both transitions."""

    difference: float
    """Size of the change after bright to dark minus that after dark to bright, grey values."""
    sigma: float
    probability: float
    """Chance that equal changes differ as much."""


def gain_control(times: Floats, values: Floats, *, step_time: float | None = None, name: str = "series") -> GainControl:
    """Follow the grey values after a step of brightness.

    The scene is the same in all frames after the step, so a change of the grey values is the camera's.
    """
    t, y = check_times(times, name), np.asarray(values, float)
    if y.shape != t.shape or not np.isfinite(y).all():
        raise InputError(f"{name}: {y.size} finite grey values at {t.size} times are needed, one per frame")
    first = _first_after(t, y, step_time, name)
    if len(y) - first < LEAST_VALUES:
        raise InputError(
            f"{name}: {len(y) - first} frames after the step; at least {LEAST_VALUES} are needed to follow the control"
        )
    approach = fit_settling(t[first:], y[first:], what=f"{name} after the step")
    ahead = y[:first]
    before = float(ahead.mean())
    spread = float(ahead.std(ddof=1)) if first >= LEAST_BEFORE else None
    after = approach.start if approach.start is not None else float(y[first])
    direction = "bright to dark" if after < before else "dark to bright"
    sigma_before = None if spread is None else spread / math.sqrt(first)
    noise = NoiseChange(spread, approach.rms, _ratio_test(spread, first - 1, approach))
    return GainControl(
        name=name,
        step_time=float(t[first]),
        direction=direction,
        before=before,
        sigma_before=sigma_before,
        approach=approach,
        noise=noise,
        first=first,
        times=t,
        values=y,
    )


def compare_transitions(dark: GainControl, bright: GainControl) -> Asymmetry:
    """Compare the change after bright to dark with that after dark to bright; no significant change counts as none."""
    sizes, variances = [], []
    for one in (dark, bright):
        a = one.approach
        if a.change is None and a.significant:
            raise InputError(f"{one.name}: {a.verdict}; the size of its change is not known and cannot be compared")
        sizes.append(abs(a.change) if a.change is not None else 0.0)
        # A change that was not seen is none, to within what the mean of the frames would show.
        none = a.rms * math.sqrt(2.0 / (a.redundancy + 1))
        variances.append((a.sigma_change if a.sigma_change is not None else none) ** 2)
    difference, sigma = sizes[0] - sizes[1], math.sqrt(sum(variances))
    probability = chance_normal(difference / sigma) if sigma > 0.0 else float(difference == 0.0)
    return Asymmetry(difference, sigma, probability)


def _first_after(t: Floats, y: Floats, step_time: float | None, name: str) -> int:
    if step_time is not None:
        first = int(np.searchsorted(t, step_time))
        if not 0 < first < len(t):
            raise InputError(
                f"{name}: the step at {step_time:g} s leaves {first} frames before and {len(t) - first} after it; "
                f"the frames run from {t[0]:g} to {t[-1]:g} s"
            )
        return first
    if len(y) < LEAST_VALUES + 1:
        raise InputError(f"{name}: {len(y)} frames; at least {LEAST_VALUES} after the step and one before are needed")
    jumps = np.abs(np.diff(y))
    k = int(jumps.argmax())
    rest = float(np.delete(jumps, k).max())
    if not jumps[k] > _CLEAR * rest:
        raise InputError(
            f"{name}: no step stands out: the largest difference of two frames is {jumps[k]:.1f} grey values, the next "
            f"{rest:.1f}; state the time of the step"
        )
    return k + 1


def _ratio_test(spread: float | None, redundancy: int, approach: Settling) -> float | None:
    if spread is None or not (spread > 0.0 and approach.rms > 0.0):
        return None
    one = chance_f((spread / approach.rms) ** 2, redundancy, approach.redundancy)
    return 2.0 * min(one, 1.0 - one)


#: Frequencies that are tried within the width of a spectral line, so that none is passed by.
_OVERSAMPLING = 4
_LONGEST = 1.5
"""Least number of periods in the series: fewer cannot be told from a curve."""
_ALARM = 0.001
"""Chance of a false alarm, for `Spectrum.level`."""
_AT_ONCE = 256
_KEPT = 4_000_000
"""Cosines that are kept in memory."""


@dataclass(frozen=True)
class Harmonic:
    """An oscillation: amplitude · sin(2π t / period + phase), with t the line counted from the window's first."""

    period: float
    """Lines."""
    sigma_period: float
    amplitude: float
    """Pixels."""
    sigma_amplitude: float
    phase: float
    """Radians, −π to π, at the window's first line."""
    sigma_phase: float
    probability: float
    """Chance that noise alone makes as strong an oscillation at any of the frequencies that were tried."""

    def at(self, t: Floats) -> Floats:
        """Its part at lines."""
        return self.amplitude * np.sin(2.0 * math.pi * np.asarray(t, float) / self.period + self.phase)

    def hertz(self, line_time: float, interlaced: bool) -> float:
        """Frequency in Hz; of an interlaced image, two successive lines count as one line of a field."""
        return (2.0 if interlaced else 1.0) / (self.period * line_time)


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Share of the sum of squares that an oscillation of each frequency explains beside the base functions."""

    frequency: Floats
    """Cycles per line, shape (k,)."""
    power: Floats
    """0 to 1, shape (k,)."""
    level: float
    """Power that noise alone exceeds anywhere with a chance of 1 ‰."""

    @property
    def best(self) -> int:
        """Index of the strongest frequency."""
        return int(self.power.argmax())


class Waves:
    """Cosines and sines of all frequencies at the lines of one series; kept where they are few."""

    def __init__(self, t: Floats) -> None:
        extent = float(t[-1] - t[0]) + 1.0
        low, high = _LONGEST / extent, 0.5 - 1.0 / extent
        self.extent = extent
        self.frequency = np.linspace(low, high, max(2, math.ceil((high - low) * extent * _OVERSAMPLING)))
        self._t = t - t[0]
        self._kept = list(self._parts()) if len(t) * len(self.frequency) <= _KEPT else None

    def parts(self) -> Iterable[tuple[slice, Floats, Floats]]:
        """Some frequencies at a time: which, cosines and sines of shape (n, some)."""
        return self._parts() if self._kept is None else self._kept

    def _parts(self) -> Iterator[tuple[slice, Floats, Floats]]:
        for first in range(0, len(self.frequency), _AT_ONCE):
            part = slice(first, first + _AT_ONCE)
            angle = 2.0 * math.pi * np.multiply.outer(self._t, self.frequency[part])
            yield part, np.cos(angle), np.sin(angle)


def spectrum(waves: Waves, y: Floats, base: Floats) -> Spectrum:
    """Least-squares spectrum: at every frequency the base functions are adjusted anew (Lomb, Scargle)."""
    frequency = waves.frequency
    Q, _ = np.linalg.qr(base)
    rest = y - Q @ (Q.T @ y)
    rss0 = max(float(rest @ rest), 1e-300)
    power = np.empty(len(frequency))
    for part, c, s in waves.parts():
        power[part] = _explained(c, s, Q, rest) / rss0
    freedom = len(y) - base.shape[1] - 3
    trials = max(1.0, float(frequency[-1] - frequency[0]) * waves.extent)
    single = -math.expm1(math.log1p(-_ALARM) / trials)
    return Spectrum(frequency, np.clip(power, 0.0, 1.0), 1.0 - single ** (2.0 / freedom))


def false_alarm(found: Spectrum, freedom: int, extent: float) -> float:
    """Chance that noise alone has its strongest power this high."""
    single = (1.0 - float(found.power[found.best])) ** (freedom / 2.0)
    trials = max(1.0, float(found.frequency[-1] - found.frequency[0]) * extent)
    return -math.expm1(trials * math.log1p(-min(single, 1.0 - 1e-12)))


def _explained(c: Floats, s: Floats, Q: Floats, rest: Floats) -> Floats:
    """Sum of squares that cosine and sine explain, after both are freed of what the base can do."""
    of_c, of_s = Q.T @ c, Q.T @ s
    cc = np.einsum("ij,ij->j", c, c) - (of_c * of_c).sum(axis=0)
    ss = np.einsum("ij,ij->j", s, s) - (of_s * of_s).sum(axis=0)
    cs = np.einsum("ij,ij->j", c, s) - (of_c * of_s).sum(axis=0)
    # The rest is free of the base already.
    yc, ys = rest @ c, rest @ s
    det = cc * ss - cs**2
    with np.errstate(divide="ignore", invalid="ignore"):
        out = (yc**2 * ss - 2.0 * yc * ys * cs + ys**2 * cc) / det
    return np.where(det > 1e-6 * np.maximum(cc * ss, 1e-12), out, 0.0)


@dataclass(frozen=True, eq=False)
class AdjustedPeriod:
    """Base functions and oscillations adjusted together."""

    unknowns: Floats
    """Of the base functions, shape (k,)."""
    sigmas: Floats
    harmonics: tuple[Harmonic, ...]
    residuals: Floats
    """Computed minus measured, shape (n,)."""
    sigma0: float
    """Standard deviation of one value."""


def adjust_periods(
    t: Floats, y: Floats, base: Floats, frequencies: list[float], chances: list[float]
) -> AdjustedPeriod:
    """Adjust the base functions and the frequency, amplitude and phase of every oscillation by least squares."""
    # About its middle, frequency and phase of an oscillation are nearly uncorrelated.
    middle = float(t.mean())
    limit, k = 0.5 / (float(t[-1] - t[0]) + 1.0), base.shape[1]

    def equations(f: Floats) -> tuple[Floats, Floats]:
        A = _design(t - middle, base, f)
        found = solve(A, y)
        return np.column_stack([A, _by_frequency(t - middle, f, found.unknowns[k:])]), found.residuals

    def moved(f: Floats, step: Floats) -> Floats:
        return np.clip(f + np.clip(step[len(step) - len(f) :], -limit, limit), 1e-6, 0.5 - 1e-6)

    found = levenberg(np.array(frequencies), equations, moved)
    f, cofactors = found.state, solve(found.A, y).cofactors
    unknowns = solve(_design(t - middle, base, f), y).unknowns
    covariance = cofactors * found.sigma0**2
    harmonics = tuple(_harmonic(i, k, f, unknowns, covariance, middle, chances) for i in range(len(f)))
    return AdjustedPeriod(
        unknowns=unknowns[:k],
        sigmas=np.sqrt(np.diag(covariance)[:k]),
        harmonics=harmonics,
        residuals=found.v,
        sigma0=found.sigma0,
    )


def _design(t: Floats, base: Floats, f: Floats) -> Floats:
    angle = 2.0 * math.pi * np.multiply.outer(t, f)
    return np.column_stack(
        [base, *(part for i in range(len(f)) for part in (np.cos(angle[:, i]), np.sin(angle[:, i])))]
    )


def _by_frequency(t: Floats, f: Floats, found: Floats) -> Floats:
    """Derivatives of every oscillation with respect to its frequency."""
    angle = 2.0 * math.pi * np.multiply.outer(t, f)
    a, b = found[0::2], found[1::2]
    return 2.0 * math.pi * t[:, None] * (b * np.cos(angle) - a * np.sin(angle))


def _harmonic(
    i: int, k: int, f: Floats, found: Floats, covariance: Floats, middle: float, chances: list[float]
) -> Harmonic:
    """Amplitude, phase and period with their standard deviations; the phase is moved to line 0."""
    a, b = found[k + 2 * i], found[k + 2 * i + 1]
    amplitude = math.hypot(a, b)
    index = [k + 2 * i, k + 2 * i + 1, k + 2 * len(f) + i]
    C = covariance[np.ix_(index, index)]
    of_amplitude = np.array([a, b, 0.0]) / max(amplitude, 1e-300)
    # phase = atan2(a, b) − 2π f · middle
    of_phase = np.array([b, -a, 0.0]) / max(amplitude, 1e-300) ** 2 - [0.0, 0.0, 2.0 * math.pi * middle]
    phase = math.remainder(math.atan2(a, b) - 2.0 * math.pi * f[i] * middle, math.tau)
    return Harmonic(
        period=1.0 / float(f[i]),
        sigma_period=math.sqrt(C[2, 2]) / float(f[i]) ** 2,
        amplitude=amplitude,
        sigma_amplitude=math.sqrt(of_amplitude @ C @ of_amplitude),
        phase=phase,
        sigma_phase=math.sqrt(of_phase @ C @ of_phase),
        probability=chances[i],
    )


#: Chance of a false alarm below which an oscillation, a curve or an offset of the fields is taken as real.
LEVEL = 0.001
#: Oscillations that are taken out, and degree of the polynomial beside them: more would follow the jitter itself.
_MOST_PERIODS = 3
_MOST_DEGREE = 3
_SPIKE = 6.0
"""Standard deviations beyond which a single line is a spike."""
_LEAST_SPIKE = 0.02
#: Lines whose median a spike is compared with.
_NEIGHBOURS = 11
#: Share of lines that may be spikes: with more there is no edge to speak of.
_MOST_SPIKES = 0.2


@dataclass(frozen=True)
class Spike:
    """A line that is off by far more than its neighbours."""

    line: int
    """Counted from 0 in the window."""
    deviation: float
    """From the adjusted line and its periodic parts, pixels."""


@dataclass(frozen=True, eq=False)
class LineJitter:
    """Deviations of an edge from a straight line, taken apart."""

    line: Floats
    """Lines with an edge, counted from 0 in the window, shape (n,)."""
    position: Floats
    """Columns in the window, shape (n,)."""
    deviation: Floats
    """d_i: measured minus adjusted straight line (curve, if `degree` > 1), spikes included, shape (n,)."""
    regular: Floats
    """The part of them that fields and oscillations explain, shape (n,)."""
    used: Mask
    """False for spikes, shape (n,)."""
    degree: int
    """1: straight; 2, 3: the edge is curved beyond chance, and a polynomial of this degree was adjusted."""
    sagitta: float
    """Largest distance of the curve from its straight line, pixels; 0 for degree 1."""
    slope: float
    """Columns per line."""
    sigma: float
    """Standard deviation of the d_i, without spikes."""
    neighbour_sigma: float
    """Root mean square difference of neighbouring lines."""
    residual_sigma: float
    """What fields and oscillations leave: noise of the method and jitter without rule."""
    field_offset: float
    """Odd lines minus even lines, pixels (the window's first line is even)."""
    sigma_field_offset: float
    field_probability: float
    """Chance that there is none."""
    harmonics: tuple[Harmonic, ...]
    """Significant oscillations, the strongest first."""
    spectrum: Spectrum
    """Of the deviations before any oscillation is taken out."""
    spikes: tuple[Spike, ...]
    missing: tuple[int, ...]
    """Lines without an edge."""

    @property
    def fields_differ(self) -> bool:
        """Whether the offset of the fields is real, with a chance of error of 1 ‰."""
        return self.field_probability < LEVEL


def line_jitter(position: Floats, name: str = "edge", degree: int | None = None) -> LineJitter:
    """Adjust a straight line to the positions of an edge, and take apart what is left.

    Spikes are set aside; polynomial, offset between even and odd lines and up to three oscillations are adjusted
    together, since each would falsify the others. A polynomial of degree 2 or 3 is used only where its last
    coefficient is significant beside the oscillations: fall-off and distortion bend an edge (Behr 1989, fig. 4.6).
    """
    p = np.asarray(position, float)
    lines = np.flatnonzero(np.isfinite(p))
    if p.ndim != 1 or len(lines) < LEAST_LINES:
        raise InputError(f"{name}: an edge in {len(lines)} lines; at least {LEAST_LINES} are needed")
    if degree is not None and not 1 <= degree <= _MOST_DEGREE:
        raise InputError(f"{name}: polynomial of degree {degree}; 1 to {_MOST_DEGREE} are allowed")
    t, y = lines.astype(float), p[lines]
    used = ~_spikes(t, y)
    if (~used).sum() > _MOST_SPIKES * len(used):
        raise InputError(
            f"{name}: {(~used).sum()} of {len(used)} lines stand out from their neighbours; the edge is no line, "
            "choose another window"
        )
    chosen, fit, whole = _chosen(t[used], y[used], degree, len(p))
    trend, parity = _base(t, chosen, len(p))
    smooth = trend @ fit.unknowns[:-1]
    regular = parity * fit.unknowns[-1] + sum((h.at(t) for h in fit.harmonics), np.zeros(len(t)))
    deviation = y - smooth
    straight = np.polynomial.Polynomial.fit(t[used], smooth[used], 1)
    offset, sigma_offset = float(fit.unknowns[-1]), float(fit.sigmas[-1])
    freedom = max(int(used.sum()) - chosen - 2 - 3 * len(fit.harmonics), 1)
    ratio = abs(offset) / sigma_offset if sigma_offset > 0.0 else math.inf
    spikes = tuple(Spike(int(t[i]), float((deviation - regular)[i])) for i in np.flatnonzero(~used))
    return LineJitter(
        line=t,
        position=y,
        deviation=deviation,
        regular=regular,
        used=used,
        degree=chosen,
        sagitta=float(np.abs(smooth - straight(t)).max()) if chosen > 1 else 0.0,
        slope=float(straight.convert().coef[-1]) if len(straight.convert().coef) > 1 else 0.0,
        sigma=math.sqrt(float((deviation[used] ** 2).sum()) / max(int(used.sum()) - chosen - 1, 1)),
        neighbour_sigma=_neighbours(t[used], deviation[used]),
        residual_sigma=fit.sigma0,
        field_offset=offset,
        sigma_field_offset=sigma_offset,
        field_probability=chance_t(ratio, freedom),
        harmonics=tuple(sorted(fit.harmonics, key=lambda h: -h.amplitude)),
        spectrum=whole,
        spikes=spikes,
        missing=tuple(int(i) for i in np.flatnonzero(~np.isfinite(p))),
    )


def _base(t: Floats, degree: int, lines: int) -> tuple[Floats, Floats]:
    """Legendre polynomials over the window, and the parity of the lines (−½ even, +½ odd)."""
    u = 2.0 * t / max(lines - 1, 1) - 1.0
    return np.asarray(np.polynomial.legendre.legvander(u, degree), float), np.where(t % 2 == 0, -0.5, 0.5)


def _chosen(t: Floats, y: Floats, degree: int | None, lines: int) -> tuple[int, AdjustedPeriod, Spectrum]:
    """Degree of the polynomial with the adjustment, and the spectrum beside this polynomial."""
    waves = Waves(t)
    tried = {d: _adjusted(waves, t, y, (d, lines)) for d in ([degree] if degree else range(1, _MOST_DEGREE + 1))}
    best = min(tried)
    for d, (fit, _) in tried.items():
        # The last but one unknown is the highest polynomial's; the last, that of the fields.
        ratio = abs(fit.unknowns[-2]) / max(fit.sigmas[-2], 1e-300)
        freedom = max(len(t) - d - 2 - 3 * len(fit.harmonics), 1)
        if d > 1 and chance_t(ratio, freedom) < LEVEL:
            best = d
    return best, *tried[best]


def _adjusted(waves: Waves, t: Floats, y: Floats, shape: tuple[int, int]) -> tuple[AdjustedPeriod, Spectrum]:
    """Oscillations one after the other, each searched beside all that were found before."""
    base = np.column_stack(_base(t, *shape))
    first = found = spectrum(waves, y, base)
    frequencies: list[float] = []
    chances: list[float] = []
    fit = adjust_periods(t, y, base, frequencies, chances)
    floor = 1e-12 * float(y @ y) / len(y)
    while len(frequencies) < _MOST_PERIODS and fit.sigma0**2 > floor:
        chance = false_alarm(found, len(t) - base.shape[1] - 3 * len(frequencies) - 3, waves.extent)
        if not chance < LEVEL:
            break
        frequencies.append(float(found.frequency[found.best]))
        chances.append(chance)
        fit = adjust_periods(t, y, base, frequencies, chances)
        frequencies = [1.0 / h.period for h in fit.harmonics]
        angle = 2.0 * math.pi * np.multiply.outer(t, np.array(frequencies))
        found = spectrum(waves, y, np.column_stack([base, np.cos(angle), np.sin(angle)]))
    return fit, first


def _spikes(t: Floats, y: Floats) -> Mask:
    """Lines far from the running median of their neighbours, after a robust straight line is taken off."""
    step = max(1, len(t) // 200)
    i, j = np.triu_indices(len(t[::step]), 1)
    # Theil (1950): the median of the slopes of all pairs.
    slope = float(np.median((y[::step][j] - y[::step][i]) / (t[::step][j] - t[::step][i])))
    level = y - slope * t
    rest = level - ndimage.median_filter(level, _NEIGHBOURS, mode="nearest")
    scale = spread(rest, None)
    return np.abs(rest) > max(_SPIKE * scale, _LEAST_SPIKE)


def _neighbours(t: Floats, deviation: Floats) -> float:
    """Root mean square difference of lines that follow each other."""
    next_to = np.diff(t) == 1.0
    if not next_to.any():
        return math.nan
    return math.sqrt(float((np.diff(deviation)[next_to] ** 2).mean()))


LEVEL_PARALLEL_EDGES = 0.01
_FARTHEST = 0.25
"""Largest distance of lines over which correlation is summed, as part of their number."""


@dataclass(frozen=True)
class EdgePair:
    """Deviations of two edges in the same lines."""

    lines: int
    correlation: float
    low: float
    high: float
    """Limits of 95 %, with the correlation of neighbouring lines taken into account."""
    effective: float
    """Number of independent lines."""
    common_sigma: float
    """Jitter that both edges share: errors at the start of the lines; 0 where the covariance is not positive."""
    sigma_common: float
    """Standard deviation of its square's root, where there is one; NaN."""
    own_sigma: tuple[float, float]
    """What each edge has for itself: clock instability within the line, and the method's noise."""
    probability: float
    """Chance that unrelated deviations correlate as much."""
    common_spikes: tuple[int, ...]
    """Lines that are spikes of both edges, counted in the first one's window."""
    single_spikes: tuple[int, ...]
    """Lines that are spikes of one edge only."""

    @property
    def verdict(self) -> str:
        """What the correlation says about the cause."""
        if self.probability >= LEVEL_PARALLEL_EDGES:
            return "no common deviations: not errors at the start of the lines"
        if self.correlation < 0.0:
            return "opposite deviations: the scale of the lines varies, the clock is not stable"
        share = self.correlation
        if share > 0.8:
            return "common deviations: errors at the start of the lines"
        return f"{100 * share:.0f} % of the variance is common (start of the lines), the rest differs (clock, noise)"


@dataclass(frozen=True)
class AboveControl:
    """Jitter beyond the method's own noise."""

    sigma: float
    """Root of the difference of variances; 0 where the control is as large."""
    sigma_sigma: float
    """Its standard deviation; NaN where it is 0."""
    probability: float
    """Chance that no jitter gives as much (F-test)."""


def compare_edges(first: LineJitter, second: LineJitter, offset: int = 0, *, periodic: bool = True) -> EdgePair:
    """Correlate the deviations of two edges, spikes left out."""
    a, b = _by_line(first, 0, periodic), _by_line(second, offset, periodic)
    lines = sorted(a.keys() & b.keys())
    if len(lines) < LEAST_LINES:
        raise InputError(f"parallel edges: {len(lines)} lines in common; at least {LEAST_LINES} are needed")
    x, y = np.array([a[i] for i in lines]), np.array([b[i] for i in lines])
    x, y = x - x.mean(), y - y.mean()
    xx, yy, xy = float(x @ x), float(y @ y), float(x @ y)
    if not (xx > 0.0 and yy > 0.0):
        raise InputError("parallel edges: one of them does not deviate at all; is it drawn, not photographed?")
    r = xy / math.sqrt(xx * yy)
    n = len(lines)
    effective = _effective(x / math.sqrt(xx), y / math.sqrt(yy), n)
    z, half = math.atanh(min(max(r, -1 + 1e-12), 1 - 1e-12)), 1.0 / math.sqrt(max(effective - 3.0, 0.5))
    covariance = xy / (n - 1)
    variances = xx / (n - 1), yy / (n - 1)
    # Of a covariance of normal variables.
    of_covariance = math.sqrt((variances[0] * variances[1] + covariance**2) / max(effective - 1.0, 1.0))
    common = math.sqrt(covariance) if covariance > 0.0 else 0.0
    spikes_a = {s.line for s in first.spikes}
    spikes_b = {s.line + offset for s in second.spikes}
    return EdgePair(
        lines=n,
        correlation=r,
        low=math.tanh(z - 1.96 * half),
        high=math.tanh(z + 1.96 * half),
        effective=effective,
        common_sigma=common,
        sigma_common=of_covariance / (2.0 * common) if common > 0.0 else math.nan,
        own_sigma=(math.sqrt(max(variances[0] - covariance, 0.0)), math.sqrt(max(variances[1] - covariance, 0.0))),
        probability=chance_normal(z / half),
        common_spikes=tuple(sorted(spikes_a & spikes_b)),
        single_spikes=tuple(sorted(spikes_a ^ spikes_b)),
    )


def mean_correlation(pairs: Sequence[EdgePair]) -> tuple[float, float]:
    """Correlation over several frames, the mean by Fisher's z, and its standard deviation."""
    z = [math.atanh(min(max(p.correlation, -0.999999), 0.999999)) for p in pairs]
    sigma = float(np.mean([(p.high - p.low) / (2 * 1.96) for p in pairs])) / math.sqrt(len(pairs))
    return math.tanh(float(np.mean(z))), sigma


def above_control(edge: LineJitter, control: LineJitter) -> AboveControl:
    """Jitter of an edge beyond what the method shows at an edge without jitter, such as a horizontal one."""
    n, m = int(edge.used.sum()) - edge.degree - 1, int(control.used.sum()) - control.degree - 1
    difference = edge.sigma**2 - control.sigma**2
    ratio = edge.sigma**2 / max(control.sigma**2, 1e-300)
    probability = chance_f(ratio, max(n, 1), max(m, 1))
    if difference <= 0.0:
        return AboveControl(0.0, math.nan, probability)
    of_difference = math.sqrt(2.0 * edge.sigma**4 / max(n, 1) + 2.0 * control.sigma**4 / max(m, 1))
    sigma = math.sqrt(difference)
    return AboveControl(sigma, of_difference / (2.0 * sigma), probability)


def _by_line(jitter: LineJitter, offset: int, periodic: bool) -> dict[int, float]:
    values = jitter.deviation if periodic else jitter.deviation - jitter.regular
    return dict(zip((jitter.line[jitter.used].astype(int) + offset).tolist(), values[jitter.used].tolist()))


def _effective(x: Floats, y: Floats, n: int) -> float:
    """Number of independent lines: n / (1 + 2 Σ ρx(k) ρy(k)) (Bartlett), summed while both are positive."""
    total = 1.0
    for k in range(1, max(2, int(_FARTHEST * n))):
        a, b = float(x[k:] @ x[:-k]), float(y[k:] @ y[:-k])
        total += 2.0 * a * b
        if k > 3 and max(abs(a), abs(b)) < 1.0 / math.sqrt(n):
            break
    return min(float(n), max(4.0, n / max(total, 1e-3)))
