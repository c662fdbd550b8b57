"""Report of a bundle adjustment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from photoplan.arrays import Floats
from photoplan.findings import with_sigma
from photoplan.orientation.intersection import CheckAccuracy
from photoplan.plain import two_figures
from photoplan.products.adjust.findings import (
    AdjustReport,
    Calibrated,
    CorrectionFigures,
    GroundFigures,
    NamedMeasurement,
    ResidualField,
)
from photoplan.report.page import (
    BLUE,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    RED,
    SKY,
    SOFT,
    Cell,
    axes_of,
    draw_normalised,
    figure,
    figure_of,
    headline,
    mpl,
    page,
    png,
    round_down,
    section,
    styled,
    table,
    text,
)

_WIDTH = 7.2
#: Radius of the 95 % ellipse of two normal coordinates in standard deviations: root of −2 ln 0.05.
_ELLIPSE_95 = 2.4477
#: Names of control and check points that are written into a map.
_NAMED = 40
#: Tie points that are drawn.
_DOTS = 20_000
_STRIPS = (BLUE, GREEN, PURPLE, SKY, "#7a5c00", INK)


@styled
def draw_network(facts: AdjustReport) -> bytes:
    """Draw image centres by strip, tie points, control and check points."""
    fig, axes = _map(facts)
    step = max(1, -(-len(facts.tie_XY) // _DOTS))
    dots = facts.tie_XY[::step]
    size = float(np.clip(4e3 / max(1, len(dots)), 0.8, 7))
    axes.scatter(*dots.T, s=size, color="#b3bec6", linewidths=0, label="tie points", rasterized=True)
    strips = list(dict.fromkeys(image.strip for image in facts.images))
    for k, strip in enumerate(strips):
        at = np.array([image.center[:2] for image in facts.images if image.strip == strip])
        name = "image centres" + (", one colour a strip" if len(strips) > 1 else "")
        side = float(np.clip(140 / max(1.0, np.sqrt(len(facts.images))), 3, 26))
        axes.scatter(
            *at.T,
            s=side,
            marker="s",
            color=_STRIPS[k % len(_STRIPS)],
            linewidths=0,
            label=name if k == 0 else None,
            zorder=3,
        )
    _ground(axes, facts.ground)
    _legend(fig)
    return png(fig)


@styled
def draw_control(facts: AdjustReport, check: bool) -> tuple[bytes, str]:
    """Draw residual vectors and 95 % ellipses of control or check points; return the scale, too.

    What was taken out has no arrow: its residual would set the scale, and the others could not be seen.
    """
    some = [g for g in facts.ground if g.check == check and np.isfinite(g.residual).any()]
    fig, axes = _map(facts)
    centers = np.array([image.center[:2] for image in facts.images]).reshape(-1, 2)
    axes.scatter(*centers.T, s=2, marker="s", color="#d3dbe0", linewidths=0)
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    axes.set_ylim(bottom - 0.08 * (top - bottom), top)
    kept = [np.where(g.rejected, np.nan, g.residual) for g in some]
    reach = max((float(np.nan_to_num(np.abs(v)).max()) for v in kept), default=0.0)
    spread = max((float(np.sqrt(np.nan_to_num(np.diag(g.covariance)[:2]).max())) for g in some), default=0.0)
    largest = max(reach, _ELLIPSE_95 * spread, 1e-6)
    scale = round_down(max(0.07 * (right - left) / largest, 1e-6))
    for g, residual in zip(some, kept):
        x, y = g.XYZ[:2] if np.isfinite(g.XYZ[:2]).all() else (np.nan, np.nan)
        if not np.isfinite([x, y]).all():
            continue
        _ellipse(axes, (x, y), g.covariance[:2, :2], scale)
        dx, dy, dz = (scale * np.nan_to_num(v) for v in residual)
        if np.isfinite(residual[:2]).any():
            _arrow(axes, x, y, dx, dy, RED)
        if np.isfinite(residual[2]):
            _arrow(axes, x, y, 0.0, dz, BLUE)
    _ground(axes, [g for g in facts.ground if g.check == check], 9.0)
    handles = [
        _key(RED, "horizontal residual"),
        _key(BLUE, "height residual (up: too high)"),
        _key(ORANGE, "95 % ellipse"),
    ]
    fig.legend(handles=handles, loc="outside lower center", ncols=3)
    _scale_bar(axes, scale, largest)
    return png(fig), f"{scale:g}".replace("e+0", "e")


@styled
def draw_sigmas(facts: AdjustReport) -> bytes:
    """Draw standard deviations of the projection centres, horizontal and height."""
    fig = figure_of(_WIDTH, _height(facts, half=True) + 0.9)
    panels = fig.subplots(1, 2, sharex=True, sharey=True)
    at = np.array([image.center for image in facts.images])
    sigma = np.array([image.sigma_center for image in facts.images])
    values = [np.hypot(sigma[:, 0], sigma[:, 1]), sigma[:, 2]]
    side = float(np.clip(300 / max(1.0, np.sqrt(len(at))), 6, 40))
    for axes, value, name in zip(panels, values, ("horizontal", "height")):
        _frame(axes, facts)
        low, high = _limits(value)
        norm = mpl.colors.Normalize(low, high)
        axes.scatter(at[:, 0], at[:, 1], c=value, cmap="viridis_r", norm=norm, s=side, marker="s", linewidths=0)
        axes.set_title(name)
        tints = mpl.cm.ScalarMappable(norm, "viridis_r")
        bar = fig.colorbar(tints, ax=axes, orientation="horizontal", shrink=0.85, aspect=30, pad=0.02)
        bar.set_label("standard deviation m")
        bar.outline.set_visible(False)
    panels[1].set_ylabel("")
    return png(fig)


@styled
def draw_field(field: ResidualField) -> tuple[bytes, str]:
    """Draw mean residual vectors over the image format; return how many times they are enlarged, too."""
    xmin, ymin, xmax, ymax = field.frame
    ratio = (ymax - ymin) / (xmax - xmin)
    fig, axes = axes_of(_WIDTH, float(np.clip(5.6 * ratio, 2.4, 7.0)) + 0.8)
    axes.add_patch(mpl.patches.Rectangle((xmin, ymin), xmax - xmin, ymax - ymin, fill=False, ec=SOFT))
    margin = 0.04 * (xmax - xmin)
    axes.set(xlim=(xmin - margin, xmax + margin), ylim=(ymin - margin, ymax + margin), aspect="equal")
    axes.set(xlabel=f"x {field.unit}", ylabel=f"y {field.unit}")
    axes.grid(False)
    largest = float(np.hypot(*field.mean.T).max()) if len(field.mean) else 0.0
    # One arrow is compared with the noise of its mean: those that stand out are dark.
    unsure = field.noise / np.sqrt(np.maximum(field.count, 1))
    clear = np.hypot(*field.mean.T) > 2.5 * unsure
    key = round_down(max(largest, 1e-6))
    side = np.sqrt((xmax - xmin) * (ymax - ymin) / max(1, len(field.at)))
    scale = 0.85 * side / max(largest, 1e-9)
    for some, colour, name in ((~clear, "#8fa3b0", "within its noise"), (clear, RED, "stands out (2.5 sigma)")):
        if some.any():
            axes.quiver(
                *field.at[some].T,
                *field.mean[some].T,
                angles="xy",
                scale_units="xy",
                scale=1 / scale,
                color=colour,
                width=0.0022,
                label=name,
                zorder=3,
            )
    axes.scatter(*field.at.T, s=3, color=SOFT, linewidths=0, zorder=2)
    x, y = xmin + 0.03 * (xmax - xmin), ymin + 0.03 * (ymax - ymin)
    axes.plot([x, x + key * scale], [y, y], color=INK, linewidth=2.2, solid_capstyle="butt", zorder=5)
    box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1.5}
    axes.annotate(f"{key:g} px", (x, y), (0, 5), textcoords="offset points", fontsize=8, color=INK, bbox=box, zorder=5)
    _legend(fig)
    return png(fig), f"{key:g} px"


def _ground(axes: Any, ground: Sequence[GroundFigures], size: float = 38.0) -> None:
    kinds = ((False, "^", RED, "control"), (True, "o", ORANGE, "check points"))
    for check, marker, colour, name in kinds:
        for seen, word in ((True, name), (False, f"{name}, not measured")):
            some = [g for g in ground if g.check == check and (g.rays > 0) == seen]
            at = np.array([g.XYZ[:2] for g in some]).reshape(-1, 2)
            at = at[np.isfinite(at).all(axis=1)]
            if len(at):
                faces, edge = (colour, "white") if seen else ("none", colour)
                axes.scatter(
                    *at.T, s=size, marker=marker, facecolor=faces, edgecolor=edge, linewidth=0.7, label=word, zorder=4.5
                )
    for g in [g for g in ground if np.isfinite(g.XYZ[:2]).all()][:_NAMED]:
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7 if size > 20 else 0.0, "pad": 0.8}
        axes.annotate(
            _short(g.name), g.XYZ[:2], (5, 4), textcoords="offset points", fontsize=7.5, color=INK, bbox=box, zorder=7
        )


def _ellipse(axes: Any, at: tuple[float, float], covariance: Floats, scale: float) -> None:
    if not np.isfinite(covariance).all():
        return
    values, vectors = np.linalg.eigh(covariance)
    width, height = (2 * _ELLIPSE_95 * scale * float(np.sqrt(max(v, 0.0))) for v in values[::-1])
    angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
    patch = mpl.patches.Ellipse(at, width, height, angle=angle, fill=False, ec=ORANGE, lw=1.2, zorder=4)
    axes.add_patch(patch)


def _bounds(facts: AdjustReport) -> tuple[float, float, float, float]:
    XY = [np.array([image.center[:2] for image in facts.images]).reshape(-1, 2), facts.tie_XY]
    XY.append(np.array([g.XYZ[:2] for g in facts.ground]).reshape(-1, 2))
    every = np.concatenate(XY)
    every = every[np.isfinite(every).all(axis=1)]
    low, high = every.min(axis=0), every.max(axis=0)
    margin = 0.05 * max(float((high - low).max()), 1.0)
    return float(low[0]) - margin, float(low[1]) - margin, float(high[0]) + margin, float(high[1]) + margin


def _height(facts: AdjustReport, half: bool = False) -> float:
    left, bottom, right, top = _bounds(facts)
    width = 3.0 if half else 6.2
    return float(np.clip(width * (top - bottom) / (right - left), 1.6 if half else 2.2, 4.2 if half else 6.4))


def _map(facts: AdjustReport) -> tuple[Any, Any]:
    fig, axes = axes_of(_WIDTH, _height(facts) + 0.8)
    _frame(axes, facts)
    return fig, axes


def _frame(axes: Any, facts: AdjustReport) -> None:
    left, bottom, right, top = _bounds(facts)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="X m", ylabel="Y m")
    axes.grid(False)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(mpl.ticker.MaxNLocator(4, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(mpl.ticker.FuncFormatter(lambda v, _: f"{v:.12g}"))


def _arrow(axes: Any, x: float, y: float, dx: float, dy: float, colour: str) -> None:
    """Draw an arrow whose head is smaller if it is short, so that its length can be seen."""
    head = {"headwidth": 4.5, "headlength": 5.0, "headaxislength": 5.0, "minshaft": 1.5, "minlength": 0.3}
    axes.quiver(
        x,
        y,
        dx,
        dy,
        angles="xy",
        scale_units="xy",
        scale=1,
        units="inches",
        width=0.018,
        color=colour,
        zorder=5,
        **head,
    )


def _key(colour: str, label: str) -> Any:
    return mpl.lines.Line2D([], [], color=colour, linewidth=1.8, label=label)


def _legend(fig: Any) -> None:
    legend = fig.legend(loc="outside lower center", ncols=3)
    for handle in legend.legend_handles:
        if hasattr(handle, "set_sizes"):
            handle.set_sizes([30])


def _scale_bar(axes: Any, scale: float, largest: float) -> None:
    left, right = axes.get_xlim()
    bottom, top = axes.get_ylim()
    length = round_down(largest)
    x, y = left + 0.03 * (right - left), bottom + 0.03 * (top - bottom)
    axes.plot([x, x + length * scale], [y, y], color=INK, linewidth=2.2, solid_capstyle="butt")
    axes.annotate(_metres(length), (x, y), (0, 4), textcoords="offset points", fontsize=8, color=INK)


def _metres(value: float) -> str:
    return f"{value * 1000:g} mm" if value < 0.01 else f"{value * 100:g} cm" if value < 1 else f"{value:g} m"


def _limits(values: Floats) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = float(np.percentile(known, 1)), float(np.percentile(known, 99))
    return low, max(high, low * 1.1 + 1e-6)


def _short(name: str) -> str:
    kept = "".join(c if c.isprintable() else "\ufffd" for c in name)
    return kept if len(kept) <= 16 else kept[:15] + "…"


#: Rows of a list at most; more are counted, and are in the JSON.
MOST_ROWS = 40
#: Correlations that are named.
_HIGH = 0.8
Row = list[str | Cell]


def measurement_table(some: Sequence[NamedMeasurement]) -> str:
    """Return a table of observations with their residuals."""
    rows: list[Row] = [
        [m.what, cell(m.residual.replace("-", "−")), cell(plain(m.normalised, 1, sign=True))] for m in some[:MOST_ROWS]
    ]
    more = _more(len(some))
    return table(["observation", "residual", "normalised"], rows) + more


def ground_table(ground: Sequence[GroundFigures], normalised: bool) -> str:
    """Return a table of residuals and standard deviations of control or check points."""
    rows: list[Row] = []
    for g in ground[:MOST_ROWS]:
        row: Row = [g.name, cell(number(g.rays) if g.rays else "–")]
        row += [cell(plain(v, None, True) + ("*" if r else "")) for v, r in zip(g.residual, g.rejected)]
        row += [cell(plain(v)) for v in g.stated]
        row += [cell(plain(float(v))) for v in np.sqrt(np.diag(g.covariance))]
        if normalised:
            worst = np.nanmax(np.abs(g.normalised)) if np.isfinite(g.normalised).any() else np.nan
            row.append(cell(plain(float(worst), 1)))
        rows.append(row)
    head = ["point", "images", "dX m", "dY m", "dZ m", "stated σX", "σY", "σZ m", "adjusted σX", "σY", "σZ m"]
    starred = any(any(g.rejected) for g in ground)
    note = paragraph("* taken out as a gross error.") if starred else ""
    return table([*head, "normalised"] if normalised else head, rows) + _more(len(ground)) + note


def camera_parts(camera: Calibrated) -> list[str]:
    """Return calibrated parameters of a camera and their correlations."""
    rows: list[Row] = []
    for k, name in enumerate(camera.parameters):
        change = float(camera.after[k] - camera.before[k])
        sigma = float(camera.sigma[k])
        rows.append(
            [
                name,
                camera.units[k],
                *(cell(_exact(float(v), sigma)) for v in (camera.before[k], camera.after[k])),
                cell(figures(sigma)),
                cell(plain(change / sigma, 1, True) if sigma > 0 else "–"),
            ]
        )
    parts = [
        f"<h3>{text(camera.name)}</h3>",
        table(["parameter", "unit", "before", "after", "standard deviation", "change ÷ σ"], rows),
    ]
    if len(camera.parameters) > 1 and np.isfinite(camera.correlation).all():
        count = range(len(camera.parameters))
        matrix: list[Row] = []
        for k, name in enumerate(camera.parameters):
            lower = [plain(float(camera.correlation[k, j]), 2, True) if j < k else "" for j in count]
            matrix.append([name, *(cell(words) for words in lower)])
        parts.append(table(["correlation", *camera.parameters], matrix))
        high = [
            f"{camera.parameters[k]} and {camera.parameters[j]} ({camera.correlation[k, j]:+.2f})"
            for k in range(len(camera.parameters))
            for j in range(k)
            if abs(camera.correlation[k, j]) > _HIGH
        ]
        if high:
            parts.append(
                paragraph(
                    f"Hardly told apart by this block: {'; '.join(high)}. Their sum of effects is determined, not each."
                )
            )
    return parts


def position_parts(facts: AdjustReport) -> list[str]:
    """Return residuals of observed positions by strip; drift, lever arm, boresight."""
    rows: list[Row] = []
    for s in facts.strips[:MOST_ROWS]:
        row: Row = [s.name, cell(number(s.count)), cell(number(s.rejected))]
        row += [cell(plain(v, None, True)) for v in s.mean] + [cell(plain(v)) for v in s.rms]
        rows.append(row)
    head = ["strip", "images", "taken out", "mean dX m", "dY", "dZ", "rms dX m", "dY", "dZ"]
    parts = [table(head, rows) + _more(len(facts.strips))]
    shifted = [s for s in facts.strips if np.isfinite(s.shift).any()]
    if shifted:
        drift: list[Row] = [
            [s.name]
            + [cell(f"{plain(v, None, True)} ± {plain(e)}") for v, e in zip(s.shift, s.sigma_shift)]
            + [cell(f"{figures(v)} ± {figures(e)}") for v, e in zip(s.rate, s.sigma_rate)]
            for s in shifted[:MOST_ROWS]
        ]
        parts.append(table(["strip", "shift X m", "Y", "Z", "rate X m/s", "Y", "Z"], drift) + _more(len(shifted)))
    for name, unit, pair in (
        ("Lever arm", "m", facts.lever_arm),
        ("Boresight angles", facts.angle_unit, facts.boresight),
    ):
        if pair is not None and any(pair[0] + pair[1]):
            values = ", ".join(f"{axis} {figures(v)} ± {figures(e)}" for axis, v, e in zip("xyz", *pair))
            parts.append(paragraph(f"{name}: {values} {unit} (camera axes)."))
    if facts.lever_arm is not None and not any(facts.lever_arm[0] + facts.lever_arm[1]):
        parts.append(paragraph("The antenna is taken to be at the projection centre (lever arm 0, held fixed)."))
    return parts


def image_parts(facts: AdjustReport) -> list[str]:
    """Return residuals and standard deviations image by image."""
    order = sorted(facts.images, key=lambda i: -np.nan_to_num(np.hypot(*i.rms), posinf=0.0))
    rows: list[Row] = []
    for image in order[:MOST_ROWS]:
        row: Row = [
            image.name,
            cell(number(image.measurements)),
            cell(number(image.rejected) if image.rejected else ""),
        ]
        row += [cell(plain(v, None, True)) for v in image.mean]
        row += [cell(plain(v, 2)) for v in (*image.rms, image.worst)]
        row += [cell(plain(v)) for v in image.sigma_center]
        row += [cell(f"{v:.2g}" if np.isfinite(v) else "–") for v in image.sigma_angles]
        rows.append(row)
    unit = facts.angle_unit
    head = [
        "image",
        "points",
        "out",
        "mean x",
        "y px",
        "rms x",
        "y px",
        "worst",
        "σX",
        "σY",
        "σZ m",
        "σ angles",
        "",
        unit,
    ]
    return [
        paragraph(
            "Images with the largest residuals first. Mean and rms are of the residuals in columns and rows, worst "
            "is the largest normalised residual, σ the standard deviations of the orientation."
        ),
        table(head, rows) + _more(len(order)),
    ]


def left_out_parts(facts: AdjustReport) -> list[str]:
    """Return what could not take part, by reason."""
    reasons: dict[str, list[str]] = {}
    for name, reason in facts.left_out:
        reasons.setdefault(reason, []).append(name)
    rows: list[Row] = [
        [reason, cell(number(len(names))), ", ".join(names[:8]) + (" …" if len(names) > 8 else "")]
        for reason, names in reasons.items()
    ]
    return [table(["reason", "number", "names"], rows)]


def paragraph(words: str) -> str:
    """Return a paragraph of escaped text."""
    return f"<p>{text(words)}</p>"


def warning(words: str) -> str:
    """Return a warning that cannot be overlooked."""
    return f"<p><strong>Warning:</strong> {text(words)}.</p>"


def _more(count: int) -> str:
    return paragraph(f"and {number(count - MOST_ROWS)} more; all are in report.json.") if count > MOST_ROWS else ""


def cell(words: str) -> Cell:
    """Return a cell with a number."""
    return Cell(words, number=True)


def to_unit(radians: float, unit: str) -> float:
    """Return radians in an angle unit."""
    return radians * {"deg": 180.0 / np.pi, "gon": 200.0 / np.pi, "rad": 1.0}[unit]


def number(value: int) -> str:
    """Return a number with thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u202f")


