"""Reports of single orientations: fiducial marks, interior orientation, resection, tie points, registration."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import shortest_path

from photoplan.arrays import Floats, Ints
from photoplan.geometry.grid import Window
from photoplan.io.raster import RasterReader
from photoplan.matching.features import Grey, GreyImage, Tracks, to_bytes
from photoplan.matching.register import APART, FOUND, STATES, TEXTURELESS, UNCERTAIN, UNLIKE
from photoplan.orientation.marks.fiducials import Scan, mark_window
from photoplan.orientation.marks.locate import FiducialResult, LocatedMark, MarkLayout, MissingMark, Template, draw
from photoplan.products.film import (
    FiducialsReport,
    ImageFiducials,
    ImageInterior,
    InteriorResult,
    ResectedImage,
    ResectResult,
    UnfoundFiducials,
)
from photoplan.products.register import RegisterReport
from photoplan.products.tie import TieImage, TieReport
from photoplan.project.camera_marks import ScanImage
from photoplan.report.page import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    SOFT,
    Cell,
    axes_of,
    cells,
    figure,
    figure_of,
    headline,
    number,
    page,
    png,
    round_down,
    section,
    shortened,
    styled,
    table,
    text,
)

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


def _thinned(report: RegisterReport) -> tuple[Floats, Floats]:
    """Mean vectors and places of groups of neighbours, as many as can be seen."""
    found = report.found
    assert found is not None
    side = -(-max(report.shape) // _ARROWS)
    rows, columns = np.divmod(np.arange(len(found.at)), report.shape[1])
    good = found.state == FOUND
    _, group = np.unique((rows // side)[good] * 10_000_000 + (columns // side)[good], return_inverse=True)
    count = np.bincount(group)

    def mean(values: NDArray[Any]) -> Floats:
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


_WIDTH = 6.2
#: Names that are written into a picture.
_NAMED = 60
#: Images that get a picture.
_PICTURES = 60


@styled
def draw_image_residuals(image: ResectedImage) -> tuple[bytes, float]:
    """Draw residual vectors at the measured points; return the factor by which they are enlarged, too."""
    (width, height), found = image.size, image.found
    xy, names = image.points.xy, image.points.names
    used = ~found.rejected & np.isfinite(found.residuals).all(axis=1)
    typical = float(np.linalg.norm(found.residuals[used], axis=1).max(initial=0.0)) or 1e-3
    scale = round_down(0.09 * max(width, height) / typical)
    tall = float(np.clip(_WIDTH * height / width, 2.5, 8.0))
    fig, axes = axes_of(_WIDTH, tall + 0.5)
    for keep, colour, label in ((used, BLUE, "points"), (found.rejected, RED, "gross errors")):
        if not keep.any():
            continue
        axes.scatter(*xy[keep].T, s=14, color=colour, zorder=3, label=label)
    ends = xy + scale * found.residuals
    for k in (int(i) for i in np.flatnonzero(used)):
        arrow = {"arrowstyle": "-|>", "color": BLUE, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
        axes.annotate("", ends[k], xy[k], arrowprops=arrow, annotation_clip=False)
    for k in range(min(len(names), _NAMED)):
        aside = (-4, 5) if found.residuals[k, 0] > 0 else (4, 5)
        side = "right" if aside[0] < 0 else "left"
        colour = RED if found.rejected[k] else INK
        label = shortened(names[k])
        axes.annotate(label, xy[k], aside, textcoords="offset points", fontsize=8, color=colour, ha=side)
    _key(axes, image.size, scale, typical)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xlabel="column px", ylabel="row px")
    axes.set_aspect("equal")
    if found.rejected.any():
        fig.legend(loc="outside upper right", ncols=2)
    return png(fig), scale


def _key(axes: Any, size: tuple[int, int], scale: float, typical: float) -> None:
    """Draw a bar with the length of a residual."""
    length = round_down(typical)
    x, y = 0.03 * size[0], 0.96 * size[1]
    axes.plot([x, x + scale * length], [y, y], color=INK, linewidth=2.2, solid_capstyle="butt", zorder=4)
    label = f"residual of {length:g} px"
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}
    axes.annotate(label, (x, y), (0, 4), textcoords="offset points", fontsize=8, color=SOFT, bbox=box)


def resect_page(made: ResectResult) -> str | None:
    """Return the report as one HTML document."""
    if not made.images:
        return None
    found = [image.found for image in made.images]
    wrong = sum(int(f.rejected.sum()) for f in found)
    used = sum(int((~f.rejected).sum()) for f in found)
    rms = float(np.sqrt(np.mean([f.rms**2 for f in found])))
    parts = [
        headline(
            [
                (str(len(found)), "images oriented", "each by itself"),
                (str(used), "measurements used", f"{wrong} gross errors" if wrong else "no gross errors"),
                (f"{rms:.2f} px", "rms of residuals", "one coordinate"),
            ]
        )
    ]
    parts += [_image(image, k < _PICTURES) for k, image in enumerate(made.images)]
    return page(
        f"Space resection: {made.project.name}", "Exterior orientation of single images by control points", parts
    )


def _image(image: ResectedImage, drawn: bool) -> str:
    found, name = image.found, image.image.name
    points = [
        [
            Cell(point + (" (gross error)" if found.rejected[k] else "")),
            *(
                Cell(number(v, 2), True)
                for v in (*image.points.xy[k], *found.residuals[k], *found.normalised[k], found.redundancies[k].mean())
            ),
        ]
        for k, point in enumerate(image.points.names)
    ]
    parts = [
        f"<p>{int((~found.rejected).sum())} points, redundancy {found.redundancy}, sigma0 {found.sigma0:.3g}, "
        f"rms {found.rms:.3g} px. Standard deviations hold sigma0"
        + (f"; 95 % of the errors lie within {found.reach_95:.2g} of them.</p>" if found.redundancy > 0 else ".</p>")
    ]
    parts += [f"<p>{text(note)}</p>" for note in (*image.gross_errors, *image.notes)]
    if drawn:
        picture, scale = draw_image_residuals(image)
        caption = f"Residuals (computed minus measured) enlarged {scale:g} times at the measured positions."
        parts.append(figure(picture, f"Residuals of {name}", caption))
    head = ("point", "column", "row", "v column px", "v row px", "norm. column", "norm. row", "controlled")
    rows = [cells(row, 1) for row in _orientation(image)]
    return section(name, [*parts, table(("parameter", "value", "standard deviation"), rows), table(head, points)])


def _orientation(image: ResectedImage) -> list[tuple[str, ...]]:
    """Return name, value and standard deviation of each parameter."""
    return [(e.name, *(f"{text} {e.unit}" for text in e.texts)) for group in image.estimates for e in group]


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
def draw_scan_residuals(scans: Sequence[ImageInterior]) -> bytes:
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
    return draw_scan_residuals(made.images) if made.images else None


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
    drawing = figure(draw_scan_residuals(scans), "Residual vectors", caption)
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


_ACROSS = 2
"""Marks in a row."""
_MOST = 200
"""Pixels of a mark's picture along a side; larger ones are thinned."""
_OVERVIEW = 900
"""Pixels of a whole scan's picture along its longer side."""
_AROUND = 1.5
"""Half side of what is shown around a place, in sides of the mark."""
_CROSS, _LOST = "#d81b60", "#b03000"


