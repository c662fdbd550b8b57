"""Lens distortion from straight lines, and calibration by a stage (Behr 1989, appendix B)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import special

from photoplan.adjustment.least_squares import Fit, by_differences, solve
from photoplan.adjustment.statistics import chance_chi_square, chance_f, chance_gain
from photoplan.arrays import Floats, Ints, Mask
from photoplan.cameras.fiducials import Affine2D, AffineFacts, affine_facts
from photoplan.errors import GeometryError, InputError

#: Points of a calibration: three determine an affine transformation, the fourth checks it. More than
#: the most are no targets that somebody measured.
LEAST_POINTS = 4
MOST_POINTS = 10_000
_GON = 200.0 / math.pi
#: Chance of a false alarm for a gross error among all points, and for a systematic part of the residuals.
LEVEL = 0.001
#: Relative step of the numerical derivatives.
_DIFFERENCE = 1e-6


@dataclass(frozen=True, eq=False)
class StageCalibration:
    """Affine transformation between stage and image, and what it means."""

    names: tuple[str, ...]
    stage: Floats
    """Stage coordinates, shape (n, 2)."""
    measured: Floats
    """Columns and rows, shape (n, 2), pixels."""
    to_image: Affine2D
    """From stage to image: X = a1 x + a2 y + a3, Y = a4 x + a5 y + a6."""
    to_stage: Affine2D
    """From image to stage."""
    covariance: Floats
    """Of a1 … a6, shape (6, 6)."""
    residuals: Floats
    """Measured minus transformed, shape (n, 2), pixels; of all points."""
    sigma: tuple[float, float]
    """Standard deviation of a column and of a row."""
    sigma0: float
    """M0: of both."""
    redundancy: int
    gross: tuple[str, ...]
    """Points that were left out: their residual is beyond chance."""
    facts: AffineFacts
    sigma_pixel_size: tuple[float, float]
    sigma_direction: tuple[float, float]
    """Of the two axes, radians."""
    sigma_shear: float
    systematic: float | None
    """Chance that residuals without system follow second-order terms as much; None: too few points."""

    @property
    def printed_rotation_y(self) -> float:
        """What fig. B.4 prints as rotation of the y axis: minus the sum of both directions, gon."""
        return -(self.facts.direction_x + self.facts.direction_y) * _GON


def stage_calibration(names: Iterable[str], stage: Floats, measured: Floats) -> StageCalibration:
    """Adjust the affine transformation from a stage's coordinates to columns and rows.

    A point whose studentised residual is beyond chance is left out, one after the other.
    """
    labels, S, P = _checked(names, stage, measured)
    used = np.ones(len(labels), bool)
    while True:
        A = np.column_stack([S, np.ones(len(S))])
        fit = solve(A[used], P[used])
        residuals = P - A @ fit.unknowns
        worst = _worst(fit, used)
        if worst is None:
            break
        used[worst] = False
        if used.sum() < max(LEAST_POINTS + 1, 0.7 * len(used)):
            lost = ", ".join(n for n, u in zip(labels, used) if not u)
            raise InputError(
                f"stage calibration: after {lost} no affine transformation fits the {int(used.sum())} points that are "
                "left; check the stage coordinates, their signs and their order"
            )
    columns, rows = np.sqrt((fit.residuals**2).sum(axis=0) / (fit.redundancy / 2))
    forward = Affine2D(*(float(v) for v in fit.unknowns.T.ravel()))
    covariance = np.asarray(np.kron(np.eye(2), fit.covariance), float)
    sizes, directions, shear = _sigmas(forward, covariance)
    return StageCalibration(
        names=labels,
        stage=S,
        measured=P,
        to_image=forward,
        to_stage=~forward,
        covariance=covariance,
        residuals=residuals,
        sigma=(float(columns), float(rows)),
        sigma0=fit.sigma0,
        redundancy=fit.redundancy,
        gross=tuple(n for n, u in zip(labels, used) if not u),
        facts=affine_facts(forward),
        sigma_pixel_size=sizes,
        sigma_direction=directions,
        sigma_shear=shear,
        systematic=_systematic(S[used], residuals[used]),
    )


def _checked(names: Iterable[str], stage: Floats, measured: Floats) -> tuple[tuple[str, ...], Floats, Floats]:
    labels = tuple(names)
    S, P = np.asarray(stage, float), np.asarray(measured, float)
    if S.shape != (len(labels), 2) or P.shape != S.shape:
        raise InputError(
            f"stage calibration: {len(labels)} names, stage coordinates of shape {S.shape}, measured of {P.shape}; two "
            "columns of equal length are needed"
        )
    if len(labels) > MOST_POINTS:
        raise InputError(f"stage calibration: {len(labels)} points; at most {MOST_POINTS} are taken")
    seen: set[str] = set()
    for name, s, p in zip(labels, S, P):
        if name in seen:
            raise InputError(
                f"stage calibration: point {name!r} is given twice; give each measurement a name of its own"
            )
        seen.add(name)
        if not (np.isfinite(s).all() and np.isfinite(p).all()):
            raise InputError(f"stage calibration: point {name!r} has a coordinate that is no finite number")
    if len(labels) < LEAST_POINTS:
        raise InputError(
            f"stage calibration: {len(labels)} points; {LEAST_POINTS} are needed, since three fit without any check"
        )
    for points, what in ((S, "stage coordinates"), (P, "measured positions")):
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if not spread[1] > 0.01 * spread[0]:
            raise GeometryError(
                f"stage calibration: the {what} lie on a line (or at one place); move the stage in both directions. "
                "Has a sign been lost?"
            )
    return labels, S, P


def _worst(fit: Fit, used: Mask) -> int | None:
    """The point whose residual is farthest beyond what the others allow; None: no gross error."""
    freedom = fit.redundancy
    if freedom < 6 or not fit.square > 1e-18 * float((fit.A**2).mean()):
        return None
    square = (fit.residuals**2).sum(axis=1) / np.clip(fit.redundancies, 1e-3, 1.0)
    # Without the point itself, so that a large error does not hide behind the sigma it makes.
    ratio = (square / 2.0) / np.maximum((fit.square - square) / (freedom - 2), 1e-300)
    k = int(ratio.argmax())
    return int(np.flatnonzero(used)[k]) if chance_f(ratio[k], 2, freedom - 2) * len(square) < LEVEL else None


def _sigmas(forward: Affine2D, covariance: Floats) -> tuple[tuple[float, float], tuple[float, float], float]:
    """Of pixel sizes, directions and shear, by differences."""
    start = np.array([forward.a1, forward.a2, forward.a3, forward.a4, forward.a5, forward.a6])

    def figures(elements: Floats) -> Floats:
        f = affine_facts(Affine2D(*(float(v) for v in elements)))
        # Next to their values, whose turn does not matter, angles have no jump.
        near = [math.remainder(a - b, math.tau) for a, b in zip(_angles(f), _angles(affine_facts(forward)))]
        return np.array([*f.pixel_size, *near])

    J = by_differences(figures, start, _DIFFERENCE * float(np.abs(start[[0, 1, 3, 4]]).max()))
    s = [math.sqrt(max(float(v), 0.0)) for v in np.diag(J @ covariance @ J.T)]
    return (s[0], s[1]), (s[2], s[3]), s[4]


def _angles(facts: AffineFacts) -> tuple[float, float, float]:
    return facts.direction_x, facts.direction_y, facts.shear


def _systematic(S: Floats, residuals: Floats) -> float | None:
    """F-test of second-order terms in the residuals (figs. B.2 and B.3 let one suspect them)."""
    n = len(S)
    if n < 9:
        return None
    d = (S - S.mean(axis=0)) / np.maximum(np.ptp(S, axis=0), 1e-300)
    x, y = d.T
    A = np.column_stack([np.ones(n), x, y, x * x, x * y, y * y])
    fit = solve(A, residuals)
    if fit.rank < 6 or not fit.square > 1e-24:
        return None
    return chance_gain(float((residuals**2).sum()), fit.square, 6, fit.redundancy)


def b4_lines(found: StageCalibration, unit: str) -> tuple[str, ...]:
    """The result as text in the order of fig. B.4."""
    f, b, facts = found.to_image, found.to_stage, found.facts
    lines = [
        "Affine transformation  X = a1 x + a2 y + a3,  Y = b1 x + b2 y + b3",
        "",
        "Stage to image: rotation and scale, shift (pixels)",
        f"{f.a1:17.10f} {f.a2:17.10f} {f.a3:10.2f}",
        f"{f.a4:17.10f} {f.a5:17.10f} {f.a6:10.2f}",
        "",
        *(f"Scale factor in {c}   : {s:.10f}" for c, s in zip("xy", facts.scale)),
        *(
            f"Pixel size in {c}     : {s:.2f} {unit} ± {e:.1g}"
            for c, s, e in zip("xy", facts.pixel_size, found.sigma_pixel_size)
        ),
        f"Rotation of x axis   : {facts.direction_x * _GON:.2f} gon",
        f"Rotation of y axis   : {facts.direction_y * _GON:.2f} gon (fig. B.4 prints minus the sum of both, "
        f"{found.printed_rotation_y:.2f})",
        f"Shear                : {facts.shear * _GON:.2f} gon",
        "",
        f"Image to stage: rotation and scale, shift ({unit})",
        f"{b.a1:17.10f} {b.a2:17.10f} {b.a3:10.2f}",
        f"{b.a4:17.10f} {b.a5:17.10f} {b.a6:10.2f}",
        "",
        "Point       Stage x     Stage y   Column      Row  Residuals",
    ]
    for name, s, p, v in zip(found.names, found.stage, found.measured, found.residuals):
        mark = "  gross error, left out" if name in found.gross else ""
        lines.append(f"{name:<8} {s[0]:10.2f}  {s[1]:10.2f}  {p[0]:7.2f}  {p[1]:7.2f}  {_two(v[0])} {_two(v[1])}{mark}")
    lines += ["", f"Mean errors {found.sigma[0]:.2f} {found.sigma[1]:.2f}    M0 = {found.sigma0:.2f}"]
    return tuple(lines)


def _two(value: float) -> str:
    """Two decimals without a minus before zero."""
    return f"{round(float(value), 2) + 0.0:6.2f}"


#: Level of significance at which the scatter about the line is taken as larger than stated.
_SIGNIFICANT = 0.01


@dataclass(frozen=True)
class StraightLine:
    """y = offset + slope · x."""

    offset: float
    slope: float
    covariance: tuple[float, float, float]
    """Variance of the offset, covariance, variance of the slope."""
    chi_square: float
    """Weighted sum of squared residuals with the stated standard deviations."""
    degrees: int

    @property
    def offset_sigma(self) -> float:
        """Standard deviation of the offset."""
        return sqrt(self.covariance[0])

    @property
    def slope_sigma(self) -> float:
        """Standard deviation of the slope."""
        return sqrt(self.covariance[2])

    def at(self, x: ArrayLike) -> Floats:
        """y at x, same shape."""
        return np.asarray(self.offset + self.slope * np.asarray(x, float))


def fit_line(x: ArrayLike, y: ArrayLike, sigma: ArrayLike) -> StraightLine:
    """Line by weighted least squares.

    Where the residuals are significantly (1 %) larger than the standard deviations allow, those of the result are
    enlarged to the scatter that was found.
    """
    x, y, sigma = (np.asarray(v, np.float64) for v in (x, y, sigma))
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(sigma).all() and (sigma > 0).all()):
        raise InputError("a straight line needs finite points with positive standard deviations")
    if len(x) < 2 or np.ptp(x) == 0:
        raise InputError(f"{len(x)} points with {len(set(x.tolist()))} different abscissas; a line needs 2")
    # Shifted and scaled, so that the normal equations are well conditioned whatever the unit of x.
    shift = float(np.average(x, weights=sigma**-2.0))
    scale = float(np.abs(x - shift).max()) or 1.0
    fit = solve(np.column_stack([np.ones_like(x), (x - shift) / scale]), y, sigma**-2.0)
    scattered = fit.redundancy and chance_chi_square(fit.square, fit.redundancy) < _SIGNIFICANT
    back = np.array([[1.0, -shift / scale], [0.0, 1.0 / scale]])
    offset, slope = back @ fit.unknowns
    c = back @ (fit.covariance if scattered else fit.cofactors) @ back.T
    covariance = float(c[0, 0]), float(c[0, 1]), float(c[1, 1])
    return StraightLine(
        offset=float(offset), slope=float(slope), covariance=covariance, chi_square=fit.square, degrees=fit.redundancy
    )


@dataclass(frozen=True, eq=False)
class GreyWedge:
    """Result for one wedge at one illumination."""

    density: Floats
    """Increasing."""
    signal: Floats
    """Grey values above black."""
    transmission: Floats
    used: Mask
    """Patches that are neither saturated nor black."""
    gamma: float
    """Slope of the logarithm of the signal over that of the transmission; 1 for a linear sensor."""
    gamma_sigma: float
    slope: float
    """Grey values per transmission, line through the origin."""
    error_percent: float
    """Largest deviation from that line, % of the largest signal used."""
    used_range_percent: float
    """Part of the scale up to saturation that the brightest patch takes."""


def grey_wedge(density: ArrayLike, signal: ArrayLike, sigma: ArrayLike, saturation: float) -> GreyWedge:
    """Characteristic curve of patches."""
    order = np.argsort(np.asarray(density, float), kind="stable")
    d, y, s = (np.asarray(v, float)[order] for v in (density, signal, sigma))
    if (np.diff(d) <= 0).any():
        raise InputError("two patches have the same density; measure each once")
    used = (y < 0.98 * saturation) & (y > np.maximum(5 * s, 0.002 * saturation))
    if np.count_nonzero(used) < 3:
        raise InputError(
            f"{np.count_nonzero(used)} of {d.size} patches are neither saturated nor black; a grey wedge needs 3"
        )
    rises = np.diff(y) > 5 * np.hypot(s[1:], s[:-1]) + 0.01 * saturation
    if rises.any():
        k = int(np.argmax(rises))
        raise InputError(
            f"the patch of density {d[k + 1]:g} is brighter ({y[k + 1]:.4g} DN) than that of {d[k]:g} ({y[k]:.4g} DN); "
            "check the densities and the patches' places"
        )
    transmission = 10.0**-d
    t, v = transmission[used], y[used]
    # A patch is even to about 1 %, whatever its noise.
    relative = np.hypot(np.maximum(s[used], 1e-9) / v, 0.01)
    line = fit_line(np.log10(t), np.log10(v), relative / np.log(10.0))
    slope = float(np.sum(v / t) / v.size)
    deviation = v - slope * t
    return GreyWedge(
        density=d,
        signal=y,
        transmission=transmission,
        used=used,
        gamma=line.slope,
        gamma_sigma=line.slope_sigma,
        slope=slope,
        error_percent=float(100 * np.abs(deviation).max() / v.max()),
        used_range_percent=float(100 * y.max() / saturation),
    )


#: Lines below which a straight line and what leaves it cannot be told apart.
LEAST_LINES = 16
#: Lines above which a spectrum would take minutes.
MOST_LINES = 10_000
#: Length of the pattern in pixels (Behr 1989, §4.1.2).
PATTERN = 10
_REACH = 7
"""Pixels on each side of an edge that are fitted."""
_STEP = 4
"""Pixels on each side that are averaged to find an edge."""
_LARGEST = 1 << 26
_CLEAR = 6.0
"""Contrast over its standard deviation below which a line shows no edge."""
_MISSING = 0.2
"""Largest part of lines that may show no edge."""
_GRAIN = 0.2
"""Largest residual of the fitted edge as part of its contrast: more is texture."""
_CUT = 0.3
"""Largest part of a side's pixels that may lie at the end of the range."""


