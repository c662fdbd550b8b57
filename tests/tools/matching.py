"""Offsets between two pictures of one ground, patch by patch: a measuring tool of the tests.

Least-squares matching. A patch of the reference is explained by the moving picture, displaced by (dx, dy) and with a
linear radiometry of its own in every channel. The displacement starts at the best whole-cell correlation inside the
search range and is refined by Gauss-Newton on a cubic spline of the moving picture. Every sum runs over the cells that
have a value in both, so a sparse reference (a coloured point cloud, say) is matched as it is, nothing being filled in.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import ndimage

__all__ = ["Matches", "Picture", "gradients", "match", "robust_sd", "smoothed"]

_STEPS = 20  # Gauss-Newton steps at most
_STILL = 1e-3  # a step below this many reference cells ends the refinement
_WORST_CONDITION = 1e3  # of the normal matrix: texture in one direction only fixes one coordinate
# Gaussian, in cells, that stands for the averaging over one cell of a coarser picture: 0.29 for the square cell alone,
# more because lenses and scattered points average as well. Symmetric, so it moves nothing.
_SIGMA_OF_CELL = 0.4


@dataclass(frozen=True)
class Picture:
    """Channels on a square grid with north up.

    Attributes
    ----------
    values : ndarray, shape (channels, rows, columns)
        float; NaN = no value.
    left, top : float
        Ground coordinates of the outer corner of the upper-left cell, metres.
    cell : float
        Side of a cell, metres.
    """

    values: NDArray[np.float64]
    left: float
    top: float
    cell: float

    def __post_init__(self) -> None:
        if self.values.ndim != 3:
            raise ValueError(f"values of shape {self.values.shape}; needed (channels, rows, columns)")

    def index_of(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray, NDArray]:
        """Ground to (row, column), cell centres being whole numbers."""
        return (self.top - y) / self.cell - 0.5, (x - self.left) / self.cell - 0.5


@dataclass(frozen=True)
class Matches:
    """One entry per patch that could be matched; a feature of the reference at (x, y) lies at (x + dx, y + dy).

    Attributes
    ----------
    x, y : ndarray
        Centres of the patches, metres.
    dx, dy : ndarray
        Offsets of the moving picture, metres, positive east and north.
    quality : ndarray
        Correlation after refinement, root of the share of the variance explained, 0 … 1.
    sigma : ndarray
        Standard deviation of the offset from the fit, metres (the larger axis of its error ellipse).
    """

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    dx: NDArray[np.float64]
    dy: NDArray[np.float64]
    quality: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.x)

    def keep(self, mask: NDArray[np.bool_]) -> Matches:
        """The entries where `mask` is true."""
        return Matches(*(getattr(self, name)[mask] for name in self.__dataclass_fields__))


def robust_sd(values: NDArray[np.float64]) -> float:
    """1.4826 times the median absolute deviation from the median: the standard deviation of the undisturbed part."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def smoothed(picture: Picture, sigma: float) -> Picture:
    """Gaussian smoothing, `sigma` in metres, over the cells that have a value; cells without one stay so."""
    if sigma <= 0:
        return picture
    known = np.isfinite(picture.values)
    spread = (0, sigma / picture.cell, sigma / picture.cell)
    total = ndimage.gaussian_filter(np.where(known, picture.values, 0.0), spread)
    weight = ndimage.gaussian_filter(known.astype(float), spread)
    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.where(known, total / weight, np.nan)
    return Picture(values, picture.left, picture.top, picture.cell)


def gradients(picture: Picture, sigma: float) -> Picture:
    """Channels ∂/∂column and ∂/∂row of every channel, by Gaussian derivatives of `sigma` metres; NaN beside a gap."""
    s = sigma / picture.cell
    known = np.isfinite(picture.values)
    filled = np.where(known, picture.values, 0.0)
    reach = int(4 * s + 0.5)  # where the filter itself ends
    inside = ndimage.binary_erosion(known, np.ones((1, 2 * reach + 1, 2 * reach + 1)), border_value=0)
    parts = [ndimage.gaussian_filter(filled, (0, s, s), order=order) for order in ((0, 0, 1), (0, 1, 0))]
    values = np.concatenate([np.where(inside, part, np.nan) for part in parts])
    return Picture(values, picture.left, picture.top, picture.cell)


