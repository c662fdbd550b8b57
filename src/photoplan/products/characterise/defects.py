"""Defect elements of a series: hot, dark and blinking pixels, rows and columns, with their positions."""

from __future__ import annotations

from math import isnan, nan

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Chart, Findings, Picture, Subject, Table, Trace, joined, known, shrunk
from photoplan.io.series import Plane
from photoplan.products.characterise.common import MOST_SATURATED, no_pair, tried
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.quality.camera.sensor import (
    DefectList,
    FrameStack,
    Kind,
    find_blinking,
    find_defects,
    find_lines,
    log_histogram,
)

#: Hot pixels whose growth with the exposure is followed, and whose places are drawn.
_FOLLOWED = 40
#: The strongest hot pixels of the longest exposure, among which the fastest are looked for.
_CANDIDATES = 1000
#: A flat pixel must differ by this part of its surroundings.
_FLAT_SHARE = 0.1

missing = no_pair


def analyse(data: SeriesData) -> Findings:
    """Defects of every plane, from the longest dark exposure and from flat frames at half of saturation."""
    return joined([_plane(data, plane) for plane in data.planes])


def _plane(data: SeriesData, plane: Plane) -> Findings:
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
    found = Findings(tuple(figures), refused, {"list": table}, _plots(pixels, stack, of))
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


def _plots(found: DefectList, stack: FrameStack, of: Subject) -> tuple[Chart | Picture, ...]:
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
