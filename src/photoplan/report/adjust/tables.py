"""Tables of the report of a bundle adjustment, and how its numbers are written."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from photoplan.plain import two_figures
from photoplan.products.adjust.figures import AdjustFigures, Calibrated, GroundFigures, NamedMeasurement
from photoplan.report.page import Cell, table, text

#: Rows of a list at most; more are counted, and are in the JSON.
MOST_ROWS = 40
#: Correlations that are named.
_HIGH = 0.8
Row = list[str | Cell]


def measurement_table(some: Sequence[NamedMeasurement]) -> str:
    """Observations with their residuals."""
    rows: list[Row] = [
        [m.what, cell(m.residual.replace("-", "−")), cell(plain(m.normalised, 1, sign=True))] for m in some[:MOST_ROWS]
    ]
    more = _more(len(some))
    return table(["observation", "residual", "normalised"], rows) + more


def ground_table(ground: Sequence[GroundFigures], normalised: bool) -> str:
    """Residuals and standard deviations of control or check points."""
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
    """Calibrated parameters of a camera and their correlations."""
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


def position_parts(facts: AdjustFigures) -> list[str]:
    """Residuals of observed positions by strip; drift, lever arm, boresight."""
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


def image_parts(facts: AdjustFigures) -> list[str]:
    """Residuals and standard deviations image by image."""
    order = sorted(facts.images, key=lambda i: -_or_zero(float(np.hypot(*i.rms))))
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


def left_out_parts(facts: AdjustFigures) -> list[str]:
    """What could not take part, by reason."""
    reasons: dict[str, list[str]] = {}
    for name, reason in facts.left_out:
        reasons.setdefault(reason, []).append(name)
    rows: list[Row] = [
        [reason, cell(number(len(names))), ", ".join(names[:8]) + (" …" if len(names) > 8 else "")]
        for reason, names in reasons.items()
    ]
    return [table(["reason", "number", "names"], rows)]


def paragraph(words: str) -> str:
    """A paragraph of escaped text."""
    return f"<p>{text(words)}</p>"


def warning(words: str) -> str:
    """A warning that cannot be overlooked."""
    return f"<p><strong>Warning:</strong> {text(words)}.</p>"


def _more(count: int) -> str:
    return paragraph(f"and {number(count - MOST_ROWS)} more; all are in report.json.") if count > MOST_ROWS else ""


def cell(words: str) -> Cell:
    """A cell with a number."""
    return Cell(words, number=True)


def to_unit(radians: float, unit: str) -> float:
    """Radians in an angle unit."""
    return radians * {"deg": 180.0 / np.pi, "gon": 200.0 / np.pi, "rad": 1.0}[unit]


def _or_zero(value: float) -> float:
    return value if np.isfinite(value) else 0.0


def number(value: int) -> str:
    """With thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u202f")


def plain(value: float, digits: int | None = None, sign: bool = False) -> str:
    """With that number of digits, None: millimetres and two figures at least; a dash where there is no value."""
    if not np.isfinite(value):
        return "–"
    digits = two_figures(value) if digits is None else digits
    return (f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}").replace("-", "−")


def figures(value: float) -> str:
    """Three figures."""
    return f"{value:.3g}".replace("-", "−") if np.isfinite(value) else "–"


def _exact(value: float, sigma: float) -> str:
    """With two figures of the standard deviation."""
    if not (np.isfinite(sigma) and sigma > 0):
        return f"{value:.8g}".replace("-", "−")
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 15))
    return f"{value:.{digits}f}".replace("-", "−")
