"""Georeferenced files as pictures for matching."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

from tools.matching import Picture


def gray(file: Path, window: Window | None = None) -> Picture:
    """Mean of the bands, or of their part in `window`; NaN outside the image, where all bands are black included."""
    with rasterio.open(file) as data:
        bands = data.read(window=window).astype(float)
        valid = (bands != 0).any(axis=0) & (data.dataset_mask(window=window) > 0)
        to_ground = data.transform if window is None else data.window_transform(window)
        values = np.where(valid, bands.mean(axis=0), np.nan)
        return Picture(values[None], to_ground.c, to_ground.f, to_ground.a)
