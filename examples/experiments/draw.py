"""Draws the figures of the experiment pages: ``python examples/experiments/draw.py docs/figures``."""

from __future__ import annotations

import sys
from pathlib import Path

import anchor_interpolation as anchors
import anchor_residual as residual
import matplotlib as mpl
import numpy as np
import resampling_kernels as kernels
from draw_idea import draw_idea
from draw_marks import draw_marks
from draw_prediction import draw_prediction
from draw_road import draw_road
from draw_strip import draw_strip
from draw_true import draw_true
from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = ["#777777", "#4477aa", "#228833", "#cc3311", "#aa3377"]
STYLE = {
    "font.size": 9,
    "axes.grid": True,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.6,
    "axes.axisbelow": True,
}


def figure(columns: int, width: float = 9.0, height: float = 3.7) -> tuple[Figure, list[Axes]]:
    """A figure without a window, with a row of axes."""
    fig = Figure(figsize=(width, height), dpi=130, layout="constrained")
    return fig, list(np.atleast_1d(fig.subplots(1, columns)))


def draw_anchor_interpolation(steps: int = 61) -> Figure:
    """Behr figs. 5.15 and 5.16, and Ecker fig. 4.23, recomputed."""
    fig, (mean, largest, ecker) = figure(3, 10.5)
    distances = np.linspace(0, 1500, steps)
    for slope, colour in zip((15.0, 30.0, 45.0), COLOURS[1:]):
        m, x = anchors.deviation_by_distance(distances, slope)
        for axes, y in ((mean, m), (largest, x)):
            axes.plot(distances, y, color=colour)
            axes.annotate(
                f"{slope:.0f}°", (distances[-1], y[-1]), (4, 0), textcoords="offset points", va="center", color=colour
            )
    for axes, title in ((mean, "mean deviation (Behr fig. 5.15)"), (largest, "largest deviation (Behr fig. 5.16)")):
        axes.set(title=title, xlabel="mesh to nadir, m", ylabel="µm in the image", ylim=(0, 46), xlim=(0, 1600))
    mean.plot([1300], [anchors.TABLE_5_6[50.0]], "o", mfc="white", mec="black", zorder=5)
    mean.annotate("27 µm printed in table 5.6", (1300, 27), (-6, 8), textcoords="offset points", ha="right")
    side = np.linspace(0, 5, steps)
    for percent, name, colour in ((10, "flat", 1), (50, "steep", 2), (100, "extreme", 3)):
        y = 1e3 * anchors.ecker_displacement(side, percent)
        ecker.plot(side, y, color=COLOURS[colour])
        ecker.annotate(
            f"{percent} %\n{name}", (5, y[-1]), (4, 0), textcoords="offset points", va="center", color=COLOURS[colour]
        )
    ecker.plot([anchors.ECKER_MESH], [anchors.ECKER_PRINTED], "o", mfc="white", mec="black", zorder=5)
    ecker.annotate("42 µm printed", (5, 42), (-8, 0), textcoords="offset points", ha="right", va="center")
    ecker.set(title="displacement ΔM (Ecker fig. 4.23)", xlabel="mesh side Δs in the image, mm", ylabel="ΔM, µm")
    ecker.set(ylim=(0, 46), xlim=(0, 5.8))
    return fig


def draw_homogeneous(steps: int = 13) -> Figure:
    """Both ways over the side of the mesh, in pixels of 15 µm."""
    fig, (axes,) = figure(1, 6.2, 3.9)
    t = anchors.SAMPLINGS[anchors.PIXEL_CENTRES]
    sides = np.geomspace(3.125, 400, steps)
    meshes = [anchors.Mesh(1300.0, float(s), 45.0) for s in sides]
    classical = [anchors.classical_deviation(m, t).max() / anchors.PIXEL for m in meshes]
    rough = np.random.default_rng(1).uniform(-10, 10, (11, 11))
    plane = [max(anchors.homogeneous_deviation(m, t).max() / anchors.PIXEL, 1e-13) for m in meshes]
    relief = [max(anchors.homogeneous_deviation(m, t, rough).max() / anchors.PIXEL, 1e-13) for m in meshes]
    axes.loglog(sides, classical, color=COLOURS[3], label="image coordinates, bilinear (plane)")
    axes.loglog(sides, relief, color=COLOURS[2], label="homogeneous, relief rough by ±10 m")
    axes.loglog(sides, plane, color=COLOURS[1], label="homogeneous, plane")
    axes.set(xlabel="mesh side, m", ylabel="largest deviation, pixels of 15 µm", ylim=(1e-13, 1e3))
    axes.legend(loc="center right", bbox_to_anchor=(1.0, 0.56))
    return fig


