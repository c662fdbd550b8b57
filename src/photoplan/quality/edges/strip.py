"""The strip of pixels along a line, summed in cells: are both sides even, valid, and free of other edges?"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import ceil, floor, sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.adjustment.robust import MEDIAN_1D
from photoplan.quality.edges.candidates import StraightEdge

Array = NDArray[np.float64]

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
_MOST = 16_000_000


@dataclass(frozen=True)
class Blur:
    """How far an edge reaches, pixels."""

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
    count: Array
    """Pixels used, shape (blocks, 2 half); the bins go from the dark to the bright side."""
    total: Array
    """Their sum."""
    square: Array
    """Their sum of squares."""
    saturated: Array
    """Saturated pixels."""
    invalid: Array
    """Invalid pixels, those outside the image included."""

    def profile(self) -> Array:
        """Medians over the blocks of the means of the bins, shape (2 half,); NaN where there is nothing."""
        with np.errstate(invalid="ignore", divide="ignore"):
            means = np.where(self.count >= 2, self.total / self.count, np.nan)
        return _median(means.T)

    def blur(self) -> Blur | None:
        """How far the step reaches to both sides, and the seam beside it; None: unknown.

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
        """Why no profile could be made."""
        return "saturated" if self.saturated.sum() > self.invalid.sum() else "invalid"


@dataclass(frozen=True, eq=False)
class Sides:
    """The cells beyond the blur on both sides."""

    strip: Strip
    dark: slice
    bright: slice
    window: slice
    means: tuple[Array, Array]
    """Of the blocks, on the dark and on the bright side; NaN: without a pixel."""
    noises: tuple[float, float]
    """Medians over the blocks of the deviation of pixels about the means of their bins, of both sides."""

    @classmethod
    def of(cls, strip: Strip, dark: slice, bright: slice, window: slice) -> Sides:
        """Both sides with their means and noise, which are asked for again and again."""
        means = _means(strip, dark), _means(strip, bright)
        noises = _noise(strip, dark), _noise(strip, bright)
        return cls(strip=strip, dark=dark, bright=bright, window=window, means=means, noises=noises)

    def blocks(self, chosen: NDArray[np.bool_]) -> Sides:
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

    def good_blocks(self, evenness: float) -> tuple[NDArray[np.bool_], Counter[str]]:
        """Which blocks are clean, and what the others are."""
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
        """Why the blocks together are no edge to measure; empty if they are one."""
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


def _means(s: Strip, side: slice) -> Array:
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


def _scatter(values: Array) -> float:
    """Standard deviation about a straight line; 0 for no more than two values."""
    if len(values) <= 2:
        return 0.0
    t = np.arange(len(values)) - (len(values) - 1) / 2
    rest = values - values.mean() - (t @ values) / (t @ t) * t
    return sqrt(float(rest @ rest) / (len(values) - 2))


def _median(values: Array) -> Array:
    """Medians of the last axis without NaN; NaN where there is nothing else."""
    ordered = np.sort(values, axis=-1).ravel()
    known = np.isfinite(values).sum(axis=-1)
    first = np.arange(known.size).reshape(known.shape) * values.shape[-1]
    middle = (ordered[first + np.maximum(known - 1, 0) // 2] + ordered[first + known // 2]) / 2
    return np.asarray(np.where(known > 0, middle, np.nan))


def _running_median(values: Array, width: int) -> Array:
    """Medians of so many neighbours along the last axis, fewer at the ends."""
    half = width // 2
    padded = np.full((*values.shape[:-1], values.shape[-1] + 2 * half), np.nan)
    padded[..., half : values.shape[-1] + half] = values
    return _median(np.lib.stride_tricks.sliding_window_view(padded, width, axis=-1))


def strip_along(
    grey: NDArray[np.float32],
    valid: NDArray[np.bool_] | None,
    saturated: NDArray[np.bool_] | None,
    line: StraightEdge,
    half: int,
) -> Strip | None:
    """Sum the pixels beside a line."""
    xs, ys = zip(*line.ends)
    reach = half + 1
    col, row = floor(min(xs)) - reach, floor(min(ys)) - reach
    width, height = ceil(max(xs)) + reach + 1 - col, ceil(max(ys)) + reach + 1 - row
    if width * height > _MOST:
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

    def summed(of: NDArray[np.bool_], weights: Array | None = None) -> Array:
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
