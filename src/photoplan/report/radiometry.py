"""Pictures of radiometry: balanced images (overlaps, tables, maps, trends), and light on slopes before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from photoplan.products.balance import BalanceReport
from photoplan.products.illumination import IlluminationReport
from photoplan.radiometry.balance import Balanced, Pairs
from photoplan.radiometry.equations import SIDE
from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, RED, SOFT, figure_of, png, styled

_BANDS = (RED, GREEN, BLUE, ORANGE)
#: Pairs and images that are shown.
_PAIRS, _TRENDS = 30, 4
#: Points of a trend along the longer side of an image.
_SIDE = 60
#: Points of light on slopes that are drawn, and classes of cos i of which the mean is.
_POINTS, _CLASSES = 4000, 20


@styled
def draw_balance(report: BalanceReport) -> bytes:
    """Overlaps, tables, maps and trends, as PNG."""
    pairs, found = report.pairs, report.balanced
    assert pairs is not None and found is not None
    shown = np.argsort(-pairs.before.mean(axis=1))[:_PAIRS]
    images = _spread(found)
    trends = bool(images) and bool(found.tones[0][0].terms)
    bands = min(len(found.tones[0]), len(_BANDS))
    heights = [1.1 + 0.2 * len(shown), 3.0, 3.6, *([2.6] if trends else [])]
    fig = figure_of(10.0, sum(heights) + 0.6)
    rows = fig.add_gridspec(len(heights), 1, height_ratios=heights)
    _overlaps(fig.add_subplot(rows[0]), report, pairs, shown.tolist())
    cells = rows[1].subgridspec(1, bands)
    for band in range(bands):
        _tables(fig.add_subplot(cells[band]), found, band)
    _maps(fig, rows[2], pairs)
    if trends:
        cells = rows[3].subgridspec(1, len(images))
        for column, k in enumerate(images):
            _trend(fig, fig.add_subplot(cells[column]), report, found, k)
    return png(fig)


def _overlaps(axes: Any, report: BalanceReport, pairs: Pairs, shown: list[int]) -> None:
    """A line from before to after, for each pair and band."""
    bands = min(pairs.before.shape[1], len(_BANDS))
    for band, colour in zip(range(bands), _BANDS):
        y = np.arange(len(shown)) + (band - (bands - 1) / 2) * 0.22
        before, after = pairs.before[shown, band], pairs.after[shown, band]
        axes.hlines(y, after, before, color=colour, linewidth=1.2, alpha=0.5)
        axes.plot(before, y, "o", markersize=3.5, markerfacecolor="white", color=colour)
        axes.plot(after, y, "o", markersize=3.5, color=colour, label=f"band {band + 1}")
    names = [" – ".join(_ending(report.named(int(i))) for i in pairs.images[k]) for k in shown]
    axes.set_yticks(range(len(shown)), names, fontsize=7)
    axes.invert_yaxis()
    axes.set_xlim(left=0)
    axes.set_xlabel("root mean square of differences, grey values")
    more = "" if len(shown) == len(pairs.images) else f", the {len(shown)} worst of {len(pairs.images)}"
    axes.set_title(f"Overlaps before (open) and after (full){more}")
    axes.legend(loc="lower right")


def _tables(axes: Any, found: Balanced, band: int) -> None:
    """The tables of all images, with what stays the same."""
    every = [tone[band] for tone in found.tones]
    ends = [every[0].grey[0], every[0].grey[-1]]
    axes.plot(ends, ends, color=SOFT, linewidth=0.8, linestyle=":")
    for tone, sigmas in zip(every, (each[band] for each in found.sigmas)):
        becomes, grey = np.array(tone.becomes), np.array(tone.grey)
        if any(tone.curve):
            grey = np.interp(grey, tone.curve[1], tone.curve[0])
        if len(every) <= 8 and sigmas:
            axes.fill_between(grey, becomes - sigmas, becomes + sigmas, color=_BANDS[band], alpha=0.12, linewidth=0)
        axes.plot(grey, becomes, color=_BANDS[band], linewidth=1.0, alpha=max(0.15, 1.0 / np.sqrt(len(every))))
    axes.set(xlabel="grey value", xlim=ends, title=f"Tables, band {band + 1}")
    if band == 0:
        axes.set_ylabel("becomes (band: one σ)" if len(every) <= 8 and found.sigmas[0][0] else "becomes")


def _maps(fig: Any, row: Any, pairs: Pairs) -> None:
    """Draw where on the map images differ, before and after, with the same colours."""
    col, line = (np.round(pairs.places.T - pairs.places.min(axis=0)[:, None]) // SIDE).astype(int)
    most = float(np.quantile(pairs.before_there, 0.98))
    cells = row.subgridspec(1, 2)
    for k, (word, values) in enumerate((("before", pairs.before_there), ("after", pairs.after_there))):
        raster = np.full((line.max() + 1, col.max() + 1), np.nan)
        raster[line, col] = values
        axes = fig.add_subplot(cells[k])
        picture = axes.imshow(raster, cmap="viridis", vmin=0, vmax=max(most, 1e-9), interpolation="nearest")
        axes.set(xticks=[], yticks=[], title=f"Differences {word}")
        axes.grid(False)
        fig.colorbar(picture, ax=axes, fraction=0.04, label="grey values")


def _trend(fig: Any, axes: Any, report: BalanceReport, found: Balanced, k: int) -> None:
    """The trend of the first band over an image, beside its mean."""
    number = int(found.images[k])
    width, height = report.survey.sizes[number].tolist()
    x, y = (np.linspace(0, side - 1, max(2, round(_SIDE * side / max(width, height)))) for side in (width, height))
    trend = found.tones[k][0].trend(x[None, :], y[:, None], (width, height))
    picture = axes.imshow(trend, cmap="RdBu_r", vmin=0.6, vmax=1.4, extent=(0, width, height, 0))
    axes.contour(x, y, trend, levels=np.arange(0.2, 3, 0.1), colors=INK, linewidths=0.4)
    axes.set_title(f"Trend: {_ending(report.named(number), 16)}", fontsize=8)
    axes.set(xticks=[], yticks=[])
    axes.grid(False)
    fig.colorbar(picture, ax=axes, fraction=0.05)


def _ending(name: str, most: int = 22) -> str:
    """The end of a name, by which images differ."""
    return name if len(name) <= most else "…" + name[1 - most :]


def _spread(found: Balanced) -> list[int]:
    """Places of some images with tones, spread over all."""
    count = len(found.images)
    return sorted({int(k) for k in np.linspace(0, count - 1, min(_TRENDS, count))}) if count else []


@styled
def draw_light(report: IlluminationReport) -> bytes:
    """Draw grey values over the light on slopes: a row of plots before, a row after, as PNG."""
    bands = min(len(report.before), len(_BANDS))
    lit = np.flatnonzero(report.sample.lit)
    some = lit[np.linspace(0, len(lit) - 1, min(_POINTS, len(lit))).astype(int)]
    fig = figure_of(1.0 + 3.2 * bands, 5.6)
    axes = fig.subplots(2, bands, sharex=True, sharey="col", squeeze=False)
    rows = zip(("before", "after"), (report.before, report.after), report.correlations, axes)
    for word, values, correlations, row in rows:
        for band, at in enumerate(row):
            _cloud(at, report, values[band], some, band)
            at.set_title(f"Band {band + 1} {word}: correlation {correlations[band]:+.3f}")
    for at in axes[1]:
        at.set_xlabel("cos i: 1 faces the sun")
    axes[0, 0].set_ylabel("grey value")
    axes[1, 0].set_ylabel("grey value")
    return png(fig)


def _cloud(axes: Any, report: IlluminationReport, values: Any, some: Any, band: int) -> None:
    """Draw pixels on which the sun shines, the means of classes, and the light on level ground."""
    light = report.sample.cos_i[some]
    axes.plot(light, values[some], ".", markersize=1.5, color=_BANDS[band], alpha=0.35)
    edges = np.linspace(0, 1, _CLASSES + 1)
    of = np.digitize(light, edges) - 1
    each = [(light[of == k].mean(), values[some][of == k].mean()) for k in range(_CLASSES) if (of == k).sum() > 5]
    axes.plot(*np.array(each).T, color=INK, linewidth=1.2)
    axes.axvline(report.model.cos_z, color=SOFT, linewidth=0.8, linestyle=":")
    axes.set_xlim(0, 1)
