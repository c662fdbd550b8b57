"""Plots and page of the interior orientation of film scans: residual vectors at the fiducial marks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.report.drawing import BLUE, INK, RED, SOFT, STYLE, load_matplotlib, png
from photoplan.report.page import Cell, figure, headline, page, section, table

#: In the units of the axes; heads in widths of their shafts.
_VECTORS = {
    "angles": "xy",
    "scale_units": "xy",
    "scale": 1.0,
    "headwidth": 3.6,
    "headlength": 4.2,
    "headaxislength": 3.8,
    "minlength": 0.6,
}
#: Panels side by side, and at most in one picture.
_COLUMNS, _PANELS = 3, 24
#: The longest vector is drawn about so long, as a part of the film's side.
_LENGTH = 0.25


@dataclass(frozen=True, eq=False)
class ResidualPanel:
    """Residuals of one scan."""

    title: str
    names: tuple[str, ...]
    plane_mm: NDArray[np.float64]
    """Marks, x right, y up, shape (n, 2), millimetres."""
    residuals_um: NDArray[np.float64]
    """Shape (n, 2), micrometres."""


def vector_scale(panels: Sequence[ResidualPanel]) -> float:
    """One round scale for all panels: how much longer vectors are drawn than they are."""
    longest = max(float(np.linalg.norm(p.residuals_um, axis=1).max()) for p in panels) / 1000
    side = max(float(np.ptp(p.plane_mm, axis=0).max()) for p in panels)
    return _nice(_LENGTH * side / max(longest, 1e-5))


class InteriorPlots:
    """Draws; made before any work, so that a missing library is known at once.

    Raises
    ------
    UsageError
        When made: matplotlib is not installed.
    """

    def __init__(self) -> None:
        self._mpl = load_matplotlib("a plot of residuals", "leave report and plot out")

    def residuals(self, panels: Sequence[ResidualPanel]) -> bytes:
        """Residual vectors of all scans, one panel each at the same scale, and all in one; PNG.

        Of more than 24 scans those with the longest vectors have a panel.
        """
        scale = vector_scale(panels)
        several = len(panels) > 1
        shown = list(panels)
        if len(shown) > _PANELS:
            shown.sort(key=lambda p: -float(np.linalg.norm(p.residuals_um, axis=1).max()))
            shown = shown[:_PANELS]
        columns = min(_COLUMNS, len(shown) + several)
        rows = -(-(len(shown) + several) // columns)
        with self._mpl.rc_context(STYLE):
            width = 7.2 if columns > 1 else 5.2
            side = width / columns
            fig = self._mpl.figure.Figure(figsize=(width, rows * (side + 0.25) + 0.3), layout="constrained")
            axes = fig.subplots(rows, columns, squeeze=False).ravel()
            if several:
                self._panel(axes[0], f"all {len(panels)} scans", panels, scale, single=False)
            for ax, panel in zip(axes[several:], shown):
                self._panel(ax, panel.title, [panel], scale, single=not several)
            for ax in axes[len(shown) + several :]:
                ax.set_axis_off()
            left_out = f", {len(shown)} of {len(panels)} scans shown" if len(shown) < len(panels) else ""
            fig.suptitle(f"residuals at the fiducial marks, vectors × {scale:.0f}{left_out}", fontsize=10)
            return png(fig)

    def _panel(self, ax: Any, title: str, panels: Sequence[ResidualPanel], scale: float, single: bool) -> None:
        named = len(panels) == 1
        low = np.min([p.plane_mm.min(axis=0) for p in panels], axis=0)
        high = np.max([p.plane_mm.max(axis=0) for p in panels], axis=0)
        middle, half = (low + high) / 2, float((high - low).max()) / 2
        # Parts of the panel's width: thin where many vectors lie on each other.
        width = 0.007 if single else 0.012 if named else 0.006
        for panel in panels:
            x, y = panel.plane_mm.T
            u, v = panel.residuals_um.T * scale / 1000
            ax.plot(x, y, "+", color=SOFT, markersize=7, zorder=2)
            ax.quiver(x, y, u, v, color=RED, width=width, zorder=3, **_VECTORS)
            if named:
                for name, px, py in zip(panel.names, x, y):
                    # Towards the middle, where a vector does not often go.
                    dx, dy = -np.sign(px - middle[0]) * 0.13 * half, -np.sign(py - middle[1]) * 0.13 * half
                    ax.annotate(_short(name), (px + dx, py + dy), ha="center", va="center", color=INK, fontsize=8)
        length = _nice(0.3 * half / scale * 1000)
        left, base = middle[0] - 0.15 * half, middle[1]
        ax.quiver(left, base, length * scale / 1000, 0, color=BLUE, width=width, **_VECTORS)
        ax.annotate(f"{length:g} µm", (left, base), (0, 5), textcoords="offset points", color=BLUE, fontsize=8)
        reach = 1.55 * half
        ax.set(
            title=_short(title, 30),
            aspect="equal",
            xlim=(middle[0] - reach, middle[0] + reach),
            ylim=(middle[1] - reach, middle[1] + reach),
        )
        if single:
            ax.set(xlabel="x mm", ylabel="y mm")
        else:
            ax.tick_params(labelbottom=False, labelleft=False, length=0)


def interior_report(
    title: str,
    images: Sequence[tuple[ResidualPanel, Mapping[str, Any]]],
    refused: Mapping[str, str],
    plots: InteriorPlots,
) -> str:
    """One HTML document.

    Parameters
    ----------
    title : str
    images : sequence of (ResidualPanel, mapping)
        Each scan with its figures, named as `photoplan interior --json` names them.
    refused : mapping
        Scans whose marks cannot be right, and why.
    plots : InteriorPlots
    """
    figures = [one for _, one in images]
    every = np.concatenate([p.residuals_um for p, _ in images])
    sigmas = [f["sigma0_um"] for f in figures if f["sigma0_um"] is not None]
    parts = [
        headline(
            [
                (str(len(figures)), "scans", f"{len(refused)} refused" if refused else ""),
                (f"{np.median(sigmas):.1f} µm" if sigmas else "–", "median sigma0", "of one coordinate, on the film"),
                (f"{np.linalg.norm(every, axis=1).max():.1f} µm", "longest residual", f"of {len(every)} marks"),
            ]
        ),
        section("Scans", [_scan_table(figures)]),
    ]
    if refused:
        parts.append(section("Refused", [table(["scan", "reason"], [[n, why] for n, why in refused.items()])]))
    caption = (
        "Transformed minus measured place of each mark, on the film, at one scale. Where all scans show the same "
        "vectors, the calibration of the marks is in doubt; a single long vector is a badly measured mark."
    )
    drawing = plots.residuals([panel for panel, _ in images])
    parts.append(section("Residuals", [figure(drawing, "Residual vectors", caption), _mark_table(figures)]))
    return page(title, "Transformation from calibrated fiducial marks to the scans", parts)


def _scan_table(figures: Sequence[Mapping[str, Any]]) -> str:
    head = ["scan", "model", "marks", "sigma0 µm", "px", "pixel x µm", "y µm", "turned °", "shear mrad"]
    head += ["shrinkage x ‰", "y ‰"]
    rows: list[list[str | Cell]] = []
    for f in figures:
        shrinkage = f["shrinkage_permille"] or (None, None)
        numbers = [
            str(len(f["marks"])),
            _number(f["sigma0_um"], ".1f"),
            _number(f["sigma0_px"], ".3f"),
            *(_number(v, ".3f") for v in f["pixel_um"]),
            _number(f["rotation_deg"], "+.3f"),
            _number(f["shear_mrad"], "+.3f"),
            *(_number(v, "+.3f") for v in shrinkage),
        ]
        rows.append([f["image"], f["model"], *(Cell(n, True) for n in numbers)])
    return table(head, rows)


def _mark_table(figures: Sequence[Mapping[str, Any]]) -> str:
    rows: list[list[str | Cell]] = []
    for f in figures:
        for mark in f["marks"]:
            um, px = mark["residual_um"], mark["residual_px"]
            numbers = [f"{v:+.1f}" for v in um] + [f"{v:+.3f}" for v in px]
            rows.append([f["image"], mark["name"], *(Cell(n, True) for n in numbers)])
    return table(["scan", "mark", "vx µm", "vy µm", "column px", "row px"], rows)


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _nice(length: float) -> float:
    """1, 2, 3, 5 or 7 times a power of ten, not above a length."""
    power = 10.0 ** math.floor(math.log10(length))
    return power * max(m for m in (1, 2, 3, 5, 7) if m * power <= length * (1 + 1e-12))


def _short(text: str, most: int = 14) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
