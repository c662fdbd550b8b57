"""The search for edges: candidates, strips, checks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from math import ceil, cos, floor, hypot, isnan, pi, radians, sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from photoplan.adjustment.least_squares import MEDIAN_1D, huber, spread
from photoplan.adjustment.statistics import chance_chi_square
from photoplan.arrays import Floats, Floats32, Mask
from photoplan.errors import InputError
from photoplan.findings import with_sigma
from photoplan.kernels.raster import gradient_ridge, join_chains

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


def range_of(grey: Floats32, valid: Mask | None = None) -> float:
    """Range of the values of a picture without half a percent at either end; 0 if nothing is valid."""
    known = grey.ravel() if valid is None else grey[valid]
    if known.size == 0:
        return 0.0
    low, high = np.quantile(known[:: max(1, known.size // _SAMPLE)], [0.005, 0.995])
    return float(high - low)


def noise_of(grey: Floats32, valid: Mask | None = None) -> float:
    """Standard deviation of the noise, from second differences in the smoothest parts of a picture.

    The mask is that of Immerkær 1996 (Fast noise variance estimation), which is blind to planes; of the medians of
    blocks of 16 × 16 pixels the lowest fifth counts, so that texture does not.
    """
    a = np.asarray(grey, np.float32)
    second = a[:, 2:] - 2 * a[:, 1:-1] + a[:, :-2]
    both = np.abs(second[2:] - 2 * second[1:-1] + second[:-2])
    if valid is not None:
        both[scipy.ndimage.binary_dilation(~valid, np.ones((3, 3)))[1:-1, 1:-1]] = np.nan
    h, w = both.shape[0] // 16 * 16, both.shape[1] // 16 * 16
    blocks = both[:h, :w].reshape(h // 16, 16, w // 16, 16).swapaxes(1, 2).reshape(-1, 256)
    blocks = blocks[np.isfinite(blocks).all(axis=1)]
    if not len(blocks):
        return float("nan")
    # The mask's weights have a root of the sum of squares of 6; a median of magnitudes becomes a deviation.
    return float(np.quantile(np.median(blocks, axis=1), 0.2) / MEDIAN_1D / 6)


def find_lines(grey: Floats32, valid: Mask | None, least_length: float) -> tuple[list[StraightEdge], Counter[str]]:
    """Straight edges of a picture, the longest first; no test yet of what lies beside them."""
    if min(grey.shape) < 5:
        return [], Counter()
    gx, gy, least = _gradient(grey, valid)
    offset = np.empty(grey.shape, np.float32)
    if not least > 0.0 or gradient_ridge(gx, gy, least, offset) == 0:
        return [], Counter()
    row, col = np.nonzero(np.isfinite(offset))
    u = np.stack([gx[row, col], gy[row, col]], 1).astype(float)
    size: Floats = np.hypot(*u.T)
    order = np.argsort(-size, kind="stable")
    row, col, u, size = row[order], col[order], (u / size[:, None])[order], size[order]
    index = np.full(grey.shape, -1, np.int32)
    index[row, col] = np.arange(len(row), dtype=np.int32)
    label = np.empty(len(row), np.int32)
    chains = int(join_chains(index, np.stack([row, col], 1).astype(np.int32), u, cos(_TURN), label))
    steep = np.abs(u[:, 0]) >= np.abs(u[:, 1])
    part = offset[row, col].astype(float)
    points: Floats = np.stack([col + np.where(steep, part, 0.0), row + np.where(steep, 0.0, part)], 1)
    return _lines(points, u, size, label, chains, least_length)


def _gradient(grey: Floats32, valid: Mask | None) -> tuple[Floats32, Floats32, float]:
    """Gradient of the smoothed picture, 0 where it saw invalid pixels, and the least one of an edge."""
    filled = np.asarray(grey, np.float32)
    if valid is not None:
        if not valid.any():
            return filled, filled, 0.0
        filled = np.where(valid, filled, np.float32(np.median(filled[valid][:: max(1, valid.size // _SAMPLE)])))
    gx = scipy.ndimage.gaussian_filter1d(
        scipy.ndimage.gaussian_filter1d(filled, SMOOTHING, axis=0), SMOOTHING, axis=1, order=1
    )
    gy = scipy.ndimage.gaussian_filter1d(
        scipy.ndimage.gaussian_filter1d(filled, SMOOTHING, axis=1), SMOOTHING, axis=0, order=1
    )
    if valid is not None:
        near = scipy.ndimage.binary_dilation(~valid, np.ones((3, 3)), iterations=round(3 * SMOOTHING))
        gx[near] = 0.0
        gy[near] = 0.0
    noise = noise_of(grey, valid)
    # White noise of deviation s has gradients of s / (sqrt(8 pi) SMOOTHING²) after the Gaussian.
    from_noise = _ABOVE_NOISE * (0.0 if isnan(noise) else noise) / (sqrt(8 * pi) * SMOOTHING**2)
    from_range = _LEAST_STEP * range_of(grey, valid) / (sqrt(2 * pi) * 2 * SMOOTHING)
    return gx, gy, max(from_noise, from_range)


def _lines(
    points: Floats, u: Floats, size: Floats, label: NDArray[np.int32], chains: int, least_length: float
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


def _straight(points: Floats, normal: Floats, size: Floats, least_length: float) -> Iterator[StraightEdge]:
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


def _cut(t: Floats, d: Floats) -> float | None:
    """Return the place at which a chain must be parted to be straight; None if it is."""
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
    middle: Floats, along: Floats, td: tuple[Floats, Floats], strength: float, least_length: float
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


#: Length of a block along the line, pixels.
_BLOCK = 6.0
#: Factor by which means of cells may scatter more than single pixels let expect: noise of compressed or interpolated
#: images hangs together over two pixels.
_TOGETHER = 2.0
#: Shares of a block's pixels that may be saturated or invalid.
_SPOILT = 0.01
#: Share of the contrast by which grey values may go beyond both sides next to an edge: more is a line, not enhancement.
_SEAM = 0.35
#: Pixels of a side that must lie beyond the blur.
SIDE = 3
#: Pixels that one strip may take at most.
_MOST_STRIP = 16_000_000


@dataclass(frozen=True)
class Blur:
    """Reach of an edge, pixels."""

    dark: float
    """From the line to the even dark side."""
    bright: float
    seam: float
    """Width beyond that in which edge enhancement shows."""

    @property
    def least_half(self) -> float:
        """Half width of the narrowest window that holds something of both sides."""
        return 1.2 * max(self.dark, self.bright) + SIDE


@dataclass(frozen=True, eq=False)
class Strip:
    """Sums of the pixels beside a line: blocks along it, bins of one pixel across it."""

    line: StraightEdge
    block: float
    """Length of a block, pixels."""
    half: int
    """Bins to each side."""
    count: Floats
    """Pixels used, shape (blocks, 2 half); the bins go from the dark to the bright side."""
    total: Floats
    """Their sum."""
    square: Floats
    """Their sum of squares."""
    saturated: Floats
    """Saturated pixels."""
    invalid: Floats
    """Invalid pixels, those outside the image included."""

    def profile(self) -> Floats:
        """Medians over the blocks of the means of the bins, shape (2 half,); NaN where there is nothing."""
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.where(self.count >= 2, self.total / self.count, np.nan)
        return _median(means.T)

    def blur(self) -> Blur | None:
        """Return how far the step reaches to both sides, and the seam next to it; None if unknown.

        The step ends where its slope has fallen to a twentieth; the seam is as wide as the step's rise: there is what
        edge enhancement does.
        """
        profile = self.profile()
        middle = self.half
        slope = np.diff(profile)
        near = slope[middle - 3 : middle + 2]
        if not np.isfinite(near).all() or near.max() <= 0.0:
            return None
        peak = middle - 3 + int(np.argmax(near))
        # Second differences tell the noise of the slopes: their own weights have a sum of squares of 6.
        bends = np.abs(np.diff(profile, 2))
        noise = float(_median(bends)) / MEDIAN_1D / 6**0.5 * 2**0.5
        even = max(0.05 * slope[peak], 2.0 * noise)
        ends = []
        for step in (-1, 1):
            k = peak
            # Two bins must be even: noise may hide a part of a wide edge.
            while 0 <= k + 2 * step < len(slope) and max(slope[k + step], slope[k + 2 * step]) > even:
                k += step
            # Slope k lies between bins k and k + 1, at distance k + 1 - half from the line.
            ends.append(abs(k + 1 - middle) + 0.5)
        low, high = (profile[middle + s] for s in (-max(1, round(ends[0])), max(0, round(ends[1]) - 1)))
        width = 1.02 * (high - low) / slope[peak] if np.isfinite(high - low) else 3.0
        ring = float(np.clip(width, 2.0, 6.0))
        return Blur(ends[0], ends[1], ring)

    def sides(self, blur: Blur, half: int) -> Sides:
        """Both sides beyond blur and seam, in a window of half a width; narrow ones hold a part of the seam."""
        outer = self.half - half
        dark_end, bright_end = (min(end + blur.seam, half - SIDE) for end in (blur.dark, blur.bright))
        dark = slice(outer, floor(self.half - dark_end))
        bright = slice(ceil(self.half + bright_end), self.half + half)
        return Sides.of(self, dark, bright, slice(outer, 2 * self.half - outer))

    def worst_reason(self) -> str:
        """Return why no profile could be made."""
        return "saturated" if self.saturated.sum() > self.invalid.sum() else "invalid"


@dataclass(frozen=True, eq=False)
class Sides:
    """The cells beyond the blur on both sides."""

    strip: Strip
    dark: slice
    bright: slice
    window: slice
    means: tuple[Floats, Floats]
    """Means of the blocks, on the dark and on the bright side; NaN without a pixel."""
    noises: tuple[float, float]
    """Medians over the blocks of the deviation of pixels about the means of their bins, of both sides."""

    @classmethod
    def of(cls, strip: Strip, dark: slice, bright: slice, window: slice) -> Sides:
        """Both sides with their means and noise, which are asked for again and again."""
        means = _means(strip, dark), _means(strip, bright)
        noises = _noise(strip, dark), _noise(strip, bright)
        return cls(strip=strip, dark=dark, bright=bright, window=window, means=means, noises=noises)

    def blocks(self, chosen: Mask) -> Sides:
        """Only the blocks that are chosen."""
        s = self.strip
        sums = (each[chosen] for each in (s.count, s.total, s.square, s.saturated, s.invalid))
        return Sides.of(Strip(s.line, s.block, s.half, *sums), self.dark, self.bright, self.window)

    @property
    def contrast(self) -> float:
        """Bright minus dark side, medians of the blocks."""
        dark, bright = (float(_median(mean)) for mean in self.means)
        return bright - dark

    @property
    def noise(self) -> float:
        """Standard deviation of the pixels of both sides about the means of their blocks and bins."""
        return sqrt(sum(noise**2 for noise in self.noises) / 2)

    @property
    def snr(self) -> float:
        """Contrast over noise; capped at 10000 where there is none."""
        contrast = self.contrast
        return contrast / max(self.noise, 1e-4 * contrast) if contrast > 0.0 else 0.0

    def good_blocks(self, evenness: float) -> tuple[Mask, Counter[str]]:
        """Return which blocks are clean, and what the others are."""
        s = self.strip
        everything = (s.count + s.saturated + s.invalid)[:, self.window].sum(axis=1)
        saturated = s.saturated[:, self.window].sum(axis=1) > _SPOILT * everything
        invalid = s.invalid[:, self.window].sum(axis=1) > _SPOILT * everything
        uneven = np.zeros(len(everything), bool)
        textured = np.zeros(len(everything), bool)
        contrast = self.contrast
        for side, mean, noise in zip((self.dark, self.bright), self.means, self.noises):
            count = s.count[:, side].sum(axis=1)
            allowed = np.maximum(evenness * contrast, 4 * _TOGETHER**0.5 * noise / np.sqrt(np.maximum(count, 1)))
            middle = _median(mean)
            # Light changes slowly along an edge: each block is compared with those around it.
            local = _running_median(mean, 9)
            textured |= ~(np.abs(mean - local) <= allowed)
            uneven |= ~(np.abs(mean - middle) <= 6 * allowed)
            deviation = np.sqrt(np.maximum(s.square[:, side].sum(axis=1) / np.maximum(count, 1) - mean**2, 0.0))
            uneven |= ~(deviation <= np.maximum(2.5 * noise, evenness * contrast))
        bad = {"saturated": saturated, "invalid": invalid, "two_sided": uneven, "textured": textured}
        why = Counter({name: int(mask.sum()) for name, mask in bad.items()})
        good = ~(saturated | invalid | uneven | textured)
        # Saturated pixels are left out of the sums, what remains then looks uneven: the cause is named, not the effect.
        if saturated.any() and saturated.sum() >= 0.3 * len(saturated):
            return good, Counter(saturated=1)
        return good, +why

    def reason(self, evenness: float, least_snr: float) -> str:
        """Return why the blocks together are no edge to measure; empty if they are one."""
        contrast = self.contrast
        inner = self.strip.profile()[self.dark.stop : self.bright.start]
        low, high = (float(_median(mean)) for mean in self.means)
        beyond = max(low - float(np.nanmin(inner)), float(np.nanmax(inner)) - high)
        # A line or a narrow bar: what rises at the edge falls again within the blur.
        if beyond > max(_SEAM * contrast, least_snr * self.noise / 2):
            return "two_sided"
        if not contrast > 0.0 or self.snr < least_snr:
            return "weak"
        s = self.strip
        for side, mean, noise in zip((self.dark, self.bright), self.means, self.noises):
            count = s.count[:, side].sum(axis=1)
            # Blocks of a side that scatter more than noise does are texture.
            expected = _TOGETHER * noise / sqrt(float(_median(count)))
            if _scatter(mean) > max(evenness / 2 * contrast, 2 * expected):
                return "textured"
            if self._grain(side, noise) > 0.6 * evenness * contrast:
                return "textured"
            bins = s.total[:, side].sum(axis=0) / np.maximum(s.count[:, side].sum(axis=0), 1)
            error = _TOGETHER**0.5 * noise / np.sqrt(np.maximum(s.count[:, side].sum(axis=0), 1))
            if (np.abs(bins - _median(bins)) > np.maximum(evenness * contrast, 4 * error)).any():
                return "two_sided"
        return ""

    def _grain(self, side: slice, noise: float) -> float:
        """Deviation of the means of cells, three bins wide and a block long, beyond what single pixels let expect."""
        s = self.strip
        count, total = ((a[:, side][:, : (side.stop - side.start) // 3 * 3]) for a in (s.count, s.total))
        count, total = (a.reshape(len(a), -1, 3).sum(axis=2) for a in (count, total))
        full = count >= 6
        if np.count_nonzero(full) < 3:
            return 0.0
        means = np.where(full, total / np.maximum(count, 1), np.nan)
        # Slow changes along the edge are light, not texture.
        apart = (means - _running_median(means.T, 9).T)[full]
        expected = _TOGETHER * noise**2 / float(_median(count[full]))
        return sqrt(max(float(np.mean(apart**2)) - expected, 0.0))


def _means(s: Strip, side: slice) -> Floats:
    count = s.count[:, side].sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0, s.total[:, side].sum(axis=1) / count, np.nan)


def _noise(s: Strip, side: slice) -> float:
    count, total, square = s.count[:, side], s.total[:, side], s.square[:, side]
    inner = (square - np.divide(total**2, count, out=np.zeros_like(total), where=count > 0)).sum(axis=1)
    free = (count - (count > 0)).sum(axis=1)
    some = free > 0
    if not some.any():
        return 0.0
    return sqrt(max(float(_median(inner[some] / free[some])), 0.0))


def _scatter(values: Floats) -> float:
    """Standard deviation about a straight line; 0 for no more than two values."""
    if len(values) <= 2:
        return 0.0
    t = np.arange(len(values)) - (len(values) - 1) / 2
    rest = values - values.mean() - (t @ values) / (t @ t) * t
    return sqrt(float(rest @ rest) / (len(values) - 2))


def _median(values: Floats) -> Floats:
    """Medians of the last axis without NaN; NaN where there is nothing else."""
    ordered = np.sort(values, axis=-1).ravel()
    known = np.isfinite(values).sum(axis=-1)
    first = np.arange(known.size).reshape(known.shape) * values.shape[-1]
    middle = (ordered[first + np.maximum(known - 1, 0) // 2] + ordered[first + known // 2]) / 2
    return np.asarray(np.where(known > 0, middle, np.nan))


def _running_median(values: Floats, width: int) -> Floats:
    """Medians of so many neighbours along the last axis, fewer at the ends."""
    half = width // 2
    padded = np.full((*values.shape[:-1], values.shape[-1] + 2 * half), np.nan)
    padded[..., half : values.shape[-1] + half] = values
    return _median(np.lib.stride_tricks.sliding_window_view(padded, width, axis=-1))


def strip_along(
    grey: Floats32, valid: Mask | None, saturated: Mask | None, line: StraightEdge, half: int
) -> Strip | None:
    """Sum the pixels beside a line."""
    xs, ys = zip(*line.ends)
    reach = half + 1
    col, row = floor(min(xs)) - reach, floor(min(ys)) - reach
    width, height = ceil(max(xs)) + reach + 1 - col, ceil(max(ys)) + reach + 1 - row
    if width * height > _MOST_STRIP:
        return None
    dx = np.arange(col, col + width) - line.x
    dy = (np.arange(row, row + height) - line.y)[:, None]
    along = dx * line.tx + dy * line.ty + line.length / 2
    across = dy * line.tx - dx * line.ty
    i, j = np.nonzero((np.abs(across) < half) & (along >= 0) & (along < line.length))
    blocks = max(1, int(line.length // _BLOCK))
    block = line.length / blocks
    bins = np.floor(across[i, j] + half).astype(np.int64)
    cell = np.minimum((along[i, j] / block).astype(np.int64), blocks - 1) * 2 * half + bins
    y, x = i + row, j + col
    inside = (x >= 0) & (x < grey.shape[1]) & (y >= 0) & (y < grey.shape[0])
    usable, clipped = inside.copy(), np.zeros(len(x), bool)
    if valid is not None:
        usable[inside] &= valid[y[inside], x[inside]]
    if saturated is not None:
        clipped[usable] = saturated[y[usable], x[usable]]
    if not usable.any():
        return None
    shape = (blocks, 2 * half)
    good = usable & ~clipped
    values = grey[y[good], x[good]].astype(float)
    # A value near all of them keeps the sums of squares exact.
    base = float(np.median(values)) if values.size else 0.0
    values -= base

    def summed(of: Mask, weights: Floats | None = None) -> Floats:
        return np.bincount(cell[of], weights, minlength=shape[0] * shape[1]).astype(float).reshape(shape)

    return Strip(
        line=line,
        block=block,
        half=half,
        count=summed(good),
        total=summed(good, values),
        square=summed(good, values**2),
        saturated=summed(clipped),
        invalid=summed(~usable),
    )


#: Side of the squares beside the edge whose means are tested for structure, pixels.
CELL = 5
#: Chance of error of the tests: a clean edge is refused once in so many.
CHANCE = 1e-4


@dataclass(frozen=True)
class EdgeSettings:
    """Demands on an edge, and the description of its profile."""

    curve: int = 1
    """1: a straight line; 2: a parabola, for edges that a lens bends."""
    reach: float = 16.0
    """Distance in pixels up to which pixels are used (8 standard deviations of wider edges); light that is spread
    farther is estimated. Infinite: the whole region, for evenly lit targets: uneven light across the edge looks like
    stray light."""
    blocks: int = 20
    """Into how many independent profiles an edge is split at most; a block has two rows at least."""
    confidence: float = 0.95
    """Probability that an interval holds the true figure."""
    least_length: float = 12.0
    """Shortest edge, pixels."""
    least_snr: float = 5.0
    """Smallest ratio of step to noise of a pixel."""
    most_clipped: float = 0.01
    """Largest share of clipped pixels on a side."""
    most_structure: float = 0.03
    """Largest structure beside the edge that is not noise, root mean square relative to the step."""
    most_uncertain: float = 0.5
    """Widest interval of MTF50 to each side, relative to it."""
    most_bend: float = 0.1
    """Largest deviation from the line, root mean square in pixels, that is more than noise."""

    def __post_init__(self) -> None:
        if self.curve not in (1, 2):
            raise InputError(f"the line of an edge has degree 1 (straight) or 2 (parabola); given: {self.curve}")
        if self.blocks < 5:
            raise InputError(f"an interval needs 5 blocks of an edge at least; given: {self.blocks}")
        if not self.reach >= 4.0:
            raise InputError(f"the reach of an edge is 4 pixels at least; given: {self.reach}")
        if not 0.5 <= self.confidence < 1.0:
            raise InputError(f"a confidence is 0.5 or more and below 1; given: {self.confidence}")


@dataclass(frozen=True, eq=False)
class EdgeResiduals:
    """Residuals of the pixels after a profile, relative to the step, with their places; shape (n,) each."""

    across: Floats
    along: Floats
    distance: Floats
    value: Floats
    spread: Floats
    """Line spread function at the pixels, per pixel."""
    width: float
    """Standard deviation of the line spread function, pixels."""


def check_region(image: Floats, valid: Mask) -> Mask:
    """Mask of the valid and finite pixels; refuse what is no region: wrong shape, too small, too large, empty."""
    if image.ndim != 2 or valid.shape != image.shape:
        raise InputError(
            f"a region is an array of rows and columns with a mask like it; given: {image.shape}, {valid.shape}"
        )
    if min(image.shape) < 8:
        raise InputError(f"a region for an edge has 8 × 8 pixels at least; given: {image.shape[1]} × {image.shape[0]}")
    if image.size > 16_000_000:
        raise InputError(
            f"a region for an edge has 16 million pixels at most; given: {image.shape[1]} × {image.shape[0]}"
        )
    # The pixels along an oblique edge fill a small part of the rectangle around them.
    valid = valid & np.isfinite(image)
    if np.count_nonzero(valid) < 100:
        raise InputError(f"the region has {np.count_nonzero(valid)} valid pixels; 100 at least are needed")
    return valid


def check_clipping(light: Floats, distance: Floats, limits: tuple[float, float] | None, most: float) -> None:
    """Refuse an edge with a clipped side: its profile is cut off, and no figure of it is right."""
    if limits is None:
        return
    low, high = limits
    slack = 1e-9 * max(abs(low), abs(high), 1e-300)
    for side, name in ((distance < 0.0, "dark"), (distance > 0.0, "bright")):
        values = light[side]
        if values.size == 0:
            continue
        share = float(np.mean((values <= low + slack) | (values >= high - slack)))
        if share > most:
            raise InputError(
                f"saturated edge: {100 * share:.1f} % of the pixels on its {name} side are clipped ({low:g} or "
                f"{high:g}), allowed are {100 * most:g} %; take an image with another exposure"
            )


def check_step(step: float, noise: float, grain: float, settings: EdgeSettings) -> None:
    """Refuse a region without a significant step, a step drowned in noise, and pixels that one edge does not
    explain.
    """
    if not step > 1.5 * noise or not step > 1.5 * grain:
        raise InputError(
            f"no edge: both sides differ by {step:.3g}, while single pixels deviate by {noise:.3g} from one edge"
        )
    if step < settings.least_snr * noise:
        if noise > 1.7 * grain:
            raise InputError(
                f"the sides of the edge are not even: pixels deviate from one edge by {100 * noise / step:.0f} % of "
                f"its step, {noise / grain if grain > 0.0 else np.inf:.1f} times their noise (a second edge, a corner "
                "or texture); choose a cleaner or narrower region"
            )
        raise InputError(
            f"edge too noisy: the step is {step / noise:.1f} times a pixel's noise, at least {settings.least_snr:g} "
            "are needed; use a stronger edge, or the mean of several images"
        )


def check_one_peak(positions: Floats, line: Floats, sigma: Floats) -> None:
    """Refuse a line spread function with a second peak: a second edge beside the first.

    A peak counts if it lies 3 pixels or more from the main one, has a sixth of its height and four standard deviations,
    and the line between both falls below half of it (ripples of edge enhancement stay far below that).
    """
    top = int(np.argmax(line))
    for side in (slice(top, None), slice(top, None, -1)):
        away, height, error = np.abs(positions[side] - positions[top]), line[side], sigma[side]
        valley = np.minimum.accumulate(height)
        second = (away >= 3.0) & (height > line[top] / 6.0) & (height > 4.0 * error) & (valley < 0.5 * height)
        if second.any():
            i = int(np.argmax(np.where(second, height, 0.0)))
            raise InputError(
                f"the sides of the edge are not even: a second edge {away[i]:.1f} pixels beside the first one, "
                f"{100 * height[i] / line[top]:.0f} % as steep; choose a narrower region"
            )


def check_overshoot(overshoot: float, undershoot: float) -> None:
    """Refuse a profile that goes farther beyond a level than from one to the other: a line."""
    most = max(overshoot, undershoot)
    if most > 1.0:
        raise InputError(
            f"no edge but a line: beside it light goes {100 * most:.0f} % of the step beyond both sides; choose "
            "a region with one edge"
        )


def check_certainty(mtf50: float, reach: float, most: float) -> None:
    """Refuse an edge whose MTF50 is hardly known; one that is not determined at all (NaN) says so itself."""
    if reach > most * mtf50:
        raise InputError(
            f"edge too noisy or too short: MTF50 would be {with_sigma(mtf50, reach)} cycles per pixel, allowed are "
            f"{100 * most:g} %; use a longer or stronger edge"
        )


def grain(pixels: Floats, along: Floats, across: Floats) -> float:
    """Noise of a pixel from differences of neighbours along the edge; robust, so that the edge itself hardly counts."""
    order = np.lexsort((along, across))
    near = (np.diff(along[order]) == 1.0) & (np.diff(across[order]) == 0.0)
    steps = np.diff(pixels[order])[near]
    return spread(steps) / float(np.sqrt(2.0)) if steps.size else 0.0


def check_line(residuals: EdgeResiduals, most: float, curve: int) -> float:
    """Root mean square deviation of the edge from its line beyond noise, pixels; refuse a bent edge.

    Each row's shift is that of least squares, Σ r · LSF / Σ LSF²; shifts of the rows are compared with what the pixels'
    noise explains, as means over stretches of the edge.
    """
    row = residuals.along.astype(np.intp)
    row -= row.min()
    near = residuals.spread > 0.05 * residuals.spread.max()
    weight = np.bincount(row[near], residuals.spread[near] ** 2, row.max() + 1)
    moment = np.bincount(row[near], (residuals.value * residuals.spread)[near], row.max() + 1)
    good = weight > 0.5 * np.median(weight[weight > 0.0])
    if np.count_nonzero(good) < 12:
        return 0.0
    rows = int(np.count_nonzero(good))
    groups = np.arange(rows) // max(4, rows // 12)
    total, sums = np.bincount(groups, weight[good]), np.bincount(groups, moment[good])
    shift = sums / total
    noise = float(residuals.value[near].var())
    excess = float((shift**2).mean() - noise * (1.0 / total).mean())
    chance = chance_chi_square((shift**2 * total).sum() / max(noise, 1e-30), shift.size)
    deviation = float(np.sqrt(max(excess, 0.0)))
    if chance < CHANCE and deviation > most:
        advice = ("measure it as a curve of degree 2, or " if curve == 1 else "") + "choose a shorter region"
        raise InputError(
            f"bent edge: it deviates from its line by {deviation:.2f} pixels (root mean square), allowed are {most:g}; "
            f"{advice}"
        )
    return deviation


def check_sides(residuals: EdgeResiduals, most: float) -> float:
    """Structure beside the edge that noise does not explain, root mean square relative to the step; refuse too much.

    Means over squares of 5 × 5 pixels on either side are compared with the noise of single pixels, which follows from
    differences of neighbours along the edge (χ² test); a second edge, a corner or a texture all show so.
    """
    far = np.abs(residuals.distance) > 2.0 * residuals.width
    value = residuals.value[far]
    across, along = residuals.across[far].astype(np.intp), residuals.along[far].astype(np.intp)
    if value.size < 4 * CELL * CELL:
        return 0.0
    across, along = across - across.min(), along - along.min()
    frame = np.full((along.max() + 1, across.max() + 1), np.nan)
    frame[along, across] = value
    steps = np.diff(frame, axis=0)
    steps = steps[np.isfinite(steps)]
    noise = spread(steps) ** 2 / 2.0 if steps.size else 0.0
    noise = max(noise, float((steps**2).mean()) / 2.0 if steps.size else 0.0)
    side = (residuals.distance[far] > 0.0).astype(np.intp)
    cell = (along // CELL * (across.max() // CELL + 1) + across // CELL) * 2 + side
    count = np.bincount(cell)
    sums = np.bincount(cell, value)[count >= 5]
    count = count[count >= 5]
    if count.size < 4:
        return 0.0
    square = sums**2 / count
    chance = chance_chi_square(square.sum() / max(noise, 1e-30), count.size)
    structure = float(np.sqrt(max((square.sum() - noise * count.size) / count.sum(), 0.0)))
    if chance < CHANCE and structure > most:
        largest = float(np.abs(sums / count).max())
        what = "a second edge, a corner or another object" if largest > 0.25 else "texture"
        raise InputError(
            f"the sides of the edge are not even: {what} of {100 * structure:.1f} % of the step (root mean square; "
            f"up to {100 * largest:.0f} %) where {100 * most:g} % are allowed; choose a cleaner or narrower region"
        )
    return structure


#: Why an edge is not measured, as messages say it.
REASONS = {
    "curved": "curved",
    "invalid": "in invalid pixels or at the border of the image",
    "saturated": "saturated",
    "two_sided": "with another edge beside them",
    "textured": "with texture beside them",
    "weak": "with too little contrast for their noise",
    "blurred": "wider than the window",
    "short": "clean over too short a length",
    "refused": "refused when they were measured",
}
#: Widths of half a window that are tried, pixels.
_HALVES = (20, 16, 13, 11, 9, 7)
#: Wider ones, where they are asked for.
_WIDE = (26, 33, 42, 52)
#: Good blocks that must lie before and behind a gap.
_RUN = 5


@dataclass(frozen=True)
class EdgeRules:
    """Demands on an edge."""

    least_length: float = 20.0
    """Pixels."""
    least_snr: float = 8.0
    """Contrast over the noise of both sides."""
    evenness: float = 0.05
    """Share of the contrast by which the sides may change in a systematic way."""
    least_contrast: float = 0.05
    """Share of the range of grey values of the picture."""
    halves: tuple[int, ...] = _HALVES
    """Half widths of the window that are tried, pixels."""

    @classmethod
    def within(cls, half: int, least_length: float, least_snr: float) -> EdgeRules:
        """Rules with windows that reach no farther than half a width, pixels."""
        halves = (*(h for h in _WIDE + _HALVES if h < half), half)
        return cls(halves=halves, least_length=least_length, least_snr=least_snr)

    def __post_init__(self) -> None:
        if not 8.0 <= self.least_length <= 10_000.0:
            raise InputError(f"least length of an edge {self.least_length:g} px; 8 to 10000 px are allowed")
        if not self.halves or min(self.halves) < 5 or max(self.halves) > 100:
            raise InputError(f"half widths of a window {self.halves}; 5 to 100 px are allowed")
        if not self.least_snr >= 3.0:
            raise InputError(f"least contrast over noise {self.least_snr:g}; at least 3 is needed")


@dataclass(frozen=True, eq=False)
class EdgePicture:
    """A picture, or a part of one, in which edges are sought."""

    grey: Floats32
    """Values proportional to light, shape (h, w)."""
    valid: Mask | None = None
    """True = may be used; None: all."""
    saturated: Mask | None = None
    """True = at an end of the range of values; None: none."""
    span: float = field(default=float("nan"))
    """Range of the values of the whole picture; NaN: that of this part."""

    def __post_init__(self) -> None:
        if self.grey.ndim != 2:
            raise InputError(f"a picture of one band has rows and columns; given is shape {self.grey.shape}")
        for mask in (self.valid, self.saturated):
            if mask is not None and mask.shape != self.grey.shape:
                raise InputError(f"a mask of shape {mask.shape} for a picture of shape {self.grey.shape}")
        if isnan(self.span):
            object.__setattr__(self, "span", range_of(self.grey, self.valid))


@dataclass(frozen=True, eq=False)
class EdgeRegion:
    """An edge, and the pixels around it that belong to it and to nothing else."""

    line: StraightEdge
    """In pixel coordinates of the picture that was searched."""
    half: int
    """Pixels reach so far to both sides of the line."""
    contrast: float
    """Bright minus dark side, grey values of the picture."""
    snr: float
    """Contrast over the standard deviation of the sides."""
    aligned: bool
    """Too nearly parallel to rows or columns for all positions within a pixel to occur along it."""
    gaps: tuple[tuple[float, float], ...] = ()
    """Stretches that are left out, from and to distances along the line from its middle, pixels."""
    of: int = 0
    """Number of the straight line that it is a part of."""

    @property
    def merit(self) -> float:
        """Order in which edges are preferred: those with little noise in the mean, slanted ones first."""
        return self.snr * sqrt(self.line.length) * (0.5 if self.aligned else 1.0)

    def window(self, size: tuple[int, int]) -> tuple[int, int, int, int]:
        """Column, row, width and height of the smallest window around its pixels in a picture of a size."""
        xs, ys = zip(*self.line.ends)
        reach = self.half + 2
        col, row = max(0, floor(min(xs)) - reach), max(0, floor(min(ys)) - reach)
        right, bottom = min(size[0], ceil(max(xs)) + reach + 1), min(size[1], ceil(max(ys)) + reach + 1)
        return col, row, right - col, bottom - row

    def mask(self, window: tuple[int, int, int, int]) -> Mask:
        """Its pixels in a window (column, row, width, height), shape (height, width), True = belongs to it."""
        col, row, width, height = window
        line = self.line
        dx = np.arange(width) + (col - line.x)
        dy = (np.arange(height) + (row - line.y))[:, None]
        along = dx * line.tx + dy * line.ty
        across = dy * line.tx - dx * line.ty
        mask = (np.abs(along) <= line.length / 2) & (np.abs(across) <= self.half)
        for start, end in self.gaps:
            mask &= (along < start) | (along > end)
        return np.asarray(mask)


def find_edges(picture: EdgePicture, rules: EdgeRules | None = None) -> tuple[list[EdgeRegion], Counter[str]]:
    """Edges of a picture that can be measured.

    Returns
    -------
    list of EdgeRegion
        The best first.
    Counter
        How many others were rejected for what, by the keys of `REASONS`.
    """
    rules = rules or EdgeRules()
    lines, reasons = find_lines(picture.grey, picture.valid, rules.least_length)
    found: list[EdgeRegion] = []
    for line in lines:
        region, reason = examine(picture, line, rules)
        if region is None:
            reasons[reason] += 1
        else:
            found.append(region)
    found.sort(key=lambda region: -region.merit)
    return found, reasons


def examine(picture: EdgePicture, line: StraightEdge, rules: EdgeRules) -> tuple[EdgeRegion | None, str]:
    """The part of a line where both sides are clean, in the widest window that allows it."""
    strip = strip_along(picture.grey, picture.valid, picture.saturated, line, max(rules.halves))
    if strip is None:
        return None, "invalid"
    blur = strip.blur()
    if blur is None:
        return None, strip.worst_reason()
    least_contrast = rules.least_contrast * picture.span
    best: tuple[float, EdgeRegion] | None = None
    reasons: Counter[str] = Counter()
    for half in sorted(rules.halves, reverse=True):
        if half < blur.least_half:
            break
        region, reason = _clean_part(strip, blur, half, rules, least_contrast)
        if region is None:
            reasons[reason] += 1
            continue
        # A narrower window must make the edge much longer: tails of the spread function need width.
        score = region.line.length * half**0.5
        if best is None or score > 1.25 * best[0]:
            best = score, region
        if region.line.length > 0.8 * line.length:
            break
    if best is not None:
        return best[1], ""
    return None, reasons.most_common(1)[0][0] if reasons else "blurred"


def _clean_part(
    strip: Strip, blur: Blur, half: int, rules: EdgeRules, least_contrast: float
) -> tuple[EdgeRegion | None, str]:
    sides = strip.sides(blur, half)
    good, why = sides.good_blocks(rules.evenness)
    start, end = _longest(_bridged(good))
    step = strip.block
    length = (end - start) * step
    if length < rules.least_length:
        return None, why.most_common(1)[0][0] if why else "short"
    # A short clean part of a line that is mostly not clean is so by chance.
    if length < 2 * rules.least_length and length < 0.5 * strip.line.length and why:
        return None, why.most_common(1)[0][0]
    chosen = good.copy()
    chosen[:start] = chosen[end:] = False
    part = sides.blocks(chosen)
    reason = part.reason(rules.evenness, rules.least_snr)
    if reason or part.contrast < least_contrast:
        return None, reason or "weak"
    line = strip.line.part(start * step, start * step + length)
    bad = np.flatnonzero(~good[start:end])
    gaps = tuple((float(k * step - length / 2), float((k + 1) * step - length / 2)) for k in bad)
    return EdgeRegion(
        line=line, half=half, contrast=part.contrast, snr=part.snr, aligned=_is_aligned(line), gaps=gaps
    ), ""


def _bridged(good: Mask) -> Mask:
    """Good blocks, and one or two others between long runs of good ones: the edge goes on behind a spot."""
    bridged = good.copy()
    for k in range(_RUN, len(good) - _RUN):
        for width in (1, 2):
            after = good[k + width : k + width + _RUN]
            if not good[k] and len(after) == _RUN and after.all() and good[k - _RUN : k].all():
                bridged[k : k + width] = True
    return bridged


def _longest(good: Mask) -> tuple[int, int]:
    """First and last + 1 of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(np.int8), [0]])))
    if not edges.size:
        return 0, 0
    starts, ends = edges[::2], edges[1::2]
    k = int(np.argmax(ends - starts))
    return int(starts[k]), int(ends[k])


def _is_aligned(line: StraightEdge) -> bool:
    """Return whether the edge crosses less than one row or column of pixels along its length."""
    return min(abs(line.tx), abs(line.ty)) * line.length < 1.0