def plain(value: float, digits: int | None = None, sign: bool = False) -> str:
    """Return a number with so many digits, by default millimetres and two figures at least; a dash without a value."""
    if not np.isfinite(value):
        return "–"
    digits = two_figures(value) if digits is None else digits
    return (f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}").replace("-", "−")


def figures(value: float) -> str:
    """Return a number with three figures."""
    return f"{value:.3g}".replace("-", "−") if np.isfinite(value) else "–"


def _exact(value: float, sigma: float) -> str:
    """Return a number with two figures of its standard deviation."""
    if not (np.isfinite(sigma) and sigma > 0):
        return f"{value:.8g}".replace("-", "−")
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 15))
    return f"{value:.{digits}f}".replace("-", "−")


def correction_parts(corrections: tuple[CorrectionFigures, ...]) -> list[str]:
    """Return residuals and corrections image by image, of strips also over time."""
    rows: list[Row] = []
    for image in corrections:
        row: Row = [image.name, image.group, cell(number(image.measurements)), cell(number(image.rejected))]
        row += [cell(plain(v, 3, True)) for v in image.mean]
        row += [cell(plain(v, 2)) for v in (*image.rms, image.worst)]
        found = (f"{p.name} {with_sigma(p.value, p.sigma, p.unit, signed=True)}" for p in image.parameters)
        rows.append([*row, "; ".join(found)])
    head = ["image", "geometry", "points", "out", "mean x", "y px", "rms x", "y px", "worst", "correction"]
    parts = [
        paragraph(
            "Images whose geometry comes with them, and what it is off by, with standard deviations. Shifts of "
            "polynomials are those in the middle of the image; what changes by row or column is what it has become at "
            "the last one."
        ),
        table(head, rows),
    ]
    for image in corrections:
        if len(image.seconds):
            parts.append(
                figure(
                    _over_time(image),
                    f"{image.name} over time",
                    "Residuals of the image points at the moment of their line, and the corrections of the trajectory. "
                    "A wave that is left in the residuals asks for knots that are closer together.",
                )
            )
        if image.angles is not None:
            parts.append(
                figure(
                    _angles_of(image.angles),
                    f"{image.name}: angles of the flight",
                    "Angles of the camera at the moments of its lines, as adjusted (Schlüter 2001, fig. 4b). Lines "
                    "that are shaken have angles of their own.",
                )
            )
    return parts


