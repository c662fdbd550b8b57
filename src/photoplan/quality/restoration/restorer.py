"""Restoration filters applied: spectrum of scene and noise, filters and borders."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from math import log, pi, sqrt
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from photoplan.arrays import Floats, Floats32, Mask
from photoplan.errors import InputError, UsageError
from photoplan.geometry.grid import Window
from photoplan.kernels.jit import is_ready
from photoplan.kernels.raster import (
    CHUNK,
    EVEN_TAPS,
    GENERAL_TAPS,
    convolve_even,
    convolve_general,
    mirror_border,
    pixel_range,
    round_clipped,
)
from photoplan.quality.curves import Linearisation

Transfer = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Modulation and its standard deviation at frequencies u along rows and v along columns, cycles per pixel; arrays that
broadcast."""

#: Side of the blocks whose spectra are averaged, pixels.
BLOCK = 64
#: Lowest frequency that is fitted, in steps of a block's spectrum: the window spreads the mean over those below.
_FIRST = 2.5
#: How many times the frequency square is repeated to each side, for what folds back.
FOLDS = 2
#: Range of the exponent of the power spectrum: 2 to 3 in photographs (Field 1987; Ruderman and Bialek 1994), 3 for
#: edges of any place and direction.
_EXPONENTS = (1.0, 3.9)
#: Where its search begins: the likelihood may have several maxima.
_STARTS = (2.0, 3.0)
#: Where the search for a white part of the scene begins: logarithms of its share.
_WHITE = (-3.0, -8.0)
#: The noise of an image, by that of its most even blocks: they may show scene besides, and compression clears them.
_LEAST, _MOST = 0.1, 30.0
#: Share of noise in a spectrum that counts as none.
_NO_NOISE = 1e-12
#: Largest smoothing of noise that is sought, pixels.
_SMOOTHED = 0.8


@dataclass(frozen=True)
class SceneStatistics:
    """Scene that a filter is designed for, in linear light.

    The scene's power spectrum is a power of the frequency and, besides, the same at all frequencies.
    """

    noise: float
    """Standard deviation of the noise, before it was smoothed."""
    contrast: float
    """Root mean square difference of neighbouring pixels as ideal apertures of one pixel without noise would see it."""
    exponent: float = 3.0
    """p of the power spectrum ν⁻ᵖ; 3: edges of any place and direction."""
    smoothed: float = 0.0
    """Sigma of a Gaussian, pixels, that took what is missing of white noise at high frequencies: compression (JPEG),
    interpolation of colours and denoising do."""
    texture: float = 0.0
    """Contrast of the part of the scene that has the same power at all frequencies: texture finer than pixels."""

    def __post_init__(self) -> None:
        some = self.contrast > 0.0 and self.texture >= 0.0
        if not self.noise >= 0.0 or not some or not _EXPONENTS[0] <= self.exponent <= _EXPONENTS[1]:
            raise InputError(
                f"noise {self.noise:g}, contrast {self.contrast:g}, exponent {self.exponent:g}; needed are noise of 0 "
                f"or more, contrast above 0 and an exponent from {_EXPONENTS[0]:g} to {_EXPONENTS[1]:g}"
            )

    def power(self, u: Floats, v: Floats) -> Floats:
        """Power of the scene at frequencies other than 0, cycles per pixel; arrays that broadcast."""
        fractal = self.contrast**2 / _unit_contrast(self.exponent) * np.hypot(u, v) ** -self.exponent
        return np.asarray(fractal + self.texture**2 / _unit_contrast(0.0))

    def noise_power(self, u: Floats, v: Floats) -> Floats:
        """Power of the noise at frequencies up to 0.5 cycles per pixel; arrays that broadcast."""
        return np.asarray(self.noise**2 * np.exp(-((2.0 * pi * self.smoothed) ** 2) * (u**2 + v**2)))


