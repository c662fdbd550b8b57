"""The slow exact twin of the engine: strict projection of every pixel, plain NumPy.

It shares no code with the kernels, so that an error in one shows as a difference from the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.cameras.base import Projection, project
from photoplan.errors import UsageError
from photoplan.geometry.grid import Window
from photoplan.surfaces.base import Surface
from photoplan.targets.map import Target


def strict_positions(
    target: Target, window: Window, camera: Projection, surface: Surface
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Image position of every pixel of a window by the strict projection.

    Returns
    -------
    xy : ndarray, shape (height, width, 2)
        Pixels of the source image; NaN where there is no surface or the point lies behind the camera.
    uvh : ndarray, shape (height, width, 3)
        The target coordinates that were projected.
    """
    v, u = np.mgrid[window.row : window.stop[1], window.col : window.stop[0]].astype(float)
    uvh = np.stack([u, v, surface.relief(target, window).astype(float)], axis=-1)
    return project(camera, target.to_ground(uvh)), uvh


def strict_scales(target: Target, camera: Projection, uvh: NDArray[np.float64]) -> NDArray[np.float64]:
    """Source pixels per target pixel along x and y at constant h, by central differences; shape (..., 2)."""
    step_u, step_v = np.array([0.5, 0, 0]), np.array([0, 0.5, 0])
    du = project(camera, target.to_ground(uvh + step_u)) - project(camera, target.to_ground(uvh - step_u))
    dv = project(camera, target.to_ground(uvh + step_v)) - project(camera, target.to_ground(uvh - step_v))
    return np.hypot(du, dv)


