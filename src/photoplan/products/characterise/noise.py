"""Noise against grey value: the form of Behr 1989, table 4.2."""

from __future__ import annotations

from math import sqrt

import numpy as np

from photoplan.products.characterise.common import prefix
from photoplan.products.characterise.data import SeriesData
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.frame_statistics import Level

#: What stands still: between frames of other kinds the scene or its brightness changes.
_KINDS = ("dark", "flat", "scene", "wedge", "drift")


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    if any(len(setting.frames) >= 2 for setting in data.settings(*_KINDS)):
        return None
    return "no setting has two frames or more; noise is what changes between them"


def analyse(data: SeriesData) -> Findings:
    """Mean grey value and temporal standard deviation of every setting, by plane."""
    settings = [setting for setting in data.settings(*_KINDS) if len(setting.frames) >= 2]
    levels = [(setting.label, data.levels(setting)) for setting in settings]
    return joined(
        [_plane(data, plane.name, [(label, level[plane.name]) for label, level in levels]) for plane in data.planes]
    )


def _plane(data: SeriesData, name: str, levels: list[tuple[str, Level]]) -> Findings:
    ordered = sorted(levels, key=lambda item: item[1].mean)
    rows, refused = [], {}
    for label, level in ordered:
        sigma = sqrt(level.temporal_variance)
        of_sigma = level.variance_sigma / (2 * sigma) if sigma > 0 else 0.0
        if not np.isfinite(sigma):
            continue
        sound = sigma > 0 and level.zero_share <= 0.005 and level.saturated_share <= 0.005
        rows.append((name, level.mean, sigma, of_sigma, level.frames, level.pixels, "yes" if sound else "no", label))
    sound_rows = [row for row in rows if row[6] == "yes"]
    figures = []
    if sound_rows:
        least = min(sound_rows, key=lambda row: row[2])
        most = max(sound_rows, key=lambda row: row[2])
        figures = [
            Figure("least_noise_dn", least[2], least[3], "smallest noise", "DN", name, f"mean {least[1]:.4g} DN"),
            Figure("largest_noise_dn", most[2], most[3], "largest noise", "DN", name, f"mean {most[1]:.4g} DN"),
        ]
    else:
        refused[prefix("noise", name)] = (
            "every level is cut off at black or saturated or has no noise at all, so that its noise is not the sensor's"
        )
    head = ("plane", "mean_dn", "sigma_dn", "sigma_of_sigma_dn", "frames", "pixels", "not_clipped", "setting")
    x = np.array([row[1] for row in sound_rows])
    rounding = data.step / sqrt(12)  # Behr 1989, eq. 3.14
    chart = Chart(
        f"Noise against grey value{f' {name}' if name else ''}",
        f"Standard deviation of a pixel between frames; the dashed line is rounding alone ({rounding:.3g} DN).",
        "mean grey value DN",
        "noise DN",
        (
            Trace(
                x, np.array([row[2] for row in sound_rows]), "measured", sigma=np.array([row[3] for row in sound_rows])
            ),
            Trace(
                np.array([x.min(), x.max()]) if x.size else x,
                np.full(min(2, 2 * x.size), rounding),
                "rounding",
                "dashed",
            ),
        ),
    )
    caption = "Mean grey value and standard deviation of a pixel (Behr 1989, table 4.2)"
    return Findings(
        tuple(figures),
        refused,
        {"levels": Listing(head, tuple(rows), caption)},
        (chart,) if len(sound_rows) > 1 else (),
    )
