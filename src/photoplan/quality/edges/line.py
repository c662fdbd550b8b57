"""Edges as lines, and profiles across them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from math import asinh, atan2, ceil, cos, degrees, hypot, pi, sin, sinh, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.ndimage import gaussian_filter
from scipy.special import exp1, ndtr

from photoplan.adjustment.least_squares import Decomposed, levenberg, solve
from photoplan.arrays import Floats, Mask
from photoplan.errors import InputError

#: A side of the pixel shorter than this, seen along the edge, is replaced by its variance (an error below 1e-13).
SHORT_SIDE = 1e-3
#: Narrowest Gaussian in pixels: keeps derivatives finite when a sharpened edge rises faster than one pixel allows.
LEAST_BLUR = 0.05


@dataclass(frozen=True)
class PixelEdge:
    """Half plane ⊗ Gaussian ⊗ square pixel, across the edge: a Gaussian and boxes |cos| and |sin| of the angle wide.

    Seen across an edge, the unit square of a pixel is a trapezoid, the convolution of both boxes. Integrals of the
    normal distribution give edge profile, line spread function and their derivatives without any sampling.
    """

    blur: float
    """Standard deviation of the Gaussian, pixels."""
    angle: float
    """Angle between the normal of the edge and the columns' axis, radians."""

    @property
    def sides(self) -> tuple[float, float]:
        """Widths of both boxes, pixels, the wider one first."""
        sides = sorted((abs(cos(self.angle)), abs(sin(self.angle))), reverse=True)
        return sides[0], sides[1]

    @property
    def total(self) -> float:
        """Standard deviation of the whole line spread function, pixels: Gaussian and pixel, which add 1/12."""
        return sqrt(self.blur**2 + 1.0 / 12.0)

    def profile(self, distance: Floats) -> tuple[Floats, Floats, Floats]:
        """Edge profile from 0 to 1, line spread function and its derivative at distances in pixels, same shape."""
        wide, narrow = self.sides
        if narrow < SHORT_SIDE:
            blur = sqrt(self.blur**2 + narrow**2 / 12.0)
            lower, upper = _integrals(distance - wide / 2, blur), _integrals(distance + wide / 2, blur)
            slope = (_density(distance + wide / 2, blur) - _density(distance - wide / 2, blur)) / wide
            return (upper[1] - lower[1]) / wide, (upper[0] - lower[0]) / wide, slope
        outer, inner = (wide + narrow) / 2, (wide - narrow) / 2
        terms = [_integrals(distance + shift, self.blur) for shift in (outer, inner, -inner, -outer)]
        rise = [(t[0] - t[1] - t[2] + t[3]) / (wide * narrow) for t in zip(*terms)]
        return rise[2], rise[1], rise[0]

    def transfer(self, frequency: Floats) -> Floats:
        """Transfer function at cycles per pixel along the normal, same shape, real: it is symmetric."""
        wide, narrow = self.sides
        gaussian = np.exp(-2.0 * (pi * self.blur * frequency) ** 2)
        return np.asarray(gaussian * np.sinc(frequency * wide) * np.sinc(frequency * narrow))


def _density(x: Floats, blur: float) -> Floats:
    return np.asarray(np.exp(-0.5 * (x / blur) ** 2) / (blur * sqrt(2.0 * pi)))


def _integrals(x: Floats, blur: float) -> tuple[Floats, ...]:
    """The normal distribution function, its integral and its second integral."""
    share, density = ndtr(x / blur), blur**2 * _density(x, blur)
    return share, x * share + density, 0.5 * ((x * x + blur * blur) * share + x * density)


#: Standard deviation in pixels of the smoothing with which an edge is first found.
SMOOTHING = 1.5
#: Steps of the fit; what has not settled by then is not one edge.
MOST_STEPS = 25
#: Part of the best determined direction of the unknowns from which a direction counts as determined. An edge along the
#: pixels shows three columns that are neither dark nor bright, too few for place, blur and both levels (2e-4); slanted
#: by a degree, it has 0.13.
_DETERMINED = 1e-3


