"""Report of resections: orientation, residuals and a picture of them for every image."""

from __future__ import annotations

from typing import Any

import numpy as np

from photoplan.products.film import ResectedImage, ResectResult
from photoplan.report.drawing import BLUE, INK, RED, SOFT, axes_of, png, round_down, shortened, styled
from photoplan.report.page import Cell, cells, figure, headline, number, page, section, table, text

_WIDTH = 6.2
#: Names that are written into a picture.
_NAMED = 60
#: Images that get a picture.
_PICTURES = 60


@styled
def draw_residuals(image: ResectedImage) -> tuple[bytes, float]:
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
        picture, scale = draw_residuals(image)
        caption = f"Residuals (computed minus measured) enlarged {scale:g} times at the measured positions."
        parts.append(figure(picture, f"Residuals of {name}", caption))
    head = ("point", "column", "row", "v column px", "v row px", "norm. column", "norm. row", "controlled")
    rows = [cells(row, 1) for row in _orientation(image)]
    return section(name, [*parts, table(("parameter", "value", "standard deviation"), rows), table(head, points)])


def _orientation(image: ResectedImage) -> list[tuple[str, ...]]:
    """Return name, value and standard deviation of each parameter."""
    return [(e.name, *(f"{text} {e.unit}" for text in e.texts)) for group in image.estimates for e in group]