@dataclass(frozen=True, eq=False)
class EdgeLines:
    """Positions of one edge in successive lines."""

    method: str
    """`correlation` or `least squares`."""
    position: Floats
    """Column in the window, shape (n,); NaN: no edge in this line."""
    sigma: Floats
    """Standard deviations as the fit to the line's pixels states them; NaN where the method states none, (n,)."""
    contrast: float
    """Bright side minus dark side, grey values."""
    width: float
    """Standard deviation of the Gaussian that the edge is blurred by, pixels."""
    noise: float
    """Root mean square of the residuals of the fitted edge, grey values."""

    @property
    def gradient(self) -> float:
        """Steepest slope, grey values per pixel."""
        return self.contrast / (self.width * math.sqrt(2.0 * math.pi))

    @property
    def missing(self) -> tuple[int, ...]:
        """Lines without an edge, counted from 0 in the window."""
        return tuple(int(i) for i in np.flatnonzero(~np.isfinite(self.position)))


@dataclass(frozen=True, eq=False)
class _Fit:
    position: Floats
    contrast: Floats
    width: float
    residuals: Floats
    sigma: Floats
    sigma_contrast: Floats


def fit_edge(grey: NDArray[np.floating], *, name: str = "edge", saturation: float | None = None) -> EdgeLines:
    """Edge of every line by least squares: own position, contrast and base of each line, blur common to all."""
    g = _window(grey, name)
    coarse, contrast = _coarse(g, name)
    _refuse_cut(g, coarse, contrast, name, saturation)
    fit = _adjusted(g, coarse)
    noise = math.sqrt(_typical_square(fit.residuals))
    seen = np.abs(fit.contrast) > _CLEAR * fit.sigma_contrast
    seen &= (np.sign(fit.contrast) == np.sign(contrast)) & (np.abs(fit.position - coarse) < _REACH / 2)
    _refuse_missing(seen, name)
    typical = float(np.median(np.abs(fit.contrast[seen])))
    if not noise < _GRAIN * typical:
        raise InputError(
            f"{name}: residuals of {noise:.1f} grey values about an edge of contrast {typical:.1f}: texture or noise, "
            "no clean edge; choose another window"
        )
    seen &= np.abs(fit.contrast) > typical / 4.0
    _refuse_missing(seen, name)
    position, sigma = np.where(seen, fit.position, np.nan), np.where(seen, fit.sigma, np.nan)
    return EdgeLines(
        method="least squares", position=position, sigma=sigma, contrast=typical, width=fit.width, noise=noise
    )


