"""The report of a built terrain model: one HTML file that says how good the model is, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from photoplan.geometry.crs import crs_label
from photoplan.io.product import check_output
from photoplan.products.dtm.build import BuildReport
from photoplan.report.drawing import draw_normalised, has_matplotlib, load_matplotlib
from photoplan.report.dtm.plots import (
    LINE_WORDS,
    draw_covariance,
    draw_filter_histograms,
    draw_filter_map,
    draw_gross,
    draw_heights,
    draw_sigmas,
)
from photoplan.report.dtm.samples import WORDS, BuildSamples, PlottedError, ReportMap
from photoplan.report.page import Cell, ReportFile, figure, headline, page, section, table, text
from photoplan.surfaces.measured import MeasuredTerrain
from photoplan.terrain.build import BuildPlan, Built
from photoplan.terrain.calibration import ClassFigures, SigmaFactor
from photoplan.terrain.clean.run import Finding

#: Rows of a list at most: more are counted.
MOST_ROWS = 2000
#: Notes of one kind that are spelled out.
MOST_NOTES = 50


def open_build_report(output: Path, wanted: bool | None, overwrite: bool) -> ReportFile | None:
    """The page beside a model to be, before any work; None: it is not wanted, or left open and matplotlib is
    missing.
    """
    if wanted is False:
        return None
    path = output.with_name(f"{output.stem}.report.html")
    check_output(path, overwrite=overwrite)
    if wanted is None and not has_matplotlib():
        return None
    load_matplotlib("the report", "give `report=False`")
    return ReportFile(path)


def build_page(model: BuildReport, inputs: Sequence[Path], samples: BuildSamples) -> str:
    """The report as one HTML document without links to anything outside it.

    Names and texts are escaped; what they contain is shown and never obeyed.
    """
    parts = [
        headline(_headline(model, samples)),
        section("The surface", _surface(samples.map)),
        section("How well the model fits its points", _fit(model.built, samples)),
        section("What the filter did", _effect(samples)),
        section("Gross errors", _gross(model.built.plan.settings.gross, samples)),
        section("What was found in the measurements", _notes(model)),
        section("Inputs and settings", _record(model.built.plan, inputs)),
    ]
    return page(model.path.stem, _systems(model.measured), parts)


def _headline(model: BuildReport, samples: BuildSamples) -> list[tuple[str, str, str]]:
    """Figure, what it is, and what to compare it with."""
    built, whole = model.built, model.built.fit.whole
    counts = _counts(model.measured)
    points = sum(count for kind, count in counts if "point" in kind or "spot" in kind)
    lines = sum(count for _, count in counts) - points
    full = Counter(built.plan.layout.side / f.meshes for f in built.figures if f.meshes > 0)
    widths = ", ".join(f"{width:g} m in {_number(count)}" for width, count in sorted(full.items()))
    limit = built.plan.settings.gross
    return [
        (_number(points), "points", "; ".join(f"{kind} {_number(n)}" for kind, n in counts if n)),
        (_number(lines), "lines", "with their intersections with the grid"),
        (
            _number(full.total()),
            "computing units",
            f"{widths}; {_number(len(built.figures) - full.total())} units are empty",
        ),
        (_metres(built.sigma), "standard deviation of heights", "root mean square over the posts that data surround"),
        (_metres(whole.noise), "noise of mass points", "their filter value"),
        (
            f"{np.sqrt(whole.variance):.3g} m",
            "standard deviation of the signal",
            f"{whole.name} covariance function, half its value at {whole.length:.3g} m",
        ),
        (_plain(samples.spread, 2), "spread of normalised residuals", "1 where the stochastic model fits"),
        (
            _number(len(samples.gross)),
            "gross errors",
            "none were sought" if limit == 0 else f"beyond {limit:g} standard deviations, left out",
        ),
        (_time(model.figures["seconds"]), "to build the model", ""),
    ]


def _surface(area: ReportMap) -> list[str]:
    kinds = [LINE_WORDS.get(kind, kind) for kind in sorted({kind for kind, _ in area.lines})]
    return [
        figure(
            draw_heights(area),
            "Map of heights",
            f"Heights, shaded as if lit from the north-west. {'Lines: ' + ', '.join(kinds) + '. ' if kinds else ''}"
            "White: no surface, outside the border lines or too far from data.",
        ),
        figure(
            draw_sigmas(area),
            "Map of standard deviations",
            "Standard deviation of the predicted height. It grows where points are sparse and towards the edges.",
        ),
    ]


def _fit(built: Built, samples: BuildSamples) -> list[str]:
    return [
        figure(
            draw_normalised(samples.normalised, built.plan.settings.gross, "points"),
            "Histogram of normalised residuals",
            "Difference of each point from what its neighbours predict, in its standard deviations, beside the normal "
            "curve. A narrower histogram means that standard deviations are too large, a wider one that they are too "
            "small. The model's standard deviations follow the spread around each place, and what held-out blocks say.",
        ),
        figure(
            draw_covariance(samples.covariance),
            "Covariance functions",
            "Left: the fitted function of the whole area, and the range of eight in ten units. Right: covariance of "
            "the heights above a plane through each neighbourhood (dots), and what the fitted functions let expect of "
            "it after the same plane is taken away (line).",
        ),
        *([f"<p><strong>{text(samples.covariance.warning)}</strong></p>"] if samples.covariance.warning else []),
        *_held_out(built.fit.calibration, built.fit.seen.spacing),
    ]


def _held_out(found: SigmaFactor, spacing: float) -> list[str]:
    """What blocks that were held out say of the standard deviations."""
    classes, bent = ([c for c in each if c.count] for each in (found.classes, found.bends))
    if not classes:
        return []
    parts = [f"{100 * (c.furthest - c.nearest):.0f} %" for c in bent]
    words = ("weakest", *("next" for _ in parts[2:]), "strongest")
    bends = [(f"{word} {part}", c) for word, part, c in zip(words, parts, bent)]
    return [
        "<p>Blocks of heights were held out and predicted from all others. Their errors, divided by the standard "
        "deviations, have this spread (1: standard deviations are right; more: they are too small):</p>",
        _classes("distance to data", [(_distances(c.nearest * spacing, c.furthest * spacing), c) for c in classes]),
        "<p>The same by curvature of the ground. Nothing is corrected by it: at edges and crests without lines, "
        "standard deviations may be too small.</p>",
        _classes("curvature", bends),
    ]


def _distances(nearest: float, furthest: float) -> str:
    return f"{nearest:.3g} to {furthest:.3g} m" if np.isfinite(furthest) else f"over {nearest:.3g} m"


def _classes(what: str, named: Sequence[tuple[str, ClassFigures]]) -> str:
    rows: list[list[str | Cell]] = []
    for where, c in named:
        after = f"{c.after:.2f}" if c.enough else "too few blocks"
        words = (_number(c.count), _number(c.blocks), f"{c.before:.2f}", after)
        rows.append([where, *(Cell(word, number=True) for word in words)])
    return table([what, "heights", "blocks", "as predicted", "as stated in the model"], rows)


def _effect(samples: BuildSamples) -> list[str]:
    effects = [effect for effect in samples.effects if np.isfinite(effect.differences).any()]
    if not effects:
        return ["<p>No point or line with heights lies on the surface.</p>"]
    rows = []
    for effect in samples.effects:
        d = effect.differences[np.isfinite(effect.differences)]
        figures = [_number(effect.count), _plain(effect.sigma)]
        if len(d):
            figures += [_plain(float(d.mean()), sign=True)]
            figures += [_plain(float(v)) for v in (np.sqrt((d**2).mean()), np.abs(d).max())]
        else:
            figures += ["–"] * 3
        row: list[str | Cell] = [effect.name, *(Cell(text, number=True) for text in figures)]
        rows.append(row)
    shown = sum(len(effect.differences) for effect in effects)
    every = sum(effect.count for effect in effects)
    sample = f" Shown are {_number(shown)} of {_number(every)} heights, evenly taken." if shown < every else ""
    return [
        table(["class", "number", "filter value m", "mean m", "root mean square m", "largest m"], rows),
        figure(
            draw_filter_histograms(effects),
            "Histograms of measured minus filtered heights",
            f"Measured minus filtered heights by class; gross errors are not among them.{sample}",
        ),
        figure(
            draw_filter_map(effects, samples.map),
            "Map of measured minus filtered heights",
            "Places of one colour that hang together are features that the filter took for noise, or errors of a whole "
            "series of measurements.",
        ),
    ]


def _gross(limit: float, samples: BuildSamples) -> list[str]:
    if not samples.gross and not samples.suspects:
        return ["<p>None were sought.</p>" if limit == 0 else "<p>None was found.</p>"]
    order = sorted(samples.gross, key=lambda g: -abs(g.normalised))
    parts = [
        figure(
            draw_gross(order, samples.suspects, samples.map),
            "Map of gross errors",
            "Where gross errors lie; the largest have the numbers of the list. Circles: suspects.",
        )
    ]
    if order:
        parts += [
            "<p>Points that contradict what their neighbours predict, alone or as a small group whose border breaks "
            "off all round. They were not used.</p>",
            *_errors(order),
        ]
    if samples.suspects:
        parts += [
            "<p>Suspects: small groups of points whose border breaks off in part, or that lie at the edge of the data. "
            "They were used; normalised residuals are those that each group has without itself. Is there a rock, a "
            "roof, a heap? Else take them out.</p>",
            *_errors(samples.suspects),
        ]
    return parts


def _errors(order: Sequence[PlottedError]) -> list[str]:
    rows: list[Sequence[str | Cell]] = [
        [
            Cell(str(k), number=True),
            g.name,
            *(Cell(text, number=True) for text in (f"{g.X:.2f}", f"{g.Y:.2f}", f"{g.height:.3f}")),
            Cell(_plain(g.difference, 3, sign=True), number=True),
            Cell(_plain(g.normalised, 1, sign=True), number=True),
        ]
        for k, g in enumerate(order[:MOST_ROWS], 1)
    ]
    parts = [table(["no.", "point", "X m", "Y m", "height m", "above the model m", "normalised residual"], rows)]
    if len(order) > MOST_ROWS:
        parts.append(f"<p>and {_number(len(order) - MOST_ROWS)} more.</p>")
    return parts


def _notes(model: BuildReport) -> list[str]:
    notes = (*(Finding("while reading", note) for note in model.measured.notes), *model.findings)
    if not notes:
        return ["<p>Nothing: lines meet in common points, no two points coincide.</p>"]
    rows: list[Sequence[str | Cell]] = []
    for kind in dict.fromkeys(note.kind for note in notes):
        some = [note for note in notes if note.kind == kind]
        for k, note in enumerate(some[:MOST_NOTES]):
            place = f"{note.X:.2f}, {note.Y:.2f}" if np.isfinite([note.X, note.Y]).all() else ""
            rows.append([kind if k == 0 else "", note.text, Cell(place, number=True)])
        if len(some) > MOST_NOTES:
            rows.append(["", f"and {_number(len(some) - MOST_NOTES)} more of this kind", ""])
    return [table(["kind", "finding", "X, Y m"], rows)]


def _record(plan: BuildPlan, inputs: Sequence[Path]) -> list[str]:
    return [
        table(["input", ""], [[path.name, _size(path)] for path in inputs]),
        table(["setting", "value"], _settings(plan)),
    ]


def _systems(measured: MeasuredTerrain) -> str:
    plan = "CRS not stated" if measured.crs is None else crs_label(measured.crs)
    return f"{plan}; heights: {measured.height_system or 'system not stated'}"


def _counts(measured: MeasuredTerrain) -> tuple[tuple[str, int], ...]:
    points: Counter[str] = Counter()
    for group in measured.points:
        points[group.kind] += len(group.xyz)
    lines = Counter(line.kind for line in measured.lines)
    return tuple((word, points.get(kind, 0) + lines.get(kind, 0)) for kind, word in WORDS.items())  # type: ignore[call-overload]


def _size(path: Path) -> str:
    """Size and folder of a file."""
    try:
        size = f"{path.stat().st_size / 1e6:.3g} MB, in "
    except OSError:
        size = "in "
    return f"{size}{path.absolute().parent}"


def _settings(plan: BuildPlan) -> list[list[str | Cell]]:
    settings = plan.settings
    given = settings.filters
    finer = f", {plan.finest:g} m where breaklines pass" if plan.finest < plan.width else ""
    own = "" if settings.grid_width else " (from the spacing of the points)"
    adapt = "a quarter of each unit's standard deviation" if settings.adapt is None else f"{settings.adapt:g} m"
    return [
        ["grid width", f"{plan.width:g} m{finer}{own}"],
        ["computing units", f"{plan.layout.side:g} m along a side: {settings.unit_meshes} grid widths"],
        ["grids widened within", "no, all have the finest width" if settings.adapt == 0 else adapt],
        ["covariance family", f"{settings.family}" + (" (the likeliest)" if settings.family == "auto" else "")],
        ["filter values", ", ".join(f"{WORDS[k]} {v:g} m" for k, v in given.items()) or "estimated from the data"],
        ["gross errors", f"beyond {settings.gross:g} standard deviations" if settings.gross else "not sought"],
        ["gaps bridged up to", f"{2 * plan.reach:.4g} m"],
        ["spacing of the points", f"{plan.seen.spacing:.3g} m"],
    ]


def _number(value: int) -> str:
    """With thin spaces between thousands."""
    return f"{value:,}".replace(",", "\u202f")


def _metres(value: float) -> str:
    return f"{value:.3f} m" if np.isfinite(value) else "–"


def _plain(value: float, digits: int = 3, sign: bool = False) -> str:
    if not np.isfinite(value):
        return "–"
    return (f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}").replace("-", "−")


def _time(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.1f} s"
    return f"{int(seconds // 60)} min {seconds % 60:.0f} s"