def frequency_grid(count: int = 64) -> tuple[Floats, Floats]:
    """Frequencies of all folds, u and v of shapes (folds, 1, count) and (folds, count, 1), none of them 0."""
    base = (np.arange(count) + 0.5) / count - 0.5
    down, right = (part.ravel() for part in np.mgrid[-FOLDS : FOLDS + 1, -FOLDS : FOLDS + 1])
    return base[None, None, :] + right[:, None, None], base[None, :, None] + down[:, None, None]


@lru_cache(maxsize=256)
def _unit_contrast(exponent: float) -> float:
    """Mean square difference of neighbours for the power spectrum ν⁻ᵖ."""
    u, v = frequency_grid()
    power = np.hypot(u, v) ** -exponent * (np.sinc(u) * np.sinc(v)) ** 2
    # Of both directions the mean.
    return float((power * 2.0 * (np.sin(pi * u) ** 2 + np.sin(pi * v) ** 2)).sum(axis=0).mean())


def block_spectra(grey: Floats, usable: Mask | None = None) -> Floats:
    """Power spectra of overlapping blocks under a Hann window, mean taken off."""
    side = min(BLOCK, *grey.shape)
    keep = np.isfinite(grey) if usable is None else np.isfinite(grey) & usable
    views = [
        np.lib.stride_tricks.sliding_window_view(a, (side, side))[:: side // 2, :: side // 2].reshape(-1, side, side)
        for a in (grey, keep)
    ]
    blocks = views[0][views[1].all(axis=(1, 2))]
    across = np.hanning(side + 2)[1:-1]
    window = np.outer(across, across)
    level = (blocks * window).sum(axis=(1, 2), keepdims=True) / window.sum()
    return np.asarray(np.abs(np.fft.fft2((blocks - level) * window)) ** 2 / (window**2).sum())


def scenes_of(
    spectrum: Floats, transfer: Transfer, even: float, stated: float | None = None
) -> tuple[SceneStatistics, ...]:
    """Return what an image may show by its mean spectrum: what is fine in it is texture, or it is noise.

    A blurred white texture and noise that was smoothed have the same spectrum, and the mean spectrum alone cannot tell
    which it is. So there are two answers: noise of any size and smoothing, and no texture; and white noise, no more
    than the most even blocks show, and for the rest a texture. Where the image has none of both, they agree.
    """
    if stated is not None:
        return (fit_scene(spectrum, transfer, (stated, stated), textured=True),)
    return (
        fit_scene(spectrum, transfer, (_LEAST * even, _MOST * even)),
        fit_scene(spectrum, transfer, (_LEAST * even, even), textured=True),
    )


def fit_scene(
    spectrum: Floats, transfer: Transfer, noise: tuple[float, float], *, textured: bool = False
) -> SceneStatistics:
    """Noise, contrast and exponent of the scene by which a mean spectrum is likeliest (Whittle 1953)."""
    side = spectrum.shape[0]
    base = np.fft.fftfreq(side)
    down, right = (part.ravel()[:, None] for part in np.mgrid[-FOLDS : FOLDS + 1, -FOLDS : FOLDS + 1])
    rows, columns = np.meshgrid(base, base, indexing="ij")
    used = np.hypot(rows, columns) >= min(_FIRST / side, 0.3)
    # The spectrum of an image is the same at opposite frequencies.
    used &= (rows > 0.0) | ((rows == 0.0) & (columns > 0.0)) | (rows == -0.5)
    u, v = columns[used][None] + right, rows[used][None] + down
    passed, logarithm = transfer(u, v)[0] ** 2, np.log(np.hypot(u, v))
    flat, square = passed.sum(axis=0), (2.0 * pi) ** 2 * (rows**2 + columns**2)[used]
    scale = float(spectrum[used].mean())
    seen = spectrum[used] / scale

    def loss(at: Floats) -> tuple[float, Floats]:
        scene = passed * np.exp(at[0] - at[1] * logarithm)
        signal, noisy, white = scene.sum(axis=0), np.exp(at[2] - at[3] * square), flat * np.exp(at[4])
        model = signal + noisy + white
        slope = (1.0 - seen / model) / model
        each = signal, -(scene * logarithm).sum(axis=0), noisy, -noisy * square, white
        return float((np.log(model) + seen / model).mean()), np.array([(slope * d).mean() for d in each])

    low, high = (log(max(n**2 / scale, _NO_NOISE)) for n in noise)
    smoothing = (0.0, 0.0 if textured else _SMOOTHED**2)
    bounds = ((-40.0, 20.0), _EXPONENTS, (low, high), smoothing, (-40.0, 20.0 if textured else -40.0))
    tried = []
    for exponent in _STARTS:
        power = (passed * np.exp(-exponent * logarithm)).sum(axis=0)
        starts = [(0.2, 0.0), (0.8, 0.0), *([] if textured else [(0.8, 0.2)])]
        for (share, smoothed), white in product(starts, _WHITE if textured else (-40.0,)):
            start = (-log(float(power.mean())), exponent, low + share * (high - low), smoothed, white)
            tried.append(scipy.optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds))
    factor, exponent, noisy, smoothed, white = min(tried, key=lambda one: float(one.fun)).x
    contrast = sqrt(scale * np.exp(factor) * _unit_contrast(float(exponent)))
    found = sqrt(scale * np.exp(noisy)) if noise[1] > 0.0 else 0.0
    texture = sqrt(scale * np.exp(white) * _unit_contrast(0.0)) if textured else 0.0
    return SceneStatistics(
        noise=found, contrast=contrast, exponent=float(exponent), smoothed=sqrt(smoothed), texture=texture
    )


