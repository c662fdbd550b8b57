"""Plots of MTF measurements: where the edges are, profiles, MTF curves, and sharpness over the field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from photoplan.report.drawing import (
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
    load_matplotlib,
    png,
)

Array = NDArray[np.float64]

_WIDTH = 7.2
_COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY)
#: Curves of single edges that are drawn.
_SINGLE = 80


@dataclass(frozen=True, eq=False)
class EdgeFacts:
    """Where an edge is, and how sharp."""

    ends: tuple[tuple[float, float], tuple[float, float]]
    mtf50: float


@dataclass(frozen=True, eq=False)
class ProfileFacts:
    """Profile of one edge."""

    title: str
    esf: tuple[Array, Array, Array]
    """Positions, values, standard deviations."""
    lsf: tuple[Array, Array, Array]
    samples: tuple[Array, Array]
    """Positions and values of the pixels' means."""
    factor: float
    """Standard deviations in an interval's half."""


@dataclass(frozen=True, eq=False)
class CurveFacts:
    """A mean MTF."""

    label: str
    frequency: Array
    modulation: Array
    sigma: Array
    single: tuple[tuple[Array, Array], ...] = ()
    """Curves of its edges."""


@dataclass(frozen=True, eq=False)
class CellFacts:
    """Sharpness over the field in a direction."""

    title: str
    mtf50: Array
    """(rows, columns), NaN where there is no edge."""
    reach: Array
    """Half intervals."""
    edges: NDArray[np.int64]


