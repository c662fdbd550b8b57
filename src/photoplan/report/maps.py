"""Products as pictures on the map: accuracy with error ellipses, regions of mosaics, objects as squares, surfaces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from photoplan.io.quicklook import read_reduced
from photoplan.io.store import write_atomically
from photoplan.products.seams import SeamsReport
from photoplan.products.surface.plan import MISFIT
from photoplan.products.surface.run import SurfaceResult
from photoplan.report.drawing import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    STYLE,
    axes_of,
    figure_of,
    load_matplotlib,
    mpl,
    png,
    round_down,
    shortened,
)
from photoplan.requests.surface import SurfaceRequest

#: Longest side of what is drawn, pixels; ellipses along it; length of the largest of them, part of their distance.
_SIDE, _ELLIPSES, _LARGEST = 900, 16, 0.8
#: Longest side where four pictures stand together, pixels.
_SIDE_OF_FOUR = 800
#: Images of smaller regions get no name in the picture, part of the whole.
_NAMED = 0.005


def _on_map(
    ax: Any, title: str, xlabel: str = "X [m]", ylabel: str | None = "Y [m]", **limits: tuple[float, float]
) -> None:
    """Coordinates of the map along the axes, and a title."""
    ax.set(aspect="equal", title=title, xlabel=xlabel, ylabel=ylabel, **limits)
    ax.ticklabel_format(useOffset=False, style="plain")
    ax.tick_params(axis="x", labelrotation=30)


def draw_accuracy(raster: Path) -> Path:
    """Draw an accuracy raster as a PNG beside it; replaces an older one."""
    load_matplotlib("a picture of the accuracy", "leave `accuracy` out")
    bands, (left, bottom, right, top) = read_reduced(raster, max_side=_SIDE)
    radial = np.hypot(bands[0], bands[1])
    known = radial[np.isfinite(radial)]
    low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 1.0)
    with mpl.rc_context(STYLE):
        fig, ax = axes_of(8.0, float(np.clip(7.0 * (top - bottom) / (right - left), 3.0, 12.0)))
        ax.grid(visible=False)
        shown = ax.imshow(radial, cmap="cividis", vmin=low, vmax=max(high, low + 1e-9),
                          extent=(left, right, bottom, top), interpolation="nearest")  # fmt: skip
        step = max(right - left, top - bottom) / _ELLIPSES
        longest = float(np.percentile(bands[3][np.isfinite(bands[3])], 98)) if known.size else 1.0
        scale = round_down(_LARGEST * step / 2 / max(longest, 1e-9))
        for y in np.arange(bottom + step / 2, top, step):
            for x in np.arange(left + step / 2, right, step):
                row = int((top - y) / (top - bottom) * radial.shape[0])
                col = int((x - left) / (right - left) * radial.shape[1])
                a, b, azimuth = bands[3:, row, col]
                for colour, width in ((INK, 2.2), ("white", 0.9)) if np.isfinite(a) else ():
                    ax.add_patch(mpl.patches.Ellipse((x, y), 2 * a * scale, 2 * b * scale, angle=90 - azimuth,
                                                     fill=False, edgecolor=colour, linewidth=width))  # fmt: skip
        fig.colorbar(shown, ax=ax, shrink=0.8, extend="both", label="standard deviation of position, m")
        _on_map(ax, f"{raster.name}: error ellipses {scale:.3g} times as large")
        ax.title.set_color(INK)
        picture = raster.with_suffix(".png")
        write_atomically(picture, png(fig))
    return picture


def seams_picture(found: SeamsReport) -> bytes | None:
    """Return the regions of a search for seams as a PNG; None if no images are joined."""
    return regions_picture(found.shapes, "Images of the mosaic") if found.shapes else None


def draw_regions(path: Path, shapes: Mapping[str, Any], title: str) -> Path:
    """Draw the regions of images, the larger ones with their names, as a PNG; replaces an older one."""
    load_matplotlib("a picture of the regions", "leave `sources` out")
    write_atomically(path, regions_picture(shapes, title))
    return path


def regions_picture(shapes: Mapping[str, Any], title: str) -> bytes:
    """Return the regions of images, the larger ones with their names, as a PNG."""
    left, bottom, right, top = shapely.total_bounds(list(shapes.values())).tolist()
    fig, ax = axes_of(9.0, float(np.clip(9.0 * (top - bottom) / (right - left), 3.0, 14.0)))
    area = sum(shape.area for shape in shapes.values())
    for (name, shape), colour in zip(shapes.items(), cycle((BLUE, ORANGE, GREEN, RED, SKY, PURPLE))):
        rings = [np.array(ring.coords) for part in shape.geoms for ring in (part.exterior, *part.interiors)]
        outline = mpl.path.Path.make_compound_path(*(mpl.path.Path(ring, closed=True) for ring in rings))
        ax.add_patch(mpl.patches.PathPatch(outline, facecolor=colour, alpha=0.55, edgecolor=INK, linewidth=0.6))
        if shape.area > _NAMED * area:
            at = max(shape.geoms, key=lambda part: part.area).representative_point()
            ax.annotate(shortened(name), (at.x, at.y), ha="center", va="center", fontsize=8, color=INK)
    _on_map(ax, title, xlim=(left, right), ylim=(bottom, top))
    return png(fig)


def draw_squares(path: Path, bounds: NDArray[np.float64], title: str) -> Path:
    """Draw squares by their outer edges xmin, ymin, xmax, ymax, shape (n, 4), as a PNG; replaces an older one."""
    load_matplotlib("a picture of the squares", "leave `show_quadtree` out")
    (left, bottom), (right, top) = bounds[:, :2].min(axis=0).tolist(), bounds[:, 2:].max(axis=0).tolist()
    fig, ax = axes_of(9.0, float(np.clip(9.0 * (top - bottom) / (right - left), 2.0, 14.0)))
    x0, y0, x1, y1 = bounds.T
    corners = np.stack([np.stack([x0, x1, x1, x0], axis=1), np.stack([y0, y0, y1, y1], axis=1)], axis=-1)
    ax.add_collection(
        mpl.collections.PolyCollection(corners, facecolor=BLUE, alpha=0.35, edgecolor=INK, linewidth=0.15)
    )
    _on_map(ax, title, xlim=(left, right), ylim=(bottom, top))
    write_atomically(path, png(fig))
    return path


def surface_drawn(result: Any, request: SurfaceRequest, can_draw: Callable[[bool], bool]) -> Iterator[str]:
    """Draw a surface as a PNG beside it if that is wanted, and say so; replaces an older one."""
    if isinstance(result, SurfaceResult) and can_draw(request.quicklook):
        picture = result.path.with_suffix(".png")
        write_atomically(picture, draw_surface(result.path, result.plan.axes))
        yield f"  drawn in {picture}"


def draw_surface(heights: Path, coordinates: tuple[str, str] = ("X", "Y")) -> bytes:
    """Return heights, grey values, standard deviations and residuals of a surface as one PNG."""
    load_matplotlib("a picture of the surface", "say `no_quicklook`")
    (z,), (left, bottom, right, top) = read_reduced(heights, max_side=_SIDE_OF_FOUR)
    grey, sigma, fit = (
        read_reduced(heights.with_name(f"{heights.stem}_{kind}.tif"), max_side=_SIDE_OF_FOUR)[0][0]
        for kind in ("grey", "sigma", "fit")
    )
    extent = left, right, bottom, top
    with mpl.rc_context(STYLE):
        fig = figure_of(12.0, float(np.clip(8.6 * (top - bottom) / (right - left) + 1.5, 5.0, 18.0)))
        # Maps keep their shape: laid out otherwise, the names of the axes leave the picture.
        fig.set_layout_engine("compressed")
        axes = fig.subplots(2, 2, sharex=True, sharey=True).ravel()
        # A few heights that went wrong would take all colours from the rest.
        low, high = _most(z, 0.5)
        z_shown = axes[0].imshow(z, cmap="terrain", vmin=low, vmax=high, extent=extent, interpolation="nearest")
        step = (right - left) / z.shape[1]
        dy, dx = np.gradient(z, step) if min(z.shape) > 1 else (np.zeros_like(z), np.zeros_like(z))
        light = (dx - dy) / np.sqrt(2 * (1 + dx**2 + dy**2))
        scale = max(float(np.nanpercentile(np.abs(light), 95)) if np.isfinite(light).any() else 1.0, 1e-6)
        axes[0].imshow(light, cmap="gray", extent=extent, alpha=0.35, vmin=-scale, vmax=scale, interpolation="nearest")
        low, high = _most(grey, 1.0)
        axes[1].imshow(grey, cmap="gray", extent=extent, vmin=low, vmax=high, interpolation="nearest")
        # Standard deviations where texture or fit fail are a hundred times those of the rest.
        low, high = _most(np.where(sigma > 0, sigma, np.nan), 1.0)
        spread = mpl.colors.LogNorm(low, max(high, 1.01 * low))
        sigma_shown = axes[2].imshow(sigma, cmap="cividis", norm=spread, extent=extent, interpolation="nearest")
        fit_shown = axes[3].imshow(
            fit, cmap="viridis", vmin=0.5, vmax=MISFIT + 0.5, extent=extent, interpolation="nearest"
        )
        for ax, shown in zip(axes, (z_shown, None, sigma_shown, fit_shown)):
            if shown is not None:
                bar = fig.colorbar(shown, ax=ax, shrink=0.8, extend="both", label="" if ax is axes[3] else "m")
                if ax is axes[2]:
                    bar.ax.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1, 2, 5)))
                    bar.ax.yaxis.set_major_formatter("{x:g}")
                    bar.ax.yaxis.set_minor_locator(mpl.ticker.NullLocator())
        titles = "heights", "grey values", "standard deviation of the heights", "residuals around them, 1 is expected"
        for ax, title in zip(axes, titles):
            ax.grid(visible=False)
            _on_map(ax, title, f"{coordinates[0]} [m]" if ax in axes[2:] else "", ylabel=None)
        for ax in axes[::2]:
            ax.set_ylabel(f"{coordinates[1]} [m]")
        return png(fig)


def _most(values: NDArray[np.float64], percent: float) -> tuple[float, float]:
    """Return between what values lie but so many percent on either side; 1 and 2 if there are none."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (percent, 100 - percent)) if known.size else (1.0, 2.0)
    return float(low), float(max(high, low + 1e-9))
