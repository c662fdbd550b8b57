"""Plots of a bundle adjustment: network, residuals, accuracy of stations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from photoplan.products.adjust.figures import AdjustFigures, GroundFigures, ResidualField
from photoplan.report.drawing import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    SOFT,
    axes_of,
    figure_of,
    mpl,
    png,
    round_down,
    styled,
)

_WIDTH = 7.2
#: Radius of the 95 % ellipse of two normal coordinates in standard deviations: root of −2 ln 0.05.
_ELLIPSE_95 = 2.4477
#: Names of control and check points that are written into a map.
_NAMED = 40
#: Tie points that are drawn.
_DOTS = 20_000
_STRIPS = (BLUE, GREEN, PURPLE, SKY, "#7a5c00", INK)


@styled
def draw_network(facts: AdjustFigures) -> bytes:
    """Image centres by strip, tie points, control and check points."""
    fig, axes = _map(facts)
    step = max(1, -(-len(facts.tie_XY) // _DOTS))
    dots = facts.tie_XY[::step]
    size = float(np.clip(4e3 / max(1, len(dots)), 0.8, 7))
    axes.scatter(*dots.T, s=size, color="#b3bec6", linewidths=0, label="tie points", rasterized=True)
    strips = list(dict.fromkeys(image.strip for image in facts.images))
    for k, strip in enumerate(strips):
        at = np.array([image.center[:2] for image in facts.images if image.strip == strip])
        name = "image centres" + (", one colour a strip" if len(strips) > 1 else "")
        side = float(np.clip(140 / max(1.0, np.sqrt(len(facts.images))), 3, 26))
        axes.scatter(
            *at.T,
            s=side,
            marker="s",
            color=_STRIPS[k % len(_STRIPS)],
            linewidths=0,
            label=name if k == 0 else None,
            zorder=3,
        )
    _ground(axes, facts.ground)
    _legend(fig)
    return png(fig)


@styled
def draw_control(facts: AdjustFigures, check: bool) -> tuple[bytes, str]:
    """Residual vectors of control or check points with the 95 % ellipses of the adjusted points, and the scale.

    What was taken out has no arrow: its residual would set the scale, and the others could not be seen.
    """
    some = [g for g in facts.ground if g.check == check and np.isfinite(g.residual).any()]
    fig, axes = _map(facts)
    centers = np.array([image.center[:2] for image in facts.images]).reshape(-1, 2)
    axes.scatter(*centers.T, s=2, marker="s", color="#d3dbe0", linewidths=0)
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    axes.set_ylim(bottom - 0.08 * (top - bottom), top)
    kept = [np.where(g.rejected, np.nan, g.residual) for g in some]
    reach = max((float(np.nan_to_num(np.abs(v)).max()) for v in kept), default=0.0)
    spread = max((float(np.sqrt(np.nan_to_num(np.diag(g.covariance)[:2]).max())) for g in some), default=0.0)
    largest = max(reach, _ELLIPSE_95 * spread, 1e-6)
    scale = round_down(max(0.07 * (right - left) / largest, 1e-6))
    for g, residual in zip(some, kept):
        x, y = g.XYZ[:2] if np.isfinite(g.XYZ[:2]).all() else (np.nan, np.nan)
        if not np.isfinite([x, y]).all():
            continue
        _ellipse(axes, (x, y), g.covariance[:2, :2], scale)
        dx, dy, dz = (scale * np.nan_to_num(v) for v in residual)
        if np.isfinite(residual[:2]).any():
            _arrow(axes, x, y, dx, dy, RED)
        if np.isfinite(residual[2]):
            _arrow(axes, x, y, 0.0, dz, BLUE)
    _ground(axes, [g for g in facts.ground if g.check == check], 9.0)
    handles = [
        _key(RED, "horizontal residual"),
        _key(BLUE, "height residual (up: too high)"),
        _key(ORANGE, "95 % ellipse"),
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=3)
    _scale_bar(axes, scale, largest)
    return png(fig), f"{scale:g}".replace("e+0", "e")


@styled
def draw_sigmas(facts: AdjustFigures) -> bytes:
    """Standard deviations of the projection centres: in the horizontal, and of the height."""
    fig = figure_of(_WIDTH, _height(facts, half=True) + 0.9)
    panels = fig.subplots(1, 2, sharex=True, sharey=True)
    at = np.array([image.center for image in facts.images])
    sigma = np.array([image.sigma_center for image in facts.images])
    values = [np.hypot(sigma[:, 0], sigma[:, 1]), sigma[:, 2]]
    side = float(np.clip(300 / max(1.0, np.sqrt(len(at))), 6, 40))
    for axes, value, name in zip(panels, values, ("horizontal", "height")):
        _frame(axes, facts)
        low, high = _limits(value)
        norm = mpl.colors.Normalize(low, high)
        axes.scatter(at[:, 0], at[:, 1], c=value, cmap="viridis_r", norm=norm, s=side, marker="s", linewidths=0)
        axes.set_title(name)
        tints = mpl.cm.ScalarMappable(norm, "viridis_r")
        bar = fig.colorbar(tints, ax=axes, orientation="horizontal", shrink=0.85, aspect=30, pad=0.02)
        bar.set_label("standard deviation m")
        bar.outline.set_visible(False)
    panels[1].set_ylabel("")
    return png(fig)


@styled
def draw_field(field: ResidualField) -> tuple[bytes, str]:
    """Mean residual vectors over the image format, and how many times they are enlarged."""
    xmin, ymin, xmax, ymax = field.frame
    ratio = (ymax - ymin) / (xmax - xmin)
    fig, axes = axes_of(_WIDTH, float(np.clip(5.6 * ratio, 2.4, 7.0)) + 0.8)
    axes.add_patch(mpl.patches.Rectangle((xmin, ymin), xmax - xmin, ymax - ymin, fill=False, ec=SOFT))
    margin = 0.04 * (xmax - xmin)
    axes.set(xlim=(xmin - margin, xmax + margin), ylim=(ymin - margin, ymax + margin), aspect="equal")
    axes.set(xlabel=f"x {field.unit}", ylabel=f"y {field.unit}")
    axes.grid(False)
    largest = float(np.hypot(*field.mean.T).max()) if len(field.mean) else 0.0
    # One arrow is compared with the noise of its mean: those that stand out are dark.
    unsure = field.noise / np.sqrt(np.maximum(field.count, 1))
    clear = np.hypot(*field.mean.T) > 2.5 * unsure
    key = round_down(max(largest, 1e-6))
    side = np.sqrt((xmax - xmin) * (ymax - ymin) / max(1, len(field.at)))
    scale = 0.85 * side / max(largest, 1e-9)
    for some, colour, name in ((~clear, "#8fa3b0", "within its noise"), (clear, RED, "stands out (2.5 sigma)")):
        if some.any():
            axes.quiver(
                *field.at[some].T,
                *field.mean[some].T,
                angles="xy",
                scale_units="xy",
                scale=1 / scale,
                color=colour,
                width=0.0022,
                label=name,
                zorder=3,
            )
    axes.scatter(*field.at.T, s=3, color=SOFT, linewidths=0, zorder=2)
    x, y = xmin + 0.03 * (xmax - xmin), ymin + 0.03 * (ymax - ymin)
    axes.plot([x, x + key * scale], [y, y], color=INK, linewidth=2.2, solid_capstyle="butt", zorder=5)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
    axes.annotate(f"{key:g} px", (x, y), (0, 5), textcoords="offset points", fontsize=8, color=INK, bbox=box, zorder=5)
    _legend(fig)
    return png(fig), f"{key:g} px"


def _ground(axes: Any, ground: Sequence[GroundFigures], size: float = 38.0) -> None:
    kinds = ((False, "^", RED, "control"), (True, "o", ORANGE, "check points"))
    for check, marker, colour, name in kinds:
        for seen, word in ((True, name), (False, f"{name}, not measured")):
            some = [g for g in ground if g.check == check and (g.rays > 0) == seen]
            at = np.array([g.XYZ[:2] for g in some]).reshape(-1, 2)
            at = at[np.isfinite(at).all(axis=1)]
            if len(at):
                faces, edge = (colour, "white") if seen else ("none", colour)
                axes.scatter(
                    *at.T, s=size, marker=marker, facecolor=faces, edgecolor=edge, linewidth=0.7, label=word, zorder=4.5
                )
    for g in [g for g in ground if np.isfinite(g.XYZ[:2]).all()][:_NAMED]:
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7 if size > 20 else 0.0, "pad": 0.8}
        axes.annotate(
            _short(g.name), g.XYZ[:2], (5, 4), textcoords="offset points", fontsize=7.5, color=INK, bbox=box, zorder=7
        )


def _ellipse(axes: Any, at: tuple[float, float], covariance: NDArray[np.float64], scale: float) -> None:
    if not np.isfinite(covariance).all():
        return
    values, vectors = np.linalg.eigh(covariance)
    width, height = (2 * _ELLIPSE_95 * scale * float(np.sqrt(max(v, 0.0))) for v in values[::-1])
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    patch = mpl.patches.Ellipse(at, width, height, angle=angle, fill=False, ec=ORANGE, lw=1.2, zorder=4)
    axes.add_patch(patch)


def _bounds(facts: AdjustFigures) -> tuple[float, float, float, float]:
    XY = [np.array([image.center[:2] for image in facts.images]).reshape(-1, 2), facts.tie_XY]
    XY.append(np.array([g.XYZ[:2] for g in facts.ground]).reshape(-1, 2))
    every = np.concatenate(XY)
    every = every[np.isfinite(every).all(axis=1)]
    low, high = every.min(axis=0), every.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1.0)
    return float(low[0]) - margin, float(low[1]) - margin, float(high[0]) + margin, float(high[1]) + margin


def _height(facts: AdjustFigures, half: bool = False) -> float:
    left, bottom, right, top = _bounds(facts)
    width = 3.0 if half else 6.2
    return float(np.clip(width * (top - bottom) / (right - left), 1.6 if half else 2.2, 4.2 if half else 6.4))


def _map(facts: AdjustFigures) -> tuple[Any, Any]:
    fig, axes = axes_of(_WIDTH, _height(facts) + 0.8)
    _frame(axes, facts)
    return fig, axes


def _frame(axes: Any, facts: AdjustFigures) -> None:
    left, bottom, right, top = _bounds(facts)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="X m", ylabel="Y m")
    axes.grid(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(4, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(mpl.ticker.FuncFormatter(lambda v, _: f"{v:.12g}"))


def _arrow(axes: Any, x: float, y: float, dx: float, dy: float, colour: str) -> None:
    """An arrow whose head is smaller where it is short, so that its length can be seen."""
    head = {"headwidth": 4.5, "headlength": 5.0, "headaxislength": 5.0, "minshaft": 1.5, "minlength": 0.3}
    axes.quiver(
        x,
        y,
        dx,
        dy,
        angles="xy",
        scale_units="xy",
        scale=1,
        units="inches",
        width=0.018,
        color=colour,
        zorder=5,
        **head,
    )


def _key(colour: str, label: str) -> Any:
    return mpl.lines.Line2D([], [], color=colour, linewidth=1.8, label=label)


def _legend(fig: Any) -> None:
    legend = fig.legend(loc="outside lower center", ncols=3)
    for handle in legend.legend_handles:
        if hasattr(handle, "set_sizes"):
            handle.set_sizes([30])


def _scale_bar(axes: Any, scale: float, largest: float) -> None:
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    length = round_down(largest)
    x, y = left + 0.03 * (right - left), bottom + 0.03 * (top - bottom)
    axes.plot([x, x + length * scale], [y, y], color=INK, linewidth=2.2, solid_capstyle="butt")
    axes.annotate(_metres(length), (x, y), (0, 4), textcoords="offset points", fontsize=8, color=INK)


def _metres(value: float) -> str:
    return f"{value * 1000:g} mm" if value < 0.01 else f"{value * 100:g} cm" if value < 1 else f"{value:g} m"


def _limits(values: NDArray[np.float64]) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = float(np.percentile(known, 1)), float(np.percentile(known, 99))
    return low, max(high, low * 1.1 + 1e-6)


def _short(name: str) -> str:
    kept = "".join(c if c.isprintable() else "\ufffd" for c in name)
    return kept if len(kept) <= 16 else kept[:15] + "…"
