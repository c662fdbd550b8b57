"""Plots and page of the interior orientation of film scans: residual vectors at the fiducial marks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from photoplan.products.film import ImageInterior, InteriorResult
from photoplan.report.drawing import BLUE, INK, RED, SOFT, figure_of, png, round_down, shortened, styled
from photoplan.report.page import cells, figure, headline, number, page, section, table

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
#: Scales and lengths are one of these times a power of ten.
_STEPS = (1.0, 2.0, 3.0, 5.0, 7.0)
#: Panels side by side, and at most in one picture.
_COLUMNS, _PANELS = 3, 24
#: The longest vector is drawn about so long, as a part of the film's side.
_LENGTH = 0.25


def vector_scale(scans: Sequence[ImageInterior]) -> float:
    """Return one round scale for all panels: how much longer vectors are drawn than they are."""
    longest = max(float(np.linalg.norm(p.residuals_um, axis=1).max()) for p in scans) / 1000
    side = max(float(np.ptp(p.plane_mm, axis=0).max()) for p in scans)
    return round_down(_LENGTH * side / max(longest, 1e-5), _STEPS)


@styled
def draw_residuals(scans: Sequence[ImageInterior]) -> bytes:
    """Draw residual vectors of all scans, one panel each at the same scale, and all in one.

    Of more than 24 scans those with the longest vectors have a panel.
    """
    scale = vector_scale(scans)
    several = len(scans) > 1
    shown = list(scans)
    if len(shown) > _PANELS:
        shown.sort(key=lambda p: -float(np.linalg.norm(p.residuals_um, axis=1).max()))
        shown = shown[:_PANELS]
    columns = min(_COLUMNS, len(shown) + several)
    rows = -(-(len(shown) + several) // columns)
    width = 7.2 if columns > 1 else 5.2
    side = width / columns
    fig = figure_of(width, rows * (side + 0.25) + 0.3)
    axes = fig.subplots(rows, columns, squeeze=False).ravel()
    if several:
        _panel(axes[0], f"all {len(scans)} scans", scans, scale, single=False)
    for ax, panel in zip(axes[several:], shown):
        _panel(ax, panel.image, [panel], scale, single=not several)
    for ax in axes[len(shown) + several :]:
        ax.set_axis_off()
    left_out = f", {len(shown)} of {len(scans)} scans shown" if len(shown) < len(scans) else ""
    fig.suptitle(f"residuals at the fiducial marks, vectors × {scale:.0f}{left_out}", fontsize=10)
    return png(fig)


def _panel(ax: Any, title: str, scans: Sequence[ImageInterior], scale: float, single: bool) -> None:
    named = len(scans) == 1
    low = np.min([p.plane_mm.min(axis=0) for p in scans], axis=0)
    high = np.max([p.plane_mm.max(axis=0) for p in scans], axis=0)
    middle, half = (low + high) / 2, float((high - low).max()) / 2
    # Parts of the panel's width: thin where many vectors lie on each other.
    width = 0.007 if single else 0.012 if named else 0.006
    for panel in scans:
        x, y = panel.plane_mm.T
        u, v = panel.residuals_um.T * scale / 1000
        ax.plot(x, y, "+", color=SOFT, markersize=7, zorder=2)
        ax.quiver(x, y, u, v, color=RED, width=width, zorder=3, **_VECTORS)
        if named:
            for name, px, py in zip(panel.fit.names, x, y):
                # Towards the middle, where a vector does not often go.
                dx, dy = -np.sign(px - middle[0]) * 0.13 * half, -np.sign(py - middle[1]) * 0.13 * half
                ax.annotate(shortened(name), (px + dx, py + dy), ha="center", va="center", color=INK, fontsize=8)
    length = round_down(0.3 * half / scale * 1000, _STEPS)
    left, base = middle[0] - 0.15 * half, middle[1]
    ax.quiver(left, base, length * scale / 1000, 0, color=BLUE, width=width, **_VECTORS)
    ax.annotate(f"{length:g} µm", (left, base), (0, 5), textcoords="offset points", color=BLUE, fontsize=8)
    reach = 1.55 * half
    ax.set(
        title=shortened(title, 30),
        aspect="equal",
        xlim=(middle[0] - reach, middle[0] + reach),
        ylim=(middle[1] - reach, middle[1] + reach),
    )
    if single:
        ax.set(xlabel="x mm", ylabel="y mm")
    else:
        ax.tick_params(labelbottom=False, labelleft=False, length=0)


def interior_plot(made: InteriorResult) -> bytes | None:
    """Draw the residual vectors of all scans, if there are any."""
    return draw_residuals(made.images) if made.images else None


def interior_page(made: InteriorResult) -> str | None:
    """Return the report as one HTML document."""
    scans, refused = made.images, made.failed
    if not scans:
        return None
    every = np.concatenate([scan.residuals_um for scan in scans])
    sigmas = [scan.sigma0_um for scan in scans if math.isfinite(scan.sigma0_um)]
    parts = [
        headline(
            [
                (str(len(scans)), "scans", f"{len(refused)} refused" if refused else ""),
                (f"{np.median(sigmas):.1f} µm" if sigmas else "–", "median sigma0", "of one coordinate, on the film"),
                (f"{np.linalg.norm(every, axis=1).max():.1f} µm", "longest residual", f"of {len(every)} marks"),
            ]
        ),
        section("Scans", [_scan_table(scans)]),
    ]
    if refused:
        parts.append(section("Refused", [table(["scan", "reason"], [[n, why] for n, why in refused.items()])]))
    caption = (
        "Transformed minus measured place of each mark, on the film, at one scale. Where all scans show the same "
        "vectors, the calibration of the marks is in doubt; a single long vector is a badly measured mark."
    )
    drawing = figure(draw_residuals(scans), "Residual vectors", caption)
    parts.append(section("Residuals", [drawing, _mark_table(scans)]))
    title = f"Interior orientation · {made.project.resolve().parent.name}"
    return page(title, "Transformation from calibrated fiducial marks to the scans", parts)


def _scan_table(scans: Sequence[ImageInterior]) -> str:
    head = ["scan", "model", "marks", "sigma0 µm", "px", "pixel x µm", "y µm", "turned °", "shear mrad"]
    head += ["shrinkage x ‰", "y ‰"]
    rows = []
    for scan in scans:
        facts, shrinkage = scan.facts, scan.shrinkage
        shrunk = ("–", "–") if shrinkage is None else (f"{1000 * v:+.3f}" for v in (shrinkage.x, shrinkage.y))
        row = [scan.image, scan.fit.model, str(len(scan.fit.names)), number(scan.sigma0_um, 1)]
        row += [number(scan.fit.sigma0, 3), *(f"{1000 * v:.3f}" for v in facts.pixel_size)]
        row += [f"{math.degrees(facts.rotation):+.3f}", f"{1000 * facts.shear:+.3f}", *shrunk]
        rows.append(cells(row, 2))
    return table(head, rows)


def _mark_table(scans: Sequence[ImageInterior]) -> str:
    rows = []
    for scan in scans:
        for name, um, px in zip(scan.fit.names, scan.residuals_um, scan.fit.residuals):
            rows.append(cells([scan.image, name, *(f"{v:+.1f}" for v in um), *(f"{v:+.3f}" for v in px)], 2))
    return table(["scan", "mark", "vx µm", "vy µm", "column px", "row px"], rows)