@styled
def _angles_of(angles: tuple[Floats, Floats]) -> bytes:
    fig = figure_of(7.2, 4.6)
    panels = fig.subplots(3, 1, sharex=True)
    for axes, name, colour, values in zip(panels, ("ω °", "φ °", "κ °"), (BLUE, GREEN, RED), angles[1].T):
        axes.plot(angles[0], np.degrees(np.unwrap(values)), color=colour, linewidth=0.8)
        axes.set_ylabel(name)
    panels[-1].set_xlabel("seconds of the flight")
    return png(fig)


@styled
def _over_time(image: CorrectionFigures) -> bytes:
    count = 1 if image.over_time is None else 3
    fig = figure_of(7.2, 1.2 + 1.5 * count)
    panels = np.atleast_1d(fig.subplots(count, 1, sharex=True))
    for k, (name, colour) in enumerate((("across (columns)", BLUE), ("along (rows)", ORANGE))):
        panels[0].scatter(image.seconds, image.residuals[:, k], s=6, color=colour, linewidths=0, label=name)
    panels[0].set_ylabel("residual px")
    panels[0].legend(loc="upper right", fontsize=8, ncols=2)
    if image.over_time is not None:
        t, values = image.over_time
        kinds = (("position m", values[:, :3], ("east", "north", "up")),
                 ("attitude °", np.degrees(values[:, 3:]), ("about x", "about y", "about z")))  # fmt: skip
        for axes, (label, rows, names) in zip(panels[1:], kinds):
            for column, name, colour in zip(rows.T, names, (BLUE, GREEN, RED)):
                axes.plot(t, column, color=colour, marker=".", linewidth=1.0, label=name)
            axes.set_ylabel(label)
            axes.legend(loc="upper right", fontsize=8, ncols=3)
    panels[-1].set_xlabel("seconds of the flight")
    return png(fig)


