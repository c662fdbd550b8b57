"""Statistics of frames that were taken under one condition, gathered frame by frame.

The mean image, the temporal variance of every pixel, and their summary. A lamp that flickers makes whole frames
brighter or darker; the summary takes the differences of the frames' means out of the temporal variance (as
EMVA 1288 release 4 linear, eq. 18, does for two frames; here for any number).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError

#: Share of zeros beyond which black is cut off, and mean and variance are not those of the signal.
ZERO_SHARE = 0.005
#: Pixels below which no figure is derived.
LEAST_PIXELS = 64


@dataclass(frozen=True)
class Level:
    """Summary of the frames of one condition; variances are squared grey values."""

    frames: int
    pixels: int
    mean: float
    """Grey value, mean over pixels and frames."""
    temporal_variance: float
    """Of a pixel from frame to frame, without the variation of the frames' means; NaN for a single frame."""
    spatial_variance: float
    """Of the mean image, with the rest of the temporal noise in it."""
    frame_mean_sigma: float
    """Standard deviation of the frames' means; NaN for a single frame."""
    saturated_share: float
    """Share of samples at or above saturation."""
    zero_share: float
    """Share of samples at zero, where black may be cut off; 0 where samples are negative too."""
    largest: float
    smallest: float

    @property
    def is_cut_off(self) -> bool:
        """Whether black is cut off: more zeros than noise about a positive bias would give."""
        return self.zero_share > ZERO_SHARE

    @property
    def mean_sigma(self) -> float:
        """Standard deviation of `mean`: by the noise of pixels, or of whole frames where that is clearly larger."""
        if self.frames < 2:
            return float("nan")
        of_pixels = self.temporal_variance / self.pixels
        of_frames = self.frame_mean_sigma**2
        # About the 1 % point of the scatter that pixels alone would give to the means of so few frames.
        usual = of_pixels * (1 + 4 * np.sqrt(2 / (self.frames - 1)))
        return float(np.sqrt((of_frames if of_frames > usual else of_pixels) / self.frames))

    def sigma_of_mean(self, step: float) -> float:
        """The same; of a single frame, which says nothing of its noise, by rounding and the scatter between pixels."""
        if np.isfinite(self.mean_sigma):
            return self.mean_sigma
        return float(np.sqrt(max(self.spatial_variance, step**2 / 12) / self.pixels))

    @property
    def degrees(self) -> int:
        """Degrees of freedom of the temporal variance."""
        return (self.frames - 1) * (self.pixels - 1)

    @property
    def variance_sigma(self) -> float:
        """Standard deviation of the temporal variance, for noise that is nearly Gaussian."""
        return float(self.temporal_variance * np.sqrt(2.0 / self.degrees)) if self.degrees else float("nan")


def cut_off(levels: Iterable[Level], of: str = "") -> str:
    """That black is cut off in some levels, as the beginning of a refusal; empty: it is not."""
    share = max((level.zero_share for level in levels if level.is_cut_off), default=0.0)
    return f"black is cut off: {100 * share:.3g} % of the samples{of} are zero" if share else ""


def check_level(level: Level) -> None:
    """Refuse a level that says nothing: too few pixels, or frames that are copies of each other."""
    if level.pixels < LEAST_PIXELS:
        raise InputError(f"{level.pixels} pixels count; {LEAST_PIXELS} or more are needed: give a larger roi or mask")
    if level.frames > 1 and not level.temporal_variance > 0 and level.saturated_share < 0.5 and level.zero_share < 0.5:
        raise InputError(
            f"the {level.frames} frames of mean {level.mean:.4g} DN do not differ in any pixel: they are copies of "
            "one file, or their noise was removed; give raw frames"
        )


@dataclass(frozen=True, eq=False)
class FrameStack:
    """Images of the frames of one condition."""

    level: Level
    mean: NDArray[np.float64]
    """Mean image, shape (h, w)."""
    variance: NDArray[np.float64] | None
    """Temporal variance of every pixel; None for a single frame."""
    counted: NDArray[np.bool_] | None
    """Pixels that the summary counts; None: all."""

    def only_counted(self, image: NDArray[np.float64]) -> NDArray[np.float64]:
        """Mean image or variance with NaN where pixels do not count."""
        return image if self.counted is None else np.where(self.counted, image, np.nan)


class StackSums:
    """Gathers frames one after the other: memory holds two images, however many frames there are."""

    def __init__(self, saturation: float, counted: NDArray[np.bool_] | None = None) -> None:
        self._saturation, self._counted = saturation, counted
        self._means: list[float] = []
        self._saturated = self._zero = 0
        self._largest, self._smallest = -np.inf, np.inf
        self._mean: NDArray[np.float64] | None = None
        self._squares: NDArray[np.float64] | None = None

    def add(self, frame: NDArray[Any]) -> None:
        """One more frame, shape (h, w)."""
        seen = frame if self._counted is None else frame[self._counted]
        if not seen.size:
            raise InputError("no pixel of the frame counts")
        values = frame.astype(np.float64)
        self._saturated += int(np.count_nonzero(seen >= self._saturation))
        self._zero += int(np.count_nonzero(seen == 0))
        self._largest = max(self._largest, float(seen.max()))
        self._smallest = min(self._smallest, float(seen.min()))
        self._means.append(float(np.mean(seen, dtype=np.float64)))
        if self._mean is None or self._squares is None:
            self._mean, self._squares = values, np.zeros_like(values)
            return
        if values.shape != self._mean.shape:
            raise InputError(f"frame of shape {values.shape}; the others have {self._mean.shape}")
        # Welford 1962: stable, and needs no second pass.
        difference = values - self._mean
        self._mean += difference / len(self._means)
        self._squares += difference * (values - self._mean)

    def stack(self) -> FrameStack:
        """What the frames say."""
        count = len(self._means)
        if self._mean is None or self._squares is None:
            raise InputError("no frame given")
        mean, squares = self._mean, self._squares
        seen = mean.ravel() if self._counted is None else mean[self._counted]
        pixels = seen.size
        temporal = sigma = float("nan")
        if count > 1:
            inner = float(squares.sum() if self._counted is None else squares[self._counted].sum())
            between = float(np.sum((np.array(self._means) - np.mean(self._means)) ** 2))
            if pixels > 1:
                temporal = max(inner - pixels * between, 0.0) / ((count - 1) * (pixels - 1))
            sigma = float(np.sqrt(between / (count - 1)))
        level = Level(
            frames=count,
            pixels=pixels,
            mean=float(seen.mean()),
            temporal_variance=temporal,
            spatial_variance=float(seen.var(ddof=1)) if pixels > 1 else float("nan"),
            frame_mean_sigma=sigma,
            saturated_share=self._saturated / (count * pixels),
            zero_share=0.0 if self._smallest < 0 else self._zero / (count * pixels),
            largest=self._largest,
            smallest=self._smallest,
        )
        variance = squares / (count - 1) if count > 1 else None
        return FrameStack(level, mean, variance, self._counted)
