"""Maps of products: accuracy, source regions, objects; and the report of a surface."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from photoplan.arrays import Floats
from photoplan.io.product import read_reduced
from photoplan.io.store import write_atomically
from photoplan.products.seams import SeamsReport
from photoplan.products.surface.plan import MISFIT, SurfacePlan
from photoplan.products.surface.run import SurfaceResult, outputs
from photoplan.report.page import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    SOFT,
    STYLE,
    axes_of,
    cells,
    figure,
    figure_of,
    headline,
    load_matplotlib,
    mpl,
    number,
    page,
    png,
    round_down,
    section,
    shortened,
    styled,
    table,
    text,
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


def draw_squares(path: Path, bounds: Floats, title: str) -> Path:
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


def _most(values: Floats, percent: float) -> tuple[float, float]:
    """Return between what values lie but so many percent on either side; 1 and 2 if there are none."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, (percent, 100 - percent)) if known.size else (1.0, 2.0)
    return float(low), float(max(high, low + 1e-9))


#: Longest side of what is drawn and counted, pixels; classes of texture; residuals that are drawn at most.
_SURFACE_SIDE, _CLASSES, _PICTURES = 1200, 4, 12


def surface_page(result: SurfaceResult) -> str:
    """Return the HTML document of a finished surface; its files are read again, reduced."""
    plan = result.plan
    paths = outputs(result.path.parent, plan)
    bands = {kind: read_reduced(path, max_side=_SURFACE_SIDE) for kind, path in paths.items() if kind != "residuals"}
    sigma, count, fit = (bands[kind][0][0] for kind in ("sigma", "count", "fit"))
    grey, extent = bands["grey"][0][0], bands["fit"][1]
    texture = _texture(grey, sigma.shape)
    lost = f"{result.misfit_share:.2%} of them fit worse than expected"
    parts = [
        headline([
            (f"{result.valid_share:.1%}", "posts with a height", f"of {plan.grid.width} × {plan.grid.height}; {lost}"),
            (f"{result.sigma:.3g} m", "standard deviation", f"median; {result.sigma_px:.2g} px of parallax")
            if result.sigma is not None
            else ("–", "standard deviation", ""),
            (f"{len(plan.images)}", "images", f"{result.redundancy:.3g} observations beyond those that are needed"),
        ]),
        *(f"<p><b>Mind:</b> {text(note)}.</p>" for note in result.notes),
        section("Standard deviations by class", [
            figure(_draw_classes(sigma, count, texture), "Standard deviations of the heights",
                   "Left by the number of images, right by texture: quarters of the ground by the spread of its grey "
                   "values around a height. Boxes hold the middle half, whiskers 90 %."),
            table(["images", "heights", "median, m", "90 %, m"], [cells(row) for row in _rows(sigma, count)]),
        ]),
        section("How the pixels fit", [
            figure(_draw_fit(fit, extent, plan.axes), "Residuals by place",
                   "Root mean square of the standardised residuals around each height; 1 is expected. Where it is over "
                   f"{MISFIT:g}, the height may be wrong: an edge that is rounded, something that moved, or a region "
                   "that went wrong."),
            *(_residuals(plan, result, paths["residuals"]) if "residuals" in paths else []),
        ]),
        section("Images and levels", [
            figure(_draw_adjustment(result), "Noise of the images, and how the heights settled",
                   "Left sigma0, the standard deviation of a grey value, by image: those that stand out have a wrong "
                   "orientation or show something else. Right the last corrections of the heights by level."),
            table(["image", "sigma0, grey values"], [
                cells([name, "–" if value is None else f"{value:.3g}"], 1) for name, value in result.sigma0.items()
            ]),
        ]),
    ]  # fmt: skip
    over = "" if plan.frame is None else f"u, v and h over {plan.settings.target}; "
    return page(f"Surface {plan.settings.name}", f"{result.path.name}: {over}{', '.join(plan.images)}", parts)


