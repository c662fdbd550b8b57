"""Plots of the report of a terrain model, as PNG in memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.report.drawing import BLUE, INK, PURPLE, RED, SKY, SOFT, axes_of, figure_of, mpl, png, styled
from photoplan.report.dtm.covariance import CovarianceTest
from photoplan.report.dtm.samples import FilterEffect, PlottedError, ReportMap

#: What lines of each kind are called.
LINE_WORDS = {"breakline": "breaklines", "formline": "form lines", "border": "border lines", "hole": "holes"}

LINE_COLOURS = {"breakline": "#7a1f00", "formline": PURPLE, "border": INK, "hole": INK}
_WIDTH = 7.2
#: Numbers in the map of gross errors.
_NUMBERED = 30
#: Points in a map at most.
_DOTS = 60_000


@styled
def draw_heights(area: ReportMap) -> bytes:
    """Heights as shaded tints, with lines."""
    fig, axes = _map(area)
    low, high = _limits(area.heights, 0.5)
    norm = mpl.colors.Normalize(low, high)
    tints = _lighter("cividis")
    rgb = tints(norm(np.nan_to_num(area.heights, nan=low)))[..., :3] * _shade(area)[..., None]
    rgb[~np.isfinite(area.heights)] = 1.0
    axes.imshow(np.clip(rgb, 0, 1), extent=area.extent, interpolation="nearest")
    _lines(axes, area)
    _bar(fig, axes, tints, norm, "height m")
    return png(fig)


@styled
def draw_sigmas(area: ReportMap) -> bytes:
    """Standard deviations."""
    fig, axes = _map(area)
    low, high = _limits(area.sigmas, 1.0)
    norm = mpl.colors.Normalize(max(0.0, low), high)
    tints = mpl.colormaps["viridis_r"]
    axes.imshow(area.sigmas, extent=area.extent, cmap=tints, norm=norm, interpolation="nearest")
    _bar(fig, axes, tints, norm, "standard deviation m", extend="both")
    return png(fig)


@styled
def draw_covariance(facts: CovarianceTest) -> bytes:
    """Fitted functions, and the test by the covariance of residuals."""
    fig = figure_of(_WIDTH, 3.1)
    fitted, test = fig.subplots(1, 2)
    square = 1e4
    fitted.fill_between(
        facts.distance, facts.low * square, facts.high * square, color=SKY, alpha=0.4, linewidth=0, label="units"
    )
    fitted.plot(facts.distance, facts.whole * square, color=BLUE, linewidth=1.8, label="whole area")
    fitted.set(title="fitted functions", xlabel="distance m", ylabel="covariance cm²")
    fitted.set(xlim=(0, facts.distance[-1]), ylim=(0, None))
    fitted.legend(loc="upper right")
    known = facts.pairs > 0
    size = 12 + 40 * facts.pairs[known] / max(1, facts.pairs.max())
    test.axhline(0, color=SOFT, linewidth=0.8)
    test.plot(facts.classes[known], facts.expected[known] * square, color=BLUE, linewidth=1.8, label="expected")
    test.scatter(facts.classes[known], facts.empirical[known] * square, s=size, color=RED, zorder=3, label="measured")
    test.set(title="heights above local planes", xlabel="distance m", xlim=(0, None))
    test.legend(loc="upper right")
    return png(fig)


@styled
def draw_filter_histograms(effects: Sequence[FilterEffect]) -> bytes:
    """A histogram for each class, all in one scale."""
    columns = min(3, len(effects))
    rows = -(-len(effects) // columns)
    fig = figure_of(_WIDTH, 0.4 + 2.0 * rows)
    panels = fig.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    reach = 100 * _reach(effects)
    for panel, effect in zip(panels, effects):
        d = 100 * effect.differences[np.isfinite(effect.differences)]
        bins = np.linspace(-reach, reach, 51)
        weights = np.full(len(d), 100 / len(d))
        panel.hist(np.clip(d, -reach, reach), bins=bins, weights=weights, color=BLUE)
        panel.axvline(0, color=INK, linewidth=0.8)
        panel.set_title(effect.name)
        panel.set(xlabel="measured − filtered cm", xlim=(-reach, reach))
    for panel in panels[::columns]:
        panel.set_ylabel("share %")
    for panel in panels[len(effects) :]:
        panel.set_visible(False)
    return png(fig)


@styled
def draw_filter_map(effects: Sequence[FilterEffect], area: ReportMap) -> bytes:
    """Where heights were changed, and which way."""
    fig, axes = _map(area)
    _grey_relief(axes, area)
    xy = np.concatenate([effect.xy for effect in effects])
    d = 100 * np.concatenate([effect.differences for effect in effects])
    step = max(1, -(-len(d) // _DOTS))
    known = np.flatnonzero(np.isfinite(d))[::step]
    reach = 100 * _reach(effects)
    norm = mpl.colors.Normalize(-reach, reach)
    tints = mpl.colormaps["RdBu"]
    size = float(np.clip(3e4 / max(1, len(known)), 0.6, 14))
    axes.scatter(*xy[known].T, c=d[known], cmap=tints, norm=norm, s=size, linewidths=0, rasterized=True, zorder=3)
    _bar(fig, axes, tints, norm, "measured − filtered cm", extend="both")
    return png(fig)


@styled
def draw_gross(errors: Sequence[PlottedError], suspects: Sequence[PlottedError], area: ReportMap) -> bytes:
    """Gross errors on the relief; those above the model point up, those below it down; suspects are circles."""
    fig, axes = _map(area)
    _grey_relief(axes, area)
    xy = np.array([(error.X, error.Y) for error in errors]).reshape(-1, 2)
    up = np.array([error.normalised > 0 for error in errors], bool)
    for some, marker, colour, name in ((up, "^", RED, "too high"), (~up, "v", BLUE, "too low")):
        if some.any():
            axes.scatter(*xy[some].T, marker=marker, s=28, color=colour, edgecolor="white", linewidth=0.5, label=name)
    if suspects:
        places = np.array([(error.X, error.Y) for error in suspects])
        axes.scatter(*places.T, s=30, facecolor="none", edgecolor=PURPLE, linewidth=1.1, label="suspects")
    for k, (x, y) in enumerate(xy[:_NUMBERED], 1):
        axes.annotate(str(k), (x, y), (4, 3), textcoords="offset points", fontsize=7.5, color=INK, zorder=5)
    fig.legend(loc="outside lower center", ncols=3)
    return png(fig)


def _map(area: ReportMap) -> tuple[Any, Any]:
    """A figure with one panel of the map's proportions and map coordinates along it."""
    left, right, bottom, top = area.extent
    ratio = (top - bottom) / (right - left)
    height = float(np.clip(5.9 * ratio, 2.2, 8.2)) + 0.7
    fig, axes = axes_of(_WIDTH, height)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="X m", ylabel="Y m")
    axes.grid(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(5, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(mpl.ticker.FuncFormatter(lambda v, _: f"{v:.12g}"))
    return fig, axes


def _bar(fig: Any, axes: Any, tints: Any, norm: Any, label: str, extend: str = "neither") -> None:
    colours = mpl.cm.ScalarMappable(norm, tints)
    bar = fig.colorbar(colours, ax=axes, shrink=0.8, aspect=28, pad=0.02, extend=extend)
    bar.set_label(label)
    bar.outline.set_visible(False)


def _lines(axes: Any, area: ReportMap) -> None:
    for kind in sorted({kind for kind, _ in area.lines}):
        some = [xy for k, xy in area.lines if k == kind]
        dashes = {"formline": "--", "hole": ":"}.get(kind, "-")
        axes.add_collection(
            mpl.collections.LineCollection(
                some,
                colors=LINE_COLOURS.get(kind, INK),
                linewidths=0.5,
                linestyles=dashes,
                label=LINE_WORDS.get(kind, kind),
            )
        )
    if area.lines:
        axes.figure.legend(loc="outside lower center", ncols=4)


def _limits(values: NDArray[np.float32], percent: float) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not known.size:
        return 0.0, 1.0
    low, high = np.percentile(known, [percent, 100 - percent])
    return float(low), float(max(high, low + 1e-6 * max(1.0, abs(low)) + 1e-4))


def _reach(effects: Sequence[FilterEffect]) -> float:
    """Difference that nearly all stay below, metres."""
    every = np.abs(np.concatenate([effect.differences for effect in effects]))
    return max(float(np.nanpercentile(every, 99.5)), 1e-4)


def _shade(area: ReportMap) -> NDArray[np.float64]:
    """Brightness of the surface lit from the north-west at 45°, relative to level ground; 1 where it is unknown."""
    z = area.heights.astype(float)
    if min(z.shape) < 2:
        return np.ones(z.shape)
    low, high = _limits(area.heights, 0.5)
    # Flat land is exaggerated so that its forms show.
    size = np.hypot(*z.shape) * area.resolution
    factor = float(np.clip(0.05 * size / (high - low), 1.0, 8.0))
    south, east = np.gradient(z * factor, area.resolution)
    light = (1.0 + (east + south) * np.sqrt(0.5)) / np.sqrt(1.0 + east**2 + south**2)
    return np.nan_to_num(np.clip(0.35 + 0.65 * light, 0.25, 1.25), nan=1.0)


def _grey_relief(axes: Any, area: ReportMap) -> None:
    grey = np.clip(0.86 * _shade(area), 0, 1)
    grey[~np.isfinite(area.heights)] = 1.0
    axes.imshow(grey, extent=area.extent, cmap="gray", vmin=0, vmax=1, interpolation="nearest")


def _lighter(name: str) -> Any:
    """A colour map mixed with white, as a ground for shading and lines."""
    colours = mpl.colormaps[name](np.linspace(0, 1, 256))
    colours[:, :3] = 0.62 * colours[:, :3] + 0.38
    return mpl.colors.ListedColormap(colours)
