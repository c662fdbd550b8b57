"""Drift of a camera that warms up: shift, scale and rotation of targets over time (Behr 1989, §4.1.1, fig. 4.2)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.linear import Decomposed, solve
from photoplan.errors import GeometryError, InputError
from photoplan.quality.camera.approach import LEAST_VALUES, Approach, check_times, fit_approach

Array = NDArray[np.float64]

#: Parameters of each model, in the order of its unknowns after the shift.
MODELS = {"shift": (), "similarity": ("scale", "rotation"), "affine": ("scale_x", "scale_y", "rotation", "shear")}
#: Targets that determine the parameters of each model.
_LEAST_TARGETS = {"shift": 1, "similarity": 2, "affine": 3}


@dataclass(frozen=True, eq=False)
class Course:
    """One parameter over time."""

    name: str
    unit: str
    values: Array
    """Against the reference, shape (m,)."""
    sigmas: Array
    approach: Approach | None
    """Exponential course; None: too few epochs."""
    largest: float
    """Largest minus smallest value."""


@dataclass(frozen=True, eq=False)
class Movement:
    """How far each target moved."""

    name: str
    shift: Array
    """Against the reference, shape (m, 2), pixels."""
    largest: tuple[float, float]
    """Largest minus smallest column and row."""


@dataclass(frozen=True, eq=False)
class WarmUp:
    """Drift of the camera's coordinate system against the targets."""

    times: Array
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
    times: Array, positions: Mapping[str, Array], *, model: str | None = None, reference: str = "first"
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
    sigmas, sigma0 = _sigmas(epochs, repeat, P, reference)
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


def _known(values: Array) -> Array:
    return values[np.isfinite(values)]


def _stacked(t: Array, positions: Mapping[str, Array]) -> tuple[tuple[str, ...], Array]:
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


def _repeatability(P: Array) -> tuple[tuple[float, float] | None, int]:
    """Pooled standard deviation within the epochs, and its redundancy per coordinate."""
    counts = np.isfinite(P).all(axis=3).sum(axis=2)
    redundancy = int(np.clip(counts - 1, 0, None).sum())
    if redundancy < 1:
        return None, 0
    repeated = P[counts > 1]
    squares = np.nansum((repeated - np.nanmean(repeated, axis=1, keepdims=True)) ** 2, axis=(0, 1))
    x, y = np.sqrt(squares / redundancy)
    return (float(x), float(y)), redundancy


def _design(d: Array, model: str) -> Array:
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

    values: Array
    cofactors: Array
    squares: Array
    freedom: int
    weights: Array


def _epochs(d: Array, moved: Array, model: str, repeat: tuple[float, float] | None) -> _Epochs:
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


def _weights(repeat: tuple[float, float] | None) -> Array:
    """Of columns and rows, from the repetitions."""
    if repeat is None or not min(repeat) > 0.0:
        return np.ones(2)
    return np.array([1.0, repeat[0] / repeat[1]])


def _sigmas(
    epochs: _Epochs, repeat: tuple[float, float] | None, P: Array, reference: str
) -> tuple[Array, tuple[float, float]]:
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


def _courses(t: Array, values: Array, sigmas: Array, model: str) -> tuple[Course, ...]:
    names = ("shift_x", "shift_y", *MODELS[model])
    units = {"shift_x": "px", "shift_y": "px", "rotation": "rad", "shear": "rad"}
    out = []
    for k, name in enumerate(names):
        y, s = values[:, k], sigmas[:, k]
        use = np.isfinite(y)
        approach = fit_approach(t[use], y[use], what=f"warm-up, {name}") if use.sum() >= LEAST_VALUES else None
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