#: Kernels wider than this are refused: they come from damaged files rather than from optics.
MOST_WIDTH = 101


@dataclass(frozen=True, eq=False)
class FilterKernel:
    """A two-dimensional kernel; the restored image is the image convolved with it."""

    values: Floats
    """Shape (2 m + 1, 2 n + 1): rows, columns; ``values[m + i, n + k]`` is the weight of the pixel i rows above and k
    columns left of the restored one."""
    at: tuple[float, float] | None = None
    """Column and row where in the image it holds, pixels; None: everywhere."""
    band: int | None = None
    """Band that it is for, counted from 1; None: all."""

    def __post_init__(self) -> None:
        values = np.array(self.values, np.float64)
        if values.ndim != 2 or values.shape[0] % 2 == 0 or values.shape[1] % 2 == 0:
            raise InputError(f"a filter has an odd number of rows and columns; given is shape {values.shape}")
        if max(values.shape) > MOST_WIDTH:
            raise InputError(
                f"a filter of {values.shape[1]} × {values.shape[0]} values; at most {MOST_WIDTH} are allowed"
            )
        if not np.isfinite(values).all():
            raise InputError("a filter has finite values only")
        values.setflags(write=False)
        object.__setattr__(self, "values", values)

    @property
    def total(self) -> float:
        """Sum of the values: 1 keeps the mean brightness."""
        return float(self.values.sum())

    @property
    def noise_gain(self) -> float:
        """By what factor uncorrelated noise grows: the root of the sum of squares."""
        return sqrt(float((self.values**2).sum()))


