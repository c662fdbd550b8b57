"""Noise of a camera: photon transfer, noise against grey value, dark signal, fixed pattern, defect elements."""

from __future__ import annotations

from dataclasses import replace
from math import isfinite, isnan, nan, sqrt

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Picture, Subject, Table, Trace, joined, known, shrunk, with_sigma
from photoplan.io.series import Plane, ReducedPoint
from photoplan.plain import plain
from photoplan.products.characterise.data import (
    MOST_SATURATED,
    SeriesData,
    Setting,
    black_of,
    dark_levels,
    dark_like,
    no_pair,
    of_one_temperature,
    tried,
    used_and_rest,
)
from photoplan.quality.camera.photon_transfer import PhotonTransfer, photon_transfer
from photoplan.quality.camera.sensor import (
    DarkCurrent,
    DefectList,
    FrameStack,
    Kind,
    Level,
    PatternVariance,
    Spectrogram,
    check_level,
    cut_off,
    dark_current,
    doubling_temperature,
    find_blinking,
    find_defects,
    find_lines,
    log_histogram,
    pattern_variance,
    prnu_percent,
    signed_root,
    spectrogram,
)

_LEAST_PHOTON_TRANSFER = 3


def missing_for_photon_transfer(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    pairs = len(data.settings("flat", least=2))
    if max(pairs, len(data.series.reduced_of("flat"))) >= _LEAST_PHOTON_TRANSFER:
        return None
    single = len(data.settings("flat")) - pairs
    more = f" ({single} have a single frame)" if single else ""
    enough = f"photon transfer needs {_LEAST_PHOTON_TRANSFER} of different mean"
    return f"{pairs} settings with two flat frames or more{more}; {enough}"


def analyse_photon_transfer(data: SeriesData) -> Findings:
    """Gain, read noise and full well with sigmas, of every plane."""
    if data.series.reduced_of("flat"):
        bright = [reduced_level(data, point) for point in data.series.reduced_of("flat")]
        dark = sorted(data.series.reduced_of("dark"), key=lambda point: point.exposure_ms or 0.0)
        levels, exposures = [reduced_level(data, point) for point in dark], [p.exposure_ms or 0.0 for p in dark]
        return tried("gain", _photon_transfer_of_plane, "", bright, levels, exposures, data)
    return joined([_photon_transfer_of_frames(data, plane, data.settings("flat", least=2)) for plane in data.planes])


def _photon_transfer_of_frames(data: SeriesData, plane: Plane, flats: tuple[Setting, ...]) -> Findings:
    bright, dark = [data.levels(setting)[plane.name] for setting in flats], dark_levels(data, plane, flats[0])
    return tried(Subject(plane.name).named("gain"), _photon_transfer_of_plane, plane.name, bright, *dark, data)


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


def _photon_transfer_of_plane(
    name: str, bright: list[Level], dark: list[Level], exposures: list[float], data: SeriesData
) -> Findings:
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
        plots=_photon_transfer_plots(f, of, data.step),
        notes=notes,
        details={key: f},
    )


def _photon_transfer_plots(found: PhotonTransfer, of: Subject, step: float) -> tuple[Chart, ...]:
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


#: What stands still: between frames of other kinds the scene or its brightness changes.
_KINDS = ("dark", "flat", "scene", "wedge", "drift")


