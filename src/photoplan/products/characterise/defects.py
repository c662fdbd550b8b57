"""Defect elements of a series: hot, dark and blinking pixels, rows and columns, with their positions."""

from __future__ import annotations

from math import isfinite, isnan, nan

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.io.series.pixels import Plane
from photoplan.products.characterise.common import MOST_SATURATED, prefix, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Plate, Trace, joined, shrunk
from photoplan.quality.camera.defects import Defect, DefectList, find_blinking, find_defects, find_lines, log_histogram
from photoplan.quality.camera.frame_statistics import FrameStack
from photoplan.quality.camera.photon_transfer import is_clipped_dark

#: Hot pixels whose growth with the exposure is followed, and whose places are drawn.
_FOLLOWED = 40
#: The strongest hot pixels of the longest exposure, among which the fastest are looked for.
_CANDIDATES = 1000
#: A flat pixel must differ by this part of its surroundings.
_FLAT_SHARE = 0.1


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    if any(len(s.frames) >= 2 for s in data.settings("dark", "flat")):
        return None
    return "no setting of dark or flat frames has two frames or more"


def analyse(data: SeriesData) -> Findings:
    """Defects of every plane, from the longest dark exposure and from flat frames at half of saturation."""
    return joined([_plane(data, plane) for plane in data.planes])


def _plane(data: SeriesData, plane: Plane) -> Findings:
    outcomes = []
    darks = sorted(_pairs(data, "dark"), key=lambda s: s.first.exposure_ms or 0.0)
    sound = [s for s in darks if data.levels(s)[plane.name].saturated_share <= MOST_SATURATED]
    dark = next(iter(sound[-1:] or darks[:1]), None)
    flats = [s for s in _pairs(data, "flat") if data.levels(s)[plane.name].saturated_share < 1e-3]
    half = data.saturation_dn(plane.name) / 2
    flat = min(flats, key=lambda s: abs(data.levels(s)[plane.name].mean - half), default=None)
    for setting, kinds, share in ((dark, ("hot",), 0.0), (flat, ("hot", "dark"), _FLAT_SHARE)):
        if setting is not None:
            key = prefix("defect elements", plane.name, setting.label)
            how = (kinds, share)
            outcomes.append(tried(key, lambda s=setting, h=how: _setting(data, s, plane, h)))  # type: ignore[misc]
    if flat is None:
        why = "no flat frames, two or more at a setting, that are not saturated"
        outcomes.append(Findings(refused={prefix("dark pixels", plane.name): why}))
    if dark is None:
        why = "no dark frames, two or more at a setting"
        outcomes.append(Findings(refused={prefix("hot pixels", plane.name): why}))
    return joined(outcomes)


def _pairs(data: SeriesData, kind: str) -> list[Setting]:
    return [s for s in data.settings(kind) if len(s.frames) >= 2]


def _setting(data: SeriesData, setting: Setting, plane: Plane, how: tuple[tuple[str, ...], float]) -> Findings:
    kinds, share = how
    stack = data.stacks(setting)[plane.name]
    level = stack.level
    mean = stack.mean if stack.counted is None else np.where(stack.counted, stack.mean, np.nan)
    how_noisy, cut = (level.temporal_variance, level.frames), is_clipped_dark(level)
    found = find_defects(mean, *how_noisy, kinds, share, data.step, cut)  # type: ignore[arg-type]
    lines = find_lines(mean, data.step)
    refused: dict[str, str] = {}
    lists = {"pixels": found, "lines": lines}
    try:
        assert stack.variance is not None
        variance = stack.variance if stack.counted is None else np.where(stack.counted, stack.variance, np.nan)
        lists["blinking"] = find_blinking(variance, level.frames, data.step)
    except InputError as error:
        refused[prefix("blinking pixels", plane.name, setting.label)] = str(error)
    figures = _figures(lists, kinds, plane.name, setting.label)
    head = ("plane", "setting", "kind", "column", "row", "deviation_dn", "over_threshold")
    rows = tuple(_row(d, plane, setting) for part in lists.values() for d in part.defects)
    growth = _growth(data, setting, plane, found) if setting.first.kind == "dark" else Findings()
    return joined(
        [
            Findings(
                tuple(figures),
                refused,
                {"list": Listing(head, rows, "Defect elements, the strongest first; positions are those of the image")},
                _plots(found, stack, plane, setting),
            ),
            growth,
        ]
    )


def _row(defect: Defect, plane: Plane, setting: Setting) -> tuple[str | float | int, ...]:
    x, y = plane.to_image(setting.first.group.window, defect.col, defect.row)
    place = ["" if isnan(v) else int(v) for v in (x, y)]
    return (plane.name, setting.label, defect.kind, *place, defect.value, defect.ratio)


