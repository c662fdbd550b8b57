"""Photon transfer of a series: gain, read noise and full well of each plane."""

from __future__ import annotations

import numpy as np

from photoplan.io.series.pixels import Plane
from photoplan.io.series.statistics import ReducedPoint
from photoplan.products.characterise.common import dark_levels, prefix, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Trace, joined
from photoplan.quality.camera.frame_statistics import Level
from photoplan.quality.camera.photon_transfer import PhotonTransfer, photon_transfer

_LEAST = 3


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    pairs = [setting for setting in data.settings("flat") if len(setting.frames) >= 2]
    reduced = len(data.series.reduced_of("flat"))
    if max(len(pairs), reduced) >= _LEAST:
        return None
    single = len(data.settings("flat")) - len(pairs)
    more = f" ({single} have a single frame)" if single else ""
    return f"{len(pairs)} settings with two flat frames or more{more}; photon transfer needs {_LEAST} of different mean"


def analyse(data: SeriesData) -> Findings:
    """Gain, read noise and full well with sigmas, of every plane."""
    if data.series.reduced_of("flat"):
        bright = [reduced_level(data, point) for point in data.series.reduced_of("flat")]
        dark = sorted(data.series.reduced_of("dark"), key=lambda point: point.exposure_ms or 0.0)
        levels = [reduced_level(data, point) for point in dark]
        return tried("gain", lambda: _plane("", bright, (levels, [p.exposure_ms or 0.0 for p in dark]), data))
    flats = [setting for setting in data.settings("flat") if len(setting.frames) >= 2]
    return joined([_of_frames(data, plane, flats) for plane in data.planes])


def _of_frames(data: SeriesData, plane: Plane, flats: list[Setting]) -> Findings:
    bright, dark = [data.levels(setting)[plane.name] for setting in flats], dark_levels(data, plane, flats[0])
    return tried(prefix("gain", plane.name), lambda: _plane(plane.name, bright, dark, data))


def reduced_level(data: SeriesData, point: ReducedPoint) -> Level:
    """A reduced figure as a level; from a mean of 99.9 % of saturation on, samples are clipped."""
    clipped = 1.0 if point.mean > 0.999 * data.series.saturation_dn else 0.0
    return Level(
        frames=point.frames,
        pixels=point.pixels,
        mean=point.mean,
        temporal_variance=point.variance,
        spatial_variance=float("nan"),
        frame_mean_sigma=0.0,
        saturated_share=clipped,
        zero_share=0.0,
        largest=point.mean,
        smallest=point.mean,
    )


def _plane(name: str, bright: list[Level], dark: tuple[list[Level], list[float]], data: SeriesData) -> Findings:
    black = data.series.camera.black_level_dn
    stated = "black_level_dn" in data.series.camera.model_fields_set
    found = photon_transfer(bright, *dark, black if stated else float("nan"), data.step)
    figures = [
        Figure("gain_dn_e", found.gain, found.gain_sigma, "system gain K", "DN/e", name),
        Figure(
            "conversion_e_dn",
            1 / found.gain,
            found.gain_sigma / found.gain**2,
            "electrons per grey value",
            "e/DN",
            name,
        ),
    ]
    refused: dict[str, str] = {}
    if found.read_noise_refused:
        refused[prefix("read noise", name)] = found.read_noise_refused
    else:
        figures += [
            Figure("read_noise_dn", found.read_noise_dn, found.read_noise_dn_sigma, "read noise", "DN", name),
            Figure("read_noise_e", found.read_noise_e, found.read_noise_e_sigma, "read noise", "e", name),
        ]
    if np.isfinite(found.full_well_e):
        figures += [
            Figure(
                "full_well_dn",
                found.full_well_dn,
                found.full_well_dn_sigma,
                "signal at the peak of variance",
                "DN",
                name,
            ),
            Figure("full_well_e", found.full_well_e, found.full_well_e_sigma, "full well", "e", name),
        ]
    else:
        refused[prefix("full well", name)] = "the variance does not fall again: saturation was not reached"
    rows = tuple(
        (name, m, v, int(u)) for m, v, u in zip(found.mean.tolist(), found.variance.tolist(), found.used.tolist())
    )
    return Findings(
        tuple(figures),
        refused,
        {
            "levels": Listing(
                ("plane", "mean_dn", "variance_dn2", "used"), rows, "Levels and whether the line uses them"
            )
        },
        _plots(found, name, data.step),
        details={f"photon_transfer{name and f'_{name}'}": found},
    )


def _plots(found: PhotonTransfer, name: str, step: float) -> tuple[Chart, ...]:
    """Logarithmic and linear."""
    title = f"Photon transfer{f' {name}' if name else ''}"
    bias = found.bias_dn if np.isfinite(found.bias_dn) else 0.0
    signal = found.mean - bias
    rest = ~found.used
    least = max(0.1 * step, 1e-5 * float(signal.max()))
    seen = (signal > least) & (found.variance > 0)
    grid = np.geomspace(max(float(signal[seen].min()), least), float(signal.max()), 100)
    curves = [Trace(signal[found.used], found.variance[found.used], "used", colour=0)]
    if rest.any():
        curves.append(Trace(signal[rest], found.variance[rest], "not used", colour=3))
    line = Trace(grid, found.line.at(grid + bias), "line", "dashed", colour=1)
    log = [
        Trace(signal[k], np.sqrt(found.variance[k]), label, colour=c)
        for k, label, c in ((found.used & seen, "used", 0), (rest & seen, "not used", 3))
        if k.any()
    ]
    model = Trace(
        grid,
        np.sqrt(np.maximum(found.line.at(grid + bias), 1e-9 * step**2)),
        "√(read² + K · signal)",
        "dashed",
        colour=1,
    )
    caption = f"Slope K = {found.gain:.4g} ± {found.gain_sigma:.2g} DN/e; each point is a level of two frames or more."
    return (
        Chart(f"{title}: variance", caption, "signal DN", "temporal variance DN²", (*curves, line)),
        Chart(
            f"{title}: noise, logarithmic",
            "Read noise to the left, shot noise with slope one half, collapse at full well to the right.",
            "signal DN",
            "temporal noise DN",
            (*log, model),
            log_x=True,
            log_y=True,
        ),
    )