def adjust_page(facts: AdjustReport) -> str:
    """Return the report as one HTML document without links to anything outside it.

    Names and texts are escaped; what they contain is shown and never obeyed.
    """
    parts = [headline(_headline(facts))]
    if facts.notes:
        parts.append("".join(paragraph(note) for note in facts.notes))
    parts.append(section("Network", _network(facts)))
    parts.append(section("Observations and their accuracy", _groups(facts)))
    parts.append(section("Gross errors", _gross(facts)))
    if any(not g.check for g in facts.ground):
        parts.append(section("Control points", _control(facts)))
    if facts.check is not None:
        parts.append(section("Check points", _check(facts, facts.check)))
    if facts.fields:
        parts.append(section("Systematic image errors", _fields(facts)))
    if facts.cameras:
        parts.append(section("Calibration", [part for camera in facts.cameras for part in camera_parts(camera)]))
    if facts.strips:
        parts.append(section("Observed positions and attitudes", position_parts(facts)))
    if facts.images:
        parts.append(section("Images", image_parts(facts)))
    if facts.corrections:
        parts.append(section("Satellites and strips", correction_parts(facts.corrections)))
    if facts.left_out:
        parts.append(section("Left out", left_out_parts(facts)))
    parts.append(section("Inputs and settings", _record(facts)))
    return page(facts.title, facts.crs, parts)


