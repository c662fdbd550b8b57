"""How a value approaches its end: an exponential with its standard deviations, or the reason why there is none."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from photoplan.adjustment.chances import chance_gain
from photoplan.adjustment.linear import solve
from photoplan.errors import InputError

Array = NDArray[np.float64]

#: Values below which no exponential is fitted: its three unknowns need something that checks them.
LEAST_VALUES = 8
#: Chance of error below which a change is taken as real.
LEVEL = 0.01
#: Time constants that are tried before the best is refined.
_CANDIDATES = 80
#: A time constant is known when its standard deviation is below this part of it.
_KNOWN = 0.5


@dataclass(frozen=True, kw_only=True)
class Approach:
    """y(t) = end + (start − end) · exp(−t / τ), with t counted from the first value."""

    mean: float
    """Of all values."""
    rms: float
    """Standard deviation of one value about the curve (about the mean, if there is no change)."""
    probability: float
    """Chance that noise alone would look as much like a change."""
    redundancy: int
    verdict: str
    """What is known and what is not, in words."""
    start: float | None = None
    """Value at the first time; None: no significant change."""
    end: float | None = None
    """Value that is approached; None: no significant change, or the series ends too early to know it."""
    change: float | None = None
    """End minus start."""
    sigma_change: float | None = None
    time_constant: float | None = None
    """τ in the unit of the times; None: not determined, see `verdict`."""
    sigma_time_constant: float | None = None

    @property
    def significant(self) -> bool:
        """Whether a change is real, with a chance of error of 1 %."""
        return self.probability < LEVEL

    def at(self, time: Array | float) -> Array:
        """Values of the curve at times since the first value; the mean where there is no curve."""
        t = np.asarray(time, float)
        if self.start is None or self.end is None or self.time_constant is None:
            return np.full(t.shape, self.mean)
        return self.end + (self.start - self.end) * np.exp(-t / self.time_constant)

    def time_within(self, bound: float) -> float | None:
        """Time since the first value after which the curve stays within a bound of its end; None: not known."""
        if not bound > 0.0:
            raise InputError(f"bound {bound}; a positive number is needed")
        if self.change is None or self.time_constant is None:
            return None
        return max(0.0, self.time_constant * math.log(max(abs(self.change), 1e-300) / bound))


def check_times(times: Array, what: str) -> Array:
    """Times as finite, increasing numbers."""
    t = np.asarray(times, float)
    if t.ndim != 1:
        raise InputError(f"{what}: times of shape {t.shape}; one per measurement is needed")
    missing = np.flatnonzero(~np.isfinite(t))
    if missing.size:
        raise InputError(f"{what}: measurement {missing[0] + 1} has no time; give every frame its time in seconds")
    back = np.flatnonzero(np.diff(t) <= 0.0)
    if back.size:
        k = int(back[0])
        raise InputError(
            f"{what}: time {t[k + 1]:g} s of measurement {k + 2} does not come after {t[k]:g} s of measurement "
            f"{k + 1}; sort the frames by time, and give each time once"
        )
    return t


def fit_approach(times: Array, values: Array, what: str = "series") -> Approach:
    """Exponential by least squares, tested against a constant."""
    t, y = _checked(times, values, what)
    t = t - t[0]
    mean, n = float(y.mean()), len(y)
    rss0 = float(((y - mean) ** 2).sum())
    taus = np.geomspace(0.3 * float(np.diff(t).min()), 10.0 * t[-1], _CANDIDATES)
    rss = np.array([_for_tau(t, y, tau)[1] for tau in taus])
    best = int(rss.argmin())
    start, end, tau, rss1 = _refined(t, y, taus, best)
    probability = _probability(rss0, rss1, n, taus)
    if probability >= LEVEL:
        rms = math.sqrt(rss0 / (n - 1))
        verdict = "no significant change"
        return Approach(mean=mean, rms=rms, probability=probability, redundancy=n - 1, verdict=verdict)
    rms = math.sqrt(rss1 / (n - 3))
    sigmas = _sigmas(t, (start, end, tau), rms)
    verdict = _verdict(t, tau, sigmas[2], (abs(end - start), sigmas[3]))
    seen = Approach(mean=mean, rms=rms, probability=probability, redundancy=n - 3, verdict=verdict)
    if verdict.startswith("the series"):  # its end is not seen
        return replace(seen, start=start)
    seen = replace(seen, end=end)
    if verdict.startswith("the change"):  # neither are its size and time
        return seen
    return replace(
        seen, start=start, change=end - start, sigma_change=sigmas[3], time_constant=tau, sigma_time_constant=sigmas[2]
    )


def _checked(times: Array, values: Array, what: str) -> tuple[Array, Array]:
    t, y = check_times(times, what), np.asarray(values, float)
    if y.shape != t.shape:
        raise InputError(f"{what}: {y.size} values at {t.size} times; as many of both are needed")
    if len(y) < LEAST_VALUES:
        raise InputError(f"{what}: {len(y)} measurements; at least {LEAST_VALUES} are needed to follow a change")
    if not np.isfinite(y).all():
        raise InputError(f"{what}: measurement {int(np.flatnonzero(~np.isfinite(y))[0]) + 1} has no value")
    return t, y


def _for_tau(t: Array, y: Array, tau: float) -> tuple[Array, float]:
    """Start and end for a given time constant, and the sum of squares that remains."""
    decay = np.exp(-t / tau)
    fit = solve(np.column_stack([decay, 1.0 - decay]), y)
    return fit.unknowns, fit.square


def _refined(t: Array, y: Array, taus: Array, best: int) -> tuple[float, float, float, float]:
    low, high = taus[max(best - 1, 0)], taus[min(best + 1, len(taus) - 1)]
    found = optimize.minimize_scalar(
        lambda log_tau: _for_tau(t, y, math.exp(log_tau))[1],
        bounds=(math.log(low), math.log(high)),
        method="bounded",
        options={"xatol": 1e-7},
    )
    tau = math.exp(float(found.x))
    (start, end), rss = _for_tau(t, y, tau)
    return float(start), float(end), tau, rss


def _probability(rss0: float, rss1: float, n: int, taus: Array) -> float:
    """Of the F-test; as the best of many time constants was taken, the chances of independent ones add up."""
    if rss1 <= 1e-24 * max(rss0, 1e-300):
        return 0.0 if rss0 > 0.0 else 1.0
    trials = 1.0 + math.log(taus[-1] / taus[0]) / 4.0
    return min(1.0, trials * chance_gain(rss0, rss1, 2, n - 3))


def _sigmas(t: Array, found: tuple[float, float, float], rms: float) -> tuple[float, float, float, float]:
    """Of start, end, time constant and change."""
    start, end, tau = found
    decay = np.exp(-t / tau)
    J = np.column_stack([decay, 1.0 - decay, (start - end) * decay * t / tau**2])
    fit = solve(J, np.zeros(len(t)))
    if fit.condition < 1e-8:
        return math.inf, math.inf, math.inf, math.inf
    Q = fit.cofactors * rms**2
    of_change = Q[0, 0] + Q[1, 1] - 2.0 * Q[0, 1]
    return math.sqrt(Q[0, 0]), math.sqrt(Q[1, 1]), math.sqrt(Q[2, 2]), math.sqrt(max(of_change, 0.0))


def _verdict(t: Array, tau: float, sigma_tau: float, change: tuple[float, float]) -> str:
    step = float(np.median(np.diff(t)))
    if tau > 2.0 * t[-1] or (tau > t[-1] / 2.0 and not sigma_tau < _KNOWN * tau):
        return (
            f"the series of {t[-1]:.4g} s is too short to see the end of the change: its time constant is longer than "
            f"about {t[-1] / 2:.3g} s"
        )
    if tau < step / 2.0 or not sigma_tau < _KNOWN * tau:
        if change[0] < 3.0 * change[1] or tau < step:
            return f"the change is over within about {step:.3g} s, the distance of two measurements: too fast to follow"
        return "the change is seen, its time constant only roughly"
    return "exponential approach"