def _texture(grey: Floats, shape: tuple[int, int]) -> Floats:
    """Spread of grey values around each height, brought to the pixels of the heights."""
    rows, columns = ((np.arange(n) * m) // n for n, m in zip(shape, grey.shape))
    dy, dx = (np.abs(np.diff(grey, axis=axis, append=np.nan)) for axis in (0, 1))
    rough = np.hypot(dx, dy)
    padded = np.pad(rough, 1, constant_values=np.nan)
    around = [padded[j : j + rough.shape[0], i : i + rough.shape[1]] for j in range(3) for i in range(3)]
    total, known = np.nansum(around, axis=0), np.isfinite(around).sum(axis=0)
    return np.asarray((total / np.maximum(known, 1))[np.ix_(rows, columns)])


def _rows(sigma: Floats, count: Floats) -> list[list[str]]:
    """Figures of the heights by the number of images."""
    found = []
    for n in range(2, int(np.nanmax(count, initial=1)) + 1):
        own = sigma[(count == n) & np.isfinite(sigma)]
        if own.size:
            found.append([str(n), str(own.size), *(number(float(np.percentile(own, p)), 4) for p in (50, 90))])
    return found


@styled
def _draw_classes(sigma: Floats, count: Floats, texture: Floats) -> bytes:
    known = np.isfinite(sigma)
    fig = figure_of(8.4, 3.2)
    left, right = fig.subplots(1, 2, sharey=True)
    by_count = {str(n): sigma[known & (count == n)] for n in range(2, int(np.nanmax(count, initial=1)) + 1)}
    names = ("least", "less", "more", "most")
    edges = np.quantile(texture[known], np.linspace(0, 1, _CLASSES + 1)) if known.any() else np.zeros(_CLASSES + 1)
    klass = np.clip(np.searchsorted(edges, texture, side="right") - 1, 0, _CLASSES - 1)
    by_texture = {names[k]: sigma[known & (klass == k)] for k in range(_CLASSES)}
    for ax, groups, label in ((left, by_count, "images"), (right, by_texture, "texture")):
        kept = {name: values for name, values in groups.items() if values.size}
        if kept:
            ax.boxplot(list(kept.values()), whis=(5, 95), showfliers=False, medianprops={"color": ORANGE},
                       boxprops={"color": BLUE}, whiskerprops={"color": SOFT}, capprops={"color": SOFT})  # fmt: skip
            ax.set_xticks(range(1, len(kept) + 1), [f"{name}\n{values.size}" for name, values in kept.items()])
            _plain_log(ax)
        ax.set_xlabel(f"{label}, and heights")
    left.set_ylabel("standard deviation, m")
    return png(fig)


@styled
def _draw_fit(fit: Floats, extent: tuple[float, float, float, float], coordinates: tuple[str, str]) -> bytes:
    left, bottom, right, top = extent
    fig = figure_of(8.4, float(np.clip(7.0 * (top - bottom) / (right - left), 2.6, 9.0)))
    ax = fig.subplots()
    shown = ax.imshow(fit, cmap="viridis", vmin=0.5, vmax=MISFIT + 0.5, extent=(left, right, bottom, top),
                      interpolation="nearest")  # fmt: skip
    fig.colorbar(shown, ax=ax, shrink=0.8, extend="both", label="residuals, standard deviations")
    ax.grid(visible=False)
    ax.set(aspect="equal", xlabel=f"{coordinates[0]}, m", ylabel=f"{coordinates[1]}, m")
    ax.ticklabel_format(useOffset=False, style="plain")
    # The layout leaves too little room for long coordinates where the figure is low.
    return png(fig, bbox_inches="tight")


def _residuals(plan: SurfacePlan, result: SurfaceResult, path: Path) -> list[str]:
    """The pictures of residuals, if there are any: of images that see something, of many those of largest sigma0."""
    bands, (left, bottom, right, top) = read_reduced(path, max_side=_SURFACE_SIDE // 3)
    seen = {name: band for name, band in zip(plan.images, bands) if np.isfinite(band).any()}
    worst = sorted(seen, key=lambda name: -(result.sigma0[name] or 0.0))[:_PICTURES]
    drawn = {name: band for name, band in seen.items() if name in worst}
    more = len(seen) - len(drawn)
    rest = f" Those of {more} more images, of smaller sigma0, are in the file." if more else ""
    caption = "The surface's grey value less the image's, in standard deviations." + rest
    shape = (top - bottom) / (right - left)
    return [figure(_draw_residuals(drawn, shape), "Residuals of the images", caption)] if drawn else []


@styled
def _draw_residuals(drawn: Mapping[str, Floats], shape: float) -> bytes:
    """Residuals by image; `shape` is their height through their width."""
    columns = min(3, len(drawn))
    rows = -(-len(drawn) // columns)
    tall = float(np.clip(8.4 / columns * shape, 1.2, 5.0))
    fig = figure_of(9.0, rows * (tall + 0.3))
    axes = fig.subplots(rows, columns, squeeze=False).reshape(-1)
    for ax, (name, band) in zip(axes, drawn.items()):
        picture = ax.imshow(band, cmap="RdBu_r", vmin=-3, vmax=3, interpolation="nearest")
        ax.set_title(name if len(name) < 28 else "…" + name[-26:], fontsize=8)
    for ax in axes:
        ax.grid(visible=False)
        ax.set(xticks=[], yticks=[])
    for ax in axes[len(drawn) :]:
        ax.set_visible(False)
    fig.colorbar(picture, ax=list(axes), shrink=0.7, extend="both", label="standard deviations")
    return png(fig)


@styled
def _draw_adjustment(result: SurfaceResult) -> bytes:
    known = {name: value for name, value in result.sigma0.items() if value is not None}
    fig = figure_of(8.4, max(2.8, 0.7 + 0.18 * len(known)))
    left, right = fig.subplots(1, 2)
    names = [name if len(name) < 20 else "…" + name[-18:] for name in known]
    left.barh(range(len(known)), list(known.values()), color=BLUE, height=0.7)
    left.set_yticks(range(len(known)), names, fontsize=7)
    left.invert_yaxis()
    left.axvline(float(np.median(list(known.values()))) if known else 0.0, color=INK, linewidth=0.8)
    left.set_xlabel("sigma0, grey values")
    levels = np.arange(len(result.corrections))[::-1]
    right.plot(levels, [max(c, 1e-4) for c in result.corrections[::-1]], "o-", color=BLUE)
    _plain_log(right)
    right.invert_xaxis()
    right.set_xticks(levels)
    right.set(xlabel="level, coarse to fine", ylabel="last correction, px of parallax")
    return png(fig)


def _plain_log(axes: Any) -> None:
    """A logarithmic axis whose labels are plain numbers."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter("{x:g}")
    # A label for each of 2 to 9 would lie on its neighbours.
    axes.yaxis.set_minor_locator(mpl.ticker.LogLocator(subs=(2, 5)))
    axes.yaxis.set_minor_formatter("{x:.2g}")