@dataclass(frozen=True)
class EdgeLine:
    """The line ``across = offset + slope · along + bend · along²`` of the frame in which it is steep.

    In direction ``x`` *across* is the column and *along* the row, in direction ``y`` the other way round; *along*
    counts from `middle`.
    """

    direction: str
    offset: float
    slope: float
    bend: float
    middle: float
    rising: int
    """1 where brightness rises with *across*, −1 where it falls."""

    def distance(self, across: Floats, along: Floats) -> Floats:
        """Distance from the line, pixels, positive on the bright side.

        Exact for a straight line; for a parabola to first order in its curvature (the next term is
        bend · slope · distance², below 1e-3 pixel for a sagitta of 1 pixel in 100 and a distance of 10).
        """
        t = along - self.middle
        steep = self.slope + 2.0 * self.bend * t
        return self.rising * (across - self.offset - t * (self.slope + self.bend * t)) / np.sqrt(1.0 + steep**2)

    @property
    def length_of_normal(self) -> float:
        """Ratio of a length along the line to the same length counted in rows (or columns)."""
        return hypot(1.0, self.slope)

    @property
    def angle(self) -> float:
        """Direction in which brightness rises, radians from +x (columns) towards +y (rows), in −π … π."""
        normal = (self.rising * 1.0, -self.rising * self.slope)
        return atan2(normal[1], normal[0]) if self.direction == "x" else atan2(normal[0], normal[1])

    @property
    def angle_deg(self) -> float:
        """The same in degrees, in −180 < angle ≤ 180."""
        angle = degrees(self.angle)
        return angle + 360.0 if angle <= -180.0 else angle

    def place(self, along: float) -> tuple[float, float]:
        """Column and row of the line at *along*."""
        t = along - self.middle
        across = self.offset + t * (self.slope + self.bend * t)
        return (across, along) if self.direction == "x" else (along, across)


@dataclass(frozen=True, eq=False)
class EdgePixels:
    """The pixels of a region in the frame of its edge, as rows: shape (n,) each."""

    across: Floats
    along: Floats
    light: Floats

    @classmethod
    def of(cls, image: Floats, valid: Mask, direction: str) -> EdgePixels:
        """Valid pixels of a region, ordered along the edge."""
        frame, mask = (image, valid) if direction == "x" else (image.T, valid.T)
        along, across = np.nonzero(mask)
        return cls(across.astype(float), along.astype(float), frame[mask])

    def where(self, chosen: Mask) -> EdgePixels:
        """Those that are chosen."""
        return EdgePixels(self.across[chosen], self.along[chosen], self.light[chosen])


def find_line(image: Floats, valid: Mask) -> EdgeLine:
    """Line through the strongest brightness steps of a region, to about a pixel.

    A line of least squares through the smoothed gradients, weighted with their squares, of which those that lie far
    from it or point elsewhere are left out step by step.
    """
    filled = np.where(valid, image, np.median(image[valid]))
    if not valid.all():
        weight = gaussian_filter(valid.astype(float), SMOOTHING)
        smooth = gaussian_filter(np.where(valid, image, 0.0), SMOOTHING) / np.maximum(weight, 1e-6)
        filled = np.where(valid, image, smooth)
    columns = gaussian_filter(filled, SMOOTHING, order=(0, 1), mode="nearest")
    rows = gaussian_filter(filled, SMOOTHING, order=(1, 0), mode="nearest")
    direction = "x" if (columns[valid] ** 2).sum() >= (rows[valid] ** 2).sum() else "y"
    main, other, mask = (columns, rows, valid) if direction == "x" else (rows.T, columns.T, valid.T)
    power = np.where(mask, main**2 + other**2, 0.0)
    strong = power > 0.25 * np.quantile(power.max(axis=1), 0.75)
    along, across = np.nonzero(strong)
    if along.size < 6:
        raise InputError("no edge: the region holds no brightness step")
    weight, sign = power[strong], np.sign(main[strong])
    rising = 1 if (weight * sign).sum() >= 0.0 else -1
    middle = (main.shape[0] - 1) / 2.0
    weight = np.where(sign == rising, weight, 0.0)
    offset, slope = 0.0, 0.0
    reach = np.inf
    for _ in range(8):
        keep = np.abs(across - offset - slope * (along - middle)) <= reach
        w = weight * keep
        if np.count_nonzero(w) < 6 or np.ptp(along[w > 0.0]) < 2:
            raise InputError("no edge: the brightness steps of the region do not lie on one line")
        t = along - middle
        design = np.stack([np.ones_like(t), t], axis=1)
        fit = solve(design, across.astype(float), w)
        offset, slope = fit.unknowns
        reach = max(2.5 * float(np.sqrt(fit.square / w.sum())), 2.0)
    return EdgeLine(
        direction=direction, offset=float(offset), slope=float(slope), bend=0.0, middle=middle, rising=rising
    )


