"""The report of a bundle adjustment: one HTML file that says how good the block is, and what is wrong with it."""

from __future__ import annotations

import numpy as np

from photoplan.orientation.check_points import CheckAccuracy
from photoplan.products.adjust.figures import AdjustFigures
from photoplan.report.adjust.corrections import correction_parts
from photoplan.report.adjust.plots import draw_control, draw_field, draw_network, draw_sigmas
from photoplan.report.adjust.tables import (
    Row,
    camera_parts,
    cell,
    figures,
    ground_table,
    image_parts,
    left_out_parts,
    measurement_table,
    number,
    paragraph,
    plain,
    position_parts,
    to_unit,
    warning,
)
from photoplan.report.drawing import draw_normalised
from photoplan.report.page import figure, headline, page, section, table


def adjust_page(facts: AdjustFigures) -> str:
    """The report as one HTML document without links to anything outside it.

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


def _headline(facts: AdjustFigures) -> list[tuple[str, str, str]]:
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


def _network(facts: AdjustFigures) -> list[str]:
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


def _groups(facts: AdjustFigures) -> list[str]:
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


def _gross(facts: AdjustFigures) -> list[str]:
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


def _control(facts: AdjustFigures) -> list[str]:
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


def _check(facts: AdjustFigures, check: CheckAccuracy) -> list[str]:
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


def _fields(facts: AdjustFigures) -> list[str]:
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


def _record(facts: AdjustFigures) -> list[str]:
    return [
        table(["input", ""], [list(row) for row in facts.inputs]),
        table(["setting", "value"], [list(row) for row in facts.settings]),
    ]