def missing_for_noise(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return (
        None
        if data.settings(*_KINDS, least=2)
        else ("no setting has two frames or more; noise is what changes between them")
    )


def analyse_noise(data: SeriesData) -> Findings:
    """Mean grey value and temporal standard deviation of every setting, by plane."""
    levels = [(setting.label, data.levels(setting)) for setting in data.settings(*_KINDS, least=2)]
    return joined(
        [_noise_of_plane(data, p.name, [(label, level[p.name]) for label, level in levels]) for p in data.planes]
    )


def _noise_of_plane(data: SeriesData, name: str, labelled: list[tuple[str, Level]]) -> Findings:
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


_LEAST_DARK_SIGNAL = 3


def missing_for_dark_signal(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    exposures = {setting.first.exposure_ms for setting in data.settings("dark")} - {None}
    if len(exposures) >= _LEAST_DARK_SIGNAL:
        return None
    return f"dark frames at {len(exposures)} stated exposures; the dark signal needs {_LEAST_DARK_SIGNAL}"


def analyse_dark_signal(data: SeriesData) -> Findings:
    """Dark current of every plane and temperature, and the doubling temperature."""
    return joined([_dark_signal_of_plane(data, plane) for plane in data.planes])


def _dark_signal_of_plane(data: SeriesData, plane: Plane) -> Findings:
    by_temperature: dict[float | None, list[Setting]] = {}
    for setting in data.settings("dark"):
        if setting.first.exposure_ms is not None:
            by_temperature.setdefault(setting.first.temperature_c, []).append(setting)
    outcomes, currents = [], {}
    for temperature, settings in by_temperature.items():
        of = Subject(plane.name, "" if temperature is None else f"{temperature:g} °C")
        settings = sorted(settings, key=lambda s: s.exposure)
        levels = [data.levels(setting)[plane.name] for setting in settings]
        outcomes.append(tried(of.named("dark current"), _current, settings, levels, of))
        current = outcomes[-1].details.get(of.key("dark_current"))
        if temperature is not None and current is not None:
            currents[temperature] = current
    stated = sum(temperature is not None for temperature in by_temperature)
    key = Subject(plane.name).named("doubling temperature")
    return joined([*outcomes, tried(key, _doubling, currents, Subject(plane.name), stated)])


def _current(settings: list[Setting], levels: list[Level], of: Subject) -> Findings:
    exposures = np.array([setting.exposure for setting in settings])
    used = np.array([level.saturated_share <= MOST_SATURATED for level in levels])
    if not used.all() and np.count_nonzero(used) < _LEAST_DARK_SIGNAL:
        raise InputError(
            f"over {100 * MOST_SATURATED:g} % of the samples are saturated from {exposures[~used][0]:g} ms on; take "
            "shorter exposures"
        )
    found = dark_current(exposures[used].tolist(), [level for level, use in zip(levels, used) if use])
    shortest = levels[0]
    noise = sqrt(shortest.temporal_variance)
    of_noise = shortest.variance_sigma / (2 * noise) if noise > 0 else 0.0
    remark = f"with rounding, at {exposures[0]:g} ms"
    figures = (
        of.figure("dark_offset_dn", found.offset_dn, found.offset_dn_sigma, "dark grey value at no exposure", "DN"),
        of.figure("dark_current_dn_s", found.current_dn_s, found.current_dn_s_sigma, "dark current", "DN/s"),
        of.figure("dark_noise_dn", noise, of_noise, "temporal dark noise", "DN", remark),
    )
    means = np.array([level.mean for level in levels])
    table = Table.of(
        "Dark frames",
        plane=of.plane,
        temperature=of.at,
        exposure_ms=exposures,
        mean_dn=means,
        sigma_dn=[level.mean_sigma for level in levels],
        variance_dn2=[level.temporal_variance for level in levels],
        used=["yes" if use else "no" for use in used],
    )
    t = exposures / 1000
    chart = Chart(
        title=of.named("Dark signal"),
        caption=f"Dark current {with_sigma(found.current_dn_s, found.current_dn_s_sigma, 'DN/s')}.",
        x_label="exposure s",
        y_label="mean grey value DN",
        curves=(Trace(t, means, "dark frames"), Trace(t, found.line.at(t), "line", "dashed")),
    )
    return Findings(
        figures,
        tables={"levels": table},
        plots=(chart,),
        notes=tuple(f"{setting.label}: saturated, not used" for setting, use in zip(settings, used) if not use),
        details={of.key("dark_current"): found},
    )


def _doubling(known: dict[float, DarkCurrent], of: Subject, stated: int) -> Findings:
    if stated < 2:
        why = f"the dark frames state {stated} temperatures; two or more are needed (temperature_c)"
        return Findings(refused={"doubling temperature": why})
    if len(known) < 2:
        raise InputError(f"a dark current is known at {len(known)} of {stated} temperatures; two are needed")
    temperatures = sorted(known)
    values = [known[t].current_dn_s for t in temperatures]
    sigmas = [known[t].current_dn_s_sigma for t in temperatures]
    found = doubling_temperature(temperatures, values, sigmas)
    grid = np.linspace(temperatures[0], temperatures[-1], 50)
    model = found.current_at_reference * 2 ** ((grid - found.reference_c) / found.doubling_k)
    chart = Chart(
        title=of.named("Dark current against temperature"),
        caption=f"It doubles every {with_sigma(found.doubling_k, found.doubling_k_sigma, 'K')}.",
        x_label="temperature °C",
        y_label="dark current DN/s",
        curves=(
            Trace(np.array(temperatures), np.array(values), "measured", sigma=np.array(sigmas)),
            Trace(grid, model, "exponential", "dashed"),
        ),
        log_y=True,
    )
    figure = of.figure("doubling_temperature_k", found.doubling_k, found.doubling_k_sigma, "doubling temperature", "K")
    return Findings((figure,), plots=(chart,), details={of.key("doubling"): found})


#: Share of saturation that the standard asks of bright frames.
_HALF = 0.5

missing_for_fixed_pattern = no_pair


def analyse_fixed_pattern(data: SeriesData) -> Findings:
    """DSNU and PRNU of every plane."""
    return joined([_fixed_pattern_of_plane(data, plane) for plane in data.planes])


def _fixed_pattern_of_plane(data: SeriesData, plane: Plane) -> Findings:
    of, outcomes = Subject(plane.name), []
    dark: PatternVariance | None = None
    flat = _half_bright(data, plane)
    setting = _matching_dark(data, flat)
    if setting is not None:
        stack = data.stacks(setting)[plane.name]
        outcomes.append(tried(of.named("DSNU"), _dsnu, stack, plane, setting.label))
        if outcomes[0].figures:
            dark = _variance(stack, filtered=False)
    if flat is None:
        why = "no flat frames, two or more at a setting, between 5 % and 95 % of saturation"
        outcomes.append(Findings(refused={of.named("PRNU"): why}))
    else:
        outcomes.append(tried(of.named("PRNU"), _prnu, data, flat, plane, dark))
    return joined(outcomes)


def _half_bright(data: SeriesData, plane: Plane) -> Setting | None:
    """The flat setting whose mean is nearest to half of saturation."""
    full = data.saturation_dn(plane.name)
    best, distance = None, np.inf
    for setting in data.settings("flat", least=2):
        level = data.levels(setting)[plane.name]
        share = (level.mean - black_of(data, setting, plane).mean) / full if isfinite(full) else _HALF
        if 0.05 <= share <= 0.95 and level.saturated_share < 1e-3 and abs(share - _HALF) < distance:
            best, distance = setting, abs(share - _HALF)
    return best


def _matching_dark(data: SeriesData, flat: Setting | None) -> Setting | None:
    """Dark frames of the same exposure as the flat ones, else those with the most frames, of their temperature."""
    same = None if flat is None else dark_like(data, flat, least=2)
    fit = [s for s in data.settings("dark", least=2) if flat is None or of_one_temperature(s, flat)]
    return same or max(fit, key=lambda s: len(s.frames), default=None)


def _variance(stack: FrameStack, filtered: bool) -> PatternVariance:
    check_level(stack.level)
    if stack.level.saturated_share > 1e-2:
        raise InputError("over 1 % of the samples are saturated, which hides the pattern")
    if stack.counted is not None:
        raise InputError("a mask or brightest is in use; rows and columns need a rectangle: give a roi instead")
    return pattern_variance(stack.mean, stack.level.temporal_variance, stack.level.frames, filtered=filtered)


def _dsnu(stack: FrameStack, plane: Plane, label: str) -> Findings:
    cut = cut_off([stack.level])
    if cut:
        raise InputError(f"{cut}, which hides the pattern; raise the camera's black level")
    found = _variance(stack, filtered=False)
    return joined([_parts(found, ("dsnu", "DSNU", "dn"), plane, 1.0, label), _spectra(stack, plane, "dark")])


def _prnu(data: SeriesData, flat: Setting, plane: Plane, dark: PatternVariance | None) -> Findings:
    stack, of = data.stacks(flat)[plane.name], Subject(plane.name)
    raw = _variance(stack, filtered=False)
    even = _variance(stack, filtered=True)
    black = dark.mean if dark is not None else data.series.camera.black_level_dn
    signal = raw.mean - black
    if signal <= 3 * np.sqrt(stack.level.temporal_variance):
        raise InputError(f"flat frames ({raw.mean:.4g} DN) are not clearly brighter than black ({black:.4g} DN)")
    figures = [
        of.figure(kind, *prnu_percent(found, black if dark is None else dark), "PRNU", "%", remark)
        for kind, found, remark in (
            ("prnu_percent", even, "slow variation of the light taken out"),
            ("prnu_unfiltered_percent", raw, "with the light's unevenness"),
        )
    ]
    notes = () if dark is not None else (f"{of.plane} PRNU: no dark pattern taken out".strip(),)
    parts = _parts(even, ("bright", "bright pattern", "percent"), plane, 100 / signal, flat.label)
    return joined([Findings(tuple(figures), notes=notes), parts, _spectra(stack, plane, "flat")])


def _parts(found: PatternVariance, named: tuple[str, str, str], plane: Plane, factor: float, label: str) -> Findings:
    """Total, rows, columns and pixels of a pattern as figures."""
    (key, words, suffix), of, figures = named, Subject(plane.name), []
    unit = {"dn": "DN", "percent": "%"}[suffix]
    for part in ("total", "row", "column", "pixel"):
        variance = getattr(found, part)
        value, sigma = signed_root(variance, getattr(found, f"{part}_sigma"))
        name, what = (f"{key}_{suffix}", words) if part == "total" else (f"{key}_{part}_{suffix}", f"{words}, {part}s")
        remark = "not above zero" if variance <= 0 else ""
        figures.append(of.figure(name, value * factor, sigma * factor, what, unit, remark))
    return Findings(tuple(figures), details={of.key(key): {**plain(found), "setting": label}})


def _spectra(stack: FrameStack, plane: Plane, what: str) -> Findings:
    """Spectrograms along rows and columns, with frequencies in pixels of the image."""
    of = Subject(plane.name)
    along = {way: _of_image(spectrogram(stack.mean, axis), plane.step) for way, axis in (("rows", 1), ("columns", 0))}
    tables = [
        Table.of(
            "Spectrograms", image=of.named(what), along=way, frequency_cycles_px=s.frequency, amplitude_dn=s.amplitude
        )
        for way, s in along.items()
    ]
    figures = [
        of.figure(f"excess_{what}_{way}", s.excess, nan, f"power over white noise along {way}, {what}", "", _peak(s))
        for way, s in along.items()
    ]
    chart = Chart(
        title=f"Spectrogram, {of.named(what)}",
        caption="Root of the power; white noise is level, peaks are periodic patterns.",
        x_label="frequency cycles/px",
        y_label="amplitude DN",
        curves=tuple(Trace(s.frequency, s.amplitude, f"along {way}", "line") for way, s in along.items()),
        log_y=True,
    )
    parts = [Findings(tables={"spectrograms": table}) for table in tables]
    return joined([Findings(tuple(figures), plots=(chart,)), *parts])


def _of_image(s: Spectrogram, step: int) -> Spectrogram:
    """With frequencies in cycles per pixel of the image, of which a colour has every second one."""
    return replace(s, frequency=s.frequency / step, peak_frequency=s.peak_frequency / step)


def _peak(s: Spectrogram) -> str:
    return f"peak at {s.peak_frequency:.4g} cycles/px" if isfinite(s.peak_frequency) else ""


#: Hot pixels whose growth with the exposure is followed, and whose places are drawn.
_FOLLOWED = 40
#: The strongest hot pixels of the longest exposure, among which the fastest are looked for.
_CANDIDATES = 1000
#: A flat pixel must differ by this part of its surroundings.
_FLAT_SHARE = 0.1

missing_for_defects = no_pair


def analyse_defects(data: SeriesData) -> Findings:
    """Defects of every plane, from the longest dark exposure and from flat frames at half of saturation."""
    return joined([_defects_of_plane(data, plane) for plane in data.planes])


def _defects_of_plane(data: SeriesData, plane: Plane) -> Findings:
    of = Subject(plane.name)
    dark, flat = _dark(data, plane), _flat(data, plane)
    outcomes = []
    for setting, kinds, share in ((dark, ("hot",), 0.0), (flat, ("hot", "dark"), _FLAT_SHARE)):
        if setting is not None:
            key = of.under(setting.label).named("defect elements")
            outcomes.append(tried(key, _setting, data, setting, plane, kinds, share))
    refused = {}
    if flat is None:
        refused[of.named("dark pixels")] = "no flat frames, two or more at a setting, that are not saturated"
    if dark is None:
        refused[of.named("hot pixels")] = "no dark frames, two or more at a setting"
    return joined([*outcomes, Findings(refused=refused)])


def _dark(data: SeriesData, plane: Plane) -> Setting | None:
    """The dark frames with most of them, from half of the longest exposure that is not saturated on; the longest."""
    settings = data.settings("dark", least=2)
    sound = [s for s in settings if data.levels(s)[plane.name].saturated_share <= MOST_SATURATED]
    if not sound:
        return min(settings, key=lambda s: s.exposure, default=None)
    longest = max(s.exposure for s in sound)
    long = [s for s in sound if s.exposure >= longest / 2]
    return max(reversed(long), key=lambda s: (len(s.frames), s.exposure))


def _flat(data: SeriesData, plane: Plane) -> Setting | None:
    """The flat frames with most of them, between 20 % and 80 % of saturation; of those, nearest to its half."""
    half = data.saturation_dn(plane.name) / 2
    levels = [(s, data.levels(s)[plane.name]) for s in data.settings("flat", least=2)]
    away = [(s, abs(level.mean - half)) for s, level in levels if level.saturated_share < 1e-3]
    middle = [each for each in away if each[1] <= 0.6 * half] or away
    return min(middle, key=lambda each: (-len(each[0].frames), each[1]), default=(None, 0.0))[0]


def _setting(data: SeriesData, setting: Setting, plane: Plane, kinds: tuple[Kind, ...], share: float) -> Findings:
    of = Subject(plane.name, setting.label)
    stack = data.stacks(setting)[plane.name]
    level, mean = stack.level, stack.only_counted(stack.mean)
    pixels = find_defects(mean, level.temporal_variance, level.frames, kinds, share, data.step, level.is_cut_off)
    lists = {"pixels": pixels, "lines": find_lines(mean, data.step)}
    refused: dict[str, str] = {}
    try:
        assert stack.variance is not None
        lists["blinking"] = find_blinking(stack.only_counted(stack.variance), level.frames, data.step)
    except InputError as error:
        refused[of.named("blinking pixels")] = str(error)
    remark = f"deviation over {pixels.threshold:.3g} DN, scatter {pixels.scatter:.3g} DN"
    counts = {kind: sum(d.kind == kind for d in pixels.defects) for kind in kinds} if len(kinds) > 1 else {}
    figures = [
        of.figure(f"{kind}_pixels", counts.get(kind, pixels.count), nan, f"{kind} pixels", "", remark) for kind in kinds
    ]
    for key, name, what in (("blinking", "blinking_pixels", "blinking pixels"), ("lines", "lines", "rows and columns")):
        if key in lists:
            over = f"over {lists[key].threshold:.3g} DN"
            figures.append(of.figure(name, lists[key].count, nan, what, "", over))
    defects = [d for part in lists.values() for d in part.defects]
    places = [plane.to_image(setting.first.group.window, d.col, d.row) for d in defects]
    columns, rows = (["" if isnan(v) else int(v) for v in axis] for axis in list(zip(*places)) or ((), ()))
    table = Table.of(
        "Defect elements, the strongest first; positions are those of the image",
        plane=of.plane,
        setting=of.at,
        kind=[d.kind for d in defects],
        column=columns,
        row=rows,
        deviation_dn=[d.value for d in defects],
        over_threshold=[d.ratio for d in defects],
    )
    found = Findings(tuple(figures), refused, {"list": table}, _defects_plots(pixels, stack, of))
    growth = _growth(data, setting, plane, pixels) if setting.first.kind == "dark" else Findings()
    return joined([found, growth])


def _growth(data: SeriesData, setting: Setting, plane: Plane, found: DefectList) -> Findings:
    """Grey values of the strongest hot pixels at every dark exposure."""
    hot = [d for d in found.defects if d.kind == "hot"][:_CANDIDATES]
    window, of = setting.first.group.window, Subject(plane.name)
    like = [
        s
        for s in data.settings("dark")
        if s.first.exposure_ms is not None
        and s.first.group.window == window
        and s.first.temperature_c == setting.first.temperature_c
        and s.exposure <= setting.exposure
    ]
    settings = sorted(like, key=lambda s: s.exposure)
    if not hot or len(settings) < 2:
        return Findings()
    means = [data.stacks(s)[plane.name].mean for s in settings]
    exposures = np.array([s.exposure for s in settings])
    values = np.array([[mean[int(d.row), int(d.col)] for mean in means] for d in hot])
    full = values >= data.saturation_dn(plane.name)
    rates = np.array([_rate(exposures / 1000, v, ~f) for v, f in zip(values, full)])
    order = np.argsort(-np.nan_to_num(rates, nan=-np.inf), kind="stable")[:_FOLLOWED]
    values, rates = values[order], rates[order]
    places = [tuple(int(v) for v in plane.to_image(window, hot[k].col, hot[k].row)) for k in order]
    named = [f"column {column}, row {row}" for column, row in places]
    overfull = int(full[:, -1].sum())
    note = (
        f"{overfull} hot pixels are full at {exposures[-1]:g} ms; charge that runs over makes their neighbours hot, too"
    )
    table = Table.of(
        "Grey values of the hottest pixels at each dark exposure",
        plane=of.plane,
        column=[place[0] for place in places],
        row=[place[1] for place in places],
        **{f"{e:g}_ms_dn": v for e, v in zip(exposures, values.T)},
        rate_dn_s=rates,
    )
    chart = Chart(
        title=of.named("Growth of the hottest pixels"),
        caption="Grey values of the hottest pixels of the longest dark exposure at all exposures.",
        x_label="exposure ms",
        y_label="grey value DN",
        curves=tuple(Trace(exposures, v, name, "line and points") for name, v in zip(named[:6], values)),
    )
    return Findings(
        known(of.figure("hottest_dn_s", float(rates[0]), nan, "rate of the hottest pixel", "DN/s", named[0])),
        tables={f"hot_growth{plane.name and f'_{plane.name}'}": table},
        plots=(chart,),
        notes=(note,) if overfull else (),
    )


def _rate(seconds: NDArray[np.float64], values: NDArray[np.float64], usable: NDArray[np.bool_]) -> float:
    """Slope where the pixel is not full; NaN if that is at fewer than two exposures."""
    return float(np.polyfit(seconds[usable], values[usable], 1)[0]) if usable.sum() > 1 else nan


def _defects_plots(found: DefectList, stack: FrameStack, of: Subject) -> tuple[Chart | Picture, ...]:
    assert found.deviation is not None
    bars = log_histogram(found.deviation[np.isfinite(found.deviation)], found.scatter)
    seen = bars.count > 0
    histogram = Chart(
        title=f"Deviations from the surroundings, {of.named()}",
        caption="Counts on a logarithmic axis; pixels beyond the dashed curve (Gaussian noise) do not belong to the "
        "many.",
        x_label="deviation DN",
        y_label="pixels",
        curves=(
            Trace(bars.deviation[seen], bars.count[seen].astype(float), "pixels", "points"),
            Trace(bars.deviation[bars.model > 0.3], bars.model[bars.model > 0.3], "Gaussian", "dashed"),
        ),
        log_y=True,
        marks=((found.threshold, "threshold"),),
    )
    points = tuple((d.col, d.row) for d in found.defects[:_FOLLOWED])
    small, factor = shrunk(stack.mean)
    shown = Picture(
        title=f"Defect pixels, {of.named()}",
        caption=f"Mean image; the {len(points)} strongest of {found.count} are circled. Positions are those of the "
        "plane.",
        values=small,
        label="grey value DN",
        points=points,
        factor=factor,
    )
    return histogram, shown
