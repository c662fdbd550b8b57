"""The picture of corrected light: grey values over the light on slopes, before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from photoplan.products.illumination import IlluminationReport
from photoplan.report.drawing import BLUE, GREEN, INK, ORANGE, RED, SOFT, figure_of, png, styled

_BANDS = (RED, GREEN, BLUE, ORANGE)
#: Points that are drawn, and classes of cos i of which the mean is.
_POINTS, _CLASSES = 4000, 20


@styled
def draw_light(report: IlluminationReport) -> bytes:
    """A row of plots before, a row after, as PNG."""
    bands = min(len(report.before), len(_BANDS))
    lit = np.flatnonzero(report.sample.lit)
    some = lit[np.linspace(0, len(lit) - 1, min(_POINTS, len(lit))).astype(int)]
    fig = figure_of(1.0 + 3.2 * bands, 5.6)
    axes = fig.subplots(2, bands, sharex=True, sharey="col", squeeze=False)
    rows = zip(("before", "after"), (report.before, report.after), report.correlations, axes)
    for word, values, correlations, row in rows:
        for band, at in enumerate(row):
            _cloud(at, report, values[band], some, band)
            at.set_title(f"Band {band + 1} {word}: correlation {correlations[band]:+.3f}")
    for at in axes[1]:
        at.set_xlabel("cos i: 1 faces the sun")
    axes[0, 0].set_ylabel("grey value")
    axes[1, 0].set_ylabel("grey value")
    return png(fig)


def _cloud(axes: Any, report: IlluminationReport, values: Any, some: Any, band: int) -> None:
    """Pixels on which the sun shines, the means of classes, and the light on level ground."""
    light = report.sample.cos_i[some]
    axes.plot(light, values[some], ".", markersize=1.5, color=_BANDS[band], alpha=0.35)
    edges = np.linspace(0, 1, _CLASSES + 1)
    of = np.digitize(light, edges) - 1
    each = [(light[of == k].mean(), values[some][of == k].mean()) for k in range(_CLASSES) if (of == k).sum() > 5]
    axes.plot(*np.array(each).T, color=INK, linewidth=1.2)
    axes.axvline(report.model.cos_z, color=SOFT, linewidth=0.8, linestyle=":")
    axes.set_xlim(0, 1)
