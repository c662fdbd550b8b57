"""Drift and blooming: exponential settling, warm-up, brightness."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from math import nan, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize, special

from photoplan.adjustment.least_squares import Decomposed, solve
from photoplan.adjustment.statistics import chance_gain, chance_t
from photoplan.arrays import Floats, Floats32, Ints, Mask
from photoplan.errors import GeometryError, InputError

#: Values below which no exponential is fitted: its three unknowns need something that checks them.
LEAST_VALUES = 8
#: Chance of error below which a change is taken as real.
LEVEL = 0.01
#: Time constants that are tried before the best is refined.
_CANDIDATES = 80
#: A time constant is known when its standard deviation is below this part of it.
_KNOWN = 0.5


@dataclass(frozen=True, kw_only=True)
class Settling:
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

    def at(self, time: Floats | float) -> Floats:
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


def check_times(times: Floats, what: str) -> Floats:
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


def fit_settling(times: Floats, values: Floats, what: str = "series") -> Settling:
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
        return Settling(mean=mean, rms=rms, probability=probability, redundancy=n - 1, verdict=verdict)
    rms = math.sqrt(rss1 / (n - 3))
    sigmas = _sigmas(t, (start, end, tau), rms)
    verdict = _verdict(t, tau, sigmas[2], (abs(end - start), sigmas[3]))
    seen = Settling(mean=mean, rms=rms, probability=probability, redundancy=n - 3, verdict=verdict)
    if verdict.startswith("the series"):  # its end is not seen
        return replace(seen, start=start)
    seen = replace(seen, end=end)
    if verdict.startswith("the change"):  # neither are its size and time
        return seen
    return replace(
        seen, start=start, change=end - start, sigma_change=sigmas[3], time_constant=tau, sigma_time_constant=sigmas[2]
    )


def _checked(times: Floats, values: Floats, what: str) -> tuple[Floats, Floats]:
    t, y = check_times(times, what), np.asarray(values, float)
    if y.shape != t.shape:
        raise InputError(f"{what}: {y.size} values at {t.size} times; as many of both are needed")
    if len(y) < LEAST_VALUES:
        raise InputError(f"{what}: {len(y)} measurements; at least {LEAST_VALUES} are needed to follow a change")
    if not np.isfinite(y).all():
        raise InputError(f"{what}: measurement {int(np.flatnonzero(~np.isfinite(y))[0]) + 1} has no value")
    return t, y


def _for_tau(t: Floats, y: Floats, tau: float) -> tuple[Floats, float]:
    """Start and end for a given time constant, and the sum of squares that remains."""
    decay = np.exp(-t / tau)
    fit = solve(np.column_stack([decay, 1.0 - decay]), y)
    return fit.unknowns, fit.square


def _refined(t: Floats, y: Floats, taus: Floats, best: int) -> tuple[float, float, float, float]:
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


def _probability(rss0: float, rss1: float, n: int, taus: Floats) -> float:
    """Of the F-test; as the best of many time constants was taken, the chances of independent ones add up."""
    if rss1 <= 1e-24 * max(rss0, 1e-300):
        return 0.0 if rss0 > 0.0 else 1.0
    trials = 1.0 + math.log(taus[-1] / taus[0]) / 4.0
    return min(1.0, trials * chance_gain(rss0, rss1, 2, n - 3))


def _sigmas(t: Floats, found: tuple[float, float, float], rms: float) -> tuple[float, float, float, float]:
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


def _verdict(t: Floats, tau: float, sigma_tau: float, change: tuple[float, float]) -> str:
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


#: Parameters of each model, in the order of its unknowns after the shift.
MODELS = {"shift": (), "similarity": ("scale", "rotation"), "affine": ("scale_x", "scale_y", "rotation", "shear")}
#: Targets that determine the parameters of each model.
_LEAST_TARGETS = {"shift": 1, "similarity": 2, "affine": 3}


@dataclass(frozen=True, eq=False)
class Course:
    """One parameter over time."""

    name: str
    unit: str
    values: Floats
    """Against the reference, shape (m,)."""
    sigmas: Floats
    approach: Settling | None
    """Exponential course; None: too few epochs."""
    largest: float
    """Largest minus smallest value."""


@dataclass(frozen=True, eq=False)
class Movement:
    """How far each target moved."""

    name: str
    shift: Floats
    """Against the reference, shape (m, 2), pixels."""
    largest: tuple[float, float]
    """Largest minus smallest column and row."""


@dataclass(frozen=True, eq=False)
class WarmUp:
    """Drift of the camera's coordinate system against the targets."""

    times: Floats
    """Of the epochs since the first, seconds, shape (m,)."""
    model: str
    courses: tuple[Course, ...]
    targets: tuple[Movement, ...]
    repeat_sigma: tuple[float, float] | None
    """Standard deviation of a single measurement in column and row from repetitions; None: no repetitions."""
    repeat_redundancy: int
    sigma0: tuple[float, float]
    """Standard deviation of an epoch's column and row from the residuals of the model; NaN: no redundancy."""
    reference: str
    centre: tuple[float, float]
    """Column and row to which the shift refers."""
    notes: tuple[str, ...]

    def course(self, name: str) -> Course:
        """The course of a parameter."""
        return next(c for c in self.courses if c.name == name)