def fit_line(
    pixels: EdgePixels, line: EdgeLine, curve: int, shading: bool, most: int = MOST_STEPS
) -> tuple[EdgeLine, PixelEdge, Floats]:
    """Line and blur of least squares for the pixels of an edge, by the profile of a Gaussian and the pixel.

    Offset, slope (and bend), blur, both levels and, where asked, their slopes are adjusted together (Levenberg and
    Marquardt). Where the true line spread function has another form the line is still right: its slope does not depend
    on the form, and a shift of its offset is taken up by the profile that is measured afterwards.
    """
    start = _LineState(line, _first_blur(pixels, line))
    state = levenberg(
        start,
        lambda state: _linearised(pixels, state, curve, shading)[:2],
        lambda state, step: state.moved(step[: curve + 2], curve),
        most,
    ).state
    return state.line, PixelEdge(state.blur, state.line.angle), _linearised(pixels, state, curve, shading)[2]


def determines(pixels: EdgePixels, line: EdgeLine, model: PixelEdge, curve: int) -> bool:
    """Whether pixels near an edge determine its place and blur beside both levels."""
    design = _linearised(pixels, _LineState(line, model.blur), curve, False)[0]
    return Decomposed.of(design, _DETERMINED).rank == design.shape[1]


@dataclass(frozen=True)
class _LineState:
    line: EdgeLine
    blur: float

    def moved(self, step: Floats, curve: int) -> _LineState:
        old = self.line
        bend = old.bend + (float(step[2]) if curve > 1 else 0.0)
        slope = float(np.clip(old.slope + step[1], -3.0, 3.0))
        line = EdgeLine(
            direction=old.direction,
            offset=old.offset + float(step[0]),
            slope=slope,
            bend=bend,
            middle=old.middle,
            rising=old.rising,
        )
        blur = float(np.clip(self.blur + step[curve + 1], max(LEAST_BLUR, 0.4 * self.blur), 2.5 * self.blur))
        return _LineState(line, blur)


def _linearised(pixels: EdgePixels, state: _LineState, curve: int, shading: bool) -> tuple[Floats, Floats, Floats]:
    """Design matrix (n, unknowns) with the levels in it, residuals (n,) computed minus observed, levels of a state."""
    line = state.line
    t = pixels.along - line.middle
    distance = line.distance(pixels.across, pixels.along)
    rise, spread, tilt = PixelEdge(state.blur, line.angle).profile(distance)
    columns = [np.ones_like(rise), rise]
    if shading:
        columns += [t * (1.0 - rise), t * rise]
    linear = np.stack(columns, axis=1)
    fit = solve(linear, pixels.light)
    levels, residual = fit.unknowns, fit.residuals
    shift = -line.rising * spread * levels[1] / line.length_of_normal
    moving = [shift, shift * t] + ([shift * t * t] if curve > 1 else [])
    moving.append(state.blur * tilt * levels[1])
    return np.concatenate([np.stack(moving, axis=1), linear], axis=1), residual, levels


def _first_blur(pixels: EdgePixels, line: EdgeLine) -> float:
    """Rough standard deviation of the line spread function, from means of the profile over one pixel each."""
    distance = np.round(line.distance(pixels.across, pixels.along)).astype(int)
    first = int(distance.min())
    count = np.bincount(distance - first)
    mean = np.bincount(distance - first, pixels.light) / np.maximum(count, 1)
    keep = count > 0
    at, mean = np.flatnonzero(keep) + first, mean[keep]
    if not ((at < 0).any() and (at > 0).any()):
        return 1.0
    dark, bright = np.median(mean[at < 0]), np.median(mean[at > 0])
    if not bright > dark:
        return 1.0
    share = np.clip((mean - dark) / (bright - dark), 0.0, 1.0)
    area = float(np.where(at < 0, share, np.where(at > 0, 1.0 - share, 0.0)).sum())
    return float(np.clip(area * 1.25, 0.3, 30.0))


#: Distance between nodes of the signal in standard deviations of the trend; farther out they grow with the distance.
NODE = 0.4
#: Beyond this many standard deviations the nodes grow and the signal fades with the square of the distance.
CORE = 3.0
#: Correlation lengths of the signal that are tried, standard deviations of the trend.
CORRELATION = (0.7, 1.4, 2.8)
#: Standard deviations of the signal that are tried, in units of the noise's and of the trend's.
SCALES = 10.0 ** np.linspace(-3.0, 3.5, 53)
#: The largest scale is taken whose logarithmic likelihood is not this far below the best (95 %): a signal that is too
#: small hides a form that the pixels cannot exclude.
UNLIKELY = 1.92
#: How many unknowns of the shape belong to the trend: step, shift, width.
TREND = 3
#: Variance of the wings that both sides have in common, relative to that of the signal elsewhere.
WINGS = 10.0


