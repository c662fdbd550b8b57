"""The drawing of the one idea: target, relief, anchors, camera, owner."""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

BLUE, GREEN, RED, GREY, SAND = "#4477aa", "#228833", "#cc3311", "#777777", "#e9dfc7"
CELLS = 6
CENTRE = np.array([4.6, 7.6])


def terrain(x: np.ndarray) -> np.ndarray:
    """Height of the drawn profile, with a wall (a breakline) in it."""
    smooth = 1.6 + 0.55 * np.sin(x * 0.85) + 0.16 * np.sin(2.3 * x + 1)
    return smooth + np.where((x > 5.55) & (x < 6.6), 0.75, 0.0)


def _section(axes: Axes) -> None:
    x = np.linspace(0.6, 8.6, 1601)
    axes.add_patch(Polygon([*zip(x, terrain(x)), (8.6, 0.55), (0.6, 0.55)], facecolor=SAND, edgecolor="none"))
    axes.plot(x, terrain(x), color="#8a6d3b", linewidth=1.4)
    edges = np.linspace(0.6, 8.6, CELLS + 1)
    for left, right in itertools.pairwise(edges):
        inside = terrain(x[(x >= left) & (x <= right)])
        low, high = inside.min() - 0.07, inside.max() + 0.07
        axes.add_patch(Rectangle((left, low), right - left, high - low, fill=False, edgecolor=BLUE, linewidth=1.1))
        axes.plot([left, right, left, right], [low, low, high, high], "o", color=BLUE, markersize=3.6, zorder=4)
    pixels = np.linspace(0.6, 8.6, 4 * CELLS + 1)
    axes.plot(pixels, np.full_like(pixels, 0.3), "|", color="black", markersize=7)
    axes.plot([0.6, 8.6], [0.3, 0.3], color="black", linewidth=0.8)
    for left, right in itertools.pairwise(pixels):
        owner = GREEN if left > pixels[2] - 0.01 else "white"
        axes.add_patch(Rectangle((left, -0.22), right - left, 0.2, facecolor=owner, edgecolor=GREY, alpha=0.8))


def _camera(axes: Axes, pixel: float) -> None:
    ground = np.array([pixel, float(terrain(np.array([pixel]))[0])])
    scale = 0.86
    # Image plane below the projection centre, as in a positive image.
    left, right = (CENTRE + (1 - scale) * (np.array([e, 1.6]) - CENTRE) for e in (1.27, 8.6))
    axes.plot([left[0], right[0]], [left[1], right[1]], color=GREEN, linewidth=2.2)
    for end in (1.27, 8.6):
        axes.plot(
            [CENTRE[0], end], [CENTRE[1], float(terrain(np.array([end]))[0])], color=GREY, linewidth=0.7, linestyle=":"
        )
    axes.plot([CENTRE[0], ground[0]], [CENTRE[1], ground[1]], color=RED, linewidth=1.3)
    axes.plot([pixel, pixel], [0.3, ground[1]], color=RED, linewidth=1.3, linestyle="--")
    axes.plot(*ground, "o", color=RED, markersize=5, zorder=5)
    t = (CENTRE[1] - left[1]) / (CENTRE[1] - ground[1])
    hit = CENTRE + t * (ground - CENTRE)
    axes.plot(*hit, "o", color=RED, markersize=5, zorder=5)
    axes.plot(*CENTRE, "^", color=GREEN, markersize=9)
    axes.annotate("(x, y)", hit, (7, 5), textcoords="offset points", color=RED)
    axes.annotate("h", (pixel, 0.95), (4, 0), textcoords="offset points", color=RED)
    axes.annotate("(u, v)", (pixel, 0.3), (5, 6), textcoords="offset points", color=RED)


def _label(axes: Axes, y: float, colour: str, word: str, text: str) -> None:
    axes.text(9.25, y, word, color=colour, fontweight="bold", va="top")
    axes.text(9.25, y - 0.36, text, va="top", linespacing=1.25)


def draw_idea() -> Figure:
    """A vertical section through one tile and its source image."""
    fig = Figure(figsize=(9.4, 5.4), dpi=130)
    axes = fig.add_axes((0.01, 0.01, 0.98, 0.98))
    axes.set(xlim=(0.2, 13.9), ylim=(-0.4, 8.15), aspect="equal")
    axes.axis("off")
    _section(axes)
    _camera(axes, 7.43)
    _label(axes, 8.0, GREEN, "Camera", "strict collinearity, lens, curvature;\nasked for the anchors only")
    _label(
        axes,
        6.35,
        BLUE,
        "Anchors",
        "eight corners of a box in (u, v, h), kept as\n(x·w, y·w, w); inside, linear interpolation\nand one division",
    )
    _label(
        axes,
        4.35,
        "#8a6d3b",
        "Relief",
        "a height h for every pixel: breaklines and\nwalls stay sharp, nothing is interpolated\nbetween anchors",
    )
    _label(axes, 2.35, "black", "Target", "the product's own grid, pixel (u, v)")
    _label(axes, 1.1, GREY, "Owner", "which image paints the pixel (the strip\nbelow the grid); none: it stays nodata")
    return fig
