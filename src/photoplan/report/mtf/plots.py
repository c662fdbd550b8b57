"""Plots of MTF measurements: where the edges are, profiles, MTF curves, and sharpness over the field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.products.mtf.result import EdgeGroup, MeasuredEdge
from photoplan.quality.spread import gaussian_modulation
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
    png,
)
from photoplan.report.page import number

Array = NDArray[np.float64]

_WIDTH = 7.2
_COLOURS = (BLUE, RED, GREEN, PURPLE, ORANGE, SKY)
#: Curves of single edges that are drawn.
_SINGLE = 80
_NORMAL_95 = 1.96


@dataclass(frozen=True, eq=False)
class MtfPlots:
    """Draws edges, their profiles and curves, and the field."""

    mpl: Any

    def overview(self, small: NDArray[np.uint8], size: tuple[int, int], edges: Sequence[MeasuredEdge]) -> bytes:
        """The image with its edges, coloured by their MTF50.

        Parameters
        ----------
        small : array
            A small copy of the image, (rows, columns).
        size : tuple of int
            Width and height of the image, pixels.
        edges : sequence of MeasuredEdge
        """
        width, height = size
        with self.mpl.rc_context(STYLE):
            # Beside the picture are its axis and the colours.
            tall = float(np.clip((_WIDTH - 1.4) * height / width, 1.4, 9.0))
            fig, axes = axes_of(self.mpl, _WIDTH, tall + 0.6)
            box = (-0.5, width - 0.5, height - 0.5, -0.5)
            axes.imshow(small, cmap="gray", vmin=-60, vmax=300, extent=box, interpolation="antialiased")
            values = np.array([e.measured.mtf50 for e in edges])
            known = np.isfinite(values)
            low, high = (float(np.quantile(values[known], q)) for q in (0.05, 0.95)) if known.any() else (0.0, 0.5)
            lines = self.mpl.collections.LineCollection(
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

    def profiles(self, edges: Sequence[MeasuredEdge]) -> bytes:
        """Edge and line spread function of some edges, with 95 % intervals and the pixels' means."""
        with self.mpl.rc_context(STYLE):
            fig = self.mpl.figure.Figure(figsize=(_WIDTH, 2.5 * len(edges)), layout="constrained")
            for row, edge in zip(fig.subplots(len(edges), 2, squeeze=False), edges):
                m, title = edge.measured, f"{edge.direction}, edge {edge.number}"
                for axes, spread, name in zip(row, (m.esf, m.lsf), ("edge", "line")):
                    at, value, reach = spread.positions, spread.values, _NORMAL_95 * spread.sigma
                    axes.fill_between(at, value - reach, value + reach, color=SKY, alpha=0.45, linewidth=0)
                    axes.plot(at, value, color=BLUE, linewidth=1.3)
                    axes.set(xlabel="distance from the edge px", title=f"{title}: {name} spread function")
                row[0].plot(m.samples.positions, m.samples.values, ".", color=INK, markersize=2.5, zorder=3)
                near = 1.1 * _extent(m.lsf.positions, m.lsf.values)
                for axes in row:
                    axes.set_xlim(-near, near)
            return png(fig)

    def curves(self, means: Sequence[EdgeGroup], total: EdgeGroup, edges: Sequence[MeasuredEdge] = ()) -> bytes:
        """Mean MTF curves with two standard deviations, beside the Gaussian and laboratory values of `total`.

        Of `edges`, those of the directions are drawn behind.
        """
        with self.mpl.rc_context(STYLE):
            fig, axes = axes_of(self.mpl, _WIDTH, 3.9)
            for mean in means:
                own = [e.measured.mtf for e in edges if mean.direction in (None, e.direction)]
                for mtf in own[:_SINGLE]:
                    axes.plot(mtf.frequency, mtf.modulation, color="#c9d2d8", linewidth=0.5, zorder=1)
            for mean, colour in zip(means, _COLOURS):
                curve = mean.curve
                sigma = 0.0 if curve.sigma is None else np.nan_to_num(curve.sigma)
                low, high = curve.modulation - 2 * sigma, curve.modulation + 2 * sigma
                axes.fill_between(curve.frequency, low, high, color=colour, alpha=0.22, linewidth=0, zorder=2)
                axes.plot(curve.frequency, curve.modulation, color=colour, linewidth=1.6, label=_label(mean), zorder=3)
            frequency = np.linspace(0.0, float(total.curve.frequency[-1]), 200)
            fwhm = total.gaussian.fwhm
            gaussian = gaussian_modulation(fwhm, frequency)
            label = f"Gaussian, FWHM {fwhm:.2f} px"
            axes.plot(frequency, gaussian, "--", color=INK, linewidth=1.0, label=label, zorder=4)
            if edges and total.laboratory is not None:
                lab = total.laboratory
                axes.plot(lab.frequency, lab.laboratory, "s", color=INK, markersize=5, label="laboratory", zorder=5)
            axes.axvline(0.5, color=SOFT, linewidth=0.8, linestyle=":")
            axes.annotate(
                "Nyquist", (0.5, 1.0), (3, -3), textcoords="offset points", fontsize=7.5, color=SOFT, va="top"
            )
            axes.axhline(0.5, color=SOFT, linewidth=0.6, linestyle=":")
            top = max(1.05, *(float(np.nanmax(m.curve.modulation)) for m in means)) + 0.03
            axes.set(xlim=(0, max(0.6, *(float(m.curve.frequency[-1]) for m in means))), ylim=(0, top))
            axes.set(xlabel="frequency, cycles per pixel", ylabel="modulation transfer")
            axes.legend(loc="upper right", fontsize=8)
            return png(fig)

    def field(self, groups: Sequence[EdgeGroup], grid: int) -> bytes:
        """MTF50 in the cells of the field, with half intervals and numbers of edges: of all edges and each direction.

        Parameters
        ----------
        groups : sequence of EdgeGroup
            Of one channel, each with its cell.
        grid : int
            Cells in each direction.
        """
        known = np.array([g.mtf50.value for g in groups if np.isfinite(g.mtf50.value)])
        low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.5)
        pad = max(0.02, 0.1 * (high - low))
        maps = [(way, own) for way in (None, "x", "y") if (own := [g for g in groups if g.direction == way])]
        with self.mpl.rc_context(STYLE):
            fig = self.mpl.figure.Figure(figsize=(_WIDTH, 3.2), layout="constrained")
            row = fig.subplots(1, len(maps), squeeze=False)[0]
            shown = None
            for axes, (way, own) in zip(row, maps):
                values = np.full((grid, grid), np.nan)
                for group in own:
                    values[group.cell] = group.mtf50.value
                shown = axes.imshow(values, cmap="viridis", vmin=low - pad, vmax=high + pad, aspect="auto")
                for group in own if grid <= 6 else ():
                    assert group.cell is not None
                    value, (first, last) = group.mtf50.value, group.mtf50.interval
                    if np.isfinite(value):
                        more = f"±{(last - first) / 2:.3f}\n" if np.isfinite(last - first) else ""
                        words = f"{value:.3f}\n{more}n = {group.mtf50.edges}"
                        colour = INK if value > (low + high) / 2 else "white"
                        at = group.cell[::-1]
                        axes.annotate(words, at, ha="center", va="center", fontsize=7, color=colour)
                axes.set(xticks=[], yticks=[], title=way or "all")
                axes.grid(False)
            fig.colorbar(shown, ax=list(row), label="MTF50, cycles per pixel", shrink=0.85)
            return png(fig)


def _label(group: EdgeGroup) -> str:
    name = group.band if group.direction is None else group.direction
    flight = "" if group.flight is None else f" ({group.flight} flight)"
    return f"{name}{flight}: MTF50 {number(group.mtf50.value, 3)}"


def _extent(at: Array, value: Array) -> float:
    """How far a line spread function reaches, pixels; what is drawn."""
    large = np.abs(at[np.abs(value) > 0.02 * np.abs(value).max()])
    return float(np.clip(1.6 * large.max(initial=1.0), 3.0, float(np.abs(at).max())))