def correlate_edge(grey: NDArray[np.floating], fitted: EdgeLines, *, name: str = "edge") -> EdgeLines:
    """Edge of every line by correlation with ten pixels of the middle line and a parabola (Behr 1989, eq. 4.8–4.10)."""
    g = _window(grey, name)
    known = np.flatnonzero(np.isfinite(fitted.position) & np.isfinite(g).all(axis=1))
    if not known.size:
        raise InputError(f"{name}: no line has both an edge and all its pixels")
    middle = int(known[np.abs(known - len(g) // 2).argmin()])
    at = float(fitted.position[middle])
    start = min(max(round(at - (PATTERN - 1) / 2.0), 0), g.shape[1] - PATTERN)
    r = _correlations(g, g[middle, start : start + PATTERN])
    best = np.where(np.isfinite(r), r, -2.0).argmax(axis=1)
    inside = (best > 0) & (best < r.shape[1] - 1)
    k, rows = np.clip(best, 1, r.shape[1] - 2), np.arange(len(g))
    # Eq. 4.9 and 4.10.
    b = (r[rows, k + 1] - r[rows, k - 1]) / 2.0
    a = (r[rows, k + 1] + r[rows, k - 1] - 2.0 * r[rows, k]) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        position = np.where(inside & (a < 0.0), k - b / (2.0 * a) + (at - start), np.nan)
    position[~np.isfinite(fitted.position)] = np.nan
    _refuse_missing(np.isfinite(position), name)
    unknown = np.full(len(g), np.nan)
    return EdgeLines(
        method="correlation",
        position=position,
        sigma=unknown,
        contrast=fitted.contrast,
        width=fitted.width,
        noise=fitted.noise,
    )


def _window(grey: NDArray[np.floating], name: str) -> Floats:
    if grey.ndim != 2 or grey.shape[0] < LEAST_LINES or grey.shape[1] < 2 * _REACH + 4:
        raise InputError(
            f"{name}: a window of {grey.shape[-1]} columns and {len(grey)} lines; at least {2 * _REACH + 4} columns "
            f"and {LEAST_LINES} lines are needed"
        )
    if grey.size > _LARGEST or len(grey) > MOST_LINES:
        raise InputError(
            f"{name}: a window of {grey.shape[1]} columns and {len(grey)} lines; at most {_LARGEST} pixels and "
            f"{MOST_LINES} lines are taken, choose a smaller one"
        )
    return np.asarray(grey, float)


def _coarse(g: Floats, name: str) -> tuple[Ints, float]:
    """Column of the greatest step in every line, all steps of the direction that most have; signed contrast."""
    total = np.concatenate([np.zeros((len(g), 1)), np.nancumsum(g, axis=1)], axis=1)
    means = (total[:, _STEP:] - total[:, :-_STEP]) / _STEP
    # Between column i + step − 1 and i + step; where pixels are unknown, there is no step.
    steps = means[:, _STEP:] - means[:, :-_STEP]
    bad = np.concatenate([np.zeros((len(g), 1)), np.cumsum(~np.isfinite(g), axis=1)], axis=1)
    steps[(bad[:, 2 * _STEP :] - bad[:, : -2 * _STEP]) > 0] = 0.0
    # Room for the pixels that are fitted.
    first = _REACH - _STEP + 1
    steps = steps[:, first : steps.shape[1] - first + 1]
    up, down = float(np.median(steps.max(axis=1))), float(np.median(-steps.min(axis=1)))
    sign = 1.0 if up >= down else -1.0
    if not max(up, down) > 0.0:
        raise InputError(f"{name}: no edge in the window: its grey values do not change along the lines")
    column = (sign * steps).argmax(axis=1) + first + _STEP
    return column.astype(np.int64), sign * max(up, down)


def _sides(g: Floats, coarse: Ints) -> tuple[Floats, Floats]:
    """Pixels on the left and on the right of the edge, four to seven pixels away."""
    offsets = np.arange(3, _REACH)
    rows = np.arange(len(g))[:, None]
    left = g[rows, np.clip(coarse[:, None] - 1 - offsets, 0, g.shape[1] - 1)]
    right = g[rows, np.clip(coarse[:, None] + offsets, 0, g.shape[1] - 1)]
    return left.ravel(), right.ravel()


def _refuse_cut(g: Floats, coarse: Ints, contrast: float, name: str, saturation: float | None) -> None:
    """Raise where one side of the edge lies at the end of the range: its place would be wrong."""
    left, right = _sides(g, coarse)
    dark, bright = (left, right) if contrast > 0.0 else (right, left)
    share_top = float((bright >= (np.nanmax(g) if saturation is None else saturation)).mean())
    share_low = float((dark <= np.nanmin(g)).mean())
    # A side at one value is cut if the other side shows noise; images without any noise are not.
    noisy_dark, noisy_bright = share_low < _CUT, share_top < _CUT
    if not noisy_bright and (saturation is not None or noisy_dark):
        raise InputError(
            f"{name}: saturated: {100 * share_top:.0f} % of the pixels on its bright side are at "
            f"{np.nanmax(bright):g} or above the saturation; the edge's place would be wrong. Take the image with less "
            "light"
        )
    if not noisy_dark and noisy_bright:
        raise InputError(
            f"{name}: cut off in the dark: {100 * share_low:.0f} % of the pixels on its dark side are at "
            f"{np.nanmin(dark):g}; the edge's place would be wrong. Take the image with more light or a "
            "higher black level"
        )


def _adjusted(g: Floats, coarse: Ints) -> _Fit:
    """g = base + contrast Φ((x − p) / s) for every line, s common."""
    n, m = len(g), 2 * _REACH
    columns = coarse[:, None] + np.arange(-_REACH, _REACH)
    part = g[np.arange(n)[:, None], columns]
    whole = np.isfinite(part).all(axis=1)
    part = np.where(np.isfinite(part), part, 0.0)
    x = columns - (coarse[:, None] - 0.5)
    p, s = np.zeros(n), 1.0
    A = np.ones((n, m, 3))
    for _ in range(25):
        u = (x - p[:, None]) / s
        bell = np.exp(-0.5 * u**2) / math.sqrt(2.0 * math.pi)
        A[:, :, 1] = special.ndtr(u)
        # Base and contrast are linear: found for the present place, with it as third unknown.
        linear = _solve(A[:, :, :2], part)[0]
        A[:, :, 2] = -linear[:, 1:2] * bell / s
        found, Q = _solve(A, part)
        residuals = part - np.einsum("nij,nj->ni", A, found)
        widen = -linear[:, 1:2] * bell * u / s
        # What the width adds beyond the three unknowns of each line.
        beyond = widen - np.einsum("nij,nj->ni", A, _solve(A, widen)[0])
        beyond[~whole] = 0.0
        weight = _calm(residuals)
        change = float((weight[:, None] * beyond * residuals).sum() / max((weight[:, None] * beyond**2).sum(), 1e-12))
        s = float(np.clip(s + np.clip(change, -0.3, 0.3), 0.15, _REACH / 2.0))
        moved = np.clip(found[:, 2], -1.0, 1.0)
        p = np.clip(p + moved, -_REACH, _REACH)
        if np.abs(moved).max() < 1e-7 and abs(change) < 1e-7:
            break
    variance = _typical_square(residuals[whole])
    sigma, sigma_contrast = (np.sqrt(variance * Q[:, k, k]) for k in (2, 1))
    position = np.where(whole, coarse - 0.5 + p, np.nan)
    return _Fit(
        position=position,
        contrast=found[:, 1],
        width=s,
        residuals=residuals[whole],
        sigma=sigma,
        sigma_contrast=sigma_contrast,
    )


def _solve(A: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Least squares of many lines at once: unknowns and cofactors."""
    N = np.einsum("nij,nik->njk", A, A)
    N += 1e-12 * np.trace(N, axis1=1, axis2=2)[:, None, None] * np.eye(A.shape[2])
    Q = np.linalg.inv(N)
    return np.einsum("njk,nik,ni->nj", Q, A, y), Q


def _typical_square(residuals: Floats) -> float:
    """Variance of a grey value from the median line, so that lines that fit badly do not count."""
    if not len(residuals):
        return math.inf
    freedom = residuals.shape[1] - 3
    # Median of a chi-square after Wilson and Hilferty.
    return float(np.median((residuals**2).sum(axis=1))) / (freedom * (1.0 - 2.0 / (9.0 * freedom)) ** 3)


def _calm(residuals: Floats) -> Floats:
    """Weights of lines: 0 where they fit far worse than most of them."""
    rms = np.sqrt((residuals**2).mean(axis=1))
    return (rms <= 4.0 * np.median(rms)).astype(float)


def _correlations(g: Floats, pattern: Floats) -> Floats:
    """Coefficients of the pattern at every place of every line, eq. 4.1; NaN where grey values do not vary."""
    windows = np.lib.stride_tricks.sliding_window_view(g, PATTERN, axis=1)
    centred = pattern - pattern.mean()
    product = windows @ centred
    variance = windows.var(axis=2) * PATTERN
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(variance > 0.0, product / np.sqrt(variance * float(centred @ centred)), np.nan)


def _refuse_missing(seen: Mask, name: str) -> None:
    lost = np.flatnonzero(~seen)
    if len(lost) > _MISSING * len(seen) or len(seen) - len(lost) < LEAST_LINES:
        listed = ", ".join(str(i) for i in lost[:8]) + (" …" if len(lost) > 8 else "")
        raise InputError(
            f"{name}: no edge in {len(lost)} of {len(seen)} lines ({listed}, counted from the window's first); at most "
            f"{100 * _MISSING:.0f} % may lack it. Choose a window that the edge crosses from its first line to its last"
        )