def twin_resample(
    image: NDArray[Any],
    valid: NDArray[np.bool_] | None,
    xy: NDArray[np.float64],
    kernel: str,
    scales: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Resample a whole image at given positions, pixel by pixel.

    Parameters
    ----------
    image : ndarray, shape (bands, rows, cols)
    valid : ndarray of bool, shape (rows, cols), or None
        Which source pixels may be used; None: all.
    xy : ndarray, shape (height, width, 2)
        Positions in the image; NaN: none.
    kernel : str
        ``nearest``, ``bilinear``, ``bicubic`` (a = −0.5), ``bicubic-1`` (a = −1; Ecker 1991, eq. 4.15), ``lanczos3``.
    scales : ndarray, shape (height, width, 2), or None
        Source pixels per target pixel along x and y; above 1.1 the kernel is stretched. None: never.

    Returns
    -------
    values : ndarray, shape (bands, height, width), float64
        Not rounded and not clipped; 0 where invalid.
    good : ndarray of bool, shape (height, width)
        A pixel is good if its position is inside the image and the valid taps carry at least half of the weight.
    """
    bands, rows, cols = image.shape
    usable = np.ones((rows, cols), bool) if valid is None else valid
    weight, radius = _KERNELS.get(kernel, (None, 0.0))
    if weight is None:
        raise UsageError(f"kernel {kernel!r}; allowed are {', '.join(_KERNELS)}")
    values = np.zeros((bands, *xy.shape[:2]))
    good = np.zeros(xy.shape[:2], bool)
    for r, c in np.ndindex(*xy.shape[:2]):
        x, y = xy[r, c]
        if not (-0.5 <= x <= cols - 0.5 and -0.5 <= y <= rows - 0.5):
            continue
        if kernel == "nearest":
            i, j = min(int(np.floor(x + 0.5)), cols - 1), min(int(np.floor(y + 0.5)), rows - 1)
            good[r, c] = usable[j, i]
            values[:, r, c] = image[:, j, i] if usable[j, i] else 0
            continue
        sx, sy = (1.0, 1.0) if scales is None else (_stretch(s) for s in scales[r, c])
        col, wx = _taps(x, sx, radius, weight)
        row, wy = _taps(y, sy, radius, weight)
        w = np.outer(wy, wx)
        inside = ((row >= 0) & (row < rows))[:, None] & ((col >= 0) & (col < cols))[None]
        part = np.ix_(np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1))
        w = np.where(inside & usable[part], w, 0.0)
        if w.sum() < 0.5:
            continue
        good[r, c] = True
        pixels = np.where(w != 0, image[:, part[0], part[1]], 0)
        values[:, r, c] = (pixels * w).sum(axis=(1, 2)) / w.sum()
    return values, good


def twin_reduce(
    image: NDArray[Any], valid: NDArray[np.bool_] | None, level: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """An image and its validity as `engine.base.Reader` gives them at a level."""
    bands, rows, cols = image.shape
    f = 2**level
    high, wide = -(-rows // f), -(-cols // f)
    known = np.zeros((bands, high * f, wide * f))
    known[:, :rows, :cols] = image
    inside, weight = np.zeros((2, high * f, wide * f))
    inside[:rows, :cols] = 1.0
    weight[:rows, :cols] = 1.0 if valid is None else valid
    known = np.where(weight > 0, known, 0.0)
    count, total = (a.reshape(high, f, wide, f).sum(axis=(1, 3)) for a in (weight, inside))
    good = 2 * count >= total
    mean = known.reshape(bands, high, f, wide, f).sum(axis=(2, 4)) / np.maximum(count, 1)
    if image.dtype.kind != "f":
        mean = np.floor(mean + 0.5)
    return np.where(good, mean, 0).astype(image.dtype), good


@dataclass(frozen=True, eq=False)
class TwinSource:
    """A whole image in memory with its camera."""

    image: NDArray[Any]
    """(bands, rows, cols)"""
    valid: NDArray[np.bool_] | None
    """(rows, cols); None: everywhere."""
    camera: Projection
    level: int = 0
    """How often it is halved before it is resampled."""


def twin_compose(
    target: Target,
    window: Window,
    surface: Surface,
    sources: Sequence[TwinSource],
    owner: NDArray[np.uint16] | None,
    kernel: str,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """A window of a product of many sources, each resampled as a whole and then cut to its own pixels.

    Parameters
    ----------
    owner : ndarray, shape (height, width), or None
        Number of the source, from one, that paints each pixel; 0: none. None: the first one.

    Returns
    -------
    values, good
        As `twin_resample`.
    """
    values = np.zeros((len(sources[0].image), window.height, window.width))
    good = np.zeros((window.height, window.width), bool)
    for number, source in enumerate(sources, 1):
        xy, uvh = strict_positions(target, window, source.camera, surface)
        size, f = np.array(source.camera.size), 2.0**source.level
        with np.errstate(invalid="ignore"):
            inside = np.all((xy >= -0.5) & (xy <= size - 0.5), axis=-1)
        mine = inside if owner is None else inside & (owner == number)
        scales = strict_scales(target, source.camera, uvh) / f
        image, valid = twin_reduce(source.image, source.valid, source.level)
        xy = np.where(mine[..., None], (xy + 0.5) / f - 0.5, np.nan)
        theirs, there = twin_resample(image, valid, xy, kernel, scales)
        values[:, there] = theirs[:, there]
        good |= there
    return values, good


def _stretch(scale: float) -> float:
    if scale <= 1.1:
        return 1.0
    return scale if scale >= 1.3 else 1.0 + (scale - 1.1) / 0.2 * 0.3


def _taps(
    position: float, stretch: float, radius: float, weight: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Indices and normalised weights of all samples within the stretched kernel."""
    reach = radius * stretch
    index = np.arange(int(np.ceil(position - reach)), int(np.floor(position + reach)) + 1)
    w = weight(np.abs(index - position) / stretch)
    return index, w / w.sum()


def _triangle(t: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.maximum(0.0, 1.0 - t)


def _cubic(a: float) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    def weight(t: NDArray[np.float64]) -> NDArray[np.float64]:
        near = (a + 2) * t**3 - (a + 3) * t**2 + 1
        far = a * (t**3 - 5 * t**2 + 8 * t - 4)
        return np.where(t < 1, near, np.where(t < 2, far, 0.0))

    return weight


def _lanczos3(t: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(t < 3, np.sinc(t) * np.sinc(t / 3), 0.0)


_KERNELS: dict[str, tuple[Callable[[NDArray[np.float64]], NDArray[np.float64]] | None, float]] = {
    "nearest": (_triangle, 0.5),
    "bilinear": (_triangle, 1.0),
    "bicubic": (_cubic(-0.5), 2.0),
    "bicubic-1": (_cubic(-1.0), 2.0),
    "lanczos3": (_lanczos3, 3.0),
}