@dataclass(frozen=True, eq=False)
class ProfileBasis:
    """The functions of which an edge profile is the sum, between two distances from the line."""

    model: PixelEdge
    low: float
    high: float
    knots: Floats

    @classmethod
    def between(cls, model: PixelEdge, low: float, high: float) -> ProfileBasis:
        """Basis for distances low < 0 < high: nodes are dense in the edge and sparse in its tails."""
        unit = model.total * CORE
        first = -max(1, ceil(asinh(-low / unit) * CORE / NODE))
        last = max(1, ceil(asinh(high / unit) * CORE / NODE))
        nodes = np.array([unit * sinh(i * NODE / CORE) for i in range(first - 3, last + 4)])
        return cls(model, low, high, nodes)

    @property
    def size(self) -> int:
        """Number of functions: of trend and signal."""
        return TREND + self.knots.size - 4

    @property
    def centres(self) -> Floats:
        """Where the functions of the signal have their middle, pixels, shape (size − 3,)."""
        return self.knots[2:-2]

    @cached_property
    def _wider(self) -> tuple[PixelEdge, PixelEdge, float]:
        """The trend with a wider and a narrower blur, and the difference of their variances."""
        variance = self.model.blur**2
        change = 0.1 * self.model.total**2
        least = max(variance - change, LEAST_BLUR**2)
        return (
            PixelEdge(sqrt(variance + change), self.model.angle),
            PixelEdge(sqrt(least), self.model.angle),
            (variance + change - least) / self.model.total**2,
        )

    @cached_property
    def _tails(self) -> Floats:
        """Light of the functions of the signal beyond both ends, where they fade with the square, shape (2, k)."""
        ends = np.array([self.low, self.high])
        return np.asarray(np.abs(ends)[:, None] * self._signal(ends))

    @cached_property
    def _signal(self) -> BSpline:
        """Line spread functions of the signal."""
        return BSpline(self.knots, np.eye(self.knots.size - 4), 3, extrapolate=False)

    @cached_property
    def _rise(self) -> BSpline:
        """Edge profiles of the signal, but for constants."""
        return self._signal.antiderivative()

    def edge(self, distance: Floats) -> Floats:
        """Edge profiles of all functions at distances (n,), shape (n, size)."""
        wide, narrow, difference = self._wider
        rise, spread, _ = self.model.profile(distance)
        width = (wide.profile(distance)[0] - narrow.profile(distance)[0]) / difference
        inside = self._rise(np.clip(distance, self.low, self.high))
        signal = inside - self._rise(np.array([self.low])) + self._tails[0]
        return np.concatenate([rise[:, None], spread[:, None] * self.model.total, width[:, None], signal], axis=1)

    def line(self, distance: Floats) -> Floats:
        """Line spread functions of all functions at distances (n,) within the nodes, shape (n, size)."""
        wide, narrow, difference = self._wider
        _, spread, tilt = self.model.profile(distance)
        width = (wide.profile(distance)[1] - narrow.profile(distance)[1]) / difference
        signal = np.nan_to_num(self._signal(distance))
        return np.concatenate([spread[:, None], tilt[:, None] * self.model.total, width[:, None], signal], axis=1)

    def transfer(self, frequency: Floats) -> NDArray[np.complex128]:
        """Fourier transforms of the line spread functions at cycles per pixel (m,), shape (m, size).

        Those of the trend in closed form, those of the signal by Gauss' quadrature between the nodes, to 1e-9, and
        beyond the window in closed form again.
        """
        wide, narrow, difference = self._wider
        own = self.model.transfer(frequency)
        width = (wide.transfer(frequency) - narrow.transfer(frequency)) / difference
        inner = self.knots[(self.knots > self.low) & (self.knots < self.high)]
        at, weight = _quadrature(np.concatenate([[self.low], inner, [self.high]]), float(frequency.max()))
        waves = np.exp(-2j * pi * np.multiply.outer(frequency, at)) * weight
        signal = waves @ self._signal(at)
        for end, tail in zip((self.low, self.high), self._tails):
            signal += np.multiply.outer(_faded(2.0 * pi * frequency * end), tail)
        shift = 2j * pi * frequency * own * self.model.total
        return np.concatenate([own[:, None], shift[:, None], width[:, None], signal], axis=1)

    @cached_property
    def steps(self) -> Floats:
        """What each function adds to the step from dark to bright, shape (size,)."""
        inside = np.diff(self._rise(np.array([self.low, self.high])), axis=0)[0]
        return np.concatenate([[1.0, 0.0, 0.0], inside + self._tails.sum(axis=0)])

    @cached_property
    def tails(self) -> Floats:
        """What each function adds to the step beyond the window, shape (size,)."""
        return np.asarray(self.steps - np.diff(self.edge(np.array([self.low, self.high])), axis=0)[0])

    def root(self, correlation: float) -> Floats:
        """Matrix R with R Rᵀ the covariance of the signal's coefficients, for unit variance in the middle.

        Twice differentiable (Matérn 5/2) in a coordinate that grows like the logarithm of the distance in the tails,
        where it fades as 1 / distance², as the lines of diffraction and of veiling light do; a part that is alike
        everywhere but for that are the wings of both sides.
        """
        unit = self.model.total * CORE
        place = np.arcsinh(self.centres / unit) * CORE
        fading = 1.0 / (1.0 + (self.centres / unit) ** 2) / self.model.total
        apart = np.abs(np.subtract.outer(place, place)) * (sqrt(5.0) / correlation)
        matern = (1.0 + apart + apart**2 / 3.0) * np.exp(-apart) + WINGS
        value, vector = eigh(matern)
        return np.asarray(fading[:, None] * (vector * np.sqrt(np.maximum(value, 0.0))))


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """Coefficients of a profile, from all pixels and with each block of the edge left out, and their covariance."""

    basis: ProfileBasis
    levels: Floats
    """Unknowns beside the shape: the dark level (far away, without `missing`), then slopes of the levels."""
    shape: Floats
    """Coefficients of the basis, shape (size,)."""
    covariance: Floats
    """Of the shape's coefficients: noise and what the prior hides, shape (size, size)."""
    hidden: Floats
    """Directions (k, size) in which the shape may be wrong by one standard deviation without the blocks telling."""
    left_out: Floats
    """Coefficients of the basis with one block left out, shape (blocks, size)."""
    noise: float
    """Standard deviation of a pixel with weight 1."""
    unknowns: float
    """Effective number of unknowns."""
    signal: float
    """Standard deviation of the signal relative to the noise."""

    @property
    def missing(self) -> float:
        """Light that lies beyond the window beside that of the shape: where its tails are negative, they are none."""
        return max(0.0, -float(self.basis.tails @ self.shape))

    @property
    def step(self) -> float:
        """Difference of both levels, far away."""
        return float(self.basis.steps @ self.shape) + self.missing

    @property
    def beyond(self) -> tuple[float, float]:
        """Share of the light beyond the window, and its standard deviation by the covariance."""
        tails, step = self.basis.tails, self.step
        share = (float(tails @ self.shape) + self.missing) / step
        change = (tails - share * self.basis.steps) / step
        return share, sqrt(max(float(change @ self.covariance @ change), 0.0))


