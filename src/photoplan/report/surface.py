"""A surface from images as a picture: shaded heights, grey values, standard deviations."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from photoplan.io.naming import write_atomically
from photoplan.io.quicklook import read_reduced
from photoplan.report.drawing import STYLE, figure_of, load_matplotlib, png

#: Longest side of what is drawn, pixels.
_SIDE = 700


def draw_surface(heights: Path, picture: Path) -> Path:
    """Draw the files of a surface as one PNG; replaces an older one.

    Parameters
    ----------
    heights : Path
        NAME.tif; NAME_sigma.tif and NAME_grey.tif stand beside it.

    Raises
    ------
    UsageError
        matplotlib is not installed, or the folder cannot be written.
    InputError
        A raster cannot be read.
    """
    mpl = load_matplotlib("a picture of the surface", "say `no_quicklook`")
    (z,), (left, bottom, right, top) = read_reduced(heights, max_side=_SIDE)
    (sigma,), _ = read_reduced(heights.with_name(f"{heights.stem}_sigma.tif"), max_side=_SIDE)
    (grey,), _ = read_reduced(heights.with_name(f"{heights.stem}_grey.tif"), max_side=_SIDE)
    extent = left, right, bottom, top
    with mpl.rc_context(STYLE):
        size = 13.0, float(np.clip(4.0 * (top - bottom) / (right - left) + 1.0, 2.8, 9.0))
        fig = figure_of(*size)
        axes = fig.subplots(1, 3, sharex=True, sharey=True)
        shown = axes[0].imshow(z, cmap="terrain", extent=extent, interpolation="nearest")
        fig.colorbar(shown, ax=axes[0], shrink=0.8, label="m")
        step = (right - left) / z.shape[1]
        dy, dx = np.gradient(z, step) if min(z.shape) > 1 else (np.zeros_like(z), np.zeros_like(z))
        light = (dx - dy) / np.sqrt(2 * (1 + dx**2 + dy**2))
        scale = max(float(np.nanpercentile(np.abs(light), 95)) if np.isfinite(light).any() else 1.0, 1e-6)
        axes[0].imshow(light, cmap="gray", extent=extent, alpha=0.35, vmin=-scale, vmax=scale, interpolation="nearest")
        low, high = np.nanpercentile(grey, (1, 99)) if np.isfinite(grey).any() else (0.0, 1.0)
        axes[1].imshow(grey, cmap="gray", extent=extent, vmin=low, vmax=high, interpolation="nearest")
        low, high = np.nanpercentile(sigma, (1, 99)) if np.isfinite(sigma).any() else (0.0, 1.0)
        shown = axes[2].imshow(
            sigma, cmap="cividis", extent=extent, vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest"
        )
        fig.colorbar(shown, ax=axes[2], shrink=0.8, extend="both", label="m")
        for ax, title in zip(axes, ("heights", "grey values", "standard deviation of the heights")):
            ax.grid(visible=False)
            ax.set(title=title, xlabel="X [m]", aspect="equal")
            ax.ticklabel_format(useOffset=False, style="plain")
            ax.tick_params(axis="x", labelrotation=30)
        axes[0].set_ylabel("Y [m]")
        write_atomically(picture, png(fig))
    return picture