class _Moving:
    """The moving picture as cubic splines, with its slopes; NaN where the neighbourhood is incomplete."""

    def __init__(self, picture: Picture) -> None:
        self.picture = picture
        known = np.isfinite(picture.values).all(axis=0)
        mean = picture.values[:, known].mean(axis=1) if known.any() else np.zeros(len(picture.values))
        filled = np.where(known, picture.values, mean[:, None, None])
        self.coefficients = [ndimage.spline_filter(channel, 3, mode="mirror") for channel in filled]
        # Slopes of the spline at the nodes, per metre east and north; between nodes linear is good enough, since
        # they only steer the iteration and weight the residuals.
        across, along = np.array([1.0, 4.0, 1.0]) / 6, np.array([-0.5, 0.0, 0.5])
        east, south = (
            [
                ndimage.correlate1d(ndimage.correlate1d(c, across, axis=1 - axis), along, axis=axis) / picture.cell
                for c in self.coefficients
            ]
            for axis in (1, 0)
        )
        self.slopes = east + [-slope for slope in south]
        self.known = ndimage.binary_erosion(known, np.ones((5, 5)), border_value=0).astype(np.uint8)

    def at(self, x: NDArray, y: NDArray) -> NDArray:
        """Values (channels, ...)."""
        where = np.stack(self.picture.index_of(x, y))
        valid = ndimage.map_coordinates(self.known, where, order=0, cval=0) > 0
        values = [ndimage.map_coordinates(c, where, order=3, prefilter=False, mode="mirror") for c in self.coefficients]
        return np.where(valid, np.stack(values), np.nan)

    def slopes_at(self, x: NDArray, y: NDArray) -> NDArray:
        """∂/∂x and ∂/∂y, shape (2, channels, ...), per metre."""
        where = np.stack(self.picture.index_of(x, y))
        slopes = np.stack([ndimage.map_coordinates(s, where, order=1, mode="mirror") for s in self.slopes])
        return slopes.reshape(2, len(self.coefficients), *x.shape)


def _normalised(values: NDArray) -> NDArray:
    """Channels (channels, cells) minus their mean, divided by their norm; a constant channel becomes zero."""
    centred = values - values.mean(axis=1, keepdims=True)
    return centred / np.maximum(np.sqrt((centred**2).sum(axis=1, keepdims=True)), 1e-30)


def _best_whole_cell(moved: NDArray, patch: NDArray, reach: int, least: float) -> tuple[int, int] | None:
    """Whole-cell displacement (rows, columns) with the largest mean correlation; None at the rim of the range.

    `moved` is the moving picture on the reference's cells, `reach` cells wider than `patch` on every side. Means and
    norms are those of the cells that both pictures know at the displacement.
    """
    inside = np.isfinite(patch).all(axis=0)
    g = _normalised(patch[:, inside])  # centred roughly, so that the differences of sums below lose no digits
    known = np.isfinite(moved).all(axis=0)
    middle = moved[:, known].mean(axis=1) if known.any() else np.zeros(len(moved))
    filled = np.where(known, moved - middle[:, None, None], 0.0)
    shape = patch.shape[1:]
    K = sliding_window_view(known, shape)[:, :, inside].astype(float)
    n = np.maximum(K.sum(axis=-1), 1.0)
    score = np.zeros(n.shape)
    for channel, values in zip(g, filled):
        W = sliding_window_view(values, shape)[:, :, inside]
        sum_g, sum_w = K @ channel, W.sum(axis=-1)
        var_g = K @ channel**2 - sum_g**2 / n
        var_w = (W**2).sum(axis=-1) - sum_w**2 / n
        score += (W @ channel - sum_g * sum_w / n) / np.sqrt(np.maximum(var_g * var_w, 1e-30))
    score[n < least] = -np.inf
    i, j = (int(k) - reach for k in np.unravel_index(np.argmax(score), score.shape))
    return None if n.max() < least or max(abs(i), abs(j)) == reach else (i, j)


