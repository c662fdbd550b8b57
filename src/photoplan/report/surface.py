"""Report of a surface: what it says of its accuracy, by classes of ground, images and levels, with plots."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.io.quicklook import read_reduced
from photoplan.products.surface.plan import MISFIT, SurfacePlan
from photoplan.products.surface.run import SurfaceResult, outputs
from photoplan.report.drawing import BLUE, INK, ORANGE, SOFT, figure_of, mpl, png, styled
from photoplan.report.page import cells, figure, headline, number, page, section, table, text

_Doubles = NDArray[np.float64]

#: Longest side of what is drawn and counted, pixels; classes of texture; residuals that are drawn at most.
_SIDE, _CLASSES, _PICTURES = 1200, 4, 12


def surface_page(result: SurfaceResult) -> str:
    """Return the HTML document of a finished surface; its files are read again, reduced."""
    plan = result.plan
    paths = outputs(result.path.parent, plan)
    bands = {kind: read_reduced(path, max_side=_SIDE) for kind, path in paths.items() if kind != "residuals"}
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


def _texture(grey: _Doubles, shape: tuple[int, int]) -> _Doubles:
    """Spread of grey values around each height, brought to the pixels of the heights."""
    rows, columns = ((np.arange(n) * m) // n for n, m in zip(shape, grey.shape))
    dy, dx = (np.abs(np.diff(grey, axis=axis, append=np.nan)) for axis in (0, 1))
    rough = np.hypot(dx, dy)
    padded = np.pad(rough, 1, constant_values=np.nan)
    around = [padded[j : j + rough.shape[0], i : i + rough.shape[1]] for j in range(3) for i in range(3)]
    total, known = np.nansum(around, axis=0), np.isfinite(around).sum(axis=0)
    return np.asarray((total / np.maximum(known, 1))[np.ix_(rows, columns)])


def _rows(sigma: _Doubles, count: _Doubles) -> list[list[str]]:
    """Figures of the heights by the number of images."""
    found = []
    for n in range(2, int(np.nanmax(count, initial=1)) + 1):
        own = sigma[(count == n) & np.isfinite(sigma)]
        if own.size:
            found.append([str(n), str(own.size), *(number(float(np.percentile(own, p)), 4) for p in (50, 90))])
    return found


@styled
def _draw_classes(sigma: _Doubles, count: _Doubles, texture: _Doubles) -> bytes:
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
def _draw_fit(fit: _Doubles, extent: tuple[float, float, float, float], coordinates: tuple[str, str]) -> bytes:
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
    bands, (left, bottom, right, top) = read_reduced(path, max_side=_SIDE // 3)
    seen = {name: band for name, band in zip(plan.images, bands) if np.isfinite(band).any()}
    worst = sorted(seen, key=lambda name: -(result.sigma0[name] or 0.0))[:_PICTURES]
    drawn = {name: band for name, band in seen.items() if name in worst}
    more = len(seen) - len(drawn)
    rest = f" Those of {more} more images, of smaller sigma0, are in the file." if more else ""
    caption = "The surface's grey value less the image's, in standard deviations." + rest
    shape = (top - bottom) / (right - left)
    return [figure(_draw_residuals(drawn, shape), "Residuals of the images", caption)] if drawn else []


@styled
def _draw_residuals(drawn: Mapping[str, _Doubles], shape: float) -> bytes:
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
