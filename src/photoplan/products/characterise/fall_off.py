"""Analysis `fall_off`: light fall-off of lens and lighting, with its correction file."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.findings import Chart, Estimate, Findings, Picture, Subject, Table, Trace, joined
from photoplan.geometry.grid import Window
from photoplan.io.quality_files import FallOffEntry, TermEntry, fall_off_text
from photoplan.io.series import Plane
from photoplan.products.characterise.common import black_of, dark_like
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.products.characterise.groups import FrameGroup
from photoplan.quality.camera.fall_off import FallOff, FallOffSettings, fit_fall_off, gain_image

_SATURATED = 1e-3
#: Longer side of the gain image that is written.
_GAIN_SIDE = 1024

Array = NDArray[np.float64]


def missing(data: SeriesData) -> str | None:
    """Return what the series lacks."""
    return (
        None if data.series.of("flat") else "flat frames: an evenly lit surface without structure, all over the image"
    )


def analyse(data: SeriesData) -> Findings:
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
        return _outcome(fit_fall_off(image, settings), plane, setting)
    except InputError as error:
        if settings.natural != "estimated" or "natural" in setting.first.group.entry.values:
            raise
        rest = replace(settings, natural="none")
        refused = Findings(refused={f"natural part{f' ({plane.name})' if plane.name else ''}": str(error)})
        return joined([_outcome(fit_fall_off(image, rest), plane, setting), refused])


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


def _outcome(found: FallOff, of: Plane, setting: Setting) -> Findings:
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
        plots=_plots(found, of),
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


def _plots(found: FallOff, plane: Plane) -> tuple[Chart | Picture, ...]:
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