def warm_up(
    times: Floats, positions: Mapping[str, Floats], *, model: str | None = None, reference: str = "first"
) -> WarmUp:
    """Separate shift, scale and rotation of targets over time.

    Every epoch is transformed from the reference by least squares: x' = x + t + M (x − c), with the shift t at the
    middle c of the targets. One target gives a shift only: what moves it, shift or scale, then stays open. Two give
    scale and rotation too, three (not on a line) the scales of columns and rows apart.
    """
    t = check_times(times, "warm-up")
    names, P = _stacked(t, positions)
    chosen = model or ("similarity" if len(names) > 1 else "shift")
    _check_model(chosen, names, reference)
    repeat, redundancy = _repeatability(P)
    with np.errstate(invalid="ignore"):
        mean = np.nansum(P, axis=2) / np.isfinite(P).all(axis=3).sum(axis=2)[..., None]
    base = np.nanmean(mean, axis=1) if reference == "mean" else mean[:, 0]
    if not np.isfinite(base).all():
        lost = [n for n, xy in zip(names, base) if not np.isfinite(xy).all()]
        raise InputError(
            f"warm-up: target {', '.join(lost)} is not measured in the first epoch; leave it out, or refer to the mean"
        )
    middle = tuple(float(v) for v in base.mean(axis=0))
    moved = mean - base[:, None]
    epochs = _epochs(base - middle, moved, chosen, repeat)
    sigmas, sigma0 = _sigmas_warm_up(epochs, repeat, P, reference)
    courses = _courses(t, epochs.values, sigmas, chosen)
    return WarmUp(
        times=t - t[0],
        model=chosen,
        courses=courses,
        targets=tuple(
            Movement(n, xy, (float(np.nanmax(xy[:, 0]) - np.nanmin(xy[:, 0])), float(np.ptp(_known(xy[:, 1])))))
            for n, xy in zip(names, moved)
        ),
        repeat_sigma=repeat,
        repeat_redundancy=redundancy,
        sigma0=sigma0,
        reference=reference,
        centre=(middle[0], middle[1]),
        notes=_notes(chosen, names, repeat, len(t)),
    )


def _known(values: Floats) -> Floats:
    return values[np.isfinite(values)]


