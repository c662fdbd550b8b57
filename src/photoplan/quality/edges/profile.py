"""The profile across an edge from all of its pixels: trend, signal and noise, without bins and without a window.

Every pixel is one observation of the edge profile at its own distance from the line (a slanted edge so samples its
profile many times per pixel). The observations are adjusted together by linear prediction, as heights are in a terrain
model: the *trend* is the profile of Gaussian optics and a square pixel with free levels, place and width; the *signal*
is what the true line spread function has beyond that (asymmetry, tails of stray light, edge enhancement), a random
function that is smooth at the scale of the edge's width, and wide and faint far from it, where both sides may have the
wings of an aperture in common; restricted likelihood says how smooth and how large, so the data decide how much of it
there is; the rest is *noise*.

Pixels end where the window does, light does not: beyond it the signal fades with the square of the distance from what
it is at the ends, as behind an aperture, so that levels, step and modulation are those of the whole line spread
function.

ISO 12233 and its relatives average pixels into bins of a quarter pixel, difference the bins and multiply with a
Hamming window; bins and differences filter the result (corrected there approximately), bins hold unequal numbers of
phases unless the slope suits them, and the window cuts tails away. Here no bin, difference or window exists, so there
is nothing to correct: the profile is a sum of functions whose derivatives and Fourier transforms are known.

Sources: linear prediction: Kraus, Photogrammetrie 3, 2000, sect. 1; restricted likelihood: Patterson and Thompson,
Biometrika 58, 1971; wings of the line spread function of a circular aperture, 2 λN / (π³ x²): the transform of the
cusp of its transfer function at frequency 0, 1 − 4 λN |f| / π (Goodman, Introduction to Fourier Optics, eq. 6-32).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from math import asinh, ceil, pi, sinh, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve, eigh
from scipy.special import exp1

from photoplan.quality.edges.model import LEAST_BLUR, PixelEdge

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
    knots: NDArray[np.float64]

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
    def centres(self) -> NDArray[np.float64]:
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
    def _tails(self) -> NDArray[np.float64]:
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

    def edge(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Edge profiles of all functions at distances (n,), shape (n, size)."""
        wide, narrow, difference = self._wider
        rise, spread, _ = self.model.profile(distance)
        width = (wide.profile(distance)[0] - narrow.profile(distance)[0]) / difference
        inside = self._rise(np.clip(distance, self.low, self.high))
        signal = inside - self._rise(np.array([self.low])) + self._tails[0]
        return np.concatenate([rise[:, None], spread[:, None] * self.model.total, width[:, None], signal], axis=1)

    def line(self, distance: NDArray[np.float64]) -> NDArray[np.float64]:
        """Line spread functions of all functions at distances (n,) within the nodes, shape (n, size)."""
        wide, narrow, difference = self._wider
        _, spread, tilt = self.model.profile(distance)
        width = (wide.profile(distance)[1] - narrow.profile(distance)[1]) / difference
        signal = np.nan_to_num(self._signal(distance))
        return np.concatenate([spread[:, None], tilt[:, None] * self.model.total, width[:, None], signal], axis=1)

    def transfer(self, frequency: NDArray[np.float64]) -> NDArray[np.complex128]:
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
    def steps(self) -> NDArray[np.float64]:
        """What each function adds to the step from dark to bright, shape (size,)."""
        inside = np.diff(self._rise(np.array([self.low, self.high])), axis=0)[0]
        return np.concatenate([[1.0, 0.0, 0.0], inside + self._tails.sum(axis=0)])

    @cached_property
    def tails(self) -> NDArray[np.float64]:
        """What each function adds to the step beyond the window, shape (size,)."""
        return np.asarray(self.steps - np.diff(self.edge(np.array([self.low, self.high])), axis=0)[0])

    def root(self, correlation: float) -> NDArray[np.float64]:
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
    levels: NDArray[np.float64]
    """Unknowns beside the shape: the dark level (far away, without `missing`), then slopes of the levels."""
    shape: NDArray[np.float64]
    """Coefficients of the basis, shape (size,)."""
    covariance: NDArray[np.float64]
    """Of the shape's coefficients: noise and what the prior hides, shape (size, size)."""
    hidden: NDArray[np.float64]
    """Directions (k, size) in which the shape may be wrong by one standard deviation without the blocks telling."""
    left_out: NDArray[np.float64]
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
    basis: ProfileBasis,
    observed: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    extra: NDArray[np.float64],
    blocks: NDArray[np.intp],
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
    basis: ProfileBasis, normal: NDArray[np.float64], right: NDArray[np.float64], square: float, number: int, trend: int
) -> tuple[NDArray[np.float64], float, float]:
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


def _looked_up(basis: ProfileBasis, distance: NDArray[np.float64]) -> NDArray[np.float64]:
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


def _quadrature(knots: NDArray[np.float64], most: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Places and weights of Gauss' quadrature between nodes, for cubic pieces times waves up to a frequency."""
    places, weights = [], []
    for a, b in pairwise(knots):
        x, w = _gauss(min(4 + ceil(3.0 * most * (b - a)), 64))
        places.append(0.5 * (a + b) + 0.5 * (b - a) * x)
        weights.append(0.5 * (b - a) * w)
    return np.concatenate(places), np.concatenate(weights)


def _faded(angle: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Transform of 1 / t² from 1 on, at angles for each unit of t: the exponential integral E₂ (DLMF 8.19.12)."""
    wave = 1j * np.where(angle == 0.0, 1.0, angle)
    return np.where(angle == 0.0, 1.0, np.exp(-wave) - wave * exp1(wave))


@lru_cache(maxsize=64)
def _gauss(order: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    places, weights = np.polynomial.legendre.leggauss(order)
    return places, weights