def _headline(facts: AdjustReport) -> list[tuple[str, str, str]]:
    control = [g for g in facts.ground if not g.check]
    sigma = np.array([image.sigma_center for image in facts.images])
    mean = np.sqrt(np.mean(sigma**2, axis=0)) if len(sigma) else np.full(3, np.nan)
    spread = "standard deviation, horizontal · height, root mean square"
    fit = "1 where the stated standard deviations are right"
    boxes = [
        (plain(facts.sigma0, 3), "sigma0", fit),
        (
            f"{plain(facts.rms_pixels, 3)} px",
            "image residuals",
            f"root mean square of {number(2 * facts.measurements)} coordinates",
        ),
        (number(facts.redundancy), "redundancy", f"{number(facts.unknowns)} unknowns, {facts.iterations} iterations"),
        (
            number(len(facts.images) + len(facts.corrections)),
            "images",
            f"{len(facts.left_out)} images and points could not take part",
        ),
        (number(facts.points), "points", f"in {plain(facts.mean_rays, 1)} images on average"),
        (number(facts.rejected), "gross errors", "measurements taken out" if facts.robust else "none were sought"),
        *(
            (f"{plain(float(np.hypot(m[0], m[1])))} · {plain(float(m[2]))} m", "projection centres", spread)
            for m in ([mean] if len(sigma) else [])
        ),
        (f"{plain(float(np.hypot(*facts.point_sigma[:2])))} · {plain(facts.point_sigma[2])} m", "tie points", spread),
    ]
    if facts.check is not None:
        c = facts.check
        boxes.append(
            (
                f"{plain(c.rmse_h)} · {plain(c.rmse_v)} m",
                "RMSE_H · RMSE_V",
                f"{max(c.horizontal, c.vertical)} check points",
            )
        )
    elif control:
        r = np.array([g.residual for g in control])
        rms = [float(np.sqrt(np.nanmean(r[:, k] ** 2))) if np.isfinite(r[:, k]).any() else np.nan for k in range(3)]
        value = f"{plain(float(np.hypot(rms[0], rms[1])))} · {plain(rms[2])} m"
        boxes.append((value, "control residuals", f"root mean square, horizontal · height; {len(control)} points"))
    return boxes


