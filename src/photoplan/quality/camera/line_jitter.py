"""Line jitter by the plumb-line method (Behr 1989, §4.1.2): what moves a straight edge from line to line."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from photoplan.adjustment.chances import chance_t
from photoplan.adjustment.robust import spread
from photoplan.errors import InputError
from photoplan.quality.camera.line_period import (
    AdjustedPeriod,
    Harmonic,
    Spectrum,
    Waves,
    adjust_periods,
    false_alarm,
    spectrum,
)
from photoplan.quality.camera.plumb_edge import LEAST_LINES

Array = NDArray[np.float64]

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

    line: Array
    """Lines with an edge, counted from 0 in the window, shape (n,)."""
    position: Array
    """Columns in the window, shape (n,)."""
    deviation: Array
    """d_i: measured minus adjusted straight line (curve, if `degree` > 1), spikes included, shape (n,)."""
    regular: Array
    """The part of them that fields and oscillations explain, shape (n,)."""
    used: NDArray[np.bool_]
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


def line_jitter(position: Array, name: str = "edge", degree: int | None = None) -> LineJitter:
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


def _base(t: Array, degree: int, lines: int) -> tuple[Array, Array]:
    """Legendre polynomials over the window, and the parity of the lines (−½ even, +½ odd)."""
    u = 2.0 * t / max(lines - 1, 1) - 1.0
    return np.asarray(np.polynomial.legendre.legvander(u, degree), float), np.where(t % 2 == 0, -0.5, 0.5)


def _chosen(t: Array, y: Array, degree: int | None, lines: int) -> tuple[int, AdjustedPeriod, Spectrum]:
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


def _adjusted(waves: Waves, t: Array, y: Array, shape: tuple[int, int]) -> tuple[AdjustedPeriod, Spectrum]:
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


def _spikes(t: Array, y: Array) -> NDArray[np.bool_]:
    """Lines far from the running median of their neighbours, after a robust straight line is taken off."""
    step = max(1, len(t) // 200)
    i, j = np.triu_indices(len(t[::step]), 1)
    # Theil (1950): the median of the slopes of all pairs.
    slope = float(np.median((y[::step][j] - y[::step][i]) / (t[::step][j] - t[::step][i])))
    level = y - slope * t
    rest = level - ndimage.median_filter(level, _NEIGHBOURS, mode="nearest")
    scale = spread(rest, None)
    return np.abs(rest) > max(_SPIKE * scale, _LEAST_SPIKE)


def _neighbours(t: Array, deviation: Array) -> float:
    """Root mean square difference of lines that follow each other."""
    next_to = np.diff(t) == 1.0
    if not next_to.any():
        return math.nan
    return math.sqrt(float((np.diff(deviation)[next_to] ** 2).mean()))
