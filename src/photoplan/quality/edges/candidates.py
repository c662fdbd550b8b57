"""Straight lines of edge pixels in a picture, to parts of a pixel."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import cos, hypot, isnan, pi, radians, sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter1d

from photoplan.adjustment.robust import MEDIAN_1D, huber, spread
from photoplan.kernels.edge_chains import grow, ridge

Array = NDArray[np.float64]

#: Standard deviation of the Gaussian before the gradient, pixels.
SMOOTHING = 1.2
#: Gradients below so many of their standard deviations are noise.
_ABOVE_NOISE = 5.0
#: Share of the picture's range of values below which a step over the gradient's width is no edge.
_LEAST_STEP = 0.02
#: By how much the gradient may turn within a chain.
_TURN = radians(15.0)
#: Distance of a point from its line at which the line is parted, pixels.
_APART = 0.8
#: How far the middle of a line may be off the straight between its ends: pixels, and share of its length; at most.
#: Lenses bend lines, and the measurement fits a parabola.
_BOW, _BOW_SHARE, _MOST_BOW = 0.3, 0.006, 1.5
#: Chains with more points than this are cut.
_MOST = 20_000
#: Pixels that are looked at for the range of values.
_SAMPLE = 200_000


@dataclass(frozen=True)
class StraightEdge:
    """A straight edge."""

    x: float
    """Column of its middle."""
    y: float
    """Row of its middle."""
    tx: float
    """Unit vector along it; (-ty, tx) points to its bright side, on its right in the picture."""
    ty: float
    length: float
    """Pixels."""
    strength: float
    """Median of the gradient of the smoothed picture, grey values per pixel."""

    @property
    def ends(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Column and row of its ends."""
        dx, dy = self.tx * self.length / 2, self.ty * self.length / 2
        return (self.x - dx, self.y - dy), (self.x + dx, self.y + dy)

    def moved(self, dx: float, dy: float) -> StraightEdge:
        """The same in other pixel coordinates."""
        return replace(self, x=self.x + dx, y=self.y + dy)

    def part(self, start: float, end: float) -> StraightEdge:
        """The part between two distances from its first end, pixels."""
        middle = (start + end - self.length) / 2
        return replace(self, x=self.x + middle * self.tx, y=self.y + middle * self.ty, length=end - start)

    @classmethod
    def between(cls, a: tuple[float, float], b: tuple[float, float], strength: float) -> StraightEdge:
        """Line from a to b, the bright side on its right in the picture."""
        length = hypot(b[0] - a[0], b[1] - a[1])
        tx, ty = (b[0] - a[0]) / length, (b[1] - a[1]) / length
        return cls(x=(a[0] + b[0]) / 2, y=(a[1] + b[1]) / 2, tx=tx, ty=ty, length=length, strength=strength)