def _network(facts: AdjustReport) -> list[str]:
    control = [g for g in facts.ground if not g.check]
    check = len(facts.ground) - len(control)
    return [
        figure(
            draw_network(facts),
            "Network",
            f"{len(facts.images) + len(facts.corrections)} images, {number(facts.points)} points, {len(control)} "
            f"control and {check} check points.",
        ),
        *(
            figure(
                draw_sigmas(facts),
                "Standard deviations of the projection centres",
                "They grow at the edges of the block, and where images hang on few points or little control.",
            )
            for _ in facts.images[:1]
        ),
    ]


def _groups(facts: AdjustReport) -> list[str]:
    rows: list[Row] = []
    for g in facts.groups:
        share = g.redundancy / g.count if g.count else np.nan
        shown, unit = (g.rms, g.unit) if g.unit != "rad" else (to_unit(g.rms, facts.angle_unit), facts.angle_unit)
        rows.append(
            [
                g.name,
                cell(number(g.count)),
                cell(plain(g.redundancy, 1)),
                cell(plain(100 * share, 0) + " %" if np.isfinite(share) else "–"),
                cell(f"{figures(shown)} {unit}"),
                cell(plain(g.factor, 2) if np.isfinite(g.factor) else "–"),
            ]
        )
    head = ["observations", "number", "redundancy", "controlled", "residuals, rms", "found ÷ stated"]
    return [
        table(head, rows),
        paragraph(
            "Controlled: the share of an error in an observation that shows in its residual. Found ÷ stated: the "
            "root of "
            "the variance factor; above 1 the stated standard deviation is too small, below 1 too large. It is sound "
            "only "
            "where the redundancy is more than about 30."
        ),
        figure(
            draw_normalised(facts.normalised, facts.critical, "image points"),
            "Normalised residuals of image points",
            "Each residual divided by its own standard deviation, beside the normal curve; dotted: the limit beyond "
            "which "
            "a measurement is taken for a gross error. Values beyond the edges are in the outermost classes.",
        ),
    ]