def fit_profile(
    basis: ProfileBasis, observed: tuple[Floats, Floats, Floats], extra: Floats, blocks: NDArray[np.intp]
) -> EdgeFit:
    """Adjust a profile to pixels."""
    distance, light, weight = observed
    design = np.concatenate([extra, _looked_up(basis, distance)], axis=1)
    root_weight = np.sqrt(weight)
    design *= root_weight[:, None]
    values = light * root_weight
    ends = np.append(blocks[1:], values.size)
    parts = np.array([design[a:b].T @ design[a:b] for a, b in zip(blocks, ends)])
    rights = np.array([design[a:b].T @ values[a:b] for a, b in zip(blocks, ends)])
    normal, right, square = parts.sum(axis=0), rights.sum(axis=0), float(values @ values)
    trend = extra.shape[1] + TREND
    root, scale, noise = _best_prior(basis, normal, right, square, values.size, trend)
    turn = np.eye(design.shape[1])
    turn[trend:, trend:] = root * scale
    prior = np.zeros(design.shape[1])
    prior[trend:] = 1.0
    full = turn.T @ normal @ turn + np.diag(prior)
    inverse = cho_solve(cho_factor(full), np.eye(full.shape[0]))
    solution = inverse @ (turn.T @ right)
    less = turn.T @ (normal - parts) @ turn + np.diag(prior)
    replicas = np.linalg.solve(less, ((right - rights) @ turn)[:, :, None])[:, :, 0]
    back = turn[extra.shape[1] :]
    hidden = (back @ inverse)[:, trend:] * noise
    vectors, values_, _ = np.linalg.svd(hidden, full_matrices=False)
    keep = values_ > 1e-3 * max(float(values_[0]), 1e-300)
    return EdgeFit(
        basis=basis,
        levels=(turn @ solution)[: extra.shape[1]],
        shape=back @ solution,
        covariance=noise**2 * back @ inverse @ back.T,
        hidden=(vectors * values_).T[keep],
        left_out=replicas @ back.T,
        noise=noise,
        unknowns=float(full.shape[0] - np.trace(inverse[trend:, trend:])),
        signal=scale,
    )


