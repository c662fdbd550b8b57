"""A filter as a picture: its weights, sections through its middle, and what it does to every frequency."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.io.naming import write_atomically
from photoplan.io.product import check_output
from photoplan.products.describe import place_of
from photoplan.project.filter_files import load_filter
from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, SOFT, figure_of, load_matplotlib, mpl, png, styled

Array = NDArray[np.float64]

#: Kernels that are drawn; of more, the first ones are.
MOST_DRAWN = 12
_DIRECTIONS = (("row", BLUE, "-"), ("column", ORANGE, "--"), ("diagonal", GREEN, ":"))


def frequency_response(values: Array, frequency: Array, direction: tuple[float, float]) -> Array:
    """Factor by which a kernel changes the amplitude of waves."""
    m, n = (side // 2 for side in values.shape)
    rows, columns = np.mgrid[-m : m + 1, -n : n + 1]
    along = (direction[0] * columns + direction[1] * rows).ravel()
    return np.asarray(np.abs(np.exp(-2j * np.pi * np.multiply.outer(frequency, along)) @ values.ravel()))


@styled
def draw_kernels(title: str, kernels: Sequence[tuple[str, Array]]) -> bytes:
    """PNG with a row of three panels for each kernel, given by name and values (2 m + 1, 2 n + 1)."""
    drawn = list(kernels[:MOST_DRAWN])
    height = 3.0 * len(drawn) + 0.7
    fig = figure_of(11.0, height)
    more = f" (the first {MOST_DRAWN} of {len(kernels)} kernels)" if len(kernels) > MOST_DRAWN else ""
    fig.suptitle(title + more, x=0.01, ha="left", fontsize=11, color=INK)
    rows = fig.subplots(len(drawn), 3, squeeze=False, gridspec_kw={"width_ratios": [1.0, 1.3, 1.3]})
    for panels, (name, values) in zip(rows, drawn):
        panels[0].set_title(name)
        _weights(panels[0], values)
        _sections(panels[1], values)
        _response(panels[2], values)
    return png(fig)


def _weights(axes: Any, values: Array) -> None:
    """Heat map; the colour is that of the root, since the middle is far larger than all others."""
    m, n = (side // 2 for side in values.shape)
    rooted = np.sign(values) * np.sqrt(np.abs(values))
    most = float(np.abs(rooted).max()) or 1.0
    box = (-n - 0.5, n + 0.5, m + 0.5, -m - 0.5)
    axes.imshow(rooted, cmap="RdBu_r", vmin=-most, vmax=most, extent=box, interpolation="nearest")
    axes.grid(visible=False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(integer=True))
    axes.set_xlabel("columns (colour: root of the weight)")
    axes.set_ylabel("rows")
    if values.size <= 49:
        for (i, k), value in np.ndenumerate(values):
            strong = abs(rooted[i, k]) > 0.6 * most
            axes.text(
                k - n, i - m, f"{value:.2g}", ha="center", va="center", fontsize=6, color="white" if strong else INK
            )


def _sections(axes: Any, values: Array) -> None:
    """Middle row, middle column, and sums."""
    m, n = (side // 2 for side in values.shape)
    axes.axhline(0.0, color=SOFT, linewidth=0.8)
    axes.plot(np.arange(-n, n + 1), values[m], "o-", color=BLUE, markersize=3.5, linewidth=1.2, label="middle row")
    axes.plot(
        np.arange(-m, m + 1), values[:, n], "s--", color=ORANGE, markersize=3, linewidth=1.2, label="middle column"
    )
    axes.plot(np.arange(-n, n + 1), values.sum(0), "^:", color=GREEN, markersize=3, linewidth=1.2, label="column sums")
    axes.xaxis.set_major_locator(mpl.ticker.MaxNLocator(integer=True))
    axes.set_title(f"sections; sum {values.sum():.4g}")
    axes.set_xlabel("pixels from the middle")
    axes.legend(fontsize=7.5)


def _response(axes: Any, values: Array) -> None:
    """Up to the Nyquist frequency along rows and columns."""
    frequency = np.linspace(0.0, 0.5, 101)
    for (name, colour, line), direction in zip(_DIRECTIONS, ((1.0, 0.0), (0.0, 1.0), (0.5**0.5, 0.5**0.5))):
        response = frequency_response(values, frequency, direction)
        axes.plot(frequency, response, line, color=colour, linewidth=1.6, label=f"along a {name}")
    axes.set_xlim(0.0, 0.5)
    axes.set_ylim(bottom=0.0)
    gain = float(np.sqrt((values**2).sum()))
    axes.set_title(f"frequency response |R|; noise grows {gain:.3g} times")
    axes.set_xlabel("cycles per pixel")
    axes.legend(fontsize=7.5)


def draw_filter(path: Path, picture: Path, *, overwrite: bool = False) -> Path:
    """Draw a filter file as PNG."""
    check_output(picture, [path], overwrite=overwrite)
    load_matplotlib("a picture of a filter")
    used = load_filter(path)
    kernels = [(place_of(kernel), kernel.values) for kernel in used.kernels]
    write_atomically(picture, draw_kernels(used.description or path.name, kernels))
    return picture