def range_of(grey: NDArray[np.float32], valid: NDArray[np.bool_] | None = None) -> float:
    """Range of the values of a picture without half a percent at either end; 0 if nothing is valid."""
    known = grey.ravel() if valid is None else grey[valid]
    if known.size == 0:
        return 0.0
    low, high = np.quantile(known[:: max(1, known.size // _SAMPLE)], [0.005, 0.995])
    return float(high - low)


def noise_of(grey: NDArray[np.float32], valid: NDArray[np.bool_] | None = None) -> float:
    """Standard deviation of the noise, from second differences in the smoothest parts of a picture.

    The mask is that of Immerkær 1996 (Fast noise variance estimation), which is blind to planes; of the medians of
    blocks of 16 × 16 pixels the lowest fifth counts, so that texture does not.
    """
    a = np.asarray(grey, np.float32)
    second = a[:, 2:] - 2 * a[:, 1:-1] + a[:, :-2]
    both = np.abs(second[2:] - 2 * second[1:-1] + second[:-2])
    if valid is not None:
        both[binary_dilation(~valid, np.ones((3, 3)))[1:-1, 1:-1]] = np.nan
    h, w = both.shape[0] // 16 * 16, both.shape[1] // 16 * 16
    blocks = both[:h, :w].reshape(h // 16, 16, w // 16, 16).swapaxes(1, 2).reshape(-1, 256)
    blocks = blocks[np.isfinite(blocks).all(axis=1)]
    if not len(blocks):
        return float("nan")
    # The mask's weights have a root of the sum of squares of 6; a median of magnitudes becomes a deviation.
    return float(np.quantile(np.median(blocks, axis=1), 0.2) / MEDIAN_1D / 6)


def find_lines(
    grey: NDArray[np.float32], valid: NDArray[np.bool_] | None, least_length: float
) -> tuple[list[StraightEdge], Counter[str]]:
    """Straight edges of a picture, the longest first; no test yet of what lies beside them."""
    if min(grey.shape) < 5:
        return [], Counter()
    gx, gy, least = _gradient(grey, valid)
    offset = np.empty(grey.shape, np.float32)
    if not least > 0.0 or ridge(gx, gy, least, offset) == 0:
        return [], Counter()
    row, col = np.nonzero(np.isfinite(offset))
    u = np.stack([gx[row, col], gy[row, col]], 1).astype(float)
    size: Array = np.hypot(*u.T)
    order = np.argsort(-size, kind="stable")
    row, col, u, size = row[order], col[order], (u / size[:, None])[order], size[order]
    index = np.full(grey.shape, -1, np.int32)
    index[row, col] = np.arange(len(row), dtype=np.int32)
    label = np.empty(len(row), np.int32)
    chains = int(grow(index, np.stack([row, col], 1).astype(np.int32), u, cos(_TURN), label))
    steep = np.abs(u[:, 0]) >= np.abs(u[:, 1])
    part = offset[row, col].astype(float)
    points: Array = np.stack([col + np.where(steep, part, 0.0), row + np.where(steep, 0.0, part)], 1)
    return _lines(points, u, size, label, chains, least_length)


def _gradient(
    grey: NDArray[np.float32], valid: NDArray[np.bool_] | None
) -> tuple[NDArray[np.float32], NDArray[np.float32], float]:
    """Gradient of the smoothed picture, 0 where it saw invalid pixels, and the least one of an edge."""
    filled = np.asarray(grey, np.float32)
    if valid is not None:
        if not valid.any():
            return filled, filled, 0.0
        filled = np.where(valid, filled, np.float32(np.median(filled[valid][:: max(1, valid.size // _SAMPLE)])))
    gx = gaussian_filter1d(gaussian_filter1d(filled, SMOOTHING, axis=0), SMOOTHING, axis=1, order=1)
    gy = gaussian_filter1d(gaussian_filter1d(filled, SMOOTHING, axis=1), SMOOTHING, axis=0, order=1)
    if valid is not None:
        near = binary_dilation(~valid, np.ones((3, 3)), iterations=round(3 * SMOOTHING))
        gx[near] = 0.0
        gy[near] = 0.0
    noise = noise_of(grey, valid)
    # White noise of deviation s has gradients of s / (sqrt(8 pi) SMOOTHING²) after the Gaussian.
    from_noise = _ABOVE_NOISE * (0.0 if isnan(noise) else noise) / (sqrt(8 * pi) * SMOOTHING**2)
    from_range = _LEAST_STEP * range_of(grey, valid) / (sqrt(2 * pi) * 2 * SMOOTHING)
    return gx, gy, max(from_noise, from_range)


def _lines(
    points: Array, u: Array, size: Array, label: NDArray[np.int32], chains: int, least_length: float
) -> tuple[list[StraightEdge], Counter[str]]:
    counts = np.bincount(label, minlength=chains)
    order = np.argsort(label, kind="stable")
    starts = np.concatenate([[0], np.cumsum(counts)])
    lines: list[StraightEdge] = []
    reasons: Counter[str] = Counter()
    for k in np.flatnonzero(counts >= 0.7 * least_length):
        chain = order[starts[k] : starts[k + 1]][:_MOST]
        if np.ptp(points[chain], axis=0).max() < 0.7 * least_length:
            continue
        found = list(_straight(points[chain], u[chain].mean(axis=0), size[chain], least_length))
        if not found:
            reasons["curved"] += 1
        lines += found
    lines.sort(key=lambda line: -line.length)
    return lines, reasons


def _straight(points: Array, normal: Array, size: Array, least_length: float) -> Iterator[StraightEdge]:
    """Straight parts of a chain."""
    waiting = [np.arange(len(points))]
    while waiting:
        of = waiting.pop()
        if len(of) < 0.7 * least_length:
            continue
        xy = points[of]
        middle = xy.mean(axis=0)
        along = np.linalg.eigh(np.cov((xy - middle).T))[1][:, 1]
        if along[1] * normal[0] - along[0] * normal[1] > 0:
            along = -along
        t = (xy - middle) @ along
        d = (xy - middle) @ np.array([-along[1], along[0]])
        if np.ptp(t) < least_length:
            continue
        cut = _cut(t, d)
        if cut is not None:
            waiting += [of[t < cut], of[t >= cut]]
            continue
        yield from _solid(middle, along, (t, d), float(np.median(size[of])), least_length)


def _cut(t: Array, d: Array) -> float | None:
    """Where a chain must be parted to be straight; None: it is."""
    order = np.argsort(t)
    ts, ds = t[order], d[order]
    length = float(ts[-1] - ts[0])
    curve = np.polyfit(ts, ds, 2)
    width = max(1, min(9, len(ts) // 5))
    smooth = np.convolve(ds - np.polyval(curve, ts), np.ones(width) / width, "valid")
    worst = int(np.argmax(np.abs(smooth)))
    if abs(smooth[worst]) > _APART:
        at = float(ts[worst + width // 2])
        # A wild end is cut off, not halved away.
        return float(np.clip(at, ts[0] + 0.1 * length, ts[-1] - 0.1 * length))
    most = min(_BOW + _BOW_SHARE * length, _MOST_BOW)
    # Noise of the points bends short lines; it must not part them.
    noise = float(np.std(ds - np.polyval(curve, ts))) / sqrt(len(ts))
    return float((ts[0] + ts[-1]) / 2) if abs(curve[0]) * length**2 / 8.0 > most + 5 * noise else None


def _solid(
    middle: Array, along: Array, td: tuple[Array, Array], strength: float, least_length: float
) -> Iterator[StraightEdge]:
    """Parts of a straight chain without gaps of more than three pixels, fitted robustly."""
    t, d = td
    order = np.argsort(t)
    t, d = t[order], d[order]
    across = np.array([-along[1], along[0]])
    for part in np.split(np.arange(len(t)), np.flatnonzero(np.diff(t) > 3.0) + 1):
        if np.ptp(t[part]) < least_length:
            continue
        tp, dp = t[part], d[part]
        slope, shift = np.polyfit(tp, dp, 1)
        for _ in range(3):
            residual = dp - slope * tp - shift
            scale = max(spread(residual), 0.02)
            slope, shift = np.polyfit(tp, dp, 1, w=np.sqrt(huber(residual / scale, 2.0)))
        a, b = (middle + at * along + (slope * at + shift) * across for at in (tp[0], tp[-1]))
        yield StraightEdge.between((float(a[0]), float(a[1])), (float(b[0]), float(b[1])), strength)