def _refined(
    moving: _Moving, x: NDArray, y: NDArray, patch: NDArray, start: tuple[float, float], cell: float, least: float
) -> tuple[float, float, float, float] | None:
    """Gauss-Newton: (dx, dy, quality, sigma), or None where it does not settle within 1.5 cells of the start.

    Solves g = a + b (f + f_x dx + f_y dy) in every channel with common dx, dy; a and b are eliminated. The slopes are
    taken anew at every step: with those of the start, a difference in sharpness would pull the offset.
    """
    d = np.array(start)
    for _ in range(_STEPS):
        f = moving.at(x + d[0], y + d[1])
        known = np.isfinite(f).all(axis=0)
        if known.sum() < least:
            return None
        g = _normalised(patch[:, known])
        f = f[:, known] - f[:, known].mean(axis=1, keepdims=True)
        power = np.maximum((f**2).sum(axis=1, keepdims=True), 1e-30)
        b = (f * g).sum(axis=1, keepdims=True) / power
        s = moving.slopes_at(x[known] + d[0], y[known] + d[1])
        s -= s.mean(axis=2, keepdims=True)
        s -= (s * f).sum(axis=2, keepdims=True) / power * f
        J = (b * s).reshape(2, -1).T
        N = J.T @ J
        residual = (g - b * f).ravel()
        if not np.linalg.cond(N) < _WORST_CONDITION:
            return None
        step = np.linalg.solve(N, J.T @ residual)
        d = d + step
        if np.abs(d - start).max() > 1.5 * cell:
            return None
        if np.abs(step).max() < _STILL * cell:
            break
    else:
        return None
    channels = len(patch)
    freedom = max(int(known.sum()) * channels - 2 - 2 * channels, 1)
    squares = float(residual @ residual)
    sigma = np.sqrt(squares / freedom * np.linalg.eigvalsh(np.linalg.inv(N))[-1])
    return d[0], d[1], float(np.sqrt(max(1.0 - squares / channels, 0.0))), float(sigma)


def match(
    moving: Picture, reference: Picture, *, patch: float, stride: float, search: float, filled: float = 0.7
) -> Matches:
    """Offsets of `moving` against `reference`.

    Parameters
    ----------
    patch, stride, search : float
        Side of a patch, distance between patches, half the search range, metres.
    filled : float
        Share of a patch's cells that must have a value in both pictures.

    Returns
    -------
    Matches
        Patches whose correlation peak lies inside the search range and whose refinement settled; judge them by
        `quality` and `sigma`.
    """
    cell = reference.cell
    side, hop = round(patch / cell), max(1, round(stride / cell))
    reach = int(np.ceil(search / cell)) + 1
    blur = _SIGMA_OF_CELL * np.sqrt(max(cell**2 - moving.cell**2, 0.0))
    source = _Moving(smoothed(moving, blur))
    least = filled * side * side
    rows, cols = reference.values.shape[1:]
    col, row = np.meshgrid(np.arange(-reach, cols + reach), np.arange(-reach, rows + reach))
    x = reference.left + (col + 0.5) * cell
    y = reference.top - (row + 0.5) * cell
    moved = source.at(x, y)
    entries = []
    for r, c in product(range(0, rows - side + 1, hop), range(0, cols - side + 1, hop)):
        block = reference.values[:, r : r + side, c : c + side]
        window = np.s_[r : r + side + 2 * reach, c : c + side + 2 * reach]
        i, j = np.nonzero(np.isfinite(block).all(axis=0))
        middle = np.isfinite(moved[:, r + reach : r + reach + side, c + reach : c + reach + side]).all(axis=0)
        if len(i) < least or middle[i, j].sum() < least:
            continue
        start = _best_whole_cell(moved[(slice(None), *window)], block, reach, least)
        if start is None:
            continue
        px, py = x[window][reach + i, reach + j], y[window][reach + i, reach + j]
        fit = _refined(source, px, py, block[:, i, j], (start[1] * cell, -start[0] * cell), cell, least)
        if fit:
            entries.append((px.mean(), py.mean(), *fit))
    return Matches(*np.array(entries, float).reshape(-1, 6).T)
