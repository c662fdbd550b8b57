"""Analysis `fall_off`: light fall-off of lens and lighting, with its correction file."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from photoplan.errors import InputError
from photoplan.geometry.grid import Window
from photoplan.io.fall_off_file import FallOffEntry, TermEntry, fall_off_text
from photoplan.io.series.pixels import Plane
from photoplan.products.characterise.common import black_of, of_one_temperature
from photoplan.products.characterise.data import SeriesData, Setting
from photoplan.products.characterise.groups import FrameGroup
from photoplan.products.characterise.result import Chart, Figure, Findings, Listing, Plate, Trace, joined
from photoplan.quality.camera.fall_off import FallOff, fit_fall_off
from photoplan.quality.camera.fall_off_adjust import FallOffSettings
from photoplan.quality.camera.fall_off_model import FallOffModel, gain_image

_SATURATED = 1e-3
#: Longer side of the gain image that is written.
_GAIN_SIDE = 1024

Array = NDArray[np.float64]


def missing(data: SeriesData) -> str | None:
    """What the series lacks."""
    return (
        None if data.series.of("flat") else "flat frames: an evenly lit surface without structure, all over the image"
    )


def analyse(data: SeriesData) -> Findings:
    """Light fall-off of the brightest flat frames that are not saturated."""
    setting = _brightest(data)
    flats = {name: (stack.mean, stack.counted) for name, stack in data.stacks(setting).items()}
    dark, note = _dark(data, setting)
    parts = []
    for plane in data.planes:
        mean, counted = flats[plane.name]
        image = _whole(data, setting, plane, np.where(counted, mean, np.nan) if counted is not None else mean)
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
    best: tuple[float, Setting] | None = None
    for setting in data.settings("flat"):
        levels = data.levels(setting).values()
        if max(level.saturated_share for level in levels) > _SATURATED:
            continue
        mean = float(np.mean([level.mean for level in levels]))
        if best is None or mean > best[0]:
            best = mean, setting
    if best is None:
        full = ", ".join(f"{data.saturation_dn(plane.name):.4g}" for plane in data.planes)
        raise InputError(
            f"{data.series.path}: all flat frames are saturated (more than {100 * _SATURATED:g} % of the pixels at "
            f"{full} DN); take flat frames with less light"
        )
    return best[1]


def _dark(data: SeriesData, flat: Setting) -> tuple[dict[str, Array | float], str]:
    """Mean dark image at the same exposure and window, else the grey value that other dark frames or the file tell."""
    for setting in data.settings("dark"):
        same = setting.first.exposure_ms == flat.first.exposure_ms and of_one_temperature(setting, flat)
        if same and setting.first.group.window == flat.first.group.window:
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
    """What the camera's facts and the entry's values say."""
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
    terms = tuple((plane, t.n, t.m, t.coefficient, t.sigma) for t in found.terms)
    corners = tuple((plane, c.name, *_percent(c.total, c.sigma, c.natural, c.artificial)) for c in found.corners)
    dirt = tuple(
        (plane, *_place(of, d.x, d.y), d.width * of.step, d.height * of.step, 100 * d.depth) for d in found.dirt
    )
    head = ("plane", "corner", "total_percent", "sigma", "natural_percent", "artificial_percent")
    return Findings(
        _figures(found, of),
        refused,
        {
            "corners": Listing(head, corners, "Brightness lost in the corners"),
            "terms": Listing(
                ("plane", "n", "m", "coefficient", "sigma"), terms, "Terms r^n cos(m θ) of the polynomial"
            ),
            "dirt": Listing(("plane", "x", "y", "width", "height", "depth_percent"), dirt, "Dust and stains"),
        },
        _plots(found, of),
        tuple(notes),
        {f"separability{suffix}": found.separability} if found.separability else {},
        {
            names[0]: correction_text(found, plane, names[1], factor).encode(),
            names[1]: gain_image(found.model, factor),
        },
    )


def _place(plane: Plane, x: float, y: float) -> tuple[float, float]:
    """Column and row in the image of a place in the whole array of a plane."""
    return plane.col + plane.step * x, plane.row + plane.step * y


def _percent(*values: float | None) -> tuple[float | str, ...]:
    return tuple("" if v is None else 100.0 * v for v in values)


def _figures(found: FallOff, of: Plane) -> tuple[Figure, ...]:
    """Lengths in pixels of the image, of which a colour has every second one."""
    nan, plane, step = math.nan, of.name, of.step

    def figure(name: str, value: float, sigma: float, label: str, unit: str = "%", at: str = "") -> Figure:
        return Figure(name, value, sigma, label, unit, plane, at)

    figures = [figure("centre_dn", found.level, found.sigma_level, "grey value at the principal point", "DN")]
    for c in found.corners:
        figures.append(figure("corner_percent", 100 * c.total, 100 * c.sigma, "fall-off in the corner", at=c.name))
        if c.natural is not None and c.artificial is not None:
            figures.append(figure("natural_percent", 100 * c.natural, nan, "natural part cos⁴ω", at=c.name))
            figures.append(figure("artificial_percent", 100 * c.artificial, nan, "artificial part", at=c.name))
    if found.camera_constant is not None and found.sigma_camera_constant is not None:
        constant, s = step * found.camera_constant, step * found.sigma_camera_constant
        figures.append(figure("camera_constant_px", constant, s, "camera constant from the fall-off", "px"))
    if found.sigma_principal_point is not None:
        for axis, value, s in zip("xy", _place(of, *found.model.principal_point), found.sigma_principal_point):
            figures.append(figure(f"principal_point_{axis}_px", value, step * s, f"principal point {axis}", "px"))
    figures += [
        figure("asymmetry_percent", 100 * found.asymmetry, nan, "largest difference of two corners"),
        figure("range_before_percent", 100 * found.range_before, nan, "brightest minus darkest before correction"),
        figure("residual_percent", 100 * found.residual_rms, nan, "left after correction, rms"),
        figure("residual_largest_percent", 100 * found.residual_largest, nan, "left after correction, largest"),
        figure("dirt", len(found.dirt), nan, "places with dust or stains", ""),
    ]
    return tuple(figures)


def _plots(found: FallOff, plane: Plane) -> tuple[Chart | Plate, ...]:
    assert found.blocks is not None and found.residuals is not None
    blocks, model = found.blocks, found.model
    of = f", {plane.name}" if plane.name else ""
    left, upper = _place(plane, -0.5, -0.5)
    right, lower = _place(plane, model.size[0] - 0.5, model.size[1] - 0.5)
    extent = (left, right, lower, upper)
    dirt = tuple(_place(plane, d.x, d.y) for d in found.dirt[:30])
    relative = blocks.values / found.level
    return (
        Plate(
            f"Brightness{of}",
            "Mean of the flat frames in blocks, relative to the principal point (Behr 1989, fig. 4.9).",
            100 * relative,
            "%",
            points=dirt,
            extent=extent,
        ),
        _profile(found, of, plane.step),
        Plate(
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
    radial = FallOffModel(
        model.size,
        model.principal_point,
        model.camera_constant,
        tuple(t for t in model.terms if t[1] == 0),
        tuple(c for t, c in zip(model.terms, model.coefficients) if t[1] == 0),
    )
    curves.append(Trace(r, 100 * radial.relative(x, y), "symmetric part", "line", colour=3))
    return Chart(
        f"Fall-off from the principal point{of}",
        "Relative brightness; the spread of the blocks at one distance is asymmetry, noise and dust.",
        "distance from the principal point px",
        "% of the brightness there",
        tuple(curves),
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
