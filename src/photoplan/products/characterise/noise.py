"""Noise against grey value: the form of Behr 1989, table 4.2."""

from __future__ import annotations

from math import sqrt

import numpy as np

from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined
from photoplan.products.characterise.data import SeriesData
from photoplan.quality.camera.sensor import Level

#: What stands still: between frames of other kinds the scene or its brightness changes.
_KINDS = ("dark", "flat", "scene", "wedge", "drift")


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return (
        None
        if data.settings(*_KINDS, least=2)
        else ("no setting has two frames or more; noise is what changes between them")
    )


def analyse(data: SeriesData) -> Findings:
    """Mean grey value and temporal standard deviation of every setting, by plane."""
    levels = [(setting.label, data.levels(setting)) for setting in data.settings(*_KINDS, least=2)]
    return joined([_plane(data, p.name, [(label, level[p.name]) for label, level in levels]) for p in data.planes])


def _plane(data: SeriesData, name: str, labelled: list[tuple[str, Level]]) -> Findings:
    of = Subject(name)
    ordered = sorted((item for item in labelled if np.isfinite(item[1].temporal_variance)), key=lambda i: i[1].mean)
    levels = [level for _, level in ordered]
    mean, sigma = np.array([level.mean for level in levels]), np.sqrt([level.temporal_variance for level in levels])
    with np.errstate(invalid="ignore"):
        of_sigma = np.where(sigma > 0, [level.variance_sigma for level in levels] / (2 * sigma), 0.0)
    clipped = np.array([max(level.zero_share, level.saturated_share) > 0.005 for level in levels], bool)
    sound = np.flatnonzero((sigma > 0) & ~clipped)
    table = Table.of(
        "Mean grey value and standard deviation of a pixel (Behr 1989, table 4.2)",
        plane=name,
        mean_dn=mean,
        sigma_dn=sigma,
        sigma_of_sigma_dn=of_sigma,
        frames=[level.frames for level in levels],
        pixels=[level.pixels for level in levels],
        not_clipped=["yes" if k in sound else "no" for k in range(len(levels))],
        setting=[label for label, _ in ordered],
    )
    if not sound.size:
        why = (
            "every level is cut off at black or saturated or has no noise at all, so that its noise is not the sensor's"
        )
        return Findings(refused={of.named("noise"): why}, tables={"levels": table})
    ends = zip(("least", "largest"), ("smallest", "largest"), sound[[sigma[sound].argmin(), sigma[sound].argmax()]])
    figures = []
    for name, word, k in ends:
        at = of.under(f"mean {mean[k]:.4g} DN")
        figures.append(at.figure(f"{name}_noise_dn", float(sigma[k]), float(of_sigma[k]), f"{word} noise", "DN"))
    x = mean[sound]
    rounding = data.step / sqrt(12)  # Behr 1989, eq. 3.14
    chart = Chart(
        title=of.named("Noise against grey value"),
        caption=f"Standard deviation of a pixel between frames; the dashed line is rounding alone ({rounding:.3g} DN).",
        x_label="mean grey value DN",
        y_label="noise DN",
        curves=(
            Trace(x, sigma[sound], "measured", sigma=of_sigma[sound]),
            Trace(x[[0, -1]], np.full(2, rounding), "rounding", "dashed"),
        ),
    )
    return Findings(tuple(figures), tables={"levels": table}, plots=(chart,) if x.size > 1 else ())
