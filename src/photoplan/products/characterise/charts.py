"""What an analysis wants to be seen, as values: curves over an axis, images with a scale. A report draws them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

#: Side of a picture, pixels, to which larger ones are reduced.
MOST_PIXELS = 900


@dataclass(frozen=True, eq=False)
class Curve:
    """One series of a chart."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    label: str = ""
    style: Literal["points", "line", "line and points", "dashed", "steps"] = "points"
    sigma: NDArray[np.float64] | None = None
    """Standard deviation of y, drawn as bars."""
    colour: int | None = None
    """Number of a colour; None: the next."""
    vectors: NDArray[np.float64] | None = None
    """From each point, shape (n, 2): drawn enlarged by what the legend says."""


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves over one axis."""

    title: str
    caption: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    log_x: bool = False
    log_y: bool = False
    marks: tuple[tuple[float, str], ...] = ()
    """Vertical lines: where, and what they mean."""


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with a scale, and positions in it."""

    title: str
    caption: str
    values: NDArray[Any]
    """Shape (h, w)."""
    label: str
    """Of the scale."""
    points: tuple[tuple[float, float], ...] = ()
    """(x, y) in pixels of `values`; drawn as circles."""
    limits: tuple[float, float] | None = None
    """Of the scale; None: 0.5 % and 99.5 % of the values."""
    factor: int = 1
    """Side of the block of pixels of which each value is the mean, see `shrunk`; positions count whole pixels."""
    extent: tuple[float, float, float, float] | None = field(default=None)
    """Left, right, bottom, top of the axes where they are no pixels of `values`."""


def shrunk(values: NDArray[Any]) -> tuple[NDArray[np.float64], int]:
    """An image as small as a picture of the report shows it anyway, and the side of the blocks it was averaged over."""
    image = np.asarray(values, np.float64)
    factor = max(1, -(-max(image.shape) // MOST_PIXELS))
    return np.array(block_means(image, factor)), factor


def block_means(values: NDArray[np.float64], factor: int) -> NDArray[np.float64]:
    """Means of blocks, which a picture of the report's size would show anyway."""
    if factor == 1:
        return values
    height, width = values.shape[0] // factor * factor, values.shape[1] // factor * factor
    blocks = values[:height, :width].reshape(height // factor, factor, width // factor, factor)
    return np.asarray(blocks.mean(axis=(1, 3)))