def _stacked(t: Floats, positions: Mapping[str, Floats]) -> tuple[tuple[str, ...], Floats]:
    """Names, and positions of shape (targets, epochs, repetitions, 2)."""
    if not positions:
        raise InputError("warm-up: no target is given")
    if len(t) < 3:
        raise InputError(f"warm-up: {len(t)} epochs; at least 3 are needed to see a drift")
    parts = []
    for name, xy in positions.items():
        a = np.asarray(xy, float)
        a = a[:, None] if a.ndim == 2 else a
        if a.ndim != 3 or a.shape[0] != len(t) or a.shape[2] != 2 or not a.shape[1]:
            raise InputError(f"warm-up: target {name} has positions of shape {a.shape} for {len(t)} epochs")
        if np.isfinite(a).all(axis=2).any(axis=1).sum() < 3:
            raise InputError(f"warm-up: target {name} is measured in less than 3 epochs; leave it out")
        parts.append(a)
    most = max(a.shape[1] for a in parts)
    return tuple(positions), np.stack(
        [np.pad(a, ((0, 0), (0, most - a.shape[1]), (0, 0)), constant_values=np.nan) for a in parts]
    )


def _check_model(model: str, names: tuple[str, ...], reference: str) -> None:
    if model not in MODELS:
        raise InputError(f"warm-up: model {model!r}; allowed are {', '.join(MODELS)}")
    if reference not in ("first", "mean"):
        raise InputError(f"warm-up: reference {reference!r}; allowed are first, mean")
    if len(names) < _LEAST_TARGETS[model]:
        raise GeometryError(
            f"warm-up: {len(names)} target for the model {model}; it needs {_LEAST_TARGETS[model]}: with less, a scale "
            "cannot be told from a shift. Measure more targets, or ask for the shift alone"
        )


def _repeatability(P: Floats) -> tuple[tuple[float, float] | None, int]:
    """Pooled standard deviation within the epochs, and its redundancy per coordinate."""
    counts = np.isfinite(P).all(axis=3).sum(axis=2)
    redundancy = int(np.clip(counts - 1, 0, None).sum())
    if redundancy < 1:
        return None, 0
    repeated = P[counts > 1]
    squares = np.nansum((repeated - np.nanmean(repeated, axis=1, keepdims=True)) ** 2, axis=(0, 1))
    x, y = np.sqrt(squares / redundancy)
    return (float(x), float(y)), redundancy


def _design(d: Floats, model: str) -> Floats:
    """Columns and rows of offsets d (k, 2) from the centre: derivatives by the unknowns, shape (2 k, u)."""
    k = len(d)
    A = np.zeros((2, k, 2 + len(MODELS[model])))
    A[0, :, 0] = A[1, :, 1] = 1.0
    x, y = d.T
    if model == "similarity":
        A[:, :, 2] = x, y
        # Clockwise as one looks at the image, from columns to rows.
        A[:, :, 3] = -y, x
    elif model == "affine":
        A[0, :, 2], A[1, :, 3] = x, y
        A[:, :, 4] = -y, x
        # Half of the shear belongs to each axis, so that rotation is their mean.
        A[:, :, 5] = y / 2.0, x / 2.0
    return A.reshape(2 * k, -1)


@dataclass(frozen=True, eq=False)
class _Epochs:
    """Parameters of every epoch, their cofactors; sums of squares of columns and rows, redundancy and weights."""

    values: Floats
    cofactors: Floats
    squares: Floats
    freedom: int
    weights: Floats