@dataclass(frozen=True, eq=False)
class RestorationFilter:
    """Kernels of one image or camera, for each band and place in the field."""

    kernels: tuple[FilterKernel, ...]
    """At least one. For a band either one without place, or several with places, between which is interpolated."""
    image_size: tuple[int, int] | None = None
    """Width and height of the images that the places refer to; None where no kernel has a place."""
    description: str = ""
    """How it was made, in words."""
    facts: Mapping[str, object] = field(default_factory=dict)
    """Figures of its making, such as spread function, condition, rule and noise gain; plain values."""

    def __post_init__(self) -> None:
        if not self.kernels:
            raise InputError("a restoration filter has at least one kernel")
        for band in {kernel.band for kernel in self.kernels}:
            places = [kernel.at for kernel in self.kernels if kernel.band == band]
            if len(places) > 1 and (None in places or len(set(places)) < len(places)):
                name = "all bands" if band is None else f"band {band}"
                raise InputError(f"a filter with several kernels for {name} needs a different place for each of them")
        if any(kernel.at is not None for kernel in self.kernels) and self.image_size is None:
            raise InputError("a filter whose kernels have places states the size of the image that they refer to")

    @property
    def margin(self) -> tuple[int, int]:
        """Columns and rows that the widest and highest kernel reaches beyond a pixel."""
        return (
            max(kernel.values.shape[1] for kernel in self.kernels) // 2,
            max(kernel.values.shape[0] for kernel in self.kernels) // 2,
        )

    def for_band(self, band: int) -> tuple[FilterKernel, ...]:
        """Kernels of a band, counted from 1: its own, else those of all bands; empty if the band stays as it is."""
        own = tuple(kernel for kernel in self.kernels if kernel.band == band)
        return own or tuple(kernel for kernel in self.kernels if kernel.band is None)

    @property
    def noise_gain(self) -> float:
        """The largest of its kernels' noise gains."""
        return max(kernel.noise_gain for kernel in self.kernels)


#: Columns of zeros that a source has before and behind its pixels, for vectors and unrolled loops.
LEFT, RIGHT = max(EVEN_TAPS), CHUNK + max(GENERAL_TAPS)
#: Part of a kernel's largest value by which mirrored values of a symmetric one may differ: the rounding of its making.
SAME = 1e-9
_ALL = np.empty((0, 0), bool)


