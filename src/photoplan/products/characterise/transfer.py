"""Photon transfer of a series: gain, read noise and full well of each plane."""

from __future__ import annotations

import numpy as np

from photoplan.findings import Chart, Findings, Subject, Table, Trace, joined, known, with_sigma
from photoplan.io.series import Plane, ReducedPoint
from photoplan.products.characterise.common import dark_levels, tried, used_and_rest
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.quality.camera.photon_transfer import PhotonTransfer, photon_transfer
from photoplan.quality.camera.sensor import Level

_LEAST = 3


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    pairs = len(data.settings("flat", least=2))
    if max(pairs, len(data.series.reduced_of("flat"))) >= _LEAST:
        return None
    single = len(data.settings("flat")) - pairs
    more = f" ({single} have a single frame)" if single else ""
    return f"{pairs} settings with two flat frames or more{more}; photon transfer needs {_LEAST} of different mean"


def analyse(data: SeriesData) -> Findings:
    """Gain, read noise and full well with sigmas, of every plane."""
    if data.series.reduced_of("flat"):
        bright = [reduced_level(data, point) for point in data.series.reduced_of("flat")]
        dark = sorted(data.series.reduced_of("dark"), key=lambda point: point.exposure_ms or 0.0)
        levels, exposures = [reduced_level(data, point) for point in dark], [p.exposure_ms or 0.0 for p in dark]
        return tried("gain", _plane, "", bright, levels, exposures, data)
    return joined([_of_frames(data, plane, data.settings("flat", least=2)) for plane in data.planes])


def _of_frames(data: SeriesData, plane: Plane, flats: tuple[Setting, ...]) -> Findings:
    bright, dark = [data.levels(setting)[plane.name] for setting in flats], dark_levels(data, plane, flats[0])
    return tried(Subject(plane.name).named("gain"), _plane, plane.name, bright, *dark, data)


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


def _plane(name: str, bright: list[Level], dark: list[Level], exposures: list[float], data: SeriesData) -> Findings:
    f, of = photon_transfer(bright, dark, exposures, data.stated_black, data.step), Subject(name)
    refused = {}
    if f.read_noise_refused:
        refused[of.named("read noise")] = f.read_noise_refused
    if not np.isfinite(f.full_well_e):
        refused[of.named("full well")] = "the variance does not fall again: saturation was not reached"
    figures = known(
        of.figure("gain_dn_e", f.gain, f.gain_sigma, "system gain K", "DN/e"),
        of.figure("conversion_e_dn", 1 / f.gain, f.gain_sigma / f.gain**2, "electrons per grey value", "e/DN"),
        of.figure("read_noise_dn", f.read_noise_dn, f.read_noise_dn_sigma, "read noise", "DN"),
        of.figure("read_noise_e", f.read_noise_e, f.read_noise_e_sigma, "read noise", "e"),
        of.figure("full_well_dn", f.full_well_dn, f.full_well_dn_sigma, "signal of full elements", "DN"),
        of.figure("full_well_e", f.full_well_e, f.full_well_e_sigma, "full well", "e"),
    )
    if f.curve.bend:
        lost, words = f.compression_percent, "signal lost by a response that bends, brightest level used"
        figures += (of.figure("compression_percent", lost, f.compression_percent_sigma, words, "%"),)
    caption = "Levels and whether the line uses them"
    table = Table.of(caption, plane=name, mean_dn=f.mean, variance_dn2=f.variance, used=f.used)
    key = f"photon_transfer{name and f'_{name}'}"
    notes = tuple(f"{name}: {note}".lstrip(": ") for note in f.notes)
    return Findings(
        figures=figures,
        refused=refused,
        tables={"levels": table},
        plots=_plots(f, of, data.step),
        notes=notes,
        details={key: f},
    )


def _plots(found: PhotonTransfer, of: Subject, step: float) -> tuple[Chart, ...]:
    """Logarithmic and linear."""
    title = of.named("Photon transfer")
    bias = found.bias_dn if np.isfinite(found.bias_dn) else 0.0
    signal, variance, used = found.mean - bias, found.variance, found.used
    least = max(0.1 * step, 1e-5 * float(signal.max()))
    seen = (signal > least) & (variance > 0)
    grid = np.geomspace(max(float(signal[seen].min()), least), float(signal.max()), 100)
    of_line = found.curve.at(grid + bias)
    line = Trace(grid, of_line, "parabola" if found.curve.bend else "line", "dashed", colour=1)
    noise = np.sqrt(np.maximum(of_line, 1e-9 * step**2))
    model = Trace(grid, noise, "parabola" if found.curve.bend else "√(read² + K · signal)", "dashed", colour=1)
    log = used_and_rest(signal[seen], np.sqrt(variance[seen]), used[seen])
    caption = (
        f"Slope K = {with_sigma(found.gain, found.gain_sigma, 'DN/e')}; each point is a level of two frames or more."
    )
    points = used_and_rest(signal, variance, used)
    return (
        Chart(
            title=f"{title}: variance",
            caption=caption,
            x_label="signal DN",
            y_label="temporal variance DN²",
            curves=(*points, line),
        ),
        Chart(
            title=f"{title}: noise, logarithmic",
            caption="Read noise to the left, shot noise with slope one half, collapse at full well to the right.",
            x_label="signal DN",
            y_label="temporal noise DN",
            curves=(*log, model),
            log_x=True,
            log_y=True,
        ),
    )
