"""Series of frames of a simulated camera, written as files; the truth is what the caller asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import rasterio
from numpy.typing import NDArray
from scipy import special

__all__ = ["disc_frame", "edge_frame", "edge_lines", "write_frame", "write_series"]

Array = NDArray[np.float64]


def write_frame(path: Path, values: Array, bits: int = 8) -> None:
    """Grey values, rounded and cut to the range, as TIFF."""
    kind = np.uint8 if bits <= 8 else np.uint16
    whole = np.clip(np.rint(values), 0, 2**bits - 1).astype(kind)
    with rasterio.open(
        path, "w", driver="GTiff", width=whole.shape[1], height=whole.shape[0], count=1, dtype=whole.dtype
    ) as dataset:
        dataset.write(whole, 1)


def write_series(folder: Path, name: str, frames: Sequence[Array], columns: dict[str, Sequence[float]]) -> None:
    """Frames `name_0.tif` …, and a table `name.csv` with columns by frame."""
    for k, frame in enumerate(frames):
        write_frame(folder / f"{name}_{k}.tif", frame)
    rows = [f"{name}_{k}.tif," + ",".join(repr(float(c[k])) for c in columns.values()) for k in range(len(frames))]
    (folder / f"{name}.csv").write_text("\n".join([",".join(["file", *columns]), *rows]) + "\n")


def edge_lines(
    position: Array, width: int, blur: float, contrast: float, base: float, noise: Callable[[tuple[int, int]], Array]
) -> Array:
    """A vertical edge that crosses line i at column position[i], integrated over the pixels; shape (n, width)."""
    x = np.arange(width)[None, :] - position[:, None]
    # The integral of Φ(t / s) over a pixel: t Φ + s φ, at its ends.
    ends = [(t * special.ndtr(t / blur) + blur * _bell(t / blur)) for t in (x + 0.5, x - 0.5)]
    return base + contrast * (ends[0] - ends[1]) + noise((len(position), width))


def edge_frame(rng: np.random.Generator, size: tuple[int, int], edges: Sequence[Array], noise: float = 1.0) -> Array:
    """A frame with dark and bright areas in turn, divided by vertical edges at given columns of each row."""
    width, height = size
    out = np.full((height, width), 50.0) + rng.normal(0.0, noise, (height, width))
    for k, position in enumerate(edges):
        sign = 1.0 if k % 2 == 0 else -1.0
        out += edge_lines(position, width, 0.8, sign * 120.0, 0.0, np.zeros)
    return out


def disc_frame(
    rng: np.random.Generator, size: tuple[int, int], discs: Sequence[tuple[float, float, float]], noise: float = 1.0
) -> Array:
    """A dark frame with bright discs (x, y, radius), blurred by about 0.7 pixel."""
    y, x = np.mgrid[: size[1], : size[0]].astype(float)
    out = np.full((size[1], size[0]), 40.0) + rng.normal(0.0, noise, (size[1], size[0]))
    for cx, cy, radius in discs:
        out += 140.0 * special.ndtr((radius - np.hypot(x - cx, y - cy)) / 0.7)
    return out


def _bell(u: Array) -> Array:
    return np.exp(-0.5 * u**2) / math.sqrt(2.0 * math.pi)
