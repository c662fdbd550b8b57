"""The picture of a registration: the field of vectors over the image, its components, its distribution."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.matching.features import Grey, GreyImage, to_bytes
from photoplan.matching.register import APART, FOUND, STATES, TEXTURELESS, UNCERTAIN, UNLIKE
from photoplan.products.register import RegisterReport
from photoplan.report.drawing import BLUE, INK, ORANGE, PURPLE, RED, SOFT, figure_of, png, round_down, styled

#: Longest side of the small copy, pixels, and arrows along the longer side at most.
_SIDE, _ARROWS = 900, 40
#: Colours of patches that were left out.
_LEFT_OUT = {TEXTURELESS: SOFT, UNLIKE: RED, UNCERTAIN: ORANGE, APART: PURPLE}


@styled
def draw_vectors(report: RegisterReport) -> bytes:
    """Arrows over the first image, both components, and the lengths of the vectors, as PNG."""
    found, figures = report.found, report.figures
    assert found is not None and figures is not None
    common = report.pair.common
    extent = common.col - 0.5, common.stop[0] - 0.5, common.stop[1] - 0.5, common.row - 0.5
    tall = float(np.clip(common.height / common.width, 0.35, 1.4))
    fig = figure_of(13.5, max(8.4 * tall + 1.2, 6.6))
    grid = fig.add_gridspec(3, 2, width_ratios=[2.5, 1])
    ax = fig.add_subplot(grid[:, 0])
    grey = _small(report.pair.images[0], common)
    ax.imshow(grey, cmap="gray", vmin=-120, vmax=300, extent=extent, interpolation="nearest")
    _arrows(ax, fig, report)
    _components(fig, [fig.add_subplot(grid[k, 1]) for k in range(2)], report, extent)
    _lengths(fig.add_subplot(grid[2, 1]), report)
    return png(fig, dpi=110)


def _arrows(ax: Any, fig: Any, report: RegisterReport) -> None:
    found = report.found
    assert found is not None
    good, at = found.state == FOUND, found.at
    for state, colour in _LEFT_OUT.items():
        here = found.state == state
        if here.any():
            name = f"{STATES[state]} ({here.sum()})"
            ax.scatter(*at[here].T, s=9, marker="x", linewidth=0.8, color=colour, label=name)
    means, places = _thinned(report)
    length = np.linalg.norm(means, axis=1)
    unit = round_down(max(float(np.percentile(length, 90)), 1e-4))
    pitch = max(report.pair.common.width, report.pair.common.height) / _ARROWS
    arrows = ax.quiver(
        *places.T, *means.T, length, angles="xy", scale_units="xy", scale=unit / (1.2 * pitch), cmap="plasma",
        width=0.0014, headwidth=4, clim=(0, max(float(np.percentile(length, 99)), 1e-6)),
    )  # fmt: skip
    fig.colorbar(arrows, ax=ax, shrink=0.6, label="length, px")
    ax.quiverkey(arrows, 0.92, 1.02, unit, f"{unit:g} px", labelpos="E", color=INK)
    each = len(means) < good.sum()
    ax.set_title(
        f"{report.pair.paths[1].name} against {report.pair.paths[0].name}: "
        f"{good.sum()} of {len(good)} patches found" + (", means of groups" if each else "")
    )
    ax.grid(visible=False)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.06), ncols=4, markerscale=1.5)


def _components(fig: Any, axes: list[Any], report: RegisterReport, extent: Any) -> None:
    found = report.found
    assert found is not None
    field = np.where((found.state == FOUND)[:, None], found.moved, np.nan).reshape(*report.shape, 2)
    middle = np.nanmedian(field, axis=(0, 1))
    scale = max(float(np.nanpercentile(np.abs(field - middle), 98)), 1e-3)
    half, (first, last) = report.step / 2, found.at[[0, -1]].astype(float)
    edges = first[0] - half, last[0] + half, last[1] + half, first[1] - half
    for k, (ax, name) in enumerate(zip(axes, ("dx", "dy"))):
        limits = {"vmin": middle[k] - scale, "vmax": middle[k] + scale}
        shown = ax.imshow(field[..., k], cmap="RdBu_r", extent=edges, interpolation="nearest", **limits)
        bar = fig.colorbar(shown, ax=ax, shrink=0.85, extend="both", label="px")
        bar.formatter.set_useOffset(False)
        ax.set(xlim=extent[:2], ylim=extent[2:], facecolor="#d9dfe3")
        ax.set_title(f"{name}: median {middle[k]:+.3f} px")
        ax.grid(visible=False)


def _lengths(ax: Any, report: RegisterReport) -> None:
    found, figures = report.found, report.figures
    assert found is not None and figures is not None
    length = np.sort(np.linalg.norm(found.moved[found.state == FOUND], axis=1))
    ax.plot(length, np.linspace(0, 100, len(length)), color=BLUE)
    if length[-1] > 0.05:
        ax.axvline(0.25, color=SOFT, linewidth=0.8, linestyle="--")
    ax.set(xlabel="length of the vector, px", ylabel="vectors not longer, %", ylim=(0, 101), xlim=(0, None))
    ax.set_title(f"{figures.quarter:.2%} within 1/4 px, longest {figures.largest:.3f} px")


def _thinned(report: RegisterReport) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean vectors and places of groups of neighbours, as many as can be seen."""
    found = report.found
    assert found is not None
    side = -(-max(report.shape) // _ARROWS)
    rows, columns = np.divmod(np.arange(len(found.at)), report.shape[1])
    good = found.state == FOUND
    _, group = np.unique((rows // side)[good] * 10_000_000 + (columns // side)[good], return_inverse=True)
    count = np.bincount(group)

    def mean(values: NDArray[Any]) -> NDArray[np.float64]:
        return np.stack([np.bincount(group, values[good, k]) / count for k in range(2)], axis=1)

    return mean(found.moved), mean(found.at)


def _small(image: Grey, window: Window) -> NDArray[np.uint8]:
    """A small copy of a window of an image."""
    assert isinstance(image, GreyImage) and isinstance(image.pixels, RasterReader)
    level = max(0, int(np.ceil(np.log2(max(window.width, window.height) / _SIDE))))
    f = 2**level
    part = Window(window.col // f, window.row // f, max(1, window.width // f), max(1, window.height // f))
    pixels, valid = image.pixels.read(part, level)
    grey = pixels.astype(np.float32).mean(axis=0)
    if valid is not None:
        grey[~valid] = np.nan
    known = grey[np.isfinite(grey)]
    low, high = np.percentile(known, (1, 99)) if known.size else (0.0, 1.0)
    return to_bytes(grey, float(low), float(max(high, low + 1e-6)))