def draw_kernels(steps: int = 201) -> Figure:
    """Deviation from a ramp, half-level shift of an edge, transfer of contrast."""
    fig, (ramp, shift, contrast) = figure(3, 10.5, 4.1)
    t = np.linspace(0, 1, steps)
    positions = np.linspace(0, 1, max(steps // 4, 11))
    frequency = np.linspace(0, 1, steps)
    for (name, _), colour in zip(kernels.KERNELS.items(), COLOURS):
        if name == "nearest":
            ramp.plot([0, 0.11], [0, -0.11], color=colour)
            ramp.plot([0.89, 1], [0.11, 0], color=colour)
            shift.plot([0.39, 0.5, 0.5, 0.61], [0.11, 0, 0, -0.11], color=colour, label=name)
        else:
            ramp.plot(t[:-1], kernels.ramp_deviation(name, t[:-1]), color=colour)
            y = [kernels.half_level_shift(name, float(p)) for p in positions]
            shift.plot(positions, y, color=colour, label=name)
        contrast.plot(frequency, kernels.transfer(name, frequency), color=colour)
    ramp.annotate("nearest:\nto ±0.5", (0.1, -0.1), (4, 2), textcoords="offset points", color=COLOURS[0])
    ramp.annotate("bilinear and\na = −0.5: zero", (0.52, 0.035), color=COLOURS[2])
    ramp.set(title="value on a ramp g(x) = x, minus x", xlabel="phase t", ylabel="pixels", ylim=(-0.11, 0.11))
    shift.set(title="half height of an edge, minus its place", xlabel="place of the edge between two pixels")
    shift.set(ylabel="pixels", ylim=(-0.11, 0.11))
    contrast.axvline(0.5, color="#999999", linewidth=0.8, linestyle=":")
    contrast.annotate("Nyquist", (0.5, 1.08), (3, 0), textcoords="offset points", color="#666666")
    contrast.axhline(0, color="#999999", linewidth=0.8)
    contrast.set(
        title="contrast after resampling", xlabel="frequency, cycles per pixel", ylim=(-0.25, 1.15), xlim=(0, 1)
    )
    fig.legend(*shift.get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return fig


def draw_residual(samples: int = 9, steps: int = 9) -> Figure:
    """Residual of homogeneous anchors with a distorted lens."""
    fig, (plan, depth) = figure(2, 8.6)
    sides = np.geomspace(8, 256, steps)
    for height, colour in ((0.0, 1), (5.0, 2), (20.0, 3)):
        y = [residual.worst_residual(float(s), height, samples) for s in sides]
        plan.loglog(sides, y, color=COLOURS[colour], label=f"{height:.0f} m of relief in the cell", base=2)
    plan.set(title="over the side of the cell", xlabel="side, pixels", ylabel="worst residual, px")
    heights = np.geomspace(1, 100, steps)
    for side, colour in ((8.0, 1), (32.0, 2), (64.0, 3)):
        y = [residual.worst_residual(side, float(h), samples) for h in heights]
        depth.loglog(heights, y, color=COLOURS[colour], label=f"cells of {side:.0f} px")
    depth.set(title="over the height range of the cell", xlabel="height range, m", ylabel="worst residual, px")
    for axes in (plan, depth):
        axes.set_yscale("log", base=10)
        axes.axhline(0.02, color="black", linewidth=0.8, linestyle="--")
        axes.annotate(
            "default tolerance 0.02 px",
            (axes.get_xlim()[0], 0.02),
            (6, -11 if axes is plan else 4),
            textcoords="offset points",
        )
        axes.set_ylim(1e-4, 1)
        axes.legend(loc="lower right")
    plan.set_xticks([8, 16, 32, 64, 128, 256], ["8", "16", "32", "64", "128", "256"])
    return fig


FIGURES = {
    "one-idea": draw_idea,
    "linear-prediction": draw_prediction,
    "anchor-interpolation": draw_anchor_interpolation,
    "homogeneous-anchors": draw_homogeneous,
    "resampling-kernels": draw_kernels,
    "anchor-residual": draw_residual,
    "road-edge": draw_road,
    "marks": draw_marks,
    "true-orthophoto": draw_true,
    "pyramid-strip": draw_strip,
}


def main(folder: Path) -> None:
    """Write every figure as PNG into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, draw in FIGURES.items():
            draw().savefig(folder / f"{name}.png", metadata={"Software": None})
            print(folder / f"{name}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "docs/figures"))