def _figures(lists: dict[str, DefectList], kinds: tuple[str, ...], plane: str, label: str) -> list[Figure]:
    pixels = lists["pixels"]
    figures = []
    for kind in kinds:
        count = sum(d.kind == kind for d in pixels.defects) if len(kinds) > 1 else pixels.count
        remark = f"deviation over {pixels.threshold:.3g} DN, scatter {pixels.scatter:.3g} DN"
        figures.append(
            Figure(
                name=f"{kind}_pixels",
                value=count,
                sigma=nan,
                label=f"{kind} pixels",
                unit="",
                plane=plane,
                at=label,
                remark=remark,
            )
        )
    for key, name, what in (("blinking", "blinking_pixels", "blinking pixels"), ("lines", "lines", "rows and columns")):
        if key in lists:
            part = lists[key]
            figures.append(
                Figure(
                    name=name,
                    value=part.count,
                    sigma=nan,
                    label=what,
                    unit="",
                    plane=plane,
                    at=label,
                    remark=f"over {part.threshold:.3g} DN",
                )
            )
    return figures


def _growth(data: SeriesData, setting: Setting, plane: Plane, found: DefectList) -> Findings:
    """Grey values of the strongest hot pixels at every dark exposure."""
    hot = [d for d in found.defects if d.kind == "hot"][:_CANDIDATES]
    settings = sorted(
        (
            s
            for s in data.settings("dark")
            if s.first.exposure_ms is not None
            and s.first.group.window == setting.first.group.window
            and s.first.temperature_c == setting.first.temperature_c
            and s.first.exposure_ms <= (setting.first.exposure_ms or 0.0)
        ),
        key=lambda s: s.first.exposure_ms or 0.0,
    )
    if not hot or len(settings) < 2:
        return Findings()
    window = setting.first.group.window
    means = [data.stacks(s)[plane.name].mean for s in settings]
    exposures = np.array([s.first.exposure_ms or 0.0 for s in settings])
    values = np.array([[mean[int(d.row), int(d.col)] for mean in means] for d in hot])
    full = values >= data.saturation_dn(plane.name)
    rates = [_rate(exposures / 1000, v, ~f) for v, f in zip(values, full)]
    order = sorted(range(len(hot)), key=lambda k: -np.nan_to_num(rates[k], nan=-np.inf))[:_FOLLOWED]
    followed, values, rates = [hot[k] for k in order], values[order], [rates[k] for k in order]
    head = ("plane", "column", "row", *(f"{e:g}_ms_dn" for e in exposures), "rate_dn_s")
    places = [tuple(int(v) for v in plane.to_image(window, d.col, d.row)) for d in followed]
    rows: list[tuple[str | float | int, ...]] = [
        (plane.name, *at, *(float(x) for x in v), rate) for at, v, rate in zip(places, values, rates)
    ]
    remark = f"column {places[0][0]}, row {places[0][1]}"
    hottest = Figure("hottest_dn_s", rates[0], nan, "rate of the hottest pixel", "DN/s", plane.name, remark=remark)
    overfull = int(full[:, -1].sum())
    note = (
        f"{overfull} hot pixels are full at {exposures[-1]:g} ms; charge that runs over makes their neighbours hot, too"
    )
    curves = tuple(
        Trace(exposures, v, f"column {at[0]}, row {at[1]}", "line and points") for at, v in zip(places[:6], values)
    )
    chart = Chart(
        f"Growth of the hottest pixels {plane.name}".strip(),
        "Grey values of the hottest pixels of the longest dark exposure at all exposures.",
        "exposure ms",
        "grey value DN",
        curves,
    )
    table = Listing(head, tuple(rows), "Grey values of the hottest pixels at each dark exposure")
    return Findings(
        (hottest,) if isfinite(rates[0]) else (),
        tables={f"hot_growth{plane.name and f'_{plane.name}'}": table},
        plots=(chart,),
        notes=(note,) if overfull else (),
    )


def _rate(seconds: NDArray[np.float64], values: NDArray[np.float64], usable: NDArray[np.bool_]) -> float:
    """Slope where the pixel is not full; NaN if that is at fewer than two exposures."""
    return float(np.polyfit(seconds[usable], values[usable], 1)[0]) if usable.sum() > 1 else nan


def _plots(found: DefectList, stack: FrameStack, plane: Plane, setting: Setting) -> tuple[Chart | Plate, ...]:
    assert found.deviation is not None
    bars = log_histogram(found.deviation[np.isfinite(found.deviation)], found.scatter)
    seen = bars.count > 0
    title = prefix(plane.name, setting.label)
    histogram = Chart(
        f"Deviations from the surroundings, {title}",
        "Counts on a logarithmic axis; pixels beyond the dashed curve (Gaussian noise) do not belong to the many.",
        "deviation DN",
        "pixels",
        (
            Trace(bars.deviation[seen], bars.count[seen].astype(float), "pixels", "points"),
            Trace(bars.deviation[bars.model > 0.3], bars.model[bars.model > 0.3], "Gaussian", "dashed"),
        ),
        log_y=True,
        marks=((found.threshold, "threshold"),),
    )
    points = tuple((d.col, d.row) for d in found.defects[:_FOLLOWED])
    small, factor = shrunk(stack.mean)
    shown = Plate(
        f"Defect pixels, {title}",
        f"Mean image; the {len(points)} strongest of {found.count} are circled. Positions are those of the plane.",
        small,
        "grey value DN",
        points,
        factor=factor,
    )
    return histogram, shown