def _gross(facts: AdjustReport) -> list[str]:
    parts: list[str] = []
    if facts.gross:
        parts.append(
            paragraph(
                "Taken out of the adjustment; residuals are those against the result without them. Measure them again: "
                "a point that was exchanged shows in several images."
            )
        )
        parts.append(measurement_table(facts.gross))
    else:
        parts.append(paragraph("None was found." if facts.robust else "None were sought."))
    if facts.worst:
        parts.append("<h3>Largest of those that were kept</h3>")
        parts.append(measurement_table(facts.worst))
    return parts


def _control(facts: AdjustReport) -> list[str]:
    picture, scale = draw_control(facts, check=False)
    out = any(any(g.rejected) for g in facts.ground if not g.check)
    return [
        figure(
            picture,
            f"Residuals of control × {scale}",
            "Adjusted minus given coordinates, with the 95 % confidence ellipses of the adjusted points, in the same "
            f"scale.{' What was taken out as a gross error has no arrow.' if out else ''}",
        ),
        ground_table([g for g in facts.ground if not g.check], normalised=True),
    ]


def _check(facts: AdjustReport, check: CheckAccuracy) -> list[str]:
    rows: list[Row] = []
    for name, k in (("X", 0), ("Y", 1), ("Z", 2)):
        count = check.vertical if k == 2 else check.horizontal
        rows.append([name, cell(number(count)), cell(plain(check.mean[k], None, True)), cell(plain(check.rmse[k]))])
    totals: list[Row] = [
        ["horizontal (RMSE_H)", cell(plain(check.fit_h)), cell(plain(check.survey_h)), cell(plain(check.rmse_h))],
        ["vertical (RMSE_V)", cell(plain(check.fit_v)), cell(plain(check.survey_v)), cell(plain(check.rmse_v))],
        ["in space (RMSE_3D)", cell(""), cell(""), cell(plain(check.rmse_3d))],
    ]
    picture, scale = draw_control(facts, check=True)
    return [
        paragraph(
            "After the ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2 (2023). Check "
            "points take "
            "no part in the adjustment."
        ),
        *(warning(said) for said in check.warnings),
        table(["accuracy", "fit to check points m", "survey m", "together m"], totals),
        table(["coordinate", "check points", "mean error m", "RMSE m"], rows),
        figure(
            picture,
            f"Residuals of check points × {scale}",
            "Adjusted minus surveyed coordinates, with the 95 % confidence ellipses of the adjusted points, in the "
            "same scale.",
        ),
        ground_table([g for g in facts.ground if g.check], normalised=False),
    ]


def _fields(facts: AdjustReport) -> list[str]:
    parts = [
        paragraph(
            "Mean residuals (computed minus measured) of all images in cells of the image format. A pattern that hangs "
            "together is an error of the camera's model: a lens, a principal point or a film that calibration "
            "parameters may take up."
        )
    ]
    for field in facts.fields:
        picture, key = draw_field(field)
        parts.append(
            figure(
                picture,
                f"Camera {field.camera}",
                f"Mean residuals of {number(int(field.count.sum()))} measurements; the bar is {key}. Red arrows are "
                "longer "
                "than 2.5 times the standard deviation of their mean.",
            )
        )
    return parts


def _record(facts: AdjustReport) -> list[str]:
    return [
        table(["input", ""], [list(row) for row in facts.inputs]),
        table(["setting", "value"], [list(row) for row in facts.settings]),
    ]
