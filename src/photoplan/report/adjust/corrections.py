"""Images without poses in the report of an adjustment: their corrections, and residuals of strips over time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from photoplan.products.adjust.figures import CorrectionFigures
from photoplan.report.adjust.tables import Row, cell, number, paragraph, plain
from photoplan.report.drawing import BLUE, GREEN, ORANGE, RED, figure_of, png, styled
from photoplan.report.page import figure, table


def correction_parts(corrections: tuple[CorrectionFigures, ...]) -> list[str]:
    """Residuals and corrections image by image; of strips, over time too."""
    rows: list[Row] = []
    for image in corrections:
        row: Row = [image.name, image.group, cell(number(image.measurements)), cell(number(image.rejected))]
        row += [cell(plain(v, 3, True)) for v in image.mean]
        row += [cell(plain(v, 2)) for v in (*image.rms, image.worst)]
        found = (f"{p.name} {p.value:+.4g} ± {p.sigma:.2g} {p.unit}" for p in image.parameters)
        rows.append([*row, "; ".join(found)])
    head = ["image", "geometry", "points", "out", "mean x", "y px", "rms x", "y px", "worst", "correction"]
    parts = [
        paragraph(
            "Images whose geometry comes with them, and what it is off by, with standard deviations. Shifts of "
            "polynomials are those in the middle of the image; what changes by row or column is what it has become at "
            "the last one."
        ),
        table(head, rows),
    ]
    for image in corrections:
        if len(image.seconds):
            parts.append(
                figure(
                    _over_time(image),
                    f"{image.name} over time",
                    "Residuals of the image points at the moment of their line, and the corrections of the trajectory. "
                    "A wave that is left in the residuals asks for knots that are closer together.",
                )
            )
        if image.angles is not None:
            parts.append(
                figure(
                    _angles_of(image.angles),
                    f"{image.name}: angles of the flight",
                    "Angles of the camera at the moments of its lines, as adjusted (Schlüter 2001, fig. 4b). Lines "
                    "that are shaken have angles of their own.",
                )
            )
    return parts


@styled
def _angles_of(angles: tuple[NDArray[np.float64], NDArray[np.float64]]) -> bytes:
    fig = figure_of(7.2, 4.6)
    panels = fig.subplots(3, 1, sharex=True)
    for axes, name, colour, values in zip(panels, ("ω °", "φ °", "κ °"), (BLUE, GREEN, RED), angles[1].T):
        axes.plot(angles[0], np.degrees(np.unwrap(values)), color=colour, linewidth=0.8)
        axes.set_ylabel(name)
    panels[-1].set_xlabel("seconds of the flight")
    return png(fig)


@styled
def _over_time(image: CorrectionFigures) -> bytes:
    count = 1 if image.over_time is None else 3
    fig = figure_of(7.2, 1.2 + 1.5 * count)
    panels = np.atleast_1d(fig.subplots(count, 1, sharex=True))
    for k, (name, colour) in enumerate((("across (columns)", BLUE), ("along (rows)", ORANGE))):
        panels[0].scatter(image.seconds, image.residuals[:, k], s=6, color=colour, linewidths=0, label=name)
    panels[0].set_ylabel("residual px")
    panels[0].legend(loc="upper right", fontsize=8, ncols=2)
    if image.over_time is not None:
        t, values = image.over_time
        kinds = (("position m", values[:, :3], ("east", "north", "up")),
                 ("attitude °", np.degrees(values[:, 3:]), ("about x", "about y", "about z")))  # fmt: skip
        for axes, (label, rows, names) in zip(panels[1:], kinds):
            for column, name, colour in zip(rows.T, names, (BLUE, GREEN, RED)):
                axes.plot(t, column, color=colour, marker=".", linewidth=1.0, label=name)
            axes.set_ylabel(label)
            axes.legend(loc="upper right", fontsize=8, ncols=3)
    panels[-1].set_xlabel("seconds of the flight")
    return png(fig)