def _epochs(d: Floats, moved: Floats, model: str, repeat: tuple[float, float] | None) -> _Epochs:
    A = _design(d, model)
    k, m, u = len(d), moved.shape[1], A.shape[1]
    parts = Decomposed.of(A)
    if parts.s[-1] < 1e-6 * parts.s[0]:
        raise GeometryError(
            f"warm-up: the {k} targets do not determine the model {model}: they lie at one place or on a line; "
            "measure targets beside it, or ask for a smaller model"
        )
    values, cofactors = np.full((m, u), np.nan), np.full((m, u, u), np.nan)
    squares, freedom = np.zeros(2), 0
    weights = _weights(repeat)
    for i in range(m):
        y = moved[:, i].T.ravel()
        use = np.isfinite(y)
        fit = solve(A[use], y[use], np.repeat(weights, k)[use] ** 2) if use.sum() >= u else None
        if fit is None or fit.rank < u:
            continue
        values[i], cofactors[i] = fit.unknowns, fit.cofactors
        squares += np.bincount(np.flatnonzero(use) // k, fit.residuals**2, 2)
        freedom += fit.redundancy
    # One epoch's redundancy goes into the reference.
    freedom -= 2 * k - u
    return _Epochs(values=values, cofactors=cofactors, squares=squares, freedom=max(freedom, 0), weights=weights)


def _weights(repeat: tuple[float, float] | None) -> Floats:
    """Of columns and rows, from the repetitions."""
    if repeat is None or not min(repeat) > 0.0:
        return np.ones(2)
    return np.array([1.0, repeat[0] / repeat[1]])


def _sigmas_warm_up(
    epochs: _Epochs, repeat: tuple[float, float] | None, P: Floats, reference: str
) -> tuple[Floats, tuple[float, float]]:
    """Standard deviations of the parameters against the reference, and sigma0 of an epoch's columns and rows.

    The variance of unit weight comes from residuals where these have redundancy, else from repetitions.
    """
    m, weights, freedom = len(epochs.cofactors), epochs.weights, epochs.freedom
    # Against the first epoch, every difference holds two epochs' errors; against the mean, a little less than one.
    both = 2.0 if reference == "first" else (m - 1.0) / m
    sigma0 = (math.nan, math.nan)
    if freedom >= 6:
        level = float((epochs.squares * weights**2).sum()) / freedom / (2.0 if reference == "first" else 1.0)
        sigma0 = (math.sqrt(level) / float(weights[0]), math.sqrt(level) / float(weights[1]))
    elif repeat is not None:
        count = np.isfinite(P).all(axis=3).sum(axis=2)
        level = repeat[0] ** 2 / float(np.mean(count[count > 0]))
    else:
        level = math.nan
    sigmas = np.sqrt(np.einsum("iuu->iu", epochs.cofactors) * level * both)
    if reference == "first":
        sigmas[0] = 0.0
    return sigmas, sigma0


def _courses(t: Floats, values: Floats, sigmas: Floats, model: str) -> tuple[Course, ...]:
    names = ("shift_x", "shift_y", *MODELS[model])
    units = {"shift_x": "px", "shift_y": "px", "rotation": "rad", "shear": "rad"}
    out = []
    for k, name in enumerate(names):
        y, s = values[:, k], sigmas[:, k]
        use = np.isfinite(y)
        approach = fit_settling(t[use], y[use], what=f"warm-up, {name}") if use.sum() >= LEAST_VALUES else None
        out.append(
            Course(
                name=name,
                unit=units.get(name, "parts"),
                values=y,
                sigmas=s,
                approach=approach,
                largest=float(np.ptp(_known(y))),
            )
        )
    return tuple(out)


def _notes(model: str, names: tuple[str, ...], repeat: tuple[float, float] | None, epochs: int) -> tuple[str, ...]:
    notes = []
    if model == "shift":
        notes.append(
            "one target: a change of scale cannot be told from a shift; two targets are needed"
            if len(names) == 1
            else "only a shift was adjusted; a change of scale is in its residuals"
        )
    if model == "similarity" and len(names) == 2:
        notes.append("two targets determine shift, scale and rotation without any check")
    if repeat is None:
        notes.append("no repetitions: the standard deviation of a measurement is not known by itself")
    if epochs < LEAST_VALUES + 1:
        notes.append(f"{epochs} epochs: too few for a course over time ({LEAST_VALUES + 1} are needed)")
    return tuple(notes)


#: Measurements below which long and short term cannot be told apart.
LEAST_MEASUREMENTS = 10
_EVEN = 0.05
"""Largest difference of an interval from their median, as part of it, at which they count as equal."""
_CLASSES = 12


@dataclass(frozen=True, eq=False)
class Variation:
    """How much grey values differ over a lapse of time: from flicker, where it is short, to drift."""

    lapse: Floats
    """Seconds, shape (k,)."""
    structure: Floats
    """Root of half the mean squared difference of two values this lapse apart; for white noise, its sigma; (k,)."""
    pairs: Ints
    """Of values, shape (k,)."""
    allan: Floats
    """Allan deviation of means over the lapse; for white noise it falls by its root; NaN: not enough means, (k,)."""


@dataclass(frozen=True, eq=False)
class BrightnessDrift:
    """The figures of table 4.1, and what of them is flicker, drift and trend."""

    count: int
    mean: float
    """Ī"""
    minimum: float
    """I_min"""
    maximum: float
    """I_max"""
    sigma: float
    """σ_I: standard deviation of one measurement, of all about their mean."""
    largest_step: float
    """Δ_I: largest difference of two successive measurements."""
    short_sigma: float
    """Standard deviation within the interval of two measurements, from successive differences."""
    long_sigma: float
    """What is left of `sigma` without it; 0 if nothing."""
    sigma_of_short: float
    """Standard deviation of `short_sigma` itself."""
    neumann: float
    """Mean squared successive difference over variance: 2 for white noise, less for drift (von Neumann)."""
    neumann_probability: float
    """Chance that white noise gives as little."""
    trend: float
    """Grey values per hour, straight line by least squares."""
    sigma_trend: float
    """Its standard deviation, with the correlation of successive residuals taken into account."""
    trend_probability: float
    """Chance that a series without trend gives as much."""
    pixel_noise: float | None
    """σ that the noise of the pixels leaves in the mean of the window; None: not known."""
    variation: Variation
    times: Floats
    values: Floats

    @property
    def drifts(self) -> bool:
        """Whether the values are not white noise, with a chance of error of 1 %."""
        return self.neumann_probability < 0.01

    @property
    def has_trend(self) -> bool:
        """Whether there is a trend, with a chance of error of 1 %."""
        return self.trend_probability < 0.01


def brightness_drift(
    times: Floats, values: Floats, pixel_noise: float | None = None, name: str = "series"
) -> BrightnessDrift:
    """Figures of repeated measurements of one constant brightness."""
    t, y = check_times(times, name), np.asarray(values, float)
    if y.shape != t.shape or not np.isfinite(y).all():
        raise InputError(f"{name}: {y.size} finite grey values at {t.size} times are needed, one per frame")
    n = len(y)
    if n < LEAST_MEASUREMENTS:
        raise InputError(f"{name}: {n} measurements; at least {LEAST_MEASUREMENTS} are needed to speak of drift")
    sigma = float(y.std(ddof=1))
    if sigma == 0.0:
        raise InputError(
            f"{name}: all {n} measurements are exactly {y[0]:g}: saturated, or the same frame again; nothing drifts"
        )
    steps = np.diff(y)
    squares = float((steps**2).mean())
    short = math.sqrt(squares / 2.0)
    neumann = squares / (sigma**2 * (n - 1) / n)
    # Moments of the ratio for white noise (von Neumann 1941): mean 2n/(n−1), variance 4n²(n−2)/((n+1)(n−1)³).
    z = (neumann - 2.0 * n / (n - 1)) / math.sqrt(4.0 * n**2 * (n - 2) / ((n + 1) * (n - 1) ** 3))
    trend, sigma_trend, probability = _trend(t, y)
    return BrightnessDrift(
        count=n,
        mean=float(y.mean()),
        minimum=float(y.min()),
        maximum=float(y.max()),
        sigma=sigma,
        largest_step=float(np.abs(steps).max()),
        short_sigma=short,
        long_sigma=math.sqrt(max(sigma**2 - short**2, 0.0)),
        # Of n−1 differences that overlap: variance of their mean square is (3n−4)/(n−1)² σ⁴ for white noise.
        sigma_of_short=short * math.sqrt(3.0 * n - 4.0) / (n - 1) / 2.0,
        neumann=neumann,
        neumann_probability=float(special.ndtr(z)),
        trend=trend,
        sigma_trend=sigma_trend,
        trend_probability=probability,
        pixel_noise=pixel_noise,
        variation=_variation(t, y),
        times=t,
        values=y,
    )


def _trend(t: Floats, y: Floats) -> tuple[float, float, float]:
    """Slope per hour, its standard deviation and the chance of as much without trend.

    Successive residuals of a drifting brightness resemble each other: n of them count as n (1 − r) / (1 + r), with r
    the correlation of neighbours. A straight line through them makes r too small, by about (2 + 4 r) / n.
    """
    hours = (t - t.mean()) / 3600.0
    n, square = len(y), float(hours @ hours)
    slope = float(hours @ y) / square
    residuals = y - y.mean() - slope * hours
    rss = float(residuals @ residuals)
    if rss <= 1e-24 * float(y @ y):
        return slope, 0.0, 0.0 if slope else 1.0
    r = float(residuals[1:] @ residuals[:-1]) / rss
    r += (2.0 + 4.0 * max(r, 0.0)) / n
    r = min(r, 0.98) if r > 2.0 / math.sqrt(n) else 0.0
    count = max(n * (1.0 - r) / (1.0 + r), 3.0)
    freedom = max(count - 2.0, 1.0)
    sigma = math.sqrt(rss / (n - 2.0) / square * n / count)
    return slope, sigma, chance_t(slope / sigma, freedom)


def _variation(t: Floats, y: Floats) -> Variation:
    """Structure function over classes of lapse that double, and Allan deviation where the intervals are equal."""
    n = len(t)
    intervals = np.diff(t)
    step = float(np.median(intervals))
    even = bool((np.abs(intervals - step) <= _EVEN * step).all())
    lapses, structure, pairs, allan = [], [], [], []
    for power in range(_CLASSES):
        m = 2**power
        if m > n // 2:
            break
        # The same number of measurements apart, and for uneven times only those about as far apart in time.
        apart = t[m:] - t[:-m]
        use = np.ones(n - m, bool) if even else np.abs(apart - m * step) <= 0.5 * m * step
        if use.sum() < 3:
            continue
        lapses.append(float(apart[use].mean()))
        structure.append(math.sqrt(float(((y[m:] - y[:-m])[use] ** 2).mean()) / 2.0))
        pairs.append(int(use.sum()))
        allan.append(_allan(y, m) if even else math.nan)
    return Variation(np.array(lapses), np.array(structure), np.array(pairs, np.int64), np.array(allan))


def _allan(y: Floats, m: int) -> float:
    """Deviation of overlapping means of m values: root of half the mean square of differences of adjacent means."""
    total = np.concatenate([[0.0], np.cumsum(y - y.mean())])
    means = (total[m:] - total[:-m]) / m
    if len(means) <= m:
        return math.nan
    return math.sqrt(float(((means[m:] - means[:-m]) ** 2).mean()) / 2.0)


#: Pixels from the object up to which its neighbours lie. The nearest ones count, since charge fills them first; what
#: they hold of the object's own light belongs to their response.
_FAR = 4
#: Standard deviations by which neighbours must exceed what was expected.
_SIGNIFICANT = 4.0
#: Part of the range of grey values up to which the threshold of lifted pixels tells them.
_TOLD = 0.25
#: Part of the brightest grey value that the object reaches, up to which it gives the responses.
_SAFE = 0.55


@dataclass(frozen=True, eq=False)
class Blooming:
    """What neighbours of a bright object show."""

    onset_dn: float
    """Grey value of the object above black, from its response, at which neighbours begin to grow faster; NaN: they do
    not."""
    onset_dn_sigma: float
    last_without: float
    """Object's grey value above black at the longest exposure without blooming."""
    object_dn: Floats
    """Grey value of the object above black that its response promises at each exposure."""
    excess_dn: Floats
    """Grey value of the neighbours above what was expected."""
    excess_sigma: Floats
    extent_rows: int
    """Pixels beyond the object along columns (up or down) that are lifted at `extent_exposure`."""
    extent_columns: int
    """The same along rows."""
    extent_exposure: float
    """The longest exposure at which lifted pixels can be told."""


def find_blooming(
    exposures: Sequence[float],
    images: Sequence[NDArray[Any]],
    black: float | Sequence[float],
    saturation: float,
    step: float = 1.0,
) -> Blooming:
    """Onset and extent of blooming around the brightest object."""
    if len(exposures) < 4 or (np.diff(exposures) <= 0).any():
        raise InputError(f"{len(exposures)} exposures; blooming needs four that increase")
    blacks = np.broadcast_to(np.asarray(black, float), len(exposures))
    lights = [np.asarray(image, np.float32) - np.float32(below) for image, below in zip(images, blacks)]
    spans = saturation - blacks
    span = float(spans[0])
    tops = [_brightest(light) for light in lights]
    # Charge that runs over may keep the object far below the largest grey value.
    reached = min(span, max(tops))
    safe = [k for k, top in enumerate(tops) if top <= _SAFE * reached]
    if len(safe) < 2:
        raise InputError(
            f"the bright object is below half of its brightest grey value in {len(safe)} of {len(tops)} exposures; "
            "blooming needs two or more: expose shorter"
        )
    response = _response(exposures, lights, safe)
    bright = _object(response)
    near = _neighbours(response, bright)
    inside = response[bright]
    of_object = float(inside[inside >= 0.9 * np.percentile(inside, 90)].mean())
    times = np.array(exposures, float)
    excess = np.array(
        [
            float((light[near] - np.minimum(response[near] * t, full)).mean())
            for light, t, full in zip(lights, times, spans)
        ]
    )
    sigma = _sigmas_blooming(lights, times, response, near, safe, step)
    usable = np.array([float(np.median(light[near])) < 0.95 * full for light, full in zip(lights, spans)])
    object_dn = of_object * times
    onset, onset_sigma, last = _onset(object_dn, excess, sigma, usable)
    if not np.isfinite(onset) and object_dn[-1] < 0.95 * span:
        raise InputError(
            f"no blooming, but the bright object reaches only {object_dn[-1]:.4g} DN of {span:.4g}; expose it longer"
        )
    thresholds = np.maximum(_SIGNIFICANT * sigma * sqrt(near.sum()), 0.03 * reached)
    # Single pixels' responses are uncertain: far beyond the exposures that gave them they promise nothing.
    last_told = int(np.flatnonzero(thresholds <= _TOLD * span)[-1]) if (thresholds <= _TOLD * span).any() else 0
    promised = response * times[last_told]
    full = float(spans[last_told])
    lifted = lights[last_told] - np.minimum(promised, full) > thresholds[last_told]
    # What is full by its own light, blurred edges and stray light included, is the object by then.
    rows, columns = _extent(lifted, bright, _grown(bright, promised >= 0.9 * full))
    return Blooming(
        onset_dn=onset,
        onset_dn_sigma=onset_sigma,
        last_without=last,
        object_dn=object_dn,
        excess_dn=excess,
        excess_sigma=sigma,
        extent_rows=rows,
        extent_columns=columns,
        extent_exposure=float(times[last_told]),
    )


def _brightest(image: NDArray[Any]) -> float:
    """Largest value that more than a pixel has."""
    return float(ndimage.median_filter(np.asarray(image, np.float32), 3, mode="nearest").max())


def _response(exposures: Sequence[float], lights: Sequence[Floats32], safe: Sequence[int]) -> Floats:
    """Grey values per exposure of every pixel, from the exposures without saturation."""
    total = np.zeros(lights[0].shape)
    weight = 0.0
    for k in safe:
        total += exposures[k] * lights[k].astype(np.float64)
        weight += exposures[k] ** 2
    return total / weight


def _object(response: Floats) -> Mask:
    """Pixels of the brightest object: over half of the largest response, the largest connected patch."""
    top = _brightest(response)
    patches, count = ndimage.label(response > 0.5 * top)
    if not count:
        raise InputError("no bright object found")
    sizes = np.bincount(patches.ravel())[1:]
    found = patches == 1 + int(np.argmax(sizes))
    if found.sum() < 4 or found.mean() > 0.5:
        raise InputError(
            f"the bright object has {int(found.sum())} of {found.size} pixels; blooming needs a small bright object on "
            "a dark ground: give a roi around one"
        )
    return np.asarray(found)


def _grown(bright: Mask, full: Mask) -> Mask:
    """The object with the full pixels that are connected to it."""
    patches, _ = ndimage.label(bright | full)
    return np.isin(patches, np.unique(patches[bright]))


def _neighbours(response: Floats, bright: Mask) -> Mask:
    """Dark pixels close to the object."""
    square = np.ones((3, 3), bool)
    far = ndimage.binary_dilation(bright, square, _FAR)
    near = far & ~bright & (response < 0.25 * float(response[bright].mean()))
    if near.sum() < 8:
        raise InputError("the bright object has no dark surrounding; give a roi around an object on a dark ground")
    return np.asarray(near)


def _sigmas_blooming(
    lights: Sequence[Floats32], times: Floats, response: Floats, near: Mask, safe: Sequence[int], step: float
) -> Floats:
    """Standard deviation of the mean excess: noise of the neighbours, and that of their responses."""
    residual = np.concatenate([(lights[k][near] - response[near] * times[k]) for k in safe])
    freedom = max(residual.size - near.sum(), 1)
    noise = sqrt(max(float(np.sum(residual**2)) / freedom, step**2 / 12))
    of_response = noise / sqrt(float(np.sum(times[list(safe)] ** 2)))
    level = np.array([max(float(light[near].mean()), step) for light in lights])
    base = max(float(np.mean(level[list(safe)])), step)
    grown = noise * np.sqrt(np.maximum(level / base, 1.0))  # shot noise
    return np.asarray(np.sqrt(grown**2 + (of_response * times) ** 2) / sqrt(near.sum()))


def _onset(level: Floats, excess: Floats, sigma: Floats, usable: Mask) -> tuple[float, float, float]:
    """Where the excess leaves zero by the line through the first levels with blooming, its sigma, last without."""
    above = excess > _SIGNIFICANT * sigma
    without = np.flatnonzero(~above)
    first = int(without[-1]) + 1 if without.size else 0
    last = float(level[first - 1]) if first else 0.0
    if first >= level.size:
        return nan, nan, last
    beyond = [k for k in range(first, level.size) if usable[k]][:3]
    upper, before = float(level[first]), float(level[first - 2]) if first > 1 else 0.0
    crossings = [_crossing(level[[i, j]], excess[[i, j]]) for i, j in pairwise(beyond)]
    if crossings and before <= crossings[0] <= upper:
        i, j = beyond[:2]
        spread = float(np.hypot(2 * sigma[i], sigma[j]) * (level[j] - level[i]) / (excess[j] - excess[i]))
        # The growth is no straight line: how far the next pair leads elsewhere says by how much.
        bend = abs(crossings[1] - crossings[0]) if len(crossings) > 1 else (upper - last) / sqrt(12.0)
        return crossings[0], float(np.hypot(max(spread, 0.1 * (upper - last)), min(bend, upper - last))), last
    return (last + upper) / 2, (upper - last) / sqrt(12.0), last


def _crossing(level: Floats, excess: Floats) -> float:
    """Where the line through two levels has no excess; NaN where it does not grow."""
    slope = (excess[1] - excess[0]) / (level[1] - level[0])
    return float(level[0] - excess[0] / slope) if slope > 0 else nan


def _extent(lifted: Mask, bright: Mask, grown: Mask) -> tuple[int, int]:
    """Longest unbroken run of lifted pixels from the grown object along the object's columns and along its rows."""
    return _run(lifted, bright, grown), _run(lifted.T, bright.T, grown.T)


def _run(lifted: Mask, bright: Mask, grown: Mask) -> int:
    longest = 0
    for col in np.flatnonzero(bright.any(axis=0)):
        rows = np.flatnonzero(grown[:, col])
        below, above = lifted[rows[-1] + 1 :, col], lifted[: rows[0], col][::-1]
        for side in (below, above):
            stop = np.flatnonzero(~side)
            longest = max(longest, int(stop[0]) if stop.size else side.size)
    return longest