def _best_prior(
    basis: ProfileBasis, normal: Floats, right: Floats, square: float, number: int, trend: int
) -> tuple[Floats, float, float]:
    """Covariance root, scale and noise: smoothness of the best restricted likelihood, scale as large as it allows.

    With the unknowns of the trend eliminated, the signal's normal equations are brought to diagonal form, in which
    the likelihood of every scale is a sum (Patterson and Thompson 1971).
    """
    factor = cho_factor(normal[:trend, :trend])
    solved = cho_solve(factor, np.column_stack([normal[:trend, trend:], right[:trend]]))
    reduced = normal[trend:, trend:] - normal[trend:, :trend] @ solved[:, :-1]
    remaining = right[trend:] - normal[trend:, :trend] @ solved[:, -1]
    rest = max(square - float(right[:trend] @ solved[:, -1]), 1e-12 * square)
    best = (-np.inf, np.eye(basis.size - TREND), float(SCALES[0]), 1.0)
    free = number - trend
    for correlation in CORRELATION:
        root = basis.root(correlation)
        value, vector = eigh(root.T @ reduced @ root)
        along = (vector.T @ (root.T @ remaining)) ** 2
        gain = 1.0 + np.multiply.outer(SCALES**2, np.maximum(value, 0.0))
        residual = np.maximum(rest - (SCALES[:, None] ** 2 * along / gain).sum(axis=1), 1e-12 * square)
        likelihood = -0.5 * (np.log(gain).sum(axis=1) + free * np.log(residual / free))
        top = float(likelihood.max())
        if top > best[0] + 1e-9:
            i = int(np.flatnonzero(likelihood >= top - UNLIKELY)[-1])
            best = (top, root, float(SCALES[i]), sqrt(residual[i] / free))
    return best[1], best[2], best[3]


def _looked_up(basis: ProfileBasis, distance: Floats) -> Floats:
    """`ProfileBasis.edge` at many distances by a fine table: linear between its lines, an error below 1e-5."""
    step = min(basis.model.total / 40.0, max(basis.model.blur / 8.0, 0.005))
    first = float(distance.min())
    lines = int((float(distance.max()) - first) / step) + 2
    if lines > 2 * distance.size:
        return basis.edge(distance)
    table = basis.edge(np.asarray(first + step * np.arange(lines), np.float64))
    place = (distance - first) / step
    at = np.minimum(place.astype(np.intp), lines - 2)
    part = (place - at)[:, None]
    return np.asarray(table[at] * (1.0 - part) + table[at + 1] * part)


def _quadrature(knots: Floats, most: float) -> tuple[Floats, Floats]:
    """Places and weights of Gauss' quadrature between nodes, for cubic pieces times waves up to a frequency."""
    places, weights = [], []
    for a, b in pairwise(knots):
        x, w = _gauss(min(4 + ceil(3.0 * most * (b - a)), 64))
        places.append(0.5 * (a + b) + 0.5 * (b - a) * x)
        weights.append(0.5 * (b - a) * w)
    return np.concatenate(places), np.concatenate(weights)


def _faded(angle: Floats) -> NDArray[np.complex128]:
    """Transform of 1 / t² from 1 on, at angles for each unit of t: the exponential integral E₂ (DLMF 8.19.12)."""
    wave = 1j * np.where(angle == 0.0, 1.0, angle)
    return np.where(angle == 0.0, 1.0, np.exp(-wave) - wave * exp1(wave))


@lru_cache(maxsize=64)
def _gauss(order: int) -> tuple[Floats, Floats]:
    places, weights = np.polynomial.legendre.leggauss(order)
    return places, weights