class MtfPlots:
    """Draws; made before any work, so that a missing library is known at once.

    Raises
    ------
    UsageError
        When made: matplotlib is not installed.
    """

    def __init__(self) -> None:
        self._mpl = load_matplotlib("a report", "leave --report out")

    def overview(self, small: NDArray[np.uint8], size: tuple[int, int], edges: Sequence[EdgeFacts]) -> bytes:
        """The image with its edges, coloured by their MTF50.

        Parameters
        ----------
        small : array
            A small copy of the image, (rows, columns).
        size : tuple of int
            Width and height of the image, pixels.
        edges : sequence of EdgeFacts
        """
        width, height = size
        with self._mpl.rc_context(STYLE):
            # Beside the picture are its axis and the colours.
            tall = float(np.clip((_WIDTH - 1.4) * height / width, 1.4, 9.0))
            fig, axes = axes_of(self._mpl, _WIDTH, tall + 0.6)
            box = (-0.5, width - 0.5, height - 0.5, -0.5)
            axes.imshow(small, cmap="gray", vmin=-60, vmax=300, extent=box, interpolation="antialiased")
            values = np.array([e.mtf50 for e in edges])
            known = np.isfinite(values)
            low, high = (float(np.quantile(values[known], q)) for q in (0.05, 0.95)) if known.any() else (0.0, 0.5)
            lines = self._mpl.collections.LineCollection(
                [e.ends for e in edges], cmap="plasma", linewidths=2.4, capstyle="round", zorder=3
            )
            lines.set_array(np.where(known, values, low))
            lines.set_clim(low, high if high > low else low + 0.01)
            axes.add_collection(lines)
            fig.colorbar(lines, ax=axes, label="MTF50, cycles per pixel", shrink=0.8, pad=0.01)
            axes.set(xlim=box[:2], ylim=box[2:], xlabel="column px", ylabel="row px")
            axes.set_aspect("equal")
            axes.grid(False)
            return png(fig)

    def profiles(self, profiles: Sequence[ProfileFacts]) -> bytes:
        """Edge and line spread function of some edges, with intervals and the pixels' means."""
        with self._mpl.rc_context(STYLE):
            fig = self._mpl.figure.Figure(figsize=(_WIDTH, 2.5 * len(profiles)), layout="constrained")
            for row, facts in zip(fig.subplots(len(profiles), 2, squeeze=False), profiles):
                for axes, (at, value, sigma), name in zip(row, (facts.esf, facts.lsf), ("edge", "line")):
                    reach = facts.factor * sigma
                    axes.fill_between(at, value - reach, value + reach, color=SKY, alpha=0.45, linewidth=0)
                    axes.plot(at, value, color=BLUE, linewidth=1.3)
                    axes.set(xlabel="distance from the edge px", title=f"{facts.title}: {name} spread function")
                row[0].plot(*facts.samples, ".", color=INK, markersize=2.5, zorder=3)
                near = 1.1 * _extent(facts.lsf)
                for axes in row:
                    axes.set_xlim(-near, near)
            return png(fig)

    def curves(
        self, means: Sequence[CurveFacts], gaussian: tuple[Array, Array, str], lab: tuple[Array, Array] | None
    ) -> bytes:
        """Mean MTF curves with intervals of two standard deviations, single edges, a Gaussian, laboratory values."""
        with self._mpl.rc_context(STYLE):
            fig, axes = axes_of(self._mpl, _WIDTH, 3.9)
            for mean in means:
                for frequency, modulation in mean.single[:_SINGLE]:
                    axes.plot(frequency, modulation, color="#c9d2d8", linewidth=0.5, zorder=1)
            for mean, colour in zip(means, _COLOURS):
                low, high = mean.modulation - 2 * mean.sigma, mean.modulation + 2 * mean.sigma
                axes.fill_between(mean.frequency, low, high, color=colour, alpha=0.22, linewidth=0, zorder=2)
                axes.plot(mean.frequency, mean.modulation, color=colour, linewidth=1.6, label=mean.label, zorder=3)
            axes.plot(gaussian[0], gaussian[1], "--", color=INK, linewidth=1.0, label=gaussian[2], zorder=4)
            if lab is not None:
                axes.plot(*lab, "s", color=INK, markersize=5, label="laboratory", zorder=5)
            axes.axvline(0.5, color=SOFT, linewidth=0.8, linestyle=":")
            axes.annotate(
                "Nyquist", (0.5, 1.0), (3, -3), textcoords="offset points", fontsize=7.5, color=SOFT, va="top"
            )
            axes.axhline(0.5, color=SOFT, linewidth=0.6, linestyle=":")
            top = max(1.05, *(float(np.nanmax(m.modulation)) for m in means)) + 0.03
            axes.set(xlim=(0, max(0.6, *(float(m.frequency[-1]) for m in means))), ylim=(0, top))
            axes.set(xlabel="frequency, cycles per pixel", ylabel="modulation transfer")
            axes.legend(loc="upper right", fontsize=8)
            return png(fig)

    def field(self, maps: Sequence[CellFacts]) -> bytes:
        """MTF50 in the cells of the field, with half intervals and numbers of edges."""
        known = np.concatenate([m.mtf50[np.isfinite(m.mtf50)] for m in maps])
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.5)
        pad = max(0.02, 0.1 * (high - low))
        with self._mpl.rc_context(STYLE):
            cells = maps[0].mtf50.shape[0]
            fig = self._mpl.figure.Figure(figsize=(_WIDTH, 3.2), layout="constrained")
            row = fig.subplots(1, len(maps), squeeze=False)[0]
            shown = None
            for axes, facts in zip(row, maps):
                shown = axes.imshow(facts.mtf50, cmap="viridis", vmin=low - pad, vmax=high + pad, aspect="auto")
                for i, j in np.ndindex(facts.mtf50.shape):
                    if np.isfinite(facts.mtf50[i, j]) and cells <= 6:
                        light = facts.mtf50[i, j] > (low + high) / 2
                        reach = facts.reach[i, j]
                        more = f"±{reach:.3f}\n" if np.isfinite(reach) else ""
                        words = f"{facts.mtf50[i, j]:.3f}\n{more}n = {facts.edges[i, j]}"
                        axes.annotate(
                            words, (j, i), ha="center", va="center", fontsize=7, color=INK if light else "white"
                        )
                axes.set(xticks=[], yticks=[], title=facts.title)
                axes.grid(False)
            fig.colorbar(shown, ax=list(row), label="MTF50, cycles per pixel", shrink=0.85)
            return png(fig)


def _extent(line: tuple[Array, Array, Array]) -> float:
    """How far a line spread function reaches, pixels; what is drawn."""
    at, value, _ = line
    large = np.abs(at[np.abs(value) > 0.02 * np.abs(value).max()])
    return float(np.clip(1.6 * large.max(initial=1.0), 3.0, float(np.abs(at).max())))