def draw_marks(report: FiducialsReport) -> dict[Path, bytes]:
    """Draw the marks of all images by the places of their pictures, also where they were searched in vain."""
    found = {image.picture: marks_picture(image) for image in report.images if image.picture is not None}
    return found | {image.picture: unfound_picture(image) for image in report.unfound if image.picture is not None}


def marks_picture(image: ImageFiducials) -> bytes:
    """Draw the marks of an image; the scan is opened again."""
    found, scan = image.found, ScanImage(image.file, image.band)
    marks: list[LocatedMark | MissingMark] = [*found.marks, *found.missing]
    across = min(_ACROSS, len(marks))
    down = math.ceil(len(marks) / across)
    figure = figure_of(4.6 * across, 0.6 + 3.0 * down)
    figure.suptitle(image.name, fontsize=11)
    panels = figure.subplots(down, 2 * across, squeeze=False).ravel()
    for panel in panels:
        panel.set_axis_off()
    for k, mark in enumerate(marks):
        _panels(panels[2 * k : 2 * k + 2], scan, image.layout, found, mark)
    return png(figure, dpi=110)


def unfound_picture(image: UnfoundFiducials) -> bytes:
    """Draw a scan on which marks were not found: places that were searched, enlarged, next to what was searched."""
    scan, layout, sought = ScanImage(image.file, image.band), image.layout, image.sought
    px_per_mm = float(np.ptp([(m.x, m.y) for m in sought], axis=0).max()) / layout.extent
    rows = max(2, len(sought))
    figure = figure_of(9.5, 0.6 + 1.9 * rows)
    figure.suptitle(f"{image.name}: {sum(m.found for m in sought)} of {len(sought)} marks found, three are needed")
    left, right = figure.subfigures(1, 2, width_ratios=(1.3, 1))
    overview, panels = left.subplots(), right.subplots(rows, 2, squeeze=False)
    factor = max(1, max(scan.size) // _OVERVIEW)
    whole = Window(0, 0, *(side // factor * factor for side in scan.size))
    box = (-0.5, whole.width - 0.5, whole.height - 0.5, -0.5)
    overview.imshow(scan.grey(whole, factor), cmap="gray", extent=box, interpolation="nearest")
    overview.set_title("circles: found; squares: expected here, not found", loc="left", fontsize=8)
    for panel in panels.ravel():
        panel.set_axis_off()
    for (place, side), mark in zip(panels, sought):
        colour = _CROSS if mark.found else _LOST
        overview.plot(mark.x, mark.y, "o" if mark.found else "s", mfc="none", mec=colour, ms=14)
        overview.annotate(mark.name, (mark.x, mark.y), xytext=(9, 6), textcoords="offset points", color=colour)
        template = draw(layout.patterns[layout.names.index(mark.name)], np.diag([px_per_mm, -px_per_mm]))
        reach = math.ceil(_AROUND * max(template.values.shape))
        said = "" if math.isnan(mark.correlation) else f", best correlation {mark.correlation:.2f}"
        _show_place(place, scan, (mark.x, mark.y), (reach, reach))
        place.set_title(f"{mark.name}   {'found' if mark.found else 'not found'}{said}", loc="left", fontsize=8)
        _show_template(side, template, (reach - template.reference[0], reach - template.reference[1]))
        side.set_xlim(-0.5, 2 * reach + 0.5)
        side.set_ylim(2 * reach + 0.5, -0.5)
        side.set_title("what was sought", loc="left", fontsize=8)
    return png(figure, dpi=110)


def _show_place(
    panel: Any, scan: Scan, xy: tuple[float, float], half: tuple[int, int]
) -> tuple[float, float, float, float]:
    """Show the scan around a place; the box that is shown."""
    grey, col, row = mark_window(scan, xy, half)
    thin = max(1, max(grey.shape) // _MOST)
    box = (col - 0.5, col + grey.shape[1] - 0.5, row + grey.shape[0] - 0.5, row - 0.5)
    panel.imshow(grey[::thin, ::thin], cmap="gray", extent=box, interpolation="nearest")
    return box


def _show_template(panel: Any, template: Template, corner: tuple[float, float]) -> None:
    """Show what is compared, with the centre of its first pixel at `corner`."""
    (a, b), (x, y) = template.values.shape, corner
    shown = np.where(template.weights > 0, template.values, np.nan)
    box = (x - 0.5, x + b - 0.5, y + a - 0.5, y - 0.5)
    panel.imshow(shown, cmap="gray", vmin=0, vmax=1, extent=box, interpolation="nearest")
    panel.set_aspect("equal")


def _panels(
    panels: Any, scan: Scan, layout: MarkLayout, found: FiducialResult, mark: LocatedMark | MissingMark
) -> None:
    """Draw one mark: the scan, and what was searched there."""
    pattern = layout.patterns[layout.names.index(mark.name)]
    matrix = found.fit.transformation.derivative(np.zeros(2))
    template = draw(pattern, matrix, negative=found.negative, blur_px=found.blur_px)
    a, b = template.values.shape
    rx, ry = template.reference
    across, down = (math.ceil(1.15 * max(r, s - 1 - r)) + 3 for r, s in ((rx, b), (ry, a)))
    image, side = panels
    box = _show_place(image, scan, (mark.x, mark.y), (across, down))
    _show_template(side, template, (mark.x - rx, mark.y - ry))
    side.set_xlim(box[0], box[1])
    side.set_ylim(box[2], box[3])
    for panel in panels:
        panel.axhline(mark.y, color=_CROSS, linewidth=0.6)
        panel.axvline(mark.x, color=_CROSS, linewidth=0.6)
    if isinstance(mark, LocatedMark):
        image.set_title(
            f"{mark.name}   {mark.x:.2f}  {mark.y:.2f}\ncorrelation {mark.correlation:.3f}", loc="left", fontsize=8
        )
        side.set_title(f"σ {mark.sigma_x:.3f}  {mark.sigma_y:.3f} px\n{mark.method}", loc="left", fontsize=8)
    else:
        best = "" if math.isnan(mark.correlation) else f"best {mark.correlation:.2f}"
        image.set_title(f"{mark.name}   not found\n{best}", loc="left", fontsize=8, color=_LOST)


#: Colours of points in two, three, four, and five or more images.
RAY_COLOURS = {2: ORANGE, 3: SKY, 4: BLUE, 5: GREEN}
_NAMES = 60
#: Longest side of the small copies, pixels.
_TIE_SIDE = 700


@styled
def draw_ties(report: TieReport) -> bytes | None:
    """Draw network and views; images are read again for small copies."""
    images, tracks = report.sources, report.found
    if tracks is None:
        return None
    points = np.bincount(tracks.image, minlength=len(images))
    shown = _spread(points)
    rows = -(-len(shown) // 2)
    fig = figure_of(9.0, 6.2 + 2.8 * rows)
    grid = fig.add_gridspec(rows + 1, 2, height_ratios=[6.0, *([2.8] * rows)])
    _network(fig.add_subplot(grid[0, :]), images, tracks, points)
    for k, which in enumerate(shown):
        _view(fig.add_subplot(grid[1 + k // 2, k % 2]), images[which], tracks, which)
    return png(fig)


def _network(axes: Any, images: Sequence[TieImage], tracks: Tracks, points: Ints) -> None:
    joined, common = _common(tracks)
    positions = [image.position for image in images if image.position is not None]
    on_map = len(positions) == len(images)
    place = np.array(positions)[:, :2] if on_map else _places(len(images), joined, common)
    most = max(1, int(common.max(initial=1)))
    for k in np.argsort(common, kind="stable"):
        part = common[k] / most
        axes.plot(*place[joined[k]].T, color=BLUE, linewidth=0.3 + 4.0 * part, alpha=0.25 + 0.6 * part, zorder=1)
    alone = points == 0
    axes.scatter(*place[~alone].T, s=26, color=INK, zorder=2)
    if alone.any():
        axes.scatter(*place[alone].T, s=60, color=RED, marker="x", zorder=3, label="without connection")
        axes.legend(loc="upper right")
    if len(images) <= _NAMES:
        for image, at in zip(images, place):
            axes.annotate(image.name, at, (4, 4), textcoords="offset points", fontsize=7, color=INK)
    where = "by position on the map" if on_map else "by what they have in common"
    axes.set_title(f"Images, {where}; lines: common points, the widest {most}")
    axes.set_aspect("equal", adjustable="datalim")
    axes.ticklabel_format(useOffset=False, style="plain")
    if on_map:
        axes.set(xlabel="X, m", ylabel="Y, m")
    else:
        axes.set(xticks=[], yticks=[])


def _view(axes: Any, image: TieImage, tracks: Tracks, which: int) -> None:
    grey, factor = _reduced(image)
    here = tracks.image == which
    xy, rays = tracks.xy[here], tracks.rays[tracks.track[here]]
    edges = -0.5, grey.shape[1] * factor - 0.5, grey.shape[0] * factor - 0.5, -0.5
    axes.imshow(grey, cmap="gray", vmin=-40, vmax=295, interpolation="nearest", extent=edges)
    for many, colour in RAY_COLOURS.items():
        some = rays == many if many < 5 else rays >= 5
        label = f"{many} images" if many < 5 else "5 or more"
        if some.any():
            axes.scatter(*xy[some].T, s=7, color=colour, label=label, linewidths=0)
    axes.set(xlabel="column, px", ylabel="row, px")
    axes.grid(False)
    axes.set_title(f"{image.name}: {len(xy)} points", color=SOFT)
    if len(xy):
        axes.legend(loc="lower left", fontsize=6, markerscale=1.8, frameon=True)


def _spread(points: Ints, most: int = 4) -> list[int]:
    """Choose images to show, spread over those that have points."""
    some = np.flatnonzero(points)
    return sorted({int(some[int(i)]) for i in np.linspace(0, some.size - 1, min(most, some.size))})


def _common(tracks: Tracks) -> tuple[Ints, Ints]:
    """Return pairs of images with common tracks, and the number of these."""
    incidence = coo_matrix((np.ones(len(tracks), np.int64), (tracks.image, tracks.track))).tocsr()
    both = (incidence @ incidence.T).tocoo()
    upper = both.row < both.col
    return np.stack([both.row[upper], both.col[upper]], axis=1).astype(np.int64), both.data[upper].astype(np.int64)


def _places(count: int, joined: Ints, common: Ints) -> Floats:
    """Place images in the plane, the closer the more they share (classical scaling of path lengths)."""
    length = 1.0 / np.sqrt(np.maximum(common, 1))
    graph = coo_matrix((length, (joined[:, 0], joined[:, 1])), shape=(count, count)).tocsr()
    distance = shortest_path(graph, directed=False)
    known = distance[np.isfinite(distance)]
    distance = np.where(np.isfinite(distance), distance, 1.3 * known.max(initial=1.0))
    middle = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * middle @ distance**2 @ middle)
    return np.asarray(vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0)))


def _reduced(image: TieImage) -> tuple[NDArray[np.uint8], int]:
    """Read a small copy in strips; return it, and how many pixels along a side are one of it."""
    width, height = image.grey.size
    factor = max(1, -(-max(width, height) // _TIE_SIDE))
    columns, rows = width // factor, height // factor
    strips = [image.grey.reduced(Window(0, row, columns, min(64, rows - row)), factor) for row in range(0, rows, 64)]
    small = np.concatenate(strips)
    known = small[np.isfinite(small)]
    low, high = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    return to_bytes(small, float(low), float(max(high, low + 1))), factor
