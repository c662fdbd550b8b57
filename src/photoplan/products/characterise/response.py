"""Response of a camera to light: linearity, grey wedge, saturation, blooming, light fall-off, gain control."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from math import hypot, isfinite, nan
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Chart, Estimate, Findings, Picture, Subject, Table, Trace, joined, known, spaced
from photoplan.geometry.grid import Window
from photoplan.io.quality_files import FallOffEntry, TermEntry, fall_off_text
from photoplan.io.series import Plane, SeriesFrame, plane_pixels
from photoplan.products.characterise.data import (
    MOST_SATURATED,
    FrameGroup,
    SeriesData,
    Setting,
    SettingsRun,
    black_of,
    dark_like,
    exposure_runs,
    frame_groups,
    no_run,
    of_runs,
    saturation_of,
    tried,
    used_and_rest,
    window_means,
)
from photoplan.quality.camera.drift import LEAST_VALUES, Blooming, find_blooming
from photoplan.quality.camera.fall_off import FallOff, FallOffSettings, fit_fall_off, gain_image
from photoplan.quality.camera.geometry import GreyWedge, grey_wedge
from photoplan.quality.camera.photon_transfer import HIGH, Linearity, linearity
from photoplan.quality.camera.sensor import Level, StackSums, check_level, cut_off
from photoplan.quality.camera.video import GainControl, compare_transitions, gain_control

_KINDS = ("flat", "scene")
_LEAST_LINEARITY = 3


def missing_for_linearity(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return no_run(data, _KINDS, _LEAST_LINEARITY, "linearity")


def analyse_linearity(data: SeriesData) -> Findings:
    """Linearity of every plane and run."""
    return of_runs(data, _KINDS, _LEAST_LINEARITY, "linearity", _linearity_of_run)


def _linearity_of_run(data: SeriesData, run: SettingsRun, plane: Plane, of: Subject) -> Findings:
    levels = [data.levels(setting)[plane.name] for setting in run.settings]
    for level in levels:
        check_level(level)
    blacks = [black_of(data, setting, plane) for setting in run.settings]
    signal = [level.mean - black.mean for level, black in zip(levels, blacks)]
    sigma = [hypot(level.sigma_of_mean(data.step), black.sigma) for level, black in zip(levels, blacks)]
    # Where this run shows saturation, else what the camera can write.
    seen = run.saturation(data, plane) if len(levels) >= 4 else None
    top = saturation_of(data, plane, levels) if seen is None else seen.level_dn
    full = top - blacks[-1].mean
    if not full > 0:
        raise InputError(f"the frames are not brighter than black ({blacks[-1].mean:.4g} DN)")
    partly = np.array([level.saturated_share > MOST_SATURATED for level in levels])
    found = linearity(run.values, signal, sigma, full, ~partly)
    rules = dict.fromkeys(black.rule for black in blacks)
    # Where black hides a part of the pixels, the mean of the others is not the signal.
    hidden = np.array([level.is_cut_off for level in levels])
    unit = f"DN/{run.unit}"
    at = [of.under(f"{x:g} {run.unit}") for x in found.exposure]
    plain_mean = (found.signal < HIGH * full) & ~hidden & ~partly
    count = f"{np.count_nonzero(found.used)} levels"
    error, of_error = found.error_percent, found.error_percent_sigma
    figures = [
        of.figure("linearity_error_percent", error, of_error, "linearity error", "%", count),
        of.figure("response", found.slope, found.slope_sigma, "response", unit),
    ]
    for k in np.flatnonzero(plain_mean):
        response, sigma_k = float(found.response[k]), float(found.response_sigma[k])
        figures.append(at[k].figure("response_at", response, sigma_k, "signal over exposure", unit))
    return Findings(
        figures=tuple(figures),
        refused={at[k].named("signal over exposure"): cut_off([levels[k]]) for k in np.flatnonzero(hidden)},
        tables={"levels": _table(found, run, of)},
        plots=_linearity_plots(found, run, of, full),
        notes=tuple(f"{of.named()}: {rule}".lstrip(": ") for rule in rules if "cut off" in rule),
        details={of.key("linearity"): found},
    )


def _table(found: Linearity, run: SettingsRun, of: Subject) -> Table:
    return Table.of(
        f"Signal and response; slopes in DN/{run.unit}",
        plane=of.plane,
        run=of.at,
        **{run.name: found.exposure},
        signal_dn=found.signal,
        response=found.response,
        segment_slope=found.segment,
        deviation_percent=found.deviation_percent,
        used=found.used,
    )


def _linearity_plots(found: Linearity, run: SettingsRun, of: Subject, full: float) -> tuple[Chart, ...]:
    title, used = of.named("Linearity"), found.used
    grid = np.linspace(0.0, float(found.exposure[used].max()) * 1.05, 60)
    line = Trace(grid, found.offset + found.slope * grid, "least relative deviations", "dashed", colour=1)
    seen = used | (found.signal < 0.999 * full)
    points = used_and_rest(found.exposure[seen], found.signal[seen], used[seen])
    caption = f"Linearity error {found.error_percent:.3g} %, from 5 % to 95 % of saturation."
    deviations = Trace(found.exposure[used], found.deviation_percent[used], style="line and points")
    return (
        Chart(title=f"{title}: signal", caption=caption, x_label=run.axis, y_label="signal DN", curves=(*points, line)),
        Chart(
            title=f"{title}: deviation",
            caption="Relative deviation from the line.",
            x_label=run.axis,
            y_label="deviation %",
            curves=(deviations,),
        ),
    )


_LEAST_WEDGE = 3


@dataclass(frozen=True)
class _Patch:
    density: float
    level: Level
    setting: Setting


def missing_for_wedge(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    frames = data.series.of("wedge")
    densities = {frame.density for frame in frames} - {None}
    densities |= {step.density for frame in frames for step in frame.group.entry.steps}
    if len(densities) >= _LEAST_WEDGE:
        return None
    found = f"wedge frames with {len(densities)} densities"
    return f"{found}; a grey wedge needs {_LEAST_WEDGE}: give density, or steps with rois"


def analyse_wedge(data: SeriesData) -> Findings:
    """Characteristic curve of every plane and illumination."""
    outcomes = []
    for plane in data.planes:
        patches: dict[str, list[_Patch]] = {}
        for setting in data.settings("wedge"):
            patches.setdefault(_label(setting.first), []).extend(_patches(data, setting, plane))
        for label, of_label in patches.items():
            of = Subject(plane.name, label)
            outcomes.append(tried(of.named("grey wedge"), _curve, data, of_label, plane, of))
    return joined(outcomes)


def _label(frame: SeriesFrame) -> str:
    light = "" if frame.illumination is None else f"illumination {frame.illumination:g}"
    time = "" if frame.exposure_ms is None else f"{frame.exposure_ms:g} ms"
    return spaced(frame.group.entry.name or "", light, time)


def _patches(data: SeriesData, setting: Setting, plane: Plane) -> list[_Patch]:
    """Statistics of each patch of the frames of one setting."""
    entry = setting.first.group.entry
    if not entry.steps:
        if setting.first.density is None:
            raise InputError(
                f"{setting.first.group.label}: {setting.first.file.name} states no density; give it or steps"
            )
        return [_Patch(setting.first.density, data.levels(setting)[plane.name], setting)]
    found = []
    size = data.series.size or (0, 0)
    for step in entry.steps:
        window = Window(*step.roi)
        if window.stop[0] > size[0] or window.stop[1] > size[1]:
            raise InputError(f"{setting.first.group.label}: step of density {step.density:g}: its roi leaves the image")
        sums = StackSums(data.saturation_dn(plane.name))
        for frame in setting.frames:
            sums.add(plane_pixels(frame, plane, window))
        found.append(_Patch(step.density, sums.stack().level, setting))
    return found


def _curve(data: SeriesData, patches: list[_Patch], plane: Plane, of: Subject) -> Findings:
    blacks = [black_of(data, patch.setting, plane) for patch in patches]
    signal = [patch.level.mean - black.mean for patch, black in zip(patches, blacks)]
    sigma = [patch.level.sigma_of_mean(data.step) for patch in patches]
    full = saturation_of(data, plane, [patch.level for patch in patches]) - blacks[0].mean
    found = grey_wedge([patch.density for patch in patches], signal, sigma, full)
    table = Table.of(
        "Patches of the wedge",
        plane=of.plane,
        at=of.at,
        density=found.density,
        transmission=found.transmission,
        signal_dn=found.signal,
        used=found.used,
    )
    return Findings(
        (
            of.figure("gamma", found.gamma, found.gamma_sigma, "gamma of the characteristic curve"),
            of.figure("wedge_error_percent", found.error_percent, nan, "largest deviation from proportionality", "%"),
            of.figure("used_range_percent", found.used_range_percent, nan, "part of the grey scale used", "%"),
        ),
        tables={"patches": table},
        plots=(_wedge_plot(found, of.named("Grey wedge")),),
        details={of.key("wedge"): found},
    )


def _wedge_plot(found: GreyWedge, title: str) -> Chart:
    grid = np.linspace(found.density.min(), found.density.max(), 60)
    return Chart(
        title=title,
        caption=f"Grey value over density; the dashed curve is a proportional sensor, gamma is {found.gamma:.3g}.",
        x_label="density",
        y_label="signal DN",
        curves=(
            Trace(found.density, found.signal, "measured", "line and points"),
            Trace(grid, found.slope * 10.0**-grid, "proportional", "dashed"),
        ),
    )


_LEAST_SATURATION = 4
_WORDS = {
    "clipping": "grey values stop at the largest that is written",
    "response": "the response falls below the line",
    "variance": "the temporal variance falls",
}
_FULL = "the elements are full, below the largest grey value"


def missing_for_saturation(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return no_run(data, _KINDS, _LEAST_SATURATION, "saturation")


def analyse_saturation(data: SeriesData) -> Findings:
    """Saturation of every plane and run."""
    return of_runs(data, _KINDS, _LEAST_SATURATION, "saturation", _saturation_of_run)


def _saturation_of_run(data: SeriesData, run: SettingsRun, plane: Plane, of: Subject) -> Findings:
    levels = [data.levels(setting)[plane.name] for setting in run.settings]
    for level in levels:
        check_level(level)
    mean = np.array([level.mean for level in levels])
    found = run.saturation(data, plane)
    if found is None:
        share = levels[-1].saturated_share
        spot = f", {100 * share:.3g} % of its samples are saturated: give them a roi, a mask or brightest"
        why = f"not reached: the brightest level has a mean of {mean[-1]:.4g} DN"
        return Findings(refused={of.named("saturation"): why + (spot if share > MOST_SATURATED else "")})
    words = _FULL if found.rule == "clipping" and plane.name in data.wells else _WORDS[found.rule]
    between = f"between {found.last_unsaturated:g} and {found.first_saturated:g} {run.unit}"
    at, sigma = found.exposure, found.exposure_sigma
    chart = Chart(
        title=of.named("Saturation"),
        caption=f"Saturated {between}: {words}.",
        x_label=run.axis,
        y_label="mean grey value DN",
        curves=(Trace(np.array(run.values), mean, style="line and points"),),
        log_x=True,
        marks=((found.first_saturated, "saturated"),),
    )
    return Findings(
        known(
            of.figure("saturation_dn", found.level_dn, nan, "saturation", "DN", f"{between}: {words}"),
            of.figure("saturation_exposure", at, sigma, "exposure at saturation", run.unit),
        ),
        plots=(chart,),
        details={of.key("saturation"): found},
    )


_LEAST_BLOOMING = 4
#: Pixels of all mean images that are held at once.
_MOST = 150_000_000


def missing_for_blooming(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return no_run(data, ("scene",), _LEAST_BLOOMING, "blooming")


def analyse_blooming(data: SeriesData) -> Findings:
    """Onset and extent for every plane and run."""
    return joined([_blooming_of_run(data, run) for run in exposure_runs(data, ("scene",), _LEAST_BLOOMING)])


def _blooming_of_run(data: SeriesData, run: SettingsRun) -> Findings:
    window = run.settings[0].first.group.window
    if window.size * len(run.settings) > _MOST:
        raise InputError(
            f"{run.settings[0].first.group.label}: {len(run.settings)} images of {window.width} × {window.height} "
            "pixels; blooming needs them together: give a roi around a bright object"
        )
    means = [data.mean_images(setting) for setting in run.settings]
    parts = []
    for plane in data.planes:
        of = Subject(plane.name, run.label)
        parts.append(
            tried(of.named("blooming"), _blooming_of_plane, data, run, plane, [each[plane.name] for each in means], of)
        )
    return joined(parts)


def _blooming_of_plane(
    data: SeriesData, run: SettingsRun, plane: Plane, images: list[np.ndarray], of: Subject
) -> Findings:
    blacks = [black_of(data, setting, plane).mean for setting in run.settings]
    full = data.saturation_dn(plane.name)
    if not isfinite(full):
        raise InputError("the largest grey value is not known; give camera.bits or camera.saturation_dn")
    found = find_blooming(run.values, images, blacks, full, data.step)
    blooms = isfinite(found.onset_dn)
    remark = f"{100 * found.onset_dn / (full - blacks[0]):.0f} % of the grey scale"
    longest = f"at {found.extent_exposure:g} {run.unit}"
    rows, columns = (n * plane.step if blooms else nan for n in (found.extent_rows, found.extent_columns))
    why = f"none up to an object of {found.last_without:.4g} DN (by its response): the neighbours grow as expected"
    table = Table.of(
        "Neighbours of the bright object",
        plane=of.plane,
        run=of.at,
        **{run.name: run.values},
        object_dn=found.object_dn,
        neighbours_excess_dn=found.excess_dn,
        sigma_dn=found.excess_sigma,
    )
    return Findings(
        known(
            of.figure("blooming_onset_dn", found.onset_dn, found.onset_dn_sigma, "onset of blooming", "DN", remark),
            of.figure("blooming_rows_px", rows, nan, "extent along columns", "px", longest),
            of.figure("blooming_columns_px", columns, nan, "extent along rows", "px", longest),
        ),
        {} if blooms else {of.named("blooming onset"): why},
        {"neighbours": table},
        (_blooming_plot(found, of.named("Blooming")),),
        details={of.key("blooming"): found},
    )


def _blooming_plot(found: Blooming, title: str) -> Chart:
    return Chart(
        title=title,
        caption="Grey value of the neighbours above what their response promises, over the grey value that the "
        "object's response promises.",
        x_label="object DN",
        y_label="excess of neighbours DN",
        curves=(Trace(found.object_dn, found.excess_dn, style="line and points", sigma=found.excess_sigma),),
        log_x=True,
        marks=((found.onset_dn, "onset"),) if isfinite(found.onset_dn) else (),
    )


_SATURATED = 1e-3
#: Longer side of the gain image that is written.
_GAIN_SIDE = 1024

Array = NDArray[np.float64]


def missing_for_fall_off(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return (
        None if data.series.of("flat") else "flat frames: an evenly lit surface without structure, all over the image"
    )


def analyse_fall_off(data: SeriesData) -> Findings:
    """Light fall-off of the brightest flat frames that are not saturated."""
    setting = _brightest(data)
    flats = {name: stack.only_counted(stack.mean) for name, stack in data.stacks(setting).items()}
    dark, note = _dark(data, setting)
    parts = []
    for plane in data.planes:
        image = _whole(data, setting, plane, flats[plane.name])
        below = dark[plane.name]
        image -= below if isinstance(below, float) else _whole(data, setting, plane, below)
        settings = _settings(data, setting, plane, below if isinstance(below, float) else float(below.mean()))
        parts.append(_fitted(image, settings, plane, setting))
    first = Findings(notes=(f"from {len(setting.frames)} frames, {setting.label}; {note}",))
    return joined([first, *parts])


def _fitted(image: Array, settings: FallOffSettings, plane: Plane, setting: Setting) -> Findings:
    """The fall-off; without its natural part where the light shows none and nobody asked for it."""
    try:
        return _fall_off_findings(fit_fall_off(image, settings), plane, setting)
    except InputError as error:
        if settings.natural != "estimated" or "natural" in setting.first.group.entry.values:
            raise
        rest = replace(settings, natural="none")
        refused = Findings(refused={f"natural part{f' ({plane.name})' if plane.name else ''}": str(error)})
        return joined([_fall_off_findings(fit_fall_off(image, rest), plane, setting), refused])


def _brightest(data: SeriesData) -> Setting:
    """Frames with the highest mean of those that are not saturated."""
    levels = [(setting, list(data.levels(setting).values())) for setting in data.settings("flat")]
    sound = [each for each in levels if max(level.saturated_share for level in each[1]) <= _SATURATED]
    if not sound:
        full = ", ".join(f"{data.saturation_dn(plane.name):.4g}" for plane in data.planes)
        raise InputError(
            f"{data.series.path}: all flat frames are saturated (more than {100 * _SATURATED:g} % of the pixels at "
            f"{full} DN); take flat frames with less light"
        )
    return max(sound, key=lambda each: float(np.mean([level.mean for level in each[1]])))[0]


def _dark(data: SeriesData, flat: Setting) -> tuple[dict[str, Array | float], str]:
    """Mean dark image at the same exposure and window, else the grey value that other dark frames or the file tell."""
    setting = dark_like(data, flat)
    if setting is not None and setting.first.group.window == flat.first.group.window:
        return {n: s.mean for n, s in data.stacks(setting).items()}, f"{setting.label} subtracted"
    blacks = {plane.name: black_of(data, flat, plane) for plane in data.planes}
    levels = ", ".join(dict.fromkeys(f"{black.mean:.4g}" for black in blacks.values()))
    rule = next(iter(blacks.values())).rule
    note = f"no dark frames at their exposure: {levels} DN are taken off ({rule})"
    return {name: black.mean for name, black in blacks.items()}, note


def _whole(data: SeriesData, setting: Setting, plane: Plane, pixels: Array) -> Array:
    """Pixels of the window at their place in the whole image of the plane; NaN around them."""
    assert data.series.size is not None
    window = setting.first.group.window
    width, height = data.series.size
    row0, col0 = plane.first(Window(0, 0, width, height))
    shape = len(range(row0, height, plane.step)), len(range(col0, width, plane.step))
    if pixels.shape == shape:
        return np.array(pixels, float)
    first = plane.first(window)
    row, col = (window.row + first[0] - row0) // plane.step, (window.col + first[1] - col0) // plane.step
    out = np.full(shape, np.nan)
    out[row : row + pixels.shape[0], col : col + pixels.shape[1]] = pixels
    return out


def _settings(data: SeriesData, setting: Setting, plane: Plane, dark: float) -> FallOffSettings:
    """Return what the camera and the values of the entry state."""
    camera, group = data.series.camera, FrameGroup(setting.first.group, setting.frames)
    point = camera.principal_point_px
    if point is not None:
        point = ((point[0] - plane.col) / plane.step, (point[1] - plane.row) / plane.step)
    known = camera.focal_px is not None
    natural = group.word("natural", ("given", "estimated", "none") if known else ("estimated", "none"))
    return FallOffSettings(
        natural=cast(Literal["given", "estimated", "none"], natural),
        camera_constant=camera.focal_px / plane.step if camera.focal_px and natural == "given" else None,
        principal_point=point,
        estimate_principal_point=group.word("principal_point", ("given", "estimated")) == "estimated",
        artificial=cast(Literal["surface", "radial", "none"], group.word("artificial", ("surface", "radial", "none"))),
        degree=int(group.number("degree", 6, 2, 10)),
        dark=dark,
    )


def _fall_off_findings(found: FallOff, of: Plane, setting: Setting) -> Findings:
    plane = of.name
    suffix = f"_{plane.replace(' ', '_')}" if plane else ""
    names = f"fall_off_model{suffix}.toml", f"fall_off_gain{suffix}.tif"
    group = FrameGroup(setting.first.group, setting.frames)
    usual = max(1, math.ceil(max(found.model.size) / _GAIN_SIDE))
    factor = int(group.number("gain_reduction", usual, 1, 1000))
    refused = {f"natural and artificial part{f' ({plane})' if plane else ''}": found.rank} if found.rank else {}
    notes = []
    if found.neighbour_correlation > 0.3:
        notes.append(
            f"{plane or 'image'}: residuals of neighbouring blocks resemble each other "
            f"({found.neighbour_correlation:.2f}): structure is left that the model does not "
            "describe; standard deviations are enlarged for it"
        )
    corners = Table.of(
        "Brightness lost in the corners",
        plane=plane,
        corner=[c.name for c in found.corners],
        total_percent=[100 * c.total for c in found.corners],
        sigma=[100 * c.sigma for c in found.corners],
        natural_percent=["" if c.natural is None else 100 * c.natural for c in found.corners],
        artificial_percent=["" if c.artificial is None else 100 * c.artificial for c in found.corners],
    )
    terms = Table.of(
        "Terms r^n cos(m θ) of the polynomial",
        plane=plane,
        **{name: [getattr(t, name) for t in found.terms] for name in ("n", "m", "coefficient", "sigma")},
    )
    places = [_place(of, d.x, d.y) for d in found.dirt]
    dirt = Table.of(
        "Dust and stains",
        plane=plane,
        x=[x for x, _ in places],
        y=[y for _, y in places],
        width=[d.width * of.step for d in found.dirt],
        height=[d.height * of.step for d in found.dirt],
        depth_percent=[100 * d.depth for d in found.dirt],
    )
    return Findings(
        figures=_figures(found, of),
        refused=refused,
        tables={"corners": corners, "terms": terms, "dirt": dirt},
        plots=_fall_off_plots(found, of),
        notes=tuple(notes),
        details={f"separability{suffix}": found.separability} if found.separability else {},
        files={
            names[0]: correction_text(found, plane, names[1], factor).encode(),
            names[1]: gain_image(found.model, factor),
        },
    )


def _place(plane: Plane, x: float, y: float) -> tuple[float, float]:
    """Column and row in the image of a place in the whole array of a plane."""
    return plane.col + plane.step * x, plane.row + plane.step * y


def _figures(found: FallOff, plane: Plane) -> tuple[Estimate, ...]:
    """Lengths in pixels of the image, of which a colour has every second one."""
    nan, of, step = math.nan, Subject(plane.name), plane.step
    figures = [of.figure("centre_dn", found.level, found.sigma_level, "grey value at the principal point", "DN")]
    for c in found.corners:
        at = of.under(c.name)
        figures.append(at.figure("corner_percent", 100 * c.total, 100 * c.sigma, "fall-off in the corner", "%"))
        if c.natural is not None and c.artificial is not None:
            figures.append(at.figure("natural_percent", 100 * c.natural, nan, "natural part cos⁴ω", "%"))
            figures.append(at.figure("artificial_percent", 100 * c.artificial, nan, "artificial part", "%"))
    if found.camera_constant is not None and found.sigma_camera_constant is not None:
        constant, s = step * found.camera_constant, step * found.sigma_camera_constant
        figures.append(of.figure("camera_constant_px", constant, s, "camera constant from the fall-off", "px"))
    if found.sigma_principal_point is not None:
        for axis, value, s in zip("xy", _place(plane, *found.model.principal_point), found.sigma_principal_point):
            figures.append(of.figure(f"principal_point_{axis}_px", value, step * s, f"principal point {axis}", "px"))
    for name, part, label in (
        ("asymmetry", found.asymmetry, "largest difference of two corners"),
        ("range_before", found.range_before, "brightest minus darkest before correction"),
        ("residual", found.residual_rms, "left after correction, rms"),
        ("residual_largest", found.residual_largest, "left after correction, largest"),
    ):
        figures.append(of.figure(f"{name}_percent", 100 * part, nan, label, "%"))
    return (*figures, of.figure("dirt", len(found.dirt), nan, "places with dust or stains"))


def _fall_off_plots(found: FallOff, plane: Plane) -> tuple[Chart | Picture, ...]:
    assert found.blocks is not None and found.residuals is not None
    blocks, model = found.blocks, found.model
    of = f", {plane.name}" if plane.name else ""
    left, upper = _place(plane, -0.5, -0.5)
    right, lower = _place(plane, model.size[0] - 0.5, model.size[1] - 0.5)
    extent = (left, right, lower, upper)
    dirt = tuple(_place(plane, d.x, d.y) for d in found.dirt[:30])
    relative = blocks.values / found.level
    return (
        Picture(
            f"Brightness{of}",
            "Mean of the flat frames in blocks, relative to the principal point (Behr 1989, fig. 4.9).",
            100 * relative,
            "%",
            points=dirt,
            extent=extent,
        ),
        _profile(found, of, plane.step),
        Picture(
            f"After correction{of}",
            f"What the model leaves; {len(found.dirt)} places with dust or stains (circles) did not count.",
            100 * found.residuals,
            "% of the brightness",
            points=dirt,
            extent=extent,
        ),
    )


def _profile(found: FallOff, of: str, unit: int) -> Chart:
    """Brightness against the distance from the principal point: measured, and the parts of the model."""
    assert found.blocks is not None
    blocks, model = found.blocks, found.model
    radius = unit * np.hypot(blocks.x - model.principal_point[0], blocks.y - model.principal_point[1])
    step = max(1, len(radius) // 1500)
    farthest = max(
        ((x, y) for x in (0.0, model.size[0] - 1.0) for y in (0.0, model.size[1] - 1.0)),
        key=lambda corner: math.dist(corner, model.principal_point),
    )
    s = np.linspace(0.0, 1.0, 100)
    x = model.principal_point[0] + s * (farthest[0] - model.principal_point[0])
    y = model.principal_point[1] + s * (farthest[1] - model.principal_point[1])
    r = s * unit * math.dist(farthest, model.principal_point)
    curves = [
        Trace(radius[::step], 100 * blocks.known[::step] / found.level, "blocks", "points", colour=5),
        Trace(r, 100 * model.relative(x, y), "model to the farthest corner", "line", colour=0),
    ]
    if model.camera_constant is not None:
        curves.append(Trace(r, 100 * model.natural(x, y), "cos⁴ω", "dashed", colour=1))
        curves.append(Trace(r, 100 * model.artificial(x, y), "artificial", "dashed", colour=2))
    symmetric = [(t, c) for t, c in zip(model.terms, model.coefficients) if t[1] == 0]
    terms, coefficients = zip(*symmetric) if symmetric else ((), ())
    radial = replace(model, terms=terms, coefficients=coefficients)
    curves.append(Trace(r, 100 * radial.relative(x, y), "symmetric part", "line", colour=3))
    return Chart(
        title=f"Fall-off from the principal point{of}",
        caption="Relative brightness; the spread of the blocks at one distance is asymmetry, noise and dust.",
        x_label="distance from the principal point px",
        y_label="% of the brightness there",
        curves=tuple(curves),
    )


def correction_text(found: FallOff, plane: str, gain_image: str, reduction: int) -> str:
    """A fitted model as the text of a correction file, which `read_fall_off` reads."""
    model = found.model
    return fall_off_text(
        FallOffEntry(
            format="photoplan light fall-off 1",
            size=model.size,
            plane=plane,
            principal_point_px=model.principal_point,
            camera_constant_px=model.camera_constant,
            dark_dn=model.dark,
            gain_image=gain_image,
            gain_reduction=reduction,
            terms=tuple(TermEntry(n=t.n, m=t.m, coefficient=t.coefficient, sigma=t.sigma) for t in found.terms),
        )
    )


def missing_for_gain_control(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    groups = frame_groups(data, "step")
    if not groups:
        return f"frames of kind step: one entry per transition, with {LEAST_VALUES} or more frames after it"
    most = max(len(g.frames) for g in groups)
    return None if most > LEAST_VALUES else f"{LEAST_VALUES + 1} step frames in one entry; there are {most}"


def analyse_gain_control(data: SeriesData) -> Findings:
    """Every transition, and bright-dark against dark-bright; one that cannot be used is named, and left out."""
    parts: list[Findings] = []
    found: dict[str, list[GainControl]] = {}
    unfit: dict[str, InputError] = {}
    for group in frame_groups(data, "step"):
        try:
            transitions = _transitions(data, group)
        except InputError as error:
            unfit[spaced("transition", group.label)] = error
            continue
        for plane, (control, noise) in transitions.items():
            parts.append(_gain_control_findings(control, noise, Subject(plane, group.label), data.step))
            found.setdefault(plane, []).append(control)
    if not parts:
        raise next(iter(unfit.values()))
    left_out = Findings(refused={name: str(error) for name, error in unfit.items()})
    return joined([left_out, *parts, *(_asymmetry(controls, plane) for plane, controls in found.items())])


def _transitions(data: SeriesData, group: FrameGroup) -> dict[str, tuple[GainControl, tuple[float, float]]]:
    """The transition of an entry by plane, with the noise of a pixel before and after it."""
    times = group.times()
    step_time = group.number("step_time_s", 0.0, -1e12, 1e12) if group.has("step_time_s") else None
    if step_time is not None:
        first = group.frames[0].time_s
        assert first is not None
        step_time -= first
    advice = "what the gain does is hidden there. Take the series with less light, or choose a darker roi"
    out = {}
    for name, seen in window_means(data, group, group.group.window, advice).items():
        found = gain_control(times, seen.mean, step_time=step_time, name=spaced(group.label, name))
        # The pair across the step is left out.
        before, after = seen.variance[: found.first - 1], seen.variance[found.first :]
        sigmas = tuple(math.sqrt(float(part.mean())) if part.size else math.nan for part in (before, after))
        out[name] = found, (sigmas[0], sigmas[1])
    return out


def _gain_control_findings(found: GainControl, pixel: tuple[float, float], of: Subject, step: float) -> Findings:
    a, nan, dn = found.approach, math.nan, "DN"
    figures = [
        of.figure("before_dn", found.before, found.sigma_before or nan, "grey value before the step", dn),
        of.figure("step_dn", found.step, nan, "step of the scene", dn, found.direction),
    ]
    refused = {}
    if a.change is not None and a.sigma_change is not None:
        remark = f"chance of none {a.probability:.1g}; {a.verdict}"
        figures.append(of.figure("change_dn", a.change, a.sigma_change, "change by the gain control", dn, remark))
        assert a.time_constant is not None and a.sigma_time_constant is not None
        figures.append(of.figure("time_constant_s", a.time_constant, a.sigma_time_constant, "time constant", "s"))
        settled = a.time_within(max(0.5 * step, a.rms))
        if settled is not None:
            figures.append(of.figure("settled_s", settled, nan, "until within half a grey value or the noise", "s"))
    else:
        refused[f"change by the gain control, {found.name}"] = f"{a.verdict} (chance of none {a.probability:.2g})"
    of_frames = (nan if found.noise.before is None else found.noise.before, found.noise.after)
    for when, value in zip(("before", "after"), of_frames):
        figures.append(of.figure(f"frame_noise_{when}_dn", value, nan, f"noise of a frame's mean {when}", dn))
    for when, value in zip(("before", "after"), pixel):
        figures.append(of.figure(f"pixel_noise_{when}_dn", value, nan, f"noise of a pixel {when} the step", dn))
    t = found.times - found.times[found.first]
    curve = np.linspace(0.0, float(t[-1]), 200)
    caption = "Mean grey value of the window"
    chart = Chart(
        title=f"After the step, {found.name}",
        caption=f"{found.direction}: {a.verdict} (Behr 1989, fig. 4.17).",
        x_label="seconds since the step",
        y_label="grey value",
        curves=(Trace(t, found.values, "measured", "points"), Trace(curve, a.at(curve), "adjusted", "line")),
        marks=((0.0, "step"),),
    )
    table = Table.of(caption, series=found.name, time_s=found.times, mean_dn=found.values)
    return Findings(known(*figures), refused, {"series": table}, (chart,))


def _asymmetry(found: list[GainControl], plane: str) -> Findings:
    """The first transition of each direction compared."""
    dark = next((g for g in found if g.direction == "bright to dark"), None)
    bright = next((g for g in found if g.direction == "dark to bright"), None)
    if dark is None or bright is None:
        return Findings(notes=("transitions in both directions are needed to compare them",))
    try:
        a = compare_transitions(dark, bright)
    except InputError as error:
        return Findings(refused={"asymmetry": str(error)})
    remark = f"chance of equal changes {a.probability:.2g}"
    label = "change after bright to dark minus that after dark to bright"
    return Findings((Subject(plane).figure("asymmetry_dn", a.difference, a.sigma, label, "DN", remark),))