@dataclass(frozen=True, eq=False)
class Convolution:
    """One kernel, convolved in float32.

    Kernels that are the same upside down and left to right, to `SAME` of their largest value, are folded to a quarter;
    all others are summed as they are. The result of a pixel differs from exact arithmetic by at most
    ``2e-7 · (rows + columns) · Σ|weights|`` times the largest pixel below the kernel (rounding of float32 sums).
    """

    kernel: FilterKernel
    even: bool = field(init=False)
    """Whether the fast way for symmetric kernels is taken."""
    _weights: Floats32 = field(init=False, repr=False)
    """As the compiled code wants them, filled up with columns of zeros."""
    _tag: tuple[int, ...] = field(init=False, repr=False)
    _zeros: int = field(init=False, repr=False)
    """Columns of zeros before the kernel's first."""

    def __post_init__(self) -> None:
        # A convolution turns the kernel round: its weights by the order of the pixels that they are for.
        values = self.kernel.values[::-1, ::-1]
        m, n = (side // 2 for side in values.shape)
        differs = max(float(np.abs(values - turned).max()) for turned in (values[::-1], values[:, ::-1]))
        even = differs <= SAME * float(np.abs(values).max())
        if even:
            taps = min(EVEN_TAPS, key=lambda t: -(-n // t) * t)
            zeros = -n % taps if n else taps
            part, before = values[m:, n:], zeros
        else:
            taps = min(GENERAL_TAPS, key=lambda t: -(-(2 * n + 1) // t) * t)
            zeros = -(2 * n + 1) % taps
            part, before = values, 0
        weights = np.ascontiguousarray(np.pad(part, ((0, 0), (0, zeros))), np.float32)
        for name, value in (("even", even), ("_weights", weights), ("_tag", (0,) * taps), ("_zeros", before)):
            object.__setattr__(self, name, value)

    def __call__(
        self, source: Floats32, margin: tuple[int, int], out: NDArray[Any], valid: Mask | None = None
    ) -> tuple[int, int]:
        """Convolve the inner part of an array."""
        rows, columns = (side // 2 for side in self.kernel.values.shape)
        if margin[0] < columns or margin[1] < rows:
            raise UsageError(f"a margin of {margin} pixels; the kernel reaches {(columns, rows)}")
        start = margin[1] - rows, LEFT + margin[0] - columns - self._zeros
        usable = _ALL if valid is None else valid
        return self._code()(source, start, self._weights, self._tag, usable, pixel_range(out.dtype), out)

    def is_compiled(self, out: np.dtype[Any]) -> bool:
        """Whether the code for results of a type is compiled already, here or on the disk."""
        source, result = np.zeros((1, 1), np.float32), np.zeros((1, 1), out)
        arguments = (source, (0, 0), self._weights, self._tag, _ALL, pixel_range(out), result)
        return bool(is_ready(self._code(), arguments))

    def _code(self) -> Any:
        return convolve_even if self.even else convolve_general


#: Values that are kept for the next tile; larger arrays are made and given back (64 MiB).
MOST_KEPT = 1 << 24


class Scratch(threading.local):
    """Float32 arrays by name, of this thread alone; what they hold is what was left in them."""

    def __init__(self) -> None:
        self._kept: dict[str, Floats32] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> Floats32:
        """An array to be filled; it is the same memory as the last one of this name."""
        count = int(np.prod(shape))
        if count > MOST_KEPT:
            return np.empty(shape, np.float32)
        kept = self._kept.get(name)
        if kept is None or kept.size < count:
            kept = self._kept[name] = np.empty(count, np.float32)
        return kept[:count].reshape(shape)


@dataclass(frozen=True)
class Margin:
    """How far filters reach beyond a pixel, and what they find there.

    Pixels beyond the image and invalid ones are one case: q gets ``2 v(p) - v(2 p - q)`` from the nearest valid pixel p
    (`photoplan.kernels.raster`). Constants and linear ramps go on, so there is nothing for a filter to sharpen: across
    a straight edge an even filter leaves the outermost pixel as it is (times its sum), noise included. Only pixels that
    a filter of this reach can need are looked at, hence the result is that of any other tile.
    """

    columns: int
    rows: int

    def around(self, window: Window, size: tuple[int, int], gaps: bool = True) -> Window:
        """Pixels of an image of `size` that the filtered pixels of a window depend on."""
        times = 3 if gaps else 1
        columns, rows = times * self.columns, times * self.rows
        wide = (window.col - columns, window.row - rows, window.stop[0] + columns, window.stop[1] + rows)
        left, top = max(wide[0], 0), max(wide[1], 0)
        return Window(left, top, min(wide[2], size[0]) - left, min(wide[3], size[1]) - top)

    def fits(self, window: Window, size: tuple[int, int]) -> bool:
        """Whether a window lies so far inside the image that nothing has to be continued at its edge."""
        return self.around(window, size, gaps=False).size == (window.width + 2 * self.columns) * (
            window.height + 2 * self.rows
        )

    def source(
        self, window: Window, pixels: NDArray[Any], at: Window, valid: Mask | None, scratch: Scratch | None = None
    ) -> Floats32:
        """Pixels of a window with its margin, all of them finite, as `Convolution` wants them."""
        wide = Window(
            window.col - self.columns,
            window.row - self.rows,
            window.width + 2 * self.columns,
            window.height + 2 * self.rows,
        )
        shape = (pixels.shape[0], wide.height, LEFT + wide.width + RIGHT)
        out = np.empty(shape, np.float32) if scratch is None else scratch.array("source", shape)
        out[..., :LEFT] = 0
        out[..., LEFT + wide.width :] = 0
        common = wide & at
        of, to = _part(common, at), _part(common, wide)
        body = out[..., LEFT : LEFT + wide.width]
        body[:, *to] = pixels[:, *of]
        gaps = valid is not None and not valid[of].all()
        if gaps or (valid is not None and common.size < wide.size):
            assert valid is not None
            known = np.zeros((wide.height, wide.width), bool)
            known[to] = valid[of]
            body[:, ~known] = 0
            wanted = self._near(valid, at, wide) & ~known
            place = (wide.row - at.row, wide.col - at.col, LEFT)
            light = np.ascontiguousarray(pixels, np.float32)
            mirror_border(light, np.ascontiguousarray(valid), wanted, _offsets(self.columns, self.rows), place, out)
        elif common.size < wide.size:
            _beyond_edges(pixels, at, wide, to, body)
        return out

    def _near(self, valid: Mask, at: Window, wide: Window) -> Mask:
        """Pixels of `wide` that have a valid one within reach."""
        sums = np.zeros((at.height + 1, at.width + 1), np.int64)
        sums[1:, 1:] = valid.cumsum(0, np.int64).cumsum(1)
        rows, cols = np.arange(wide.row, wide.stop[1]) - at.row, np.arange(wide.col, wide.stop[0]) - at.col
        top, bottom = np.clip(rows - self.rows, 0, at.height), np.clip(rows + self.rows + 1, 0, at.height)
        left, right = np.clip(cols - self.columns, 0, at.width), np.clip(cols + self.columns + 1, 0, at.width)
        found = sums[np.ix_(bottom, right)] - sums[np.ix_(top, right)]
        return np.asarray(found - sums[np.ix_(bottom, left)] + sums[np.ix_(top, left)] > 0)


def _part(common: Window, of: Window) -> tuple[slice, slice]:
    """Rows and columns of a common part in the arrays of a window."""
    return (slice(common.row - of.row, common.stop[1] - of.row), slice(common.col - of.col, common.stop[0] - of.col))


def _beyond_edges(pixels: NDArray[Any], at: Window, wide: Window, to: tuple[slice, slice], body: Floats32) -> None:
    """What `extend_oddly` does where the image has no gaps: its nearest pixel is found without search."""
    rows, cols = np.arange(wide.row, wide.stop[1]) - at.row, np.arange(wide.col, wide.stop[0]) - at.col
    above, below, left, right = (
        slice(0, to[0].start),
        slice(to[0].stop, None),
        slice(0, to[1].start),
        slice(to[1].stop, None),
    )
    for part in ((above, slice(None)), (below, slice(None)), (to[0], left), (to[0], right)):
        y, x = rows[part[0]], cols[part[1]]
        if not y.size or not x.size:
            continue
        py, px = np.clip(y, 0, at.height - 1), np.clip(x, 0, at.width - 1)
        my, mx = 2 * py - y, 2 * px - x
        inside = np.logical_and.outer((my >= 0) & (my < at.height), (mx >= 0) & (mx < at.width))
        nearest = pixels[:, py[:, None], px].astype(np.float32)
        mirror = pixels[:, np.clip(my, 0, at.height - 1)[:, None], np.clip(mx, 0, at.width - 1)].astype(np.float32)
        body[:, *part] = np.where(inside, np.float32(2.0) * nearest - mirror, nearest)


@lru_cache(maxsize=16)
def _offsets(columns: int, rows: int) -> NDArray[np.int32]:
    """Squared distance, rows and columns of all neighbours within reach, the nearest first."""
    dy, dx = np.mgrid[-rows : rows + 1, -columns : columns + 1]
    squared = dy**2 + dx**2
    order = np.lexsort((dx.ravel(), dy.ravel(), squared.ravel()))[1:]
    table = np.stack([squared.ravel(), dy.ravel(), dx.ravel()], axis=1)[order].astype(np.int32)
    table.setflags(write=False)
    return table


_SCRATCH = Scratch()


@dataclass(frozen=True, eq=False)
class RestoredPixels:
    """A restored window."""

    values: NDArray[Any]
    """(bands, height, width); 0 where invalid."""
    valid: Mask | None
    """(height, width); None: all. Invalid pixels are those of the image."""
    below: tuple[int, ...]
    """Valid pixels of each band that would be below the least value of the type."""
    above: tuple[int, ...]
    """Valid pixels of each band that would be above its largest."""


@dataclass(frozen=True, eq=False)
class Restorer:
    """Convolves images of one size and type; the result does not depend on how the image is cut into windows."""

    filter: RestorationFilter
    size: tuple[int, int]
    """Width and height of the images, pixels."""
    bands: int
    dtype: np.dtype[Any]
    """Type of their pixels: uint8, uint16, int16 or float32."""
    out: np.dtype[Any]
    """Type of the restored pixels; grey values keep their scale."""
    linearisation: Linearisation = field(default_factory=Linearisation)
    """How grey values become light, which is what is filtered; the result is encoded again."""
    nodata: float | None = None
    """A value of whole numbers that restored pixels do not take: they become its neighbour."""
    light_given: bool = False
    """Whether windows hold light as float32, on the scale of `dtype`, instead of grey values."""
    _ready: tuple[tuple[Convolution, ...], ...] = field(init=False, repr=False)
    """Convolutions of each band."""

    def __post_init__(self) -> None:
        known = self.filter.image_size
        if known is not None and tuple(known) != tuple(self.size) and any(k.at for k in self.filter.kernels):
            raise InputError(
                f"the filter has places in images of {known[0]} × {known[1]} pixels, the image has {self.size[0]} × "
                f"{self.size[1]}; an image that was cropped or scaled needs a filter of its own"
            )
        for kernel in self.filter.kernels:
            if kernel.band is not None and not 1 <= kernel.band <= self.bands:
                raise InputError(f"the filter has a kernel for band {kernel.band}; the image has {self.bands}")
        ready = {id(kernel): Convolution(kernel) for kernel in self.filter.kernels}
        bands = (self.filter.for_band(band + 1) for band in range(self.bands))
        object.__setattr__(self, "_ready", tuple(tuple(ready[id(k)] for k in kernels) for kernels in bands))

    @property
    def margin(self) -> Margin:
        """How far the filter reaches."""
        return Margin(*self.filter.margin)

    @property
    def is_compiled(self) -> bool:
        """Whether the code for all kernels is compiled already."""
        direct = self.linearisation.is_linear
        return all(
            each.is_compiled(self.out if direct and len(ready) == 1 else np.dtype(np.float32))
            for ready in self._ready
            for each in ready
        )

    def restore(self, window: Window, pixels: NDArray[Any], at: Window, valid: Mask | None) -> RestoredPixels:
        """Restore a window."""
        rows = slice(window.row - at.row, window.stop[1] - at.row)
        cols = slice(window.col - at.col, window.stop[0] - at.col)
        mask = None if valid is None else np.ascontiguousarray(valid[rows, cols])
        mask = None if mask is None or mask.all() else mask
        values = np.zeros((self.bands, window.height, window.width), self.out)
        counts = []
        for band in range(self.bands):
            if mask is not None and not mask.any():
                counts.append((0, 0))
                continue
            if self._ready[band]:
                light = pixels[band]
                if not self.light_given:
                    light = light_of(self.linearisation, light, valid, band + 1)
                source = self.margin.source(window, light[None], at, valid, _SCRATCH)[0]
                counts.append(self._convolved(source, window, mask, band, values[band]))
            else:
                grey = np.ascontiguousarray(pixels[band, rows, cols], np.float32)
                lost = (0, 0)
                if self.light_given:
                    grey, lost = self._grey(grey, mask, band + 1)
                clipped = _store(grey, mask, values[band])
                counts.append((lost[0] + clipped[0], lost[1] + clipped[1]))
        self._keep_apart(values)
        if mask is not None:
            values[:, ~mask] = 0
        return RestoredPixels(values, mask, tuple(c[0] for c in counts), tuple(c[1] for c in counts))

    def _convolved(
        self, source: Floats32, window: Window, mask: Mask | None, band: int, values: NDArray[Any]
    ) -> tuple[int, int]:
        """Grey values of a window of light, filtered; returns how many pixels were clipped."""
        ready, margin = self._ready[band], self.filter.margin
        places = [each.kernel.at or (0.0, 0.0) for each in ready]
        if len(ready) == 1 and self.linearisation.is_linear:
            return ready[0](source, margin, values, mask)
        part, total = (_SCRATCH.array(name, values.shape) for name in ("part", "total"))
        total[:] = 0
        for index, weights in field_weights(places, window):
            ready[index](source, margin, part if weights is not None else total)
            if weights is not None:
                np.multiply(part, weights, out=part)
                np.add(total, part, out=total, where=weights > 0)
        grey, lost = self._grey(total, mask, band + 1)
        clipped = _store(grey, mask, values)
        return lost[0] + clipped[0], lost[1] + clipped[1]

    def _grey(self, light: Floats32, mask: Mask | None, band: int) -> tuple[Floats32, tuple[int, int]]:
        """Grey values of light, and how many valid pixels were darker and brighter than a table reaches."""
        if self.linearisation.is_linear:
            return light, (0, 0)
        lost = (0, 0)
        if self.linearisation.kind == "table":
            low, high = self.linearisation.limits(self.dtype, band)
            count = np.ones(light.shape, bool) if mask is None else mask
            lost = int(((light < np.float32(low)) & count).sum()), int(((light > np.float32(high)) & count).sum())
        return self.linearisation.to_values(light.astype(np.float64), self.dtype, band).astype(np.float32), lost

    def _keep_apart(self, values: NDArray[Any]) -> None:
        """Give the neighbour of the nodata value to pixels that happen to have it."""
        if self.nodata is None or self.out.kind == "f":
            return
        limits = np.iinfo(self.out)
        if limits.min <= self.nodata <= limits.max:
            step = 1 if self.nodata < limits.max else -1
            values[values == self.out.type(self.nodata)] = self.out.type(self.nodata + step)


def light_of(linearisation: Linearisation, grey: NDArray[Any], valid: Mask | None, band: int) -> NDArray[Any]:
    """Light of grey values of a band (from 1), float32; as they are where they are light already.

    What invalid pixels hold is of no account.
    """
    if linearisation.is_linear:
        return grey
    if linearisation.kind == "srgb" and grey.dtype.kind == "u":
        table = linearisation.to_linear(np.arange(np.iinfo(grey.dtype).max + 1, dtype=grey.dtype), band)
        return table.astype(np.float32)[grey]
    if valid is not None and valid.any():
        grey = np.where(valid, grey, grey[valid][0])
    return linearisation.to_linear(grey, band).astype(np.float32)


def _store(grey: Floats32, mask: Mask | None, values: NDArray[Any]) -> tuple[int, int]:
    """Round into the type of the result; returns how many pixels were clipped."""
    if values.dtype.kind == "f":
        values[:] = grey
        return 0, 0
    usable = np.empty((0, 0), bool) if mask is None else mask
    below, above = round_clipped(grey, usable, pixel_range(values.dtype), values)
    return int(below), int(above)


def field_weights(places: Sequence[tuple[float, float]], window: Window) -> list[tuple[int, Floats32 | None]]:
    """Weights of the places for every pixel of a window; they add up to 1.

    Places that form a full grid (each of their columns with each of their rows, whatever the steps) are interpolated
    bilinearly, and beyond the outer ones the outer ones hold. Others get weights by the inverse square of the distance
    (Shepard 1968), so that each place has its own filter exactly and far from all of them their mean holds.
    """
    if len(places) == 1:
        return [(0, None)]
    col = np.arange(window.col, window.stop[0], dtype=np.float64)
    row = np.arange(window.row, window.stop[1], dtype=np.float64)
    cols, rows = sorted({x for x, _ in places}), sorted({y for _, y in places})
    found = []
    if len(cols) * len(rows) == len(places):
        across, down = _hats(cols, col), _hats(rows, row)
        for i, (x, y) in enumerate(places):
            along, below = across[cols.index(x)], down[rows.index(y)]
            if along.any() and below.any():
                found.append((i, np.multiply.outer(below, along).astype(np.float32)))
        return found
    nearness = [1.0 / np.maximum((row[:, None] - y) ** 2 + (col - x) ** 2, 1e-12) for x, y in places]
    total = np.sum(nearness, axis=0)
    return [(i, (near / total).astype(np.float32)) for i, near in enumerate(nearness)]


def _hats(nodes: Sequence[float], at: Floats) -> Floats:
    """Linear interpolation between nodes as one row of weights for each of them, (nodes, positions)."""
    return np.stack([np.interp(at, nodes, unit) for unit in np.eye(len(nodes))])
