"""Two parallel edges in one image, and an edge beside a control (Behr 1989, §4.1.2, figs. 4.4 and 4.5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.chances import chance_f, chance_normal
from photoplan.errors import InputError
from photoplan.quality.camera.line_jitter import LineJitter
from photoplan.quality.camera.plumb_edge import LEAST_LINES

Array = NDArray[np.float64]

LEVEL = 0.01
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
        if self.probability >= LEVEL:
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


def _effective(x: Array, y: Array, n: int) -> float:
    """Number of independent lines: n / (1 + 2 Σ ρx(k) ρy(k)) (Bartlett), summed while both are positive."""
    total = 1.0
    for k in range(1, max(2, int(_FARTHEST * n))):
        a, b = float(x[k:] @ x[:-k]), float(y[k:] @ y[:-k])
        total += 2.0 * a * b
        if k > 3 and max(abs(a), abs(b)) < 1.0 / math.sqrt(n):
            break
    return min(float(n), max(4.0, n / max(total, 1e-3)))
